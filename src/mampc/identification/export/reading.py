"""An export becomes records: the pieces without a gap, and a list of all that was noticed and done."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array, as_number, as_whole
from mampc.base.errors import MampcError, counted, shown
from mampc.base.names import Names
from mampc.identification.data import IOData
from mampc.identification.export.clock import Clock, read_clock
from mampc.identification.export.findings import Findings
from mampc.identification.export.grid import STRAYING, Grid, bridged, make_grid, pieces, resampled
from mampc.identification.export.header import find_column
from mampc.identification.export.numbers import Reading, read_numbers
from mampc.identification.export.on_change import hint_of_changes, hold_last, sampled
from mampc.identification.export.quality import drop_bad_quality, quality_columns
from mampc.identification.export.stamps import TimeReading
from mampc.identification.export.suspects import note_suspects
from mampc.identification.export.tall import open_table


class ReadingOptions(TypedDict, total=False):
    """How an export is read, where that is not plain from the file; messages say which one they miss.

    time: column of times; default found.
    time_unit: of times that are numbers: "ms", "s", "min", "h" or "d".
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
class Export:
    """What an export holds.

    Attributes:
        records: one for each piece without a gap, in the order of time.
        notes: all that was noticed and done, a sentence each.
        changes: those of them after which the records are not simply what stands in the rows.
        starts: when each record begins, as text.
    """

    records: tuple[IOData, ...]
    notes: tuple[str, ...]
    changes: tuple[str, ...]
    starts: tuple[str, ...]


def read_export(
    source: Any,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
    disturbances: Sequence[str] = (),
    dt: float | None = None,
    **options: Unpack[ReadingOptions],
) -> Export:
    """Read the named columns of an export: CSV in its many forms, Excel, Parquet, or a pandas DataFrame.

    No number is made of a mark for a missing or bad value, no gap is closed, and no sample time is changed: rows
    without a complete set of values are left out, and gaps split the record.

    Args:
        source: path of a file, or a DataFrame.
        inputs, outputs: column names, with or without the unit behind them.
        disturbances: columns of inputs that are measured and not manipulated.
        dt: sample time in seconds; default from the column of times, with which it must agree.
        options: see `ReadingOptions`.

    Raises:
        MampcError: a file that cannot be read, or a list of what cannot be decided, with the rows.
    """
    origin = str(source) if isinstance(source, (str, Path)) else "DataFrame"
    findings = Findings(origin)
    names = Names(listed(inputs), listed(outputs), disturbances=listed(disturbances))
    wanted = (*names.inputs, *names.disturbances, *names.outputs)
    if not names.inputs + names.disturbances or not names.outputs:
        raise MampcError(
            f"{origin}: expected at least one input and output, received {len(wanted) - len(names.outputs)} and "
            f"{len(names.outputs)}"
        )
    if dt is not None:
        dt = as_number("dt", dt, 0.0, exclusive=True)
    how, reading = readings(options, wanted)
    fill = as_whole("fill", options.get("fill", 0), 0)

    table = _read_table(source, names, how, reading, options, dt, findings)
    grid = make_grid(table.clock, table.values, table.numbers, dt, findings)
    findings.require_none()
    assert grid is not None  # else there is a doubt
    records, starts = _cut(table, grid, fill, findings)
    if not records:
        filled = np.count_nonzero(~np.isnan(table.values), axis=0)
        counts = ", ".join(f"{count} of {name}" for name, count in zip(wanted, filled, strict=True))
        raise MampcError(
            f"{origin}: expected consecutive rows with a number in every column, received numbers in {counts} in "
            f"{len(table.values)} rows; export all columns at the same times, name those that are stored only when "
            "they change (on_change, --on-change), or pass how many values in a row may be made up (fill, --fill)"
        )
    return Export(tuple(records), tuple(findings.notes), tuple(findings.changes), tuple(starts))


class _Table(NamedTuple):
    """The wanted columns, inputs before disturbances before outputs; nothing else of the file is kept."""

    names: Names
    clock: Clock | None
    values: Array
    numbers: npt.NDArray[np.int64]


