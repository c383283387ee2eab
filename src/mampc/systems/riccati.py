"""The stationary covariance of a Kalman filter, for models of some hundred states too."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError

_ROUNDS = 60  # each doubles the number of samples seen


def predicted_covariance(A: Array, C: Array, Q: Array, R: Array) -> Array:
    """P = A (P - P C' (C P C' + R)^-1 C P) A' + Q, positive semidefinite, shape (n, n).

    Source: Chu, Fan, Lin and Wang, Int. J. Control 77 (2004): structure-preserving doubling, which converges
    quadratically.

    Raises:
        MampcError: no such solution is found: a mode that does not decay is not seen, or never disturbed.
    """
    I = np.eye(len(A))
    F, G, P = A.T, C.T @ np.linalg.solve(R, C), Q
    with np.errstate(all="ignore"):
        for _ in range(_ROUNDS):
            try:
                solved = np.linalg.solve(I + G @ P, np.hstack([F, G]))
            except np.linalg.LinAlgError:
                break
            W, V = solved[:, : len(A)], solved[:, len(A) :]
            more_P, more_G = F.T @ P @ W, F @ V @ F.T
            P, G, F = P + (more_P + more_P.T) / 2, G + (more_G + more_G.T) / 2, F @ W
            if not np.isfinite(P).all():
                break
            if (np.abs(np.diag(more_P)) <= 1e-13 * np.diag(P)).all():
                return P
    raise MampcError("expected a detectable model whose modes are all disturbed, the Riccati equation failed")
