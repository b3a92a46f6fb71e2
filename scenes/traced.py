"""Traced light of any press of one sensor, learned from the traced light of many presses.

Light that is not gathered has walked far through the guide and carries the Monte Carlo noise, which in blocks
of pixels is above the camera's (`tests/test_traced.py`). It changes little and smoothly from press to press:
here its maps are a mean plus a few modes, whose amounts are smooth functions (`kriging`) of the leading
principal components of real contact fraction and displacement, of presses without inclusion and of what
inclusions add to them. A picture that takes it (`Renderer.render(traced=...)`) has no noise of its own and is
the same function of the press every time, so that pictures can be compared and differentiated.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import ies, kriging
from .cells import finer
from .sensor import NotModelled, Sensor
from .surface import OpticalSurface

Array = NDArray[np.float64]
Single = NDArray[np.float32]

_STATES, _ADDED = 6, 12  # principal components without inclusion, and of what inclusions add
_DISPLACED = 4.0  # weight of displacements among them, that of contact fractions is 1
_LEADING, _AREAS, _OUTPUTS = 4, 5, 30
"""What lengths are found from: leading maps of the light, areas per side, their principal components."""
_MODES = 40
_STRESS = 3.0  # what inclusions change is so much of what presses change, times as much in the modes
_FEWEST = 40  # presses
_COARSE = 50  # cells per side on which modes are kept, and contact fraction is looked at
_FINE = 100  # on which their mean is
_NARROWEST = 1e-4  # of a kernel: less would be no number by the time it is squared
_BEYOND = 2.0  # how far inputs may leave what was learned, times its reach
FORMAT = "tsis-traced-4"
LIGHT = 15
"""Counts up when pictures of the same press change: what was learned or kept before is of no use then.
9: windows of other LEDs in painted walls, thin sheets that hardly scatter; 10: tissue whose scatterings
favour a direction (see `version`); 11: half the noise, so that pictures and references go together; 12: less
noise of LEDs together, likewise; 13: what tissue gives back under a bent contact, and narrower smoothing, by
which references of light learned before are 0.1 % off; 14: a bulging rim is cut off where it passes the wall,
by which light learned before is up to 0.8 % off beside the rim; 15: learned light on finer cells keeps its
means."""
BIAS_SINCE = 13
"""The first light of which a quality's measured bias holds (`assets/light_bias.json`); later ones' too, as
long as what they change is common to all qualities, or less than the bias is known to."""
PRESSES_SINCE = 14
"""The first light of which presses that were traced to learn from hold; later ones' too, as above."""
ARRAYS = ("centre", "axes", "nodes", "weights", "kernel", "mean", "modes")
"""Fields of `TracedLight` that are arrays."""


@dataclass(frozen=True)
class TracedLight:
    """Weighted irradiance on the contact surface per watt of each LED, as a function of the contact.

    Attributes
    ----------
    key : of the sensor's optics (`optics_key`); light of another is refused.
    centre, axes : (d,) and (d, inputs); inputs of a press are (its description - centre) @ axes, in units of
        the lengths over which light changes.
    nodes : (presses, inputs) of those that were learned.
    weights : (1 + presses, modes) amounts of the modes, of `kriging.Kernel.terms`.
    kernel : (3,) what a `kriging.Kernel` is made of.
    mean : (n_led, layers, m, m), 1/mm².
    modes : (modes, n_led, layers, 50, 50), 1/mm²; at most 1, kept in half precision.
    error_percent : root mean square over the presses, each pair left out in turn, of the error of the leading
        map, all of it together, in per cent; the noise of what was traced is in it.
    """

    key: str
    centre: Array
    axes: Array
    nodes: Array
    weights: Array
    kernel: Array
    mean: Single
    modes: Single
    error_percent: float

    @property
    def presses(self) -> int:
        """How many were learned."""
        return len(self.nodes)

    def at(self, sensor: Sensor, shape: OpticalSurface, fraction: Array, cells: int | None = None) -> Single:
        """Return the traced light of a press, (n_led, layers, g, g) W/mm², in single precision.

        Parameters
        ----------
        fraction : (g, g) real contact fraction on cells, `transport.Ground.fraction`.
        cells : g of the maps, if it is not that of the fraction.

        Raises
        ------
        NotModelled
            For another sensor, and for presses far from those that were learned.
        """
        if optics_key(sensor) != self.key or _in_the_dark(self, sensor):
            raise NotModelled(
                "traced: received light learned of another sensor or by an earlier version; allowed this "
                "sensor's own"
            )
        inputs = (describe(shape, fraction) - self.centre) @ self.axes
        far = float(np.max(np.abs(inputs) / np.abs(self.nodes).max(axis=0)))
        if far > _BEYOND:
            raise NotModelled(
                f"traced: received a press {far:.2g} times as far out as those learned; allowed {_BEYOND:g}"
            )
        kernel = kriging.Kernel(int(self.kernel[0]), *(float(one) for one in self.kernel[1:]))
        amounts = (kernel.terms(inputs[None], self.nodes)[0] @ self.weights).astype(np.float32)
        cells = cells or fraction.shape[0]
        found = finer(self.mean, cells, means=True)
        found += finer(np.tensordot(amounts, self.modes, 1), cells, means=True)
        found *= np.array([led.flux_W for led in sensor.leds], np.float32)[:, None, None, None]
        return found


