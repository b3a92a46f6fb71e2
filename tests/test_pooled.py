"""Work in processes: all of it is done, and nothing of it outlives who asked for it."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from twin.pooled import each


def write(place: Path) -> None:
    place.write_text(str(os.getpid()))


def wait(place: Path) -> None:
    place.write_text(str(os.getpid()))
    time.sleep(600.0)


def fail(place: Path) -> None:
    raise ValueError(place.name)


def die(place: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def nothing() -> None:
    pass


def waiting(folder: Path) -> None:
    # A shell without job control starts what runs behind it with SIGINT ignored, and so do its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    each(wait, [folder / str(n) for n in range(6)], 1, nothing, lambda count: None)


def gone(pid: int) -> bool:
    for _ in range(200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        if "Z" in Path(f"/proc/{pid}/stat").read_text().split(")")[1][:3]:
            return True
        time.sleep(0.1)
    return False


def test_every_task_is_done(tmp_path: Path) -> None:
    places, told = [tmp_path / str(n) for n in range(5)], []
    each(write, places, 2, nothing, told.append)
    assert all(place.exists() for place in places) and told == [1, 2, 3, 4, 5]


def test_what_goes_wrong_is_raised(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bad"):
        each(fail, [tmp_path / "bad"], 1, nothing, lambda count: None)


def test_a_process_that_is_killed_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ChildProcessError, match="ended from outside"):
        each(die, [tmp_path / "a"], 1, nothing, lambda count: None)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_nothing_outlives_who_asked(tmp_path: Path, how: signal.Signals) -> None:
    """After Ctrl-C at once, after kill -9 within seconds."""
    asking = multiprocessing.get_context("spawn").Process(target=waiting, args=(tmp_path,))
    asking.start()
    until = time.monotonic() + 60.0
    while not (tmp_path / "0").exists() or not (tmp_path / "0").read_text():
        assert time.monotonic() < until
        time.sleep(0.05)
    os.kill(asking.pid or 0, how)
    asking.join(30)
    assert asking.exitcode is not None
    assert gone(int((tmp_path / "0").read_text()))
    assert not (tmp_path / "1").exists()


COMMAND = """
import sys
from twin import __main__, cli, pooled

def begin():
    pass

def fake():
    pooled.each(print, ["worked"], 1, begin, lambda count: None)
    return 0

if __name__ == "__main__":
    cli.main = fake
    sys.exit(__main__.main())
"""


def test_processes_run_nothing_of_the_current_folder(tmp_path: Path) -> None:
    """The command lies elsewhere, as the installed one does; its current folder has a file like a module."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "twin_command.py").write_text(COMMAND)
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "pickle.py").write_text("open('ran', 'w').close()\nraise SystemExit(3)\n")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    root = str(Path(__file__).resolve().parent.parent)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "bin" / "twin_command.py")],
        cwd=tmp_path / "strange",
        env=environment | {"PYTHONPATH": root},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0 and "worked" in done.stdout, done.stderr
    assert not (tmp_path / "strange" / "ran").exists()
