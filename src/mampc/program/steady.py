"""Steady targets: the state and inputs at which a model rests with its outputs at a reference.

    minimise   |r - y_s|^2_Q + rho |(u_s - u_op) / s|^2
    subject to x_s = A x_s + B (u_s + d_u - u_op) + B^v (v - v_op),   u_min <= u_s <= u_max
               y_s = y_op + C x_s + D (u_s + d_u - u_op) + D^v (v - v_op) + d_y

rho is so small that it decides only where the reference leaves the inputs free. s is a unit per input, in which it
moves the weighted outputs by about 1 over the horizon.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.program.daqp import DaqpSolver
from mampc.program.parameter import Parameter
from mampc.program.problem import TrackingProblem
from mampc.program.qp import UNBOUNDED, QuadraticProgram
from mampc.program.tail import square_root

NEAREST = 1e-8  # rho
INTEGRATES = 1e-9  # singular values of [I - A, -B] below it, relative to the largest, are zero


class Steady(NamedTuple):
    """A steady state x (n,) (a deviation) and inputs u (m,) and outputs y (l,) in engineering units."""

    x: Array
    u: Array
    y: Array


class SteadyStates:
    """All steady states (x / size, (u - u_op) / unit) of a problem's model.

    Attributes:
        unit: of each input, shape (m,): it moves the weighted outputs by about 1 over the horizon.
        size: of each state, shape (n,), which makes the model's numbers alike.
        basis: without disturbances all are combinations of these columns, shape (n + m, k).
    """

    def __init__(self, problem: TrackingProblem) -> None:
        from scipy.linalg import matrix_balance, null_space

        model = problem.model
        n, m = model.n_states, model.n_inputs
        response = model.step_response(problem.prediction_horizon + 1)[:, :, :m]
        gain = np.abs(square_root(problem.output_weight) @ response).max(axis=(0, 1))
        self.unit: Array = 1 / np.where(gain > 0, gain, 1.0)
        # In units that make the model's numbers alike a small singular value is an integrator.
        _, (self.size, _) = matrix_balance(model.A, permute=False, separate=True)
        dynamics = np.hstack([(np.eye(n) - model.A) * self.size, -model.B[:, :m] * self.unit])
        self._row = np.maximum(np.linalg.norm(dynamics, axis=1), np.finfo(float).tiny)
        dynamics /= self._row[:, None]
        self.basis: Array = null_space(dynamics, rcond=INTEGRATES)
        self._inverse = np.linalg.pinv(dynamics, rcond=INTEGRATES)

    def particular(self, forcing: Array) -> Array:
        """One steady state where disturbances add `forcing`, shape (n,), to the states at each sample."""
        found: Array = self._inverse @ (forcing / self._row)
        return found


class SteadyTarget:
    """Finds the steady target of a problem's model; one small program a change of reference or disturbance."""

    def __init__(self, problem: TrackingProblem, parameter: Parameter) -> None:
        if problem.zoned.any():
            raise MampcError(
                "problem: expected set points for a steady target, received outputs with a zone_below or zone_above"
            )
        self._problem, self._parameter = problem, parameter
        model = problem.model
        n, m, l = model.n_states, model.n_inputs, model.n_outputs
        self._states = states = SteadyStates(problem)
        self._unit, self._size, self._steady = states.unit, states.size, states.basis
        self._root = root = square_root(problem.output_weight)
        self._outputs = root @ np.hstack([model.C * self._size, model.D[:, :m] * self._unit])
        to_u = self._steady[n:]
        weighted = self._outputs @ self._steady
        k = self._steady.shape[1]
        H = 2 * (weighted.T @ weighted + NEAREST * to_u.T @ to_u)
        H += NEAREST**2 * max(np.trace(H) / max(k, 1), 1e-300) * np.eye(k)
        # In these coordinates the Hessian is I: daqp regularises smaller ones about where it was last.
        curvature, directions = np.linalg.eigh(H)
        self._of = directions / np.sqrt(
            np.maximum(curvature, np.finfo(float).eps * curvature.max(initial=0.0))
        )
        self._solver = DaqpSolver(QuadraticProgram(np.eye(k), to_u @ self._of, 0))
        self._weighted, self._to_u, self._shape = weighted, to_u, (n, l)

    def at(self, p: Array) -> Steady:
        """The target for the parameter p of a sample; with a previewed reference for its last row."""
        at, model = self._parameter, self._problem.model
        n, l = self._shape
        d_u, v = p[at.input_disturbance], p[at.measured_disturbance]
        reference = p[-l:]  # from the operating point, as v is
        forcing = model.B @ np.concatenate([d_u, v])
        feed = model.D @ np.concatenate([d_u, v])
        particular = self._states.particular(forcing)
        missing = self._root @ (reference - p[at.output_disturbance] - feed)
        missing = missing - self._outputs @ particular
        f = -2 * self._weighted.T @ missing + 2 * NEAREST * self._to_u.T @ particular[n:]
        limits = self._problem.limits
        low = np.maximum((limits.u_min - model.u_op) / self._unit - particular[n:], -UNBOUNDED)
        high = np.minimum((limits.u_max - model.u_op) / self._unit - particular[n:], UNBOUNDED)
        self._solver.start()
        solution = self._solver.solve(self._of.T @ f, low, high)
        z = np.zeros(len(f)) if solution.z is None else self._of @ solution.z
        both = particular + self._steady @ z
        x, u = self._size * both[:n], model.u_op + self._unit * both[n:]
        u = np.clip(u, limits.u_min, limits.u_max)
        y = (
            model.y_op
            + model.C @ x
            + model.D[:, : len(u)] @ (u - model.u_op)
            + feed
            + p[at.output_disturbance]
        )
        return Steady(x, u, y)
