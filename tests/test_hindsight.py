"""What a bank foretold is compared with what came, and models that resonate or integrate are trusted by it."""

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
def test_sums_are_those_of_predictions_made_up_to_a_horizon_before(missing):
    model, rng = resonant(0.4, 0.2, 3.0), np.random.default_rng(0)
    bank = mampc.LoadBank(model, noise=0.1)
    h, believed = bank._hindsight.horizon, np.ones(1, dtype=bool)
    estimate, v, sums, course = bank.initial(np.zeros(1)), np.zeros(0), np.zeros(2), []
    A, B, C = augmented(bank)
    for k in range(40):
        u, y = rng.standard_normal(1), rng.standard_normal(1)
        course = [(A @ plain + (B @ u)[:, None], A @ beside) for plain, beside in course[-h:]]
        blind = missing and k % 5 == 3
        if blind:
            estimate = bank.predict(estimate, u, v)
        elif missing:
            estimate = bank.predict(estimate, u, v)
            estimate = bank.corrected(estimate, bank.innovation(estimate, u, y, v), believed)
        else:
            estimate = bank.update(estimate, u, y, v, v).estimate
        if course and not blind:
            d = np.array([(C @ beside)[:, 0] / 0.1 for _, beside in course])
            e = np.array([(y - (C @ plain)[:, 0]) / 0.1 for plain, _ in course])
            sums = (1 - FORGETS) * sums + np.array([np.sum(e**2 - (e - d) ** 2), np.sum(d**2)]) / h
        plain = estimate.plain @ bank._plain_part
        mixed = (estimate.weights[:, None] * estimate.members).ravel() @ bank._mixture
        course.append((plain[:, None], (mixed - plain)[:, None]))
        np.testing.assert_allclose(estimate.hindsight[:2], sums, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("came", "expected"), [(1.3, 1.0), (1.0, 1.0), (0.8, 0.6), (0.5, 0.0), (-0.5, 0.0)])
def test_the_share_is_what_the_bank_misses_less_than_the_filter(came, expected):
    """Where half of what it foretold came, it is as far off as the filter."""
    hindsight, rng = mampc.LoadBank(resonant(0.4, 0.2, 3.0), noise=0.1)._hindsight, np.random.default_rng(1)
    sums = np.zeros(2)
    for foretold in 10 * rng.standard_normal((200, 5, 1)):
        sums = compared(sums, foretold, came * foretold)
    counted = UNPROVEN / (UNPROVEN + sums[1])
    assert hindsight.share(sums, np.array([1.0, 10.0])) == pytest.approx(
        np.clip(counted + (1 - counted) * (2 * came - 1), 0, 1), rel=1e-9
    )
    assert abs(hindsight.share(sums, np.array([1.0, 10.0])) - expected) < 0.01


@pytest.mark.parametrize(("damping", "expected"), [(0.1, True), (0.6, True), (0.75, False), (1.5, False)])
def test_what_resonates_is_told_by_its_damping_whatever_its_dead_time(damping, expected):
    assert resonates(resonant(0.3, damping, 0.0)) is expected
    assert resonates(resonant(0.3, damping, 12.0)) is expected


def mode(*denominator, dead_time, gain=1.0):
    return mampc.StateSpace(*joined([[transfer([gain], list(denominator), dead_time, 1.0)]]), 1.0)


WRONG = {
    "resonance": (resonant(0.13, 0.16, 3.0), resonant(0.17, 0.16, 6.7)),
    "resonance of two": (resonant(0.3, 0.1, 2.0), resonant(0.27, 0.1, 6.0)),
    "integrator behind a lag": (
        mode(7.1, 1.0, 0.0, dead_time=5.0, gain=0.05), mode(5.5, 1.0, 0.0, dead_time=7.0, gain=0.065),
    ),
    "integrator behind a resonance": (
        mode(6.3, 1.0, 1.0, 0.0, dead_time=3.0, gain=0.05), mode(5.2, 0.9, 1.0, 0.0, dead_time=5.0, gain=0.06),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("later", [False, True])
def test_where_dead_times_and_modes_are_off_a_bank_costs_little_more_than_the_filter(name, later):
    model, plant = WRONG[name]
    size = float(0.35 * np.abs(model.step_response(31)).max())
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, output_weight=1 / size**2, move_weight=0.02,
        tail_horizon=20.0, limits=mampc.Limits(u_min=-1.0, u_max=1.0),
    )  # fmt: skip
    reference, cost = mampc.steps(300, [0.0], [(10, [0.7 * size]), (150, [0.15 * size])]), []
    for estimator, counts in (
        (mampc.LoadBank(model, noise=0.03 * size), later),
        (mampc.KalmanFilter.offset_free(model, measurement_noise=0.03 * size), False),
    ):
        regulator = mampc.Regulator(
            mampc.MAMPC(problem, mampc.MoveRules(price=0.1)), estimator, value_of_information=counts
        )
        batch = mampc.simulate_batch(
            plant, regulator, reference, noise=0.03 * size, seeds=range(3), progress=False
        )
        error = np.square((batch.y - batch.r) / size).sum()
        cost.append(error + 0.1 * np.count_nonzero(np.diff(batch.u, axis=1)))
    assert cost[0] < 1.5 * cost[1]


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_integrators_in_a_row_do_not_resonate_in_any_coordinates(order, seed):
    T = np.random.default_rng(seed).standard_normal((order, order))
    A = np.linalg.solve(T, (np.eye(order) + np.eye(order, k=1)) @ T)
    model = mampc.StateSpace(A, np.linalg.inv(T)[:, -1:], T[:1], None, 1.0)
    assert not resonates(model)
