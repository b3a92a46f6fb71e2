"""The card of a corpus: true numbers, and figures in which nothing covers anything."""

import itertools
import re
import shutil

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from painted import paint
from PIL import Image

import twin
from twin import card_figures, cli, store
from twin.card import text, write_card

MORE = """
[randomise."leds.*.flux_W"]
distribution = "uniform"
low = 0.8
high = 1.2
relative = true
[randomise."specimen.modulus_kPa"]
distribution = "normal"
sd = 0.05
relative = true
"""
FIGURES = ("montage", "parameters", "scalars", "errors")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    return twin.Corpus(paint(folder, count=30, levels=(1.0, 2.0, 3.0), blanks=0.1, more=MORE))


def test_its_numbers_are_the_tables(corpus):
    told = text(corpus)
    first = corpus.table.iloc[::3]
    assert "| **Samples** | 30 (all that were planned), 3 of them blanks without inclusion |" in told
    assert "| **Frames** | 90: 3 press levels each, 1, 2, 3 mm |" in told
    sizes = first["size_mm"].dropna()
    row = (sizes.min(), sizes.mean(), sizes.max(), sizes.std(ddof=0))
    assert "| `size_mm` | " + " | ".join(f"{value:.4g}" for value in row) + " |" in told
    assert "`leds.3.flux_W`" in told and "`specimen.modulus_kPa`" in told
    size = sum(path.stat().st_size for path in (corpus.path / "samples").rglob("*") if path.is_file())
    assert f"{size / 1e6:.3g} MB" in told and "about" not in told.split("On disk")[1].split("\n")[0]
    assert "Licence" in told and "twin.Corpus(" in told and "small strain" in told


def test_the_code_that_it_shows_runs(corpus, monkeypatch, capsys):
    code = text(corpus).split("```python\n")[1].split("```")[0]
    monkeypatch.setattr("multiprocessing.cpu_count", lambda: 2)
    exec(code.replace("THIS FOLDER", str(corpus.path)), {})
    assert "torch.Size([30, 3, 24, 32]) torch.Size([30, 5])" in capsys.readouterr().out
    shutil.rmtree(corpus.path / "cache")


def test_correlation_is_pearsons():
    x = np.array([0.0, 1.0, 2.0, 3.0])
    assert card_figures.pearson(x, 5 - 2 * x) == pytest.approx(-1.0)
    assert card_figures.pearson(x, np.array([1.0, -1.0, -1.0, 1.0])) == pytest.approx(0.0)
    assert np.isnan(card_figures.pearson(x, np.ones(4)))


@pytest.mark.parametrize("name", FIGURES)
def test_no_text_covers_another(corpus, name):
    figure = getattr(card_figures, name)(corpus)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [(one.get_text(), one.get_window_extent(canvas.get_renderer())) for one in words(figure)]
    assert len(boxes) > 6
    for told, box in boxes:
        assert box.x0 >= -1 and box.x1 <= figure.bbox.width + 1, told
        assert box.y0 >= -1 and box.y1 <= figure.bbox.height + 1, told
    for (told, one), (other_told, other) in itertools.combinations(boxes, 2):
        assert not one.padded(-1).overlaps(other.padded(-1)), (told, other_told)


def words(figure):
    """All texts that are drawn; ticks beyond the axes' limits are not."""
    found = list(figure.texts) + ([figure._suptitle] if figure._suptitle else [])
    for axes in figure.axes:
        titles = [axes.title, axes._left_title, axes._right_title]
        legend = axes.get_legend()
        found += [*(titles + list(axes.texts)), *(legend.get_texts() if legend else [])]
        if axes.axison:
            for axis in (axes.xaxis, axes.yaxis):
                low, high = sorted(axis.get_view_interval())
                ticks = (tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high)
                found += [axis.label, axis.get_offset_text()]
                found += [label for tick in ticks for label in (tick.label1, tick.label2)]
    return {one: None for one in found if one.get_text() and one.get_visible()}


def test_command_line(corpus, capsys):
    assert cli.main(["corpus", "card", str(corpus.path)]) == 0
    for name in FIGURES:
        with Image.open(corpus.path / "figures" / f"{name}.png") as picture:
            assert 400 <= picture.width <= 1300
        assert f"figures/{name}.png" in (corpus.path / "README.md").read_text()
    one = {path: path.read_bytes() for path in (corpus.path / "figures").iterdir()}
    write_card(corpus)  # over the earlier one, the same bytes
    assert one == {path: path.read_bytes() for path in (corpus.path / "figures").iterdir()}
    capsys.readouterr()
    (corpus.path / "README.md").write_text("My own words")
    assert cli.main(["corpus", "card", str(corpus.path)]) == 2
    assert "README.md: received another's" in capsys.readouterr().err
    (corpus.path / "README.md").unlink()


def test_one_sample_is_enough(tmp_path):
    corpus = twin.Corpus(paint(tmp_path, count=1, levels=(2.0,), blanks=0.0))
    assert len(write_card(corpus)) == 5
    blanks = twin.Corpus(paint(tmp_path / "blank", count=1, levels=(2.0,), blanks=1.0))
    assert len(write_card(blanks)) == 5


def test_none_is_not(tmp_path, capsys):
    place = paint(tmp_path, count=1, levels=(2.0,))
    shutil.rmtree(store.sample_folder(place, 0))
    from painted import reindex

    reindex(place)
    assert cli.main(["corpus", "card", str(place)]) == 2
    assert "no finished sample" in capsys.readouterr().err


def test_a_strangers_words_stay_words(tmp_path):
    place = paint(tmp_path, count=1, levels=(2.0,))
    plan = place / "plan.json"
    trick = "[x](javascript:alert) <script> | a"
    plan.write_text(plan.read_text().replace('"Painted light"', f'"{trick}"'))
    from painted import reindex

    reindex(place)
    told = text(twin.Corpus(place))
    assert "<script>" not in told and not re.search(r"(?<!\\)\]\(javascript", told)
