"""The stationary covariance of a Kalman filter, for models of some hundred states too."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError

_ROUNDS = 60  # each doubles the number of samples seen
_SETTLED = 1e-10  # what one more doubling may still add, as a share of what is there
_ROUNDED = 1e-6  # the same where rounding lets it add more with every further doubling, after a sample for each state
_SCALING = 5  # doublings that tell how far states go


def predicted_covariance(A: Array, C: Array, Q: Array, R: Array) -> Array:
    """P = A (P - P C' (C P C' + R)^-1 C P) A' + Q, positive semidefinite, shape (n, n).

    Raises:
        MampcError: no such solution is found: a mode that does not decay is not seen, or never disturbed.
    """
    for P, more in _doubled(A, C, Q, R):
        if (np.abs(np.diag(more)) <= 1e-13 * np.diag(P)).all():
            return P
    raise MampcError("expected a detectable model whose modes are all disturbed, the Riccati equation failed")


def seen_covariance(A: Array, C: Array, Q: Array, R: Array) -> Array:
    """P after so many samples, from P = Q, that what outputs show of it has settled, shape (n, n).

    Where all is detectable this is `predicted_covariance`. Elsewhere, as with loads at inputs and outputs that
    cannot be told apart, P grows without bound along what no output ever shows, and only there.

    Raises:
        MampcError: it does not settle: a mode that grows is not seen, or never disturbed.
    """
    last, added = Q, np.inf
    for rounds, (P, more) in enumerate(_doubled(A, C, Q, R), 1):
        size = np.sqrt(np.outer(np.diag(C @ P @ C.T) + np.diag(R), np.diag(P)))
        last_added, added = added, float((np.abs(C @ more) / np.where(size > 0, size, 1.0)).max(initial=0.0))
        if added <= _SETTLED:
            return P
        if last_added <= _ROUNDED and not added < last_added and 2**rounds > len(A):
            return last
        last = P
    raise MampcError("expected a model whose modes are all seen and disturbed, the Riccati equation failed")


def _doubled(A: Array, C: Array, Q: Array, R: Array) -> Iterator[tuple[Array, Array]]:
    """P after 2, 4, 8, ... samples, and by how much it grew, until numbers overflow; in any units of the states.

    Source: Chu, Fan, Lin and Wang, Int. J. Control 77 (2004): structure-preserving doubling, which converges
    quadratically.
    """
    unit: Array = np.ones(len(A))
    I, F, G, P = np.eye(len(A)), A.T, C.T @ np.linalg.solve(R, C), Q
    with np.errstate(all="ignore"):
        for rounds in range(_ROUNDS):
            if rounds == _SCALING:  # on in units of how far states go; powers of two change no digit
                spread = np.sqrt(np.diag(P))
                unit = 2.0 ** np.round(np.log2(np.where(spread > 0, spread, 1.0)))
                F, G, P = F * unit[:, None] / unit, G * np.outer(unit, unit), P / np.outer(unit, unit)
            try:
                solved = np.linalg.solve(I + G @ P, np.hstack([F, G]))
            except np.linalg.LinAlgError:
                return
            W, V = solved[:, : len(A)], solved[:, len(A) :]
            more_P, more_G = F.T @ P @ W, F @ V @ F.T
            P, G, F = P + (more_P + more_P.T) / 2, G + (more_G + more_G.T) / 2, F @ W
            if not np.isfinite(P).all():
                return
            yield P * np.outer(unit, unit), more_P * np.outer(unit, unit)
