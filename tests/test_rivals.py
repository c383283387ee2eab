"""Rivals solve the problems that the literature states, and run like any controller."""

import cvxpy as cp
import numpy as np
import pytest

import mampc
from builders import random_model, random_problem, tank_model, tank_problem
from mampc import rivals
from mampc.program.qp import QPStatus, QuadraticProgram
from mampc.rivals.norms import Norm, NormsSolver
from seeds import seeds

SIZE = (0.5, 2.0)  # of penalties, per input
RULES = {
    "dead_band": lambda c: rivals.DeadBand(c, size=0.5),
    "any": lambda c: rivals.DeadBand(c, size=0.5, kind="any"),
    "norm": lambda c: rivals.DeadBand(c, size=0.5, kind="norm"),
    "rounded": lambda c: rivals.Rounded(c, step=0.5),
    "hysteresis": lambda c: rivals.Rounded(c, step=0.5, hysteresis=0.25),
    "periodic": lambda c: rivals.Periodic(c, every=3),
    "event": lambda c: rivals.EventTriggered(c, threshold=0.2),
    "self": lambda c: rivals.SelfTriggered(c),
    "quiet": lambda c: rivals.QuietZone(c, band=0.3),
}
OTHERS = {
    "l1": lambda p: rivals.Penalised(p, penalty=rivals.L1(weight=1.0)),
    "log_sum": lambda p: rivals.Penalised(p, penalty=rivals.LogSum(weight=1.0)),
    "lasso": lambda p: rivals.Penalised(p, penalty=rivals.L1(), on="inputs", terminal="riccati"),
    "sparse": lambda p: rivals.SparseInputs(p, most=1),
}
ALL = {**{name: lambda p, r=rule: r(mampc.MPC(p)) for name, rule in RULES.items()}, **OTHERS}


def convex(problem, x, reference, u, penalty, *, on="moves", u_s=None, extra=None):
    """The penalised problem as CVXPY states it, from predictions of the model; the optimum's cost."""
    model, n_p, n_c = problem.model, problem.prediction_horizon, problem.control_horizon
    m, cost, state = model.n_inputs, 0, x
    inputs = cp.Variable((n_c, m))
    for i in range(n_p + 1):
        now = inputs[min(i, n_c - 1)] - model.u_op
        cost += cp.sum_squares(reference - model.y_op - model.C @ state)
        state = state if i == n_p else model.A @ state + model.B @ now
    moves = [inputs[0] - u, *(inputs[j] - inputs[j - 1] for j in range(1, n_c))]
    cost += 0.1 * sum(cp.sum_squares(move) for move in moves)
    z = moves if on == "moves" else [inputs[j] - u_s for j in range(n_c)]
    cost += penalty(cp.vstack([cp.multiply(1 / np.array(SIZE), part) for part in z]))
    if extra is not None:
        cost += extra(state)
    limits = [
        inputs >= np.tile(problem.limits.u_min, (n_c, 1)),
        inputs <= np.tile(problem.limits.u_max, (n_c, 1)),
    ]
    program = cp.Problem(cp.Minimize(cost), limits)
    program.solve(solver=cp.CLARABEL)
    return program.value, inputs.value


PENALTIES = {
    "l1": (rivals.L1(weight=2.0, size=SIZE), lambda z: 2 * cp.sum(cp.abs(z))),
    "elastic_net": (
        rivals.ElasticNet(weight=2.0, size=SIZE, curvature=0.3),
        lambda z: 2 * (cp.sum(cp.abs(z)) + 0.3 * cp.sum_squares(z)),
    ),
    "group_l2": (rivals.GroupL2(weight=2.0, size=SIZE), lambda z: 2 * cp.sum(cp.norm(z, axis=1))),
    "clot": (
        rivals.CLOT(weight=2.0, size=SIZE, ratio=0.5),
        lambda z: 2 * (cp.sum(cp.abs(z)) + 0.5 * cp.norm(cp.vec(z, order="C"))),
    ),
}


