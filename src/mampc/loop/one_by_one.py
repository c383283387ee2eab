"""Many closed loops whose regulators are stepped one by one, while their plants move as one batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.controllers.decision import Decision
from mampc.loop.motion import Faults, motions_of
from mampc.loop.regulator import Regulator
from mampc.loop.simulation import Course, at_rest
from mampc.plants import Plant
from mampc.systems.state_space import StateSpace


class Moment(NamedTuple):
    """One sample of S loops: inputs, positions (S, m), outputs, measurements (S, l), decisions, faults by loop."""

    u: Array
    position: Array
    y: Array
    y_measured: Array
    decisions: tuple[Decision, ...]
    faults: dict[int, Faults]


def closed_loops(
    plants: Sequence[Plant | StateSpace],
    regulators: Sequence[Regulator],
    courses: Sequence[Course],
    *,
    preview: bool,
    samples: Iterable[int],
) -> Iterator[Moment]:
    """The loops sample by sample, each with its own plant (which may be the same), regulator and course."""
    model = regulators[0].controller.problem.model
    ahead = [r.controller.problem.prediction_horizon + 1 if preview else None for r in regulators]
    rests = [
        at_rest(plant, regulator, course.u_initial, course.v[0])
        for plant, regulator, course in zip(plants, regulators, courses, strict=True)
    ]
    most = max(len(x) for x, _ in rests)
    x, states = np.array([np.pad(x, (0, most - len(x))) for x, _ in rests]), [state for _, state in rests]
    noise, at_inputs, at_outputs, v = (
        np.array([getattr(course, name) for course in courses]).swapaxes(0, 1)
        for name in ("noise", "at_inputs", "at_outputs", "v")
    )
    position, stems = np.array([course.u_initial for course in courses]), [c.stems for c in courses]
    motion = motions_of(plants, model.dt, x, np.concatenate([position, v[0]], axis=1))
    for k in samples:
        y = motion.output(x, np.concatenate([position + at_inputs[k], v[k]], axis=1)) + at_outputs[k]
        measured, decisions = y + noise[k], []
        position = np.empty_like(position)
        for s, (regulator, course) in enumerate(zip(regulators, courses, strict=True)):
            told = course.told(k, v[k, s] if model.n_disturbances else None)
            decision = regulator.step(states[s], measured[s], course.asked(k, ahead[s]), **told)
            states[s], stem = decision.state, stems[s]
            if stem is not None:
                stem = stems[s] = stem.moved(decision.u)
            position[s] = decision.u if stem is None else stem.position
            if course.interventions is not None:
                position[s] = course.interventions.moved(k, position[s])
            decisions.append(decision._replace(state=None))
        applied = np.concatenate([position + at_inputs[k], v[k]], axis=1)
        x = motion.move(x, applied)
        u = np.array([decision.u for decision in decisions])
        yield Moment(u, position, y, measured, tuple(decisions), motion.faults(x, applied))
