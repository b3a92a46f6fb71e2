"""Light in a scattering body, scattering by scattering: the volumetric reference, by Monte Carlo.

The body fills z > 0 behind its face z = 0, mm; +z points into it. It knows nothing of `slab` and `tissue`,
whose independent check it is. Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .arrays import floats
from .ftir import gap_transmittance

Array = NDArray[np.float64]
Passing = Callable[[mi.Point3f, mi.Float], mi.Float]
"""Transmittance of the face at points (z = 0) for light from inside at a cosine, both on the device."""
Scores = tuple[mi.Float, ...]
"""Of each parameter the derivative of the logarithm of a path's density."""
Witness = Callable[[mi.Point3f, mi.Vector3f, mi.Float, mi.Float, mi.Bool, mi.Bool, Scores], None]
"""Told of every collision and of light that the backing throws back: where, direction before it, share of the
light after it, mean cosine g, in which lanes, in which of these it is the backing (a Lambertian plane), and
the scores so far."""
Scoring = Callable[[mi.Point3f, mi.Float, mi.Bool, mi.Bool], Scores]
"""What a meeting with the face adds to scores: where, cosine, whether light leaves, and which lanes meet."""

_FIXED_POINT = float(
    2**20
)  # deposits are summed as integers: the sum does not depend on the order of threads
_LOTS = 32  # independent shares of the light, whose spread is the error
_FAINT = 0.5  # weight below which Russian roulette is played
_MOST_STEPS = 50_000
_STATE = ("where", "direction", "weight", "through", "alive", "step", "depth", "normal", "random")
_ANGLES = 1024  # nodes of a face's transmittance over the cosine


@dataclass(frozen=True)
class Medium:
    """A medium that scatters and absorbs: µs (not reduced) and µa, 1/mm, and g of Henyey and Greenstein
    (1941; key henyey1941)."""

    scattering_per_mm: float
    absorption_per_mm: float
    anisotropy: float = 0.0

    @property
    def extinction_per_mm(self) -> float:
        return self.scattering_per_mm + self.absorption_per_mm


class Face(Protocol):
    """A face that is not flat; the body lies on its +z side."""

    def at(self, point: mi.Point3f) -> tuple[mi.Float, mi.Vector3f]:
        """Depth of points below the face, mm, and its normal there, into the body."""


class Inclusion(Protocol):
    """A part of the body that is another medium, of the same refractive index."""

    @property
    def medium(self) -> Medium: ...

    def holds(self, point: mi.Point3f) -> mi.Bool:
        """Which points are in it."""


@dataclass(frozen=True)
class Ball:
    """A sphere of another medium below the face."""

    centre_mm: tuple[float, float, float]
    radius_mm: float
    medium: Medium

    def holds(self, point: mi.Point3f) -> mi.Bool:
        """Which points are in it."""
        centre, radius = mi.Point3f(*self.centre_mm), dr.opaque(mi.Float, self.radius_mm)
        return dr.squared_norm(point - centre) < dr.square(radius)


@dataclass(frozen=True)
class Body:
    """What light walks in: a half-space, or a slab in front of a Lambertian backing; another medium may be in
    it, and its face may be bent, by a height over x and y, little over a free path."""

    medium: Medium
    thickness_mm: float = np.inf
    backing: float = 0.0
    ball: Inclusion | None = None
    face: Face | None = None


@dataclass(frozen=True)
class Walked:
    """Shares of the light that entered, each with its standard error.

    Attributes
    ----------
    reflectance, transmittance
        (share, error) of what left through the face, and of what got to the slab's other face (and was not
        thrown back by the backing).
    profile, profile_error : (n,)
        Light leaving through the face per area, 1/mm², in rings between `edges_mm` about the entry.
    lobe, lobe_error : (b,)
        Light leaving in even steps of the squared cosine (in the body) from 0 to 1: all equal if Lambertian.
    """

    reflectance: tuple[float, float]
    transmittance: tuple[float, float]
    edges_mm: Array
    profile: Array
    profile_error: Array
    lobe: Array
    lobe_error: Array


