"""Expected pictures to second order about a truth, and estimators that fit them to noisy, rounded pictures.

Means are µ(δ) = µ + J δ + ½ δᵀ H δ, all three from pictures rendered with the light that was traced in the
middle. H is that of size, depth and modulus; what is left out of it belongs to nuisances that calibration
holds within a thousandth of what would bend the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

import fem
import twin
from estimation.information import Noise, mean_variance, pixel_information
from scenes.camera import expose, fixed_pattern, mean_electrons
from scenes.sensor import Camera
from twin import forward
from twin.exposure import light_seed

Floats = NDArray[np.float64]

_STEPS = {"size_mm": 0.2, "depth_mm": 0.2, "modulus_kPa": 0.1}  # of the curvature; the modulus in e-folds
_CHUNK = 2048  # pixels at a time


@dataclass(frozen=True)
class Expansion:
    """Pictures (k, n) of counts, their Jacobian (p, k, n) and the curvature (k, n) of pairs of unknowns."""

    mean: Floats
    jacobian: Floats
    curvature: dict[tuple[int, int], Floats]

    def rows(self, picture: int) -> Floats:
        """Mean, slopes and curvatures of one picture, (1 + p + c, n)."""
        bends = [each[picture] for each in self.curvature.values()]
        return np.stack([self.mean[picture], *self.jacobian[:, picture], *bends])

    def amounts(self, delta: Floats) -> Floats:
        """How much of each row is in the mean, (m, 1 + p + c), at offsets (m, p)."""
        bends = [delta[:, i] * delta[:, j] * (0.5 if i == j else 1.0) for i, j in self.curvature]
        return np.column_stack([np.ones(len(delta)), delta, *bends])

    def slopes(self, delta: Floats) -> Floats:
        """Derivatives (m, p, 1 + p + c) of the amounts."""
        count, unknowns = delta.shape
        found = np.zeros((count, unknowns, 1 + unknowns + len(self.curvature)))
        found[:, np.arange(unknowns), 1 + np.arange(unknowns)] = 1.0
        for number, (i, j) in enumerate(self.curvature):
            found[:, i, 1 + unknowns + number] = delta[:, j]
            found[:, j, 1 + unknowns + number] = delta[:, i]
        return found


def expand(
    design: twin.Design,
    ball: fem.Inclusion,
    unknowns: Sequence[forward.Unknown],
    emulator: fem.Emulator,
    level: float = 2.0,
) -> tuple[forward.Expected, Expansion, Any]:
    """Return pictures with their slopes, the same to second order, and a function: counts at offsets (p,)."""
    first = forward.expected(design, ball, (level,), unknowns, emulator=emulator)
    stage = forward._Stage(design, ball, (level,), emulator, "preview", light_seed(0))
    middle = stage.pictures((), None)
    middle = replace(middle, mean=stage.pictures((), middle).mean)

    def at(offsets: dict[int, float]) -> Floats:
        moved = []
        for place, offset in offsets.items():
            value = stage.value(unknowns[place].name)
            to = value * np.exp(offset) if unknowns[place].relative else value + offset
            moved.append((unknowns[place].name, float(to)))
        return stage.pictures(tuple(moved), middle).mean.reshape(2, -1)

    step = {place: _STEPS[one.name] for place, one in enumerate(unknowns) if one.name in _STEPS}
    up = {place: at({place: h}) for place, h in step.items()}
    here = middle.mean.reshape(2, -1)
    bends = {}
    for i, j in combinations_with_replacement(step, 2):
        if i == j:
            bends[i, j] = (up[i] - 2 * here + at({i: -step[i]})) / step[i] ** 2
        else:
            bends[i, j] = (at({i: step[i], j: step[j]}) - up[i] - up[j] + here) / (step[i] * step[j])
    jacobian = first.jacobian.reshape(len(unknowns), 2, -1)
    return first, Expansion(here, jacobian, bends), at


def with_pattern(camera: Camera, noise: Noise, rows: Floats) -> Floats:
    """The rows of an expansion as the camera's own pixels respond: its fixed pattern is calibrated."""
    response, dark_e = (part.ravel() for part in fixed_pattern(camera))
    seen = rows * response
    seen[0] = noise.offset_dn + (rows[0] - noise.offset_dn) * response + dark_e / camera.gain_e_per_dn
    return seen


def photograph(
    design: twin.Design, mean: Floats, frames: int, count: int, rng: np.random.Generator
) -> NDArray[Any]:
    """Pictures (count, n) that the camera takes of what has these mean counts (n,) in it."""
    camera, noise = design.camera, forward.noise_of(design)
    light_e = (mean.reshape(camera.shape) - noise.offset_dn) * camera.gain_e_per_dn
    per_radiance = mean_electrons(camera, np.ones(camera.shape), design.light.wavelength_nm)
    radiance = light_e / per_radiance
    taken = [
        expose(camera, radiance, design.light.wavelength_nm, rng, frames=frames).ravel() for _ in range(count)
    ]
    return np.stack(taken)


