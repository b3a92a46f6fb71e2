"""How light in and under the contact answers small changes: the tangent of `transport`, order by order.

Arrays of light have a first axis of 1 + q: the light, then its derivatives to q parameters, per unit of each.
The tissue's part is linear in light, and its equations V = R (*) [E + W V] are differentiated as they
stand, dV = R (*) [dE + dW V + W dV], so that the solver itself finds the derivative.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .abreast import abreast
from .irradiance import AngularBasis, Entrance, Weighing, by_fraction, transmitted
from .passage import Face, Glimpse, Passage, Seen
from .transport import Under, coarser, even

Array = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Other:
    """Derivative of the contact's optics to a parameter, on the nodes of its tables.

    Attributes
    ----------
    transmittance : (n_fraction, n_cos), of `contact.ContactOptics`.
    held : (n_fraction, modes, modes), of `tissue.Coupling`.
    thrown : by harmonic, (n_fraction, r, r), of the same.
    basis : of the tissue's functions times `transmittance`.
    """

    transmittance: Array
    held: Array
    thrown: tuple[Array, ...]
    basis: AngularBasis


@dataclass(frozen=True)
class Basis:
    """An `AngularBasis` and, of light whose derivatives nobody needs, those of other optics beside it."""

    parts: tuple[AngularBasis, ...]

    @property
    def layers(self) -> int:
        return sum(part.layers for part in self.parts)

    @property
    def told(self) -> int:
        return self.parts[0].layers

    def weights(self) -> _Weights:
        return _Weights(tuple(part.weights() for part in self.parts))


@dataclass(frozen=True)
class _Weights:
    parts: tuple[Weighing, ...]

    def at(self, *where):  # type: ignore[no-untyped-def]
        return [weight for part in self.parts for weight in part.at(*where)]


@dataclass(frozen=True)
class _Change:
    """What a parameter changes under the contact.

    Attributes
    ----------
    entrances : list of (Entrance, slice)
        Derivatives of what enters, and on which layers of the light.
    held : (modes, modes, m, m) or None
        Of W, with the margin.
    face : of what the face throws back, or None.
    """

    entrances: list[tuple[Entrance, slice]]
    held: Array | None
    face: Face | None


@dataclass(frozen=True)
class Landed:
    """Weighted irradiance (n_led, layers, m, m), W/mm², on all layers of a `Basis`, and its derivatives
    (q, n_led, told, m, m) on the first."""

    light: Singles
    slopes: Singles

    def __add__(self, other: Landed) -> Landed:
        return Landed(self.light + other.light, self.slopes + other.slopes)

    def even(self, factor: int = 1) -> Landed:
        """Smooth, on cells so many times finer."""
        return Landed(even(self.light, factor), even(self.slopes, factor))

    def coarser(self) -> Landed:
        """On the cells that walks are counted on."""
        return Landed(coarser(self.light), coarser(self.slopes))

    def over(self, count: int) -> Landed:
        """So many times less."""
        return Landed(self.light / np.float32(count), self.slopes / np.float32(count))


@dataclass(frozen=True)
class Response:
    """The tissue under one contact, and how it answers; make it with `of`."""

    under: Under
    changes: list[_Change]

    @staticmethod
    def of(under: Under, slopes: Array, others: Sequence[Other | None]) -> Response:
        """From the derivatives of the contact fraction on its cells, (q, m, m), and of the optics."""
        basis, behind, fraction = under.entrance.basis, under.behind, under.ground.fraction
        wide = np.pad(fraction, under.margin)
        bare = np.pad(np.zeros(fraction.shape, bool), under.margin, constant_values=True)
        first, changes = basis.layers, []
        for slope, other in zip(slopes, others, strict=True):
            entrances, held = [], np.zeros((*behind.coupling.free.shape, *wide.shape))
            faces = [np.zeros((*free.shape, *wide.shape)) for free in behind.coupling.thrown_free[:2]]
            if slope.any():
                entrances.append((_steep(basis, fraction, slope), slice(0, basis.layers)))
                risen = np.pad(slope, under.margin)
                held += _by_node(_rise(behind.coupling.held), wide, risen)
                for face, table in zip(faces, behind.coupling.thrown, strict=False):
                    face += _by_node(_rise(table), wide, risen)
            if other is not None:
                entrances.append(
                    (Entrance.at(other.basis, fraction), slice(first, first + other.basis.layers))
                )
                first += other.basis.layers
                inside = np.where(bare, 0.0, 1.0)
                held += inside * _between(other.held, wide)
                for face, table in zip(faces, other.thrown, strict=False):
                    face += inside * _between(table, wide)
            moves = bool(entrances)
            turned = Face(faces[0].astype(np.float32), (0.5 * faces[1]).astype(np.float32))
            changes.append(_Change(entrances, held if moves else None, turned if moves else None))
        return Response(under, changes)

    def again(self, landed: Landed) -> Array:
        """`Under.again` of all, (1 + q, n_led, modes, m, m)."""
        inside = self.under.inside

        def one(number: int) -> Array:
            source = self.under.wide(self._entering(landed, number, self._modes))
            found = self._answered(source, 1e-3)
            return found[..., inside, inside] * self.under.factor(source, found)

        return np.stack(abreast(one, len(landed.light)), axis=1)

    def upward(self, landed: Landed) -> Array:
        """`Under.upward` of all."""
        inside = self.under.inside

        def one(number: int) -> Array:
            entering = self._entering(landed, number)
            straight = self._passage.enter(entering, glimpse=False)[0]
            source = self.under.wide(entering[:, : self._modes], straight)
            found = self._answered(source, 1e-3)
            return found[..., inside, inside] * self.under.factor(source, found)

        return np.stack(abreast(one, len(landed.light)), axis=1)

    def seen(self, landed: Landed) -> list[Seen]:
        """`Under.seen`, and its derivatives to each parameter."""
        found = abreast(lambda number: self._seen(landed, number), len(landed.light))
        return [Seen.of(parts) for parts in zip(*found, strict=True)]

    def _seen(self, landed: Landed, number: int) -> list[Seen]:
        """The same of one LED."""
        passage, face = self._passage, self.under.face
        entering = self._entering(landed, number)
        straight, first = passage.enter(entering)
        source = self.under.wide(entering[:, : self._modes], straight)
        upward = self._answered(source, 1e-6)
        further, again = passage.thrown_back(upward, face)
        more = np.zeros_like(upward)
        more[:, 0] = further
        turned: list[list[Glimpse]] = [[] for _ in self.changes]
        for k, change in enumerate(self.changes):
            if change.face is not None:
                extra, glimpse = passage.thrown_back(upward[:1], change.face)
                more[1 + k, 0] += extra[0]
                turned[k].append(glimpse)
        more = self._answered(more, 1e-3)
        last = passage.last_thrown_back(more, face)
        for parts, change in zip(turned, self.changes, strict=True):
            if change.face is not None:
                parts.append(passage.last_thrown_back(more[:1], change.face))
        whole = [[one.only(k) for one in (first, again, last)] for k in range(len(entering))]
        seen = [passage.towards_camera(*whole[0])]
        for parts, beside in zip(whole[1:], turned, strict=True):
            seen.append(passage.change_towards_camera(whole[0], [*parts, *beside]))
        factor = self.under.factor(source, upward)
        return [self.under.bent(one, factor) for one in seen]

    def _entering(self, landed: Landed, number: int, only: int | None = None) -> Array:
        """`irradiance.transmitted` of one LED's light and its derivatives, (1 + q, functions, m, m)."""
        entrance, counts = self.under.entrance, self.under.ground.meets
        light = landed.light[number : number + 1]
        lights = np.concatenate([light[:, : entrance.basis.layers], landed.slopes[:, number]])
        found = transmitted(entrance, lights * counts, only).astype(np.float64)
        for one, change in zip(found[1:], self.changes, strict=True):
            for steep, layers in change.entrances:
                one += transmitted(steep, light[:, layers] * counts, only)[0]
        return found

    def _answered(self, sources: Array, tolerance: float) -> Array:
        """V of E, and dV of dE + dW V: (1 + q, modes, m, m), with the margin."""
        bed = self.under.bed
        found = np.empty_like(sources)
        found[:1] = bed.solve(sources[:1], tolerance)
        for k, change in enumerate(self.changes, start=1):
            more = sources[k : k + 1]
            if change.held is not None:
                more = more + _held(change.held, found[:1])
            found[k : k + 1] = bed.solve(more, tolerance)
        return found

    @property
    def _passage(self) -> Passage:
        return self.under.behind.passage

    @property
    def _modes(self) -> int:
        return len(self.under.behind.coupling.lobes)


