"""What tissue gives back under a bent contact, over what it gives back under a flat one.

Under a face that bulges into it there is more tissue for each area of the face the deeper one looks, by
1 + H z with H the sum of both curvatures (Weyl 1939; key weyl1939). Diffuse light that falls as exp(-λ z)
under a flat face then falls as exp(-(λ + H/2) z), to first order: φ'' + H φ' - λ² φ = 0. Its decay also grows
with the lateral wave number, λ² = λ0² + k² (`slab`), so that the flat reflectance tells what a faster decay
costs: d ln R / dλ = (λ/k) d ln R / dk. Light that the face throws back comes again: R / (1 - w R) for R.

Curvature that changes from place to place tells less: a crest is also where light has not yet spread out. By
walks under waves it tells half at a wave number k½ with k½² = 0.06 + 0.45 λ0², per transport mean free path,
and nothing at 1.6 times that (`tests/test_bent.py`); a Gaussian stands for it.

All this is the change of all the light that one spot gives back, and by reciprocity of what comes back there
of light all over. Half of it is due where light goes in and half where it comes out: a factor 1 + γ at either
end, with γ (1 + G / G(0)) that change, G the reflectance with what is thrown back.

All else of standard light has tissue flat; the reference (`wander`) walks under the surface as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .tissue import TissueOptics

Array = NDArray[np.float64]

_NODES = 160  # wave numbers at which the flat reflectance is worked out
_LEAST, _MOST = 1e-3, 1e3  # of them, per transport mean free path
_EVEN = np.array([0.045, 0.055])  # wave numbers that stand for even curvature


@dataclass(frozen=True)
class Bent:
    """The answer to curvature of one tissue, on square cells over the guide's face; make it with `bent`.

    Attributes
    ----------
    reflectance, answer : (m, m)
        R, and d ln R / dλ as far as curvature tells, mm, at the wave numbers of cosines over the face.
    cell_mm
        Side of a cell.
    """

    reflectance: Array
    answer: Array
    cell_mm: float

    def on(self, height_mm: Array, thrown: float) -> Array:
        """Factor, over a flat face, of light that goes in and again of light that comes out, (m, m), where
        the face is at heights [iy, ix] (m, m), mm, and throws back such a share of what comes up under it.

        What comes back there of light all over is f + G * (f - 1) / G(0) times as much, f² where it is even.
        """
        bends = np.zeros(height_mm.shape)
        bends[1:-1] -= np.diff(height_mm, 2, axis=0)
        bends[:, 1:-1] -= np.diff(height_mm, 2, axis=1)
        # what is seen of the rim comes from this side of it: the other is taken to be its mirror image
        spectrum = scipy.fft.dctn(np.pad(bends[1:-1, 1:-1], 1, mode="edge") / self.cell_mm**2, workers=1)
        again = 1.0 / (1.0 - thrown * self.reflectance)
        given = self.reflectance * again
        spectrum *= self.answer * again / (1.0 + given / given[0, 0])
        return np.asarray(1.0 + 0.5 * scipy.fft.idctn(spectrum, workers=1))


def bent(tissue: TissueOptics, width_mm: float, cells: int) -> Bent:
    """Prepare the answer on `cells` x `cells` cells over a face of `width_mm`."""
    per_mm, cell = tissue.transport_per_mm, width_mm / cells
    line = np.pi / width_mm * np.arange(cells)
    wave = np.clip(np.hypot(line, line[:, None]) / per_mm, _LEAST, _MOST)
    nodes = np.geomspace(_LEAST, _MOST, _NODES)
    flat = np.maximum(tissue.slab.reflectance(nodes), 1e-12)
    decay, mean = tissue.slab.decay_rate, float(_EVEN.mean())
    low, high = np.log(np.maximum(tissue.slab.reflectance(_EVEN), 1e-12))
    even = (high - low) / float(np.ptp(_EVEN)) * np.hypot(decay, mean) / mean / per_mm
    answer = even * 0.5 ** (wave**2 / (0.06 + 0.45 * decay**2))
    return Bent(np.interp(np.log(wave), np.log(nodes), flat), answer, cell)
