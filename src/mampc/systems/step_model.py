"""State-space models of step responses, such as those of dynamic matrix control, by balanced truncation.

A response that has settled is a finite impulse response. Its Hankel matrix, zero beyond the last coefficient, is
that of a shift register, and the singular vectors of the largest singular values are its balanced truncation,
which is always stable. What clearly has not settled by the end goes on as its last sixth does: along a line (an
integrator) where its time constant is longer than the record, else towards where an exponential leads. These tails
are states of their own, and what is left of the responses has settled.

Source: Kung, 12th Asilomar Conference (1978); Cutler and Ramaker, Joint Automatic Control Conference (1980).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, BoolArray, as_array, as_number, require_finite
from mampc.base.errors import MampcError
from mampc.systems.model_file import MOST_STATES
from mampc.systems.state_space import StateSpace

MOST_COEFFICIENTS = 2000
LARGEST_HANKEL = 2000  # columns of the Hankel matrix; its decomposition takes the cube of it
ABSENT = 1e-9  # of the largest beside it: a channel of rounding alone
CLEAR = 6.0  # roughnesses of a tail by which it has to move to be more than noise
FINEST = 1e-6  # accuracies below it are lost in the squares of the Hankel matrix

Matrices = tuple[Array, Array, Array, Array]


def step_model(S: Any, accuracy: float) -> Matrices:
    """A, B, C, D of step responses S (N, l, m); see `StateSpace.from_step_response`."""
    S = _checked(S)
    if not FINEST <= as_number("accuracy", accuracy) < 1:
        raise MampcError(f"accuracy: expected a share from {FINEST:g} to below 1, received {accuracy:g}")
    largest = np.abs(S).max(axis=0)
    rows = np.where(largest.any(axis=1), largest.max(axis=1), 1.0)
    columns = (largest / rows[:, None]).max(axis=0)
    columns[columns == 0] = 1.0
    S = S / rows[:, None] / columns  # the largest in each row and column is about one
    present = np.abs(S).max(axis=0) > ABSENT
    ways = [_together(S, present, accuracy)]
    if not present.all():
        ways.append(_transposed(_together(S.transpose(0, 2, 1), present.T, accuracy)))
    A, B, C, D = min(ways, key=lambda matrices: len(matrices[0]))
    if len(A) > MOST_STATES:
        raise _too_many(accuracy)
    return A, B * columns, rows[:, None] * C, rows[:, None] * D * columns


def _together(S: Array, present: BoolArray, accuracy: float) -> Matrices:
    """Outputs that the same inputs move, as one model each: no state carries one input to an output that it spares."""
    _, l, m = S.shape
    found: Matrices = np.zeros((0, 0)), np.zeros((0, m)), np.zeros((l, 0)), np.zeros((l, m))
    for pattern in np.unique(present, axis=0):
        outputs = np.flatnonzero((present == pattern).all(axis=1))
        at = np.ix_(outputs, np.flatnonzero(pattern))
        if not pattern.any():
            continue
        A, B, C, D = _reduced(S[:, at[0], at[1]], accuracy)
        to, of, direct = np.zeros((len(A), m)), np.zeros((l, len(A))), np.zeros((l, m))
        to[:, pattern], of[outputs], direct[at] = B, C, D
        found = _beside(found, (A, to, of, direct))
    return found


def _reduced(S: Array, accuracy: float) -> Matrices:
    """A model of responses none of which is absent."""
    allowed = accuracy * np.abs(S).max(axis=0)
    tails, settled = _tails(S, accuracy)
    for truncation in _truncations(settled):
        matrices = _beside(truncation, tails)
        if (np.abs(StateSpace(*matrices, dt=1.0).step_response(len(S)) - S) <= allowed).all():
            return matrices
    raise _too_many(accuracy)


def _transposed(matrices: Matrices) -> Matrices:
    A, B, C, D = matrices
    return A.T, C.T, B.T, D.T


def _too_many(accuracy: float) -> MampcError:
    return MampcError(
        f"from_step_response: expected responses that at most {MOST_STATES} states describe to {100 * accuracy:g} %; "
        "allow more with accuracy, or leave out samples"
    )


def _checked(given: Any) -> Array:
    S = as_array("from_step_response", given)
    if S.ndim != 3 or 0 in S.shape or not 2 <= len(S) <= MOST_COEFFICIENTS:
        raise MampcError(
            "from_step_response: expected coefficients of shape (N, outputs, inputs), N from 2 to "
            f"{MOST_COEFFICIENTS}, the first of them D, received shape {S.shape}"
        )
    require_finite("from_step_response", S)
    if (len(S) - 1) * min(S.shape[1:]) > LARGEST_HANKEL:
        raise MampcError(
            f"from_step_response: expected at most {LARGEST_HANKEL} coefficients of the outputs or of the inputs, "
            f"received shape {S.shape}; leave out samples"
        )
    if not S.any():
        raise MampcError("from_step_response: expected outputs that answer, received zeros alone")
    return S


def _tails(S: Array, accuracy: float) -> tuple[Matrices, Array]:
    """What goes on beyond the record, as a model, and the responses without it."""
    N, l, m = S.shape
    span = max(1, N // 6)
    poles, slopes = np.zeros((l, m)), np.zeros((l, m))
    if 2 * span < N - 1:
        now, before = S[-1] - S[-1 - span], S[-1 - span] - S[-1 - 2 * span]
        roughness = np.std(np.diff(S[-1 - 2 * span :], 2, axis=0), axis=0) / np.sqrt(6.0)
        moving = np.abs(now) > np.maximum(accuracy * np.abs(S).max(axis=0), CLEAR * roughness)
        decay = np.where(moving, now / np.where(before == 0, np.inf, before), 0.0)
        integrates = decay >= np.exp(-span / N)
        settles = ~integrates & (decay >= np.exp(-1.0))
        poles = np.where(settles, np.where(settles, decay, 1.0) ** (1 / span), poles)
        slopes = np.where(integrates, now / span, 0.0)
    tails: Matrices = *_integrators(slopes, accuracy), np.zeros((l, m))
    for i, j in np.argwhere(poles > 0).tolist():
        p = poles[i, j]
        last = (S[-1, i, j] - S[-1 - span, i, j]) * (1 - p) / (p**-span - 1)  # the next change is p times it
        C = last * p ** -(N - 2.0) * np.eye(l)[:, i : i + 1]
        tails = _beside(tails, (np.array([[p]]), np.eye(m)[j : j + 1], C, np.zeros((l, m))))
    return tails, S - StateSpace(*tails, dt=1.0).step_response(N)


def _integrators(slopes: Array, accuracy: float) -> tuple[Array, Array, Array]:
    """As few integrators as make these slopes, (l, m) per sample."""
    left, size, right = np.linalg.svd(slopes, full_matrices=False)
    count = int((size > accuracy * max(float(size.max(initial=0.0)), 1e-300)).sum())
    root = np.sqrt(size[:count])
    return np.eye(count), root[:, None] * right[:count], left[:, :count] * root


def _truncations(S: Array) -> Any:
    """Balanced truncations of settled responses, of growing order."""
    pulses = np.diff(S, axis=0)
    N, l, m = pulses.shape
    if l < m:  # the smaller side is decomposed
        yield from map(_transposed, _truncations(S.transpose(0, 2, 1)))
        return
    hankel = np.zeros((N, l, N, m))
    for k in range(N):
        hankel[k, :, : N - k] = pulses[k:].transpose(1, 0, 2)
    square = hankel.reshape(N * l, N * m)
    values, right = np.linalg.eigh(square.T @ square)
    kept = np.flatnonzero(values > max(float(values[-1]), 1e-300) * FINEST**2)[::-1][:MOST_STATES]
    root = np.sqrt(np.sqrt(values[kept]))
    reach = (right[:, kept] * root).T.reshape(len(root), N, m)
    # A moves past inputs back by one sample.
    older = np.concatenate([reach[:, 1:], np.zeros_like(reach[:, :1])], axis=1)
    A = older.reshape(len(root), N * m) @ (right[:, kept] / root)
    C = (square[:l] @ right[:, kept]) / root
    for order in _orders(len(root)):
        yield A[:order, :order], reach[:order, 0], C[:, :order], S[0]


def _orders(most: int) -> list[int]:
    """Every order up to 20, then such as are a tenth apart."""
    orders = list(range(min(most, 20) + 1))
    while orders[-1] < most:
        orders.append(min(most, orders[-1] + max(1, orders[-1] // 10)))
    return orders


def _beside(one: Matrices, other: Matrices) -> Matrices:
    """The sum of two models."""
    n, q = len(one[0]), len(other[0])
    A = np.block([[one[0], np.zeros((n, q))], [np.zeros((q, n)), other[0]]])
    return A, np.vstack([one[1], other[1]]), np.hstack([one[2], other[2]]), one[3] + other[3]
