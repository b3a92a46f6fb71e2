"""The picture that a person looks at: one sheet from the press to the tared picture, units on everything.

Drawn with matplotlib's Agg canvas alone: no display, no GPU, no pyplot state. Same frame, same bytes.
"""

from __future__ import annotations

import io
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scenes.exr import write_bytes
from twin.captions import error_in_words, inclusion_in_words, mechanics_in_words, percent_in_words
from twin.cutaway import draw_cut, draw_profiles
from twin.panels import (
    FAINT,
    INK,
    Pictured,
    draw_counts,
    draw_pressure,
    draw_radiance,
    draw_relief,
    draw_tared,
)

WIDTH_PX, HEIGHT_PX, DPI = 1800, 1200, 150

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so every machine sets the same type
    "font.size": 7.0,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.titlepad": 5.0,
    "axes.linewidth": 0.6,
    "axes.labelpad": 2.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "text.color": INK,
}


def overview(frame: Pictured, path: str | Path) -> None:
    """Draw the whole chain of one frame into a PNG of 1800 x 1200 pixels.

    Parameters
    ----------
    frame : Frame
        With ``inclusion`` None the sheet shows a press on plain tissue.
    path : path
        Appears all at once, under this name. Raises `scenes.exr.ImageError` where it cannot.
    """
    with mpl.rc_context():
        mpl.rcdefaults()  # a user's own matplotlibrc must not change the picture
        mpl.rcParams.update(STYLE)
        canvas = FigureCanvasAgg(Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI))
        draw_sheet(canvas.figure, frame)
        stream = io.BytesIO()
        with warnings.catch_warnings():  # a design may have a name that the sheet's type cannot write
            warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from font", UserWarning)
            canvas.print_png(stream, metadata={"Software": None})  # it would name the version of matplotlib
    write_bytes(path, stream.getvalue())


def draw_sheet(figure: Figure, frame: Pictured) -> None:
    """Fill an empty figure of the sheet's size."""
    _headline(figure, frame)
    draw_cut(_axes(figure, 85, 100, 520, 385), frame, "a")
    draw_pressure(_axes(figure, 715, 100, 385, 385), frame, "b")
    draw_radiance(_axes(figure, 1255, 100, 420, 314), frame, "c")
    draw_profiles([_axes(figure, 105, top, 480, 80) for top in (572, 663, 754)], frame, "d")
    draw_counts(_axes(figure, 715, 572, 385, 288), frame, "e")
    draw_tared(_axes(figure, 1255, 572, 385, 288), frame, "f")
    # The box of a 3-D panel has wide empty margins, so it may overlap its neighbours.
    draw_relief(_axes(figure, 30, 880, 590, 325, "3d"), frame)
    figure.text(57 / WIDTH_PX, 1 - 913 / HEIGHT_PX, "g  Tared picture as a relief (smoothed)", **_TITLE)
    _scalars(_axes(figure, 685, 905, 530, 280), frame, "h")
    _facts(_axes(figure, 1300, 905, 465, 280), frame, "i")


_TITLE: dict[str, Any] = {"fontsize": 8, "fontweight": "bold", "va": "bottom"}
_LINE, _CLOSE = 0.1, 0.08  # distance of the two tables' lines, as a share of their height


def _axes(
    figure: Figure, left: float, top: float, width: float, height: float, projection: str | None = None
) -> Axes:
    """Axes at a place counted in pixels from the sheet's upper left corner."""
    box = (left / WIDTH_PX, 1 - (top + height) / HEIGHT_PX, width / WIDTH_PX, height / HEIGHT_PX)
    return figure.add_axes(box, projection=projection)


def _headline(figure: Figure, frame: Pictured) -> None:
    found = frame.inclusion
    what = "Plain tissue, no inclusion"
    if found is not None:
        what = f"Inclusion {inclusion_in_words(found)}"
    what += f", pressed {frame.press['indentation_mm']:.2f} mm"
    notes = [f"design {frame.design.name}", f"seed {frame.seed}", "computed, not photographed"]
    tilt, position = frame.press["tilt_deg"], frame.press["position_mm"]
    if found is not None and any(found.offset):
        notes.insert(0, f"inclusion off centre by ({found.offset[0]:g}, {found.offset[1]:g}) mm")
    if any(position):
        notes.insert(0, f"sensor at ({position[0]:g}, {position[1]:g}) mm of the specimen")
    if any(tilt):
        notes.insert(0, f"tilted by ({tilt[0]:g}, {tilt[1]:g})° about x and y")
    note = " · ".join(notes)
    place = 30 / WIDTH_PX
    figure.text(place, 1 - 30 / HEIGHT_PX, what, fontsize=12, fontweight="bold", va="center")
    figure.text(place, 1 - 58 / HEIGHT_PX, note, color=FAINT, va="center", parse_math=False)


