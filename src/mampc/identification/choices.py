"""What is estimated from records: the trend, the dead times and whose poles, by what predicts held-out data."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, as_whole
from mampc.base.errors import MampcError
from mampc.identification.arx import estimate_arx
from mampc.identification.closed_loop import estimate_predictor
from mampc.identification.delays import Integers, find_delays
from mampc.identification.estimate import Settings, estimate
from mampc.identification.fir import estimate_fir
from mampc.identification.held_out import (
    AS_GOOD,
    CHANCE,
    NOTHING,
    RIVAL,
    Errors,
    compared,
    errors,
    split,
)
from mampc.identification.parts import Part, groups, records_of_part
from mampc.identification.prewhitening import prewhitened
from mampc.identification.scaling import Scaled

TRENDS = {
    "none": "nothing was taken off the record",
    "constant": "constants were fitted",
    "linear": "a line in time was fitted to each output",
    "differences": "changes were explained, as outputs that drift ask for",
    "whitened": "disturbances were made white first, as drifts, slow waves or a loop that was closed ask for",
}
ENOUGH = 20_000  # samples in which choices are compared
SHORT = 3  # samples of dead time that are left to the states
WALKING = ("whitened", "differences")  # where what is left is slow
RIVALS = ("ARX", "FIR")  # for the poles of subspace models


@dataclass(frozen=True)
class Choice:
    """What is estimated: the trend, the dead times (l, m), whose poles, and whether from predictors."""

    trend: str
    delays: Integers
    poles: str = "subspace"  # or one of `RIVALS`
    predictor: bool = False
    notes: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        late = "with dead times" if self.delays.any() else "without dead times"
        return f"{self.poles} models, trend: {self.trend}, {late}"


class Score(NamedTuple):
    """Of a choice on held-out data, and how many integrators it takes."""

    errors: Errors
    integrators: int


def estimated(
    records: Scaled,
    settings: Settings,
    choice: Choice,
    values: list[Array] | None = None,
    orders: Sequence[int] | None = None,
) -> list[Part]:
    """The parts of a model, of given orders if any; appends the singular values of each."""
    if choice.predictor:
        return [estimate_predictor(records, settings.feedthrough, None if orders is None else orders[0])[0]]
    if choice.poles == "ARX" or choice.trend == "whitened":
        return estimate_arx(records, choice.delays, settings, choice.trend, orders)
    if choice.poles == "FIR":
        return estimate_fir(records, choice.delays, settings, choice.trend, orders)
    parts = []
    for k, (outputs, delays) in enumerate(groups(choice.delays)):
        fixed = settings if orders is None else replace(settings, order=orders[k])
        part, own = estimate(records, outputs, delays, fixed, choice.trend)
        parts.append(part)
        if values is not None:
            values.append(own)
    return parts


def chosen(
    records: Scaled, settings: Settings, detrend: str, delays: Integers | None, feedback: bool,
    tell: Callable[[str], None],
) -> Choice:  # fmt: skip
    """Trend, dead times and rival by what predicts the held-out part of the records."""
    m, l = records.u[0].shape[1], records.y[0].shape[1]
    none = np.zeros((l, m), dtype=int)
    tell("looking for dead times")
    latest = 0 if settings.feedthrough and not feedback else 1
    found = find_delays(records.u, records.y, latest) if delays is None else delays
    if delays is None and found.max() <= SHORT:
        found = none
    compared_on = records.shortened(ENOUGH)
    front, cuts = split(compared_on)
    notes: list[str] = []

    def scored(choice: Choice) -> Score:
        tell(f"trying {choice.words}")
        try:
            s = block_rows_for(
                [len(u) - int(choice.delays.max()) for u in front.u], m, l, settings.order, None
            )
            trial = replace(settings, block_rows=min(s, settings.block_rows))
            parts = estimated(front, trial, choice)
        except (MampcError, np.linalg.LinAlgError):
            return Score(NOTHING, 0)
        return Score(errors(parts, compared_on, cuts), sum(part.integrators for part in parts))

    def offered(trend: str) -> Choice:
        own = trend == "whitened" and delays is None
        return Choice(trend, _delays_of_each(compared_on, latest) if own else found)

    trends = ("constant", "linear") if detrend == "auto" else (detrend,)
    choices = [offered(trend) for trend in trends]
    scores = [scored(choice) for choice in choices]
    # Where inputs excite too little for anything else, white disturbances say nothing.
    if not any(np.isfinite(score.errors.ahead) for score in scores):
        why = "Too short to hold a part out, so that nothing was compared"
        return Choice(trends[0], none if delays is None else found, notes=(f"{why}: {TRENDS[trends[0]]}.",))
    preferred: tuple[str, ...] = ()
    if detrend == "auto":
        preferred = WALKING if scores[0].errors.slow else WALKING[:1] if feedback else ()
        if settings.order is not None and not feedback:  # white disturbances come with orders of their own
            preferred = preferred[1:]
        trends = (*trends, *preferred)
        choices += [offered(trend) for trend in preferred]
        scores += [scored(choice) for choice in choices[len(scores) :]]
    alike = min(AS_GOOD, CHANCE / (l * (compared_on.samples - front.samples)))
    best = _best(trends, scores, preferred, alike, feedback)
    choice, score = choices[best], scores[best].errors.ahead
    said = f"Trend: {TRENDS[choice.trend]}"
    if feedback:
        said += "; past outputs moved the inputs"
    if best:
        said += f"; this predicts held-out data {compared(score, scores[0].errors.ahead)} constants"
    notes.append(f"{said}.")
    if delays is None and choice.delays.any():
        without = scored(replace(choice, delays=none)).errors.ahead
        if without < score - AS_GOOD:
            choice, score = replace(choice, delays=none), without
        else:
            spans = ", ".join(map(str, np.unique(choice.delays[choice.delays > 0])))
            notes.append(
                f"Dead times of {spans} samples; they predict held-out data {compared(score, without)} none."
            )
    if settings.order is None and choice.trend != "whitened":
        rivals = {poles: scored(replace(choice, poles=poles)).errors.ahead for poles in RIVALS}
        best_rival = min(RIVALS, key=lambda poles: rivals[poles])
        if rivals[best_rival] < score - RIVAL:
            choice = replace(choice, poles=best_rival)
            own, rivals = rivals.pop(best_rival), rivals | {"subspace": score}
        else:
            own = score
        said = " and ".join(f"{compared(own, error)} {poles} ones" for poles, error in rivals.items())
        notes.append(f"{choice.poles[0].upper()}{choice.poles[1:]} poles; they predict held-out data {said}.")
    return replace(choice, notes=tuple(notes))


def _delays_of_each(records: Scaled, first: int) -> Integers:
    """Dead times of every output, its disturbance made white. Each is a part alone: short ones cost no states."""
    rows = []
    for i in range(len(records.y_spread)):
        white = prewhitened(records_of_part(records, (i,), np.zeros(records.u[0].shape[1], dtype=int)), first)
        rows.append(find_delays(white.u, white.y, first)[0])
    return np.array(rows)


def _best(
    trends: Sequence[str], scores: Sequence[Score], preferred: Sequence[str], alike: float, feedback: bool
) -> int:
    """Which trend: constants, unless others are preferred or better.

    Preferred ones are taken, the first of those that are alike, unless others predict clearly better or constants
    explain held-out levels better for certain. Levels say nothing under feedback: inputs answer disturbances.

    Otherwise a drift passes for an integrator that inputs hardly move: the fewest of these win among those that predict
    alike, and constants among these unless others are clearly better.
    """
    ahead = [score.errors.ahead for score in scores]
    fair = [
        k
        for k, trend in enumerate(trends)
        if trend in preferred
        and ahead[k] <= min(ahead) + RIVAL
        and (feedback or not scores[0].errors.excludes(scores[k].errors))
    ]
    if fair:
        least = min(ahead[k] for k in fair)
        return next(k for k in fair if ahead[k] <= least + alike)
    near = [k for k, trend in enumerate(trends) if trend not in preferred]
    near = [k for k in near if ahead[k] <= min(ahead[k] for k in near) + AS_GOOD]
    fewest = min(scores[k].integrators for k in near)
    near = [k for k in near if scores[k].integrators == fewest]
    constant = scores[0].integrators == fewest and ahead[0] <= ahead[near[0]] + RIVAL
    return 0 if constant else near[0]


def block_rows_for(samples: list[int], m: int, l: int, order: int | None, block_rows: int | None) -> int:
    if order is not None:
        as_whole("order", order, 1)
    least = 2 if order is None else -(-order // l) + 1

    # 2 s (m + l) Hankel rows want at least as many columns, N - 2 s + 1 of each record. One goes for its constant, of a
    # single record too, but there is room for that.
    def fits(s: int) -> bool:
        return 2 * s * (m + l) <= sum(max(0, N - 2 * s) for N in samples) + 1

    most = bisect_left(range(1, max(samples) + 1), True, key=lambda s: not fits(s))
    total = sum(samples)
    if most < least:
        raise MampcError(
            f"n4sid: expected at least {2 * (m + l + 1) * least - 1} samples for {m} inputs, {l} outputs"
            f"{'' if order is None else f' and order {order}'}, received {total}"
        )
    if block_rows is None:
        return max(least, min(max(15, least + 5), total // (8 * (m + l)), most))
    s = as_whole("block_rows", block_rows, least)
    if s > most:
        raise MampcError(f"block_rows: expected at most {most} for {total} samples, received {s}")
    return s
