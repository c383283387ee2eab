"""Parts of a linear system: the coordinates in which some of its modes stand apart from the others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mampc.base.checks import Array


def apart(A: Array, chosen: Callable[[complex], bool]) -> tuple[Array, Array, int]:
    """A transformation T, its inverse T A makes block diagonal, with the chosen modes first.

    Returns:
        T^-1 A T, T, and the number of chosen modes. Complex pairs are chosen together.

    Source: Bavely and Stewart, SIAM J. Numerical Analysis 16 (1979): an ordered Schur form, and a Sylvester
    equation for what couples its blocks.
    """
    from scipy.linalg import schur, solve_sylvester

    n = len(A)
    S, Q, count = schur(A, output="real", sort=lambda re, im: chosen(complex(re, abs(im))))
    first, rest = np.s_[:count], np.s_[count:]
    T, blocks = np.eye(n), np.zeros((n, n))
    blocks[first, first], blocks[rest, rest] = S[first, first], S[rest, rest]
    if 0 < count < n:
        T[first, rest] = solve_sylvester(S[first, first], -S[rest, rest], -S[first, rest])
    return blocks, Q @ T, count


def balanced(A: Array, discrete: bool) -> tuple[Array, Array]:
    """I - A, or -A in continuous time, in units of the states that make its numbers alike; and these, shape (n,)."""
    from scipy.linalg import matrix_balance

    alike, (sizes, _) = matrix_balance(A, permute=False, separate=True)
    return np.eye(len(A)) * discrete - alike, sizes
