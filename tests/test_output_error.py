"""Poles of one output whose disturbance is white: those that leave least of the record when it is simulated."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

import mampc
from mampc.identification.output_error import least_output_error
from mampc.identification.scaling import Scaled
from mampc.systems.properties import properties
from seeds import deep, seeds
from test_loops_from_records import DT, made_up_plant


def records(rng, poles, *, inputs=2, samples=400, pieces=2, noise=0.3):
    """Pieces that start anywhere, each about a constant of its own."""
    recursion = np.poly(poles).real
    u, y = [], []
    for _ in range(pieces):
        moved = np.repeat(rng.choice([-1.0, 1.0], (samples // 5, inputs)), 5, axis=0)
        gains = rng.uniform(0.1, 0.5, (len(poles), inputs))
        driven = sum(lfilter(np.append(0.0, gains[:, j]), recursion, moved[:, j]) for j in range(inputs))
        start = lfilter(rng.standard_normal(len(poles)), recursion, np.eye(1, samples)[0])
        u.append(moved)
        y.append((driven + start + rng.normal(3) + noise * rng.standard_normal(samples))[:, None])
    one = np.ones(1)
    return Scaled(tuple(u), tuple(y), np.zeros(inputs), (np.zeros(1),) * pieces, np.ones(inputs), one)


def left(a, given):
    """What the best simulation leaves, all starts, constants and inputs fitted in one set of equations."""
    n, recursion, blocks = len(a), np.append(1.0, -a), []
    for k, (u, y) in enumerate(zip(given.u, given.y, strict=True)):
        late = [np.roll(lfilter([1.0], recursion, u, axis=0), lag, axis=0) for lag in range(1, n + 1)]
        for lag, signal in enumerate(late, start=1):
            signal[:lag] = 0.0
        start = [lfilter(np.eye(n)[i], recursion, np.eye(1, len(u))[0]) for i in range(n)]
        own = np.column_stack([*start, np.ones(len(u))])
        others = [np.zeros_like(own) for _ in given.u]
        others[k] = own
        blocks.append(np.hstack([*late, *others, y]))
    rows = np.concatenate(blocks)
    return rows[:, -1] - rows[:, :-1] @ np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]


@pytest.mark.parametrize("seed", seeds(20, quick=4))
def test_no_other_poles_leave_less(seed):
    rng = np.random.default_rng(seed)
    poles = [0.95, 0.8] if seed % 2 else [0.9 * np.exp(0.2j), 0.9 * np.exp(-0.2j), 0.5]
    given, start = records(rng, poles), -np.poly(np.array(poles) * 0.95).real[1:]
    found = least_output_error(start, given, 1)
    referee = least_squares(left, found, args=(given,), xtol=1e-12, ftol=1e-12)
    assert np.sum(left(found, given) ** 2) <= 2 * referee.cost * (1 + 1e-3)
    assert np.sum(left(found, given) ** 2) < np.sum(left(start, given) ** 2)


@pytest.mark.parametrize("seed", seeds(20, quick=2))
def test_units_change_nothing(seed):
    rng = np.random.default_rng(seed)
    given, start = records(rng, [0.95, 0.8]), -np.poly([0.9, 0.7])[1:]
    other = given.replaced([u * [1e4, 1e-5] for u in given.u], [y * 1e3 for y in given.y])
    np.testing.assert_allclose(
        least_output_error(start, other, 1), least_output_error(start, given, 1), rtol=1e-6
    )


@pytest.mark.parametrize("seed", [16, 86, *deep(*range(1, 150, 5))])
def test_a_lag_under_a_load_that_wanders_is_no_level(seed):
    plant, rng = made_up_plant(seed), np.random.default_rng(100 + seed)
    m = plant.n_inputs
    u = mampc.prbs(order=8, amplitude=3.0, hold=8, mean=plant.u_op, inputs=m, samples=1200, seed=seed)
    y = mampc.excite(plant, u, dt=DT).y
    noise, steps = rng.standard_normal(y.shape), rng.standard_normal(y.shape)
    y = y + y.std(axis=0) * (0.05 * noise + np.cumsum(0.02 * steps, axis=0))
    model = mampc.n4sid(mampc.IOData(u, y, DT), feedthrough=False, detrend="whitened").model
    assert properties(model).integrators == 0
    true = plant.step_response(200)[-1]
    assert np.abs(model.step_response(200)[-1] - true).max() < 0.35 * np.abs(true).max()
