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


def span(columns: Array) -> Array:
    """An orthonormal basis of what columns span, whatever their units."""
    scale = np.linalg.norm(columns, axis=0)
    left, size, _ = np.linalg.svd(columns / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return left[:, size > 1e-12 * size.max(initial=0.0)]
