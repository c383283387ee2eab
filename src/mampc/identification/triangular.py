"""Least squares on long records in little memory: only the triangular factor is kept."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array


def fold(R: Array, rows: Array) -> Array:
    """The triangular factor of all rows so far: that of R on top of the new rows."""
    return np.asarray(np.linalg.qr(np.concatenate([R, rows]), mode="r"))


def solve(R: Array) -> Array:
    """Least-squares solution where the last column of the folded rows is the right-hand side."""
    scale = np.linalg.norm(R[:, :-1], axis=0)
    scale[scale == 0.0] = 1.0  # units of the columns must not matter to what counts as dependent
    solution: Array = np.linalg.lstsq(R[:, :-1] / scale, R[:, -1], rcond=1e-12)[0] / scale
    return solution
