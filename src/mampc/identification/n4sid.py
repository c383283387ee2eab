"""Subspace identification (N4SID) of a state-space model from one input-output record.

Block Hankel matrices with s block rows split the record into past (p) and future (f). Projecting the
future outputs off the future inputs leaves, up to noise, the observability matrix times states that the
past inputs and outputs determine; a singular value decomposition finds its range and the order.

Sources: Van Overschee and De Moor, Subspace Identification for Linear Systems (1996), whose unifying
theorem gives the weightings; Verhaegen, Automatica 30 (1994) for the projected form used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_whole
from mampc.base.errors import MampcError
from mampc.identification.data import IOData
from mampc.identification.realisation import realise
from mampc.identification.triangular import fold
from mampc.identification.validation import Validation, validate
from mampc.systems.state_space import StateSpace

WEIGHTINGS = ("cva", "n4sid", "moesp")
NEAR_BEST = 1.02  # simulation errors that are as good as equal
_CHUNK = 4096  # Hankel columns taken into the triangular factor at once


@dataclass(frozen=True, eq=False)
class Identified:
    """An identified model and how well it explains the record it came from.

    Attributes:
        model: discrete `StateSpace` whose operating point is the mean of the record.
        x0: state at the first sample, shape (n,).
        singular_values: of the weighted projection, shape (s * l,); canonical correlations for "cva".
        order: n.
        fit: percent per output, shape (l,), of the simulated model on the record itself.
        stabilised: True if poles were moved inside the unit circle.
    """

    model: StateSpace
    x0: Array
    singular_values: Array
    order: int
    fit: Array
    stabilised: bool

    def validate(self, data: IOData) -> Validation:
        """Simulate the model on another record; see `mampc.validate`."""
        return validate(self.model, data)


def n4sid(
    data: IOData,
    *,
    order: int | None = None,
    weighting: str = "cva",
    block_rows: int | None = None,
    feedthrough: bool = True,
    unstable: str = "stabilise",
) -> Identified:
    """Identify a state-space model; the means of the record become its operating point.

    Args:
        data: the record.
        order: n; by default the singular values say how many orders the record supports, and the
            smallest of these is taken whose simulation error is within 2 % of the best.
        weighting: "cva" (canonical variates: whitens the future outputs, best with noise), "n4sid" or
            "moesp" (unweighted; the same range in the projected form used here, which is SLICOT's).
        block_rows: s, how many samples past and future hold; default 15, less for short records, more
            for a high order.
        feedthrough: False fixes D = 0, as for sampled physical plants.
        unstable: "stabilise" mirrors poles outside the unit circle to its inside, "refuse" raises.

    Raises:
        MampcError: a record too short, constant signals, or an unstable model with unstable="refuse".
    """
    if weighting not in WEIGHTINGS:
        raise MampcError(f"weighting: expected one of {WEIGHTINGS}, received {weighting!r}")
    if unstable not in ("stabilise", "refuse"):
        raise MampcError(f"unstable: expected 'stabilise' or 'refuse', received {unstable!r}")
    m, l = data.u.shape[1], data.y.shape[1]
    s = _block_rows(len(data), m, l, order, block_rows)
    signals = zip(
        (*data.names.inputs, *data.names.disturbances, *data.names.outputs),
        (*data.u.T, *data.y.T),
        strict=True,
    )
    still = [name for name, signal in signals if np.ptp(signal) == 0]
    if still:
        raise MampcError(f"n4sid: expected signals that vary, received constant {', '.join(still)}")
    u_op, y_op = data.u.mean(axis=0), data.y.mean(axis=0)
    u, y = data.u - u_op, data.y - y_op

    R = _triangular_factor(u, y, s)
    _require_excitation(R, m, s)
    gamma, singular_values = _observability(R, m, l, s, weighting)
    if order is None:
        _, correlations = _canonical(*_projection(R[1:, 1:], m, l, s))
        orders = range(1, supported_order(correlations, len(data) - 2 * s - s * m, m, l, s) + 1)
    elif order <= len(singular_values) - l:
        orders = range(order, order + 1)
    else:
        most = len(singular_values) - l
        raise MampcError(f"order: expected at most {most} with {s} block rows, received {order}")
    candidates = [realise(gamma[:, :n], u, y, feedthrough=feedthrough, unstable=unstable) for n in orders]
    best = min(candidate.error for candidate in candidates)
    chosen = next(candidate for candidate in candidates if candidate.error <= NEAR_BEST * best)
    manipulated = len(data.names.inputs)
    model = StateSpace(
        chosen.A, chosen.B, chosen.C, chosen.D, data.dt, u_op[:manipulated], y_op, data.names,
        v_op=u_op[manipulated:],
    )  # fmt: skip
    quality = validate(model, data)
    return Identified(
        model, quality.x0, singular_values, model.n_states, quality.fit, chosen.stabilised
    )  # fmt: skip


def supported_order(correlations: Array, columns: int, m: int, l: int, s: int) -> int:
    """How many canonical correlations are larger than chance makes them, 1 to 20.

    Chance reaches up to the edge of Wachter's distribution (Annals of Statistics 8, 1980).

    Args:
        correlations: singular values of the weighting "cva", shape (s * l,).
        columns: Hankel columns less those that the future inputs take up.
        m, l, s: numbers of inputs, outputs and block rows.
    """
    past, future = min(1.0, s * (m + l) / columns), min(1.0, s * l / columns)
    edge = np.sqrt(past * (1 - future)) + np.sqrt(future * (1 - past))
    counted = int(np.count_nonzero(correlations > edge if past + future < 1 else correlations > 1.0))
    return max(1, min(counted, len(correlations) - l, 20))


def _block_rows(samples: int, m: int, l: int, order: int | None, block_rows: int | None) -> int:
    if order is not None:
        as_whole("order", order, 1)
    least = 2 if order is None else -(-order // l) + 1
    # 2 s (m + l) Hankel rows want at least as many columns, N - 2 s + 1.
    most = (samples + 1) // (2 * (m + l + 1))
    if most < least:
        raise MampcError(
            f"n4sid: expected at least {2 * (m + l + 1) * least - 1} samples for {m} inputs, {l} outputs"
            f"{'' if order is None else f' and order {order}'}, received {samples}"
        )
    if block_rows is None:
        return max(least, min(max(15, least + 5), samples // (8 * (m + l)), most))
    s = as_whole("block_rows", block_rows, least)
    if s > most:
        raise MampcError(f"block_rows: expected at most {most} for {samples} samples, received {s}")
    return s


def _observability(R: Array, m: int, l: int, s: int, weighting: str) -> tuple[Array, Array]:
    """Range of the observability matrix, shape (s l, s l), and the weighted singular values.

    A record that starts or ends in a transient has means that are not a rest of the system: what is left
    is a constant, which would pass for one more mode. "cva" projects it off; "n4sid" and "moesp" keep it,
    as SLICOT does.
    """
    if weighting == "cva":
        return _canonical(*_projection(R[1:, 1:], m, l, s))
    projected, _ = _projection(fold(R[:1, 1:], R[1:, 1:]), m, l, s)
    left, singular_values, _ = np.linalg.svd(projected)
    return left, singular_values


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


def _require_excitation(R: Array, m: int, s: int) -> None:
    """The inputs must be linearly independent over 2 s samples, and not constant."""
    size = np.abs(np.diag(R)[1 : 1 + 2 * s * m])
    if not size.min() > 1e-10 * max(size.max(), 1e-300):
        raise MampcError(
            f"n4sid: expected inputs that excite {2 * s} samples' span, received too poor or constant ones; "
            "use a longer or richer record, or fewer block_rows"
        )


def _triangular_factor(u: Array, y: Array, s: int) -> Array:
    """R of the QR factorisation of the Hankel rows (1, U_f, U_p, Y_p, Y_f), transposed, in chunks.

    Memory is that of one chunk, whatever the length of the record.
    """
    columns = len(u) - 2 * s + 1
    windows_u = np.lib.stride_tricks.sliding_window_view(u, 2 * s, axis=0)  # (columns, m, 2 s)
    windows_y = np.lib.stride_tricks.sliding_window_view(y, 2 * s, axis=0)
    R: Array = np.empty((0, 1 + 2 * s * (u.shape[1] + y.shape[1])))
    for start in range(0, columns, _CHUNK):
        chunk = slice(start, start + _CHUNK)
        U = windows_u[chunk].transpose(0, 2, 1)
        Y = windows_y[chunk].transpose(0, 2, 1)
        parts = (U[:, s:], U[:, :s], Y[:, :s], Y[:, s:])
        hankel = [np.ones((len(U), 1)), *(part.reshape(len(U), -1) for part in parts)]
        R = fold(R, np.concatenate(hankel, axis=1))
    return R
