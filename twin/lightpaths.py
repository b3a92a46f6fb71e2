"""The sensor doctor's picture: sample light paths seen from the side and from above, and the light's balance.

Drawn with matplotlib's Agg canvas alone, as the overview sheet is: no display, no GPU.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from scenes.exr import write_bytes
from twin.cutaway import GLASS, LAYERS, TISSUE
from twin.doctor import Checkup
from twin.lightbars import FATES, draw_bars, draw_first, draw_legend, write_facts
from twin.panels import FAINT, INK, LED
from twin.pictures import DPI, HEIGHT_PX, STYLE, WIDTH_PX

_LINES = 70  # in one panel, about
_LEAST = 2  # of every fate that an LED has; 1 where there are many LEDs
_MANY = 6
_BELOW_MM, _BESIDE_MM, _TISSUE_MM = 6.0, 6.0, 3.0  # drawn beyond the sensor
_HOUSING_MM = 0.6  # thickness that is drawn
_SIDES = {"x": 0, "y": 1}


def draw(checkup: Checkup, path: str | Path) -> None:
    """Draw a checkup into a PNG of 1800 x 1200 pixels, which appears all at once under this name."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        canvas = FigureCanvasAgg(Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI))
        figure = canvas.figure
        state = f"pressed {checkup.indentation_mm:g} mm" if checkup.light_is_pressed else "untouched"
        title = f"Where the light goes: {checkup.design.name}, {state}"
        figure.text(0.017, 0.975, title, fontsize=12, fontweight="bold", va="center", parse_math=False)
        note = "sample paths that a photon may take; rare fates are drawn too often: c has the true shares"
        figure.text(0.017, 0.952, note, color=FAINT, va="center")
        side, above = _axes(figure, 75, 110, 1010, 470), _axes(figure, 75, 650, 490, 490)
        axis = _busiest_axis(checkup)
        _draw_side(side, checkup, axis)
        _draw_above(above, checkup)
        draw_bars(_axes(figure, 1205, 110, 555, 420), checkup)
        draw_first(_axes(figure, 1205, 640, 555, 220), checkup)
        draw_legend(
            figure.add_axes((590 / WIDTH_PX, 60 / HEIGHT_PX, 500 / WIDTH_PX, 490 / HEIGHT_PX)), checkup
        )
        write_facts(
            figure.add_axes((1205 / WIDTH_PX, 40 / HEIGHT_PX, 555 / WIDTH_PX, 160 / HEIGHT_PX)), checkup
        )
        stream = io.BytesIO()
        canvas.print_png(stream, metadata={"Software": None})
    write_bytes(path, stream.getvalue())


def chosen(fate: NDArray[np.int64], count: int, least: int = _LEAST) -> NDArray[np.intp]:
    """Places of about `count` paths of one LED: the first ones, and at least `least` of every fate."""
    kept = set(range(min(count, fate.size)))
    for kind in np.unique(fate):
        kept |= set(np.flatnonzero(fate == kind)[:least].tolist())
    return np.array(sorted(kept), dtype=np.intp)


def _axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    box = (left / WIDTH_PX, 1 - (top + height) / HEIGHT_PX, width / WIDTH_PX, height / HEIGHT_PX)
    return figure.add_axes(box)


def _busiest_axis(checkup: Checkup) -> str:
    """The axis that most LEDs shine along: the side view looks across it."""
    along = [led.side[-1] for led in checkup.design.leds]
    return "y" if along.count("y") > along.count("x") else "x"


