"""The sensor doctor: where the light goes, how the camera is exposed, and what a standard inclusion adds.

Everything is measured on one press at preview quality: untouched, on plain tissue, and on the standard
inclusion. `twin.findings` turns what is measured into advice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

import fem
from scenes.sensor import NotModelled
from twin import presses
from twin.complaint import DesignError
from twin.conflicts import colourless
from twin.design import Design
from twin.exposure import saturated_percent
from twin.frame import grey
from twin.simulation import Device

if TYPE_CHECKING:
    import pyvista as pv

    from fem import Press
    from scenes import Rendering
    from scenes.paths import Paths

STANDARD = fem.Inclusion(size=10.0, depth=5.0, modulus=100.0)
"""The inclusion that every sensor is asked to see."""

FILL = 0.8
"""Share of the counts' range that the advised exposure fills with all but the brightest 0.1 % of pixels."""

_BRIGHTEST = 0.1  # per cent of the pixels that the advised exposure may saturate
_SPOTS = 3.0  # pixels of an LED's spot, with its edge and mirror image, over those that look straight at it
_LIGHT_PATHS = 2**17  # per LED, for the balance; the other pictures take half of them
_MORE = 4  # times as many, where the balance is off by more than
_ROUGH_PERCENT = 0.15
_SAMPLE_PATHS = 2**12  # per LED, recorded
_PLACE_MM = 0.5
_NOISE_FRAMES, _NOISE_REACH = 32, 7  # pictures, and pixels about the signal, that tell the camera's noise

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Exposure:
    """One picture's counts without noise: brightest and mean, and the share of full pixels in one frame."""

    brightest_dn: float
    mean_dn: float
    saturated_percent: float


@dataclass(frozen=True)
class Signal:
    """What the standard inclusion adds to the picture.

    ``counts`` is the 3 x 3 mean of the tared picture where that is brightest; ``noise_dn`` the standard
    deviation of one pixel's noise there, in one frame; ``at_px`` its row and column.
    """

    counts: float
    noise_dn: float
    at_px: tuple[int, int]

    @property
    def over_noise(self) -> float:
        """Signal over the noise of one pixel in one frame."""
        return self.counts / self.noise_dn


@dataclass(frozen=True, eq=False)
class Checkup:
    """What was measured; ``None`` where this press or inclusion could not be computed.

    Light is per cent of what the LEDs emit, (n_led,) for each; exposures and signal are of all LEDs together.
    """

    design: Design
    indentation_mm: float
    emitted_W: Array
    sinks: dict[str, Array]
    """Where light ends, as `scenes.trace.SINKS` names it."""
    first: dict[str, Array]
    """What happens first: ``missed`` never enters the guide; ``trapped`` and ``leaked`` come to the contact
    surface beyond and within the critical angle to the gaps; ``elsewhere`` never comes to it."""
    detected: Array
    """Through the lens onto the pixels: a part of what leaves below; 0 of what the camera is blind to."""
    response: Array
    """What the camera makes of each LED's light, over light that it sees best."""
    lit_percent: Array
    """Share of the picture's light above black that each LED gives."""
    in_sight_percent: Array
    """Share of the pixels that look straight into each LED."""
    light_is_pressed: bool
    """Whether the light was followed under the press, or only through the untouched sensor."""
    background: Exposure
    blank: Exposure | None
    standard: Exposure | None
    signal: Signal | None
    advised_exposure_ms: float | None
    """None where no light reaches the camera."""
    rim_mm: float | None
    """Lowest height of the pressed contact surface."""
    noise_percent: float
    """Monte Carlo noise of the pictures, per cent of their mean (rms)."""
    uniformity: float
    """Brightest over darkest hundredth of the light on plain tissue (untouched where there is no press)."""
    from_housing_percent: float = 0.0
    """Of the picture's light, what is a white housing, mirrored in glass and contact."""
    failures: tuple[str, ...] = ()
    """One line for each thing that could not be computed."""
    paths: Paths | None = field(default=None, repr=False)
    height_mm: Array | None = field(default=None, repr=False)
    """(n, n) height of the contact surface on a regular grid of the guide's face, as the paths met it."""

    @property
    def closure_percent(self) -> Array:
        """Sum of all sinks minus what was emitted, per cent of the latter, for each LED."""
        return np.asarray(np.sum(list(self.sinks.values()), axis=0) - 100.0 * (self.emitted_W > 0))

    @property
    def spots_percent(self) -> float:
        """About the share of the pixels that the spots of LEDs in sight take."""
        return _SPOTS * float(self.in_sight_percent.sum())

    def together(self, share: Array) -> float:
        """A share of the LEDs, weighted with their flux."""
        total = float(self.emitted_W.sum())
        return float(np.dot(share, self.emitted_W) / total) if total else 0.0


