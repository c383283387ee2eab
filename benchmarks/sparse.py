"""Rows of the benchmark that measure the exact method and the heuristics.

Sizes: A (2 inputs, control horizon 5, prediction horizon 10) and B (2, 20, 50) on a model of the tank, C (4,
30, 60) on a random one.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pyscipopt

import mampc
from measuring import (
    Asked,
    Comparison,
    Row,
    closed_loop,
    interleaved,
    readable,
    steps_of,
    tank_problem,
    three_inputs,
    timed,
)

BUDGET_A = mampc.MoveRules(max_moves=4)
BUDGET_B = mampc.MoveRules(max_moves=6)
HARD_B = mampc.MoveRules(max_moves=10, min_size=0.5)  # far from proven within any short time
NARROW = mampc.Limits(u_min=47.0, u_max=53.0)  # plans at size A run into them in about a tenth of the samples
SIZE_B = {"prediction_horizon": 50, "control_horizon": 20}


def against_plain(
    controller, problem: mampc.TrackingProblem, asked: Sequence[Asked], blocks: int = 30
) -> Comparison:
    """A controller against plain MPC on the same samples."""
    return interleaved([(steps_of(controller, asked), steps_of(mampc.MPC(problem), asked))] * blocks)


def active_share(problem: mampc.TrackingProblem, asked: Sequence[Asked]) -> float:
    """In how many of the samples plain MPC runs into a limit."""
    condensed = mampc.MPC(problem).condensed
    broken = []
    for a in asked:
        u_previous = a.state.inputs[-1]
        parameter = condensed.parameter.vector(a.x, u_previous, a.reference, a.output_disturbance)
        broken.append(condensed.sample(parameter, u_previous).margins.min() < 0)
    return float(np.mean(broken))


def exact_against_plain() -> Row:
    """The exact optimum with at most 4 of 10 moves against plain MPC, in closed loop."""
    problem = tank_problem()
    controller = mampc.MAMPC(problem, BUDGET_A)
    times = against_plain(controller, problem, closed_loop(controller))
    return Row(
        "A, 4 of 10 moves: exact step / plain MPC step", "at most 2", f"{times.ratio:.2f}", str(times),
        times.ratio <= 2,
    )  # fmt: skip


class BigM:
    """One sample of the sparse problem as a mixed-integer program for SCIP; `solve` is all that is timed."""

    def __init__(self, condensed, asked: Asked, most: int) -> None:
        problem, u_previous = condensed.problem, asked.state.inputs[-1]
        parameter = condensed.parameter.vector(asked.x, u_previous, asked.reference, asked.output_disturbance)
        sample, n, program = condensed.sample(parameter, u_previous), condensed.n_moves, condensed.program
        self.constant, self.scip = sample.constant, pyscipopt.Model()
        self.scip.hideOutput()
        total, largest = pyscipopt.quicksum, problem.limits.u_max - problem.limits.u_min
        d = [self.scip.addVar(lb=-size, ub=size) for size in np.tile(largest, problem.control_horizon)]
        on = [self.scip.addVar(vtype="B") for _ in range(n)]
        rows = np.vstack([np.eye(program.n_simple, n), program.A])
        for row, low, high in zip(rows, sample.lower, sample.upper, strict=True):
            self.scip.addCons(low <= (total(row[i] * d[i] for i in np.flatnonzero(row)) <= high))
        for move, moves in zip(d, on, strict=True):
            self.scip.addCons(move <= move.getUbOriginal() * moves)
            self.scip.addCons(-move <= move.getUbOriginal() * moves)
        self.scip.addCons(total(on) <= most)
        # 1/2 d' H d = 1/2 |L' d|^2 <= curved
        curved, roots = self.scip.addVar(lb=None), [self.scip.addVar(lb=None) for _ in d]
        for column, root in zip(np.linalg.cholesky(condensed.H).T, roots, strict=True):
            self.scip.addCons(total(column[i] * d[i] for i in np.flatnonzero(column)) == root)
        self.scip.addCons(total(0.5 * root * root for root in roots) <= curved)
        self.scip.setObjective(curved + total(f * move for f, move in zip(sample.f_moves, d, strict=True)))

    def solve(self) -> None:
        self.scip.optimize()

    @property
    def objective(self) -> float:
        return self.constant + self.scip.getObjVal()


def scip_against_exact() -> Row:
    """SCIP on a big-M form against the exact step, on samples of the closed loop."""
    problem = tank_problem()
    controller = mampc.MAMPC(problem, BUDGET_A)
    asked = closed_loop(controller)[::12]
    programs = [BigM(controller.condensed, a, BUDGET_A.max_moves) for a in asked]
    ours = steps_of(controller, asked)
    times = interleaved(
        [([program.solve], [step] * 25) for program, step in zip(programs, ours, strict=True)]
    )
    differences = [
        abs(program.objective - step().objective) / step().objective
        for program, step in zip(programs, ours, strict=True)
    ]
    return Row(
        "A, 4 of 10 moves: SCIP (big-M, its solve alone) / exact step", "at least 1000", f"{times.ratio:.0f}",
        f"{times}; optima differ by at most {max(differences):.0e}", times.ratio >= 1000,
    )  # fmt: skip


def exact_tail() -> Row:
    """The slowest steps of a run in which a tenth of the samples have active limits."""
    controller = mampc.MAMPC(tank_problem(limits=NARROW), BUDGET_A)
    asked = closed_loop(controller)
    each = undisturbed(controller, asked)
    median, p99 = np.median(each), np.percentile(each, 99)
    unlimited = steps_of(mampc.MAMPC(tank_problem(limits=mampc.Limits()), BUDGET_A), asked)
    plans = np.array([step().plan for step in unlimited])
    share = np.mean(((plans < NARROW.u_min) | (plans > NARROW.u_max)).any(axis=(1, 2)))
    return Row(
        "A, 4 of 10 moves: exact step, 99th percentile / median", "at most 5", f"{p99 / median:.1f}",
        f"{readable(p99)} against {readable(median)}; limits active in {share:.0%} of the samples",
        p99 <= 5 * median,
    )  # fmt: skip


def undisturbed(controller, asked: Sequence[Asked], repeats: int = 9) -> np.ndarray:
    """Seconds of each step, the least of several: what other programs take is not the step's."""
    return np.array([min(timed(step) for _ in range(repeats)) for step in steps_of(controller, asked)])


