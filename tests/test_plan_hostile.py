"""A stranger's plan can do no harm: whatever is wrong with it is told in one line."""

import json
import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_plan import frozen

from twin.complaint import DesignError
from twin.plan import load_plan
from twin.planned import design_sha256, sha256


def edit(folder, change):
    """Change plan.json as a stranger would, with hashes that fit."""
    head = json.loads((folder / "plan.json").read_text())
    change(head)
    if isinstance(head, dict) and "Infinity" not in json.dumps(head):
        head["design_sha256"] = design_sha256(head["design"])
    (folder / "plan.json").write_text(json.dumps(head))


def nested(levels):
    found = 1.0
    for _ in range(levels):
        found = {"x": found}
    return found


def rewrite(folder, change):
    """Change samples.parquet likewise."""
    table = change(pq.read_table(folder / "samples.parquet"))
    pq.write_table(table, folder / "samples.parquet")
    rehash(folder)


def rehash(folder):
    edit(folder, lambda found: found["samples"].update(sha256=sha256(folder / "samples.parquet")))


def column(name, values, type=None):
    def change(table):
        at = table.schema.get_field_index(name)
        return table.set_column(at, name, pa.array(values(table[name].to_pylist()), type or table[name].type))

    return change


def head(**changes):
    return lambda folder: edit(folder, lambda found: found.update(changes))


def design(change):
    return lambda folder: edit(folder, lambda found: change(found["design"]))


def samples(change):
    return lambda folder: rewrite(folder, change)


def said(**changes):
    return lambda folder: edit(folder, lambda found: found["samples"].update(changes))


def first(value):
    return lambda values: [value, *values[1:]]


