"""Samples of a corpus as PyTorch wants them: a map-style dataset, and a loader of it.

What an item holds depends on its place and the options alone, noise and lighting included: these are children
of (seed, epoch, sample, level), so that the number of workers and the order change nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from twin import retake
from twin.complaint import DesignError, shown
from twin.corpus_files import INCLUSION
from twin.design import Design
from twin.exposure import REFERENCE_FRAMES

if TYPE_CHECKING:
    from twin.corpus import Corpus

Noise = bool | Literal["exact", "fast"]
Weights = Sequence[float] | tuple[Literal["uniform"], float, float] | tuple[Literal["lognormal"], float]
Float = NDArray[np.float32]

_NOISE, _LEDS = range(2)


class Frames(Dataset[dict[str, Any]]):
    """One item for each sample, a dict of tensors.

    =================  ====================================================================================
    ``tared``          (levels, rows, columns[, 3]) float32, picture minus reference, counts
    ``parameters``     float32, the columns of ``parameter_names``; NaN for what a blank has not
    ``blank``          bool, whether there is no inclusion
    ``mask``           (rows, columns) bool, pixels that look at the surface under the inclusion
    ``sample``         int64, the sample's number
    ``image``, ``reference``  with ``raw``, in the place of ``tared``: counts of both
    ``radiance``, ``reference_radiance``  with ``per_led``: (levels, n_led, rows, columns[, 3]) float32
    ``weights``        with ``led_weights``: (n_led,) float32
    =================  ====================================================================================

    Parameters
    ----------
    shape : (rows, columns)
        Smaller pictures, each pixel the mean of a whole number of stored ones; none for the stored size.
    levels : which press levels, by number; none for all.
    noise : False, True or "exact", "fast"
        False: the stored picture. Else a new exposure from the stored layers of light: exactly as the camera
        takes it, or fast (`twin.retake` says what differs). The reference stays the stored one unless the
        LEDs change.
    frames : how many exposures each picture is the mean of, with ``noise``; none for the camera's own.
    led_weights : (n_led,) factors, ("uniform", low, high) or ("lognormal", sd)
        Factors of the LEDs' power, for picture and reference alike: given, or drawn for each sample and
        epoch.
        Without ``noise`` such pictures are what noisy ones tend to. Exact references cost 16 exposures each.
    cached : read from the cache (`twin.cache`), built if it is not there.
    mask : whether items hold a mask.
    parameters : columns of the table, of the sample's first level.
    seed : of noise and weights.

    Raises
    ------
    DesignError
        In one line, for an option that cannot be, and when a file is not what the index says.
    """

    def __init__(
        self,
        corpus: Corpus,
        *,
        shape: tuple[int, int] | None = None,
        levels: Sequence[int] | None = None,
        raw: bool = False,
        per_led: bool = False,
        noise: Noise = False,
        frames: int | None = None,
        led_weights: Weights | None = None,
        cached: bool = False,
        mask: bool = True,
        parameters: Sequence[str] = INCLUSION,
        seed: int = 0,
    ) -> None:
        self.corpus, self.raw, self.per_led, self.mask, self.seed = corpus, raw, per_led, mask, seed
        self.shape = corpus.shape if shape is None else (shape[0], shape[1])
        self.block = blocks(corpus.shape, self.shape)
        self.levels = tuple(range(corpus.levels)) if levels is None else tuple(levels)
        if not self.levels or any(level not in range(corpus.levels) for level in self.levels):
            raise DesignError("levels", shown(levels), f"some of 0 to {corpus.levels - 1}")
        if noise not in (False, True, "exact", "fast"):
            raise DesignError("noise", shown(noise), 'False, True, "exact" or "fast"')
        self.noise = "exact" if noise is True else noise
        if frames is not None and (
            self.noise is False or isinstance(frames, bool) or not 1 <= frames <= 10_000
        ):
            raise DesignError("frames", f"{shown(frames)} with noise = {noise}", "1 to 10000, with noise")
        self.frames = frames
        self.led_weights = _checked(led_weights, len(corpus.design.leds))
        self.parameter_names = tuple(parameters)
        columns = corpus.arrow.column_names
        if unknown := [name for name in self.parameter_names if name not in columns]:
            raise DesignError("parameters", shown(unknown[0]), f"columns of the table: {', '.join(columns)}")
        rows = slice(None, None, corpus.levels)
        values = [corpus.arrow[name].to_numpy()[rows] for name in self.parameter_names]
        self._parameters = torch.tensor(np.array(values, np.float32).reshape(len(values), -1).T)
        self._blank = torch.tensor(np.array(corpus.arrow["blank"].to_numpy()[rows], bool))
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()  # workers that live on see it change
        self._cache = None
        if cached:
            changes = self.noise is not False or self.led_weights is not None
            if self.noise == "exact" or per_led:
                what = "per_led" if per_led else 'noise = "exact"'
                raise DesignError("cached", f"True with {what}", 'stored pictures, or noise = "fast"')
            self._cache = corpus.cache(None if self.shape == corpus.shape else self.shape, layers=changes)

    def __len__(self) -> int:
        return len(self.corpus)

    def epoch(self, number: int) -> None:
        """Choose which noise and weights come next, in all workers; 0 at first."""
        self._epoch[0] = number

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(index)  # what ends a loop over the samples
        index = int(index) % len(self)
        sample = int(self.corpus.samples[index])
        weights = self._weights(sample)
        images, references = zip(*(self._pair(sample, level, weights) for level in self.levels), strict=True)
        item: dict[str, Any] = {
            "parameters": self._parameters[index],
            "blank": self._blank[index],
            "sample": torch.tensor(sample),
        }
        if self.raw:
            item |= {"image": _tensor(images), "reference": _tensor(references)}
        else:
            item["tared"] = _tensor([a - b for a, b in zip(images, references, strict=True)])
        if self.per_led:
            for name, layers in (
                ("radiance", self.corpus.layers),
                ("reference_radiance", self.corpus.reference_layers),
            ):
                item[name] = torch.stack([self._radiance(layers(sample, level)) for level in self.levels])
        if self.mask:
            found = self.corpus.mask(sample)
            item["mask"] = torch.from_numpy(retake.average(found.view(np.uint8), self.block) >= 0.5)
        if weights is not None:
            item["weights"] = torch.tensor(weights, dtype=torch.float32)
        return item

    def _radiance(self, layers: NDArray[Any]) -> torch.Tensor:
        light = layers.astype(np.float32)
        return torch.from_numpy(np.stack([retake.average(layer, self.block) for layer in light]))

    def _pair(self, sample: int, level: int, weights: NDArray[np.float64] | None) -> tuple[Float, Float]:
        """Return picture and reference, (rows, columns[, 3]) counts."""
        corpus, row = self.corpus, self.corpus.row(sample, level)
        if self.noise is False and weights is None:
            if self._cache is not None:
                return self._cache.image(row), self._cache.reference(row)
            return retake.average(corpus.image(sample, level), self.block), self._stored(sample, level)
        design, level_mm = corpus.design_of(sample), corpus.cell("indentation_mm", row)
        frames = design.camera.frames if self.frames is None else self.frames
        if self.noise == "exact":
            design = _averaging(design, frames)
            seed = self._child(sample, _NOISE)
            light = corpus.layers(sample, level)
            image = retake.average(retake.taken(design, light, weights, seed, level_mm), self.block)
            if weights is None:
                return image, self._stored(sample, level)
            light = corpus.reference_layers(sample, level)
            taken = retake.reference_taken(design, light, weights, seed, level_mm)
            return image, retake.average(taken, self.block)
        rng = None
        if self.noise == "fast":
            children = self._sequence(sample, _NOISE, level)
            rng = np.random.Generator(np.random.SFC64(children))
        image = retake.counts(
            design, self._charge(sample, level, weights, row, False), self.block, frames, rng
        )
        if weights is None:
            return image, self._stored(sample, level)
        charge = self._charge(sample, level, weights, row, True)
        return image, retake.counts(design, charge, self.block, max(REFERENCE_FRAMES, frames), rng)

    def _stored(self, sample: int, level: int) -> Float:
        corpus, row = self.corpus, self.corpus.row(sample, level)
        if self._cache is not None:
            return self._cache.reference(row)
        name, what = corpus.cell("reference", row), f"counts {self.block}"
        found = corpus.kept(name, what, lambda: retake.average(corpus.reference(sample, level), self.block))
        return found

    def _charge(
        self, sample: int, level: int, weights: NDArray[np.float64] | None, row: int, reference: bool
    ) -> Float:
        if self._cache is not None:
            return self._cache.charge(row, weights, reference)
        read = self.corpus.reference_layers if reference else self.corpus.layers
        return retake.charge(self.corpus.design_of(sample), read(sample, level), weights, self.block)

    def _weights(self, sample: int) -> NDArray[np.float64] | None:
        match self.led_weights:
            case None:
                return None
            case ("uniform", low, high):
                rng = np.random.default_rng(self._sequence(sample, _LEDS))
                return rng.uniform(low, high, len(self.corpus.design.leds))
            case ("lognormal", sd):
                rng = np.random.default_rng(self._sequence(sample, _LEDS))
                return np.exp(sd * rng.standard_normal(len(self.corpus.design.leds)))
            case fixed:
                return np.array(fixed, np.float64)

    def _sequence(self, sample: int, *more: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(self.seed, spawn_key=(int(self._epoch[0]), sample, *more))

    def _child(self, sample: int, purpose: int) -> int:
        low, high = self._sequence(sample, purpose).generate_state(2)
        return (int(high) << 31) ^ int(low)


def blocks(stored: tuple[int, int], wanted: tuple[int, ...]) -> tuple[int, int]:
    """Return how many stored rows and columns make one pixel. Raises `DesignError` if they are not whole."""
    whole = all(isinstance(size, int | np.integer) and size > 0 for size in wanted)
    if len(wanted) != 2 or not whole or any(a % b for a, b in zip(stored, wanted, strict=True)):
        allowed = f"(rows, columns) that divide {stored}"
        raise DesignError("shape", shown(wanted), allowed)
    return stored[0] // wanted[0], stored[1] // wanted[1]


@lru_cache(maxsize=1024)
def _averaging(design: Design, frames: int) -> Design:
    return design if design.camera.frames == frames else retake.averaging(design, frames)


def _tensor(pictures: Sequence[Float]) -> torch.Tensor:
    return torch.from_numpy(np.stack(pictures))


def _checked(weights: Weights | None, leds: int) -> Any:
    if weights is None:
        return None
    allowed = f'{leds} numbers >= 0, ("uniform", low, high) or ("lognormal", sd)'
    given: tuple[Any, ...] = tuple(weights)
    match given:
        case ("uniform", low, high) if _real(low) and _real(high) and 0 <= low <= high:
            return ("uniform", float(low), float(high))
        case ("lognormal", sd) if _real(sd) and 0 <= sd <= 10:
            return ("lognormal", float(sd))
        case numbers if len(numbers) == leds and all(_real(number) and number >= 0 for number in numbers):
            return tuple(float(number) for number in numbers)
    raise DesignError("led_weights", shown(weights), allowed)


def _real(value: Any) -> bool:
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return number and bool(np.isfinite(value))


def loader(
    frames: Frames, batch_size: int, workers: int, *, shuffle: bool, seed: int
) -> DataLoader[dict[str, Any]]:
    """Return a loader of batches; the order of an epoch is the same for any number of workers."""
    return DataLoader(
        frames,
        batch_size=batch_size,
        shuffle=shuffle,
        num_workers=workers,
        persistent_workers=workers > 0,
        generator=torch.Generator().manual_seed(seed),
    )
