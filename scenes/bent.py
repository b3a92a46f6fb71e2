"""What tissue gives back under a bent contact, over what it gives back under a flat one.

To first order in the face's heights h, how light that enters with the lateral wave vector k and comes up with
p is changed by the domain's perturbation (Hadamard 1908; key hadamard1908). For light that diffuses,
φ ~ exp(-λ z) with λ² = λ0² + k² (`slab`), that is h(p - k) A_p A_k (λ0² + p·k - λ_p λ_k): what is absorbed
and what spreads in the layer by which the face is moved, less what moving it changes by the field's fall with
depth. As maps, of light E that enters, u = A E,

    δV = A [λ0² h u - ∇·(h ∇u) - Λ (h Λ u)],    Λ: times λ of the wave number.

A² is what a faster decay costs, -dG/dλ, told by the flat reflectance, in which λ and k go together:
(1 + 0.28 λ0 + 0.41 λ0²) (-(λ/k) dR/dk) / (1 - w R)², with w what the face throws back. The first bracket, λ0
per transport mean free path, is for absorption so strong that light hardly diffuses, by walks
(`tests/test_bent.py`). A face moved or tilted as a whole changes nothing, and one bent evenly A²/2 times the
sum of its curvatures.

All else of standard light has tissue flat; the reference (`wander`) walks under the surface as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .cells import coarser, finer
from .tissue import TissueOptics

Array = NDArray[np.float64]

_NODES = 160  # wave numbers at which the flat reflectance is worked out
_LEAST, _MOST = 1e-2, 1e3  # of them, per transport mean free path
_STRONG = (0.41, 0.28, 1.0)  # over λ0, highest power first
_SHARP = 0.3  # of the finest wave: finer ones fade from A, or products of two would come back as others
_FAINT = 1e-9  # of the brightest light: where there is less, nothing is changed
_AT_MOST = 0.5  # a first order is not to be believed beyond


@dataclass(frozen=True)
class Bent:
    """One tissue on square cells over the guide's face and a margin beside it; make it with `bent`.

    Attributes
    ----------
    reflectance, strength : (m, m // 2 + 1)
        R, and A² of a face that throws nothing back, mm, at the wave vectors of real Fourier transforms over
        the cells and those that keep the maps `apart` from their own repetition.
    decay : (m, m // 2 + 1)
        λ, 1/mm.
    waves : (m // 2 + 1,) and (m, 1)
        Along x and y, 1/mm.
    slowest_per_mm
        λ0.
    cells, margin, apart
        Of the guide's face per side, on each side of it, and of one side beyond.
    """

    reflectance: Array
    strength: Array
    decay: Array
    waves: tuple[Array, Array]
    slowest_per_mm: float
    cells: int
    margin: int
    apart: int

    def on(self, height_mm: Array, thrown: float) -> Bend:
        """Under a face of heights [iy, ix], mm, on as many cells or so many times finer ones, which throws
        back such a share of what comes up under it."""
        height = _straight_on(coarser(height_mm, self.cells), self.margin, self.margin + self.apart)
        face = np.sqrt(self.strength) / (1.0 - thrown * self.reflectance)
        return Bend(self, face, height - height.mean())


@dataclass(frozen=True)
class Bend:
    """A `Bent` under one face.

    Attributes
    ----------
    amplitude : (m, m // 2 + 1)
        A.
    height_mm : (m, m)
        Of the face, over its mean; beside it it goes on straight.
    """

    bent: Bent
    amplitude: Array
    height_mm: Array

    def factor(self, entering: Array, upward: Array) -> Array:
        """Light that goes up under the face, over what goes up under a flat one, on the face's cells.

        Parameters
        ----------
        entering, upward : (n, w, w)
            E and V of `spread`, W/mm², with the margin, on the tissue's cells or so many times finer ones.
        """
        wide = len(self.height_mm) - self.bent.apart
        change = self._change(coarser(entering, wide))[..., :wide, :wide]
        light = coarser(upward, wide)
        seen = light > _FAINT * light.max(axis=(-2, -1), keepdims=True)
        change = np.divide(change, light, out=np.zeros_like(light), where=seen)
        inside = slice(self.bent.margin, wide - self.bent.margin)
        found = 1.0 + np.clip(change[..., inside, inside], -_AT_MOST, _AT_MOST)
        return finer(found, found.shape[-1] * entering.shape[-1] // wide)

    def _change(self, entering: Array) -> Array:
        """δV of E."""
        bent, box = self.bent, self.height_mm.shape
        light = self.amplitude * scipy.fft.rfft2(entering, box, workers=1)

        def layer(symbol: NDArray[np.inexact] | float) -> NDArray[np.complex128]:
            """The operator of a symbol before and after the heights."""
            field = scipy.fft.irfft2(symbol * light, box, workers=1)
            return np.asarray(symbol * scipy.fft.rfft2(self.height_mm * field, workers=1))

        along, up = (1j * wave for wave in bent.waves)
        change = layer(bent.slowest_per_mm) - layer(along) - layer(up) - layer(bent.decay)
        return np.asarray(scipy.fft.irfft2(self.amplitude * change, box, workers=1))


def bent(tissue: TissueOptics, width_mm: float, cells: int, margin: int, apart: int) -> Bent:
    """Prepare tissue under a face of `width_mm` on `cells` x `cells` cells, with a margin, and cells `apart`
    at least between the map and where it comes again; without either it goes on as it began."""
    apart = scipy.fft.next_fast_len(cells + 2 * margin + apart, real=True) - cells - 2 * margin
    wide, step, per_mm = cells + 2 * margin + apart, width_mm / cells, tissue.transport_per_mm
    along, up = (2.0 * np.pi * waves(wide, step) for waves in (scipy.fft.rfftfreq, scipy.fft.fftfreq))
    wave = np.hypot(along, up[:, None]) / per_mm
    nodes = np.geomspace(_LEAST, _MOST, _NODES)
    flat, slowest = tissue.slab.reflectance(nodes), tissue.slab.decay_rate
    # (λ/k) dR/dk = 2 λ dR/d(k²)
    steep = -2.0 * np.hypot(slowest, nodes) * np.gradient(flat, nodes**2)
    steep = np.maximum(steep, 0.0) * np.polyval(_STRONG, slowest) / per_mm
    at = np.log(np.clip(wave, _LEAST, _MOST))
    reflectance, strength = (np.interp(at, np.log(nodes), one) for one in (flat, steep))
    strength *= np.exp(-((wave * per_mm * step / np.pi / _SHARP) ** 2))
    decay = per_mm * np.hypot(slowest, wave)
    return Bent(reflectance, strength, decay, (along, up[:, None]), per_mm * slowest, cells, margin, apart)


def _straight_on(height: Array, before: int, after: int) -> Array:
    """With cells before and after, in which each row and column goes on as it ends."""
    steps = np.arange(-before, len(height) + after)
    near = np.clip(steps, 0, len(height) - 1)
    over = (steps - near)[:, None]
    for _ in range(2):
        slope = np.where(over < 0, height[1] - height[0], height[-1] - height[-2])
        height = (height[near] + over * slope).T
    return height
