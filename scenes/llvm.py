"""Find an LLVM library that Dr.Jit can live with.

Mitsuba's CPU backend compiles its kernels with whatever `libLLVM` the machine has, and that is a gamble: LLVM
14 and older are rejected, 15 and 16 abort the whole process ("Cannot select: fmaximum"), 19 works. So the
library is judged here, before Mitsuba is imported: by its version where that is known, and otherwise by
compiling a small kernel in a process of its own, whose verdict is remembered.

Nothing is imported but the standard library, and nothing is downloaded: `scenes.llvm_fetch` does that.
"""

from __future__ import annotations

import ctypes
import glob
import importlib.metadata
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

TESTED = 19
"""Major version that the tests run on: taken at its word."""

OLDEST = 17
"""Oldest major version worth a try; 15 and 16 abort the process, older ones are rejected by Dr.Jit."""

ADVICE = (
    "install LLVM 19, for example with `sudo apt-get install libllvm19 libatomic1`, or without root with "
    "`python -m scenes.llvm_fetch`"
)

_PROBE = """
import drjit as dr
from drjit.llvm.ad import Float, UInt32
x = dr.linspace(Float, -1, 1, 1000)
dr.enable_grad(x)
y = dr.maximum(x, 0.25) + dr.minimum(x, 0.5) + dr.fma(x, x, 1) + dr.exp(dr.abs(x)) + dr.sqrt(dr.square(x) + 1)
start = UInt32(0), dr.detach(y)
n, total = dr.while_loop(start, lambda n, t: n < 5, lambda n, t: (n + 1, dr.maximum(t / 2, 0.1)))
bins = dr.zeros(Float, 10)
dr.scatter_reduce(dr.ReduceOp.Add, bins, total, dr.arange(UInt32, 1000) % 10)
dr.backward(dr.sum(y))
assert dr.width(dr.grad(x)) == 1000 and dr.width(bins) == 10 and dr.all(bins > 0)
assert dr.sum(dr.maximum(Float(1, 2, 4), 3))[0] == 10
print("usable")
"""


@dataclass(frozen=True)
class Library:
    """One `libLLVM` on this machine and the verdict on it."""

    path: Path
    version: int | None
    """Major version, None where neither name nor library tells."""
    fault: str
    """Why it cannot be used; empty where it can."""


def find() -> Library:
    """Best LLVM library of this machine.

    Returns
    -------
    Library
        One with an empty `fault`, or else the verdicts on all that were looked at, joined in the `fault` of a
        library at the path `""`.
    """
    rejected: list[Library] = []
    for path in sorted(set(_candidates()), key=_preference):
        library = judge(path)
        if not library.fault:
            return library
        rejected.append(library)
    seen = dict.fromkeys(f"{lib.path.name} {lib.fault}" for lib in rejected)
    return Library(Path(), None, "; ".join(seen) or "found none")


def judge(path: Path) -> Library:
    """Verdict on one library file: loads it, and tries it in a process of its own where its version is
    untested."""
    version = version_of(path)
    if version is not None and version < 15:
        return Library(path, version, "is too old")
    if version is not None and version < OLDEST:
        return Library(path, version, "would abort the process")
    if version != TESTED and not _probed(path):
        return Library(path, version, "failed a trial kernel")
    fault = load(path)
    return Library(path, version, f"does not load ({fault})" if fault else "")


def version_of(path: Path) -> int | None:
    """Major version of an LLVM library, from the name of the file behind `path`; None where that does not
    tell.

    The name is enough and costs nothing: `libLLVM-15.so.1`, `libLLVM-14.0.6.so.1` and `libLLVM.so.19.1` are
    what LLVM's own build calls them. Loading an LLVM to ask it would leave two of them in one process.
    """
    for name in (path.resolve().name, path.name):
        match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", name)
        if match:
            return int(match[1])
    return None


