"""LED intensities without rendering: light is linear, so the layers of an evaluation hold every setting.

With intensities u (1 is the design's flux) a picture has the mean µ = base + Σ u_k L_k and the slopes
J = Σ u_k ∂L_k, exactly; the weight of a pixel is a function of its mean alone (`estimation.information`),
tabled once for each camera. Fisher's matrix of any setting is then a sum over pixels. LEDs may also shine one
after the other, a picture each. What to set them to: `lamp_settings`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.information import Information, Noise, fisher, mean_variance, pixel_information
from twin.evaluate import noises_of

if TYPE_CHECKING:
    from twin.evaluate import Evaluation, Judged

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

WANTED = ("size_mm", "depth_mm", "modulus_kPa")
_SPARE = 4.0  # standard deviations of noise between a picture's brightest pixel and the end of the range
_STEPS = 64  # entries of the weights' table per standard deviation of the least noise, or per count
_MEMORY = 1e6  # numbers at a time, which stay in the cache
_THREADS = 2


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture, flat: n pixels, and r of the unknowns, which are all that it depends on.

    Attributes
    ----------
    layers : (n_led, n) counts of each LED at the design's flux, without offset.
    slopes : (n_led + 1, r, n) of the layers, and of what does not follow the light, by combinations of the
        unknowns that the design's own setting tells apart equally well: in single precision nothing is lost.
    mixing : (p, r) back to the unknowns: F = mixing F' mixingᵀ.
    dark : (n,) counts with all LEDs off: offset, dark current, ambient light.
    noise, top : of the camera; counts at which it is full.
    """

    layers: Singles
    slopes: Singles
    mixing: Floats
    dark: Floats
    noise: Noise
    top: float


@dataclass(frozen=True)
class Lamps:
    """What re-weighting needs of one inclusion: its pictures, fluxes (n_led,) of the design, W, and the
    unknowns' names with what was known before, (p, p)."""

    pictures: tuple[Picture, ...]
    flux_W: Floats
    names: tuple[str, ...]
    prior: Floats

    @property
    def count(self) -> int:
        """Number of LEDs."""
        return len(self.flux_W)


def lamps_of(evaluation: Evaluation) -> tuple[Lamps, ...]:
    """Return the lamps of each inclusion of an evaluation that kept the slopes of its layers.

    Raises
    ------
    ValueError
        Where they were not kept, or a slope is neither of the light nor of the camera behind it.
    """
    noise, reference = noises_of(evaluation.camera, evaluation.block, evaluation.layout.protocol)
    camera = evaluation.camera.camera
    well = camera.offset_dn + camera.full_well_e / camera.gain_e_per_dn
    top = min(well, 2**camera.bits - 1)
    flux = [led.flux_W for led in evaluation.layout.design.leds]
    found: list[Lamps] = []
    for judged in evaluation.judged:
        before = found[-1].pictures if found else ()
        found.append(lamps(judged, noise=noise, reference=reference, top=top, flux_W=flux, known=before))
    return tuple(found)


def lamps(
    judged: Judged,
    *,
    noise: Noise,
    reference: Noise,
    top: float,
    flux_W: ArrayLike,
    known: Sequence[Picture] = (),
) -> Lamps:
    """Return the lamps of one inclusion; ``noise`` is of pictures, ``reference`` of those behind each.

    References that are the same as `known` ones are taken from there: `bounds` computes them once.
    """
    if judged.layer_jacobian is None:
        raise ValueError("layer_jacobian: received none; allowed evaluations that keep it")
    pictures = []
    for k in range(len(judged.mean)):
        if k % 2 and k < len(known) and np.array_equal(known[k].layers, _flat(judged.layers[k], 1)):
            pictures.append(known[k])
        else:
            pictures.append(_picture(judged, k, reference if k % 2 else noise, top))
    flux = np.asarray(flux_W, np.float64)
    return Lamps(tuple(pictures), flux, judged.names, judged.information.prior)


