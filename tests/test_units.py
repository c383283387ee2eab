"""Units are the user's: kg/s and Pa, or percent and bar, lead to the same decisions."""

import numpy as np
import pytest

import mampc
from builders import random_model
from seeds import examples, seeds

METHODS = {
    "mpc": None,
    "exact": {"method": "exact"},
    "alternating": {"method": "alternating", "polish": True},
}

RULES = mampc.MoveRules(price=0.02, max_moves=4, sparsity_horizon=2)  # a price is in units of the cost


def scaled(model, u, y):
    """The model with inputs in units that make their numbers u times as large, and outputs y times."""
    return mampc.StateSpace(
        model.A, model.B / u, model.C * y, model.D * y / u, model.dt, model.u_op * u, model.y_op * y
    )


@pytest.mark.parametrize(("u", "y"), [(1e-6, 1.0), (1e-5, 1e-5), (1.0, 1e-6), (1e-6, 1e6), (1e6, 1e-6)])
@pytest.mark.parametrize("rules", [None, mampc.MoveRules(max_moves=3), mampc.MoveRules(price=0.5)], ids=str)
def test_optima_are_the_same_in_small_and_large_units(rules, u, y):
    """One sample each of many problems with active limits."""
    for seed in range(examples(25, quick=8)):
        rng = np.random.default_rng(seed)
        usual = random_model(seed, n=3, m=2, l=2, radius=0.9)
        x, reference = rng.standard_normal(3), 3 * rng.standard_normal(2)
        objectives = []
        for u_unit, y_unit in ((1.0, 1.0), (u, y)):
            model = scaled(usual, u_unit, y_unit)
            limits = mampc.Limits(
                u_min=model.u_op - u_unit,
                u_max=model.u_op + u_unit,
                du_max=0.8 * u_unit,
                y_max=model.y_op + y_unit * np.array([1.5, np.inf]),
            )
            problem = mampc.TrackingProblem(
                model, prediction_horizon=8, control_horizon=3, limits=limits,
                output_weight=1 / y_unit**2, move_weight=0.1 / u_unit**2,
            )  # fmt: skip
            controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
            decision = controller.step(controller.initial_state(), x, model.y_op + y_unit * reference)
            assert decision.status == "optimal"
            objectives.append(decision.objective)
        assert objectives[1] == pytest.approx(objectives[0], rel=1e-6)


def run(model, u, y, settings, weights):
    limits = mampc.Limits(
        u_min=(model.u_op - 0.8) * u,
        u_max=(model.u_op + 0.8) * u,
        du_max=0.5 * u,
        y_max=(model.y_op + 1.2) * y,
    )
    problem = mampc.TrackingProblem(
        scaled(model, u, y), prediction_horizon=15, control_horizon=4, limits=limits, **weights
    )
    controller = mampc.MPC(problem)
    if settings is not None:
        controller = mampc.MAMPC(problem, RULES, **settings)
    high = model.y_op + np.array([1.0, -0.5])
    reference = mampc.steps(60, model.y_op * y, [(5, high * y), (30, model.y_op * y)])
    return mampc.simulate(problem.model, mampc.Regulator(controller), reference, progress=False)


@pytest.mark.parametrize("name", ["mpc", "exact"])
@pytest.mark.parametrize(("u", "y"), [(1e-3, 1.0), (1.0, 1e5), (1e4, 1e-3), (1e-3, 1e5)])
def test_units_change_numbers_and_not_decisions(name, u, y):
    """With weights in the same units."""
    model = random_model(4, n=3, m=2, l=2, radius=0.8)
    usual = run(model, 1.0, 1.0, METHODS[name], {"output_weight": 1.0, "move_weight": 0.1})
    weights = {"output_weight": 1.0 / y**2, "move_weight": 0.1 / u**2}
    other = run(model, u, y, METHODS[name], weights)
    assert other.statuses == usual.statuses
    np.testing.assert_allclose(other.u / u, usual.u, atol=1e-5)
    np.testing.assert_allclose(other.y / y, usual.y, atol=1e-5)


