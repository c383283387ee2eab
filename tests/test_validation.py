"""Validation: fit, initial state and whiteness are what they say."""

import numpy as np
import pytest

import mampc
from mampc import IOData, MampcError, n4sid, validate
from mampc.identification.validation import whiteness
from random_systems import noise_free, noisy_record, random_system


def test_a_model_explains_its_own_simulation_from_any_state():
    system = random_system(2, 5, 2, 3, True)
    data = noise_free(system, 7, at_rest_on_average=False)
    result = validate(system, data)
    np.testing.assert_allclose(result.fit, 100, atol=1e-9)
    np.testing.assert_allclose(result.y_hat, data.y, atol=1e-10)
    np.testing.assert_allclose(system.response(data.u, result.x0), data.y, atol=1e-10)


def test_the_fit_is_that_of_its_definition():
    data, _ = noisy_record(random_system(2, 4, 2, 2, True), 0)
    result = validate(random_system(3, 4, 2, 2, True), data)
    assert np.array_equal(result.residuals, data.y - result.y_hat)
    error = np.linalg.norm(result.residuals, axis=0)
    spread = np.linalg.norm(data.y - data.y.mean(axis=0), axis=0)
    np.testing.assert_allclose(result.fit, 100 * (1 - error / spread))


def test_no_other_initial_state_fits_better():
    system = random_system(2, 4, 2, 2, True)
    data = noisy_record(system, 0)[0][:40]
    result = validate(system, data)
    spread = data.y.std(axis=0)
    least = np.sum((result.residuals / spread) ** 2)
    for direction in np.eye(4):
        for step in (-1e-3, 1e-3):
            other = data.y - system.response(data.u, result.x0 + step * direction)
            assert np.sum((other / spread) ** 2) > least


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            IOData(np.zeros((9, 2)), np.zeros((9, 2)), 2.0),
            "expected a record sampled every 1 s, received 2 s",
        ),
        (
            IOData(np.zeros((9, 1)), np.zeros((9, 2)), 1.0),
            "expected 2 inputs and 2 outputs, received 1 and 2",
        ),
        (
            IOData(np.zeros((9, 2)), np.zeros((9, 3)), 1.0),
            "expected 2 inputs and 2 outputs, received 2 and 3",
        ),
    ],
)
def test_a_record_that_does_not_belong_to_the_model_is_refused(data, message):
    with pytest.raises(MampcError, match=message):
        validate(random_system(0, 4, 2, 2, True), data)


def test_white_residuals_pass_the_whiteness_test_as_often_as_its_level_says():
    p = whiteness(np.random.default_rng(0).standard_normal((500, 400)))
    assert 0.02 < np.mean(p < 0.05) < 0.09
    assert 0.4 < np.median(p) < 0.6


def test_coloured_residuals_fail_the_whiteness_test():
    noise = np.random.default_rng(1).standard_normal((500, 3))
    moving_average = noise[1:] + 0.7 * noise[:-1]
    drifting = np.cumsum(noise, axis=0)[1:]
    assert (whiteness(np.hstack([moving_average, drifting])) < 1e-6).all()


def test_residuals_that_vanish_count_as_white():
    assert np.array_equal(whiteness(np.zeros((50, 2))), [1.0, 1.0])


def test_the_residuals_of_the_true_system_are_white_and_those_of_a_wrong_one_are_not():
    system = random_system(1, 4, 2, 2, True)
    data = noisy_record(system, 1)[0]
    assert (validate(system, data).whiteness > 0.01).all()
    assert (n4sid(data, order=1).validate(data).whiteness < 1e-6).all()


def test_the_fit_to_several_records_counts_all_of_their_samples():
    rng = np.random.default_rng(5)
    model = mampc.StateSpace.from_first_order(
        gain=[[2.0]], time_constant=[[50.0]], dead_time=[[0.0]], dt=10.0
    )
    u = np.concatenate([np.zeros(40), np.repeat(rng.choice([-1.0, 1.0], 60), 5)])[:, None]
    y = model.response(u) + 0.05 * rng.standard_normal((len(u), 1))
    whole = mampc.n4sid(mampc.IOData(u, y, 10.0), order=1)
    pieces = mampc.n4sid([mampc.IOData(u[:40], y[:40], 10.0), mampc.IOData(u[40:], y[40:], 10.0)], order=1)
    np.testing.assert_allclose(pieces.fit, whole.fit, atol=3.0)
