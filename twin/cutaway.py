"""Panels of the overview sheet along x: the cut through probe and tissue, and the profiles of the surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Ellipse, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from twin.frame import grey
from twin.panels import (
    DASHED,
    FAINT,
    INCLUSION,
    INK,
    INNER,
    LED,
    ROUND,
    Pictured,
    quads,
    scale_bar,
    triangles,
)

if TYPE_CHECKING:
    import pyvista as pv

Floats = NDArray[np.float64]

TISSUE, GLASS, WALL, PRESSURE = "#f3ddcf", "#d5e8df", "#d0d0d0", "#2b6ca3"
LAYERS = ("#deebf7", "#9ecae1", "#4a90c4", "#2b6ca3", "#1f4e79")


def draw_cut(axes: Axes, frame: Pictured, letter: str) -> None:
    """Cut through the middle of probe and inclusion, in the probe's frame, true to scale: glass at rest,
    specimen pushed towards it. Nodes off the plane y = 0 are drawn where they are seen from the side.

    Without a cut, as an emulator's frames are, only the contact line is drawn as deformed."""
    design = frame.design
    layers = design.waveguide.layers
    half = design.waveguide.width_mm / 2
    moved, wall = _outline(axes, frame) if frame.cut is None else _bodies(axes, frame, frame.cut)
    bottom = -sum(layer.thickness_mm for layer in layers)
    glass = design.glass.thickness_mm
    edge: dict[str, Any] = {"edgecolor": INK, "lw": 0.5}
    axes.add_patch(Rectangle((-half, bottom - glass), 2 * half, glass, facecolor=GLASS, **edge))
    hatch: dict[str, Any] = {"facecolor": WALL, "edgecolor": "#9a9a9a", "hatch": "////", "lw": 0.5}
    away = 2.5 * _normal(wall)
    axes.add_patch(Polygon([*wall, *(wall + away)[::-1]], closed=True, **hatch))
    for led in design.leds:
        if led.side not in ("+x", "-x"):
            continue
        sign = 1 if led.side == "+x" else -1
        face = half + (led.gap_mm if led.coupling == "air" else -led.gap_mm)
        corner = (min(sign * face, sign * (face + 0.8)), led.z_mm - led.diameter_mm / 2)
        axes.add_patch(Rectangle(corner, 0.8, led.diameter_mm, facecolor=LED, zorder=4, **edge))
    low, high = bottom - glass - 2.6, float(wall[:, 1].max()) + 7.0
    left, right = moved[:, 0].min() - 3, max(moved[:, 0].max() + 6, half + 23.5)  # keeps the names inside
    box = axes.get_window_extent()
    spare = max(0.0, (high - low) * box.width / box.height - (right - left)) / 2
    axes.set_xlim(left - spare, right + spare)
    axes.set_ylim(low, high)
    _name_the_parts(axes, frame, bottom, wall)
    axes.set_aspect("equal", anchor="N")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("z, mm (into the tissue)")
    indentation = frame.press["indentation_mm"]
    y = 0.0 if frame.inclusion is None else frame.inclusion.offset[1]
    title = f"Cut at y = 0 under a press of {indentation:.2f} mm (deformation × 1)"
    if y:
        title = f"Cut through the inclusion (y = {y:g} mm), pressed {indentation:.2f} mm"
    if frame.cut is None:
        title = f"At y = {y:g} mm, pressed {indentation:.2f} mm; dashed: not computed"
    axes.set_title(f"{letter}  {title}")


def _bodies(axes: Axes, frame: Pictured, mesh: pv.PolyData) -> tuple[Floats, Floats]:
    """Draw the deformed mesh of the cut; its nodes (n, 2) mm of x and z, and the ends of the chest wall."""
    count = len(frame.design.waveguide.layers)
    colours = np.array([TISSUE, INCLUSION, *(LAYERS[i % len(LAYERS)] for i in range(count))])
    material = np.asarray(mesh.cell_data["material"]).astype(int)
    moved = (np.asarray(mesh.points) + np.asarray(mesh.point_data["displacement"]))[:, [0, 2]]
    fill = list(colours[material])
    axes.add_collection(
        PolyCollection(moved[quads(mesh)], facecolors=fill, edgecolors="#00000030", linewidths=0.2)
    )
    return moved, _wall(frame, moved)


