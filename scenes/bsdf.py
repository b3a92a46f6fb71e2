"""The contact surface as a Mitsuba BSDF: frustrated total internal reflection in front of a diffusing tissue.

Import only after a variant is set (`scenes.backend.use`): Mitsuba binds the class to the active variant.
"""

from __future__ import annotations

import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import floats, tensor
from .contact import ContactOptics
from .tissue import Coupling


class Table:
    """A `ContactOptics` and the tissue's lobes on the device, looked up (bi)linearly.

    `transmittance(fraction, cosine)`, `hemispherical(fraction)`, `lobes(cosine)` and
    `diffuse(fraction, cosine_in, cosine_out)` take and return `mi.Float`.
    """

    def __init__(self, packed: mi.TensorXf) -> None:
        values = packed.numpy()
        self.modes = int(values[-1, -1])
        self.rows, self.columns = values.shape[0] - self.modes, values.shape[1] - 1 - self.modes**2
        top = values[: self.rows]
        self._t = floats(top[:, : self.columns])
        self._mean = floats(top[:, self.columns])
        self._gain = [floats(column) for column in top[:, self.columns + 1 :].T]
        self._lobes = [floats(row[: self.columns]) for row in values[self.rows :]]
        binned, summed = _binned(top[:, : self.columns].astype(np.float64))
        self._binned = floats(binned)
        self._summed = floats(summed)
        self._all = floats(summed[:, -1])

    @staticmethod
    def pack(optics: ContactOptics, coupling: Coupling | None = None) -> mi.TensorXf:
        """One tensor, the form in which a Mitsuba scene description can carry it.

        (n_fraction + modes, n_cos + 1 + modes²): T, its hemispherical mean and the gains K_ij, and below them
        the lobes and, as last number, how many there are. Without `coupling`, one even lobe.
        """
        rows, columns = optics.transmittance.shape
        lobes = np.ones((1, columns)) if coupling is None else coupling.lobes
        gain = optics.diffuse_gain[:, None, None] if coupling is None else coupling.gain
        top = np.hstack([optics.transmittance, optics.hemispherical[:, None], gain.reshape(rows, -1)])
        packed = np.zeros((rows + len(lobes), top.shape[1]), dtype=np.float32)
        packed[:rows], packed[rows:, :columns], packed[-1, -1] = top, lobes, len(lobes)
        return tensor(packed)

    def transmittance(self, fraction: mi.Float, cosine: mi.Float, active: mi.Bool | bool = True) -> mi.Float:
        return self.steep(fraction, cosine, active)[0]

    def steep(
        self, fraction: mi.Float, cosine: mi.Float, active: mi.Bool | bool = True
    ) -> tuple[mi.Float, mi.Float]:
        """Transmittance, and its derivative to the contact fraction."""
        i, u = _cell(fraction, self.rows)
        j, v = _cell(cosine, self.columns)
        corner = i * self.columns + j
        t00, t01 = (dr.gather(mi.Float, self._t, corner + k, active) for k in (0, 1))
        t10, t11 = (dr.gather(mi.Float, self._t, corner + self.columns + k, active) for k in (0, 1))
        low, high = dr.lerp(t00, t01, v), dr.lerp(t10, t11, v)
        return dr.lerp(low, high, u), (high - low) * (self.rows - 1)

    def look_up(
        self, values: mi.Float, fraction: mi.Float, cosine: mi.Float, active: mi.Bool | bool = True
    ) -> mi.Float:
        """Other values on the nodes of the transmittance, between these as that is."""
        i, u = _cell(fraction, self.rows)
        j, v = _cell(cosine, self.columns)
        corner = i * self.columns + j
        low, high = (
            dr.lerp(dr.gather(mi.Float, values, at, active), dr.gather(mi.Float, values, at + 1, active), v)
            for at in (corner, corner + self.columns)
        )
        return dr.lerp(low, high, u)

    def moved(self, change: mi.Float) -> Table:
        """The same with so much more transmittance on its nodes; drawn from is what was."""
        other = copy.copy(self)
        other._t = self._t + change
        return other

    def hemispherical(self, fraction: mi.Float, active: mi.Bool | bool = True) -> mi.Float:
        return self._row(self._mean, fraction, active)

    def lobes(self, cosine: mi.Float, active: mi.Bool | bool = True) -> list[mi.Float]:
        """The tissue's lobes phi_i at cosines in the guide."""
        j, v = _cell(cosine, self.columns)
        return [
            dr.lerp(dr.gather(mi.Float, lobe, j, active), dr.gather(mi.Float, lobe, j + 1, active), v)
            for lobe in self._lobes
        ]

    def diffuse(
        self, fraction: mi.Float, cos_in: mi.Float, cos_out: mi.Float, active: mi.Bool | bool = True
    ) -> mi.Float:
        """Reflectance of tissue that gives light back where it came in, behind the face:
        sum phi_i(cos_in) K_ij phi_j(cos_out)."""
        before, after = self.lobes(cos_in, active), self.lobes(cos_out, active)
        return sum(
            (
                before[i] * self._row(self._gain[i * self.modes + j], fraction, active) * after[j]
                for i in range(self.modes)
                for j in range(self.modes)
            ),
            mi.Float(0.0),
        )

    def typical(self, fraction: mi.Float, cos_in: mi.Float, active: mi.Bool | bool = True) -> mi.Float:
        """About what comes back of the light that passed: it only decides how often to follow it."""
        back = dr.maximum(self.diffuse(fraction, cos_in, cos_in, active), 1e-3)
        return back * self.hemispherical(fraction, active)

    def leaving(
        self, fraction: mi.Float, cos_in: mi.Float, cos_out: mi.Float, active: mi.Bool | bool = True
    ) -> mi.Float:
        """What of the light that passed leaves again per solid angle, times cosine, 1/sr."""
        back = self.diffuse(fraction, cos_in, cos_out, active)
        return dr.maximum(back * self.transmittance(fraction, cos_out, active), 0.0) * cos_out * dr.inv_pi

    def draw(
        self, fraction: mi.Float, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool | bool = True
    ) -> mi.Vector3f:
        """Directions that fill the hemisphere as re-emitted light does, in proportion to T(cos) cos."""
        i, u = _cell(fraction, self.rows)
        low, high = (dr.gather(mi.Float, self._all, i + k, active) for k in (0, 1))
        upper = sample1 * dr.lerp(low, high, u) >= (1.0 - u) * low
        row = dr.select(upper, i + 1, i)
        start = row * _BINS
        aim = sample2.x * dr.gather(mi.Float, self._all, row, active)
        found = dr.binary_search(
            0, _BINS - 1, lambda k: dr.gather(mi.Float, self._summed, start + k, active) <= aim
        )
        end = dr.gather(mi.Float, self._summed, start + found, active)
        height = dr.gather(mi.Float, self._binned, start + found, active)
        within = dr.clip(1.0 - (end - aim) * _BINS / height, 0.0, 1.0)
        squared = (mi.Float(found) + within) / _BINS  # of the cosine
        sine, cosine = dr.sqrt(dr.maximum(1.0 - squared, 0.0)), dr.sqrt(squared)
        s, c = dr.sincos(dr.two_pi * sample2.y)
        return mi.Vector3f(sine * c, sine * s, cosine)

    def density(self, fraction: mi.Float, cosine: mi.Float, active: mi.Bool | bool = True) -> mi.Float:
        """Density of `draw` per solid angle, 1/sr."""
        i, u = _cell(fraction, self.rows)
        place = i * _BINS + dr.minimum(mi.UInt32(dr.square(cosine) * _BINS), _BINS - 1)
        low, high = (dr.gather(mi.Float, self._binned, place + k * _BINS, active) for k in (0, 1))
        low_all, high_all = (dr.gather(mi.Float, self._all, i + k, active) for k in (0, 1))
        return dr.lerp(low, high, u) / dr.lerp(low_all, high_all, u) * cosine * dr.inv_pi

    def _row(self, data: mi.Float, fraction: mi.Float, active: mi.Bool | bool) -> mi.Float:
        i, u = _cell(fraction, self.rows)
        return dr.lerp(dr.gather(mi.Float, data, i, active), dr.gather(mi.Float, data, i + 1, active), u)


