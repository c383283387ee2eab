"""Branch and bound where limits bind: every node is a quadratic program.

At a node some moves are made, some left out, and the others undecided: free within what they can be, at the price
per unit that is at most theirs (see `relaxation`). With the multipliers of its program the cost is a quadratic about
the program's moves d, whose curvature is that of the free moves alone: with P = Z Z' the inverse of their normal
matrix and s_i the pull at the move i, a move x there adds at least

    (x - d_i)^2 / P_ii + p_i [x != 0] - s_i x - min(0, p_i - max s_i x)

Left out, x is zero; made, the least of this within the move's limits counts. What both add, the node costs more;
moves for which one of both is too much are decided at once; the search branches on the move whose leaving out adds
most. Best bound first, so that a search cut short leaves the best bound there is; and some nodes at a time, which
are arrays of all of them but for the programs, each of which starts from its parent's active bounds.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.relaxation import Multipliers, RelaxedMany, Start, alone
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.exact.zone_curvature import ZoneCurvature
from mampc.program.least_distance import ROUNDING
from mampc.program.sample import Indices

UNDECIDED, OUT, MADE = 0, 1, 2
TOGETHER = 16  # nodes treated at once


class _Node(NamedTuple):
    """A node that waits; nodes of equal bounds are told apart by their numbers.

    Attributes:
        bound: on all that it leads to.
        state: of each move, shape (n,).
        Z: of its parent, shape (n, n).
        start: of its program: that of its parent.
    """

    bound: float
    number: int
    state: Indices
    Z: Array
    start: Start


class _Solved(NamedTuple):
    """The relaxed programs of K nodes.

    Attributes:
        bound: on all that each leads to, infinite where no moves keep the limits, shape (K,).
        out, made: what leaving out or making each undecided move adds to the bound at least, shape (K, n).
        relaxed: the programs.
    """

    bound: Array
    out: Array
    made: Array
    relaxed: RelaxedMany


class Branching:
    """The search of one sample."""

    def __init__(self, problem: SampleProblem) -> None:
        self._problem, self._of = problem, problem.admissible
        order, m, dwell = problem.order, self._of.n_inputs, self._of.rules.dwell
        self._at = order // m
        self._samples = np.eye(self._of.control_horizon, dtype=np.intp)[self._at]  # that of each move
        self._price = self._of.price[order % m]
        self._near: Indices | None = None  # pairs of moves that the dwell time keeps apart
        if dwell > 1:
            apart = np.abs(self._at[:, None] - self._at)
            near = (apart < dwell) & (order[:, None] % m == order % m) & (apart > 0)
            self._near = near.astype(np.intp)
        squares, sample = problem.squares, problem.sample
        zoned = squares.condensed.bounds.zones is not None
        self._zones = ZoneCurvature(squares.condensed, squares.normal, order, sample) if zoned else None
        self._tried: set[bytes] = set()
        self._made = 0  # nodes
        self._out_of_time = False  # for the last nodes' programs, or for a plan that they show

    def run(self, root: Multipliers | None = None) -> float:
        """A lower bound over everything that was not visited: infinite when the search is complete.

        Args:
            root: the program with all moves undecided, where it is at hand.
        """
        problem = self._problem
        state: Indices = np.full((1, len(self._at)), UNDECIDED)
        state[:, (problem.domain.low == 0) & (problem.domain.high == 0)] = OUT
        heap: list[_Node] = []
        if self._closed(state)[0]:
            start = problem.relaxation.start
            heap.append(_Node(float(problem.terms.rest[0]), 0, state[0], problem.squares.inverse, start))
        while heap:
            bound = heap[0].bound
            if bound >= problem.cutoff:
                return np.inf
            if problem.late:
                return bound
            nodes = [heappop(heap) for _ in range(min(TOGETHER, len(heap)))]
            solved = None if root is None else alone(root, problem.relaxation.start)
            root = None
            for child in self._children(nodes, solved):
                heappush(heap, child)
            if self._out_of_time:
                return bound
        return np.inf

    def _children(self, nodes: list[_Node], relaxed: RelaxedMany | None) -> list[_Node]:
        """What nodes, whose programs may be solved already, lead to, as far as it may beat the best plan."""
        states, Z = np.array([node.state for node in nodes]), np.array([node.Z for node in nodes])
        _leave_out(Z, (states == OUT) & Z.any(axis=2))
        solved = self._solve(states, Z, relaxed or [node.start for node in nodes])
        if self._out_of_time:
            return []
        found: list[tuple[Indices, float, int]] = []
        for row in solved.relaxed.without_answer:
            found += [(state, nodes[row].bound, row) for state in self._split(states[row])]
        none = np.full(len(nodes), -np.inf)  # where no moves keep the limits
        gap = np.subtract(self._problem.cutoff, solved.bound, out=none, where=solved.bound < np.inf)[:, None]
        undecided = states == UNDECIDED
        made, out = undecided & (solved.out >= gap), undecided & (solved.made >= gap)
        states[made], states[out] = MADE, OUT
        may = (gap[:, 0] > 0) & ~(made & out).any(axis=1) & self._closed(states)
        # Programs with nothing undecided are those of plans, which were tried.
        rows: Indices = np.flatnonzero(may & undecided.any(axis=1))
        least = np.array([node.bound for node in nodes])
        bounds, states = np.maximum(least, solved.bound)[rows], states[rows]
        for _ in range(2 if 4 * len(rows) <= TOGETHER else 1):  # few nodes are split over two moves at once
            states, bounds, rows = self._halved(states, bounds, rows, solved)
        kept = self._closed(states) & (bounds < self._problem.cutoff)
        found += zip(states[kept], bounds[kept].tolist(), rows[kept].tolist(), strict=True)
        children = []
        for state, bound, row in found:
            self._made += 1
            children.append(_Node(bound, self._made, state, Z[row].copy(), solved.relaxed.starts[row]))
        return children

    def _halved(
        self, states: Indices, bounds: Array, rows: Indices, solved: _Solved
    ) -> tuple[Indices, Array, Indices]:
        """Nodes with one move more decided, either way, and their bounds; `rows` are theirs in their programs."""
        out, made = solved.out[rows], solved.made[rows]
        every, i = np.arange(len(rows)), np.where(states == UNDECIDED, out, -1.0).argmax(axis=1)
        open_ = states[every, i] == UNDECIDED
        parts = [(states[~open_], bounds[~open_], rows[~open_])]
        every, i = every[open_], i[open_]
        for kind, adds in ((OUT, out), (MADE, made)):
            half = states[every]
            half[np.arange(len(half)), i] = kind
            bound = np.maximum(bounds[every], solved.bound[rows[every]] + adds[every, i])
            parts.append((half, bound, rows[every]))
        states, bounds, rows = (np.concatenate(part) for part in zip(*parts, strict=True))
        return states, bounds, rows

    def _split(self, state: Indices) -> list[Indices]:
        """What a node leads to whose program has no answer though it may have one."""
        open_ = np.flatnonzero(state == UNDECIDED)
        if not len(open_):
            self._problem.offer(self._problem.pattern(state == MADE))
            return []
        children = np.array([state, state])
        children[:, open_[0]] = OUT, MADE
        return list(children[self._closed(children)])

    def _closed(self, states: Indices) -> BoolArray:
        """Leave out what the rules forbid beside the moves made, in place, (K, n); False where those break a rule."""
        of, left, made = self._of, self._problem.allowance.left, states == MADE
        open_, kept = states == UNDECIDED, np.ones(len(states), dtype=bool)
        used = made.sum(axis=1)
        if not of.simple:
            at = made @ self._samples
            kept &= (at <= of.per_step).all(axis=1)
            if self._near is not None:
                near = made @ self._near > 0
                kept &= ~(near & made).any(axis=1)
                states[open_ & near] = OUT
            states[open_ & (at[:, self._at] >= of.per_step)] = OUT
            if of.simultaneous:
                used = (at > 0).sum(axis=1)
                open_ &= at[:, self._at] == 0
        states[open_ & (used >= left)[:, None]] = OUT
        kept &= used <= left
        return kept

    def _solve(self, states: Indices, Z: Array, relaxed: RelaxedMany | list[Start]) -> _Solved:
        """The nodes' programs, or where they start; plans that they show are tried."""
        domain, of, left = self._problem.domain, self._of, self._problem.allowance.left
        undecided, made, within = states == UNDECIDED, states == MADE, states != OUT
        low, high = np.where(within, domain.low, 0.0), np.where(within, domain.high, 0.0)
        slope = undecided
        if of.simultaneous:
            paid = made @ self._samples > 0
            slope = undecided & ~paid[:, self._at]
        up, down = np.where(slope, domain.up, 0.0), np.where(slope, domain.down, 0.0)
        found = (
            self._problem.relaxation.solve_many(low, high, up, down, relaxed)
            if isinstance(relaxed, list)
            else relaxed
        )
        self._out_of_time = found.out_of_time
        d = found.moves
        s = np.where(domain.bounded | ~within, found.pulls, 0.0)
        _, rest = self._problem.terms.priced(found.rows, s)
        support = np.maximum(np.maximum(s * low, s * high), 0.0)
        variance = self._variance(Z, d, within)
        out = d * d / np.where(variance > 0, variance, np.inf)
        if of.simultaneous:
            bound, adds = self._of_samples(rest, support, undecided, paid)
        else:
            bound, left_out, adds = self._of_moves(rest, s, d, variance, undecided, made)
            out += left_out
        raised = np.minimum(out, adds).max(axis=1, where=undecided, initial=0.0)
        if not of.simultaneous:
            # So many have to be left out.
            moving = undecided & (d != 0)
            more = moving.sum(axis=1) + made.sum(axis=1) - left
            least = np.sort(np.where(moving, out, np.inf), axis=1)
            least = least[np.arange(len(more)), np.maximum(more, 1) - 1]
            raised = np.where(more > 0, np.maximum(raised, least), raised)
        # The moves of the program, and those that are at least half of what they may be.
        cost = bound - of.charges(self._problem.patterns(made)) - np.maximum(d * up, -d * down).sum(axis=1)
        large = (np.maximum(d * domain.up, -d * domain.down) >= 0.5 * self._price) | made
        cost[~found.solved] = np.inf
        shown = [np.where(which, d, 0.0) for which in (within, large & within)]
        self._try(np.vstack(shown), np.tile(cost, 2), found.starts * 2)
        bound = np.where(found.solved, bound + raised, np.inf)
        return _Solved(
            bound, np.maximum(out - raised[:, None], 0.0), np.maximum(adds - raised[:, None], 0.0), found
        )

    def _variance(self, Z: Array, d: Array, within: BoolArray) -> Array:
        """The diagonals of inverse curvatures in the moves `within`, about moves d; zero for the others; all (K, n)."""
        squares = self._problem.squares
        if self._zones is not None:
            return np.array([self._zones.variance(*node) for node in zip(d, within, strict=True)])
        if not squares.orthogonal:
            return np.asarray(np.einsum("kiq,kiq->ki", Z, Z))
        variance = np.zeros(d.shape)
        for row, moves in enumerate(within):
            inverse = np.linalg.inv(np.linalg.qr(squares.L[:, :-1][:, moves], mode="r"))
            # No less than rounding leaves possible.
            variance[row, moves] = np.square(inverse).sum(axis=1) * (
                1 + len(moves) * ROUNDING * squares.condensed.condition
            )
        return variance

    def _of_moves(
        self, rest: Array, s: Array, d: Array, variance: Array, undecided: BoolArray, made: BoolArray
    ) -> tuple[Array, Array, Array]:
        """Bounds, and what leaving out moves adds beside the cost without prices, and what making them adds.

        A move x costs (x - d)^2 / variance - s x more at least, and its price.
        """
        domain = self._problem.domain
        adds = self._price - domain.support(s)
        gains = np.minimum(adds, 0.0)
        left = self._problem.allowance.left - made.sum(axis=1)
        open_ = np.sort(np.where(undecided, gains, 0.0), axis=1)
        open_ = np.hstack([open_, np.zeros((len(open_), 1))])
        first = np.arange(open_.shape[1]) < left[:, None]
        bound = rest + adds.sum(axis=1, where=made) + open_.sum(axis=1, where=first)
        # Without a move that gains the next one may, where the budget leaves one out.
        next_ = open_[np.arange(len(open_)), np.minimum(left, len(self._at))][:, None]
        x = np.minimum(np.maximum(d + 0.5 * s * variance, domain.low), domain.high)
        away = x - d
        adds = self._price - s * x + away * away / np.where(variance > 0, variance, np.inf)
        return bound, np.maximum(next_ - gains, 0.0), np.maximum(adds - gains, 0.0)

    def _of_samples(
        self, rest: Array, support: Array, undecided: BoolArray, paid: BoolArray
    ) -> tuple[Array, Array]:
        """Bounds and what making moves adds, where samples have a price."""
        pull = support @ self._samples
        open_ = undecided @ self._samples > 0
        price = self._of.price[0]
        adds = np.where(open_ & ~paid, price - pull, 0.0)
        gains = np.minimum(adds, 0.0)
        left = self._problem.allowance.left - paid.sum(axis=1)
        kept = np.sort(gains, axis=1).sum(axis=1, where=np.arange(gains.shape[1]) < left[:, None])
        bound = rest + (price - pull).sum(axis=1, where=paid) + kept
        bound -= pull.sum(axis=1, where=~paid & ~open_)
        return bound, (adds - gains)[:, self._at]

    def _try(self, moves: Array, cost: Array, starts: list[Start]) -> None:
        """Offer the best plans with the moves that are not zero, (K, n), as far as they keep the rules.

        `cost` is about the least that they cost without prices, shape (K,): what cannot be best at that is left, and
        what the relaxed program, which is prepared, shows not to be best.
        """
        problem, domain, rows = self._problem, self._problem.domain, []
        patterns = problem.moving(moves)
        charges = self._of.charges(patterns)
        for row in np.flatnonzero(cost + charges < problem.best.objective).tolist():
            key = patterns[row].tobytes()
            if key not in self._tried:
                self._tried.add(key)
                if self._of.allows(patterns[row], problem.allowance):
                    rows.append(row)
        if not rows:
            return
        made, none = patterns[rows][:, problem.order], np.zeros((len(rows), len(problem.order)))
        low, high = np.where(made, domain.low, 0.0), np.where(made, domain.high, 0.0)
        found = problem.relaxation.solve_many(low, high, none, none, [starts[row] for row in rows])
        s = np.where(domain.bounded | ~made, found.pulls, 0.0)
        _, rest = problem.terms.priced(found.rows, s)
        least = rest - np.maximum(s * low, s * high).sum(axis=1) + charges[rows]
        least[~found.solved] = -np.inf
        least[found.infeasible] = np.inf
        for k in np.argsort(least).tolist():
            if least[k] >= problem.cutoff:
                return
            if problem.late and problem.best.moves is not None:
                self._out_of_time = True
                return
            problem.offer(patterns[rows[k]])


def _leave_out(Z: Array, moves: BoolArray) -> None:
    """Leave these moves, shape (K, n), out of Z, shape (K, n, n), in place."""
    while len(rows := np.flatnonzero(moves.any(axis=1))):
        i = moves[rows].argmax(axis=1)
        phi = Z[rows, i]
        share = phi / np.square(phi).sum(axis=1, keepdims=True)
        Z[rows] -= (Z[rows] @ phi[:, :, None]) * share[:, None, :]
        Z[rows, i] = 0.0
        moves[rows, i] = False
