"""Panels of the overview sheet that are maps: pressure, radiance, counts, tared counts and their relief.

Pictures are (rows, columns) with rows growing with -y, drawn as seen from the specimen; axes are mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

from twin.frame import grey

if TYPE_CHECKING:
    import pyvista as pv

INK, FAINT, LED, INCLUSION = "#1a1a1a", "#777777", "#f2b200", "#a63603"
DASHED = (0, (4, 3))
ROUND = (1, 2, 5, 10)
"""Steps of the ticks: whole millimetres make short labels."""

INNER = 0.88
"""Share of the probe's half width that colours and scales span: the pressure is singular at the rim."""


class Pictured(Protocol):
    """What the sheet needs to know of a frame; mm, kPa, N."""

    @property
    def design(self) -> Any: ...
    @property
    def inclusion(self) -> Any: ...  # None, or size, depth, modulus, offset, stretch
    @property
    def press(self) -> Mapping[str, Any]: ...  # indentation_mm, force_N, position_mm, tilt_deg
    @property
    def seed(self) -> int: ...
    @property
    def image(self) -> NDArray[Any]: ...  # counts, (rows, columns[, 3])
    @property
    def tared(self) -> NDArray[Any]: ...  # signed counts
    @property
    def radiance(self) -> NDArray[Any]: ...  # (n_led, rows, columns[, 3]) W m-2 sr-1
    @property
    def surface(self) -> pv.PolyData: ...
    @property
    def cut(self) -> pv.PolyData | None: ...  # None from an emulator
    @property
    def fem(self) -> Mapping[str, Any]: ...
    @property
    def tsis(self) -> Mapping[str, Any]: ...


def quads(mesh: pv.PolyData) -> NDArray[np.intp]:
    """Corners of a mesh of quadrilaterals, (n, 4)."""
    return np.asarray(mesh.faces).reshape(-1, 5)[:, 1:]


def triangles(mesh: pv.PolyData) -> NDArray[np.intp]:
    """Corners of the halves of the quadrilaterals, (2 n, 3)."""
    corners = quads(mesh)
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def scale_bar(axes: Axes, x: float, y: float, length_mm: float, colour: str) -> None:
    """A bar of known length with its lower left end at (x, y)."""
    axes.plot([x, x + length_mm], [y, y], color=colour, lw=2, solid_capstyle="butt", zorder=6)
    text = f"{length_mm:g} mm\n"
    axes.text(x + length_mm / 2, y, text, ha="center", va="center", color=colour, zorder=6)


def draw_pressure(axes: Axes, frame: Pictured, letter: str) -> None:
    """Contact pressure over the whole contact surface, kPa; the singular rim runs off the colours."""
    from scenes.surface import resample  # not before it is needed: it imports a mesh library

    camera, width_mm = frame.design.camera, frame.design.waveguide.width_mm
    half = width_mm / 2
    smooth = resample(frame.surface, width_mm)
    pressure = np.maximum(smooth.pressure_kPa, 0.0)  # the spline swings below zero where contact ends
    inside = np.abs(smooth.nodes_mm) < INNER * half
    top = float(pressure[np.ix_(inside, inside)].max())
    drawn = axes.imshow(
        pressure,
        origin="lower",
        extent=(-half, half, -half, half),
        interpolation="bilinear",
        cmap="viridis",
        vmin=float(pressure.min()),
        vmax=top,
    )
    beyond = pressure.max() > top
    unit = f"kPa (singular rim: {pressure.max():.2g} on this mesh)" if beyond else "kPa"
    _colour_bar(axes, drawn, unit, extend="max" if beyond else "neither")
    width, height = camera.field_of_view_mm, camera.field_height_mm
    corner = (-width / 2, -height / 2)
    dotted: dict[str, Any] = {"fill": False, "edgecolor": "white", "lw": 0.8, "ls": (0, (1, 2))}
    axes.add_patch(Rectangle(corner, width, height, **dotted))
    axes.text(corner[0] + 2.5, corner[1] + 0.2, "field of view", color="white", fontsize=6, va="bottom")
    _outline(axes, frame, "white")
    _millimetres(axes, (-half, half, -half, half))
    axes.set_title(f"{letter}  Contact pressure, {frame.press['force_N']:.2f} N in all")


