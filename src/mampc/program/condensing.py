"""Condensing: the tracking problem as a dense quadratic program in the moves d = (du_0, ..., du_{nc-1}).

With the predicted outputs free + theta d (see `prediction`) and error = Q^(1/2) (r - y_op - free)

    cost = |error - Q^(1/2) theta d|^2 + |R^(1/2) d|^2 = |W d - (error, 0)|^2,    W = [Q^(1/2) theta; R^(1/2)]

and W = Qo U, U upper triangular, this is a least-squares problem of no more rows than moves:

    cost = |U d - target|^2 + cost of the free optimum,    target = Qo' (error, 0),    d_free = U^-1 target.

Both parts are sums of squares, so that nothing cancels, and U is as well conditioned as the problem; the Hessian
H = 2 U' U has its condition squared.

Everything that changes from sample to sample (target, bounds, and the optimum as long as no limit is active) is
affine in the `parameter` p: one matrix-vector product. Where outputs are limited, one violation per limited output,
scaled as in `TrackingProblem`, stands before the moves: z = (violations, d).

On a move pattern S (all other moves zero) the optimum without limits is affine as well, by a QR of U's columns S.
"""

from __future__ import annotations

import warnings
from functools import cached_property
from typing import Any

import numpy as np

from mampc.base.checks import Array, BoolArray, ComplexArray
from mampc.base.errors import MampcError, MampcWarning
from mampc.base.tolerances import prefix, size_of_move
from mampc.program.bounds import Bounds
from mampc.program.input_cost import distance_from_targets, price_of_inputs
from mampc.program.least_distance import ROUNDING, Nearest
from mampc.program.parameter import Parameter
from mampc.program.prediction import Prediction
from mampc.program.problem import TrackingProblem
from mampc.program.qp import QuadraticProgram
from mampc.program.restriction import Restriction
from mampc.program.sample import Indices, LeastSquares, Parts, PatternOptimum, Sample
from mampc.program.tail import square_root, tail

ILL_CONDITIONED = 1e6  # condition, or growth of predictions, from which on a proof has to look at rounding
SINGULAR = 1e13  # condition of U, of unit columns, from which on rounding determines some move