def score_of_one(counts: Floats, mean: Floats, noise: Noise) -> Floats:
    """Derivative by the mean of the log likelihood of a rounded count whose variance follows the mean."""
    assert noise.bits is not None
    variance = mean_variance(mean, noise)
    sd = np.sqrt(variance)
    low = np.where(counts <= 0, -40.0, (counts - 0.5 - mean) / sd)
    high = np.where(counts >= 2**noise.bits - 1, 40.0, (counts + 0.5 - mean) / sd)
    flip = low > 0
    chance = ndtr(np.where(flip, -low, high)) - ndtr(np.where(flip, -high, low))
    below, above = (np.exp(-0.5 * u * u) / np.sqrt(2 * np.pi) for u in (low, high))
    slope = (below - above) / sd + 0.5 * noise.shot * (low * below - high * above) / variance
    return np.asarray(slope / np.maximum(chance, 1e-300))


class Rounded:
    """Mean and variance of a rounded count over the mean before it was rounded, from a table."""

    def __init__(self, noise: Noise) -> None:
        assert noise.bits is not None
        top = 2**noise.bits - 1
        self.step = 1 / 32 if noise.bits <= 8 else 1 / 2
        at = np.arange(0.0, top + 8.0 * np.sqrt(mean_variance(top, noise)), self.step)
        sd = np.sqrt(mean_variance(at, noise))
        reach = int(np.ceil(8 * sd.max())) + 1
        number = np.clip(np.rint(at), 0, top)[:, None] + np.arange(-reach, reach + 1.0)
        upper = np.where(number >= top, 1.0, ndtr((number + 0.5 - at[:, None]) / sd[:, None]))
        lower = np.where(number <= 0, 0.0, ndtr((number - 0.5 - at[:, None]) / sd[:, None]))
        chance = np.where((number < 0) | (number > top), 0.0, upper - lower)
        self.mean = (chance * number).sum(axis=1)
        self.variance = (chance * (number - self.mean[:, None]) ** 2).sum(axis=1)
        self.slope = np.gradient(self.mean, self.step)
        self.full = top + 4.0 * sd[-1]  # pixels that look at a lamp tell nothing
        self.variance = np.maximum(self.variance, 1e-6)

    def score(self, counts: Floats, mean: Floats, frames: int) -> Floats:
        """Best linear score of the average of so many rounded counts (Godambe's estimating function)."""
        place = np.clip(mean / self.step, 0, len(self.mean) - 1.001)
        whole = place.astype(np.int64)
        part = place - whole

        def table(values: Floats) -> Floats:
            return np.asarray(values[whole] * (1 - part) + values[whole + 1] * part)

        told = (counts - table(self.mean)) * table(self.slope) * frames / table(self.variance)
        return np.where(mean < self.full, told, 0.0)


def fit(
    pictures: Sequence[tuple[NDArray[Any], Floats, Noise]],
    expansion: Expansion,
    precision: Floats,
    calibrated: Floats,
    rounds: int = 12,
) -> tuple[Floats, float]:
    """Most likely offsets (m, p) of each set of pictures with its calibration, by Gauss and Newton's steps.

    ``pictures`` holds counts (m, n), rows (q, n) and noise of each. Also returns the last step, in bounds.
    """
    weighed = [(rows * pixel_information(rows[0], noise)) @ rows.T for _, rows, noise in pictures]
    laws = [Rounded(noise) if noise.frames > 1 else None for _, _, noise in pictures]
    delta = np.zeros_like(calibrated)
    last = np.inf
    for _ in range(rounds):
        amounts, slopes = expansion.amounts(delta), expansion.slopes(delta)
        gained = np.zeros_like(amounts)
        for (counts, rows, noise), law in zip(pictures, laws, strict=True):
            for start in range(0, counts.shape[1], _CHUNK):
                some = slice(start, start + _CHUNK)
                mean, seen = amounts @ rows[:, some], counts[:, some].astype(np.float64)
                score = (
                    score_of_one(seen, mean, noise) if law is None else law.score(seen, mean, noise.frames)
                )
                gained += score @ rows[:, some].T
        gradient = np.einsum("mpq,mq->mp", slopes, gained) - (delta - calibrated) @ precision
        # the weak direction turns as one goes along it: every set of pictures has its own information
        told = np.einsum("mpq,qr,msr->mps", slopes, np.sum(weighed, axis=0), slopes) + precision
        moved = np.linalg.solve(told, gradient[..., None])[..., 0]
        unit = np.sqrt(np.diagonal(np.linalg.inv(told), axis1=1, axis2=2))
        delta, last = delta + moved, float(np.abs(moved / unit).max())
        if last < 0.02:
            break
    return delta, last
