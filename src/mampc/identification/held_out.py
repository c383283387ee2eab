"""What predicts held-out data: trends, dead times and rivals compared on the part of the records kept back.

Source of the test for a random walk: Dickey and Fuller, J. Amer. Stat. Assoc. 74 (1979).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.identification.drift import whitened
from mampc.identification.parts import Part, records_of_part
from mampc.identification.scaling import Scaled
from mampc.identification.simulation_error import Trend, independent_samples, residuals

SHARE = 3 / 4  # of every record, to estimate on
POLES = (0.0, 0.5, 0.8, 0.9, 0.95)  # of filters that whiten a walk under noise
PAST = 8  # values
SHORTEST = 8  # samples held out of a record that say something
ROUNDING = 1e-6  # of the spread: smaller errors are as good as none
AS_GOOD = 0.01  # logarithm of errors that are as good as equal
CHANCE = 4.0  # difference of log likelihoods that chance brings
RIVAL = 0.03  # by which a rival must be better
ROOT = -3.41  # above which what is left may walk (Fuller's table, with a line in time, one in twenty)
LITTLE = 0.01  # of an output's spread: what is left less than that hides nothing
SLOW = 1.0  # logarithm of how much larger it is than its past leaves of it, from which it moves slowly in any case


def split(records: Scaled) -> tuple[Scaled, list[int]]:
    """The first three quarters of every record, and how many samples that are."""
    cuts = [round(SHARE * len(u)) for u in records.u]
    u, y = ([one[:cut] for one, cut in zip(all_, cuts, strict=True)] for all_ in (records.u, records.y))
    return records.replaced(u, y), cuts


class Errors(NamedTuple):
    """Of predictions of held-out data.

    Attributes:
        ahead: logarithm of the errors of predictions one sample ahead, mean over outputs.
        slow: whether what is left of an output, in the second half of the records, may walk or is a slow wave.
        level: logarithm of the errors of simulated levels, shape (l,).
        independent: how many independent samples these amount to, shape (l,).
    """

    ahead: float
    slow: bool
    level: Array
    independent: Array

    def excludes(self, other: Errors) -> bool:
        """Whether the levels of another are worse by more than chance, if what it leaves is what disturbs."""
        both = np.isfinite(self.ahead) and np.isfinite(other.ahead)
        return bool(both and other.independent @ (other.level - self.level) > CHANCE)


NOTHING = Errors(np.inf, False, np.empty(0), np.empty(0))


def errors(parts: Sequence[Part], records: Scaled, cuts: Sequence[int]) -> Errors:
    """How well parts of a model predict the records from these samples on.

    Only what inputs do counts: the parts are simulated from a rest at the start of the records. What they leave, a line
    in time set aside, is predicted as white noise and a random walk, in the proportion that suits it best, or from its
    own last values: a disturbance says nothing about a model of what the inputs do, whatever its colour.
    """
    logs: list[float] = []
    slow = False
    level, independent = np.zeros((2, len(records.y_spread)))
    for part in parts:
        own = records_of_part(records, part.outputs, part.delays)
        rest = Trend(np.zeros(len(part.A)), np.empty((0, len(part.C))), np.empty(0))
        whole = residuals(part.A, part.C, part.fit._replace(trends=[rest] * len(own.u)), own)
        late = part.delays.max(initial=0)
        starts = [max(cut - late, 0) for u, cut in zip(records.u, cuts, strict=True) if len(u) > late]
        left = [one[start:] for one, start in zip(whole, starts, strict=True) if len(one) - start > SHORTEST]
        if not left:
            return NOTHING
        picked = list(part.outputs)
        level[picked], least, _ = _unpredicted(left)
        logs.extend(least)
        independent[picked] = [
            independent_samples([one[:, i : i + 1] for one in left]) for i in range(len(picked))
        ]
        # The start of a record no longer shows in its second half.
        size, ahead, root = _unpredicted([one[len(one) // 2 :] for one in whole])
        moves = (root > ROOT) & (size > ahead + RIVAL) | (size > ahead + SLOW)
        slow |= bool((moves & (size > np.log(LITTLE))).any())
    return Errors(float(np.mean(logs)), slow, level, independent)


def _unpredicted(signals: Sequence[Array]) -> tuple[Array, Array, Array]:
    """How large signals are, a line in time set aside, and what their past leaves of them.

    Returns:
        logarithms of both, and how near to a random walk each is (Dickey and Fuller), shapes (l,).
    """
    left = [_off_a_line(one) for one in signals if len(one) > SHORTEST]
    tried = [left, *([whitened(one, pole)[1:] for one in left] for pole in POLES)]
    sizes = [np.sqrt(np.mean(np.concatenate(one) ** 2, axis=0)) for one in tried]
    past = np.array([_from_last_values([one[:, i] for one in left]) for i in range(left[0].shape[1])])
    logs = np.log(np.maximum([*sizes, past[:, 0]], ROUNDING))
    return logs[0], logs.min(axis=0), past[:, 1]


def _off_a_line(signals: Array) -> Array:
    """Signals (N, l) less the line in time that each has; what is left counts for the two it took."""
    N = len(signals)
    basis = np.linalg.qr(np.column_stack([np.ones(N), np.arange(N)]))[0]
    off: Array = (signals - basis @ (basis.T @ signals)) * np.sqrt(N / (N - 2))
    return off


def _from_last_values(signals: Sequence[Array]) -> tuple[float, float]:
    """What the last values of a signal leave of the next, and whether their coefficients sum to one.

    Returns:
        a standard deviation, by Akaike's final prediction error, and how many of its own standard deviations the sum
        differs from one by (Dickey and Fuller); infinity and minus infinity where signals are too short.
    """
    past, now = [], []
    for signal in signals:
        if len(signal) > 2 * PAST:
            windows = np.lib.stride_tricks.sliding_window_view(signal, PAST + 1)
            past.append(windows[:, :PAST])
            now.append(windows[:, PAST])
    count = sum(map(len, now))
    if count <= 4 * PAST:
        return np.inf, -np.inf
    rows, target = np.concatenate(past), np.concatenate(now)
    gram = rows.T @ rows
    inverse = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)
    coefficients = inverse @ (rows.T @ target)
    variance = np.mean((target - rows @ coefficients) ** 2)
    certain = variance * inverse.sum()
    root = (coefficients.sum() - 1.0) / np.sqrt(certain) if certain > 0 else -np.inf
    return float(np.sqrt(variance * (count + PAST) / (count - PAST))), float(root)


def compared(one: float, other: float) -> str:
    """How one error compares with another, in words that end in "than" or "as"."""
    if not np.isfinite(other):
        return "where nothing could be found with"
    if abs(one - other) <= AS_GOOD:
        return "as well as"
    if one < other:
        return f"{100 * (1 - np.exp(one - other)):.0f} % better than"
    return f"{100 * (np.exp(one - other) - 1):.0f} % worse than"
