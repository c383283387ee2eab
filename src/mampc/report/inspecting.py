"""An export looked at: its columns as a table and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.drawing import BLUE, VERMILION, new_figure, plain, styled, time_scale
from mampc.identification.export import Inspection

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS = 24
SHOWN_POINTS = 3000  # of a column; more are drawn as the band between the least and the largest


def inspection_table(seen: Inspection) -> Any:
    """One row a column."""
    from rich.markup import escape
    from rich.table import Column, Table

    from mampc.report.columns import numbers

    told = numbers("rows with a number", "least", "mean", "largest", "moves")
    table = Table("column", "unit", *told, Column("movement", overflow="fold"))
    for column in seen.columns:
        known = column.values[~np.isnan(column.values)]
        figures = (
            [f"{value:.5g}" for value in (known.min(), known.mean(), known.max())]
            if len(known)
            else ["-"] * 3
        )
        rows = f"{len(column.values) - column.missing} of {len(column.values)}"
        table.add_row(
            escape(column.name), escape(column.unit), rows, *figures, str(column.moves), column.verdict
        )
    return table


def inspection_words(seen: Inspection) -> list[str]:
    """Span, sample time and pieces, a line each."""
    lines = []
    if seen.time:
        lines.append(f"Times in {seen.time}: from {seen.start} to {seen.end}")
    if seen.dt is not None:
        split = (
            "" if len(seen.pieces) < 2 else f", in {len(seen.pieces)} pieces of {_some(seen.pieces)} samples"
        )
        lines.append(f"Sampled every {seen.dt:g} s{split}")
    if seen.others:
        lines.append(f"Without numbers: {', '.join(seen.others)}")
    return lines


def inspection_figure(seen: Inspection) -> Figure:
    """Every column over time, and where it has no number."""
    shown = seen.columns[:MOST_PANELS]
    with styled():
        figure, axes = new_figure(len(shown), height=0.9, sharex=True)
        since = seen.seconds - (seen.seconds[0] if len(seen.seconds) else 0.0)
        known_step = seen.dt is not None or bool(seen.time)
        scale, unit = time_scale(since) if known_step else (1.0, "rows")
        for column, panel in zip(shown, axes[:, 0], strict=True):
            _draw(panel, since / scale, column.values, seen.dt / scale if seen.dt else None)
            title = f"{column.name} ({column.unit})" if column.unit else column.name
            panel.set_title(plain(f"{title}: {column.verdict.split(':')[0]}", 90))
        start = f", from {seen.start}" if seen.start else ""
        axes[-1, 0].set_xlabel(f"time ({unit}){start}" if unit != "rows" else "rows")
        axes[-1, 0].set_xlim(0, since[-1] / scale if len(since) and since[-1] else None)
    return figure


def _draw(panel: Axes, time: Array, values: Array, dt: float | None) -> None:
    """A line with breaks at gaps, and a mark below where there is no number."""
    missing = np.isnan(values)
    if dt is not None:
        gaps = np.flatnonzero(np.diff(time) > 1.5 * dt) + 1
        time, values = np.insert(time, gaps, time[gaps - 1] + dt), np.insert(values, gaps, np.nan)
        missing = np.insert(missing, gaps, False)
    if len(time) <= SHOWN_POINTS:
        panel.plot(time, values, color=BLUE, linewidth=0.9, drawstyle="steps-post")
    else:
        size = -(-len(time) // SHOWN_POINTS)
        whole = len(time) // size * size
        parts = values[:whole].reshape(-1, size)
        least, most = (np.where(np.isnan(parts), far, parts) for far in (np.inf, -np.inf))
        low, high = least.min(axis=1), most.max(axis=1)
        low[~np.isfinite(low)] = high[~np.isfinite(high)] = np.nan
        panel.fill_between(time[:whole:size], low, high, color=BLUE, linewidth=0.6)
    if missing.any():
        panel.plot(
            time[missing], np.zeros(int(missing.sum())), "|", color=VERMILION, markersize=6,
            transform=panel.get_xaxis_transform(), clip_on=False,
        )  # fmt: skip


def _some(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers[:6])) + (", ..." if len(numbers) > 6 else "")
