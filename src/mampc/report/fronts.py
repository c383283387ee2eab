"""A sweep on paper: its table of runs, fronts of moves against error, and moves at equal error."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from mampc.base.drawing import legend_above, new_figure, plain, styled
from mampc.base.errors import MampcError
from mampc.base.files import written_whole
from mampc.compare.fronts import FEWEST, RATIOS, Estimate, Point, error_ratio, moves_at, non_dominated
from mampc.compare.sweep import points_of
from mampc.loop.drawing import looks
from mampc.report.columns import numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Rows = list[dict[str, Any]]
WIDEST = 2.5  # times the error of plain MPC, that the figure shows; more where a larger one is marked
SHOWN = 1.25  # the ratio of errors that the figure marks and controllers are ranked by


def write_rows(rows: Rows, path: Path) -> None:
    """All runs as CSV, or as Parquet by the file's ending; raises `MampcError` where that needs a missing library."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    if path.suffix == ".parquet":
        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError:
            raise MampcError("--table: expected pyarrow for Parquet, received none installed") from None
        table = pyarrow.table({name: [row.get(name) for row in rows] for name in columns})
        with written_whole(path) as unfinished:
            parquet.write_table(table, unfinished)
        return
    with written_whole(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def scenarios_of(rows: Rows) -> list[str]:
    return list(dict.fromkeys(row["scenario"] for row in rows))


def equal_error(rows: Rows, scenario: str) -> dict[str, dict[float, Estimate]]:
    """Each controller's moves over plain MPC's where its error is `RATIOS` times that of plain MPC."""
    baseline, points = points_of(rows, scenario)
    return {name: {ratio: moves_at(own, baseline, ratio) for ratio in RATIOS} for name, own in points.items()}


def front_tables(rows: Rows) -> Iterator[Table]:
    """Moves at equal error, one table a scenario."""
    for scenario in scenarios_of(rows):
        title = f"{scenario}: moves at equal error, in percent of plain MPC's (standard error)"
        headers = [f"{ratio:g} x MPC's error" for ratio in RATIOS]
        table = Table("controller", *numbers(*headers), title=escape(title), title_justify="left")
        for name, estimates in equal_error(rows, scenario).items():
            table.add_row(escape(name), *(_shown(estimates[ratio]) for ratio in RATIOS))
        yield table


def _shown(estimate: Estimate) -> str:
    if not np.isfinite(estimate.value):
        return "not reached"
    error = f" ({100 * estimate.standard_error:.1f})" if np.isfinite(estimate.standard_error) else ""
    return f"{100 * estimate.value:.1f}{error}"


def front_figure(
    rows: Rows,
    scenario: str,
    marked: float | None = SHOWN,
    *,
    ratio: Callable[[Point, Point], float] = error_ratio,
    beside: str = "plain MPC",
    widest: float = WIDEST,
) -> Figure:
    """Moves against error of every controller, both over plain MPC's; bars are standard errors over the seeds.

    A dotted line is at the ratio of errors that is `marked`; `ratio` makes them of runs, `beside` names what they are
    compared with, and `widest` is the largest ratio drawn.
    """
    widest = max(WIDEST, 1.1 * (marked or 0.0))
    baseline, points = points_of(rows, scenario)
    best = sorted(points, key=lambda name: _merit(points[name], baseline))[:2]
    look = looks(list(points), ["", *best])
    base, root = max(float(baseline.moves.mean()), FEWEST), np.sqrt(len(baseline.moves))
    with styled():
        figure, [[panel]] = new_figure(height=4.2)
        least = 100.0
        for name, own in points.items():
            style = look[name]
            errors = np.array([ratio(p, baseline) for p in own])
            moves = 100 * np.array([max(p.moves.mean(), FEWEST) for p in own]) / base
            spread = np.array([p.moves.std(ddof=1) if len(p.moves) > 1 else 0.0 for p in own])
            spread = 100 * spread / root / base
            front = non_dominated(moves, errors)
            least = min(least, *moves[errors <= widest], 100.0)
            panel.errorbar(
                errors, moves, yerr=np.minimum(spread, 0.9 * moves), fmt="o", markersize=2.5, linewidth=0.6,
                color=style.colour, zorder=style.order,
            )  # fmt: skip
            panel.plot(
                errors[front], moves[front], style.dashes, color=style.colour, linewidth=style.width,
                zorder=style.order, label=plain(name),
            )  # fmt: skip
        panel.plot([1.0], [100.0], "ks", markersize=4, zorder=6, label=beside)
        if marked is not None:
            panel.axvline(marked, color="#9a9a9a", linewidth=0.7, linestyle=":")
        panel.set_yscale("log")
        panel.set_xlim(0.9, widest)
        panel.set_ylim(0.6 * least, 150.0)
        panel.yaxis.set_major_formatter("{x:g}")
        panel.set_xlabel(f"tracking error, times that of {beside}")
        panel.set_ylabel(f"input changes, percent of those of {beside}")
        legend_above(figure)
    return figure


def _merit(points: Sequence[Point], baseline: Point) -> float:
    estimate = moves_at(points, baseline, SHOWN).value
    return estimate if np.isfinite(estimate) else np.inf
