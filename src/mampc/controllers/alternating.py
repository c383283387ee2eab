"""The paper's method: alternate a quadratic program with a hard threshold (Algorithm 1, problem P1).

Symbols: d are the future moves, psi the past and future moves (the paper's Psi u), v a copy of psi with
at most s entries, mu the penalty that ties them:

    first step     d <- argmin J(d) + mu |v_future - d|^2     within the limits
    second step    v <- the s entries of psi largest in magnitude, zero elsewhere

until |u_{i+1} - u_i|_1 <= eps1. Past entries are fixed and compete in the second step. At a fixed point
v = d on the pattern and v = 0 off it, so d is the MPC solution with move weight lambda on the pattern and
lambda + mu off it: moves off the pattern shrink and never vanish. `polish` makes them vanish.

Where other rules than a budget hold, the second step is the same minimisation under them: v is zero off the
admissible pattern of largest mu |d|^2 less price.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mampc.arrays import Array, BoolArray, as_flag, as_number, as_whole
from mampc.condensing import CondensedQP
from mampc.controllers.controller import HELD_BY, Plan
from mampc.controllers.decision import ControllerState, Status
from mampc.controllers.heuristic import Heuristic, HeuristicSearch
from mampc.controllers.pattern_solver import Incumbent
from mampc.instance import Instance
from mampc.patterns import MoveRules, Past
from mampc.qp import QPStatus, QuadraticProgram
from mampc.qp_daqp import DaqpSolver


@dataclass(frozen=True, kw_only=True)
class Alternating(Heuristic):
    """Settings of the alternating minimisation.

    Args:
        penalty: mu > 0, cost per squared move off the pattern.
        tolerance: eps1 > 0; stop when the plan changes by no more, sum of |u| in engineering units.
        max_iterations: rounds of both steps at most.
        polish: solve once more on the chosen pattern, with all other moves exactly zero and the rules
            strictly kept. Implied by `certify`, since a proof is about plans that keep the rules.
        warm_up: samples of plain MPC at the start; default the sparsity horizon.
        certify: see `Heuristic`.
    """

    penalty: float = 10.0
    tolerance: float = 1e-4
    max_iterations: int = 500
    polish: bool = False
    warm_up: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        as_flag("polish", self.polish)
        as_number("penalty", self.penalty, 0.0, exclusive=True)
        as_number("tolerance", self.tolerance, 0.0, exclusive=True)
        as_whole("max_iterations", self.max_iterations, 1)
        if self.warm_up is not None:
            as_whole("warm_up", self.warm_up, 0)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> AlternatingSearch:
        """The search for one problem and one set of rules."""
        return AlternatingSearch(self, condensed, rules)


class AlternatingSearch(HeuristicSearch):
    """The alternating minimisation, prepared for one condensed problem."""

    def __init__(self, settings: Alternating, condensed: CondensedQP, rules: MoveRules) -> None:
        super().__init__(settings, condensed, rules)
        self.settings, self._polish = settings, settings.polish or settings.certify
        self.warm_up = rules.sparsity_horizon if settings.warm_up is None else settings.warm_up
        self._first_step = FirstStep(condensed, settings.penalty)
        self._threshold = None
        if self.admissible.simple and rules.max_moves is not None and not self.admissible.priced:
            m = self.admissible.n_inputs
            self._threshold = HardThreshold(rules.max_moves, rules.sparsity_horizon, m, condensed.n_moves)

    def plan(self, instance: Instance, state: ControllerState) -> Plan:
        """Algorithm 1 for one sample, from the guess that the last sample left (at first: v = 0)."""
        past = self.admissible.past(state.inputs, instance.rest)
        v = np.zeros(self.condensed.n_moves) if state.guess is None else state.guess.ravel()
        choose = self._second_step(state, past)
        settled = alternate(
            self._first_step, instance, v, choose, self.settings.tolerance, self.settings.max_iterations
        )
        if settled.status is QPStatus.ITERATION_LIMIT:
            status = Status.ITERATION_LIMIT
        elif settled.status is not QPStatus.OPTIMAL:
            return Plan(None, HELD_BY[settled.status], settled.rounds)
        else:
            status = Status.FEASIBLE if self._polish else Status.SETTLED
        guess = self._shifted(settled.v)
        if not self._polish and instance.rest is None:  # at rest, not even a small move
            return Plan(settled.d, status, settled.rounds, guess=guess, remarks=self._remarks(past))
        pattern = settled.v != 0.0
        if not self.admissible.allows(pattern, past):  # past moves compete above; here they are gone for good
            pattern = self.admissible.select(
                np.where(pattern, np.abs(settled.d) + self.admissible.price.max(), 0.0), past
            )
        best = Incumbent()
        self._solver.offer(instance, pattern, best)
        return self._certified(
            self._best(instance, best, past, settled.rounds, guess, status), instance, state
        )

    def _second_step(self, state: ControllerState, past: Past) -> Callable[[Array], BoolArray]:
        """What picks the pattern: the paper's threshold for a budget, its extension for other rules."""
        threshold, mu = self._threshold, self.settings.penalty
        if threshold is None:
            return lambda d: self.admissible.select(mu * d * d, past)
        magnitude = threshold.magnitude(self.rules.past_changes(state.inputs))
        return lambda d: threshold.pattern(magnitude, d)


class Settled(NamedTuple):
    """How an alternation ended: moves d, their copy v on the pattern, rounds.

    The status is ITERATION_LIMIT where it had to stop, and the solver's where the first step failed.
    """

    d: Array
    v: Array
    rounds: int
    status: QPStatus


def alternate(
    first_step: FirstStep,
    instance: Instance,
    v: Array,
    choose: Callable[[Array], BoolArray],
    tolerance: float,
    most: int,
) -> Settled:
    """Both steps by turns from v, until the planned inputs change by no more than the tolerance in sum."""
    sample, u_last, d = first_step.begin(instance), None, v
    for rounds in range(1, most + 1):
        d, u, solved = first_step.minimise(sample, v)
        if solved is not QPStatus.OPTIMAL:
            return Settled(d, v, rounds, solved)
        v = d * choose(d)
        if u_last is not None and np.abs(u - u_last).sum() <= tolerance:
            return Settled(d, v, rounds, QPStatus.OPTIMAL)
        u_last = u
    return Settled(d, v, most, QPStatus.ITERATION_LIMIT)


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
        self._solver.start()
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
