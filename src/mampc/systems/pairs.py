"""Pairs of one input and one output with dead times, and models put together of them.

Dead times may be parts of samples: an input that is held over a sample acts for the rest of it only, and for the
beginning of the next. Past inputs, as many as the dead times need, are states.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array

NEGLIGIBLE = 1e-9  # of the largest: what is rounding
SLOWEST_FREE = 1e-6  # poles nearer to zero belong to no lag


class Pair(NamedTuple):
    """One input and output: x+ = A x + early u_{k-q} + late u_{k-q-1}, y = C x + D u_k, q the whole part of `delay`.

    `delay` is in samples.
    """

    A: Array
    early: Array
    late: Array
    C: Array
    D: float
    delay: float


def delayed(A: Array, B: Array, C: Array, D: float, delay: float) -> Pair:
    """A discrete system x+ = A x + B u, y = C x + D u behind a dead time in samples."""
    early, late = _held(A, B, 1 - (delay - np.floor(delay)))
    return Pair(A, early, late, C, D, delay)


def transfer(numerator: Sequence[float], denominator: Sequence[float], dead_time: float, dt: float) -> Pair:
    """A strictly proper transfer function in s, highest powers first, sampled every dt behind a dead time."""
    from scipy.linalg import expm

    b, a = np.asarray(numerator) / denominator[0], np.asarray(denominator) / denominator[0]
    n = len(a) - 1
    flow = np.eye(n + 1, k=1)  # in controllable form, with the input behind the states
    flow[n - 1, :n], flow[n] = -a[:0:-1], 0.0
    held = expm(flow * dt)
    C = np.zeros(n)
    C[: len(b)] = b[::-1]
    return delayed(held[:n, :n], held[:n, n], C, 0.0, dead_time / dt)


def _held(A: Array, B: Array, part: float) -> tuple[Array, Array]:
    """How an input acts that comes when only the last `part` of a sample is left: then, and in the sample after."""
    if part == 1.0 or not len(A):
        return B, np.zeros_like(B)
    early = part * B
    if np.abs(np.linalg.eigvals(A)).min() > SLOWEST_FREE:
        from scipy.linalg import expm, logm

        held = np.eye(len(A) + 1)
        held[:-1, :-1], held[:-1, -1] = A, B
        flow = logm(held)
        if np.isrealobj(flow) or np.abs(flow.imag).max() < NEGLIGIBLE:
            early = expm(np.real(flow) * part)[:-1, -1]
    return early, B - early


def joined(pairs: list[list[Pair]], gains: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of one model of all pairs, outputs first, whose gains may be multiplied by `gains`, shape (l, m)."""
    l, m = len(pairs), len(pairs[0])
    gains = np.ones((l, m)) if gains is None else gains
    chains = [max(int(np.floor(pairs[i][j].delay)) + 1 for i in range(l)) for j in range(m)]
    orders = [len(pairs[i][j].A) for i in range(l) for j in range(m)]
    first_pair = sum(chains)
    n = first_pair + sum(orders)
    A, B, C, D = np.zeros((n, n)), np.zeros((n, m)), np.zeros((l, n)), np.zeros((l, m))
    starts = np.cumsum([0, *chains[:-1]])
    for j, (start, length) in enumerate(zip(starts, chains, strict=True)):
        B[start, j] = 1.0
        A[start + 1 : start + length, start : start + length - 1] = np.eye(length - 1)
    at = first_pair
    for i in range(l):
        for j in range(m):
            pair, gain = pairs[i][j], gains[i, j]
            own = slice(at, at := at + len(pair.A))
            whole = int(np.floor(pair.delay))
            A[own, own], C[i, own], D[i, j] = pair.A, gain * pair.C, gain * pair.D
            for behind, column in ((whole, pair.early), (whole + 1, pair.late)):
                if behind == 0:
                    B[own, j] += column
                else:
                    A[own, starts[j] + behind - 1] += column
    return A, B, C, D
