"""A least-squares problem within bounds, made exact from a guess of its active bounds.

    minimise |F z - c|^2  subject to  low <= A z <= high

A fast dual solver keeps bounds to a tolerance, and where rows are nearly parallel (an unstable plant: every input must
do nearly the same) a little slack is worth a lot of cost. This is the dual method of Goldfarb and Idnani (Mathematical
Programming 27, 1983) with every point worked out anew by the null-space method: with A_W' = Q R on the active bounds W,
z = Q1 R^-T b + Q2 y, and y solves a least-squares problem of F Q2. So neither the condition of F is squared nor do
steps add up rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array

BROKEN = 1e-11  # of the sizes in a row: a bound missed by more is not kept
WRONG = 1e-11  # of the largest multiplier: one of the wrong sign by more is wrong
NOISE = 1e-15  # of what a sum adds up: how far it may be from the truth
DEPENDENT = 1e-12  # of a row's length: what others leave of it, when it says nothing new
ROUNDS, ROUNDS_PER_VARIABLE = 100, 4  # until it is given up; each takes up one bound, or leaves one out


class Refined(NamedTuple):
    """The optimum z and its multipliers, shape (rows,), positive at upper bounds."""

    z: Array
    multipliers: Array


class Cost(NamedTuple):
    """|F z - c|^2, the triangular factor of F, its optimum without bounds, and how far that may be from the truth."""

    F: Array
    c: Array
    factor: Array
    optimum: Array
    doubt: Array

    @classmethod
    def of(cls, F: Array, c: Array) -> Cost:
        Q, factor = np.linalg.qr(F)
        optimum = np.linalg.solve(factor, Q.T @ c)
        optimum = optimum + np.linalg.solve(factor, Q.T @ (c - F @ optimum))
        lost = NOISE * (np.abs(c) + np.abs(F) @ np.abs(optimum))
        return cls(F, c, factor, optimum, np.abs(np.linalg.solve(factor, Q.T)) @ lost)


def refined(F: Array, c: Array, A: Array, low: Array, high: Array, pull: Array) -> Refined | None:
    """The optimum, from the active bounds that multipliers `pull` (rows,) tell; None if not found."""
    length = np.sqrt(np.square(A).sum(axis=1))
    length[length == 0] = 1.0
    A, low, high = A / length[:, None], low / length, high / length
    signs = {int(i): float(np.sign(pull[i])) for i in np.flatnonzero(pull)}
    cost = Cost.of(F, c)
    for _ in range(ROUNDS + ROUNDS_PER_VARIABLE * len(F.T)):
        solved = _at(cost, A, low, high, signs)
        if solved is None:
            return None
        z, u, signs = solved
        size = max(u.values(), default=0.0)
        wrong = min(u, key=lambda i: u[i], default=-1)
        if wrong >= 0 and u[wrong] < -WRONG * max(size, -u[wrong]):
            del signs[wrong]
            continue
        rows = A @ z
        excess = np.maximum(rows - high, low - rows) - BROKEN * (np.abs(A) @ np.abs(z))
        excess[list(signs)] = -np.inf
        if not (excess > 0).any():
            multipliers = np.zeros(len(A))
            for i, sign in signs.items():
                multipliers[i] = sign * u[i]
            return Refined(z, multipliers / length)
        worst = int(excess.argmax())
        if not _taken_up(
            cost.factor, A, signs, u, worst, 1.0 if rows[worst] > high[worst] else -1.0, excess[worst]
        ):
            return None
    return None


def _taken_up(
    factor: Array,
    A: Array,
    signs: dict[int, float],
    u: dict[int, float],
    row: int,
    sign: float,
    excess: float,
) -> bool:
    """Take a broken bound up among the active ones, and leave out those that this would make pull the wrong way.

    False where nothing can keep it. `factor` is the triangular factor of F.
    """
    u_row = 0.0
    while True:
        active = list(signs)
        normals = np.array([signs[i] * A[i] for i in active]).reshape(-1, A.shape[1])
        normal = sign * A[row]
        in_cost = np.linalg.solve(factor.T, np.vstack([normals, normal]).T)
        r = np.linalg.lstsq(in_cost[:, :-1], in_cost[:, -1])[0] if active else np.zeros(0)
        left = in_cost[:, -1] - in_cost[:, :-1] @ r
        told = normals.T @ np.linalg.lstsq(normals.T, normal)[0] if active else 0.0 * normal
        new = float(np.linalg.norm(normal - told)) > DEPENDENT
        gain = float(left @ left) / 2
        full = excess / gain if new and gain > 0 else np.inf
        ratios = [u[i] / ri if ri > 0 else np.inf for i, ri in zip(active, r, strict=True)]
        at = int(np.argmin(ratios)) if ratios else -1
        step = min(full, max(ratios[at], 0.0)) if ratios else full
        if step == np.inf:
            return False
        for i, ri in zip(active, r, strict=True):
            u[i] -= step * float(ri)
        u_row, excess = u_row + step, excess - (step * gain if new else 0.0)
        if step == full:
            signs[row], u[row] = sign, u_row
            return True
        del signs[active[at]], u[active[at]]


def _at(
    cost: Cost, A: Array, low: Array, high: Array, signs: dict[int, float]
) -> tuple[Array, dict[int, float], dict[int, float]] | None:
    """The optimum on active bounds, their multipliers (positive ones pull back), and those that say something new."""
    F, c, kept = cost.F, cost.c, list(signs)
    while kept:
        # What those before leave of each row.
        left = np.abs(np.diag(np.linalg.qr(A[kept].T, mode="r")))
        known = np.flatnonzero(left <= DEPENDENT)
        if not len(known) and len(kept) <= len(left):
            break
        del kept[known[0] if len(known) else len(left)]
    k = len(kept)
    sign = np.array([signs[i] for i in kept])
    W, b = A[kept], np.where(sign > 0, high[kept], low[kept])
    Q, R = np.linalg.qr(W.T, mode="complete")
    z = Q[:, :k] @ np.linalg.solve(R[:k].T, b) if k else np.zeros(A.shape[1])
    if k < len(Q):
        Q2, R2 = np.linalg.qr(F @ Q[:, k:])
        z = z + Q[:, k:] @ np.linalg.solve(R2, Q2.T @ (c - F @ z))
    pull: Array = np.zeros(0)
    if k:
        pull, noise = _pulls(cost, z, W, b, sign, np.linalg.solve(R[:k], Q[:, :k].T))
        # One that rounding alone makes wrong is none: to leave out its bound gains less than rounding.
        pull[(sign * pull < 0) & (sign * pull > -noise)] = 0.0
    if not (np.isfinite(z).all() and np.isfinite(pull).all()):
        return None
    return z, dict(zip(kept, (sign * pull).tolist(), strict=True)), {i: signs[i] for i in kept}


def _pulls(cost: Cost, z: Array, W: Array, b: Array, sign: Array, inverse: Array) -> tuple[Array, Array]:
    """Multipliers of W z = b at the optimum z there, and how far rounding leaves them from the truth.

    They are what the gradient at z leaves, `inverse` being that of W', and what takes the optimum without bounds to z.
    Where the first does not tell a sign, each is taken as the one of both tells it that knows it better.
    """
    F, c = cost.F, cost.c
    pull = 2 * inverse @ (F.T @ (c - F @ z))
    noise = 2 * NOISE * (np.abs(inverse) @ (np.abs(F.T) @ (np.abs(c) + np.abs(F) @ np.abs(z))))
    if (sign * pull > noise).all():
        return pull, noise
    rows = np.linalg.qr(np.linalg.solve(cost.factor.T, W.T), mode="r")
    if not (np.diag(rows) != 0).all():
        return pull, noise
    back = np.linalg.inv(rows)
    back = 2 * (back @ back.T)
    other = back @ (W @ cost.optimum - b)
    of_other = np.abs(back) @ (np.abs(W) @ (cost.doubt + NOISE * np.abs(cost.optimum)) + NOISE * np.abs(b))
    better = of_other < noise
    return np.where(better, other, pull), np.where(better, of_other, noise)
