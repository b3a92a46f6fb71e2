"""One plain line for whatever is wrong with a value: where it stands, what was received, what is allowed.

pydantic finds the mistakes; this file says them in words a sensor designer uses. What is allowed is read
from the JSON schema of the model that refused the value, so that a bound is written down once, on the
field.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from datetime import date, time
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

Location = tuple[str | int, ...]

_TAGS = frozenset(
    {"number", "range", "table"}
)  # pydantic's names for the kinds of a value that may be either

_NOTHING = object()
_shorten = reprlib.Repr()
_shorten.maxstring = _shorten.maxother = 60
_shorten.maxlist = _shorten.maxtuple = _shorten.maxdict = 4


class DesignError(ValueError):
    """A value that cannot be: of a design, an inclusion or a press. Its text is one line.

    ``field`` is the dotted name, ``received`` the value as text, ``allowed`` what would do, ``source`` the
    file (or "") and ``more`` how many other mistakes were found beside this one. ``conflicts`` holds them all
    where every value alone can be read, but some do not fit the others.
    """

    def __init__(
        self,
        field: str,
        received: str,
        allowed: str,
        *,
        source: str = "",
        more: int = 0,
        conflicts: Sequence[DesignError] = (),
    ) -> None:
        self.conflicts = tuple(conflicts)
        self.field, self.received, self.allowed, self.source, self.more = (
            field,
            received,
            allowed,
            source,
            more,
        )
        where = f"{source}: {field}" if source else field
        text = f"{where}: received {received}; allowed {allowed}" + (f" (+{more} more)" if more else "")
        super().__init__(" ".join(text.split()))

    def renamed(self, field: str | None = None, *, source: str | None = None) -> DesignError:
        """Return the same complaint about another name of the field, or as found in a file."""
        return DesignError(
            self.field if field is None else field,
            self.received,
            self.allowed,
            source=self.source if source is None else source,
            more=self.more,
            conflicts=self.conflicts,
        )


def shown(value: object) -> str:
    """Return a value as a person would have written it, shortened to fit a line."""
    return str(value) if isinstance(value, date | time) else _shorten.repr(value)


def from_validation(error: ValidationError, data: object, schema: Mapping[str, Any]) -> DesignError:
    """Return pydantic's first error as a `DesignError`, counting the others.

    ``data`` is what was validated (nested dicts and lists) and ``schema`` the JSON schema of the model.
    """
    errors = error.errors(include_url=False)
    first, more = errors[0], len(errors) - 1
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, DesignError):
        more += cause.more
        return DesignError(cause.field, cause.received, cause.allowed, more=more, conflicts=cause.conflicts)
    field, received, allowed = _words(first, data, schema)
    return DesignError(field, received, allowed, more=more)


def not_finite(data: object, schema: Mapping[str, Any], location: Location = ()) -> Iterator[DesignError]:
    """Yield a complaint for every NaN or infinity in nested dicts and lists."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            yield from not_finite(value, schema, (*location, key))
    elif isinstance(data, Sequence) and not isinstance(data, str):
        for index, value in enumerate(data):
            yield from not_finite(value, schema, (*location, index))
    elif isinstance(data, float) and not math.isfinite(data):
        allowed = describe(schema, location).replace("a number", "a finite number")
        yield DesignError(dotted(location), shown(data), allowed)


def dotted(location: Location) -> str:
    """Return ``("leds", 0, "z_mm")`` as ``leds.0.z_mm``."""
    return ".".join(str(step) for step in location) or "the file"


def describe(schema: Mapping[str, Any], location: Location) -> str:
    """Return in words what the schema allows at a location, such as ``a number > 0 and <= 1``."""
    node: Mapping[str, Any] | None = schema
    for step in location:
        node = _child(schema, node, step)
    return _in_words(schema, node)


