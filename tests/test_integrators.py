"""Integrators: poles at one are found as such, slow ones are not taken for them, and models rest where plants do."""

import numpy as np
import pytest

import mampc
from mampc import IOData, StateSpace, n4sid, prbs
from mampc.study.draft import draft
from mampc.systems.properties import properties
from seeds import deep, examples, seeds


def plant_with(poles, seed=0):
    """Every output has a pole of its own, behind lags of the inputs; operating points far from zero."""
    rng = np.random.default_rng([seed, len(poles)])
    l = len(poles)
    A = np.block([[np.diag(poles), np.zeros((l, l))], [np.zeros((l, l)), 0.7 * np.eye(l)]])
    gain = rng.uniform(0.5, 1.5, (l, l)) * rng.choice([-1, 1], (l, l)) + 2 * np.eye(l)
    A[:l, l:] = gain * np.maximum(1 - np.array(poles), 0.01)[:, None]
    B = np.vstack([np.zeros((l, l)), 0.3 * np.eye(l)])
    C = np.hstack([np.eye(l), np.zeros((l, l))])
    return StateSpace(A, B, C, None, 60.0, np.full(l, 50.0), np.full(l, 4.0))


def record_of(plant, seed, *, samples=1500, noise=0.05, off=0.2, units=(1.0, 1.0)):
    """A PRBS about inputs that are not those at which the plant rests."""
    rng = np.random.default_rng(seed)
    m = plant.n_inputs
    u = plant.u_op + off + prbs(order=10, hold=8, inputs=m, samples=samples, seed=seed, amplitude=2.0)
    y = plant.response(u, 3 * rng.standard_normal(plant.n_states))
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    return IOData(u * units[0], y * units[1], plant.dt)


@pytest.mark.parametrize("units", [(1e-4, 1e5), *deep((1.0, 1.0))])
@pytest.mark.parametrize("noise", [0.0, 0.1, *deep(0.02)])
@pytest.mark.parametrize("poles", [(1.0,), (1.0, 1.0), (1.0, 0.9)])
def test_integrators_are_integrators(poles, noise, units):
    for seed in range(examples(2, quick=1)):
        fitted = n4sid(record_of(plant_with(poles), seed, noise=noise, units=units), feedthrough=False)
        assert fitted.integrators == poles.count(1.0)
        model, q = fitted.model, fitted.integrators
        np.testing.assert_array_equal(model.A[:, :q], np.eye(model.n_states)[:, :q])
        np.testing.assert_array_equal(model.A[:q], np.eye(model.n_states)[:q])
        assert not fitted.stabilised
        assert np.abs(np.linalg.eigvals(model.A[q:, q:])).max(initial=0) < 0.99
        assert (fitted.fit > 100 - 100 * noise - 1).all()


@pytest.mark.parametrize("noise", [0.1, *deep(0.02)])
@pytest.mark.parametrize("poles", [(0.98,), (0.995,), (0.998,), (0.98, 0.995)])
def test_slow_poles_that_a_record_shows_to_decay_are_no_integrators(poles, noise):
    for seed in range(examples(2, quick=1)):
        fitted = n4sid(record_of(plant_with(poles), seed, noise=noise), feedthrough=False)
        assert fitted.integrators == 0
        slowest = np.sort(fitted.model.poles().real)[-len(poles) :]
        np.testing.assert_allclose(1 - slowest, 1 - np.sort(poles), rtol=0.2)


@pytest.mark.parametrize("poles", [(1.0,), (1.0, 1.0), (1.0, 0.9), (0.99,)])
def test_the_model_rests_where_the_plant_rests(poles):
    plant = plant_with(poles)
    fitted = n4sid(record_of(plant, 0), feedthrough=False)
    model = fitted.model
    for at_rest in (plant.u_op, plant.u_op + (1.0 if 1.0 not in poles else 0.0)):
        y = model.response(np.tile(at_rest, (400, 1)), model.steady_state(at_rest))
        np.testing.assert_allclose(y, np.tile(y[:1], (400, 1)), atol=0.15)
        if 1.0 not in poles:
            np.testing.assert_allclose(y[0], plant.y_op + plant.dc_gain() @ (at_rest - plant.u_op), atol=0.05)
    unseen = record_of(plant, 5, noise=0.0, off=0.0)
    assert (fitted.validate(unseen).fit > 95).all()


@pytest.mark.parametrize("units", [(1e-4, 1e5), *deep((1.0, 1.0))])
@pytest.mark.parametrize("poles", [(1.0, 0.9), (0.95, 1.0, 0.8)])
def test_no_level_leaks_into_outputs_that_settle(poles, units):
    for seed in range(examples(3, quick=1)):
        model = n4sid(record_of(plant_with(poles, seed), seed, units=units), feedthrough=False).model
        settles = np.array(poles) < 1
        assert (model.C[settles, 0] == 0).all()
        assert (model.C[~settles, 0] != 0).all()
        np.testing.assert_array_equal(properties(model).integrating.all(axis=1), ~settles)


@pytest.mark.parametrize("seed", seeds(3, quick=1))
def test_a_loop_on_the_model_of_a_level_beside_a_settling_output_leaves_no_offset(seed):
    """A leak of the integrator into the other output once let the load drive it away."""
    plant = plant_with((1.0, 0.9), seed)
    model = n4sid(record_of(plant, seed), feedthrough=False).model
    plan = draft(model, properties(model))
    regulator = mampc.Regulator(mampc.MPC(plan.problem))
    load = mampc.loads.Steps(sizes=[[0.2, 0.2]], times=[150 * plant.dt])
    run = mampc.simulate(plant, regulator, plant.y_op, steps=500, loads=[load])
    asked = np.abs(plan.changes).max(axis=0)
    assert (np.abs(run.y - plant.y_op)[-20:].mean(axis=0) < 0.01 * asked).all()
