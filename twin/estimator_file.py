"""The files of a trained estimator.

A model is two files: NAME.safetensors holds arrays only (network, light map, features, likeness, the emulator
of the mechanics, learned light), NAME.json its card. Neither can run code. A lean model holds no emulator and
learned light, but the hashes of those that ship, which it is of no use without.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
import torch
from numpy.typing import NDArray

import fem
from estimation.features import Features
from estimation.light_map import LightMap
from estimation.posterior import restored
from scenes import traced
from scenes.traced import TracedLight
from twin import learned, likeness
from twin.chain import Chain
from twin.complaint import DesignError, shown
from twin.design import parse_design
from twin.discrepancy import Discrepancy
from twin.estimator import Estimator, Sight
from twin.fitting import Prior, apart

FORMAT = "tsis-estimator-3"
_FEATURES = ("mean", "axes", "noise", "spread")
_OFF = tuple(field.name for field in fields(Discrepancy))
_MADE = "those of this version's `twin train` and `twin calibrate`"
_LEAST_FLAT = 0.1  # pictures are divided by it
_CARD_BYTES = 4 * 2**20
_NEEDED = {
    "design": dict,
    "shape": list,
    "bits": int,
    "colour": str,
    "indentation_mm": list,
    "frames": list,
    "ranges": dict,
    "refuse_below": float,
    "network": dict,
    "light": dict,
    "features": list,
    "nuisances": list,
    "traced": list,
    "sha256": str,
}


def without_luminaires(tables: dict[str, Any]) -> dict[str, Any]:
    """Design tables without files of luminaires: a model needs none, and a stranger's may name any file."""
    leds = tables.get("leds")
    if not isinstance(leds, list):
        return tables
    return {**tables, "leds": [{**led, "ies": None} if isinstance(led, dict) else led for led in leds]}


