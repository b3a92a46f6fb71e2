"""What lies behind the contact: tissue, or a contact sheet, that scatters light in depth and gives it back.

The boundary is split off (it is the contact's), so that tissue is a half-space, a sheet a slab, without index
step. Light comes in and goes out spread over angles; the reflectance is written as a sum of modes,

    L_up(x, µ) = Σ_i φ_i(µ) V_i(x) / π,    V_i = ρ_i R_i (*) [E_i + Σ_j W_ij V_j],

with µ the cosine in the tissue and E_i = ∫ φ_i T L dω the weighted irradiance that enters. Mode 0 is all
that forgets its direction: φ_0(µ) is the plane albedo over the total reflectance ρ_0, so that the total is
right for every angle, and R_0 spreads light over about a millimetre. The others are what light scattered a
few times remembers (grazing light leaves at grazing angles): they have no net flux, return within a fraction
of a mean free path, and are taken as local. Mode 1 makes what leaves towards the camera right for light from
any angle; the next are the largest of what is left. W(A_r) is what the face throws back into the tissue.
Where light comes out depends on how it came in: `aslant` and `passage` have that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .aslant import Aslant, aslant
from .contact import ContactOptics, moment_weights
from .ftir import gap_transmittance
from .half_space import HalfSpace
from .radial import Kernel, kernel
from .skin import Skin, Tissue
from .slab import Slab, cosines

Array = NDArray[np.float64]

MODES = 2
_COSINES = 513
_CAMERA = 0.985  # cosine in the tissue at which mode 1 is exact: about what the camera sees
_LEAST = 1e-12  # reflectance below which nothing comes back
_NOTHING = 1e-6  # of it, below which a mode is rounding


@dataclass(frozen=True)
class TissueOptics:
    """How a scattering body without boundary gives light back.

    Attributes
    ----------
    transport_per_mm
        µt' = µs' + µa, 1/mm.
    slab
        The body in units of 1/µt'.
    kernel
        Radial reflectance of mode 0 in units of 1/µt'; `profile` has it in mm.
    strengths : (modes,)
        ρ_i; the first is the total diffuse reflectance.
    lobes : (modes, n)
        φ_i on cosines in the tissue uniform on 0..1; Lambertian means: ⟨φ_0⟩ = 1, ⟨φ_i⟩ = 0.
    """

    transport_per_mm: float
    slab: Slab | HalfSpace
    kernel: Kernel
    strengths: Array
    lobes: Array

    @property
    def reflectance(self) -> float:
        """Total diffuse reflectance for Lambertian light, without boundary."""
        return float(self.strengths[0])

    def lobe(self, cosine: Array) -> Array:
        """φ_i at cosines in the tissue: (modes, *shape of cosine)."""
        grid = np.linspace(0.0, 1.0, self.lobes.shape[1])
        return np.stack([np.interp(cosine, grid, lobe) for lobe in self.lobes])

    def profile(self, radius_mm: Array) -> Array:
        """Light that leaves per area at a distance from where it entered, 1/mm², Lambertian in, all out."""
        scaled = self.transport_per_mm * np.asarray(radius_mm, dtype=np.float64)
        return self.transport_per_mm**2 * self.kernel.profile(scaled)

    def within(self, radius_mm: Array) -> Array:
        """Share of the light that leaves within a distance from where it entered."""
        return self.kernel.within(self.transport_per_mm * np.asarray(radius_mm, dtype=np.float64))

    def jumps_mm(self, count: int = 256) -> Array:
        """Radii, (count,) mm, at the quantiles 0..1 (count even steps) of the distance between in and out."""
        radius = np.concatenate([[0.0], np.geomspace(1e-5, 200.0, 2000)])
        inside = np.concatenate([[0.0], np.maximum.accumulate(self.kernel.within(radius[1:]))])
        aim = np.linspace(0.0, 1.0, count) * min(inside[-1], (1.0 - 1e-4) * self.kernel.total)
        return np.interp(aim, inside, radius) / self.transport_per_mm


@dataclass(frozen=True)
class Coupling:
    """Tissue behind a contact, on the nodes of its `ContactOptics`.

    Attributes
    ----------
    lobes : (modes, n_cos)
        φ_i on the cosines in the *guide*, by Snell's law.
    held : (n_fraction, modes, modes)
        W: what of mode j the face throws back as mode i, ⟨φ_i φ_j (1 - T)⟩ over the tissue's side.
    gain : (n_fraction, modes, modes)
        K of the local limit f = T(cos_i) T(cos_o) Σ φ_i(cos_i) K_ij φ_j(cos_o) / π, symmetric.
    scale
        (n1/n3)²: radiance in the guide over that in the tissue.
    free : (modes, modes)
        W of bare skin beside the guide, in air.
    aslant
        How light that enters aslant comes out.
    ways : by harmonic m of the azimuth, (r_m, n_cos)
        `Aslant.functions` h on the cosines in the guide.
    thrown, thrown_free : by harmonic, (n_fraction, r_m, r_m) and (r_m, r_m)
        ⟨h_i h_j (1 - T)⟩ of them: what the face throws back, and bare skin; `held`, `free` are part of the
        first.
    """

    lobes: Array
    held: Array
    gain: Array
    scale: float
    free: Array
    aslant: Aslant
    ways: tuple[Array, ...]
    thrown: tuple[Array, ...]
    thrown_free: tuple[Array, ...]


def tissue_optics(
    scattering_per_mm: float,
    absorption_per_mm: float,
    thickness_mm: float = np.inf,
    backing: float = 0.0,
    modes: int = MODES,
    *,
    anisotropy: float = 0.0,
) -> TissueOptics:
    """Solve the diffuse reflectance of tissue (a half-space) or of a sheet (a slab with a backing); 20 ms.

    `scattering_per_mm` is the reduced coefficient µs', 1/mm; `backing` the reflectance, 0..1, of what lies
    behind a sheet. Total, angles and radial profile are those of radiative transfer with isotropic scattering
    of albedo µs'/(µs' + µa) (Chandrasekhar 1960, ch. V; key chandrasekhar1960), by `slab` and `radial`; with
    a mean cosine g of one scattering, `anisotropy`, of a half-space by `half_space` (2 s).
    """
    transport = scattering_per_mm + absorption_per_mm
    albedo = scattering_per_mm / transport
    body: Slab | HalfSpace = Slab(albedo, thickness_mm * transport, backing)
    if anisotropy != 0.0:
        assert np.isinf(thickness_mm)
        body = HalfSpace(albedo, anisotropy)
    curve = kernel(body.reflectance, body.first, body.decay_rate, body.bend)
    mu, weight = cosines()
    even = 2.0 * mu * weight
    grid = np.linspace(0.0, 1.0, _COSINES)
    total = curve.total
    if total < _LEAST:
        lobes = np.vstack([np.ones((1, _COSINES)), np.zeros((modes - 1, _COSINES))])
        return TissueOptics(transport, body, curve, np.zeros(modes), lobes)
    nodes, out = body.factors(mu), body.factors(grid)  # (to, from) cosines
    plane, shape = nodes @ even / total, out @ even / total
    strengths, shapes = [total], [shape]
    nodes, out = nodes - total * np.outer(plane, plane), out - total * np.outer(shape, plane)
    camera, root = int(np.argmin(np.abs(mu - _CAMERA))), np.sqrt(even)
    for number in range(1, modes):
        values, vectors = np.linalg.eigh(0.5 * (nodes + nodes.T) * np.outer(root, root))
        largest = int(np.argmax(np.abs(values)))
        if abs(values[largest]) < _NOTHING * total:  # as in a clear sheet, which remembers nothing
            strengths.append(0.0)
            shapes.append(np.zeros(_COSINES))
            continue
        strength, on_nodes = values[largest], vectors[:, largest] / root
        on_grid = out @ (even * on_nodes) / strength
        norm = even @ nodes[:, camera] ** 2
        if number == 1 and 0.0 < norm < 3.0 * abs(strength) * nodes[camera, camera]:
            strength = norm / nodes[camera, camera]
            on_nodes, on_grid = nodes[:, camera] / np.sqrt(norm), out[:, camera] / np.sqrt(norm)
        strengths.append(float(strength))
        shapes.append(on_grid)
        nodes = nodes - strength * np.outer(on_nodes, on_nodes)
        out = out - strength * np.outer(on_grid, on_nodes)
    return TissueOptics(transport, body, curve, np.array(strengths), np.stack(shapes))


@lru_cache(maxsize=16)
def body_behind(skin: Skin, tissue: Tissue) -> tuple[float, TissueOptics]:
    """Refractive index and optics of what the light enters: the contact sheet, or without one the tissue."""
    sheet = skin.sheet
    if sheet is None:
        optics = tissue_optics(
            tissue.scattering_per_mm, tissue.absorption_per_mm, anisotropy=tissue.anisotropy
        )
        return tissue.refractive_index, optics
    optics = tissue_optics(
        sheet.scattering_per_mm, sheet.absorption_per_mm, sheet.thickness_mm, sheet.backing
    )
    return sheet.refractive_index, optics


def couple(
    optics: ContactOptics, tissue: TissueOptics, n_guide: float, n_tissue: float, n_gap: float
) -> Coupling:
    """Put tissue behind a contact whose T(A_r, cos) is tabulated."""
    cosine = np.linspace(0.0, 1.0, optics.transmittance.shape[1])
    scale = (n_guide / n_tissue) ** 2
    inside = 1.0 - scale * (1.0 - cosine**2)  # squared cosine in the tissue
    there, grid = np.sqrt(np.maximum(inside, 0.0)), np.linspace(0.0, 1.0, _COSINES)
    apart = aslant(tissue.slab, tissue.transport_per_mm, tissue.lobes, n_tissue, n_gap)
    mu, weight = cosines()
    moments, critical = 2.0 * moment_weights(cosine), _passed_by_bare_skin(n_tissue)
    ways, thrown, free = [], [], []
    for functions in apart.functions:
        several = np.array([np.interp(there, grid, one) for one in functions]).reshape(-1, cosine.size)
        several *= inside > 0.0
        inner, bare = (
            np.array([np.interp(at, grid, one) for one in functions]).reshape(-1, at.size)
            for at in (mu, critical[0])
        )
        overlap = np.einsum("m,im,jm->ij", 2.0 * mu * weight, inner, inner)
        passed = np.einsum("m,im,jm,am->aij", moments, several, several, optics.transmittance, optimize=True)
        ways.append(several)
        thrown.append(overlap - scale * passed)
        free.append(overlap - np.einsum("m,im,jm->ij", critical[1], bare, bare))
    modes = slice(len(tissue.lobes))
    held = thrown[0][:, modes, modes]
    gain = scale * _resummed(tissue.strengths, held)
    of_ways = tuple(ways), tuple(thrown), tuple(free)
    return Coupling(ways[0][modes], held, gain, scale, free[0][modes, modes], apart, *of_ways)


def _passed_by_bare_skin(n_tissue: float) -> tuple[Array, Array]:
    """Cosines, and weights of ∫ f T 2µ dµ, of a face to air; T starts at the critical angle."""
    critical = np.sqrt(1.0 - 1.0 / n_tissue**2)
    x, w = np.polynomial.legendre.leggauss(200)
    inner = 0.5 * (1.0 + x)
    cosine = critical + (1.0 - critical) * inner**2  # T rises as a square root
    weight = 2.0 * cosine * (1.0 - critical) * inner * w
    t_s, t_p = gap_transmittance(n_tissue, 1.0, 1.0, 0.0, cosine, 550.0)  # no gap: any wavelength will do
    return cosine, np.asarray(weight * 0.5 * (t_s + t_p))


def _resummed(strengths: Array, held: Array) -> Array:
    """All passes between tissue and face, (1/ρ - W)^-1 = (1 - ρ W)^-1 ρ, over the leading axes of `held`."""
    rho = np.diag(strengths)
    return np.asarray(np.linalg.solve(np.eye(strengths.size) - rho @ held, np.broadcast_to(rho, held.shape)))