def read_table(filename: str) -> mi.TensorXf:
    """A packed table from an .npy file; relative names are looked for beside the scene file.

    Raises ValueError, in one line, for a file that is no such table.
    """
    path = mi.file_resolver().resolve(filename)
    try:
        with open(str(path), "rb") as file:
            packed = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise ValueError(
            f"frustrated_tir: filename: received {filename!r} ({error}); allowed a table"
        ) from None
    modes = packed[-1, -1] if packed.ndim == 2 and packed.size and packed.dtype == np.float32 else np.nan
    if modes not in range(1, 9) or min(packed.shape[0] - modes, packed.shape[1] - 1 - modes**2) < 2:
        received = f"{filename!r} with {packed.dtype} of shape {packed.shape}"
        raise ValueError(f"frustrated_tir: filename: received {received}; allowed a table of `Table.pack`")
    shares = packed[: -int(modes), : -int(modes**2)]
    if not (np.isfinite(packed).all() and shares.min() >= 0.0 and shares.max() <= 1.0 + 1e-5):
        received = f"{filename!r} with numbers that are no shares of light"
        raise ValueError(f"frustrated_tir: filename: received {received}; allowed 0 to 1")
    return tensor(packed)


_BINS = 512  # of squared cosine, in which `Table.draw` takes T as constant
_FLOOR = 1e-4  # of T there: no direction is left out


