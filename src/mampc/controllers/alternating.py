"""The paper's method: alternate a quadratic program with a hard threshold (Algorithm 1, problem P1).

Symbols: d are the future moves, psi the past and future moves (the paper's Psi u), v a copy of psi with
at most s entries, mu the penalty that ties them:

    first step     d <- argmin J(d) + mu |v_future - d|^2     within the limits
    second step    v <- the s entries of psi largest in magnitude, zero elsewhere

until |u_{i+1} - u_i|_1 <= eps1. Past entries are fixed and compete in the second step. At a fixed point
v = d on the pattern and v = 0 off it, so d is the MPC solution with move weight lambda on the pattern and
lambda + mu off it: moves off the pattern shrink and never vanish. `polish` makes them vanish.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mampc.arrays import Array, BoolArray, as_number, as_whole
from mampc.condensing import CondensedQP, Instance
from mampc.controllers.controller import HELD_BY, Plan
from mampc.controllers.decision import ControllerState, Status
from mampc.controllers.pattern_solver import PatternSolver
from mampc.errors import MampcError
from mampc.patterns import MoveRules
from mampc.qp import QPSolution, QPStatus, QuadraticProgram
from mampc.qp_daqp import DaqpSolver

HIGHEST_PENALTY = 1e10  # a growing mu stops here: beyond it the first step loses its digits


@dataclass(frozen=True, kw_only=True)
class Alternating:
    """Settings of the alternating minimisation.

    Args:
        penalty: mu > 0, cost per squared move off the pattern.
        tolerance: eps1 > 0; stop when the plan changes by no more, sum of |u| in engineering units.
        max_iterations: rounds of both steps at most.
        polish: solve once more on the chosen pattern, with all other moves exactly zero and the budget
            left after the past moves strictly kept.
        penalty_growth: >= 1; when above 1, mu is multiplied by it each time the rounds have settled,
            until no move off the pattern exceeds the tolerance.
        warm_up: samples of plain MPC at the start; default the sparsity horizon.
    """

    penalty: float = 10.0
    tolerance: float = 1e-4
    max_iterations: int = 500
    polish: bool = False
    penalty_growth: float = 1.0
    warm_up: int | None = None

    def __post_init__(self) -> None:
        as_number("penalty", self.penalty, 0.0, exclusive=True)
        as_number("tolerance", self.tolerance, 0.0, exclusive=True)
        as_whole("max_iterations", self.max_iterations, 1)
        as_number("penalty_growth", self.penalty_growth, 1.0)
        if self.warm_up is not None:
            as_whole("warm_up", self.warm_up, 0)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> AlternatingSearch:
        """The search for one problem and one set of rules."""
        return AlternatingSearch(self, condensed, rules)


class AlternatingSearch:
    """The alternating minimisation, prepared for one condensed problem."""

    def __init__(self, settings: Alternating, condensed: CondensedQP, rules: MoveRules) -> None:
        if rules.max_moves is None:
            raise MampcError("Alternating: expected MoveRules with max_moves, received none")
        self.settings, self.condensed, self.rules = settings, condensed, rules
        self.warm_up = rules.sparsity_horizon if settings.warm_up is None else settings.warm_up
        m = condensed.problem.model.n_inputs
        self._threshold = HardThreshold(rules.max_moves, rules.sparsity_horizon, m, condensed.n_moves)
        self._first_steps: dict[float, FirstStep] = {}
        self._first_step(settings.penalty)
        self._polisher = PatternSolver(condensed)

    def plan(self, instance: Instance, state: ControllerState) -> Plan:
        """Algorithm 1 for one sample, from the guess that the last sample left (at first: v = 0)."""
        settings, growth = self.settings, self.settings.penalty_growth
        threshold = self._threshold
        magnitude = threshold.magnitude(self.rules.past_changes(state.inputs))
        v: Array = np.zeros(self.condensed.n_moves) if state.guess is None else state.guess.ravel()
        first_step = self._first_step(settings.penalty)
        sample = first_step.begin(instance)
        u_last, settled, rounds = None, False, 0
        while rounds < settings.max_iterations:
            d, u, solved = first_step.minimise(sample, v)
            if solved is not QPStatus.OPTIMAL:
                return Plan(None, HELD_BY[solved], rounds)
            pattern = threshold.pattern(magnitude, d)
            v = d * pattern
            rounds += 1
            if u_last is not None and np.abs(u - u_last).sum() <= settings.tolerance:
                if (
                    growth == 1.0
                    or np.abs(d - v).max() <= settings.tolerance
                    or first_step.mu >= HIGHEST_PENALTY
                ):
                    settled = True
                    break
                first_step = self._first_step(min(first_step.mu * growth, HIGHEST_PENALTY))
                sample = first_step.begin(instance)
            u_last = u
        m = len(instance.u_previous)
        guess = np.concatenate([v[m:], np.zeros(m)]).reshape(-1, m)
        if settings.polish:
            polished = self._polished(instance, state, d, pattern)
            if polished.z is None:
                return Plan(None, HELD_BY[polished.status], rounds)
            d = polished.z
        status = (
            Status.ITERATION_LIMIT if not settled else Status.FEASIBLE if settings.polish else Status.SETTLED
        )
        return Plan(d, status, rounds, guess=guess)

    def _polished(
        self, instance: Instance, state: ControllerState, d: Array, pattern: BoolArray
    ) -> QPSolution:
        """The best moves on the pattern, cut to the budget that the applied moves leave."""
        left = self.rules.moves_left(state.inputs, len(d))
        if np.count_nonzero(pattern) > left:
            on_pattern = np.where(pattern, np.abs(d), -1.0)
            pattern = np.zeros(len(d), dtype=bool)
            pattern[np.argsort(-on_pattern, kind="stable")[:left]] = True
        return self._polisher.solve(instance, pattern)

    def _first_step(self, mu: float) -> FirstStep:
        step = self._first_steps.get(mu)
        if step is None:
            step = self._first_steps[mu] = FirstStep(self.condensed, mu)
        return step


class Sample(NamedTuple):
    """One sample's data for the first step: its minimiser at v = 0 without limits, f, all bounds."""

    start: Array
    f: Array
    lower: Array
    upper: Array
    lower_rows: Array
    upper_rows: Array


