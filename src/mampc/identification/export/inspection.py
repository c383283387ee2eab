"""What an export holds, before anybody decides what to identify from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.identification.excitation import FEW_MOVES, missing_movement
from mampc.identification.export.clock import Clock
from mampc.identification.export.findings import Findings
from mampc.identification.export.grid import make_grid, pieces
from mampc.identification.export.numbers import Column
from mampc.identification.export.on_change import RARE
from mampc.identification.export.suspects import note_suspects
from mampc.identification.export.table import ReadingOptions, listed, origin_of, read_table

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
    findings = Findings(origin_of(source))
    wanted = (*listed(inputs), *listed(disturbances), *listed(outputs))
    if dt is not None:
        dt = as_number("dt", dt, 0.0, exclusive=True)
    table = read_table(source, wanted, listed(outputs), options, dt, findings)
    clock, values, numbers = table.clock, table.values, table.numbers
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
    values = values[order]
    for column, own in zip(table.columns, values.T, strict=True):
        if column.name not in (*listed(inputs), *listed(disturbances)):
            note_suspects(column.name, own, numbers[order], findings)
    summaries = tuple(map(_summary, table.columns, values.T))
    return Inspection(
        findings.origin, summaries, table.others, clock.name if clock else "", seconds, grid.dt if grid else None,
        *_ends(clock, seconds), lengths, tuple(_missing_excitation(summaries, listed(inputs))),
        tuple(findings.notes), tuple(findings.doubts),
    )  # fmt: skip


def _ends(clock: Clock | None, seconds: Array) -> tuple[str, str]:
    if clock is None or not len(seconds):
        return "", ""
    return clock(float(seconds[0])), clock(float(seconds[-1]))


def _summary(column: Column, values: Array) -> ColumnSummary:
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
        column.name, column.unit, values, str(column) if column.marks else "", missing, moves, held, verdict
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
