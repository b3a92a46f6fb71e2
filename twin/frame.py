"""A frame: one press of the sensor on one specimen, as arrays in memory and as files on disk.

Pictures are stored as seen from the specimen: columns grow with +x, rows with -y. Pressed in is negative
``displacement`` in the fields and positive in every scalar.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fem import Inclusion
from twin.design import Design
from twin.stage import has_keys, staged

if TYPE_CHECKING:
    import pyvista

RECORD = "frame.json"
PICTURES = ("frame.exr", "image.png", "tared.png", "reference.exr", "reference.png", "overview.png")
MEAN = "image.exr"
"""Only where the camera averages frames: their mean, with its fractions of counts."""
FILES = frozenset({RECORD, "surface.vtp", *PICTURES})

_PACKAGES = (
    "tsis-twin",
    "numpy",
    "scipy",
    "scikit-fem",
    "pyvista",
    "vtk",
    "mitsuba",
    "drjit",
    "OpenEXR",
    "matplotlib",
)


@dataclass(frozen=True, eq=False)
class Frame:
    """One press level: the picture, the fields behind it and the scalars of both."""

    design: Design
    inclusion: Inclusion | None
    press: dict[str, Any]
    """``indentation_mm`` and ``force_N`` of the press on the specimen with its inclusion; the sensor's
    ``position_mm`` on it and its ``tilt_deg``, [x, y] each."""
    seed: int
    image: NDArray[Any]
    """(rows, columns) counts, (rows, columns, 3) in colour: uint8, or uint16 above 8 bits; float32, the mean,
    where the camera averages frames."""
    reference: NDArray[np.float32]
    """(rows, columns[, 3]) counts: mean of 16 noisy frames, or of as many as `image` if that is more, of the
    same press without inclusion."""
    radiance: NDArray[np.float32]
    """(n_led, rows, columns[, 3]) W m⁻² sr⁻¹, one layer per LED, at the camera's lens, summed over
    wavelengths against the camera's response (see `scenes.spectrum`)."""
    pressure: NDArray[np.float32]
    """(rows, columns) contact pressure that each pixel looks at, kPa."""
    displacement_z: NDArray[np.float32]
    """(rows, columns) displacement of the surface that each pixel looks at, mm; negative is pressed in."""
    surface: pyvista.PolyData
    """Contact surface, mm, with the point arrays of `fem.press`."""
    cut: pyvista.PolyData | None
    """Cut through the middle of probe and inclusion along x, mm, with the arrays of `fem.press`; None from an
    emulator, which knows the contact surface only."""
    fem: dict[str, Any] = field(default_factory=dict)
    """Scalars ``raw`` and ``tared`` of the surface, ``min_pressure_kPa``, ``path``, ``background``,
    ``signal``, ``mechanics``, ``error_percent``, ``dof`` and ``seconds``, as `fem.Press` explains them. From
    an emulator, ``mechanics`` is "emulator", ``emulated`` what it learned ("finite" or "linear"), ``dof``
    None, and ``error_percent`` (`fem.Emulated`) None where it cannot tell."""
    tsis: dict[str, Any] = field(default_factory=dict)
    """Scalars ``raw`` and ``tared`` of the picture, ``saturated_percent``, ``frames`` and
    ``reference_frames`` (exposures that picture and reference are the mean of), ``seconds``,
    ``noise_percent``, ``bias_percent`` and ``bias_of`` (`twin.light_bias`)."""

    @property
    def tared(self) -> NDArray[np.float32]:
        """(rows, columns[, 3]) counts of the picture minus those of the reference; negative ones too."""
        return self.image.astype(np.float32) - self.reference

    def record(self) -> dict[str, Any]:
        """Return what `frame.json` says of the frame, but for the checksums of its files."""
        inclusion = None
        if self.inclusion is not None:
            units = {"size": "size_mm", "depth": "depth_mm", "modulus": "modulus_kPa", "offset": "offset_mm"}
            inclusion = {units.get(key, key): value for key, value in asdict(self.inclusion).items()}
            if self.design.specimen.inclusion is not None:
                inclusion["optics"] = asdict(self.design.specimen.inclusion.of(self.design.tissue()))
        return {
            "inclusion": inclusion,
            "press": self.press,
            "lens": _lens(self.design),
            "fem": self.fem,
            "tsis": self.tsis,
            "design": self.design.name,
            "seed": self.seed,
            "versions": versions(),
        }

    def write(self, out: str | Path) -> Path:
        """Write the frame's files into a new folder, or in place of an earlier frame; see `write_frames`."""
        return write_frames([self], out)


