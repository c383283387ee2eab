"""The exact search where outputs have zones: patterns of several moves have no bound there that needs no program.

It starts from a local search with set points at the nearest ends of the zones. No plan costs less than that with every
move free and its prices, so that a good plan leaves few moves that pay: few patterns are tried one by one, more are
left to branch and bound. What a single move costs at least is a function of one number, for all moves at once.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from mampc.base.checks import Array
from mampc.methods.exact.branching import Branching
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.local_search import LocalSearch
from mampc.moves.pattern_solver import PatternSolver
from mampc.program.sample import Indices

FEW = 60  # patterns of several moves that are tried one by one
MOST = 3  # moves that these have
ROUNDS = 8  # of Newton's method for single moves


def search_zones(problem: SampleProblem, solver: PatternSolver, local: LocalSearch) -> float:
    """A lower bound over everything that was not visited: infinite when the search is complete."""
    if problem.terms.rest[0] >= problem.cutoff:
        return np.inf
    sample, condensed = problem.sample, problem.squares.condensed
    if problem.late:
        return float(problem.terms.rest[0])
    free = condensed.plain.solve(sample.moves, sample.lower, sample.upper)
    if free.multipliers is None:
        return Branching(problem).run()
    least = sample.cost + free.excess
    if not _are_few(problem, least):
        f, _ = condensed.relaxed_limits(sample, free.multipliers)
        local.offer(solver, sample, f, problem.allowance, problem.best, problem.deadline)
        if problem.late:
            return least
        if not _are_few(problem, least):
            return Branching(problem).run()
    if _most_moves(problem, least) < 1:
        return np.inf
    single = single_moves(problem)
    for i in np.argsort(single):
        if single[i] >= problem.cutoff:
            break
        if problem.late:
            return least
        _offer(problem, np.array([i]))
    for count in range(2, _most_moves(problem, least) + 1):
        for positions in combinations(range(len(problem.order)), count):
            if problem.late:
                return least
            _offer(problem, np.array(positions))
    return np.inf


def _offer(problem: SampleProblem, positions: Indices) -> None:
    pattern = problem.pattern(positions)
    if problem.admissible.allows(pattern, problem.allowance):
        problem.offer(pattern)


def single_moves(problem: SampleProblem) -> Array:
    """What each move alone costs at least, limits of outputs aside and its price included, shape (n,).

    With L the curvature without zones a function f of a move costs at least f - f'^2 / (4 L) wherever it is taken.
    """
    squares, sample, of = problem.squares, problem.sample, problem.admissible
    zones, rows = squares.condensed.bounds.zones, squares.condensed.bounds.zone_rows
    assert zones is not None
    L, c = squares.L[:, :-1], problem.terms.c[:, :1]
    theta, weight = zones.theta[:, problem.order], zones.root * zones.root
    low, high = sample.lower[rows, None], sample.upper[rows, None]
    x = np.zeros(len(problem.order))
    others = problem.terms.rest[0] + of.price[problem.order % of.n_inputs]
    single: Array = np.full(len(x), -np.inf)
    for _ in range(ROUNDS):
        missed, values = L * x - c, theta * x
        away = values - np.minimum(np.maximum(values, low), high)
        cost = np.square(missed).sum(axis=0) + weight @ np.square(away)
        slope = 2 * ((missed * L).sum(axis=0) + weight @ (away * theta))
        single = np.maximum(single, others + cost - slope * slope / (4 * squares.curvature))
        if (single >= problem.cutoff).all():
            break
        x -= slope / (2 * (squares.curvature + weight @ np.where(away != 0, theta * theta, 0.0)))
    return single


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
    patterns = sum(comb(len(problem.order), count) for count in range(2, min(most, MOST) + 1))
    return most <= MOST and patterns <= FEW
