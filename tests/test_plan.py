"""Plans: what is frozen, that it can be read again, and what it will cost. See also test_plan_hostile.py."""

import json
import os
import shutil
import sys
import types

import numpy as np
import pandas as pd
import pytest

import fem
from fem.sampling import Ranges
from twin import cli, index, probe, sample
from twin.complaint import DesignError
from twin.design import load_design
from twin.plan import freeze, load_plan
from twin.study_file import shipped_studies

STUDY = """
kind = "corpus"
name = "mine"
mechanics = "linear"
indentation_mm = [1, 2]
seed = 5

[[samples]]
name = "box"
sampler = "{sampler}"
count = {count}
blanks = 0.2
[samples.inclusion]
size_mm = [2, 13]
depth_mm = [4, 12]
modulus_kPa = 80

[randomise."leds.*.flux_W"]
distribution = "normal"
sd = 0.05
relative = true

[randomise."press.indentation_mm"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true

[randomise."press.indentation_mm.*"]
distribution = "normal"
sd = 0.01
relative = true

[randomise."camera.pattern_seed"]
distribution = "integer"
low = 1
high = 1000
"""


def frozen(place, text=STUDY, name="corpus", *, sampler="uniform", count=20, **options):
    (place / "study.toml").write_text(text.replace("{sampler}", sampler).replace("{count}", str(count)))
    return freeze(place / "study.toml", place / name, **options)


def test_a_plan_is_what_its_study_says(tmp_path):
    plan = frozen(tmp_path)
    assert sorted(entry.name for entry in (tmp_path / "corpus").iterdir()) == ["plan.json", "samples.parquet"]
    assert len(plan) == 20 and [plan.inclusion(n) for n in (4, 9, 14, 19)] == [None] * 4
    assert (plan.mechanics, plan.quality, plan.light, plan.seed) == ("linear", "standard", "standard", 5)
    assert plan.emulator is None and plan.k == load_design("tsis").signal and plan.group(3) == "box"
    for number in range(len(plan)):
        design, found = plan.design(number), plan.parameters(number)
        assert design.mechanics == "linear"
        assert [led.flux_W for led in design.leds] == [found[f"leds.{n}.flux_W"] for n in range(4)]
        assert design.press.indentation_mm == plan.indentations(number)
        assert design.camera.pattern_seed == found["camera.pattern_seed"]
        if plan.inclusion(number):
            assert (plan.inclusion(number).size, 80) == (found["size_mm"], plan.inclusion(number).modulus)
    # levels share the study's common factor of 10 %, and differ by a per cent
    depths = np.array([plan.indentations(n) for n in range(20)]) / [1, 2]
    assert 0.03 < depths.std(axis=0).mean() < 0.09
    assert 0.002 < (depths[:, 0] / depths[:, 1] - 1).std() < 0.03
    table = pd.read_parquet(tmp_path / "corpus" / "samples.parquet")
    assert list(table.columns[:8]) == ["sample", "group", "blank", *list(plan.parameter_names[:5])]
    assert table.dtypes["size_mm"] == np.float64 and list(table["group"].unique()) == ["box"]


def test_the_same_study_makes_the_same_bytes(tmp_path):
    frozen(tmp_path, name="a"), frozen(tmp_path, name="b"), frozen(tmp_path, name="c", seed=6)
    for name in ("plan.json", "samples.parquet"):
        a, b, c = ((tmp_path / folder / name).read_bytes() for folder in "abc")
        assert a == b != c


def test_the_digest_is_of_all_that_decides_the_pictures(tmp_path):
    """The drawn numbers are the same at another quality; what was kept of its pictures is of no use."""
    one = frozen(tmp_path, name="one")
    again, rough = (
        frozen(tmp_path, name="again"),
        frozen(tmp_path, name="rough", light="preview", quality="preview"),
    )
    assert one.head.samples.sha256 == rough.head.samples.sha256
    assert one.digest == again.digest != rough.digest


def test_more_light_paths_make_less_noise_of_the_same_samples(tmp_path, variant):
    """Sixteen times as many take noise to a quarter; the plan of a study that says nothing is as it was."""
    plain = frozen(tmp_path, name="plain", light="preview", count=1)
    assert plain.head.paths is None and '"paths"' not in (tmp_path / "plain" / "plan.json").read_text()
    few, many = (
        frozen(tmp_path, name=str(paths), quality="preview", light="preview", count=1, paths=paths)
        for paths in (2**14, 2**18)
    )
    assert few.head.samples.sha256 == many.head.samples.sha256 and few.digest != many.digest
    noise = []
    for plan in (few, many):
        sample.make(plan, 0, plan.folder)
        index.build(plan.folder, plan, plan.digest)
        noise.append(pd.read_parquet(plan.folder / "index.parquet")["noise_percent"].mean())
    print(noise)
    assert 2.5 < noise[0] / noise[1] < 6.0
    with pytest.raises(DesignError, match="paths: received 3; allowed an integer from 1024"):
        frozen(tmp_path, name="none", paths=3)


