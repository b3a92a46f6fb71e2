"""What all tests share."""

import os
from pathlib import Path

import pytest

# Pictures are drawn without a display, and the sums of a test do not depend on how many cores a machine has.
os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("OMP_NUM_THREADS", "1")

if os.environ.get("TWIN_DEVICE") == "cuda":  # what tests ask of the CPU is computed on the GPU
    from scenes import backend

    backend.VARIANTS["cpu"], settle = backend.VARIANTS["cuda"], backend._settle
    backend._settle = lambda device, variants: settle("cuda", variants)


def pytest_addoption(parser: pytest.Parser) -> None:
    what = "write what tests/test_standard_quality.py measures to assets/light_bias.json"
    parser.addoption("--write-bias", action="store_true", help=what)


@pytest.fixture(scope="session")
def variant() -> str:
    """Mitsuba on the CPU, which every machine has: ask for this fixture before importing mitsuba or drjit."""
    from scenes.backend import use

    return use("cpu")


@pytest.fixture(scope="session")
def finished_corpus(variant: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small corpus that is whole; tests that change something copy it."""
    from corpora import finish_tiny

    return finish_tiny(tmp_path_factory.mktemp("finished"))
