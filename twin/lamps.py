"""LED intensities without rendering: light is linear, so the layers of an evaluation hold every setting.

With intensities u (1 is the design's flux) a picture has the mean µ = base + Σ u_k L_k and the slopes
J = Σ u_k ∂L_k, exactly; the weight of a pixel is a function of its mean alone (`estimation.information`),
tabled once for each camera. Fisher's matrix of any setting is then a sum over pixels. LEDs may also shine one
after the other, a picture each.

    best = optimise(lamps_of(evaluation), power_W=0.08)
    best.intensity, best.worth, best.before
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.information import Information, Noise, bound, mean_variance, pixel_information
from twin.complaint import DesignError, shown
from twin.forward import noise_of

if TYPE_CHECKING:
    from twin.evaluate import Evaluation, Judged

Floats = NDArray[np.float64]

WANTED = ("size_mm", "depth_mm", "modulus_kPa")
_SPARE = 4.0  # standard deviations of noise between a picture's brightest pixel and the end of the range
_STEPS = 64  # entries of the weights' table per standard deviation of the least noise, or per count
_MEMORY = 4e6  # numbers at a time
_SUBSETS = 6  # LEDs at most of which every combination is tried
_CLOUD, _ROUNDS = 160, 7


@dataclass(frozen=True)
class Lamps:
    """What re-weighting needs of the pictures of one inclusion; n pixels, p unknowns, k pictures.

    Attributes
    ----------
    layers : (k, n_led, n) counts of each LED at the design's flux, without offset.
    slopes : (p, k, n_led, n) of the layers, per unit of each unknown.
    gains, shifts : (p, k) of what the camera does after the light: that much of the light, and counts.
    noises : of each picture; their offset is what the camera gives without light.
    top : counts at which pictures are full.
    flux_W : (n_led,) of the design.
    block : true pixels that each pixel stands for.
    names, prior : of the unknowns, and what was known before (p, p).
    """

    layers: Floats
    slopes: Floats
    gains: Floats
    shifts: Floats
    noises: tuple[Noise, ...]
    top: float
    flux_W: Floats
    block: float
    names: tuple[str, ...]
    prior: Floats

    @property
    def count(self) -> int:
        """Number of LEDs."""
        return self.layers.shape[1]


@dataclass(frozen=True)
class Setting:
    """Intensities and what they are worth.

    Attributes
    ----------
    intensity : (n_led,) times the design's flux.
    sd : (inclusions, w) prior-included bounds of the wanted unknowns.
    worth : geometric mean over the wanted of their bounds' root mean square over inclusions.
    power_W : of all LEDs together.
    full : the brightest pixel's mean over the greatest that is allowed; 1 is at the limit.
    """

    intensity: Floats
    sd: Floats
    worth: float
    power_W: float
    full: float


@dataclass(frozen=True)
class Optimum:
    """The best setting found, the design's own, and whether LEDs shine one after the other."""

    best: Setting
    before: Setting
    wanted: tuple[str, ...]
    sequential: bool


def lamps_of(evaluation: Evaluation) -> tuple[Lamps, ...]:
    """Return the lamps of each inclusion of an evaluation that kept the slopes of its layers.

    Raises
    ------
    ValueError
        Where they were not kept, or a slope is neither of the light nor of the camera behind it.
    """
    frames = evaluation.layout.protocol.frames
    return tuple(
        lamps(
            judged,
            noise=noise_of(evaluation.camera, frames),
            reference=noise_of(evaluation.camera, max(frames, 16)),
            top=_top(evaluation),
            flux_W=[led.flux_W for led in evaluation.layout.design.leds],
            block=evaluation.block,
        )
        for judged in evaluation.judged
    )


def lamps(
    judged: Judged, *, noise: Noise, reference: Noise, top: float, flux_W: ArrayLike, block: float = 1.0
) -> Lamps:
    """Return the lamps of one inclusion; arguments as the attributes of `Lamps`.

    ``noise`` is that of pictures, ``reference`` that of the references that stand behind each.
    """
    if judged.layer_jacobian is None:
        raise ValueError("layer_jacobian: received none; allowed evaluations that keep it")
    pictures, leds = judged.layers.shape[:2]
    layers = judged.layers.reshape(pictures, leds, -1).astype(np.float64)
    slopes = judged.layer_jacobian.reshape(len(judged.names), pictures, leds, -1).astype(np.float64)
    rest = judged.jacobian.reshape(len(judged.names), pictures, -1) - slopes.sum(axis=2)
    gains, shifts = np.zeros((2, len(judged.names), pictures))
    light = layers.sum(axis=1)
    for k in range(pictures):
        basis = np.column_stack([light[k], np.ones(light.shape[1])])
        found = np.linalg.lstsq(basis, rest[:, k].T, rcond=None)[0]
        size = np.linalg.norm(judged.jacobian.reshape(len(judged.names), pictures, -1)[:, k], axis=1)
        left = np.linalg.norm(rest[:, k].T - basis @ found, axis=0)
        for name, off, whole in zip(judged.names, left, size, strict=True):
            if off > 0.01 * whole + 1e-9:
                raise ValueError(
                    f"{name}: received a slope of which the layers hold {100 * (1 - off / whole):.0f} %; "
                    "allowed what light or the camera's gain and offset explain within 1 %"
                )
        gains[:, k], shifts[:, k] = found
    noises = tuple(reference if number % 2 else noise for number in range(pictures))
    flux = np.asarray(flux_W, np.float64)
    return Lamps(
        layers,
        slopes,
        gains,
        shifts,
        noises,
        float(top),
        flux,
        block,
        judged.names,
        judged.information.prior,
    )


