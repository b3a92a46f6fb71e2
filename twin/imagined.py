"""Specimens as a corpus's study would draw them, as many as one likes, by the chain instead of light."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.features import Features
from estimation.novelty import misaligned
from estimation.posterior import Simulated
from twin.block_noise import noise_variance
from twin.chain import FIELDS, Chain, contacts
from twin.complaint import DesignError, shown
from twin.design import Design
from twin.fields import expand, tables_of
from twin.plan import Plan
from twin.pooled import ENDED
from twin.settling import Setting, drawn
from twin.study import PARAMETERS, parse_study

Single = NDArray[np.float32]
Floats = NDArray[np.float64]

WANTED = PARAMETERS
_AT_ONCE = 64  # specimens whose contacts are worked out together
_DRAWS = 4  # of noise for every specimen
MISALIGNED_PERCENT = 1.0


def specimens(plan: Plan, count: int, seed: int) -> list[dict[str, float]]:
    """Return the values of so many specimens with an inclusion, of the first group that draws them.

    Raises
    ------
    DesignError
        For a corpus without such a group, or one that varies what the chain does not know.
    """
    study = parse_study(plan.head.study)
    group = next((one for one in study.samples if one.inclusion is not None), None)
    if group is None:
        raise DesignError(
            "samples", "tables and grids", "a group that is drawn from ranges", source=plan.name
        )
    tables = tables_of(plan.base)
    varied = tuple(expand(tables, study.randomise))
    check_fields(plan)
    if plan.emulator is None:
        raise DesignError("mechanics", shown(plan.mechanics), '"emulator"', source=plan.name)
    setting = Setting(seed, tables, plan.base, varied, fem.load_emulator(plan.emulator))
    many = replace(group, name="imagined", sampler="uniform", count=count, blanks=0.0)
    columns = drawn(setting, many, Path(), "samples", None, lambda share: None).columns
    names = [*PARAMETERS, *(one.field for one in varied)]
    return [{name: float(columns[name][number]) for name in names} for number in range(count)]


def check_fields(plan: Plan) -> None:
    """Raise `DesignError` where samples differ in what the chain does not know: drawn, or from a table."""
    for field in plan.columns:
        parts = field.split(".")
        known = field in FIELDS or (parts[0] == "leds" and parts[-1] == "flux_W")
        if "." in field and not known and parts[:2] != ["press", "indentation_mm"]:
            allowed = f"{', '.join(FIELDS)}, leds.*.flux_W, press.indentation_mm"
            raise DesignError("what varies", field, allowed, source=plan.name)


def inputs_of(
    chain: Chain,
    emulator: Path,
    values: Sequence[dict[str, float]],
    workers: int,
    tell: Callable[[float], None],
) -> Floats:
    """Return the light map's inputs (n, levels, 2, k) of specimens."""
    parts = [values[at : at + _AT_ONCE] for at in range(0, len(values), _AT_ONCE)]
    found = []
    try:
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            jobs = pool.map(_contacts, [(chain.design, str(emulator), part) for part in parts])
            for number, one in enumerate(jobs, start=1):
                inputs = chain.light.inputs(one.reshape(-1, one.shape[-1]))
                found.append(inputs.reshape(*one.shape[:3], -1))
                tell(number / len(parts))
    except BrokenProcessPool:
        raise ChildProcessError(ENDED) from None
    return np.concatenate(found)


def _contacts(task: tuple[Design, str, list[dict[str, float]]]) -> Single:
    design, emulator, values = task
    return contacts(design, _emulator(emulator), values)


@lru_cache(maxsize=1)
def _emulator(file: str) -> fem.Emulator:
    return fem.load_emulator(file)


@dataclass(frozen=True)
class Brightness:
    """What multiplies the light of specimens: LED powers (n, n_led) W and gains (n,) electrons per count."""

    flux_W: Single
    gain: Single

    @staticmethod
    def of(chain: Chain, values: Sequence[dict[str, float]]) -> Brightness:
        return Brightness(
            np.stack([chain.fluxes(one) for one in values]),
            np.array([chain.gain(one) for one in values], np.float32),
        )


def pictures(chain: Chain, inputs: Floats, brightness: Brightness) -> Single:
    """Return expected coarse counts above black, (n, levels, 2, r, c), for inputs (n, levels, 2, k)."""
    found = np.empty((*inputs.shape[:3], *chain.shape), np.float32)
    for rows in _slices(len(inputs), 128):
        charges = chain.light.at(inputs[rows].reshape(-1, inputs.shape[-1]))
        charges = charges.reshape(*inputs[rows].shape[:3], *chain.light.shape)
        light = np.einsum("nlpiyx,ni->nlpyx", charges, brightness.flux_W[rows], optimize=True)
        found[rows] = light / brightness.gain[rows, None, None, None, None]
    return found


def misaligned_share(seen: Single, rng: np.random.Generator) -> Single:
    """Return pictures (n, levels, 2, r, c), every other one as seen by a camera that stands 1 % off.

    An estimator that knows only perfect alignment is sure of nonsense where a real camera is a little off.
    """
    found = seen.copy()
    off = found[1::2]
    flat = off.reshape(len(off), -1, *off.shape[-2:])
    found[1::2] = misaligned(flat, rng, MISALIGNED_PERCENT).reshape(off.shape)
    return found


def simulate(
    chain: Chain,
    features: Features,
    inputs: Floats,
    values: Sequence[dict[str, float]],
    ranges: NDArray[np.floating],
    error: Single,
    seed: int,
    tell: Callable[[float], None],
) -> Simulated:
    """Return specimens as features, with noise of their own.

    Parameters
    ----------
    inputs : (n, levels, 2, k) of the light map.
    ranges : (5, 2) of `WANTED`, which become 0 to 1.
    error : (m, k) features of the light map's errors.
    """
    n, onto = len(inputs), features.onto
    brightness = Brightness.of(chain, values)
    k = len(features.spread)
    present, absent = np.empty((n, k), np.float32), np.empty((n, k), np.float32)
    noise, reference, stays = (np.empty((n, _DRAWS, k), np.float32) for _ in range(3))
    rng = np.random.default_rng([seed, 1])
    flat = onto.reshape(-1, 2, onto.shape[2], k)
    for rows in _slices(n, 128):
        seen = pictures(chain, inputs[rows], Brightness(brightness.flux_W[rows], brightness.gain[rows]))
        seen = misaligned_share(seen, np.random.default_rng([seed, 2, rows.start]))
        present[rows] = features(seen)
        absent[rows] = features(np.stack([seen[:, :, 1], seen[:, :, 1]], axis=2))
        spreads = [np.sqrt(one) for one in noise_variance(chain.design, seen, brightness.gain[rows])]
        once, always = (one.reshape(*one.shape[:3], -1) for one in spreads)
        for draw in range(_DRAWS):
            for place, pool in ((0, noise), (1, reference)):
                one = once[:, :, place] * rng.standard_normal(once[:, :, place].shape, np.float32)
                pool[rows, draw] = np.einsum("nlm,lmk->nk", one, flat[:, place], optimize=True)
            one = always * rng.standard_normal(always.shape, np.float32)
            stays[rows, draw] = np.einsum("nlpm,lpmk->nk", one, flat, optimize=True)
        tell(rows.stop / n)
    low, high = np.asarray(ranges, np.float64).T
    truth = np.array([[one[name] for name in WANTED] for one in values])
    return Simulated(
        ((truth - low) / (high - low)).astype(np.float32), present, absent, noise, reference, stays, error
    )


def _slices(n: int, step: int) -> Iterator[slice]:
    for start in range(0, n, step):
        yield slice(start, min(start + step, n))
