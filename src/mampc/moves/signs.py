"""The search over signs: moves with a least size are each at most -size or at least +size.

A depth-first search: the best moves without least sizes first; while one of them falls short of its size, two
programs follow, in which the move that falls short by most is negative or positive enough. No program costs less
than the one it came from, so those that cost no less than the best moves found are left out.
"""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.program.least_distance import Nearest
from mampc.program.qp import QPStatus
from mampc.program.restriction import Restriction


class Signed(NamedTuple):
    """The best moves found, shape (k,), or None, and their excess over the optimum without limits and sizes.

    The status is TIME_LIMIT where the search was not finished: there may be better moves. Without moves, the excess
    is that below which there are none.
    """

    moves: Array | None
    excess: float
    status: QPStatus
    programs: int


def search_signs(
    restriction: Restriction,
    first: Nearest,
    optimum: Array,
    bounds: tuple[Array, Array],
    sizes: Array,
    rounding: Array,
    *,
    cutoff: float = np.inf,
    most: float = np.inf,
    deadline: float = np.inf,
) -> Signed:
    """The best moves of at least their sizes.

    Args:
        restriction: the problem on a pattern of which every move has a simple bound.
        first: its solution without least sizes.
        optimum: its optimum without limits, shape (k,).
        bounds: lower and upper ones, those that the restriction keeps.
        sizes: least sizes, shape (k,).
        rounding: by how much a move may fall short of its size for rounding, shape (k,).
        cutoff: moves with a larger excess are of no interest.
        most: programs that the search may take.
        deadline: of `perf_counter`; one program is solved whatever the time is.
    """
    first_move = restriction.n_violations
    best, least, status, solved = None, cutoff, first.status, 1
    pending: list[tuple[Array, Array]] = []
    node, (lower, upper) = first, bounds
    while True:
        if node.moves is not None and node.excess < least:
            short = sizes - np.abs(node.moves)
            worst = int((short / rounding).argmax())
            if short[worst] > rounding[worst]:
                pending += _apart(lower, upper, first_move + worst, sizes[worst], node.moves[worst])
            else:
                best = np.where(short > 0, np.copysign(sizes, node.moves), node.moves)
                least = node.excess
        elif node.moves is None and node.status not in (QPStatus.INFEASIBLE, QPStatus.BAD_DATA):
            return Signed(None, -np.inf, node.status, solved)
        if not pending:
            return Signed(best, least, status, solved)
        if solved >= most or perf_counter() > deadline:
            return Signed(best, least, QPStatus.TIME_LIMIT, solved)
        lower, upper = pending.pop()
        node = restriction.solve(optimum, lower, upper)
        solved += 1


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
