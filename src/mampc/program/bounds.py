"""The bounds of the condensed program: which quantities are bounded, and between what.

The bounded quantities, in this order:

    violations e      one per limited output, at least zero                                          (simple)
    moves             du_j within du_max, or without move limits du_0 within u_min - u_prev ..       (simple)
    inputs            u_j - u_prev within u_min - u_prev .. u_max - u_prev, those not said above
    outputs           theta d - rho_i e <= y_max - y_op - free, then theta d + rho_i e >= y_min - y_op - free
    zones             low - g <= theta d - s <= high - g, s an error of either sign (see `zone_rows`)

rho falls evenly along the horizon, see `TrackingProblem`; e is scaled as stated there. Errors s are violations as well:
without bounds, behind the others, and scaled so that each costs its square.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.program.least_distance import ViolationCost
from mampc.program.parameter import Parameter
from mampc.program.prediction import Prediction
from mampc.program.problem import TrackingProblem
from mampc.program.qp import UNBOUNDED
from mampc.program.sample import Indices
from mampc.program.zone_rows import ZoneRows

FADED = 0.5  # of a violation at the first sample: what it may be at the last at the same penalty


class Bounds:
    """The bounds of one problem; the module's docstring says in which order.

    Attributes:
        every_move: whether every move has a simple bound; if not, the first inputs have.
        n_violations: limited outputs, and errors of zones.
        violation_cost: of all violations.
        n_simple: violations and moves with simple bounds.
        size: how many there are.
        rows: the other bounded quantities per (violations, moves), shape (rows, n_violations + n_moves).
        of_moves: all bounded quantities but the violations, per move, shape (n_bounds - n_violations, n_moves).
        lower, upper: maps of the parameter, shape (n_bounds, its size).
        violation_scale: sqrt(q) of `TrackingProblem`, per output, shape (l,).
        input_rows: where the rows of the inputs stand among the bounds, a slice.
        move_of_bound: the move that makes an input row new, -1 for other bounds, shape (n_bounds,).
        above, below: rows of theta that y_max and y_min bound.
        above_rows, below_rows: where they stand among the bounds, slices.
        zones: the values that have zones, None where there are none.
        zone_rows: where they stand among the bounds, a slice.
    """

    def __init__(
        self, problem: TrackingProblem, prediction: Prediction, parameter: Parameter, *, every_move: bool
    ) -> None:
        limits, n_c, theta = problem.limits, problem.control_horizon, prediction.theta
        m, l, n = problem.model.n_inputs, problem.model.n_outputs, theta.shape[1]
        self.every_move = every_move or bool(np.isfinite(limits.du_max).any())
        limited = np.isfinite(limits.y_min) | np.isfinite(limits.y_max)
        v_limited = int(limited.sum())
        self.zones = ZoneRows(problem, prediction, parameter) if problem.zoned.any() else None
        n_zones = 0 if self.zones is None else len(self.zones.root)
        self.n_violations = v = v_limited + n_zones
        self.violation_cost = ViolationCost(
            np.concatenate([problem.output_limit_weights[limited], np.zeros(n_zones)]),
            np.concatenate([problem.output_limit_weights[limited], np.full(n_zones, 2.0)]),
        )
        n_simple = self.n_simple = v + (n if self.every_move else m)
        inputs = np.flatnonzero(np.tile(np.isfinite(limits.u_min) | np.isfinite(limits.u_max), n_c))
        inputs = inputs[inputs >= (0 if self.every_move else m)]

        predicted = np.arange(l, len(theta))  # nothing can limit y_0
        self.above = predicted[np.isfinite(limits.y_max)[predicted % l]]
        self.below = predicted[np.isfinite(limits.y_min)[predicted % l]]
        self._above_outputs = np.flatnonzero(np.isfinite(limits.y_max))
        self._below_outputs = np.flatnonzero(np.isfinite(limits.y_min))
        weight = np.maximum(np.abs(np.diag(problem.output_weight)), _least_move_cost(problem, prediction))
        self.violation_scale = np.sqrt(np.where(weight > 0, weight, 1.0))
        fading = fade(problem.prediction_horizon)
        self._fading_above, self._fading_below = fading[self.above // l], fading[self.below // l]
        violation = np.zeros((l, v))
        violation[limited, :v_limited] = np.diag(1 / self.violation_scale[limited])
        cumulate = np.kron(np.tri(n_c), np.eye(m))
        self.rows = np.block(
            [
                [np.zeros((len(inputs), v)), cumulate[inputs]],
                [-violation[self.above % l] * self._fading_above[:, None], theta[self.above]],
                [violation[self.below % l] * self._fading_below[:, None], theta[self.below]],
            ]
        )
        if self.zones is not None:
            per_error = np.hstack([np.zeros((n_zones, v_limited)), np.diag(-1 / self.zones.root)])
            self.rows = np.vstack([self.rows, np.hstack([per_error, self.zones.theta])])
        self.of_moves = np.vstack([np.eye(n_simple - v, n), self.rows[:, v:]])
        self.input_rows = slice(n_simple, n_simple + len(inputs))
        self.size = n_simple + len(self.rows)
        self.move_of_bound = np.full(self.size, -1)
        self.move_of_bound[self.input_rows] = inputs
        start, middle = self.input_rows.stop, self.input_rows.stop + len(self.above)
        self.above_rows, self.below_rows = slice(start, middle), slice(middle, middle + len(self.below))
        self.zone_rows = slice(middle + len(self.below), self.size)

        self._theta_above, self._theta_below = theta[self.above], theta[self.below]
        self.lower, self.upper = (parameter.no_map(self.size) for _ in range(2))
        self._bound_inputs(problem, parameter, inputs)
        self._bound_outputs(problem, parameter, prediction.free)
        if self.zones is not None:
            errors = slice(v_limited, v)
            self.lower[errors, parameter.one], self.upper[errors, parameter.one] = -UNBOUNDED, UNBOUNDED
            self.lower[self.zone_rows], self.upper[self.zone_rows] = self.zones.low, self.zones.high

    def _bound_inputs(self, problem: TrackingProblem, parameter: Parameter, inputs: Indices) -> None:
        """Fill in the bounds of violations, moves and inputs."""
        limits, m, lower, upper = problem.limits, problem.model.n_inputs, self.lower, self.upper
        violations, moves = slice(self.n_violations), slice(self.n_violations, self.n_simple)
        one, u_previous = parameter.one, np.eye(m)
        u_min = np.maximum(limits.u_min, -UNBOUNDED)[:, None]
        u_max = np.minimum(limits.u_max, UNBOUNDED)[:, None]
        upper[violations, one] = UNBOUNDED
        if self.every_move:
            du_max = np.minimum(limits.du_max, UNBOUNDED)[:, None]
            upper[moves, one] = np.tile(du_max, (problem.control_horizon, 1))
            lower[moves, one] = -upper[moves, one]
        else:
            lower[moves, parameter.u_previous] = upper[moves, parameter.u_previous] = -u_previous
            lower[moves, one], upper[moves, one] = u_min, u_max
        rows, of = self.input_rows, inputs % m
        lower[rows, parameter.u_previous] = upper[rows, parameter.u_previous] = -u_previous[of]
        lower[rows, one], upper[rows, one] = u_min[of], u_max[of]

    def _bound_outputs(self, problem: TrackingProblem, parameter: Parameter, free: Array) -> None:
        """Fill in the bounds of the outputs; each row has one, above or below."""
        limits, l, one, y_op = problem.limits, problem.model.n_outputs, parameter.one, problem.model.y_op
        self.upper[self.above_rows] = -free[self.above]
        self.upper[self.above_rows, one] += (limits.y_max - y_op)[self.above % l, None]
        self.lower[self.above_rows, one] = -UNBOUNDED
        self.lower[self.below_rows] = -free[self.below]
        self.lower[self.below_rows, one] += (limits.y_min - y_op)[self.below % l, None]
        self.upper[self.below_rows, one] = UNBOUNDED

    def output_rows(self) -> tuple[Array, Indices, Array]:
        """Limited outputs per move, those below turned over, their outputs, and their rho of `TrackingProblem`."""
        rows = np.vstack([self._theta_above, -self._theta_below])
        l = len(self.violation_scale)
        outputs = np.concatenate([self.above % l, self.below % l])
        return rows, outputs, np.concatenate([self._fading_above, self._fading_below])

    def excess(self, moves: Array, lower: Array, upper: Array, *, faded: bool = False) -> Array:
        """Largest predicted excess over its limits of each output over i = 1..np, shape (l,).

        Args:
            moves: d, shape (n_moves,).
            lower, upper: bounds of the sample, shape (n_bounds,).
            faded: the e of `TrackingProblem`, for which later excess counts more.
        """
        excess = np.zeros(len(self.violation_scale))
        above, below = self._above_outputs, self._below_outputs
        # Rows come sample by sample, each with the same outputs.
        if len(above):
            over = self._theta_above.dot(moves) - upper[self.above_rows]
            if faded:
                over /= self._fading_above
            excess[above] = over.reshape(-1, len(above)).max(axis=0)
        if len(below):
            over = lower[self.below_rows] - self._theta_below.dot(moves)
            if faded:
                over /= self._fading_below
            excess[below] = np.maximum(excess[below], over.reshape(-1, len(below)).max(axis=0))
        return np.maximum(excess, 0.0)

    def zone_errors(self, moves: Array, lower: Array, upper: Array) -> Array:
        """How far values are below their zones (negative) or above them, weighted: their squares sum up to the cost.

        Args:
            moves, lower, upper: see `excess`.
        """
        if self.zones is None:
            return np.zeros(0)
        values = self.zones.theta.dot(moves)
        low, high = lower[self.zone_rows], upper[self.zone_rows]
        errors: Array = self.zones.root * (values - np.minimum(np.maximum(values, low), high))
        return errors


def _least_move_cost(problem: TrackingProblem, prediction: Prediction) -> Array:
    """Per output the weight of the cheapest move that shifts it by one unit within the horizon, shape (l,)."""
    model, m = problem.model, problem.model.n_inputs
    reach = np.abs(prediction.step_response[:, :, :m]).max(axis=0)
    states = np.abs(prediction.state_response[:, :, :m]).max(axis=0)
    reached = reach > 1e-12 * (np.abs(model.C) @ states + np.abs(model.D[:, :m]))  # else it is rounding
    cost = np.abs(np.diag(problem.move_weight)) / np.where(reached, reach, 1.0) ** 2
    least: Array = np.where(reached, cost, np.inf).min(axis=1)
    return np.where(np.isfinite(least), least, 0.0)


def fade(n_p: int) -> Array:
    """rho_i of `TrackingProblem` for i = 0..np, shape (np + 1,)."""
    return np.interp(np.arange(n_p + 1), [1, max(n_p, 2)], [1.0, FADED])