@pytest.mark.parametrize("seed", seeds(4, quick=2))
@pytest.mark.parametrize("name", PENALTIES)
@pytest.mark.parametrize("on", ["moves", "inputs"])
def test_convex_penalties_reach_the_optimum_of_an_independent_solver(name, on, seed):
    penalty, stated = PENALTIES[name]
    problem, x, reference, u = random_problem(seed)
    controller = rivals.Penalised(problem, penalty=penalty, on=on)
    decision = controller.step(controller.initial_state(u), x, reference)
    parameter = controller.condensed.parameter.vector(x, u, reference)
    u_s = mampc.program.steady.SteadyTarget(problem, controller.condensed.parameter).at(parameter).u
    optimum, _ = convex(problem, x, reference, u, stated, on=on, u_s=u_s)
    z = decision.changes if on == "moves" else decision.plan - u_s
    ours = decision.objective + penalty.value(np.abs(z) / SIZE)
    assert ours == pytest.approx(optimum, rel=2e-6)


@pytest.mark.parametrize("seed", seeds(20, quick=4))
@pytest.mark.parametrize("made", [rivals.GroupL2, rivals.CLOT], ids=["group_l2", "clot"])
@pytest.mark.parametrize("weight", [0.0, 1.0, 1e9])
@pytest.mark.parametrize("on", ["moves", "inputs"])
def test_norms_are_the_same_in_whatever_units(on, weight, made, seed):
    rng = np.random.default_rng(seed)
    model, scales = random_model(seed, n=3, m=2, l=2), 10.0 ** rng.uniform(-6, 6, (2, 2))
    x, deviation, u = rng.standard_normal(3), rng.standard_normal(2), rng.uniform(-1, 1, 2)

    def decided(a, b):
        scaled = mampc.StateSpace(
            model.A, model.B / a, model.C * b[:, None], model.D * b[:, None] / a, model.dt,
            model.u_op * a, model.y_op * b,
        )  # fmt: skip
        limits = mampc.Limits(
            u_min=(model.u_op - 1) * a, u_max=(model.u_op + 1) * a, y_max=(model.y_op + 1) * b
        )
        problem = mampc.TrackingProblem(
            scaled, prediction_horizon=8, control_horizon=4, output_weight=1 / b**2, move_weight=0.1 / a**2,
            limits=limits,
        )  # fmt: skip
        controller = rivals.Penalised(problem, penalty=made(weight=weight, size=0.5 * a), on=on)
        decision = controller.step(
            controller.initial_state((model.u_op + u) * a), x, (model.y_op + deviation) * b
        )
        assert not decision.status.name.startswith("HELD")
        return decision.plan / a

    np.testing.assert_allclose(decided(*scales), decided(np.ones(2), np.ones(2)), atol=1e-4)


@pytest.mark.parametrize(
    "penalty", [rivals.GroupL2(weight=0.5), rivals.CLOT(weight=0.5)], ids=["group_l2", "clot"]
)
def test_limits_of_moves_told_at_a_sample_are_kept_to_rounding(penalty):
    limits = mampc.Limits(u_min=-3.0, u_max=3.0, du_max=1.0, y_max=2.0)
    controller = rivals.Penalised(
        mampc.TrackingProblem(
            random_model(1, n=3, m=2, l=2), prediction_horizon=6, control_horizon=3, limits=limits
        ),
        penalty=penalty,
    )
    rng, state = np.random.default_rng(0), controller.initial_state()
    for _ in range(25):
        du_max = rng.uniform(0.0, 1.0, 2)
        decision = controller.step(
            state, 1e4 * rng.standard_normal(3), [0.0, 0.0], limits=mampc.Limits(du_max=du_max)
        )
        assert (np.abs(decision.u - state.inputs[-1]) <= du_max + 1e-12).all()
        state = decision.state


