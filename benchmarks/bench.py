"""Speed of mampc against what one would do without it, measured side by side in one run.

    python benchmarks/bench.py

Every row states a target and what was measured. Both sides of a ratio run in short interleaved blocks,
so that whatever else the machine does hits both alike; the figure is the median over blocks of the
ratio of the blocks' median times per call. To add a row, write a function that returns a `Row` and
append it to `ROWS`. `measuring` says how times are taken, `sparse` has the rows of the exact method and heuristics,
`batches` those of many loops, `solvers` those of other solvers.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from functools import partial

import cvxpy as cp
import daqp
import numpy as np
from rich.console import Console
from rich.table import Table

import batches
import mampc
import solvers
import sparse
from measuring import LAMBDA, Asked, Row, closed_loop, interleaved, options, steps_of, tank_problem

RULES = mampc.MoveRules(max_moves=3, sparsity_horizon=3)
PAPER = mampc.Alternating(penalty=10.0, tolerance=1e-4)
HEAVY = ("scipy.signal", "matplotlib", "pandas", "plotly")


def mpc_against_bare_daqp(*, bounds: bool) -> Row:
    """A whole MPC step (parameters, checks, optimum, decision) against the bare solver on its programs."""
    mpc = mampc.MPC(tank_problem())
    asked, program = closed_loop(mpc), mpc.condensed.program
    instances = [
        mpc.condensed.sample(
            mpc.condensed.parameter.vector(a.x, a.state.inputs[-1], a.reference, a.output_disturbance),
            a.state.inputs[-1],
        )
        for a in asked
    ]
    model = daqp.Model()
    model.settings = {"primal_tol": 1e-9}
    wide = np.full(program.n_bounds, 1e30)
    model.setup(
        program.H, np.zeros(program.n_variables), program.A, wide, -wide, np.zeros(len(wide), np.intc)
    )

    def solve(**changed):
        model.update(**changed)
        return model.solve()

    data = [{"f": i.f.copy()} for i in instances]
    if bounds:
        data = [{"f": i.f.copy(), "blower": i.lower.copy(), "bupper": i.upper.copy()} for i in instances]
    ours, bare = steps_of(mpc, asked), [partial(solve, **changed) for changed in data]
    difference = max(np.abs(a().changes.ravel() - b()[0]).max() for a, b in zip(ours, bare, strict=True))
    times = interleaved([(ours, bare)] * 100)
    return Row(
        f"MPC step / bare warm daqp, update({'f and bounds' if bounds else 'f'}) + solve",
        "at most 4",
        f"{times.ratio:.2f}",
        f"{times}; moves differ by {difference:.0e}",
        times.ratio <= 4,
    )


class Transcription:
    """The paper's Algorithm 1 as one would write it in CVXPY, compiled once, solved by daqp."""

    def __init__(self, problem: mampc.TrackingProblem) -> None:
        model, n_p, n_c = problem.model, problem.prediction_horizon, problem.control_horizon
        m, l, ns = model.n_inputs, model.n_outputs, RULES.sparsity_horizon
        self.past, self.x = cp.Parameter((m, ns)), cp.Parameter(model.n_states)
        self.target, self.v = cp.Parameter(l), cp.Parameter((m, ns + n_c - 1))  # target: r - d_y - y_op
        self.u, X = cp.Variable((m, n_c)), cp.Variable((n_p + 1, model.n_states))
        moves = cp.diff(cp.hstack([self.past, self.u]), axis=1)
        held = np.eye(n_c)[np.minimum(np.arange(n_p + 1), n_c - 1)] @ self.u.T - model.u_op[None]
        error = cp.reshape(self.target, (1, l), order="C") - X @ model.C.T - held @ model.D.T
        self.first_step = cp.Problem(
            cp.Minimize(
                cp.sum_squares(error)
                + LAMBDA * cp.sum_squares(moves[:, ns - 1 :])
                + PAPER.penalty * cp.sum_squares(self.v - moves)
            ),
            [
                X[0] == self.x,
                X[1:] == X[:-1] @ model.A.T + held[:-1] @ model.B.T,
                self.u >= problem.limits.u_min[:, None],
                self.u <= problem.limits.u_max[:, None],
            ],
        )
        self.y_op = model.y_op

    def plan(self, asked: Asked) -> np.ndarray:
        """The planned inputs, shape (nc, m), from the same first guess of v."""
        self.past.value, self.x.value = asked.state.inputs.T, asked.x
        self.target.value = asked.reference - asked.output_disturbance - self.y_op
        v, last = np.zeros(self.v.shape), None
        if asked.state.guess is not None:
            v[:, -len(asked.state.guess) :] = asked.state.guess.T
        for _ in range(PAPER.max_iterations):
            self.v.value = v
            self.first_step.solve(solver=cp.DAQP)
            u = self.u.value
            moves = np.diff(np.hstack([self.past.value, u]))
            largest = np.argsort(-np.abs(moves).ravel(), kind="stable")[: RULES.max_moves]
            v = np.zeros(moves.shape)
            v.flat[largest] = moves.flat[largest]
            if last is not None and np.abs(u - last).sum() <= PAPER.tolerance:
                break
            last = u
        return u.T


