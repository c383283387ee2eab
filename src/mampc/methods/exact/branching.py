"""Branch and bound where limits bind: every node is a quadratic program.

At a node some moves are made, some left out, and the others undecided: free within what they can be, at the price
per unit that is at most theirs (see `relaxation`). With the multipliers of its program the cost is a quadratic about
the program's moves d, whose curvature is that of the free moves alone: with P = Z Z' the inverse of their normal
matrix and s_i the pull at the move i, a move x there adds at least

    (x - d_i)^2 / P_ii + p_i [x != 0] - s_i x - min(0, p_i - max s_i x)

Left out, x is zero; made, the least of this within the move's limits counts. What both add, the node costs more;
moves for which one of both is too much are decided at once; the search branches on the move whose leaving out adds
most. Best bound first, so that a search cut short leaves the best bound there is.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.exact.zone_curvature import ZoneCurvature
from mampc.program.least_distance import ROUNDING
from mampc.program.qp import QPStatus
from mampc.program.sample import Indices

UNDECIDED, OUT, MADE = 0, 1, 2


class Solved(NamedTuple):
    """A node's relaxed program.

    Attributes:
        bound: on all that the node leads to.
        d: its moves, shape (n,).
        out, made: what leaving out or making each undecided move adds to the bound at least, shape (n,).
        undecided: which are, shape (n,).
    """

    bound: float
    d: Array
    out: Array
    made: Array
    undecided: BoolArray


class Branching:
    """The search of one sample."""

    def __init__(self, problem: SampleProblem) -> None:
        self._problem, self._of = problem, problem.admissible
        order, m, dwell = problem.order, self._of.n_inputs, self._of.rules.dwell
        self._at = order // m
        self._samples = self._of.control_horizon
        self._price = self._of.price[order % m]
        self._near: BoolArray | None = None  # pairs of moves that the dwell time keeps apart
        if dwell > 1:
            apart = np.abs(self._at[:, None] - self._at)
            self._near = (apart < dwell) & (order[:, None] % m == order % m) & (apart > 0)
        squares, sample = problem.squares, problem.sample
        zoned = squares.condensed.bounds.zones is not None
        self._zones = ZoneCurvature(squares.condensed, squares.normal, order, sample) if zoned else None
        self._tried: set[bytes] = set()
        self._out_of_time = (
            False  # whether the last node's program, or a plan that it shows, had no time left
        )

    def run(self) -> float:
        """A lower bound over everything that was not visited: infinite when the search is complete."""
        problem = self._problem
        state: Indices = np.full(len(self._at), UNDECIDED)
        state[(problem.domain.low == 0) & (problem.domain.high == 0)] = OUT
        heap: list[tuple[float, int, Indices, Array]] = []
        if self._closed(state):
            heap.append((float(problem.terms.rest[0]), 0, state, problem.squares.inverse))
        number = 0  # tells nodes of equal bounds apart
        while heap:
            bound, _, state, Z = heap[0]
            if bound >= problem.cutoff:
                return np.inf
            if problem.late:
                return bound
            heappop(heap)
            Z = self._without(Z, np.flatnonzero((state == OUT) & Z.any(axis=1)))
            for child_bound, child in self._children(bound, state, Z):
                number += 1
                heappush(heap, (child_bound, number, child, Z))
            if self._out_of_time:
                return bound
        return np.inf

    def _children(self, bound: float, state: Indices, Z: Array) -> list[tuple[float, Indices]]:
        """What a node, on which there is a bound, leads to, as far as it may beat the best plan, with bounds."""
        solved = self._solve(state, Z)
        if solved is None or self._out_of_time:
            return []
        if isinstance(solved, QPStatus):
            return self._split(bound, state)
        if solved.bound >= self._problem.cutoff:
            return []
        gap = self._problem.cutoff - solved.bound
        made, out = solved.undecided & (solved.out >= gap), solved.undecided & (solved.made >= gap)
        if (made & out).any():
            return []
        if decided := bool(made.any() or out.any()):
            state = state.copy()
            state[made], state[out] = MADE, OUT
            if not self._closed(state):
                return []
        i = int(np.where(state == UNDECIDED, solved.out, -1.0).argmax())
        if state[i] != UNDECIDED:
            return [(max(bound, solved.bound), state)] if decided else []
        children = []
        for kind, adds in ((OUT, solved.out[i]), (MADE, solved.made[i])):
            child = state.copy()
            child[i] = kind
            if solved.bound + adds < self._problem.cutoff and self._closed(child):
                children.append((max(bound, float(solved.bound + adds)), child))
        return children

    def _split(self, bound: float, state: Indices) -> list[tuple[float, Indices]]:
        """What a node leads to whose program has no answer though it may have one."""
        open_ = np.flatnonzero(state == UNDECIDED)
        if not len(open_):
            self._problem.offer(self._problem.pattern(state == MADE))
            return []
        children = []
        for kind in (OUT, MADE):
            child = state.copy()
            child[open_[0]] = kind
            if self._closed(child):
                children.append((bound, child))
        return children

    def _without(self, Z: Array, left_out: Indices) -> Array:
        """Z with these moves left out."""
        if not len(left_out):
            return Z
        Z = Z.copy()
        for i in left_out:
            phi = Z[i].copy()
            Z -= np.outer(Z @ phi, phi / (phi @ phi))
            Z[i] = 0.0
        return Z

    def _closed(self, state: Indices) -> bool:
        """Leave out what the rules forbid beside the moves made, in place; False where those break a rule."""
        of, made = self._of, state == MADE
        open_ = state == UNDECIDED
        used = int(made.sum())
        if not of.simple:
            at = np.bincount(self._at[made], minlength=self._samples)
            if (at > of.per_step).any():
                return False
            if self._near is not None:
                near = self._near[made].any(axis=0)
                if near[made].any():
                    return False
                state[open_ & near] = OUT
            state[open_ & (at[self._at] >= of.per_step)] = OUT
            if of.simultaneous:
                used = int((at > 0).sum())
                if used >= self._problem.allowance.left:
                    state[open_ & (at[self._at] == 0)] = OUT
                return used <= self._problem.allowance.left
        if used >= self._problem.allowance.left:
            state[open_] = OUT
        return used <= self._problem.allowance.left

    def _solve(self, state: Indices, Z: Array) -> Solved | QPStatus | None:
        """The node's program; None if no moves keep the limits, its status without an answer. Plans shown are tried."""
        domain, of = self._problem.domain, self._of
        undecided, made = state == UNDECIDED, state == MADE
        within = state != OUT
        low, high = np.where(within, domain.low, 0.0), np.where(within, domain.high, 0.0)
        paid = np.zeros(self._samples, dtype=bool)
        slope = undecided
        if of.simultaneous:
            paid[self._at[made]] = True
            slope = undecided & ~paid[self._at]
        up, down = np.where(slope, domain.up, 0.0), np.where(slope, domain.down, 0.0)
        found = self._problem.relaxation.solve_priced(low, high, up, down)
        if not found.solved:
            self._out_of_time = found.status is QPStatus.TIME_LIMIT
            return None if found.infeasible else found.status
        d = found.moves
        s = np.where(domain.bounded | ~within, found.pulls, 0.0)
        _, rest = self._problem.terms.priced(found, s)
        support = np.maximum(np.maximum(s * low, s * high), 0.0)
        variance = self._variance(Z, d, within)
        out = d * d / np.where(variance > 0, variance, np.inf)
        if of.simultaneous:
            bound, adds = self._of_samples(rest, support, undecided, paid)
        else:
            bound, left_out, adds = self._of_moves(rest, s, d, variance, undecided, made)
            out += left_out
        raised = float(np.minimum(out, adds).max(where=undecided, initial=0.0))
        left, moving = self._problem.allowance.left - int(made.sum()), undecided & (d != 0)
        if not of.simultaneous and (more := int(moving.sum()) - left) > 0:
            raised = max(raised, float(np.sort(out[moving])[more - 1]))  # so many have to be left out
        # The moves of the program, and those that are at least half of what they may be.
        cost = bound - of.charge(self._problem.pattern(made)) - float(np.maximum(d * up, -d * down).sum())
        self._try(np.where(within, d, 0.0), cost)
        large = (np.maximum(d * domain.up, -d * domain.down) >= 0.5 * self._price) | made
        self._try(np.where(large & within, d, 0.0), cost)
        return Solved(
            bound + raised, d, np.maximum(out - raised, 0.0), np.maximum(adds - raised, 0.0), undecided
        )

    def _variance(self, Z: Array, d: Array, within: BoolArray) -> Array:
        """The diagonal of the inverse curvature in the moves `within`, about moves d; zero for the others."""
        squares = self._problem.squares
        if self._zones is not None:
            return self._zones.variance(d, within)
        if not squares.orthogonal:
            return np.asarray(np.einsum("iq,iq->i", Z, Z))
        variance = np.zeros(len(d))
        inverse = np.linalg.inv(np.linalg.qr(squares.L[:, :-1][:, within], mode="r"))
        # No less than rounding leaves possible.
        variance[within] = np.square(inverse).sum(axis=1) * (
            1 + len(d) * ROUNDING * squares.condensed.condition
        )
        return variance

    def _of_moves(
        self, rest: float, s: Array, d: Array, variance: Array, undecided: BoolArray, made: BoolArray
    ) -> tuple[float, Array, Array]:
        """Bound, and what leaving out moves adds beside the cost without prices, and what making them adds.

        A move x costs (x - d)^2 / variance - s x more at least, and its price.
        """
        domain = self._problem.domain
        support = domain.support(s)
        gains = np.minimum(self._price - support, 0.0)
        left = self._problem.allowance.left - int(made.sum())
        open_ = np.sort(gains[undecided])
        bound = rest + float((self._price - support)[made].sum() + open_[:left].sum())
        # Without a move that gains the next one may, where the budget leaves one out.
        next_ = open_[left] if left < len(open_) else 0.0
        x = np.minimum(np.maximum(d + 0.5 * s * variance, domain.low), domain.high)
        away = x - d
        adds = self._price - s * x + away * away / np.where(variance > 0, variance, np.inf)
        return bound, np.maximum(next_ - gains, 0.0), np.maximum(adds - gains, 0.0)

    def _of_samples(
        self, rest: float, support: Array, undecided: BoolArray, paid: BoolArray
    ) -> tuple[float, Array]:
        """Bound and what making moves adds, where samples have a price."""
        pull = np.bincount(self._at, weights=support, minlength=self._samples)
        open_ = np.bincount(self._at[undecided], minlength=self._samples) > 0
        price = self._of.price[0]
        adds = np.where(open_ & ~paid, price - pull, 0.0)
        gains = np.minimum(adds, 0.0)
        left = self._problem.allowance.left - int(paid.sum())
        kept = np.sort(gains)[:left] if left < len(gains) else gains
        bound = rest + float((price - pull)[paid].sum() - pull[~paid & ~open_].sum() + kept.sum())
        return bound, (adds - gains)[self._at]

    def _try(self, moves: Array, cost: float) -> None:
        """Offer the best plan with the moves that are not zero, if they keep the rules.

        `cost` is about the least that they cost without prices: what cannot be best at that is left, and what the
        relaxed program, which is prepared, shows not to be best.
        """
        problem, pattern = self._problem, self._problem.moving(moves)
        key, charge = pattern.tobytes(), self._of.charge(pattern)
        if key in self._tried or cost + charge >= problem.best.objective:
            return
        if problem.late and problem.best.moves is not None:
            self._out_of_time = True
            return
        self._tried.add(key)
        if not self._of.allows(pattern, problem.allowance):
            return
        made, domain = pattern[problem.order], problem.domain
        low, high = np.where(made, domain.low, 0.0), np.where(made, domain.high, 0.0)
        found = problem.relaxation.solve(low, high)
        if found.solved:
            s = np.where(domain.bounded | ~made, found.pulls, 0.0)
            _, rest = problem.terms.priced(found, s)
            cost = rest - float(np.maximum(s * low, s * high).sum())
            if cost + charge >= problem.cutoff:
                return
        if not found.infeasible:
            problem.offer(pattern)
