"""A planned test in tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.identification.plant_test import PlannedTest


def plan_tables(plan: PlannedTest) -> list[Any]:
    """How each input moves, and what each output will tell of it."""
    from rich.markup import escape
    from rich.table import Table

    moves = Table(title="inputs")
    moves.add_column("input")
    for header in ("low", "around", "high"):
        moves.add_column(header, justify="right")
    for name, middle, amplitude in zip(plan.names.inputs, plan.around, plan.amplitude, strict=True):
        moves.add_row(escape(name), *(f"{middle + k * amplitude:.6g}" for k in (-1, 0, 1)))
    expected = Table(title="what outputs will tell")
    expected.add_column("output")
    expected.add_column("moves by", justify="right")
    for name in plan.names.inputs:
        expected.add_column(f"gain from {escape(name)} to", justify="right")
    for name, swing, row in zip(plan.names.outputs, plan.swing, plan.uncertainty, strict=True):
        cells = ("-" if np.isnan(value) else f"± {100 * value:.2g} %" for value in row)
        expected.add_row(escape(name), f"± {swing:.3g}", *cells)
    return [moves, expected]
