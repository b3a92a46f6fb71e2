"""The card of a corpus: README.md and its figures, made from the index and a few pictures.

What a person needs to know before training on it: what it holds, how it was drawn, how the surface and the
picture go together, how noisy and how wrong it is, how to load it, and what it is not.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scenes import exr
from twin import card_figures
from twin.complaint import DesignError
from twin.corpus import Corpus
from twin.corpus_files import inside

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARK = "<!-- written by `twin corpus card`; written anew each time -->"
_MOST_SIZED = 500  # samples whose files are measured; of more, so many are taken for all

_FIGURES: dict[str, Callable[[Corpus], Figure]] = {
    "montage": card_figures.montage,
    "parameters": card_figures.parameters,
    "scalars": card_figures.scalars,
    "errors": card_figures.errors,
}


def write_card(corpus: Corpus, progress: Callable[[int, int], None] | None = None) -> list[Path]:
    """Write DIR/README.md and DIR/figures/*.png; return their paths.

    Raises
    ------
    DesignError
        In one line: for a corpus without samples, or a README.md that something else wrote.
    """
    if not len(corpus):
        raise DesignError("corpus", "no finished sample", "some to show (`twin corpus run` makes them)")
    readme = inside(corpus.path, "README.md")
    if readme.exists() and MARK not in readme.read_text(encoding="utf-8", errors="replace"):
        raise DesignError("README.md", "another's", "none, or an earlier card", source=str(corpus.path))
    folder = inside(corpus.path, "figures")
    folder.mkdir(exist_ok=True)
    written = []
    for number, (name, draw) in enumerate(_FIGURES.items()):
        stream = io.BytesIO()
        draw(corpus).savefig(stream, format="png", dpi=110, metadata={"Software": None})
        exr.write_bytes(folder / f"{name}.png", stream.getvalue())
        written.append(folder / f"{name}.png")
        if progress is not None:
            progress(number + 1, len(_FIGURES))
    exr.write_bytes(readme, text(corpus).encode("utf-8"))
    return [readme, *written]


def text(corpus: Corpus) -> str:
    """Return the card as Markdown."""
    plan, table, design = corpus.plan, corpus.table, corpus.design
    blanks = int(table["blank"].to_numpy()[:: corpus.levels].sum())
    rows, columns = corpus.shape
    size, exact = _bytes(corpus)
    levels = ", ".join(f"{level:g}" for level in corpus.indentation_mm)
    done = "all" if len(corpus) == len(plan) else f"{len(corpus)} of {len(plan)}"
    facts = {
        "Samples": f"{len(corpus)} ({done} that were planned), {blanks} of them blanks without inclusion",
        "Frames": f"{corpus.frames}: {corpus.levels} press levels each, {levels} mm",
        "Pictures": f"{columns} x {rows} pixels, {design.camera.bits} bits, {design.camera.colour}; "
        f"{len(design.leds)} layers of light, one for each LED",
        "On disk": f"{'' if exact else 'about '}{_human(size)}, {_human(size / corpus.frames)} a frame",
        "Sensor": f"{_plain(design.name)}: {_plain(design.description)}",
        "Mechanics": f"{plan.mechanics}, quality {plan.quality}; light: quality {plan.light}, "
        f"{'' if plan.head.paths is None else f'{plan.head.paths} paths from each LED, '}"
        f"{'one seed for all' if plan.light_seed == 'shared' else 'a seed for each sample'}",
        "Seed": str(plan.seed),
        "Versions": ", ".join(
            f"{_plain(name)} {_plain(found)}" for name, found in plan.head.versions.items()
        ),
    }
    groups = "\n".join(
        f"| {_plain(group.name)} | {group.sampler} | {group.count} | {group.redrawn} |"
        for group in plan.groups
    )
    return f"""{MARK}
# {_plain(corpus.name)}

{_plain(corpus.description) or "Simulated pictures of an optical tactile sensor pressed on tissue."}

![Pictures with the reference subtracted, small inclusions above, large ones below](figures/montage.png)

| | |
|---|---|
{chr(10).join(f"| **{name}** | {value} |" for name, value in facts.items())}

## What was drawn

| group | sampler | samples | draws refused |
|---|---|---|---|
{groups}

{_spans(corpus)}

![Histograms of what varies](figures/parameters.png)

## Surface and picture

Tared scalars of the contact surface against those of the picture, for each press level, with Pearson's r.
`max`, `total` and `area` are over k = {plan.k.displacement_um:g} µm and {plan.k.counts:g} counts.

![Surface scalars against picture scalars](figures/scalars.png)

## How far it can be trusted

{_trust(corpus)}

![Noise, error and saturation](figures/errors.png)

## Load it

```python
import twin

corpus = twin.Corpus("THIS FOLDER")
print(corpus.table.describe())  # one row per frame
for batch in corpus.loader(batch_size=32, workers=2, shape=({_small(corpus)}), cached=True):
    print(batch["tared"].shape, batch["parameters"].shape)
```

`noise="fast"` and `led_weights=("uniform", 0.8, 1.2)` make new noise and new light from the stored layers.
Every file's SHA-256 stands in `index.parquet`; `twin corpus verify` checks them. Files are JSON, Parquet,
OpenEXR and PNG: reading them runs no code.

## Licence

None is stated: who publishes this corpus chooses one. The program that made it is under the MIT licence.

## Limits

- Pictures are simulated: no real sensor has been compared with them.
- Light is stored as half floats, each value within 0.05 % of what was computed: far below the camera's noise.
- Inclusions are spheres in a homogeneous slab; skin, ribs and layers of tissue are not there.
{_limits(corpus)}
"""


def _spans(corpus: Corpus) -> str:
    rows = []
    for name in (*card_figures.varied(corpus), *corpus.randomised):
        values = corpus.table[name].to_numpy()[:: corpus.levels]
        values = values[np.isfinite(values)]
        if values.size:
            row = (values.min(), values.mean(), values.max(), values.std())
            rows.append(f"| `{name}` | " + " | ".join(f"{value:.4g}" for value in row) + " |")
    head = "| what varies | lowest | mean | highest | standard deviation |\n|---|---|---|---|---|\n"
    return head + "\n".join(rows) if rows else "Nothing varies."


def _trust(corpus: Corpus) -> str:
    said = {
        "noise_percent": "Monte Carlo noise of the light, standard deviation of a pixel, %",
        "error_percent": "error of the mechanics' signal, estimated, %",
        "saturated_percent": "pixels that are full, %",
        "min_pressure_kPa": "lowest contact pressure, kPa (0: contact has opened somewhere)",
    }
    rows = ["| | median | worst |", "|---|---|---|"]
    for name, words in said.items():
        values = corpus.table[name].to_numpy()
        values = values[np.isfinite(values)]
        if values.size:
            worst = values.min() if name == "min_pressure_kPa" else values.max()
            rows.append(f"| {words} | {np.median(values):.3g} | {worst:.3g} |")
    return "\n".join(rows)


def _limits(corpus: Corpus) -> str:
    plan, lines = corpus.plan, []
    if plan.mechanics == "emulator":
        lines.append(
            "- Surfaces come from an emulator, whose error the table above has, not from own solves."
        )
    if plan.mechanics in ("linear", "multipoles"):
        lines.append("- Mechanics are of small strain, which underrates presses beyond 0.5 mm.")
    if plan.light_seed == "shared":
        lines.append("- All pictures share one seed of light: its pattern is common, and mostly tares away.")
    if plan.quality == "preview" or plan.light == "preview":
        lines.append("- Preview quality: fit for trying out code, not for results.")
    return "\n".join(lines)


def _small(corpus: Corpus) -> str:
    rows, columns = corpus.shape
    half = (rows // 2, columns // 2) if rows % 2 == 0 and columns % 2 == 0 else (rows, columns)
    return f"{half[0]}, {half[1]}"


def _bytes(corpus: Corpus) -> tuple[float, bool]:
    """Return the size of all frames and their references, and whether all were measured."""
    picked = corpus.samples[np.unique(np.linspace(0, len(corpus) - 1, _MOST_SIZED).astype(int))]
    total, shared = 0, set()
    for sample in picked:
        row = corpus.row(int(sample))
        place = (corpus.path / corpus.cell("exr", row)).parent
        total += sum(entry.stat().st_size for entry in os.scandir(place))
        shared |= {corpus.cell("reference", row + level) for level in range(corpus.levels)}
    references = [name for name in shared if name.startswith("references/")]
    more = sum((corpus.path / name).stat().st_size for name in references)
    return total * len(corpus) / len(picked) + more, len(picked) == len(corpus)


def _human(size: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def _plain(value: Any) -> str:
    """Return text of a stranger's as one line that Markdown takes for words."""
    line = " ".join(str(value).split())
    line = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return "".join(f"\\{sign}" if sign in "\\`*_[]|#!" else sign for sign in line)
