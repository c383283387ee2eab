"""Quadratic programs on a fixed move pattern: everything off the pattern is exactly zero."""

from __future__ import annotations

from collections import OrderedDict
from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import ROUNDING, SMALLER
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.rounding import without_rounding
from mampc.program.condensing import CondensedQP, Restriction
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample

CACHE_BYTES = 64e6  # for recent patterns and their solvers


class OnPattern(NamedTuple):
    """The best moves on a pattern, shape (n_moves,), with their objective, price included.

    The moves are None where there are none below the cutoff: the objective is then a lower bound.
    Multipliers, shape (n_bounds,) and positive at upper bounds, are those without least sizes of moves.
    The status is TIME_LIMIT where the search over signs was not finished: there may be better moves.
    """

    moves: Array | None
    objective: float
    status: QPStatus
    multipliers: Array | None
    iterations: int


class Incumbent:
    """The best plan found so far, and the work it took."""

    __slots__ = ("failure", "moves", "multipliers", "objective", "solved")

    def __init__(self) -> None:
        self.moves: Array | None = None
        self.objective = np.inf
        self.multipliers: Array | None = None
        self.solved = 0
        self.failure: QPStatus | None = None

    def offer(self, on_pattern: OnPattern) -> bool:
        """Take the moves of a pattern if they are better; says whether they were."""
        self.solved += 1
        if on_pattern.status not in (QPStatus.OPTIMAL, QPStatus.INFEASIBLE, QPStatus.TIME_LIMIT):
            self.failure = on_pattern.status
        if on_pattern.moves is None or on_pattern.objective >= self.objective:
            return False
        self.moves, self.objective = on_pattern.moves, on_pattern.objective
        self.multipliers = on_pattern.multipliers
        return True


class Prepared:
    """What the programs on one pattern share: the optimum without limits, and a solver for the rest."""

    def __init__(self, condensed: CondensedQP, pattern: BoolArray, time_limit: float | None) -> None:
        self._condensed, self._pattern, self._time_limit = condensed, pattern, time_limit
        self.chosen = np.flatnonzero(pattern)
        self._minus_inverse = -np.linalg.inv(condensed.H[self.chosen[:, None], self.chosen])
        self._rows = condensed.bounds.of_moves[:, self.chosen]
        self.bytes = 4 * (self._rows.nbytes + 20 * len(self._rows))  # with its solver, about
        self._solver: tuple[Restriction, DaqpSolver] | None = None

    def unlimited(self, f_moves: Array, lower: Array, upper: Array, sizes: Array | None) -> Array | None:
        """The optimum without limits, shape (moves of the pattern,), if it keeps all limits and least sizes."""
        d: Array = self._minus_inverse @ f_moves[self.chosen]
        rows = self._rows @ d
        inside = (rows >= lower).all() and (rows <= upper).all()
        return d if inside and (sizes is None or (np.abs(d) >= sizes).all()) else None

    @property
    def solver(self) -> tuple[Restriction, DaqpSolver]:
        """The restricted program and its solver, set up when first wanted."""
        if self._solver is None:
            restriction = self._condensed.restricted(self._pattern)
            self._solver = restriction, DaqpSolver(restriction.program, time_limit=self._time_limit)
        return self._solver


