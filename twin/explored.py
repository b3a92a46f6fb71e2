"""What an exploration leaves on disk: a folder for each layout, written whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tomllib
import uuid
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from estimation.budget import error_budget
from twin.complaint import DesignError
from twin.design import Design
from twin.evaluate import Evaluation, Judged
from twin.fields import tables_of

EVALUATION, PICTURES, DESIGN = "evaluation.json", "pictures.npz", "design.toml"
WANTED = ("size_mm", "depth_mm", "modulus_kPa")


def write_trial(folder: Path, evaluation: Evaluation, values: Mapping[str, Any], number: int | None) -> None:
    """Write `evaluation.json`, `pictures.npz` and `design.toml` into a new folder that appears whole.

    `pictures.npz` holds of inclusion k: `mean_k`, `layers_k`, `jacobian_k` as in `evaluate.Judged`, of the
    unknowns `names`; `fisher_k` and `prior_k`.
    """
    arrays: dict[str, Any] = {}
    for number_, one in enumerate(evaluation.judged):
        arrays[f"mean_{number_}"] = one.mean
        arrays[f"layers_{number_}"] = one.layers
        kept = [one.names.index(name) for name in WANTED if name in one.names]
        arrays[f"jacobian_{number_}"] = one.jacobian[kept]
        arrays[f"fisher_{number_}"], arrays[f"prior_{number_}"] = (
            one.information.fisher,
            one.information.prior,
        )
    names = evaluation.judged[0].names
    arrays["names"] = np.array(names)
    arrays["jacobian_names"] = np.array([name for name in WANTED if name in names])
    record = {
        "number": number,
        "state": "complete",
        "values": dict(values),
        "protocol": asdict(evaluation.layout.protocol),
        "objectives": evaluation.objectives,
        "unknowns": [asdict(unknown) for unknown in evaluation.unknowns],
        "inclusions": [_inclusion(one) for one in evaluation.judged],
        "block": evaluation.block,
        "seconds": evaluation.seconds,
    }
    with _whole(folder) as place:
        with (place / PICTURES).open("wb") as file:
            np.savez_compressed(file, **arrays)
        design = evaluation.layout.design
        note = "# " + "; ".join(f"{name} = {value}" for name, value in values.items()) if values else ""
        (place / DESIGN).write_text(f"{note}\n{design_toml(design)}".lstrip(), encoding="utf-8")
        _json(place / EVALUATION, record)


def write_infeasible(folder: Path, reason: str, values: Mapping[str, Any], number: int) -> None:
    """Write `evaluation.json` of a layout that cannot be, with its reason."""
    with _whole(folder) as place:
        record = {"number": number, "state": "infeasible", "reason": reason, "values": dict(values)}
        _json(place / EVALUATION, record)


def read(folder: Path) -> dict[str, Any] | None:
    """Return `evaluation.json` of a layout's folder, None where there is none."""
    try:
        found = json.loads((folder / EVALUATION).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def design_toml(design: Design) -> str:
    """Return a design as the TOML that `twin simulate` reads, wherever it is put."""
    tables = tables_of(design)
    for led in tables["leds"]:
        if led["ies"] is not None:
            led["ies"] = str(Path(led["ies"]).resolve())
    text = _toml(tables, "")
    tomllib.loads(text)
    return text


def _toml(table: Mapping[str, Any], name: str) -> str:
    plain = {k: v for k, v in table.items() if not _nested(v) and v is not None}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in plain.items()]
    text = "\n".join(lines) + "\n" if lines else ""
    for key, value in table.items():
        if not _nested(value):
            continue
        full = f"{name}.{key}" if name else key
        if isinstance(value, Mapping):
            text += f"\n[{full}]\n{_toml(value, full)}"
        else:
            text += "".join(f"\n[[{full}]]\n{_toml(one, full)}" for one in value)
    return text


def _nested(value: Any) -> bool:
    return isinstance(value, Mapping) or (
        isinstance(value, list | tuple) and bool(value) and all(isinstance(one, Mapping) for one in value)
    )


def _inclusion(one: Judged) -> dict[str, Any]:
    ball, budget = one.inclusion, None
    wanted = [name for name in WANTED if name in one.names]
    if wanted:
        found = error_budget(one.information, wanted)
        budget = {
            "wanted": wanted,
            "sd": found.sd.tolist(),
            "best": found.best.tolist(),
            "costs": [
                {
                    "name": cost.name,
                    **{k: getattr(cost, k).tolist() for k in ("known", "halved", "alone", "cost")},
                }
                for cost in found.costs
            ],
        }
    return {
        "size_mm": ball.size,
        "depth_mm": ball.depth,
        "modulus_kPa": ball.modulus,
        "offset_mm": list(ball.offset),
        "sd": one.sd,
        "budget": budget,
    }


class _whole:
    """A folder in the making beside its place, moved there when the block ends well."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.part = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}")

    def __enter__(self) -> Path:
        self.part.mkdir(parents=True)
        return self.part

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is not None:
            shutil.rmtree(self.part, ignore_errors=True)
            return
        if self.folder.exists():  # left by a worker that was cut off before it told the storage
            shutil.rmtree(self.folder, ignore_errors=True)
        os.replace(self.part, self.folder)


def _json(path: Path, record: Any) -> None:
    try:
        text = json.dumps(record, indent=1, allow_nan=False)
    except ValueError:
        raise DesignError("evaluation", "a number that is not finite", "finite ones") from None
    path.write_text(text + "\n", encoding="utf-8")