def _words(error: ErrorDetails, data: object, schema: Mapping[str, Any]) -> tuple[str, str, str]:
    location: Location = tuple(step for step in error["loc"] if step not in _TAGS)
    value = _value(data, location)
    received = "nothing" if value is _NOTHING else shown(value)
    match error["type"]:
        case "unexpected_keyword_argument" | "extra_forbidden":
            parent = _node(schema, location[:-1])
            names = ", ".join(parent.get("properties", {}))
            return dotted(location), f"the unknown key {location[-1]!r} = {received}", f"one of {names}"
        case "value_error":
            return dotted(location), received, str(error.get("ctx", {}).get("error", error["msg"]))
        case _:
            return dotted(location), received, describe(schema, location)


def _value(data: object, location: Location) -> object:
    for step in location:
        try:
            data = data[step]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            return _NOTHING
    return data


def _node(schema: Mapping[str, Any], location: Location) -> Mapping[str, Any]:
    node: Mapping[str, Any] | None = schema
    for step in location:
        node = _child(schema, node, step)
    return _of_kind(schema, node, "object")


def _resolved(schema: Mapping[str, Any], node: Mapping[str, Any] | None) -> Mapping[str, Any]:
    while node is not None and ("$ref" in node or "anyOf" in node):
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
        else:  # a value that may be left out
            node = next((kind for kind in node["anyOf"] if kind.get("type") != "null"), None)
    return node or {}


def _of_kind(schema: Mapping[str, Any], node: Mapping[str, Any] | None, kind: str) -> Mapping[str, Any]:
    """The node, or of several kinds of value that it allows the one of this type."""
    node = _resolved(schema, node)
    choices = [_resolved(schema, choice) for choice in node.get("oneOf", [])]
    return next((choice for choice in choices if choice.get("type") == kind), node)


def _child(
    schema: Mapping[str, Any], node: Mapping[str, Any] | None, step: str | int
) -> Mapping[str, Any] | None:
    node = _of_kind(schema, node, "array" if isinstance(step, int) else "object")
    if isinstance(step, int):
        fixed = node.get("prefixItems", [])
        return fixed[step] if step < len(fixed) else node.get("items")
    named = node.get("properties", {}).get(step)
    if named is not None:
        return named
    # keys that are names of the user's own; true or false where any or none may stand
    own = next(iter(node.get("patternProperties", {}).values()), node.get("additionalProperties"))
    return own if isinstance(own, Mapping) else None


_PATTERNS = {
    r"^[A-Za-z0-9][A-Za-z0-9_.-]*$": "a name of letters, digits, _ . and -, 100 characters at most",
    r"^[0-9a-f]{64}$": "64 hexadecimal digits in quotes",
}
_BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


def _in_words(schema: Mapping[str, Any], node: Mapping[str, Any] | None) -> str:
    node = _resolved(schema, node)
    if "oneOf" in node:  # a value of several kinds
        return " or ".join(_in_words(schema, kind) for kind in node["oneOf"])
    if "enum" in node:
        return "one of " + ", ".join(repr(choice) for choice in node["enum"])
    if "const" in node:
        return repr(node["const"])
    match node.get("type"):
        case "boolean":
            return "true or false"
        case "number" | "integer" as kind:
            bounds = [f"{sign} {node[key]:g}" for key, sign in _BOUNDS.items() if key in node]
            return " ".join(["a number" if kind == "number" else "an integer", " and ".join(bounds)]).strip()
        case "string" if node.get("pattern") in _PATTERNS:
            return _PATTERNS[node["pattern"]]
        case "string":
            most = f" of 1 to {node['maxLength']} characters" if node.get("minLength") else ""
            return (
                f"a text in quotes{most}, without control characters"
                if "pattern" in node
                else "a text in quotes"
            )
        case "array":
            return _list_in_words(schema, node)
        case "object":
            return "a table with the keys " + ", ".join(node.get("properties", {}))
    return "a value of another type"


def _list_in_words(schema: Mapping[str, Any], node: Mapping[str, Any]) -> str:
    fixed, least, most = node.get("prefixItems"), node.get("minItems"), node.get("maxItems")
    if fixed:
        return f"a list of {len(fixed)}, each {_in_words(schema, fixed[0])}"
    count = f" of {least} or more" if least and most is None else f" of {least} to {most}" if most else ""
    return f"a list{count}, each {_in_words(schema, node.get('items'))}"
