"""Subspace identification (N4SID) of a state-space model from input-output records."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_array, as_choice, as_matrix, as_whole
from mampc.base.errors import MampcError, MampcWarning
from mampc.identification.choices import ENOUGH, Choice, block_rows_for, chosen, estimated
from mampc.identification.closed_loop import certainly_unstable, estimate_predictor, under_feedback
from mampc.identification.data import IOData
from mampc.identification.delays import Integers
from mampc.identification.drift import noise_and_walk
from mampc.identification.estimate import DEGREES, Settings
from mampc.identification.excitation import answering
from mampc.identification.parts import Part, assembled, part_residuals
from mampc.identification.scaling import Scaled, scaled
from mampc.identification.subspace import WEIGHTINGS
from mampc.identification.uncertainty import jackknife, movement, telling, unmodelled
from mampc.identification.validation import Validation, fit_to_all, validate
from mampc.systems.noise import Noise
from mampc.systems.state_space import StateSpace

DETREND = ("auto", *DEGREES)
UNSTABLE = (
    "The record was taken under feedback and shows poles outside the unit circle for certain; they were kept. A load "
    "that moves in a large wave can look so too: unless the plant runs away on its own, do not use this model."
)
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
        fit: percent per output, shape (l,), of the simulated model on the records themselves, a line in
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

    def uncertainty(
        self, samples: int, *, segments: int = 8, progress: Callable[[int], None] | None = None
    ) -> Array:
        """Standard deviations of the step response, shape (samples, l, m + d); see `StateSpace.step_response`.

        The model is estimated again, trend, dead times and order as they are, without one segment of the record
        after another; what it may lack beyond is sought in what it leaves of the record (see `unmodelled`). A
        disturbance that moved with an input does not show. Of long records a part is looked at (see `telling`).

        Args:
            samples: of the response.
            segments: at least 3.
            progress: is told how many segments are done.

        Raises:
            MampcError: records too short for that.
        """
        as_whole("segments", segments, 3)
        as_whole("samples", samples, 1)
        whole, where = self._estimate.records, telling(self._estimate.records)
        few = whole.stretches(where)
        tell = progress if progress is not None else (lambda done: None)
        chance = jackknife(few, segments, lambda rest: self._estimate.response(rest, samples), tell)
        chance = chance * np.sqrt(movement(few) / np.maximum(movement(whole), 1e-300))
        return np.sqrt(chance**2 + self._estimate.lacking(samples, where))

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
        order: n; by default the singular values say how many orders the record supports, and the one
            is taken that explains it best by Schwarz's criterion. Where disturbances are made white first, each of
            several outputs has an order of its own, which the record says.
        weighting: "cva" (canonical variates: whitens the future outputs, best with noise), "n4sid" or
            "moesp" (unweighted; the same range in the projected form used here, which is SLICOT's).
        block_rows: s, how many samples past and future hold; default 15, less for short records, more
            for a high order.
        feedthrough: False fixes D = 0, as for sampled physical plants.
        unstable: "stabilise" mirrors poles outside the unit circle to its inside, "refuse" raises; "auto" keeps
            them where a record taken under feedback shows them for certain, and mirrors them elsewhere.
        detrend: "none" explains the signals as they are, "constant" (beside the means) and "linear" fit a
            constant or a line in time to each output of each record, "differences" explains changes from
            sample to sample, "whitened" makes disturbances white first, one output after the other; "auto" takes
            constants unless what they leave is slow, disturbances moved the inputs, or a line predicts better.
        delays: dead times in samples, beyond the one of every sampled plant, a scalar or (l, m + d); by
            default those that show in the record, if they exceed `SHORT` and predict held-out data.
        progress: is told each stage in a few words; long records with many signals take some seconds.

    Warns:
        MampcWarning: inputs did nothing but answer outputs, so that the model says little of the plant.

    Raises:
        MampcError: a record too short, constant signals, or an unstable model with unstable="refuse".
    """
    as_choice("weighting", weighting, WEIGHTINGS)
    as_choice("unstable", unstable, ("auto", "stabilise", "refuse"))
    as_choice("detrend", detrend, DETREND)
    given = _records(data)
    first = given[0]
    m, l = first.u.shape[1], first.y.shape[1]
    lengths = [len(record) for record in given]
    s = block_rows_for(lengths, m, l, order, block_rows)
    records = scaled(given, centred=detrend != "none")
    settings = Settings(order, weighting, s, feedthrough, unstable)
    dead = _given_delays(delays, l, m, max(lengths))
    tell = progress if progress is not None else (lambda stage: None)
    values: list[Array] = []
    feedback = detrend != "none" and _under_feedback(records)
    try:
        if unstable == "auto" and dead is None and detrend != "none" and _keeps_unstable(records, settings):
            choice = Choice("constant", np.zeros((l, m), dtype=int), predictor=True, notes=(UNSTABLE,))
            part, errors_ahead = estimate_predictor(records, feedthrough, order)
            parts, noise = (
                [part],
                Noise(np.maximum(errors_ahead, LEAST_NOISE) * records.y_spread, np.zeros(l)),
            )
        else:
            choice = chosen(records, settings, detrend, dead, feedback, tell)
            tell("identifying a model on all of the record")
            parts = estimated(records, settings, choice, values)
            noise = _noise(parts, records)
        model = replace(assembled(parts, records, first), noise=noise)
    except np.linalg.LinAlgError as failure:
        raise MampcError(
            f"n4sid: expected records that a model can be computed from, received ones with {failure}; "
            "look for inputs that hardly move or move together, or give order and detrend"
        ) from failure
    for said in answering(given):
        warnings.warn(said, MampcWarning, stacklevel=2)
    integrators = sum(part.integrators for part in parts)
    notes = list(choice.notes)
    if integrators:
        notes.append(f"Poles that the record cannot tell from one were made exactly one: {integrators}.")
    drift = choice.trend not in ("none", "constant")
    quality = validate(model, first, drift=drift)
    return Identified(
        model=model,
        x0=quality.x0,
        singular_values=np.sort(np.concatenate(values))[::-1] if values else np.empty(0),
        order=sum(len(part.A) for part in parts),
        integrators=integrators,
        delays=choice.delays,
        detrend=choice.trend,
        notes=tuple(notes),
        fit=quality.fit if len(given) == 1 else fit_to_all(model, given, drift=drift),
        stabilised=any(part.stabilised for part in parts),
        _estimate=_Estimate(records, settings, choice, tuple(parts), first),
    )


