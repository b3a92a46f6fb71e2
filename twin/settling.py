"""Draw the samples of a group, and draw those again that cannot be simulated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

import fem
from twin import presses
from twin.complaint import DesignError
from twin.design import Design, parse_design
from twin.draws import Stream, again, blanks, draw, inclusions
from twin.fields import Varied, factor, put
from twin.study import PARAMETERS, Group
from twin.tables import read_grid, read_table

if TYPE_CHECKING:
    from fem import Emulator
    from scenes.traced import TracedLight

Columns = dict[str, NDArray[Any]]

MAX_ATTEMPTS = 100
"""Draws of one sample before the study is given up."""
MAX_REFUSED = 0.9
"""Largest share of draws that may be refused in a group."""
_ROOMS = ("fem.", "scenes.", "twin.")
_SOON = 200  # draws after which that share is looked at


@dataclass(frozen=True)
class Setting:
    """What all groups share: the design, as nested tables too, its numbers that vary, who presses: an
    emulator, multipoles of a quality, or neither."""

    seed: int
    tables: Mapping[str, Any]
    design: Design
    varied: tuple[Varied, ...]
    emulator: Emulator | None
    traced: tuple[TracedLight, ...] | None = None
    multipoles: presses.Quality | None = None

    def check(self, columns: Columns, number: int) -> None:
        """Raise ValueError, in one line, if a sample cannot be simulated."""
        fields = [(name, float(values[number])) for name, values in columns.items() if "." in name]
        design = parse_design(put(self.tables, fields)) if fields else self.design
        inclusion = None
        if not columns["blank"][number]:
            size, depth, modulus, x, y = (float(columns[name][number]) for name in PARAMETERS)
            inclusion = fem.Inclusion(size, depth, modulus, (x, y))
        levels = design.press.indentation_mm
        presses.check(design, inclusion, levels)
        if self.emulator is not None:
            presses.check_emulated(design, inclusion, levels, self.emulator)
        if self.multipoles is not None:
            presses.check_expanded(design, inclusion, self.multipoles)
        if self.traced is not None:
            from scenes import spectral, traced

            parts = spectral.band_sensors(design.sensor(), count=design.light.bands, at=design.sensor)
            traced.check(self.traced, [sensor for _, _, sensor in parts])


@dataclass(frozen=True)
class Drawn:
    """Samples of a group: `columns` of `PARAMETERS`, "blank" and fields of the design, (n,) each; `fields`
    are those that its table gives; `redrawn` counts the draws that were refused."""

    columns: Columns
    fields: tuple[str, ...]
    redrawn: int


def drawn(
    setting: Setting,
    group: Group,
    folder: Path,
    where: str,
    count: int | None,
    tell: Callable[[float], None],
) -> Drawn:
    """Return the first ``count`` samples of a group, every one of which can be simulated.

    Raises
    ------
    DesignError
        In one line, about the group ``where``: for a listed sample that cannot be simulated, and for ranges
        of which hardly any draw can.
    """
    stream = Stream(setting.seed, group.name)
    fixed: tuple[str, ...] = ()
    if group.grid is not None:
        columns = read_grid(group.grid)
    elif group.table is not None:
        columns = read_table(folder / group.table, setting.tables)
        fixed = tuple(name for name in columns if "." in name)
    else:
        assert group.count is not None
        n = group.count if count is None else min(count, group.count)
        columns = {**inclusions(group, stream, n), "blank": blanks(group, n)}
    columns = {name: values[:count] for name, values in columns.items()}
    varied = [one for one in setting.varied if one.field not in fixed]
    whole = len(columns["blank"])
    columns |= fields_of(varied, lambda purpose: stream.many(purpose, whole))
    first = {name: columns[name].copy() for name in PARAMETERS}
    refused: Counter[str] = Counter()
    for number in range(whole):
        if number % 1000 == 0:
            tell(number / whole)
        attempt = 0
        while (reason := _refusal(setting, columns, number)) is not None:
            attempt += 1
            refused[reason] += 1
            draws = number + refused.total()
            if group.inclusion is None and not varied:
                raise DesignError(f"{where}, sample {number}", f"one that cannot be ({reason})", "others")
            if attempt >= MAX_ATTEMPTS or (draws > _SOON and refused.total() > MAX_REFUSED * draws):
                _give_up(where, refused, draws)
            if group.inclusion is not None and not columns["blank"][number]:
                own = {name: float(values[number]) for name, values in first.items()}
                for name, value in again(group, stream, number, attempt, own).items():
                    columns[name][number] = value
            for name, values in fields_of(varied, _again(stream, number, attempt)).items():
                columns[name][number] = values[0]
    if refused.total() > MAX_REFUSED * (whole + refused.total()):
        _give_up(where, refused, whole + refused.total())
    return Drawn(columns, fixed, refused.total())


def fields_of(varied: list[Varied], numbers: Callable[[str], NDArray[np.float64]]) -> Columns:
    """Return the values of randomised fields from the random numbers of their purposes, (n,) each."""
    columns: Columns = {}
    for one in varied:
        unit = numbers(one.purpose)
        if factor(one.distribution):  # of what the design says, or of an earlier factor
            values = draw(one.distribution, 1.0, unit) * columns.get(one.field, np.asarray(one.base))
        else:
            values = draw(one.distribution, one.base, unit)
        columns[one.field] = values
    return columns


def _again(stream: Stream, number: int, attempt: int) -> Callable[[str], NDArray[np.float64]]:
    return lambda purpose: np.array([stream.one(purpose, number, attempt)])


def _refusal(setting: Setting, columns: Columns, number: int) -> str | None:
    """Return why a sample cannot be simulated, None if it can."""
    try:
        setting.check(columns, number)
    except ValidationError as error:  # an inclusion beyond all bounds
        return f"inclusion: {error.errors()[0]['msg']}"
    except ValueError as error:
        if not type(error).__module__.startswith(_ROOMS) and ": received " not in str(error):
            raise  # a mistake of this program
        return str(error)
    return None


def _give_up(where: str, refused: Counter[str], draws: int) -> None:
    """Raise `DesignError` with the most frequent reason, told by its field, and an example of it."""
    kinds = Counter[str]()
    for reason, times in refused.items():
        kinds[reason.partition(":")[0]] += times
    kind, times = kinds.most_common(1)[0]
    example = next(reason for reason in refused if reason.partition(":")[0] == kind)
    received = f"ranges of which {refused.total()} of {draws} draws cannot be simulated"
    allowed = f"ranges of which at most {MAX_REFUSED:.0%} cannot ({times} of them like: {example})"
    raise DesignError(where, received, allowed)
