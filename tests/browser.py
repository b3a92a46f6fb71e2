"""Pages as a browser shows them: headless Chromium without network."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from debian_fetch import CHROMIUM

LAPTOP = (1366, 768)


def run(page: Path, *flags: str, at: str = "") -> tuple[str, list[str]]:
    """Open a page from its file; return what the browser prints, and what the page said on its console."""
    browser = CHROMIUM.find()
    if browser is None:
        pytest.skip("Chromium is neither installed nor in .chromium: make setup")
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={page.parent / 'browser'}",
            "--enable-logging=stderr",
            "--virtual-time-budget=4000",
            *flags,
            page.as_uri() + at,
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line or "ERR_" in line]
    return done.stdout, said


def screenshot(page: Path, out: Path, size: tuple[int, int] = LAPTOP) -> list[str]:
    """Write what a window of this size shows; return what the page said on its console."""
    said = run(page, f"--window-size={size[0]},{size[1]}", f"--screenshot={out}")[1]
    assert out.is_file(), "the browser took no picture"
    return said