def fishers(lamps: Lamps, intensity: ArrayLike, *, sequential: bool = False) -> Floats:
    """Return Fisher's matrix (s, p, p) of each setting (s, n_led), all LEDs at once or one after the other.

    One after the other, there are n_led pictures for each picture, every one with the protocol's frames.
    """
    settings = np.atleast_2d(np.asarray(intensity, np.float64))
    if settings.ndim != 2 or settings.shape[1] != lamps.count or not (settings >= 0).all():
        raise ValueError(
            f"intensity: received shape {settings.shape}, least {settings.min():g}; "
            f"allowed (settings, {lamps.count}) of numbers >= 0"
        )
    if sequential:
        alone = [settings * (np.arange(lamps.count) == k) for k in range(lamps.count)]
        return np.asarray(sum(fishers(lamps, one) for one in alone))
    p, pictures, n_led, n = lamps.slopes.shape
    found = np.zeros((len(settings), p, p))
    for k in range(pictures):
        table = _Weights.of(lamps.noises[k], lamps.top)
        slopes = np.ascontiguousarray(np.moveaxis(lamps.slopes[:, k], 1, 0)).reshape(n_led, p * n)
        for some in _parts(len(settings), p * n):
            light = settings[some] @ lamps.layers[k]
            jacobian = (settings[some] @ slopes).reshape(-1, p, n)
            for row in np.flatnonzero(lamps.gains[:, k]):
                jacobian[:, row] += lamps.gains[row, k] * light
            jacobian += lamps.shifts[:, k, None]
            weighed = jacobian * np.sqrt(table(light))[:, None]
            found[some] += weighed @ weighed.transpose(0, 2, 1)
    return lamps.block * found


def bounds(
    lamps: Sequence[Lamps],
    intensity: ArrayLike,
    wanted: Sequence[str] = WANTED,
    *,
    sequential: bool = False,
) -> Floats:
    """Return prior-included bounds (s, inclusions, w) of the wanted unknowns at each setting (s, n_led)."""
    found = []
    for one in lamps:
        place = Information(one.names, one.prior, one.prior).index(wanted)
        total = fishers(one, intensity, sequential=sequential) + one.prior
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
        alone = [fullness(lamps, settings * (np.arange(settings.shape[1]) == k)) for k in range(lamps[0].count)]
        return np.asarray(np.max(alone, axis=0))
    found = np.zeros(len(settings))
    for one in lamps:
        for k, noise in enumerate(one.noises):
            room = one.top - noise.offset_dn
            room -= _SPARE * float(np.sqrt(mean_variance(one.top, noise)))
            for some in _parts(len(settings), one.layers.shape[2]):
                brightest = (settings[some] @ one.layers[k]).max(axis=1)
                found[some] = np.maximum(found[some], brightest / max(room, 1e-9))
    return found


def setting(
    lamps: Sequence[Lamps],
    intensity: ArrayLike,
    wanted: Sequence[str] = WANTED,
    *,
    sequential: bool = False,
) -> Setting:
    """Return what one setting (n_led,) is worth."""
    at = np.asarray(intensity, np.float64)
    sd = bounds(lamps, at, wanted, sequential=sequential)
    power = at * lamps[0].flux_W
    return Setting(
        at,
        sd[0],
        float(worth(sd)[0]),
        float(power.max() if sequential else power.sum()),
        float(fullness(lamps, at, sequential=sequential)[0]),
    )


