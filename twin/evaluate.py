"""What one layout of a sensor can tell: expected pictures, their derivatives, bounds and other objectives.

Pictures are computed on coarse pixels, each of which stands for `Evaluation.block` pixels of the camera that
see the same: counts are those of one true pixel, and information is multiplied by their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.information import Information
from twin.design import Design
from twin.forward import Unknown

Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Protocol:
    """How the sensor is used.

    Attributes
    ----------
    indentation_mm : press levels.
    positions_mm : centres of the sensor at which it is pressed, over the specimen, minus the first guess of
        the inclusion's place; every level is taken at every position.
    frames : exposures that are averaged into each picture.
    """

    indentation_mm: tuple[float, ...]
    positions_mm: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    frames: int = 1


@dataclass(frozen=True)
class Layout:
    """One sensor with its protocol; ``values`` are the study's fields and what this trial took."""

    design: Design
    protocol: Protocol
    values: dict[str, float | int | str]


@dataclass(frozen=True)
class Judged:
    """What the pictures of one inclusion tell.

    Pictures are ordered by position, then level: for each the picture, then its reference.

    Attributes
    ----------
    mean : (pictures, rows, columns[, 3]) counts of one true pixel, without rounding.
    layers : (pictures, n_led, rows, columns[, 3]) counts from each LED alone, without offset and full well.
    names : of the p unknowns.
    jacobian : (p, pictures, rows, columns[, 3]) counts per unit of each unknown, per e-fold where relative.
    layer_jacobian : (p, pictures, n_led, rows, columns[, 3]) the same of each layer; of a LED's flux its own
        layer, of what the camera does after the light zero.
    information : of all pictures together, with the protocol's frames.
    sd : prior-included bound of each unknown.
    """

    inclusion: fem.Inclusion
    mean: Singles
    layers: Singles
    names: tuple[str, ...]
    jacobian: Singles
    layer_jacobian: Singles | None
    information: Information
    sd: dict[str, float]


@dataclass(frozen=True)
class Evaluation:
    """All that was found about a layout; `objectives` by the names of `twin.objectives.OBJECTIVES`.

    ``block`` is the number of true pixels that a coarse one stands for; ``camera`` is the design on the coarse
    pixels: its counts, noise and full well are those of one true pixel.
    """

    layout: Layout
    unknowns: tuple[Unknown, ...]
    judged: tuple[Judged, ...]
    objectives: dict[str, float]
    seconds: dict[str, float]
    block: float
    camera: Design
