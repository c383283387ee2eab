"""How uncertain a model's step responses are: estimated again without one segment of the records after another.

Source: the delete-one jackknife (Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11), with
segments that are long against the plant's memory in place of single samples (Künsch, Annals of Statistics 17 (1989)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.scaling import Scaled


def jackknife(records: Scaled, segments: int, response: Callable[[Scaled], Array]) -> Array:
    """Standard deviations of what `response` makes of the records, in its shape.

    Raises:
        MampcError: fewer than three segments leave enough to estimate on.
    """
    found = []
    for left_out in range(segments):
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