def walk(
    body: Body,
    photons: int,
    seed: int,
    *,
    entry: float | None = None,
    indices: tuple[float, float] = (1.0, 1.0),
    edges_mm: Array | None = None,
    bins: int = 8,
) -> Walked:
    """Follow light that has entered at the origin.

    Parameters
    ----------
    entry
        Cosine in the body of a beam; None for Lambertian light.
    indices
        Refractive index of the body and of what is before its face (Fresnel, unpolarised); equal by default.
        The mirror reflection on the way in is not part of the result.
    edges_mm
        Of the rings; 40 of them from 0.05 to 20 mean free paths if None.
    """
    transport = body.medium.scattering_per_mm * (1 - body.medium.anisotropy) + body.medium.absorption_per_mm
    edges = (
        np.geomspace(0.05, 20.0, 41) / transport if edges_mm is None else np.asarray(edges_mm, dtype=float)
    )
    random = generator(photons, seed)
    along, around = random.next_float32(), random.next_float32()
    if entry is None:
        direction = mi.warp.square_to_cosine_hemisphere(mi.Point2f(along, around))
    else:
        direction = mi.Vector3f(float(np.sqrt(1.0 - entry**2)), 0.0, float(entry)) + dr.zeros(
            mi.Vector3f, photons
        )
    where = dr.zeros(mi.Point3f, photons)
    where, direction, weight, through, _, _ = roam(body, where, direction, random, fresnel(*indices))

    lot = dr.arange(mi.UInt32, photons) % _LOTS
    rings = floats(np.concatenate([[0.0], edges]))
    radius = dr.hypot(where.x, where.y)
    ring = dr.binary_search(0, edges.size + 1, lambda i: dr.gather(mi.Float, rings, i) <= radius)
    ring = dr.clip(ring, 1, edges.size + 1) - 1
    angle = dr.minimum(mi.UInt32(dr.square(direction.z) * bins), bins - 1)
    by_ring = _sums(weight, lot, ring, edges.size + 1) * (_LOTS / photons)
    by_angle = _sums(weight, lot, angle, bins) * (_LOTS / photons)
    below = _sums(through, lot, dr.zeros(mi.UInt32, photons), 1) * (_LOTS / photons)
    profile, profile_error = _mean(by_ring[:, 1:-1] / (np.pi * np.diff(edges**2)))
    lobe, lobe_error = _mean(by_angle)
    reflectance, transmittance = (_mean(part.sum(axis=1)) for part in (by_ring, below))
    return Walked(
        (float(reflectance[0]), float(reflectance[1])),
        (float(transmittance[0]), float(transmittance[1])),
        edges,
        profile,
        profile_error,
        lobe,
        lobe_error,
    )


