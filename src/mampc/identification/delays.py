"""Dead times, found channel by channel.

For every output, an ARX model with a few coefficients of its own past and a few of each input is fitted by
least squares with each input set back by a number of samples; the smallest set-back is taken that explains the
output as well as the best one does. Inputs take turns until nothing improves.

Source: Ljung, System Identification (1999), section 17.3 (scanning delays of low-order ARX models).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array

Integers: TypeAlias = npt.NDArray[np.integer[Any]]

LONGEST = 300  # samples
OWN, EACH = 4, 4  # coefficients of the output's past and of each input
SAFE = 1  # samples by which a delay found may be too long
CHANCE = 12.0  # difference of log likelihoods, twice, that sets a delay apart from the best
ENOUGH = 20_000  # samples to look at
_TURNS = 3
_CHUNK = 2048  # rows at once


def find_delays(u: Sequence[Array], y: Sequence[Array], first: int = 0) -> Integers:
    """Dead times in samples, shape (l, m), of records u (N, m) and y (N, l); zero where none shows.

    Beyond the one sample that every sampled plant without feedthrough takes.

    Args:
        first: lag of the latest inputs that may act, 0 or 1. Under feedback the present ones know the present outputs.
    """
    m, l = u[0].shape[1], y[0].shape[1]
    total = sum(map(len, u))
    longest = min(LONGEST, total // (10 * m), max(map(len, u)) // 4)
    if longest < 4:
        return np.zeros((l, m), dtype=int)
    lags = longest + EACH
    moments, count = _moments(u, y, lags)
    delays = np.zeros((l, m), dtype=int)
    for i in range(l):
        delays[i] = _delays_of_output(moments, count, m, lags, i, longest, first)
    return delays


def _moments(u: Sequence[Array], y: Sequence[Array], lags: int) -> tuple[Array, int]:
    """Products of all lagged signals: u_1 at lags 0..lags - 1, u_2 ..., y_1 at lags 0..OWN, y_2 ..., summed up.

    A line in time is taken off every column.
    """
    m, l = u[0].shape[1], y[0].shape[1]
    size = m * lags + l * (OWN + 1)
    moments, count = np.zeros((size, size)), 0
    for inputs, outputs in zip(u, y, strict=True):
        if len(inputs) <= 2 * lags:
            continue
        inputs, outputs = inputs[-ENOUGH:], outputs[-ENOUGH:]
        N = len(inputs) - lags + 1
        time = np.arange(N) / N - 0.5
        basis = np.linalg.qr(np.column_stack([np.ones(N), time]))[0]
        U = np.lib.stride_tricks.sliding_window_view(inputs, lags, axis=0)[..., ::-1]  # (N, m, lags)
        Y = np.lib.stride_tricks.sliding_window_view(outputs[lags - OWN - 1 :], OWN + 1, axis=0)[..., ::-1]
        trend = np.zeros((2, size))
        for start in range(0, N, _CHUNK):
            chunk = slice(start, start + _CHUNK)
            rows = np.concatenate([part[chunk].reshape(len(part[chunk]), -1) for part in (U, Y)], axis=1)
            moments += rows.T @ rows
            trend += basis[chunk].T @ rows
        moments -= trend.T @ trend
        count += N
    return moments, count


def _delays_of_output(M: Array, count: int, m: int, lags: int, i: int, longest: int, first: int) -> Integers:
    own = m * lags + i * (OWN + 1) + np.arange(OWN + 1)
    target, past = own[:1], own[1:]
    window = np.arange(EACH)
    delays = np.full(m, first)
    for _ in range(_TURNS):
        before = delays.copy()
        for j in range(m):
            others = [k * lags + delays[k] + window for k in range(m) if k != j]
            fixed = np.concatenate([past, *others])
            error = _errors(M, target, fixed, j * lags + window, longest)[first:]
            worse = count * np.log(error / error.min())
            delays[j] = first + int(np.argmax(worse <= CHANCE))
        if (delays == before).all():
            break
    shorter: Integers = np.maximum(delays - SAFE, 0)
    return shorter


def _errors(M: Array, target: Integers, fixed: Integers, window: Integers, longest: int) -> Array:
    """The sum of squared errors with one input's window set back by 0..longest - 1 samples, shape (longest,)."""
    F = M[np.ix_(fixed, fixed)]
    F = F + np.diag(_ridge(1e-12, np.diag(F)))
    solved = np.linalg.solve(F, M[fixed])  # what the fixed regressors take of everything
    places = np.arange(longest)[:, None] + window  # (longest, EACH)
    W = M[places[:, :, None], places[:, None, :]] - M[fixed][:, places].transpose(1, 2, 0) @ solved[
        :, places
    ].transpose(1, 0, 2)
    c = M[places, target[0]] - solved[:, places].transpose(1, 2, 0) @ M[fixed, target[0]]
    total = M[target[0], target[0]] - M[target[0], fixed] @ solved[:, target[0]]
    scale = np.einsum("kii->ki", M[places[:, :, None], places[:, None, :]])
    W = W + _ridge(1e-10, scale)[:, :, None] * np.eye(len(window))
    gain = np.einsum("ki,ki->k", c, np.linalg.solve(W, c[..., None])[..., 0])
    errors: Array = np.maximum(total - gain, 1e-12 * M[target[0], target[0]])
    return errors


def _ridge(share: float, squares: Array) -> Array:
    """A share of sums of squares; what stands still gets anything, which leaves it without a say."""
    ridge: Array = np.where(squares > 0, share * squares, 1.0)
    return ridge