def _picture(judged: Judged, k: int, noise: Noise, top: float) -> Picture:
    """One picture of those that were judged; what the camera does after the light goes with light or not."""
    assert judged.layer_jacobian is not None
    layers, mean = _flat(judged.layers[k], 1).astype(np.float64), judged.mean[k].ravel().astype(np.float64)
    slopes = _flat(judged.layer_jacobian[:, k], 2).astype(np.float64)
    whole = _flat(judged.jacobian[:, k], 1).astype(np.float64)
    light, seen = layers.sum(axis=0), mean < top
    if not seen.any():
        raise ValueError("mean: received a picture that is full everywhere; allowed pictures with light")
    dark = np.where(seen, mean - light, np.median((mean - light)[seen]))
    basis = np.column_stack([light, np.ones(light.shape)])[seen]
    rest = (whole - slopes.sum(axis=1))[:, seen]
    gain, shift = np.linalg.lstsq(basis, rest.T, rcond=None)[0]
    left = np.linalg.norm(rest.T - basis @ np.stack([gain, shift]), axis=0)
    for name, off, size in zip(judged.names, left, np.linalg.norm(whole[:, seen], axis=1), strict=True):
        if off > 0.01 * size + 1e-9:
            raise ValueError(
                f"{name}: received a slope of which the layers hold {100 * (1 - off / size):.0f} %; "
                "allowed what light or the camera's gain and offset explain within 1 %"
            )
    slopes = slopes + gain[:, None, None] * layers
    each = np.concatenate(
        [slopes, np.broadcast_to(shift[:, None, None], (len(whole), 1, len(light)))], axis=1
    )
    rows = np.flatnonzero(np.abs(each).max(axis=(1, 2)) > 0)
    each = each[rows]
    told = fisher(each.sum(axis=1), pixel_information(np.minimum(mean, top), noise) * seen)
    told += judged.information.prior[np.ix_(rows, rows)]
    scale = np.sqrt(np.diag(told))
    root = np.linalg.cholesky(told / np.outer(scale, scale)) * scale[:, None]
    mixing = np.zeros((len(whole), len(rows)))
    mixing[rows] = root
    mixed = np.linalg.solve(root, each.reshape(len(rows), -1)).reshape(each.shape)
    mixed = np.ascontiguousarray(np.moveaxis(mixed, 1, 0), np.float32)
    return Picture(layers.astype(np.float32), mixed, mixing, dark, noise, float(top))


def fishers(lamps: Lamps, intensity: ArrayLike, *, sequential: bool = False) -> Floats:
    """Return Fisher's matrix (s, p, p) of each setting (s, n_led), all LEDs at once or one after the other.

    One after the other, there are n_led pictures for each picture, every one with the protocol's frames.
    """
    settings = _settings(intensity, lamps.count)
    return np.asarray(sum(_told(picture, settings, sequential) for picture in lamps.pictures))


def _told(picture: Picture, settings: Floats, sequential: bool) -> Floats:
    """Fisher's matrix (s, p, p) of one picture at each setting."""
    if sequential:
        alone = [settings * (np.arange(settings.shape[1]) == k) for k in range(settings.shape[1])]
        return np.asarray(sum(_told(picture, one, False) for one in alone))
    lit, r, n = picture.slopes.shape
    slopes, table = picture.slopes.reshape(lit, r * n), _Weights.of(picture.noise, picture.top)
    found = np.empty((len(settings), r, r))
    for some in _parts(len(settings), r * n):
        now = np.column_stack([settings[some], np.ones(some.stop - some.start)]).astype(np.float32)
        jacobian = (now @ slopes).reshape(-1, r, n)
        jacobian *= table(now[:, :-1] @ picture.layers + picture.dark)[:, None]
        # single precision would lose what other settings tell least of: variances could come out negative
        double = jacobian.astype(np.float64)
        np.matmul(double, double.transpose(0, 2, 1), out=found[some])
    return np.asarray(picture.mixing @ found @ picture.mixing.T)


