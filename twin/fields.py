"""Numbers of a design by their dotted names: "leds.0.flux_W", or "leds.*.flux_W" for every LED's.

Designs stand here as nested tables, lists and numbers, every value written out; see `tables_of`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from pydantic import TypeAdapter

from twin.complaint import DesignError, shown
from twin.complaint import _child as child
from twin.complaint import _resolved as resolved
from twin.design import Design, design_schema
from twin.study import Distribution

Path = tuple[str | int, ...]

PRESS = "press.indentation_mm"
"""As a key of what is randomised: one factor for all press levels."""

MOST = 2000
"""Most numbers of a design that vary over a corpus."""

# The same for all samples, or the pictures of a corpus would not fit each other.
_FIXED = ("camera.columns", "camera.rows", "camera.binning", "camera.bits", "signal.")


@dataclass(frozen=True)
class Varied:
    """One number of the design that a distribution is drawn for."""

    field: str
    """Its dotted name, also that of its column."""
    purpose: str
    """Name of its stream of random numbers: fields of one purpose share their draws."""
    distribution: Distribution
    base: float | None
    """What the design says; None where it says nothing."""


_ADAPTER = TypeAdapter(Design)


def tables_of(design: Design) -> dict[str, Any]:
    """Return the nested tables that a design can be read from again."""
    tables: dict[str, Any] = _ADAPTER.dump_python(design, mode="json")
    for led in tables["leds"]:
        if led["flux_lm"] is not None:  # which flux_W follows from
            del led["flux_W"]
    return tables


def expand(tables: Mapping[str, Any], randomise: Mapping[str, Distribution]) -> list[Varied]:
    """Return every number that is randomised, in the order of the study.

    Raises
    ------
    DesignError
        For names that the design does not have, that are no numbers, or that are said twice.
    """
    found: list[Varied] = []
    taken: dict[tuple[str, str], str] = {}
    for key, distribution in sorted(randomise.items(), key=lambda item: item[0] != PRESS):
        where = f"randomise.{key}"
        whole = key == PRESS
        if whole and not factor(distribution):
            allowed = "true (one factor for all levels), or the key press.indentation_mm.*"
            raise DesignError(f"{where}.relative", "false", allowed)
        for path in _paths(tables, (), (f"{PRESS}.*" if whole else key).split("."), where, key):
            field = ".".join(map(str, path))
            base = _number(tables, path, where, distribution)
            slot = (field, "press" if whole else "field")
            if slot in taken:
                raise DesignError(where, f"{field} again", f"it once, not also as {taken[slot]}")
            if (field, "press") in taken and not factor(distribution):
                raise DesignError(f"{where}.relative", "false", f"true beside randomise.{PRESS}")
            taken[slot] = key
            found.append(Varied(field, key if whole else field, distribution, base))
            if len(found) > MOST:
                raise DesignError(where, "more numbers", f"at most {MOST} that vary")
    return found


def factor(distribution: Distribution) -> bool:
    """Whether draws multiply what is there."""
    return distribution.relative or distribution.distribution == "lognormal"


def number_at(tables: Mapping[str, Any], field: str, where: str) -> float | None:
    """Return a number of the design by its full dotted name; raises `DesignError` about ``where``."""
    paths = _paths(tables, (), field.split("."), where, field)
    if "*" in field.split(".") or len(paths) != 1:
        raise DesignError(where, shown(field), "the dotted name of one number of the design")
    return _number(tables, paths[0], where, None)


def _paths(node: Any, so_far: Path, steps: list[str], where: str, key: str) -> list[Path]:
    """Return the paths that a pattern stands for."""
    if not steps:
        return [so_far]
    step, rest = steps[0], steps[1:]
    if isinstance(node, list):
        if step == "*":
            each = range(len(node))
            return [path for k in each for path in _paths(node[k], (*so_far, k), rest, where, key)]
        if step.isascii() and step.isdigit() and len(step) < 6 and int(step) < len(node):
            return _paths(node[int(step)], (*so_far, int(step)), rest, where, key)
        allowed = f'"*" or 0 to {len(node) - 1} after {".".join(map(str, so_far))}'
        raise DesignError(where, shown(step), allowed)
    if isinstance(node, Mapping) and step in node:
        return _paths(node[step], (*so_far, step), rest, where, key)
    place = f" of {'.'.join(map(str, so_far))}" if so_far else ""
    if isinstance(node, Mapping):
        raise DesignError(where, shown(step), f"a field{place} that the design has: {', '.join(node)}")
    raise DesignError(where, shown(key), f"a field that the design has; nothing lies below{place[3:]}")


@lru_cache(maxsize=MOST)
def limits(path: Path) -> Mapping[str, Any]:
    """Return the JSON schema's words on a field of a design."""
    schema = _schema()
    node: Mapping[str, Any] | None = schema
    for step in path:
        node = child(schema, node, step)
    node = resolved(schema, node)
    # a number or a table: the number
    return next((n for n in node.get("oneOf", ()) if n.get("type") in ("number", "integer")), node)


