"""The emulator of the contact field: against solves it has not seen, by symmetry and scaling, as a file."""

import io
import json
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.format import write_array

import fem
from fem.emulating import build_emulator, fit
from fem.emulator import Emulator, lagrange, resample, signals
from fem.emulator_errors import FEWEST, Errors, off_the_edge
from fem.emulator_file import NotAnEmulator, load_emulator, save_emulator
from fem.emulator_limits import check
from fem.ground import cubic
from fem.regression import MATERN, Regression
from fem.sampling import Plan, Ranges
from fem.solving import claim, knots
from fem.specimen import background, geometry_at, solve
from fem.symmetry import unfold
from fem.topology import Resolution

PROBE = fem.Probe(20.0, (fem.Layer(6.0, 60.0),))
RANGES = Ranges(
    size_mm=(7.0, 9.0),
    depth_mm=(5.0, 6.0),
    modulus_kPa=(40.0, 80.0),
    offset_mm=1.5,
    indentation_mm=(0.5, 3.0),
    tissue_kPa=(4.5, 5.5),
    thickness_mm=(27.0, 30.0),
)
COARSE = Resolution(arc=1, core=1, shell=1, above=1, below=1, edge=1, side=1, layer=1, backing=1)
FINER = Resolution(arc=2, core=1, shell=2, above=2, below=1, edge=1, side=1, layer=1, backing=1)
PLAN = Plan(PROBE, 44.0, ranges=RANGES, resolution=COARSE, fine=FINER, seed=3)
SLAB = fem.Slab(28.3, 44.0, 5.1)
INCLUSION = fem.Inclusion(8.2, 5.4, 61.0, (1.1, 0.4))
SAMPLES = 32


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("samples")


@pytest.fixture(scope="module")
def emulator(folder: Path) -> Emulator:
    return build_emulator(PLAN, folder, samples=SAMPLES, workers=2)


def grids(answer: object) -> dict[str, np.ndarray]:
    data = answer.surface.point_data  # type: ignore[attr-defined]
    n = round(answer.surface.n_points**0.5)  # type: ignore[attr-defined]
    return {name: np.asarray(data[name]).reshape(n, n, *data[name].shape[1:]) for name in list(data)}


def test_cubic_and_polynomial_weights_are_exact() -> None:
    nodes, at = np.array([-1.0, 0.5, 1.0, 2.0, 4.0]), np.linspace(-1, 4, 11)
    assert cubic(nodes, at) @ (nodes**3 - nodes) == pytest.approx(at**3 - at)
    assert lagrange(nodes, 0.3) @ nodes**4 == pytest.approx(0.3**4)


def test_held_out_solves_are_met(emulator: Emulator) -> None:
    """Solves of a plan with another seed, on the samples' own mesh and off-centre, are as far away as
    cross-validation says; the gain from the finer mesh is left out on both sides."""
    other = replace(PLAN, seed=99)
    thick, tissue = knots(PLAN)
    errors = []
    for number in range(5):
        point = other.point(number)
        truth = solve(other, point)["rise"][1]
        geometry = geometry_at(PLAN, point, float(PLAN.ratios[1] * point[5]))
        assert geometry.inclusion is not None
        coarse = replace(emulator, finer=silent(emulator.finer))
        guess, _ = signals(coarse, geometry.slab, geometry.inclusion, [np.ones(1)])[0]
        onto = resample(geometry, PLAN.resolution, emulator.x)
        unit = np.tensordot(
            lagrange(tissue, np.log(point[5])),
            np.tensordot(lagrange(thick, 1 / point[4]), emulator.pressure[:, :, 0], 1),
            1,
        )
        true = onto[0] @ truth @ onto[1].T * unit
        missed, size = (np.abs(f)[off_the_edge(emulator.x)] for f in (guess * unit - true, true))
        errors.append(100 * missed.max() / size.max())
    typical, bad = np.percentile(emulator.errors.pressure[:, 0], (50, 95))  # of six samples
    assert np.median(errors) < 2 * typical < 4.0
    assert max(errors) < 2 * bad


