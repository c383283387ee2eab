"""How much of what a bank of hypotheses foretells comes true, beside what a plain Kalman filter foretells.

A model that is wrong answers moves otherwise than it should, and hypotheses about the load explain that at once: by
loads that are not there. This shows as soon as the outputs come for which they were foretold. With d what the bank
foretold an output to be h samples later beyond what the filter did, and e what the filter missed it by then,

    share = (p + sum d e) / (p + sum d^2), between 0 and 1

is the part of d that predicts best, by least squares with p samples of noise for a whole one, and older samples
counting less and less. Both foretell with the same model and the same inputs, so that d needs no inputs, and e is a sum
of the filter's last innovations:

    d = C A^h (z_bank - z_filter)      e(k) = i(k) + sum over j = 1 .. h - 1 of C A^j K i(k - j)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.loop.doubt import LATE, dead_times
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.mixing import FORGETS
from mampc.systems.state_space import StateSpace

UNPROVEN = 10.0  # samples with differences like the noise that speak as loudly as those seen
AHEAD = int(2 * LATE)  # samples after the longest dead time at which what was foretold is compared
FAST = 0.6  # size of the poles below which a mode is over soon; those of dead times are there, for rounding
SWINGS = 1e-3  # angle from which a pair of poles swings: rounding parts up to four equal ones by less
MOST, FURTHEST = 1e8, 1e9  # that a sample counts in either sum, so that they stay numbers


class Hindsight:
    """Compares what was foretold with what came; outputs are in standard deviations of their noise.

    Args:
        planning: the model that plans predict with, whose states, and loads at inputs and outputs, are z of the bank.
        plain: the filter.
        noise: of the outputs, shape (l,).

    Attributes:
        counts: whether the model resonates: elsewhere a wrong model costs little, and the share is one.
        horizon: h.
        foretells: from the difference of two z to d, shape (l, n + m + l).
        misses: from e and the h - 1 innovations before, latest first, and one more, to the next of these, shape
            (h l, (h + 1) l).
    """

    def __init__(self, planning: StateSpace, plain: KalmanFilter, noise: Array) -> None:
        model = plain.model
        n, m, l = planning.n_states, model.n_inputs, model.n_outputs
        self.counts = resonates(model)
        self.horizon = h = int(dead_times(model).max(initial=0)) + AHEAD
        at_inputs, lasting = planning.B[:, :m], np.eye(m + l)
        A = np.block([[planning.A, at_inputs, np.zeros((n, l))], [np.zeros((m + l, n)), lasting]])
        C = np.hstack([planning.C, planning.D[:, :m], np.eye(l)]) / noise[:, None]
        self.foretells = C @ np.linalg.matrix_power(A, h)
        _, before, i = np.split(np.eye((h + 1) * l), [l, h * l])
        A, C, gain, e = plain.A, plain.C / noise[:, None], plain.gain * noise, i
        for j in range(h - 1):
            gain = A @ gain
            e = e + C @ gain @ before[j * l : (j + 1) * l]
        self.misses = np.vstack([e, i, before[: (h - 2) * l]])

    def share(self, sums: Array, scale: Array) -> Any:
        """How much of the bank counts, given the sums (..., 2) of d e and d^2 and `BankEstimate.scale` (..., 2)."""
        unproven = UNPROVEN * np.minimum(scale[..., 0], 1.0)
        share = np.clip((unproven + sums[..., 0]) / (unproven + sums[..., 1]), 0.0, 1.0)
        return share if self.counts else np.ones_like(share)


def resonates(model: StateSpace) -> bool:
    """Whether a mode swings with a damping below 1 / sqrt(2), and for more than a few samples."""
    poles = model.poles().astype(complex)
    slow = np.log(poles[np.abs(poles) > FAST])
    return bool((-slow.real < np.sqrt(0.5) * np.abs(slow))[np.abs(slow.imag) > SWINGS].any())


def compared(sums: Array, foretold: Array, missed: Array) -> Array:
    """The sums after a sample at which d (..., l) had been foretold and e (..., l) was missed."""
    squares = np.square(foretold).sum(axis=-1)
    counts = MOST / np.maximum(squares, MOST)
    products = np.clip(counts * (foretold * missed).sum(axis=-1), -FURTHEST, FURTHEST)
    after: Array = (1 - FORGETS) * sums + np.stack([products, counts * squares], axis=-1)
    return after
