"""Unstable plants, recorded under feedback: dynamics and inputs from one-step predictors.

A long vector ARX model predicts without bias under feedback too. Its coefficients are the Markov parameters of the
predictor x+ = (A - K C) x + (B - K D) u + K y, whose realisation gives A, C and K. B, D, initial states and constants
then minimise the prediction error, which stays finite whatever the poles of A.

Sources: Jansson, Subspace identification and ARX modeling, SYSID (2003); Chiuso, Automatica 43 (2007) (predictor-based
subspace identification).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mampc.base.checks import Array
from mampc.identification.parts import Part
from mampc.identification.scaling import Scaled
from mampc.identification.simulation_error import Trend, fit_inputs, residuals, states
from mampc.identification.triangular import fold, solve
from mampc.identification.uncertainty import jackknife

PAST = 20  # coefficients of every signal, at most
FEEDBACK = 5.0  # standard deviations by which past outputs must explain inputs better than chance
OUTSIDE = 3.0  # standard deviations by which a pole must lie outside the unit circle
SEGMENTS = 8
MOST = 8  # states


def under_feedback(records: Scaled) -> bool:
    """Whether past disturbances say something of the inputs beside their own past.

    Disturbances are what a long vector ARX model does not predict of the outputs. Outputs themselves also tell of
    inputs long ago, which say more of a held signal than its last values do.
    """
    return _tells(_innovations(records, _lags(records)))


def _innovations(records: Scaled, lags: int) -> Scaled:
    """The records with what a vector ARX model leaves of the outputs in their place.

    It knows the present inputs: what these do at once is no disturbance.
    """
    theta = _predictors(records, lags, feedthrough=True)[0]
    kept = [(u, y) for u, y in zip(records.u, records.y, strict=True) if len(u) > 2 * lags + 1]
    left = [y[lags:] - np.hstack([*_past(u, y, lags), u[lags:]]) @ theta for u, y in kept]
    return records.replaced([u[lags:] for u, _ in kept], left)


def _tells(records: Scaled) -> bool:
    """Whether the past of the outputs says something of the inputs beside their own: a likelihood ratio test."""
    if not records.u:
        return False
    lags = _lags(records)
    m, l = records.u[0].shape[1], records.y[0].shape[1]
    factor = _regression(records.u, records.y, lags, target="u", feedthrough=False)
    size = lags * (m + l)
    whole = factor[size:, size:]
    without = fold(np.empty((0, lags * m + m)), np.delete(factor, np.s_[lags * m : size], axis=1))[
        lags * m :, lags * m :
    ]
    N = sum(len(u) - lags for u in records.u)
    gain = 0.0
    for j in range(m):
        less, more = np.linalg.norm(whole[:, j]), np.linalg.norm(without[:, j])
        if less > 1e-9 * np.sqrt(N):
            gain += 2 * N * np.log(more / less)
    chance = m * l * lags
    return bool(gain > chance + FEEDBACK * np.sqrt(2 * chance))


def certainly_unstable(records: Scaled, feedthrough: bool, order: int | None) -> bool:
    """Whether past outputs say something of the inputs, and poles lie outside the unit circle for certain.

    For certain: by more than what leaving out parts of the records changes.
    """
    if not _tells(records):
        return False
    A, _, _, n = _dynamics(records, feedthrough, order)
    size = np.abs(np.linalg.eigvals(A)).max()
    if size <= 1.0:
        return False

    def largest(rest: Scaled) -> Array:
        poles = np.linalg.eigvals(_dynamics(rest, feedthrough, n)[0])
        return np.array([np.abs(poles).max()])

    spread = jackknife(records, SEGMENTS, largest, lambda done: None)[0]
    return bool(size - 1.0 > OUTSIDE * spread)


def estimate_predictor(records: Scaled, feedthrough: bool, order: int | None) -> tuple[Part, Array]:
    """The part of all outputs that predicts them best one sample ahead, and its prediction errors' sizes (l,)."""
    A, C, K, _ = _dynamics(records, feedthrough, order)
    return _predicted(A, C, K, records, feedthrough)


