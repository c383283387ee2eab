"""How uncertain a model's step responses are: what chance makes of them, and what the model lacks.

Chance: the model is estimated again without one segment of the records after another. What all of these lack, such as a
slow mode that the noise hides, is sought in what the model leaves of the records (`unmodelled`). Both look at no more
samples than it takes: where inputs moved most, of each record (`telling`); chance is less by what they moved elsewhere.

Source: the delete-one jackknife (Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11), with
segments that are long against the plant's memory in place of single samples (Künsch, Annals of Statistics 17 (1989)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.held_out import ROUNDING
from mampc.identification.parts import Part, part_residuals
from mampc.identification.prewhitening import denominator, filtered_by
from mampc.identification.scaling import Scaled

LAGS = 8  # time constants of what a model may lack
SLOWER = (0, 2, 4)  # powers of a lag's time constant with which its variance may grow
VARIANCES = 10.0 ** np.arange(-8, 2)  # of the slowest lag's gain
PLENTY = 50_000  # samples that both look at
PAST, LEAST = 20, 8  # values that make a disturbance white, and samples of a record that says something


def telling(records: Scaled) -> list[slice]:
    """The stretch of each record, `PLENTY` samples of all, in which inputs moved most, all that move in it."""
    found = []
    for u, length in zip(records.u, records.lengths(PLENTY), strict=True):
        start = 0
        if 0 < length < len(u):
            moved = np.cumsum(np.diff(u, axis=0, prepend=u[:1]) ** 2, axis=0)
            starts = np.arange(0, len(u) - length + 1, max(1, length // 4))
            moved = moved[:, moved[-1] > 0] / moved[-1, moved[-1] > 0]
            inside = moved[starts + length - 1] - moved[starts]
            start = int(starts[np.argmax(inside.prod(axis=1))])
        found.append(slice(start, start + length))
    return found


def movement(records: Scaled) -> Array:
    """By how much each input moved, the sum of squares of its changes, shape (m,)."""
    total: Array = sum(np.sum(np.diff(u, axis=0) ** 2, axis=0) for u in records.u)
    return total


def jackknife(
    records: Scaled, segments: int, response: Callable[[Scaled], Array], tell: Callable[[int], None]
) -> Array:
    """Standard deviations of what `response` makes of the records, in its shape; `tell` is told each segment.

    Raises:
        MampcError: fewer than three segments leave enough to estimate on.
    """
    found = []
    for left_out in range(segments):
        tell(left_out)
        try:
            found.append(response(_without(records, left_out / segments, (left_out + 1) / segments)))
        except (MampcError, np.linalg.LinAlgError):
            continue
    if len(found) < 3:
        raise MampcError(
            f"uncertainty: expected records that can be estimated on without one of {segments} segments, "
            "received shorter ones"
        )
    count = len(found)
    spread: Array = np.sqrt(
        (count - 1) / count * np.sum((np.array(found) - np.mean(found, axis=0)) ** 2, axis=0)
    )
    return spread


def _without(records: Scaled, start: float, stop: float) -> Scaled:
    """The records without a stretch, given as shares of all samples; what stays on both sides is two records."""
    u: list[Array] = []
    y: list[Array] = []
    means: list[Array] = []
    first, last = round(start * records.samples), round(stop * records.samples)
    at = 0
    for inputs, outputs, mean in zip(records.u, records.y, records.y_mean, strict=True):
        for piece in _pieces(len(inputs), first - at, last - at):
            u.append(inputs[piece])
            y.append(outputs[piece])
            means.append(mean)
        at += len(inputs)
    return Scaled(tuple(u), tuple(y), records.u_mean, tuple(means), records.u_spread, records.y_spread)


def _pieces(length: int, first: int, last: int) -> Sequence[slice]:
    """What of 0..length lies outside first..last."""
    sides = slice(0, min(max(first, 0), length)), slice(min(max(last, 0), length), length)
    return [side for side in sides if side.stop > side.start]


def unmodelled(parts: Sequence[Part], records: Scaled, where: Sequence[slice], samples: int) -> Array:
    """Mean square of what the parts' step responses may lack, shape (samples, l, m), in units of the spreads.

    What a part leaves of an output in these stretches is explained by lags of every input, from a sample to a tenth of
    the longest stretch, the disturbance made white by its own past. Gains of lags are normal about zero with a variance
    of which little is known: a mean is taken over its powers of ten, each as likely as it makes the residuals.

    Sources: Ljung, Model validation and model error modeling, Åström symposium on control (1999); MacKay, Bayesian
    interpolation, Neural Computation 4 (1992).
    """
    from scipy.signal import lfilter

    inputs = [u[rows] for u, rows in zip(records.u, where, strict=True)]
    longest, m = max(map(len, inputs)), records.u[0].shape[1]
    size = np.geomspace(min(1.0, 10 / longest), 1.0, LAGS)  # time constants, of the slowest
    poles = np.exp(-10 / longest / size)
    steps = 1 - poles ** np.arange(samples)[:, None]  # (samples, LAGS)
    lagged = [
        np.concatenate([lfilter([0.0, 1 - p], [1.0, -p], u, axis=0) for p in poles], axis=1) for u in inputs
    ]
    lacking = np.zeros((samples, len(records.y_spread), m))
    for part in parts:
        late = int(part.delays.max(initial=0))
        seen = [k for k, u in enumerate(records.u) if len(u) > late]
        ends = [(max(where[k].start - late, 0), max(where[k].stop - late, 0)) for k in seen]
        lefts = [
            left[first:last] for left, (first, last) in zip(part_residuals(part, records), ends, strict=True)
        ]
        pairs = [(lagged[k], left) for k, left in zip(seen, lefts, strict=True) if len(left) > LEAST]
        if not pairs:
            continue
        past = min(PAST, min(len(left) for _, left in pairs) // 4)
        for k, i in enumerate(part.outputs):
            own = [left[:, k : k + 1] for _, left in pairs]
            a = denominator([left[:, :0] for left in own], own, past, 0)
            white = [
                filtered_by(np.hstack([rows[-len(left) :], left]), a)
                for (rows, _), left in zip(pairs, own, strict=True)
            ]
            rows = np.concatenate([one - one.mean(axis=0) for one in white])
            second = _second_moments(rows[:, :-1], rows[:, -1], np.repeat(size, m)).reshape(LAGS, m, LAGS, m)
            lacking[:, i] = np.einsum("np,pjqj,nq->nj", steps, second, steps)
    return np.maximum(lacking, 0.0)


def _second_moments(X: Array, e: Array, size: Array) -> Array:
    """E[c c'] of coefficients c in e = X c + white noise.

    Args:
        X, e: shapes (N, p) and (N,).
        size: whose powers `SLOWER`, times `VARIANCES`, may be variances of c, shape (p,).
    """
    gram, product = X.T @ X, X.T @ e
    left = float(e @ e - product @ np.linalg.lstsq(gram, product, rcond=1e-9)[0])
    noise = max(left / max(len(e) - len(gram), 1), ROUNDING**2)
    moments, evidence = [], []
    for power in SLOWER:
        prior = np.sqrt(size**power)
        values, vectors = np.linalg.eigh(prior[:, None] * gram * prior)
        values, along, back = np.maximum(values, 0.0), vectors.T @ (prior * product), prior[:, None] * vectors
        for variance in VARIANCES:
            shrunk = values + noise / variance
            mean = along / shrunk
            moments.append(back @ (np.outer(mean, mean) + np.diag(noise / shrunk)) @ back.T)
            evidence.append((along @ mean / noise - np.log1p(values * variance / noise).sum()) / 2)
    weight = np.exp(np.array(evidence) - max(evidence))
    second: Array = np.tensordot(weight / weight.sum(), np.array(moments), axes=1)
    return second
