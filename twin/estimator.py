"""A trained estimator: from a sensor's pictures to the posterior of the inclusion's size, depth and modulus.

A model is two files: NAME.safetensors holds arrays only (network, light map, features, likeness, the emulator
of the mechanics), NAME.json its card. Neither can run code.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
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
from estimation.posterior import MOST_FRAMES, REFERENCE_FRAMES, Posterior, restored
from scenes import traced
from scenes.sensor import NotModelled
from scenes.traced import TracedLight
from twin import likeness
from twin.chain import BLOCK, Chain, whole_blocks
from twin.complaint import DesignError, shown
from twin.design import parse_design
from twin.estimates import NAMES, Estimate
from twin.fitting import Fitted, Near, Prior, fit, limits
from twin.imagined import mean_variance
from twin.put_back import put_back, where
from twin.received import Received
from twin.refining import Refined, refine
from twin.rendered import rendered as render
from twin.retake import average

FORMAT = "tsis-estimator-2"
_LEFT_PERCENT = 0.05  # of misalignment, standard deviation, after pictures were put back
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

Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Estimator:
    """What a sensor's pictures tell, as it was trained; see `load_estimator`."""

    card: dict[str, Any]
    chain: Chain
    features: Features
    network: Posterior
    prior: Prior
    error: NDArray[np.float64]
    """(k, k) covariance of the features' errors of the chain."""
    novelty: Mapping[str, NDArray[Any]]
    """What `twin.likeness.learn` gave."""
    traced: tuple[TracedLight, ...] = ()
    """Learned light of each band, to render with; none where the corpus was traced press by press."""

    def estimate(
        self, received: Received, *, samples: int = 4000, seed: int = 0, rendered: bool = True
    ) -> Estimate:
        """Return what is known after the pictures; ``samples`` of the posterior are drawn from ``seed``.

        The network's answer is refined by rendering (`refining.refine`; ten seconds), unless ``rendered`` is
        False, the pictures are refused or hold no inclusion, or what is rendered does not explain them, even
        if the camera stands a little off.
        """
        seen, frames = self.coarse(received), exposures(received)
        counts = seen + black(self.chain)
        like, strangest = likeness.likeness(self.novelty, counts[:, 0], counts[:, 1])
        told = self.features(seen[None])
        presence = float(self.network.present(told, frames)[0])
        drawn = self.unscaled(self.network.sample(told, frames, samples, seed)[0])
        reason = None
        if like < self.card["refuse_below"]:
            reason = f"pictures unlike this sensor's: {strangest}"
        refined = None
        if rendered and self.traced and reason is None and presence >= 0.5:
            start = drawn.mean(axis=0)
            refined = self.refined(told[0], frames, start, samples=samples, seed=seed)
            if refined is None or not refined.explains:
                again, back = self._put_back(received, frames, start, samples, seed)
                if again is not None:
                    refined, seen = again, back
        fitted = self.fitted(told[0], frames, drawn.mean(axis=0)) if refined is None else refined.fitted
        trusted = refined is not None and refined.explains
        wanted = (refined.samples if refined is not None and trusted else drawn)[:, : len(NAMES)]
        gain = np.array([self.chain.gain(self.prior.values(fitted.x[: len(self.prior.middle)]))])
        variance = mean_variance(self.chain.design, seen[None], gain, frames)[0]
        return Estimate(
            NAMES,
            wanted,
            wanted.mean(axis=0),
            np.cov(wanted.T),
            np.percentile(wanted, [5.0, 95.0], axis=0).T,
            presence,
            like,
            reason,
            np.asarray(seen[:, 0] - seen[:, 1], np.float64),
            np.asarray(fitted.pictures[:, 0] - fitted.pictures[:, 1], np.float64),
            np.sqrt(variance.sum(axis=1, dtype=np.float64)),
            "rendered" if trusted else "network",
            fitted.chi_square / len(self.features.spread),
        )

    def refined(
        self,
        told: Single,
        frames: float,
        start: NDArray[np.floating],
        *,
        samples: int = 4000,
        seed: int = 0,
        begin: Near | None = None,
        prior: Prior | None = None,
        threads: int | None = None,
    ) -> Refined | None:
        """Return the posterior of features (k,) by rendering, from a start (5,); None where the best fit lies
        beyond what the emulator or the learned light know."""
        prior = prior or self.prior
        x = np.concatenate([start, np.zeros(prior.basis.shape[1])])
        try:
            return refine(
                self.chain,
                self.features,
                prior,
                self.error,
                told,
                frames,
                x,
                lambda values: render(self.chain, self.traced, values, threads=threads),
                samples=samples,
                seed=seed,
                begin=begin,
            )
        except (fem.NotModelled, NotModelled):
            return None

    def _put_back(
        self, received: Received, frames: float, start: NDArray[np.floating], samples: int, seed: int
    ) -> tuple[Refined | None, Single]:
        """Return what `refined` does of pictures of a camera that stands a little off, and these pictures put
        back; blocks that it has not seen are those that are expected."""
        parts = (self.chain, self.features, self.error, self.coarse)
        matrix = where(*parts, self.prior.of_another_camera(self._pattern), received, start)
        now, blocks = put_back(received, matrix)
        left = self.prior.of_another_camera(self._pattern, _LEFT_PERCENT)
        placed = replace(self, features=self.features.only(blocks), prior=left)
        back = self.coarse(now)
        found = placed.refined(placed.features(back[None])[0], frames, start, samples=samples, seed=seed)
        return found, back if found is None else np.where(blocks, back, found.fitted.pictures)

    @property
    def _pattern(self) -> float:
        return 0.01 * likeness.PATTERN * self.chain.design.camera.prnu_percent

    def coarse(self, received: Received) -> Single:
        """Return coarse counts above black, (levels, 2, r, c)."""
        both = zip(received.images, received.references, strict=True)
        found = np.stack([np.stack([average(whole_blocks(one), BLOCK) for one in pair]) for pair in both])
        return np.asarray(found - black(self.chain) - self.chain.pattern_dn, np.float32)

    def unscaled(self, unit: NDArray[np.floating]) -> NDArray[np.float64]:
        """Parameters (..., 5) from 0 to 1."""
        low, high = self.prior.ranges.T
        return np.asarray(low + (high - low) * unit)

    def limits(self, values: Mapping[str, float], frames: float) -> tuple[NDArray[np.float64], float]:
        """Return the bound and the deflection at true values; see `fitting.limits`."""
        return limits(self.chain, self.features, self.prior, values, frames)

    def fitted(self, told: Single, frames: float, start: NDArray[np.floating]) -> Fitted:
        """Return the most probable specimen by the chain, for features (k,), from a start (5,)."""
        x = np.concatenate([start, np.zeros(self.prior.basis.shape[1])])
        return fit(self.chain, self.features, self.prior, told, frames, x, self.error)


