"""What counts as an earlier result, which the next run replaces: nothing that is not ours."""

import json

import pytest

from twin import estimate, export, export_optics, exporting, frame, mapping_report, plan, prescription
from twin.complaint import DesignError
from twin.stage import staged

OURS = {
    "plan": (plan.holds_plan, {"plan.json": json.dumps({"format": 1, "design_sha256": "0"})}),
    "export": (
        exporting._is_export,
        {"export.json": json.dumps({"tared_png_scale": 1.0, "plan": "0"}), "image/000001_0.png": ""},
    ),
    "table": (
        exporting._is_export,
        {
            "export.json": json.dumps({"tared_png_scale": 1.0, "plan": "0"}),
            "data/train-00000-of-00001.parquet": "",
        },
    ),
    "decks": (export._holds_decks, {"README.txt": export.README, "with.inp": ""}),
    "scene": (export_optics._is_ours("mitsuba"), {"README.txt": export_optics._MITSUBA_README}),
    "meshes": (export_optics._is_ours("stl"), {"README.txt": export_optics._MESH_README, "guide.stl": ""}),
    "estimate": (estimate.holds_estimate, {"estimate.json": json.dumps({"presence": 1, "likeness": 1})}),
    "check": (prescription.holds_checkup, {"check.json": json.dumps({"findings": [], "versions": {}})}),
    "frame": (frame.holds_frames, {"frame.json": json.dumps({"design": "a", "versions": {}})}),
    "map": (mapping_report._holds_map, {"map.json": json.dumps({"corpora": []})}),
}
OTHERS = {
    "plan": {"plan.json": json.dumps({"my": "plan"})},
    "export": {"image/thesis.txt": "mine"},
    "table": {"export.json": "[]"},
    "decks": {"README.txt": "My own words"},
    "scene": {"README.txt": "My own words"},
    "meshes": {"README.txt": export_optics._MITSUBA_README},
    "estimate": {"estimate.json": "mine"},
    "check": {"check.json": "{}"},
    "frame": {"frame.json": "[]"},
    "map": {"map.json": json.dumps({"my": "map"})},
}


def write(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


@pytest.mark.parametrize("kind", OURS)
def test_names_alone_do_not_make_a_folder_ours(kind, tmp_path):
    is_ours, files = OURS[kind]
    write(tmp_path, files)
    assert is_ours(tmp_path)
    write(tmp_path, OTHERS[kind])
    assert not is_ours(tmp_path)


def test_the_working_directory_is_not_replaced(tmp_path, monkeypatch):
    """The shell would stand in a folder that is gone; said before any work, not after."""
    monkeypatch.chdir(tmp_path)
    for name in (".", str(tmp_path)):
        with pytest.raises(DesignError, match="the working directory"), staged(name, lambda folder: True):
            raise AssertionError("work was begun")
    with staged("inside", lambda folder: True) as folder:
        (folder / "a").touch()
    assert (tmp_path / "inside" / "a").is_file()


def test_a_mounted_folder_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr("os.path.ismount", lambda place: str(place) == str(tmp_path))
    with pytest.raises(DesignError, match="mounted"), staged(tmp_path, lambda folder: True):
        raise AssertionError("work was begun")