def _binned(transmittance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T averaged over bins of squared cosine (uniform in cosine-weighted solid angle), and its sums."""
    middles = np.sqrt((np.arange(4 * _BINS) + 0.5) / (4 * _BINS))
    nodes = np.linspace(0.0, 1.0, transmittance.shape[1])
    fine = np.stack([np.interp(middles, nodes, row) for row in transmittance])
    binned = np.maximum(fine.reshape(len(fine), _BINS, 4).mean(axis=2), _FLOOR)
    return binned, np.cumsum(binned, axis=1) / _BINS


def _cell(x: mi.Float, nodes: int) -> tuple[mi.UInt32, mi.Float]:
    scaled = dr.clip(x, 0.0, 1.0) * (nodes - 1)
    index = dr.minimum(mi.UInt32(scaled), nodes - 2)
    return index, scaled - mi.Float(index)


class FrustratedTIR(mi.BSDF):
    """Mirror reflection 1 - T and a diffuse lobe T(cos_i) T(cos_o) K(cos_i, cos_o) / pi.

    Reciprocal, and black from behind.

    Properties: `table` (from `Table.pack`) or `filename` (of an .npy file that holds it), `contact_fraction`
    (a texture, real contact fraction 0..1). The side that the surface normal points to is the guide.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        packed = props["table"] if "table" in props else read_table(props["filename"])
        self.table = Table(mi.TensorXf(packed))
        self.fraction = props["contact_fraction"]
        mirror = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.SpatiallyVarying
        diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.SpatiallyVarying
        self.m_components = [mirror, diffuse]
        self.m_flags = mirror | diffuse

    def traverse(self, callback: Any) -> None:
        callback.put("contact_fraction", self.fraction, mi.ParamFlags.Differentiable)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool | bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color1f]:
        cos_i = mi.Frame3f.cos_theta(si.wi)
        active = active & (cos_i > 0.0)
        a, t = self._at(si, cos_i, active)
        mirror = mi.Float(1.0 if ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0) else 0.0) * (1.0 - t)
        diffuse = mi.Float(1.0 if ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1) else 0.0) * t
        albedo = mirror + diffuse * self.table.typical(a, cos_i, active)
        p_mirror = dr.select(albedo > 0.0, mirror / albedo, 0.0)
        is_mirror = sample1 < p_mirror

        bs = dr.zeros(mi.BSDFSample3f)
        rest = (sample1 - p_mirror) / dr.maximum(1.0 - p_mirror, 1e-6)
        if ctx.mode == mi.TransportMode.Importance:
            spread = self.table.draw(a, rest, sample2, active)
        else:
            spread = mi.warp.square_to_cosine_hemisphere(sample2)
        cos_spread = mi.Frame3f.cos_theta(spread)
        density = self._density(ctx, a, cos_spread, active)
        bs.wo = dr.select(is_mirror, mi.reflect(si.wi), spread)
        bs.pdf = dr.select(is_mirror, p_mirror, (1.0 - p_mirror) * density)
        bs.eta = 1.0
        bs.sampled_type = dr.select(
            is_mirror, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        )
        bs.sampled_component = dr.select(is_mirror, mi.UInt32(0), mi.UInt32(1))
        active &= bs.pdf > 0.0
        value = diffuse * self.table.leaving(a, cos_i, cos_spread, active)
        weight = dr.select(is_mirror, albedo, dr.select(bs.pdf > 0.0, value / bs.pdf, 0.0))
        return bs, mi.Color1f(weight) & active

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Color1f:
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0.0) & (cos_o > 0.0)
        if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1):
            return mi.Color1f(0.0)
        a, t = self._at(si, cos_i, active)
        return mi.Color1f(t * self.table.leaving(a, cos_i, cos_o, active)) & active

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0.0) & (cos_o > 0.0)
        if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1):
            return mi.Float(0.0)
        a, t = self._at(si, cos_i, active)
        mirror = mi.Float(1.0 if ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0) else 0.0) * (1.0 - t)
        albedo = mirror + t * self.table.typical(a, cos_i, active)
        share = dr.select(albedo > 0.0, 1.0 - mirror / albedo, 0.0)
        return dr.select(active, share * self._density(ctx, a, cos_o, active), 0.0)

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def _density(self, ctx: mi.BSDFContext, a: mi.Float, cosine: mi.Float, active: mi.Bool) -> mi.Float:
        """Density of the diffuse directions, 1/sr.

        Light from an LED follows the lobe, so that its weight stays that of the tissue's albedo; paths from
        the camera are spread evenly, because LEDs are found in the trapped directions, a small part of it.
        """
        if ctx.mode == mi.TransportMode.Importance:
            return self.table.density(a, cosine, active)
        return dr.maximum(cosine, 0.0) * dr.inv_pi

    def _at(self, si: mi.SurfaceInteraction3f, cos_i: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        a = self.fraction.eval_1(si, active)
        a = dr.select(dr.isfinite(a), a, 0.0)  # slivers at a pressed-back rim have no barycentric coordinates
        return a, self.table.transmittance(a, cos_i, active)

    def to_string(self) -> str:
        return f"FrustratedTIR[table = {self.table.rows} x {self.table.columns}]"


mi.register_bsdf("frustrated_tir", FrustratedTIR)