def _predicted(A: Array, C: Array, K: Array, records: Scaled, feedthrough: bool) -> tuple[Part, Array]:
    """With B, D and trends that minimise the prediction error."""
    predictor, l = A - K @ C, len(C)
    innovations = [y - states(predictor, y @ K.T, np.zeros(len(A))) @ C.T for y in records.y]
    explained = records.replaced(records.u, innovations)
    fit = fit_inputs(predictor, C, explained, feedthrough=feedthrough, degree=0)
    sizes = np.concatenate(residuals(predictor, C, fit, explained)).std(axis=0)
    seen = np.eye(l) - C @ np.linalg.solve(np.eye(len(A)) - predictor, K)  # of a constant, in the innovations
    trends = [Trend(t.x0, np.linalg.lstsq(seen, t.polynomial.T)[0].T, t.drive) for t in fit.trends]
    fit = fit._replace(B=fit.B + K @ fit.D, trends=trends)
    delays = np.zeros(records.u[0].shape[1], dtype=int)
    return Part(tuple(range(l)), delays, A, C, 0, False, fit), sizes


def _dynamics(records: Scaled, feedthrough: bool, order: int | None) -> tuple[Array, Array, Array, int]:
    """A, C, K and the order, from the Hankel matrix of the predictor's Markov parameters."""
    m, l, lags = records.u[0].shape[1], records.y[0].shape[1], _lags(records)
    theta, factor = _predictors(records, lags, feedthrough=feedthrough)
    own = theta[: lags * (m + l)]
    blocks = np.concatenate(
        [own[: lags * m].reshape(lags, m, l), own[lags * m :].reshape(lags, l, l)], axis=1
    )
    markov = blocks.transpose(0, 2, 1)  # (lags, l, m + l): C (A - K C)^i [B - K D, K]
    rows = lags // 2 + 1
    zero = np.zeros_like(markov[0])
    hankel = np.block([[markov[i + j] if i + j < lags else zero for j in range(lags)] for i in range(rows)])
    past = [lag * (m + l) + j for lag in range(lags) for j in range(m)]
    past += [lag * (m + l) + m + j for lag in range(lags) for j in range(l)]
    left, values, _ = np.linalg.svd(hankel[:, past] @ factor[: lags * (m + l), : lags * (m + l)].T)
    most = min(MOST, len(values) - l)
    found = {}
    for n in [order] if order is not None else range(1, most + 1):
        gamma = left[:, :n]
        delta = gamma.T @ hankel
        predictor, C, K = np.linalg.lstsq(gamma[:-l], gamma[l:])[0], gamma[:l], delta[:, m : m + l]
        found[n] = (predictor + K @ C, C, K, n)
    if len(found) == 1:
        return next(iter(found.values()))
    N = records.samples

    def information(n: int) -> float:
        """Schwarz's criterion."""
        A, C, K, _ = found[n]
        if np.abs(np.linalg.eigvals(A - K @ C)).max() >= 1.0:
            return np.inf
        error = _predicted(A, C, K, records, feedthrough)[0].fit.error
        return float(l * N * np.log(max(error, 1e-9) ** 2) + n * (m + 2 * l) * np.log(l * N))

    return found[min(found, key=information)]


def _lags(records: Scaled) -> int:
    """Coefficients of every signal, so few that some record is longer than twice as many samples."""
    m, l, longest = records.u[0].shape[1], records.y[0].shape[1], max(map(len, records.u))
    return int(max(2, min(PAST, records.samples // (10 * (m + l)), (longest - 2) // 2)))


def _predictors(records: Scaled, lags: int, *, feedthrough: bool) -> tuple[Array, Array]:
    """Coefficients of a vector ARX model, a column per output, and the triangular factor they were found from."""
    factor = _regression(records.u, records.y, lags, target="y", feedthrough=feedthrough)
    size = factor.shape[1] - records.y[0].shape[1]
    columns = [solve(np.column_stack([factor[:, :size], target])) for target in factor[:, size:].T]
    return np.column_stack(columns), factor


def _past(u: Array, y: Array, lags: int) -> list[Array]:
    """Inputs 1..lags samples ago, then outputs, from the first sample with a whole past on."""
    N = len(u) - lags
    return [signal[lags - i : lags - i + N] for signal in (u, y) for i in range(1, lags + 1)]


def _regression(
    u: Sequence[Array], y: Sequence[Array], lags: int, *, target: str, feedthrough: bool
) -> Array:
    """The triangular factor of past inputs, past outputs (the present inputs) and the target."""
    factor: Array = np.empty((0, 0))
    for inputs, outputs in zip(u, y, strict=True):
        N = len(inputs) - lags
        if N <= 1:
            continue
        now = [inputs[lags:]] if feedthrough else []
        rows = np.concatenate(
            [
                np.ones((N, 1)),
                *_past(inputs, outputs, lags),
                *now,
                (inputs if target == "u" else outputs)[lags:],
            ],
            axis=1,
        )
        reduced = fold(np.empty((0, rows.shape[1])), rows)[1:, 1:]
        factor = fold(factor if factor.size else np.empty((0, reduced.shape[1])), reduced)
    return factor
