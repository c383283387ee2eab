"""A study of one's own: everything in it comes from a model and from what its record said.

Outputs count in units of the change of reference that is asked of them, inputs in units of what they do to the outputs,
and prices in units of what moves save, so that no unit decides.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import MampcError, listed
from mampc.controllers import MAMPC, MPC
from mampc.controllers.controller import Controller
from mampc.controllers.offset import HIGHEST_PRICE, highest_price
from mampc.loop.defaults import FEW
from mampc.loop.doubt import runs_away
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.regulator import Regulator
from mampc.loop.simulation import simulate
from mampc.moves.rules import MoveRules
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.usual import dead_samples, usual_problem
from mampc.systems.properties import Properties, properties, time_in_words
from mampc.systems.state_space import StateSpace

CHANGE_LASTS = (20, 200)  # fewest and most samples that a change of reference lasts, dead times aside
ASKED = 0.3  # of what inputs can hold: the change of reference
GUESSED_NOISE = 0.02  # of that change, where no record told
MOST_CHANGES = 4  # of single outputs
USUAL = 1 / 4  # of the highest price: most often it costs next to no error
CHEAPER, PRICES = 4.0, 5  # how much lower the next price is that is tried, and how many are
LITTLE = 1.25  # times the error of plain MPC
DEAD_BAND = 0.01  # of the inputs' range
LARGEST_WEIGHT = 1e9
LEVEL_TAKES = 20  # samples behind dead times in which a level goes as far as all its inputs can move it
PLANNED = {1: 5, 2: 5, 3: 4}  # samples with moves, of so many inputs; 3 of more


class Draft(NamedTuple):
    """What is chosen for a study; changes are from the operating point, one row each."""

    problem: TrackingProblem
    changes: Array
    every: int
    price: float
    usual: float
    noise: Array
    known_limits: bool
    known_noise: bool


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


def draft(
    model: StateSpace, found: Properties, on_stage: Callable[[str], None] = lambda stage: None
) -> Draft:
    """Limits, horizons, weights, reference, price and noise."""
    low, high, known = _input_limits(model)
    m, l = model.n_inputs, model.n_outputs
    limits = Limits(u_min=low, u_max=high)
    horizon = usual_problem(model, limits, 1.0).prediction_horizon
    gain, integrates = _held_gain(model, found, min(horizon, LEVEL_TAKES + dead_samples(model)))
    if not gain.any():
        raise MampcError("expected a model whose inputs move an output, received one where none does")
    changes = _reachable(gain, integrates, model.u_op - low, high - model.u_op)
    asked = np.abs(changes).max(axis=0)
    # Outputs that none of the changes concerns weigh as little as what inputs do to them says.
    asked = np.where(asked > 0, asked, np.maximum((np.abs(gain) @ (high - low)) * ASKED, 1e-300))
    output_weight: Array = 1 / np.where(asked > 1e-300, asked, 1.0) ** 2
    problem = usual_problem(model, limits, output_weight)
    move_weight = np.diag(problem.move_weight)
    # Only ratios matter, and a study's numbers are bounded.
    within = min(1.0, LARGEST_WEIGHT / max(output_weight.max(), move_weight.max()))
    horizon = problem.prediction_horizon
    problem = replace(
        problem, control_horizon=min(PLANNED.get(m, 3), horizon), output_weight=_rounded(within * output_weight),
        move_weight=_rounded(within * move_weight), tail_horizon=0.0 if found.unstable else float(horizon),
    )  # fmt: skip
    known_noise = model.noise is not None and bool((model.noise.output > 0).any())
    noise = model.noise.output if known_noise and model.noise is not None else GUESSED_NOISE * asked
    settling, dead = int(np.ceil(found.settling_time / model.dt)), dead_samples(model)
    every = int(np.clip(1.5 * max(settling - dead, horizon - dead), *CHANGE_LASTS)) + 2 * dead
    highest = highest_price(problem, changes)
    usual = _usual_price(problem, np.vstack([changes, np.zeros(l)]), every, highest, on_stage)
    return Draft(problem, changes, every, highest, usual, _rounded(noise), known, known_noise)


def _usual_price(
    problem: TrackingProblem, changes: Array, every: int, highest: float, on_stage: Callable[[str], None]
) -> float:
    """The highest of some prices with which the changes, without noise, come out nearly as with plain MPC.

    What a price costs after a change is foreseen by `highest_price`; not how far outputs may go astray while they
    still move, which is much beside the error of plain MPC where some modes are fast and others slow.
    """
    model, prices = problem.model, [highest * USUAL / CHEAPER**k for k in range(PRICES)]
    if problem.control_horizon * model.n_inputs > FEW:
        return prices[0]
    reference, estimator = model.y_op + np.repeat(changes, every, axis=0), KalmanFilter.offset_free(model)

    def error(controller: Controller) -> float:
        run = simulate(model, Regulator(controller, estimator), reference, progress=False)
        return float(np.einsum("ti,ij,tj->", run.y - run.r, problem.output_weight, run.y - run.r))

    most = LITTLE * error(MPC(problem))
    for number, price in enumerate(prices, 1):
        on_stage(f"trying price {number} of {len(prices)} at most")
        if error(MAMPC(problem, MoveRules(price=price))) <= most:
            break
    return price


def _input_limits(model: StateSpace) -> tuple[Array, Array, bool]:
    """Limits about the operating point, and whether they are those of a record."""
    m = model.n_inputs
    if model.evidence is not None:
        low, high = model.evidence.inputs[:m].T.copy()
        span = high - low
        if (span > 0).all():
            low, high = np.minimum(low, model.u_op - 0.1 * span), np.maximum(high, model.u_op + 0.1 * span)
            step = 10.0 ** np.floor(np.log10(span) - 2)
            return np.floor(low / step) * step, np.ceil(high / step) * step, True
    span = np.where(model.u_op == 0, 1.0, np.abs(model.u_op) / 2)
    step = 10.0 ** np.floor(np.log10(span) - 1)
    return np.floor((model.u_op - span) / step) * step, np.ceil((model.u_op + span) / step) * step, False


def _held_gain(model: StateSpace, found: Properties, samples: int) -> tuple[Array, BoolArray]:
    """What held inputs do, (l, m), and which outputs integrate: steady, or after so many samples for these."""
    m = model.n_inputs
    gain = found.gain[:, :m]
    if found.unstable and not found.integrators:
        gain = model.dc_gain()[:, :m]  # of the steady state that a controller can hold
    gain = np.where(np.isfinite(gain), gain, 0.0)
    integrating = found.integrating[:, :m]
    moved = np.where(integrating, model.step_response(samples + 1)[-1, :, :m], 0.0)
    held: Array = np.where(integrating.any(axis=1, keepdims=True), moved, gain)
    rows: BoolArray = np.any(moved, axis=1)
    return held, rows


def _reachable(gain: Array, integrates: BoolArray, down: Array, up: Array) -> Array:
    """Changes of one output each, as far as inputs can hold them; where that is not possible, what one input does.

    Outputs that integrate rest at any level, and only with inputs that leave them where they are.

    Args:
        gain, integrates: of `_held_gain`.
        down, up: how far each input can go, shape (m,).
    """
    if integrates.any():
        room = np.maximum(down, up)
        levels = np.diag(ASKED * np.abs(gain * room).max(axis=1))[integrates]
        scaled = gain[integrates] * room
        scaled = scaled / np.abs(scaled).max(axis=1, keepdims=True)
        resting = gain - gain * room @ np.linalg.pinv(scaled) @ scaled / room
        resting = np.where(
            np.abs(resting) * room > 1e-9 * np.abs(gain * room).max(axis=1, keepdims=True), resting, 0.0
        )
        resting[integrates] = 0.0
        rest = (
            _reachable(resting, np.zeros_like(integrates), down, up)
            if resting.any()
            else np.zeros((0, len(gain)))
        )
        return np.vstack([_rounded(levels), rest])[:MOST_CHANGES]
    l, m = gain.shape
    room = np.minimum(down, up)
    room = np.where(room > 0, room, np.maximum(down, up))
    scaled = gain * room
    size = np.where(scaled.any(axis=1), np.abs(scaled).max(axis=1), 1.0)[:, None]
    scaled = scaled / size
    moved = scaled.any(axis=1)
    if np.linalg.matrix_rank(scaled[moved], tol=1e-6) == moved.sum():
        directions = np.zeros((m, l))
        directions[:, moved] = np.linalg.pinv(scaled[moved])
        directions = directions[:, moved]
    else:
        directions = np.eye(m)[:, scaled.any(axis=0)]
    shares = directions.T * room  # input changes, one row a change
    changes = []
    for share in shares[:MOST_CHANGES]:
        reach = [_reach(sign * share, down, up) for sign in (1.0, -1.0)]
        sign = 1.0 if reach[0] >= reach[1] else -1.0
        change = gain @ (ASKED * max(reach) * sign * share)
        changes.append(
            np.where(np.abs(change) > 1e-9 * np.abs(change / size[:, 0]).max() * size[:, 0], change, 0.0)
        )
    found = _rounded(np.array(changes))
    return found[found.any(axis=1)]


def _reach(change: Array, down: Array, up: Array) -> float:
    """How many times inputs can take this change."""
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where(change > 0, up / change, np.where(change < 0, -down / change, np.inf))
    return float(times.min())


def _rounded(values: Array, digits: int = 2) -> Array:
    """To so many digits each."""
    flat = [float(f"{value:.{digits}g}") for value in np.ravel(values)]
    rounded: Array = np.reshape(flat, np.shape(values))
    return rounded


def _text(model: StateSpace, found: Properties, plan: Draft, file: str, name: str) -> str:
    problem, names = plan.problem, model.names
    limits, changes = problem.limits, [*plan.changes, np.zeros(model.n_outputs)]
    first = 5
    steps = first + plan.every * len(changes)
    settled = time_in_words(found.settling_time)
    threshold = float(f"{0.002 * np.min(limits.u_max - limits.u_min):.1g}")
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
{_output_ranges(model)}{_later_data(problem)}
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
settings = {{ size = {_list(_rounded(DEAD_BAND * (limits.u_max - limits.u_min)))} }}
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
loads = [{{ kind = "random_walk", at = "output", size = {_list(_rounded(model.noise.drift))} }}]
"""


def _later_data(problem: TrackingProblem) -> str:
    """Where a search is quick, and nothing runs away from a plan that waits."""
    if problem.control_horizon * problem.model.n_inputs > FEW or runs_away(problem.model):
        return ""
    return """
[estimator]
value_of_information = true  # plans count on later measurements: fewer moves at the same price
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