@pytest.mark.parametrize("u", [1e-9, 2e-5, 3e4, 1e9])
def test_what_a_run_counts_does_not_depend_on_units(u):
    """Moves, reversals and holds are those of the same run in other units, and so are the starts of its actuators."""
    model = random_model(4, n=3, m=2, l=2, radius=0.8)
    counted = []
    for unit in (1.0, u):
        outcome = run(
            model, unit, 1.0, METHODS["exact"], {"output_weight": 1.0, "move_weight": 0.1 / unit**2}
        )
        metrics = outcome.metrics(threshold=0.1 * unit, dead_band=0.05 * unit)
        counted.append(
            (
                metrics.moves,
                metrics.reversals,
                metrics.median_hold_time,
                metrics.starts,
                metrics.sparse_density,
            )
        )
        counted[-1] += (outcome.metrics().starts, metrics.travel / unit)
    assert 0 < counted[0][0].sum() < 120
    for usual, other in zip(*counted, strict=True):
        np.testing.assert_allclose(other, usual, rtol=1e-6)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("u", "y"), [(1e-3, 1e3), (1e-3, 1e5), (1e-4, 1e6), (1.0, 1e8)])
def test_with_the_default_weights_too_units_far_apart_are_controlled(name, u, y):
    """Tracking outweighs moves by many orders of magnitude then; limits are kept all the same."""
    model = random_model(4, n=3, m=2, l=2, radius=0.8)
    outcome = run(model, u, y, METHODS[name], {})
    assert set(outcome.statuses) <= {"optimal", "feasible", "warm_up"}
    assert (np.abs(outcome.u - model.u_op * u) <= 0.8 * u * (1 + 1e-9)).all()
    assert (np.abs(outcome.y[-1] - outcome.r[-1]) < 0.05 * y).all()


