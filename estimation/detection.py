"""Is there an inclusion at all? What the ideal observer of a known signal reaches.

The deflection d' is the distance between the two cases' means in standard deviations of the best linear
statistic, and the log likelihood ratio of a normal picture: AUC = Φ(d'/√2) (Barrett and Myers 2004,
section 13.2; [barrett2004]). Nuisances that could imitate the signal are projected out, as far as their
priors leave room: d'² = sᵀWs - sᵀWJᵀ (J W Jᵀ + P)⁻¹ J W s, with the signal s, the pixels' weights W and the
nuisances' Jacobian J (Kay 1998, section 7.7; [kay1998]).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from estimation.information import Noise, fisher, marginal, mean_variance, pixel_information
from estimation.quantised import count_divergence

Floats = NDArray[np.float64]


def signal_weight(mean_0: ArrayLike, mean_1: ArrayLike, noise: Noise) -> Floats:
    """What each pixel tells between two means, counts⁻²: divergence over squared difference.

    With it, Σ w s² is the divergence between the two pictures, rounding included, however large the signal;
    where the two means agree within 1e-4 counts it is the information about the mean between them.

    Parameters
    ----------
    mean_0, mean_1 : (...) counts without and with the signal.
    """
    before, after = np.broadcast_arrays(np.asarray(mean_0, np.float64), np.asarray(mean_1, np.float64))
    middle = (before + after) / 2.0
    weight = np.array(pixel_information(middle, noise))
    light = np.maximum(middle - noise.offset_dn, 0.0)
    fixed = noise.fixed_dn**2 + (noise.fixed_share * light) ** 2
    apart = np.abs(after - before) > 1e-4
    before, after = before[apart], after[apart]
    spread = mean_variance(before, noise), mean_variance(after, noise)
    told = noise.frames * count_divergence(before, spread[0], after, spread[1], noise.bits)
    told /= (after - before) ** 2
    weight[apart] = told / (1.0 + told * fixed[apart])
    return weight


def deflection(
    signal: ArrayLike, weight: ArrayLike, jacobian: ArrayLike | None = None, prior: ArrayLike | None = None
) -> float:
    """d' of a known signal, without unit.

    Parameters
    ----------
    signal : (...) counts that the inclusion adds.
    weight : (...) counts⁻², from `signal_weight` or, for signals below the noise, `pixel_information`.
    jacobian : (q, ...) counts per unit of each nuisance.
    prior : (q, q) precision of the nuisances; without, they are free.
    """
    seen = np.asarray(signal, np.float64)[None]
    if jacobian is None:
        return float(np.sqrt(fisher(seen, weight)[0, 0]))
    total = fisher(np.concatenate([seen, np.asarray(jacobian, np.float64)]), weight)
    if prior is not None:
        total[1:, 1:] += np.asarray(prior, np.float64)
    return float(np.sqrt(max(marginal(total, [0])[0, 0], 0.0)))


def ideal_auc(d_prime: ArrayLike) -> Floats:
    """Area under the ideal observer's ROC curve, Φ(d'/√2): 0.5 where nothing can be told."""
    return np.asarray(ndtr(np.asarray(d_prime, np.float64) / np.sqrt(2.0)))
