"""A corpus's pictures unpacked and averaged once: arrays on disk that a training run maps into memory.

DIR/cache/KEY/ holds, of all frames in the order of the index,

    picture.npy             (frames, rows, columns[, 3]) uint16, counts times ``steps``
    reference.npy           (references, rows, columns[, 3]) uint16, the same
    charge.npy, reference_charge.npy   with ``layers``: (.., n_led, rows, columns[, 3]) float16, mean charge
                            of each block's pixels from each LED, as a share of the camera's full well
    cache.json              what it is, and the largest error that rounding to steps made

KEY is a hash of shape, design and the SHA-256 of all files, so a cache of other frames is never taken for
this one. With 8 bits, blocks of up to 4 x 4 pixels and 16 frames of reference, steps are the sums that the
means are made of, and nothing is lost; elsewhere counts are rounded to 1/65535 of the camera's range.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from twin import retake
from twin.complaint import DesignError
from twin.corpus_files import inside
from twin.exposure import REFERENCE_FRAMES
from twin.stage import staged

if TYPE_CHECKING:
    from twin.corpus import Corpus

Float = NDArray[np.float32]

FORMAT = 1
_NOTE = "cache.json"
_FILES = ("picture.npy", "reference.npy", "charge.npy", "reference_charge.npy")
_LARGEST_HALF = 65504.0


class Cache:
    """The arrays of one cache, mapped into memory by each process that asks. Rows are those of the index."""

    def __init__(self, corpus: Corpus, shape: tuple[int, int], layers: bool) -> None:
        """Raises `DesignError` if the cache is not there, or not what its name says."""
        self.shape, self.layers = shape, layers
        self.folder = folder_of(corpus, shape, layers)
        self._root = corpus.path
        camera = corpus.design.camera
        self._planes = () if camera.colour == "mono" else (3,)
        self._leds = len(corpus.design.leds)
        codes = pc.dictionary_encode(corpus.arrow["reference"]).combine_chunks()
        self._code: NDArray[np.int32] = codes.indices.to_numpy()
        self._references = len(codes.dictionary)
        self._steps = steps(corpus, shape)
        self._wells = _wells(corpus)
        self._maps  # noqa: B018 (opens the files, so that a damaged one is known now)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_maps"}

    @cached_property
    def _maps(self) -> dict[str, NDArray[Any]]:
        picture, light = (*self.shape, *self._planes), (self._leds, *self.shape, *self._planes)
        wanted: dict[str, tuple[tuple[int, ...], Any]] = {
            "picture.npy": ((len(self._code), *picture), np.uint16),
            "reference.npy": ((self._references, *picture), np.uint16),
        }
        if self.layers:
            wanted |= {
                "charge.npy": ((len(self._code), *light), np.float16),
                "reference_charge.npy": ((self._references, *light), np.float16),
            }
        return {name: self._map(name, *what) for name, what in wanted.items()}

    def _map(self, name: str, shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
        place = inside(self._root, str((self.folder / name).relative_to(self._root)))
        try:
            found = np.load(place, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            what = f"a file that cannot be read ({str(error).splitlines()[0][:80]})"
            raise DesignError(name, what, _RETRY, source=str(self.folder)) from None
        if not isinstance(found, np.memmap) or found.shape != shape or found.dtype != kind:
            received = f"{getattr(found, 'dtype', type(found))} {getattr(found, 'shape', '')}"
            allowed = f"{np.dtype(kind)} {shape} ({_RETRY})"
            raise DesignError(name, received, allowed, source=str(self.folder))
        return found

    def image(self, row: int) -> Float:
        """Return a picture, (rows, columns[, 3]) counts with fractions."""
        return self._maps["picture.npy"][row] * np.float32(1.0 / self._steps[0])

    def reference(self, row: int) -> Float:
        """Return a picture's reference, the same."""
        return self._maps["reference.npy"][self._code[row]] * np.float32(1.0 / self._steps[1])

    def charge(self, row: int, weights: NDArray[np.float64] | None, reference: bool) -> Float:
        """Return the LEDs' charge, each times its weight, (rows, columns[, 3]) electrons.

        That of the picture, or of its reference.
        """
        import torch

        name, place = ("reference_charge.npy", self._code[row]) if reference else ("charge.npy", row)
        layers = torch.from_numpy(np.array(self._maps[name][place]))
        total = torch.zeros(layers.shape[1:])
        well = float(self._wells[row])
        for number, layer in enumerate(layers):
            total.add_(layer.float(), alpha=well * (1.0 if weights is None else float(weights[number])))
        found = total.numpy()
        if not (found.min() >= 0 and np.isfinite(found.max())):  # NaN passes through both
            received = f"{found.min()} to {found.max()} electrons"
            raise DesignError(f"{name}, row {place}", received, f">= 0 ({_RETRY})", source=str(self.folder))
        return found


