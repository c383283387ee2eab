"""Ranks of outputs: one program with weights a hundred times apart, against programs one after the other.

    python benchmarks/ranks.py            # prints the table of docs/methods.md; some ten seconds
    python benchmarks/ranks.py --seeds 20 # fewer instances

Random plants with one or two inputs and two outputs of which not both can be kept, with limits and with zones.
In a row, the first program leaves the second output out; the second one holds the first output to what it
reached there, sample by sample, and does for the second output what is left. What an output suffers is its
largest violation of a limit, or the root of the mean squared distance to its zone. Everything is in units of
what it would suffer without any rank.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

import mampc
from measuring import Comparison, interleaved, options

HORIZON = 20
FAR = 1e3  # limits that are there, so that a sample may have its own
HARD = [1, 3]  # ranks whose weights are 10 000 times apart: as good as a constraint
WIDTH = 0.1


class Instance:
    """A plant, a state and a reference at which not both outputs can be kept."""

    def __init__(self, seed: int, kind: str) -> None:
        rng = np.random.default_rng(seed)
        inputs = 1 + seed % 2
        gain = rng.uniform(0.4, 1.2, (2, 1)) * np.ones((2, inputs)) + 0.02 * rng.standard_normal((2, inputs))
        model = mampc.StateSpace.from_first_order(
            gain=gain, time_constant=rng.uniform(3.0, 15.0, (2, inputs)), dt=1.0
        )
        self.kind, self.x = kind, 0.3 * rng.standard_normal(model.n_states)
        self.reference = np.array([1.0, -1.0]) * rng.uniform(0.5, 1.5, 2)
        common = mampc.TrackingProblem(
            model, prediction_horizon=HORIZON, control_horizon=4, move_weight=0.01,
            limits=mampc.Limits(u_min=-5.0, u_max=5.0),
        )  # fmt: skip
        if kind == "limits":
            r = self.reference
            both = mampc.Limits(u_min=-5.0, u_max=5.0, y_min=[r[0], -FAR], y_max=[FAR, r[1]])
            self.none = replace(common, limits=both, output_weight=1e-3)
            only = mampc.Limits(u_min=-5.0, u_max=5.0, y_min=[r[0], -np.inf], y_max=[FAR, np.inf])
            self.first = replace(self.none, limits=only)
            self.second = replace(self.none, output_rank=HARD)
        else:
            zones = {"zone_below": WIDTH, "zone_above": WIDTH}
            self.none = replace(common, **zones)
            self.first = replace(self.none, output_weight=[1.0, 0.0])
            hard = mampc.Limits(u_min=-5.0, u_max=5.0, y_min=[-FAR, -np.inf], y_max=[FAR, np.inf])
            self.second = replace(self.none, limits=hard, output_weight=[1e-6, 1.0], output_limit_weight=1e8)
        ranked = [replace(self.none, output_rank=ranks) for ranks in ([1, 2], HARD)]
        self.programs = {
            "no rank": self.one(mampc.MPC(self.none)),
            "weights, 100": self.one(mampc.MPC(ranked[0])),
            "weights, 10 000": self.one(mampc.MPC(ranked[1])),
            "in a row": self.in_a_row(mampc.MPC(self.first), mampc.MPC(self.second)),
        }
        self.alone = self.suffered(self.one(mampc.MPC(self.first))())[0]

    def asked(self) -> np.ndarray:
        return np.zeros(2) if self.kind == "limits" else self.reference

    def one(self, mpc: mampc.MPC) -> Callable[[], np.ndarray]:
        return partial(self._plan, mpc, mpc.initial_state())

    def _plan(self, mpc: mampc.MPC, state: mampc.ControllerState, **now: object) -> np.ndarray:
        decision = mpc.step(state, self.x, self.asked(), **now)
        if decision.held:
            raise RuntimeError(f"expected a plan, received {decision.status}")
        return decision.plan

    def in_a_row(self, first: mampc.MPC, second: mampc.MPC) -> Callable[[], np.ndarray]:
        states = first.initial_state(), second.initial_state()

        def plan() -> np.ndarray:
            reached = self.outputs(self._plan(first, states[0]))[1:, 0]
            low = self.reference[0] - (0.0 if self.kind == "limits" else WIDTH)
            rows = np.full((HORIZON, 2), np.nan)
            rows[:, 0] = np.minimum(low, reached)
            now = {"y_min": rows}
            if self.kind == "zones":
                high = np.full((HORIZON, 2), np.nan)
                high[:, 0] = np.maximum(self.reference[0] + WIDTH, reached)
                now["y_max"] = high
            return self._plan(second, states[1], limits=mampc.Limits(**now))

        return plan

    def outputs(self, plan: np.ndarray) -> np.ndarray:
        """As predicted, shape (np + 1, 2)."""
        u = plan[np.minimum(np.arange(HORIZON + 1), len(plan) - 1)]
        return self.none.model.response(u, self.x)

    def suffered(self, plan: np.ndarray) -> np.ndarray:
        """By each output, shape (2,)."""
        y = self.outputs(plan)
        if self.kind == "limits":
            return np.maximum(
                0.0, [(self.reference[0] - y[1:, 0]).max(), (y[1:, 1] - self.reference[1]).max()]
            )
        return np.sqrt((np.maximum(np.abs(y - self.reference) - WIDTH, 0.0) ** 2).mean(axis=0))


def found(kind: str, seeds: int) -> tuple[list[list[str]], Comparison]:
    """Rows of the table, and times of both ways."""
    instances = [Instance(seed, kind) for seed in range(seeds)]
    suffered = {
        name: np.array([instance.suffered(instance.programs[name]()) for instance in instances])
        for name in instances[0].programs
    }
    unit, alone = suffered["no rank"], np.array([instance.alone for instance in instances])
    torn = (unit[:, 0] - alone > 1e-3) & (unit[:, 1] > 1e-3)  # where a rank has something to decide
    rows = []
    for name, values in suffered.items():
        first = (values[:, 0] - alone)[torn] / unit[torn, 0]
        second = values[torn, 1] / unit[torn, 1]
        rows.append(
            [
                kind,
                name,
                f"{np.median(first):.2%}",
                f"{first.max():.2%}",
                f"{np.median(second):.2f}",
                str(torn.sum()),
            ]
        )
    calls = [[i.programs[name] for i in instances] for name in ("in a row", "weights, 100")]
    return rows, interleaved([(calls[0], calls[1])] * 5)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=100, help="instances of each kind")
    arguments = parser.parse_args()
    table = Table(
        "of", "program", "first rank more than alone, median", "largest", "second rank, median", "instances"
    )
    times = {}
    for kind in ("limits", "zones"):
        rows, times[kind] = found(kind, arguments.seeds)
        for row in rows:
            table.add_row(*row)
    Console(width=120).print(table)
    for kind, comparison in times.items():
        print(f"{kind}: in a row {comparison.ratio:.1f} times as long, {comparison}")


if __name__ == "__main__":
    main()
