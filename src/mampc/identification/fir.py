"""The rival for dynamics that few states do not describe: impulse responses, as smooth as the record asks for.

For every output the impulse response of each input is normal about zero, neighbours are alike and it dies out: its
increments are independent and shrink by a factor a sample (the TC kernel). How large and how long it is, and how large
the noise, are what makes the record likeliest. The Hankel matrix of the mean response gives A and C of every order;
inputs, constants and integrators are then found as for any other model.

Source: Chen, Ohlsson and Ljung, On the estimation of transfer functions, regularizations and Gaussian processes,
Automatica 48 (2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.delays import Integers
from mampc.identification.drift import high_passed
from mampc.identification.estimate import PROJECTED, Settings, finished
from mampc.identification.parts import Part, groups, records_of_part
from mampc.identification.realisation import realise
from mampc.identification.scaling import Scaled
from mampc.identification.triangular import fold

COEFFICIENTS = 300  # of one output
LONGEST = 150  # samples of an impulse response
EACH = 2  # equations for each coefficient, at least
ENOUGH = 20_000  # samples that impulse responses are found from
HIGHEST = 15  # order
ITERATIONS = 30
LEAST = 1e-8  # of variances, of what an output moves
NEGLIGIBLE = 1e-3  # singular value of a Hankel matrix, of the largest
_CHUNK = 2048  # equations at once


def estimate_fir(
    records: Scaled, delays: Integers, settings: Settings, trend: str, orders: Sequence[int] | None = None
) -> list[Part]:
    """One part for outputs that share dead times, each with the order that explains the record best for its size.

    Args:
        delays: in samples, shape (l, m).
        orders: one per part, if they are known.

    Raises:
        MampcError: records too short for that.
    """
    parts = []
    for k, (outputs, late) in enumerate(groups(delays)):
        own = records_of_part(records, outputs, late)
        seen = high_passed(own, 0.0) if trend == "differences" else own
        gamma = _observability(impulse_responses(seen.shortened(ENOUGH), PROJECTED[trend]))
        tried = range(1, gamma.shape[1] + 1) if orders is None else orders[k : k + 1]
        dynamics = partial(_dynamics, gamma, len(outputs))
        parts.append(finished(dynamics, tried, own, seen, outputs, late, settings, trend))
    return parts


def _dynamics(gamma: Array, l: int, n: int, _: Scaled) -> tuple[Array, Array]:
    return realise(gamma[:, :n], l)


def impulse_responses(records: Scaled, degree: int) -> Array:
    """The mean of what the records say of them, shape (p, l, m), from a sample after the impulse on.

    Args:
        degree: of a polynomial in time that is taken off each record, -1 for none.

    Raises:
        MampcError: records too short for any.
    """
    m = records.u[0].shape[1]
    p = min(LONGEST, COEFFICIENTS // m, records.samples // (EACH * (m + 1)), max(map(len, records.u)) // 3)
    if p < 2:
        raise MampcError(
            f"n4sid: expected records that hold impulse responses, received {records.samples} samples"
        )
    R, count = _factor(records, p, degree)
    X, Y = R[:, : m * p], R[:, m * p :]
    steps = np.array([_likeliest(X.T @ X, X.T @ y, float(y @ y), count, m) for y in Y.T])  # (l, m, p)
    responses: Array = np.cumsum(steps[..., ::-1], axis=2)[..., ::-1].transpose(2, 0, 1)
    return responses


def _factor(records: Scaled, p: int, degree: int) -> tuple[Array, int]:
    """The triangular factor of inputs 1..p samples ago, summed up so that increments are coefficients, and outputs."""
    m, l = records.u[0].shape[1], records.y[0].shape[1]
    R: Array = np.empty((0, m * p + l))
    count = 0
    for u, y in zip(records.u, records.y, strict=True):
        N = len(u) - p
        if p > N:
            continue
        sums = np.cumsum(np.vstack([np.zeros((1, m)), u]), axis=0)  # u[k - 1] + ... + u[k - i]
        time = np.arange(N) / N - 0.5
        own: Array = np.empty((0, degree + 1 + m * p + l))
        for start in range(0, N, _CHUNK):
            k = np.arange(start, min(start + _CHUNK, N)) + p
            past = sums[k[:, None]] - sums[k[:, None] - np.arange(1, p + 1)]  # (chunk, p, m)
            trend = time[k - p, None] ** np.arange(degree + 1)
            own = fold(
                own, np.concatenate([trend, past.transpose(0, 2, 1).reshape(len(k), -1), y[k]], axis=1)
            )
        R = fold(R, own[degree + 1 :, degree + 1 :])
        count += N - degree - 1
    return R, count


def _likeliest(gram: Array, product: Array, power: float, count: int, m: int) -> Array:
    """The mean of the increments of m impulse responses to one output, shape (m, p), by empirical Bayes.

    Args:
        gram, product, power: X'X, X'y and y'y of y = X w + white noise.
        count: of equations.
    """
    from scipy.linalg import cho_solve, lapack
    from scipy.optimize import minimize

    n = len(gram)
    p, size = n // m, power / count
    if size <= 0:
        return np.zeros((m, p))
    at = np.arange(1, p + 1)

    def spreads(amplitude: Array, time: Array) -> tuple[Array, Array]:
        """Standard deviations of increments, shape (m, p), and how the logarithms of their squares go with log time."""
        variance = -np.expm1(-1 / time)[:, None] * np.exp(-at / time[:, None])
        slope = at / time[:, None] - 1 / (time * np.expm1(1 / time))[:, None]
        variance[:, -1], slope[:, -1] = np.exp(-p / time), p / time
        return np.sqrt(amplitude[:, None] * variance), slope

    def posterior(theta: Array) -> tuple[Array, Array, Array, Array, float]:
        noise = float(np.exp(theta[0]))
        spread, slope = spreads(np.exp(theta[1 : 1 + m]), np.exp(theta[1 + m :]))
        d = spread.ravel()
        M = d[:, None] * gram * d
        # Rounding may take as much.
        M[np.diag_indices(n)] += noise + 4 * n * np.finfo(float).eps * np.diag(M).max()
        factor = np.linalg.cholesky(M)
        return factor, cho_solve((factor, True), d * product), d, slope, noise

    def unlikely(theta: Array) -> tuple[float, Array]:
        """Twice the negative logarithm of the likelihood, and its gradient."""
        factor, along, d, slope, noise = posterior(theta)
        inverse = np.diag(lapack.dpotri(factor, lower=1)[0])
        w = d * along
        left = power - 2 * w @ product + w @ gram @ w
        value = (power - product @ w) / noise + 2 * np.log(np.diag(factor)).sum() + (count - n) * theta[0]
        each = (1 - noise * inverse - along**2).reshape(m, p)
        own = count - n + noise * inverse.sum() - left / noise
        return value, np.concatenate([[own], each.sum(axis=1), (each * slope).sum(axis=1)])

    start = np.log([size / 4, *np.full(m, size / p), *np.full(m, p / 6)])
    bounds = [(np.log(size * LEAST), np.log(size)), *[(np.log(size * LEAST), np.log(size / LEAST))] * m]
    bounds += [(np.log(0.5), np.log(2.0 * p))] * m
    found = minimize(
        unlikely, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ITERATIONS}
    )
    _, along, d, _, _ = posterior(found.x)
    mean: Array = (d * along).reshape(m, p)
    return mean


def _observability(responses: Array) -> Array:
    """The range of the Hankel matrix of impulse responses, shape (rows l, orders worth trying)."""
    p, l, m = responses.shape
    rows = p // 2 + 1
    padded = np.concatenate([responses, np.zeros_like(responses)])
    hankel = padded[np.arange(rows)[:, None] + np.arange(p)].transpose(0, 2, 1, 3).reshape(rows * l, p * m)
    left, values, _ = np.linalg.svd(hankel, full_matrices=False)
    worth = int(np.count_nonzero(values > NEGLIGIBLE * values.max()))
    return left[:, : max(1, min(worth, HIGHEST, (rows - 1) * l))]
