"""The range of the observability matrix, from the Hankel matrices of records.

Block Hankel matrices with s block rows split the records into past (p) and future (f). Projecting the
future outputs off the future inputs leaves, up to noise, the observability matrix times states that the
past inputs and outputs determine; a singular value decomposition finds its range and the order.

Sources: Van Overschee and De Moor, Subspace Identification for Linear Systems (1996), whose unifying
theorem gives the weightings; Verhaegen, Automatica 30 (1994) for the projected form used here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.triangular import fold

WEIGHTINGS = ("cva", "n4sid", "moesp")
_TREND = 4  # windows that a trend may take up
_CHUNK = 4096  # Hankel columns taken into the triangular factor at once


def observability(
    R: Array, m: int, l: int, s: int, weighting: str, unit: Array | float = 1.0
) -> tuple[Array, Array]:
    """Range of the observability matrix, shape (s l, s l), and the weighted singular values.

    Args:
        R: from `hankel_factor`.
        m, l, s: numbers of inputs, outputs and block rows.
        weighting: one of `WEIGHTINGS`.
        unit: of the outputs, for the singular values that have one, scalar or (l,).
    """
    projected, remainder = _projection(R, m, l, s)
    if weighting == "cva":
        return _canonical(projected, remainder)
    left = np.linalg.svd(projected)[0]
    return left, np.linalg.svd(projected * np.tile(np.broadcast_to(unit, l), s)[:, None], compute_uv=False)


def correlations(R: Array, m: int, l: int, s: int) -> Array:
    """Canonical correlations between past and future, shape (s l,)."""
    return _canonical(*_projection(R, m, l, s))[1]


def supported_order(correlations: Array, columns: int, m: int, l: int, s: int) -> int:
    """How many canonical correlations are larger than chance makes them, 1 to 20.

    Chance reaches up to the edge of Wachter's distribution (Annals of Statistics 8, 1980).

    Args:
        correlations: singular values of the weighting "cva", shape (s * l,).
        columns: Hankel columns less those that the future inputs take up.
        m, l, s: numbers of inputs, outputs and block rows.
    """
    columns = max(columns, 1)  # with none left, everything may be chance
    past, future = min(1.0, s * (m + l) / columns), min(1.0, s * l / columns)
    edge = np.sqrt(past * (1 - future)) + np.sqrt(future * (1 - past))
    counted = int(np.count_nonzero(correlations > edge if past + future < 1 else correlations > 1.0))
    return max(1, min(counted, len(correlations) - l, 20))


def require_excitation(R: Array, m: int, s: int) -> None:
    """The records must be long enough, and the inputs linearly independent over 2 s samples and not constant."""
    if len(R) + _TREND < R.shape[1]:
        raise MampcError(f"n4sid: expected at least {R.shape[1]} windows of samples, received {len(R)}")
    inputs = R[:, : 2 * s * m]
    length = np.linalg.norm(inputs, axis=0)
    size = np.abs(np.diag(inputs)) / np.maximum(length, 1e-300)
    if not (size > 1e-10).all() or not length.min() > 1e-10 * length.max():
        raise MampcError(
            f"n4sid: expected inputs that excite {2 * s} samples' span, received too poor or constant ones; "
            "use a longer or richer record, or fewer block_rows"
        )


def hankel_factor(u: Sequence[Array], y: Sequence[Array], s: int, degree: int) -> Array:
    """R of the QR factorisation of the Hankel rows (U_f, U_p, Y_p, Y_f), transposed, in chunks.

    A polynomial of the given degree in time (-1 for none) is projected off each record's rows on its own:
    what a constant or a drift adds to the outputs of a linear system is that at every lag. Memory is that
    of one chunk, whatever the length of the records.

    Args:
        u, y: one array per record, shapes (N, m) and (N, l).
    """
    m, l = u[0].shape[1], y[0].shape[1]
    size = 2 * s * (m + l)
    total: Array = np.empty((0, size))
    for inputs, outputs in zip(u, y, strict=True):
        columns = len(inputs) - 2 * s + 1
        if columns < 1:
            continue
        windows_u = np.lib.stride_tricks.sliding_window_view(inputs, 2 * s, axis=0)  # (columns, m, 2 s)
        windows_y = np.lib.stride_tricks.sliding_window_view(outputs, 2 * s, axis=0)
        time = np.arange(columns) / columns - 0.5
        R: Array = np.empty((0, degree + 1 + size))
        for start in range(0, columns, _CHUNK):
            chunk = slice(start, start + _CHUNK)
            U = windows_u[chunk].transpose(0, 2, 1)
            Y = windows_y[chunk].transpose(0, 2, 1)
            parts = (U[:, s:], U[:, :s], Y[:, :s], Y[:, s:])
            trend = time[chunk, None] ** np.arange(degree + 1)
            R = fold(R, np.concatenate([trend, *(part.reshape(len(U), -1) for part in parts)], axis=1))
        total = fold(total, R[degree + 1 :, degree + 1 :])
    return total


def _projection(R: Array, m: int, l: int, s: int) -> tuple[Array, Array]:
    """The future outputs off the future inputs: their part along the past, and the rest; factors only."""
    future, past = s * m, s * (m + l)
    return R[future : future + past, future + past :].T, R[future + past :, future + past :].T


def _canonical(projected: Array, remainder: Array) -> tuple[Array, Array]:
    """The range after whitening the future outputs, and the canonical correlations with the past."""
    values, vectors = np.linalg.eigh(projected @ projected.T + remainder @ remainder.T)
    floor = np.sqrt(np.maximum(values, values[-1] * 1e-14))  # noise-free records have flat directions
    left, correlations, _ = np.linalg.svd((vectors / floor).T @ projected)
    return (vectors * floor) @ left, correlations
