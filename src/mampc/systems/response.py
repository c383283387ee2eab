"""Outputs of a linear system, in blocks of samples: the states of a long record are never all there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mampc.base.checks import Array

BLOCK = 4096  # samples


def responses(A: Array, B: Array, C: Array, D: Array, u: Array, u_op: Array, x: Array) -> Iterator[Array]:
    """C x[k] + D du[k] with x[k + 1] = A x[k] + B du[k] and du = u - u_op, in blocks of shape (block, l)."""
    for start in range(0, len(u), BLOCK):
        du = u[start : start + BLOCK] - u_op
        drive, states = du @ B.T, np.empty((len(du), len(A)))
        for k in range(len(du)):
            states[k] = x
            x = A @ x + drive[k]
        yield states @ C.T + du @ D.T