_schema = lru_cache(maxsize=1)(design_schema)


@lru_cache(maxsize=MOST)
def path_of(field: str) -> Path:
    """Return ``leds.0.z_mm`` as ``("leds", 0, "z_mm")``."""
    return tuple(int(step) if step.isdigit() else step for step in field.split("."))


def _number(
    tables: Mapping[str, Any], path: Path, where: str, distribution: Distribution | None
) -> float | None:
    """Return the design's value of a field; raises if it is no number, or does not suit its distribution."""
    field, kind = ".".join(map(str, path)), limits(path).get("type")
    value: Any = tables
    for step in path:
        value = value[step]
    if kind not in ("number", "integer") or isinstance(value, bool | str | list | Mapping):
        allowed = 'a field that is one number ("*" stands for every element of a list)'
        raise DesignError(where, f"{field} = {shown(value)}", allowed)
    if field.startswith(_FIXED):
        raise DesignError(where, field, "a field that may differ from picture to picture")
    if distribution is None:
        return value
    name = distribution.distribution
    if (kind == "integer") != (name == "integer") and name != "choice":
        allowed = (
            f"'integer' or 'choice' for {field}" if kind == "integer" else f"another: {field} is a number"
        )
        raise DesignError(f"{where}.distribution", shown(name), allowed)
    of = distribution.of or ()
    if kind == "integer" and of and (distribution.relative or not all(v.is_integer() for v in of)):
        raise DesignError(f"{where}.of", shown(list(of)), f"integers for {field}")
    leans = factor(distribution) or (name == "normal" and distribution.mean is None)
    if leans and value is None:
        raise DesignError(where, f"{field}, which the design does not set", "a field that it sets")
    if factor(distribution) and value == 0:
        raise DesignError(where, f"{field} = 0, which no factor changes", "absolute values")
    return value


def put(tables: Mapping[str, Any], changes: Iterable[tuple[str, float]]) -> dict[str, Any]:
    """Return the tables with other numbers at some dotted names; the given ones stay as they are."""
    changed = dict(tables)
    fresh: set[Path] = set()
    for field, value in changes:
        path, node = path_of(field), changed
        for depth, step in enumerate(path[:-1]):
            if path[: depth + 1] not in fresh:  # not yet a copy of our own
                inner = node[step]  # type: ignore[index]
                node[step] = list(inner) if isinstance(inner, list) else dict(inner)  # type: ignore[index]
                fresh.add(path[: depth + 1])
            node = node[step]  # type: ignore[index]
        whole = limits(path).get("type") == "integer"
        node[path[-1]] = int(value) if whole else float(value)  # type: ignore[index]
    return changed


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Values of nested tables and lists by their dotted names."""
    if isinstance(value, dict):
        items: Any = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    else:
        return {prefix: value}
    found: dict[str, Any] = {}
    for key, inner in items:
        found |= flat(inner, f"{prefix}.{key}" if prefix else str(key))
    return found