def optimise(
    lamps: Sequence[Lamps],
    wanted: Sequence[str] = WANTED,
    *,
    power_W: float | None = None,
    sequential: bool = False,
    seed: int = 0,
) -> Optimum:
    """Return the intensities that tell most under a power limit and without saturation.

    More light never hurts below saturation, so only the shares are searched: every setting is as bright as
    the limits let it be. First each combination of LEDs that shine alike, then rounds of a shrinking cloud
    about the best.

    Parameters
    ----------
    power_W : of the LEDs that shine at once; that of the design where not given.
    sequential : LEDs shine one after the other; each is then as bright as it may be, and nothing is searched.
    """
    given, n_led = lamps[0], lamps[0].count
    limit = float(given.flux_W.sum()) if power_W is None else power_W
    if not 0 < limit < np.inf:
        raise DesignError("power_W", shown(power_W), "a number > 0")
    before = setting(lamps, np.ones(n_led), wanted)
    if sequential:
        alone = np.eye(n_led) * limit / given.flux_W
        each = np.diag(alone / np.maximum(fullness(lamps, alone), 1.0)[:, None])
        return Optimum(setting(lamps, each, wanted, sequential=True), before, tuple(wanted), True)

    def bright(shares: Floats) -> Floats:
        full = shares * (limit / (shares @ given.flux_W))[:, None]
        return np.asarray(full / np.maximum(fullness(lamps, full), 1.0)[:, None])

    rng = np.random.Generator(np.random.PCG64(seed))
    shares = np.concatenate([_combinations(n_led), rng.dirichlet(np.ones(n_led), _CLOUD)])
    best, least = shares[0], np.inf
    for number in range(_ROUNDS + 1):
        found = worth(bounds(lamps, bright(shares), wanted))
        if found.min() < least:
            best, least = shares[found.argmin()], float(found.min())
        width = 0.8 * 0.5**number
        # dark LEDs of the best may come back, lit ones go dark: logarithms alone never cross zero
        woken = 0.1 * best.max() * (rng.random((_CLOUD, n_led)) < 0.2)
        kept = rng.random((_CLOUD, n_led)) > 0.05
        kept[:, best.argmax()] = True
        shares = np.maximum(best, woken) * kept * np.exp(width * rng.standard_normal((_CLOUD, n_led)))
    return Optimum(setting(lamps, bright(best[None])[0], wanted), before, tuple(wanted), False)


def failures(lamps: Sequence[Lamps], intensity: ArrayLike, wanted: Sequence[str] = WANTED) -> Floats:
    """Return bounds (n_led, inclusions, w) with each LED dark in turn, the others as they were."""
    at = np.asarray(intensity, np.float64)
    return bounds(lamps, at * (1.0 - np.eye(len(at))), wanted)


def binning(
    lamps: Sequence[Lamps],
    intensity: ArrayLike,
    tolerance: float = 0.1,
    wanted: Sequence[str] = WANTED,
    *,
    draws: int = 200,
    seed: int = 0,
) -> Floats:
    """Return bounds (draws, inclusions, w) of sensors whose LEDs differ from the nominal flux.

    Fluxes are even within ± `tolerance` of their own, as in a bin of a maker's; each sensor's are known.
    """
    if not 0 <= tolerance < 1:
        raise DesignError("tolerance", shown(tolerance), "at least 0 and below 1")
    at = np.asarray(intensity, np.float64)
    rng = np.random.Generator(np.random.PCG64(seed))
    return bounds(lamps, at * rng.uniform(1 - tolerance, 1 + tolerance, (draws, len(at))), wanted)


@dataclass(frozen=True)
class _Weights:
    """Information of one count over its light, evenly tabled; none where pictures are full."""

    step: float
    values: Floats

    @staticmethod
    @lru_cache(maxsize=16)
    def of(noise: Noise, top: float) -> _Weights:
        least = min(max(noise.read_dn, 0.05), 1.0)
        step = least / _STEPS
        light = np.arange(0.0, max(top - noise.offset_dn, step), step)
        return _Weights(step, np.append(pixel_information(light + noise.offset_dn, noise), [0.0, 0.0]))

    def __call__(self, light: Floats) -> Floats:
        place = np.minimum(light * (1.0 / self.step), len(self.values) - 2)
        whole = place.astype(np.intp)
        part = place - whole
        return np.asarray(self.values[whole] * (1.0 - part) + self.values[whole + 1] * part)


def _top(evaluation: Evaluation) -> float:
    """Counts at which a pixel is full: the converter's last or the full well's."""
    camera = evaluation.camera.camera
    well = camera.offset_dn + camera.full_well_e * camera.binning**2 / camera.gain_e_per_dn
    return float(min(well, 2**camera.bits - 1))


def _parts(count: int, each: int) -> Iterator[slice]:
    step = max(1, int(_MEMORY / each))
    yield from (slice(start, min(start + step, count)) for start in range(0, count, step))


def _combinations(count: int) -> Floats:
    """Shares (m, count) of LEDs that shine alike: all of them, each left out; every combination of few."""
    if count > _SUBSETS:
        return np.concatenate([np.ones((1, count)), 1.0 - np.eye(count), np.eye(count)])
    numbers = np.arange(2**count - 1, 0, -1)
    return ((numbers[:, None] >> np.arange(count)) & 1).astype(np.float64)


def scaled(lamps: Lamps, frames: int) -> Lamps:
    """The same lamps with so many averaged frames of each picture; references have at least 16."""
    noises = tuple(
        replace(noise, frames=max(frames, 16) if number % 2 else frames)
        for number, noise in enumerate(lamps.noises)
    )
    return replace(lamps, noises=noises)
