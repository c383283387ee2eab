"""Gains of a model, input by input and output by output, corrected from records of the plant under control.

A `GainLearner` goes through the records. Inputs count from their first values, and what they did before belongs to the
states that nobody measured. The correction counts only where it predicts better than the gains as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_vector, require_finite
from mampc.base.errors import MampcError
from mampc.identification.data import IOData
from mampc.loop.corrected_gains import CLEARLY, FEWEST, another_model, another_time, require_apart, with_gains
from mampc.loop.gain_learner import GainLearner
from mampc.loop.run import Run
from mampc.systems.noise import white_noise
from mampc.systems.state_space import StateSpace, as_discrete


@dataclass(frozen=True, eq=False)
class LearntGains:
    """What `learn_gains` found.

    Attributes:
        model: with its gains corrected where that predicts better; else the one given.
        accepted: whether they are.
        reason: in words.
        factors: of each gain, (l, m), as learnt from all records, accepted or not.
        deviation: their standard deviations, shape (l, m).
        gained: by how much the log-likelihood of the measurements rises, each predicted before it was learnt from.
    """

    model: StateSpace = field(repr=False)
    accepted: bool
    reason: str
    factors: Array
    deviation: Array
    gained: float

    def __str__(self) -> str:
        return self.reason


def learn_gains(
    model: StateSpace, records: IOData | Run | Sequence[IOData | Run], *, noise: Any = None
) -> LearntGains:
    """Correct the gains of a model from records of the plant, under control or not.

    Args:
        model: a discrete model with at most as many inputs as outputs, whose gains no two inputs share.
        records: of inputs and measured outputs, at least 60 samples together.
        noise: standard deviation of the measurement noise, scalar or (l,), output units; default `model.noise`.

    Raises:
        MampcError: redundant inputs, records of other signals, sample time or too few samples, or no noise.
    """
    as_discrete("model", model)
    l = model.n_outputs
    given = list(records) if isinstance(records, Sequence) else [records]
    if not given:
        raise MampcError("records: expected at least one, received none")
    known = [_signals(record, model) for record in given]
    noise = white_noise(model.noise) if noise is None else noise
    if noise is None:
        raise MampcError(
            "noise: expected the standard deviation of each output's measurement noise, received none"
        )
    sizes = as_vector("noise", noise, l, 0.0, exclusive=True)
    require_apart(model, sizes)
    total = sum(len(y) for _, y in known)
    if total < FEWEST:
        raise MampcError(f"records: expected at least {FEWEST} samples together, received {total}")
    learner, learnt = GainLearner(model, sizes), None
    for u, y in known:
        learnt = learner.initial(u[0], learnt)
        for before, now, measured in zip(np.vstack([u[:1], u]), u, y, strict=False):
            learnt = learner.update(learnt, before, now, measured)
    assert learnt is not None
    (factors, deviation), gained = learner.found(learnt), float(learnt.evidence[0])
    answer = LearntGains(model, False, "", factors, deviation, gained)
    words = f"log-likelihood {gained:+.1f} over {total} samples, each predicted before it was learnt from"
    against = another_model(model, factors) or another_time(model, *learner.delay(learnt))
    if against:
        return replace(answer, reason=f"gains stay: {against}, which calls for another model")
    if not gained > CLEARLY:
        return replace(answer, reason=f"gains stay: corrected they predict no better ({words})")
    return replace(
        answer,
        model=with_gains(model, factors),
        accepted=True,
        reason=f"gains corrected: they predict better ({words})",
    )


def _signals(record: Any, model: StateSpace) -> tuple[Array, Array]:
    """Inputs (N, m + d) and outputs (N, l) of a record."""
    if isinstance(record, Run):
        u, y, dt = np.hstack([record.u, record.v]), record.y_measured, record.dt
    elif isinstance(record, IOData):
        u, y, dt = record.u, record.y, record.dt
    else:
        raise MampcError(f"records: expected IOData or runs, received {type(record).__name__}")
    if u.shape[1] != model.B.shape[1] or y.shape[1] != model.n_outputs:
        raise MampcError(
            f"records: expected {model.B.shape[1]} inputs and {model.n_outputs} outputs, "
            f"received {u.shape[1]} and {y.shape[1]}"
        )
    if not np.isclose(dt, model.dt, rtol=1e-6):
        raise MampcError(f"records: expected the model's sample time of {model.dt:g} s, received {dt:g} s")
    return require_finite("records", u), require_finite("records", y)
