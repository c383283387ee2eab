"""Quadratic programs on a fixed move pattern: everything off the pattern is exactly zero."""

from __future__ import annotations

from collections import OrderedDict
from copy import copy
from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import ROUNDING, SMALLER
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.courses import Found, Past
from mampc.moves.level_search import Completion, LevelSearch
from mampc.moves.rounding import without_rounding
from mampc.moves.signs import search_signs
from mampc.program.condensing import CondensedQP
from mampc.program.least_distance import Nearest
from mampc.program.levels import InputLevels
from mampc.program.qp import QPStatus
from mampc.program.restriction import Restriction
from mampc.program.sample import LeastSquares, Sample

CACHE_BYTES = 64e6  # for recent patterns and their solvers
SHARE = 0.1  # of the programs left, that one pattern may take
NODES = 200  # of a search over levels, that take about as long as a program


class OnPattern(NamedTuple):
    """The best moves on a pattern, shape (n_moves,), with their objective, price included.

    The moves are None where there are none below the cutoff: the objective is then a lower bound.
    Multipliers, shape (n_bounds,) and positive at upper bounds, are those without least sizes of moves.
    The status is TIME_LIMIT where the search over signs was not finished: there may be better moves.
    `programs` is how many it took.
    """

    moves: Array | None
    objective: float
    status: QPStatus
    multipliers: Array | None
    programs: int


class Incumbent:
    """The best plan found so far, and the work it took.

    `failure` says how a pattern was left without an answer, if any was; `unproven` bounds what such patterns cost.
    `left_programs`, at first `programs`, is how many more all searches over signs may take.
    """

    __slots__ = ("failure", "left_programs", "moves", "multipliers", "objective", "solved", "unproven")

    def __init__(self, programs: float = np.inf) -> None:
        self.left_programs = programs
        self.moves: Array | None = None
        self.objective = np.inf
        self.multipliers: Array | None = None
        self.solved = 0
        self.failure: QPStatus | None = None
        self.unproven = np.inf

    def offer(self, on_pattern: OnPattern, bound: float = -np.inf) -> bool:
        """Take the moves of a pattern if they are better; says whether they were. `bound`: on their objective."""
        self.solved += 1
        self.left_programs -= on_pattern.programs
        if on_pattern.status not in (QPStatus.OPTIMAL, QPStatus.INFEASIBLE, QPStatus.TIME_LIMIT):
            self.left(on_pattern.status, max(bound, on_pattern.objective))
        if on_pattern.moves is None or on_pattern.objective >= self.objective:
            return False
        self.moves, self.objective = on_pattern.moves, on_pattern.objective
        self.multipliers = on_pattern.multipliers
        return True

    def left(self, status: QPStatus, bound: float) -> None:
        """Plans that cost at least `bound` stay unproven, for a program that ended like this."""
        self.failure, self.unproven = status, min(self.unproven, bound)