@pytest.mark.parametrize("seed", seeds(6, quick=3))
def test_inputs_in_units_far_from_one_another_take_no_more_iterations(seed):
    """daqp by itself cycles there; and its answers depend on what it solved before."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, n=4, m=3, l=3, radius=0.9)
    u, y = 10.0 ** rng.integers(-3, 4, 3), 10.0 ** rng.integers(-3, 4, (3, 1))
    model = mampc.StateSpace(model.A, model.B / u, model.C * y, None, model.dt)
    y = y[:, 0]
    problem = mampc.TrackingProblem(
        model,
        prediction_horizon=8,
        control_horizon=3,
        output_weight=1 / y**2,
        move_weight=0.1 / u**2,
        limits=mampc.Limits(u_min=-u, u_max=u, du_max=0.5 * u, y_min=-y, y_max=y),
    )
    for controller in (mampc.MPC(problem), mampc.MAMPC(problem, mampc.MoveRules(price=0.5))):
        loop = mampc.Regulator(controller, sensors=mampc.SensorChecks(largest_jump=np.inf, stuck_after=None))
        state = loop.initial_state()
        for _ in range(30):
            told = rng.standard_normal(3) * y, rng.standard_normal(3) * 2 * y
            decision, again = loop.step(state, *told), loop.step(state, *told)
            assert decision.status == "optimal"
            assert decision.iterations < 100
            np.testing.assert_array_equal(again.u, decision.u)
            state = decision.state


@pytest.mark.parametrize("u", [[1.0, 1e-2], [1.0, 1e3], [1e-4, 1e2]])
@pytest.mark.parametrize("y", [[1.0, 1.0], [1.0, 1e7], [1e-5, 1e3]])
def test_what_a_violated_output_limit_costs_does_not_depend_on_units(u, y):
    """One input moves the second output much more than the other does, and both limits cannot be kept."""
    decisions = []
    for u_unit, y_unit in ((np.ones(2), np.ones(2)), (np.array(u), np.array(y))):
        B = np.array([[0.3, 0.02], [-0.2, 0.1]]) / u_unit
        model = mampc.StateSpace(0.9 * np.eye(2), B, np.diag(y_unit), None, 1.0)
        limits = mampc.Limits(u_min=-3 * u_unit, u_max=3 * u_unit, y_max=2 * y_unit)
        problem = mampc.TrackingProblem(
            model, prediction_horizon=10, control_horizon=3, limits=limits,
            output_weight=1 / y_unit**2, move_weight=0.1 / u_unit**2,
        )  # fmt: skip
        mpc = mampc.MPC(problem)
        decision = mpc.step(mpc.initial_state(), [3.3, 4.9], [0.0, 0.0])
        decisions.append((decision.u / u_unit, decision.violations / y_unit, decision.objective))
    for other, usual in zip(decisions[1], decisions[0], strict=True):
        np.testing.assert_allclose(other, usual, rtol=1e-6, atol=1e-6)


RULED = {
    "budget": mampc.MoveRules(max_moves=3, sparsity_horizon=3),
    "price": mampc.MoveRules(price=0.05),
    "least size": mampc.MoveRules(price=0.05, min_size=0.2, max_moves=4),
    "dwell": mampc.MoveRules(price=0.02, dwell=3, max_moves_per_step=1),
}


def decisions_in(u, y, seed, method, rules, limited=True):
    """Samples of a closed loop on a model whose inputs and outputs are counted in units u (2,) and y (2,)."""
    rng, usual = np.random.default_rng(seed), random_model(seed, n=3, m=2, l=2, radius=0.85)
    model = mampc.StateSpace(
        usual.A, usual.B / u, usual.C * y[:, None], None, 1.0, usual.u_op * u, usual.y_op * y
    )
    limits = mampc.Limits(
        u_min=model.u_op - 0.8 * u, u_max=model.u_op + 0.6 * u, du_max=0.5 * u, y_max=model.y_op + 1.2 * y
    )  # fmt: skip
    problem = mampc.TrackingProblem(
        model, prediction_horizon=8, control_horizon=3, limits=limits if limited else mampc.Limits(),
        output_weight=1 / y**2, move_weight=0.1 / u**2,
    )  # fmt: skip
    if method == "mpc":
        controller = mampc.MPC(problem)
    else:
        size = None if rules.min_size == 0.0 else rules.min_size * u
        rules = rules if size is None else mampc.MoveRules(price=rules.price, max_moves=4, min_size=size)
        controller = mampc.MAMPC(
            problem, rules, method=method, on_limit_violation="ignore_budget", violation_margin=0.3 * y
        )
    state, x, found = controller.initial_state(), np.zeros(3), []
    for k in range(12):
        now = (
            mampc.Limits(u_max=model.u_op + (0.6 - 0.05 * np.arange(3)[:, None]) * u)
            if limited and k % 3
            else None
        )
        reference = model.y_op + (1.5 if k < 6 else -0.5) * y
        decision = controller.step(
            state, x + 0.05 * rng.standard_normal(3), reference, limits=now, manual=[k in (3, 9), False]
        )
        found.append(decision)
        state, x = decision.state, model.A @ x + model.B @ (decision.u - model.u_op)
    return found


@pytest.mark.parametrize("rules", RULED)
@pytest.mark.parametrize("method", ["mpc", "exact", "greedy", "hard_thresholding", "l1", "reweighted_l1"])
def test_moves_and_words_are_the_same_whatever_the_units(method, rules):
    """But for the alternating method, whose one penalty for all inputs is in their units, and two that multiply
    rounding from round to round, in the same units as well: penalty decomposition and ADMM.
    """
    rng = np.random.default_rng(0)
    for seed in range(examples(4, quick=1)):
        for limited in (True, *[False] * examples(1, quick=method in ("mpc", "exact"))):
            usual = decisions_in(np.ones(2), np.ones(2), seed, method, RULED[rules], limited)
            for _ in range(examples(2, quick=1)):
                u, y = 10.0 ** rng.uniform(-6, 6, 2), 10.0 ** rng.uniform(-6, 6, 2)
                other = decisions_in(u, y, seed, method, RULED[rules], limited)
                for a, b in zip(usual, other, strict=True):
                    np.testing.assert_array_equal(b.moves, a.moves)
                    assert (b.status, b.remarks) == (a.status, a.remarks)
                    np.testing.assert_allclose(b.changes / u, a.changes, atol=1e-6)
                    assert b.objective == pytest.approx(a.objective, rel=1e-6, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("seed", range(4))
def test_units_of_states_do_not_decide(seed):
    rng = np.random.default_rng(seed)
    delay = np.eye(3, k=1)
    A = np.block(
        [
            [np.array([[0.9, 0.3], [0.0, 0.7]]), np.outer([0.2, 0.5], [1.0, 0.0, 0.0])],
            [np.zeros((3, 2)), delay],
        ]
    )
    model = mampc.StateSpace(A, np.eye(5)[:, -1:], np.eye(5)[:1], None, 1.0)
    unit = 2.0 ** rng.integers(-25, 26, 5)
    other = mampc.StateSpace(A * unit[:, None] / unit, model.B * unit[:, None], model.C / unit, None, 1.0)
    np.testing.assert_allclose(other.dc_gain(), model.dc_gain(), rtol=1e-9)
    runs = []
    for one in (model, other):
        problem = mampc.TrackingProblem(
            one, prediction_horizon=12, control_horizon=3, limits=mampc.Limits(u_min=-2.0, u_max=2.0)
        )
        controller = mampc.MAMPC(problem, mampc.MoveRules(price=0.05))
        kalman = mampc.Regulator(controller, mampc.KalmanFilter.offset_free(one))
        for regulator in (kalman, mampc.Regulator(controller)):
            # What does not fit the model, up to what is too far off to be believed.
            load = np.where(np.arange(40)[:, None] > 15, 1.5, 0.0) + 9.0 * (np.arange(40)[:, None] == 25)
            runs.append(
                mampc.simulate(model, regulator, [1.0], steps=40, noise=0.02, seed=1, output_disturbance=load)
            )
    for run, same in zip(runs[:2], runs[2:], strict=True):
        np.testing.assert_allclose(same.u, run.u, rtol=1e-9, atol=1e-9)
        assert [d.ignored_outputs for d in same.decisions] == [d.ignored_outputs for d in run.decisions]
    assert any(d.ignored_outputs for d in runs[0].decisions)


@pytest.mark.parametrize("seed", range(3))
def test_steady_states_and_what_a_price_leaves_do_not_depend_on_units(seed):
    rng = np.random.default_rng(seed)
    gain = np.array([[1.0, 0.5, -0.2], [0.3, -1.0, 0.8]])
    model = mampc.StateSpace.from_first_order(gain=gain, time_constant=10.0 + 20 * rng.random((2, 3)), dt=2.0)
    x, u, y = (2.0 ** rng.integers(-25, 26, count) for count in (model.n_states, 3, 2))
    other = mampc.StateSpace(
        model.A * x[:, None] / x, model.B * x[:, None] / u, model.C * y[:, None] / x, None, model.dt
    )
    np.testing.assert_allclose(
        other.steady_state([1, 2, 3] * u) / x, model.steady_state([1, 2, 3]), rtol=1e-9
    )
    offsets = [
        mampc.largest_offset(
            mampc.TrackingProblem(
                one, prediction_horizon=20, control_horizon=2, output_weight=1 / wide**2,
                move_weight=0.1 / far**2, tail_horizon=100.0,
            ),
            mampc.MoveRules(price=0.1),
        ) / wide
        for one, wide, far in ((model, np.ones(2), np.ones(3)), (other, y, u))
    ]  # fmt: skip
    assert np.isfinite(offsets[0]).all()
    np.testing.assert_allclose(offsets[1], offsets[0], rtol=1e-6)
