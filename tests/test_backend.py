"""Mitsuba runs on a good LLVM or says in one line what to install; a bad one never gets to abort the process.

Each case is a process of its own, because a bad LLVM takes the process with it. `TWIN_LLVM_DIRS` stands in
for "the library path of this machine": the program looks there and nowhere else.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from scenes import backend, llvm, llvm_fetch

ROOT = Path(__file__).resolve().parent.parent

# Runs a kernel of the kind that LLVM 15 cannot compile ("Cannot select: fmaximum").
PROGRAM = """
import sys
from scenes.backend import BackendError, use
try:
    variant = use(sys.argv[1])
except BackendError as error:
    print(error, file=sys.stderr)
    sys.exit(2)
import drjit, mitsuba, os
total = drjit.sum(drjit.maximum(drjit.arange(mitsuba.Float, 16), 3))[0]
print(variant, total, os.path.realpath(os.environ["DRJIT_LIBLLVM_PATH"]))
"""

# Bad libraries, called as Debian calls them. Those that this machine has are used besides.
STUBS = ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVM.so.15.0", "libLLVM.so")
REAL = sorted({path.resolve() for path in Path("/usr/lib").glob("*-linux-gnu/libLLVM-1[456].so.1")})
BAD = [*STUBS, *REAL]


def run(
    device: str, folder: Path, program: str = PROGRAM, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run a program where only the libraries of `folder` can be found."""
    clean = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
    surroundings = {
        "TWIN_LLVM_DIRS": str(folder),
        "LD_LIBRARY_PATH": str(folder),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))),
    }
    return subprocess.run(
        [sys.executable, "-c", program, device],
        env=clean | surroundings | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )


def place(bad: str | Path, folder: Path) -> Path:
    """Put a bad library into `folder`: a link to a real one, or a file that only has its name."""
    if isinstance(bad, Path):
        link = folder / f"{bad.name.split('.so')[0]}.so.1"
        link.symlink_to(bad)
        return link
    (folder / bad).write_bytes(b"\x7fELF, but no library")
    return folder / bad


@pytest.fixture(scope="module")
def good() -> Path:
    """The LLVM that the set-up provided."""
    found = llvm.find()
    assert not found.fault, f"the set-up must provide an LLVM: {found.fault}"
    return found.path


@pytest.mark.parametrize(
    ("bad", "named"),
    [*((bad, False) for bad in BAD), ("libLLVM-15.so.1", True), *((bad, True) for bad in REAL[-1:])],
    ids=lambda value: {False: "found", True: "named"}.get(value) or getattr(value, "name", value),
)
def test_bad_llvm_alone_is_refused_in_one_line(bad: str | Path, named: bool, tmp_path: Path) -> None:
    library = place(bad, tmp_path)
    done = run("cpu", tmp_path, **({"DRJIT_LIBLLVM_PATH": str(library)} if named else {}))
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert library.name in done.stderr or library.resolve().name in done.stderr
    assert "libllvm19" in done.stderr and "scenes.llvm_fetch" in done.stderr


def test_no_llvm_at_all_is_refused_in_one_line(tmp_path: Path) -> None:
    done = run("cpu", tmp_path)
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert "found none" in done.stderr and "libllvm19" in done.stderr


@pytest.mark.parametrize("named", [False, True], ids=["found", "named"])
def test_good_llvm_is_picked_among_bad_ones(good: Path, named: bool, tmp_path: Path) -> None:
    """Whatever else is there, and even when DRJIT_LIBLLVM_PATH names a bad one."""
    bad = [place(one, tmp_path) for one in STUBS]
    (tmp_path / good.name).symlink_to(good)
    done = run("cpu", tmp_path, **({"DRJIT_LIBLLVM_PATH": str(bad[1])} if named else {}))
    assert done.returncode == 0, done.stderr
    variant, total, path = done.stdout.split()
    assert variant == "llvm_ad_mono"
    assert float(total) == sum(max(i, 3) for i in range(16))
    assert Path(path) == good.resolve()


def test_the_set_up_proved_its_llvm(good: Path) -> None:
    """The trial kernel that untested versions have to pass is one that a good LLVM passes."""
    assert llvm.trial(good) == ""


@pytest.mark.parametrize("bad", [path for path in REAL if "-14" not in path.name], ids=lambda path: path.name)
def test_trial_survives_a_library_that_aborts(bad: Path) -> None:
    """Why versions are judged before they are loaded: this very kernel kills the process that compiles it."""
    assert llvm.trial(bad) != ""