@pytest.mark.parametrize("seed", [0, 1])
def test_with_inputs_to_spare_a_step_is_the_same_to_the_bit(seed):
    rng = np.random.default_rng(26 + seed)
    gain, lag = 3 * rng.standard_normal((1, 3)), rng.uniform(1.0, 20.0, (1, 3))
    dead_time = rng.integers(0, 3, (1, 3)).astype(float)
    model = mampc.StateSpace.from_first_order(gain=gain, time_constant=lag, dead_time=dead_time, dt=1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=4, control_horizon=2)
    for controller in (
        rivals.SelfTriggered(mampc.MPC(problem), longest=5),
        rivals.SparseInputs(problem, most=1),
        rivals.Penalised(problem, penalty=rivals.L1(), on="inputs"),
    ):
        state, x = controller.initial_state(), rng.standard_normal(model.n_states)
        first, *others = [controller.step(state, x, [1.0]).plan for _ in range(4)]
        for plan in others:
            np.testing.assert_array_equal(plan, first)


def test_bounds_that_cross_are_refused_beside_norms_too():
    program = QuadraticProgram(np.eye(2), np.zeros((0, 2)), 2)
    solver = NormsSolver(program, [Norm(1.0, np.eye(2))])
    low, high = np.array([-1.0, 1.0]), np.array([1.0, -1.0])
    assert solver.solve(np.ones(2), low, high, [np.zeros(2)]).status is QPStatus.BAD_DATA
    assert solver.solve(np.ones(2), -np.ones(2), np.ones(2), [np.zeros(2)]).status is QPStatus.OPTIMAL


@pytest.mark.parametrize("seed", range(3))
def test_the_riccati_weight_is_the_cost_of_going_on_for_ever(seed):
    """The optimum is that of an independent solver with the terminal cost of the Riccati equation added."""
    problem, x, reference, u = random_problem(seed)
    stated = PENALTIES["l1"]
    controller = rivals.Penalised(problem, penalty=stated[0], on="inputs", terminal="riccati")
    parameter = controller.condensed.parameter.vector(x, u, reference)
    steady = mampc.program.steady.SteadyTarget(problem, controller.condensed.parameter).at(parameter)
    from scipy.linalg import solve_discrete_are

    model = problem.model
    P = solve_discrete_are(model.A, model.B, model.C.T @ model.C, 0.1 * np.eye(2))
    optimum, _ = convex(
        problem, x, reference, u, stated[1], on="inputs", u_s=steady.u,
        extra=lambda state: cp.quad_form(state - steady.x, cp.psd_wrap(P)),
    )  # fmt: skip
    decision = controller.step(controller.initial_state(u), x, reference)
    state = x
    for i in range(problem.prediction_horizon):
        state = model.A @ state + model.B @ (decision.plan[min(i, 3)] - model.u_op)
    ours = decision.objective + stated[0].value(np.abs(decision.plan - steady.u) / SIZE)
    assert ours + (state - steady.x) @ P @ (state - steady.x) == pytest.approx(optimum, rel=2e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "penalty", [rivals.SCAD(weight=2.0, size=0.3), rivals.MCP(weight=2.0, size=0.3), rivals.LogSum(weight=1.0)],
    ids=["scad", "mcp", "log_sum"],
)  # fmt: skip
def test_rounds_never_raise_a_concave_objective_and_end_where_it_is_stationary(penalty, seed):
    problem, x, reference, u = random_problem(seed)

    def objective(rounds):
        controller = rivals.Penalised(problem, penalty=penalty, rounds=rounds)
        decision = controller.step(controller.initial_state(u), x, reference)
        return decision, decision.objective + penalty.value(np.abs(decision.changes) / penalty.size)

    values = [objective(rounds)[1] for rounds in range(1, 8)]
    assert (np.diff(values) <= 1e-6 * values[0]).all()
    decision, value = objective(200)
    rng = np.random.default_rng(seed)
    low, high = problem.limits.u_min, problem.limits.u_max
    controller = mampc.MPC(problem)
    sample = controller.condensed.sample(controller.condensed.parameter.vector(x, u, reference), u)
    for _ in range(200):  # no small step to other plans within the limits lowers it to first order
        plan = np.clip(decision.plan + 1e-5 * rng.standard_normal(decision.plan.shape), low, high)
        changes = np.diff(plan, axis=0, prepend=u[None])
        near = controller.condensed.cost(sample, changes.ravel()) + penalty.value(
            np.abs(changes) / penalty.size
        )
        assert near >= value - 1e-6 * 1e-2 * abs(value)