def roam(
    body: Body,
    where: mi.Point3f,
    direction: mi.Vector3f,
    random: mi.PCG32,
    passing: Passing,
    active: mi.Bool | bool = True,
    witness: Witness | None = None,
    scores: Scores = (),
    scoring: Scoring | None = None,
) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Float, mi.PCG32, Scores]:
    """Follow light from points on or below the face until it leaves or is absorbed.

    Free paths are drawn for the densest medium; what collides elsewhere does so in proportion (delta
    tracking: Woodcock et al. 1965; key woodcock1965). A collision keeps the share µs/µt of the light.

    Returns
    -------
    where, direction
        Place on the face and direction (in the body, z < 0) in which the light leaves.
    weight
        Share that leaves there, 0 where it was absorbed.
    through
        Share that was lost at the slab's other face.
    random
        Random numbers for what comes next.
    scores
        What they began with, and what `scoring` added.
    """
    lanes = dr.width(where)
    medium, ball = body.medium, body.ball
    majorant = max(medium.extinction_per_mm, ball.medium.extinction_per_mm if ball else 0.0)
    longest = dr.opaque(mi.Float, 1.0 / majorant)
    bottom = dr.opaque(mi.Float, min(body.thickness_mm, 1e30))
    kept, real, g = (dr.opaque(mi.Float, v) for v in _collision(medium, majorant))
    if ball:
        kept_in, real_in, g_in = (dr.opaque(mi.Float, v) for v in _collision(ball.medium, majorant))
    isotropic = medium.anisotropy == 0.0 and (ball is None or ball.medium.anisotropy == 0.0)

    def lies(point: mi.Point3f) -> tuple[mi.Float, mi.Vector3f]:
        """Depth, and the face's normal."""
        return (point.z, mi.Vector3f(0.0, 0.0, 1.0)) if body.face is None else body.face.at(point)

    def going(where, direction, weight, through, alive, step, depth, normal, random, *scores):  # type: ignore[no-untyped-def]
        return alive

    def on(where, direction, weight, through, alive, step, depth, normal, random, *scores):  # type: ignore[no-untyped-def]
        if body.face is None:  # the place tells both, and the compiler knows the normal
            depth, normal = lies(where)
        sinks = dr.dot(direction, normal)
        up = sinks < 0.0
        free = -dr.log(1.0 - random.next_float32()) * longest
        face = dr.select(up, -depth, bottom - depth) / sinks
        face = dr.select(sinks == 0.0, dr.inf, face)
        if body.face is not None:  # which bends away from the plane that touches it: one step of Newton's
            tried = dr.minimum(face, free)
            below, leaning = lies(where + tried * direction)
            climbs = -dr.dot(direction, leaning)
            nearer = dr.select(climbs > 0.0, dr.maximum(tried + below / climbs, 0.0), dr.inf)
            met = (up & (face <= free)) | (below < 0.0)
            face, up = dr.select(met, nearer, face), up | met
        meets = free >= face
        ahead = where + dr.minimum(free, face) * direction
        at_face, at_bottom = meets & up, meets & ~up
        now, normal = lies(ahead)
        depth = dr.select(at_face, 0.0, dr.select(at_bottom, bottom, dr.maximum(now, 0.0)))
        where = mi.Point3f(ahead.x, ahead.y, ahead.z + (depth - now) / normal.z)
        sinks = dr.dot(direction, normal)

        u1, u2, u3 = (random.next_float32() for _ in range(3))
        leaves = at_face & (u3 < passing(where, -sinks))
        through = through + dr.select(alive & at_bottom, weight * (1.0 - body.backing), 0.0)
        weight = dr.select(at_bottom, weight * body.backing, weight)

        share, chance, mean = kept, real, g
        if ball:
            inside = ball.holds(where)
            share, chance, mean = (
                dr.select(inside, a, b) for a, b in ((kept_in, kept), (real_in, real), (g_in, g))
            )
        collides = ~meets & (u3 < chance)
        weight = dr.select(collides, weight * share, weight)
        if witness is not None:
            backed = alive & at_bottom & (body.backing > 0.0)
            witness(where, direction, weight, mean, backed | (alive & collides), backed, scores)
        if scoring is not None:
            more = scoring(where, -sinks, leaves, alive & at_face)
            scores = tuple(one + new for one, new in zip(scores, more, strict=True))
        turned = mi.Frame3f(direction).to_world(_scattered(mean, u1, u2, isotropic))
        thrown = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2))
        lambert = mi.Vector3f(thrown.x, thrown.y, -dr.maximum(thrown.z, 1e-6))
        mirrored = direction + (dr.abs(sinks) - sinks) * normal
        if body.face is not None:
            lambert = mi.Frame3f(normal).to_world(lambert)
        following = dr.select(collides, turned, dr.select(at_bottom, lambert, direction))
        following = dr.select(at_face & ~leaves, mirrored, following)
        direction = mi.Vector3f(dr.select(alive, dr.normalize(following), direction))

        survives = dr.select(weight < _FAINT, dr.maximum(weight, 1e-3) / _FAINT, 1.0)
        survives = dr.select(leaves, 1.0, survives)
        weight = dr.select(random.next_float32() < survives, weight / survives, 0.0)
        weight = dr.select(step < _MOST_STEPS, weight, 0.0)
        alive = alive & ~leaves & (weight > 0.0)
        return where, direction, weight, through, alive, step + 1, depth, normal, random, *scores

    state = (
        mi.Point3f(where),
        mi.Vector3f(direction),
        dr.full(mi.Float, 1.0, lanes),
        dr.zeros(mi.Float, lanes),
        dr.full(mi.Bool, True, lanes) & active,
        dr.zeros(mi.UInt32, lanes),
        *(place * dr.full(mi.Float, 1.0, lanes) for place in lies(mi.Point3f(where))),
        random,
        *scores,
    )
    labels = (*_STATE, *(f"score_{number}" for number in range(len(scores))))
    where, direction, weight, through, _, _, _, _, random, *scored = dr.while_loop(
        state, going, on, labels=labels
    )
    return where, direction, weight, through, random, tuple(scored)


