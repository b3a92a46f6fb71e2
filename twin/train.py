"""`twin train`: from a corpus to an estimator that says how sure it is.

The corpus teaches how contact becomes light (`estimation.light_map`); with that and the corpus's emulator any
number of specimens are imagined (`twin.imagined`), and a flow learns their posterior
(`estimation.posterior`). Samples of the group "test" are kept out of all this, and tell how well it does.
What is done is kept in MODEL.parts.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray

import fem
from estimation import light_map
from estimation.features import Features, compress
from estimation.posterior import MOST_FRAMES, Simulated, Training, device_of, restored
from estimation.posterior import train as train_network
from scenes import traced
from twin import assess, likeness
from twin.block_noise import mean_variance
from twin.chain import BLOCK, Chain, coarse_charges, contacts
from twin.complaint import DesignError, shown
from twin.corpus import Corpus
from twin.design import Design
from twin.estimator import Estimator, black
from twin.estimator_file import save_estimator, shares_of, without_luminaires
from twin.fields import tables_of
from twin.fitting import prior_of
from twin.frame import versions
from twin.imagined import (
    WANTED,
    Brightness,
    inputs_of,
    misaligned_share,
    pictures,
    simulate,
    specimens,
)

Progress = Callable[[str, float], None]
Single = NDArray[np.float32]
Floats = NDArray[np.float64]

TEST = "test"
"""Name of the group that nothing is learned from."""
IMAGINED = 16_000
_LEAST = 30  # samples that a light map is learned from
_SHOWN = 2500  # specimens that features are found from
_STEPS = 12_000
LIKE = 600  # specimens that likeness is learned from
REFUSE_BELOW = 0.005


@dataclass(frozen=True)
class Seen:
    """Samples of a corpus: their numbers, values by name, contacts and coarse light.

    Attributes
    ----------
    contacts : (n, levels, 2, d).
    charges : (n, levels, 2, n_led, r, c) electrons per watt of each LED.
    """

    numbers: NDArray[np.int64]
    values: list[dict[str, float]]
    blank: NDArray[np.bool_]
    contacts: Single
    charges: Single

    def of(self, rows: NDArray[Any]) -> Seen:
        """Return some of them."""
        places = np.arange(len(self.numbers))[rows]
        values = [self.values[place] for place in places]
        return Seen(self.numbers[rows], values, self.blank[rows], self.contacts[rows], self.charges[rows])


def train(
    corpus: str | Path,
    out: str | Path,
    *,
    levels: Sequence[int] | None = None,
    minutes: float = 20.0,
    seed: int = 0,
    imagined: int | None = None,
    samples: int | None = None,
    workers: int | None = None,
    lean: bool = False,
    device: str = "auto",
    progress: Progress | None = None,
) -> str:
    """Train an estimator on a corpus, write it as OUT.safetensors and OUT.json, and say how well it does.

    Parameters
    ----------
    levels : press levels to use, by number; all by default.
    minutes : the longest that the network is trained.
    imagined : specimens that it is trained on, 100 or more; by default `IMAGINED`.
    samples : of the corpus that the light map is learned from, at most; all by default.
    lean : as of `twin.estimator_file.save_estimator`.
    device : what the network is trained on, as of `estimation.posterior.device_of`.

    Raises
    ------
    DesignError
        In one line, for a corpus that cannot teach this.
    DeviceError
        In one line, for a device that is not there.
    """
    tell, imagined = progress or (lambda stage, share: None), imagined or IMAGINED
    device = device_of(device)
    source, place = Corpus(corpus), Path(f"{out}.safetensors")
    parts = place.with_name(place.name.removesuffix(".safetensors") + ".parts")
    plan = source.plan
    design = of_levels(source, levels)
    groups = np.array([plan.group(int(number)) for number in source.samples])
    learned = np.flatnonzero(groups != TEST)[:samples]
    if len(learned) < _LEAST:
        allowed = f"{_LEAST} or more outside the group {TEST!r}"
        raise DesignError("samples", f"{len(learned)} samples", allowed, source=source.name)
    many = specimens(plan, imagined, seed)
    if plan.emulator is None:
        raise DesignError("mechanics", shown(plan.mechanics), '"emulator"', source=source.name)
    emulator = fem.load_emulator(plan.emulator)
    lights = () if plan.traced is None else traced.load(plan.traced)
    if lean:
        shares_of(plan.emulator.read_bytes(), lights)  # refused now, not in an hour
    chosen = tuple(range(source.levels)) if levels is None else tuple(levels)
    parts.mkdir(parents=True, exist_ok=True)
    seen = gather(source, emulator, parts, lambda share: tell("pictures", 0.2 * share))
    seen = replace(
        seen,
        values=[level_names(one, chosen) for one in seen.values],
        contacts=seen.contacts[:, list(chosen)],
        charges=seen.charges[:, list(chosen)],
    )
    learning, testing = seen.of(learned), seen.of(groups == TEST)
    many = [level_names(one, chosen) for one in many]
    chain, errors = learn_light(design, emulator, learning)
    inputs = inputs_of(
        chain,
        plan.emulator,
        many,
        workers or os.cpu_count() or 1,
        lambda share: tell("specimens", 0.2 + 0.2 * share),
    )
    features = features_of(chain, inputs[:_SHOWN], many[:_SHOWN])
    error = features(errors) + features.mean @ features.axes.T
    ranges = np.array([_range(plan, name) for name in WANTED])
    told = simulate(
        chain, features, inputs, many, ranges, error, seed, lambda s: tell("noise", 0.4 + 0.1 * s)
    )
    key = hashlib.sha256(
        repr((plan.digest, chosen, seed, imagined, samples, versions())).encode() + told.present.tobytes()
    ).hexdigest()[:16]
    network = _network(told, parts / f"{key}.safetensors", minutes, seed, device, tell)
    estimator = Estimator(
        {
            "name": place.name.removesuffix(".safetensors"),
            "corpus": source.name,
            "design": without_luminaires(tables_of(design)),
            "design_sha256": plan.head.design_sha256,
            "shape": list(source.shape),
            "bits": design.camera.bits,
            "colour": design.camera.colour,
            "indentation_mm": list(design.press.indentation_mm),
            "frames": [1, MOST_FRAMES],
            "ranges": {name: list(map(float, ranges[place])) for place, name in enumerate(WANTED)},
            "refuse_below": REFUSE_BELOW,
            "block": list(BLOCK),
            "seed": seed,
            "samples": {"learned": len(learning.numbers), "test": len(testing.numbers), "imagined": imagined},
            "versions": versions(),
        },
        chain,
        features,
        network,
        prior_of(ranges, many),
        np.asarray(error.T @ error / max(len(error), 1), np.float64),
        likeness_of(chain, inputs[:LIKE], many[:LIKE], errors, seed),
        lights,
    )
    metrics: dict[str, Any] = {}
    if len(testing.numbers):
        metrics = assess.assess(
            estimator, source, testing, chosen, seed, lambda s: tell("test", 0.9 + 0.1 * s)
        )
    estimator = replace(estimator, card={**estimator.card, "metrics": metrics})
    save_estimator(estimator, plan.emulator.read_bytes(), place, lean=lean)
    return assess.words(metrics, str(place))


def of_levels(source: Corpus, levels: Sequence[int] | None) -> Design:
    design = source.plan.base
    check_camera(source)
    if design.camera.colour != "mono":
        raise DesignError("camera.colour", shown(design.camera.colour), '"mono"', source=source.name)
    if levels is None:
        return design
    for level in levels:
        if level not in range(source.levels):
            allowed = f"some of 0 to {source.levels - 1}"
            raise DesignError("levels", shown(level), allowed, source=source.name)
    depths = tuple(design.press.indentation_mm[level] for level in levels)
    return replace(design, press=replace(design.press, indentation_mm=depths))


def check_camera(source: Corpus) -> None:
    """Refuse pictures that are means of exposures, for estimators learn from single ones and take means of
    these; and stray light, of which they know nothing."""
    camera = source.design.camera
    if camera.frames != 1:
        allowed = "1: estimators learn from single exposures"
        raise DesignError("camera.frames", shown(camera.frames), allowed, source=source.name)
    if camera.ambient > 0.0:
        allowed = "0: estimators know of no stray light"
        raise DesignError("camera.ambient", shown(camera.ambient), allowed, source=source.name)


def level_names(values: dict[str, float], levels: Sequence[int]) -> dict[str, float]:
    """Values with the press depths of these levels only, under their new numbers."""
    start = "press.indentation_mm."
    found = {name: value for name, value in values.items() if not name.startswith(start)}
    return found | {
        f"{start}{new}": values[f"{start}{old}"]
        for new, old in enumerate(levels)
        if f"{start}{old}" in values
    }


def _range(plan: Any, name: str) -> tuple[float, float]:
    values = plan.columns[name][~plan.columns["blank"]]
    from twin.study import parse_study

    group = next(one for one in parse_study(plan.head.study).samples if one.inclusion is not None)
    assert group.inclusion is not None
    low, high = group.inclusion.span(name)
    return (low, high) if high > low else (float(values.min()) - 1e-3, float(values.max()) + 1e-3)


def gather(source: Corpus, emulator: fem.Emulator, parts: Path, tell: Callable[[float], None]) -> Seen:
    """Return a corpus's samples; what was read before is kept in the folder ``parts``."""
    plan, base = source.plan, source.plan.base
    kept = parts / f"pictures-{plan.digest[:16]}.npz"
    old: dict[int, tuple[Single, Single]] = {}
    if kept.is_file():
        with np.load(kept, allow_pickle=False) as file:
            old = {
                int(n): (x, y)
                for n, x, y in zip(file["numbers"], file["contacts"], file["charges"], strict=True)
            }
    found, before = [], len(old)
    for count, number in enumerate(source.samples):
        number = int(number)
        if number not in old:
            values = {k: v for k, v in plan.parameters(number).items() if v is not None}
            blank = plan.inclusion(number) is None
            old[number] = (
                contacts(base, emulator, [values], [blank])[0],
                np.stack([charges_of(source, number, level) for level in range(source.levels)]),
            )
            if count % 100 == 99:
                _keep(kept, old)
        found.append(old[number])
        tell((count + 1) / len(source.samples))
    if len(old) > before:
        _keep(kept, old)
    return Seen(
        np.asarray(source.samples),
        [{k: v for k, v in plan.parameters(int(n)).items() if v is not None} for n in source.samples],
        np.array([plan.inclusion(int(n)) is None for n in source.samples]),
        np.stack([one[0] for one in found]),
        np.stack([one[1] for one in found]),
    )


