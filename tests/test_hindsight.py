"""What a bank foretold is compared with what came, and models that resonate are trusted by it."""

from __future__ import annotations

import numpy as np
import pytest

import mampc
from mampc.loop.hindsight import UNPROVEN, compared, resonates
from mampc.loop.mixing import FORGETS
from mampc.systems.pairs import joined, transfer


def resonant(frequency, damping, dead_time, gain=1.0):
    numerator, denominator = [gain * frequency**2], [1.0, 2 * damping * frequency, frequency**2]
    system = transfer(numerator, denominator, dead_time, 1.0)
    return mampc.StateSpace(*joined([[system]]), 1.0)


def augmented(bank):
    """A, B and C of (x, d_u, d_y) as plans predict with."""
    model, l, m = bank.planning_model, bank.model.n_outputs, bank.model.n_inputs
    n, B = model.n_states, model.B[:, :m]
    A = np.block([[model.A, B, np.zeros((n, l))], [np.zeros((m + l, n)), np.eye(m + l)]])
    return A, np.vstack([B, np.zeros((m + l, m))]), np.hstack([model.C, model.D[:, :m], np.eye(l)])


@pytest.mark.parametrize("missing", [False, True])
def test_sums_are_those_of_predictions_made_a_horizon_before(missing):
    model, rng = resonant(0.4, 0.2, 3.0), np.random.default_rng(0)
    bank = mampc.LoadBank(model, noise=0.1)
    h, believed = bank._hindsight.horizon, np.ones(1, dtype=bool)
    estimate, v, sums, course = bank.initial(np.zeros(1)), np.zeros(0), np.zeros(2), []
    A, B, C = augmented(bank)
    for k in range(40):
        u, y = rng.standard_normal(1), rng.standard_normal(1)
        course = [(A @ plain + (B @ u)[:, None], A @ beside) for plain, beside in course]
        if missing and k % 5 == 3:
            estimate = bank.predict(estimate, u, v)
        elif missing:
            estimate = bank.predict(estimate, u, v)
            estimate = bank.corrected(estimate, bank.innovation(estimate, u, y, v), believed)
        else:
            estimate = bank.update(estimate, u, y, v, v).estimate
        if k >= h and not (missing and k % 5 == 3):
            plain, beside = course.pop(0)
            sums = compared(sums, (C @ beside)[:, 0] / 0.1, (y - (C @ plain)[:, 0]) / 0.1)
        elif k >= h:
            course.pop(0)
        plain = estimate.plain @ bank._plain_part
        mixed = (estimate.weights[:, None] * estimate.members).ravel() @ bank._mixture
        course.append((plain[:, None], (mixed - plain)[:, None]))
        np.testing.assert_allclose(estimate.sums, sums, rtol=1e-6, atol=1e-9)


def test_the_share_is_the_least_squares_fit_of_what_came():
    hindsight, rng = mampc.LoadBank(resonant(0.4, 0.2, 3.0), noise=0.1)._hindsight, np.random.default_rng(1)
    d, sums = rng.standard_normal((30, 1)), np.zeros(2)
    e = 0.4 * d + 0.1 * rng.standard_normal((30, 1))
    for foretold, missed in zip(d, e, strict=True):
        sums = compared(sums, foretold, missed)
    root = np.sqrt((1 - FORGETS) ** np.arange(30)[::-1])
    rows = np.append(root * d[:, 0], np.sqrt(UNPROVEN))
    wanted = np.append(root * e[:, 0], np.sqrt(UNPROVEN))
    (fitted,) = np.linalg.lstsq(rows[:, None], wanted)[0]
    assert hindsight.share(sums, np.array([1.0, 10.0])) == pytest.approx(fitted, rel=1e-9)


@pytest.mark.parametrize(("damping", "expected"), [(0.1, True), (0.6, True), (0.75, False), (1.5, False)])
def test_what_resonates_is_told_by_its_damping_whatever_its_dead_time(damping, expected):
    assert resonates(resonant(0.3, damping, 0.0)) is expected
    assert resonates(resonant(0.3, damping, 12.0)) is expected


def test_a_resonance_whose_frequency_and_dead_time_are_off_costs_little_more_than_with_the_filter():
    """Plans that trusted the bank whatever it had foretold cost two to five times as much."""
    model, plant = resonant(0.13, 0.16, 3.0), resonant(0.17, 0.16, 6.7)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, output_weight=8.0, move_weight=0.02,
        limits=mampc.Limits(u_min=-1.0, u_max=1.0),
    )  # fmt: skip
    reference, cost = mampc.steps(220, [0.0], [(10, [0.25]), (110, [0.05])]), []
    for estimator in (
        mampc.LoadBank(model, noise=0.005),
        mampc.KalmanFilter.offset_free(model, measurement_noise=0.005),
    ):
        regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(price=0.1)), estimator)
        batch = mampc.simulate_batch(plant, regulator, reference, noise=0.005, seeds=range(3), progress=False)
        cost.append(8 * np.square(batch.y - batch.r).sum() + 0.1 * np.count_nonzero(np.diff(batch.u, axis=1)))
    assert cost[0] < 1.5 * cost[1]


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_integrators_in_a_row_do_not_resonate_in_any_coordinates(order, seed):
    T = np.random.default_rng(seed).standard_normal((order, order))
    A = np.linalg.solve(T, (np.eye(order) + np.eye(order, k=1)) @ T)
    model = mampc.StateSpace(A, np.linalg.inv(T)[:, -1:], T[:1], None, 1.0)
    assert not resonates(model)