def _read_table(
    source: Any,
    names: Names,
    how: TimeReading,
    reading: Reading,
    options: ReadingOptions,
    dt: float | None,
    findings: Findings,
) -> _Table:
    wanted = (*names.inputs, *names.disturbances, *names.outputs)
    sheet = open_table(
        source, wanted, how, findings, options.get("encoding"), listed(options.get("no_quality", ()))
    )
    positions = {name: _position(sheet.header, name) for name in wanted}
    units = {name: sheet.units[at] for name, at in positions.items() if at in sheet.units}
    measured = listed(options.get("no_quality", ()))
    quality = tuple(quality_columns(sheet, positions, measured))
    clock = read_clock(sheet, [*positions.values(), *quality], how, findings)
    columns, values = read_numbers(sheet, positions, reading, findings, (*names.inputs, *names.disturbances))
    units = {column.name: column.unit for column in columns if column.unit} | units
    drop_bad_quality(sheet, columns, positions, listed(options.get("good", ())), measured, findings)
    for column in columns:
        if column.marks:
            findings.change(str(column))
    on_change = listed(options.get("on_change", ()))
    hint_of_changes(values, wanted, on_change, findings)
    hold_last(sheet, positions, on_change, clock, values, findings)
    held = np.array([name in on_change for name in wanted])
    clock, values, numbers = sampled(clock, values, sheet.numbers, held, dt, findings)
    return _Table(replace(names, units=units), clock, values, numbers)


def _cut(table: _Table, grid: Grid, fill: int, findings: Findings) -> tuple[list[IOData], list[str]]:
    """A record for each piece without a gap, and when it begins."""
    names, clock, _, numbers = table
    values = table.values
    if not np.array_equal(grid.order, np.arange(len(values))):
        values = values[grid.order]
    m, d = len(names.inputs), len(names.disturbances)
    for i, name in enumerate(names.outputs):
        note_suspects(name, values[:, m + d + i], numbers[grid.order], findings)
    if fill:
        values = bridged(
            grid, values, m, fill, (*names.inputs, *names.disturbances, *names.outputs), findings
        )
    usable = np.asarray(np.isfinite(values).all(axis=1))
    records, starts, strays, short = [], [], 0.0, 0
    for piece in pieces(grid, clock, usable, numbers, findings, fill):
        whole = len(piece) == piece[-1] - piece[0] + 1  # rows beside each other are not copied
        rows = slice(piece[0], piece[-1] + 1) if whole else piece
        held, changing, straying = resampled(grid.seconds[rows], values[rows, :m], values[rows, m:], grid.dt)
        if len(held) < 2 <= len(usable):
            short += 1
            continue
        strays = max(strays, straying)
        records.append(IOData(np.hstack([held, changing[:, :d]]), changing[:, d:], grid.dt, names))
        first = piece[0]
        starts.append(clock(float(grid.seconds[first])) if clock else f"row {numbers[grid.order[first]]}")
    if short:
        findings.change(f"{counted(short, 'row')} between gaps on both sides left out")
    if strays > STRAYING:
        findings.change(
            f"times stray by up to {strays * grid.dt:.3g} s from even steps of {grid.dt:.8g} s: resampled, outputs on "
            "straight lines between rows, inputs from the nearest row"
        )
    elif strays > 1e-6:
        findings.note(
            f"times stray by up to {strays * grid.dt:.2g} s from even steps of {grid.dt:.8g} s; taken as even"
        )
    return records, starts


def read_one(source: Any, **options: Any) -> IOData:
    """The one record of an export; warns of what was changed.

    Raises:
        MampcError: as `read_export`, or gaps that split the record in several.
    """
    export = read_export(source, **options)
    if len(export.records) > 1:
        lengths = ", ".join(str(len(record)) for record in export.records[:8])
        gaps = "; ".join(note for note in export.notes if "in the record, which is split there" in note)
        origin = str(source) if isinstance(source, (str, Path)) else "DataFrame"
        raise MampcError(
            f"{origin}: expected one record, received {len(export.records)} pieces of {lengths} samples ({gaps}); "
            "take them all with read_export(...).records"
        )
    if export.changes:
        warnings.warn("\n".join(export.changes), stacklevel=3)
    return export.records[0]


def readings(options: ReadingOptions, names: Sequence[str] | None) -> tuple[TimeReading, Reading]:
    """The options, checked; `names` are the columns that may have a range, None for any."""
    how = TimeReading(
        options.get("time"), options.get("time_unit"), options.get("time_format"), options.get("time_zone")
    )
    reading = Reading(options.get("decimal"), listed(options.get("bad", ())), options.get("ranges", {}))
    unknown = [name for name in reading.ranges if names is not None and name not in names]
    if unknown:
        raise MampcError(f"ranges: expected names among {tuple(names or ())}, received {shown(unknown[0])}")
    return how, reading


def _position(header: Sequence[str], name: str) -> int:
    at = find_column(header, name)
    assert at is not None  # the sheet was opened with this name
    return at


def listed(names: Any) -> tuple[Any, ...]:
    """One word or several, as a tuple."""
    return (names,) if isinstance(names, (str, int, float)) else tuple(names)
