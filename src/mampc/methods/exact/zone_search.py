"""The exact search where outputs have zones: patterns have no bound there that needs no program.

It starts from a local search with set points at the nearest ends of the zones. No plan costs less than that with every
move free and its prices, so that a good plan leaves few moves that pay: few patterns are tried one by one, more are
left to branch and bound.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from mampc.methods.exact.branching import Branching
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.local_search import LocalSearch
from mampc.moves.pattern_solver import PatternSolver

FEW = 60  # patterns that are tried one by one
MOST = 3  # moves that these have


def search_zones(problem: SampleProblem, solver: PatternSolver, local: LocalSearch) -> float:
    """A lower bound over everything that was not visited: infinite when the search is complete."""
    if problem.terms.rest[0] >= problem.cutoff:
        return np.inf
    sample, condensed = problem.sample, problem.squares.condensed
    free = condensed.plain.solve(sample.moves, sample.lower, sample.upper)
    if free.multipliers is None:
        return Branching(problem).run()
    least = sample.cost + free.excess
    if not _are_few(problem, least):
        f, _ = condensed.relaxed_limits(sample, free.multipliers)
        local.offer(solver, sample, f, problem.allowance, problem.best, problem.deadline)
        if not _are_few(problem, least):
            return Branching(problem).run()
    for count in range(1, _most_moves(problem, least) + 1):
        for positions in combinations(range(len(problem.order)), count):
            pattern = problem.pattern(np.array(positions))
            if problem.admissible.allows(pattern, problem.allowance):
                problem.offer(pattern)
    return np.inf


def _most_moves(problem: SampleProblem, least: float) -> int:
    """How many moves a better plan than the best may have, where none costs less than `least` without prices."""
    of, most = problem.admissible, len(problem.order)
    if of.simultaneous:
        return most
    price, gain = float(of.price.min()), problem.cutoff - least
    if gain <= 0:
        return 0
    if gain < most * price:
        most = int(gain / price)
    return int(min(most, problem.allowance.left))


def _are_few(problem: SampleProblem, least: float) -> bool:
    """Whether the patterns that may be better are few."""
    most = _most_moves(problem, least)
    patterns = sum(comb(len(problem.order), count) for count in range(1, min(most, MOST) + 1))
    return most <= MOST and patterns <= FEW