# Self-triggered control waits for loads that fade as it does for the plant: its function counts all states alike.
@pytest.mark.parametrize(
    ("name", "bank"), [(n, bank) for n in ALL for bank in (False, True) if (n, bank) != ("self", True)]
)
def test_a_rival_runs_like_any_controller_with_either_estimator(name, bank):
    estimator = mampc.LoadBank(tank_model(), noise=0.1) if bank else None
    regulator = mampc.Regulator(ALL[name](tank_problem()), estimator)
    run = mampc.simulate(tank_model(), regulator, [34.0, 28.0], steps=60, noise=0.1)
    assert run.metrics(skip=30).tracking_error < 0.5
    assert (run.u >= 0).all()
    assert (run.u <= 100).all()
    state = regulator.initial_state()
    for k in range(5):
        decision = regulator.step(state, run.y_measured[k], [34.0, 28.0])
        copy = regulator.state_from_json(state.to_json())
        again = regulator.step(copy, run.y_measured[k], [34.0, 28.0])
        assert (again.u == decision.u).all()
        state = decision.state
    assert regulator.step(state, [np.nan, np.nan], [34.0, 28.0]).u.shape == (2,)


@pytest.mark.parametrize("name", ALL)
def test_units_decide_nothing(name):
    scale = np.array([1e-4, 1e3])

    def inputs(by, name=name):
        model = tank_model()
        other = mampc.StateSpace(
            model.A, model.B / by, model.C, model.D / by, model.dt, model.u_op * by, model.y_op, model.names
        )
        problem = tank_problem(
            other, limits=mampc.Limits(u_min=0.0, u_max=100.0 * by), move_weight=0.1 / by**2
        )
        made = {
            "dead_band": lambda c: rivals.DeadBand(c, size=0.5 * by),
            "any": lambda c: rivals.DeadBand(c, size=0.5 * by, kind="any"),
            "norm": lambda c: rivals.DeadBand(c, size=0.5 * by, kind="norm"),
            "rounded": lambda c: rivals.Rounded(c, step=0.5 * by),
            "hysteresis": lambda c: rivals.Rounded(c, step=0.5 * by, hysteresis=0.25),
        }
        if name in made:
            controller = made[name](mampc.MPC(problem))
        elif name in RULES:
            controller = RULES[name](mampc.MPC(problem))
        elif name == "sparse":
            controller = rivals.SparseInputs(problem, most=1)
        else:
            penalty = (rivals.LogSum if name == "log_sum" else rivals.L1)(size=by)
            lasso = {"on": "inputs", "terminal": "riccati"} if name == "lasso" else {}
            controller = rivals.Penalised(problem, penalty=penalty, **lasso)
        run = mampc.simulate(other, mampc.Regulator(controller), [34.0, 28.0], steps=25, noise=0.1)
        return run.u / by

    np.testing.assert_allclose(inputs(scale), inputs(np.ones(2)), rtol=1e-4, atol=1e-3)


def test_a_dead_band_moves_by_more_than_its_size_or_not_at_all():
    problem = tank_problem()
    run = mampc.simulate(
        tank_model(),
        mampc.Regulator(rivals.DeadBand(mampc.MPC(problem), size=1.5)),
        [34.0, 28.0],
        steps=80,
        noise=0.2,
    )
    moves = np.abs(np.diff(run.u, axis=0, prepend=run.u_initial[None]))
    assert (moves[moves > 0] > 1.5).all()
    assert 0 < (moves > 0).mean() < 0.5


