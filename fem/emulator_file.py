"""Keep an emulator in a file: an npz of plain numbers and one line of JSON, which can run no code when
read."""

from __future__ import annotations

import io
import os
import tokenize
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fem.emulator import Emulator
from fem.emulator_errors import Errors
from fem.lines import logical_lines
from fem.regression import MATERN, SQUARED, Regression, groups
from fem.sampling import PLAN, Plan
from fem.solving import KNOTS

Floats = NDArray[np.float64]

_FORMAT = 8
_SQUARED = 7  # the format before, whose covariances are squared exponentials
_LARGEST = 512 * 2**20  # bytes of all arrays
_REGRESSIONS = ("rise", "tared", "finer", "finer_tared")
_MORE = ("rise_more", "tared_more", "finer_more", "finer_tared_more")  # that finite strain has besides
_GRIDS = ("x", "pressure", "moved")


class NotAnEmulator(ValueError):
    """A file that is no emulator, or a damaged one: one line says why."""


def save_emulator(emulator: Emulator, place: str | Path) -> None:
    """Write an emulator; the file appears whole or not at all."""
    arrays: dict[str, NDArray[Any]] = {name: getattr(emulator, name) for name in _GRIDS}
    for name in _parts(emulator.plan):
        arrays |= {f"{name}.{f.name}": getattr(getattr(emulator, name), f.name) for f in fields(Regression)}
    arrays |= {f"errors.{f.name}": getattr(emulator.errors, f.name) for f in fields(Errors)}
    kept = {name: np.asarray(values, np.float64) for name, values in arrays.items()}
    head = np.frombuffer(b"%d\n" % _FORMAT + PLAN.dump_json(emulator.plan), np.uint8)
    place = Path(place)
    rough = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        with open(rough, "wb") as stream:
            np.savez(stream, head=head, **kept)  # type: ignore[arg-type]
        os.replace(rough, place)
    finally:
        rough.unlink(missing_ok=True)


def load_emulator(place: str | Path | BinaryIO) -> Emulator:
    """Read an emulator; nothing in the file is trusted: no pickles, all shapes and numbers are checked.

    Raises
    ------
    NotAnEmulator
        In one line.
    FileNotFoundError
        Where there is no such file.
    """
    try:
        return _checked(_read(Path(place).read_bytes() if isinstance(place, str | Path) else place.read()))
    except (
        KeyError,
        TypeError,
        ValueError,
        EOFError,
        OverflowError,
        MemoryError,  # a header may announce any size
        tokenize.TokenError,  # numpy's word for a header that does not end
        zipfile.BadZipFile,
        zlib.error,
        RuntimeError,  # zipfile's word for encrypted parts, and for methods that it does not know
    ) as e:
        why = " ".join(str(e).split())[:200] or type(e).__name__
        raise NotAnEmulator(
            f"emulator: received {str(place)!r}, which is none ({why}); allowed is a file of `twin emulate`"
        ) from None


def _parts(plan: Plan) -> tuple[str, ...]:
    return (*_REGRESSIONS, *_MORE) if plan.finite else _REGRESSIONS


