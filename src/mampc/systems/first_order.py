"""Models of first-order lags with dead times, as process engineers write them down: one channel per output and input.

    y_i(s) = sum_j  K_ij exp(-theta_ij s) / (tau_ij s + 1)  u_j(s)       integrating: K_ij exp(-theta_ij s) / s

sampled exactly for inputs held constant between samples. A dead time of q samples and a part f of one makes

    x+ = a x + b(f) u_{k-q} + (b(0) - b(f)) u_{k-q-1},     a = exp(-dt / tau),  b(f) = K (1 - exp(-(dt - f) / tau))

and past inputs are states, in one chain for all channels of an input (or, where that takes fewer integrators or, of as
many, fewer states, past outputs for all channels of an output): two integrators of one output could not be told apart.

Source: Åström and Wittenmark, Computer-Controlled Systems (1997), section 2.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, as_array, as_number, require_finite
from mampc.base.errors import MampcError
from mampc.systems.model_file import MOST_STATES


def first_order(
    gain: Any, time_constant: Any, dead_time: Any, dt: float
) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of the channels; see `StateSpace.from_first_order`.

    Raises:
        MampcError: shapes that do not fit together, negative or not-a-number values, more than `MOST_STATES` states.
    """
    dt = as_number("dt", dt, 0.0, exclusive=True)
    K, tau, theta = _broadcast(gain, time_constant, dead_time)
    absent = K == 0
    tau, theta = np.where(absent, 0.0, tau), np.where(absent, 0.0, theta)
    for name, values in (("time_constant", tau), ("dead_time", theta)):
        if not (values >= 0).all():
            raise MampcError(f"{name}: expected no negative values, received {values[~(values >= 0)][0]:g}")
    require_finite("dead_time", theta)
    # A dead time within rounding of whole samples is whole.
    samples = np.where(np.abs(theta / dt - np.round(theta / dt)) < 1e-9, np.round(theta / dt), theta / dt)
    turned = _size(tau.T, samples.T) < _size(tau, samples)
    _, states = _size(tau.T, samples.T) if turned else _size(tau, samples)
    if states > MOST_STATES:
        raise MampcError(
            f"from_first_order: expected a model of at most {MOST_STATES} states, received dead times that take "
            f"{states:g}; a longer dt takes fewer"
        )
    if turned:
        A, B, C, D = _realised(K.T, tau.T, samples.T, dt)
        return A.T, C.T, B.T, D.T
    return _realised(K, tau, samples, dt)


def _broadcast(*given: Any) -> tuple[Array, ...]:
    """The three matrices, of one shape (l, m)."""
    arrays = []
    for name, value in zip(("gain", "time_constant", "dead_time"), given, strict=True):
        array = as_array(name, value)
        if array.ndim not in (0, 2):
            raise MampcError(
                f"{name}: expected a number or a matrix (outputs, inputs), received shape {array.shape}"
            )
        arrays.append(array)
    require_finite("gain", arrays[0])
    shapes = {array.shape for array in arrays if array.ndim}
    if len(shapes) > 1 or 0 in next(iter(shapes), (1,)):
        received = ", ".join(str(array.shape) for array in arrays)
        raise MampcError(
            f"gain, time_constant, dead_time: expected numbers or matrices of one shape, received shapes {received}"
        )
    shape = next(iter(shapes), (1, 1))
    return tuple(np.broadcast_to(array, shape).copy() for array in arrays)


def _size(tau: Array, samples: Array) -> tuple[int, float]:
    """How many integrators and states `_realised` takes."""
    lags = sum(len({value for value in row if value > 0}) for row in tau.tolist())
    return int(np.isinf(tau).any(axis=1).sum()), float(_chains(tau, samples).sum()) + lags


def _chains(tau: Array, samples: Array) -> Array:
    """How many past values of each input are needed, shape (m,): a part of a sample takes one more."""
    longest: Array = np.ceil(samples).max(axis=0, initial=0.0)
    return longest


def _realised(K: Array, tau: Array, samples: Array, dt: float) -> tuple[Array, Array, Array, Array]:
    """One lag for each output and time constant, driven through one chain of past values for each input.

    Lags and past values are of sizes about one, whatever the units of inputs and outputs.
    """
    l, m = K.shape
    size = np.abs(np.where(np.isinf(tau), K * dt, K))
    rows = np.where(size.any(axis=1), size.max(axis=1), 1.0)
    columns = (size / rows[:, None]).max(axis=0)
    columns[columns == 0] = 1.0
    K = K / rows[:, None] / columns

    chains = _chains(tau, samples).astype(int)
    starts = np.cumsum([0, *chains])
    lags = [(i, value) for i in range(l) for value in sorted({v for v in tau[i].tolist() if v > 0})]
    n = int(starts[-1]) + len(lags)
    A, B, C, D = np.zeros((n, n)), np.zeros((n, m)), np.zeros((l, n)), np.zeros((l, m))
    for j, length in enumerate(chains):
        first = starts[j]
        if length:
            B[first, j] = columns[j]
            A[first + 1 : first + length, first : first + length - 1] = np.eye(length - 1)

    def enter(state_row: Array, input_row: Array, j: int, behind: int, amount: float) -> None:
        """Let input j, so many samples ago, enter a row."""
        if behind:
            state_row[starts[j] + behind - 1] += amount
        elif amount:
            input_row[j] += amount * columns[j]

    for state, (i, value) in enumerate(lags, int(starts[-1])):
        A[state, state], C[i, state] = np.exp(-dt / value), rows[i]
        for j in np.flatnonzero((tau[i] == value) & (K[i] != 0)).tolist():
            q = int(samples[i, j])
            rest = (1.0 - (samples[i, j] - q)) * dt
            if np.isinf(value):
                late, both = K[i, j] * rest, K[i, j] * dt
            else:
                late, both = -K[i, j] * np.expm1(-rest / value), -K[i, j] * np.expm1(-dt / value)
            enter(A[state], B[state], j, q, late)
            if rest < dt:
                enter(A[state], B[state], j, q + 1, both - late)
    for i, j in np.argwhere((tau == 0) & (K != 0)).tolist():
        enter(C[i], D[i], j, int(np.ceil(samples[i, j])), rows[i] * K[i, j])
    return A, B, C, D
