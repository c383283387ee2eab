"""Even samples out of rows as recorded: put in order, each once, split at gaps, resampled where they stray."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import counted
from mampc.identification.export.clock import Clock
from mampc.identification.export.findings import MOST_SHOWN, Findings, rows_text

STRAYING = 0.01  # of dt: rows whose times stray less from even steps are taken as even
GAP = 1.5  # of dt between rows
SAME_STEP = 0.01  # relative: a dt given and one read that differ by more contradict each other
MOST_SHIFTS = 3  # uneven steps that say that the clock was set, and nothing of the sample time
UNEVEN = 0.3  # of the usual step: one that far from any whole number of usual steps is uneven
MOST_UNEVEN = 0.2  # of all steps; where more are uneven, the record has no sample time
MOST_GAPS = 1 / 3  # of all steps


@dataclass(frozen=True, eq=False)
class Grid:
    """Rows in the order of time.

    Attributes:
        dt: seconds between samples.
        order: positions of rows, in order, each time once; shape (n,).
        seconds: of these rows.
    """

    dt: float
    order: npt.NDArray[np.int64]
    seconds: Array


def make_grid(
    clock: Clock | None, values: Array, numbers: npt.NDArray[np.int64], dt: float | None, findings: Findings
) -> Grid | None:
    """The order of rows and their sample time; None where there is a doubt about it.

    Args:
        clock: times of the rows, or None where the file has none and `dt` says it.
        values: all wanted columns, shape (N, columns), not-a-number where there is none; changed where two rows of one
            time contradict each other.
        numbers: of the rows in the file.
        dt: sample time that was asked for.
        findings: receives notes and doubts.
    """
    if clock is None:
        if dt is None and findings.doubts:
            return None
        if dt is None:
            findings.doubt(
                "expected a column of times; name it (time, --time), or pass the sample time (dt, --dt)"
            )
            return None
        return Grid(dt, np.arange(len(values)), np.arange(len(values)) * dt)
    if clock.doubtful:
        return None
    order = _each_once(_in_order(clock, numbers, findings), clock.seconds, values, numbers, findings)
    if order is None:
        return None
    seconds = clock.seconds[order]
    if len(seconds) < 2:
        findings.doubt(f"expected an evenly increasing time column, received {len(seconds)} different times")
        return None
    found = _step(seconds, clock, numbers[order], findings)
    if found is None:
        return None
    if dt is not None and abs(dt - found) > SAME_STEP * found:
        findings.doubt(
            f"dt: expected {found:.6g} s, the step of column {clock.name!r}, received {dt:.6g} s; "
            "leave it out (--dt), or say what unit the times have (time_unit, --time-unit)"
        )
        return None
    if dt is not None and abs(dt - found) > 1e-6 * found:
        findings.change(
            f"the step of column {clock.name!r} is {found:.8g} s; resampled every {dt:.8g} s, as asked for"
        )
    return Grid(found if dt is None else dt, order, seconds)


def bridged(
    grid: Grid, values: Array, inputs: int, fill: int, names: Sequence[str], findings: Findings
) -> Array:
    """Rows in order, with up to `fill` missing values in a row of a column put in.

    The first columns are inputs, which keep their value; the others lie on a line between their neighbours.
    """
    values = values.copy()
    for j, column in enumerate(values.T):
        known = np.flatnonzero(~np.isnan(column))
        holes = np.flatnonzero(np.diff(known) > 1)
        short = np.diff(grid.seconds[known])[holes] <= (fill + GAP) * grid.dt
        short &= np.diff(known)[holes] <= fill + 1
        put = np.concatenate(
            [np.arange(known[h] + 1, known[h + 1]) for h in holes[short]] or [np.empty(0, dtype=np.int64)]
        )
        if not len(put):
            continue
        if j < inputs:
            column[put] = column[known[np.searchsorted(known, put) - 1]]
        else:
            column[put] = np.interp(grid.seconds[put], grid.seconds[known], column[known])
        how = "the one before" if j < inputs else "on a line between its neighbours"
        findings.change(f"{names[j]}: {counted(len(put), 'missing value')} put in, each {how}")
    return values


def pieces(
    grid: Grid,
    clock: Clock | None,
    usable: BoolArray,
    numbers: npt.NDArray[np.int64],
    findings: Findings,
    fill: int = 0,
) -> list[npt.NDArray[np.int64]]:
    """Positions in the grid of runs of usable rows without a gap in time of more than `fill` samples."""
    kept = np.flatnonzero(usable)
    if not kept.size:
        return []
    seconds = grid.seconds[kept]
    steps = np.diff(seconds) / grid.dt
    cuts = np.flatnonzero(steps > fill + GAP)
    closed = np.flatnonzero((steps > GAP) & (steps <= fill + GAP))
    if len(closed):
        rows = rows_text(numbers[grid.order[kept[closed]]])
        findings.change(
            f"{counted(len(closed), 'gap')} of up to {counted(fill, 'sample')} closed, after {rows}"
        )
    if len(cuts):
        lines = []
        for cut in cuts[:MOST_SHOWN]:
            lost = round((seconds[cut + 1] - seconds[cut]) / grid.dt) - 1
            last = numbers[grid.order[kept[cut]]]
            since = f" ({clock(seconds[cut])})" if clock else ""
            lines.append(f"{lost} after row {last}{since}")
        more = f" and {len(cuts) - MOST_SHOWN} more gaps" if len(cuts) > MOST_SHOWN else ""
        findings.change(
            f"{counted(len(cuts), 'gap')} in the record, which is split there; samples missing: "
            f"{', '.join(lines)}{more}"
        )
    if kept[0] > 0:
        findings.change(
            f"{counted(int(kept[0]), 'row')} at the beginning without a complete set of values left out"
        )
    if kept[-1] < len(usable) - 1:
        findings.change(
            f"{counted(len(usable) - 1 - int(kept[-1]), 'row')} at the end without a complete set of values left out"
        )
    return np.split(kept, cuts + 1)


def resampled(seconds: Array, held: Array, changing: Array, dt: float) -> tuple[Array, Array, float]:
    """One piece every dt from its first row on.

    Args:
        seconds: of its rows, shape (n,), gaps excluded.
        held: signals that keep their value between rows, shape (n, m): each sample takes the nearest row's.
        changing: signals that go on between rows, shape (n, l): each sample lies on the line between two rows.
        dt: seconds between samples.

    Returns:
        Both, shape (samples, m) and (samples, l), and how far a row strays from its place, in dt; where that is next
        to nothing, the rows are the samples.
    """
    places = (seconds - seconds[0]) / dt
    straying = places - np.arange(len(seconds))
    middle = (straying.max() + straying.min()) / 2
    largest = float(np.abs(straying - middle).max())
    if largest <= STRAYING:
        return held, changing, largest
    at = np.arange(int(np.floor(places[-1] + STRAYING)) + 1, dtype=np.float64)
    right = np.clip(np.searchsorted(places, at), 1, len(places) - 1)
    nearest = np.where(at - places[right - 1] <= places[right] - at, right - 1, right)
    lines = np.column_stack([np.interp(at, places, signal) for signal in changing.T])
    strays = float(np.abs(places - np.round(places)).max())
    return held[nearest], lines, strays


def _in_order(clock: Clock, numbers: npt.NDArray[np.int64], findings: Findings) -> npt.NDArray[np.int64]:
    """Positions of rows whose time is known, the earliest first."""
    known = np.flatnonzero(~np.isnan(clock.seconds))
    seconds = clock.seconds[known]
    steps = np.diff(seconds)
    if len(steps) and (steps <= 0).all() and (steps < 0).any():
        findings.change("rows run backwards in time; put in order")
        return known[::-1]
    late = np.flatnonzero(steps < 0)
    if not len(late):
        return known
    findings.change(
        f"rows are not in the order of time, first in row {numbers[known[late[0] + 1]]} "
        f"({counted(len(late), 'step')} back); put in order"
    )
    return known[np.argsort(seconds, kind="stable")]


def _each_once(
    order: npt.NDArray[np.int64],
    seconds: Array,
    values: Array,
    numbers: npt.NDArray[np.int64],
    findings: Findings,
) -> npt.NDArray[np.int64] | None:
    """One row for each time: what rows of one time agree on; where they do not, no value. None where many are not."""
    first = np.flatnonzero(np.diff(seconds[order], prepend=-np.inf) > 0)
    if len(first) == len(order):
        return order
    repeated = np.flatnonzero(np.diff(first, append=len(order)) > 1)
    contradicting, rows = [], []
    for group in repeated:
        members = order[first[group] : first[group + 1] if group + 1 < len(first) else len(order)]
        same = values[members]
        rows.extend(numbers[members[1:]].tolist())
        for j, column in enumerate(same.T):
            known = np.unique(column[~np.isnan(column)])
            if len(known) > 1:
                contradicting.append(int(numbers[members[1]]))
            values[members[0], j] = known[0] if len(known) == 1 else np.nan
    findings.change(f"times stand more than once in {rows_text(sorted(rows))}; each kept once")
    if contradicting:
        places = rows_text(sorted(set(contradicting)))
        verb = "contradicts" if len(set(contradicting)) == 1 else "contradict"
        findings.change(f"{places} {verb} another row of the same time; neither is used")
    if contradicting and len(repeated) > MOST_UNEVEN * len(first):
        findings.doubt(
            f"expected a time for each sample, received {len(repeated)} of {len(first)} times more than once, first in "
            f"row {min(rows)}; export times with more digits, or with the column that tells their hours and minutes"
        )
        return None
    return order[first]


def _step(seconds: Array, clock: Clock, numbers: npt.NDArray[np.int64], findings: Findings) -> float | None:
    """The seconds between samples, as round as the record allows."""
    steps = np.diff(seconds)
    usual = float(np.median(steps))
    whole = np.maximum(np.round(steps / usual), 1.0)
    uneven = np.abs(steps / usual - whole) > UNEVEN
    if uneven.mean() > MOST_UNEVEN or (steps > GAP * usual).mean() > MOST_GAPS:
        kinds = Counter(float(f"{step:.3g}") for step in steps.tolist()).most_common(4)
        shown = ", ".join(f"{step:g} s ({count})" for step, count in kinds)
        first = int(np.flatnonzero(uneven | (steps > GAP * usual))[0])
        findings.doubt(
            f"expected an evenly increasing time column, received in {clock.name!r} steps of {shown}, the first of "
            f"another length before row {numbers[first + 1]}; export evenly sampled values"
        )
        return None
    # The mean over the longest runs without a gap: jitter of single rows cancels.
    together = steps <= GAP * usual
    if uneven.sum() <= MOST_SHIFTS:
        together &= ~uneven
    edges = np.flatnonzero(np.diff(np.concatenate(([False], together, [False])).astype(int)))
    begins, ends = edges[::2], edges[1::2]
    mean = float(np.sum(seconds[ends] - seconds[begins]) / np.sum(ends - begins))
    longest = int((ends - begins).max())
    unknown = max(STRAYING * mean / 2, float(np.std(steps[together])))  # of the length of a run
    for digits in range(1, 16):
        rounded = float(f"{mean:.{digits}g}")
        if abs(rounded - mean) * longest <= unknown:
            return rounded
    return mean