@pytest.mark.parametrize("sampler", ["uniform", "sobol", "latin"])
def test_the_first_samples_of_a_plan_are_those_of_a_smaller_one(tmp_path, sampler):
    whole = frozen(tmp_path, name="whole", sampler=sampler, count=40)
    few = freeze(tmp_path / "study.toml", tmp_path / "few", count=8)
    assert [whole.parameters(n) for n in range(8)] == [few.parameters(n) for n in range(8)]
    assert [whole.seeds(n) for n in range(8)] == [few.seeds(n) for n in range(8)]
    if sampler != "latin":  # which divides its ranges by the count
        other = frozen(tmp_path, name="other", sampler=sampler, count=8)
        assert [other.parameters(n) for n in range(8)] == [few.parameters(n) for n in range(8)]


def test_seeds_are_shared_by_the_light_and_own_by_the_camera(tmp_path):
    plan = frozen(tmp_path)
    assert len({plan.seeds(n)[0] for n in range(20)}) == 1
    assert len({plan.seeds(n)[1] for n in range(20)}) == 20
    own = frozen(tmp_path, STUDY.replace("seed = 5", 'seed = 5\nlight_seed = "own"'))
    assert len({own.seeds(n)[0] for n in range(20)}) == 20
    assert all(0 <= light < 2**26 and 0 <= camera < 2**53 for light, camera in map(own.seeds, range(20)))


def test_what_cannot_be_simulated_is_drawn_again_and_counted(tmp_path):
    """Half of the box lies in the chest wall: what stays is uniform over the other half."""
    text = STUDY.split("[randomise")[0].replace("[2, 13]", "[2, 22]").replace("[4, 12]", "[8, 28]")
    plan = frozen(tmp_path, text.replace("blanks = 0.2", ""), count=400)
    reach = plan.columns["size_mm"] + plan.columns["depth_mm"]
    assert reach.max() < 30 and 300 < plan.groups[0].redrawn < 500
    lower = plan.columns["size_mm"] + plan.columns["depth_mm"] < 10 + np.sqrt(200)  # half of the triangle
    assert abs(lower.mean() - 0.5) < 4 * 0.5 / np.sqrt(400)
    fewer = freeze(tmp_path / "study.toml", tmp_path / "few", count=50)
    assert [fewer.parameters(n) for n in range(50)] == [plan.parameters(n) for n in range(50)]


def test_grid_and_groups(tmp_path):
    text = (
        STUDY.split("[[samples]]")[0]
        + """
[[samples]]
name = "grid"
sampler = "grid"
[samples.grid]
size_mm = [6, 8]
depth_mm = [4]
modulus_kPa = [40, 80, 120]
[[samples]]
name = "one"
sampler = "uniform"
count = 1
[samples.inclusion]
size_mm = 6
depth_mm = 4
modulus_kPa = 40
"""
    )
    plan = frozen(tmp_path, text)
    assert len(plan) == 7 and plan.group(5) == "grid" and plan.group(6) == "one"
    assert [(plan.inclusion(n).size, plan.inclusion(n).modulus) for n in (0, 1, 3)] == [
        (6, 40),
        (6, 80),
        (8, 40),
    ]
    assert plan.inclusion(6) == fem.Inclusion(6, 4, 40)


def test_the_papers_set(tmp_path):
    plan = freeze("paper", tmp_path / "corpus")
    assert len(plan) == 134 and plan.indentation_mm == (1, 2, 3) and not plan.columns["blank"].any()
    assert plan.inclusion(133) == fem.Inclusion(10, 5, 100) and plan.groups[0].redrawn == 0
    assert load_plan(tmp_path / "corpus").base.mechanics == "finite"


def test_an_emulator_travels_with_the_corpus_and_its_ranges_hold(tmp_path, monkeypatch):
    """Only the plan of the emulator matters here; nothing is built."""
    design = load_design("tsis")
    known = fem.sampling.Plan(design.probe(), 60.0, ranges=Ranges(depth_mm=(4.0, 8.0)), mechanics="finite")
    monkeypatch.setattr(fem, "load_emulator", lambda place: types.SimpleNamespace(plan=known))
    (tmp_path / "mine.npz").write_bytes(b"an emulator")
    plan = frozen(tmp_path, mechanics="emulator", emulator=tmp_path / "mine.npz", count=100)
    assert plan.emulator.read_bytes() == b"an emulator" and not plan.shares_references
    assert np.nanmax(plan.columns["depth_mm"]) <= 8 and plan.groups[0].redrawn > 40
    plan.emulator.write_bytes(b"another")
    with pytest.raises(DesignError, match=r"emulator\.npz: received a file of SHA-256"):
        load_plan(tmp_path / "corpus")