def check_up(
    design: Design,
    indentation: float | None = None,
    *,
    seed: int = 0,
    device: Device = "auto",
    progress: Progress | None = None,
) -> Checkup:
    """Measure a design.

    Parameters
    ----------
    indentation : depth of the press, mm; by default the deepest of the design.
    progress : called with the stage that runs and the share of all work that is done.

    Raises
    ------
    DesignError, scenes.backend.BackendError
        The depth is out of reach, or light cannot be computed on this device.
    """
    depth = max(design.press.indentation_mm) if indentation is None else indentation
    design.check_indentation(depth)
    colourless(design, "a check")
    tell = progress or (lambda stage, done: None)
    tell("setting up", 0.0)
    from scenes import SpectralRenderer

    # one band for each spectrum: shares and counts change by a per cent or two with more
    renderer = SpectralRenderer(design.sensor(), count=1, at=design.sensor, device=device)
    failures: list[str] = []
    tell("mechanics", 0.15)
    press, has_inclusion = _press(design, depth, failures)
    tell("light untouched", 0.25)
    from scenes import paths, surface

    hovering = untouched(design)
    emitted = np.array([led.flux_W for led in design.leds])

    def balanced(surface: pv.PolyData, field: str = "pressure") -> Rendering:
        found = renderer.render(surface, field=field, quality="preview", seed=seed, samples=_LIGHT_PATHS)
        if np.abs(_off(found, emitted)).max() > _ROUGH_PERCENT:
            more = _MORE * _LIGHT_PATHS
            found = renderer.render(surface, field=field, quality="preview", seed=seed, samples=more)
        return found

    background = renderer.render(hovering, quality="preview", seed=seed, samples=_LIGHT_PATHS // 2)
    blank = standard = None
    followed = hovering
    rim = None
    if press is not None:
        tell("light under the press", 0.4)
        pressed = surface.resample(press.surface, design.waveguide.width_mm, suffix="_0")
        rim = float((pressed.rest_mm + pressed.displacement_mm[..., 2]).min())
        try:
            if has_inclusion:
                standard = renderer.render(
                    press.surface, quality="preview", seed=seed, samples=_LIGHT_PATHS // 2
                )
            tell("light under the press", 0.55)
            blank = balanced(press.surface, "pressure_0")
            followed = press.surface
        except NotModelled as error:
            failures.append(str(error))
            standard = None
    if blank is None:
        background = balanced(hovering)
    lit = blank or background
    tell("sample paths", 0.75)
    whole = renderer.whole
    if whole not in renderer.renderers:  # its surface is still untouched
        whole.render(followed, field="pressure_0" if followed is not hovering else "pressure", samples=2)
    recorded = paths.from_leds(whole.scene, whole.sensor, whole.table, _SAMPLE_PATHS, seed)
    shape = surface.resample(
        followed, design.waveguide.width_mm, suffix="_0" if followed is not hovering else "", nodes=65
    )
    tell("camera", 0.9)
    found = _signal(design, standard, blank, seed) if standard and blank else None
    in_sight = 100.0 * paths.in_sight(whole.scene, whole.sensor, whole.rays)
    checkup = Checkup(
        design=design,
        indentation_mm=depth,
        emitted_W=emitted,
        sinks=_sinks(lit, emitted),
        first=_first(design, lit, recorded, emitted),
        detected=_detected(design, lit, emitted, renderer.response),
        response=renderer.response,
        lit_percent=_shares(lit),
        in_sight_percent=in_sight,
        light_is_pressed=blank is not None,
        background=_exposure(design, background, seed),
        blank=_exposure(design, blank, seed) if blank else None,
        standard=_exposure(design, standard, seed) if standard else None,
        signal=found,
        advised_exposure_ms=_advised(design, standard or lit, in_sight),
        rim_mm=rim,
        noise_percent=lit.noise_percent,
        uniformity=_uniformity(lit),
        from_housing_percent=lit.from_housing_percent,
        failures=tuple(failures),
        paths=recorded,
        height_mm=shape.rest_mm + shape.displacement_mm[..., 2],
    )
    tell("camera", 1.0)
    return checkup


def _press(design: Design, depth: float, failures: list[str]) -> tuple[Press | None, bool]:
    """The press on the standard inclusion, or on plain tissue where that one cannot be; and which it is."""
    for inclusion in (STANDARD, None):
        try:
            presses.check(design, inclusion, [depth])
            (press,) = presses.solved(design, inclusion, [depth], quality="preview", estimate=False)
            return press, inclusion is not None
        except (DesignError, fem.NotModelled, fem.NotConverged) as error:
            failures.append(str(error))
    return None, False


def untouched(design: Design) -> pv.PolyData:
    """The contact surface before anything touches it, as `Renderer.render` takes it: no pressure at all."""
    import pyvista as pv

    guide = design.waveguide
    line = np.linspace(-guide.width_mm / 2, guide.width_mm / 2, 65)
    x, y = (part.ravel() for part in np.meshgrid(line, line))
    radius, z = guide.dome_radius_mm, np.zeros(x.size)
    if radius is not None:
        z = np.sqrt(radius**2 - x**2 - y**2) - radius
    surface = pv.PolyData(np.column_stack([x, y, z]))
    surface.point_data["displacement"] = np.zeros((x.size, 3))
    surface.point_data["pressure"] = np.zeros(x.size)
    return surface


def _percent(watt: Array, emitted: Array) -> Array:
    """Of each LED's flux; 0 for an LED that is off."""
    return np.asarray(100.0 * np.divide(watt, emitted, out=np.zeros_like(emitted), where=emitted > 0))


def _sinks(rendering: Rendering, emitted: Array) -> dict[str, Array]:
    from scenes.trace import SINKS

    assert rendering.sinks is not None
    return {name: _percent(rendering.sinks[:, k], emitted) for k, name in enumerate(SINKS)}


def _off(rendering: Rendering, emitted: Array) -> Array:
    """Sum of each LED's sinks minus what it emits, per cent of the latter; 0 for one that is off."""
    return np.asarray(np.sum(list(_sinks(rendering, emitted).values()), axis=0) - 100.0 * (emitted > 0))


def _first(design: Design, rendering: Rendering, paths: Paths, emitted: Array) -> dict[str, Array]:
    """First events: the trapped share from all light paths, the rest from the recorded ones."""
    assert rendering.trapped is not None
    guide = design.guide().refractive_index
    critical = np.sqrt(max(1.0 - (design.surface.gap_index / guide) ** 2, 0.0))
    n_led = emitted.size

    def share(which: NDArray[np.bool_]) -> Array:
        return np.asarray(100.0 * which.reshape(n_led, -1).mean(axis=1))

    trapped = _percent(rendering.trapped, emitted)
    missed, leaked = share(~paths.entered), share(paths.first_cosine >= critical)
    on = emitted > 0
    first = {"missed": missed * on, "trapped": trapped, "leaked": leaked * on}
    first["elsewhere"] = np.maximum(100.0 * on - sum(first.values()), 0.0)
    return first


def _detected(design: Design, rendering: Rendering, emitted: Array, response: Array) -> Array:
    """Flux of each LED on the pixels, per cent: what the entrance pupil takes of the field of view. Radiance
    is what the camera makes of it (`response`); 0 where it is blind."""
    from scenes.camera import irradiance

    camera = design.camera
    area_m2 = camera.pitch_mm[0] * camera.pitch_mm[1] * 1e-6
    flux = [grey(irradiance(camera, layer)).sum() * area_m2 for layer in rendering.radiance]
    return _percent(np.array(flux), emitted * response)


def _shares(rendering: Rendering) -> Array:
    light = np.array([layer.sum(dtype=np.float64) for layer in rendering.radiance])
    return np.asarray(100.0 * light / max(float(light.sum()), 1e-300))


def _total(design: Design, rendering: Rendering) -> Array:
    """What the lens lets through to the pixels, all LEDs together."""
    from scenes.lens import through

    return through(design.sensor(), rendering.radiance.sum(axis=0, dtype=np.float64))


def _uniformity(rendering: Rendering) -> float:
    low, high = np.percentile(grey(rendering.radiance.sum(axis=0, dtype=np.float64)), [1.0, 99.0])
    return float(high / low) if low > 0 else float("inf") if high > 0 else 1.0


def _exposure(design: Design, rendering: Rendering, seed: int) -> Exposure:
    from scenes.camera import expose, mean_counts

    radiance, wavelength = _total(design, rendering), design.light.wavelength_nm
    mean = mean_counts(design.camera, radiance, wavelength)
    image = expose(design.camera, radiance, wavelength, np.random.default_rng(seed))
    mean = np.minimum(mean, 2**design.camera.bits - 1)
    return Exposure(float(mean.max()), float(mean.mean()), saturated_percent(design, image, radiance))


def _advised(design: Design, rendering: Rendering, in_sight: Array) -> float | None:
    """Exposure time that fills `FILL` of the range, ms, to two figures; within what a design may say."""
    from scenes.camera import mean_electrons

    camera = design.camera
    electrons = mean_electrons(camera, _total(design, rendering), design.light.wavelength_nm)
    spared = min(_BRIGHTEST + _SPOTS * float(in_sight.sum()), 50.0)
    bright = float(np.percentile(electrons, 100.0 - spared))
    if bright <= 0.0:
        return None
    top = min(
        (2**camera.bits - 1 - camera.offset_dn) * camera.gain_e_per_dn, camera.full_well_e * camera.binning**2
    )
    wanted = camera.exposure_ms * FILL * top / bright
    return float(np.clip(float(f"{wanted:.2g}"), 1e-3, 1e5))


def _signal(design: Design, standard: Rendering, blank: Rendering, seed: int) -> Signal:
    """The tared signal, and the noise about it from differences of frames, which the fixed pattern leaves."""
    from scenes.camera import expose, mean_counts

    camera, wavelength = design.camera, design.light.wavelength_nm
    lit, unlit = _total(design, standard), _total(design, blank)
    top = 2**camera.bits - 1
    tared = np.minimum(mean_counts(camera, lit, wavelength), top)
    tared -= np.minimum(mean_counts(camera, unlit, wavelength), top)
    tared = grey(tared)
    # where half a millimetre is brightest: the brightest pixels alone would be the light's Monte Carlo noise
    rows_, columns_ = camera.shape
    pixel = camera.field_of_view_mm / columns_, camera.field_height_mm / rows_
    window = [max(round(_PLACE_MM / pixel[1]), 1), max(round(_PLACE_MM / pixel[0]), 1)]
    row, column = np.unravel_index(int(uniform_filter(tared, window, mode="nearest").argmax()), tared.shape)
    counts = uniform_filter(tared, 3, mode="nearest")[row, column]
    rng = np.random.default_rng(seed)
    rows = slice(max(row - _NOISE_REACH, 0), row + _NOISE_REACH + 1)
    columns = slice(max(column - _NOISE_REACH, 0), column + _NOISE_REACH + 1)
    near = (rows, columns)
    frames = np.stack([grey(expose(camera, lit, wavelength, rng)[near]) for _ in range(_NOISE_FRAMES)])
    noise = float(np.sqrt(np.mean(np.var(frames, axis=0, ddof=1))))
    # a saturated pixel does not stir; the converter's step is always there
    return Signal(float(counts), max(noise, 1.0 / np.sqrt(12.0)), (int(row), int(column)))