def version(sensor: Sensor) -> int:
    """Return the last `LIGHT` that changed a sensor's pictures beyond their noise; 9 changed none of polished
    walls without a sheet, 10 none of tissue that scatters evenly, as the light that ships is of."""
    if sensor.skin.sheet is None and sensor.tissue.anisotropy != 0.0:
        return 10
    return 8 if sensor.guide.walls == "polished" and sensor.skin.sheet is None else 9


def optics_key(sensor: Sensor) -> str:
    """Return a hash of all that traced light depends on, but for the press: not the camera, the LEDs' power
    and what the contact fraction says."""
    leds = tuple(replace(led, flux_W=1.0, ies=None) for led in sensor.leds)
    skin = replace(sensor.skin, rms_slope=1.0, kappa=1.0)
    told: tuple[object, ...] = (
        version(sensor),
        sensor.guide,
        sensor.glass,
        leds,
        skin,
        sensor.tissue,
        sensor.wavelength_nm,
    )
    told += (sensor.guide.lower,) if sensor.guide.lower else ()
    told += tuple(ies.digest(led.ies) for led in sensor.leds if led.ies is not None)
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def check(light: Sequence[TracedLight], sensors: Sequence[Sensor]) -> None:
    """Raise `NotModelled` if light was not learned of these sensors, one for each band."""
    keys = [optics_key(sensor) for sensor in sensors]
    if [one.key for one in light] != keys or any(map(_in_the_dark, light, sensors)):
        raise NotModelled(
            "traced: received light learned of another sensor or by an earlier version; allowed this one's "
            "(LED power, camera and rms_slope are free)"
        )


def _in_the_dark(light: TracedLight, sensor: Sensor) -> bool:
    """Whether an LED is lit that was dark in this band where its light was learned."""
    lit = np.array([led.flux_W > 0.0 for led in sensor.leds])
    return bool((lit & ~light.mean.any(axis=(1, 2, 3))).any())