def test_what_a_finer_mesh_adds_makes_up_for_the_lean_one(emulator: Emulator) -> None:
    """Under the middle the answer is the finer mesh's, between its nodes too: a press that no sample has, ten
    times as near as the lean mesh's own."""
    point = np.array([8.2, 5.4, 0.0, 0.0, 28.3, 5.1, 0.0])
    geometry = geometry_at(PLAN, point, float(PLAN.ratios[1] * point[5]))
    assert geometry.inclusion is not None
    onto = resample(geometry, PLAN.fine, emulator.x)
    solved = solve(replace(PLAN, resolution=PLAN.fine), point)
    plain = replace(emulator, finer=silent(emulator.finer), finer_tared=silent(emulator.finer_tared))
    answers = [signals(e, geometry.slab, geometry.inclusion, [np.ones(1)])[0] for e in (emulator, plain)]
    for name, guess, lean in zip(("rise", "moved"), *answers, strict=True):
        true = np.einsum("ai,ij...,bj->ab...", onto[0], solved[name][1], onto[1])
        off, before = (np.abs(f - true)[off_the_edge(emulator.x)].max() for f in (guess, lean))
        assert off < 0.1 * before and off < 0.01 * np.abs(true).max()


def silent(regression: Regression) -> Regression:
    return replace(regression, mean=0 * regression.mean, modes=0 * regression.modes)


def test_background_between_the_knots_is_a_solve(emulator: Emulator) -> None:
    """Plain tissue: force within 0.1 % of a solve on the same mesh."""
    found = background(PLAN, SLAB.thickness_mm, SLAB.modulus_kPa)
    answer = grids(emulator(PROBE, SLAB, None, 1.0))
    truth = SLAB.modulus_kPa * found["pressure"][0]
    assert answer["pressure"] == pytest.approx(truth, rel=1e-3)
    assert answer["displacement"] == pytest.approx(found["moved"][0], abs=1e-3 * np.abs(found["moved"]).max())
    assert emulator(PROBE, SLAB, None, 1.0).error_percent == 0.0


def test_images_of_an_offset(emulator: Emulator) -> None:
    """The eight images of an offset under the square's symmetry give the images of one field, but for
    rounding."""
    base = grids(emulator(PROBE, SLAB, INCLUSION, 2.0))
    for offset in (
        (1.1, -0.4),
        (-1.1, 0.4),
        (0.4, 1.1),
        (-0.4, 1.1),
        (0.4, -1.1),
        (-1.1, -0.4),
        (-0.4, -1.1),
    ):
        image = grids(emulator(PROBE, SLAB, replace(INCLUSION, offset=offset), 2.0))
        pressure, displacement = unfold(base["pressure"], base["displacement"], offset)
        assert image["pressure"] == pytest.approx(pressure, rel=1e-9)
        assert image["displacement"] == pytest.approx(displacement, abs=1e-9)


@pytest.mark.parametrize("offset", [(1.0, 0.0), (0.8, 0.8)])
def test_no_seam_where_images_meet(emulator: Emulator, offset: tuple[float, float]) -> None:
    """On a plane of symmetry the field is symmetric, and across it, it has no jump and no kink."""

    def tared(away: float) -> np.ndarray:
        x, y = (offset[0], away) if offset[1] == 0 else (offset[0] - away, offset[1] + away)
        answer = grids(emulator(PROBE, SLAB, replace(INCLUSION, offset=(x, y)), 1.0))
        return answer["pressure"] - answer["pressure_0"]

    step, size = 1e-2, np.abs(tared(0.0)).max()
    mirrored = tared(0.0)[:, ::-1] if offset[1] == 0 else tared(0.0).T
    assert tared(0.0) == pytest.approx(mirrored, abs=1e-9 * size)
    assert np.abs(tared(1e-9) - tared(-1e-9)).max() < 1e-7 * size
    bend = [np.abs(tared(at + step) - 2 * tared(at) + tared(at - step)).max() for at in (0.0, 3 * step)]
    assert bend[0] < 2 * bend[1] < 0.01 * size  # a kink would bend by a step, smooth fields by its square


