"""Rows of `bench.py`: many closed loops as arrays against the same loops one by one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mampc
from measuring import Row, interleaved, readable, tank_problem

SEEDS, SAMPLES = 1000, 100
REFERENCE = [34.0, 28.0]


def batch_against_loops(name: str, rules: mampc.MoveRules | None, target: float) -> Row:
    """`simulate_batch` of the nonlinear tank with 1000 seeds against `simulate`, per step of one loop."""
    plant, problem = mampc.plants.QuadrupleTank(), tank_problem()
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    loop = mampc.Regulator(controller, mampc.KalmanFilter.offset_free(problem.model))
    settings = {"steps": SAMPLES, "noise": 0.1, "progress": False}
    one = partial(mampc.simulate, plant, loop, REFERENCE, seed=0, **settings)
    many = partial(mampc.simulate_batch, plant, loop, REFERENCE, seeds=range(SEEDS), **settings)
    times = interleaved([([one], [many])] * 3)
    ratio = times.ratio * SEEDS
    return Row(
        f"simulate / simulate_batch, {SEEDS} seeds, {name}",
        f"at least {target:g}",
        f"{ratio:.0f}",
        f"{readable(times.first / SAMPLES)} against {readable(times.second / SAMPLES / SEEDS)} a step",
        ratio >= target,
    )


ROWS: list[Callable[[], Row]] = [
    partial(batch_against_loops, "MPC", None, 50),
    partial(
        batch_against_loops,
        "price and budget",
        mampc.MoveRules(price=1.0, max_moves=3, sparsity_horizon=3),
        50,
    ),
    partial(batch_against_loops, "price, all 1024 patterns", mampc.MoveRules(price=1.0), 25),
]
