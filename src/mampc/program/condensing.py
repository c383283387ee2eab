"""Condensing: the tracking problem as a dense quadratic program in the moves.

With the step response S_i = D + sum_{k<i} C A^k B of the model, the predicted outputs are

    y_i = free_i + sum_{j <= min(i, nc-1)} S_{i-j} du_j
    free_i = y_op + C A^i x + S_i (u_prev + d_u - u_op) + S^v_i (v - v_op) + d_y      (no more moves)

with constant disturbances: d_u at the inputs, d_y at the outputs, and measured ones v with their own step
response S^v. With `theta` the lower block-triangular matrix of step responses and error = r - free

    cost = |error - theta d|^2_Q + |d|^2_R = 1/2 d' H d + f' d + |error|^2_Q
    H = 2 (theta' Q theta + R),   f = -2 theta' Q error,   d = (du_0, ..., du_{nc-1}).

Everything that changes from sample to sample (f, the bounds, the error, and the optimum as long as no
limit is active) is affine in the parameter p = (x, u_prev, d_u, d_y, v, 1, r): one matrix-vector product.
Where outputs are limited, one violation per limited output, scaled as in `TrackingProblem`, stands before
the moves: z = (violations, d).

On a move pattern S (all other moves zero) the optimum without limits is d_S = -H_SS^-1 f_S: affine as well.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray, ComplexArray, as_shaped
from mampc.base.errors import MampcError
from mampc.program.problem import TrackingProblem
from mampc.program.qp import UNBOUNDED, QuadraticProgram
from mampc.program.sample import Indices, Parts, PatternOptimum, Sample
from mampc.program.tail import square_root, tail

FADED = 0.5  # of a violation at the first sample: what it may be at the last at the same penalty
LARGEST_RESPONSE = 1e100  # per unit of state or input; its square is still a number


class Restriction(NamedTuple):
    """A program on some of the moves (the others are zero), and where its data stand in the full one."""

    program: QuadraticProgram
    columns: Indices
    bounds: Indices


class CondensedQP:
    """The condensed form of a `TrackingProblem`; the module's docstring defines every symbol.

    Attributes:
        program: the `QuadraticProgram` in z = (violations, d); d is time-major, n_moves = nc * m.
        H: its block for the moves, shape (n_moves, n_moves).
        theta: predicted outputs per move, shape ((np + 1) l, n_moves).
        cumulate: u_j - u_prev per move, shape (n_moves, n_moves).
        weighted_theta: Q^(1/2) theta, and below it the weighted tail's rows, shape (n_errors, n_moves).
        error_of_reference: what a constant reference adds to the error, shape (n_errors, l).
        map_bytes: about the memory that an `optimum_on` some pattern takes.
        violation_scale: sqrt(q) of `TrackingProblem`, per output, shape (l,).
        moves_bounded: whether every move has a simple bound; if not, the first inputs have.
        input_rows: where the rows of the inputs stand among the bounds, a slice.
        move_of_bound: the move that makes an input row new, -1 for other bounds, shape (n_bounds,).
        above, below: rows of theta that y_max and y_min bound.
        above_rows, below_rows: where they stand among the bounds.

    Args:
        problem: what to condense.
        bound_every_move: give every move a simple bound, though du_max may be infinite.

    Raises:
        MampcError: the moves are not all determined by the weights (H is singular), or an unstable
            model's predictions overflow.
    """

    def __init__(self, problem: TrackingProblem, *, bound_every_move: bool = False) -> None:
        self.problem = problem
        # With move limits every move has a simple bound and every input a row; without, the first inputs'
        # limits are simple bounds of the first moves.
        self.moves_bounded = bound_every_move or bool(np.isfinite(problem.limits.du_max).any())
        model, n_p, n_c = problem.model, problem.prediction_horizon, problem.control_horizon
        m, l = model.n_inputs, model.n_outputs
        self.n_moves = n_c * m
        self.cumulate = np.kron(np.tri(n_c), np.eye(m))

        power = [np.eye(model.n_states)]
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(n_p):
                power.append(power[-1] @ model.A)
            powers = np.array(power)  # A^i
            observed = model.C @ powers  # C A^i
            step = np.cumsum([model.D, *(observed[:-1] @ model.B)], axis=0)  # S_i
        if not (np.abs(observed) < LARGEST_RESPONSE).all() or not (np.abs(step) < LARGEST_RESPONSE).all():
            raise MampcError(
                f"CondensedQP: expected predictions that stay within numbers over {n_p} samples, received a "
                "model that grows without bound; shorten the prediction horizon"
            )
        self.theta = np.zeros(((n_p + 1) * l, self.n_moves))
        for j in range(n_c):
            self.theta[j * l :, j * m : (j + 1) * m] = step[: n_p + 1 - j, :, :m].reshape(-1, m)

        root = np.kron(np.eye(n_p + 1), square_root(problem.output_weight))
        self.weighted_theta = root @ self.theta
        self.R = np.kron(np.eye(n_c), problem.move_weight)
        if not problem.weigh_first_move:
            self.R[:m, :m] = 0.0
        # Affine maps of p = (x, u_prev, d_u, d_y, v, 1, r), for a previewed reference.
        responses = step.reshape(-1, model.B.shape[1])
        inputs, measured = responses[:, :m], responses[:, m:]
        ones = np.tile(np.eye(l), (n_p + 1, 1))
        none = np.zeros(((n_p + 1) * l, len(ones)))
        offset = (np.tile(model.y_op, n_p + 1) - responses @ model.all_inputs_op)[:, None]
        free = np.hstack([np.concatenate(observed), inputs, inputs, ones, measured, offset, none])
        self._one_at = free.shape[1] - len(none) - 1
        error = -free
        error[:, self._one_at + 1 :] = np.eye(len(none))
        u_previous = np.zeros((m, free.shape[1]))
        u_previous[:, model.n_states : model.n_states + m] = np.eye(m)

        error = root @ error
        if problem.tail_horizon > 0:
            tail_error, tail_theta = tail(problem, powers, free.shape[1])
            error, self.weighted_theta = (
                np.vstack([error, tail_error]), np.vstack([self.weighted_theta, tail_theta]),
            )  # fmt: skip
        H = 2 * (self.weighted_theta.T @ self.weighted_theta + self.R)
        self.H = (H + H.T) / 2
        lower, upper = self._build_program(free, u_previous, _least_move_cost(problem, powers, step))
        f = np.zeros((self.program.n_variables, free.shape[1]))
        f[: self.n_violations, self._one_at] = problem.output_limit_weight
        f[self.n_violations :] = -2 * self.weighted_theta.T @ error
        self._affine = {"error": error, "f": f, "lower": lower, "upper": upper}
        self._u_previous_map, self._root_R = u_previous, square_root(self.R)
        self._preview_map, self.parts = _stacked(
            **self._optimum_maps(np.ones(self.n_moves, dtype=bool)), f=f, f_moves=f[self.n_violations :],
            error=error, lower=lower, upper=upper,
        )  # fmt: skip
        self.map_bytes = self._preview_map.nbytes
        self.error_of_reference = self._with_constant_reference(error)[:, self._one_at + 1 :]
        self._constant_map = self._with_constant_reference(self._preview_map)
        parts: tuple[Array, Array, Array, Array] = np.zeros(m), np.zeros(l), model.v_op, np.ones(1)
        self._undisturbed_parts, self._undisturbed = parts, np.concatenate(parts)  # (d_u, d_y, v, 1)

    def _build_program(self, free: Array, u_previous: Array, move_cost: Array) -> tuple[Array, Array]:
        """The program, and its bounds as affine maps; `move_cost` (l,) is that of moving an output by one unit.

        Rows: violations and moves (simple), then inputs after the first sample, then outputs.
        """
        problem, limits = self.problem, self.problem.limits
        m, l, n_c, n = problem.model.n_inputs, problem.model.n_outputs, problem.control_horizon, self.n_moves
        limited = np.isfinite(limits.y_min) | np.isfinite(limits.y_max)
        self.n_violations = v = int(limited.sum())
        n_simple = v + (n if self.moves_bounded else m)
        skipped = 0 if self.moves_bounded else m
        inputs = np.flatnonzero(np.tile(np.isfinite(limits.u_min) | np.isfinite(limits.u_max), n_c))
        inputs = inputs[inputs >= skipped]
        # theta d - rho_i e <= y_max - free and theta d + rho_i e >= y_min - free, e that output's violation.
        predicted = np.arange(l, len(self.theta))
        self.above = predicted[np.isfinite(limits.y_max)[predicted % l]]
        self.below = predicted[np.isfinite(limits.y_min)[predicted % l]]
        self._above_outputs = np.flatnonzero(np.isfinite(limits.y_max))
        self._below_outputs = np.flatnonzero(np.isfinite(limits.y_min))
        tracking = np.abs(np.diag(problem.output_weight))
        weight = np.maximum(tracking, move_cost)
        self.violation_scale = np.sqrt(np.where(weight > 0, weight, 1.0))
        # Row 0 is y_0, which nothing can limit.
        fading = fade(problem.prediction_horizon)
        self._fading_above, self._fading_below = fading[self.above // l], fading[self.below // l]
        violation = np.zeros((l, v))
        violation[limited] = np.diag(1 / self.violation_scale[limited])
        A = np.block(
            [
                [np.zeros((len(inputs), v)), self.cumulate[inputs]],
                [-violation[self.above % l] * fading[self.above // l, None], self.theta[self.above]],
                [violation[self.below % l] * fading[self.below // l, None], self.theta[self.below]],
            ]
        )
        H = np.block(
            [[problem.output_limit_weight * np.eye(v), np.zeros((v, n))], [np.zeros((n, v)), self.H]]
        )
        self.program = QuadraticProgram(H, A, n_simple)
        self.bounded_rows = np.vstack([np.eye(n_simple - v, n), A[:, v:]])
        self.move_of_bound = np.full(n_simple + len(A), -1)  # the move that makes an input row new, else -1
        self.input_rows = slice(n_simple, n_simple + len(inputs))
        self.move_of_bound[self.input_rows] = inputs
        self.above_rows = n_simple + len(inputs) + np.arange(len(self.above))
        self.below_rows = self.above_rows.size + n_simple + len(inputs) + np.arange(len(self.below))

        lower, one = np.zeros((n_simple + len(A), free.shape[1])), self._one_at
        lower[:, one] = -UNBOUNDED
        upper = -lower
        lower[:v, one] = 0.0
        u_min, u_max = np.maximum(limits.u_min, -UNBOUNDED), np.minimum(limits.u_max, UNBOUNDED)
        if self.moves_bounded:
            upper[v:n_simple, one] = np.tile(np.minimum(limits.du_max, UNBOUNDED), n_c)
            lower[v:n_simple, one] = -upper[v:n_simple, one]
        else:
            lower[v:n_simple], upper[v:n_simple] = -u_previous, -u_previous
            lower[v:n_simple, one], upper[v:n_simple, one] = u_min, u_max
        rows = self.input_rows
        lower[rows], upper[rows] = -u_previous[inputs % m], -u_previous[inputs % m]
        lower[rows, one], upper[rows, one] = u_min[inputs % m], u_max[inputs % m]
        upper[self.above_rows] = -free[self.above]
        upper[self.above_rows, one] += limits.y_max[self.above % l]
        lower[self.below_rows] = -free[self.below]
        lower[self.below_rows, one] += limits.y_min[self.below % l]
        return lower, upper

    def _optimum_maps(self, pattern: BoolArray) -> dict[str, Array]:
        """The optimum without limits on a pattern: its margins, moves, inputs and residual as maps of p."""
        v, affine = self.n_violations, self._affine
        bounds = (
            self.restricted(pattern).bounds[v:] if not pattern.all() else np.arange(v, self.program.n_bounds)
        )
        moves = np.zeros((self.n_moves, affine["f"].shape[1]))
        moves[pattern] = -np.linalg.solve(self.H[np.ix_(pattern, pattern)], affine["f"][v:][pattern])
        at_optimum = self.bounded_rows[bounds - v] @ moves
        return {
            "margins": np.concatenate(
                [at_optimum - affine["lower"][bounds], affine["upper"][bounds] - at_optimum]
            ),
            "moves": moves,
            "inputs": np.tile(self._u_previous_map, (self.problem.control_horizon, 1))
            + self.cumulate @ moves,
            "residual": np.concatenate([affine["error"] - self.weighted_theta @ moves, self._root_R @ moves]),
        }

    def optimum_on(self, pattern: BoolArray) -> PatternOptimum:
        """The optimum without limits where only the moves of `pattern`, shape (n_moves,), may differ from zero."""
        preview_map, parts = _stacked(**self._optimum_maps(pattern))
        return PatternOptimum(preview_map, self._with_constant_reference(preview_map), parts)

    def _with_constant_reference(self, preview_map: Array) -> Array:
        """The map for one reference (l,) that holds over the horizon."""
        reference = self._one_at + 1
        constant = (
            preview_map[:, reference:].reshape(len(preview_map), -1, self.problem.model.n_outputs).sum(axis=1)
        )
        return np.hstack([preview_map[:, :reference], constant])

    def parameter(
        self,
        x: Array,
        u_previous: Array,
        reference: Array,
        output_disturbance: Any = None,
        input_disturbance: Any = None,
        measured_disturbance: Any = None,
    ) -> Array:
        """p for one sample; the reference has shape (l,) or (np + 1, l), each disturbance may be left out."""
        if reference.ndim == 2:
            reference = reference.ravel()
        if output_disturbance is None and input_disturbance is None and measured_disturbance is None:
            return np.concatenate((x, u_previous, self._undisturbed, reference))
        d_u, d_y, v, one = self._undisturbed_parts
        if input_disturbance is not None:
            d_u = as_shaped("input_disturbance", input_disturbance, d_u.shape)
        if output_disturbance is not None:
            d_y = as_shaped("output_disturbance", output_disturbance, d_y.shape)
        if measured_disturbance is not None:
            v = as_shaped("measured_disturbance", measured_disturbance, v.shape)
        return np.concatenate((x, u_previous, d_u, d_y, v, one, reference))

    def sample(self, parameter: Array, u_previous: Array, frozen: Indices | None = None) -> Sample:
        """The data of one sample, from its `parameter`; `frozen` as in `Sample`."""
        maps = self._constant_map if len(parameter) == self._constant_map.shape[1] else self._preview_map
        return Sample(maps.dot(parameter), self.parts, parameter, u_previous, frozen)

    def cost(self, sample: Sample, moves: Array) -> float:
        """Tracking cost plus move weights plus output-limit penalty of the moves d, shape (n_moves,)."""
        residual = sample.error - self.weighted_theta @ moves
        cost = residual @ residual + moves @ self.R @ moves
        if self.n_violations:
            scaled = self.violation_scale * self.violations(sample, moves, faded=True)
            cost += self.problem.output_limit_weight * (scaled.sum() + 0.5 * (scaled @ scaled))
        return float(cost)

    def violations(self, sample: Sample, moves: Array, *, faded: bool = False) -> Array:
        """Largest predicted excess over its limits of each output over i = 1..np, shape (l,).

        `faded`: the e of `TrackingProblem`, for which later excess counts more.
        """
        l = self.problem.model.n_outputs
        excess = np.zeros(l)
        above = self.theta[self.above] @ moves - sample.upper[self.above_rows]
        below = sample.lower[self.below_rows] - self.theta[self.below] @ moves
        if faded:
            above, below = above / self._fading_above, below / self._fading_below
        # Rows come sample by sample, each with the same outputs.
        for over, outputs in ((above, self._above_outputs), (below, self._below_outputs)):
            if len(over):
                largest = over.reshape(-1, len(outputs)).max(axis=0)
                excess[outputs] = np.maximum(excess[outputs], largest)
        return excess

    def relaxed_limits(self, sample: Sample, multipliers: Array) -> tuple[Array, float]:
        """The program with its limits priced by multipliers instead of kept (Lagrangian relaxation).

        Args:
            multipliers: of the bounds, shape (n_bounds,), positive at upper bounds.

        Returns:
            Linear term g, shape (n_moves,), and constant c: no moves that keep the limits cost less than
            c + min 1/2 d' H d + g' d, on any pattern.
        """
        v, n_simple = self.n_violations, self.program.n_simple
        g = sample.f + multipliers[n_simple:].dot(self.program.A)
        g[:n_simple] += multipliers[:n_simple]
        constant = (
            sample.constant
            - np.maximum(multipliers, 0.0).dot(sample.upper)
            - np.minimum(multipliers, 0.0).dot(sample.lower)
        )
        if v:
            constant -= 0.5 * g[:v].dot(g[:v]) / self.problem.output_limit_weight
        return g[v:], float(constant)

    def restricted(self, pattern: BoolArray) -> Restriction:
        """The program on the moves where `pattern`, shape (n_moves,), is true; the others are zero.

        Input rows at samples where that input does not move repeat earlier ones and are left out.
        """
        v, full = self.n_violations, self.program
        kept = np.concatenate([np.ones(v, dtype=bool), pattern])
        columns = np.flatnonzero(kept)
        move = self.move_of_bound
        bound_kept = np.where(move < 0, True, pattern[np.maximum(move, 0)])
        bound_kept[: full.n_simple] = kept[: full.n_simple]
        bounds = np.flatnonzero(bound_kept)
        n_simple = int(kept[: full.n_simple].sum())
        rows = bounds[n_simple:] - full.n_simple
        program = QuadraticProgram(full.H[np.ix_(columns, columns)], full.A[np.ix_(rows, columns)], n_simple)
        return Restriction(program, columns, bounds)

    def closed_loop_poles(self) -> ComplexArray:
        """Poles, shape (n + m,), of model and unlimited receding-horizon law, state (x, u_prev)."""
        model = self.problem.model
        n, m = model.n_states, model.n_inputs
        feedback = self._preview_map[self.parts.moves][:m, : n + m]
        B = model.B[:, :m]
        open_loop = np.block([[model.A, B], [np.zeros((m, n)), np.eye(m)]])
        return np.linalg.eigvals(open_loop + np.vstack([B, np.eye(m)]) @ feedback).astype(complex)


def _stacked(**maps: Array) -> tuple[Array, Parts]:
    """The affine maps in one matrix, and where each stands in it; f_moves is the end of f."""
    at, start = {}, 0
    for name, rows in maps.items():
        if name == "f_moves":
            at[name] = slice(start - len(rows), start)
            continue
        at[name] = slice(start, start + len(rows))
        start += len(rows)
    together = np.vstack([rows for name, rows in maps.items() if name != "f_moves"])
    return np.ascontiguousarray(together), Parts(**at)


def _least_move_cost(problem: TrackingProblem, powers: Array, step: Array) -> Array:
    """Per output the weight of the cheapest move that shifts it by one unit within the horizon, shape (l,).

    Args:
        powers: A^0 .. A^np, shape (np + 1, n, n).
        step: S_0 .. S_np, shape (np + 1, l, m), or more columns after the inputs'.
    """
    model, m = problem.model, problem.model.n_inputs
    reach = np.abs(step[:, :, :m]).max(axis=0)
    states = np.abs(np.cumsum(powers[:-1] @ model.B[:, :m], axis=0)).max(axis=0)
    reached = reach > 1e-12 * (np.abs(model.C) @ states + np.abs(model.D[:, :m]))  # else it is rounding
    cost = np.abs(np.diag(problem.move_weight)) / np.where(reached, reach, 1.0) ** 2
    least: Array = np.where(reached, cost, np.inf).min(axis=1)
    return np.where(np.isfinite(least), least, 0.0)


def fade(n_p: int) -> Array:
    """rho_i of `TrackingProblem` for i = 0..np, shape (np + 1,)."""
    return np.interp(np.arange(n_p + 1), [1, max(n_p, 2)], [1.0, FADED])