def test_rounded_inputs_are_on_the_grid_and_hysteresis_saves_moves():
    def run(hysteresis):
        controller = rivals.Rounded(mampc.MPC(tank_problem()), step=0.5, hysteresis=hysteresis)
        return mampc.simulate(tank_model(), mampc.Regulator(controller), [34.0, 28.0], steps=80, noise=0.2).u

    plain, patient = run(0.0), run(0.4)
    assert (np.abs(plain / 0.5 - np.round(plain / 0.5)) < 1e-9).all()
    assert np.count_nonzero(np.diff(patient, axis=0)) < np.count_nonzero(np.diff(plain, axis=0))


@pytest.mark.parametrize("seed", range(3))
def test_slower_sampling_plans_moves_at_its_own_samples_only(seed):
    problem, x, reference, u = random_problem(seed, limits=mampc.Limits())
    controller = rivals.Periodic(mampc.MPC(problem), every=2)
    decision = controller.step(controller.initial_state(u), x, reference)
    condensed, due = controller.condensed, np.array([0, 1, 4, 5])  # of four samples with two inputs
    sample = condensed.sample(condensed.parameter.vector(x, u, reference), u)
    best = np.linalg.lstsq(condensed.U[:, due], sample.target, rcond=None)[0]
    np.testing.assert_allclose(decision.u - u, best[:2], atol=1e-9)
    held = controller.step(decision.state, x, reference)
    assert (held.u == decision.u).all()


def test_nothing_happens_without_an_event():
    """With a perfect model and no noise the outputs follow the plan, as long as its inputs are those applied."""
    problem = tank_problem(control_horizon=1)
    regulator = mampc.Regulator(rivals.EventTriggered(mampc.MPC(problem), threshold=1e-6))
    run = mampc.simulate(tank_model(), regulator, [34.0, 28.0], steps=11)
    assert np.count_nonzero(np.diff(run.u, axis=0).any(axis=1)) <= 1  # the end of the horizon


@pytest.mark.parametrize("given", [{"size": -1.0}, {"size": 1.0, "kind": "some"}])
def test_wrong_settings_are_refused(given):
    with pytest.raises(mampc.MampcError, match="expected"):
        rivals.DeadBand(mampc.MPC(tank_problem()), **given)


def test_a_rule_needs_a_controller():
    with pytest.raises(mampc.MampcError, match="expected one such as"):
        rivals.Periodic(tank_problem(), every=2)


@pytest.mark.parametrize("units", [1.0, 1e4])
@pytest.mark.parametrize("penalty", [rivals.GroupL2, rivals.CLOT], ids=["group_l2", "clot"])
def test_where_a_penalty_with_norms_holds_inputs_still_no_move_is_left(penalty, units):
    """A conic solver comes near zero only; what it leaves there would count as moves."""
    model = mampc.StateSpace(
        [[0.9, 0.1], [0, 0.7]], np.array([[1, 0.2], [0.3, 1]]) / units, np.eye(2), None, 1.0
    )
    limits = mampc.Limits(u_min=-units, u_max=units, du_max=0.2 * units)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=8, control_horizon=3, move_weight=0.1 / units**2, limits=limits
    )
    controller = rivals.Penalised(problem, penalty=penalty(weight=1.0, size=units))
    rng = np.random.default_rng(0)
    still = 0
    for _ in range(30):
        decision = controller.step(controller.initial_state(), np.zeros(2), 0.02 * rng.standard_normal(2))
        largest = np.abs(decision.changes).max(axis=1)
        assert (largest[decision.moves.any(axis=1)] > 1e-5 * units).all()
        still += not decision.moves.any()
    assert 5 < still < 30
