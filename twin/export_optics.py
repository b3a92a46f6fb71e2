"""A press as files of the optics: a Mitsuba scene, or meshes of guide, contact surface and glass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import fem
from twin import presses
from twin.complaint import DesignError, shown
from twin.conflicts import colourless
from twin.design import Design
from twin.presses import Quality
from twin.stage import begins, staged

if TYPE_CHECKING:
    from scenes.surface import OpticalSurface

Kind = Literal["mitsuba", "stl", "ply"]
KINDS: tuple[Kind, ...] = ("mitsuba", "stl", "ply")

_README = "README.txt"
_BODIES = ("guide", "contact", "glass")

_MITSUBA_README = """\
A pressed sensor of the twin as a scene of Mitsuba 3 ({version}). Units: mm, radiance W mm^-2 sr^-1.

  scene.xml     the scene, with stock `path`; -Dspp=..., -Dresx=..., -Dresy=... change what they say
  contact.ply   the deformed contact surface, with the vertex attribute vertex_contact_fraction
  contact.npy   what the contact does to light, by contact fraction and angle (read without pickle)

The contact surface and the camera (pixels that are not square) are plugins of this package. One import
registers them, after a variant is set; they know llvm_ad_mono and cuda_ad_mono:

  import mitsuba as mi
  mi.set_variant("llvm_ad_mono")
  import scenes.plugins

  scene = mi.load_file("scene.xml")
  picture = mi.render(scene, spp=64)        # slow: next-event estimation stops at the glass

What is in the twin's own pictures but not in this scene: {left_out}.

LLVM 15 and 16 abort the process: set DRJIT_LIBLLVM_PATH to a good one (19) first, or put
`import scenes.backend; scenes.backend.use()` in place of the first two lines, which finds one.

design {design}, {inclusion}, press {depth:g} mm
"""
_MESH_README = """\
A pressed sensor of the twin as meshes. Units: mm; +z points into the specimen, 0 is the undeformed contact
surface.

  guide.{kind}      the waveguide as a closed body: deformed on top, flat sides and bottom
  contact.{kind}    its contact surface alone{fields}
  glass.{kind}      the plate below

design {design}, {inclusion}, press {depth:g} mm
"""
_FIELDS = """, with vertex attributes: pressure (kPa), contact_fraction (0 to 1),
                 displacement_z (mm)"""


def check(design: Design, inclusion: fem.Inclusion | None, levels: Sequence[float], kind: Kind) -> None:
    """Raise `DesignError` before any work is done."""
    if kind == "mitsuba":
        colourless(design, "a scene for Mitsuba")
    presses.check(design, inclusion, levels)
    if len(levels) != 1:
        raise DesignError("press.indentation_mm", shown(list(levels)), "one depth for one scene")


def export(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    kind: Kind,
    name: str,
    *,
    quality: Quality = "standard",
    progress: Callable[[str, float], None] | None = None,
) -> Path:
    """Press, and write the folder `name` whole or not at all.

    Parameters
    ----------
    levels : depth of the press, mm: one.
    kind : "mitsuba" (`scenes.mitsuba_files`), or "stl" or "ply" (`scenes.meshes`).
    """
    check(design, inclusion, levels, kind)
    tell = progress or (lambda stage, done: None)
    try:
        with staged(name, _is_ours(kind)) as folder:
            (press,) = presses.solved(
                design,
                inclusion,
                levels,
                quality=quality,
                estimate=False,
                pictured=True,
                progress=lambda stage, share: tell("mechanics", 0.8 * share),
            )
            tell("files", 0.8)
            from scenes import surface

            deformed = surface.resample(press.surface, design.waveguide.width_mm)
            told = _write_scene(design, deformed, folder) if kind == "mitsuba" else _MESH_README
            if kind != "mitsuba":
                _write_meshes(design, deformed, kind, folder)
            told = told.format(
                version=_version(),
                kind=kind,
                left_out="; ".join(_left_out(design)),
                fields=_FIELDS if kind == "ply" else "",
                design=design.name,
                inclusion=_in_words(inclusion),
                depth=levels[0],
            )
            (folder / _README).write_text(told, encoding="utf-8")
            tell("files", 1.0)
    except DesignError as error:
        raise error.renamed(kind) if error.field == "out" else error from None
    return Path(name).absolute()


def _left_out(design: Design) -> Iterator[str]:
    """What stock `path` through this scene does not show of a design."""
    guide, leds = design.waveguide, design.leds
    yield "light that spreads sideways in the tissue (it comes back where it went in)"
    yield "the lens's depth of field and vignetting (a pinhole takes its place)"
    if guide.absorption_per_mm or design.glass.absorption_per_mm:
        yield "absorption in guide and glass"
    if guide.walls != "polished" and any(led.coupling == "air" for led in leds):
        yield "paint on the side walls"
    if any(led.pattern != "lambertian" or led.tilt_deg != 0.0 for led in leds):
        yield "the LEDs' patterns (they are Lambertian)"
    at = design.light.wavelength_nm
    if any(led.spectrum != "line" or led.peak_nm not in (None, at) for led in leds):
        yield f"the LEDs' spectra (all is at {at:g} nm), and what the camera makes of them"
    if design.camera.ambient > 0.0:
        yield "ambient light"


def _write_scene(design: Design, deformed: OpticalSurface, folder: Path) -> str:
    from scenes import Renderer

    renderer = Renderer(design.sensor())
    from scenes import mitsuba_files  # only now that Mitsuba has its variant

    mitsuba_files.write(renderer.sensor, renderer.packed, deformed, folder)
    return _MITSUBA_README


def _write_meshes(design: Design, deformed: OpticalSurface, kind: str, folder: Path) -> None:
    from scenes import meshes

    for name, mesh in meshes.bodies(design.sensor(), deformed).items():
        (folder / f"{name}.{kind}").write_bytes(meshes.as_bytes(mesh, kind))


def _is_ours(kind: Kind) -> Callable[[Path], bool]:
    """Only what this writes, so that no picture of the user's is ever lost."""
    names = {"scene.xml", "contact.ply", "contact.npy"}
    if kind != "mitsuba":
        names = {f"{body}.{kind}" for body in _BODIES}
    told = _MITSUBA_README if kind == "mitsuba" else _MESH_README

    def ours(folder: Path) -> bool:
        there = {entry.name for entry in folder.iterdir()}
        return there <= names | {_README} and begins(folder / _README, told)

    return ours


def _in_words(inclusion: fem.Inclusion | None) -> str:
    from twin.captions import inclusion_in_words

    return "no inclusion" if inclusion is None else f"inclusion {inclusion_in_words(inclusion)}"


def _version() -> str:
    from twin.frame import versions

    return versions()["mitsuba"]
