"""What predicts held-out data: trends, dead times and rivals compared on the part of the records kept back."""

from __future__ import annotations

from collections.abc import Sequence

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


def split(records: Scaled) -> tuple[Scaled, Scaled]:
    """The first three quarters of every record, and the rest."""
    cuts = [round(SHARE * len(u)) for u in records.u]
    pairs = list(zip(records.u, records.y, cuts, strict=True))
    front = records.replaced([u[:cut] for u, _, cut in pairs], [y[:cut] for _, y, cut in pairs])
    back = records.replaced([u[cut:] for u, _, cut in pairs], [y[cut:] for _, y, cut in pairs])
    return front, back


def errors(parts: Sequence[Part], records: Scaled, *, coloured: bool = False) -> tuple[float, float, float]:
    """The logarithm of the error of predictions one sample ahead, a mean over outputs.

    The parts are simulated from initial states that fit, a line in time set aside. What they leave is
    predicted as white noise and a random walk, in the proportion that suits it best: a drift says nothing about
    a model of what the inputs do. With `coloured` it may also be predicted from its own last values: under feedback
    a model that mistakes the controller for the plant explains a disturbance of another colour.

    Returns:
        that, by how much it is smaller than without a walk, and the same of simulated levels.
    """
    logs: list[float] = []
    levels: list[float] = []
    for part in parts:
        own = records_of_part(records, part.outputs, part.delays)
        if not own.u:
            return np.inf, 0.0, np.inf
        fit = part.fit
        trends = fit_trends(part.A, part.C, fit.B, fit.D, own, degree=1, integrators=part.integrators)
        left = residuals(part.A, part.C, fit._replace(trends=trends), own)
        # Initial states and lines explain some of it by themselves: where records are short, all of it.
        count, l = own.samples * len(part.outputs), len(part.outputs)
        spent = sum(min(len(u) * l, len(part.A) + 2 * l) for u in own.u)
        if spent > count / 2:
            return np.inf, 0.0, np.inf
        left = [one * np.sqrt(count / (count - spent)) for one in left]
        tried = [left, *([whitened(one, pole)[1:] for one in left] for pole in POLES)]
        sizes = np.array([np.sqrt(np.mean(np.concatenate(one) ** 2, axis=0)) for one in tried])
        if coloured:
            sizes = np.vstack(
                [sizes, [_unpredictable([one[:, i] for one in left]) for i in range(len(part.outputs))]]
            )
        sizes = np.log(np.maximum(sizes, ROUNDING))
        logs.extend(sizes.min(axis=0))
        levels.extend(sizes[0])
    error, level = float(np.mean(logs)), float(np.mean(levels))
    return error, level - error, level


def _unpredictable(signals: Sequence[Array]) -> float:
    """The standard deviation of what the last values of a signal do not predict; Akaike's final prediction error."""
    past, now = [], []
    for signal in signals:
        if len(signal) > 2 * PAST:
            windows = np.lib.stride_tricks.sliding_window_view(signal, PAST + 1)
            past.append(windows[:, :PAST])
            now.append(windows[:, PAST])
    count = sum(map(len, now))
    if count <= 4 * PAST:
        return np.inf
    rows, target = np.concatenate(past), np.concatenate(now)
    left = target - rows @ np.linalg.lstsq(rows, target)[0]
    return float(np.sqrt(np.mean(left**2) * (count + PAST) / (count - PAST)))


def compared(one: float, other: float) -> str:
    """How one error compares with another, in words that end in "than" or "as"."""
    if not np.isfinite(other):
        return "where nothing could be found with"
    if abs(one - other) <= AS_GOOD:
        return "as well as"
    if one < other:
        return f"{100 * (1 - np.exp(one - other)):.0f} % better than"
    return f"{100 * (np.exp(one - other) - 1):.0f} % worse than"
