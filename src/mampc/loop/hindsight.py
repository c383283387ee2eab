"""How much of what a bank of hypotheses foretells comes true, beside what a plain Kalman filter foretells.

A model that is wrong answers moves otherwise than it should, and hypotheses about the load explain that at once: by
loads that are not there. This shows as soon as the outputs come for which they were foretold. With d what the bank
foretold an output to be beyond what the filter did, and e what the filter missed it by,

    share = (p + sum e^2 - sum (e - d)^2) / (p + sum d^2), between 0 and 1

is how much less the bank misses than the filter, of what that would be were all of d to come; with p samples of noise
for a whole one, and older samples counting less and less. Where the filter foretells as well, plans count on it alone:
a loop that swings with a wrong model may well be foretold half by the bank that swings it.

Sums are over what was foretold for this sample 1 .. h samples before, and a mean over these: of one horizon alone a
swing hides from whoever looks half its period back. Both foretell with the same model and the same inputs, so that d
needs no inputs, and e are sums of the filter's last innovations:

    d_j = C A^j (z_bank - z_filter)(k - j)      e_j = i(k) + sum over a = 1 .. j - 1 of C A^a K i(k - a)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.loop.disturbances import REACH
from mampc.loop.doubt import dead_times
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.mixing import FORGETS
from mampc.systems.state_space import StateSpace

UNPROVEN = 40.0  # samples with differences like the noise that speak as loudly as those seen
FAST = 0.6  # size of the poles below which a mode is over soon; those of dead times are there, for rounding
SWINGS = 1e-3  # angle from which a pair of poles swings: rounding parts up to four equal ones by less
MOST, FURTHEST = 1e8, 1e9  # that a sample counts in either sum, so that they stay numbers


class Hindsight:
    """Compares what was foretold with what came; outputs are in standard deviations of their noise.

    It remembers, in one array or with loops first, the two sums of `compared`, the filter's innovations at h samples,
    and z_bank - z_filter at h + 1; the latest is first.

    Args:
        planning: the model that plans predict with, whose states, and loads at inputs and outputs, are z of the bank.
        plain: the filter.
        noise: of the outputs, shape (l,).

    Attributes:
        horizon: h, the longest dead time and as long as inputs take to show what they do.
        foretells: from z_bank - z_filter to d_j, shape (h, l, n + m + l).
        answers: C A^a K, and one for a = 0, shape (h, l, l).
    """

    def __init__(self, planning: StateSpace, plain: KalmanFilter, noise: Array) -> None:
        model = plain.model
        n, m, l = planning.n_states, model.n_inputs, model.n_outputs
        self.horizon = h = int(dead_times(model).max(initial=0)) + REACH
        at_inputs, lasting = planning.B[:, :m], np.eye(m + l)
        A = np.block([[planning.A, at_inputs, np.zeros((n, l))], [np.zeros((m + l, n)), lasting]])
        C = np.hstack([planning.C, planning.D[:, :m], np.eye(l)]) / noise[:, None]
        self.foretells = _propagated(C, A, h + 1)[1:]
        self.answers = _propagated(plain.C / noise[:, None], plain.A, h) @ (plain.gain * noise)
        self.answers[0] = np.eye(l)
        self._seen = slice(2, 2 + h * l)
        self._now = 2 + h * l  # where z_bank - z_filter stands, and earlier ones
        self._before = self._now + len(A)

    @property
    def initial(self) -> Array:
        """What is remembered before the first sample."""
        h, _, size = self.foretells.shape
        return np.zeros(self._now + (h + 1) * size)

    def predicted(self, memory: Array) -> Array:
        """A sample later, at which nothing has come yet."""
        after, (_, l, size) = np.zeros_like(memory), self.foretells.shape
        after[..., :2] = memory[..., :2]
        after[..., 2 + l : self._now] = memory[..., 2 : self._now - l]
        after[..., self._before :] = memory[..., self._now : -size]
        return after

    def corrected(self, memory: Array, innovation: Array, believed: Any = 1.0) -> Array:
        """After the filter's innovation (..., l) of the outputs believed, a flag or (l,); zeros for others."""
        after, (h, l, size) = memory.copy(), self.foretells.shape
        after[..., 2 : 2 + l] = innovation
        seen = after[..., self._seen].reshape((*after.shape[:-1], h, l, 1))
        beside = after[..., self._before :].reshape((*after.shape[:-1], h, size, 1))
        missed = np.matmul(self.answers, seen)[..., 0].cumsum(axis=-2)
        after[..., :2] = compared(
            memory[..., :2], np.matmul(self.foretells, beside)[..., 0] * believed, missed
        )
        return after

    def foretelling(self, memory: Array, beside: Array) -> Array:
        """With what the bank foretells beyond the filter, of which its z differs by `beside` (..., n + m + l)."""
        after = memory.copy()
        after[..., self._now : self._before] = beside
        return after

    def share(self, memory: Array, scale: Array) -> Any:
        """How much of the bank counts, given `BankEstimate.scale` (..., 2)."""
        unproven = UNPROVEN * np.minimum(scale[..., 0], 1.0)
        return np.clip((unproven + memory[..., 0]) / (unproven + memory[..., 1]), 0.0, 1.0)


def resonates(model: StateSpace) -> bool:
    """Whether a mode swings with a damping below 1 / sqrt(2), and for more than a few samples."""
    poles = model.poles().astype(complex)
    slow = np.log(poles[np.abs(poles) > FAST])
    return bool((-slow.real < np.sqrt(0.5) * np.abs(slow))[np.abs(slow.imag) > SWINGS].any())


@np.errstate(over="ignore", invalid="ignore")
def compared(sums: Array, foretold: Array, missed: Array) -> Array:
    """The sums (..., 2) of e^2 - (e - d)^2 and d^2 after a sample for which d (..., h, l) had been foretold, where e of
    that shape was missed.
    """
    squares = np.square(foretold).sum(axis=(-2, -1)) / foretold.shape[-2]
    counts = MOST / np.maximum(squares, MOST)
    less = (foretold * (2 * missed - foretold)).sum(axis=(-2, -1)) / foretold.shape[-2]
    shown = np.stack([np.clip(counts * less, -FURTHEST, FURTHEST), counts * squares], axis=-1)
    after: Array = (1 - FORGETS) * sums + shown
    return after


def _propagated(C: Array, A: Array, count: int) -> Array:
    """C A^j for j = 0 .. count - 1."""
    rows = [C]
    for _ in range(count - 1):
        rows.append(rows[-1] @ A)
    return np.stack(rows)
