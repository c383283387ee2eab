"""Where the moves go that a limit does without: to the plan, or to not knowing the load.

    python benchmarks/gap.py [--plants tank level] [--loads steps coloured]

The plants and loads of the attention benchmark, each plant being its linear model, so that nothing but the load is
unknown. Ours plans moves at three samples, three tenths as heavy as plain MPC's, at eight prices, and counts on later
data; its tail is none or 20 samples, whichever makes fewer moves at 1.25 times plain MPC's error. It knows of the load:

    bank        what the load bank makes of the measurements
    process     how it goes on, to which a Kalman filter is fitted: the best linear estimate there is
    jumps       the same, and when it jumps, but not by how much (steps only)
    all         state and load themselves, and how it goes on

Beside them the non-anticipative limit, which knows all and plans further ahead, with moves at every sample.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

import mampc
from attention import BASELINE, RATIO, measured
from attention_cases import LOADS, Case, cases, load_of, per_input, reference_of
from attention_limits import ENOUGH, HORIZONS, PRICES, Loops, non_anticipative
from mampc.compare.fronts import Estimate, Point, moves_at
from mampc.controllers.decision import ControllerState
from mampc.loop.batched_plans import EachPlans, batched_plans
from measuring import options

SEEDS, TAILS, OUR_PRICES = range(4000, 4006), (0.0, 20.0), np.geomspace(3000, 10, 8)
SIZES = {"none": 0.0, "steps": 8.0, "wandering": 0.4, "coloured": 3.0, "sinusoidal": 6.0}  # as in `load_of`
FADES, TURNS, JUMPS = np.exp(-1 / 10), 2 * np.pi / 100, 1 / 60  # a sample


class Process:
    """A plant with its load as states behind its own: z = (x, load) or, of a sinusoid, (x, load, its quadrature).

    Attributes:
        model: of z, driven by the inputs.
        Q: covariance of what a sample adds to z that nobody can know.
        start: covariance of z at the first sample.
    """

    def __init__(self, case: Case, kind: str) -> None:
        plant, unit = case.model, per_input(case)
        n, m = plant.n_states, plant.n_inputs
        turn = np.array([[np.cos(TURNS), np.sin(TURNS)], [-np.sin(TURNS), np.cos(TURNS)]])
        goes_on = np.kron(turn, np.eye(m)) if kind == "sinusoidal" else np.eye(m)
        goes_on = goes_on * (FADES if kind == "coloured" else 1.0)
        k = len(goes_on)
        B, D = plant.B[:, :m], plant.D[:, :m]  # measured disturbances stay as they are
        A = np.block([[plant.A, B, np.zeros((n, k - m))], [np.zeros((k, n)), goes_on]])
        C = np.hstack([plant.C, D, np.zeros((plant.n_outputs, k - m))])
        driven = np.vstack([B, np.zeros((k, m))])
        self.model = mampc.StateSpace(A, driven, C, D, plant.dt, plant.u_op, plant.y_op)
        self.n, self.size = n, np.square(SIZES[kind] * unit)
        new = {"steps": JUMPS, "wandering": 1.0, "coloured": 1 - FADES**2}.get(kind, 0.0)
        first = {"coloured": 1.0, "sinusoidal": 0.5}.get(kind, 0.0)
        self.Q, self.start = self.of_load(new * self.size), self.of_load(first * self.size)

    def of_load(self, variance: np.ndarray) -> np.ndarray:
        """A covariance of z with this of the loads, shape (..., m), and nothing else."""
        k = self.model.n_states - self.n
        each = np.tile(variance, k // variance.shape[-1])
        full = np.zeros((*each.shape[:-1], self.model.n_states))
        full[..., self.n :] = each
        covariance: np.ndarray = full[..., None] * np.eye(self.model.n_states)
        return covariance

    def load_states(self, load: np.ndarray) -> np.ndarray:
        """Of loads (S, T, m), shape (S, T, k)."""
        if self.model.n_states - self.n == load.shape[2]:
            return load
        last = 2 * np.cos(TURNS) * load[:, -1:] - load[:, -2:-1]
        after = np.concatenate([load[:, 1:], last], axis=1)
        return np.concatenate([load, (after - np.cos(TURNS) * load) / np.sin(TURNS)], axis=2)


class Filter:
    """What is known of z = (x, load) of many loops, from one sample to the next.

    Args:
        process: of the plant and its load.
        noise: of each output.
        jumped: which loads jump at each sample, shape (S, T, m), where that is known; else None.
    """

    def __init__(self, process: Process, noise: np.ndarray, jumped: np.ndarray | None = None) -> None:
        self._process, self._R, self._jumped = process, np.diag(noise**2), jumped
        self._P = process.start

    def gain(self) -> np.ndarray:
        C = self._process.model.C
        gain: np.ndarray = np.linalg.solve(C @ self._P @ C.T + self._R, C @ self._P)
        return gain.swapaxes(-1, -2)

    def corrected(self, z: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """The estimates (S, n + k) after measurements (S, l), as differences from the operating point."""
        C, gain = self._process.model.C, self.gain()
        self._P = self._P - gain @ C @ self._P
        return z + np.einsum("...nl,...l->...n", gain, measured - z @ C.T)

    def go_on(self, k: int) -> None:
        """From sample k to the next."""
        A, P, Q = self._process.model.A, self._P, self._process.Q
        if self._jumped is not None:
            P, Q = P + self._process.of_load(self._process.size * self._jumped[:, k]), 0 * Q
        self._P = A @ P @ A.T + Q

    def innovations(self) -> np.ndarray:
        """What the innovation of a sample does to (z, d_u, d_y) in the end, shape (n + k + m + l, l)."""
        C = self._process.model.C
        for k in range(500):
            self._P = self._P - self.gain() @ C @ self._P
            self.go_on(k)
        root = np.linalg.cholesky(C @ self._P @ C.T + self._R)
        model = self._process.model
        return np.vstack([self.gain() @ root, np.zeros((model.n_inputs + model.n_outputs, len(root)))])


def ours(case: Case, kind: str, knows: str, tail: float, loops: Loops) -> list[Point]:
    """Moves and errors at every price, with what is known of the load."""
    process, plant, S = Process(case, kind), case.model, len(loops.courses)
    model, m = process.model, plant.n_inputs
    problem = mampc.TrackingProblem(
        model, prediction_horizon=case.horizon, control_horizon=3, output_weight=1 / case.noise**2,
        move_weight=0.03 / per_input(case) ** 2, limits=case.limits, tail_horizon=tail,
    )  # fmt: skip
    shift = Filter(process, case.noise).innovations()
    if knows == "all":
        shift = np.vstack(
            [np.sqrt(process.Q)[:, process.n :], np.zeros((m + plant.n_outputs, model.n_states - process.n))]
        )
    each = [
        mampc.MAMPC(problem, mampc.MoveRules(price=price)).with_information(np.tile(shift, (1, 2, 1, 1)))
        for price in OUR_PRICES for _ in range(S)
    ]  # fmt: skip
    plans, N = EachPlans(batched_plans(each, False) or []), len(each)
    load = np.tile(loops.load, (len(OUR_PRICES), 1, 1))
    noise = np.tile([course.noise[: loops.T] for course in loops.courses], (len(OUR_PRICES), 1, 1))
    jumped = np.diff(load, axis=1, prepend=0.0) != 0
    known, filtered = (
        process.load_states(load),
        Filter(process, case.noise, jumped if knows == "jumps" else None),
    )
    place, u = each[0].condensed.parameter, np.tile(plant.u_op, (N, 1))
    x, z, certain, decided = np.zeros((N, process.n)), np.zeros((N, model.n_states)), np.ones((N, 1)), []
    for k in range(loops.T):
        z = filtered.corrected(z, x @ plant.C.T + noise[:, k])
        if knows == "all":
            z = np.concatenate([x, known[:, k]], axis=1)
        parameters = np.array([place.vector(z[s], u[s], loops.reference[k]) for s in range(N)])
        fine, first = plans.decide(parameters, u[:, None], certain)
        for s in np.flatnonzero(~fine):
            state = ControllerState(u[s : s + 1], k, None, None)
            first[s] = each[s].step(state, z[s], loops.reference[k], hypotheses=certain[s]).u
        u = first
        decided.append(u)
        x = x @ plant.A.T + (u - plant.u_op + load[:, k]) @ plant.B[:, :m].T
        z = z @ model.A.T + (u - plant.u_op) @ model.B.T
        filtered.go_on(k)
    courses = np.array(decided).swapaxes(0, 1).reshape(len(OUR_PRICES), S, loops.T, m)
    return [
        loops.point(knows, price, own, loops.outputs(own))
        for price, own in zip(OUR_PRICES, courses, strict=True)
    ]


def cell(name: str, kind: str) -> dict[str, Estimate]:
    """Moves over plain MPC's by what is known."""
    case = replace(cases()[name], plant=cases()[name].model)
    base = measured(case, kind, *BASELINE, [1.0], SEEDS)[0]
    around = load_of(kind, case), reference_of(case)
    loops = Loops(case, *around, SEEDS)
    prices = PRICES * base.error.mean() * loops.reference.size
    bank, knobs = "exact price, load bank", OUR_PRICES / 100
    found = {
        "bank": [measured(case, kind, bank, ("bank", tail, 0.3), knobs, SEEDS) for tail in TAILS],
    } | {
        knows: [ours(case, kind, knows, tail, loops) for tail in TAILS]
        for knows in ("process", "jumps", "all") if knows != "jumps" or kind == "steps"
    } | {
        "limit": [
            non_anticipative(loops, kind, 0.1 / per_input(case) ** 2, prices, ENOUGH * float(base.error.mean()), ahead)
            for ahead in HORIZONS
        ]
    }  # fmt: skip
    each = {knows: [moves_at(points, base, RATIO) for points in both] for knows, both in found.items()}
    return {
        knows: min(both, key=lambda one: one.value if np.isfinite(one.value) else np.inf)
        for knows, both in each.items()
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--plants", nargs="*", default=list(cases()), help="only these")
    parser.add_argument("--loads", nargs="*", default=list(LOADS), help="only these")
    given = parser.parse_args()
    warnings.simplefilter(
        "ignore", mampc.MampcWarning
    )  # loads that inputs do not move are no fault of the model
    print("| plant | load | bank | process | jumps | all | limit |\n|---|---|" + "---|" * 5)
    values: dict[str, list[dict[str, Estimate]]] = {}
    for name in given.plants:
        for kind in given.loads:
            found = cell(name, kind)
            values.setdefault(kind, []).append(found)
            row = [
                f"{100 * found[knows].value:.1f} ± {100 * found[knows].standard_error:.1f}"
                if knows in found
                else ""
                for knows in ("bank", "process", "jumps", "all", "limit")
            ]
            print(f"| {name} | {kind} | " + " | ".join(row) + " |", flush=True)
    for kind, rows in values.items():
        ratios = {
            knows: np.log(
                [row[knows].value / row["limit"].value for row in rows if np.isfinite(row[knows].value)]
            )
            for knows in rows[0]
        }
        told = ", ".join(
            f"{np.exp(of.mean()):.2f} {knows} ({len(of)})" for knows, of in ratios.items() if len(of)
        )
        print(f"{kind}, moves over the limit's, geometric mean over so many plants: {told}")


if __name__ == "__main__":
    main()