def test_trial_runs_nothing_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ctypes.py").write_text("open('ran', 'w').close()\n")
    monkeypatch.chdir(tmp_path)
    assert llvm.trial(tmp_path / "libLLVM.so") != ""
    assert not (tmp_path / "ran").exists()


def test_untested_version_is_tried_once(tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A newer LLVM has to compile a kernel first, and the verdict is remembered."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tried: list[Path] = []
    monkeypatch.setattr(llvm, "trial", lambda path: tried.append(path) or "it died")
    newer = tmp_path / "libLLVM.so.23.1"
    newer.write_bytes(good.read_bytes()[:1000])
    for _ in range(2):
        assert llvm.judge(newer).fault == "failed a trial kernel"
    assert tried == [newer]


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM-15.so.1", 15),
        ("libLLVM-19.so", 19),
        ("libLLVM.so.19.1", 19),
        ("libLLVM.so.20.1", 20),
        ("libLLVM.so", None),
    ],
)
def test_version_is_in_the_name(name: str, version: int | None, tmp_path: Path) -> None:
    assert llvm.version_of(tmp_path / name) == version


def test_unknown_device_is_refused(tmp_path: Path) -> None:
    done = run("tpu", tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip() == "device: received 'tpu'; allowed: 'auto', 'cpu', 'cuda'"


@pytest.mark.skipif(backend._cuda_fault() == "", reason="this machine has a CUDA GPU")
def test_cuda_without_a_gpu_is_refused_and_auto_takes_the_cpu(good: Path, tmp_path: Path) -> None:
    done = run("cuda", tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and "received 'cuda'" in done.stderr
    done = run("auto", good.parent)
    assert done.returncode == 0 and done.stdout.startswith("llvm_ad_mono"), done.stderr


@pytest.mark.skipif(backend._cuda_fault() != "", reason="this machine has no CUDA GPU")
def test_cuda_gpu_is_used_unless_the_cpu_is_asked_for(good: Path) -> None:
    assert run("auto", good.parent).stdout.startswith("cuda_ad_mono")
    assert run("cpu", good.parent).stdout.startswith("llvm_ad_mono")


def test_gpu_that_fails_leaves_the_cpu_usable(good: Path, tmp_path: Path) -> None:
    """Trying a CUDA variant starts Dr.Jit's LLVM as well: it has to be the good one by then."""
    for one in STUBS:
        place(one, tmp_path)
    (tmp_path / good.name).symlink_to(good)
    pretend = "from scenes import backend\nbackend._cuda_fault = lambda: ''\n"
    done = run("auto", tmp_path, program=pretend + PROGRAM)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[0] in backend.VARIANTS.values() and done.stdout.split()[1] == "126.0"


def test_choice_is_made_once(variant: str) -> None:
    assert backend.use() == backend.use("cpu") == variant == "llvm_ad_mono"
    with pytest.raises(backend.BackendError, match="already runs Mitsuba's llvm_ad_mono"):
        backend.use("cuda")


def test_threads_are_counted_from_one(variant: str) -> None:
    import drjit

    before = drjit.thread_count()
    backend.threads(1)
    assert drjit.thread_count() == 1
    backend.threads(before)
    with pytest.raises(backend.BackendError, match="threads: received 0"):
        backend.threads(0)


def test_fetch_without_apt_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TWIN_LLVM_DIRS", str(tmp_path))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(llvm_fetch.FetchError, match="LLVM 19") as caught:
        llvm_fetch.provide(tmp_path / "llvm")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "llvm").exists()


def test_command_line_refuses_a_bad_llvm(tmp_path: Path) -> None:
    """What a user sees: exit status 2, one line with what to install, and no half-made folder."""
    place("libLLVM-15.so.1", tmp_path)
    words = ["simulate", "tsis", "--size", "10", "--depth", "5", "--modulus", "100", "--device", "cpu"]
    done = subprocess.run(
        [sys.executable, "-m", "twin", *words, "--out", str(tmp_path / "out")],
        env={key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
        | {"TWIN_LLVM_DIRS": str(tmp_path)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert "libllvm19" in done.stderr and "libLLVM-15.so.1 would abort the process" in done.stderr
    assert not (tmp_path / "out").exists()