def bounds(
    lamps: Sequence[Lamps],
    intensity: ArrayLike,
    wanted: Sequence[str] = WANTED,
    *,
    sequential: bool = False,
    times: float = 1.0,
) -> Floats:
    """Return prior-included bounds (s, inclusions, w) of the wanted unknowns at each setting (s, n_led).

    With so many `times` the protocol's exposures: what a sequence of all LEDs is compared with.
    """
    settings = _settings(intensity, lamps[0].count)
    every = {id(picture): picture for one in lamps for picture in one.pictures}
    with ThreadPoolExecutor(_THREADS) as pool:  # numpy lets go of the interpreter
        told = dict(
            zip(every, pool.map(lambda one: _told(one, settings, sequential), every.values()), strict=True)
        )
    found = []
    for one in lamps:
        place = Information(one.names, one.prior, one.prior).index(wanted)
        total = times * np.sum([told[id(picture)] for picture in one.pictures], axis=0) + one.prior
        unit = 1.0 / np.sqrt(np.diagonal(total, axis1=1, axis2=2))
        scaled = total * unit[:, :, None] * unit[:, None, :]
        variance = np.diagonal(np.linalg.inv(scaled), axis1=1, axis2=2) * unit**2
        found.append(np.sqrt(variance[:, place]))
    return np.stack(found, axis=1)


def worth(sd: Floats) -> Floats:
    """Return one figure (s,) of bounds (s, inclusions, w): smaller is better, whatever the units."""
    return np.asarray(np.exp(np.log(np.sqrt((sd**2).mean(axis=1))).mean(axis=1)))


def fullness(lamps: Sequence[Lamps], intensity: ArrayLike, *, sequential: bool = False) -> Floats:
    """Return how full the brightest pixel of each setting (s, n_led) is; above 1 some noise is clipped."""
    settings = np.atleast_2d(np.asarray(intensity, np.float64))
    if sequential:
        alone = [
            fullness(lamps, settings * (np.arange(settings.shape[1]) == k)) for k in range(lamps[0].count)
        ]
        return np.asarray(np.max(alone, axis=0))
    found = np.zeros(len(settings))
    for picture in {id(each): each for one in lamps for each in one.pictures}.values():
        spare = _SPARE * float(np.sqrt(mean_variance(picture.top, picture.noise)))
        share = picture.layers / np.maximum(picture.top - spare - picture.dark, 1e-9).astype(np.float32)
        for some in _parts(len(settings), share.shape[1]):
            brightest = (settings[some].astype(np.float32) @ share).max(axis=1)
            found[some] = np.maximum(found[some], brightest)
    return found


@dataclass(frozen=True)
class _Weights:
    """Root of a count's information over its mean, evenly tabled from the offset; 0 where it is full."""

    start: float
    step: float
    values: Singles

    @staticmethod
    @lru_cache(maxsize=16)
    def of(noise: Noise, top: float) -> _Weights:
        step = min(max(noise.read_dn, 0.05), 1.0) / _STEPS
        mean = np.arange(noise.offset_dn, max(top, noise.offset_dn + step), step)
        root = np.sqrt(np.append(pixel_information(mean, noise), [0.0, 0.0]))
        return _Weights(noise.offset_dn, step, root.astype(np.float32))

    def __call__(self, mean: Floats) -> Singles:
        place = np.clip((mean - self.start) * (1.0 / self.step), 0.0, len(self.values) - 2).astype(np.float32)
        whole = place.astype(np.int32)
        low = self.values[whole]
        return np.asarray(low + (self.values[whole + 1] - low) * (place - whole).astype(np.float32))


def _settings(intensity: ArrayLike, count: int) -> Floats:
    settings = np.atleast_2d(np.asarray(intensity, np.float64))
    if settings.ndim != 2 or settings.shape[1] != count or not (settings >= 0).all():
        raise ValueError(
            f"intensity: received shape {settings.shape}, least {settings.min():g}; "
            f"allowed (settings, {count}) of numbers >= 0"
        )
    return settings


def _flat(array: Any, kept: int) -> Any:
    return array.reshape(*array.shape[:kept], -1)


def _parts(count: int, each: int) -> Iterator[slice]:
    step = max(1, int(_MEMORY / each))
    yield from (slice(start, min(start + step, count)) for start in range(0, count, step))
