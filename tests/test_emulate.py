"""`twin emulate`: what it learns of a design, what it refuses, and that it goes on where it was cut off."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest

import fem
from fem import equilibrium, solving
from fem.sampling import Plan, Ranges
from fem.topology import Resolution
from twin import emulate, load_design
from twin.cli import main
from twin.complaint import DesignError

TINY = Resolution(arc=1, core=1, shell=1, above=1, below=1, edge=1, side=1, layer=1, backing=1)


def test_the_papers_sensor_and_its_box() -> None:
    """Of `tsis`, an emulator learns the box of the source paper's phantoms and more."""
    plan = emulate.plan_of(load_design("tsis").pressed(mechanics="linear"), seed=4)
    assert plan.probe == load_design("tsis").probe()
    assert plan.mechanics == "linear" and plan.seed == 4
    expected = Ranges()
    for name, value in vars(plan.ranges).items():
        assert value == pytest.approx(getattr(expected, name)), name


def test_at_finite_strain_presses_are_half_as_deep() -> None:
    plan = emulate.plan_of(load_design("tsis"))
    assert plan.mechanics == "finite" and plan.ranges.indentation_mm == (0.1, 3.0)
    assert list(plan.levels) == [0.0, 1.0, 2.0, 3.0]


def test_designs_that_are_not_straight_are_refused() -> None:
    design = load_design("tsis")
    for changed, field in (
        (design.pressed(tilt_deg=(0.0, 2.0)), "press.tilt_deg"),
        (design.pressed(position_mm=(1.0, 0.0)), "press.position_mm"),
        (
            dataclasses.replace(
                design, waveguide=dataclasses.replace(design.waveguide, dome_radius_mm=300.0)
            ),
            "waveguide.dome_radius_mm",
        ),
    ):
        with pytest.raises(DesignError, match=field):
            emulate.plan_of(changed)


def test_specimens_too_thin_for_inclusions_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`twin emulate` looked for one that fits for ever."""
    monkeypatch.chdir(tmp_path)
    design = load_design("tsis")
    press, slab = dataclasses.replace(design.press, indentation_mm=(1.0,)), design.specimen
    thin, thick = (
        dataclasses.replace(design, press=press, specimen=dataclasses.replace(slab, thickness_mm=t))
        for t in (6.0, 8.3)
    )
    monkeypatch.setattr("twin.cli.load_design", lambda name: thin)
    assert main(["emulate", "thin", "--out", "thin.npz"]) == 2
    error = capsys.readouterr().err
    assert "specimen.thickness_mm: received 6.0; allowed at least 8.3 mm" in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
    plan = emulate.plan_of(thick)
    assert plan.inside(np.array([plan.point(k) for k in (0, 29)])).shape == (2,)


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        ([], "--out: received nothing"),
        (["--out", "a.txt"], "out: received 'a.txt'"),
        (["--out", "a.npz", "--workers", "0"], "--workers: received 0"),
        (["--out", "a.npz", "--minutes", "-1"], "--minutes: received '-1'"),
        (["--out", "a.npz", "--samples", "29"], "samples: received 29; allowed 30 and more"),
    ],
)
def test_mistakes_are_one_line(
    flags: list[str],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["emulate", "tsis", *flags]) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


class Here:
    """Stands where worker processes do: all is done at once, in this one."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *_: object) -> None: ...

    def submit(self, work: Callable[..., None], *arguments: object) -> Future[None]:
        done: Future[None] = Future()
        try:
            done.set_result(work(*arguments))
        except Exception as error:
            done.set_exception(error)
        return done

    def shutdown(self, **_: object) -> None: ...


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (equilibrium.NotConverged("stuck at 2 mm"), 2, "specimen: received plain tissue of 3"),
        (np.linalg.LinAlgError("singular"), 2, "cannot be pressed by 3 mm (singular); allowed"),
        (BrokenProcessPool("a child died"), 1, "workers: received one that ended by itself"),
    ],
)
def test_plain_tissue_that_cannot_be_followed_is_one_line(
    error: Exception,
    status: int,
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(solving, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(solving, "background", fails)
    assert main(["emulate", "tsis", "--workers", "1", "--out", str(tmp_path / "a.npz")]) == status
    told = [said for said in capsys.readouterr().err.splitlines() if said.startswith("twin emulate: ")]
    assert len(told) == 1 and line in told[0]
    assert [place.name for place in (tmp_path / "a.npz.samples").iterdir()] == ["plan.json"]


@pytest.mark.slow
def test_builds_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command with more samples solves those that are new, and writes the file."""

    def small(design: object, seed: int = 0) -> Plan:
        ranges = Ranges(
            size_mm=(7.0, 9.0),
            depth_mm=(5.0, 6.0),
            offset_mm=1.0,
            tissue_kPa=(4.5, 5.5),
            thickness_mm=(28.0, 30.0),
        )
        probe = fem.Probe(20.0, (fem.Layer(6.0, 60.0),))
        return Plan(probe, 44.0, ranges=ranges, resolution=TINY, fine=TINY, seed=seed)

    monkeypatch.setattr(emulate, "plan_of", small)
    out = tmp_path / "small.npz"
    command = ["emulate", "tsis", "--workers", "2", "--out", str(out), "--samples"]
    assert main([*command, "30"]) == 0
    folder = tmp_path / "small.npz.samples"
    kept = {place: place.stat().st_mtime_ns for place in folder.iterdir()}
    assert folder / "sample-00029.npz" in kept
    out.unlink()
    assert main([*command, "32"]) == 0
    assert (folder / "sample-00031.npz").exists()
    assert {place: place.stat().st_mtime_ns for place in kept} == kept
    said = capsys.readouterr().out
    assert "emulator: " in said and "inclusions of 4 mm and more: errors not known" in said  # of seven
    built = fem.load_emulator(out)
    answer = built(built.plan.probe, fem.Slab(29.0, 44.0, 5.0), fem.Inclusion(8.0, 5.5, 60.0), 2.0)
    assert answer.force_N > answer.force_0_N > 0
