"""What is chosen for a study of one's own: limits, horizons, weights, reference, price and noise, out of a model.

Outputs count in units of the change of reference that is asked of them, inputs in units of what they do to the outputs,
and prices in units of what moves save, so that no unit decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import MampcError
from mampc.controllers import MAMPC, MPC
from mampc.controllers.controller import Controller
from mampc.controllers.offset import highest_price
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.regulator import Regulator
from mampc.loop.simulation import simulate
from mampc.moves.rules import MoveRules
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.usual import dead_samples, usual_problem
from mampc.systems.properties import Properties
from mampc.systems.state_space import StateSpace

CHANGE_LASTS = (20, 200)  # fewest and most samples that a change of reference lasts, dead times aside
ASKED = 0.3  # of what inputs can hold: the change of reference
SEEN = 0.5  # of the range of an output in the record: the largest change of its reference
GUESSED_NOISE = 0.02  # of that change, where no record told
MOST_CHANGES = 4  # of single outputs
USUAL = 1 / 4  # of the highest price: most often it costs next to no error
CHEAPER, PRICES = 4.0, 5  # how much lower the next price is that is tried, and how many are
LITTLE = 1.25  # times the error of plain MPC
QUICK = 12  # planned moves, up to which a search takes a moment
LARGEST_WEIGHT = 1e9
LEVEL_TAKES = 20  # samples behind dead times in which a level goes as far as all its inputs can move it
PLANNED = {1: 5, 2: 5, 3: 4}  # samples with moves, of so many inputs; 3 of more
THRESHOLD = 0.002  # of the inputs' range
NEGLIGIBLE = 1e-9  # of the largest: what is rounding


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
    changes = _seen(_reachable(gain, integrates, model.u_op - low, high - model.u_op), model)
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
        problem, control_horizon=min(PLANNED.get(m, 3), horizon), output_weight=rounded(within * output_weight),
        move_weight=rounded(within * move_weight), tail_horizon=0.0 if found.unstable else float(horizon),
    )  # fmt: skip
    known_noise = model.noise is not None and bool((model.noise.output > 0).any())
    noise = (
        model.noise.output
        if known_noise and model.noise is not None
        else GUESSED_NOISE * np.where(asked > 1e-300, asked, 0.0)
    )
    settling, dead = int(np.ceil(found.settling_time / model.dt)), dead_samples(model)
    every = int(np.clip(1.5 * max(settling - dead, horizon - dead), *CHANGE_LASTS)) + 2 * dead
    highest = highest_price(problem, changes)
    usual = _usual_price(problem, np.vstack([changes, np.zeros(l)]), every, highest, on_stage)
    return Draft(problem, changes, every, highest, usual, rounded(noise), known, known_noise)


def _usual_price(
    problem: TrackingProblem, changes: Array, every: int, highest: float, on_stage: Callable[[str], None]
) -> float:
    """The highest of some prices with which the changes, without noise, come out nearly as with plain MPC.

    What a price costs after a change is foreseen by `highest_price`; not how far outputs may go astray while they
    still move, which is much beside the error of plain MPC where some modes are fast and others slow.
    """
    model, prices = problem.model, [highest * USUAL / CHEAPER**k for k in range(PRICES)]
    if problem.control_horizon * model.n_inputs > QUICK:
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
    """Changes of one output each, as far as inputs can take them.

    Outputs that integrate rest at any level, and only with inputs that leave them where they are; the others change
    with such inputs.

    Args:
        gain, integrates: of `_held_gain`.
        down, up: how far each input can go, shape (m,).
    """
    if not integrates.any():
        return _holdable(gain, down, up)
    effect = gain * np.maximum(down, up)
    levels = np.diag(ASKED * np.abs(effect).max(axis=1))[integrates]
    moving = effect[integrates] / np.abs(effect[integrates]).max(axis=1, keepdims=True)
    resting = effect - effect @ np.linalg.pinv(moving) @ moving
    resting[np.abs(resting) <= NEGLIGIBLE * np.abs(effect).max(axis=1, keepdims=True)] = 0.0
    resting[integrates] = 0.0
    others = _holdable(resting / np.maximum(down, up), down, up)
    return np.vstack([rounded(levels), others])[:MOST_CHANGES]


def _seen(changes: Array, model: StateSpace) -> Array:
    """The changes, made smaller where they go further than the record showed outputs to go.

    A slow level never settles in a record: what inputs can hold there is far from anything that the plant does.
    """
    if model.evidence is None:
        return changes
    most = SEEN * np.ptp(model.evidence.outputs, axis=1)
    asked = (changes != 0) & (most > 0)
    shares = np.where(asked, most / np.where(asked, np.abs(changes), 1.0), 1.0).min(axis=1, initial=1.0)
    return np.where(shares[:, None] < 1, rounded(changes * shares[:, None]), changes)


def _holdable(gain: Array, down: Array, up: Array) -> Array:
    """Changes of one output each, as far as inputs can hold them; where that is not possible, what one input does."""
    l, m = gain.shape
    if not gain.any():
        return np.zeros((0, l))
    room = np.minimum(down, up)
    room = np.where(room > 0, room, np.maximum(down, up))
    scaled = gain * room
    size = np.where(scaled.any(axis=1), np.abs(scaled).max(axis=1), 1.0)[:, None]
    scaled = scaled / size
    moved = scaled.any(axis=1)
    if np.linalg.matrix_rank(scaled[moved], tol=1e-6) == moved.sum():
        directions = np.linalg.pinv(scaled[moved])
    else:
        directions = np.eye(m)[:, scaled.any(axis=0)]
    shares = directions.T * room  # input changes, one row a change
    changes = []
    for share in shares[:MOST_CHANGES]:
        sign = max((1.0, -1.0), key=lambda sign: _reach(sign * share, down, up))
        change = gain @ (ASKED * _reach(sign * share, down, up) * sign * share)
        of_size = np.abs(change) / size[:, 0]
        changes.append(np.where(of_size > NEGLIGIBLE * of_size.max(), change, 0.0))
    found = rounded(np.array(changes))
    return found[found.any(axis=1)]


def _reach(change: Array, down: Array, up: Array) -> float:
    """How many times inputs can take this change."""
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where(change > 0, up / change, np.where(change < 0, -down / change, np.inf))
    return float(times.min())


def usual_threshold(limits: Limits) -> float:
    """The input change from which on moves count in tables: a 500th of the narrowest range, 0 without limits."""
    range_ = np.min(limits.u_max - limits.u_min)
    return float(f"{THRESHOLD * range_:.1g}") if np.isfinite(range_) else 0.0


def rounded(values: Array, digits: int = 2) -> Array:
    """To so many digits each."""
    flat = [float(f"{value:.{digits}g}") for value in np.ravel(values)]
    rounded: Array = np.reshape(flat, np.shape(values))
    return rounded