class PatternSolver:
    """Solves the condensed program on one pattern at a time, keeping what recent patterns took to prepare.

    Args:
        condensed, admissible: the problem and its rules.
    """

    def __init__(self, condensed: CondensedQP, admissible: AdmissiblePatterns) -> None:
        self.condensed, self.admissible = condensed, admissible
        self._rounding = ROUNDING * condensed.move_prefix
        self._kept: OrderedDict[bytes, Restriction] = OrderedDict()
        self._kept_bytes = 0
        self._levels: LevelSearch | None = None
        self._past: Past | None = None
        if admissible.on_levels:
            levels = InputLevels(admissible.rules.levels, condensed.problem)
            self._levels = LevelSearch(condensed, admissible, levels)
            self._past = self._levels.past(condensed.problem.model.u_op[None])
            self._all_free = Allowance(admissible.n_moves, (0,) * admissible.n_inputs, False)

    def after(self, inputs: Array) -> PatternSolver:
        """The solver after the applied inputs, shape (h, m), on which what inputs on levels may do depends."""
        if self._levels is None:
            return self
        after = copy(self)
        after._past = self._levels.past(inputs)
        return after

    @property
    def free(self) -> BoolArray | None:
        """The moves of inputs without levels, shape (n_moves,), where others have some; else None."""
        return None if self._levels is None else ~self._levels.on_levels

    @property
    def rounding_cost(self) -> float:
        """What it costs on average to round a move to a level, in prices; infinite where some move has none."""
        return np.inf if self._levels is None else self._levels.rounding_cost

    def best_course(
        self,
        sample: Sample,
        allowance: Allowance,
        free: BoolArray,
        limits: LeastSquares | None = None,
        cutoff: float = np.inf,
        deadline: float = np.inf,
    ) -> Found:
        """The best course of the inputs on levels with the moves `free`, shape (n_moves,), of the others.

        `limits`: the problem with limits priced in, if they are active.
        """
        assert self._levels is not None
        assert self._past is not None
        pattern = self._levels.on_levels & self.admissible.open(allowance) | free
        completed = None
        if free.any():
            restriction = self._restriction(pattern)
            optimum, bounds = restriction.optimum(sample.target), self._bounds(sample, pattern)
            if bounds is None:
                return Found(None, np.inf, np.inf, True, 0)
            completed = self._completion(sample, pattern, optimum, bounds)
        return self._levels.search(
            sample, pattern, allowance, self._past, priced=limits, completed=completed, cutoff=cutoff,
            deadline=deadline,
        )  # fmt: skip

    def _completion(
        self, sample: Sample, pattern: BoolArray, optimum: Array, bounds: tuple[Array, Array]
    ) -> Completion:
        """What finds the moves of inputs without levels; bounds are those of the program on the pattern."""
        assert self._levels is not None
        restriction, of = self._restriction(pattern), self._levels.factor(pattern)
        is_free = np.isin(restriction.moves, of.free)
        own, kept = restriction.n_violations + np.flatnonzero(~is_free), restriction.bounds

        def completed(moves: Array) -> tuple[Array, float] | None:
            lower, upper = bounds[0][kept], bounds[1][kept]
            lower[own] = upper[own] = moves[of.moves]
            nearest = restriction.solve(optimum, lower, upper)
            if nearest.moves is None:
                return None
            moves[of.free] = nearest.moves[is_free]
            moves = without_rounding(self.condensed, sample, moves)
            return moves, self.condensed.cost(sample, moves) + self.admissible.charge(moves != 0)

        return completed

    def priced(self, sample: Sample, multipliers: Array | None) -> LeastSquares | None:
        """The problem with limits priced in by multipliers, shape (n_bounds,), if any is not zero."""
        if multipliers is None or not multipliers.dot(multipliers) > 0:
            return None
        return self.condensed.priced(sample, multipliers)

    def solve(
        self,
        sample: Sample,
        pattern: BoolArray,
        cutoff: float = np.inf,
        deadline: float = np.inf,
        *,
        within: tuple[Array, Array] | None = None,
        paid: bool = False,
        most: float = np.inf,
    ) -> OnPattern:
        """The best moves that are zero off `pattern`, if their objective is below `cutoff`.

        With least sizes, `within` are intervals of the pattern's moves that tell their signs. With levels, `paid` says
        that the pattern's price counts, though single moves may turn out to be none.
        A search over signs stops at the deadline, of `perf_counter`, or after `most` programs.
        """
        bounds = self._bounds(sample, pattern)
        if bounds is None:
            return OnPattern(None, np.inf, QPStatus.INFEASIBLE, None, 0)
        restriction = self._restriction(pattern)
        base = sample.cost + self.admissible.charge(pattern) + sample.charge(pattern)
        sized = self.admissible.sized and within is None and bool(pattern.any())
        if within is None and self._levels is None and not sized:
            both = sample.both_bounds if sample.bounds_now is None else np.concatenate(bounds)
            nearest = restriction.nearest(sample.target, both, cutoff - base)
            if nearest.moves is None:
                excess = restriction.excess(sample.target) if _failed(nearest) else nearest.excess
                return OnPattern(None, base + excess, nearest.status, nearest.multipliers, 1)
            return self._answer(sample, pattern, nearest, base + nearest.excess, cutoff)
        optimum = restriction.optimum(sample.target)
        base += restriction.excess(sample.target)
        lower, upper = kept = bounds[0][restriction.bounds], bounds[1][restriction.bounds]
        if within is not None:
            own = slice(restriction.n_violations, restriction.n_violations + len(within[0]))
            lower[own], upper[own] = np.maximum(lower[own], within[0]), np.minimum(upper[own], within[1])
        nearest = restriction.solve(optimum, lower, upper)
        if nearest.moves is None or base + nearest.excess >= cutoff:
            bound = base if _failed(nearest) else base + nearest.excess
            return OnPattern(None, bound, nearest.status, nearest.multipliers, 1)
        if self._levels is not None:
            return self._on_levels(
                sample, pattern, optimum, bounds, nearest.multipliers, paid, cutoff, deadline, most
            )
        sizes = self.admissible.min_size[pattern]
        if not sized or (nearest.moves is optimum and (np.abs(optimum) >= sizes).all()):
            return self._answer(sample, pattern, nearest, base + nearest.excess, cutoff)
        signed = search_signs(
            restriction, nearest, optimum, kept, sizes, SMALLER * self.condensed.move_prefix[pattern],
            cutoff=cutoff - base, most=most, deadline=deadline,
        )  # fmt: skip
        if signed.moves is None:
            excess = max(signed.excess, nearest.excess)  # that without least sizes where a program failed
            return OnPattern(None, base + excess, signed.status, nearest.multipliers, signed.programs)
        of_signs = nearest._replace(moves=signed.moves)
        answer = self._answer(sample, pattern, of_signs, base + signed.excess, np.inf)
        return answer._replace(status=signed.status, programs=signed.programs)

    def _on_levels(
        self,
        sample: Sample,
        pattern: BoolArray,
        optimum: Array,
        bounds: tuple[Array, Array],
        multipliers: Array | None,
        paid: bool,
        cutoff: float,
        deadline: float,
        most: float,
    ) -> OnPattern:
        """The best moves on a pattern that lead from level to level; those that stay cost nothing unless `paid`."""
        assert self._levels is not None
        assert self._past is not None
        mixed = len(self._levels.factor(pattern).free) > 0
        found = self._levels.search(
            sample, pattern, self._all_free, self._past, priced=self.priced(sample, multipliers),
            completed=self._completion(sample, pattern, optimum, bounds) if mixed else None, paid=paid,
            cutoff=cutoff, deadline=deadline, most=NODES * most,
        )  # fmt: skip
        status = QPStatus.OPTIMAL if found.complete else QPStatus.TIME_LIMIT
        if found.moves is None and found.complete and cutoff == np.inf:
            status = QPStatus.INFEASIBLE
        objective = found.bound if found.moves is None else found.objective
        return OnPattern(found.moves, objective, status, multipliers, 1 + found.visited // NODES)

    def _bounds(self, sample: Sample, pattern: BoolArray) -> tuple[Array, Array] | None:
        """The bounds that hold on a pattern; None where it cannot keep them."""
        if sample.bounds_now is None:
            return sample.lower, sample.upper
        return sample.bounds_now.on(pattern)

    def _answer(
        self, sample: Sample, pattern: BoolArray, nearest: Nearest, objective: float, cutoff: float
    ) -> OnPattern:
        """Moves of the pattern, shape (its moves,), as an answer; those that are none after all cost nothing."""
        chosen, multipliers = nearest.moves, nearest.multipliers
        if chosen is None or objective >= cutoff:
            return OnPattern(None, objective, QPStatus.OPTIMAL, multipliers, 1)
        moves: Array = np.zeros(self.condensed.n_moves)
        moves[pattern] = chosen
        small = np.abs(chosen) < self._rounding[pattern]
        if np.count_nonzero(small) and (self.admissible.priced or np.count_nonzero(chosen[small])):
            moves = without_rounding(self.condensed, sample, moves)
            # With later data the pattern counts: what these will decide may be nothing as yet.
            if sample.later_data is None:
                objective = self.condensed.cost(sample, moves) + self.admissible.charge(moves != 0)
        return OnPattern(moves, objective, QPStatus.OPTIMAL, multipliers, 1)

    def offer(
        self,
        sample: Sample,
        pattern: BoolArray,
        best: Incumbent,
        deadline: float = np.inf,
        *,
        first: bool = False,
    ) -> OnPattern:
        """Offer the best moves on a pattern; where moves have a least size, also with single ones left out.

        Each takes a share of the programs that are left, and one at least. With levels, `first` asks for a plan to
        begin with: the best one found in about the time of a program.
        """

        def solved(pattern: BoolArray) -> OnPattern:
            most = 1.0 if first and self._levels is not None else max(SHARE * best.left_programs, 1)
            return self.solve(sample, pattern, best.objective, deadline, most=most)

        before, proposed = best.objective, solved(pattern)
        best.offer(proposed)
        while self.admissible.sized and best.objective < before and best.moves is not None:
            before, moves = best.objective, best.moves
            for i in np.flatnonzero(moves):
                if best.left_programs <= 0 or perf_counter() > deadline:
                    return proposed
                fewer = moves != 0
                fewer[i] = False
                best.offer(solved(fewer))
        return proposed

    def _restriction(self, pattern: BoolArray) -> Restriction:
        key = pattern.tobytes()
        entry = self._kept.get(key)
        if entry is None:
            entry = self._kept[key] = self.condensed.restricted(pattern)
            self._kept_bytes += entry.bytes
            while self._kept_bytes > CACHE_BYTES and len(self._kept) > 1:
                self._kept_bytes -= self._kept.popitem(last=False)[1].bytes
        else:
            self._kept.move_to_end(key)
        return entry


def _failed(nearest: Nearest) -> bool:
    """Whether a program has no answer though there may be one."""
    return nearest.status not in (QPStatus.OPTIMAL, QPStatus.INFEASIBLE, QPStatus.BAD_DATA)
