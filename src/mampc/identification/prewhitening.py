"""Disturbances of any colour, and records under feedback: the noise is made white before a model is estimated.

An ARX model with many coefficients, A(q) y = B(q) u + e, predicts without bias under feedback too, and A(q) makes the
disturbance white. What A(q) leaves of inputs and output is explained by the same plant with white noise: simulation
errors of that are prediction errors, the most certain ones, also where past outputs moved the inputs.

Source: Zhu and Hjalmarsson, The Box-Jenkins Steiglitz-McBride algorithm, Automatica 65 (2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mampc.base.checks import Array
from mampc.identification.output_error import stable
from mampc.identification.scaling import Scaled
from mampc.identification.triangular import fold, solve

LONGEST = 30  # coefficients of the filter
ITERATIONS = 5
SETTLED = 1e-6  # change of a coefficient
SHORTEST = 8  # samples of a record, of which the filter takes a quarter
_CHUNK = 4096  # equations at once
EACH = 20  # samples for each coefficient of the ARX model, at least


def prewhitened(records: Scaled, first: int) -> Scaled:
    """Inputs and the one output through A(q) of a long ARX model; records too short for that are left out."""
    long = [k for k, u in enumerate(records.u) if len(u) >= SHORTEST]
    if 0 < len(long) < len(records.u):
        records = replace(
            records,
            u=tuple(records.u[k] for k in long),
            y=tuple(records.y[k] for k in long),
            y_mean=tuple(records.y_mean[k] for k in long),
        )
    m = records.u[0].shape[1]
    lags = max(2, min(LONGEST, records.samples // (EACH * (m + 1)), min(map(len, records.u)) // 4))
    a = denominator(records.u, records.y, lags, 0, first)
    return replace(
        records,
        u=tuple(filtered_by(u, a) for u in records.u),
        y=tuple(filtered_by(y, a) for y in records.y),
    )


def denominator(u: Sequence[Array], y: Sequence[Array], n: int, degree: int, first: int = 0) -> Array:
    """a_1 .. a_n of y[k] = sum a_i y[k - i] + sum b_ij u_j[k - i] + trend.

    Inputs count from the lag `first` on: under feedback, those of the same sample know the disturbance.
    """
    own, width = degree + 1, u[0].shape[1] * (n + 1 - first) + n + 1
    total: Array = np.empty((0, width))
    for inputs, output in zip(u, y, strict=True):
        N = len(output) - n
        if own >= N:  # too short to say anything
            continue
        R: Array = np.empty((0, own + width))
        for start in range(0, N, _CHUNK):
            stop = min(start + _CHUNK, N)
            time = np.arange(start, stop) / N - 0.5
            columns: list[Array] = [time[:, None] ** np.arange(own)]
            columns += [inputs[n - i + start : n - i + stop] for i in range(first, n + 1)]
            columns += [output[n - i + start : n - i + stop] for i in range(1, n + 1)]
            R = fold(R, np.concatenate([*columns, output[n + start : n + stop]], axis=1))
        total = fold(total, R[own:, own:])
    return solve(total)[-n:]


def refined(a: Array, records: Scaled, first: int) -> Array:
    """A denominator for white noise at the output, by the iterations of Steiglitz and McBride from a first one.

    Its poles are kept inside the unit circle.
    """
    from scipy.signal import lfilter

    a = stable(a)
    for _ in range(ITERATIONS):
        recursion = np.concatenate([[1.0], -a])
        u, y = (
            [lfilter([1.0], recursion, signal, axis=0) for signal in signals]
            for signals in (records.u, records.y)
        )
        found = stable(denominator(u, y, len(a), 0, first))
        if np.abs(found - a).max() < SETTLED:
            return found
        a = found
    return a


def filtered_by(signal: Array, a: Array) -> Array:
    """signal[k] - sum a_i signal[k - i], from the first sample with a whole past on."""
    from scipy.signal import lfilter

    whole: Array = lfilter(np.concatenate([[1.0], -a]), [1.0], signal, axis=0)
    return whole[len(a) :]