def draw_radiance(axes: Axes, frame: Pictured, letter: str) -> None:
    """Radiance at the lens, all LEDs together, false colour spanning the middle of the picture."""
    total = grey(np.asarray(frame.radiance, np.float64).sum(axis=0))
    rows, columns = total.shape
    inner = total[rows // 8 : rows - rows // 8, columns // 8 : columns - columns // 8]
    low, high = max(float(inner.min()), 0.0), max(float(inner.max()), 0.0)
    if low == high:  # even light has no span of its own: show it against the dark
        low, high = 0.0, high or 1.0
    drawn = axes.imshow(
        total, cmap="inferno", extent=_extent(frame), interpolation="nearest", vmin=low, vmax=high
    )
    below, above = total.min() < low, total.max() > high
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    bar = _colour_bar(axes, drawn, "W m⁻² sr⁻¹", extend=extend)
    if not total.any():
        bar.set_ticks([0.0])
        axes.text(0.5, 0.5, "no light", color="white", fontsize=9, ha="center", transform=axes.transAxes)
    _led_marks(axes, frame)
    _outline(axes, frame, "white")
    _millimetres(axes, _extent(frame))
    count = len(frame.design.leds)
    axes.set_title(f"{letter}  Radiance at the lens, {count} LED{'s' if count > 1 else ''} (false colour)")


def draw_counts(axes: Axes, frame: Pictured, letter: str) -> None:
    """The picture as the camera delivers it: black is 0, white the converter's last count."""
    bits, image = frame.design.camera.bits, np.asarray(frame.image)
    extent = _extent(frame)
    top = 2**bits - 1
    shown = image if image.ndim == 2 else image / top  # three channels are drawn from 0 to 1
    drawn = axes.imshow(shown, cmap="gray", extent=extent, interpolation="nearest", vmin=0, vmax=top)
    if image.ndim == 2:
        _colour_bar(axes, drawn, "counts")
    scale_bar(axes, extent[0] + 1, extent[2] + 1, 5.0, "white" if image.mean() < 2 ** (bits - 1) else INK)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(f"{letter}  Picture, {bits} bit, {image.min():.5g} to {image.max():.5g} counts")


def draw_tared(axes: Axes, frame: Pictured, letter: str) -> None:
    """Picture minus its reference; noise alone stays pale, because the colours span twice the threshold."""
    counts, k, extent = grey(frame.tared), frame.design.signal.counts, _extent(frame)
    limit = max(2.0 * k, float(np.quantile(np.abs(counts), 0.9995)))
    drawn = axes.imshow(
        counts, cmap="RdBu_r", extent=extent, interpolation="nearest", vmin=-limit, vmax=limit
    )
    _colour_bar(axes, drawn, "counts", extend="both")
    smooth, lines = gaussian_filter(counts, 4.0), []
    if smooth.max() > k:
        x = np.linspace(extent[0], extent[1], counts.shape[1])
        y = np.linspace(extent[3], extent[2], counts.shape[0])
        axes.contour(x, y, smooth, levels=[k], colors=[INK], linewidths=0.7)
        lines.append(f"solid: {k:g} counts")
    if frame.inclusion is not None:
        _outline(axes, frame, INK)
        axes.set(xlim=extent[:2], ylim=extent[2:])  # whatever of the inclusion lies beyond the picture
        lines.append("dashed: inclusion")
    scale_bar(axes, extent[0] + 1, extent[2] + 1, 5.0, INK)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(f"{letter}  Tared picture" + (f" ({'; '.join(lines)})" if lines else ""))


def draw_relief(axes: Any, frame: Pictured) -> None:
    """Tared picture as a landscape, as in Fig. 3(c) of the source paper (key ``lee2011``)."""
    extent = _extent(frame)
    counts = gaussian_filter(grey(frame.tared), 5.0)
    small = zoom(counts, (64 / counts.shape[0], 96 / counts.shape[1]), order=1)
    x = np.linspace(extent[0], extent[1], small.shape[1])
    y = np.linspace(extent[3], extent[2], small.shape[0])
    low, high = min(0.0, float(small.min())), max(2.0 * frame.design.signal.counts, float(small.max()))
    style: dict[str, Any] = {
        "cmap": "viridis",
        "norm": Normalize(low, high),
        "linewidth": 0,
        "antialiased": False,
    }
    axes.plot_surface(*np.meshgrid(x, y), small, rcount=64, ccount=96, **style)
    axes.set_zlim(low, high)
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=ROUND))
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND))
    axes.zaxis.set_major_locator(MaxNLocator(4))
    axes.set_box_aspect((extent[1], extent[3], 0.44 * max(extent[1], extent[3])), zoom=0.94)
    axes.view_init(elev=32, azim=-62)
    axes.tick_params(labelsize=6, pad=-2)
    axes.set_xlabel("x, mm", labelpad=-4)
    axes.set_ylabel("y, mm", labelpad=-4)
    axes.set_zlabel("counts", labelpad=-5)