@dataclass(frozen=True, eq=False)
class _Estimate:
    """What it takes to estimate a model again from other samples: its orders stay."""

    records: Scaled
    settings: Settings
    choice: Choice
    parts: tuple[Part, ...]
    like: IOData

    def response(self, records: Scaled, samples: int) -> Array:
        """The step response of the model of other records, shape (samples, l, m + d)."""
        parts = estimated(records, self.settings, self.choice, orders=[len(part.A) for part in self.parts])
        return assembled(parts, records, self.like).step_response(samples)

    def lacking(self, samples: int, where: Sequence[slice]) -> Array:
        """Mean square of what the step response may lack, in the same shape."""
        if self.choice.predictor:
            return np.zeros((samples, *self.choice.delays.shape))
        records = self.records
        units = records.y_spread[:, None] / records.u_spread
        return unmodelled(self.parts, records, where, samples) * units**2


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
    except (MampcError, np.linalg.LinAlgError):
        return False


def _noise(parts: Sequence[Part], records: Scaled) -> Noise:
    """White noise and random walk in what the parts leave, in output units."""
    output, drift = np.zeros((2, len(records.y_spread)))
    for part in parts:
        picked = list(part.outputs)
        output[picked], drift[picked] = noise_and_walk(part_residuals(part, records))
    return Noise(np.maximum(output, LEAST_NOISE) * records.y_spread, drift * records.y_spread)


def _given_delays(delays: Any, l: int, m: int, longest: int) -> Integers | None:
    if delays is None:
        return None
    given = as_array("delays", delays)
    given = np.full((l, m), float(given)) if given.ndim == 0 else as_matrix("delays", given, l, m)
    if not (given == np.round(given)).all() or given.min() < 0 or given.max() >= longest // 4:
        raise MampcError(
            f"delays: expected whole numbers of samples from 0 to {longest // 4}, received {given.tolist()}"
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