def _scalars(axes: Axes, frame: Pictured, letter: str) -> None:
    """The three scalars of the surface and of the picture, raw and tared."""
    signal, fem, tsis = frame.design.signal, frame.fem, frame.tsis
    rows = (
        ("max displacement", fem, "max_mm", 1e3, "µm"),
        ("total displacement", fem, "total_mm3", 1.0, "mm³"),
        (f"area above {signal.displacement_um:g} µm", fem, "area_mm2", 1.0, "mm²"),
        ("max brightness", tsis, "max_dn", 1.0, "counts"),
        ("total brightness", tsis, "total_dn", 1.0, "counts"),
        (f"area above {signal.counts:g} counts", tsis, "area_px", 1.0, "pixels"),
    )
    _head(axes, f"{letter}  The three scalars of the surface and of the picture")
    axes.text(0.62, 0.84, "raw", ha="right", color=FAINT)
    axes.text(0.84, 0.84, "tared", ha="right", color=FAINT)
    for i, (name, where, key, scale, unit) in enumerate(rows):
        y = 0.73 - _LINE * i - (0.03 if i > 2 else 0)
        axes.text(0, y, name)
        axes.text(0.62, y, _number(where["raw"][key] * scale), ha="right")
        axes.text(0.84, y, _number(where["tared"][key] * scale), ha="right", fontweight="bold")
        axes.text(0.86, y, unit, color=FAINT)
    notes = (
        "Raw numbers hold the background too (of the picture: all its light and its black level);",
        "only the tared column is the inclusion.",
        "The raw maximum displacement sits at the probe's edge and depends on the mesh.",
    )
    for i, note in enumerate(notes):
        axes.text(0, 0.1 - 0.06 * i, note, fontsize=6, color=FAINT)


def _facts(axes: Axes, frame: Pictured, letter: str) -> None:
    fem, tsis, camera = frame.fem, frame.tsis, frame.design.camera
    _head(axes, f"{letter}  How it was made")
    facts = [
        ("indentation", f"{frame.press['indentation_mm']:.3f} mm"),
        ("force", f"{frame.press['force_N']:.4f} N"),
        ("lowest contact pressure", f"{fem['min_pressure_kPa']:.3f} kPa"),
        ("mechanics", mechanics_in_words(fem)),
        (error_in_words(fem), percent_in_words(fem["error_percent"], " of its maximum")),
        ("unknowns of the mechanics", "none" if fem["dof"] is None else _number(fem["dof"])),
        ("LEDs", _coupling(frame)),
        ("noise of the computed light", f"{tsis['noise_percent']:.2f} % of its mean (rms)"),
        ("camera exposure", f"{camera.exposure_ms:g} ms"),
    ]
    saturated = tsis.get("saturated_percent")
    if saturated is not None:
        facts.append(("saturated pixels", f"{saturated:.2f} %"))
    for i, (name, value) in enumerate(facts):
        axes.text(0, 0.73 - _CLOSE * i, name)
        axes.text(1, 0.73 - _CLOSE * i, value, ha="right")


def _coupling(frame: Pictured) -> str:
    """How many LEDs shine into the guide which way."""
    ways = Counter(led.coupling for led in frame.design.leds)
    names = {"air": "through air", "embedded": "embedded"}
    if len(ways) == 1:
        way, count = next(iter(ways.items()))
        return f"{count}, {names[way]}"
    return ", ".join(f"{ways[way]} {name}" for way, name in names.items()) if ways else "none"


def _head(axes: Axes, title: str) -> None:
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    axes.text(0, 0.92, title, **_TITLE)
    axes.plot([0, 1], [0.82, 0.82], color=INK, lw=0.5)


def _number(value: float) -> str:
    """Four figures, thousands apart, no exponent in everyday sizes."""
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.4g}"