def test_linear_in_the_indentation_and_inverted_by_force(emulator: Emulator) -> None:
    one, three = (emulator(PROBE, SLAB, INCLUSION, depth) for depth in (1.0, 3.0))
    assert grids(three)["displacement"] == pytest.approx(3 * grids(one)["displacement"], rel=1e-12)
    assert three.force_N == pytest.approx(3 * one.force_N, rel=1e-12)
    back = emulator(PROBE, SLAB, INCLUSION, force=2 * one.force_N)
    assert back.indentation_mm == pytest.approx(2.0, rel=1e-9)
    assert back.force_0_N == pytest.approx(2 * one.force_N, rel=1e-9)
    assert back.indentation_0_mm > 2.0  # plain tissue is softer


def test_force_is_the_integral_of_the_pressure(emulator: Emulator) -> None:
    answer = emulator(PROBE, SLAB, INCLUSION, 2.0)
    data = answer.surface.point_data
    assert 1e-3 * (data["pressure"] * data["area"]).sum() == pytest.approx(answer.force_N)
    assert data["area"].sum() == pytest.approx(PROBE.width_mm**2)
    assert answer.min_pressure_kPa > 0
    assert answer.path == "emulated"
    assert 0 < np.percentile(emulator.errors.displacement[:, 0], 95) < 20
    assert answer.error_percent is None  # six samples were held out


def test_errors_are_of_ten_samples_or_not_known() -> None:
    """Of the inclusion's kind, else of those nearest in size; two samples are no percentile."""

    def errors(*sizes: float) -> Errors:
        size = np.array(sizes)
        each = np.repeat(size[:, None], 3, axis=1)  # a sample is off by as much per cent as it has mm
        none = np.zeros((0, 3))
        return Errors(size, each, each, none, none, np.zeros((0, 9)), np.zeros((4, 2)))

    many = errors(2.5, 3.5, *np.linspace(5.0, 13.0, 17))
    assert many.percentile("displacement", 95, 8.0) == pytest.approx(12.6)
    assert many.percentile("displacement", 100, 3.0) == pytest.approx(8.5)  # the tenth
    assert many.alike(3.0).sum() == many.alike(2.0).sum() == FEWEST
    both = errors(*np.linspace(2.0, 3.8, 10), *np.linspace(5.0, 13.0, 10))
    assert both.percentile("pressure", 100, 3.0) == pytest.approx(3.8)
    assert both.percentile("pressure", 100, 4.0) == pytest.approx(13.0)
    for few in (errors(), errors(*np.linspace(5.0, 13.0, FEWEST - 1))):
        assert few.percentile("displacement", 95, 8.0) is few.percentile("pressure", 50, 3.0) is None