def _read(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an npz, which may hold nothing but the expected ones, of plain numbers."""
    expected = {"head", *_GRIDS, *(f"errors.{f.name}" for f in fields(Errors))}
    expected |= {f"{name}.{f.name}" for name in _REGRESSIONS for f in fields(Regression)}
    more = {f"{name}.{f.name}" for name in _MORE for f in fields(Regression)}
    orders = {name for name in expected | more if name.endswith(".order")}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        found = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        allowed = expected, expected | more, expected - orders, (expected | more) - orders
        if set(found) not in allowed or len(archive.infolist()) != len(found):
            raise ValueError("its arrays are not those of an emulator")
        if sum(info.file_size for info in found.values()) > _LARGEST:
            raise ValueError("it is too large")
        arrays = {}
        for name, info in found.items():
            array = np.lib.format.read_array(io.BytesIO(archive.read(info)), allow_pickle=False)
            if array.dtype != (np.uint8 if name == "head" else np.float64):
                raise ValueError(f"{name} is not of plain numbers")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} is not finite")
            arrays[name] = array
    return arrays


def _checked(arrays: dict[str, NDArray[Any]]) -> Emulator:
    number, _, text = arrays["head"].tobytes().partition(b"\n")
    if number not in (b"%d" % _FORMAT, b"%d" % _SQUARED):
        raise ValueError(f"format {number[:20]!r}, known are {_SQUARED} and {_FORMAT}")
    plan = PLAN.validate_json(text)
    if number == b"%d" % _SQUARED:
        arrays |= {f"{name}.order": np.array(SQUARED) for name in _parts(plan)}
    if ("rise_more.inputs" in arrays) != plan.finite:
        raise ValueError("its arrays are not those of its mechanics")
    m, levels, moduli = len(arrays["x"]), len(plan.levels), len(plan.ratios)
    lean, coarse, fine = (len(logical_lines(res)) ** 2 for res in (plan.resolution, plan.coarse, plan.fine))
    half = plan.probe.width_mm / 2
    x = arrays["x"]
    if m < 3 or m % 2 == 0 or not (np.diff(x) > 0).all() or not np.allclose(x[[0, -1]], [-half, half]):
        raise ValueError("x does not span the probe")
    shapes: dict[str, tuple[int, ...]] = {"x": (m,), "pressure": (*KNOTS, levels, m, m)}
    shapes["moved"] = (*KNOTS, levels, m, m, 3)
    for name in _parts(plan):
        finite, finer = name in _MORE, name.startswith("finer")
        q = (5 if finer else 7) + finite
        values = (levels - 1 if finite else moduli) * (fine if finer else coarse if finite else lean)
        shapes |= _shapes_of(arrays, name, q, values * (3 if "tared" in name else 1))
    points, *pairs, rows = (len(arrays[f"errors.{k}"]) for k in ("size_mm", "finer", "finer_more", "curve"))
    shapes |= {
        "errors.size_mm": (points,),
        "errors.pressure": (points, 3),
        "errors.displacement": (points, 3),
    }
    shapes |= {"errors.finer": (pairs[0], 6), "errors.finer_more": (pairs[1], 6)}
    shapes |= {"errors.curve": (rows, 9), "errors.solves": (4, 2)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, not {shape}")
    return _assemble(plan, arrays)


def _shapes_of(arrays: dict[str, NDArray[Any]], name: str, q: int, values: int) -> dict[str, tuple[int, ...]]:
    samples, modes = len(arrays[f"{name}.inputs"]), len(arrays[f"{name}.modes"])
    if not ((arrays[f"{name}.lengths"] > 0).all() and (arrays[f"{name}.noise"] > 0).all()):
        raise ValueError(f"{name}: lengths and noise are not positive")
    if arrays[f"{name}.order"].tolist() not in (SQUARED, MATERN):
        raise ValueError(f"{name}: the order of its covariances is not known")
    shapes = {
        "inputs": (samples, q),
        "lengths": (len(groups(modes)), q),
        "noise": (len(groups(modes)),),
        "mean": (values,),
        "modes": (modes, values),
    }
    shapes |= {"trend": (q + 1, modes), "weights": (samples, modes), "order": ()}
    return {f"{name}.{key}": shape for key, shape in shapes.items()}


def _assemble(plan: Plan, arrays: dict[str, NDArray[Any]]) -> Emulator:
    grids = {name: arrays[name] for name in _GRIDS}
    parts: dict[str, Regression | None] = dict.fromkeys(_MORE)
    parts |= {
        name: Regression(**{f.name: arrays[f"{name}.{f.name}"] for f in fields(Regression)})
        for name in _parts(plan)
    }
    errors = Errors(**{f.name: arrays[f"errors.{f.name}"] for f in fields(Errors)})
    return Emulator(plan=plan, errors=errors, **grids, **parts)  # type: ignore[arg-type]
