"""Poles of one output whose disturbance is white: those of the least simulation error, by Gauss-Newton steps.

With y = sum_j B_j(q) / F(q) u_j + what a start adds + a constant + e, everything but F is linear, so that steps are
taken in F alone, the rest being fitted anew for each (variable projection). Equation errors, and iterations that filter
by the last F, need not end there: slow modes that they add make up for poles that are a little off.

Sources: Ljung, System Identification (1999), section 10.2; Golub and Pereyra, Inverse Problems 19 (2003).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.identification.scaling import Scaled

NUMBERS = 100_000  # in the equations of one step
STEPS, TRIES = 15, 3  # and lengths of each step, which are quarters of one another
SETTLED = 1e-4  # of the sum of squares
EDGE = 1 - 1e-9  # largest pole


class _Fit(NamedTuple):
    """Of one denominator: the sum of squares left, and the step that would leave least."""

    squares: float
    step: Array


def least_output_error(a: Array, records: Scaled, first: int) -> Array:
    """Coefficients a of F(q) = 1 - a_1 q^-1 - .. - a_n q^-n, shape (n,), from the ones given.

    Args:
        records: of one output; no more samples of it are looked at than it takes.
        first: lag from which inputs count.
    """
    n, m = len(a), records.u[0].shape[1]
    records = records.shortened(NUMBERS // (n + m * (n + 1 - first) + n + 1))
    a = stable(a)
    found = _fit(a, records, first)
    for _ in range(STEPS):
        for shortened in range(TRIES):
            further = stable(a + found.step / 4**shortened)
            tried = _fit(further, records, first)
            if tried.squares < found.squares:
                break
        else:
            return a
        settled = tried.squares > found.squares * (1 - SETTLED)
        a, found = further, tried
        if settled:
            return a
    return a


def stable(a: Array) -> Array:
    """Poles outside the unit circle mirrored to its inside, as far as rounded coefficients can say."""
    poles = np.roots(np.concatenate([[1.0], -a]))
    size = np.maximum(np.abs(poles), 1e-300)
    inside = np.where(size > EDGE, poles / size * np.minimum(1 / size, EDGE), poles)
    found: Array = -np.real(np.poly(inside))[1:]
    return np.concatenate([found, np.zeros(len(a) - len(found))])  # leading zeros have no roots


def _fit(a: Array, records: Scaled, first: int) -> _Fit:
    from scipy.signal import lfilter

    n, recursion = len(a), np.concatenate([[1.0], -a])
    sides, own, outputs = [], [], []
    for u, y in zip(records.u, records.y, strict=True):
        start = np.zeros((len(u), 1))
        start[0] = 1.0
        both = lfilter([1.0], recursion, np.hstack([u, start]), axis=0)
        # The start of each record and its constant are its own.
        Q, R = np.linalg.qr(np.hstack([_late(both[:, -1:], range(n)), np.ones((len(u), 1))]))
        side = _late(both[:, :-1], range(first, n + 1))
        sides.append(side - Q @ (Q.T @ side))
        outputs.append((y - Q @ (Q.T @ y))[:, 0])
        own.append((Q, R, side))
    X, target = np.concatenate(sides), np.concatenate(outputs)
    theta = np.linalg.lstsq(X, target, rcond=None)[0]
    left = target - X @ theta
    slopes, at = [], 0
    for (Q, R, side), y in zip(own, records.y, strict=True):
        rest = left[at : at + len(y)]
        constant = np.linalg.lstsq(R, Q.T @ (y[:, 0] - side @ theta), rcond=None)[0][-1]
        slope = _late(
            lfilter([1.0], recursion, (y[:, 0] - rest - constant)[:, None], axis=0), range(1, n + 1)
        )
        slopes.append(slope - Q @ (Q.T @ slope))
        at += len(y)
    step = np.linalg.lstsq(np.hstack([np.concatenate(slopes), X]), left, rcond=None)[0][:n]
    return _Fit(float(left @ left), step)


def _late(signals: Array, lags: range) -> Array:
    """Signals (N, p) so many samples late, side by side, zero before they begin."""
    N = len(signals)
    late = [
        np.concatenate([np.zeros((min(lag, N), signals.shape[1])), signals[: max(N - lag, 0)]])
        for lag in lags
    ]
    return np.hstack(late)
