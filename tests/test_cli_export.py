"""`twin export`: files of other programs, whole or not at all."""

import os
import signal

import numpy as np
import pytest
import pyvista

from twin import cli

PRESS = ["export", "--size", "10", "--depth", "5", "--modulus", "100", "--indentation", "2"]
QUICK = [*PRESS, "--mechanics", "linear", "--quality", "preview"]


@pytest.fixture(scope="module")
def volume(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "new" / "press.vtu"
    assert cli.main([*QUICK, "--vtu", str(path)]) == 0
    assert list(path.parent.iterdir()) == [path]
    return pyvista.read(path)


def test_volume_is_the_whole_press(volume):
    """Probe and slab of the paper's sensor; glass at rest, chest wall moved by the press; stress in cells."""
    assert volume.bounds == pytest.approx((-30, 30, -30, 30, -10, 30))
    z, moved = volume.points[:, 2], volume.point_data["displacement"]
    assert np.abs(moved[np.abs(z + 10) < 1e-9]).max() < 1e-12
    assert np.allclose(moved[np.abs(z - 30) < 1e-9], [0, 0, -2], atol=1e-12)
    assert set(np.unique(volume.cell_data["material"])) == {0, 1, 2, 3, 4}
    inside = volume.cell_data["material"] == 1
    assert volume.cell_data["modulus_kPa"][inside] == pytest.approx(100)
    assert volume.cell_data["stress"][inside][:, 2].mean() < 0  # pressed


def test_an_earlier_file_is_replaced_only_by_a_whole_one(tmp_path, monkeypatch, capfd):
    path = tmp_path / "press.vtu"
    path.write_text("mine")

    def terminate(*args, **options):
        os.kill(os.getpid(), signal.SIGTERM)

    def fill_the_disk(*args, **options):
        raise OSError(28, "No space left on device")

    for accident, status in ((terminate, 130), (fill_the_disk, 1)):
        with monkeypatch.context() as patch:
            patch.setattr("fem.save_volume", accident, raising=False)
            assert cli.main([*QUICK, "--vtu", str(path)]) == status
        assert path.read_text() == "mine" and list(tmp_path.iterdir()) == [path]
        assert "nothing was written" in capfd.readouterr().err.splitlines()[-1]
    assert cli.main([*QUICK, "--vtu", str(path)]) == 0
    assert path.stat().st_size > 1e5 and list(tmp_path.iterdir()) == [path]


def test_a_folder_of_that_name_is_left_alone(tmp_path, capfd):
    (tmp_path / "a.vtu").mkdir()
    assert cli.main([*QUICK, "--vtu", str(tmp_path / "a.vtu")]) == 2
    assert "which is not a file" in capfd.readouterr().err
    (tmp_path / "b").write_text("mine")
    assert cli.main([*QUICK, "--vtu", str(tmp_path / "b" / "a.vtu")]) == 2
    assert "--vtu" in capfd.readouterr().err


def test_decks_come_in_a_folder_of_their_own(tmp_path, capfd):
    """Both decks and how to run them; written again over themselves, never over CalculiX's answers."""
    folder = tmp_path / "new" / "decks"
    for _ in range(2):
        assert cli.main([*QUICK, "--ccx", str(folder)]) == 0
        assert {path.name for path in folder.iterdir()} == {"with.inp", "without.inp", "README.txt"}
    assert "ccx -i with" in (folder / "README.txt").read_text()
    assert (folder / "with.inp").read_text() != (folder / "without.inp").read_text()
    (folder / "with.dat").write_text("mine")
    assert cli.main([*QUICK, "--ccx", str(folder)]) == 2
    assert "--ccx" in capfd.readouterr().err and (folder / "with.dat").read_text() == "mine"