def exact_with_output_limits() -> Row:
    """The exact optimum where output limits are active at every step."""
    plant = mampc.plants.QuadrupleTank()
    y_max = plant.output(plant.steady_state()) - 2.0  # below every reference of the run
    problem = tank_problem(limits=mampc.Limits(u_min=0.0, u_max=100.0, y_max=y_max))
    controller = mampc.MAMPC(problem, BUDGET_A)
    asked = closed_loop(controller)
    times = against_plain(controller, problem, asked)
    return Row(
        "A, 4 of 10 moves, output limits active: exact step / plain MPC step", "at most 15", f"{times.ratio:.1f}",
        f"{times}; limits active in {active_share(problem, asked):.0%} of the samples", times.ratio <= 15,
    )  # fmt: skip


def exact_at_size_b() -> Row:
    """The time to a proven optimum with at most 6 of 40 moves."""
    problem = tank_problem(**SIZE_B)
    controller = mampc.MAMPC(problem, BUDGET_B)
    decisions = [step() for step in steps_of(controller, closed_loop(controller))]
    seconds = [d.solve_time for d in decisions]
    proven = float(np.mean([d.status is mampc.Status.OPTIMAL for d in decisions]))
    median = statistics.median(seconds)
    return Row(
        "B, 6 of 40 moves: exact step", "at most 50 ms", readable(median),
        f"99th percentile {readable(np.percentile(seconds, 99))}, longest {readable(max(seconds))}; "
        f"proven in {proven:.0%}",
        median <= 0.05 and proven == 1.0,
    )  # fmt: skip


def exact_at_size_b_within_limits() -> Row:
    """The slowest steps with at most 6 of 40 moves, where plans run into limits of the inputs."""
    problem = tank_problem(limits=NARROW, **SIZE_B)
    controller = mampc.MAMPC(problem, BUDGET_B)
    asked = closed_loop(controller)
    each = undisturbed(controller, asked, repeats=3)
    proven = float(np.mean([step().status is mampc.Status.OPTIMAL for step in steps_of(controller, asked)]))
    p99 = float(np.percentile(each, 99))
    return Row(
        "B, 6 of 40 moves, narrow limits: exact step, 99th percentile", "at most 20 ms", readable(p99),
        f"median {readable(np.median(each))}, longest {readable(each.max())}; plain MPC runs into a limit in "
        f"{active_share(problem, asked):.0%}; proven in {proven:.0%}",
        p99 <= 0.02 and proven == 1.0,
    )  # fmt: skip


