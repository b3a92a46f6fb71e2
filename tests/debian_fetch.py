"""Provide programs for the tests without root: `python tests/debian_fetch.py [FOLDER]`.

CalculiX (`ccx`) checks the mechanics, Chromium the reports. What is installed is taken. Where there is none,
Debian's or Ubuntu's package and the libraries that it needs and the machine lacks are downloaded and unpacked
into FOLDER/.ccx and FOLDER/.chromium (of the checkout, by default), with a script that runs it. Nothing is
installed. A failure ends in status 1: `make setup` goes on, and what needs the program is skipped by `make
test`; `make test-all` and `make bench`, whose comparisons are what it is for, stop.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Program:
    """A program of one of Debian's packages.

    Attributes
    ----------
    title : its name, for people.
    names : by which it is found on the PATH; the first is the script's and the folder's, with a dot.
    packages : the package, and plain ones of what several packages provide, so that apt needs no choice.
    place : of the program within the package.
    asked, answer : an argument that it answers at once, and a word of its answer.
    """

    title: str
    names: tuple[str, ...]
    packages: tuple[str, ...]
    place: str
    asked: str
    answer: str

    def find(self, checkout: Path = CHECKOUT) -> Path | None:
        """The installed program, or else the one unpacked into the checkout."""
        for name in self.names:
            if installed := shutil.which(name):
                return Path(installed)
        script = checkout / f".{self.names[0]}" / self.names[0]
        return script if os.access(script, os.X_OK) else None


CCX = Program(
    "CalculiX", ("ccx",), ("calculix-ccx", "libblas3", "liblapack3"), "usr/bin/ccx", "-v", "version"
)
CHROMIUM = Program(
    "Chromium",
    ("chromium", "chromium-browser", "google-chrome", "chrome", "chromium-headless-shell"),
    ("chromium",),
    "usr/lib/chromium/chromium",
    "--version",
    "chromium",
)


class FetchError(RuntimeError):
    """A program cannot be provided; the message is one line."""


def provide(program: Program, checkout: Path = CHECKOUT) -> Path:
    """Return a program that starts; raise FetchError if none can be had."""
    found = program.find(checkout)
    if found is None:
        if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
            raise FetchError(f"there is no apt-get to fetch {program.packages[0]} with")
        folder = checkout / f".{program.names[0]}"
        with tempfile.TemporaryDirectory(prefix="tsis-debian-") as scratch:
            root = _unpack(program, Path(scratch))
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(root, folder, symlinks=True)
        found = _script(program, folder)
    done = _run([str(found), program.asked])
    if program.answer not in done.stdout.lower():
        raise FetchError(
            f"{found} does not start: {(done.stderr.strip() or 'no reason given').splitlines()[-1]}"
        )
    return found


def _script(program: Program, folder: Path) -> Path:
    """Write the script that runs the unpacked program with its libraries."""
    libraries = {str(p.parent.relative_to(folder)) for p in folder.rglob("*.so*")}
    places = ":".join(f"$here/{place}" for place in sorted(libraries))
    script = folder / program.names[0]
    paths = f'LD_LIBRARY_PATH="{places}${{LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}}" ' if libraries else ""
    script.write_text(
        f'#!/bin/sh\nhere=$(cd "$(dirname "$0")" && pwd)\n{paths}exec "$here/{program.place}" "$@"\n',
        encoding="ascii",
    )
    script.chmod(0o755)
    return script


def _unpack(program: Program, scratch: Path) -> Path:
    """Download and unpack the package and what it needs; the folder with their contents."""
    options: list[str] = []
    needed = _resolve(program, options)
    debs = scratch / "debs"
    debs.mkdir()
    if not needed or not _download(options, needed, debs):
        # No package lists, or stale ones: fetch lists into a folder of our own, which takes no root.
        for name in ("lists/partial", "cache/archives/partial"):
            (scratch / name).mkdir(parents=True)
        options = ["-o", f"Dir::State::lists={scratch}/lists", "-o", f"Dir::Cache={scratch}/cache"]
        if os.geteuid() == 0:
            options += ["-o", "APT::Sandbox::User=root"]
        _run(["apt-get", *options, "update"])
        needed = _resolve(program, options)
        if not needed or not _download(options, needed, debs):
            raise FetchError(f"apt cannot give {program.packages[0]}")
    root = scratch / "root"
    for deb in sorted(debs.glob("*.deb")):
        _run(["dpkg-deb", "-x", str(deb), str(root)], check=True)
    if not (root / program.place).is_file():
        raise FetchError(f"the package {program.packages[0]} has no {program.place}")
    return root


def _resolve(program: Program, options: list[str]) -> list[str]:
    """The package and those that this machine lacks for it; empty if apt does not know it.

    `apt-get --simulate install` needs no root. What is there in another version ("Inst name [old] (new ...)")
    is left as it is.
    """
    done = _run(["apt-get", *options, "--simulate", "--no-install-recommends", "install", *program.packages])
    if done.returncode != 0:
        return []
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith("Inst ")]
    return sorted(
        {program.packages[0], *(words[1] for words in lines if len(words) > 2 and words[2][0] != "[")}
    )


def _download(options: list[str], packages: list[str], into: Path) -> bool:
    return _run(["apt-get", *options, "download", *packages], cwd=into).returncode == 0


def _run(
    command: list[str], cwd: Path | None = None, check: bool = False
) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=check, timeout=600
    )


def main() -> int:
    """Command line: prints the programs, or why there is none, and returns 1 if one is missing."""
    checkout, missing = Path(sys.argv[1]) if len(sys.argv) > 1 else CHECKOUT, 0
    for program in (CCX, CHROMIUM):
        try:
            print(f"{program.title} for the tests: {provide(program, checkout)}")
        except (FetchError, OSError, subprocess.SubprocessError) as error:
            print(f"{program.title} for the tests: none ({error})", file=sys.stderr)
            missing += 1
    return min(missing, 1)


if __name__ == "__main__":
    sys.exit(main())