def save_estimator(estimator: Estimator, emulator: bytes, path: str | Path, *, lean: bool = False) -> Path:
    """Write NAME.safetensors and NAME.json; ``path`` is the former's. The card is written last.

    Parameters
    ----------
    emulator : the file of its mechanics.
    lean : without emulator and learned light, half of the size, where they are those that ship.

    Raises
    ------
    DesignError
        For a lean model of others.
    """
    target = Path(path)
    shares = shares_of(emulator, estimator.traced) if lean else None
    arrays: dict[str, NDArray[Any]] = {}
    if shares is None:
        arrays |= {"emulator": np.frombuffer(emulator, np.uint8)}
    parts: dict[str, Any] = {"light": estimator.chain.light, "features": estimator.features}
    for name, part in parts.items():
        arrays |= {
            f"{name}.{field.name}": getattr(part, field.name)
            for field in fields(part)
            if isinstance(getattr(part, field.name), np.ndarray)
        }
    prior = estimator.prior
    arrays |= {"prior.ranges": prior.ranges, "prior.mean": prior.mean, "prior.basis": prior.basis}
    arrays |= {"error": estimator.error}
    if (sight := estimator.calibration) is not None:
        arrays |= {f"sight.{name}": getattr(sight.features, name) for name in _FEATURES}
        assert sight.discrepancy is not None  # a calibration is made of one
        arrays |= {"sight.error": sight.error}
        arrays |= {f"sight.{name}": value for name, value in vars(sight.discrepancy).items()}
    for number, one in enumerate(() if shares else estimator.traced):
        arrays |= {f"traced.{number}.{name}": getattr(one, name) for name in traced.ARRAYS}
    arrays |= {f"novelty.{name}": np.asarray(value) for name, value in estimator.novelty.items()}
    arrays |= {f"network.{k}": v.detach().numpy() for k, v in estimator.network.state_dict().items()}
    data = safetensors.numpy.save({name: np.ascontiguousarray(value) for name, value in arrays.items()})
    card = {
        **estimator.card,
        "format": FORMAT,
        "network": estimator.network.size,
        "light": {"length": estimator.chain.light.length, "shape": list(estimator.chain.light.shape)},
        "features": list(estimator.features.shape),
        "nuisances": list(prior.names),
        "traced": [
            {"key": one.key, "presses": one.presses, "error_percent": one.error_percent}
            for one in estimator.traced
        ],
        "shares": shares,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    for place, text in (
        (target, data),
        (card_of(target), (json.dumps(card, indent=1, allow_nan=False) + "\n").encode()),
    ):
        part = place.with_name(f".{place.name}.{os.getpid()}.part")
        part.write_bytes(text)
        os.replace(part, place)
    return target


def file_of(model: str | Path) -> Path:
    """Return the place of a model's arrays; see `learned.model_file`."""
    return learned.model_file(model)


def card_of(path: Path) -> Path:
    """Return the place of a model's card."""
    return path.with_suffix(".json")


def load_estimator(path: str | Path) -> Estimator:
    """Return a trained estimator; nothing in its files is trusted.

    Raises
    ------
    DesignError
        In one line.
    """
    place, name = file_of(path), str(path)
    if not place.is_file() or not card_of(place).is_file():
        allowed = "a .safetensors file of `twin train`, its .json beside it"
        if learned.models():
            allowed += f", or {', '.join(learned.models())}, which ships"
        raise DesignError("MODEL", shown(name), allowed)
    try:
        card = _card(card_of(place))
        data = place.read_bytes()
        if hashlib.sha256(data).hexdigest() != card["sha256"]:
            raise DesignError("sha256", "other arrays", "those that the card tells of", source=name)
        return _assembled(card, safetensors.numpy.load(data))
    except DesignError as error:
        raise error.renamed(source=error.source or name) from None
    except (
        OSError,
        KeyError,
        IndexError,
        ValueError,
        TypeError,
        OverflowError,
        RecursionError,
        safetensors.SafetensorError,
    ) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DesignError("MODEL", f"files that do not fit ({reason})", _MADE, source=name) from None


def _card(place: Path) -> dict[str, Any]:
    if place.stat().st_size > _CARD_BYTES:
        raise ValueError("the card is too long")
    card = json.loads(place.read_bytes())
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise ValueError(f"format is not {FORMAT}")
    for name, kind in _NEEDED.items():
        if not isinstance(card.get(name), kind):
            raise ValueError(f"{name} is not {kind.__name__}")
    return card


def _assembled(card: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Estimator:
    for name, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ValueError(f"{name} is not finite")
    design = parse_design(without_luminaires(card["design"]))
    said = card["light"]
    light = LightMap(
        arrays["light.centre"],
        arrays["light.axes"],
        arrays["light.nodes"],
        float(said["length"]),
        arrays["light.weights"],
        arrays["light.mean"],
        arrays["light.modes"],
        tuple(int(side) for side in said["shape"]),
    )
    pixels = int(np.prod(light.shape))
    levels, two, rows, columns = (int(side) for side in card["features"])
    features = _features(arrays, "features", (levels, two, rows, columns))
    k = len(features.spread)
    sight = None
    if "sight.error" in arrays:
        own = _features(arrays, "sight", features.shape)
        error, off = arrays["sight.error"], Discrepancy(*(arrays[f"sight.{name}"] for name in _OFF))
        if any(one.shape != (len(own.spread),) * 2 for one in (error, off.common, off.tared)):
            raise ValueError("shapes")
        if off.flat.shape != (levels, rows, columns) or off.share.shape != (levels,):
            raise ValueError("shapes")
        if min(off.flat.min(), off.share.min()) < _LEAST_FLAT:
            raise ValueError("sight.flat, sight.share")
        sight = Sight(own, error, off)
    prior = Prior(
        arrays["prior.ranges"],
        tuple(map(str, card["nuisances"])),
        arrays["prior.mean"],
        arrays["prior.basis"],
    )
    fits = (
        light.axes.shape[0] == len(light.centre)
        and light.nodes.shape == (len(light.weights), light.axes.shape[1])
        and light.modes.shape == (light.weights.shape[1], pixels)
        and light.mean.shape == (pixels,)
        and light.length > 0
        and features.shape[0] == len(design.press.indentation_mm)
        and features.shape[2:] == light.shape[1:]
        and light.shape[0] == len(design.leds)
        and arrays["error"].shape == (k, k)
        and prior.ranges.shape == (5, 2)
        and prior.basis.shape[0] == len(prior.names) == len(prior.mean)
    )
    if not fits:
        raise ValueError("shapes")
    state = {
        name.removeprefix("network."): torch.from_numpy(value.copy())
        for name, value in arrays.items()
        if name.startswith("network.")
    }
    network = restored(card["network"], state)
    if network.size["k"] != k or network.size["p"] != 5:
        raise ValueError("network.size")
    shares = card.get("shares")
    emulator = fem.load_emulator(BytesIO(_emulator(card, arrays)))
    strange = {
        name.removeprefix("novelty."): value for name, value in arrays.items() if name.startswith("novelty.")
    }
    if not likeness.fits(strange, (features.shape[0], *features.shape[2:])):
        raise ValueError("novelty")
    lights = tuple(
        traced.assembled(
            {name: arrays[f"traced.{number}.{name}"] for name in traced.ARRAYS},
            str(said["key"]),
            float(said["error_percent"]),
        )
        for number, said in enumerate(() if shares else card["traced"])
    )
    if shares:
        lights = traced.load(_shipped(shares, "light"))
    chain = Chain(design, emulator, light)
    return Estimator(card, chain, features, network, apart(prior), arrays["error"], strange, lights, sight)


def _features(arrays: dict[str, NDArray[Any]], start: str, shape: tuple[int, int, int, int]) -> Features:
    mean, axes, noise, spread = (arrays[f"{start}.{name}"] for name in _FEATURES)
    if axes.shape != (len(spread), int(np.prod(shape))) or mean.shape != axes.shape[1:]:
        raise ValueError("shapes")
    noise = noise.reshape(*noise.shape, *(1,) * (4 - noise.ndim))  # older models have two axes
    if noise.shape not in ((*shape[:2], 1, 1), shape):
        raise ValueError("shapes")
    return Features(mean, axes, noise, spread, shape)


def emulator_of(path: str | Path) -> bytes:
    """Return the emulator's file in a model's."""
    place = file_of(path)
    with safetensors.safe_open(place, "numpy") as file:
        arrays = {name: file.get_tensor(name) for name in ("emulator",) if name in file.keys()}  # noqa: SIM118
    return _emulator(_card(card_of(place)), arrays)


def _emulator(card: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> bytes:
    shares = card.get("shares")
    return _shipped(shares, "emulator").read_bytes() if shares else arrays["emulator"].tobytes()


def shares_of(emulator: bytes, lights: Sequence[TracedLight]) -> dict[str, str]:
    """Return whose emulator and light a lean model shares, with their hashes. Raises `DesignError` for others
    than those that ship."""
    for name in learned.shipped():
        files = {"emulator": learned.emulator_file(name), "light": learned.light_file(name)}
        light = traced.load(files["light"])
        same = len(light) == len(lights) and all(
            np.array_equal(getattr(one, part), getattr(other, part))
            for one, other in zip(light, lights, strict=True)
            for part in traced.ARRAYS
        )
        if same and files["emulator"].read_bytes() == emulator:
            return {"name": name} | {part: _sha256(place) for part, place in files.items()}
    allowed = f"it for a model of the emulator and learned light that ship ({', '.join(learned.shipped())})"
    raise DesignError("--lean", "it for a model of others", allowed)


def _shipped(shares: Any, part: str) -> Path:
    """Return a file that a lean model shares, if it is still the same."""
    name = shares.get("name") if isinstance(shares, dict) else None
    if name not in learned.shipped():
        raise DesignError("shares", shown(name), ", ".join(learned.shipped()))
    place = learned.emulator_file(name) if part == "emulator" else learned.light_file(name)
    if _sha256(place) != shares.get(part):
        raise DesignError(
            f"shares.{part}", f"that of {name} in another version", "a model trained with this version's"
        )
    return place


def _sha256(place: Path) -> str:
    return hashlib.sha256(place.read_bytes()).hexdigest()
