"""Open loop with fixed final time, as the literature states sparse control: reach a state in N samples with few
moves (minimum attention) or few inputs (maximum hands-off), by the l1 norm or exactly by the l0 count.

    minimise   |z|_1 or |z|_0     subject to x_0 given, x_N = x_target, limits

with z the moves, u_{-1} = 0, or the inputs. l1 is a linear program, l0 a mixed-integer one; both are HiGHS's
(Nagahara, Quevedo and Nesic 2016; Nagahara and Nesic 2020).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, as_choice, as_vector, as_whole
from mampc.base.errors import MampcError
from mampc.program.problem import Limits
from mampc.systems.state_space import StateSpace, as_discrete

NORMS = ("l1", "l0")
ZERO = 1e-9  # of the largest input or move: smaller ones are none


class OpenLoopPlan(NamedTuple):
    """A plan from x_0 to x_N, all in deviations from the operating point.

    Attributes:
        u: inputs, shape (N, m).
        x: states x_0 .. x_N, shape (N + 1, n).
        nonzero: how many moves or inputs are not zero.
        norm: the sum of their sizes.
    """

    u: Array
    x: Array
    nonzero: int
    norm: float


def minimum_attention(
    model: StateSpace, x0: Any, x_target: Any = None, *, steps: int, limits: Limits | None = None,
    norm: str = "l1", u_previous: Any = 0.0, time_limit: float = 60.0,
) -> OpenLoopPlan:  # fmt: skip
    """The plan with least change of the inputs that takes the state from x0 to x_target in N = `steps` samples.

    Args:
        model: discrete; states and inputs count as deviations from its operating point.
        x0, x_target: shape (n,); target default zero.
        steps: N >= 1.
        limits: of inputs and moves, in engineering units; l0 needs u_min and u_max.
        norm: "l1", or "l0" for the exact count.
        u_previous: inputs before the first sample less the operating point, shape (m,).
        time_limit: seconds that the count may take.

    Raises:
        MampcError: shapes, or no plan that keeps the limits and reaches the target.
    """
    return _solved(model, x0, x_target, steps, limits, norm, u_previous, time_limit, moves=True)


def hands_off(
    model: StateSpace, x0: Any, x_target: Any = None, *, steps: int, limits: Limits | None = None,
    norm: str = "l1", time_limit: float = 60.0,
) -> OpenLoopPlan:  # fmt: skip
    """The plan with the fewest (l0) or smallest (l1) inputs; arguments as in `minimum_attention`.

    Raises:
        MampcError: shapes, or no plan that keeps the limits and reaches the target.
    """
    return _solved(model, x0, x_target, steps, limits, norm, 0.0, time_limit, moves=False)


def _solved(
    model: StateSpace, x0: Any, x_target: Any, steps: int, limits: Limits | None, norm: str,
    u_previous: Any, time_limit: float, *, moves: bool,
) -> OpenLoopPlan:  # fmt: skip
    from scipy.optimize import Bounds, LinearConstraint, milp

    as_discrete("model", model)
    n, m, N = model.n_states, model.n_inputs, as_whole("steps", steps, 1, 2000)
    as_choice("norm", norm, NORMS)
    x = as_vector("x0", x0, n)
    goal = as_vector("x_target", 0.0 if x_target is None else x_target, n)
    before = as_vector("u_previous", u_previous, m)
    kept = (Limits() if limits is None else limits).checked(m, model.n_outputs)
    low, high = (np.tile(limit - model.u_op, N) for limit in (kept.u_min, kept.u_max))
    reach, free = [model.B[:, :m]], x
    for _ in range(N):
        free = model.A @ free
    for _ in range(N - 1):
        reach.insert(0, model.A @ reach[0])
    to_end = np.hstack(reach)
    difference = np.eye(N * m) - np.eye(N * m, k=-m)
    Z = difference if moves else np.eye(N * m)
    z0 = np.zeros(N * m)
    if moves:
        z0[:m] = -before
    largest = np.minimum(np.tile(kept.du_max, N), high - low) if moves else np.maximum(-low, high)
    if norm == "l0" and not np.isfinite(largest).all():
        raise MampcError("limits: expected finite u_min and u_max for the exact count, received none")
    size = np.linalg.norm(to_end, axis=1, keepdims=True)
    size = np.where(size > 0, size, 1.0)
    k = N * m
    # Variables (u, t): |Z u + z0| <= t, or <= largest * t with t in {0, 1}.
    gain = largest if norm == "l0" else np.ones(k)
    rows = [
        LinearConstraint(np.hstack([to_end / size, np.zeros((n, k))]), *2 * [(goal - free) / size.ravel()]),
        LinearConstraint(np.hstack([Z, -np.diag(gain)]), -np.inf, -z0),
        LinearConstraint(np.hstack([-Z, -np.diag(gain)]), -np.inf, z0),
    ]
    if np.isfinite(kept.du_max).any():
        most = np.tile(kept.du_max, N)
        first = np.zeros(k)
        first[:m] = before
        rows.append(LinearConstraint(np.hstack([difference, np.zeros((k, k))]), first - most, first + most))
    bounds = Bounds(
        np.concatenate([low, np.zeros(k)]),
        np.concatenate([high, np.full(k, 1.0 if norm == "l0" else np.inf)]),
    )
    whole = np.concatenate([np.zeros(k), np.full(k, 1.0 if norm == "l0" else 0.0)])
    solution: Any = milp(
        np.concatenate([np.zeros(k), np.ones(k)]), constraints=rows, bounds=bounds, integrality=whole,
        options={"time_limit": time_limit},
    )  # fmt: skip
    if solution.x is None:
        raise MampcError(
            f"expected a target that can be reached in {N} samples within the limits, received one that cannot: "
            f"{solution.message}"
        )
    inputs = solution.x[:k]
    return _plan(model, x, inputs.reshape(N, m), Z @ inputs + z0)


def _plan(model: StateSpace, x0: Array, u: Array, z: Array) -> OpenLoopPlan:
    """The plan of inputs u, shape (N, m), whose moves or inputs z count."""
    path = [x0]
    for inputs in u:
        path.append(model.A @ path[-1] + model.B[:, : model.n_inputs] @ inputs)
    beyond = np.abs(z) > ZERO * max(np.abs(z).max(initial=0.0), 1e-300)
    return OpenLoopPlan(u, np.array(path), int(beyond.sum()), float(np.abs(z).sum()))
