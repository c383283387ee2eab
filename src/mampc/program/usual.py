"""Plain MPC as one would set it up for a model of which nothing else is known: horizons and move weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.program.condensing import CondensedQP
from mampc.program.problem import MOST_PREDICTIONS, Limits, TrackingProblem
from mampc.systems.properties import growth, samples_to_grow
from mampc.systems.state_space import StateSpace

SETTLED = 0.05  # share of a step response's largest value that may be missing where it has settled
LONGEST_SETTLING = 500  # samples that are looked at
HORIZONS = (10, 60)  # fewest and most samples of a prediction horizon; dead times come on top of both
BEGUN = 1e-3  # share of a step response's largest value up to which it is dead time
LASTS = 1e-6  # distance from the unit circle of poles of levels
FREE_MOVES = 5  # control horizon
CONDITION = 500.0  # of the program that the move weight aims at, as in dynamic matrix control
DEARER, LONGER, TIMES = 4.0, 1.5, 8  # moves and horizon of loops that are not stable, and how often


def usual_problem(model: StateSpace, limits: Limits, output_weight: Any) -> TrackingProblem:
    """The prediction horizon covers what step responses take to settle, in bounded samples behind the dead time.

    The move weight of an input is the curvature of its first move over 500 / nc, with nc the control horizon. The
    horizon, and then the weight, grow as far as it takes a loop that is stable without limits: a plant that first
    answers in the wrong direction wants a horizon that sees the right one.

    Source of the move weight: Shridhar and Cooper, Ind. Eng. Chem. Research 36 (1997).
    """
    shortest, longest = HORIZONS
    dead, most = dead_samples(model), MOST_PREDICTIONS // model.n_outputs
    longest, furthest = (min(samples + dead, most) for samples in (longest, 2 * longest))
    n_p = int(np.clip(settling(model), min(shortest + dead, longest), longest))
    n_c = min(FREE_MOVES, n_p)
    settings = {"prediction_horizon": n_p, "control_horizon": n_c, "output_weight": output_weight}
    problem = TrackingProblem(model, **settings, move_weight=1.0, limits=limits)
    response = _without_growth(model, model.step_response(n_p + 1)[:, :, : model.n_inputs])
    curvature = np.einsum("kij,ia,kaj->j", response, problem.output_weight, response)
    curvature = np.where(curvature > 0, curvature, curvature.max() or 1.0)
    problem = replace(problem, move_weight=curvature * n_c / CONDITION)
    for _ in range(TIMES):
        if np.abs(CondensedQP(problem).closed_loop_poles()).max() < 1 + 1e-6:
            break
        longer = min(int(LONGER * n_p), furthest)
        dearer = DEARER if longer <= n_p else 1.0
        n_p = max(n_p, longer)
        problem = replace(problem, prediction_horizon=n_p, move_weight=dearer * problem.move_weight)
    return problem


def settling(model: StateSpace) -> int:
    """Samples until every step response stays where it leads; of models that integrate, until its slope does; of
    unstable ones, until errors have grown tenfold.
    """
    growing = samples_to_grow(model)
    if growing is not None:
        return min(growing, LONGEST_SETTLING)
    response = model.step_response(LONGEST_SETTLING + 1)[:, :, : model.n_inputs]
    if np.abs(model.poles()).max(initial=0.0) > 1 - LASTS:
        response = np.diff(response, axis=0)
    if not np.isfinite(response).all():
        return 0
    off = np.abs(response - response[-1]) > SETTLED * np.abs(response).max(axis=0)
    return int(np.flatnonzero(off.any(axis=(1, 2))).max(initial=-1)) + 1


def dead_samples(model: StateSpace) -> int:
    """The longest dead time of an output and an input that moves it, in samples."""
    response = np.abs(model.step_response(LONGEST_SETTLING + 1)[:, :, : model.n_inputs])
    if not np.isfinite(response).all():
        return 0
    response = _without_growth(model, response)
    lasting = int((np.abs(model.poles()) > 1 - LASTS).sum())
    response /= np.arange(1, len(response) + 1)[:, None, None] ** max(lasting - 1, 0)
    begun = (response > BEGUN * response.max(axis=0)).argmax(axis=0)
    return int(max(begun.max(initial=0) - 1, 0))


def _without_growth(model: StateSpace, response: Array) -> Array:
    """A response of an unstable model, (samples, l, m), over how much its errors grow; others as they are."""
    less: Array = response / growth(model) ** np.arange(len(response))[:, None, None]
    return less
