"""Test and reference signals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_array, as_vector, as_whole
from mampc.base.errors import MampcError

LONGEST = 100_000_000  # samples


def prbs(
    *,
    order: int = 8,
    amplitude: Any = 1.0,
    hold: int = 1,
    mean: Any = 0.0,
    inputs: int | None = None,
    samples: int | None = None,
    seed: int = 0,
) -> Array:
    """Pseudo-random binary sequences, one per input, each from its own start state.

    A maximum-length sequence repeats after 2^order - 1 bits; its bits are balanced to one. The start
    states lie evenly along one period: inputs that are short shifts of each other could not be told apart.

    Args:
        order: length of the shift register, 2 to 20.
        amplitude: half the distance between the two levels, scalar or one per input, in input units.
        hold: samples for which each bit is held.
        mean: middle of the two levels, scalar or one per input, in input units.
        inputs: number of inputs; default as many as `amplitude` or `mean` have entries, or 1.
        samples: length of the signal; default one full period, (2^order - 1) * hold.
        seed: chooses the first start state.

    Returns:
        Inputs in engineering units, shape (samples, inputs).

    Source: Ljung, System Identification (1999), section 13.3.

    Raises:
        MampcError: arguments out of range, or more inputs than there are start states.
    """
    from scipy.signal import max_len_seq

    order, hold = as_whole("order", order, 2, 20), as_whole("hold", hold, 1, LONGEST)
    if inputs is None:
        inputs = max(as_array("amplitude", amplitude).size, as_array("mean", mean).size)
    inputs = as_whole("inputs", inputs, 1, 2**order - 1)
    period = 2**order - 1
    samples = as_whole("samples", period * hold if samples is None else samples, 1, LONGEST)
    levels, middle = as_vector("amplitude", amplitude, inputs), as_vector("mean", mean, inputs)
    first = np.random.default_rng(as_whole("seed", seed, 0)).integers(period)
    bits = max_len_seq(order)[0].astype(np.float64)  # int8 would overflow when scaled
    signal = np.empty((samples, inputs))
    for i in range(inputs):
        held = np.repeat(np.roll(bits, -(first + i * period // inputs)), hold)
        signal[:, i] = middle[i] + levels[i] * (2 * np.resize(held, samples) - 1)
    return signal


def steps(samples: int, initial: Any, changes: Sequence[tuple[int, Any]]) -> Array:
    """A staircase: `initial` until the first change, then each change's value from its sample on.

    Args:
        samples: length.
        initial: values before the first change, shape (l,).
        changes: pairs (sample, values), values of shape (l,).

    Returns:
        Shape (samples, l).

    Raises:
        MampcError: values of different lengths or a sample below zero.
    """
    start = np.atleast_1d(as_array("initial", initial))
    signal = np.tile(start, (as_whole("samples", samples, 1, LONGEST), 1))
    try:
        pairs = [(as_whole("changes", at, 0), value) for at, value in changes]
    except (TypeError, ValueError):
        raise MampcError(f"changes: expected pairs (sample, values), received {changes!r}") from None
    for at, value in sorted(pairs, key=lambda change: change[0]):
        values = as_array("changes", value)
        if values.shape not in ((), start.shape):
            raise MampcError(f"changes: expected {start.size} values at {at}, received shape {values.shape}")
        signal[at:] = values
    return signal
