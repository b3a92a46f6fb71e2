"""`simulate` with an emulator in place of a solve. The emulators are made up here: what they learn of real
presses is in test_fem_emulator.py."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_simulate import INCLUSION, small

import fem
import twin
from fem.emulator import Emulator
from fem.emulator_errors import Errors
from fem.lines import lines, logical_lines
from fem.regression import MATERN, Regression
from fem.solving import KNOTS
from fem.topology import Resolution
from twin import presses
from twin.cli import main
from twin.emulate import plan_of, summary
from twin.reporting import summarise

TINY = Resolution(arc=2, core=1, shell=1, above=1, below=1, edge=1, side=1, layer=1, backing=1)
QUICK = {"quality": "preview", "device": "cpu"}
SAMPLED = ("size_mm", "pressure", "displacement")  # what `Errors` has for each sample
PRESS = ["--size", "9", "--depth", "5", "--modulus", "80", "--quality", "preview", "--seed", "3"]


def constant(values: np.ndarray, inputs: int) -> Regression:
    """A field that nothing changes."""
    flat = values.ravel()
    return Regression(
        inputs=np.zeros((1, inputs)),
        lengths=np.ones((1, inputs)),
        noise=np.full(1, 1e-6),
        mean=flat,
        modes=np.zeros((1, len(flat))),
        trend=np.zeros((inputs + 1, 1)),
        weights=np.zeros((1, 1)),
        order=np.array(MATERN),
    )


def invented(mechanics: str = "linear") -> Emulator:
    """Of the shipped sensor: pressure 0.09 kPa per kPa and mm, and a bump over the inclusion."""
    design = small().pressed(mechanics=mechanics)  # type: ignore[arg-type]
    plan = replace(plan_of(design), resolution=TINY, coarse=TINY, fine=TINY)
    x = np.linspace(-12.5, 12.5, 9)
    levels, n = len(plan.levels), len(logical_lines(TINY))
    pressure = np.full((*KNOTS, levels, 9, 9), 0.09)
    moved = np.zeros((*KNOTS, levels, 9, 9, 3))
    moved[..., 2] = -0.01
    bump = np.exp(-(np.linspace(-3, 3, n) ** 2))
    bump = 0.09 * np.multiply.outer(bump, bump)
    into = bump[..., None] * [0.0, 0.0, -0.1]
    more = [None, None, None, None]
    if plan.finite:
        parts = (bump, 8), (into, 8), (0 * bump, 6), (0 * into, 6)
        more = [constant(np.stack([0.1 * k * b for k in (1, 2, 3)]), inputs) for b, inputs in parts]
    errors = Errors(
        np.full(20, 8.0),
        np.ones((20, 3)),
        np.full((20, 3), 1.5),
        np.ones((16, 6)),
        np.ones((16 if plan.finite else 0, 6)),
        np.zeros((0, 9)),
        np.zeros((4, 2)),
    )
    known = [np.stack([b] * 3) for b in (bump, into)]
    return Emulator(
        plan,
        x,
        pressure,
        moved,
        constant(known[0], 7),
        constant(known[1], 7),
        constant(0 * known[0], 5),
        constant(0 * known[1], 5),
        *more,
        errors,
    )


@pytest.fixture(scope="module")
def frames() -> list[twin.Frame]:
    return twin.simulate(
        small(), INCLUSION, [1.0, 2.0], mechanics="emulator", emulator=invented("finite"), seed=7, **QUICK
    )


def test_the_picture_is_of_the_emulators_surface(frames):
    known = invented("finite")
    for frame, depth in zip(frames, (1.0, 2.0), strict=True):
        answer = known(small().probe(), small().slab(), INCLUSION, depth)
        for name in ("pressure", "displacement", "pressure_0", "displacement_0"):
            assert np.array_equal(frame.surface.point_data[name], answer.surface.point_data[name])
        assert frame.press["force_N"] == answer.force_N
    assert frames[1].tsis["tared"]["total_dn"] > frames[0].tsis["tared"]["total_dn"] > 0


def test_the_record_says_emulator_and_how_far_off_it_is(frames, tmp_path, capsys):
    folder = frames[1].write(tmp_path / "out")
    record = json.loads((folder / "frame.json").read_text(encoding="utf-8"))["fem"]
    assert (record["mechanics"], record["emulated"], record["path"]) == ("emulator", "finite", "emulated")
    assert record["background"] == "shared"
    assert record["error_percent"] == 1.5 and record["dof"] is None
    assert record["seconds"] < 1.0
    assert (folder / "overview.png").stat().st_size > 50_000
    summarise(frames, tmp_path)
    printed = " ".join(capsys.readouterr().out.split())
    assert "mechanics: emulator (finite strain)" in printed
    assert "95 % of held-out solves were met within: 1.5 %" in printed


def test_an_error_that_nobody_knows_is_null_and_told(tmp_path, capsys):
    """Too few samples were held out to tell; the picture is kept all the same."""
    known = invented()
    few = replace(known, errors=replace(known.errors, **{n: getattr(known.errors, n)[:9] for n in SAMPLED}))
    frame = twin.simulate(small(), INCLUSION, 1.0, mechanics="emulator", emulator=few, seed=7, **QUICK)
    record = json.loads((frame.write(tmp_path / "out") / "frame.json").read_text(encoding="utf-8"))["fem"]
    assert record["error_percent"] is None
    summarise([frame], tmp_path)
    assert "95 % of held-out solves were met within: not known" in " ".join(capsys.readouterr().out.split())
    said = summary(few, "few.npz")
    assert said.count("not known") == 2 and "nan" not in said
    assert "smaller ones, by the nearest samples of 8 to 8 mm" in summary(known, "many.npz")


def test_plain_tissue_and_presses_by_force():
    known = invented()
    frame = twin.simulate(small(), None, force=0.5, mechanics="emulator", emulator=known, seed=7, **QUICK)
    assert frame.press["force_N"] == pytest.approx(0.5)
    assert frame.press["indentation_mm"] == pytest.approx(0.5e3 / (0.09 * 5 * 625))
    assert frame.fem["error_percent"] == 0.0


@pytest.mark.parametrize(
    ("design", "inclusion", "depth", "start"),
    [
        (
            {},
            twin.Inclusion(size=13.5, depth=5, modulus=80),
            2.0,
            "inclusion.size: received 13.5 mm; allowed",
        ),
        (
            {},
            twin.Inclusion(size=9, depth=5, modulus=80, offset=(7, 0)),
            2.0,
            "inclusion.offset: received 7 mm",
        ),
        ({}, INCLUSION, 3.5, "press.indentation_mm: received 3.5 mm; allowed in this emulator 0.1 to 3 mm"),
        ({"tilt_deg": (1.0, 0.0)}, INCLUSION, 1.0, "press.tilt_deg: received"),
    ],
)
def test_what_it_does_not_know_is_refused_in_the_designs_words(design, inclusion, depth, start):
    changed = small().pressed(**design)
    with pytest.raises(fem.NotModelled) as caught:
        presses.emulated(changed, inclusion, [depth], invented("finite"))
    assert str(caught.value).startswith(start) and "\n" not in str(caught.value)


def test_another_sensor_is_refused_by_the_part_that_differs():
    design = small()
    layers = list(design.waveguide.layers)
    layers[1] = replace(layers[1], modulus_kPa=70.0)
    other = replace(design, waveguide=replace(design.waveguide, layers=tuple(layers)))
    with pytest.raises(
        fem.NotModelled, match=r"^waveguide\.layers\.1\.modulus_kPa: received 70\.0; .* 61\.0"
    ):
        presses.emulated(other, INCLUSION, [1.0], invented())


def test_the_command_finds_the_designs_own_emulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["simulate", *PRESS, "--mechanics", "emulator", "--out", "out"]
    with monkeypatch.context() as nothing_ships:
        nothing_ships.setattr("twin.learned.shipped", list)
        assert main(command) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "--emulator: received 'emulators/tsis.npz'" in line
    assert "twin emulate" in line and not (tmp_path / "out").exists()
    Path("emulators").mkdir()
    fem.save_emulator(invented("finite"), "emulators/tsis.npz")
    assert main([*command, "--indentation", "4"]) == 2
    assert "--indentation: received 4 mm; allowed in this emulator 0.1 to 3 mm" in capsys.readouterr().err
    assert main(command) == 0
    assert json.loads(Path("out/frame.json").read_text(encoding="utf-8"))["fem"]["mechanics"] == "emulator"


def test_lines_of_the_mesh_span_the_probe():
    """The made-up emulators' fields lie on the nodes of a real mesh."""
    from fem.specimen import geometry_at

    plan = invented().plan
    along = lines(geometry_at(plan, np.array([9.0, 5.0, 2.0, 1.0, 30.0, 5.0, 0.5]), 80.0), TINY)
    assert all(line[0] == -12.5 and line[-1] == 12.5 for line in along)
