"""B and D by least squares on the simulation error, given A and C.

Initial states and trends are fitted with them, each record its own: B, D and these enter the simulated
outputs linearly. The outputs of (A, e_i, C) are first-order filters in a row once A is triangular.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np

from mampc.base.checks import Array
from mampc.identification.modes import Modes, modes
from mampc.identification.scaling import Scaled
from mampc.identification.triangular import fold, solve, span

_CORRELATED = 2**16  # samples whose autocorrelation is looked at
_ENTRIES = 2**20  # numbers taken into the triangular factor at once, 8 MB


Signals: TypeAlias = Callable[[slice], Array]  # some rows of what would be large as a whole


class Trend(NamedTuple):
    """What a record needs besides its inputs: x0 (n,), output polynomial (degree + 1, l), drive (q,).

    The polynomial is one of time from -1/2 to 1/2 over the record; the drive is a constant that integrators
    add up.
    """

    x0: Array
    polynomial: Array
    drive: Array


class InputFit(NamedTuple):
    """B (n, m), D (l, m), the trend of each record, and the root of the sum of squared errors."""

    B: Array
    D: Array
    trends: list[Trend]
    error: float


def fit_inputs(
    A: Array, C: Array, records: Scaled, *, feedthrough: bool, degree: int = 0, integrators: int = 0,
) -> InputFit:  # fmt: skip
    """Fit everything but A and C.

    Args:
        A, C: shapes (n, n) and (l, n), in the units of `records`.
        records: the scaled records.
        feedthrough: False fixes D = 0.
        degree: of the polynomial in time at each output; -1 for none.
        integrators: how many states, the first ones of A, integrate and nothing else. A constant at
            the outputs that their initial states make is not fitted twice; a constant at their inputs is.
    """
    n, m, l, q = len(A), records.u[0].shape[1], len(C), integrators
    directions = _complement(C[:, :q]) if degree >= 0 else np.zeros((l, 0))  # outputs' constants
    drives = q if degree >= 0 else 0
    own = n + directions.shape[1] * (degree + 1) + drives
    common = n * m + (l * m if feedthrough else 0)
    factor: Array = np.empty((0, common + 1))
    heads = []
    found = modes(A, C, q) if l > 1 else None  # a single output has no others to share signals with
    for u, y in zip(records.u, records.y, strict=True):
        if found is not None:
            head = _shared_rows(found, u, y, feedthrough, degree, directions, drives)
            explained = span(head[:, :own])
            factor = fold(factor, head[:, own:] - explained @ (explained.T @ head[:, own:]))
        else:
            R: Array = np.empty((0, own + common + 1))
            for rows in _rows(A, C, u, y, feedthrough, degree, directions, drives):
                R = fold(R, rows)
            head = R[:own]
            factor = fold(factor, R[own:, own:])
        heads.append(head)
    theta = solve(factor)
    error = float(np.linalg.norm(factor[:, -1] - factor[:, :-1] @ theta))
    trends = []
    for head, samples in zip(heads, map(len, records.u), strict=True):
        left = head[:, -1] - head[:, own:-1] @ theta
        specific = solve(np.column_stack([head[:, :own], left]))
        polynomial = specific[n : own - drives].reshape(degree + 1, directions.shape[1]) @ directions.T
        trends.append(Trend(specific[:n], polynomial, specific[own - drives :] / samples))
    B = theta[: n * m].reshape(n, m)
    D = theta[n * m :].reshape(l, m) if feedthrough else np.zeros((l, m))
    return InputFit(B, D, trends, error)


def fit_trends(
    A: Array, C: Array, B: Array, D: Array, records: Scaled, *, degree: int, integrators: int
) -> list[Trend]:
    """Only the trends, B and D being known; see `fit_inputs`."""
    still = Trend(np.zeros(len(A)), np.empty((0, len(C))), np.empty(0))
    unexplained = residuals(A, C, InputFit(B, D, [still] * len(records.u), 0.0), records)
    without = records.replaced([u[:, :0] for u in records.u], unexplained)
    return fit_inputs(A, C, without, feedthrough=False, degree=degree, integrators=integrators).trends


def _rows(
    A: Array, C: Array, u: Array, y: Array, feedthrough: bool, degree: int, directions: Array, drives: int
) -> Iterator[Array]:
    """Blocks of equations: x0, polynomial, drive, B, D, and the right-hand side; l rows per sample."""
    N, m = u.shape
    p = m + 1 + (drives > 0)
    start = 0
    for response in filtered(A, C, partial(_sources, u, p), (N, p)):
        count = len(response)
        chunk = slice(start, start + count)
        powers = _time(chunk, N)[:, None] ** np.arange(degree + 1)
        yield _equations(response, powers, u[chunk], y[chunk], feedthrough, directions, drives)
        start += count


def _shared_rows(
    found: Modes, u: Array, y: Array, feedthrough: bool, degree: int, directions: Array, drives: int
) -> Array:
    """Few equations that say the same: outputs are sums of the modes' signals, whose triangular factor serves all."""
    (l, n), (N, m) = (y.shape[1], found.shares.shape[2]), u.shape
    p = m + 1 + (drives > 0)
    last: Array = np.zeros((len(found.poles), p))
    R: Array = np.empty((0, n * p + degree + 1 + m + l))
    block = max(1, _ENTRIES // (4 * n * p))
    for start in range(0, N, block):
        rows = slice(start, min(start + block, N))
        signals, last = found.signals(_sources(u, p, rows), last)
        powers = _time(rows, N)[:, None] ** np.arange(degree + 1)
        R = fold(R, np.concatenate([signals, powers, u[rows], y[rows]], axis=1))
    count, at = len(R), n * p + degree + 1
    response = np.einsum("krp,lrs->klsp", R[:, : n * p].reshape(count, n, p), found.shares)
    return _equations(
        response, R[:, n * p : at], R[:, at : at + m], R[:, at + m :], feedthrough, directions, drives
    )


def _equations(
    response: Array, powers: Array, u: Array, y: Array, feedthrough: bool, directions: Array, drives: int
) -> Array:
    """Of a block of samples, l rows each: what states answer, (block, l, n, p), powers of time, inputs, outputs."""
    (count, l, n, _), m = response.shape, u.shape[1]
    parts = [
        response[..., 0],
        np.einsum("kd,lc->kldc", powers, directions).reshape(count, l, -1),
        response[:, :, :drives, -1],
        response[..., 1 : 1 + m].reshape(count, l, n * m),
    ]
    if feedthrough:
        parts.append(np.einsum("op,kj->kopj", np.eye(l), u).reshape(count, l, l * m))
    return np.concatenate([*parts, y[..., None]], axis=2).reshape(count * l, -1)


def _sources(u: Array, p: int, rows: slice) -> Array:
    """What moves states: one sample at the start, the inputs a sample ago, and a constant that adds up to one."""
    m, first = u.shape[1], rows.start == 0
    block = np.zeros((rows.stop - rows.start, p))
    block[0, 0] = first
    block[first:, 1 : 1 + m] = u[rows.start - 1 + first : rows.stop - 1]
    block[first:, 1 + m :] = 1.0 / len(u)
    return block


def filtered(A: Array, C: Array, signals: Signals, shape: tuple[int, int]) -> Iterator[Array]:
    """What (A, e_i, C) makes of each signal w: sum over j <= k of C A^(k-j) e_i w(j), in blocks of samples.

    Args:
        signals: makes some rows of them.
        shape: (N, p), of all.

    Yields:
        shape (block, l, n, p).
    """
    from scipy.linalg import rsf2csf, schur
    from scipy.signal import lfilter

    (l, n), (N, p) = C.shape, shape
    T, U = schur(A, output="real")
    if np.any(np.diag(T, -1)):
        T, U = rsf2csf(T, U)
    c = C @ U
    block = max(1, min(N, _ENTRIES // (4 * l * n * p)))
    last = np.zeros((n, l, p, 1), dtype=T.dtype)
    for start in range(0, N, block):
        w = signals(slice(start, min(start + block, N))).T
        G = np.empty((n, l, p, w.shape[1]), dtype=T.dtype)
        before = np.empty_like(G)  # G one sample earlier
        for i in range(n):
            drive = c[:, i, None, None] * w + np.tensordot(T[:i, i], before[:i], axes=1)
            G[i], _ = lfilter([1.0], [1.0, -T[i, i]], drive, axis=-1, zi=T[i, i] * last[i])
            before[i, ..., :1], before[i, ..., 1:] = last[i], G[i, ..., :-1]
        last = G[..., -1:].copy()
        yield np.real(np.tensordot(G, U.conj(), axes=(0, 1))).transpose(2, 0, 3, 1)


def _complement(C: Array) -> Array:
    """An orthonormal basis, as columns, of what the columns of C leave; shape (l, l - rank)."""
    if not C.shape[1]:
        return np.eye(len(C))
    left, size, _ = np.linalg.svd(C)
    return left[:, np.count_nonzero(size > 1e-9 * max(size[0], 1e-300)) :]


def residuals(A: Array, C: Array, fit: InputFit, records: Scaled) -> list[Array]:
    """Measured less simulated outputs of each record, shape (N, l), in the units of `records`."""
    found: list[Array] = []
    drive = np.zeros(len(A))
    for u, y, trend in zip(records.u, records.y, fit.trends, strict=True):
        drive[: len(trend.drive)] = trend.drive
        left = np.empty_like(y)
        for rows, x in _states(A, lambda rows, u=u: u[rows] @ fit.B.T + drive, len(u), trend.x0):  # type: ignore[misc]
            constants = _time(rows, len(u))[:, None] ** np.arange(len(trend.polynomial)) @ trend.polynomial
            left[rows] = y[rows] - x @ C.T - u[rows] @ fit.D.T - constants
        found.append(left)
    return found


def integrated(A: Array, C: Array, fit: InputFit, records: Scaled, integrators: int) -> list[Array]:
    """What the first states, which integrate, add to the outputs of each record, shape (N, l), but for a constant."""
    q = integrators
    shown: list[Array] = []
    for u, trend in zip(records.u, fit.trends, strict=True):
        push = u @ fit.B[:q].T
        push[:, : len(trend.drive)] += trend.drive
        walked = np.cumsum(push, axis=0) @ C[:, :q].T
        shown.append(walked - walked.mean(axis=0))
    return shown


def states(A: Array, push: Array, x0: Array) -> Array:
    """x[k + 1] = A x[k] + push[k] from x[0] = x0, shape (N, n), without a loop over samples."""
    return np.concatenate([x for _, x in _states(A, lambda rows: push[rows], len(push), x0)])


def _states(A: Array, push: Signals, N: int, x0: Array) -> Iterator[tuple[slice, Array]]:
    """The same in blocks of samples: which they are, and x of shape (block, n)."""
    from scipy.linalg import rsf2csf, schur
    from scipy.signal import lfilter

    n = len(A)
    T, U = schur(A, output="real")
    if np.any(np.diag(T, -1)):
        T, U = rsf2csf(T, U)
    last = U.conj().T @ x0
    block = max(1, _ENTRIES // (8 * max(n, 1)))
    for start in range(0, N, block):
        rows = slice(start, min(start + block, N))
        z = np.empty((n, rows.stop - start + 1), dtype=T.dtype)
        z[:, 0], z[:, 1:] = last, U.conj().T @ push(rows).T
        for i in range(n - 1, -1, -1):
            z[i, 1:] += T[i, i + 1 :] @ z[i + 1 :, :-1]
            z[i] = lfilter([1.0], [1.0, -T[i, i]], z[i])
        last = z[:, -1].copy()
        yield rows, np.real(U @ z[:, :-1]).T


def _time(rows: slice, N: int) -> Array:
    """From -1/2 to 1/2 over a record of N samples."""
    return np.arange(rows.start, rows.stop) / N - 0.5


def independent_samples(residuals: Sequence[Array]) -> float:
    """How many independent numbers residuals (N, l) amount to, given how they are correlated in time.

    N / (1 + 2 sum of the autocorrelations up to where they first vanish), summed over outputs.
    """
    total = 0.0
    for whole in residuals:
        residual = whole[:_CORRELATED]
        N = len(residual)
        centred = residual - residual.mean(axis=0)
        spectrum = np.fft.rfft(centred, 2 * N, axis=0)
        covariance = np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[:N]
        for column in covariance.T:
            if column[0] <= 0:
                continue
            first = int(np.argmax(column <= 0)) or N
            total += len(whole) * column[0] / (column[0] + 2 * column[1:first].sum())
    return total
