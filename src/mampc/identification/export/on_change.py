"""Tags that a historian stores only when they change: between two values the first one holds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import MampcError, shown
from mampc.identification.export.clock import Clock
from mampc.identification.export.findings import Findings
from mampc.identification.export.sheet import Sheet

RARE = 0.5  # of the rows in which others have values: a column with fewer may be stored on change only
MOST_SAMPLES = 10_000_000  # made of values that are all held


def hold_last(
    sheet: Sheet,
    positions: Mapping[str, int],
    names: Collection[str],
    clock: Clock | None,
    values: Array,
    findings: Findings,
) -> None:
    """Put the last value into empty cells of the named columns, in the order of time, in place.

    A value that is marked as bad is not known, and neither is what follows until the next one.

    Args:
        positions: of the columns of `values`, in its order.
        values: shape (N, columns).

    Raises:
        MampcError: a name that is none of the columns.
    """
    unknown = [name for name in names if name not in positions]
    if unknown:
        raise MampcError(f"on_change: expected names among {tuple(positions)}, received {shown(unknown[0])}")
    order = np.arange(len(values)) if clock is None else np.argsort(clock.seconds, kind="stable")
    for column, (name, at) in zip(values.T, positions.items(), strict=True):
        if name not in names:
            continue
        empty = np.array([not word for word in sheet.words(at)], dtype=bool)[order]
        told = np.where(empty, -1, np.arange(len(order)))
        last = np.maximum.accumulate(told)
        held = np.where(last >= 0, column[order[np.maximum(last, 0)]], np.nan)
        put = np.count_nonzero(empty & ~np.isnan(held))
        column[order] = held
        findings.change(f"{name}: its last value held in {put} rows without one, as asked for (on_change)")


def hint_of_changes(values: Array, names: Collection[str], held: Collection[str], findings: Findings) -> None:
    """Tell of columns that have values in few of the rows in which others have."""
    there = ~np.isnan(values)
    for j, name in enumerate(names):
        total, own = np.count_nonzero(np.delete(there, j, axis=1).any(axis=1)), np.count_nonzero(there[:, j])
        if name not in held and 0 < own < RARE * total:
            findings.note(
                f"{name} has {own} values, others have some in {total} rows; if it is stored only when it changes, "
                "name it in on_change (--on-change), and its last value holds"
            )


def sampled(
    clock: Clock | None,
    values: Array,
    numbers: npt.NDArray[np.int64],
    held: BoolArray,
    dt: float | None,
    findings: Findings,
) -> tuple[Clock | None, Array, npt.NDArray[np.int64]]:
    """The rows at which the other columns were sampled; every `dt` where all columns are held.

    Args:
        numbers: of the rows in the file.
        held: which columns hold their last value.
    """
    if not held.any() or clock is None:
        return clock, values, numbers
    if held.all():
        order = np.argsort(clock.seconds, kind="stable")
        order = order[np.isfinite(clock.seconds[order])]
        order = order[np.cumsum(np.isfinite(values[order]).all(axis=1)) > 0]  # since all have a value
        if dt is None or not len(order):
            findings.doubt(
                "expected a sample time (dt, --dt), as all columns hold their last value (on_change)"
            )
            return clock, values, numbers
        seconds = clock.seconds[order]
        if not (seconds[-1] - seconds[0]) / dt < MOST_SAMPLES:
            findings.doubt(
                f"dt: expected at most {MOST_SAMPLES} samples in {seconds[-1] - seconds[0]:.6g} s, received one every "
                f"{dt:.6g} s"
            )
            return clock, values, numbers
        times = np.arange(seconds[0], seconds[-1] + dt / 2, dt)
        order = order[np.searchsorted(seconds, times, side="right") - 1]
        return replace(clock, seconds=times), values[order], numbers[order]
    kept = ~np.isnan(values[:, ~held]).all(axis=1)
    return replace(clock, seconds=clock.seconds[kept]), values[kept], numbers[kept]