class CondensedQP:
    """The condensed form of a `TrackingProblem`; the module's docstring defines the symbols.

    Attributes:
        n_moves: nc * m; moves are time-major.
        U: upper triangular, shape (n_moves, n_moves).
        H: 2 U' U, the Hessian in the moves; where outputs have zones as if these were set points.
        R: weights of the moves, shape (n_moves, n_moves).
        plain: the problem with every move free, which is plain MPC; whoever solves it shares its solver.
        lengths: of U's columns, shape (n_moves,).
        condition: of U with columns of length 1, so that units do not count.
        input_prefix: power of a thousand in which each input is a number of ordinary size, shape (m,).
        move_prefix: the same for every move, shape (n_moves,).
        move_size: of a move that matters, the same for all of an input, shape (n_moves,).
        growth: how many times larger the outputs that a state predicts become than they are at first.
        ill_conditioned: whether rounding may decide; a `MampcWarning` says so when the problem is made.
        parameter: where each quantity stands in p.
        bounds: which quantities are bounded, and between what.
        theta: predicted outputs per move, shape ((np + 1) l, n_moves).
        cumulate: u_j - u_prev per move, shape (n_moves, n_moves).
        weighted_theta: Q^(1/2) theta, and below it the rows of the weighted tail and of targets for inputs, shape
            (n_errors, n_moves).
        error_of_reference: what a constant reference adds to the error, shape (n_errors, l).
        map_bytes: about the memory that an `optimum_on` some pattern takes.

    Args:
        problem: what to condense.
        bound_every_move: give every move a simple bound, though du_max may be infinite.
        time_limit: seconds that one program may take; None for no limit.

    Raises:
        MampcError: the moves are not all determined by the weights (H is singular), or an unstable
            model's predictions overflow.
    """

    def __init__(
        self, problem: TrackingProblem, *, bound_every_move: bool = False, time_limit: float | None = None
    ) -> None:
        self.problem, self._time_limit = problem, time_limit
        self._limit_weights = problem.output_limit_weights
        n_c, m = problem.control_horizon, problem.model.n_inputs
        n = self.n_moves = n_c * m
        self.cumulate = np.kron(np.tri(n_c), np.eye(m))
        self.parameter = parameter = Parameter(problem)
        prediction = Prediction(problem, parameter)
        self.theta = prediction.theta
        self.bounds = Bounds(problem, prediction, parameter, every_move=bound_every_move)
        self.n_violations = v = self.bounds.n_violations

        single = ~problem.zoned
        root = np.kron(np.eye(problem.prediction_horizon + 1), square_root(problem.set_point_weight)[single])
        self._error = -(root @ prediction.free)
        self._error[:, parameter.references] = root
        self.weighted_theta = root @ prediction.theta
        if problem.tail_horizon > 0 and single.any():
            tail_error, tail_theta = tail(problem, prediction, parameter)
            self._error = np.vstack([self._error, tail_error])
            self.weighted_theta = np.vstack([self.weighted_theta, tail_theta])
        if problem.u_target is not None:
            from_targets, per_move = distance_from_targets(problem, parameter)
            self._error = np.vstack([self._error, from_targets])
            self.weighted_theta = np.vstack([self.weighted_theta, per_move])
        self.R = np.kron(np.eye(n_c), problem.move_weight)
        if not problem.weigh_first_move:
            self.R[:m, :m] = 0.0
        self._triangularise()
        zones = self.bounds.zones
        of_zones = np.zeros((0, n)) if zones is None else zones.root[:, None] * zones.theta
        self.H = self._H + 2 * of_zones.T @ of_zones
        width = problem.limits.u_max - problem.limits.u_min
        matters = size_of_move(0.5 * np.diag(self.H)[:m], width)
        self.move_size = np.tile(matters, n_c)
        self.input_prefix = prefix(matters)
        self.move_prefix = np.tile(self.input_prefix, n_c)
        self.growth = self._growth(problem.model.n_states, problem.model.n_outputs)
        self.ill_conditioned = max(self.condition, self.growth) > ILL_CONDITIONED
        if self.ill_conditioned:
            warnings.warn(
                f"TrackingProblem: predictions over {problem.prediction_horizon} samples have a condition of "
                f"{self.condition:.0e} and grow {self.growth:.0e} times, which enlarges rounding as much; decisions "
                "say what that leaves open in their gap. Shorten the prediction horizon, give moves a larger weight, "
                "or predict with a model that is stabilised",
                MampcWarning,
                stacklevel=3,
            )

        f = parameter.no_map(v + n)
        f[:v, parameter.one] = self.bounds.violation_cost.linear[:, None]
        f[v:] = -2 * self.U.T @ self._target
        self._u_previous = parameter.no_map(n)
        self._u_previous[:, parameter.u_previous] = np.tile(np.eye(m), (n_c, 1))
        self.plain = self.restricted(np.ones(n, dtype=bool))
        self._preview_map, self.parts = _stacked(
            **self._optimum_maps(self.plain), target=self._target, f=f, f_moves=f[v:],
            lower=self.bounds.lower, upper=self.bounds.upper,
        )  # fmt: skip
        self._constant_map = parameter.with_constant_reference(self._preview_map)
        self.map_bytes = self._preview_map.nbytes
        errors = self._error if zones is None else np.vstack([self._error, zones.weighted_free])
        self._error_lengths = {
            of_error.shape[1]: np.linalg.norm(of_error, axis=0)
            for of_error in (errors, parameter.with_constant_reference(errors))
        }
        for lengths in self._error_lengths.values():
            lengths[parameter.one] += self._shift
        of_constant = parameter.with_constant_reference(self._error)[:, parameter.one.stop :]
        self.error_of_reference = of_constant[:, : problem.model.n_outputs]

    def _triangularise(self) -> None:
        """U, the target, and rows whose squares sum up to the cost of the free optimum, the last two as maps of p."""
        W = np.vstack([self.weighted_theta, square_root(self.R)])
        error = np.vstack([self._error, self.parameter.no_map(self.n_moves)])
        Q, self.U = np.linalg.qr(W)
        self.lengths = np.linalg.norm(self.U, axis=0)
        self.condition = float(np.linalg.cond(self.U / np.where(self.lengths > 0, self.lengths, 1.0)))
        if not self.condition < SINGULAR:
            raise MampcError(
                "CondensedQP: expected a positive definite Hessian, so that weights and outputs determine every move, "
                f"received a condition of {self.condition:.1e} squared; give every move a weight"
            )
        self._H = 2 * (self.U.T @ self.U)
        self._target = Q.T @ error
        rest = error - Q @ self._target
        lost = Q.T @ rest  # what rounding left in the range of W
        self._target += lost
        self._free_residual: Array = np.asarray(np.linalg.qr(rest - Q @ lost, mode="r"))
        self._price: Array | None = None
        self._shift = 0.0
        if self.problem.u_cost.any():
            self._price_inputs()

    def _price_inputs(self) -> None:
        """A linear cost g'd + held: a shift D of the target, and what this costs beside squares, which is affine in p.

        |U d - t|^2 + g'd + held = |U d - t - D|^2 - 2 D't - |D|^2 + held,    D = -1/2 U^-T g
        """
        per_move, held = price_of_inputs(self.problem, self.parameter)
        D, one = -0.5 * np.linalg.solve(self.U.T, per_move), self.parameter.one.start
        held = held - 2 * (D @ self._target)
        held[one] -= D @ D
        self._target[:, one] += D
        self._price, self._shift = held[None], float(np.linalg.norm(D))

    def _growth(self, n: int, l: int) -> float:
        """How many times larger the outputs that a state predicts become than over the first n + 1 samples."""
        zones, zoned = self.bounds.zones, int(self.problem.zoned.sum())
        parts = [(self._error, l - zoned)] + ([] if zones is None else [(zones.weighted_free, zoned)])
        most = 1.0
        for errors, width in parts:
            of_state = errors[:, self.parameter.x]
            samples = of_state[: (n + 1) * width], of_state
            first, all_of_them = (np.linalg.norm(rows, axis=0) for rows in samples)
            most = float(np.max(all_of_them[first > 0] / first[first > 0], initial=most))
        return most

    def _optimum_maps(self, restriction: Restriction) -> dict[str, Array]:
        """The optimum without limits on a pattern: its margins, moves, inputs and residual as maps of p."""
        moves, kept = self.parameter.no_map(self.n_moves), restriction.bounds[self.n_violations :]
        chosen = moves[restriction.moves] = restriction.optimum(self._target)
        at_optimum, lower, upper = restriction.rows @ chosen, self.bounds.lower[kept], self.bounds.upper[kept]
        price = {} if self._price is None else {"price": self._price}
        return price | {
            "margins": np.concatenate([at_optimum - lower, upper - at_optimum]),
            "moves": moves,
            "inputs": self._u_previous + self.cumulate @ moves,
            "residual": np.vstack([self._free_residual, restriction.missed @ self._target]),
        }

    def optimum_on(self, pattern: BoolArray) -> PatternOptimum:
        """The optimum without limits where only the moves of `pattern`, shape (n_moves,), may differ from zero."""
        preview_map, parts = _stacked(**self._optimum_maps(self.restricted(pattern)))
        return PatternOptimum(preview_map, self.parameter.with_constant_reference(preview_map), parts)

    def sample(self, parameter: Array, u_previous: Array, frozen: Indices | None = None) -> Sample:
        """The data of one sample, from its p; `frozen` as in `Sample`."""
        maps = self._constant_map if len(parameter) == self._constant_map.shape[1] else self._preview_map
        data = maps.dot(parameter)
        if self.bounds.zones is not None:  # a zone of width zero has one end, whatever rounding says
            lower, upper = data[self.parts.lower], data[self.parts.upper]
            rows = self.bounds.zone_rows
            upper[rows] = np.maximum(lower[rows], upper[rows])
        return Sample(data, self.parts, parameter, u_previous, frozen)

    @property
    def target_map(self) -> Array:
        """The target as a map of p, shape (n_moves, size of p)."""
        return self._target

    def cost(self, sample: Sample, moves: Array) -> float:
        """Tracking cost plus move weights plus output-limit penalty of the moves d, shape (n_moves,)."""
        missed = self.U.dot(moves) - sample.target
        cost = sample.cost + missed.dot(missed)
        if self.n_violations:
            scaled = self.bounds.violation_scale * self.violations(sample, moves, faded=True)
            cost += (scaled + 0.5 * scaled * scaled).dot(self._limit_weights)
            if self.bounds.zones is not None:
                errors = self.bounds.zone_errors(moves, sample.lower, sample.upper)
                cost += errors.dot(errors)
        return float(cost)

    def rounding(self, sample: Sample, moves: Array | None = None) -> float:
        """How far rounding may shift the vector whose squared length is the cost of a plan, in roots of cost.

        What moves, shape (n_moves,), add to errors beside zones counts where they are given.
        """
        added = self._error_lengths[len(sample.parameter)].dot(np.abs(sample.parameter))
        added += self.lengths.dot(np.abs(sample.moves))
        if moves is not None and self.bounds.zones is not None:
            added += self.bounds.zones.lengths.dot(np.abs(moves))
        return ROUNDING * float(added)

    def violations(self, sample: Sample, moves: Array, *, faded: bool = False) -> Array:
        """Largest predicted excess over its limits of each output over i = 1..np, shape (l,).

        `faded`: the e of `TrackingProblem`, for which later excess counts more.
        """
        return self.bounds.excess(moves, sample.lower, sample.upper, faded=faded)

    def nearest(self, sample: Sample, active: Array | None = None) -> Nearest:
        """The best moves within limits with every move free.

        `active`: bounds to start from, flags of `DaqpSolver.start`, shape (n_bounds,).
        """
        return self.plain.program.solve_at(sample.moves, self._distances(sample), sample.both_bounds, active)

    def _distances(self, sample: Sample) -> Array:
        if sample.distances is None:
            sample.distances = self.plain.program.distances(sample.moves, sample.both_bounds)
        return sample.distances

    def priced(self, sample: Sample, multipliers: Array) -> LeastSquares:
        """The problem with its limits priced by multipliers instead of kept (Lagrangian relaxation).

        Args:
            multipliers: of the bounds, shape (n_bounds,), positive at upper bounds.

        Returns:
            A least-squares problem in the moves: on any pattern, no moves that keep the limits cost less than its
            optimum there.
        """
        program = self.plain.program
        delta, excess = program.relaxed(self._distances(sample), multipliers)
        return LeastSquares(sample.target + delta, sample.cost + float(excess))

    def relaxed_limits(self, sample: Sample, multipliers: Array) -> tuple[Array, float]:
        """The same as `linear` gives it, for heuristics: c + f' d + 1/2 d' H d.

        Zones have become set points, the ones nearest to the outputs that the multipliers belong to.
        """
        priced, zones = self.priced(sample, multipliers), self.bounds.zones
        if zones is None:
            return self.linear(priced)
        values, rows = zones.theta.dot(self.plain.optimum(priced.target)), self.bounds.zone_rows
        nearest = zones.root * np.minimum(np.maximum(values, sample.lower[rows]), sample.upper[rows])
        others = multipliers.copy()
        others[rows] = 0.0
        f, constant = self.linear(self.priced(sample, others))
        return f - 2 * (zones.root * nearest) @ zones.theta, constant + float(nearest.dot(nearest))

    def linear(self, cost: LeastSquares) -> tuple[Array, float]:
        """A cost as linear term f, shape (n_moves,), and constant c, of c + f' d + 1/2 d' H d."""
        return -2 * self.U.T.dot(cost.target), cost.least + float(cost.target.dot(cost.target))

    def restricted(self, pattern: BoolArray) -> Restriction:
        """The problem on the moves where `pattern`, shape (n_moves,), is true."""
        return Restriction(self.U, self.bounds, pattern, self._time_limit)

    @cached_property
    def program(self) -> QuadraticProgram:
        """The `QuadraticProgram` in z = (violations, d), for methods that change its Hessian.

        Raises:
            MampcError: a Hessian that is not positive definite to working precision, though U has full rank.
        """
        v = self.n_violations
        full = np.zeros((v + self.n_moves, v + self.n_moves))
        full[:v, :v], full[v:, v:] = np.diag(self.bounds.violation_cost.curvature), self._H
        return QuadraticProgram(full, self.bounds.rows, self.bounds.n_simple)

    def closed_loop_poles(self) -> ComplexArray:
        """Poles, shape (n + m,), of model and unlimited receding-horizon law, state (x, u_prev)."""
        model = self.problem.model
        n, m = model.n_states, model.n_inputs
        feedback = self._preview_map[self.parts.moves][:m]
        of_state = np.hstack([feedback[:, self.parameter.x], feedback[:, self.parameter.u_deviation]])
        B = model.B[:, :m]
        open_loop = np.block([[model.A, B], [np.zeros((m, n)), np.eye(m)]])
        return np.linalg.eigvals(open_loop + np.vstack([B, np.eye(m)]) @ of_state).astype(complex)


def _stacked(**maps: Array) -> tuple[Array, Parts]:
    """The affine maps in one matrix, and where each stands in it; f_moves is the end of f."""
    at: dict[str, Any] = {}
    start = 0
    for name, rows in maps.items():
        if name == "f_moves":
            at[name] = slice(start - len(rows), start)
            continue
        if name == "price":
            at[name] = start
            start += 1
            continue
        at[name] = slice(start, start + len(rows))
        start += len(rows)
    together = np.vstack([rows for name, rows in maps.items() if name != "f_moves"])
    return np.ascontiguousarray(together), Parts(**at)