def regulator_against_mpc() -> Row:
    """Output feedback (checks of sensors, estimator, MPC) against the MPC step in it, on the same samples."""
    mpc = mampc.MPC(tank_problem())
    asked, regulator = closed_loop(mpc), mampc.Regulator(mpc)
    y_op, noise = mpc.problem.model.y_op, np.random.default_rng(0)
    state, ours = regulator.initial_state(), []
    for a in asked:
        y = y_op + 0.1 * noise.standard_normal(len(y_op))
        ours.append(partial(regulator.step, state, y, a.reference))
        state = ours[-1]().state
    times = interleaved([(ours, steps_of(mpc, asked))] * 100)
    return Row("Regulator.step / MPC step", "at most 3", f"{times.ratio:.2f}", str(times), times.ratio <= 3)


def load_bank_against_filter() -> Row:
    """A step of plain MPC with a load bank against one with a Kalman filter, each in its closed loop."""
    mpc = mampc.MPC(tank_problem())
    regulators = (
        mampc.Regulator(mpc, mampc.LoadBank(mpc.problem.model, noise=0.1)), mampc.Regulator(mpc)
    )  # fmt: skip
    model, calls = mpc.problem.model, []
    reference = mampc.steps(145, model.y_op, [(5, model.y_op + 1.0), (75, model.y_op)])
    for regulator in regulators:
        run = mampc.simulate(model, regulator, reference, noise=0.1, seed=0, progress=False)
        state, steps = regulator.initial_state(), []
        for y, r in zip(run.y_measured, run.r, strict=True):
            steps.append(partial(regulator.step, state, y, r))
            state = steps[-1]().state
        calls.append(steps)
    times = interleaved([(calls[0], calls[1])] * 100)
    return Row(
        "Regulator.step with a load bank / with a Kalman filter", "at most 2", f"{times.ratio:.2f}", str(times),
        times.ratio <= 2,
    )  # fmt: skip


def alternating_against_cvxpy() -> Row:
    """The alternating method per step against the transcription, on the same samples."""
    problem = tank_problem()
    controller = mampc.MAMPC(problem, RULES, method=PAPER)
    asked = [a for a in closed_loop(controller) if a.state.samples >= RULES.sparsity_horizon][::14]
    transcription = Transcription(problem)
    ours, theirs = steps_of(controller, asked), [partial(transcription.plan, a) for a in asked]
    decisions = [step() for step in ours]
    difference = max(np.abs(d.plan - plan()).max() for d, plan in zip(decisions, theirs, strict=True))
    times = interleaved([([plan], [step] * 25) for plan, step in zip(theirs, ours, strict=True)] * 4)
    rounds = statistics.median(d.iterations for d in decisions)
    return Row(
        "paper's method in CVXPY (compiled once, daqp) / alternating MAMPC step",
        "at least 100",
        f"{times.ratio:.0f}",
        f"{times}; {rounds:.0f} rounds; plans differ by {difference:.0e}",
        times.ratio >= 100,
    )


def import_time() -> Row:
    """`import mampc` in fresh interpreters, from compiled bytecode."""
    code = (
        "import sys, time; start = time.perf_counter(); import mampc; "
        f"print(time.perf_counter() - start, *(name for name in {HEAVY} if name in sys.modules))"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}

    def once() -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
        )
        return done.stdout.split()

    once()  # compiles what is not compiled yet
    runs = [once() for _ in range(7)]
    times, loaded = [float(run[0]) * 1e3 for run in runs], runs[0][1:]
    median = statistics.median(times)
    return Row(
        "import mampc",
        "under 250 ms",
        f"{median:.0f} ms",
        f"median of 7, least {min(times):.0f} ms; heavy modules loaded: {', '.join(loaded) or 'none'}",
        median < 250 and not loaded,
    )


ROWS: list[Callable[[], Row]] = [
    partial(mpc_against_bare_daqp, bounds=False),
    partial(mpc_against_bare_daqp, bounds=True),
    regulator_against_mpc,
    load_bank_against_filter,
    alternating_against_cvxpy,
    *batches.ROWS,
    *solvers.ROWS,
    *sparse.ROWS,
    import_time,
]


def main() -> None:
    options(__doc__).parse_args()
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    table = Table("", "measured", "target", "", "detail", title="mampc benchmark")
    for measure in ROWS:
        row = measure()
        verdict = "[green]PASS[/]" if row.passed else "[red]MISS[/]"
        table.add_row(row.name, row.measured, row.target, verdict, row.detail)
    console.print(table)


if __name__ == "__main__":
    main()