def describe(shape: OpticalSurface, fraction: Array) -> Array:
    """Return what a press looks like, (d,): contact fraction on 50 x 50 cells, displacement in mm on a coarse
    grid."""
    step = max((len(shape.nodes_mm) - 1) // 32, 1)
    moved = shape.displacement_mm[::step, ::step]
    return np.concatenate([_coarse(np.asarray(fraction)).ravel(), moved.ravel()])


def learn(
    sensor: Sensor,
    descriptions: Sequence[NDArray[np.floating]],
    traced: Iterable[NDArray[np.floating]],
) -> TracedLight:
    """Learn from presses of one sensor, in pairs: with an inclusion and without, by the same light paths.

    Parameters
    ----------
    descriptions : (n, d) from `describe`.
    traced : n maps (n_led, layers, g, g), W/mm², `Rendering.traced` of one band; taken one by one.
    """
    n = len(descriptions)
    if n < _FEWEST or n % 2:
        raise ValueError(f"traced: received {n} descriptions; allowed {_FEWEST} or more, in pairs")
    x = np.asarray(descriptions, np.float64)
    centre = x[1::2].mean(axis=0)
    x -= centre
    cells = _COARSE**2
    scale = np.full(x.shape[1], (x[:, cells:] - x[:, cells:].mean(axis=0)).std() / _DISPLACED)
    scale[:cells] = (x[:, :cells] - x[:, :cells].mean(axis=0)).std()
    state = _principal(x[1::2] / scale, _STATES)
    added = (x[::2] - x[1::2]) / scale
    axes = np.concatenate([state, _principal(added - added @ state.T @ state, _ADDED)]).T / scale[:, None]
    flux = np.array([led.flux_W for led in sensor.leds])[:, None, None, None]
    mean, coarse = np.zeros(()), np.zeros((), np.float32)
    for number, maps in zip(range(n), traced, strict=True):
        # an LED that is dark in this band, its light being in another, stands in the way here all the same
        whole = np.asarray(maps, np.float64)
        per_watt = np.divide(whole, flux, out=np.zeros_like(whole), where=flux > 0.0)
        if number == 0:
            fine = min(whole.shape[-1], _FINE)
            mean = np.zeros((*whole.shape[:2], fine, fine))
            coarse = np.empty((n, *whole.shape[:2], _COARSE, _COARSE), np.float32)
        mean += blocks(per_watt, fine) / n
        coarse[number] = blocks(per_watt, _COARSE)
    lengths, kernel, noise = kriging.fit(x @ axes, len(state), _leading(coarse))
    axes = axes / lengths
    nodes = x @ axes
    total = coarse[:, :, 0].sum(axis=(1, 2, 3), dtype=np.float64)
    missed = kriging.left_out(kernel, nodes, (total - total.mean())[:, None], noise)[:, 0] / total
    flat = coarse.reshape(n, -1)
    flat -= flat.mean(axis=0)
    # the maps are many: weights of the presses, then theirs
    weigh = kriging.weights(kernel, nodes, np.eye(n), noise)
    smooth = kernel.terms(nodes, nodes) @ weigh
    told = np.concatenate([smooth[1::2], _STRESS * (smooth[::2] - smooth[1::2])]).astype(np.float32)
    values, vectors = np.linalg.eigh(np.asarray(told @ (flat @ flat.T) @ told.T, np.float64))
    first = np.argsort(values)[::-1][:_MODES]
    first = first[values[first] > 1e-10 * values[first[0]]]
    modes = (vectors[:, first].T.astype(np.float32) @ told) @ flat
    amounts = flat @ modes.T / values[first]
    largest = np.abs(modes).max(axis=1)
    modes /= largest[:, None]
    return TracedLight(
        optics_key(sensor),
        centre,
        axes,
        nodes,
        weigh @ (amounts * largest),
        np.array([kernel.states, kernel.slower, kernel.bend]),
        mean.astype(np.float32),
        modes.astype(np.float16).astype(np.float32).reshape(-1, *coarse.shape[1:]),
        100.0 * float(np.sqrt(np.mean(missed**2))),
    )


def _principal(rows: Array, count: int) -> Array:
    """Directions (count, d) in which rows (n, d) are largest; fewer where they are in fewer."""
    _, size, directions = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(directions[:count][size[:count] > 1e-6 * size[0]])


def _leading(maps: Single) -> Array:
    """What tells of lengths in light (n, n_led, layers, 50, 50), (n, 30): principal components of the leading
    maps' means over areas, which have little noise."""
    areas = blocks(maps[:, :, :_LEADING], _AREAS).reshape(len(maps), -1)
    left, size, _ = np.linalg.svd(areas - areas.mean(axis=0), full_matrices=False)
    return np.asarray(left[:, :_OUTPUTS] * size[:_OUTPUTS])


def save(light: Sequence[TracedLight], path: str | Path) -> None:
    """Write the light of each band as plain arrays; see `load`."""
    arrays: dict[str, NDArray[np.generic]] = {"format": np.array(FORMAT), "bands": np.array(len(light))}
    for number, one in enumerate(light):
        arrays |= {f"{number}.{name}": np.asarray(value) for name, value in vars(one).items()}
        arrays[f"{number}.modes"] = one.modes.astype(np.float16)
    with open(path, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load(path: str | Path) -> tuple[TracedLight, ...]:
    """Read what `save` wrote, one for each band. Raises `NotModelled` for other files, OSError for none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["format"]) != FORMAT:
                raise ValueError
            return tuple(_one(file, number) for number in range(min(int(file["bands"]), 64)))
    except OSError:
        raise
    except Exception:  # whatever a broken archive leads to
        raise NotModelled(
            f"{path}: received no traced light; allowed a file of `twin emulate --light`"
        ) from None


def _one(file: np.lib.npyio.NpzFile, number: int) -> TracedLight:
    arrays = {name: file[f"{number}.{name}"] for name in (*ARRAYS, "error_percent")}
    return assembled(arrays, str(file[f"{number}.key"]), float(arrays["error_percent"]))


def assembled(arrays: Mapping[str, NDArray[np.generic]], key: str, error_percent: float) -> TracedLight:
    """Return learned light from its `ARRAYS` and the rest; raises ValueError where they do not fit."""
    for name in ARRAYS:
        if arrays[name].dtype.kind != "f" or not np.isfinite(arrays[name]).all():
            raise ValueError(name)
    if arrays["axes"].ndim != 2 or not np.isfinite(error_percent):
        raise ValueError("axes, error_percent")
    centre, axes, nodes, weights, kernel = (
        np.asarray(arrays[name], np.float64) for name in ("centre", "axes", "nodes", "weights", "kernel")
    )
    mean, modes = (np.asarray(arrays[name], np.float32) for name in ("mean", "modes"))
    k, m = axes.shape[1], len(modes)
    fits = (
        axes.shape == (len(centre), k)
        and kernel.shape == (3,)
        and kernel[0] in range(1, k)
        and (kernel[1:] > _NARROWEST).all()
        and nodes.shape == (len(nodes), k)
        and (np.abs(nodes).max(axis=0) > 0.0).all()
        and weights.shape == (1 + len(nodes), m)
        and mean.ndim == 4
        and mean.shape[-1] == mean.shape[-2]
        and modes.shape == (m, *mean.shape[:2], _COARSE, _COARSE)
    )
    if not fits:
        raise ValueError("shapes")
    return TracedLight(key, centre, axes, nodes, weights, kernel, mean, modes, error_percent)


def _coarse(cells: Array) -> Array:
    return blocks(cells, _COARSE)


def blocks(cells: NDArray[np.floating], to: int) -> Array:
    """Means over blocks of cells (..., g, g), `to` blocks per side."""
    step = cells.shape[-1] // to
    return np.asarray(cells.reshape(*cells.shape[:-2], to, step, to, step).mean(axis=(-3, -1)))