HOSTILE = {
    "no plan": (lambda f: (f / "plan.json").unlink(), ["plan.json"]),
    "no JSON": (lambda f: (f / "plan.json").write_text("{"), ["not JSON"]),
    "bytes": (lambda f: (f / "plan.json").write_bytes(b"\xff\xfe"), ["not JSON"]),
    "nested deep": (lambda f: (f / "plan.json").write_text("[" * 100_000), ["not JSON"]),
    "a nested design": (
        lambda f: edit(f, lambda h: h["design"].update(glass=nested(300))), ["nested too deep"]),
    "a design nested deeper": (
        lambda f: edit(f, lambda h: h["design"].update(glass=nested(700))), ["nested too deep"]),
    "a distribution without spread": (
        lambda f: edit(f, lambda h: h["randomise"]["leds.*.flux_W"].pop("sd")), ["leds.*.flux_W.sd"]),
    "a group elsewhere": (lambda f: edit(f, lambda h: h["groups"][0].update(name="../x")), ["groups.0.name"]),
    "a list": (lambda f: (f / "plan.json").write_text("[]"), ["the file"]),
    "a long number": (lambda f: (f / "plan.json").write_text('{"seed": ' + "9" * 9999 + "}"), ["not JSON"]),
    "another format": (head(format=2), ["format", "2"]),
    "an extra key": (head(run="rm"), ["run", "unknown key"]),
    "a seed too large": (head(seed=2**70), ["seed"]),
    "NaN": (head(indentation_mm=[float("nan"), 2]), ["indentation_mm.0", "nan"]),
    "a press through the slab": (
        lambda f: edit(f, lambda h: (h.update(indentation_mm=[1, 90.0]), h["design"]["press"].update(
            indentation_mm=[1, 90.0]))),
        ["press.indentation_mm.1", "90.0"],
    ),
    "other levels": (head(indentation_mm=[1.0, 1.5]), ["design.press.indentation_mm", "2.0"]),
    "samples elsewhere": (said(file="../../etc/passwd"), ["samples.file", "samples.parquet"]),
    "an absolute path": (head(mechanics="emulator", emulator={"file": "/etc/passwd", "sha256": "0" * 64}),
                         ["emulator.file", "emulator.npz"]),
    "an emulator for nothing": (head(emulator={"file": "emulator.npz", "sha256": "0" * 64}), ["emulator"]),
    "no emulator": (head(mechanics="emulator"), ["emulator", "None"]),
    "a wrong hash": (said(sha256="0" * 64), ["samples.parquet", "SHA-256"]),
    "no hash": (said(sha256="../x"), ["samples.sha256"]),
    "a wrong count": (said(count=21), ["groups", "21"]),
    "too many samples": (said(count=10**9), ["samples.count", "1000000000"]),
    "a huge picture": (design(lambda d: d["camera"].update(columns=16384, rows=16384)), ["camera"]),
    "a lamp of the system": (
        design(lambda d: d["leds"][0].update(ies="/etc/passwd", pattern="ies")), ["ies", "/etc/passwd"]),
    "an unknown part": (design(lambda d: d.update(run="rm")), ["run", "unknown key"]),
    "an infinite LED": (design(lambda d: d["leds"][0].update(flux_W=float("inf"))), ["flux_W", "inf"]),
    "another design": (
        lambda f: (f / "plan.json").write_text((f / "plan.json").read_text().replace("0.5,", "0.6,", 1)),
        ["design_sha256"],
    ),
    "another threshold": (head(k={"displacement_um": 1.0, "counts": 10.0}), ["k", "signal"]),
    "a field that is none": (head(randomise={"leds.9.x": {"distribution": "normal", "sd": 1}}), ["'9'"]),
    "another field": (head(randomise={}), ["columns", "press.indentation_mm.0"]),
    "no table": (lambda f: (f / "samples.parquet").unlink(), ["samples.parquet"]),
    "a link": (
        lambda f: (f / "samples.parquet").symlink_to((f / "samples.parquet").rename(f / "../x")),
        ["samples.parquet", "plain file"],
    ),
    "no Parquet": (
        lambda f: (f / "samples.parquet").write_bytes(b"junk") and rehash(f),
        ["samples.parquet", "cannot be read"],
    ),
    "an extra column": (samples(lambda t: t.append_column("x", t["size_mm"])), ["columns", "'x'"]),
    "a missing column": (samples(lambda t: t.drop_columns(["depth_mm"])), ["columns", "depth_mm"]),
    "fewer rows": (samples(lambda t: t.slice(1)), ["rows", "19", "20"]),
    "text for numbers": (
        samples(column("size_mm", lambda v: ["x"] * len(v), pa.string())), ["size_mm", "string"]),
    "numbers repeated": (samples(column("sample", lambda v: [0] * len(v))), ["sample", "0 to 19"]),
    "a strange group": (samples(column("group", first("../x"))), ["group", "'../x'"]),
    "nulls": (samples(column("size_mm", first(None))), ["size_mm", "nothing in some rows"]),
    "a size of NaN": (samples(column("size_mm", first(float("nan")))), ["size_mm", "nan", ">= 0.1"]),
    "a huge size": (samples(column("size_mm", first(1e300))), ["size_mm", "1e+300", "<= 500"]),
    "a blank with a size": (samples(column("blank", first(True))), ["size_mm", "NaN where"]),
    "an infinite flux": (samples(column("leds.2.flux_W", first(float("inf")))), ["leds.2.flux_W", "inf"]),
    "a negative flux": (samples(column("leds.2.flux_W", first(-1.0))), ["leds.2.flux_W", "-1.0", ">= 0"]),
}  # fmt: skip


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    place = tmp_path_factory.mktemp("planned")
    frozen(place)
    return place / "corpus"


@pytest.mark.parametrize("case", HOSTILE)
def test_a_strangers_plan_is_refused_in_one_line(case, planned, tmp_path):
    spoil, words = HOSTILE[case]
    folder = tmp_path / "corpus"
    shutil.copytree(planned, folder)
    load_plan(folder)
    spoil(folder)
    with pytest.raises(DesignError) as caught:
        load_plan(folder)
    line = str(caught.value)
    assert "\n" not in line and len(line) < 600
    assert not [word for word in words if word not in line], line