def _keep(place: Path, samples: dict[int, tuple[Single, Single]]) -> None:
    part = place.with_name(f".{place.name}.{os.getpid()}.part.npz")
    np.savez(
        part,
        allow_pickle=False,
        numbers=np.array(list(samples)),
        contacts=np.stack([one[0] for one in samples.values()]),
        charges=np.stack([one[1] for one in samples.values()]),
    )
    os.replace(part, place)


def charges_of(source: Corpus, number: int, level: int) -> Single:
    """Return coarse light of a picture and its reference, (2, n_led, r, c) electrons per watt of each LED."""
    design = source.design_of(number)
    flux = np.array([led.flux_W for led in design.leds], np.float32)[:, None, None]
    both = (source.layers(number, level), source.reference_layers(number, level))
    found = []
    for layers in both:
        found.append(coarse_charges(design, layers) / flux)
    return np.stack(found)


def learn_light(
    design: Design, emulator: fem.Emulator, seen: Seen, most: int = light_map.MOST
) -> tuple[Chain, Single]:
    """Return the chain, and its errors of pictures left out, (n, levels, 2, r, c) counts of all LEDs.

    No more samples are taken than `most` pictures come from.
    """
    levels = seen.contacts.shape[1]
    seen = seen.of(np.arange(min(len(seen.numbers), most // (2 * levels))))
    n = len(seen.numbers)
    light, left = light_map.learn(
        seen.contacts.reshape(n * levels * 2, -1),
        seen.charges.reshape(n * levels * 2, *seen.charges.shape[3:]),
        np.repeat(np.arange(n), levels * 2),
    )
    chain = Chain(design, emulator, light)
    bright = Brightness.of(chain, seen.values)
    scale = bright.flux_W / bright.gain[:, None]
    errors = np.einsum("nlpiyx,ni->nlpyx", left.reshape(seen.charges.shape), scale, optimize=True)
    return chain, np.asarray(errors, np.float32)


def features_of(chain: Chain, inputs: Floats, values: Sequence[dict[str, float]]) -> Features:
    """Return the features of pictures of these specimens."""
    bright = Brightness.of(chain, values)
    seen = misaligned_share(pictures(chain, inputs, bright), np.random.default_rng(0))
    variance = mean_variance(chain.design, seen, bright.gain, 1.0).mean(axis=(0, 3, 4))
    return compress(seen, np.sqrt(np.stack([variance.sum(axis=1), variance[:, 1]], axis=1)))


def likeness_of(
    chain: Chain, inputs: Floats, values: Sequence[dict[str, float]], errors: Single, seed: int
) -> dict[str, NDArray[Any]]:
    """Return what `likeness.likeness` needs, of pictures with the light map's errors in them."""
    rng = np.random.default_rng([seed, 3])
    seen = pictures(chain, inputs, Brightness.of(chain, values))
    seen += errors[rng.integers(len(errors), size=len(seen))] + np.float32(black(chain))
    return dict(likeness.learn(seen[:, :, 0], seen[:, :, 1], chain.design.camera, BLOCK[0], seed))


def _network(told: Simulated, place: Path, minutes: float, seed: int, device: str, tell: Progress) -> Any:
    """Train the network, from where it was left."""
    training = Training.begin(told, seed, device)
    best: dict[str, torch.Tensor] | None = None
    memory = place.with_suffix(".json")
    spent = 0.0
    if place.is_file() and memory.is_file():
        state, said = safetensors.torch.load_file(place), json.loads(memory.read_bytes())
        if said.get("sha256") == hashlib.sha256(place.read_bytes()).hexdigest():
            training.restore(state, said)
            best = {n.removeprefix("best."): v for n, v in state.items() if n.startswith("best.")}
            spent = float(said["seconds"])
    began = time.monotonic()

    def keep(state: dict[str, torch.Tensor]) -> None:
        arrays = {**training.state(), **{f"best.{name}": value for name, value in state.items()}}
        data = safetensors.torch.save({name: value.contiguous() for name, value in arrays.items()})
        said = {
            "step": training.step,
            "best": training.best,
            "seconds": spent + time.monotonic() - began,
            "sha256": hashlib.sha256(data).hexdigest(),
        }
        for path, text in ((place, data), (memory, json.dumps(said).encode())):
            part = path.with_name(f".{path.name}.{os.getpid()}.part")
            part.write_bytes(text)
            os.replace(part, path)

    def on(step: int, loss: float) -> None:
        share = max(step / _STEPS, (spent + time.monotonic() - began) / (60.0 * minutes))
        tell("network", 0.5 + 0.4 * min(share, 1.0))

    best = train_network(
        training,
        told,
        steps=_STEPS,
        seed=seed,
        until=began + 60.0 * minutes - spent,
        best=best,
        tell=on,
        keep=keep,
    )
    return restored(training.network.size, best)
