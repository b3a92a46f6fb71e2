"""The camera as a design describes it: lens, pixels, noise, and what of that cannot be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Discriminator, Field, Tag
from pydantic.dataclasses import dataclass

from .quantity import CONFIG, Conflict, Length

PixelSize = Annotated[float, Field(ge=0.1, le=1000.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Curve = Annotated[tuple[Share, ...], Field(min_length=2, max_length=1000)]
Colour = Literal["mono", "rgb"]

MAX_PIXELS = 16_000_000
"""Largest picture: some ten arrays of that many numbers are in memory at a time."""
MAX_LAYER_PIXELS = 64_000_000
"""Largest picture times its number of LEDs, each of which has a layer of radiance per channel."""


@dataclass(frozen=True, config=CONFIG)
class Efficiency:
    """Electrons per photon over wavelength, a curve for each channel: linear in between, 0 outside."""

    wavelength_nm: Annotated[
        tuple[Annotated[float, Field(ge=200.0, le=2000.0)], ...],
        Field(min_length=2, max_length=1000, description="Wavelengths of the curves, nm, rising."),
    ]
    mono: Annotated[Curve | None, Field(description="Electrons per photon of a camera without colour.")] = (
        None
    )
    R: Annotated[Curve | None, Field(description="Electrons per photon of the red channel.")] = None
    G: Annotated[Curve | None, Field(description="Electrons per photon of the green channel.")] = None
    B: Annotated[Curve | None, Field(description="Electrons per photon of the blue channel.")] = None


def _kind(value: Any) -> str:
    return "table" if isinstance(value, (dict, Efficiency)) else "number"


QuantumEfficiency = Annotated[
    Annotated[float, Field(ge=1e-3, le=1.0), Tag("number")] | Annotated[Efficiency, Tag("table")],
    Discriminator(_kind),
]


@dataclass(frozen=True, config=CONFIG)
class Camera:
    """The camera below the glass: a thin lens at a distance, and a sensor with EMVA 1288 noise."""

    columns: Annotated[int, Field(ge=1, le=16384, description="Pixels along x.")]
    rows: Annotated[int, Field(ge=1, le=16384, description="Pixels along y.")]
    pixel_um: Annotated[
        tuple[PixelSize, PixelSize],
        Field(description="Width (x) and height (y) of one pixel on the sensor, µm."),
    ]
    field_of_view_mm: Annotated[
        Length,
        Field(description="Width (x) of the part of the contact surface that fills the picture, mm."),
    ]
    distance_mm: Annotated[
        float,
        Field(
            ge=1.0,
            le=10_000.0,
            description="Distance of the pinhole (entrance pupil) below the glass's lower face, mm.",
        ),
    ] = 40.0
    f_number: Annotated[
        float,
        Field(ge=0.5, le=64.0, description="f-number of the lens: focal length over entrance pupil."),
    ] = 4.0
    exposure_ms: Annotated[
        float,
        Field(
            ge=1e-3,
            le=1e5,
            description="Exposure time of one frame, ms; fixed, never chosen per picture.",
        ),
    ] = 10.0
    quantum_efficiency: Annotated[
        QuantumEfficiency,
        Field(
            description="Electrons per photon, 0 to 1: one number for all light, or a table of wavelength_nm "
            "and one curve per channel (mono; or R, G and B)."
        ),
    ] = 0.5
    full_well_e: Annotated[
        float, Field(ge=100.0, le=1e7, description="Electrons at which a pixel saturates.")
    ] = 45_000.0
    read_noise_e: Annotated[
        float, Field(ge=0.0, le=1e4, description="Standard deviation of the read noise, electrons.")
    ] = 12.0
    dark_current_e_s: Annotated[
        float, Field(ge=0.0, le=1e6, description="Dark current of one pixel, electrons per second.")
    ] = 20.0
    prnu_percent: Annotated[
        float,
        Field(ge=0.0, le=100.0, description="Photo-response non-uniformity (spread of the pixels' gain), %."),
    ] = 1.0
    dsnu_e: Annotated[
        float,
        Field(
            ge=0.0,
            le=1e4,
            description="Dark-signal non-uniformity (spread of the pixels' offset), electrons.",
        ),
    ] = 10.0
    gain_e_per_dn: Annotated[float, Field(ge=1e-3, le=1e5, description="Electrons per digital count.")] = (
        45_000.0 / 255.0
    )
    offset_dn: Annotated[
        float, Field(ge=0.0, le=65535.0, description="Counts of a pixel without signal (black level).")
    ] = 4.0
    bits: Annotated[int, Field(ge=8, le=16, description="Bits of one pixel's count: 8 to 16.")] = 8
    pattern_seed: Annotated[
        int,
        Field(
            ge=0,
            lt=2**63,
            description="Seed of the camera's own fixed pattern (PRNU and DSNU): one number, one camera.",
        ),
    ] = 1
    focus_mm: Annotated[
        float,
        Field(
            ge=-500.0,
            le=500.0,
            description="Height of the plane that is in focus, mm; 0 is the undeformed contact surface.",
        ),
    ] = 0.0
    vignetting: Annotated[
        bool, Field(description="Whether the picture darkens off the axis as a thin lens does (cos^4).")
    ] = False
    distortion: Annotated[
        tuple[Annotated[float, Field(ge=-10.0, le=10.0)], Annotated[float, Field(ge=-100.0, le=100.0)]],
        Field(
            description="Radial distortion k1, k2: tangent r of the ray in air to r (1 + k1 r² + k2 r⁴); "
            "negative k1 is a barrel. The picture stays field_of_view_mm wide."
        ),
    ] = (0.0, 0.0)
    binning: Annotated[
        int,
        Field(
            ge=1,
            le=16,
            description="So many pixels along x and y share their charge: rows and columns of the picture "
            "are those of the array over this.",
        ),
    ] = 1
    frames: Annotated[
        int, Field(ge=1, le=10_000, description="Exposures that are averaged into one picture.")
    ] = 1
    ambient: Annotated[
        float,
        Field(
            ge=0.0,
            le=1e6,
            description="Stray light added everywhere, W m⁻² sr⁻¹ at the lens, as of light.wavelength_nm at "
            "the camera's best quantum efficiency.",
        ),
    ] = 0.0
    colour: Annotated[
        Colour, Field(description="mono; or rgb, with three channels in every pixel (no mosaic).")
    ] = "mono"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the picture, after binning."""
        return self.rows // self.binning, self.columns // self.binning

    @property
    def pitch_mm(self) -> tuple[float, float]:
        """Width and height of a picture's pixel on the sensor, mm, after binning."""
        return self.pixel_um[0] * self.binning * 1e-3, self.pixel_um[1] * self.binning * 1e-3

    @property
    def magnification(self) -> float:
        """Width of the pixel array over that of the field of view."""
        return self.columns * self.pixel_um[0] * 1e-3 / self.field_of_view_mm

    @property
    def field_height_mm(self) -> float:
        """Height (y) of the part of the contact surface that fills the picture, mm."""
        sensor_width, sensor_height = self.columns * self.pixel_um[0], self.rows * self.pixel_um[1]
        return self.field_of_view_mm * sensor_height / sensor_width

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the picture's channels: one, or R, G and B."""
        return ("mono",) if self.colour == "mono" else ("R", "G", "B")

    @property
    def best_efficiency(self) -> NDArray[np.float64]:
        """Largest quantum efficiency of each channel, (channels,)."""
        if isinstance(self.quantum_efficiency, float):
            return np.full(len(self.channels), self.quantum_efficiency)
        return np.array([max(getattr(self.quantum_efficiency, name)) for name in self.channels])

    def efficiency(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Electrons per photon at wavelengths (n,) in nm, (channels, n)."""
        at = np.atleast_1d(np.asarray(wavelength_nm, np.float64))
        table = self.quantum_efficiency
        if isinstance(table, float):
            return np.full((len(self.channels), at.size), table)
        curves = [getattr(table, name) for name in self.channels]
        return np.stack([np.interp(at, table.wavelength_nm, curve, left=0.0, right=0.0) for curve in curves])


def camera_conflicts(camera: Camera, width_mm: float, thickness_mm: float, leds: int) -> Iterator[Conflict]:
    """Yield what does not fit within the camera, to a guide of this size, or to so many LEDs."""
    yield from _too_many_pixels(camera, leds * len(camera.channels))
    fields = {"width": camera.field_of_view_mm, "height": camera.field_height_mm}
    for name, extent in fields.items():
        if extent > width_mm * (1 + 1e-9):
            yield Conflict(
                "camera.field_of_view_mm",
                camera.field_of_view_mm,
                f"a field whose {name} ({extent:.4g} mm) stays within the guide's {width_mm:g} mm",
            )
            break
    if camera.offset_dn >= 2**camera.bits - 1:
        yield Conflict(
            "camera.offset_dn",
            camera.offset_dn,
            f"a number below the {2**camera.bits - 1} counts of {camera.bits} bits",
        )
    if abs(camera.focus_mm) > thickness_mm:
        allowed = f"-{thickness_mm:g} to {thickness_mm:g} mm, the guide's thickness below and above"
        yield Conflict("camera.focus_mm", camera.focus_mm, allowed)
    if camera.rows % camera.binning or camera.columns % camera.binning:
        allowed = f"a divisor of {camera.rows} rows and {camera.columns} columns"
        yield Conflict("camera.binning", camera.binning, allowed)
    yield from _efficiency_conflicts(camera)
    yield from _distortion_conflicts(camera)


def _efficiency_conflicts(camera: Camera) -> Iterator[Conflict]:
    path, table = "camera.quantum_efficiency", camera.quantum_efficiency
    if isinstance(table, float):
        if camera.colour == "rgb":
            yield Conflict(path, table, "a table with wavelength_nm, R, G and B where colour is 'rgb'")
        return
    if any(b <= a for a, b in zip(table.wavelength_nm, table.wavelength_nm[1:], strict=False)):
        yield Conflict(f"{path}.wavelength_nm", table.wavelength_nm, "wavelengths that rise")
    for name in ("mono", "R", "G", "B"):
        curve, wanted = getattr(table, name), name in camera.channels
        if (curve is not None) != wanted:
            allowed = f"{'a curve' if wanted else 'no such curve'} where camera.colour is {camera.colour!r}"
            yield Conflict(f"{path}.{name}", curve, allowed)
        elif curve is not None and len(curve) != len(table.wavelength_nm):
            allowed = f"as many numbers as the {len(table.wavelength_nm)} of wavelength_nm"
            yield Conflict(f"{path}.{name}", f"{len(curve)} numbers", allowed)
        elif curve is not None and max(curve) < 1e-3:
            yield Conflict(f"{path}.{name}", curve, "a curve that reaches 0.001 or more")


def _distortion_conflicts(camera: Camera) -> Iterator[Conflict]:
    """The picture must not fold: r (1 + k1 r² + k2 r⁴) rises beyond the corner's tangent."""
    k1, k2 = camera.distortion
    corner = np.hypot(camera.field_of_view_mm, camera.field_height_mm) / 2 / camera.distance_mm
    square = np.linspace(0.0, (1.5 * corner) ** 2, 500)
    if np.any(1.0 + 3.0 * k1 * square + 5.0 * k2 * square**2 <= 0.0):
        allowed = (
            f"k1, k2 with 1 + 3 k1 r² + 5 k2 r⁴ > 0 up to r = {1.5 * corner:.3g}, lest the picture folds"
        )
        yield Conflict("camera.distortion", camera.distortion, allowed)


def _too_many_pixels(camera: Camera, layers: int) -> Iterator[Conflict]:
    pixels = camera.rows * camera.columns
    if pixels > MAX_PIXELS:
        allowed = f"at most {MAX_PIXELS // camera.columns} with {camera.columns} columns"
        yield Conflict("camera.rows", camera.rows, f"{allowed} ({MAX_PIXELS // 1_000_000} million pixels)")
    elif pixels * layers > MAX_LAYER_PIXELS:
        allowed = f"at most {MAX_LAYER_PIXELS // camera.columns // layers} with {camera.columns} columns"
        most = f"{MAX_LAYER_PIXELS // 1_000_000} million pixels times LEDs"
        what = "LEDs" if camera.colour == "mono" else "layers of LEDs in R, G and B"
        yield Conflict("camera.rows", camera.rows, f"{allowed} and {layers} {what} ({most})")
