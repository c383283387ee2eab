"""Cells as numbers, and which of them are marks for a value that is not there."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mampc.base.checks import LARGEST, Array, as_number
from mampc.base.errors import MampcError, shown
from mampc.identification.export.cells import (
    APART,
    APART_FOR_SURE,
    DIGIT,
    EITHER,
    GROUPED,
    GROUPED_FOR_SURE,
    MARK,
    POINT,
    SPACE,
    SPACED,
    STATES,
    SWAPPED,
    clean,
    has_point,
    states,
    ungrouped,
    without_unit,
)
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.sheet import Cells, Sheet

PLAIN_CHARACTERS = frozenset("0123456789+-.eE \n")
# Numbers that programs write in the place of a value: they count as marks only far from all other
# values, or below zero where no other value is.
MARKS = [
    *(sign * float("9" * count) for count in range(3, 13) for sign in (1, -1)),
    999.25, -999.25, 32767.0, -32768.0, 65535.0, -32767.0, 2147483647.0, -2147483648.0, 4294967295.0,
]  # fmt: skip


@dataclass(frozen=True)
class Reading:
    """How cells become numbers, where that is not plain.

    Args:
        decimal: "." or ","; None to see it from the cells.
        bad: words and numbers that mark a value as missing, beside the usual ones.
        ranges: lowest and highest believable value of columns.
    """

    decimal: str | None = None
    bad: tuple[str, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.decimal not in (None, ".", ","):
            raise MampcError(f"decimal: expected '.' or ',', received {shown(self.decimal)}")
        bad = (self.bad,) if isinstance(self.bad, (str, int, float)) else tuple(self.bad)
        object.__setattr__(self, "bad", tuple(str(word).strip().casefold() for word in bad))
        for name, limits in self.ranges.items():
            if not isinstance(limits, Sequence) or len(limits) != 2:
                raise MampcError(
                    f"ranges[{name!r}]: expected a lowest and a highest value, received {shown(limits)}"
                )
            low, high = (as_number(f"ranges[{name!r}]", limit) for limit in limits)
            if low >= high:
                raise MampcError(
                    f"ranges[{name!r}]: expected the lowest value first, received {shown(limits)}"
                )


@dataclass
class Column:
    """One column as numbers, not-a-number where there is none.

    Attributes:
        name: as it stands in the header.
        values: shape (N,).
        marks: what stood in the place of numbers: how often, and the first row.
        unit: behind each of its numbers; empty where there is none.
    """

    name: str
    values: Array
    marks: dict[str, list[int]] = field(default_factory=dict)
    unit: str = ""

    def mark(self, what: str, row: int) -> None:
        """Count one cell without a number."""
        self.marks.setdefault(what, [0, row])[0] += 1

    def __str__(self) -> str:
        """'TI101: no number in 12 rows: "Bad" (8, first in row 57), ...'."""
        total = sum(count for count, _ in self.marks.values())
        kinds = sorted(self.marks.items(), key=lambda item: -item[1][0])
        words = [f"{what} ({count}, first in row {row})" for what, (count, row) in kinds[:6]]
        if len(kinds) > 6:
            words.append(f"{len(kinds) - 6} other kinds")
        return f"{self.name}: no number in {total} of {len(self.values)} rows: {', '.join(words)}"


def read_numbers(
    sheet: Sheet,
    columns: Mapping[str, int],
    reading: Reading,
    findings: Findings,
    switches: Collection[str] = (),
) -> tuple[list[Column], Array]:
    """The columns, by name and position, as numbers; cells that may or may not be numbers become doubts.

    Columns that may be `switches` are 0 and 1 where they hold nothing but two states in words, such as OFF and ON.
    Their values are the columns of one array, shape (N, columns), which is returned beside them.
    """
    doubts = len(findings.doubts)
    decimal = reading.decimal or _decimal_mark(sheet, list(columns.values()), findings)
    grouped = reading.decimal is not None or len(findings.doubts) > doubts
    values = np.full((len(sheet), len(columns)), np.nan)
    readers = [
        _Reader(Column(name, own), decimal, grouped, reading)
        for name, own in zip(columns, values.T, strict=True)
    ]
    start = 0
    for part in sheet.chunks(list(columns.values())):
        rows = sheet.numbers[start : start + len(part[0])]
        for reader, cells in zip(readers, part, strict=True):
            reader.read(start, cells, rows)
        start += len(rows)
    return [reader.finish(sheet.numbers, findings, switches) for reader in readers], values


class _Cells(NamedTuple):
    """Cells with one unit behind their numbers: the first one, positions and numbers."""

    first: str
    places: array[int]
    numbers: array[float]


class _Reader:
    """Reads one column chunk by chunk."""

    def __init__(self, column: Column, decimal: str, grouped: bool, reading: Reading) -> None:
        self.column = column
        self.reading = reading
        self.decimal = decimal
        self.unclear: dict[str, list[int]] = {}
        self.either: list[tuple[int, str]] = []  # positions and cells such as 1,234
        self.grouped = grouped  # whether thousands are known to stand in groups
        self.states: dict[str, array[int]] = {}  # positions of words such as ON
        self.apart: list[tuple[int, str]] = []  # positions and cells such as 1 234
        self.spaced = False  # whether spaces are known to stand between thousands
        self.units: dict[str, _Cells] = {}  # such as 12 %, by what stands behind the number

    def read(self, start: int, cells: Cells, rows: npt.NDArray[np.int64]) -> None:
        values = self.column.values[start : start + len(cells)]
        if not isinstance(cells, list):
            values[:] = cells
            for i in np.flatnonzero(np.isnan(values)).tolist():
                self.column.mark("nothing", int(rows[i]))
        else:
            text = "\n".join(cells)
            if self.decimal == ",":
                text = text.translate(SWAPPED)
            plain = None
            if PLAIN_CHARACTERS.issuperset(text) and text.count("\n") == len(cells) - 1:
                try:
                    plain = [float(word) for word in text.split("\n")]
                except ValueError:
                    plain = None
            if plain is not None:
                values[:] = plain
            else:
                for i, cell in enumerate(cells):
                    values[i] = self._number(start + i, clean(cell), int(rows[i]))
        self._drop_beyond_reason(values, rows)

    def finish(self, rows: npt.NDArray[np.int64], findings: Findings, switches: Collection[str]) -> Column:
        column = self.column
        for at, cell in self.apart:
            if self.spaced:
                column.values[at] = float(cell.replace(" ", ""))
            else:
                self.unclear.setdefault(cell, []).append(int(rows[at]))
        self._take_units(rows, findings)
        if column.name in switches:
            self._take_states(findings)
        if self.either and self.grouped:
            for at, cell in self.either:
                column.values[at] = float(cell.replace(",", ""))
        elif self.either:
            at, cell = self.either[0]
            cell = cell.translate(SWAPPED) if self.decimal == "," else cell
            findings.doubt(
                f"{column.name}: {cell!r} in row {rows[at]} and {len(self.either) - 1} more like it may have "
                "grouped thousands or another decimal mark; pass decimal (--decimal)"
            )
        for what, places in list(self.unclear.items())[:3]:
            findings.doubt(
                f"expected a number in {rows_text(places)}, column {column.name!r}, received {shown(what)}; "
                "if it marks a missing value, name it in bad (--bad)"
            )
        if len(self.unclear) > 3:
            findings.doubt(f"{column.name}: {len(self.unclear) - 3} other cells that are no numbers")
        self._drop_marked_numbers(rows, findings)
        self._drop_out_of_range(rows)
        if not self.unclear and not self.either and np.isnan(column.values).all():
            found = ", ".join(list(column.marks)[:5])
            hint = (
                ""
                if set(column.marks) <= {"nothing"}
                else "; only inputs may be words, and of these only two such as ON and OFF; save others as numbers"
            )
            findings.doubt(f"expected numbers in column {column.name!r}, received only {found}{hint}")
        return column

    def _number(self, at: int, cell: str, row: int) -> float:
        """The number in a cell, or not-a-number and a remark why."""
        if cell.casefold() in self.reading.bad:
            self.column.mark(shown(cell), row)
            return np.nan
        word = cell.translate(SWAPPED) if self.decimal == "," else cell
        if SPACED.fullmatch(word):
            word = SPACE.sub("", word)
        elif APART_FOR_SURE.fullmatch(word):
            self.spaced, word = True, word.replace(" ", "")
        if POINT.fullmatch(word):
            return float(word)
        if GROUPED.fullmatch(word):
            self.grouped = self.grouped or GROUPED_FOR_SURE.fullmatch(word) is not None
            self.either.append((at, word))
        elif cell == "":
            self.column.mark("nothing", row)
        elif not DIGIT.search(cell) or MARK.search(cell):
            self.column.mark(shown(cell), row)
            if cell.casefold() in STATES:
                self.states.setdefault(cell.casefold(), array("q")).append(at)
        elif APART.fullmatch(word):
            self.apart.append((at, cell))
        else:
            number, unit = without_unit(word)
            if unit and (POINT.fullmatch(number) or GROUPED_FOR_SURE.fullmatch(number)):
                alike = self.units.setdefault(unit, _Cells(cell, array("q"), array("d")))
                alike.places.append(at)
                alike.numbers.append(float(number.replace(",", "")))
            else:
                self.unclear.setdefault(cell, []).append(row)
        return np.nan

    def _take_units(self, rows: npt.NDArray[np.int64], findings: Findings) -> None:
        """Numbers with a unit behind them count where each number of the column has it, and the same one."""
        column = self.column
        if len(self.units) == 1 and not (self.unclear or self.either) and np.isnan(column.values).all():
            [(unit, alike)] = self.units.items()
            column.values[np.frombuffer(alike.places, dtype=np.int64)] = alike.numbers
            column.unit = unit.translate(SWAPPED) if self.decimal == "," else unit
            findings.note(f"{column.name}: {shown(column.unit)} stands behind each number, read as its unit")
            return
        for alike in self.units.values():
            self.unclear.setdefault(alike.first, []).extend(rows[list(alike.places)].tolist())

    def _take_states(self, findings: Findings) -> None:
        """Two states in words as 0 and 1, where there is no number."""
        column, pair = self.column, states(frozenset(self.states))
        if pair is None or not np.isnan(column.values).all() or self.unclear or self.either:
            return
        for word, at in self.states.items():
            column.values[np.frombuffer(at, dtype=np.int64)] = float(word == pair[1])
        for what in [what for what in column.marks if what.strip("'\"").casefold() in pair]:
            del column.marks[what]
        off, on = (word.upper() for word in pair)
        findings.change(
            f"{column.name}: words read as numbers, {off} as 0 and {on} as 1; a controller that is to "
            "switch it, and take no value between, has levels (rules of a study)"
        )

    def _drop_beyond_reason(self, values: Array, rows: npt.NDArray[np.int64]) -> None:
        for i in np.flatnonzero(np.abs(values) >= LARGEST):
            self.column.mark("infinite" if np.isinf(values[i]) else f"{values[i]:g}", int(rows[i]))
            values[i] = np.nan

    def _drop_marked_numbers(self, rows: npt.NDArray[np.int64], findings: Findings) -> None:
        values, name = self.column.values, self.column.name
        named = [float(word) for word in self.reading.bad if POINT.fullmatch(word)]
        self._drop(np.isin(values, named), rows)
        low, high = self.reading.ranges.get(name, (np.inf, -np.inf))
        suspects = [mark for mark in MARKS if not low <= mark <= high]
        suspect = np.isin(values, suspects)
        others = values[~suspect & ~np.isnan(values)]
        if not suspect.any() or not others.size:
            return
        least, most = float(others.min()), float(others.max())
        for mark in np.unique(values[suspect]):
            distance = max(least - mark, mark - most)
            if distance > most - least or mark < 0 <= least:
                self._drop(values == mark, rows)
            elif distance > 0:
                findings.doubt(
                    f"{name}: {mark:g} in {rows_text(rows[values == mark])} may be a value or a mark for a "
                    "missing one; name it in bad (--bad), or state a range that holds it (--range)"
                )

    def _drop_out_of_range(self, rows: npt.NDArray[np.int64]) -> None:
        low, high = self.reading.ranges.get(self.column.name, (-np.inf, np.inf))
        values = self.column.values
        self._drop((values < low) | (values > high), rows, f"outside {low:g} to {high:g}")

    def _drop(
        self, where: npt.NDArray[np.bool_], rows: npt.NDArray[np.int64], why: str | None = None
    ) -> None:
        for i in np.flatnonzero(where):
            self.column.mark(why or f"{self.column.values[i]:g}", int(rows[i]))
        self.column.values[where] = np.nan


def _decimal_mark(sheet: Sheet, columns: Sequence[int], findings: Findings) -> str:
    """The decimal mark, from the first cells that leave no choice."""
    either = None
    for part in sheet.chunks(columns):
        for cells in part:
            for cell in cells if isinstance(cells, list) else ():
                if "," not in cell and "." not in cell:
                    continue
                word = ungrouped(without_unit(clean(cell))[0])
                if EITHER.fullmatch(word):
                    either = either or word
                    continue
                point, comma = has_point(word), has_point(word.translate(SWAPPED))
                if point != comma:
                    return "." if point else ","
    if either is None:
        return "."
    if sheet.separator == ";" and "," in either:
        findings.note(
            f"numbers such as {either} are read with a decimal comma, as fields are separated by semicolons"
        )
        return ","
    if "," in either:
        findings.doubt(
            f"numbers such as {either!r} may have a decimal comma or grouped thousands; pass decimal (--decimal)"
        )
    elif sheet.separator not in (None, ",") and _whole_beside_grouped(sheet, columns):
        findings.doubt(
            f"numbers such as {either!r} stand beside whole ones below a thousand and none above: they may be grouped "
            "thousands; pass decimal (--decimal)"
        )
    return "."


def _whole_beside_grouped(sheet: Sheet, columns: Sequence[int]) -> bool:
    """Whether a column holds both 7.198 and 64, and none holds 7198."""
    found: list[set[str]] = [set() for _ in columns]
    for part in sheet.chunks(columns):
        for kinds, cells in zip(found, part, strict=True):
            for cell in cells if isinstance(cells, list) else ():
                word = without_unit(clean(cell))[0].lstrip("+-")
                if EITHER.fullmatch(word):
                    kinds.add("either")
                elif word.isdigit() and len(word) > 1:
                    kinds.add("small" if len(word) < 4 else "large")
    return any({"either", "small"} <= kinds for kinds in found) and not any(
        "large" in kinds for kinds in found
    )