REFUSED = [
    (
        lambda e: e(fem.Probe(20.0, (fem.Layer(6.0, 61.0),)), SLAB, INCLUSION, 1.0),
        "probe.layers.0.modulus_kPa: ",
    ),
    (lambda e: e(replace(PROBE, dome_radius_mm=90.0), SLAB, INCLUSION, 1.0), "probe.dome_radius_mm: "),
    (lambda e: e(PROBE, replace(SLAB, width_mm=50.0), INCLUSION, 1.0), "slab.width_mm: "),
    (lambda e: e(PROBE, replace(SLAB, poisson=0.45), INCLUSION, 1.0), "slab.poisson: "),
    (lambda e: e(PROBE, replace(SLAB, sides="symmetric"), INCLUSION, 1.0), "slab.sides: "),
    (lambda e: e(PROBE, replace(SLAB, thickness_mm=31.0), INCLUSION, 1.0), "slab.thickness_mm: "),
    (lambda e: e(PROBE, replace(SLAB, modulus_kPa=9.0), INCLUSION, 1.0), "slab.modulus_kPa: "),
    (lambda e: e(PROBE, SLAB, replace(INCLUSION, size=9.5), 1.0), "inclusion.size: "),
    (lambda e: e(PROBE, SLAB, replace(INCLUSION, depth=4.0), 1.0), "inclusion.depth: "),
    (lambda e: e(PROBE, SLAB, replace(INCLUSION, modulus=200.0), 1.0), "inclusion.modulus: "),
    (lambda e: e(PROBE, SLAB, replace(INCLUSION, offset=(0.0, -2.0)), 1.0), "inclusion.offset: "),
    (lambda e: e(PROBE, SLAB, replace(INCLUSION, poisson=0.4), 1.0), "inclusion.poisson: "),
    (lambda e: e(PROBE, SLAB, replace(INCLUSION, stretch=(1.0, 1.0, 2.0)), 1.0), "inclusion.stretch: "),
    (lambda e: e(PROBE, SLAB, INCLUSION, 4.0), "indentation: "),
    (lambda e: e(PROBE, SLAB, INCLUSION, float("nan")), "indentation: "),
    (lambda e: e(PROBE, SLAB, INCLUSION, force=50.0), "force: "),
    (lambda e: e(PROBE, SLAB, INCLUSION), "indentation, force: "),
    (lambda e: e(PROBE, SLAB, INCLUSION, 1.0, mechanics="finite"), "mechanics: "),
    (lambda e: e(PROBE, SLAB, INCLUSION, 1.0, tilt=(1.0, 0.0)), "tilt: "),
    (lambda e: e(PROBE, SLAB, INCLUSION, 1.0, position=(0.0, 3.0)), "position: "),
]


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_what_it_does_not_know_is_refused_in_one_line(emulator: Emulator, number: int) -> None:
    ask, start = REFUSED[number]
    with pytest.raises(ValueError) as caught:
        ask(emulator)
    assert str(caught.value).startswith(start)
    assert "received" in str(caught.value) and "\n" not in str(caught.value)


def test_refusals_near_the_chest_wall() -> None:
    plan = Plan(PROBE, 44.0)
    with pytest.raises(
        ValueError, match=r"inclusion.depth .* received 22 mm; allowed in this emulator up to 20 mm"
    ):
        check(
            plan, PROBE, fem.Slab(24.0, 44.0, 5.0), fem.Inclusion(11.0, 11.0, 50.0), "linear", (0, 0), (0, 0)
        )


def test_answer_is_fast(emulator: Emulator) -> None:
    times = []
    for _ in range(20):
        start = time.perf_counter()
        emulator(PROBE, SLAB, INCLUSION, 2.0)
        times.append(time.perf_counter() - start)
    assert min(times) < 5e-3


def test_builds_resume_and_keep_apart(emulator: Emulator, folder: Path) -> None:
    """A second build solves nothing anew and gives the same numbers; another plan is refused the folder."""
    before = {place.name: place.stat().st_mtime_ns for place in folder.iterdir()}
    again = build_emulator(PLAN, folder, samples=SAMPLES, workers=1)
    assert {place.name: place.stat().st_mtime_ns for place in folder.iterdir()} == before
    assert np.array_equal(again.rise.weights, emulator.rise.weights)
    with pytest.raises(ValueError, match="another plan"):
        build_emulator(replace(PLAN, seed=4), folder, samples=SAMPLES)
    with pytest.raises(ValueError, match="samples: received 5 samples"):
        fit(PLAN, folder, 5)
    with pytest.raises(ValueError, match="samples, minutes: received neither"):
        build_emulator(PLAN, folder)


def test_samples_of_other_mechanics_are_kept_apart(tmp_path: Path) -> None:
    """A build that was begun before the mechanics changed does not go on as if nothing had."""
    claim(PLAN, tmp_path)
    claim(PLAN, tmp_path)
    place = tmp_path / "plan.json"
    head = json.loads(place.read_bytes())
    place.write_text(json.dumps(head | {"format": head["format"] - 1}))
    with pytest.raises(ValueError, match="or of another version"):
        claim(PLAN, tmp_path)