def grey(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Return counts as (rows, columns): those of a picture without colour, or the mean of R, G and B."""
    counts = np.asarray(picture, np.float64)
    return counts if counts.ndim == 2 else counts.mean(axis=2)


def _lens(design: Design) -> dict[str, float]:
    """Return the lens that the camera's geometry asks for, as `frame.json` names it."""
    from scenes.lens import lens_of

    lens, (pitch, _) = lens_of(design.sensor()), design.camera.pitch_mm
    return {
        "focal_length_mm": lens.focal_mm,
        "pupil_mm": lens.pupil_mm,
        "magnification": lens.magnification,
        "blur_px": lens.blur_mm / pitch,
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a frame depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # run from a source tree that is not installed
            found[package] = "unknown"
    return found


def write_frames(frames: Sequence[Frame], out: str | Path) -> Path:
    """Write one frame straight into ``out``, several into ``out/00``, ``out/01``, ...; all or nothing.

    Raises
    ------
    DesignError
        If ``out`` holds anything but an earlier result of twin, or cannot be made.
    """
    with staged(out, holds_frames) as folder:
        fill(frames, folder)
    return Path(out)


def fill(frames: Sequence[Frame], folder: Path) -> None:
    """Write the frames into a folder that exists and is empty."""
    for number, frame in enumerate(frames):
        place = folder if len(frames) == 1 else folder / f"{number:02d}"
        place.mkdir(exist_ok=True)
        _write(frame, place)


def holds_frames(folder: Path) -> bool:
    """Return whether a folder holds what `write_frames` wrote, and nothing else."""
    inside = list(folder.iterdir())
    if all(entry.is_dir() and entry.name.isdigit() for entry in inside):
        return bool(inside) and all(_holds_one_frame(entry) for entry in inside)
    return _holds_one_frame(folder)


def _holds_one_frame(folder: Path) -> bool:
    names = {entry.name for entry in folder.iterdir()}
    return names <= FILES | {MEAN} and has_keys(folder / RECORD, "design", "versions")


def _write(frame: Frame, folder: Path) -> None:
    # Slow to import, and a look at `twin --help` needs none of them.
    from scenes.camera import count_dtype, tare
    from scenes.exr import flat_planes, write_exr, write_png
    from twin.pictures import overview

    layers = flat_planes({f"led.{number}": layer for number, layer in enumerate(frame.radiance)})
    fields = {"pressure": frame.pressure, "displacement.z": frame.displacement_z}
    units = {"pressure": "kPa", "displacement.z": "mm", **dict.fromkeys(layers, "W m-2 sr-1")}
    write_exr(folder / "frame.exr", {**layers, **fields}, {f"unit.{name}": units[name] for name in units})
    whole = count_dtype(frame.design.camera.bits)
    for name, counts in (("image", frame.image), ("reference", frame.reference)):
        if counts.dtype == np.float32:
            planes = flat_planes({"counts": counts})
            write_exr(folder / f"{name}.exr", planes, {f"unit.{plane}": "DN" for plane in planes})
        write_png(folder / f"{name}.png", np.rint(counts).astype(whole))
    write_png(folder / "tared.png", tare(frame.image, frame.reference, frame.design.camera.bits))
    frame.surface.save(folder / "surface.vtp")
    overview(frame, folder / "overview.png")
    record = frame.record()
    record["sha256"] = {path.name: _sha256(path) for path in sorted(folder.iterdir())}
    text = json.dumps(record, indent=2, allow_nan=False, ensure_ascii=False, default=np.generic.item)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
