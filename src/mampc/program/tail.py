"""The tail of the horizon: errors beyond its end, as `TrackingProblem.tail_horizon` weighs them.

From sample np on the inputs stay, so zeta = (x_np, b, a) evolves by itself, with b = B u constant and the error
a - C x: the sum of its weighted squares is zeta' P zeta, with P from a Lyapunov equation.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.program.parameter import Parameter
from mampc.program.prediction import Prediction
from mampc.program.problem import TrackingProblem
from mampc.systems.state_space import StateSpace


def tail(problem: TrackingProblem, prediction: Prediction, parameter: Parameter) -> tuple[Array, Array]:
    """Rows of the error, as a map of p, and of weighted_theta: their squares sum up to the tail of the cost.

    Raises:
        MampcError: a tail so long that an unstable model's errors sum up without bound.
    """
    model = problem.model
    n, l, gamma = model.n_states, model.n_outputs, shrink(problem)
    E = np.hstack([-model.C, np.zeros((l, n)), np.eye(l)])
    F = np.sqrt(gamma) * beyond_horizon(model)
    root = square_root(problem.set_point_weight) @ E @ F
    while True:  # doubling, P_2k = P_k + F^k' P_k F^k, with P = root' root: squares would lose digits
        added = root @ F
        if (np.abs(added).max(axis=0) <= 1e-17 * np.abs(root).max(axis=0)).all():
            break
        root, F = np.linalg.qr(np.vstack([root, added]), mode="r"), F @ F

    zeta, of_moves = end_of_horizon(problem, prediction, parameter)
    zeta[2 * n :] *= -1.0
    zeta[2 * n :, parameter.final_reference] = np.eye(l)
    of_moves[2 * n :] *= -1.0
    return root @ zeta, -root @ of_moves


def beyond_horizon(model: StateSpace) -> Array:
    """What takes (x, b, a) one sample on where inputs stay, shape (2n + l, 2n + l)."""
    n, l = model.n_states, model.n_outputs
    eye, zero = np.eye(n), np.zeros((n, l))
    return np.block([[model.A, eye, zero], [0 * eye, eye, zero], [zero.T, zero.T, np.eye(l)]])


def shrink(problem: TrackingProblem) -> float:
    """By how much each sample of the tail counts less than the last; a tail that grows without bound is refused."""
    gamma = problem.tail_horizon / (1 + problem.tail_horizon)
    radius = np.max(np.abs(np.linalg.eigvals(problem.model.A)), initial=0.0)
    if not gamma * radius**2 < 1:
        raise MampcError(
            f"tail_horizon: expected below {1 / max(radius**2 - 1, 1e-16):.3g} samples for a model with a pole "
            f"of size {radius:.4g}, received {problem.tail_horizon:g}; without inputs that move its errors grow"
        )
    return gamma


def end_of_horizon(
    problem: TrackingProblem, prediction: Prediction, parameter: Parameter
) -> tuple[Array, Array]:
    """(x_np, b, y - C x), the last two constant from then on, as a map of p, and per move."""
    model, n_c = problem.model, problem.control_horizon
    n, m, l = model.n_states, model.n_inputs, model.n_outputs
    forced = prediction.state_response
    per_input = np.vstack([forced[-1], model.B, model.D])  # per input held from the first sample on
    zeta = parameter.no_map(2 * n + l)
    zeta[:, parameter.u_deviation] = zeta[:, parameter.input_disturbance] = per_input[:, :m]
    zeta[:, parameter.measured_disturbance] = per_input[:, m:]
    zeta[:n, parameter.x] = prediction.final_power
    zeta[2 * n :, parameter.output_disturbance] = np.eye(l)
    of_moves = np.vstack(
        [
            np.hstack([forced[problem.prediction_horizon - j][:, :m] for j in range(n_c)]),
            np.tile(model.B[:, :m], n_c),
            np.tile(model.D[:, :m], n_c),
        ]
    )
    return zeta, of_moves


def square_root(weight: Array) -> Array:
    """The symmetric S with S' S = weight, a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(weight)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root
