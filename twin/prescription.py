"""What the sensor doctor hands over: tables on the terminal, or JSON; a folder with JSON and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from twin.doctor import STANDARD, Checkup, Exposure
from twin.findings import CLOSURE_PERCENT, RANKS, SATURATED, Finding
from twin.frame import versions
from twin.stage import has_keys

if TYPE_CHECKING:
    from numpy.typing import NDArray

RECORD, PICTURE = "check.json", "check.png"

FIRST_IN_WORDS = {
    "missed": "never enters the guide",
    "elsewhere": "never comes to the contact",
    "trapped": "comes to it, trapped",
    "leaked": "comes to it too steeply: leaks",
}
SINKS_IN_WORDS = {
    "tissue": "tissue keeps",
    "guide": "guide absorbs",
    "glass": "glass absorbs",
    "walls": "painted walls absorb",
    "frame": "glass's black frame",
    "leds": "LED bodies",
    "housing": "white housing absorbs",
    "below": "leaves below",
    "aside": "leaves aside, or never enters",
}
_COLOURS = {"error": "bold red", "warning": "yellow", "note": "cyan"}
_LABEL, _COLUMN = 35, 9  # characters that a row's name and a column take


def record(checkup: Checkup | None, found: Sequence[Finding], name: str) -> dict[str, Any]:
    """Everything as plain numbers and text, findings first."""
    counted = {rank: sum(finding.rank == rank for finding in found) for rank in RANKS}
    numbers = {"design": name} if checkup is None else measured(checkup)
    return {
        "ok": counted["error"] == 0,
        "count": counted,
        "findings": [asdict(finding) for finding in found],
        **numbers,
        "versions": versions(),
    }


def measured(checkup: Checkup) -> dict[str, Any]:
    """What was measured, as plain numbers with units in their names."""
    design, signal = checkup.design, checkup.signal

    def shares(values: dict[str, NDArray[np.float64]]) -> dict[str, Any]:
        return {
            name: {"per_led": [float(v) for v in part], "all": checkup.together(part)}
            for name, part in values.items()
        }

    def exposure(part: Exposure | None) -> dict[str, float] | None:
        return None if part is None else dict(vars(part))

    return {
        "design": design.name,
        "press": {"indentation_mm": checkup.indentation_mm, "mechanics": design.mechanics},
        "light": {
            "emitted_W": [float(v) for v in checkup.emitted_W],
            "pressed": checkup.light_is_pressed,
            "first_percent": shares(checkup.first),
            "sinks_percent": shares(checkup.sinks),
            "detected_percent": shares({"detected": checkup.detected})["detected"],
            "closure_percent": shares({"closure": checkup.closure_percent})["closure"],
            "picture_share_percent": [float(v) for v in checkup.lit_percent],
            "in_sight_percent": [float(v) for v in checkup.in_sight_percent],
            "noise_percent": checkup.noise_percent,
        },
        "exposure": {
            "exposure_ms": design.camera.exposure_ms,
            "advised_exposure_ms": checkup.advised_exposure_ms,
            "range_dn": 2**design.camera.bits - 1,
            "background": exposure(checkup.background),
            "blank": exposure(checkup.blank),
            "standard": exposure(checkup.standard),
        },
        "signal": None
        if signal is None
        else {
            "inclusion": {"size_mm": STANDARD.size, "depth_mm": STANDARD.depth}
            | {"modulus_kPa": STANDARD.modulus},
            "max_dn": signal.counts,
            "noise_dn": signal.noise_dn,
            "over_noise": signal.over_noise,
            "at_px": list(signal.at_px),
        },
        "from_housing_percent": checkup.from_housing_percent,
        "rim_mm": checkup.rim_mm,
        "uniformity": checkup.uniformity if np.isfinite(checkup.uniformity) else None,
        "not_computed": list(checkup.failures),
    }


def fill(checkup: Checkup | None, found: Sequence[Finding], name: str, folder: Path) -> None:
    """Write `check.json`, and `check.png` where something was measured, into an empty folder."""
    text = json.dumps(record(checkup, found, name), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")
    if checkup is not None:
        from twin.lightpaths import draw

        draw(checkup, folder / PICTURE)


def holds_checkup(folder: Path) -> bool:
    """Whether a folder holds what `fill` wrote, and nothing else."""
    names = {entry.name for entry in folder.iterdir()}
    return names <= {RECORD, PICTURE} and has_keys(folder / RECORD, "findings", "versions")


def show(checkup: Checkup | None, found: Sequence[Finding], name: str, *, as_json: bool = False) -> None:
    """Print the findings and, where something was measured, the tables behind them."""
    if as_json:
        print(json.dumps(record(checkup, found, name), indent=2, allow_nan=False, ensure_ascii=False))
        return
    console = Console(highlight=False)
    if checkup is not None:
        console.print(_balance(checkup, console.width))
        console.print(_exposures(checkup))
        console.print(_signal(checkup), soft_wrap=True)
    else:
        console.print("Every value can be read, but some do not fit the others: nothing was computed.")
    counts = ", ".join(
        f"{n} {rank}{'s' * (n != 1)}" for rank in RANKS if (n := sum(f.rank == rank for f in found))
    )
    console.print(f"\n[bold]{escape(name)}: {counts or 'nothing to complain about'}[/bold]")
    for finding in found:
        colour = _COLOURS[finding.rank]
        console.print(f"[{colour}]{finding.rank:8}[/{colour}]{escape(str(finding))}", soft_wrap=True)


def _balance(checkup: Checkup, width: int) -> Table:
    design = checkup.design
    state = f"pressed {checkup.indentation_mm:g} mm" if checkup.light_is_pressed else "untouched"
    table = Table(
        title=f"Where the light goes, % of what each LED emits ({escape(design.name)}, {state})",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("", no_wrap=True)
    shown = range(min(len(design.leds), max((width - _LABEL) // _COLUMN - 1, 1)))
    for number in shown:
        led = design.leds[number]
        table.add_column(f"led {number}\n{led.side}\n{led.coupling}", justify="right", no_wrap=True)
    table.add_column("all\n\n", justify="right", style="bold", no_wrap=True)

    def row(name: str, part: NDArray[np.float64], shape: str = "{:.2f}", **style: Any) -> None:
        cells = [shape.format(part[number]) for number in shown]
        table.add_row(name, *cells, shape.format(checkup.together(part)), **style)

    table.add_row("[bold]first[/bold]")
    for key, words in FIRST_IN_WORDS.items():
        row(f"  {words}", checkup.first[key], "{:.1f}")
    table.add_row("[bold]in the end[/bold]")
    for key, part in checkup.sinks.items():
        if not part.any():
            continue
        words = SINKS_IN_WORDS.get(key, key)
        if key == "tissue" and design.surface.sheet is not None:
            words = "contact sheet keeps"
        row(f"  {words}", part)
        if key == ("housing" if design.housing.reflects else "below"):
            row("    of it into the camera", checkup.detected, "{:.2g}", style="dim")
    total = 100.0 * (checkup.emitted_W > 0) + checkup.closure_percent
    row(f"  together (100 ± {CLOSURE_PERCENT:g})", total, end_section=True)
    row("share of the picture's light", checkup.lit_percent, "{:.1f}")
    if design.housing.reflects:
        table.add_row(f"  mirrored housing in it: {checkup.from_housing_percent:.1f} %", style="dim")
    if len(design.leds) > len(shown):
        table.caption = f"{len(design.leds) - len(shown)} more LEDs: see --json"
    return table


def _exposures(checkup: Checkup) -> Table:
    camera = checkup.design.camera
    top = 2**camera.bits - 1
    title = f"Counts of {top} at {camera.exposure_ms:g} ms"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("")
    for head in ("brightest", "mean", "saturated"):
        table.add_column(head, justify="right", no_wrap=True)
    parts: tuple[tuple[str, Exposure | None], ...] = (
        ("untouched", checkup.background),
        (f"plain tissue, {checkup.indentation_mm:g} mm", checkup.blank),
        ("standard inclusion", checkup.standard),
    )
    for name, part in parts:
        if part is not None:
            full = f"{part.saturated_percent:.2f} %"
            table.add_row(name, f"{part.brightest_dn:.1f}", f"{part.mean_dn:.1f}", full)
    return table


def _signal(checkup: Checkup) -> str:
    lines = []
    if checkup.signal is not None:
        signal, shown = checkup.signal, checkup.standard
        over = shown is not None and shown.saturated_percent > SATURATED["error"] + checkup.spots_percent
        full = ", but pixels are full: not to be trusted" if over else ""
        what = f"{STANDARD.size:g} mm, {STANDARD.depth:g} mm deep, {STANDARD.modulus:g} kPa"
        lines.append(
            f"[bold]signal[/bold]: the standard inclusion ({what}) adds {signal.counts:.1f} counts "
            f"(tared, 3 x 3 mean); a pixel's noise there is {signal.noise_dn:.2f} in one frame; "
            f"signal over noise {signal.over_noise:.0f}{full}"
        )
    if checkup.advised_exposure_ms is not None:
        lines.append(
            f"[bold]exposure[/bold]: {checkup.advised_exposure_ms:g} ms would fill 80 % of the range on this "
            f"press; now {checkup.design.camera.exposure_ms:g} ms"
        )
    lines.append(
        f"preview quality, {checkup.design.mechanics} mechanics; noise of the computed light "
        f"{checkup.noise_percent:.1f} % of its mean (rms of a pixel)"
    )
    return "\n".join(lines)
