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

from mampc.arrays import Array, as_whole
from mampc.errors import MampcError
from mampc.identification.data import IOData
from mampc.identification.triangular import fold, solve
from mampc.identification.validation import Validation, validate
from mampc.lti import StateSpace

WEIGHTINGS = ("cva", "n4sid", "moesp")
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
        order: n; default chosen from the singular values (see `choose_order`).
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
    signals = zip((*data.names.inputs, *data.names.outputs), (*data.u.T, *data.y.T), strict=True)
    still = [name for name, signal in signals if np.ptp(signal) == 0]
    if still:
        raise MampcError(f"n4sid: expected signals that vary, received constant {', '.join(still)}")
    u_op, y_op = data.u.mean(axis=0), data.y.mean(axis=0)
    u, y = data.u - u_op, data.y - y_op

    R = _triangular_factor(u, y, s)
    _require_excitation(R, m, s)
    gamma, singular_values = _observability(R, m, l, s, weighting)
    if order is None:
        projected, remainder = _projection(R[1:, 1:], m, l, s)
        energies = np.linalg.svd(projected, compute_uv=False)
        order = choose_order(_canonical(projected, remainder)[1], energies, len(data), m, l)
    if order > len(singular_values) - l:
        raise MampcError(
            f"order: expected at most {len(singular_values) - l} with {s} block rows, received {order}"
        )
    gamma = gamma[:, :order]
    C = gamma[:l]
    A = np.linalg.lstsq(gamma[:-l], gamma[l:])[0]  # shift invariance
    A, stabilised = _inside_unit_circle(A, unstable)
    B, D = _input_matrices(A, C, u, y, feedthrough)
    manipulated = len(data.names.inputs)
    model = StateSpace(
        A, B, C, D, data.dt, u_op[:manipulated], y_op, data.names, v_op=u_op[manipulated:]
    )  # fmt: skip
    quality = validate(model, data)
    return Identified(model, quality.x0, singular_values, order, quality.fit, stabilised)


def choose_order(correlations: Array, energies: Array, samples: int, m: int, l: int) -> int:
    """The number of modes that matter, among those the record can support.

    The record supports orders up to the minimum of rho_{n+1}^2 plus log(N)/N times the number of
    parameters 2 n l + m (n + l): the singular value criterion of Bauer, Automatica 37 (2001). Among
    these, modes count whose energy is above 2 % of the largest, and all before the last drop of the
    energies by a factor of 3: weak modes of a clean record, but not the weak ones into which a nonlinear
    plant's record fades.

    Args:
        correlations: canonical correlations rho, the singular values of weighting "cva", shape (s * l,).
        energies: singular values without weighting, shape (s * l,).
        samples, m, l: length of the record, numbers of inputs and outputs.

    Returns:
        An order of at least 1.
    """
    n = np.arange(1, max(2, len(correlations) - l))
    parameters = 2 * n * l + m * (n + l)
    most = int(n[np.argmin(correlations[n] ** 2 + np.log(samples) / samples * parameters)])
    strong = int(np.count_nonzero(energies[:most] > 0.02 * energies[0]))
    drops = np.flatnonzero(energies[:most] > 3 * energies[1 : most + 1])
    return max(1, strong, int(drops[-1]) + 1 if len(drops) else 0)


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
        return min(max(15, least + 5), most)
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


def _inside_unit_circle(A: Array, unstable: str) -> tuple[Array, bool]:
    """A itself, or with each pole outside the unit circle mirrored to 1 / conj(pole)."""
    poles, vectors = np.linalg.eig(A)
    outside = np.abs(poles) >= 1.0
    if not outside.any():
        return A, False
    if unstable == "refuse":
        raise MampcError(
            f"n4sid: expected a stable model, received poles of size {np.sort(np.abs(poles[outside]))}; "
            "remove drifts from the record, try another order, or allow unstable='stabilise'"
        )
    mirrored = np.where(outside, poles / np.maximum(np.abs(poles), 1.0 + 1e-6) ** 2, poles)
    stable: Array = np.real(vectors @ np.diag(mirrored) @ np.linalg.inv(vectors))
    return stable, True


def _input_matrices(A: Array, C: Array, u: Array, y: Array, feedthrough: bool) -> tuple[Array, Array]:
    """B and D by least squares on the simulation error, to which x0 and a constant contribute too.

    Column (i, j) of the response to B is the output of (A, e_i, C) driven by input j.
    """
    n, m, l = len(A), u.shape[1], len(C)
    unknowns = n * m + n + l + (l * m if feedthrough else 0)
    state = np.zeros((n, n * m + n))
    state[:, n * m :] = np.eye(n)
    picks = np.eye(n)
    normal: Array = np.empty((0, unknowns + 1))
    for start in range(0, len(u), _CHUNK):
        block = u[start : start + _CHUNK]
        rows = np.zeros((len(block), l, unknowns + 1))
        states = np.empty((len(block), n, n * m + n))
        for k, inputs in enumerate(block):
            states[k] = state
            state = A @ state
            state[:, : n * m] += np.kron(picks, inputs)
        rows[:, :, : n * m + n] = C @ states
        rows[:, :, n * m + n : n * m + n + l] = np.eye(l)
        if feedthrough:
            direct = np.einsum("op,kj->kopj", np.eye(l), block)
            rows[:, :, n * m + n + l : -1] = direct.reshape(len(block), l, l * m)
        rows[:, :, -1] = y[start : start + _CHUNK]
        normal = fold(normal, rows.reshape(-1, unknowns + 1))
    solution = solve(normal)
    B = solution[: n * m].reshape(n, m)
    D = solution[n * m + n + l :].reshape(l, m) if feedthrough else np.zeros((l, m))
    return B, D
