"""What an export holds, before anybody decides what to identify from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.identification.excitation import FEW_MOVES, missing_movement
from mampc.identification.export.clock import Clock, read_clock
from mampc.identification.export.findings import Findings
from mampc.identification.export.grid import make_grid, pieces
from mampc.identification.export.header import find_column
from mampc.identification.export.numbers import Column, read_numbers, says_numbers
from mampc.identification.export.on_change import RARE, hint_of_changes, hold_last, sampled
from mampc.identification.export.quality import drop_bad_quality, is_quality
from mampc.identification.export.reading import ReadingOptions, listed, readings
from mampc.identification.export.sheet import Sheet
from mampc.identification.export.suspects import note_suspects
from mampc.identification.export.tall import open_table

HELD = 0.5  # share of samples: what keeps its value more often moves in steps


@dataclass(frozen=True, eq=False)
class ColumnSummary:
    """One column of numbers.

    Attributes:
        name, unit: as they stand in the file; an empty unit where there is none.
        values: in the order of time, not-a-number where there is none; shape (n,).
        marks: what stands in the place of numbers, as a sentence; empty where nothing does.
        missing: how many rows have no number.
        moves: how often the value changes from one sample to the next.
        held: the median of how many samples it keeps a value.
        verdict: what its movement makes of it.
    """

    name: str
    unit: str
    values: Array
    marks: str
    missing: int
    moves: int
    held: float
    verdict: str


@dataclass(frozen=True, eq=False)
class Inspection:
    """An export, looked at.

    Attributes:
        origin: the file.
        columns: those with numbers, the column of times left out.
        others: names of columns without numbers.
        time: the column of times, or empty.
        seconds: of the rows in order, shape (n,).
        dt: seconds between samples, or None where they are not even.
        start, end: the first and last moment, as text.
        pieces: numbers of rows between gaps.
        excitation: what is missing in the movement of the inputs, a sentence each.
        notes: all that was noticed.
        doubts: what has to be decided before a record can be read.
    """

    origin: str
    columns: tuple[ColumnSummary, ...]
    others: tuple[str, ...]
    time: str
    seconds: Array
    dt: float | None
    start: str
    end: str
    pieces: tuple[int, ...]
    excitation: tuple[str, ...]
    notes: tuple[str, ...]
    doubts: tuple[str, ...]


def inspect_export(
    source: Any,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    disturbances: Sequence[str] = (),
    dt: float | None = None,
    **options: Unpack[ReadingOptions],
) -> Inspection:
    """Look at an export as `read_export` would read it, without refusing what it cannot decide.

    Args:
        source: path of a file, or a pandas DataFrame.
        inputs, outputs, disturbances: columns to look at; default all that hold numbers.
        dt: sample time in seconds, where there is no column of times.
        options: see `ReadingOptions`.

    Raises:
        MampcError: a file that cannot be read at all.
    """
    findings = Findings(str(source) if isinstance(source, (str, Path)) else "DataFrame")
    wanted = (*listed(inputs), *listed(disturbances), *listed(outputs))
    how, reading = readings(options, wanted or None)
    if dt is not None:
        dt = as_number("dt", dt, 0.0, exclusive=True)
    measured = listed(options.get("no_quality", ()))
    sheet = open_table(source, wanted, how, findings, options.get("encoding"), measured)
    taken = [at for name in wanted if (at := find_column(sheet.header, name)) is not None]
    qualities = [at for at in range(len(sheet.header)) if at not in taken and is_quality(sheet, at, measured)]
    clock = read_clock(sheet, [*taken, *qualities], how, findings)
    free = [
        at
        for at in range(len(sheet.header))
        if at not in (*qualities, *(clock.columns if clock else ())) and sheet.header[at]
    ]
    positions = dict(zip(wanted, taken, strict=True)) or _numeric(sheet, free)
    others = tuple(sheet.header[at] for at in free if at not in positions.values()) if not wanted else ()
    switches = [name for name in positions if name not in listed(outputs)]
    columns, values = read_numbers(sheet, positions, reading, findings, switches)
    drop_bad_quality(sheet, columns, positions, listed(options.get("good", ())), measured, findings)
    for column in columns:
        if column.marks:
            findings.note(str(column))
    on_change = listed(options.get("on_change", ()))
    hint_of_changes(values, list(positions), on_change, findings)
    if on_change:
        hold_last(sheet, positions, on_change, clock, values, findings)
    held = np.array([name in on_change for name in positions])
    clock, values, numbers = sampled(clock, values, sheet.numbers, held, dt, findings)
    for column, own in zip(columns, values.T, strict=True):
        column.values = own
    grid = make_grid(clock, values, numbers, dt, findings)
    order, seconds = (np.arange(len(values)), np.arange(len(values)) * 1.0)
    lengths: tuple[int, ...] = (len(values),)
    if grid is not None:
        order, seconds = grid.order, grid.seconds
        usable = (
            np.asarray(~np.isnan(values[order]).any(axis=1)) if wanted else np.ones(len(order), dtype=bool)
        )
        fill = options.get("fill", 0)
        lengths = tuple(len(piece) for piece in pieces(grid, clock, usable, numbers, findings, fill))
    elif clock is not None:
        order = np.argsort(clock.seconds, kind="stable")[: np.count_nonzero(~np.isnan(clock.seconds))]
        seconds = clock.seconds[order]
    for column in columns:
        if column.name not in (*listed(inputs), *listed(disturbances)):
            note_suspects(column.name, column.values[order], numbers[order], findings)
    summaries = tuple(
        _summary(column, sheet.units.get(positions[column.name], column.unit), order) for column in columns
    )
    return Inspection(
        findings.origin, summaries, others, clock.name if clock else "", seconds, grid.dt if grid else None,
        *_ends(clock, seconds), lengths, tuple(_missing_excitation(summaries, listed(inputs))),
        tuple(findings.notes), tuple(findings.doubts),
    )  # fmt: skip


def _numeric(sheet: Sheet, free: Sequence[int]) -> dict[str, int]:
    """Columns with numbers in more than half of the first rows' filled cells; of two with one name, the first."""
    found: dict[str, int] = {}
    for at in free:
        if says_numbers([row[at] for row in sheet.sample]):
            found.setdefault(sheet.header[at], at)
    return found