def test_luminaire_files_travel_with_the_corpus(tmp_path):
    shutil.copy(os.path.join(os.path.dirname(__file__), "..", "assets", "designs", "tsis.toml"), tmp_path)
    text = (tmp_path / "tsis.toml").read_text()
    text = text.replace("flux_W = 0.010 ", 'pattern = "ies"\nies = "lamp.ies"\nflux_W = 0.010 ', 1)
    (tmp_path / "mine.toml").write_text(text)
    lamp = "IESNA:LM-63-2002\nTILT=NONE\n1 1000 1 3 1 1 2 0 0 0\n1 1 1\n0 45 90\n0\n100 70 0\n"
    (tmp_path / "lamp.ies").write_text(lamp)
    frozen(tmp_path, STUDY.replace("name =", 'design = "mine.toml"\nname =', 1))
    (tmp_path / "corpus").rename(tmp_path / "moved")
    plan = load_plan(tmp_path / "moved")
    assert plan.design(0).leds[0].ies == str(tmp_path / "moved" / "leds.0.ies")
    head = json.loads((tmp_path / "moved" / "plan.json").read_text())
    head["design"]["leds"][0]["ies"] = "../lamp.ies"
    (tmp_path / "moved" / "plan.json").write_text(json.dumps(head))
    with pytest.raises(DesignError, match=r"ies: received '\.\./lamp\.ies'"):
        load_plan(tmp_path / "moved")


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path):
    frozen(tmp_path)
    frozen(tmp_path, seed=9)  # a plan that nothing was run of is replaced
    (tmp_path / "corpus" / "samples").mkdir()
    with pytest.raises(DesignError, match=r"out: received .* holds something else"):
        frozen(tmp_path)
    assert load_plan(tmp_path / "corpus").seed == 9


def test_samples_that_are_not_there_are_refused(tmp_path):
    plan = frozen(tmp_path)
    for number in (-1, 20):
        with pytest.raises(DesignError, match=r"sample: received -?\d+; allowed an integer from 0 to 19"):
            plan.design(number)


def fake(monkeypatch, made):
    """A twin.sample that takes no time and says that it did."""

    def make(plan, number, folder):
        made.append(number)
        (folder / str(number)).write_bytes(b"x")
        return {"seconds": {"mechanics": 1.0, "light": 2.5, "write": 0.5}, "bytes": 3_000_000}

    import twin

    module = types.SimpleNamespace(make=make)
    monkeypatch.setitem(sys.modules, "twin.sample", module)
    monkeypatch.setattr(twin, "sample", module, raising=False)


def test_the_probe_and_what_follows_from_it(tmp_path, monkeypatch):
    """4 s a sample on one core: a million frames at two levels are 2 million core seconds."""
    made = []
    fake(monkeypatch, made)
    plan = frozen(tmp_path)
    cost = probe.measure(plan)
    assert len(set(made)) == 2 and not any(plan.columns["blank"][made])
    assert cost.seconds == pytest.approx(4.0, abs=0.1) and cost.bytes == 3_000_000
    exact = probe.Cost(1.0, 2.5, 0.5, 3e6, 0.0)
    text = probe.projected(plan, exact, 1_000_000, 100)
    for words in (
        "1000000 in 500000 samples",
        "core hours  556",
        "5.6 h, 1500.0 samples a minute",
        "1.51 TB",
        "75 MB/s",
        "50 tasks a second, 5 % of its time",
        "up to 1000 workers",
    ):
        assert words in text, text


def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fake(monkeypatch, [])
    monkeypatch.setattr("twin.learned.shipped", list)
    assert cli.main(["corpus", "plan", "quick", "--out", "c", "--frames", "1000", "--seed", "3"]) == 0
    out = capsys.readouterr().out
    assert "4 samples (1 blank) at 2 mm, 4 frames; seed 3" in out and "1000 in 1000 samples" in out
    assert cli.main(["corpus", "plan", "quick", "--out", "c", "--no-probe", "--quality", "standard"]) == 0
    assert "linear, standard; light standard" in capsys.readouterr().out
    for arguments, words in (
        (["nonesuch", "--out", "d"], ["STUDY", "'nonesuch'", *shipped_studies()]),
        (["quick"], ["--out", "nothing"]),
        (["quick", "--out", "d", "--count", "0"], ["--count", "0", "> 0"]),
        (["quick", "--out", "d", "--mechanics", "magic"], ["--mechanics", "'magic'", "emulator"]),
        (["quick", "--out", "d", "--emulator", "a.npz"], ["--emulator"]),
        (["training", "--out", "d"], ["training: emulator", "tsis.npz", "twin emulate"]),
        (["quick", "--out", "d", "--no-probe", "--frames", "9"], ["--frames", "--no-probe"]),
    ):
        assert cli.main(["corpus", "plan", *arguments]) == 2
        line = capsys.readouterr().err
        assert line.startswith("twin corpus plan: ") and line.count("\n") == 1
        assert not [word for word in words if word not in line], line
    assert not (tmp_path / "d").exists()
