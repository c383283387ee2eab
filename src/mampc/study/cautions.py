"""What should be known of a study before its figures are trusted: seen from its problem, reference and regulators."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mampc.base.checks import Array
from mampc.controllers.offset import largest_offset, largest_saving
from mampc.methods.registry import METHODS
from mampc.program.condensing import CondensedQP
from mampc.program.problem import TrackingProblem
from mampc.program.steady import SteadyTarget
from mampc.study.schema import Study

MISSED = 0.05  # of an output's largest change of reference: what inputs within their limits may leave
ROUNDING = 1e-6  # of the largest change, as outputs weigh: what an output that is to stay may miss by
MOST_LEVELS = 50  # different references that are looked at


def cautions(
    study: Study, problem: TrackingProblem, reference: Array, offsets: Mapping[str, Array]
) -> tuple[str, ...]:
    """A sentence each.

    Args:
        study: whose controllers have prices.
        problem: that all of them have.
        reference: shape (steps, l), in engineering units.
        offsets: of each controller, `Regulator.largest_offset`.
    """
    # A zone is as good as a set point for what happens beyond it.
    condensed = CondensedQP(replace(problem, zone_below=0.0, zone_above=0.0))
    levels = _some(np.unique(np.vstack([problem.model.y_op, reference]), axis=0))
    return (
        *_unstable(study, condensed),
        *_late(study),
        *_out_of_reach(condensed, levels, problem),
        *_never_pays(study, condensed, levels, offsets),
    )


def _some(levels: Array) -> Array:
    """Of many references some, with the least and the largest of each output."""
    count = len(levels)
    if count <= MOST_LEVELS:
        return levels
    evenly = np.linspace(0, count - 1, MOST_LEVELS).round().astype(int)
    some: Array = levels[np.unique([*evenly, *levels.argmin(axis=0), *levels.argmax(axis=0)])]
    return some


def _unstable(study: Study, condensed: CondensedQP) -> list[str]:
    problem = condensed.problem
    radius = float(np.abs(condensed.closed_loop_poles()).max())
    if radius < 1.0 + 1e-6:  # inputs that can stand in for one another leave a pole at 1, which is harmless
        return []
    return [
        f"the closed loop without limits is unstable: spectral radius {radius:.3f} "
        f"at dt = {study.dt:g} s with horizons "
        f"{problem.prediction_horizon} and {problem.control_horizon}; "
        "lengthen the prediction horizon or the sample time, or raise move_weight"
    ]


def _late(study: Study) -> list[str]:
    """Changes that a run does not reach."""
    late = [
        f"{what} at {at}"
        for what, at in (
            *(("reference.changes", change.at) for change in study.reference.changes),
            *(("reference.zones", zone.at) for zone in study.reference.zones),
            *(
                (f"{what} of {table.name!r}", change.at)
                for table in study.scenarios
                for what in ("switches", "limits", "manual")
                for change in getattr(table, what)
            ),
            *(
                (f"disturbances of {table.name!r}", table.disturbance_at)
                for table in study.scenarios
                if (table.input_disturbance, table.output_disturbance, table.measured_disturbance)
                != (None, None, None)
            ),
        )
        if at >= study.steps
    ]
    return [f"after the last sample, which is {study.steps - 1}: {', '.join(late)}"] if late else []


def _out_of_reach(condensed: CondensedQP, levels: Array, zones: TrackingProblem) -> list[str]:
    """Outputs whose reference or zone no steady inputs within their limits reach, by the model."""
    problem = condensed.problem
    model, parameter = problem.model, condensed.parameter
    target = SteadyTarget(problem, parameter)
    u_op = np.clip(model.u_op, problem.limits.u_min, problem.limits.u_max)
    change = np.abs(levels - model.y_op).max(axis=0)
    worst = np.zeros(model.n_outputs)
    for level in levels:
        reached = target.at(parameter.vector(np.zeros(model.n_states), u_op, level)).y
        apart = reached - level
        worst = np.maximum(worst, np.maximum(apart - zones.zone_above, -apart - zones.zone_below))
    unit = np.sqrt(np.diag(problem.output_weight))
    counts = unit * worst > ROUNDING * (unit * change).max()
    return [
        f"the reference of {name} is up to {missed:.3g} away from what the inputs can hold within their limits, by the "
        "model; widen the limits or move it"
        for name, missed, largest, more in zip(model.names.outputs, worst, change, counts, strict=True)
        if more and missed > MISSED * largest
    ]


def _never_pays(
    study: Study, condensed: CondensedQP, levels: Array, offsets: Mapping[str, Array]
) -> list[str]:
    """Controllers with a price beyond what any change of the reference can save."""
    problem = condensed.problem
    changes = (levels[:, None] - levels[None]).reshape(-1, levels.shape[1])
    saving = max(largest_saving(condensed, change) for change in np.unique(changes, axis=0))
    found = []
    for table in study.controllers:
        if table.rules is None or table.method not in METHODS or not saving > 0:
            continue
        rules = table.rules.made()
        price = float(np.min(rules.price))
        if price >= saving:
            found.append(
                f"{table.name!r} can never move for a change of reference: a move costs {price:.3g} and saves at most "
                f"{saving:.3g}; lower the price, or raise output_weight or tail_horizon"
            )
            continue
        offset = offsets[table.name]
        if not np.isfinite(offset).all():  # zones and heuristics promise nothing, and leave no less
            offset = largest_offset(problem, rules)
        if price > 0 and np.isfinite(offset).all() and (offset >= np.abs(changes).max(axis=0)).all():
            found.append(
                f"{table.name!r} may leave every change of the reference as it is: at its price, offsets of up to "
                f"{', '.join(f'{value:.3g}' for value in offset[:4])} can stay; lower it, or raise tail_horizon"
            )
    return found