def _ends(clock: Clock | None, seconds: Array) -> tuple[str, str]:
    if clock is None or not len(seconds):
        return "", ""
    return clock(float(seconds[0])), clock(float(seconds[-1]))


def _summary(column: Column, unit: str, order: Any) -> ColumnSummary:
    values = column.values[order]
    known = values[~np.isnan(values)]
    changes = np.flatnonzero(np.diff(known))
    moves = len(changes)
    held = float(np.median(np.diff(changes))) if moves > 1 else float(len(known))
    if len(known) < RARE * len(values):
        verdict = "has few values: stored on change?"
    elif not moves:
        verdict = "never moves"
    elif moves > HELD * (len(known) - 1):
        verdict = "moves at nearly every sample: measured, or under control"
    elif moves < FEW_MOVES:
        verdict = "moves in steps: too few for an input"
    else:
        verdict = "moves in steps: could be an input"
    missing = len(values) - len(known)
    return ColumnSummary(
        column.name, unit, values, str(column) if column.marks else "", missing, moves, held, verdict
    )


def _missing_excitation(columns: Sequence[ColumnSummary], inputs: Sequence[str]) -> list[str]:
    """What the inputs' movement leaves open, of the columns named, else of those that could be inputs."""
    chosen = {
        column.name: column.values
        for column in columns
        if column.name in inputs or (not inputs and column.verdict.endswith("could be an input"))
    }
    if not chosen:
        return ["no column moves in steps, up and down, as an input under test does"]
    return missing_movement(list(chosen), [np.column_stack(list(chosen.values()))])
