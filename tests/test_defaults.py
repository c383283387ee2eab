"""Who estimates with what, unless told: the same in a regulator and in a study."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import identified_tank, tank_problem
from mampc import KalmanFilter, LoadBank, MoveRules
from mampc.study import parse_study, template
from mampc.study.regulators import regulator_of

PRICE = MoveRules(price=1.0)
SPARSE = {
    "price": PRICE, "budget": MoveRules(max_moves=2, sparsity_horizon=3), "dwell": MoveRules(dwell=3),
    "least size": MoveRules(min_size=1.0),
}  # fmt: skip


def estimator(controller):
    return mampc.Regulator(controller).estimator


@pytest.mark.parametrize("rules", SPARSE)
def test_where_moves_are_priced_or_bounded_there_is_a_load_bank(rules):
    model = identified_tank()
    bank = estimator(mampc.MAMPC(tank_problem(model), SPARSE[rules]))
    assert isinstance(bank, LoadBank)
    np.testing.assert_array_equal(bank.noise, model.noise.output)  # as its record showed


def test_plain_mpc_rules_that_bind_nothing_rivals_and_the_paper_have_a_kalman_filter():
    problem = tank_problem(identified_tank())
    mpc, price = mampc.MPC(problem), mampc.MAMPC(problem, PRICE)
    controllers = [
        mpc, mampc.MAMPC(problem, MoveRules()), mampc.rivals.DeadBand(mpc, size=1.0),
        mampc.rivals.DeadBand(price, size=1.0), mampc.ControllerBank({"price": price, "plain": mpc}),
        *(mampc.MAMPC(problem, SPARSE["budget"], method="alternating", polish=polish) for polish in (False, True)),
    ]  # fmt: skip
    for controller in controllers:
        assert isinstance(estimator(controller), KalmanFilter)
    assert isinstance(estimator(mampc.ControllerBank({"a": price, "b": price})), LoadBank)


def test_noise_that_nobody_told_is_guessed_from_limits_or_there_is_a_kalman_filter():
    model = replace(identified_tank(), noise=None)
    bank = estimator(mampc.MAMPC(tank_problem(model), PRICE))
    np.testing.assert_array_equal(bank.noise, LoadBank.for_problem(tank_problem(model)).noise)
    unlimited = tank_problem(model, limits=mampc.Limits())
    assert isinstance(estimator(mampc.MAMPC(unlimited, PRICE)), KalmanFilter)


def test_a_regulator_says_what_it_estimates_with():
    problem = tank_problem(identified_tank())
    assert "KalmanFilter" in repr(mampc.Regulator(mampc.MPC(problem)))
    sparse = mampc.MAMPC(problem, PRICE)
    assert "LoadBank" in repr(mampc.Regulator(sparse))
    assert "value_of_information" in repr(mampc.Regulator(sparse, value_of_information=True))


def counts(controller, **settings):
    return mampc.Regulator(controller, **settings).value_of_information


def test_plans_count_on_later_data_where_few_moves_have_a_price():
    model = identified_tank()
    problem = tank_problem(model, control_horizon=3)
    assert counts(mampc.MAMPC(problem, PRICE))
    assert counts(mampc.ControllerBank({"a": mampc.MAMPC(problem, PRICE), "b": mampc.MAMPC(problem, PRICE)}))
    assert not counts(mampc.MAMPC(problem, PRICE), value_of_information=False)
    assert not counts(mampc.MAMPC(problem, PRICE), estimator=KalmanFilter.offset_free(model))
    sized = MoveRules(price=1.0, min_size=1.0)
    assert counts(mampc.MAMPC(problem, sized))
    assert not counts(mampc.MAMPC(replace(problem, control_horizon=7), sized))
    assert not counts(mampc.MAMPC(problem, MoveRules(max_moves=2, sparsity_horizon=3)))
    assert not counts(mampc.MAMPC(problem, PRICE, method="greedy"))
    promised = mampc.Regulator(mampc.MAMPC(replace(problem, tail_horizon=2000.0), PRICE))
    assert promised.value_of_information
    assert np.isfinite(promised.largest_offset()).all()
    for other in (replace(problem, zone_above=1.0), replace(problem, control_horizon=8)):
        assert not counts(mampc.MAMPC(other, PRICE))
    runs_away = mampc.StateSpace([[1.05]], [[1.0]], [[1.0]], None, 1.0)
    limits = mampc.Limits(u_min=-9.0, u_max=9.0)
    unstable = mampc.TrackingProblem(runs_away, prediction_horizon=9, control_horizon=3, limits=limits)
    assert isinstance(estimator(mampc.MAMPC(unstable, PRICE)), LoadBank)
    assert not counts(mampc.MAMPC(unstable, PRICE))


@pytest.mark.parametrize(
    ("table", "of_mpc", "of_price"),
    [
        ("", KalmanFilter, LoadBank),
        ("value_of_information = false", KalmanFilter, LoadBank),
        ("measurement_noise = 0.2", KalmanFilter, LoadBank),
        ('kind = "load_bank"', LoadBank, LoadBank),
        ('kind = "kalman_filter"', KalmanFilter, KalmanFilter),
        ("drift = 0.1", KalmanFilter, KalmanFilter),
        ("value_of_information = true", KalmanFilter, LoadBank),
    ],
)
def test_a_study_has_the_same_defaults(table, of_mpc, of_price):
    text = template()
    start, end = text.index("[estimator]"), text.index("[sensors]")
    study = parse_study(f"{text[:start]}[estimator]\n{table}\n{text[end:]}")
    model = identified_tank()
    made = {one.name: regulator_of(study, model, one) for one in study.controllers}
    for name, kind in (("MPC", of_mpc), ("MAMPC ns=3", of_mpc), ("exact price", of_price)):
        assert isinstance(made[name].estimator, kind)
        assert made[name].value_of_information == (
            name == "exact price" and of_price is LoadBank and "false" not in table
        )
    if "noise" in table:
        np.testing.assert_array_equal(made["exact price"].estimator.noise, [0.2, 0.2])


def with_a_missing_delay(price):
    model, plant = (
        mampc.StateSpace.from_first_order(gain=[[2.0]], time_constant=[[20.0]], dead_time=[[delay]], dt=1.0)
        for delay in (0.0, 3.0)
    )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=4, move_weight=0.1, tail_horizon=30.0,
        limits=mampc.Limits(u_min=-10.0, u_max=10.0),
    )  # fmt: skip
    return mampc.MAMPC(problem, MoveRules(price=price)), plant, mampc.steps(300, [0.0], [(5, [1.0])])


@pytest.mark.parametrize("price", [0.1, 1.0])
@pytest.mark.parametrize("bank", [False, True])
def test_a_delay_that_the_model_lacks_is_forgiven(price, bank):
    controller, plant, reference = with_a_missing_delay(price)
    model = controller.problem.model
    estimator = LoadBank(model, noise=0.02) if bank else KalmanFilter.offset_free(model)
    regulator = mampc.Regulator(controller, estimator, value_of_information=False)
    run = mampc.simulate(plant, regulator, reference, noise=0.02, seed=1, progress=False)
    assert not np.diff(run.u[200:], axis=0).any()
    assert np.abs(run.y[200:] - 1.0).max() < (0.1 if price < 1 else 0.15)  # what the price leaves


def test_plans_that_count_on_later_data_move_less_beside_a_delay_that_the_model_lacks():
    controller, plant, reference = with_a_missing_delay(0.1)
    moves, error = [], []
    for counts in (False, True):
        regulator = mampc.Regulator(
            controller, LoadBank(controller.problem.model, noise=0.02), value_of_information=counts
        )
        batch = mampc.simulate_batch(plant, regulator, reference, noise=0.02, seeds=range(8), progress=False)
        moves.append(np.count_nonzero(np.diff(batch.u, axis=1)))
        error.append(np.square(batch.y - reference).mean())
    assert moves[1] < 0.8 * moves[0]
    assert error[1] < 1.1 * error[0]


def cost_over_the_filters(plant, problem, reference, *, price, noise, guessed=False, **surroundings):
    """Squared errors and prices of loops with a bank, over those of loops with the filter."""
    bank = LoadBank.for_problem(problem) if guessed else LoadBank(problem.model, noise=noise)
    cost = []
    for estimator in (bank, KalmanFilter.offset_free(problem.model, measurement_noise=noise)):
        regulator = mampc.Regulator(mampc.MAMPC(problem, MoveRules(price=price)), estimator)
        batch = mampc.simulate_batch(plant, regulator, reference, noise=noise, progress=False, **surroundings)
        cost.append(np.square(batch.y - batch.r).sum() + price * np.count_nonzero(np.diff(batch.u, axis=1)))
    return cost[0] / cost[1]


@pytest.mark.parametrize("delay", [6.0, 10.0])
def test_with_longer_delays_missing_the_bank_does_better_than_the_filter(delay):
    """Of 0.3 and 0.5 of the time constant."""
    model, plant = (
        mampc.StateSpace.from_first_order(gain=[[2.0]], time_constant=[[20.0]], dead_time=[[late]], dt=1.0)
        for late in (0.0, delay)
    )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, move_weight=0.1, tail_horizon=30.0,
        limits=mampc.Limits(u_min=-10.0, u_max=10.0),
    )  # fmt: skip
    reference = mampc.steps(200, [0.0], [(5, [1.0])])
    assert cost_over_the_filters(plant, problem, reference, price=0.1, noise=0.02, seeds=[1]) < 0.9


@pytest.mark.parametrize("inputs", [1, 2])
def test_with_dead_times_a_fifth_and_a_sample_off_the_bank_does_not_swing(inputs):
    """A bank that forgets moves before they show costs ten times more."""
    gain, lag, dead = [[1.0]], [[6.0]], [[8.0]]
    if inputs == 2:
        gain, lag, dead = [[1.0, 0.6], [-0.5, 1.0]], [[6.0, 10.0], [8.0, 5.0]], [[6.0, 3.0], [2.0, 7.0]]
    model, plant = (
        mampc.StateSpace.from_first_order(
            gain=off * np.array(gain), time_constant=np.array(lag) / off,
            dead_time=np.ceil(off * np.array(dead)) + late, dt=1.0,
        )
        for off, late in ((1.0, 0.0), (1.2, 1.0))
    )  # fmt: skip
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, move_weight=0.05,
        limits=mampc.Limits(u_min=-5 * np.ones(inputs), u_max=5 * np.ones(inputs)),
    )  # fmt: skip
    reference = mampc.steps(160, np.zeros(inputs), [(5, np.ones(inputs))])
    assert cost_over_the_filters(plant, problem, reference, price=0.1, noise=0.02, seeds=range(3)) < 1.5


RESONANT, INTEGRATOR = (0.0, 1.0), (1.0, 0.0)


def second_order(gain, time, damping, kind):
    """Gain over time^2 s^2 + 2 damping time s + 1, or an integrator behind a lag of that time."""
    last = [-1 / time**2, -2 * damping / time] if kind is RESONANT else [0.0, -1 / time]
    scale = 1 / time**2 if kind is RESONANT else 1 / time
    continuous = mampc.StateSpace([[0.0, 1.0], last], [[0.0], [gain * scale]], [[1.0, 0.0]], None, 0.0)
    return continuous.discretise(1.0)


@pytest.mark.parametrize("guessed", [False, True])
@pytest.mark.parametrize("kind", [RESONANT, INTEGRATOR], ids=["resonant", "integrator and lag"])
def test_with_a_wrong_model_the_bank_costs_little_more_than_the_filter(kind, guessed):
    """Gain and time are a quarter off, noise is small beside what inputs do."""
    model = second_order(1.0, 4.0, 0.1, kind)
    plant = second_order(1.25, 4.0 * 1.25 ** (-1 if kind is RESONANT else 1), 0.1, kind)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, move_weight=0.02, tail_horizon=20.0,
        limits=mampc.Limits(u_min=-1.0, u_max=1.0),
    )  # fmt: skip
    loads = [mampc.loads.RandomSteps(size=0.2, every=60.0)]
    reference = mampc.steps(150, [0.0], [(10, [0.5])])
    assert cost_over_the_filters(
        plant, problem, reference, price=0.02, noise=0.005, guessed=guessed, seeds=range(2), loads=loads
    ) < 1.4  # fmt: skip


INVERSE = mampc.StateSpace(  # first the wrong way
    [[0.78, 0.0], [0.2, 0.9]], [[0.2], [0.0]], [[-1.0, 1.5]], None, 1.0
)
DIRECT = mampc.StateSpace(
    [[0.9, 0.1], [0.0, 0.7]],
    [[0.1, 0.0], [0.05, 0.2]],
    [[1.0, 0.0], [0.3, 1.0]],
    [[0.3, 0.0], [0.1, 0.4]],
    1.0,
)
TALL = mampc.StateSpace.from_first_order(
    gain=[[1.0], [0.5], [2.0]], time_constant=[[3.0], [6.0], [2.0]], dt=1.0
)


def test_on_an_integrator_behind_a_lag_with_twice_the_gain_the_loop_with_a_bank_does_not_swing():
    """A bank that corrects less after moves costs nine times the filter."""
    model, plant = (second_order(gain, 5.0, 0.0, INTEGRATOR) for gain in (0.1, 0.2))
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, move_weight=0.02,
        limits=mampc.Limits(u_min=-1.0, u_max=1.0),
    )  # fmt: skip
    reference = mampc.steps(160, [0.0], [(5, [0.5])])
    assert cost_over_the_filters(plant, problem, reference, price=0.1, noise=0.02, seeds=range(3)) < 2.0


@pytest.mark.parametrize("guessed", [False, True])
def test_where_a_mode_grows_and_answers_come_late_the_bank_costs_no_more_than_the_filter(guessed):
    """Gain and dead time are off; a bank without doubt costs 8 times the filter where it is told the noise."""
    model, real = (mampc.StateSpace([[1.03]], [[gain * 0.03]], [[1.0]], None, 1.0) for gain in (1.0, 1.3))
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=3, move_weight=0.02, tail_horizon=1.0,
        limits=mampc.Limits(u_min=-5.0, u_max=5.0),
    )  # fmt: skip
    reference = mampc.steps(160, [0.0], [(5, [0.5])])
    assert cost_over_the_filters(
        later(real, 2), problem, reference, price=0.1, noise=0.01, guessed=guessed, seeds=range(3)
    ) < 1.1  # fmt: skip


@pytest.mark.parametrize(
    "model", [INVERSE, DIRECT, TALL], ids=["inverse response", "feedthrough", "more outputs"]
)
def test_with_twice_the_gain_of_the_model_a_loop_with_the_bank_does_not_swing_from_limit_to_limit(model):
    plant = replace(model, B=2 * model.B, D=2 * model.D)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, move_weight=0.05, tail_horizon=10.0,
        limits=mampc.Limits(u_min=-10.0, u_max=10.0),
    )  # fmt: skip
    reference = mampc.steps(200, np.zeros(model.n_outputs), [(10, 3 * model.dc_gain().sum(axis=1))])
    error = []
    for estimator in (LoadBank(model, noise=0.1), KalmanFilter.offset_free(model, measurement_noise=0.1)):
        regulator = mampc.Regulator(mampc.MAMPC(problem, MoveRules(price=0.1)), estimator)
        batch = mampc.simulate_batch(plant, regulator, reference, noise=0.1, seeds=range(2), progress=False)
        error.append(np.square(batch.y - reference).mean())
    assert error[0] < 2.5 * error[1]


DOUBLE = mampc.StateSpace([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], [[1.0, 0.0]], None, 1.0)
UNSTABLE = mampc.StateSpace([[1.08, 0.2], [0.0, 0.7]], [[0.05], [0.3]], [[1.0, 0.0]], None, 1.0)
LEVEL = mampc.StateSpace([[1.0, 0.3], [0.0, 0.7]], [[0.05], [0.3]], [[1.0, 0.0]], None, 1.0)


def later(model, samples):
    """The same model behind a dead time."""
    for _ in range(samples):
        n, m = model.B.shape
        model = mampc.StateSpace(
            np.block([[model.A, model.B], [np.zeros((m, n + m))]]), np.eye(n + m)[:, n:],
            np.hstack([model.C, model.D]), None, model.dt,
        )  # fmt: skip
    return model


@pytest.mark.parametrize(
    ("model", "late"),
    [(DOUBLE, 0), (UNSTABLE, 0), (LEVEL, 2), (UNSTABLE, 2)],
    ids=["double integrator", "unstable", "late actuator", "late unstable"],
)
def test_on_plants_that_run_away_the_bank_does_better_than_the_filter(model, late):
    """Under jumping loads outputs go far; what goes on by itself is no reason to correct less."""
    plant = later(model, late)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=3, move_weight=0.1,
        limits=mampc.Limits(u_min=-5.0, u_max=5.0),
    )  # fmt: skip
    error = []
    for estimator in (LoadBank(model, noise=0.05), KalmanFilter.offset_free(model, measurement_noise=0.05)):
        batch = mampc.simulate_batch(
            plant, mampc.Regulator(mampc.MAMPC(problem, MoveRules(price=0.1)), estimator), np.zeros((150, 1)),
            noise=0.05, seeds=range(2), loads=[mampc.loads.RandomSteps(size=0.2, every=40.0)], progress=False,
        )  # fmt: skip
        error.append(np.square(batch.y).mean())
    assert error[0] < 0.8 * error[1]