def _extent(frame: Pictured) -> tuple[float, float, float, float]:
    width, height = frame.design.camera.field_of_view_mm, frame.design.camera.field_height_mm
    return (-width / 2, width / 2, -height / 2, height / 2)


def _colour_bar(axes: Axes, drawn: Any, label: str, extend: str = "neither") -> Colorbar:
    beside = axes.inset_axes((1.025, 0.0, 0.03, 1.0))  # leaves the panel its size
    bar = axes.figure.colorbar(drawn, cax=beside, extend=extend)
    bar.outline.set_linewidth(0.5)
    bar.set_label(label, fontsize=6.5, labelpad=2)
    beside.tick_params(labelsize=6.5)
    return bar


def _outline(axes: Axes, frame: Pictured, colour: str) -> None:
    """Where the inclusion lies, seen from above."""
    found = frame.inclusion
    if found is not None:
        centre = (float(found.offset[0]), float(found.offset[1]))
        widths = found.size * found.stretch[0], found.size * found.stretch[1]
        axes.add_patch(Ellipse(centre, *widths, fill=False, edgecolor=colour, lw=1.0, ls=DASHED))


def _led_marks(axes: Axes, frame: Pictured) -> None:
    """A mark for every LED, pointing the way it shines; on the border where the LED lies beyond it."""
    left, right, low, high = _extent(frame)
    beyond, marks = False, []
    for led in frame.design.leds:
        if led.side == "below":
            place = np.clip(led.x_mm, left, right), np.clip(led.y_mm, low, high)
            marks += axes.plot(*place, "o", ms=6, color=LED, mec=INK, mew=0.5, clip_on=False, zorder=5)
            continue
        along, face = led.along_mm, frame.design.waveguide.width_mm / 2
        away = face + (led.gap_mm if led.coupling == "air" else -led.gap_mm)
        x, y, mark = {
            "+x": (away, along, "<"),
            "-x": (-away, along, ">"),
            "+y": (along, away, "v"),
            "-y": (along, -away, "^"),
        }[led.side]
        place = np.clip(x, left, right), np.clip(y, low, high)
        beyond |= place != (x, y)
        marks += axes.plot(*place, mark, ms=6, color=LED, mec=INK, mew=0.5, clip_on=False, zorder=5)
    if marks:
        text = "LED (beyond the edge, at the guide's side)" if beyond else "LED"
        style: dict[str, Any] = {"fontsize": 6, "frameon": False, "borderaxespad": 0, "handletextpad": 0.2}
        axes.legend(marks[:1], [text], loc="upper right", bbox_to_anchor=(1.0, -0.14), **style)


def _millimetres(axes: Axes, extent: tuple[float, float, float, float]) -> None:
    axes.set_xlim(*extent[:2])
    axes.set_ylim(*extent[2:])
    axes.set_aspect("equal")
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=ROUND))
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=ROUND))
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
