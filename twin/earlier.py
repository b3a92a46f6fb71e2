"""The methods that the paper names as its predecessors, run on the same pictures ([lee2011], section I).

All the paper tells of them: [9] "2-dimensional finite element method based forward algorithm and Gaussian
fitting model-based inversion algorithms"; [10] the same "extended to find a more complete set of tissue
inclusions", both "limited to tissue inclusion at least 100 times stiffer than the surrounding tissues"; [11]
2-D finite elements and a network, with a "small number of 2-D FEM data". The rest is guessed, and `GUESSES`
says what: the report prints it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

import fem
from estimation import paper
from estimation.baselines import fit_bump, fit_profile, invert_table
from estimation.regression import fit_line
from fem.plane import Press2D, press_2d
from fem.plane_scalars import scalars_2d
from twin.frame import grey

if TYPE_CHECKING:
    from estimation.ann import Settings
    from twin.corpus import Corpus
    from twin.design import Design

Floats = NDArray[np.float64]

STIFF = 100.0
"""Inclusion's modulus over the tissue's in [9] and [10]."""

_TABLES = {"[9]": 5, "[10]": 9}  # entries along d and along h
_FEW = 30  # inclusions that [11]'s network is trained on
_QUALITY = "preview"

GUESSES = (
    "2-D is taken as plane strain: probe, slab and inclusion are infinite along y, the sphere is a cylinder; "
    "linear elasticity, the same layers, slab and press level as ours.",
    f"[9] is a table of {_TABLES['[9]']} x {_TABLES['[9]']} and [10] one of {_TABLES['[10]']} x "
    f"{_TABLES['[10]']} "
    f"pairs (d, h) over the paper's box, the inclusion {STIFF:g} times as stiff as the tissue; E is not "
    f"estimated.",
    "A round Gaussian on a slanted background is fitted to the tared picture, a Gaussian on a constant to "
    "the tared "
    "line of displacements; amplitude and width are looked up in the table by least squares, each weighted "
    "with its "
    "spread over the table.",
    "Counts are turned into mm, and the picture's width into the line's, by one line each through the nine "
    "phantoms "
    "and their own 2-D solutions, leaving out the phantom that is estimated: without it a plane model's "
    "amplitude and a picture's have no common scale.",
    f"[11] is a network as in our chain on the three scalars of {_FEW} random inclusions of the paper's "
    f"box, in plane "
    "strain (total and area per mm of width), mapped by a line each through the other eight phantoms.",
)


@dataclass(frozen=True)
class Earlier:
    """One method's estimates of the nine phantoms, (9, 3), modulus NaN where it tells none."""

    name: str
    words: str
    estimate: Floats


def earlier(
    corpus: Corpus,
    level: int,
    samples: ArrayLike,
    picture: ArrayLike,
    *,
    repeats: int,
    seed: int,
    settings: Settings | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Earlier]:
    """Run all three on the phantoms' pictures.

    Parameters
    ----------
    level : number of the press level.
    samples : (9,) the phantoms' numbers in the corpus, as in Table I.
    picture : (9, 3) scalars of their tared pictures, for [11].
    """
    tell = progress or (lambda done: None)
    design, indentation = corpus.design, corpus.indentation_mm[level]
    truth = paper.true_inclusions()
    camera = design.camera
    pixel = camera.field_of_view_mm / camera.columns, camera.field_height_mm / camera.rows
    bumps = [fit_bump(grey(corpus.tared(int(one), [level])[0]), pixel) for one in np.asarray(samples)]
    shapes = np.array([[bump.amplitude, bump.sigma_mm] for bump in bumps])
    tell(0.1)
    rigid = STIFF * design.slab().modulus_kPa
    own = np.array([_shape(plane(design, (d, h, rigid), indentation)) for d, h, _ in truth])
    found = []
    for name, side in _TABLES.items():
        axes = (np.linspace(*paper.RANGES[key], side) for key in ("size_mm", "depth_mm"))
        entries = np.array(list(product(*axes)))
        answers = np.array([_shape(plane(design, (d, h, rigid), indentation)) for d, h in entries])
        guess = np.full((9, 3), np.nan)
        for one in range(9):
            seen = _through_lines(shapes, own, one)
            guess[one, :2] = invert_table(entries, answers, seen[None], answers.std(axis=0))[0][0]
        words = f"plane strain, table of {side} x {side}, Gaussian fit; d and h only"
        found.append(Earlier(name, words, guess))
        tell(0.3 if side == 5 else 0.7)
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, 11])))
    low, high = np.array([paper.RANGES[key] for key in paper.PARAMETERS]).T
    training = low + (high - low) * rng.random((_FEW, 3))
    surface = np.array([_three(design, plane(design, one, indentation)) for one in training])
    mine = np.array([_three(design, plane(design, one, indentation)) for one in truth])
    tell(0.9)
    from estimation.ann import train

    asked = np.array([_through_lines(np.asarray(picture, np.float64), mine, one) for one in range(9)])
    members = train(surface, training, repeats=repeats, seed=seed, settings=settings)
    words = f"plane strain, network on three scalars of {_FEW} inclusions"
    found.append(Earlier("[11]", words, members.predict(asked).mean(axis=0)))
    tell(1.0)
    return found


def plane(design: Design, inclusion: ArrayLike, indentation: float) -> Press2D:
    """Press on an inclusion (size mm, depth mm, modulus kPa) in plane strain."""
    size, depth, modulus = (float(value) for value in np.asarray(inclusion))
    return press_2d(
        design.probe(),
        design.slab(),
        fem.Inclusion(size=size, depth=depth, modulus=modulus),
        indentation,
        "plane_strain",
        _QUALITY,
    )


def _shape(press: Press2D) -> list[float]:
    """Amplitude mm and width mm of the Gaussian that fits the tared line."""
    amplitude, sigma, _ = fit_profile(press.x, press.displacement_0[:, 1] - press.displacement[:, 1])
    return [amplitude, sigma]


def _three(design: Design, press: Press2D) -> list[float]:
    return list(scalars_2d(press, design.signal.displacement_um)["tared"].values())


def _through_lines(picture: Floats, surface: Floats, one: int) -> Floats:
    """The picture's values of one phantom on the scale of the surface's, by lines through the others."""
    others = np.delete(np.arange(len(picture)), one)
    return np.array(
        [
            float(fit_line(picture[others, column], surface[others, column])(picture[one, column]))
            for column in range(picture.shape[1])
        ]
    )
