"""A least-squares problem within bounds, made exact from a guess of its active bounds.

    minimise |F z - c|^2  subject to  low <= A z <= high

A dual solver keeps bounds to a tolerance, and where rows are nearly parallel (an unstable plant: every input must do
nearly the same) a little slack is worth a lot of cost. Here active bounds are met by the null-space method: with
A_W' = Q R, z = Q1 R^-T b + Q2 y, and y solves a least-squares problem of F Q2. A bound that pulls the wrong way is
dropped, one that is broken is taken up, until the optimality conditions hold.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray

BROKEN = 1e-11  # of the sizes in a row: a bound missed by more is not kept
WRONG = 1e-11  # of the largest multiplier: one of the wrong sign by more is wrong
DEPENDENT = 1e-13  # of a row's length: what others leave of it, when it says nothing new


class Refined(NamedTuple):
    """The optimum z and its multipliers, shape (rows,), positive at upper bounds."""

    z: Array
    multipliers: Array


def refined(F: Array, c: Array, A: Array, low: Array, high: Array, pull: Array, most: int) -> Refined | None:
    """The optimum, from the active bounds that multipliers `pull` (rows,) tell; None if not found in `most` rounds."""
    length = np.sqrt(np.square(A).sum(axis=1))
    length[length == 0] = 1.0
    A, low, high = A / length[:, None], low / length, high / length
    sign = np.sign(pull * length)
    for _ in range(most):
        solved = _equality(F, c, A, np.where(sign > 0, high, low), sign != 0)
        if solved is None:
            return None
        z, multipliers = solved
        wrong = -multipliers * sign
        if (at := int(wrong.argmax())) >= 0 and wrong[at] > WRONG * np.abs(multipliers).max():
            sign[at] = 0.0
            continue
        rows, size = A @ z, np.abs(A) @ np.abs(z)
        above, below = rows - high - BROKEN * size, low - rows - BROKEN * size
        above[sign != 0], below[sign != 0] = -np.inf, -np.inf
        up, down = int(above.argmax()), int(below.argmax())
        if above[up] <= 0 and below[down] <= 0:
            return Refined(z, multipliers / length)
        if above[up] >= below[down]:
            sign[up] = 1.0
        else:
            sign[down] = -1.0
    return None


def _equality(F: Array, c: Array, A: Array, b: Array, active: BoolArray) -> tuple[Array, Array] | None:
    """The optimum where the active rows equal b, and multipliers of all rows; rows that say nothing new get none."""
    chosen = np.flatnonzero(active)
    independent: list[int] = []
    basis = np.zeros((0, A.shape[1]))
    for row in chosen:
        rest = A[row] - (A[row] @ basis.T) @ basis
        rest = rest - (rest @ basis.T) @ basis
        left = float(np.sqrt(rest @ rest))
        if left > DEPENDENT:
            independent.append(int(row))
            basis = np.vstack([basis, rest / left])
    W, k = A[independent], len(independent)
    Q, R = np.linalg.qr(W.T, mode="complete")
    z = Q[:, :k] @ np.linalg.solve(R[:k].T, b[independent]) if k else np.zeros(A.shape[1])
    if k < len(Q):
        free = F @ Q[:, k:]
        Q2, R2 = np.linalg.qr(free)
        z = z + Q[:, k:] @ np.linalg.solve(R2, Q2.T @ (c - F @ z))
    multipliers = np.zeros(len(A))
    if k:
        gradient = 2 * F.T @ (c - F @ z)
        multipliers[independent] = np.linalg.solve(R[:k], Q[:, :k].T @ gradient)
    return (z, multipliers) if np.isfinite(z).all() and np.isfinite(multipliers).all() else None
