"""Inputs on levels: how long a step takes, what is proven, and what a loop with an on/off valve holds on average.

    python benchmarks/levels.py      # the table of docs/methods.md; about a minute

A first-order plant (10 samples) whose valve is on or off, reference 8 of 10, horizons of 10 and 15 samples, with and
without times; the paper's tank with valves on a grid of 0.5 %, with and without rules; and three inputs on grids of a
hundredth and a twentieth of their range, horizons 30/8, with a price.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import mampc
from measuring import options, three_inputs

TIMES = mampc.OnOff(min_on=3.0, min_off=2.0)
STEPS = 200
SETTLED = 50


def cases() -> Iterator[tuple[str, dict[str, Any]]]:
    """Names, and what `simulate` takes."""
    plant = mampc.StateSpace.from_first_order(gain=[[1.0]], time_constant=[[10.0]], dt=1.0)
    limits = mampc.Limits(u_min=0.0, u_max=10.0)
    for n in (10, 15):
        problem = mampc.TrackingProblem(
            plant, prediction_horizon=n, control_horizon=n, move_weight=1e-3, limits=limits
        )
        for name, rules in {
            "on/off": {"levels": mampc.OnOff()},
            "on/off, price 0.1": {"levels": mampc.OnOff(), "price": 0.1},
            "on/off, 3 s on, 2 s off": {"levels": TIMES},
        }.items():
            regulator = mampc.Regulator(
                mampc.MAMPC(problem, mampc.MoveRules(**rules)), mampc.KalmanFilter.offset_free(problem.model)
            )
            yield (
                f"{name}, {n}/{n}",
                {
                    "plant": plant,
                    "regulator": regulator,
                    "reference": [8.0],
                    "u_initial": [0.0],
                    "noise": 0.02,
                },
            )
    tank = mampc.plants.QuadrupleTank()
    model = mampc.linearise(tank).discretise(10.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=5, limits=mampc.Limits(u_min=0.0, u_max=100.0)
    )
    reference = mampc.steps(STEPS, model.y_op, [(5, model.y_op + 2.0), (60, model.y_op - 1.0)])
    for name, rules in {
        "grid of 0.5 %": {},
        "grid of 0.5 %, price 1": {"price": 1.0},
        "grid of 0.5 %, 3 moves in 3 + nc": {"max_moves": 3, "sparsity_horizon": 3},
    }.items():
        regulator = mampc.Regulator(
            mampc.MAMPC(problem, mampc.MoveRules(levels=0.5, **rules)),
            mampc.KalmanFilter.offset_free(problem.model),
        )
        yield f"tank, {name}", {"plant": tank, "regulator": regulator, "reference": reference, "noise": 0.1}
    model = three_inputs()
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=8, limits=mampc.Limits(u_min=-5.0, u_max=5.0)
    )
    reference = mampc.steps(STEPS, [0.0, 0.0, 0.0], [(5, [2.0, -1.0, 1.5]), (100, [0.0, 1.0, 0.5])])
    for step in (0.1, 0.5):
        regulator = mampc.Regulator(
            mampc.MAMPC(problem, mampc.MoveRules(levels=step, price=0.3)),
            mampc.KalmanFilter.offset_free(model),
        )
        yield (
            f"3 inputs, grid of {step / 10:.0%}, price 0.3",
            {"plant": model, "regulator": regulator, "reference": reference, "noise": 0.05},
        )


def main() -> None:
    options(__doc__).parse_args()
    table = Table("case", "mean output", "moves a sample", "proven", "step, median", "p99", "largest")
    for name, settings in track(list(cases()), "loops"):
        run = mampc.simulate(steps=STEPS, progress=False, **settings)
        late, times = slice(SETTLED, None), 1e3 * run.solve_times
        moves = np.diff(run.u[late], axis=0) != 0
        table.add_row(
            name, ", ".join(f"{y:.2f}" for y in run.y[late].mean(axis=0)), f"{moves.any(axis=1).mean():.2f}",
            f"{run.statuses.get('optimal', 0) / STEPS:.0%}", f"{np.median(times):.1f} ms",
            f"{np.percentile(times, 99):.1f} ms", f"{times.max():.1f} ms",
        )  # fmt: skip
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
