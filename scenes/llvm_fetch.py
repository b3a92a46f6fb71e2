"""Provide a good LLVM without root: `python -m scenes.llvm_fetch [FOLDER]`.

Does nothing where `scenes.llvm` finds a good one already. Otherwise it takes the Debian or Ubuntu package,
and those that it needs and the machine lacks, and unpacks the libraries into FOLDER (by default one in the
user's cache), where the program finds them. Nothing is installed: apt only resolves, downloads and verifies.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from scenes import llvm

PACKAGES = ("libllvm19", "libllvm20", "libllvm21", "libllvm18", "libllvm17")
"""Debian and Ubuntu packages to try, the tested version first."""

EXTRA = "libatomic1"
"""Dr.Jit's thread pool needs it; a machine without a compiler may lack it."""


class FetchError(RuntimeError):
    """No LLVM could be provided; the message is one line and says what to do."""


def provide(folder: Path) -> Path:
    """Make sure that this machine has an LLVM which Mitsuba can use.

    Parameters
    ----------
    folder : Path
        Where libraries are unpacked if need be. `scenes.llvm.own_folders()` are the ones that are searched
        later.

    Returns
    -------
    Path
        The library; a kernel has been compiled and run with it.

    Raises
    ------
    FetchError
        None is there and none can be had.
    """
    folder = folder.resolve()
    found = llvm.find()
    if not found.fault and not llvm.load_atomic():
        return found.path
    if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
        raise FetchError(
            f"no usable LLVM ({found.fault}) and no apt-get to fetch one with: install the shared library of "
            "LLVM 19 and set DRJIT_LIBLLVM_PATH to it"
        )
    with tempfile.TemporaryDirectory(prefix="tsis-llvm-") as scratch:
        unpacked = _unpack(Path(scratch))
        folder.mkdir(parents=True, exist_ok=True)
        for source in unpacked:
            part = folder / f".{source.name}.part"
            shutil.copyfile(source, part)
            part.replace(folder / source.name)
    fault = llvm.load_atomic()
    if fault:
        raise FetchError(f"{fault}: install the package {EXTRA}")
    library = next(path for path in unpacked if path.name.startswith("libLLVM"))
    fault = llvm.trial(folder / library.name)
    if fault:
        (folder / library.name).unlink()
        raise FetchError(f"the package's {library.name} fails a trial kernel ({fault}); {llvm.ADVICE}")
    return folder / library.name


def _unpack(scratch: Path) -> list[Path]:
    """Download and unpack one of PACKAGES and what it needs; the shared libraries of them all, each by its
    soname."""
    options: list[str] = []
    package, needed = _resolve(options)
    if not package:
        # No package lists, or stale ones: fetch lists into a folder of our own, which takes no root.
        for name in ("lists/partial", "cache/archives/partial"):
            (scratch / name).mkdir(parents=True)
        options = ["-o", f"Dir::State::lists={scratch}/lists", "-o", f"Dir::Cache={scratch}/cache"]
        if os.geteuid() == 0:
            options += ["-o", "APT::Sandbox::User=root"]
        _run(["apt-get", *options, "update"])
        package, needed = _resolve(options)
    if not package:
        raise FetchError(f"apt offers none of {', '.join(PACKAGES)}; {llvm.ADVICE}")
    debs = scratch / "debs"
    debs.mkdir()
    done = _run(["apt-get", *options, "download", *needed], cwd=debs)
    if done.returncode != 0:
        reason = (done.stderr.strip() or "it says nothing").splitlines()[-1]
        raise FetchError(f"apt-get could not download {' '.join(needed)}: {reason}")
    root = scratch / "root"
    for deb in debs.glob("*.deb"):
        _run(["dpkg-deb", "-x", str(deb), str(root)], check=True)
    # A soname link and its target are one library: keep it under the link's name, which is what the loader
    # asks for.
    named: dict[Path, Path] = {}
    for path in sorted(root.rglob("lib*.so*")):
        if path.is_file() and ".so." in path.name:
            target = path.resolve()
            if target not in named or path.is_symlink():
                named[target] = path
    return list(named.values())


def _resolve(options: list[str]) -> tuple[str, list[str]]:
    """First of PACKAGES that apt can give, and all packages to be had for it; ("", []) if there is none.

    `apt-get --simulate install` needs no root, and lists just what this machine lacks. What is there in
    another version ("Inst name [old] (new ...)") is left as it is: the C library of this machine is the one
    to use.
    """
    for package in PACKAGES:
        done = _run(["apt-get", *options, "--simulate", "--no-install-recommends", "install", package, EXTRA])
        if done.returncode == 0:
            lines = [line.split() for line in done.stdout.splitlines() if line.startswith("Inst ")]
            needed = [words[1] for words in lines if len(words) > 2 and not words[2].startswith("[")]
            return package, sorted({package, *needed})
    return "", []


def _run(
    command: list[str], cwd: Path | None = None, check: bool = False
) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=check)


def main() -> int:
    """Command line: prints the library; exit status 1 and one line where there is none."""
    parser = argparse.ArgumentParser(prog="python -m scenes.llvm_fetch", description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=llvm.own_folders()[-1])
    try:
        print(f"LLVM for Mitsuba: {provide(parser.parse_args().folder)}")
    except (FetchError, OSError, subprocess.CalledProcessError) as error:
        print(f"LLVM for Mitsuba: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
