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

import numpy as np

from mampc.base.checks import Array, BoolArray, as_flag, as_number, as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Status
from mampc.methods.heuristic import Ended, Heuristic, HeuristicSearch, proposing
from mampc.methods.method import Plan
from mampc.methods.splitting import FirstStep, alternate
from mampc.moves.admissible import Allowance
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample


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
        if rules.levels is not None:
            if not self._polish or settings.warm_up:
                raise MampcError(
                    "alternating: expected polish=True and no warm_up with levels, which plain MPC and small moves "
                    f"do not keep, received polish={settings.polish} and warm_up={settings.warm_up}"
                )
            self.warm_up = 0
        self._first_step = FirstStep(condensed, settings.penalty)
        self._threshold = None
        if self.admissible.simple and rules.max_moves is not None and not self.admissible.priced:
            m = self.admissible.n_inputs
            self._threshold = HardThreshold(rules.max_moves, rules.sparsity_horizon, m, condensed.n_moves)

    def plan(self, sample: Sample, inputs: Array, guess: Array | None) -> Plan:
        """Algorithm 1 for one sample, from the guess that the last sample left (at first: v = 0)."""
        allowance = self.admissible.allowance(inputs, sample.frozen)
        v = np.zeros(self.condensed.n_moves) if guess is None else guess.ravel()
        choose = self._second_step(inputs, allowance)
        settled = alternate(
            self._first_step, sample, v, choose, self.settings.tolerance, self.settings.max_iterations
        )
        status = Status.FEASIBLE if self._polish else Status.SETTLED
        if settled.status is QPStatus.ITERATION_LIMIT:
            status = Status.ITERATION_LIMIT
        elif settled.status is not QPStatus.OPTIMAL:
            failed = proposing([], Ended(settled.rounds, failure=settled.status))
            return self._best_of(failed, sample, inputs, allowance)
        if not self._polish and sample.frozen is None:  # a frozen input makes not even a small move
            return Plan(
                settled.d,
                status,
                settled.rounds,
                guess=self._shifted(settled.v),
                remarks=self._remarks(allowance),
            )
        pattern = settled.v != 0.0
        if not self.admissible.allows(pattern, allowance):  # past moves compete above, and are done
            pattern = self.admissible.select(
                np.where(pattern, np.abs(settled.d) + self.admissible.price.max(), 0.0), allowance
            )
        proposals = proposing([pattern], Ended(settled.rounds, settled.v))
        return self._best_of(proposals, sample, inputs, allowance, status)

    def _second_step(self, inputs: Array, allowance: Allowance) -> Callable[[Array], BoolArray]:
        """What picks the pattern: the paper's threshold for a budget, its extension for other rules."""
        threshold, mu = self._threshold, self.settings.penalty
        if threshold is None:
            return lambda d: self.admissible.select(mu * d * d, allowance)
        magnitude = threshold.magnitude(self.rules.past_changes(inputs))
        return lambda d: threshold.pattern(magnitude, d)


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