def _outline(axes: Axes, frame: Pictured) -> tuple[Floats, Floats]:
    """Draw the contact line as deformed, and dashed, moved with the chest wall alone, what an emulator does
    not know: the tissue's free surface, the layers and the inclusion. Returns as `_bodies`."""
    design, found, down = frame.design, frame.inclusion, frame.press["indentation_mm"]
    half, side = design.waveguide.width_mm / 2, design.specimen.width_mm / 2
    deep, y = design.specimen.thickness_mm - down, 0.0 if found is None else found.offset[1]
    x = np.linspace(-half, half, 401)[1:-1]
    displacement = np.asarray(frame.surface.point_data["displacement"], float)
    line = np.stack(
        [x + _along_x(frame, displacement[:, 0], x, y), _along_x(frame, displacement[:, 2], x, y)], 1
    )
    rims = [(line[0, 0], -down), (line[-1, 0], -down)]
    tissue = np.array([(-side, -down), rims[0], *line, rims[1], (side, -down), (side, deep), (-side, deep)])
    axes.add_patch(Polygon(tissue, closed=True, facecolor=TISSUE, edgecolor="none"))
    top = [*line]
    depth = 0.0
    for number, layer in enumerate(design.waveguide.layers):
        depth -= layer.thickness_mm
        low = np.array([[-half, depth], [half, depth]])
        colour = LAYERS[number % len(LAYERS)]
        axes.add_patch(Polygon([*top, *low[::-1]], closed=True, facecolor=colour, edgecolor="none"))
        if number + 1 < len(design.waveguide.layers):
            axes.plot(*low.T, color=INK, lw=0.6, ls=DASHED)
        top = [*low]
    axes.plot(*line.T, color=INK, lw=1.0)
    for rim, end in zip(rims, (-side, side), strict=True):
        axes.plot([end, rim[0]], [-down, -down], color=INK, lw=0.6, ls=DASHED)
    if found is not None:
        centre = (found.offset[0], found.centre_mm - down)
        style: dict[str, Any] = {"facecolor": "none", "edgecolor": INCLUSION, "lw": 1.0, "ls": DASHED}
        axes.add_patch(Ellipse(centre, 2 * found.radii_mm[0], 2 * found.radii_mm[2], **style))
        text = f"inclusion\n{found.modulus:g} kPa"
        right = (centre[0] + found.radii_mm[0] + 1, centre[1])
        axes.text(*right, text, ha="left", va="center", color=INCLUSION, linespacing=1.1)
    return tissue, np.array([[-side, deep], [side, deep]])


def _wall(frame: Pictured, moved: Floats) -> Floats:
    """Ends of the chest wall's face, (2, 2) mm of x and z, by rising x; level but for a tilted press."""
    assert frame.cut is not None
    points = np.asarray(frame.cut.points, float)
    about_x, about_y = np.radians(frame.press["tilt_deg"])
    # the specimen's depth axis in the frame of a probe that was turned about x, then y
    deep = points @ [-np.sin(about_y), np.cos(about_y) * np.sin(about_x), np.cos(about_y) * np.cos(about_x)]
    face = moved[deep > deep.max() - 1e-6 * np.ptp(deep)]
    return face[[face[:, 0].argmin(), face[:, 0].argmax()]]


