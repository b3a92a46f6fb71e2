"""The model that ships, as a user meets it: presses and light that it has not seen, and what it refuses."""

import json
import shutil
from pathlib import Path

import pytest

from twin import learned
from twin.cli import main
from twin.complaint import DesignError
from twin.estimates import NAMES
from twin.estimator_file import card_of, emulator_of, load_estimator, shares_of

TRUTH = (9.0, 5.5, 80.0)
INCLUSION = ["--size", "9", "--depth", "5.5", "--modulus", "80", "--offset", "1", "-0.5"]
LEVELS = ["--indentation", "1", "2", "2.9", "--seed", "11"]


def answer(folder: Path, *press: str) -> dict:
    """What `twin estimate` says of what `twin simulate` makes."""
    assert main(["simulate", "tsis", *press, *LEVELS, "--out", str(folder / "levels")]) == 0
    assert main(["estimate", "tsis", str(folder / "levels"), "--out", str(folder / "found")]) == 0
    return json.loads((folder / "found" / "estimate.json").read_text(encoding="utf-8"))


def check_inclusion(record: dict) -> None:
    assert record["presence"] > 0.99 and record["method"] != "network"
    parts = [record["inclusion"][name] for name in NAMES]
    for part, true in zip(parts, TRUTH, strict=True):
        assert abs(part["mean"] - true) < 3.0 * part["sd"], part
    size, depth, _ = parts
    assert size["sd"] < 0.4 and depth["sd"] < 0.4


def test_light_that_was_traced_for_the_press_alone(tmp_path):
    """By the emulator, so that it takes seconds."""
    check_inclusion(answer(tmp_path, *INCLUSION, "--mechanics", "emulator"))


def test_tissue_without_inclusion(tmp_path):
    """Which the network alone takes for one with: the light is not the model's."""
    record = answer(tmp_path, "--no-inclusion", "--mechanics", "emulator")
    assert record["presence"] < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("press", "there"), [(INCLUSION, True), (["--no-inclusion"], False)])
def test_full_solves(tmp_path, press, there):
    record = answer(tmp_path, *press)
    if there:
        check_inclusion(record)
    assert (record["presence"] > 0.5) == there


def test_a_model_of_ones_own_comes_before_one_that_ships(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "tsis" in learned.models()
    ships = learned.model_file("tsis")
    assert ships.is_absolute() and card_of(ships).is_file()
    assert learned.model_file("tsis.safetensors") == Path("tsis.safetensors")
    assert learned.model_file("models/tsis") == Path("models/tsis.safetensors")
    Path("tsis.safetensors").touch()
    assert learned.model_file("tsis") == Path("tsis.safetensors")


def test_a_lean_model_takes_what_ships_or_says_that_it_is_another(tmp_path):
    ships = learned.model_file("tsis")
    assert emulator_of("tsis") == learned.emulator_file("tsis").read_bytes()
    card = json.loads(card_of(ships).read_text(encoding="utf-8"))
    place = tmp_path / "tsis.safetensors"
    shutil.copy(ships, place)
    for shares, match in (
        (
            card["shares"] | {"emulator": "0" * 64},
            "shares.emulator: received that of tsis in another",
        ),
        (card["shares"] | {"light": "0" * 64}, "shares.light: received that of tsis in another"),
        (card["shares"] | {"name": "../tsis"}, "shares: received"),
    ):
        card_of(place).write_text(json.dumps(card | {"shares": shares}), encoding="utf-8")
        with pytest.raises(DesignError, match=match):
            load_estimator(place)
    with pytest.raises(DesignError, match="--lean: received it for a model of others"):
        shares_of(b"another emulator", load_estimator("tsis").traced)
