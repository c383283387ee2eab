"""The tail of the horizon: errors beyond its end, as `TrackingProblem.tail_horizon` weighs them.

From sample np on the inputs stay, so zeta = (x_np, b, a) evolves by itself, with b = B u constant and the error
a - C x: the sum of its weighted squares is zeta' P zeta, with P from a Lyapunov equation.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.program.problem import TrackingProblem


def tail(problem: TrackingProblem, powers: Array, n_parameters: int) -> tuple[Array, Array]:
    """Rows of the error, as a map of p, and of weighted_theta: their squares sum up to the tail of the cost.

    Args:
        problem: whose tail.
        powers: A^0 .. A^np, shape (np + 1, n, n).
        n_parameters: length of p.

    Raises:
        MampcError: a tail so long that an unstable model's errors sum up without bound.
    """
    model = problem.model
    n, m, l, n_c = model.n_states, model.n_inputs, model.n_outputs, problem.control_horizon
    gamma = problem.tail_horizon / (1 + problem.tail_horizon)
    radius = np.max(np.abs(np.linalg.eigvals(model.A)), initial=0.0)
    if not gamma * radius**2 < 1:
        raise MampcError(
            f"tail_horizon: expected below {1 / max(radius**2 - 1, 1e-16):.3g} samples for a model with a pole "
            f"of size {radius:.4g}, received {problem.tail_horizon:g}; without inputs that move its errors grow"
        )
    eye, zero = np.eye(n), np.zeros((n, l))
    F = np.block([[model.A, eye, zero], [0 * eye, eye, zero], [zero.T, zero.T, np.eye(l)]])
    E = np.hstack([-model.C, zero.T, np.eye(l)])
    F *= np.sqrt(gamma)
    P = F.T @ E.T @ problem.output_weight @ E @ F
    while F.any() and np.abs(F).max() > 1e-150:  # doubling: P_2k = P_k + F^k' P_k F^k
        grown = P + F.T @ P @ F
        if np.allclose(grown, P, rtol=1e-15, atol=0.0):
            break
        P, F = grown, F @ F

    forced = np.concatenate([np.zeros((1, n, model.B.shape[1])), np.cumsum(powers[:-1] @ model.B, axis=0)])
    columns = np.split(np.arange(n_parameters), np.cumsum([n, m, m, l, model.B.shape[1] - m, 1]))
    x, u_previous, d_u, d_y, v, one, r = columns
    zeta = np.zeros((2 * n + l, n_parameters))
    for row, matrix in zip(
        (slice(n), slice(n, 2 * n), slice(2 * n, None)), (forced[-1], model.B, -model.D), strict=True
    ):
        zeta[row, u_previous] = zeta[row, d_u] = matrix[:, :m]
        zeta[row, v] = matrix[:, m:]
        zeta[row, one] = -(matrix @ model.all_inputs_op)[:, None]
    zeta[:n, x] = powers[-1]
    zeta[2 * n :, one] -= model.y_op[:, None]
    zeta[2 * n :, d_y], zeta[2 * n :, r[-l:]] = -np.eye(l), np.eye(l)
    of_moves = np.vstack(
        [
            np.hstack([forced[problem.prediction_horizon - j][:, :m] for j in range(n_c)]),
            np.tile(model.B[:, :m], n_c),
            np.tile(-model.D[:, :m], n_c),
        ]
    )
    root = square_root(P)
    return root @ zeta, -root @ of_moves


def square_root(weight: Array) -> Array:
    """The symmetric S with S' S = weight, a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(weight)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root