def test_file_gives_the_same_bytes_and_answers(emulator: Emulator, tmp_path: Path) -> None:
    places = tmp_path / "a.npz", tmp_path / "b.npz"
    for place in places:
        save_emulator(emulator, place)
    assert places[0].read_bytes() == places[1].read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]
    loaded = load_emulator(places[0])
    assert loaded.plan == emulator.plan
    assert np.array_equal(loaded.errors.pressure, emulator.errors.pressure)
    mine, theirs = (grids(e(PROBE, SLAB, INCLUSION, 2.0)) for e in (emulator, loaded))
    assert all(np.array_equal(mine[name], theirs[name]) for name in mine)


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (Path("exploded"),)  # type: ignore[return-value]


def changed(place: Path, name: str, array: np.ndarray) -> Path:
    """The file with one array replaced."""
    out = place.with_name("changed.npz")
    with zipfile.ZipFile(place) as old, zipfile.ZipFile(out, "w") as new:
        for entry in old.namelist():
            data = io.BytesIO()
            write_array(data, array, allow_pickle=True)
            new.writestr(entry, data.getvalue() if entry == f"{name}.npy" else old.read(entry))
    return out


def deflated(place: Path) -> bytearray:
    """The same archive, compressed."""
    data = io.BytesIO()
    with zipfile.ZipFile(place) as old, zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    return bytearray(data.getvalue())


def encrypted(place: Path) -> bytes:
    """All parts said to be encrypted: bit 0 of the flags in local and central headers."""
    data = deflated(place)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(signature)
        while at >= 0:
            data[at + flags] |= 1
            at = data.find(signature, at + 4)
    return bytes(data)


def undeflatable(place: Path) -> bytes:
    """The first part's compressed bytes overwritten."""
    data = deflated(place)
    start = 30 + int.from_bytes(data[26:28], "little")
    data[start : start + 6] = b"\xff" * 6
    return bytes(data)


def unclosed(place: Path) -> bytes:
    """An array of an older format, whose header is a dictionary without end."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (3L,), "
    data = io.BytesIO()
    with zipfile.ZipFile(place) as old, zipfile.ZipFile(data, "w") as new:
        for entry in old.namelist():
            array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
            new.writestr(entry, array if entry == "x.npy" else old.read(entry))
    return data.getvalue()


def test_a_strangers_file_is_not_trusted(
    emulator: Emulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "a.npz"
    save_emulator(emulator, place)
    bomb = np.array([Bomb()], dtype=object)
    wrong = [("x", bomb), ("head", bomb), ("x", emulator.x[1:]), ("x", emulator.x[::-1].copy())]
    wrong += [("pressure", np.full_like(emulator.pressure, np.nan)), ("rise.lengths", -emulator.rise.lengths)]
    wrong += [("rise.modes", emulator.rise.modes[:, 1:]), ("tared.weights", emulator.tared.weights[:, 1:])]
    wrong += [("head", np.frombuffer(b"2\n{}", np.uint8)), ("head", np.frombuffer(b"1\n{}", np.uint8))]
    wrong += [("rise.order", np.array(1.0)), ("rise.order", np.array([MATERN]))]
    wrong += [("errors.curve", np.zeros((2, 5))), ("x", emulator.x.astype(np.float32))]
    for name, array in wrong:
        with pytest.raises(NotAnEmulator) as caught:
            load_emulator(changed(place, name, array))
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "exploded").exists()
    for data in (b"", b"PK", place.read_bytes()[:-30], b"\x80\x04N."):
        (tmp_path / "bad.npz").write_bytes(data)
        with pytest.raises(NotAnEmulator):
            load_emulator(tmp_path / "bad.npz")
    for damaged in (encrypted(place), undeflatable(place), unclosed(place)):
        (tmp_path / "bad.npz").write_bytes(damaged)
        with pytest.raises(NotAnEmulator):
            load_emulator(tmp_path / "bad.npz")
    with pytest.raises(FileNotFoundError):
        load_emulator(tmp_path / "none.npz")
