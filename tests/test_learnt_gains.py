"""Gains learnt from records under control: when they are taken, and when they stay."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import random_model
from mampc import loads
from mampc.loop.corrected_gains import MOST, with_gains
from seeds import seeds

NOISE = np.array([0.05, 0.1])
MODEL = mampc.StateSpace.from_first_order(
    gain=[[2.0, -0.6], [0.5, 1.5]], time_constant=[[50.0, 80.0], [40.0, 60.0]], dead_time=[[20.0, 0.0], [0.0, 10.0]],
    dt=10.0,
)  # fmt: skip
OFF = np.array([[1.25, 0.85], [0.9, 0.8]])


def record(plant, seed=0, *, model=MODEL, acting=(), noise=NOISE, steps=160):
    """A run of plain MPC on the plant, with a few set-points."""
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=3, output_weight=1 / noise**2, move_weight=20.0
    )
    loop = mampc.Regulator(mampc.MPC(problem), mampc.KalmanFilter.offset_free(model, measurement_noise=noise))
    levels = model.y_op + 20 * noise * np.random.default_rng(seed).uniform(-1, 1, (4, model.n_outputs))
    return mampc.simulate(
        plant,
        loop,
        np.repeat(levels, steps // 4, axis=0),
        noise=noise,
        seed=seed,
        loads=acting,
        progress=False,
    )


@pytest.mark.parametrize("acting", [(), (loads.RandomWalk(size=0.01),)], ids=["no load", "walk"])
def test_gains_that_are_off_are_found_under_feedback(acting):
    found = mampc.learn_gains(
        MODEL, [record(with_gains(MODEL, OFF), seed, acting=acting) for seed in (0, 1)], noise=NOISE
    )
    assert found.accepted
    assert "predict better" in str(found)
    np.testing.assert_allclose(found.factors, OFF, atol=0.12)
    assert (np.abs(found.factors - OFF) < 4 * found.deviation).all()
    np.testing.assert_allclose(
        found.model.step_response(30), MODEL.step_response(30) * found.factors, atol=1e-9
    )


@pytest.mark.parametrize("seed", range(4))
def test_gains_that_are_right_stay(seed):
    acting = (loads.RandomSteps(size=0.1, every=300.0),) if seed % 2 else ()
    found = mampc.learn_gains(MODEL, record(MODEL, seed, acting=acting), noise=NOISE)
    assert not found.accepted
    assert found.model is MODEL
    assert "no better" in found.reason


def test_a_record_may_come_from_elsewhere_and_units_decide_nothing():
    run = record(with_gains(MODEL, OFF))
    data = mampc.IOData(run.u, run.y_measured, run.dt)
    found, same = (mampc.learn_gains(MODEL, one, noise=NOISE) for one in (run, data))
    np.testing.assert_array_equal(found.factors, same.factors)
    of_u, of_y = np.array([4.0, 0.125]), np.array([2.0, 64.0])
    scaled = replace(
        MODEL, B=MODEL.B / of_u, C=MODEL.C * of_y[:, None], D=MODEL.D * of_y[:, None] / of_u, u_op=MODEL.u_op * of_u,
        y_op=MODEL.y_op * of_y,
    )  # fmt: skip
    other = mampc.learn_gains(
        scaled, mampc.IOData(run.u * of_u, run.y_measured * of_y, run.dt), noise=NOISE * of_y
    )
    np.testing.assert_allclose(other.factors, found.factors, rtol=1e-6)
    assert other.gained == pytest.approx(found.gained, rel=1e-6)


def test_no_gain_changes_its_sign():
    wrong = OFF.copy()
    wrong[0, 0] = 0.1
    found = mampc.learn_gains(
        MODEL, [record(with_gains(MODEL, wrong), seed) for seed in range(3)], noise=NOISE
    )
    assert (np.abs(found.model.dc_gain() / MODEL.dc_gain() - 1) <= MOST + 1e-9).all()
    if not found.accepted:
        assert "another model" in found.reason


def test_each_gain_is_multiplied_and_nothing_else():
    model = random_model(3, n=4, m=2, l=3, feedthrough=True)
    factors = np.random.default_rng(0).uniform(0.5, 1.5, (3, 2))
    np.testing.assert_allclose(
        with_gains(model, factors).step_response(20), model.step_response(20) * factors, atol=1e-9
    )
    assert with_gains(MODEL, np.ones((2, 2))).n_states == MODEL.n_states  # states of one input stay with it


def test_what_cannot_be_learnt_is_refused():
    run = record(MODEL)
    redundant = mampc.StateSpace.from_first_order(gain=[[1.0, 2.0]], time_constant=[[50.0, 50.0]], dt=10.0)
    alike = mampc.StateSpace.from_first_order(
        gain=[[1.0, 1.02], [1.0, 1.0]], time_constant=np.full((2, 2), 50.0), dt=10.0
    )
    for model in (redundant, alike):
        data = mampc.IOData(np.zeros((80, 2)), np.zeros((80, model.n_outputs)), 10.0)
        with pytest.raises(mampc.MampcError, match="stand in for"):
            mampc.learn_gains(model, data, noise=0.1)
    missing = np.where(run.t[:, None] == 400.0, np.nan, run.y)
    for records, words in (
        ([], "at least one"), (3, "records"), ([3], "IOData or runs"),
        (mampc.IOData(run.u, run.y, 5.0), "sample time"), (mampc.IOData(run.u[:, :1], run.y, 10.0), "2 inputs"),
        (mampc.IOData(run.u[:20], run.y[:20], 10.0), "60 samples"),
        (replace(run, y_measured=missing), r"received nan at \[40, 0\]"),
    ):  # fmt: skip
        with pytest.raises(mampc.MampcError, match=words):
            mampc.learn_gains(MODEL, records, noise=NOISE)
    with pytest.raises(mampc.MampcError, match="noise"):
        mampc.learn_gains(MODEL, run)


@pytest.mark.parametrize("seed", seeds(6, quick=2))
def test_a_loop_goes_on_with_learnt_gains_without_a_bump_and_with_less_error(seed):
    """Begun from the inputs so far and the present measurements, in a steady state."""
    plant, rng = mampc.Mismatch(gain=0.25).drawn(MODEL, seed=seed), np.random.default_rng(seed)
    reference = np.tile(np.repeat([[1.0, -1.0], [0.0, 0.0]], 100, axis=0), (2, 1))
    noise = NOISE * rng.standard_normal((400, 2))

    def regulator(model):
        problem = mampc.TrackingProblem(
            model, prediction_horizon=20, control_horizon=3, output_weight=1 / NOISE**2, move_weight=20.0
        )
        return mampc.Regulator(
            mampc.MAMPC(problem, mampc.MoveRules(price=30.0)), mampc.LoadBank(model, noise=NOISE)
        )

    def went_on(loop, state, x, samples):
        u, y = [], []
        for k in samples:
            y.append(plant.y_op + plant.C @ x + noise[k])
            decision = loop.step(state, y[-1], reference[k])
            state, x = decision.state, plant.A @ x + plant.B @ (decision.u - plant.u_op)
            u.append(decision.u)
        return np.array(u), np.array(y), state, x

    old, first, second = regulator(MODEL), range(200), range(200, 400)
    u, y, state, x = went_on(old, old.initial_state(), np.zeros(plant.n_states), first)
    found = mampc.learn_gains(MODEL, mampc.IOData(u, y, MODEL.dt), noise=NOISE)
    new = regulator(found.model)
    kept = went_on(old, state, x, second)
    learnt = went_on(new, new.initial_state(u[-10:], y[-1]), x, second)
    error, moves = [], []
    for inputs, outputs, *_ in (kept, learnt):
        error.append(np.mean(((outputs - reference[200:]) / NOISE) ** 2))
        moves.append(np.count_nonzero(np.diff(np.vstack([u[-1:], inputs[:10]]), axis=0)))
    assert error[1] < error[0] or not found.accepted  # else it only forgot what its estimator knew
    assert moves[1] <= moves[0] + 1