class FirstStep:
    """argmin J(d) + mu |v - d|^2 within the limits, for one mu.

    The unconstrained minimiser is affine in v, so it costs one product; the solver is called only when
    that minimiser breaks a limit.
    """

    def __init__(self, condensed: CondensedQP, mu: float) -> None:
        self.mu, self._violations = mu, condensed.n_violations
        full, v = condensed.program, condensed.n_violations
        H = full.H.copy()
        H[v:, v:] += 2 * mu * np.eye(condensed.n_moves)
        self._solver = DaqpSolver(QuadraticProgram(H, full.A, full.n_simple))
        inverse = np.linalg.inv(H[v:, v:])
        self._inverse, self._from_v = (inverse + inverse.T) / 2, 2 * mu * inverse
        self._cumulate = condensed.cumulate
        # One product gives the changes of u and every bounded quantity.
        self._rows = np.vstack([condensed.cumulate, condensed.bounded_rows])

    def begin(self, instance: Instance) -> Sample:
        """What the rounds of one sample share."""
        v = self._violations
        start = -(self._inverse @ instance.f_moves)
        return Sample(
            start, instance.f, instance.lower, instance.upper, instance.lower[v:], instance.upper[v:]
        )

    def minimise(self, sample: Sample, v: Array) -> tuple[Array, Array, QPStatus]:
        """The moves d and the changes u - u_previous they add up to, each (n_moves,), if OPTIMAL."""
        start, f, lower, upper, lower_rows, upper_rows = sample
        d: Array = start + self._from_v @ v
        rows = self._rows @ d
        n = len(d)
        bounded = rows[n:]
        if (bounded >= lower_rows).all() and (bounded <= upper_rows).all():
            return d, rows[:n], QPStatus.OPTIMAL
        f = f.copy()
        f[self._violations :] -= 2 * self.mu * v
        solution = self._solver.solve(f, lower, upper)
        if solution.z is None:
            return d, d, solution.status
        d = solution.z[self._violations :]
        return d, self._cumulate @ d, QPStatus.OPTIMAL


class HardThreshold:
    """The second step: the s largest of the past and future moves, in the order of the paper's Psi.

    Psi stacks each input's past and future moves behind one another; among equals the first counts.
    """

    def __init__(self, s: int, sparsity_horizon: int, n_inputs: int, n_moves: int) -> None:
        past, future = sparsity_horizon - 1, n_moves // n_inputs
        self._s, self._size = s, (past + future) * n_inputs
        place = np.arange(self._size).reshape(n_inputs, past + future).T  # (time, input) -> Psi
        self._past, self._future = place[:past].ravel(), place[past:].ravel()

    def magnitude(self, past_changes: Array) -> Array:
        """Minus the size of every move, the applied ones (ns - 1, m) filled in, shape (all moves,)."""
        magnitude = np.zeros(self._size)
        magnitude[self._past] = -np.abs(past_changes).ravel()
        return magnitude

    def pattern(self, magnitude: Array, d: Array) -> BoolArray:
        """Which future moves are among the s largest, shape (n_moves,); fills d into `magnitude`."""
        magnitude[self._future] = -np.abs(d)
        chosen = np.zeros(self._size, dtype=bool)
        chosen[magnitude.argsort(kind="stable")[: self._s]] = True
        pattern: BoolArray = chosen[self._future]
        return pattern
