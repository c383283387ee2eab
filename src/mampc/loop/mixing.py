"""How likely each hypothesis about the load is: before a measurement, and by Bayes' rule after it.

The formulas are those at the top of `load_bank`. Weights mu are (B,), or loops first, (S, B). Beside them stand the
usual ones, to which jumps return, and the scale: the variance of the innovations beside what the noise told leads to,
and how many samples have shown it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import MampcError
from mampc.loop.estimator import Estimate
from mampc.loop.hypotheses import Member

STAYS = 0.998  # chance that a load goes on as it does
TO_JUMP = 0.001  # chance that it jumps; what is left goes to the other hypotheses
JUMP_GOES_ON = 0.3  # chance that a jump takes one more sample
FORGETS = 0.01  # share by which a sample counts in what usually holds
LEAST = 1e-6  # share of samples in which each hypothesis usually holds at least
NOISE_REMEMBERED = 100.0  # and of what is seen of it
NOISE_RANGE = (0.01, 100.0)  # of the variance, beside what was told
UNUSUAL = 9.0  # times the variance: no innovation counts for more in it
IMPOSSIBLE = 1e-300  # no hypothesis is less likely, so that some are left whatever comes


@dataclass(frozen=True, eq=False)
class BankEstimate(Estimate):
    """What every hypothesis estimates, and their mixture.

    Attributes:
        x: states of `planning_model`: those of the plant, and loads that fade.
        output_disturbance, input_disturbance: lasting ones, shapes (l,) and (m,).
        members: z of each hypothesis, shape (B, n + 2k).
        weights: how likely each hypothesis is, shape (B,), with sum 1.
        usual: how likely each one is on average of the samples without jumps, shape (B,), with sum 1.
        scale: variance of the innovations beside what the noise told leads to, and how many samples have shown it.
        late: what the inputs' moves of the last samples did to the outputs (l,), these moves (N, m) with the latest
            first, and the inputs (m,), one behind the other.
        plain: x, d_y and d_u of the plain filter, shape (n + l + m,).
        hindsight: what `Hindsight` remembers; empty without it.
    """

    members: Array
    weights: Array
    usual: Array
    scale: Array
    late: Array
    plain: Array
    hindsight: Array


def bank_estimate(estimate: Estimate) -> BankEstimate:
    """The estimate itself, or `MampcError` where it is not one of a bank."""
    if not isinstance(estimate, BankEstimate):
        raise MampcError(f"estimate: expected one of a LoadBank, received {type(estimate).__name__}")
    return estimate


class Filters(NamedTuple):
    """The gains of all hypotheses where some outputs are believed, and what measures their innovations.

    Vectors of all hypotheses, one behind the other, have shape (B l,) where each has (l,), and so on.

    Attributes:
        gains: from their innovations to what these add to their z, shape (B (n + 2k), B l).
        whiten: from their innovations to W e of each, with |W e|^2 = e' S^-1 e, shape (B l, B l).
        precisions: the diagonals of S^-1 over how many outputs are believed, shape (B, l); of all where none is.
        log_scale: -1/2 log det S of each, shape (B,).
        believed: how many outputs are.
    """

    gains: Array
    whiten: Array
    precisions: Array
    log_scale: Array
    believed: int


def filters_of(members: Sequence[Member], noise: Array, believed: BoolArray) -> Filters:
    """Those of members with noise (l,) in their outputs, where only some of these, bool (l,), are believed."""
    whiten, log_scale = [], []
    for member in members:
        root = np.linalg.cholesky(member.innovation_covariance(believed))
        whiten.append(np.zeros((len(believed), len(believed))))
        whiten[-1][np.ix_(believed, believed)] = np.linalg.inv(root)
        log_scale.append(-np.log(np.diag(root) / noise[believed]).sum())
    gains, count = [member.gain(believed) for member in members], int(believed.sum())
    # Without any output the inputs' moves are as doubtful as they were with all.
    doubtful = (
        np.square(whiten).sum(axis=1) / count if count else filters_of(members, noise, ~believed).precisions
    )
    return Filters(_apart(gains), _apart(whiten), doubtful, np.array(log_scale), count)


def _apart(blocks: Sequence[Array]) -> Array:
    """One matrix with blocks of equal shape along its diagonal."""
    count, rows, columns = np.shape(blocks)
    matrix = np.zeros((count, rows, count, columns))
    matrix[range(count), :, range(count)] = blocks
    return matrix.reshape(count * rows, count * columns)


class Mixing:
    """The chances that loads begin to behave in another way, and what measurements make of them.

    Args:
        jumps: which hypotheses say that the load has just jumped, shape (B,).
        doubting: up to which factor of the noise, beside what was told, it makes moves of the inputs less doubtful.

    Attributes:
        chances: T as far as it does not depend on what usually holds, shape (B, B).
        lasts: 1 for hypotheses that may hold usually, 0 for jumps, shape (B,).
    """

    def __init__(self, jumps: BoolArray, doubting: float = 1.0) -> None:
        self.chances, returns = _chances(jumps)
        self.lasts = np.where(jumps & ~jumps.all(), 0.0, 1.0)
        self._returns, self._ones = returns[:, None], np.ones(len(jumps))
        self._all, self._impossible = np.ones((len(jumps), len(jumps))), np.full(len(jumps), IMPOSSIBLE)
        self._kept, self._remembered = (1 - FORGETS) * self._ones, FORGETS * self.lasts
        self._least, self._doubting = LEAST * self.lasts, doubting

    def before(self, weights: Array, usual: Array, members: Array) -> tuple[Array, Array]:
        """How likely each hypothesis is now, before the measurement, (..., B); and where its filter starts."""
        chances = self._returns * usual[..., None, :]
        chances += self.chances
        if usual.ndim == 1:  # one loop: `dot` takes half the time of `matmul` here
            c = np.maximum(weights.dot(chances), self._impossible)
            return c, (chances.T * weights).dot(members) / c[:, None]
        joint = weights[..., None] * chances
        c = np.maximum(self._ones @ joint, IMPOSSIBLE)
        return c, np.matmul(joint.swapaxes(-1, -2), members) / c[..., None]

    def trust(self, moved: Array, scale: Array) -> Array:
        """t of every hypothesis, shape (..., B), given h' diag(S^-1) h / l, of that shape, and the scale (..., 2)."""
        trust: Array = 1 / (1 + moved / np.minimum(scale[..., :1], self._doubting))
        return trust

    def many(
        self, c: Array, surprise: Array, moved: Array, filters: Filters, usual: Array, scale: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Trust, weights, usual ones and scale of many loops after their innovations.

        Args:
            c: of `before`.
            surprise: e' S^-1 e of each hypothesis, shape (S, B).
            moved: h' diag(S^-1) h / l of each, shape (S, B).
            filters: of the outputs believed, at least one.
            usual, scale: at the last sample, shapes (S, B) and (S, 2).
        """
        trust, believed = self.trust(moved, scale), filters.believed
        surprise = surprise * trust
        likelihood = filters.log_scale + 0.5 * believed * np.log(trust) - 0.5 * surprise / scale[:, :1]
        weights = c * np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
        weights /= weights.dot(self._ones)[:, None]
        usual = np.maximum((1 - FORGETS) * usual + FORGETS * weights, LEAST) * self.lasts
        usual /= usual.dot(self._ones)[:, None]
        shown = np.einsum("sb,sb->s", weights, surprise) / believed
        variance, seen = scale[:, 0], np.minimum(scale[:, 1] + 1, NOISE_REMEMBERED)
        variance = variance + (np.minimum(shown, UNUSUAL * variance) - variance) / seen
        return trust, weights, usual, np.stack([np.clip(variance, *NOISE_RANGE), seen], axis=1)

    def one(
        self, c: Array, surprise: Array, moved: Array, filters: Filters, usual: Array, scale: Array
    ) -> tuple[Array, Array, Array, Array]:
        """The same of one loop, in as few calls as a handful of numbers allow."""
        believed, (variance, samples) = filters.believed, scale.tolist()
        doubt = moved / min(variance, self._doubting)
        trust = self._ones / (self._ones + doubt)
        surprise = surprise * trust
        likelihood = filters.log_scale - np.log1p(doubt) * (0.5 * believed) - surprise * (0.5 / variance)
        weights = c * np.exp(likelihood - likelihood[likelihood.argmax()])
        weights /= self._all.dot(weights)
        usual = np.maximum(usual * self._kept + weights * self._remembered, self._least)
        usual /= self._all.dot(usual)
        if not believed:
            return trust, weights, usual, scale
        shown = float(weights.dot(surprise)) / believed
        samples = min(samples + 1, NOISE_REMEMBERED)
        variance += (min(shown, UNUSUAL * variance) - variance) / samples
        variance = min(max(variance, NOISE_RANGE[0]), NOISE_RANGE[1])
        return trust, weights, usual, np.array((variance, samples))


def _chances(jumps: BoolArray) -> tuple[Array, Array]:
    """The chances T that do not depend on what usually holds, and what share of each jump returns to that."""
    if jumps.all() or len(jumps) == 1:
        return np.eye(len(jumps)), np.zeros(len(jumps))
    others = np.outer(~jumps, ~jumps) & ~np.eye(len(jumps), dtype=bool)
    to_jump = np.outer(~jumps, jumps)
    chances = TO_JUMP * _shared(to_jump) + (1 - STAYS - TO_JUMP) * _shared(others)
    chances += np.diag(np.where(jumps, JUMP_GOES_ON, 1 - chances.sum(axis=1)))
    return chances, np.where(jumps, 1 - JUMP_GOES_ON, 0.0)


def _shared(places: BoolArray) -> Array:
    """Every row's chance of one, shared by its places; zeros in rows without any."""
    count: Array = places.sum(axis=1, keepdims=True).astype(np.float64)
    return places / np.maximum(count, 1.0)
