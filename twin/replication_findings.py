"""What a replication comes to: its numbers for JSON, the goal, what E is worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation import paper
from twin.replication import FROM_MM, GOAL, LARGE, Crossed, Replication

Floats = NDArray[np.float64]


def figures_of(
    truth: Floats, estimate: Floats, places: Sequence[int] | None = None
) -> dict[str, list[float]]:
    """Return MAE, RMSE and bias, three numbers each, over all nine phantoms or some."""
    some = np.arange(len(truth)) if places is None else np.asarray(places)
    found = paper.errors(truth[some], estimate[some])
    return {"mae": found.mae.tolist(), "rmse": found.rmse.tolist(), "bias": found.bias.tolist()}


def as_json(found: Replication) -> dict[str, Any]:
    """Return every number of the replication, under names that stay."""
    truth, published = paper.true_inclusions(), paper.published_estimates()
    prior, mean = paper.constant(truth, paper.prior_mean()), paper.constant(truth)

    def both(estimate: Floats) -> dict[str, Any]:
        return {"all": figures_of(truth, estimate), "large": figures_of(truth, estimate, LARGE.tolist())}

    best = found.best()
    line, off, met = linear(found)
    return {
        "parameters": list(paper.PARAMETERS),
        "paper": {
            "table1": truth,
            "table2": published,
            "table3_printed": paper.published_errors(),
            "recomputed": both(published),
        },
        "constants": {"prior_mean": both(prior), "mean_of_the_nine": both(mean)},
        "trained": found.trained,
        "repeats": found.repeats,
        "seed": found.seed,
        "main_mm": found.main_mm,
        "k_dn": found.k_dn,
        "low_k_dn": found.low_k_dn,
        "noise_dn": found.noise_dn,
        "chosen": {"variant": found.chosen[0], "k_dn": found.chosen[1]},
        "runs": [
            {
                "variant": run.variant.name,
                "words": run.variant.words,
                "protocol": run.protocol,
                "level_mm": list(run.level_mm),
                "k_dn": run.k_dn,
                "estimate": run.estimate,
                "spread": run.spread,
                **both(run.estimate),
            }
            for run in found.runs
        ],
        "earlier": [
            {"name": one.name, "words": one.words, "estimate": one.estimate, **both(one.estimate)}
            for one in found.earlier
        ],
        "cross_validated": [
            {
                "variant": one.variant.name,
                "level_mm": list(one.level_mm),
                "k_dn": one.k_dn,
                "rmse_from_4_mm": one.rmse,
                "half_width_90": one.half_width,
                "explained": one.explained,
            }
            for one in found.crossed
        ],
        "modulus": {
            "half_width_90_kPa": best.half_width[2],
            "explained": best.explained[2],
            "words": worth_of_modulus(found),
        },
        "goal": goal(found),
        "goal_with_a_linear_mapping": {
            "variant": line.variant.name,
            "k_dn": line.k_dn,
            "rmse": off,
            "met": met,
        },
    }


def goal(found: Replication) -> dict[str, Any]:
    """Return whether the chosen chain, by 125/9 at the main level, does what three scalars should."""
    name, k = found.chosen
    run = found.run(name, "125/9", (found.main_mm,), k)
    reached = paper.rmse(paper.true_inclusions()[LARGE], run.estimate[LARGE])
    plain = found.run("paper", "125/9", (found.main_mm,), found.k_dn)
    first = paper.rmse(paper.true_inclusions()[LARGE], plain.estimate[LARGE])
    return {
        "rmse_mm": {key: float(reached[i]) for i, key in enumerate(GOAL)},
        "plain_rmse_mm": {key: float(first[i]) for i, key in enumerate(GOAL)},
        "allowed_mm": GOAL,
        "met": all(reached[i] <= limit for i, limit in enumerate(GOAL.values())),
        "met_by_the_plain_chain": all(first[i] <= limit for i, limit in enumerate(GOAL.values())),
    }


def linear(found: Replication) -> tuple[Crossed, Floats, bool]:
    """Return the chain with a linear mapping that did best on the random inclusions, its RMSE (3,) on the
    large phantoms by 125/9, and whether that meets the goal."""
    some = [
        one for one in found.crossed if one.variant.mapping in ("lines", "joint") and not one.variant.logs
    ]
    best = min(some, key=lambda one: float(((one.rmse / one.truth.std(axis=0))[:2] ** 2).sum()))
    run = found.run(best.variant.name, "125/9", (found.main_mm,), best.k_dn)
    off = paper.rmse(paper.true_inclusions()[LARGE], run.estimate[LARGE])
    return best, off, all(off[i] <= limit for i, limit in enumerate(GOAL.values()))


def worth_of_modulus(found: Replication) -> str:
    """Say plainly what the estimated modulus is worth, from the random inclusions."""
    best = found.best()
    most = max(float(one.explained[2]) for one in found.crossed)
    half, share = float(best.half_width[2]), float(best.explained[2])
    some = best.truth[best.truth[:, 0] >= FROM_MM, 2]
    prior = float(np.quantile(np.abs(some - some.mean()), 0.9))
    if max(share, most) < 0.1:
        verdict = "it is worth nothing, the mean of the training set does as well"
    elif share < 0.5:
        verdict = "it tells soft from stiff at best"
    else:
        verdict = "it is an estimate"
    return (
        f"E from three scalars (the chosen chain, random inclusions of 4 mm and more): 90 % lie within "
        f"±{half:.0f} kPa "
        f"of the estimate, and within ±{prior:.0f} kPa of a constant; it explains "
        f"{100 * max(share, 0.0):.0f} % of the "
        f"variance, the best of all chains {100 * max(most, 0.0):.0f} %: {verdict}."
    )
