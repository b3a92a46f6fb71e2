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

from .irradiance import AngularBasis, Entrance, Weighing, by_fraction, transmitted
from .passage import Face, Glimpse, Passage, Seen
from .transport import INSIDE, MARGIN, Under

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
    """Weighted irradiance (n_led, layers, GRID, GRID), W/mm², on all layers of a `Basis`, and its derivatives
    (q, n_led, told, GRID, GRID) on the first."""

    light: Singles
    slopes: Singles

    def __add__(self, other: Landed) -> Landed:
        return Landed(self.light + other.light, self.slopes + other.slopes)

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
        """From the derivatives of the contact fraction on its cells, (q, GRID, GRID), and of the optics."""
        basis, behind, fraction = under.entrance.basis, under.behind, under.ground.fraction
        wide = np.pad(fraction, MARGIN)
        bare = np.pad(np.zeros(fraction.shape, bool), MARGIN, constant_values=True)
        first, changes = basis.layers, []
        for slope, other in zip(slopes, others, strict=True):
            entrances, held = [], np.zeros((*behind.coupling.free.shape, *wide.shape))
            faces = [np.zeros((*free.shape, *wide.shape)) for free in behind.coupling.thrown_free[:2]]
            if slope.any():
                entrances.append((_steep(basis, fraction, slope), slice(0, basis.layers)))
                risen = np.pad(slope, MARGIN)
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
        """`Under.again` of all, (1 + q, n_led, modes, GRID, GRID)."""
        entering = self._entering(landed, self._modes)
        return self._solved(entering, 1e-3)[..., INSIDE, INSIDE]

    def upward(self, landed: Landed) -> Array:
        """`Under.upward` of all."""
        entering = self._entering(landed)
        straight = np.stack([self._passage.enter(one)[0] for one in entering])
        return self._solved(entering[:, :, : self._modes], 1e-3, straight)[..., INSIDE, INSIDE]

    def seen(self, landed: Landed) -> list[Seen]:
        """`Under.seen`, and its derivatives to each parameter."""
        passage, spread, fraction = self._passage, self.under.behind.spread, self._fraction
        entering = self._entering(landed)
        straight, glimpses = map(list, zip(*(passage.enter(one) for one in entering), strict=True))
        upward = self._solved(entering[:, :, : self._modes], 1e-6, np.stack(straight))
        face = passage.face(fraction)
        thrown = [passage.thrown_back(one, face) for one in upward]
        more = np.zeros_like(upward)
        for number, (further, _) in enumerate(thrown):
            more[number, :, 0] = further
        turned = [
            None if change.face is None else passage.thrown_back(upward[0], change.face)
            for change in self.changes
        ]
        for number, one in enumerate(turned, start=1):
            if one is not None:
                more[number, :, 0] += one[0]
        more[0] = spread.solve(more[0], fraction, 1e-3)
        for number, change in enumerate(self.changes, start=1):
            source = more[number] if change.held is None else more[number] + _held(change.held, more[0])
            more[number] = spread.solve(source, fraction, 1e-3)
        last = [passage.thrown_back(one, face, even=True)[1] for one in more]
        found = [[*parts] for parts in zip(glimpses, (again for _, again in thrown), last, strict=True)]
        for parts, change, one in zip(found[1:], self.changes, turned, strict=True):
            if change.face is not None and one is not None:
                parts += [one[1], passage.thrown_back(more[0], change.face, even=True)[1]]
        return _tangents(passage, found)

    def _entering(self, landed: Landed, only: int | None = None) -> Array:
        """`irradiance.transmitted` of all, (1 + q, n_led, functions, GRID, GRID)."""
        entrance, meets = self.under.entrance, self.under.ground.meets
        lights = (landed.light[:, : entrance.basis.layers], *landed.slopes)
        found = [transmitted(entrance, one * meets, only) for one in lights]
        for one, change in zip(found[1:], self.changes, strict=True):
            for steep, layers in change.entrances:
                one += transmitted(steep, landed.light[:, layers] * meets, only)
        return np.stack(found)

    def _solved(self, entering: Array, tolerance: float, straight: Array | None = None) -> Array:
        """V of all, with the margin."""
        spread, fraction = self.under.behind.spread, self._fraction
        wide = np.pad(entering, ((0, 0), (0, 0), (0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN)))
        if straight is not None:
            wide[:, :, 0] = straight
        found = [spread.solve(wide[0], fraction, tolerance)]
        for source, change in zip(wide[1:], self.changes, strict=True):
            more = source if change.held is None else source + _held(change.held, found[0])
            found.append(spread.solve(more, fraction, tolerance))
        return np.stack(found)

    @property
    def _passage(self) -> Passage:
        return self.under.behind.passage

    @property
    def _modes(self) -> int:
        return len(self.under.behind.coupling.lobes)

    @property
    def _fraction(self) -> Array:
        return np.pad(self.under.ground.fraction, MARGIN, constant_values=np.nan)


def _tangents(passage: Passage, found: list[list[Glimpse]]) -> list[Seen]:
    """What goes to the camera from the light's glimpses, and of each parameter's."""
    middle = passage.towards_camera(*found[0])
    sums, seen = middle.maps.sum(axis=(1, 2)), [middle]
    for parts in found[1:]:
        maps = passage.towards_camera(*parts).maps
        behind = np.sum([one.behind for one in parts], axis=0) - middle.behind_mm * maps.sum(axis=(1, 2))
        behind = behind / np.maximum(sums, 1e-300)
        seen.append(Seen(maps, behind, -passage.transport_per_mm * behind))
    return seen


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
