"""What a sensor designer does with a mapping: what it is, where it holds, what to change, in three lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.adequacy import Limits
from estimation.regression import fit_line
from twin.mapping import FEWEST, PAIRS, Mapped
from twin.report import digits
from twin.thresholds import SIGMAS, Swept

Floats = NDArray[np.float64]

_HARDLY = 0.5
"""Share of R² below which a line is not worth its name."""


@dataclass(frozen=True)
class AtThreshold:
    """The mapping with another k of the picture.

    Attributes
    ----------
    k_dn : counts.
    unseen_percent : samples without a pixel above it.
    false_px : pixels of a picture that pass it by noise alone, if noise is normal.
    r2_max, r2_area, error_max, error_area : of the lines; errors are leave-one-out, % of the span.
    """

    k_dn: float
    unseen_percent: float
    false_px: float
    r2_max: float
    r2_area: float
    error_max: float
    error_area: float


def at_thresholds(swept: Swept, surface_max: Floats, surface_area: Floats, pixels: int) -> list[AtThreshold]:
    """Fit the lines of maximum and area again at every threshold.

    Parameters
    ----------
    surface_max, surface_area : (n,) of the swept samples, as the record has them.
    pixels : of a picture.
    """
    from scipy.special import ndtr

    found = []
    for i, k in enumerate(swept.picture_k):
        seen = swept.area_px[:, i] > 0
        lines = [
            _fit(x[seen], y[seen, i]) for x, y in ((surface_max, swept.max_dn), (surface_area, swept.area_px))
        ]
        found.append(
            AtThreshold(
                k_dn=float(k),
                unseen_percent=100.0 * float((~seen).mean()),
                false_px=float(pixels * ndtr(-k / swept.noise_dn)) if swept.noise_dn > 0 else 0.0,
                r2_max=lines[0][0],
                r2_area=lines[1][0],
                error_max=lines[0][1],
                error_area=lines[1][1],
            )
        )
    return found


def area_r2(swept: Swept) -> Floats:
    """R² (p, s) of the area's line for each k of the picture and each of the surface; NaN where none fits."""
    found = np.full((len(swept.picture_k), len(swept.surface_k)), np.nan)
    for i in range(len(swept.picture_k)):
        seen = swept.area_px[:, i] > 0
        for j in range(len(swept.surface_k)):
            found[i, j] = _fit(swept.area_mm2[seen, j], swept.area_px[seen, i])[0]
    return found


def headline(maps: Sequence[Mapped], kind: str) -> float:
    """Return the press level whose leave-one-out errors are least; an unseen sample is 100 % off."""
    levels = sorted({one.level_mm for one in maps})

    def cost(level: float) -> float:
        costs = []
        for one in maps:
            if (one.level_mm, one.kind) == (level, kind):
                unseen = one.unseen / max(one.unseen + len(one.x), 1)
                costs.append(unseen + (1.0 if one.fit is None else (1 - unseen) * min(one.fit.error, 1.0)))
        return float(np.mean(costs))

    return min(levels, key=cost)


def verdict(
    maps: Sequence[Mapped],
    kind: str,
    level_mm: float,
    ks: Sequence[AtThreshold],
    noise_dn: float,
    k_dn: float,
) -> list[str]:
    """Return the three lines, of one corpus."""
    here = {one.pair.name: one for one in maps if (one.kind, one.level_mm) == (kind, level_mm)}
    what = [_what(here[pair.name]) for pair in PAIRS if pair.name in here]
    where = [_where(here[pair.name]) for pair in PAIRS if pair.name in here]
    unseen = here["max"].unseen if "max" in here else 0
    total = unseen + len(here["max"].x) if "max" in here else 0
    if unseen:
        where.append(
            f"{unseen} of {total} inclusions have no pixel above k = {k_dn:g} counts: no maximum, no area"
        )
    return [
        f"What the map is ({kind}, {level_mm:g} mm): " + "; ".join(what) + ".",
        "Where a line holds: " + "; ".join(where) + ".",
        "What to change: " + "; ".join(_changes(maps, kind, level_mm, here, ks, noise_dn, k_dn)) + ".",
    ]