def move_limits_and_a_price() -> Row:
    """Closed loop of a plant with two inputs, three outputs and a measured disturbance, far from its references."""
    gains = [[1.9, 1.9, 1.9], [-0.74, 0.74, 0.74], [-0.5, 2.0, 0.1]]
    constants = [[180.0, 180.0, 180.0], [80.0, 80.0, 80.0], [100.0, 250.0, 80.0]]
    poles = np.exp(-10.0 / np.array(constants))
    B, C = np.zeros((9, 3)), np.zeros((3, 9))
    for i, j in np.ndindex(3, 3):
        B[3 * i + j, j], C[i, 3 * i + j] = gains[i][j] * (1 - poles[i, j]), 1.0
    names = mampc.Names(("u1", "u2"), ("y1", "y2", "y3"), disturbances=("v",))
    model = mampc.StateSpace(
        np.diag(poles.ravel()), B, C, np.zeros((3, 3)), 10.0,
        u_op=[20, 20], y_op=[50, 30, 25], v_op=[20], names=names,
    )  # fmt: skip
    problem = mampc.TrackingProblem(
        model, prediction_horizon=40, control_horizon=10, output_weight=[1, 1, 0.01], move_weight=2.0,
        limits=mampc.Limits(u_min=10, u_max=55, du_max=0.5, y_min=20, y_max=[70, 70, 30]),
    )  # fmt: skip
    reference = mampc.steps(200, [50, 30, 25], [(50, [50, 40, 25]), (100, [54, 30, 25])])
    disturbance = mampc.steps(200, [20.0], [(150, [25.0])])
    estimator = mampc.KalmanFilter.offset_free(model)
    regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(price=2.0)), estimator)
    run = mampc.simulate(
        model, regulator, reference, measured_disturbance=disturbance, steps=200, progress=False
    )
    seconds = np.array([d.solve_time for d in run.decisions])
    stopped = sum(d.status is mampc.Status.TIME_LIMIT for d in run.decisions)
    median = float(np.median(seconds))
    return Row(
        "2 inputs, horizons 40/10, du_max and a price, closed loop: median exact step", "at most 5 ms",
        readable(median),
        f"all 200 steps {seconds.sum():.1f} s, longest {readable(seconds.max())}; {stopped} at the limit of 1 s",
        median <= 5e-3 and not stopped,
    )  # fmt: skip


def a_price_near_a_steady_state() -> Row:
    """Closed loop of a plant with three inputs and noise, most of which is spent near steady states."""
    model = three_inputs()
    problem = mampc.TrackingProblem(
        model, prediction_horizon=60, control_horizon=15, limits=mampc.Limits(u_min=-50, u_max=50)
    )
    regulator = mampc.Regulator(
        mampc.MAMPC(problem, mampc.MoveRules(price=0.3)), mampc.KalmanFilter.offset_free(model)
    )
    reference = mampc.steps(60, [0, 0, 0], [(3, [1, -0.5, 0.5])])
    run = mampc.simulate(model, regulator, reference, noise=0.05, seed=1, progress=False)
    seconds = np.array([d.solve_time for d in run.decisions])
    proven = float(np.mean([d.status is mampc.Status.OPTIMAL for d in run.decisions]))
    median = float(np.median(seconds))
    return Row(
        "3 inputs, horizons 60/15, a price and noise, closed loop: median exact step", "at most 2 ms",
        readable(median), f"longest {readable(seconds.max())}; proven in {proven:.0%}",
        median <= 2e-3 and proven == 1.0,
    )  # fmt: skip


def on_off(horizon: int) -> Row:
    """A valve that is open or shut, in closed loop with a first-order plant; every move of the horizon is free."""
    plant = mampc.StateSpace([[0.95]], [[0.05]], [[20.0]], [[0.0]], 1.0)
    problem = mampc.TrackingProblem(
        plant, prediction_horizon=horizon, control_horizon=horizon, limits=mampc.Limits(u_min=0.0, u_max=1.0)
    )
    estimator = mampc.KalmanFilter.offset_free(plant)
    regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(min_size=1.0)), estimator)
    run = mampc.simulate(plant, regulator, reference=[8.0], steps=60, u_initial=[0.0], progress=False)
    seconds = np.array([d.solve_time for d in run.decisions])
    proven = float(np.mean([d.status is mampc.Status.OPTIMAL for d in run.decisions]))
    p99 = float(np.percentile(seconds, 99))
    return Row(
        f"on/off valve, horizons {horizon}/{horizon}: exact step, 99th percentile", "at most 50 ms", readable(p99),
        f"median {readable(np.median(seconds))}; proven in {proven:.0%}; mean output {run.y[30:].mean():.2f} for 8",
        p99 <= 0.05 and proven == 1.0,
    )  # fmt: skip


