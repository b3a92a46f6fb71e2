"""What a frame leaves on disk: every file, whole or not at all, and the same bytes for the same seed."""

import gc
import hashlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista
from test_simulate import INCLUSION, small

import twin
import twin.cli
import twin.stage
from scenes.exr import read_exr, read_exr_header, read_png
from twin.frame import FILES, holds_frames, write_frames
from twin.interrupt import guarded, stop_if_asked
from twin.reporting import summarise
from twin.stage import staged, staged_file

FRAME_KEYS = {"inclusion", "press", "lens", "fem", "tsis", "design", "seed", "versions", "sha256"}
RUN = ["simulate", "--size", "10", "--depth", "5", "--modulus", "100", "--out", "out"]


@pytest.fixture
def plain_sheet(monkeypatch):
    """Draw no sheet where a test is not about it: it takes seconds."""
    monkeypatch.setattr("twin.pictures.overview", lambda frame, path: path.write_bytes(b"sheet"))


@pytest.fixture(scope="module")
def frame():
    return twin.simulate(small(), INCLUSION, 2.0, quality="preview", seed=7)


@pytest.fixture(scope="module")
def folder(frame, tmp_path_factory):
    return frame.write(tmp_path_factory.mktemp("frames") / "new" / "out")


def test_every_file_is_there_and_holds_the_frames_arrays(frame, folder):
    assert {path.name for path in folder.iterdir()} == FILES
    layers = read_exr(folder / "frame.exr")
    assert set(layers) == {"led.0", "led.1", "led.2", "led.3", "pressure", "displacement.z"}
    assert np.array_equal(layers["led.2"], frame.radiance[2])
    assert np.array_equal(layers["pressure"], frame.pressure)
    assert np.array_equal(layers["displacement.z"], frame.displacement_z)
    assert np.array_equal(read_png(folder / "image.png"), frame.image)
    assert np.array_equal(read_exr(folder / "reference.exr")["counts"], frame.reference)
    assert np.array_equal(read_png(folder / "reference.png"), np.rint(frame.reference))
    assert np.array_equal(read_png(folder / "tared.png"), np.clip(np.rint(frame.tared + 128), 0, 255))
    surface = pyvista.read(folder / "surface.vtp")
    for name in ("displacement", "pressure", "displacement_0", "pressure_0"):
        assert np.array_equal(surface.point_data[name], frame.surface.point_data[name])


def test_frame_json_has_exactly_the_promised_keys(frame, folder):
    record = json.loads((folder / "frame.json").read_text(encoding="utf-8"))
    assert set(record) == FRAME_KEYS
    lies = {"size_mm": 10, "depth_mm": 5, "modulus_kPa": 100, "offset_mm": [0, 0], "poisson": 0.49}
    assert record["inclusion"] == {**lies, "stretch": [1, 1, 1]}
    assert set(record["press"]) == {"indentation_mm", "force_N", "position_mm", "tilt_deg"}
    assert (record["press"]["position_mm"], record["press"]["tilt_deg"]) == ([0, 0], [0, 0])
    trust = {"min_pressure_kPa", "path", "background", "signal", "mechanics", "error_percent"}
    assert set(record["fem"]) == {"raw", "tared", "dof", "seconds", *trust}
    assert (record["fem"]["path"], record["fem"]["mechanics"]) == ("tied", "linear")
    assert (record["fem"]["background"], record["fem"]["signal"]) == ("shared", "smooth")
    assert set(record["fem"]["raw"]) == set(record["fem"]["tared"]) == {"max_mm", "total_mm3", "area_mm2"}
    told = {"frames", "reference_frames", "seconds", "noise_percent", "saturated_percent"}
    told |= {"bias_percent", "bias_of"}
    assert set(record["tsis"]) == {"raw", "tared", *told}
    assert (record["tsis"]["frames"], record["tsis"]["reference_frames"]) == (1, 16)
    assert set(record["tsis"]["raw"]) == set(record["tsis"]["tared"]) == {"max_dn", "total_dn", "area_px"}
    assert (record["design"], record["seed"]) == ("tsis", 7)
    assert record["tsis"]["tared"] == frame.tsis["tared"]
    assert {"python", "mitsuba", "numpy"} <= set(record["versions"])


def test_checksums_are_of_every_other_file(folder):
    record = json.loads((folder / "frame.json").read_text(encoding="utf-8"))
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}
    del found["frame.json"]
    assert record["sha256"] == found


