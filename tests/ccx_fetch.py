"""Provide CalculiX for the tests without root: `python tests/ccx_fetch.py [FOLDER]`.

Takes the `ccx` that is installed. Where there is none, Debian's or Ubuntu's package and the libraries that it
needs and the machine lacks are downloaded and unpacked into FOLDER (`.ccx` beside the tests), with a script
`ccx` that runs it. Nothing is installed, and a failure only means that those tests are skipped: the exit
status is 0 in any case.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / ".ccx"
PACKAGE = "calculix-ccx"
PROVIDERS = ("libblas3", "liblapack3")
"""Plain ones of what several packages provide, so that apt needs no choice."""


class FetchError(RuntimeError):
    """CalculiX cannot be provided; the message is one line."""


def find(folder: Path = FOLDER) -> Path | None:
    """The installed program, or else the one unpacked into the folder."""
    installed = shutil.which("ccx")
    if installed:
        return Path(installed)
    return folder / "ccx" if os.access(folder / "ccx", os.X_OK) else None


def provide(folder: Path = FOLDER) -> Path:
    """Return a `ccx` that starts; raise FetchError if none can be had."""
    found = find(folder)
    if found is None:
        if not (shutil.which("apt-get") and shutil.which("dpkg-deb")):
            raise FetchError(f"there is no apt-get to fetch {PACKAGE} with")
        with tempfile.TemporaryDirectory(prefix="tsis-ccx-") as scratch:
            root = _unpack(Path(scratch))
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(root, folder, symlinks=True)
        found = _script(folder)
    done = _run([str(found), "-v"])
    if "version" not in done.stdout.lower():
        raise FetchError(
            f"{found} does not start: {(done.stderr.strip() or 'no reason given').splitlines()[-1]}"
        )
    return found


def _script(folder: Path) -> Path:
    """Write the script that runs the unpacked program with its libraries."""
    libraries = {str(p.parent.relative_to(folder)) for p in folder.rglob("*.so*")}
    places = ":".join(f"$here/{place}" for place in sorted(libraries))
    script = folder / "ccx"
    paths = f'LD_LIBRARY_PATH="{places}${{LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}}" ' if libraries else ""
    script.write_text(
        f'#!/bin/sh\nhere=$(cd "$(dirname "$0")" && pwd)\n{paths}exec "$here/usr/bin/ccx" "$@"\n',
        encoding="ascii",
    )
    script.chmod(0o755)
    return script


def _unpack(scratch: Path) -> Path:
    """Download and unpack the package and what it needs; the folder with their contents."""
    options: list[str] = []
    needed = _resolve(options)
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
        needed = _resolve(options)
        if not needed or not _download(options, needed, debs):
            raise FetchError(f"apt cannot give {PACKAGE}")
    root = scratch / "root"
    for deb in sorted(debs.glob("*.deb")):
        _run(["dpkg-deb", "-x", str(deb), str(root)], check=True)
    if not (root / "usr/bin/ccx").is_file():
        raise FetchError(f"the package {PACKAGE} has no usr/bin/ccx")
    return root


def _resolve(options: list[str]) -> list[str]:
    """The package and those that this machine lacks for it; empty if apt does not know it.

    `apt-get --simulate install` needs no root. What is there in another version ("Inst name [old] (new ...)")
    is left as it is.
    """
    done = _run(
        ["apt-get", *options, "--simulate", "--no-install-recommends", "install", PACKAGE, *PROVIDERS]
    )
    if done.returncode != 0:
        return []
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith("Inst ")]
    return sorted({PACKAGE, *(words[1] for words in lines if len(words) > 2 and words[2][0] != "[")})


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
    """Command line: prints the program, or why there is none."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    try:
        print(f"CalculiX for the tests: {provide(folder)}")
    except (FetchError, OSError, subprocess.SubprocessError) as error:
        print(f"CalculiX for the tests: none, so that they are skipped ({error})", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
