"""One sample of the sparse problem, as the searches beyond the table see it."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import ROUNDING, tie
from mampc.methods.exact.relaxation import Multipliers, Relaxation
from mampc.methods.exact.terms import Domain, Squares, Terms
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.pattern_solver import Incumbent, PatternSolver
from mampc.program.sample import Indices, Sample

SOON = 0.1  # of the time there is: a search that ends does so within


class SampleProblem:
    """What is known of one sample, and the best plan so far.

    Attributes:
        squares, admissible: of the problem.
        sample, allowance: its data, and what the past allows.
        order: indices of the moves that some admissible pattern holds, in time; positions in it stand for moves.
        domain: what each of them may be.
        prefix: of the units of each move, see `tolerances`, shape (n,).
        relaxation: its relaxed programs.
        terms: what nodes are bounded with.
        best: the best plan so far.
        deadline: of `perf_counter`.
    """

    def __init__(
        self,
        squares: Squares,
        relaxation: Relaxation,
        admissible: AdmissiblePatterns,
        solver: PatternSolver,
        sample: Sample,
        allowance: Allowance,
        best: Incumbent,
        deadline: float,
    ) -> None:
        self.squares, self.admissible, self.order = squares, admissible, squares.order
        self.sample, self.allowance, self.best = sample, allowance, best
        self._solver, self.deadline = solver, deadline
        self._lasting_from = perf_counter() + SOON * (deadline - perf_counter())
        self.domain = Domain(squares.condensed, admissible, self.order, sample, allowance)
        self.prefix = squares.condensed.move_prefix[self.order]
        c, rest, optimum = squares.at(sample)
        self.relaxation = relaxation.at(sample, optimum, deadline)
        self.terms = Terms(admissible, self.relaxation, self.domain, c, rest)
        self._rounding = squares.condensed.rounding(sample)

    @property
    def cutoff(self) -> float:
        """What a plan has to cost less than to be better than the best so far."""
        return self.best.objective - tie(self.best.objective, self._rounding)

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return perf_counter() > self.deadline

    @property
    def lasting(self) -> bool:
        """Whether the search takes longer than those that end."""
        return perf_counter() > self._lasting_from

    def pattern(self, positions: Indices | BoolArray) -> BoolArray:
        """The pattern, shape (n_moves,), with the moves at these positions."""
        pattern = np.zeros(self.admissible.n_moves, dtype=bool)
        pattern[self.order[positions]] = True
        return pattern

    def patterns(self, made: BoolArray) -> BoolArray:
        """The patterns, shape (..., n_moves), with the moves that are made, shape (..., n)."""
        patterns = np.zeros((*made.shape[:-1], self.admissible.n_moves), dtype=bool)
        patterns[..., self.order] = made
        return patterns

    def moving(self, moves: Array) -> BoolArray:
        """The patterns, shape (..., n_moves), of moves, shape (..., n), that are more than rounding."""
        return self.patterns(np.abs(moves) > ROUNDING * self.prefix)

    def offer(self, pattern: BoolArray, within: tuple[Array, Array] | None = None) -> Multipliers | None:
        """Offer the best plan on a pattern; its multipliers, where it ran into limits.

        `within`: intervals of its moves that tell their signs.
        """
        solved = self._solver.solve(
            self.sample,
            pattern,
            self.best.objective,
            self.deadline,
            within=within,
            paid=self.admissible.priced,
        )
        self.best.offer(solved)
        return self.relaxation.of_bounds(solved.multipliers)

    def offer_first(self, pattern: BoolArray) -> None:
        """Offer a plan on a pattern that will be visited again, to begin with."""
        most = 1.0 if self.admissible.on_levels else np.inf
        self.best.offer(
            self._solver.solve(self.sample, pattern, self.best.objective, self.deadline, most=most)
        )