def fresnel(n_body: float, n_before: float) -> Passing:
    """A plain face between two indices, unpolarised (Born & Wolf 1999, ch. 1; key born1999)."""
    cosine = np.linspace(0.0, 1.0, _ANGLES) ** 2  # crowded at grazing angles
    t_s, t_p = gap_transmittance(n_body, n_before, n_before, 0.0, cosine, 550.0)
    table = floats(0.5 * np.asarray(t_s + t_p))

    def passing(where: mi.Point3f, cosine: mi.Float) -> mi.Float:
        at = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (_ANGLES - 1)
        node = dr.minimum(mi.UInt32(at), _ANGLES - 2)
        low, high = (dr.gather(mi.Float, table, node + i) for i in (0, 1))
        return dr.lerp(low, high, at - mi.Float(node))

    return passing if n_body != n_before else lambda where, cosine: mi.Float(1.0)


def behind_guide(n_body: float, n_guide: float, transmittance: Passing) -> Passing:
    """A face whose transmittance is known for cosines in the guide (`bsdf.Table`): the same both ways."""
    square = (n_body / n_guide) ** 2

    def passing(where: mi.Point3f, cosine: mi.Float) -> mi.Float:
        inside = 1.0 - square * (1.0 - dr.square(cosine))
        return dr.select(inside > 0.0, transmittance(where, dr.safe_sqrt(inside)), 0.0)

    return passing


def _collision(medium: Medium, majorant: float) -> tuple[float, float, float]:
    """Share kept per collision, chance that a collision is real, and g."""
    extinction = medium.extinction_per_mm
    return medium.scattering_per_mm / max(extinction, 1e-30), extinction / majorant, medium.anisotropy


def _scattered(g: mi.Float, u1: mi.Float, u2: mi.Float, isotropic: bool) -> mi.Vector3f:
    """Direction after a scattering, about +z (Henyey & Greenstein 1941)."""
    cosine = 1.0 - 2.0 * u1
    if not isotropic:
        fraction = (1.0 - dr.square(g)) / (1.0 - g + 2.0 * g * u1)
        skewed = (1.0 + dr.square(g) - dr.square(fraction)) / (2.0 * g)
        cosine = dr.select(dr.abs(g) > 1e-3, skewed, cosine)
    sine = dr.sqrt(dr.maximum(1.0 - dr.square(cosine), 0.0))
    s, c = dr.sincos(dr.two_pi * u2)
    return mi.Vector3f(sine * c, sine * s, cosine)


def generator(lanes: int, seed: int) -> mi.PCG32:
    """Random numbers for so many lanes, which depend on the seed and nothing else."""
    sequence = dr.arange(mi.UInt64, lanes) + 1
    return mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)


def _sums(amount: mi.Float, lot: mi.UInt32, place: mi.UInt32, count: int) -> Array:
    """Amounts summed by lot and place, (lots, count), in fixed point."""
    sums = dr.zeros(mi.Int64, _LOTS * count)
    dr.scatter_add(sums, mi.Int64(dr.round(amount * _FIXED_POINT)), lot * count + place, amount > 0.0)
    return np.asarray(sums.numpy().reshape(_LOTS, count) / _FIXED_POINT)


def _mean(lots: Array) -> tuple[Array, Array]:
    """Mean over lots, and its standard error."""
    return lots.mean(axis=0), lots.std(axis=0, ddof=1) / np.sqrt(len(lots))