def _what(one: Mapped) -> str:
    if one.fit is None:
        return f"{one.pair.name}: {one.why}"
    line, pair = one.fit.line, one.pair
    return (
        f"{pair.name} {digits(line.slope)} {pair.picture_unit} per {pair.surface_unit}, R² {line.r2:.3f}, "
        f"leave-one-out {100 * one.fit.error:.1f} % of the span: {state_of(one)}"
    )


def state_of(one: Mapped) -> str:
    """Return a word or two for a map: a line, bent but near one, or none."""
    if one.fit is None:
        return "none"
    if one.fit.adequate:
        return "a line"
    if one.fit.error <= Limits().tolerance:
        return f"nearly a line, bent by {100 * one.fit.bow:.1f} %"
    return "no line"


def _where(one: Mapped) -> str:
    if one.fit is None or one.fit.range is None:
        return f"{one.pair.name} nowhere (within {100 * Limits().tolerance:g} % of the span)"
    low, high = one.fit.range
    return (
        f"{one.pair.name} {digits(low)} to {digits(high)} {one.pair.surface_unit} "
        f"({one.fit.range_count} of {len(one.x)} samples)"
    )


def _changes(
    maps: Sequence[Mapped],
    kind: str,
    level_mm: float,
    here: dict[str, Mapped],
    ks: Sequence[AtThreshold],
    noise_dn: float,
    k_dn: float,
) -> list[str]:
    found = []
    allowed = [one for one in ks if one.k_dn >= SIGMAS * noise_dn and one.k_dn < k_dn]
    if allowed and (now := next((one for one in ks if one.k_dn == k_dn), None)) is not None:
        low = allowed[0]
        if now.unseen_percent - low.unseen_percent >= 5 or low.r2_area > now.r2_area + 0.05:
            found.append(
                f"lower signal.counts from {k_dn:g} to {low.k_dn:g} ({low.k_dn / noise_dn:.1f} times the "
                f"noise of "
                f"{noise_dn:.2f} counts): unseen {now.unseen_percent:.0f} -> {low.unseen_percent:.0f} %, "
                f"R² of the area {now.r2_area:.2f} -> {low.r2_area:.2f}"
            )
    best = headline(maps, kind)
    if best != level_mm:
        found.append(f"press {best:g} mm instead of {level_mm:g}: fewer unseen, straighter")
    bent = [
        f"{one.pair.name} ({one.fit.best}, error {100 * one.fit.error:.1f} -> "
        f"{100 * one.fit.error * one.fit.left_out[one.fit.best] / one.fit.left_out['linear']:.1f} %)"
        for one in here.values()
        if one.fit is not None
        and not one.fit.adequate
        and one.fit.left_out[one.fit.best] < 0.9 * one.fit.left_out["linear"]
    ]
    if bent:
        found.append("use a bent map for " + ", ".join(bent))
    raw = {one.pair.name: one for one in maps if (one.kind, one.level_mm) == ("raw", level_mm)}
    if kind == "raw":
        found.append("tare: a press without inclusion subtracted")
    elif (top := raw.get("max")) is not None and (top.fit is None or top.fit.line.r2 < _HARDLY):
        r2 = 0.0 if top.fit is None else top.fit.line.r2
        found.append(f"keep taring: the raw maximum has R² {r2:.2f}")
    scattered = [
        one.pair.name
        for one in here.values()
        if one.fit is not None
        and min(one.fit.left_out.values()) > Limits().tolerance * one.fit.line.left_out_rmse / one.fit.error
    ]
    if scattered:
        found.append(
            f"do not map {' and '.join(scattered)} one by one: no curve through one scalar comes within "
            f"{100 * Limits().tolerance:g} %, since depth enters; map all three together or train on pictures"
        )
    return found or ["nothing: the lines hold"]


def _fit(x: Floats, y: Floats) -> tuple[float, float]:
    """R² and leave-one-out error in % of the span, NaN where there is nothing to fit."""
    if len(x) < FEWEST or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan"), float("nan")
    line = fit_line(x, y)
    return line.r2, 100.0 * line.left_out_rmse / float(np.ptp(y))
