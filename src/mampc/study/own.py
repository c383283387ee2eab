"""A study of one's own: everything in it comes from a model and from what its record said."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import listed
from mampc.controllers.offset import HIGHEST_PRICE
from mampc.study.draft import Draft, draft, rounded, usual_threshold
from mampc.systems.properties import Properties, properties, time_in_words
from mampc.systems.state_space import StateSpace

DEAD_BAND = 0.01  # of the inputs' range


def own_study(
    model: StateSpace, file: str, name: str, on_stage: Callable[[str], None] = lambda stage: None
) -> str:
    """The commented text of a study of a model, which stands in for the plant.

    Args:
        model: discrete.
        file: of the model, as the study names it.
        name: of the study.
        on_stage: called when a stage begins.

    Raises:
        MampcError: a continuous model, or one whose outputs no input moves.
    """
    found = properties(model)
    return _text(model, found, draft(model, found, on_stage), file, name)


def _text(model: StateSpace, found: Properties, plan: Draft, file: str, name: str) -> str:
    problem, names = plan.problem, model.names
    limits, changes = problem.limits, [*plan.changes, np.zeros(model.n_outputs)]
    first = 5
    steps = first + plan.every * len(changes)
    settled = time_in_words(found.settling_time)
    threshold = usual_threshold(limits)
    limit_note = (
        "the range of the record; the valves' own may be wider"
        if plan.known_limits
        else "PLACEHOLDERS about the operating point: put in those of the plant"
    )
    noise_note = "as found in the record" if plan.known_noise else "a PLACEHOLDER: what the sensors have"
    pays = plan.price / plan.usual / HIGHEST_PRICE
    return f"""# A mampc study of the model {_words([file])}, in engineering units. Run it with `mampc run THIS-FILE`;
# `mampc new other.toml` writes a study in which every key is explained.
#
# inputs: {_words(names.inputs)}
# outputs: {_words(names.outputs)}

name = {_string(name)}
steps = {steps}
dt = {_number(model.dt)}  # seconds, as the model's
threshold = {_number(threshold)}  # input changes above it count as moves in the first table
skip = {first}

[plant]
kind = "model"  # the model stands in for the plant

[model]
file = {_string(file)}

[problem]
prediction_horizon = {problem.prediction_horizon}  # samples; the model settles within {settled}
control_horizon = {problem.control_horizon}
tail_horizon = {_number(problem.tail_horizon)}  # samples that a lasting error counts for beyond the prediction horizon
output_weight = {_list(np.diag(problem.output_weight))}  # errors count by the changes of reference below
move_weight = {_list(np.diag(problem.move_weight))}  # by what inputs do to outputs
# Limits of the inputs are {limit_note}.
limits = {{ u_min = {_list(limits.u_min)}, u_max = {_list(limits.u_max)} }}  # also du_max, y_min, y_max
{_output_ranges(model)}{_estimator(plan)}
[reference]
relative = true  # from the operating outputs {_some(model.y_op)}
initial = {_list(np.zeros(model.n_outputs))}
changes = [
{_changes(changes, first, plan.every)}
]

[[scenarios]]
name = "noise-free"

[[scenarios]]
name = "noisy"
noise = {_list(plan.noise)}  # standard deviation, output units: {noise_note}
seed = 0
{_loads(model, plan)}# Scenarios may have loads, valves, a plant off the model: mismatch = {{ gain = 0.2, lag = 0.2 }}

[[controllers]]
name = "MPC"
method = "mpc"

# A move must save this much; changes of the reference save {pays:.0f} times as much for each
# input, or more.
# `mampc tune THIS-FILE --max-error-increase 25%` finds the price for the error that you allow.
[[controllers]]
name = "price"
method = "exact"
rules = {{ price = {_number(float(f"{plan.usual:.2g}"))} }}

# Fewer moves for more error; smaller changes are not followed.
[[controllers]]
name = "higher price"
method = "exact"
rules = {{ price = {_number(plan.price)} }}

# What one would use instead: moves below a size are left out.
[[controllers]]
name = "dead band"
method = "dead_band"
settings = {{ size = {_list(rounded(DEAD_BAND * (limits.u_max - limits.u_min)))} }}
"""


def _loads(model: StateSpace, plan: Draft) -> str:
    """A scenario with the random walk that the record showed."""
    if model.noise is None or not model.noise.drift.any():
        return ""
    return f"""
[[scenarios]]
name = "with loads"
noise = {_list(plan.noise)}
seed = 0
# Outputs wandered like this in the record, by loads, drifts and what the model lacks: standard deviation in a sample.
loads = [{{ kind = "random_walk", at = "output", size = {_list(rounded(model.noise.drift))} }}]
"""


def _estimator(plan: Draft) -> str:
    """The noise that filters expect, where the model does not know it.

    Its guess from the inputs' range would be beyond changes of reference where inputs act against each other, and plans
    would wait for data rather than follow.
    """
    if plan.known_noise or not plan.noise.all():  # an output that nothing moves has no size
        return ""
    return f"""
[estimator]
measurement_noise = {_list(plan.noise)}  # what is expected of the sensors: as in the scenarios below
"""


def _output_ranges(model: StateSpace) -> str:
    if model.evidence is None:
        return ""
    low, high = model.evidence.outputs.T
    return f"# The record's outputs ran from {_some(low)} to {_some(high)}.\n"


def _changes(changes: Sequence[Array], first: int, every: int) -> str:
    return "\n".join(
        f"  {{ at = {first + k * every}, value = {_list(change)} }}," for k, change in enumerate(changes)
    )


def _list(values: Array) -> str:
    return "[" + ",\n  ".join(
        ", ".join(map(_number, values[k : k + 8])) for k in range(0, len(values), 8)
    ) + "]"  # fmt: skip


def _some(values: Array) -> str:
    """The first values, for a comment."""
    return ", ".join(f"{value:.5g}" for value in values[:8]) + (", ..." if len(values) > 8 else "")


def _number(value: float) -> str:
    """As few digits as give the same number back, up to rounding."""
    return repr(float(f"{value:.12g}") + 0.0)


def _string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _words(names: Sequence[str]) -> str:
    """Names as a comment can hold them."""
    return listed([re.sub(r"[\x00-\x1f\x7f\ud800-\udfff]", " ", name)[:80] for name in names], 20)
