"""`twin export --mitsuba`, `--stl`, `--ply`: the stock package sees our scene, other programs our meshes."""

import dataclasses
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import trimesh
from sensors import bump, paper_sensor

from twin import cli

ROOT = Path(__file__).resolve().parent.parent
PRESS = ["export", "--size", "10", "--depth", "5", "--modulus", "100", "--indentation", "2"]
QUICK = [*PRESS, "--mechanics", "linear", "--quality", "preview"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "new" / "scene"
    assert cli.main([*QUICK, "--mitsuba", str(folder)]) == 0
    assert list(folder.parent.iterdir()) == [folder]
    return folder


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_the_loaded_scene_is_ours_to_the_bit(variant, tmp_path, coupling):
    """Every parameter is equal but the normals, which Mitsuba's PLY reader scales again (one unit in the last
    place); with ours put in, stock `path` gives equal pixels for the same seed, but for rounding of a few."""
    import mitsuba as mi

    from scenes import Renderer, build, mitsuba_files, surface

    sensor = paper_sensor(coupling, columns=96, rows=64, pixel_um=(67.0, 75.0))
    shape = surface.resample(bump(), 25.0)
    renderer = Renderer(sensor, "cpu")
    ours = renderer.scene
    build.put_surface(ours, sensor, shape)
    mitsuba_files.write(sensor, renderer.packed, shape, tmp_path)
    loaded = mi.load_file(str(tmp_path / "scene.xml"), optimize=False)
    mine, theirs = mi.traverse(ours), mi.traverse(loaded)
    names = [name for name in mine.keys() if not name.startswith("camera") and "aabb" not in name]  # noqa: SIM118
    assert {"contact.vertex_contact_fraction", "led_3.emitter.radiance.value"} <= set(names)
    for name in names:
        values = (getattr(part[name], "matrix", part[name]) for part in (mine, theirs))
        one, other = (np.asarray(value, dtype=np.float64) for value in values)
        off = np.abs(one - other).max(initial=0.0)
        assert one.shape == other.shape and off <= (1.2e-7 if name == "contact.vertex_normals" else 0.0), name
    path = mi.load_dict({"type": "path", "max_depth": 256, "rr_depth": 24})
    wanted = np.asarray(mi.render(ours, integrator=path, spp=4, seed=3))
    assert wanted.shape == (64, 96, 1) and wanted.mean() > 0
    as_it_is = np.asarray(mi.render(loaded, spp=4, seed=3))
    assert as_it_is.mean() == pytest.approx(wanted.mean(), rel=1e-5)
    theirs["contact.vertex_normals"] = mine["contact.vertex_normals"]
    theirs.update()
    # one path a pixel: each scene has a kernel of its own, whose compiler may round a few of them another way
    # (5 of 6144, by up to 6e-7, the same ones every time)
    one, other = (np.asarray(mi.render(s, integrator=path, spp=1, seed=3)) for s in (ours, loaded))
    assert (one != other).mean() < 2e-3
    np.testing.assert_allclose(other, one, rtol=1e-6, atol=0)


def test_one_import_is_all_that_stock_mitsuba_needs(scene):
    """As the README.txt says, in a process of its own, from another folder, with the default options."""
    told = (scene / "README.txt").read_text()
    lines = [line.strip() for line in told.splitlines() if line.startswith("  ")]
    commands = [
        line for line in lines if line.startswith(("import mitsuba", "mi.set", "import scenes", "scene ="))
    ]
    assert len(commands) == 4
    script = "\n".join(
        [
            "import os; from scenes import llvm",
            "llvm.load_atomic(); os.environ['DRJIT_LIBLLVM_PATH'] = str(llvm.find().path)",
            f"os.chdir({str(scene)!r})",
            *commands,
            "size = scene.sensors()[0].film().size()",
            "print(*size, len(scene.shapes()) > 8, scene.integrator().class_name())",
        ]
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["768", "492", "True", "PathIntegrator"]


def test_scene_is_readable_and_whole(scene):
    """Names, not merged shapes; only files that lie beside it; a table that loads without pickle."""
    root = ElementTree.parse(scene / "scene.xml").getroot()
    ids = {element.get("id") for element in root if element.get("id")}
    assert {"contact", "guide_to_glass", "wall_+x", "led_0", "led_3", "camera"} <= ids
    named = {element.get("value") for element in root.iter("string") if element.get("name") == "filename"}
    assert named == {"contact.ply", "contact.npy"}
    assert {path.name for path in scene.iterdir()} == {*named, "scene.xml", "README.txt"}
    table = np.load(scene / "contact.npy", allow_pickle=False)
    assert table.dtype == np.float32 and table.ndim == 2
    transmitted = table[:129, :1025]
    assert transmitted.min() >= 0.0 and 0.9 < transmitted.max() <= 1.0


def test_what_the_scene_leaves_out_is_said(tmp_path):
    """The shipped white design has spectra; its scene is one wavelength, and says so."""
    folder = tmp_path / "scene"
    bare = ["export", "white", "--no-inclusion", "--mechanics", "linear", "--quality", "preview"]
    assert cli.main([*bare, "--indentation", "1", "--mitsuba", str(folder)]) == 0
    told = (folder / "README.txt").read_text()
    assert "spectra (all is at" in told and "sideways in the tissue" in told and "no inclusion" in told
    assert "paint" not in told and "absorption" not in told


@pytest.mark.parametrize("fault", ["missing", "pickled", "flat", "not shares"])
def test_a_bad_table_is_refused_in_one_line(variant, tmp_path, fault):
    import mitsuba as mi

    import scenes.plugins  # noqa: F401 (registers the BSDF)

    path = tmp_path / "table.npy"
    if fault == "pickled":
        np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    elif fault == "flat":
        np.save(path, np.zeros(9, np.float32))
    elif fault == "not shares":
        table = np.full((4, 6), np.nan, np.float32)
        table[-1, -1] = 1.0
        np.save(path, table)
    with pytest.raises(Exception, match="frustrated_tir: filename: received") as caught:
        mi.load_dict(
            {
                "type": "frustrated_tir",
                "filename": str(path),
                "contact_fraction": {"type": "uniform", "value": 0.5},
            }
        )
    assert "allowed" in str(caught.value) or "no shares" in str(caught.value)


def test_plugins_ask_for_a_variant_first():
    script = "import mitsuba as mi\nmi.set_variant('scalar_rgb')\nimport scenes.plugins"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert "ImportError: scenes.plugins: received Mitsuba's variant 'scalar_rgb'" in done.stderr


@pytest.mark.parametrize("kind", ["stl", "ply"])
def test_meshes_are_the_pressed_guide(tmp_path, kind):
    """A closed body whose volume is the surface's height integrated over the face, facing outwards."""
    folder = tmp_path / "meshes"
    assert cli.main([*QUICK, f"--{kind}", str(folder)]) == 0
    parts = {name: trimesh.load(folder / f"{name}.{kind}") for name in ("guide", "contact", "glass")}
    assert parts["guide"].is_watertight and parts["glass"].is_watertight
    assert parts["glass"].volume == pytest.approx(25.0 * 25.0 * 2.0)
    top = parts["contact"]
    assert top.face_normals[:, 2].min() > -0.01  # but for the folded rim, up
    corners = top.triangles
    flat = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    volume = np.sum(flat * (corners[:, :, 2].mean(axis=1) + 10.0))
    assert parts["guide"].volume == pytest.approx(volume, rel=1e-6)
    assert 0.97 * 6250 < volume < 6250  # pressed in
    if kind == "ply":
        fields = top.metadata["_ply_raw"]["vertex"]["data"]
        assert 0.0 < fields["contact_fraction"].max() < 1.0
        assert 0.3 < np.median(fields["pressure"]) < 3.0
        assert fields["displacement_z"].min() < -0.2
        assert np.allclose(top.vertices[:, 2], fields["displacement_z"], atol=1e-5)


def test_fraction_in_contact_is_the_lights() -> None:
    """Adhesion closes all gaps: the mesh says what the light meets, as where contact is rough."""
    from scenes import meshes, surface
    from scenes.contact import real_contact

    base = paper_sensor()
    for contact in ("rough", "full"):
        sensor = dataclasses.replace(base, skin=dataclasses.replace(base.skin, contact=contact))
        top = meshes.bodies(sensor, surface.flat(25.0, 1.0))["contact"]
        expected = float(real_contact(np.ones(1), sensor.skin, sensor.effective_modulus_kPa)[0])
        np.testing.assert_allclose(top.vertex_attributes["contact_fraction"], expected, rtol=1e-5)
    assert expected == 1.0


@pytest.mark.parametrize("flag", ["--mitsuba", "--stl", "--ply"])
def test_folders_are_replaced_only_if_they_are_ours(tmp_path, capfd, flag):
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "picture.exr").write_text("mine")
    assert cli.main([*QUICK, flag, str(folder)]) == 2
    error = capfd.readouterr().err.splitlines()
    assert len(error) == 1 and flag in error[0]
    assert (folder / "picture.exr").read_text() == "mine"
    assert cli.main([*QUICK[:-5], "1", "2", flag, str(folder)]) == 2
    assert "one depth" in capfd.readouterr().err


def test_one_kind_at_a_time(tmp_path, capfd):
    assert cli.main([*QUICK, "--stl", "a", "--ply", "b"]) == 2
    assert "one of them" in capfd.readouterr().err
    assert cli.main(QUICK) == 2
    assert "--mitsuba" in capfd.readouterr().err
