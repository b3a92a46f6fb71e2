"""The overview sheet, from a made-up frame: shapes like the real ones, values from closed forms."""

import itertools
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
import pyvista as pv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.text import Text
from PIL import Image

from twin import cutaway
from twin.panels import draw_tared
from twin.pictures import DPI, HEIGHT_PX, STYLE, WIDTH_PX, draw_sheet, overview

ROWS, COLUMNS = 492, 768


def grid(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) of a rectangular grid and the corners (m, 4) of its cells."""
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange(len(points)).reshape(len(x), len(y))
    corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
    return points, np.stack([c.ravel() for c in corners], axis=1)


def mesh(points: np.ndarray, quads: np.ndarray) -> pv.PolyData:
    return pv.PolyData(points, faces=np.insert(quads, 0, 4, axis=1).ravel())


def make_design() -> SimpleNamespace:
    layers = [
        SimpleNamespace(thickness_mm=t, modulus_kPa=e) for t, e in ((2.0, 27.0), (3.0, 61.0), (5.0, 156.0))
    ]
    led = {"along_mm": 0.0, "z_mm": -5.0, "diameter_mm": 1.5, "coupling": "air", "gap_mm": 0.5}
    return SimpleNamespace(
        name="tsis",
        waveguide=SimpleNamespace(width_mm=25.0, layers=layers),
        glass=SimpleNamespace(thickness_mm=2.0),
        leds=[SimpleNamespace(side=side, **led) for side in ("+x", "-x", "+y", "-y")],
        camera=SimpleNamespace(
            field_of_view_mm=25.0,
            field_height_mm=18.69,
            distance_mm=40.0,
            exposure_ms=6.0,
            bits=8,
            rows=ROWS,
            columns=COLUMNS,
        ),
        specimen=SimpleNamespace(thickness_mm=30.0, width_mm=60.0, modulus_kPa=5.0),
        signal=SimpleNamespace(displacement_um=2.0, counts=10.0),
    )


def make_surface(size: float) -> pv.PolyData:
    x = 12.5 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 65))
    points, quads = grid(x, x)
    r2 = (points**2).sum(axis=1)
    bump = np.exp(-r2 / (2 * 5.0**2)) * (size > 0)
    rim = 1 / np.sqrt(np.maximum(1 - (np.abs(points).max(axis=1) / 12.9) ** 2, 1e-3))
    found = mesh(np.insert(points, 2, 0.0, axis=1), quads)
    pressure_0 = 0.8 * rim
    displacement_0 = np.zeros((len(points), 3))
    displacement_0[:, 2] = -0.025 * rim
    displacement = displacement_0.copy()
    displacement[:, 2] -= 0.018 * bump
    found.point_data.update(
        {
            "pressure": pressure_0 * (1 + 0.4 * bump),
            "pressure_0": pressure_0,
            "displacement": displacement,
            "displacement_0": displacement_0,
        }
    )
    return found


def make_cut(size: float, depth: float, press: float) -> pv.PolyData:
    probe, probe_quads = grid(np.linspace(-12.5, 12.5, 33), np.array([-10, -7.5, -5, -3.5, -2, -1, 0.0]))
    slab, slab_quads = grid(np.linspace(-30, 30, 81), np.linspace(0, 30, 41))
    points = np.concatenate([probe, slab])
    quads = np.concatenate([probe_quads, slab_quads + len(probe)])
    x, z = points[quads].mean(axis=1).T
    material = np.where(z > 0, 0, np.where(z > -2, 2, np.where(z > -5, 3, 4)))
    if size > 0:
        material[np.hypot(x, z - depth - size / 2) < size / 2] = 1
    moved = np.zeros((len(points), 3))
    s = np.clip(points[:, 1] / 30, 0, 1)
    under = 1 / (1 + np.exp((np.abs(points[:, 0]) - 13) / 1.5)) ** (1 - s)
    moved[:, 2] = np.where(points[:, 1] > 0, -press * (1 - (1 - s) * under), 0)
    moved[:, 0] = np.where(points[:, 1] > 0, press * points[:, 0] / 30 * 4 * s * (1 - s), 0)
    found = mesh(np.insert(points, 1, 0.0, axis=1), quads)
    found.point_data["displacement"] = moved
    found.point_data["displacement_0"] = moved
    found.cell_data["material"] = material
    return found


def make_frame(
    size: float = 10.0, depth: float = 5.0, modulus: float = 100.0, seed: int = 0
) -> SimpleNamespace:
    """A frame as `twin.simulate` returns it; size 0 is no inclusion."""
    rng = np.random.Generator(np.random.Philox(seed))
    y, x = np.meshgrid(np.linspace(9.345, -9.345, ROWS), np.linspace(-12.5, 12.5, COLUMNS), indexing="ij")
    blob = np.exp(-(x**2 + y**2) / (2 * 5.0**2)) * (size > 0)
    light = 0.6 * (1 + 0.5 * ((x / 12.5) ** 2 + (y / 12.5) ** 2))
    radiance = np.stack([0.25 * light * (1 + 0.3 * s * x / 12.5) * (1 + 0.35 * blob) for s in (1, -1, 0, 0)])
    noise = rng.normal(0, 1.0, (2, ROWS, COLUMNS))
    image = np.clip(np.rint(radiance.sum(axis=0) * 120 + noise[0]), 0, 255).astype(np.uint8)
    tared = (0.35 * blob * light * 120 + noise[1]).astype(np.float32)
    return SimpleNamespace(
        design=make_design(),
        inclusion=SimpleNamespace(
            size=size, depth=depth, modulus=modulus, offset=(0.0, 0.0), stretch=(1.0, 1.0, 1.0)
        )
        if size
        else None,
        press={
            "indentation_mm": 2.0,
            "force_N": 0.5617,
            "position_mm": [0.0, 0.0],
            "tilt_deg": [0.0, 0.0],
        },
        seed=seed,
        image=image,
        tared=tared,
        radiance=radiance.astype(np.float32),
        surface=make_surface(size),
        cut=make_cut(size, depth, 2.0),
        fem={
            "raw": {"max_mm": 0.0431, "total_mm3": 15.81, "area_mm2": 625.0},
            "tared": {"max_mm": 0.018, "total_mm3": 2.6731, "area_mm2": 214.7},
            "min_pressure_kPa": 0.41,
            "path": "sliding",
            "mechanics": "finite",
            "error_percent": 0.83,
            "dof": 14203,
            "seconds": 3.2,
        },
        tsis={
            "raw": {"max_dn": 112.3, "total_dn": 40123456, "area_px": 377856},
            "tared": {"max_dn": 25.3, "total_dn": 3012345, "area_px": 141234},
            "seconds": 7.9,
            "noise_percent": 0.21,
        },
    )


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sheet") / "overview.png"
    overview(make_frame(), path)
    return path


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.array(picture.convert("RGB"))


def test_sheet_has_its_size_and_tells_no_time(sheet):
    with Image.open(sheet) as picture:
        assert picture.size == (WIDTH_PX, HEIGHT_PX)
        assert set(picture.info) <= {"dpi"}


@pytest.mark.parametrize(
    ("panel", "left", "top", "right", "bottom"),
    [
        ("cut", 90, 110, 600, 480),
        ("pressure", 720, 110, 1095, 480),
        ("radiance", 1260, 110, 1670, 410),
        ("profiles", 110, 580, 580, 830),
        ("picture", 720, 580, 1095, 855),
        ("tared", 1260, 580, 1635, 855),
        ("relief", 150, 930, 520, 1180),
        ("scalars", 690, 910, 1215, 1180),
        ("facts", 1300, 910, 1760, 1180),
    ],
)
def test_no_panel_is_blank(sheet, panel, left, top, right, bottom):
    part = pixels(sheet)[top:bottom, left:right].reshape(-1, 3)
    assert len(np.unique(part, axis=0)) > 15


def test_same_frame_same_bytes_without_display_and_whatever_the_users_settings(sheet, tmp_path):
    """A machine without display, with a matplotlibrc of its own and a backend that cannot open."""
    (tmp_path / "matplotlibrc").write_text("font.size: 30\nimage.cmap: jet\naxes.facecolor: red\n")
    hidden = {"DISPLAY", "WAYLAND_DISPLAY"}
    settings = {key: value for key, value in os.environ.items() if key not in hidden}
    settings |= {"MPLBACKEND": "TkAgg", "MATPLOTLIBRC": str(tmp_path / "matplotlibrc")}
    code = "import sys; from test_pictures import make_frame, overview; overview(make_frame(), sys.argv[1])"
    here = Path(__file__).parent
    settings["PYTHONPATH"] = os.pathsep.join([str(here), str(here.parent)])
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "b.png")], check=True, env=settings, timeout=120
    )
    assert (tmp_path / "b.png").read_bytes() == sheet.read_bytes()


def test_drawing_leaves_matplotlibs_settings_alone(tmp_path):
    before = dict(mpl.rcParams)
    overview(make_frame(), tmp_path / "a.png")
    after = dict(mpl.rcParams)
    assert after == before


def test_sheet_of_plain_tissue(tmp_path, sheet):
    overview(make_frame(size=0.0), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() != sheet.read_bytes()
    tared = pixels(tmp_path / "a.png")[580:800, 1280:1600].astype(int)
    assert np.abs(tared - tared.mean(axis=(0, 1))).max() < 80  # noise alone looks pale


def test_the_inclusion_is_where_it_was_put(sheet):
    """The tared picture's red blob and the cut's inclusion are centred on x = 0."""
    tared = pixels(sheet)[572:860, 1255:1640].astype(int)
    red = tared[..., 0] - tared[..., 2]
    rows, columns = np.nonzero(red > 120)
    assert columns.mean() == pytest.approx(385 / 2, abs=4)
    assert rows.mean() == pytest.approx(288 / 2, abs=4)


def test_sixteen_bit_pictures_are_drawn(tmp_path):
    frame = make_frame()
    frame.design.camera.bits, frame.image = 12, frame.image.astype(np.uint16) * 16
    overview(frame, tmp_path / "a.png")
    assert pixels(tmp_path / "a.png").shape == (HEIGHT_PX, WIDTH_PX, 3)


def awkward() -> SimpleNamespace:
    """A frame whose numbers and names are as long as they get."""
    frame = make_frame(13.0, 12.5, 112.55)
    frame.design.name = "a-sensor-with-a-long-name"
    frame.inclusion.offset = (-3.25, 2.75)
    frame.inclusion.stretch = (1.05, 0.95, 0.9)
    frame.fem["mechanics"], frame.fem["path"], frame.fem["error_percent"] = "finite", "unilateral", 12.345
    frame.tsis["raw"]["total_dn"] = 96_353_279
    frame.fem["dof"], frame.fem["seconds"], frame.tsis["seconds"] = 1_234_567, 123.4, 1234.5
    for layer in frame.design.waveguide.layers:
        layer.modulus_kPa = 156.25
    return frame


def slanted(tilt: tuple[float, float] = (-3.25, 9.75)) -> SimpleNamespace:
    """A frame of a tilted press at the side of the specimen, part of it open; y is off the middle too."""
    frame = make_frame()
    frame.inclusion.offset = (4.25, -12.5)
    frame.press |= {"tilt_deg": list(tilt), "position_mm": [-12.25, 3.75]}
    frame.fem["path"] = "unilateral"
    a, b = np.radians(tilt)
    slab = np.arange(frame.cut.n_points) >= frame.cut.n_points - 81 * 41
    x, z = frame.cut.points[slab, 0] + 12.25, frame.cut.points[slab, 2]
    # the undeformed slab in the probe's frame: turned back about y, then x
    x, z = np.cos(b) * x - np.sin(b) * z, np.sin(b) * x + np.cos(b) * z
    frame.cut.points[slab] = np.stack([x, np.sin(a) * z, np.cos(a) * z], axis=1)
    pressure = frame.surface.point_data["pressure"]
    frame.surface.point_data["pressure"] = np.where(frame.surface.points[:, 0] > 6, 0.0, pressure)
    return frame


def dark() -> SimpleNamespace:
    """A frame taken with every LED failed."""
    frame = make_frame()
    frame.radiance = np.zeros_like(frame.radiance)
    frame.image, frame.tared = np.full_like(frame.image, 4), np.zeros_like(frame.tared)
    frame.tsis["saturated_percent"] = 0.0
    return frame


def narrow() -> SimpleNamespace:
    """A frame of a guide and a field of view of 20 mm, one of the LEDs inside the guide."""
    frame = make_frame()
    frame.design.waveguide.width_mm = frame.design.camera.field_of_view_mm = 20.0
    frame.design.camera.field_height_mm = 14.95
    frame.design.leds[0].coupling = "embedded"
    frame.surface.points[:, :2] *= 0.8
    return frame


def texts(frame: SimpleNamespace) -> list[str]:
    """Everything that the sheet says, but for tick labels."""
    with mpl.rc_context(STYLE):
        canvas = FigureCanvasAgg(Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI))
        draw_sheet(canvas.figure, frame)
        return [text.get_text() for text in canvas.figure.findobj(Text)]


def test_no_light_is_black_and_says_so(tmp_path):
    overview(dark(), tmp_path / "a.png")
    radiance = pixels(tmp_path / "a.png")[110:200, 1270:1400]
    assert radiance.max() < 8
    assert "no light" in texts(dark()) and "no light" not in texts(make_frame())


def test_sheet_says_how_it_was_made():
    said = texts(narrow())
    assert {"3 through air, 1 embedded", "6 ms", "LED (beyond the edge, at the guide's side)"} <= set(said)
    assert "saturated pixels" not in said and "saturated pixels" in texts(dark())
    assert {"finite strain, closed, sliding contact", "0.83 % of its maximum"} <= set(said)


def test_sheet_says_where_the_cut_lies_and_how_the_sensor_stands():
    said = texts(slanted())
    assert "a  Cut through the inclusion (y = -12.5 mm), pressed 2.00 mm" in said
    assert "d  What the inclusion (shaded) adds along y = -8.41 mm" in said  # as far as the picture goes
    assert "finite strain, contact open in places" in said
    (note,) = (text for text in said if "computed, not photographed" in text)
    assert note.startswith(
        "tilted by (-3.25, 9.75)° about x and y · sensor at (-12.25, 3.75) mm of the specimen"
    )


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.0, 8.0), (0.0, -8.0), (-5.0, 3.0)])
def test_the_chest_wall_is_drawn_where_the_mesh_has_it(tilt):
    """The plane 30 mm above the origin, turned by the tilt and cut with y = 0, under a press of 2 mm."""
    frame = slanted(tilt)
    moved = np.asarray(frame.cut.points)[:, [0, 2]] + frame.cut.point_data["displacement"][:, [0, 2]]
    wall = cutaway._wall(frame, moved)
    slope = np.degrees(np.arctan2(*(wall[1] - wall[0])[::-1]))
    a, b = np.radians(tilt)
    assert slope == pytest.approx(np.degrees(np.arctan(np.cos(a) * np.tan(b))), abs=1e-3)
    x, z = wall.mean(axis=0)
    away = np.dot([x, z + 2.0], cutaway._normal(wall))  # the press goes along z
    assert away == pytest.approx(30 * np.cos(a) / np.hypot(np.cos(b), np.cos(a) * np.sin(b)), rel=1e-4)


def test_an_ellipsoid_is_outlined_as_one():
    frame = make_frame(6.0)
    frame.inclusion.stretch = (2.0, 1.0, 0.5)
    assert "12 × 6 × 3 mm (x, y, z)" in " ".join(texts(frame))
    canvas = FigureCanvasAgg(Figure())
    axes = canvas.figure.add_subplot()
    draw_tared(axes, frame, "f")
    (ellipse,) = (patch for patch in axes.patches if isinstance(patch, Ellipse))
    assert (ellipse.width, ellipse.height) == (12.0, 6.0)


@pytest.mark.filterwarnings("error")
def test_names_that_the_type_cannot_write_draw_no_warning(tmp_path):
    frame = make_frame()
    frame.design.name = "触覚 $\\frac{ $"
    overview(frame, tmp_path / "a.png")


@pytest.mark.parametrize(
    "frame",
    [make_frame(), make_frame(0.0), make_frame(2.0, 5.0, 120.0), awkward(), dark(), narrow(), slanted()],
)
def test_no_text_runs_into_another_or_off_the_sheet(frame, monkeypatch):
    drawn: dict[int, Text] = {}  # what is drawn, without the tick labels that matplotlib keeps in reserve
    draw = Text.draw

    def note(text, renderer, *args, **kwargs):
        drawn[id(text)] = text
        return draw(text, renderer, *args, **kwargs)

    with mpl.rc_context(STYLE):
        canvas = FigureCanvasAgg(Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI))
        draw_sheet(canvas.figure, frame)
        monkeypatch.setattr(Text, "draw", note)
        canvas.draw()
        seen = [text for text in drawn.values() if text.get_visible() and text.get_text().strip()]
        ours = [(text.get_text(), Text.get_window_extent(text, canvas.get_renderer())) for text in seen]
    assert len(ours) > 100
    for name, box in ours:
        inside = min(box.x0, box.y0) >= 0 and box.x1 <= WIDTH_PX and box.y1 <= HEIGHT_PX
        assert inside, f"{name!r} at {box}"
    for (name, box), (other, beside) in itertools.combinations(ours, 2):
        wide = min(box.x1, beside.x1) - max(box.x0, beside.x0)
        high = min(box.y1, beside.y1) - max(box.y0, beside.y0)
        assert wide < 2 or high < 5, f"{name!r} and {other!r}"  # lines of type may touch within their leading