def load(path: Path) -> str:
    """Load a library into this process, and the libraries it needs that lie beside it (see
    `scenes.llvm_fetch`).

    Returns
    -------
    str
        What the loader said against it; empty when it is loaded.
    """
    beside = [] if path.parent not in own_folders() else [p for p in path.parent.glob("*.so.*") if p != path]
    fault = _load_one(path)
    while fault and beside:
        # Loaded libraries satisfy later ones by soname: go round until a round loads nothing new.
        left = [p for p in beside if _load_one(p)]
        if len(left) == len(beside):
            break
        beside = left
        fault = _load_one(path)
    return fault


def load_atomic() -> str:
    """Make `libatomic.so.1` present: Dr.Jit's thread pool needs it and a machine without a compiler may lack
    it.

    Returns
    -------
    str
        What the loader said against it; empty when it is loaded.
    """
    fault = _load_one(Path("libatomic.so.1"))
    for folder in own_folders():
        if fault and (folder / "libatomic.so.1").exists():
            fault = _load_one(folder / "libatomic.so.1")
    return fault


def own_folders() -> list[Path]:
    """Folders that `scenes.llvm_fetch` fills: `.llvm` of a source tree, and one in the user's cache."""
    return [Path(__file__).resolve().parent.parent / ".llvm", cache_folder() / "llvm"]


def cache_folder() -> Path:
    """Where this program keeps what it can make again."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "tsis-twin"


def _candidates() -> Iterator[Path]:
    """Every file that may be an LLVM library. `TWIN_LLVM_DIRS` (folders, joined by ':') replaces the usual
    places."""
    if named := os.environ.get("DRJIT_LIBLLVM_PATH"):
        yield Path(named)
    if only := os.environ.get("TWIN_LLVM_DIRS"):
        folders = only.split(":")
    else:
        folders = [str(folder) for folder in own_folders()]
        folders += [folder for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":") if folder]
        folders += [f"{sys.prefix}/lib", "/usr/lib/*-linux-gnu", "/usr/lib/llvm-*/lib", "/usr/lib64"]
        folders += ["/usr/lib", "/usr/local/lib", "/usr/lib64/llvm*/lib*", "/opt/homebrew/opt/llvm*/lib"]
    for folder in folders:
        for name in glob.glob(f"{folder}/libLLVM*"):
            if re.search(r"\.so(\.[\d.]+)?$|\.dylib$", name) and os.path.isfile(name):
                yield Path(os.path.realpath(name))


def _preference(path: Path) -> tuple[bool, int, str]:
    """Sort key: the tested version first, then newer before older, then by name."""
    version = version_of(path)
    return version != TESTED, -(version or 0), str(path)


def _load_one(path: Path) -> str:
    try:
        ctypes.CDLL(str(path))
    except OSError as error:
        return str(error).splitlines()[0]
    return ""


def _probed(path: Path) -> bool:
    """Whether a small kernel compiles and runs with this library; remembered for each file and Dr.Jit
    version."""
    try:
        stat = path.stat()
        key = f"{path} {stat.st_size} {stat.st_mtime_ns} drjit {importlib.metadata.version('drjit')}"
    except (OSError, importlib.metadata.PackageNotFoundError):
        return False
    memory = cache_folder() / "llvm-verdicts.json"
    try:
        verdicts: dict[str, bool] = json.loads(memory.read_text())
    except (OSError, ValueError):
        verdicts = {}
    if key not in verdicts:
        verdicts[key] = not trial(path)
        try:
            memory.parent.mkdir(parents=True, exist_ok=True)
            scratch = memory.with_suffix(f".{os.getpid()}")
            scratch.write_text(json.dumps(verdicts, indent=1))
            scratch.replace(memory)
        except OSError:
            pass  # A home that cannot be written to costs a trial each time, no more.
    return verdicts[key]


def trial(path: Path) -> str:
    """Compile and run a small kernel with this library in a process of its own, which may die of it.

    Returns
    -------
    str
        How that ended; empty when all went well.
    """
    code = f"import runpy\nllvm = runpy.run_path({__file__!r})\nllvm['load_atomic']()\n"
    code += f"fault = llvm['load'](llvm['Path']({str(path)!r}))\nassert not fault, fault\n{_PROBE}"
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(path)}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", code],  # -P: whatever the current folder holds
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0 and done.stdout.strip() == "usable":
        return ""
    return (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]