def black(chain: Chain) -> float:
    """Counts of a pixel without light."""
    return chain.design.camera.offset_dn + chain.dark_dn / chain.design.camera.gain_e_per_dn


def exposures(received: Received) -> float:
    """Return the exposures that pictures count as, where references are the mean of few."""
    variance = 1.0 / received.frames
    if received.reference_frames < max(received.frames, REFERENCE_FRAMES):
        variance += 1.0 / received.reference_frames - 1.0 / max(received.frames, REFERENCE_FRAMES)
    return float(np.clip(1.0 / variance, 1.0, MOST_FRAMES))


def without_luminaires(tables: dict[str, Any]) -> dict[str, Any]:
    """Design tables without files of luminaires: a model needs none, and a stranger's may name any file."""
    leds = tables.get("leds")
    if not isinstance(leds, list):
        return tables
    return {**tables, "leds": [{**led, "ies": None} if isinstance(led, dict) else led for led in leds]}


def save_estimator(estimator: Estimator, emulator: Path, path: str | Path) -> Path:
    """Write NAME.safetensors and NAME.json; ``path`` is the former's. The card is written last."""
    target = Path(path)
    arrays: dict[str, NDArray[Any]] = {"emulator": np.frombuffer(emulator.read_bytes(), np.uint8)}
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
    for number, one in enumerate(estimator.traced):
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
    place = Path(path)
    name = str(place)
    if place.suffix != ".safetensors":
        place = place.with_name(place.name + ".safetensors")
    if not place.is_file() or not card_of(place).is_file():
        allowed = "a .safetensors file of `twin train`, its .json beside it"
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
        raise DesignError(
            "MODEL", f"files that do not fit ({reason})", "those of `twin train`", source=name
        ) from None


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
    mean, axes, noise, spread = (arrays[f"features.{name}"] for name in ("mean", "axes", "noise", "spread"))
    levels, two, rows, columns = (int(side) for side in card["features"])
    features = Features(mean, axes, noise, spread, (levels, two, rows, columns))
    k = len(features.spread)
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
        and features.axes.shape == (k, int(np.prod(features.shape)))
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
    emulator = fem.load_emulator(BytesIO(arrays["emulator"].tobytes()))
    strange = {
        name.removeprefix("novelty."): value for name, value in arrays.items() if name.startswith("novelty.")
    }
    if not likeness.fits(strange, (features.shape[0], *features.shape[2:])):
        raise ValueError("novelty")
    lights = tuple(
        traced.assembled(
            {name: arrays[f"traced.{number}.{name}"] for name in traced.ARRAYS},
            str(said["key"]),
            int(said["presses"]),
            float(said["error_percent"]),
        )
        for number, said in enumerate(card["traced"])
    )
    chain = Chain(design, emulator, light)
    return Estimator(card, chain, features, network, prior, arrays["error"], strange, lights)