def _draw_paths(axes: Axes, checkup: Checkup, columns: tuple[int, int], leds: list[int]) -> None:
    """Paths of these LEDs, projected onto two of the coordinates; signal above the rest."""
    from scenes.paths import FATES as NAMES

    paths = checkup.paths
    assert paths is not None
    each = max(_LINES // max(len(leds), 1), 4)
    lines: dict[str, list[NDArray[np.float32]]] = {}
    ended = paths.fate != NAMES.index("going")  # what goes round and round would cover all else
    for number in leds:
        mine = np.flatnonzero((paths.led == number) & ended)
        for place in mine[chosen(paths.fate[mine], each, _LEAST if len(leds) < _MANY else 1)]:
            corners = paths.vertices_mm[:, place]
            corners = corners[np.isfinite(corners[:, 0])][:, columns]
            lines.setdefault(NAMES[paths.fate[place]], []).append(corners)
    order = sorted(
        lines, key=lambda name: (name == "tissue", name == "below", name not in ("aside", "missed"))
    )
    for level, name in enumerate(order):
        colour = FATES.get(name, ("black", ""))[0]
        strong = name in ("tissue", "below")
        style: dict[str, Any] = {"linewidths": 0.9 if strong else 0.5, "alpha": 0.9 if strong else 0.45}
        axes.add_collection(LineCollection(lines[name], colors=colour, zorder=5 + level, **style))
        if name != "missed":
            ends = np.array([line[-1] for line in lines[name]])
            mark = "o" if name not in ("aside", "below") else "."
            axes.plot(*ends.T, mark, color=colour, ms=2.2 if mark == "o" else 1.2, mew=0, zorder=5 + level)


def _draw_side(axes: Axes, checkup: Checkup, axis: str) -> None:
    design = checkup.design
    guide, glass = design.waveguide, design.glass
    half, bottom, across = guide.width_mm / 2, -guide.thickness_mm, _SIDES[axis]
    lowest = bottom - glass.thickness_mm
    assert checkup.height_mm is not None
    middle = checkup.height_mm.shape[0] // 2
    line = np.linspace(-half, half, checkup.height_mm.shape[0])
    height = checkup.height_mm[middle] if axis == "x" else checkup.height_mm[:, middle]
    roof = np.column_stack([line, height])
    top = float(height.max()) + _TISSUE_MM
    edge: dict[str, Any] = {"edgecolor": INK, "lw": 0.6}
    axes.add_patch(Polygon([*roof, (half, top), (-half, top)], facecolor=TISSUE, edgecolor="none", alpha=0.8))
    body = [(-half, bottom), *roof, (half, bottom)]
    axes.add_patch(Polygon(body, closed=True, facecolor=LAYERS[0], alpha=0.7, **edge))
    axes.add_patch(
        Rectangle((-half, lowest), 2 * half, glass.thickness_mm, facecolor=GLASS, alpha=0.7, **edge)
    )
    optics = design.guide()
    for face in optics.floors_mm[:-1]:
        axes.plot([-half, half], [face] * 2, color=INK, lw=0.5, ls=(0, (2, 2)), zorder=4)
    for sign in (-1, 1):  # the black frame about the glass
        axes.plot([sign * half] * 2, [lowest, bottom], color="black", lw=2, solid_capstyle="butt", zorder=4)
    shown = [k for k, led in enumerate(design.leds) if led.side[-1] == axis or led.side == "below"]
    _draw_paths(axes, checkup, (across, 2), shown)
    _leds_from_the_side(axes, checkup, shown, across)
    _draw_camera(axes, checkup, across, lowest)
    aim: dict[str, Any] = {"fontsize": 7, "zorder": 20, "va": "center"}
    axes.text(-half - 0.6, top - _TISSUE_MM / 2, "tissue", ha="right", **aim)
    roofs = (2.0 + bottom, *optics.floors_mm[:-1]) if not optics.lower else (0.0, *optics.floors_mm[:-1])
    for ceiling, floor, (_, index) in zip(roofs, optics.floors_mm, optics.layers, strict=True):
        axes.text(half + 1.2, 0.5 * (ceiling + floor), f"guide, n = {index:.4g}", **aim)
    axes.text(half + 1.2, 0.5 * (bottom + lowest), f"glass, n = {glass.refractive_index:g}", **aim)
    axes.set_xlim(-half - _BESIDE_MM, half + _BESIDE_MM + 3)
    axes.set_ylim(lowest - _BELOW_MM, top)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{axis}, mm")
    axes.set_ylabel("z, mm (into the tissue)")
    which = "the LEDs" if len(shown) == len(design.leds) else f"the LEDs that shine along {axis}"
    axes.set_title(f"a  From the side: light of {which}" if shown else "a  From the side")


def _leds_from_the_side(axes: Axes, checkup: Checkup, shown: list[int], across: int) -> None:
    """The LEDs' bodies; those behind each other share a name."""
    design = checkup.design
    half = design.waveguide.width_mm / 2
    floor = -design.waveguide.thickness_mm - design.glass.thickness_mm
    names: dict[tuple[float, float, str], list[str]] = {}
    for number in shown:
        led = design.leds[number]
        away = led.gap_mm if led.coupling == "air" else -led.gap_mm
        if led.side == "below":
            middle, top = (led.x_mm, led.y_mm)[across], floor - away
            corner, size = (middle - led.diameter_mm / 2, top - 0.8), (led.diameter_mm, 0.8)
            name = (middle, top - 1.4, "center")
        else:
            sign, face = (1 if led.side[0] == "+" else -1), half + away
            corner = (min(sign * face, sign * (face + 0.8)), led.z_mm - led.diameter_mm / 2)
            size = (0.8, led.diameter_mm)
            name = (sign * (face + 1.1), led.z_mm, "left" if sign > 0 else "right")
        axes.add_patch(Rectangle(corner, *size, facecolor=LED, edgecolor=INK, lw=0.5, zorder=15))
        names.setdefault(name, []).append(str(number))
    for (x, z, side), numbers in names.items():
        text = f"led {', '.join(numbers)}"
        axes.text(x, z, text, fontsize=6.5, va="center", ha=side, zorder=20)


def _draw_camera(axes: Axes, checkup: Checkup, across: int, lowest: float) -> None:
    """The edges of the field of view, from the contact surface down towards the pinhole."""
    from scenes import view

    sensor = checkup.design.sensor()
    rays = view.pixel_rays(sensor)
    rows, columns = rays.transmittance.shape
    ends = (
        ((rows // 2, 0), (rows // 2, columns - 1)) if across == 0 else ((0, columns // 2), (-1, columns // 2))
    )
    distance = sensor.camera.distance_mm
    cone = []
    for row, column in ends:
        start, aim = rays.origin_mm[row, column], rays.direction[row, column]
        upper = start[across] - aim[across] / aim[2] * start[2]
        sine = aim[across] * sensor.guide.refractive_index
        corners = [(upper, 0.0), (start[across], sensor.guide.floors_mm[0])]
        for layer, floor in zip(sensor.guide.lower, sensor.guide.floors_mm[1:], strict=True):
            run = sine / np.sqrt(layer.refractive_index**2 - sine**2) * layer.thickness_mm
            corners.append((corners[-1][0] - run, floor))
        lower = sine / np.sqrt(1.0 - sine**2) * distance
        cut = lower * (1.0 - _BELOW_MM / distance)
        cone.append([*corners, (lower, lowest), (cut, lowest - _BELOW_MM)])
    outline = Polygon([*cone[0], *cone[1][::-1]], closed=True, facecolor="#2b8cbe", alpha=0.08, zorder=3)
    axes.add_patch(outline)
    for edge in cone:
        axes.plot(*np.array(edge).T, color="#2b8cbe", lw=0.7, ls=(0, (5, 3)), zorder=16)
    if sensor.housing.reflects:
        for side in (-1, 1):
            x = side * (sensor.guide.width_mm / 2 + _HOUSING_MM * np.array([0.0, 1.0, 1.0, 0.0]))
            z = lowest - _BELOW_MM * np.array([0.0, 0.0, 1.0, 1.0])
            axes.fill(x, z, facecolor="white", edgecolor=INK, lw=0.5, hatch="////", zorder=5)
    axes.text(
        0,
        lowest - _BELOW_MM + 0.4,
        f"what the camera sees; its pinhole is {distance:g} mm below the glass",
        ha="center",
        va="bottom",
        fontsize=6.5,
        color="#2b6ca3",
        zorder=20,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.8},
    )


def _draw_above(axes: Axes, checkup: Checkup) -> None:
    design = checkup.design
    half, camera = design.waveguide.width_mm / 2, design.camera
    axes.add_patch(
        Rectangle((-half, -half), 2 * half, 2 * half, facecolor=LAYERS[0], alpha=0.7, edgecolor=INK, lw=0.6)
    )
    _draw_paths(axes, checkup, (0, 1), list(range(len(design.leds))))
    width, height = camera.field_of_view_mm, camera.field_height_mm
    axes.add_patch(
        Rectangle(
            (-width / 2, -height / 2),
            width,
            height,
            fill=False,
            edgecolor="#2b8cbe",
            lw=0.7,
            ls=(0, (5, 3)),
            zorder=16,
        )
    )
    for number, led in enumerate(design.leds):
        if led.side == "below":
            axes.add_patch(Circle((led.x_mm, led.y_mm), led.diameter_mm / 2, facecolor=LED, zorder=15))
            axes.text(led.x_mm, led.y_mm, str(number), fontsize=6.5, ha="center", va="center", zorder=20)
            continue
        sign, along = (1 if led.side[0] == "+" else -1), _SIDES[led.side[-1]]
        face = half + (led.gap_mm if led.coupling == "air" else -led.gap_mm)
        low = [led.along_mm - led.diameter_mm / 2] * 2
        low[along] = min(sign * face, sign * (face + 0.8))
        size = [led.diameter_mm] * 2
        size[along] = 0.8
        axes.add_patch(Rectangle(tuple(low), *size, facecolor=LED, edgecolor=INK, lw=0.5, zorder=15))
        place = [led.along_mm] * 2
        place[along] = sign * (face + 2.2)
        axes.text(*place, str(number), fontsize=6.5, ha="center", va="center", zorder=20)
    reach = half + _BESIDE_MM
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_title("b  From above, as seen from the tissue: all LEDs")
