"""A planned test in tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.identification.plant_test import PlannedTest


def plan_tables(plan: PlannedTest) -> list[Any]:
    """How each input moves, and what each output will tell of it."""
    from rich.markup import escape
    from rich.table import Table

    from mampc.report.columns import numbers

    moves = Table("input", *numbers("low", "around", "high"), title="inputs")
    for name, middle, amplitude in zip(plan.names.inputs, plan.around, plan.amplitude, strict=True):
        moves.add_row(escape(name), *(f"{middle + k * amplitude:.6g}" for k in (-1, 0, 1)))
    gains = [f"gain from {escape(name)} to" for name in plan.names.inputs]
    expected = Table("output", *numbers("moves by", *gains), title="what outputs will tell")
    for name, swing, row in zip(plan.names.outputs, plan.swing, plan.uncertainty, strict=True):
        cells = ("-" if np.isnan(value) else f"± {100 * value:.2g} %" for value in row)
        expected.add_row(escape(name), f"± {swing:.3g}", *cells)
    return [moves, expected]
