"""An export becomes records: the pieces without a gap, and a list of all that was noticed and done."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np

from mampc.base.checks import as_number, as_whole
from mampc.base.errors import MampcError, counted
from mampc.base.names import Names
from mampc.identification.data import IOData
from mampc.identification.export.findings import Findings
from mampc.identification.export.grid import STRAYING, Grid, bridged, make_grid, pieces, resampled
from mampc.identification.export.suspects import note_suspects
from mampc.identification.export.table import ReadingOptions, Table, listed, origin_of, read_table


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
    """Read the named columns of an export: CSV in its many forms, Excel, Parquet, JSON, or a pandas DataFrame.

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
    findings = Findings(origin_of(source))
    names = Names(listed(inputs), listed(outputs), disturbances=listed(disturbances))
    wanted = (*names.inputs, *names.disturbances, *names.outputs)
    if not names.inputs + names.disturbances or not names.outputs:
        raise MampcError(
            f"{findings.origin}: expected at least one input and output, received "
            f"{len(wanted) - len(names.outputs)} and {len(names.outputs)}"
        )
    if dt is not None:
        dt = as_number("dt", dt, 0.0, exclusive=True)
    fill = as_whole("fill", options.get("fill", 0), 0)
    table = read_table(source, wanted, names.outputs, options, dt, findings)
    grid = make_grid(table.clock, table.values, table.numbers, dt, findings)
    findings.require_none()
    assert grid is not None  # else there is a doubt
    names = replace(names, units={column.name: column.unit for column in table.columns if column.unit})
    records, starts = _cut(names, table, grid, fill, findings)
    if not records:
        filled = np.count_nonzero(~np.isnan(table.values), axis=0)
        counts = ", ".join(f"{count} of {name}" for name, count in zip(wanted, filled, strict=True))
        raise MampcError(
            f"{findings.origin}: expected consecutive rows with a number in every column, received numbers in {counts} "
            f"in {len(table.values)} rows; export all columns at the same times, name those that are stored only when "
            "they change (on_change, --on-change), or pass how many values in a row may be made up (fill, --fill)"
        )
    return Export(tuple(records), tuple(findings.notes), tuple(findings.changes), tuple(starts))


def _cut(
    names: Names, table: Table, grid: Grid, fill: int, findings: Findings
) -> tuple[list[IOData], list[str]]:
    """A record for each piece without a gap, and when it begins."""
    clock, values, numbers = table.clock, table.values, table.numbers
    if not np.array_equal(grid.order, np.arange(len(values))):
        values = values[grid.order]
    m, d = len(names.inputs), len(names.disturbances)
    for i, name in enumerate(names.outputs):
        note_suspects(name, values[:, m + d + i], numbers[grid.order], findings)
    if fill:
        values = bridged(grid, values, m, fill, [column.name for column in table.columns], findings)
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
        raise MampcError(
            f"{origin_of(source)}: expected one record, received {len(export.records)} pieces of {lengths} samples "
            f"({gaps}); take them all with read_export(...).records"
        )
    if export.changes:
        warnings.warn("\n".join(export.changes), stacklevel=3)
    return export.records[0]
