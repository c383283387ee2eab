"""The wanted columns of an export as numbers, and when each row was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array
from mampc.base.errors import MampcError, shown
from mampc.identification.export.cells import STATES, says_numbers
from mampc.identification.export.clock import Clock, read_clock
from mampc.identification.export.findings import Findings
from mampc.identification.export.header import find_column
from mampc.identification.export.numbers import Column, Reading, read_numbers
from mampc.identification.export.on_change import hint_of_changes, hold_last, sampled
from mampc.identification.export.quality import drop_bad_quality, is_quality
from mampc.identification.export.sheet import Sheet
from mampc.identification.export.stamps import TimeReading
from mampc.identification.export.tall import open_table


class ReadingOptions(TypedDict, total=False):
    """How an export is read, where that is not plain from the file; messages say which one they miss.

    time: column of times; default found.
    time_unit: of times that are numbers: "ns", "us", "ms", "s", "min", "h" or "d".
    time_format: of time stamps, as in `strptime`.
    time_zone: of local time stamps, such as "Europe/Berlin".
    decimal: "." or ",".
    encoding: of a text that is neither UTF-8 nor UTF-16, such as "cp932"; default Windows-1252.
    bad: further words and numbers that stand in the place of a missing value.
    good: words of quality columns that mean a good value.
    no_quality: columns that say nothing of others, though they are called so, such as the quality of a product.
    ranges: lowest and highest believable value of columns, {"TI101": (0.0, 200.0)}.
    fill: up to so many samples in a row may be made up where they are missing: inputs are held, outputs lie on lines;
        default none.
    on_change: columns that are stored only when they change: their last value holds in empty cells.
    """

    time: str | None
    time_unit: str | None
    time_format: str | None
    time_zone: str | None
    decimal: str | None
    encoding: str | None
    bad: Sequence[str]
    good: Sequence[str]
    no_quality: Sequence[str]
    ranges: Mapping[str, tuple[float, float]]
    fill: int
    on_change: Sequence[str]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of numbers; nothing else of the file is kept.

    Attributes:
        columns: their names, units and what stands in the place of numbers.
        others: names of columns that were not asked for and hold no numbers.
        clock: when the rows were recorded; None where no column tells it.
        values: shape (N, columns), not-a-number where there is none.
        numbers: of the rows in the file.
    """

    columns: list[Column]
    others: tuple[str, ...]
    clock: Clock | None
    values: Array
    numbers: npt.NDArray[np.int64]


def read_table(
    source: Any,
    wanted: Sequence[str],
    outputs: Sequence[str],
    options: ReadingOptions,
    dt: float | None,
    findings: Findings,
) -> Table:
    """Read the wanted columns of an export, all with numbers where none is named; those of `outputs` hold no switches.

    Raises:
        MampcError: a file that cannot be read at all, or a wrong option.
    """
    how = TimeReading(
        options.get("time"), options.get("time_unit"), options.get("time_format"), options.get("time_zone")
    )
    reading = Reading(options.get("decimal"), listed(options.get("bad", ())), options.get("ranges", {}))
    unknown = [name for name in reading.ranges if wanted and name not in wanted]
    if unknown:
        raise MampcError(f"ranges: expected names among {tuple(wanted)}, received {shown(unknown[0])}")
    measured, on_change = listed(options.get("no_quality", ())), listed(options.get("on_change", ()))
    sheet = open_table(source, wanted, how, findings, options.get("encoding"), measured)
    positions = {name: at for name in wanted if (at := find_column(sheet.header, name)) is not None}
    taken = list(positions.values())
    taken += [at for at in range(len(sheet.header)) if at not in taken and is_quality(sheet, at, measured)]
    clock = read_clock(sheet, taken, how, findings)
    others: tuple[str, ...] = ()
    if not wanted:
        taken += clock.columns if clock else ()
        free = [at for at in range(len(sheet.header)) if at not in taken and sheet.header[at]]
        positions = _numeric(sheet, free)
        others = tuple(sheet.header[at] for at in free if at not in positions.values())
    columns, values = read_numbers(
        sheet, positions, reading, findings, [name for name in positions if name not in outputs]
    )
    drop_bad_quality(sheet, columns, positions, listed(options.get("good", ())), measured, findings)
    for column in columns:
        column.unit = sheet.units.get(positions[column.name], column.unit)
        if column.marks:
            findings.change(str(column))
    hint_of_changes(values, list(positions), on_change, findings)
    hold_last(sheet, positions, on_change, clock, values, findings)
    held = np.array([name in on_change for name in positions])
    return Table(columns, others, *sampled(clock, values, sheet.numbers, held, dt, findings))


def _numeric(sheet: Sheet, free: Sequence[int]) -> dict[str, int]:
    """Columns with numbers in more than half of the first rows' filled cells; of two with one name, the first.

    A switch that holds one word all along is none of them.
    """
    found: dict[str, int] = {}
    for at in free:
        cells = sheet.first(at)
        if says_numbers(cells) and not (len(set(cells) - {""}) == 1 and _one_word(sheet.words(at))):
            found.setdefault(sheet.header[at], at)
    return found


def _one_word(cells: Sequence[str]) -> bool:
    [word, *others] = {*cells} - {""}
    return not others and word.casefold() in STATES


def origin_of(source: Any) -> str:
    """How messages name what is read."""
    return str(source) if isinstance(source, (str, Path)) else "DataFrame"


def listed(names: Any) -> tuple[Any, ...]:
    """One word or several, as a tuple."""
    return (names,) if isinstance(names, (str, int, float)) else tuple(names)
