"""Pseudo-random binary sequences and staircases."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mampc import MampcError, prbs, steps

ORDERS = [2, 3, 5, 8, 11]


def correlation(a, b):
    """Circular correlation of two periods, one value per shift of b against a."""
    return np.fft.ifft(np.fft.fft(a).conj() * np.fft.fft(b)).real


def lag(a, b):
    """How far b is a circular shift of a, in either direction."""
    shift = int(np.argmax(correlation(a, b)))
    return min(shift, len(a) - shift)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seed", [0, 1, 7])
def test_a_period_has_two_levels_balanced_to_one_bit(order, seed):
    signal = prbs(order=order, seed=seed)
    assert signal.shape == (2**order - 1, 1)
    assert signal.dtype == np.float64
    assert set(signal[:, 0]) == {-1.0, 1.0}
    assert signal.sum() == 1.0


@pytest.mark.parametrize("order", ORDERS)
def test_the_autocorrelation_is_two_valued(order):
    bits = prbs(order=order, seed=3)[:, 0]
    np.testing.assert_allclose(correlation(bits, bits)[1:], -1.0, atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_the_sequence_does_not_repeat_within_a_period(order):
    bits = prbs(order=order)[:, 0]
    assert all(not np.array_equal(bits, np.roll(bits, shift)) for shift in range(1, len(bits)))


@pytest.mark.parametrize("seed", range(30))
def test_inputs_are_far_shifts_of_one_sequence(seed):
    """Two inputs that were short shifts of each other could not be told apart by identification."""
    signal = prbs(order=8, inputs=3, seed=seed)
    for i, j in [(0, 1), (0, 2), (1, 2)]:
        distance = lag(signal[:, i], signal[:, j])
        assert distance >= 255 // 3
        shifted = [np.roll(signal[:, i], shift) for shift in (distance, -distance)]
        assert any(np.array_equal(candidate, signal[:, j]) for candidate in shifted)


def test_there_are_as_many_different_inputs_as_bits_in_a_period():
    assert len(np.unique(prbs(order=4, inputs=15), axis=1).T) == 15


@given(order=st.integers(2, 7), hold=st.integers(1, 6), seed=st.integers(0, 99))
@settings(deadline=None)
def test_each_bit_is_held(order, hold, seed):
    signal = prbs(order=order, hold=hold, seed=seed, inputs=2)
    assert np.array_equal(signal, np.repeat(prbs(order=order, seed=seed, inputs=2), hold, axis=0))


def test_longer_signals_repeat_the_period_and_shorter_ones_are_its_beginning():
    period = prbs(order=4, hold=2)
    assert np.array_equal(prbs(order=4, hold=2, samples=75), np.tile(period, (3, 1))[:75])
    assert np.array_equal(prbs(order=4, hold=2, samples=7), period[:7])


def test_levels_are_in_engineering_units_per_input():
    signal = prbs(order=6, amplitude=[25.0, 0.5], mean=[50.0, -1.0])
    assert signal.shape == (63, 2)
    assert [sorted(set(column)) for column in signal.T] == [[25.0, 75.0], [-1.5, -0.5]]
    assert sorted(set(prbs(amplitude=200.0).ravel())) == [-200.0, 200.0]


def test_a_seed_gives_the_same_signal_and_others_another():
    assert np.array_equal(prbs(seed=4, inputs=2), prbs(seed=4, inputs=2))
    assert len({prbs(seed=seed).tobytes() for seed in range(10)}) > 8


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"order": 1}, "order"),
        ({"order": 21}, "order"),
        ({"order": 8.0}, "order"),
        ({"hold": 0}, "hold"),
        ({"inputs": 0}, "inputs"),
        ({"order": 3, "inputs": 8}, "inputs"),
        ({"samples": 0}, "samples"),
        ({"samples": 2.5}, "samples"),
        ({"amplitude": np.nan}, "amplitude"),
        ({"amplitude": "large"}, "amplitude"),
        ({"amplitude": [1.0, 2.0], "mean": [0.0, 0.0, 0.0]}, "amplitude"),
        ({"mean": [0.0, 0.0], "inputs": 3}, "mean"),
        ({"seed": -1}, "seed"),
        ({"seed": "lucky"}, "seed"),
    ],
    ids=repr,
)
def test_wrong_arguments_are_refused_by_name(arguments, named):
    with pytest.raises(MampcError, match=rf"{named}: expected .* received"):
        prbs(**arguments)


def test_a_staircase_holds_each_value_from_its_sample_on():
    signal = steps(8, [1.0, 2.0], [(3, [5.0, 6.0]), (6, [7.0, 8.0])])
    assert np.array_equal(signal, [[1, 2]] * 3 + [[5, 6]] * 3 + [[7, 8]] * 2)


def test_the_order_of_changes_does_not_matter():
    changes = [(6, 3.0), (2, 1.0), (4, 2.0)]
    assert np.array_equal(steps(9, 0.0, changes), steps(9, 0.0, sorted(changes)))


def test_a_scalar_is_every_value_and_a_change_past_the_end_is_none():
    assert np.array_equal(steps(3, 4.0, []), [[4.0]] * 3)
    assert np.array_equal(steps(3, [1, 2], [(1, 0.0), (9, 5.0)]), [[1, 2], [0, 0], [0, 0]])


@pytest.mark.parametrize(
    ("samples", "initial", "changes", "named"),
    [
        (0, 1.0, [], "samples"),
        (5, "high", [], "initial"),
        (5, [0.0, 0.0], [(-1, [1.0, 1.0])], "changes"),
        (5, [0.0, 0.0], [(1.5, [1.0, 1.0])], "changes"),
        (5, [0.0, 0.0], [("late", 1.0), (1, 1.0)], "changes"),
        (5, [0.0, 0.0], [(1, [1.0, 1.0, 1.0])], "changes"),
        (5, [0.0, 0.0], [(1, "high")], "changes"),
        (5, [0.0, 0.0], [3], "changes"),
    ],
)
def test_a_wrong_staircase_is_refused_by_name(samples, initial, changes, named):
    with pytest.raises(MampcError, match=rf"{named}: expected .* received"):
        steps(samples, initial, changes)
