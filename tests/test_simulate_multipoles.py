"""`simulate` and corpora with a sphere's multipoles in place of a mesh around it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_simulate import small

import fem
import twin
from twin import sample
from twin.cli import main
from twin.complaint import DesignError
from twin.plan import freeze

BALL = fem.Inclusion(9, 5.5, 80)


def test_the_picture_is_that_of_a_linear_press() -> None:
    """By both ways at preview quality, same light: pictures, scalars and the background."""
    frames = [
        twin.simulate(small(), BALL, 1.0, mechanics=way, quality="preview", seed=7)
        for way in ("linear", "multipoles")
    ]
    ours, theirs = frames[1], frames[0]
    assert ours.fem["mechanics"] == "linear" and ours.fem["path"] == "multipoles"
    assert ours.fem["background"] == theirs.fem["background"] == "shared"
    assert ours.fem["dof"] < theirs.fem["dof"]
    plain = [np.asarray(frame.surface["pressure_0"]) for frame in frames]
    np.testing.assert_array_equal(*plain)
    for name in ("max_mm", "total_mm3"):
        assert ours.fem["tared"][name] == pytest.approx(theirs.fem["tared"][name], rel=0.03)
    light = [
        np.asarray(frame.radiance, float) for frame in frames
    ]  # of the same paths, without a camera's noise
    assert np.abs(light[0] - light[1]).mean() < 2e-3 * light[0].mean()


def test_by_force_and_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    design = small()
    frame = twin.simulate(design, BALL, force=0.3, mechanics="multipoles", quality="preview")
    assert frame.press["force_N"] == pytest.approx(0.3)
    with pytest.raises(ValueError, match="quality: received 'reference' with multipoles"):
        twin.simulate(design, BALL, 1.0, mechanics="multipoles", quality="reference")
    with pytest.raises(fem.NotModelled, match=r"press\.tilt_deg: received .* multipoles"):
        twin.simulate(design, BALL, 1.0, mechanics="multipoles", tilt=(1.0, 0.0))
    with pytest.raises(fem.NotModelled, match=r"inclusion\.offset: received"):
        twin.simulate(design, replace(BALL, offset=(9.0, 0.0)), 1.0, mechanics="multipoles")
    out = tmp_path / "none"
    command = ["simulate", "--size", "9", "--depth", "5.5", "--modulus", "80", "--out", str(out)]
    assert main([*command, "--mechanics", "multipoles", "--offset", "9", "0"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "--offset: received (9.0, 0.0)" in said and not out.exists()


def test_a_corpus_by_multipoles(tmp_path: Path) -> None:
    plan = freeze("quick", tmp_path / "corpus", mechanics="multipoles")
    number = next(n for n in range(len(plan)) if plan.inclusion(n) is not None)
    (contact,) = sample.pressed(plan, number)
    assert (contact.facts["mechanics"], contact.facts["path"]) == ("linear", "multipoles")
    linear = freeze("quick", tmp_path / "linear", mechanics="linear")
    (meshed,) = sample.pressed(linear, number)
    for name in ("max_mm", "total_mm3"):
        assert contact.facts["tared"][name] == pytest.approx(meshed.facts["tared"][name], rel=0.05)
    with pytest.raises(DesignError, match="quality: received 'reference' with multipoles"):
        freeze("quick", tmp_path / "none", mechanics="multipoles", quality="reference")
    assert not (tmp_path / "none").exists()