_RETRY = "what `Corpus.cache` writes: remove this folder, and it is made again"


def cached(
    corpus: Corpus,
    shape: tuple[int, int] | None,
    *,
    layers: bool = False,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Cache:
    """Return the cache of pictures of a shape, built if it is not there: whole or not at all.

    Caches of the same shape whose frames are no longer those of the index are removed.

    Parameters
    ----------
    layers : whether it holds each LED's light too, as noise and LED weights need.
    workers : processes that read.
    progress : called with the frames that are done and all of them.

    Raises
    ------
    DesignError
        For a shape that does not divide the pictures, a file that is not what the index knows, or a folder
        that cannot be written.
    """
    from twin.dataset import blocks

    wanted = corpus.shape if shape is None else (int(shape[0]), int(shape[1]))
    block = blocks(corpus.shape, wanted)
    layers = layers or (folder_of(corpus, wanted, True) / _NOTE).is_file()  # which holds the pictures too
    if not (folder_of(corpus, wanted, layers) / _NOTE).is_file():
        _build(corpus, wanted, block, layers, workers, progress)
    return Cache(corpus, wanted, layers)


def folder_of(corpus: Corpus, shape: tuple[int, int], layers: bool) -> Path:
    """Return where the cache lies of these frames, of this shape."""
    told = hashlib.sha256(
        json.dumps([FORMAT, shape, layers, corpus.plan.head.design_sha256], sort_keys=True).encode()
    )
    for name in ("sample", "reference", "sha256_exr", "sha256_png", "sha256_reference", *corpus.randomised):
        for chunk in corpus.arrow[name].chunks:
            array = chunk.to_numpy(zero_copy_only=False)
            told.update(array.tobytes() if array.dtype != object else "\n".join(array).encode())
    return corpus.path / "cache" / told.hexdigest()[:16]


def steps(corpus: Corpus, shape: tuple[int, int]) -> tuple[float, float]:
    """Return how many steps of the cache make a count, of pictures and of references."""
    camera = corpus.design.camera
    pixels = math.prod(corpus.shape) // math.prod(shape)
    most = 65535 / (2**camera.bits - 1)
    frames = camera.frames, max(REFERENCE_FRAMES, camera.frames)
    own, reference = (float(pixels * number) if pixels * number <= most else most for number in frames)
    return own, reference


def _wells(corpus: Corpus) -> NDArray[np.float64]:
    """Return the full well that each row's charges are shares of, electrons."""
    name, camera = "camera.full_well_e", corpus.design.camera
    each = corpus.arrow[name].to_numpy() if name in corpus.randomised else np.full(1, camera.full_well_e)
    return np.broadcast_to(each * camera.binning**2, corpus.frames)


def _build(
    corpus: Corpus,
    shape: tuple[int, int],
    block: tuple[int, int],
    layers: bool,
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    folder = folder_of(corpus, shape, layers)
    inside(corpus.path, "cache/.")  # a link that leads out is refused before anything is made
    scales, worst, seen = steps(corpus, shape), 0.0, set[str]()
    names = corpus.arrow["reference"].to_pylist()
    counts = {"picture.npy": corpus.frames, "reference.npy": len(set(names))}
    counts |= {"charge.npy": corpus.frames, "reference_charge.npy": len(set(names))} if layers else {}
    with staged(folder, _is_cache) as making, ExitStack() as files:
        out = {name: files.enter_context(open(making / name, "xb")) for name in counts}
        heads: set[str] = set()

        def put(name: str, array: NDArray[Any]) -> None:
            # Written, not mapped: a full disk is then an error, where a map would kill the process.
            if name not in heads:
                _head(out[name], (counts[name], *array.shape), array.dtype)
                heads.add(name)
            out[name].write(np.ascontiguousarray(array).tobytes())

        for row, frame in enumerate(_frames(corpus, shape, block, layers, workers)):
            fresh = names[row] not in seen
            seen.add(names[row])
            for kind, scale in (("picture", scales[0]), ("reference", scales[1])):
                if kind == "picture" or fresh:
                    stored = np.rint(frame[kind].astype(np.float64) * scale)
                    worst = max(worst, float(np.abs(stored / scale - frame[kind]).max()))
                    put(f"{kind}.npy", stored.astype(np.uint16))
            if layers:
                put("charge.npy", frame["charge"])
                if fresh:
                    put("reference_charge.npy", frame["reference_charge"])
            if progress is not None:
                progress(row + 1, corpus.frames)
        for file in out.values():
            file.flush()
            os.fsync(file.fileno())
        note = {"format": FORMAT, "shape": shape, "layers": layers, "steps": scales, "worst_error_dn": worst}
        (making / _NOTE).write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")
    _remove_stale(folder, shape, layers)


def _head(file: BinaryIO, shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    described = np.lib.format.dtype_to_descr(kind)
    np.lib.format.write_array_header_1_0(
        file, {"descr": described, "fortran_order": False, "shape": tuple(int(size) for size in shape)}
    )


def _frames(
    corpus: Corpus, shape: tuple[int, int], block: tuple[int, int], layers: bool, workers: int
) -> Iterator[dict[str, NDArray[Any]]]:
    from torch.utils.data import DataLoader

    source = _Source(corpus, shape, block, layers)
    for item in DataLoader(source, batch_size=None, num_workers=workers):
        for level in range(corpus.levels):
            yield {name: stack[level].numpy() for name, stack in item.items()}


class _Source:
    """What the cache is made of, sample by sample: a dataset that worker processes can read."""

    def __init__(self, corpus: Corpus, shape: tuple[int, int], block: tuple[int, int], layers: bool) -> None:
        self.corpus, self.block, self.layers = corpus, block, layers
        self.frames = corpus.dataset(shape=shape, raw=True, mask=False)

    def __len__(self) -> int:
        return len(self.corpus)

    def __getitem__(self, index: int) -> dict[str, Any]:
        import torch

        item = self.frames[index]
        found = {"picture": item["image"], "reference": item["reference"]}
        if self.layers:
            sample = int(self.corpus.samples[index])
            for name, read in (
                ("charge", self.corpus.layers),
                ("reference_charge", self.corpus.reference_layers),
            ):
                stack = [self._shares(sample, read(sample, level)) for level in range(self.corpus.levels)]
                found[name] = torch.from_numpy(np.stack(stack))
        return found

    def _shares(self, sample: int, layers: NDArray[Any]) -> NDArray[np.float16]:
        design = self.corpus.design_of(sample)
        well = design.camera.full_well_e * design.camera.binning**2
        found = retake.charges(design, layers, self.block) / np.float32(well)
        return np.minimum(found, _LARGEST_HALF).astype(np.float16)


def _is_cache(folder: Path) -> bool:
    return {entry.name for entry in folder.iterdir()} <= {_NOTE, *_FILES}


def _remove_stale(folder: Path, shape: tuple[int, int], layers: bool) -> None:
    for other in folder.parent.iterdir():
        try:
            note = json.loads((other / _NOTE).read_text(encoding="utf-8"))
            if (
                other != folder
                and (note["shape"], note["layers"]) == (list(shape), layers)
                and _is_cache(other)
            ):
                shutil.rmtree(other, ignore_errors=True)
        except (OSError, ValueError, KeyError, TypeError):
            continue
