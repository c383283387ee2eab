"""What inputs cost where they are: their distance from resting values, and a price per unit.

    sum_{i=0..np} |u_i - u_target|^2_W + c' (u_i - u_cheapest),    held inputs counting L times more in the tail

with the input held at its last value from i = nc-1 on. u_cheapest is the limit towards which the price pulls, so that
no input within its limits costs less than nothing.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.program.parameter import Parameter
from mampc.program.problem import TrackingProblem
from mampc.program.tail import square_root


def distance_from_targets(problem: TrackingProblem, parameter: Parameter) -> tuple[Array, Array]:
    """Rows of the distance, as a map of p, and minus those of the moves: their squares sum up to the cost."""
    m, target = problem.model.n_inputs, problem.u_target
    root = square_root(problem.u_target_weight)
    root = root[root.any(axis=1)]
    samples = np.sqrt(_samples(problem))
    error = parameter.no_map(len(samples) * len(root))
    if len(root):
        error[:, parameter.u_deviation] = np.kron(samples[:, None], -root)
        error[:, parameter.one.start] = np.kron(samples, root @ (target - problem.model.u_op))
    return error, np.kron(samples[:, None] * np.tri(len(samples)), root).reshape(-1, len(samples) * m)


def price_of_inputs(problem: TrackingProblem, parameter: Parameter) -> tuple[Array, Array]:
    """What moves cost per unit, shape (n_moves,), and what inputs cost without moves, as a map of p (its size,)."""
    limits, cost, samples = problem.limits, problem.u_cost, _samples(problem)
    cheapest = np.where(cost > 0, limits.u_min, np.where(cost < 0, limits.u_max, 0.0))
    held = parameter.no_map(1)[0]
    held[parameter.u_deviation] = samples.sum() * cost
    held[parameter.one.start] = samples.sum() * float(cost @ (problem.model.u_op - cheapest))
    return np.kron(np.cumsum(samples[::-1])[::-1], cost), held


def _samples(problem: TrackingProblem) -> Array:
    """How many samples each planned input stands for, shape (nc,)."""
    samples = np.ones(problem.control_horizon)
    samples[-1] = problem.prediction_horizon - problem.control_horizon + 2 + problem.tail_horizon
    return samples