def gap_of_many_moves() -> Row:
    """What is left unproven after a second with 500 moves, of 10 inputs."""
    rng = np.random.default_rng(1)
    A = rng.standard_normal((20, 20))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    model = mampc.StateSpace(A, rng.standard_normal((20, 10)), rng.standard_normal((10, 20)), None, 1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=100, control_horizon=50, move_weight=0.1)
    controller = mampc.MAMPC(problem, mampc.MoveRules(max_moves=10))
    decisions = [
        controller.step(controller.initial_state(), rng.standard_normal(20), 2 * rng.standard_normal(10))
        for _ in range(3)
    ]
    gaps = [(d.objective - d.lower_bound) / d.objective for d in decisions]
    longest = max(d.solve_time for d in decisions)
    return Row(
        "10 inputs, 10 of 500 moves: gap of the exact method after 1 s", "at most 33 %", f"{max(gaps):.0%}",
        f"gaps {', '.join(f'{gap:.0%}' for gap in gaps)}; longest step {readable(longest)}", max(gaps) <= 0.33,
    )  # fmt: skip


def exact_within_time() -> Row:
    """How far the exact search passes its time limit, where it is far too short."""
    limit = 0.01
    problem = tank_problem(**SIZE_B)
    controller = mampc.MAMPC(problem, HARD_B, method=mampc.Exact(time_limit=limit))
    asked = closed_loop(controller)
    stopped = np.mean([step().status is mampc.Status.TIME_LIMIT for step in steps_of(controller, asked)])
    longest = undisturbed(controller, asked).max() / limit
    return Row(
        f"B, 10 of 40 moves of least size: longest exact step / time limit of {readable(limit)}",
        "at most 1.2", f"{longest:.2f}", f"{len(asked)} steps, of which {stopped:.0%} stopped at the limit",
        longest <= 1.2,
    )  # fmt: skip


def problem_of_size_c() -> mampc.TrackingProblem:
    """A random stable model of order 8 with 4 inputs and outputs, and input limits that are seldom active."""
    rng = np.random.default_rng(3)
    A = rng.standard_normal((8, 8))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    model = mampc.StateSpace(A, rng.standard_normal((8, 4)), rng.standard_normal((4, 8)), None, 1.0)
    return mampc.TrackingProblem(
        model, prediction_horizon=60, control_horizon=30, move_weight=0.1, limits=mampc.Limits(u_min=-1.0, u_max=1.0)
    )  # fmt: skip


def random_loop(controller, steps: int = 60, hold: int = 15) -> list[Asked]:
    """What a controller is asked in a closed loop of its own model with noise and random reference steps."""
    rng, model = np.random.default_rng(4), controller.problem.model
    state, x, asked = controller.initial_state(), np.zeros(model.n_states), []
    for k in range(steps):
        if k % hold == 0:
            reference = rng.standard_normal(model.n_outputs)
        measured = x + 0.01 * rng.standard_normal(len(x))
        asked.append(Asked(state, measured, reference, np.zeros(model.n_outputs)))
        decision = controller.step(state, measured, reference)
        state, x = decision.state, model.A @ x + model.B @ decision.u
    return asked


def heuristic_at_size_c(name: str, **settings) -> Row:
    """A heuristic with at most 6 of 120 moves against plain MPC, and its gap to what the exact method proves."""
    problem = problem_of_size_c()
    controller = mampc.MAMPC(problem, BUDGET_B, method=name, **settings)
    exact = mampc.MAMPC(problem, BUDGET_B, method=mampc.Exact(time_limit=1.0))
    asked = random_loop(controller)
    times = against_plain(controller, problem, asked, blocks=10)
    decisions = [step() for step in steps_of(controller, asked)]
    proofs = [step() for step in steps_of(exact, asked)]
    gaps = [(d.objective - p.lower_bound) / p.lower_bound for d, p in zip(decisions, proofs, strict=True)]
    proven = np.mean([p.status is mampc.Status.OPTIMAL for p in proofs])
    return Row(
        f"C, 6 of 120 moves: {name} step / plain MPC step", "at most 20", f"{times.ratio:.1f}",
        f"{times}; gap median {max(0.0, np.median(gaps)):.1%}, 95 % {np.percentile(gaps, 95):.1%} "
        f"(optimum proven in {proven:.0%})",
        times.ratio <= 20,
    )  # fmt: skip


ROWS: list[Callable[[], Row]] = [
    exact_against_plain,
    scip_against_exact,
    exact_tail,
    exact_with_output_limits,
    exact_at_size_b,
    exact_at_size_b_within_limits,
    move_limits_and_a_price,
    a_price_near_a_steady_state,
    partial(on_off, 10),
    partial(on_off, 15),
    gap_of_many_moves,
    exact_within_time,
    partial(heuristic_at_size_c, "alternating", polish=True, warm_up=0),
    partial(heuristic_at_size_c, "greedy"),
]
