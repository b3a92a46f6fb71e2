"""Pictures of a camera that stands a little off, put back to where it should stand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.alignment import placement, taken_from
from estimation.features import Features
from twin.chain import Chain
from twin.fitting import ALIGNMENT, Prior, expected, fit
from twin.received import Received

Single = NDArray[np.float32]

_ROUNDS = 3


def put_back(
    chain: Chain,
    features: Features,
    error: NDArray[np.float64],
    coarse: Callable[[Received], Single],
    prior: Prior,
    received: Received,
    start: NDArray[np.floating],
) -> Single:
    """Return coarse pictures (levels, 2, r, c) as of a camera that stands right.

    Where it stands is fitted to the coarse pictures, with the inclusion (5,) held at the start; they blur too
    much to fit more, so all pixels are then taken from where they are. Blocks at the border, which such a
    camera may not have seen, are those that are expected.

    Parameters
    ----------
    prior : `Prior.of_another_camera`.
    """
    x = np.concatenate([start, np.zeros(prior.basis.shape[1])])
    matrix, now = np.eye(3), received
    for _ in range(_ROUNDS):
        told = features(coarse(now)[None])[0]
        x = fit(chain, features, prior, told, 1.0, x, error, held=len(start)).x
        values = prior.values(x)
        rows, columns = received.images.shape[1:3]
        stands = placement((rows, columns), *(values[name] for name in ALIGNMENT))
        # from where a place should be to where it is in what was received
        matrix = matrix @ np.linalg.inv(stands)
        x[-len(ALIGNMENT) :] = 0.0
        now = replace(
            received,
            images=taken_from(received.images, matrix).astype(np.float32),
            references=taken_from(received.references, matrix).astype(np.float32),
        )
    seen, straight = coarse(now), expected(chain, prior, [x])[0]
    inner = np.zeros(seen.shape[-2:], np.bool_)
    inner[1:-1, 1:-1] = True
    return np.where(inner, seen, straight)