def _normal(wall: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normal of the chest wall in the cut, away from the probe."""
    along = wall[1] - wall[0]
    return np.array([-along[1], along[0]]) / np.hypot(*along)


def _name_the_parts(axes: Axes, frame: Pictured, bottom: float, wall: NDArray[np.float64]) -> None:
    design = frame.design
    slab, glass = design.specimen, design.glass.thickness_mm
    half, left = design.waveguide.width_mm / 2, wall[0, 0] + 1.5
    slope = (wall[1, 1] - wall[0, 1]) / (wall[1, 0] - wall[0, 0])
    top = wall[0, 1] + min(0.0, 20 * slope)  # the name is about 20 mm long
    axes.text(left, top - 1.2, f"tissue {slab.modulus_kPa:g} kPa", va="top", fontsize=7.5)
    paper: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    middle = wall.mean(axis=0) + 1.15 * _normal(wall)
    turn = np.degrees(np.arctan(slope))
    axes.text(
        *middle,
        "chest wall (fixed)",
        ha="center",
        va="center",
        rotation=turn,
        rotation_mode="anchor",
        bbox=paper,
    )
    at_rest = "drawn with the probe at rest; the chest wall comes down"
    axes.text(middle[0], wall[:, 1].max() + 6.4, at_rest, fontsize=6.5, ha="center", va="top", color=FAINT)
    if frame.inclusion is not None and frame.cut is not None:
        _name_the_inclusion(axes, frame, frame.cut)
    parts, top = [], 0.0
    for layer in design.waveguide.layers:
        text = f"PDMS {layer.modulus_kPa:g} kPa, {layer.thickness_mm:g} mm"
        parts.append((top - layer.thickness_mm / 2, text))
        top -= layer.thickness_mm
    parts.append((bottom - glass / 2, f"glass {glass:g} mm"))
    arrow: dict[str, Any] = {"arrowstyle": "-", "lw": 0.5, "color": FAINT, "shrinkA": 0, "shrinkB": 0}
    free = -3.6  # below the tissue, which sags beside the probe
    for z, text in parts:
        height = min(z, free)
        axes.annotate(text, (half, z), (half + 3, height), va="center", fontsize=6, arrowprops=arrow)
        free = height - 2.4
    lit = [led for led in design.leds if led.side == "-x"]
    if lit:
        axes.text(-half - 2, lit[0].z_mm, "LED", ha="right", va="center")
    below = f"camera {design.camera.distance_mm:g} mm below"
    axes.text(0, bottom - glass - 0.5, below, fontsize=6.5, ha="center", va="top", color=FAINT)
    scale_bar(axes, min(left, -half - 14), bottom - glass + 0.4, 10.0, INK)


def _name_the_inclusion(axes: Axes, frame: Pictured, mesh: pv.PolyData) -> None:
    found = frame.inclusion
    text = f"inclusion\n{found.modulus:g} kPa"
    inside = quads(mesh)[np.asarray(mesh.cell_data["material"]) == 1]
    if not inside.size:  # off the plane of the cut
        return
    moved = (np.asarray(mesh.points) + np.asarray(mesh.point_data["displacement"]))[np.unique(inside)]
    (left, _, low), (right, _, high) = moved.min(axis=0), moved.max(axis=0)
    middle = (low + high) / 2
    (first, last), wide = axes.get_xlim(), axes.get_window_extent().width
    if (right - left) * wide / (last - first) >= 72:  # pixels: the name fits in
        place, side, colour = (left + right) / 2, "center", "white"
    else:
        place, side, colour = right + 1, "left", INCLUSION
    axes.text(place, middle, text, ha=side, va="center", color=colour, linespacing=1.1)


def draw_profiles(rows: Sequence[Axes], frame: Pictured, letter: str) -> None:
    """Cause to effect along x, in three rows: tared displacement, pressure, tared counts.

    Through the middle of the inclusion, or as near to it as the picture goes. Dots are nodes of the mechanics
    that lie on the line; the picture is the mean of 17 rows.
    """
    data, signal, found = frame.surface.point_data, frame.design.signal, frame.inclusion
    points = np.asarray(frame.surface.points, float)
    half, camera = frame.design.waveguide.width_mm / 2, frame.design.camera
    y = 0.0 if found is None else found.offset[1]
    y = round(float(np.clip(y, -0.45 * camera.field_height_mm, 0.45 * camera.field_height_mm)), 2)
    nodes = np.flatnonzero(np.abs(points[:, 1] - y) < 1e-6 * half)
    x = np.linspace(-half, half, 401)[1:-1]

    def along(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return _along_x(frame, values, x, y)

    pushed = np.asarray(data["displacement_0"])[:, 2] - np.asarray(data["displacement"])[:, 2]
    rows[0].plot(x, 1e3 * along(pushed), color=INCLUSION, lw=1.2)
    rows[0].plot(points[nodes, 0], 1e3 * pushed[nodes], ".", color=INCLUSION, ms=2.5)
    _threshold(rows[0], signal.displacement_um, f"k = {signal.displacement_um:g} µm")
    rows[0].set_ylabel("pushed in\nµm, tared", fontsize=6.5)

    pressure, pressure_0 = (np.asarray(data[name], float) for name in ("pressure", "pressure_0"))
    if found is not None:
        line: dict[str, Any] = {"color": FAINT, "lw": 1.0, "ls": "--", "label": "without inclusion"}
        rows[1].plot(x, along(pressure_0), **line)
    label = "with inclusion" if found is not None else "plain tissue"
    rows[1].plot(x, along(pressure), color=PRESSURE, lw=1.2, label=label)
    rows[1].plot(points[nodes, 0], pressure[nodes], ".", color=PRESSURE, ms=2.5)
    inner = np.abs(points[:, :2]).max(axis=1) < INNER * half
    rows[1].set_ylim(0, 1.15 * max(pressure[inner].max(), pressure_0[inner].max()))
    rows[1].set_ylabel("pressure\nkPa", fontsize=6.5)
    rows[1].legend(fontsize=6, frameon=False, loc="best", ncols=2, handlelength=2.2, borderpad=0)

    counts = grey(frame.tared)
    row = round((0.5 - y / camera.field_height_mm) * counts.shape[0])  # rows grow with -y
    band = counts[max(row - 8, 0) : row + 9].mean(axis=0)
    columns = ((np.arange(counts.shape[1]) + 0.5) / counts.shape[1] - 0.5) * camera.field_of_view_mm
    rows[2].plot(columns, uniform_filter1d(band, 5), color="#4d4d4d", lw=1.2)
    _threshold(rows[2], signal.counts, f"k = {signal.counts:g}")
    rows[2].set_ylabel("picture\ncounts, tared", fontsize=6.5)
    rows[2].set_xlabel("x, mm")

    for axes in rows:
        axes.set_xlim(-half, half)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=ROUND))
        axes.spines[["top", "right"]].set_visible(False)
        axes.yaxis.set_label_coords(-0.085, 0.5)
        if found is not None:
            radius = found.size * found.stretch[0] / 2
            axes.axvspan(
                found.offset[0] - radius, found.offset[0] + radius, color=INCLUSION, alpha=0.08, lw=0
            )
        if axes is not rows[2]:
            axes.tick_params(labelbottom=False)
    what = f"What the inclusion (shaded) adds along y = {y:g}{' mm' if y else ''}"
    rows[0].set_title(f"{letter}  {what if found is not None else 'Along y = 0, on plain tissue'}")


def _threshold(axes: Axes, level: float, text: str) -> None:
    """A dashed level, named beside the panel, where no curve can run into the name."""
    axes.margins(y=0.15)
    axes.axhline(level, color=FAINT, lw=0.6, ls="--")
    place = axes.get_yaxis_transform()
    axes.text(1.01, level, text, fontsize=6, va="center", color=FAINT, transform=place)


def _along_x(
    frame: Pictured, values: NDArray[np.float64], x: NDArray[np.float64], y: float
) -> NDArray[np.float64]:
    """Values of the contact surface's nodes, interpolated at (x, y); NaN beside the surface."""
    points = np.asarray(frame.surface.points, float)
    field = LinearTriInterpolator(Triangulation(points[:, 0], points[:, 1], triangles(frame.surface)), values)
    return np.ma.filled(field(x, np.full_like(x, y)), np.nan)
