"""Pictures of a camera that stands a little off, put back to where it should stand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.alignment import covered, placement, taken_from
from estimation.features import Features
from twin.chain import BLOCK, Chain, whole_blocks
from twin.fitting import ALIGNMENT, Prior, fit
from twin.received import Received

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_ROUNDS = 3
_HELD = 3  # size, depth and modulus; an offset goes with the camera


def where(
    chain: Chain,
    features: Features,
    error: Floats,
    coarse: Callable[[Received], Single],
    prior: Prior,
    received: Received,
    start: NDArray[np.floating],
) -> Floats:
    """Return the matrix (3, 3) from where a place should be to where it is in the pictures received.

    Where the camera stands is fitted to the coarse pictures, with size, depth and modulus of the start (5,)
    held; they blur too much to fit more. All pixels are then taken from where they are, and what is left is
    fitted with the inclusion: one that is held a little wrong moves the camera by pixels.

    Parameters
    ----------
    prior : `Prior.of_another_camera`.
    """
    x = np.concatenate([start, np.zeros(prior.basis.shape[1])])
    matrix, shape = np.eye(3), (received.images.shape[1], received.images.shape[2])
    for number in range(_ROUNDS):
        now, blocks = put_back(received, matrix)
        seen = features.only(blocks)
        told = seen(coarse(now)[None])[0]
        x = fit(chain, seen, prior, told, 1.0, x, error, held=0 if number else _HELD).x
        values = prior.values(x)
        matrix = matrix @ np.linalg.inv(placement(shape, *(values[name] for name in ALIGNMENT)))
        x[-len(ALIGNMENT) :] = 0.0
    return matrix


def put_back(received: Received, matrix: Floats) -> tuple[Received, NDArray[np.bool_]]:
    """Return the pictures with all pixels taken from where they are, and which blocks (r, c) the camera has
    seen."""
    shape = (received.images.shape[1], received.images.shape[2])
    now = replace(
        received,
        images=taken_from(received.images, matrix).astype(np.float32),
        references=taken_from(received.references, matrix).astype(np.float32),
    )
    seen = whole_blocks(covered(shape, matrix).astype(np.float32))
    (high, wide), (rows, columns) = BLOCK, seen.shape
    blocks = seen.reshape(rows // high, high, columns // wide, wide).min(axis=(1, 3))
    return now, np.asarray(blocks > 0.0)
