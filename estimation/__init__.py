"""What pictures say about inclusions: features, what can be known from them, the paper's mapping and network.

The scalars load at once, the rest with its first use. `estimation.scg` and `estimation.ann` import torch and
are imported by themselves, as is `estimation.paper`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from estimation.scalars import scalars

if TYPE_CHECKING:
    from estimation.adequacy import Adequacy, Limits, judge_line
    from estimation.budget import Budget, error_budget
    from estimation.detection import deflection, ideal_auc, signal_weight
    from estimation.information import (
        Bound,
        Information,
        Noise,
        bound,
        fisher,
        inform,
        pixel_information,
        van_trees,
    )
    from estimation.regression import Line, fit_line

__all__ = [
    "Adequacy",
    "Bound",
    "Budget",
    "Information",
    "Limits",
    "Line",
    "Noise",
    "bound",
    "deflection",
    "error_budget",
    "fisher",
    "fit_line",
    "ideal_auc",
    "inform",
    "judge_line",
    "pixel_information",
    "scalars",
    "signal_weight",
    "van_trees",
]

_LATER = {
    **dict.fromkeys(("Adequacy", "Limits", "judge_line"), "adequacy"),
    **dict.fromkeys(("Budget", "error_budget"), "budget"),
    **dict.fromkeys(("deflection", "ideal_auc", "signal_weight"), "detection"),
    **dict.fromkeys(("Bound", "Information", "Noise", "bound", "fisher"), "information"),
    **dict.fromkeys(("inform", "pixel_information", "van_trees"), "information"),
    **dict.fromkeys(("Line", "fit_line"), "regression"),
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