class PatternSolver:
    """Solves the condensed program on one pattern at a time, keeping what recent patterns took to prepare.

    Where moves have a least size, each must be at most -size or at least +size: a small search over
    signs, those of the optimum without least sizes first.

    Args:
        condensed, admissible: the problem and its rules.
        limits_expected: whether plans mostly run into limits, so that it does not pay to try the optimum without
            them first. (Where they do not, it spares setting up a solver for every new pattern.)
        most_programs: that a search over signs may take.
        time_limit: seconds that one program may take; None for no limit.
    """

    def __init__(
        self,
        condensed: CondensedQP,
        admissible: AdmissiblePatterns,
        *,
        limits_expected: bool = False,
        most_programs: float = np.inf,
        time_limit: float | None = None,
    ) -> None:
        self.condensed, self.admissible, self._time_limit = condensed, admissible, time_limit
        self._limits_expected, self._most_programs = limits_expected, most_programs
        self._kept: OrderedDict[bytes, Prepared] = OrderedDict()
        self._kept_bytes = 0

    def solve(
        self, sample: Sample, pattern: BoolArray, cutoff: float = np.inf, deadline: float = np.inf
    ) -> OnPattern:
        """The best moves that are zero off `pattern`, if their objective is below `cutoff`.

        A search over signs stops at the deadline, of `perf_counter`, or after `most_programs`.
        """
        base = sample.constant + self.admissible.charge(pattern)
        every_lower, every_upper = sample.lower, sample.upper
        if sample.bounds_now is not None:
            own = sample.bounds_now.on(pattern)
            if own is None:
                return OnPattern(None, np.inf, QPStatus.INFEASIBLE, None, 0)
            every_lower, every_upper = own
        v, n = self.condensed.n_violations, self.condensed.n_moves
        if not pattern.any() and not v:
            return OnPattern(np.zeros(n) if base < cutoff else None, base, QPStatus.OPTIMAL, None, 0)
        prepared = self._prepared(pattern)
        sizes = self.admissible.min_size[pattern] if self.admissible.sized else None
        d = None
        if not self._limits_expected:
            d = prepared.unlimited(sample.f_moves, sample.lower[v:], sample.upper[v:], sizes)
        if d is not None:
            objective = base + 0.5 * float(sample.f_moves[prepared.chosen].dot(d))
            moves: Array | None = None
            if objective < cutoff:
                moves = np.zeros(n)
                moves[prepared.chosen] = d
            return OnPattern(moves, objective, QPStatus.OPTIMAL, None, 0)
        (program, columns, bounds), solver = prepared.solver
        solver.start()
        f, H = sample.f[columns], program.H
        best, least, status = None, cutoff, QPStatus.INFEASIBLE
        multipliers, iterations, solved = None, 0, 0
        pending = [(every_lower[bounds], every_upper[bounds])]
        while pending:
            if multipliers is not None and (solved >= self._most_programs or perf_counter() > deadline):
                status = QPStatus.TIME_LIMIT
                break
            lower, upper = pending.pop()
            solution = solver.solve(f, lower, upper)
            solved += 1
            iterations += solution.iterations
            z = solution.z
            if z is None:
                if solution.status not in (QPStatus.INFEASIBLE, QPStatus.BAD_DATA):
                    return OnPattern(None, -np.inf, solution.status, multipliers, iterations)
                continue
            status = QPStatus.OPTIMAL
            objective = base + float(z.dot(0.5 * H.dot(z) + f))
            if multipliers is None and solution.multipliers is not None:
                multipliers = np.zeros(len(sample.lower))
                multipliers[bounds] = solution.multipliers
                if objective >= cutoff:
                    return OnPattern(None, objective, status, multipliers, iterations)
            if objective >= least:
                continue
            d = z[v:]
            if sizes is not None and len(d):
                short = sizes - np.abs(d)
                worst = int(short.argmax())
                if short[worst] > SMALLER:
                    pending += _apart(lower, upper, v + worst, sizes[worst], d[worst])
                    continue
                d = np.where(short > 0, np.copysign(sizes, d), d)
            best, least = d, objective
        if best is None:
            return OnPattern(
                None, np.inf if status is QPStatus.INFEASIBLE else least, status, multipliers, iterations
            )
        moves = np.zeros(n)
        moves[pattern] = best
        if len(best) and np.abs(best).min() < ROUNDING:
            moves = without_rounding(self.condensed, sample, moves)
            if self.admissible.priced:
                least += self.admissible.charge(moves != 0) - self.admissible.charge(pattern)
        return OnPattern(moves, least, status, multipliers, iterations)

    def offer(
        self, sample: Sample, pattern: BoolArray, best: Incumbent, deadline: float = np.inf
    ) -> OnPattern:
        """Offer the best moves on a pattern; where moves have a least size, also with single ones left out."""
        solved, before = self.solve(sample, pattern, best.objective, deadline), best.objective
        best.offer(solved)
        while self.admissible.sized and best.objective < before and best.moves is not None:
            before, moves = best.objective, best.moves
            for i in np.flatnonzero(moves):
                if perf_counter() > deadline:
                    return solved
                fewer = moves != 0
                fewer[i] = False
                best.offer(self.solve(sample, fewer, best.objective, deadline))
        return solved

    def _prepared(self, pattern: BoolArray) -> Prepared:
        key = pattern.tobytes()
        entry = self._kept.get(key)
        if entry is None:
            entry = self._kept[key] = Prepared(self.condensed, pattern.copy(), self._time_limit)
            self._kept_bytes += entry.bytes
            while self._kept_bytes > CACHE_BYTES and len(self._kept) > 1:
                self._kept_bytes -= self._kept.popitem(last=False)[1].bytes
        else:
            self._kept.move_to_end(key)
        return entry


def _apart(lower: Array, upper: Array, at: int, size: float, value: float) -> list[tuple[Array, Array]]:
    """The bounds with z[at] <= -size and with z[at] >= size, the one nearer to `value` last."""
    children = []
    for sign in (-1, 1) if value >= 0 else (1, -1):
        low, high = lower.copy(), upper.copy()
        if sign > 0:
            low[at] = max(low[at], size)
        else:
            high[at] = min(high[at], -size)
        if low[at] <= high[at]:
            children.append((low, high))
    return children
