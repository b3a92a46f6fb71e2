"""A corpus, read: its table, its pictures and light, and what PyTorch trains on.

    corpus = twin.Corpus("corpora/paper")
    corpus.table                                   # pandas, one row per frame
    for batch in corpus.loader(batch_size=32, workers=2, shape=(246, 384)):
        batch["tared"], batch["parameters"]

Everything that is read is checked first (`twin.corpus_files`): a corpus may come from a stranger.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scenes import exr
from scenes.camera import count_dtype
from twin import store
from twin.complaint import DesignError, shown
from twin.corpus_files import INCLUSION, inside, read_checked, read_index
from twin.design import Design
from twin.footprint import footprint
from twin.planned import load_plan

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from torch.utils.data import DataLoader

    from twin.cache import Cache
    from twin.dataset import Frames

_KEPT_BYTES = 256 * 2**20
"""Of references, kept by each process."""


class Corpus:
    """The finished samples of a corpus.

    ``len`` counts samples. Methods take a sample's number as the table has it, and a press level from 0.
    Pictures are (rows, columns), (rows, columns, 3) in colour, as seen from the specimen.

    Attributes
    ----------
    path : folder of the corpus.
    name, description : of the study.
    design : `twin.Design` that randomised values are put into; `design_of` has those of a sample.
    indentation_mm : nominal press levels.
    plan : `twin.plan.Plan`; ``len(plan)`` samples are to be made.
    arrow : index, `pyarrow.Table` of one row per frame, sorted by sample and level.
    samples : (n,) int64, numbers of the samples that are there.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a corpus. Raises `DesignError`, in one line, for whatever does not fit."""
        self.path = Path(path)
        if not self.path.is_dir():
            raise DesignError("corpus", shown(str(path)), "the folder of a corpus")
        self.plan = plan = load_plan(self.path)
        self.name, self.description, self.design = plan.name, plan.head.description, plan.base
        self.indentation_mm = plan.indentation_mm
        self.arrow: pyarrow.Table = read_index(self.path, plan)
        self.samples: NDArray[np.int64] = self.arrow["sample"].to_numpy()[:: self.levels]
        self._kept: OrderedDict[tuple[str, str], NDArray[Any]] = OrderedDict()
        self._designs: OrderedDict[int, Design] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Leave what can be read again: a worker process needs none of it."""
        left: dict[str, Any] = {"_kept": OrderedDict(), "_designs": OrderedDict()}
        return {key: left.get(key, value) for key, value in self.__dict__.items() if key != "table"}

    def __len__(self) -> int:
        return len(self.samples)

    def __repr__(self) -> str:
        there = f"{len(self)} of {len(self.plan)} samples"
        return f"Corpus({self.name!r}, {there}, {self.levels} levels, {self.shape[1]} x {self.shape[0]})"

    @property
    def levels(self) -> int:
        """How many press levels each sample has."""
        return len(self.indentation_mm)

    @property
    def frames(self) -> int:
        """Frames that are there: samples times levels."""
        return int(self.arrow.num_rows)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the pictures."""
        return self.design.camera.shape

    @cached_property
    def table(self) -> pandas.DataFrame:
        """The index as a pandas table, one row per frame."""
        return self.arrow.to_pandas(ignore_metadata=True)

    @cached_property
    def randomised(self) -> tuple[str, ...]:
        """Columns that hold values of each sample's own design or press, by dotted name."""
        return tuple(name for name in self.arrow.column_names if "." in name)

    def row(self, sample: int, level: int = 0) -> int:
        """Return the row of the table that a frame has. Raises `DesignError` if there is none."""
        place = int(np.searchsorted(self.samples, sample))
        if isinstance(sample, bool) or place == len(self) or self.samples[place] != sample:
            allowed = f"one of the {len(self)} that are there (Corpus.samples)"
            raise DesignError("sample", shown(sample), allowed)
        if isinstance(level, bool) or level not in range(self.levels):
            raise DesignError("level", shown(level), f"0 to {self.levels - 1}")
        return place * self.levels + int(level)

    def cell(self, column: str, row: int) -> Any:
        """Return one value of the index."""
        return self.arrow[column][row].as_py()

    def design_of(self, sample: int) -> Design:
        """Return the design of a sample, with its own randomised values. Raises `DesignError`."""
        self.row(sample)
        if not self.randomised:
            return self.design
        if sample not in self._designs:
            if len(self._designs) >= 1000:
                self._designs.popitem(last=False)
            self._designs[sample] = self.plan.design(sample)
        return self._designs[sample]

    def image(self, sample: int, level: int) -> NDArray[Any]:
        """Return the picture, counts: uint8, uint16, or float32 where the camera averages frames."""
        row = self.row(sample, level)
        if self.design_of(sample).camera.frames > 1:
            return self._counts(self._exr(row, "exr"), row)
        camera, name = self.design.camera, self.cell("png", row)
        data = read_checked(self.path, name, self._most_bytes(1), self.cell("sha256_png", row))
        picture = exr.decode_png(data, self.path / name, shape=self.shape)
        planes = () if camera.colour == "mono" else (3,)
        if picture.dtype != count_dtype(camera.bits) or picture.shape != (*self.shape, *planes):
            allowed = f"{np.dtype(count_dtype(camera.bits))} {(*self.shape, *planes)}"
            raise DesignError(name, f"{picture.dtype} {picture.shape}", allowed, source=str(self.path))
        return picture

    def reference(self, sample: int, level: int) -> NDArray[np.float32]:
        """Return the reference, counts with fractions: the mean of noisy frames without inclusion."""
        row = self.row(sample, level)
        name = self.cell("reference", row)
        return self.kept(name, "counts", lambda: self._counts(self._exr(row, "reference"), row)).copy()

    def tared(self, sample: int, levels: Sequence[int] | None = None) -> NDArray[np.float32]:
        """Return picture minus reference, (levels, rows, columns[, 3]) counts."""
        steps = range(self.levels) if levels is None else levels
        return np.stack([self.image(sample, step) - self.reference(sample, step) for step in steps])

    def radiance(self, sample: int, level: int) -> NDArray[np.float32]:
        """Return the light of each LED, (n_led, rows, columns[, 3]) W m⁻² sr⁻¹ at the lens."""
        return self.layers(sample, level).astype(np.float32)

    def reference_radiance(self, sample: int, level: int) -> NDArray[np.float32]:
        """Return the same without inclusion."""
        return self.reference_layers(sample, level).astype(np.float32)

    def layers(self, sample: int, level: int) -> NDArray[Any]:
        """Return `radiance` as it is stored, half or single floats."""
        row = self.row(sample, level)
        return self._layers(self._exr(row, "exr"), self.cell("exr", row))

    def reference_layers(self, sample: int, level: int) -> NDArray[Any]:
        """Return `reference_radiance` as it is stored; kept for the next frame that shares it."""
        row = self.row(sample, level)
        name = self.cell("reference", row)
        return self.kept(name, "layers", lambda: self._layers(self._exr(row, "reference"), name))

    def field(self, sample: int, level: int, name: str) -> NDArray[np.float32]:
        """Return ``pressure`` (kPa) or ``displacement.z`` (mm) that each pixel looks at, (rows, columns)."""
        if name not in ("pressure", "displacement.z"):
            raise DesignError("field", shown(name), "pressure or displacement.z")
        row = self.row(sample, level)
        planes = self._exr(row, "exr")
        if name not in planes:
            raise DesignError(self.cell("exr", row), "no such channel", name, source=str(self.path))
        return planes[name].astype(np.float32)

    def record(self, sample: int, level: int) -> dict[str, Any]:
        """Return what stands in the head of a frame's EXR file."""
        self._exr_bytes(row := self.row(sample, level), "exr")
        return store.read_record(inside(self.path, self.cell("exr", row)))

    def mask(self, sample: int) -> NDArray[np.bool_]:
        """Return which pixels look at the contact surface under the inclusion, (rows, columns); see
        `twin.footprint`."""
        size, _, _, x, y = (self.cell(name, self.row(sample)) for name in INCLUSION)
        if self.cell("blank", self.row(sample)) or not size:
            return np.zeros(self.shape, bool)
        return footprint(self.design_of(sample).sensor(), size, (x or 0.0, y or 0.0))

    def dataset(self, **options: Any) -> Frames:
        """Return a map-style torch dataset of the samples; options as of `twin.dataset.Frames`."""
        from twin.dataset import Frames

        return Frames(self, **options)

    def loader(
        self, batch_size: int = 32, workers: int = 0, *, shuffle: bool = True, seed: int = 0, **options: Any
    ) -> DataLoader[Any]:
        """Return a `torch.utils.data.DataLoader` of `dataset`; ``options`` are of `twin.dataset.Frames`.

        ``workers`` processes read; how many there are changes no number. ``seed`` is of order and noise: call
        ``loader.dataset.epoch(n)`` before each pass to have other noise.
        """
        from twin.dataset import loader

        return loader(self.dataset(seed=seed, **options), batch_size, workers, shuffle=shuffle, seed=seed)

    def cache(
        self,
        shape: tuple[int, int] | None = None,
        *,
        layers: bool = False,
        workers: int = 0,
        progress: Callable[[int, int], None] | None = None,
    ) -> Cache:
        """Return the cache of pictures of this size, built if it is not there; see `twin.cache`."""
        from twin.cache import cached

        return cached(self, shape, layers=layers, workers=workers, progress=progress)

    def kept(self, name: str, what: str, read: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """Return an array of a file, from memory if it was read lately by this process;
        not to be written to."""
        key = (name, what)
        if key not in self._kept:
            array = read()
            self._kept[key] = array
            while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > _KEPT_BYTES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    @cached_property
    def _names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the planes of light and of counts."""
        ends = ("",) if self.design.camera.colour == "mono" else (".R", ".G", ".B")
        leds = tuple(f"led.{number}{end}" for number in range(len(self.design.leds)) for end in ends)
        return leds, tuple(f"counts{end}" for end in ends)

    def _most_bytes(self, planes: int) -> int:
        """Size of a file that holds so many planes, uncompressed, and its head."""
        rows, columns = self.shape
        return 4 * rows * columns * 3 * planes + 2**20

    def _exr_bytes(self, row: int, column: str) -> bytes:
        name, told = self.cell(column, row), self.cell(f"sha256_{column}", row)
        return read_checked(self.path, name, self._most_bytes(len(self.design.leds) + 3), told)

    def _exr(self, row: int, column: str) -> dict[str, NDArray[Any]]:
        leds, counts = self._names
        names = {*leds, *counts, "pressure", "displacement.z"}
        data = self._exr_bytes(row, column)
        return exr.decode_exr(data, self.path / self.cell(column, row), shape=self.shape, names=names)

    def _counts(self, planes: dict[str, NDArray[Any]], row: int) -> NDArray[np.float32]:
        _, names = self._names
        return self._stacked(planes, names, f"frame of row {row}", 2.0**self.design.camera.bits - 1)

    def _layers(self, planes: dict[str, NDArray[Any]], file: str) -> NDArray[Any]:
        leds, colours = self._names[0], len(self._names[1])
        found = [
            self._stacked(planes, leds[at : at + colours], file, np.inf)
            for at in range(0, len(leds), colours)
        ]
        return np.stack(found)

    def _stacked(
        self, planes: dict[str, NDArray[Any]], names: Sequence[str], file: str, highest: float
    ) -> NDArray[Any]:
        """Return planes, finite, >= 0 and not above a value, as (rows, columns[, 3])."""
        for name in names:
            if name not in planes:
                raise DesignError(f"{file}: channel", "none", name, source=str(self.path))
            if not _fits(planes[name], highest):
                lowest, most = planes[name].min(), planes[name].max()
                allowed = f"finite values >= 0 and <= {highest:g}"
                raise DesignError(f"{file}: {name}", f"{lowest} to {most}", allowed, source=str(self.path))
        found = [planes[name] for name in names]
        return found[0] if len(found) == 1 else np.stack(found, axis=-1)


def _fits(plane: NDArray[Any], highest: float) -> bool:
    """Whether all values are finite, >= 0 and not above the highest.

    Floats >= 0 sort as the integers of their bits do, with infinity and NaN above all and negative ones
    beyond: one quick look clears almost all planes of half floats, which are slow to compare.
    """
    if highest == np.inf and plane.dtype == np.float16 and plane.view(np.uint16).max() < 0x7C00:
        return True
    lowest, most = plane.min(), plane.max()  # NaN passes through both
    return bool(lowest >= 0 and most <= highest and np.isfinite(most))
