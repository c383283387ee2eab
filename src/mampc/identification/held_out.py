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
from mampc.identification.simulation_error import fit_trends, residuals

SHARE = 3 / 4  # of every record, to estimate on
POLES = (0.0, 0.5, 0.8, 0.9, 0.95)  # of filters that whiten a walk under noise
PAST = 8  # values
ROUNDING = 1e-6  # of the spread: smaller errors are as good as none
AS_GOOD = 0.01  # logarithm of errors that are as good as equal
RIVAL = 0.03  # by which a rival must be better
CLEARLY = 0.3  # by which simulated levels must not be worse
WALK = 0.45  # by which a random walk must explain what is left better than white noise, to be one
ROOT = -2.86  # above which what is left may walk (Fuller's table, with a constant, one in twenty)


def split(records: Scaled) -> tuple[Scaled, Scaled]:
    """The first three quarters of every record, and the rest."""
    cuts = [round(SHARE * len(u)) for u in records.u]
    pairs = list(zip(records.u, records.y, cuts, strict=True))
    front = records.replaced([u[:cut] for u, _, cut in pairs], [y[:cut] for _, y, cut in pairs])
    back = records.replaced([u[cut:] for u, _, cut in pairs], [y[cut:] for _, y, cut in pairs])
    return front, back


class Errors(NamedTuple):
    """Of predictions of held-out data, as logarithms, means over outputs.

    Attributes:
        ahead: of predictions one sample ahead.
        walk: by how much a random walk explains what is left better than white noise.
        level: of simulated levels.
        root: statistic of Dickey and Fuller of what is left: far below zero unless it walks.
    """

    ahead: float
    walk: float
    level: float
    root: float


NOTHING = Errors(np.inf, 0.0, np.inf, -np.inf)


def errors(parts: Sequence[Part], records: Scaled) -> Errors:
    """How well parts of a model predict records.

    The parts are simulated from initial states that fit, a line in time set aside. What they leave is predicted as
    white noise and a random walk, in the proportion that suits it best, or from its own last values: a disturbance says
    nothing about a model of what the inputs do, whatever its colour.
    """
    roots: list[float] = []
    logs: list[float] = []
    levels: list[float] = []
    walks: list[float] = []
    for part in parts:
        own = records_of_part(records, part.outputs, part.delays)
        if not own.u:
            return NOTHING
        fit = part.fit
        trends = fit_trends(part.A, part.C, fit.B, fit.D, own, degree=1, integrators=part.integrators)
        left = residuals(part.A, part.C, fit._replace(trends=trends), own)
        # Initial states and lines explain some of it by themselves: where records are short, all of it.
        count, l = own.samples * len(part.outputs), len(part.outputs)
        spent = sum(min(len(u) * l, len(part.A) + 2 * l) for u in own.u)
        if spent > count / 2:
            return NOTHING
        left = [one * np.sqrt(count / (count - spent)) for one in left]
        tried = [left, *([whitened(one, pole)[1:] for one in left] for pole in POLES)]
        sizes = np.array([np.sqrt(np.mean(np.concatenate(one) ** 2, axis=0)) for one in tried])
        own_past = [_from_last_values([one[:, i] for one in left]) for i in range(len(part.outputs))]
        roots.extend(root for _, root in own_past)
        sizes = np.log(np.maximum(np.vstack([sizes, [size for size, _ in own_past]]), ROUNDING))
        logs.extend(sizes.min(axis=0))
        levels.extend(sizes[0])
        walks.extend(sizes[0] - sizes[:-1].min(axis=0))
    return Errors(*(float(np.mean(values)) for values in (logs, walks, levels, roots)))


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
