"""Subspace identification (N4SID) of a state-space model from input-output records."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, as_array, as_matrix, as_whole
from mampc.base.errors import MampcError
from mampc.identification.arx import estimate_arx
from mampc.identification.closed_loop import certainly_unstable, estimate_predictor, under_feedback
from mampc.identification.data import IOData
from mampc.identification.delays import Integers, find_delays
from mampc.identification.drift import noise_and_walk
from mampc.identification.estimate import DEGREES, Settings, estimate
from mampc.identification.held_out import AS_GOOD, CLEARLY, RIVAL, WALK, compared, errors, split
from mampc.identification.parts import Part, assembled, groups, part_residuals
from mampc.identification.scaling import Scaled, scaled
from mampc.identification.subspace import WEIGHTINGS
from mampc.identification.uncertainty import jackknife
from mampc.identification.validation import Validation, validate
from mampc.systems.noise import Noise
from mampc.systems.state_space import StateSpace

DETREND = ("auto", *DEGREES)
TRENDS = {
    "none": "nothing was taken off the record",
    "constant": "constants were fitted",
    "linear": "a line in time was fitted to each output",
    "differences": "changes were explained, as outputs that drift ask for",
    "whitened": "disturbances were made white first, as their colour or a loop that was closed ask for",
}
UNSTABLE = (
    "The record was taken under feedback and shows poles outside the unit circle for certain; they were kept."
)
ENOUGH = 20_000  # samples in which choices are compared
SHORT = 3  # samples of dead time that are left to the states
LEAST_NOISE = 1e-6  # of an output's spread: a record without noise shows rounding


@dataclass(frozen=True, eq=False)
class Identified:
    """An identified model and how well it explains the record it came from.

    Attributes:
        model: discrete `StateSpace`; its operating point is where the model rests at the mean inputs.
        x0: state at the first sample of the first record, shape (n,).
        singular_values: of the weighted projection, shape (s * l,); canonical correlations for "cva",
            else in the outputs' units; of all parts where outputs have dead times of their own, none of a rival's.
        order: n, dead times not counted.
        integrators: how many poles are exactly one.
        delays: dead times in samples, shape (l, m + d), beyond the one of every sampled plant; they are
            shift registers among the model's states.
        detrend: what was done about drifts, one of "none", "constant", "linear", "differences", "whitened".
        notes: what was found and decided, in sentences.
        fit: percent per output, shape (l,), of the simulated model on the (first) record itself, a line in
            time set aside unless `detrend` is "none" or "constant".
        stabilised: True if poles were moved inside the unit circle.
    """

    model: StateSpace
    x0: Array
    singular_values: Array
    order: int
    integrators: int
    delays: Integers
    detrend: str
    notes: tuple[str, ...]
    fit: Array
    stabilised: bool
    _estimate: _Estimate = field(repr=False)

    def uncertainty(self, samples: int, *, segments: int = 8) -> Array:
        """Standard deviations of the step response, shape (samples, l, m + d); see `StateSpace.step_response`.

        The model is estimated again, trend, dead times and order as they are, without one segment of the record
        after another. What all of these share, such as a disturbance that moved with an input, does not show.

        Args:
            samples: of the response.
            segments: at least 3.

        Raises:
            MampcError: records too short for that.
        """
        as_whole("segments", segments, 3)
        as_whole("samples", samples, 1)
        return jackknife(
            self._estimate.records, segments, lambda rest: self._estimate.response(rest, samples)
        )

    def validate(self, data: IOData) -> Validation:
        """Simulate the model on another record, drifts set aside as they were here; see `mampc.validate`."""
        return validate(self.model, data, drift=self.detrend not in ("none", "constant"))


def n4sid(
    data: IOData | Sequence[IOData],
    *,
    order: int | None = None,
    weighting: str = "cva",
    block_rows: int | None = None,
    feedthrough: bool = True,
    unstable: str = "auto",
    detrend: str = "auto",
    delays: Any = None,
    progress: Callable[[str], None] | None = None,
) -> Identified:
    """Identify a state-space model from one record or several of the same plant.

    Every signal counts in units of its own spread. Slow poles that the record cannot tell from one are made
    exactly one (see `integrators`), and the operating point is one at which the model rests.

    Args:
        data: a record, or several of the same plant, each with an initial state and constants of its own.
        order: n; by default the singular values say how many orders the record supports, and the
            smallest of these is taken whose simulation error is within 2 % of the best.
        weighting: "cva" (canonical variates: whitens the future outputs, best with noise), "n4sid" or
            "moesp" (unweighted; the same range in the projected form used here, which is SLICOT's).
        block_rows: s, how many samples past and future hold; default 15, less for short records, more
            for a high order.
        feedthrough: False fixes D = 0, as for sampled physical plants.
        unstable: "stabilise" mirrors poles outside the unit circle to its inside, "refuse" raises; "auto" keeps
            them where a record taken under feedback shows them for certain, and mirrors them elsewhere.
        detrend: "none" explains the signals as they are, "constant" (beside the means) and "linear" fit a
            constant or a line in time to each output of each record, "differences" explains changes from
            sample to sample, "whitened" makes disturbances white first, one output after the other; "auto" takes what
            predicts held-out data best, the simplest if that is alike, "whitened" if outputs moved the inputs.
        delays: dead times in samples, beyond the one of every sampled plant, a scalar or (l, m + d); by
            default those that show in the record, if they exceed `SHORT` and predict held-out data.
        progress: is told each stage in a few words; long records with many signals take some seconds.

    Raises:
        MampcError: a record too short, constant signals, or an unstable model with unstable="refuse".
    """
    if weighting not in WEIGHTINGS:
        raise MampcError(f"weighting: expected one of {WEIGHTINGS}, received {weighting!r}")
    if unstable not in ("auto", "stabilise", "refuse"):
        raise MampcError(f"unstable: expected 'auto', 'stabilise' or 'refuse', received {unstable!r}")
    if detrend not in DETREND:
        raise MampcError(f"detrend: expected one of {DETREND}, received {detrend!r}")
    given = _records(data)
    first = given[0]
    m, l = first.u.shape[1], first.y.shape[1]
    lengths = [len(record) for record in given]
    s = _block_rows(lengths, m, l, order, block_rows)
    records = scaled(given, centred=detrend != "none")
    settings = Settings(order, weighting, s, feedthrough, unstable)
    dead = _given_delays(delays, l, m, min(lengths))
    tell = progress if progress is not None else (lambda stage: None)
    values: list[Array] = []
    feedback = detrend != "none" and _under_feedback(records)
    if unstable == "auto" and dead is None and feedback and _keeps_unstable(records, settings):
        choice = _Choice("constant", np.zeros((l, m), dtype=int), predictor=True, notes=(UNSTABLE,))
        part, errors_ahead = estimate_predictor(records, feedthrough, order)
        parts, noise = [part], Noise(np.maximum(errors_ahead, LEAST_NOISE) * records.y_spread, np.zeros(l))
    else:
        choice = _chosen(records, settings, detrend, dead, feedback, tell)
        tell("identifying a model on all of the record")
        parts = _parts(records, settings, choice, values)
        noise = _noise(parts, records)
    model = replace(assembled(parts, records, first), noise=noise)
    integrators = sum(part.integrators for part in parts)
    notes = list(choice.notes)
    if integrators:
        notes.append(f"Poles that the record cannot tell from one were made exactly one: {integrators}.")
    quality = validate(model, first, drift=choice.trend not in ("none", "constant"))
    return Identified(
        model=model,
        x0=quality.x0,
        singular_values=np.sort(np.concatenate(values))[::-1] if values else np.empty(0),
        order=sum(len(part.A) for part in parts),
        integrators=integrators,
        delays=choice.delays,
        detrend=choice.trend,
        notes=tuple(notes),
        fit=quality.fit,
        stabilised=any(part.stabilised for part in parts),
        _estimate=_Estimate(records, settings, choice, tuple(len(part.A) for part in parts), first),
    )


@dataclass(frozen=True)
class _Choice:
    """What is estimated: the trend, the dead times (l, m), and whether by the rival or from predictors."""

    trend: str
    delays: Integers
    rival: bool = False
    predictor: bool = False
    notes: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        late = "with dead times" if self.delays.any() else "without dead times"
        return f"{'ARX' if self.rival else 'subspace'} models, trend: {self.trend}, {late}"


class _Score(NamedTuple):
    """Of a choice on held-out data: see `held_out.errors`; and how many integrators and states it takes."""

    error: float
    walk: float
    level: float
    integrators: int
    states: int


@dataclass(frozen=True, eq=False)
class _Estimate:
    """What it takes to estimate a model again from other samples: its orders stay."""

    records: Scaled
    settings: Settings
    choice: _Choice
    orders: tuple[int, ...]
    like: IOData

    def response(self, records: Scaled, samples: int) -> Array:
        """The step response of the model of other records, shape (samples, l, m + d)."""
        parts = _parts(records, self.settings, self.choice, orders=self.orders)
        return assembled(parts, records, self.like).step_response(samples)


def _under_feedback(records: Scaled) -> bool:
    """Whether past outputs moved the inputs."""
    try:
        return under_feedback(records.shortened(ENOUGH))
    except np.linalg.LinAlgError:
        return False


def _keeps_unstable(records: Scaled, settings: Settings) -> bool:
    """Whether a record under feedback shows poles outside the unit circle for certain."""
    try:
        return certainly_unstable(records.shortened(ENOUGH), settings.feedthrough, settings.order)
    except np.linalg.LinAlgError:
        return False


def _noise(parts: Sequence[Part], records: Scaled) -> Noise:
    """White noise and random walk in what the parts leave, in output units."""
    output, drift = np.zeros((2, len(records.y_spread)))
    for part in parts:
        picked = list(part.outputs)
        output[picked], drift[picked] = noise_and_walk(part_residuals(part, records))
    return Noise(np.maximum(output, LEAST_NOISE) * records.y_spread, drift * records.y_spread)


def _parts(
    records: Scaled,
    settings: Settings,
    choice: _Choice,
    values: list[Array] | None = None,
    orders: Sequence[int] | None = None,
) -> list[Part]:
    """The parts of a model, of given orders if any; appends the singular values of each."""
    if choice.predictor:
        return [estimate_predictor(records, settings.feedthrough, None if orders is None else orders[0])[0]]
    if choice.rival or choice.trend == "whitened":
        return estimate_arx(records, choice.delays, settings, choice.trend, orders)
    parts = []
    for k, (outputs, delays) in enumerate(groups(choice.delays)):
        fixed = settings if orders is None else replace(settings, order=orders[k])
        part, own = estimate(records, outputs, delays, fixed, choice.trend)
        parts.append(part)
        if values is not None:
            values.append(own)
    return parts


def _chosen(
    records: Scaled, settings: Settings, detrend: str, delays: Integers | None, feedback: bool,
    tell: Callable[[str], None],
) -> _Choice:  # fmt: skip
    """Trend, dead times and rival by what predicts the held-out part of the records."""
    m, l = records.u[0].shape[1], records.y[0].shape[1]
    none = np.zeros((l, m), dtype=int)
    tell("looking for dead times")
    found = find_delays(records.u, records.y) if delays is None else delays
    if delays is None and found.max() <= SHORT:
        found = none
    front, back = split(records.shortened(ENOUGH))
    notes: list[str] = []

    def scored(choice: _Choice) -> _Score:
        tell(f"trying {choice.words}")
        try:
            s = _block_rows([len(u) - int(choice.delays.max()) for u in front.u], m, l, settings.order, None)
            trial = replace(settings, block_rows=min(s, settings.block_rows))
            parts = _parts(front, trial, choice)
        except (MampcError, np.linalg.LinAlgError):
            return _Score(np.inf, 0.0, np.inf, 0, 0)
        found = errors(parts, back, coloured=feedback)
        return _Score(*found, sum(part.integrators for part in parts), sum(len(part.A) for part in parts))

    trends = ("constant", "linear", "differences") if detrend == "auto" else (detrend,)
    choices = [_Choice(trend, found) for trend in trends]
    scores = [scored(choice) for choice in choices]
    if detrend == "auto" and (feedback or scores[0].walk > WALK):
        trends = (*trends, "whitened")
        choices.append(_Choice("whitened", found))
        scores.append(scored(choices[-1]))
    # Where inputs excite too little for anything else, white disturbances say nothing.
    telling = [score for trend, score in zip(trends, scores, strict=True) if trend != "whitened"] or scores
    if not any(np.isfinite(score.error) for score in telling):
        why = "Too short to hold a part out, so that nothing was compared"
        return _Choice(trends[0], none if delays is None else found, notes=(f"{why}: {TRENDS[trends[0]]}.",))
    # A drift passes for an integrator or a slow mode that inputs hardly move: the fewest of these win, and among
    # equals changes are explained where what is left of levels walks, else the simplest. Noise is made white only
    # where it is not, as levels say nothing then. They say nothing under feedback either: inputs answer disturbances.
    first = scores[0]

    def is_fair(k: int) -> bool:
        score = scores[k]
        if feedback:
            return bool(np.isfinite(score.error))
        if trends[k] == "whitened":
            alike = score.level <= first.level + CLEARLY and score.states <= first.states
            return min(score.walk, first.walk) > WALK and alike
        simple = score.level <= first.level + CLEARLY and score.states <= first.states
        return k == 0 or simple or score.error < first.error - CLEARLY

    fair = [k for k in range(len(trends)) if is_fair(k)]
    least = min(scores[k].error for k in fair)
    near = [k for k in fair if scores[k].error <= least + AS_GOOD]
    walks = scores[near[0]].walk > WALK

    def rank(k: int) -> tuple[bool, int, int, bool, int]:
        white = feedback and trends[k] != "whitened"
        return white, scores[k].integrators, scores[k].states, walks and trends[k] != "differences", k

    best = min(near, key=rank)
    choice, score = choices[best], scores[best].error
    said = f"Trend: {TRENDS[choice.trend]}"
    if feedback:
        said += "; past outputs moved the inputs"
    if best:
        said += f"; this predicts held-out data {compared(score, scores[0].error)} constants"
    notes.append(f"{said}.")
    if delays is None and found.any():
        without = scored(replace(choice, delays=none)).error
        if without < score - AS_GOOD:
            choice, score = replace(choice, delays=none), without
        else:
            spans = ", ".join(map(str, np.unique(found[found > 0])))
            notes.append(
                f"Dead times of {spans} samples; they predict held-out data {compared(score, without)} none."
            )
    if settings.order is None and choice.trend != "whitened":
        rival = scored(replace(choice, rival=True)).error
        wins = rival < score - RIVAL
        choice = replace(choice, rival=wins)
        poles, other = ("ARX", "subspace") if wins else ("Subspace", "ARX")
        said = compared(min(rival, score) if wins else score, score if wins else rival)
        notes.append(f"{poles} poles; they predict held-out data {said} {other} ones.")
    return replace(choice, notes=tuple(notes))


def _given_delays(delays: Any, l: int, m: int, shortest: int) -> Integers | None:
    if delays is None:
        return None
    given = as_array("delays", delays)
    given = np.full((l, m), float(given)) if given.ndim == 0 else as_matrix("delays", given, l, m)
    if not (given == np.round(given)).all() or given.min() < 0 or given.max() >= shortest // 4:
        raise MampcError(
            f"delays: expected whole numbers of samples from 0 to {shortest // 4}, received {given.tolist()}"
        )
    return given.astype(int)


def _records(data: IOData | Sequence[IOData]) -> list[IOData]:
    records: list[Any] = list(data) if isinstance(data, (list, tuple)) else [data]
    if not records or not all(isinstance(record, IOData) for record in records):
        raise MampcError("n4sid: expected a record (IOData) or several, received something else")
    first = records[0]
    for record in records[1:]:
        if not np.isclose(record.dt, first.dt, rtol=1e-6) or record.names != first.names:
            raise MampcError(
                "n4sid: expected records of one sample time and one set of names, "
                f"received {first.dt:g} s and {record.dt:g} s, {first.names} and {record.names}"
            )
    return records


def _block_rows(samples: list[int], m: int, l: int, order: int | None, block_rows: int | None) -> int:
    if order is not None:
        as_whole("order", order, 1)
    least = 2 if order is None else -(-order // l) + 1

    # 2 s (m + l) Hankel rows want at least as many columns, N - 2 s + 1 of each record.
    def fits(s: int) -> bool:
        return 2 * s * (m + l) <= sum(max(0, N - 2 * s + 1) for N in samples)

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
