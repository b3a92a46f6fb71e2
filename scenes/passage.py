"""Light's passes through the tissue, on cells: what enters at an angle comes out ahead and spread.

Each map of what enters (`irradiance.transmitted`) is spread by its own kernel (`aslant`), for all light that
leaves and for what leaves towards the camera, which comes from deeper; and so is what the face throws back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .aslant import AHEAD, ALL, DEEP, HELD, LEFT, RISE, STEEP, Aslant
from .tissue import Coupling

Array = NDArray[np.float64]

_PADDED = 1.5  # light that has come farther than half the face is left out
_LEAST = 1e-30  # in place of no light below a fraction bar


@dataclass(frozen=True)
class Face:
    """What a face throws back of light that leaves with one function of the angle as light of another:
    (i, j, cells, cells), of harmonic 0, and of harmonic 1."""

    even: NDArray[np.float32]
    turning: NDArray[np.float32]


@dataclass(frozen=True)
class Glimpse:
    """What of a pass leaves along the normal, and what `Passage.beside` tells of light beside it: Fourier
    transforms (n, p, p // 2 + 1) and (n, 1 or 3, p, p // 2 + 1)."""

    spectra: NDArray[np.complex64]
    beside: NDArray[np.complex64]

    def only(self, number: int) -> Glimpse:
        """That of one source."""
        return Glimpse(self.spectra[number : number + 1], self.beside[number : number + 1])


@dataclass(frozen=True)
class Seen:
    """Light that leaves towards the camera.

    Attributes
    ----------
    maps : (n, 4, m, m)
        π times the radiance in the tissue along the normal, W/mm², on cells [iy, ix] of the guide's face and
        a margin beside it. Then of what leaves aslant, beyond what `behind_mm` and `steeper` say of all: its
        further rise per 1 - cosine, and per sine of the angle in the tissue towards +x and +y, W/mm². Or
        (n, 1, m, m) without them.
    behind_mm : (n,)
        How far behind, mm per sine of the angle in the tissue, light is to be looked up that leaves aslant.
    steeper : (n,)
        Its relative rise per 1 - cosine: what leaves aslant has come from less deep.
    """

    maps: NDArray[np.floating]
    behind_mm: Array
    steeper: Array

    @staticmethod
    def of(parts: Sequence[Seen]) -> Seen:
        """Of several sources."""
        columns = zip(*((one.maps, one.behind_mm, one.steeper) for one in parts), strict=True)
        return Seen(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class Passage:
    """The kernels of one tissue on one grid of square cells; make it with `passage`.

    Attributes
    ----------
    entering, leaving, seen : (functions, p, p // 2 + 1)
        Fourier transforms of the kernels, over cells, padded so that nothing wraps round: of Lambertian light
        of which as much is thrown back as of what entered, and of which as much comes out; of the light
        towards the camera.
    beside : (1 or 3, functions, p, p // 2 + 1)
        Of that light times its depth, mm. Or, where scatterings favour a direction, of its change per
        1 - cosine, and per sine of the angle in the tissue towards +x and +y, as light goes.
    shift : (p, p // 2 + 1)
        Moves the origin from the guide's first cell to the margin's.
    rings, turns
        How many functions are of harmonic 0, and of harmonic 1 with the cosine.
    cells, margin
        Of the guide's face per side, and beside it.
    thrown, free : by harmonic, (n_fraction, r, r) and (r, r)
        Of `tissue.Coupling`.
    transport_per_mm
        Of `aslant.Aslant`.
    cell_mm
        Side of a cell.
    """

    entering: NDArray[np.complex64]
    leaving: NDArray[np.complex64]
    seen: NDArray[np.complex64]
    beside: NDArray[np.complex64]
    shift: NDArray[np.complex64]
    rings: int
    turns: int
    cells: int
    margin: int
    thrown: tuple[Array, ...]
    free: tuple[Array, ...]
    transport_per_mm: float
    cell_mm: float

    def enter(self, maps: NDArray[np.floating], *, glimpse: bool = True) -> tuple[Array, Glimpse]:
        """From maps (n, functions, m, m) of what enters, W/mm²: Lambertian irradiance that would come out as
        it does, (n, cells, cells) with the margin; and what of the first pass leaves along the normal, or
        nothing where no `glimpse` is asked for."""
        entering, found = self._nothing(len(maps))
        for number, one in enumerate(maps):
            spectra = self._forth(one)
            entering[number] = self._back(self.shift * _summed(spectra, self.entering))
            if glimpse:
                found.spectra[number] = self.shift * _summed(spectra, self.seen)
                found.beside[number] = [self.shift * _summed(spectra, one) for one in self.beside]
        return entering, found

    def face(self, fraction: Array) -> Face:
        """The face where the real contact fraction is (cells, cells), not a number where no guide is but bare
        skin."""
        bare = np.isnan(fraction)
        nodes, known = np.linspace(0.0, 1.0, len(self.thrown[0])), np.where(bare, 0.0, fraction)

        def at(harmonic: int) -> NDArray[np.float32]:
            table, free = self.thrown[harmonic], self.free[harmonic]
            found = np.empty((*free.shape, *fraction.shape), np.float32)
            for i, j in np.ndindex(*free.shape):
                found[i, j] = np.where(bare, free[i, j], np.interp(known, nodes, table[:, i, j]))
            return found

        return Face(at(0), 0.5 * at(1))

    def thrown_back(self, upward: Array, face: Face) -> tuple[Array, Glimpse]:
        """What the face throws back, as `enter` has it, beyond what `spread` knows: that takes it for
        Lambertian, but light that leaves aslant goes on in its direction when it is mirrored.

        By reciprocity light that entered evenly leaves as light that comes out evenly has entered: aslant
        where it is not the same all over. The local modes are beside that.

        Parameters
        ----------
        upward : (n, modes, cells, cells)
            V, from `spread`.
        """
        rings, light = slice(self.rings), upward.astype(np.float32)
        halves = [self.rings + half * self.turns + np.arange(self.turns) for half in (0, 1)]
        entering, glimpse = self._nothing(len(light))
        for number, fields in enumerate(light):
            lit, modes = self._forth(fields[0]), len(fields)
            leaving = self._back(lit * self.leaving[rings])
            leaving[1:modes] += fields[1:]
            spectra = self._forth(_weighed(face.even, leaving))
            known = self._forth(_weighed(face.even[:1, :modes], fields)[0])
            glimpse.beside[number] = [_summed(spectra, one[rings]) for one in self.beside]
            found = _summed(spectra, self.entering[rings]) - known
            seen = _summed(spectra, self.seen[rings])
            if self.turns:
                aslant = self._back(lit * self.leaving[np.concatenate(halves)])
                for half, own in zip(halves, np.split(aslant, len(halves)), strict=True):
                    spectra = self._forth(_weighed(face.turning, own))
                    found += _summed(spectra, self.entering[half])
                    seen += _summed(spectra, self.seen[half])
            entering[number], glimpse.spectra[number] = self._back(found), seen
        return entering, glimpse

    def last_thrown_back(self, upward: Array, face: Face) -> Glimpse:
        """What the camera sees of light so weak that it may be taken to leave as `spread` has it."""
        rings, light = slice(self.rings), upward.astype(np.float32)
        _, glimpse = self._nothing(len(light))
        for number, fields in enumerate(light):
            spectra = self._forth(_weighed(face.even[:, : len(fields)], fields))
            glimpse.spectra[number] = _summed(spectra, self.seen[rings])
            glimpse.beside[number] = [_summed(spectra, one[rings]) for one in self.beside]
        return glimpse

    def towards_camera(self, *glimpses: Glimpse) -> Seen:
        """What leaves towards the camera, all passes together."""
        count = len(glimpses[0].spectra)
        maps, mean = np.empty((count, 4, *self._wide), np.float32), np.empty(count)
        for number in range(count):
            spectrum, beside = _all(glimpses, number)
            mean[number] = beside[0, 0, 0].real / max(spectrum[0, 0].real, _LEAST)
            beside[0] -= np.float32(mean[number]) * spectrum
            self._tell(maps[number], spectrum, beside)
        return self._seen(maps, mean, 1.0)

    def change_towards_camera(self, glimpses: Sequence[Glimpse], changes: Sequence[Glimpse]) -> Seen:
        """Derivative of `towards_camera` where the glimpses change by so much per unit: linear in the light,
        but for the quotient that the mean depth is, or the mean rise."""
        count = len(glimpses[0].spectra)
        maps, mean = np.empty((count, 4, *self._wide), np.float32), np.empty(count)
        for number in range(count):
            (spectrum, beside), (change, turns) = _all(glimpses, number), _all(changes, number)
            light = max(spectrum[0, 0].real, _LEAST)
            now = beside[0, 0, 0].real / light
            mean[number] = (turns[0, 0, 0].real - now * change[0, 0].real) / light
            turns[0] -= np.float32(now) * change + np.float32(mean[number]) * spectrum
            self._tell(maps[number], change, turns)
        return self._seen(maps, mean, 0.0)

    def _tell(
        self, maps: NDArray[np.float32], spectrum: NDArray[np.complex64], beside: NDArray[np.complex64]
    ) -> None:
        """Fill in the maps of `Seen`, of light and what is `beside`, the first less what it is all over."""
        maps[0] = self._back(spectrum)
        if self._by_depth:
            deeper = self._back(beside[0])
            maps[1] = -self.transport_per_mm * deeper
            maps[3], maps[2] = np.gradient(deeper, self.cell_mm)
        else:  # rays to the camera are told by where they come from
            maps[1], maps[2], maps[3] = self._back(beside[0]), -self._back(beside[1]), -self._back(beside[2])

    def _seen(self, maps: NDArray[np.float32], mean: Array, flat: float) -> Seen:
        """With the mean depth or the mean rise, and the rise of light that comes from the face itself."""
        if self._by_depth:
            return Seen(maps, mean, flat - self.transport_per_mm * mean)
        return Seen(maps, np.zeros_like(mean), mean)

    @property
    def _by_depth(self) -> bool:
        """Whether light beside the normal is told by how deep it comes from: with even scatterings."""
        return len(self.beside) == 1

    @property
    def _wide(self) -> tuple[int, int]:
        wide = self.cells + 2 * self.margin
        return wide, wide

    def _nothing(self, count: int) -> tuple[Array, Glimpse]:
        """Room for so many LEDs' light."""
        spectra = np.zeros((count, *self.shift.shape), dtype=np.complex64)
        beside = np.zeros((count, len(self.beside), *self.shift.shape), dtype=np.complex64)
        return np.zeros((count, *self._wide)), Glimpse(spectra, beside)

    def _forth(self, maps: NDArray[np.floating]) -> NDArray[np.complex64]:
        padded = len(self.shift)
        rows = scipy.fft.rfft(maps.astype(np.float32, copy=False), padded, axis=-1, workers=1)
        return np.asarray(scipy.fft.fft(rows, padded, axis=-2, workers=1, overwrite_x=True))

    def _back(self, spectrum: NDArray[np.complex64]) -> NDArray[np.float32]:
        padded, (wide, _) = len(self.shift), self._wide
        rows = scipy.fft.ifft(spectrum, axis=-2, workers=1)[..., :wide, :]
        return np.asarray(scipy.fft.irfft(rows, padded, axis=-1, workers=1)[..., :wide])


def _all(glimpses: Sequence[Glimpse], number: int) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Spectra of one source's light, and of what is beside, of all passes together."""
    spectrum = np.sum([one.spectra[number] for one in glimpses], axis=0)
    return spectrum, np.sum([one.beside[number] for one in glimpses], axis=0)


def _weighed(weights: NDArray[np.float32], fields: NDArray[np.float32]) -> NDArray[np.float32]:
    """Σ_j weights (i, j, m, m) fields (j, m, m)."""
    return np.stack([sum((w * f for w, f in zip(row, fields, strict=True))) for row in weights])


def _summed(spectra: NDArray[np.complex64], kernels: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Σ_k of products (k, p, q)."""
    total = spectra[0] * kernels[0]
    for one, kernel in zip(spectra[1:], kernels[1:], strict=True):
        total += one * kernel
    return total


def passage(coupling: Coupling, width_mm: float, cells: int, margin: int) -> Passage:
    """Prepare the passes on `cells` x `cells` cells over a face of `width_mm`, and a margin beside it."""
    apart, step = coupling.aslant, width_mm / cells
    padded = int(scipy.fft.next_fast_len(int(_PADDED * (cells + 2 * margin)), real=True))
    kx, ky = (2.0 * np.pi * waves(padded, step) for waves in (scipy.fft.rfftfreq, scipy.fft.fftfreq))
    k, azimuth = np.hypot(kx, ky[:, None]), np.arctan2(ky[:, None], kx)
    shift = np.exp(-1j * margin * step * (kx + ky[:, None])).astype(np.complex64)
    kernels: dict[int, list[NDArray[np.complex64]]] = {HELD: [], ALL: [], STEEP: [], DEEP: []}
    beside: list[NDArray[np.complex64]] = []
    for m, transforms in enumerate(apart.transforms):
        unit = 1j if m % 2 else 1.0
        for turn in (np.cos, np.sin) if m else (np.cos,):
            for what, tail in ((HELD, 0.0), (ALL, 0.0), (STEEP, 1.0), (DEEP, 2.0)):
                found = apart.at(transforms[what], k, tail) * turn(m * azimuth) * unit
                kernels[what].extend(found.astype(np.complex64))
            if len(transforms) > RISE:  # scatterings favour a direction
                beside.append(_beside_normal(apart, transforms, k, azimuth, m, turn is np.sin))
    spectra = {what: np.array(one, dtype=np.complex64) for what, one in kernels.items()}
    return Passage(
        spectra[HELD],
        spectra[ALL],
        spectra[STEEP],
        np.concatenate(beside, axis=1) if beside else spectra[DEEP][None],
        shift,
        len(apart.functions[0]),
        len(apart.functions[1]),
        cells,
        margin,
        thrown=coupling.thrown,
        free=coupling.thrown_free,
        transport_per_mm=apart.transport_per_mm,
        cell_mm=step,
    )


def _beside_normal(
    apart: Aslant, transforms: Array, k: Array, azimuth: Array, m: int, sine: bool
) -> NDArray[np.complex64]:
    """`Passage.beside` where scatterings favour a direction, (3, r_m, p, p // 2 + 1), of light weighed by
    cos mφ or sin mφ: sin m(φ - φ_k) is sin mφ cos mφ_k - cos mφ sin mφ_k."""
    unit = 1j if m % 2 else 1.0
    along, aside = (np.sin, np.cos) if sine else (np.cos, lambda angle: -np.sin(angle))
    rise, ahead, left = (
        unit * apart.at(transforms[what], k, 1.0) * turn(m * azimuth)
        for what, turn in ((RISE, along), (AHEAD, along), (LEFT, aside))
    )
    east, north = (
        -1j * (ahead * first + left * second)
        for first, second in ((np.cos(azimuth), -np.sin(azimuth)), (np.sin(azimuth), np.cos(azimuth)))
    )
    return np.stack([rise, east, north]).astype(np.complex64)
