"""Inputs that do nothing but answer outputs are named; inputs with a test, or in an open loop, are not."""

import numpy as np
import pytest
from scipy.signal import lfilter

from mampc import IOData, MampcWarning, n4sid, prbs
from mampc.identification.excitation import answering


def loop(test, controlled, load, scale=(1.0, 1.0)):
    """A lag under a PI controller, or in an open loop, with a load, its inputs and outputs in other units."""
    rng = np.random.default_rng(1)
    n = 1000
    wave = np.sin(np.arange(n) / 40) if load == "wave" else np.cumsum(rng.normal(0, 0.1, n))
    moves = test * np.repeat(rng.choice([-1.0, 1.0], n // 10), 10)
    u, y, x, total = np.zeros(n), np.zeros(n), 0.0, 0.0
    for k in range(n):
        y[k] = x + 0.05 * rng.standard_normal()
        total -= 0.04 * y[k]
        u[k] = controlled * (total - 2 * y[k]) + moves[k]
        x = 0.97 * x + 0.03 * (u[k] + 3 * wave[k])
    return [IOData(50 + scale[0] * u[:, None], 100 + scale[1] * y[:, None], 10.0)]


@pytest.mark.parametrize("load", ["wave", "walk"])
@pytest.mark.parametrize("scale", [(1.0, 1.0), (1e-4, 1e5)])
def test_a_controller_without_a_test_is_named_in_any_units(load, scale):
    [said] = answering(loop(0.0, 1.0, load, scale))
    assert "u1 follows from the outputs" in said
    assert answering(loop(1.0, 1.0, load, scale)) == []
    assert answering(loop(1.0, 0.0, load, scale)) == []


def test_n4sid_warns_of_them():
    with pytest.warns(MampcWarning, match="u1 follows from the outputs"):
        n4sid(loop(0.0, 1.0, "wave"), order=1)


def test_a_test_of_two_levels_seen_within_the_sample_is_not_named():
    """Means over a sample show at once what an input does, and a random test moves at half of the samples."""
    u = prbs(order=9, hold=1, samples=1022)
    y = lfilter([0.15, 0.13], [1.0, -0.72], u[:, 0])[:, None]
    y = y + 0.003 * np.random.default_rng(0).standard_normal(y.shape)
    assert answering([IOData(u, y, 1.0)]) == []
