"""Panels of the sensor doctor's picture that are sums: where the light ends, and what it does first."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from twin.doctor import Checkup
from twin.panels import INK

# Fate of a path: colour, and words for the legend. What `scenes.paths` does not name yet is drawn black.
FATES: dict[str, tuple[str, str]] = {
    "tissue": ("#d7301f", "enters what it touches (bars: stays in it)"),
    "below": ("#08519c", "leaves below, a little of it into the camera"),
    "aside": ("#9e9e9e", "crosses the guide and leaves by a side face"),
    "missed": ("#d9d9d9", "goes by the guide, or is mirrored off its side"),
    "frame": ("#3f3f3f", "ends in the black frame about the glass"),
    "leds": ("#e08a00", "ends on the body of an LED"),
    "walls": ("#6a51a3", "absorbed by the painted walls"),
    "guide": ("#41ab5d", "absorbed in the guide"),
    "glass": ("#006d2c", "absorbed in the glass"),
    "housing": ("#5d4037", "absorbed by the housing"),
    "going": ("#f768a1", "not followed to its end"),
}
_FIRST = {
    "missed": ("#d9d9d9", "never enters the guide"),
    "elsewhere": ("#bdd7e7", "never reaches the contact surface"),
    "trapped": ("#2b6ca3", "reaches it trapped: touch lets it out"),
    "leaked": ("#c51b8a", "reaches it too steeply: leaks"),
}


def _shares(checkup: Checkup) -> dict[str, NDArray[np.float64]]:
    """Fates of the bars: the sinks, but for what goes by the guide, which stands for itself."""
    from scenes.paths import FATES as NAMES

    paths = checkup.paths
    assert paths is not None
    by = (paths.fate == NAMES.index("missed")).reshape(len(checkup.design.leds), -1).mean(axis=1)
    shares = {name: part for name, part in checkup.sinks.items() if name != "aside"}
    shares["missed"] = np.minimum(100.0 * by, checkup.sinks["aside"])
    shares["aside"] = checkup.sinks["aside"] - shares["missed"]
    order = [*FATES, *(name for name in shares if name not in FATES)]
    return {name: shares[name] for name in order if name in shares and shares[name].max() > 0.0}


def _stack(axes: Axes, checkup: Checkup, shares: dict[str, Any], colours: dict[str, tuple[str, str]]) -> None:
    """One bar for each LED (twelve at the most) and one for all, 0 to 100 %."""
    n_led = min(len(checkup.design.leds), 12)
    places = np.append(np.arange(n_led), n_led + 0.4)
    left = np.zeros(n_led + 1)
    for name, part in shares.items():
        colour = colours.get(name, ("black", name))[0]
        widths = np.append(part[:n_led], checkup.together(part))
        axes.barh(places, widths, left=left, color=colour, height=0.72, edgecolor="white", lw=0.3)
        for place, start, width in zip(places, left, widths, strict=True):
            if width >= 4.0:
                light = sum(to_rgb(colour)) > 1.7
                text: dict[str, Any] = {"color": INK if light else "white", "fontsize": 6}
                axes.text(start + width / 2, place, f"{width:.0f}", ha="center", va="center", **text)
        left = left + widths
    labels = [f"led {k} {checkup.design.leds[k].side}" for k in range(n_led)]
    axes.set_yticks(places, [*labels, "all"])
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of the emitted light")
    axes.spines[["top", "right"]].set_visible(False)


def draw_bars(axes: Axes, checkup: Checkup) -> None:
    _stack(axes, checkup, _shares(checkup), FATES)
    axes.set_title("c  Where it ends")


def draw_first(axes: Axes, checkup: Checkup) -> None:
    _stack(axes, checkup, checkup.first, _FIRST)
    axes.set_title("d  What it does first")
    handles = [Rectangle((0, 0), 1, 1, facecolor=colour) for colour, _ in _FIRST.values()]
    words = [text for _, text in _FIRST.values()]
    style: dict[str, Any] = {
        "fontsize": 6.5,
        "frameon": False,
        "ncols": 2,
        "handlelength": 1.2,
        "columnspacing": 1.0,
    }
    axes.legend(handles, words, loc="upper left", bbox_to_anchor=(-0.08, -0.24), **style)


def draw_legend(axes: Axes, checkup: Checkup) -> None:
    """Colours of paths and bars, with the share of all light."""
    axes.set_axis_off()
    shares = _shares(checkup)
    handles = [Line2D([], [], color=FATES.get(name, ("black", ""))[0], lw=3) for name in shares]
    words = [
        f"{checkup.together(part):5.1f} %  {FATES.get(name, ('', name))[1]}" for name, part in shares.items()
    ]
    style: dict[str, Any] = {"frameon": False, "fontsize": 7.5, "labelspacing": 1.0, "handlelength": 1.6}
    title = "What becomes of the light (colours of a, b and c)"
    legend = axes.legend(handles, words, loc="upper left", title=title, alignment="left", **style)
    legend.get_title().set_fontweight("bold")
    legend.get_title().set_fontsize(8)


def write_facts(axes: Axes, checkup: Checkup) -> None:
    axes.set_axis_off()
    signal, camera = checkup.signal, checkup.design.camera
    shown = checkup.standard or checkup.blank or checkup.background
    top = 2**camera.bits - 1
    lines = [
        f"Into the camera: {checkup.together(checkup.detected):.2g} % of the light"
        + (", without what it is blind to." if not checkup.response.all() else "."),
        f"Brightest pixel {shown.brightest_dn:.0f} of {top} counts, mean {shown.mean_dn:.0f}; untouched "
        f"{checkup.background.mean_dn:.1f}.",
        f"Full pixels at {camera.exposure_ms:g} ms: {shown.saturated_percent:.3g} %.",
    ]
    if signal is not None:
        times = f"{signal.over_noise:.0f} times a pixel's noise"
        lines.append(f"A standard inclusion adds {signal.counts:.0f} counts, {times}.")
    closure = 100.0 + checkup.together(checkup.closure_percent)
    lines.append(f"Sum of all sinks: {closure:.2f} % of what is emitted.")
    for number, text in enumerate(lines):
        axes.text(0, 1.0 - 0.2 * number, text, fontsize=7.5, va="top", transform=axes.transAxes)