def _steep(basis: AngularBasis, fraction: Array, slope: Array) -> Entrance:
    """Derivative of `Entrance.at` along a slope of the fraction."""

    def rows(table: Array) -> Singles:
        return _by_node(_rise(np.moveaxis(table, 1, 0)), fraction, slope).astype(np.float32)

    return Entrance(basis, rows(basis.rows), tuple(rows(part.rows) for part in basis.turning))


def _rise(table: Array) -> Array:
    """Slope over the contact fraction between the nodes (first axis) of a table."""
    return np.diff(table, axis=0) * (len(table) - 1)


def _by_node(rise: Array, fraction: Array, slope: Array) -> Array:
    """Rise (n - 1, *shape) between nodes, where the fraction is (m, m), times its slope: (*shape, m, m)."""
    node = np.clip((fraction * len(rise)).astype(np.int64), 0, len(rise) - 1)
    return np.moveaxis(rise[node], (0, 1), (-2, -1)) * slope


def _between(table: Array, fraction: Array) -> Array:
    """Values on nodes (n, i, j) at fractions (m, m): (i, j, m, m)."""
    return by_fraction(np.moveaxis(table, 0, 1), fraction).astype(np.float64)


def _held(held: Array, upward: Array) -> Array:
    """Σ_j W_ij V_j of (modes, modes, m, m) and (n, modes, m, m)."""
    return np.einsum("ijyx,njyx->niyx", held, upward)