def test_the_same_seed_writes_the_same_bytes(folder, tmp_path):
    again = twin.simulate(small(), INCLUSION, 2.0, quality="preview", seed=7).write(tmp_path / "again")
    for name in FILES - {"frame.json"}:
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name


def test_several_frames_go_into_numbered_folders_and_replace_an_earlier_result(frame, tmp_path, plain_sheet):
    out = tmp_path / "levels"
    frame.write(out)
    write_frames([frame, frame], out)
    assert sorted(path.name for path in out.iterdir()) == ["00", "01"]
    assert holds_frames(out)
    frame.write(out)
    assert {path.name for path in out.iterdir()} == FILES
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_with_anything_else_is_left_alone(frame, tmp_path, plain_sheet):
    out = frame.write(tmp_path / "out")
    (out / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(twin.DesignError, match="holds something else"):
        frame.write(out)
    assert {path: path.read_bytes() for path in out.iterdir()} == before
    assert list(tmp_path.iterdir()) == [out]


def test_no_inclusion_is_null(tmp_path):
    out = twin.simulate(small(), None, 2.0, quality="preview").write(tmp_path / "flat")
    assert json.loads((out / "frame.json").read_text(encoding="utf-8"))["inclusion"] is None


class DiskFull(OSError):
    """What the system raises where nothing more fits."""


def interrupt(*args, **options):
    raise KeyboardInterrupt


def terminate(*args, **options):
    os.kill(os.getpid(), signal.SIGTERM)


def fill_the_disk(*args, **options):
    raise DiskFull(28, "No space left on device")


@pytest.mark.parametrize(("accident", "status"), [(interrupt, 130), (terminate, 130), (fill_the_disk, 1)])
@pytest.mark.parametrize("earlier", [False, True])
def test_an_accident_leaves_nothing_new_behind(
    accident, status, earlier, frame, tmp_path, monkeypatch, capfd, plain_sheet
):
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    if earlier:
        frame.write(out)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    monkeypatch.setattr(twin.cli, "simulate", lambda *args, **options: [frame])
    monkeypatch.setattr("twin.pictures.overview", accident)  # the last file but one
    assert twin.cli.main(RUN) == status
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert list(tmp_path.iterdir()) == ([out] if earlier else [])
    error = capfd.readouterr().err.strip().splitlines()
    assert "nothing was written" in error[-1] and not any("Traceback" in line for line in error)


@pytest.mark.parametrize("delay", [0.3, 0.7, 1.1, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_heard_even_while_things_are_imported(number, delay, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "CUDA_VISIBLE_DEVICES": ""}
    arguments = [sys.executable, "-m", "twin", "demo", "--quality", "reference", "--out", "out"]
    with subprocess.Popen(
        arguments,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell ignores it for its jobs in the background, and so would what they start
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as run:
        time.sleep(delay)
        run.send_signal(number)
        out, error = run.communicate(timeout=120)
    assert run.returncode == 130, error
    assert out == ""
    assert error.splitlines()[-1].endswith("interrupted; nothing was written")
    assert "Traceback" not in error and "ignored" not in error
    assert not list(tmp_path.iterdir())


def test_an_interrupt_inside_an_import_is_raised_after_it(tmp_path, monkeypatch):
    (tmp_path / "slow_to_load.py").write_text(
        "import os, signal\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT); loaded = 'whole'\n"
        "except BaseException:\n    loaded = 'swallowed'\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    module, kept = None, signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), guarded():
            import slow_to_load as module

            time.sleep(5)
    finally:
        signal.signal(signal.SIGINT, kept)
    assert module.loaded == "whole"


def test_an_interrupt_inside_an_import_comes_once(tmp_path, monkeypatch):
    """Raised by whoever asks first, it must not come again into what cleans up."""
    (tmp_path / "slow_to_load.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "slow_to_load", raising=False)
    kept, cleaned = signal.signal(signal.SIGINT, signal.default_int_handler), False
    try:
        with pytest.raises(KeyboardInterrupt), guarded():
            import slow_to_load  # noqa: F401

            try:
                stop_if_asked()
            finally:
                time.sleep(0.3)
                cleaned = True
    finally:
        signal.signal(signal.SIGINT, kept)
    assert cleaned


def test_folders_of_killed_runs_go_with_the_next_run(frame, tmp_path, plain_sheet):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    abandoned, alive = tmp_path / f".out.{gone.pid}.part", tmp_path / f".out.{os.getppid()}.part"
    others = [alive, tmp_path / f".other.{gone.pid}.part", tmp_path / ".out.mine.part"]
    for place in (abandoned, *others):
        (place / "00").mkdir(parents=True)
    out = frame.write(tmp_path / "out")
    assert set(tmp_path.iterdir()) == {out, *others}


def test_an_earlier_result_that_a_killed_run_had_moved_aside_comes_back(frame, tmp_path, plain_sheet):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    earlier = frame.write(tmp_path / "out").rename(tmp_path / f".out.{gone.pid}.old")
    before = {path.name: path.read_bytes() for path in earlier.iterdir()}
    with pytest.raises(DiskFull), staged(tmp_path / "out", holds_frames):
        fill_the_disk()
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def write_staged(place):
    with staged(place, lambda folder: True) as folder:
        (folder / "new").write_text("whole")


def write_staged_file(place):
    with staged_file(f"{place}.txt", "out", ".txt") as path:
        path.write_text("whole")


@pytest.mark.parametrize(
    ("write", "earlier"), [(write_staged, False), (write_staged, True), (write_staged_file, False)]
)
def test_an_interrupt_between_any_two_lines_leaves_all_or_nothing(write, earlier, tmp_path):
    """Raises at the first line that `twin.stage` runs, then at the second, and so on to its last."""
    countdown = 0

    def trace(code_frame, event, argument):
        nonlocal countdown
        if code_frame.f_code.co_filename != twin.stage.__file__:
            return None
        if event == "line":
            countdown -= 1
            if countdown == 0:
                raise KeyboardInterrupt
        return trace

    raised = 0
    gc.collect()
    gc.freeze()  # then only what is new is looked at below
    for line in itertools.count(1):
        place = tmp_path / str(line) / "above" / "out"
        if earlier:
            place.mkdir(parents=True)
            (place / "old").write_text("whole")
        else:
            place.parent.parent.mkdir()
        countdown = line
        kept = sys.gettrace()
        sys.settrace(trace)
        try:
            write(place)
        except KeyboardInterrupt:
            raised += 1
        finally:
            sys.settrace(kept)
        gc.collect()  # a generator that was never entered ends here
        if countdown > 0:  # no line was left to raise at
            gc.unfreeze()
            break
        found = {path.name: path.read_text() for path in place.parent.parent.rglob("*") if path.is_file()}
        whole = [{"old": "whole"}] if earlier else [{}]
        assert found in [*whole, {"new": "whole"}, {"out.txt": "whole"}], line
        folders = {path.name for path in place.parent.parent.rglob("*") if path.is_dir()}
        assert folders <= {"above", "out"} if found else not folders, line
    assert raised > 15


def test_headers_name_the_units(folder):
    units = read_exr_header(folder / "frame.exr")
    assert units["unit.led.3"] == "W m-2 sr-1"
    assert (units["unit.pressure"], units["unit.displacement.z"]) == ("kPa", "mm")
    assert read_exr_header(folder / "reference.exr")["unit.counts"] == "DN"


@pytest.mark.parametrize(
    ("change", "words"),
    [({}, None), ({"saturated_percent": 3.25}, "saturated: 3.2 %"), ({"dark": True}, "no light reaches")],
)
def test_the_last_lines_warn_of_useless_pictures(change, words, frame, tmp_path, capfd):
    radiance = np.zeros_like(frame.radiance) if change.pop("dark", False) else frame.radiance
    summarise([replace(frame, tsis={**frame.tsis, **change}, radiance=radiance)], tmp_path)
    printed = capfd.readouterr().out
    assert words in printed if words else "saturated" not in printed and "dark" not in printed


def test_the_command_line_writes_what_python_returns(frame, tmp_path, monkeypatch, capfd, plain_sheet):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(twin.cli, "simulate", lambda *args, **options: [frame, frame])
    assert twin.cli.main([*RUN, "--indentation", "1", "2"]) == 0
    assert {path.name for path in (tmp_path / "out" / "01").iterdir()} == FILES
    printed = capfd.readouterr().out
    assert "10 mm wide" in printed and "linear, closed contact" in printed and "estimated error" in printed
    assert "tared" in printed and "overview.png" in printed
