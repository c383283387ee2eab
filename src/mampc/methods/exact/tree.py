"""Branch and bound over move patterns, in the order of time.

A node has decided the moves up to some level of the time-major order: those of S are made, the others not. All
later moves are relaxed to be free, which leaves a small least squares problem (see `nodes`): a sum of squares that
rises from the free optimum as moves are left out. Early moves matter most and late ones little, so that few nodes
survive. Moves of a least size go up or down; with the sign comes an interval, and where limits leave one value
that is the move.

Limits, and prices of later moves, come in by multipliers (see `terms`). No multipliers suit all nodes, so each is
bounded with several, and takes the largest bound: those of the relaxed program of the root, of the most promising
node of each batch, and of leaves. Where moves have limits and a price, the relaxed programs are so good that every
node is given its own (see `branching`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.branching import Branching
from mampc.methods.exact.children import children_of
from mampc.methods.exact.leaves import Leaves, appraised, finished, with_one_more
from mampc.methods.exact.nodes import Nodes, lift, renewed, root_of, trimmed, variance_of, worked_out
from mampc.methods.exact.relaxation import Multipliers, Relaxation
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.exact.terms import Squares
from mampc.methods.exact.zone_search import search_zones
from mampc.methods.local_search import LocalSearch
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.pattern_solver import Incumbent, PatternSolver
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Indices, Sample

CHUNK = 256  # nodes treated at once; half as many where each has three children
TOGETHER = 64  # leaves tried at once
FIRST = 4  # of the nodes that spend their budget; the others are tried when their turn comes
SEVERAL = 32  # nodes take longer than a relaxed program
SHARE = 0.5  # of the time limit that one relaxed program may take
WORTH = 0.01  # of the gap at the root: prices of moves that can be large close nothing


class PatternTree:
    """The search tree of one problem; `search` runs it for one sample."""

    def __init__(
        self,
        condensed: CondensedQP,
        admissible: AdmissiblePatterns,
        time_limit: float | None,
    ) -> None:
        self._admissible = admissible
        order = np.flatnonzero(admissible.candidates)
        self._squares = Squares(condensed, order)
        self._relaxation = Relaxation(
            condensed, order, self._squares.L[:, :-1], None if time_limit is None else SHARE * time_limit
        )
        self._local = LocalSearch(condensed, admissible)
        # A price per unit says little of moves that can be large.
        limits = condensed.problem.limits
        self._close = admissible.priced and not (admissible.sized or admissible.on_levels)
        self._close &= bool(np.isfinite(limits.du_max).any())
        # Relaxed without their bounds, errors of zones tell nothing.
        self._zoned = condensed.bounds.zones is not None and not admissible.sized

    def search(
        self,
        sample: Sample,
        allowance: Allowance,
        best: Incumbent,
        deadline: float,
        solver: PatternSolver,
        first: BoolArray | None = None,
    ) -> float:
        """Visit every admissible pattern that may cost less than the best plan, to which better ones are offered.

        Args:
            deadline: of `perf_counter`.
            solver: of the programs on patterns.
            first: a pattern to try before others, if it is admissible, where moves have limits and a price.

        Returns:
            A lower bound over everything that was not visited: infinite when the search is complete.
        """
        problem = SampleProblem(
            self._squares, self._relaxation, self._admissible, solver, sample, allowance, best, deadline
        )
        problem.offer(problem.pattern(np.zeros(0, dtype=np.intp)))
        if self._close and first is not None and self._admissible.allows(first, allowance):
            problem.offer_first(first)
        if not (allowance.left > 0 and len(problem.order)):
            return np.inf
        if self._zoned:
            return search_zones(problem, solver, self._local)
        limited, close = bool(sample.margins.min(initial=np.inf) < 0), self._close
        root = self._relax_root(problem) if limited else None
        batches = _BatchSearch(problem)
        if not (limited and close):
            terms, f = problem.terms, np.zeros(self._admissible.n_moves)
            f[problem.order] = -2.0 * (terms.c[:, -1] @ self._squares.L[:, :-1])
            self._local.offer(solver, sample, f, allowance, best, deadline)
            found = problem.relaxation.of_bounds(best.multipliers)
            if found is not None and found.active:
                terms.add(found)
            if not limited and self._admissible.priced and not batches.ends_at_once:
                root = self._relax_root(problem, WORTH)
                close &= root is not None
        if problem.terms.at_root(allowance.left) >= problem.cutoff:
            return np.inf
        return Branching(problem).run(root) if close and not batches.ends_at_once else batches.run()

    def _relax_root(self, problem: SampleProblem, worth: float = 0.0) -> Multipliers | None:
        """Bound everything with limits and prices as a relaxed program has them, and try its moves.

        Its multipliers; None where they close less than a share `worth` of the gap and are dropped again, since each
        batch of nodes would take a program more, or where there are none.
        """
        domain, terms = problem.domain, problem.terms
        found = problem.relaxation.solve_priced(domain.low, domain.high, domain.up, domain.down)
        if not found.solved or not found.active:
            return None
        without = terms.at_root(problem.allowance.left)
        terms.add(found)
        closed = terms.at_root(problem.allowance.left) - without
        close = not worth or closed >= worth * (problem.cutoff - without)
        if not close:
            terms.drop_latest()
        pattern = problem.moving(found.moves)
        if self._admissible.allows(pattern, problem.allowance):
            problem.offer_first(pattern)
        return found if close else None


class _Pending(NamedTuple):
    """Nodes of one level that wait, whose columns belong to the terms `ids`; none costs less than `least`."""

    least: float
    level: int
    nodes: Nodes
    ids: list[int]


def _pending(level: int, nodes: Nodes, ids: list[int]) -> _Pending:
    return _Pending(float(nodes.bound.min(initial=np.inf)), level, nodes, ids)


class _BatchSearch:
    """The search of one sample, many nodes of one level at a time."""

    def __init__(self, problem: SampleProblem) -> None:
        self._problem, self._of, self._terms = problem, problem.admissible, problem.terms
        self._squares, self._order = problem.squares, problem.order
        self._left_at_root = problem.allowance.left
        # Nodes that get one move more at most need no descendants: all last moves are priced at once. Beside a least
        # size only the first move is, whose sign its program finds.
        self._resolves = not (self._of.simultaneous or self._squares.refined)
        # Another move never costs more: then only patterns that spend the whole budget are of interest.
        self._nested = self._of.simple and not (
            self._of.priced or self._of.sized or any(problem.allowance.frozen)
        )

    @property
    def ends_at_once(self) -> bool:
        """Whether no two moves pay."""
        left = self._problem.allowance.left
        return self._resolves and self._terms.at_root(left, 2) >= self._problem.cutoff

    def run(self) -> float:
        """A lower bound over everything that was not visited: infinite when the search is complete."""
        problem, n = self._problem, len(self._order)
        chunk = CHUNK // 2 if self._of.sized else CHUNK
        root = self._bounded(0, root_of(self._terms, problem.allowance, self._of))
        pending = [_pending(0, root, list(self._terms.ids))]
        while pending:
            if problem.late:
                return _least_bound(pending)
            # Depth first ends soonest; where no end is in sight, best bound first proves most.
            _, level, nodes, ids = pending.pop(_best_of(pending) if problem.lasting else -1)
            nodes = nodes.below(problem.cutoff)
            if not len(nodes.bound):
                continue
            if len(nodes.bound) > chunk:
                by_bound = np.argsort(nodes.bound, kind="stable")
                pending.append(_pending(level, nodes.take(by_bound[chunk:]), ids))
                nodes = nodes.take(by_bound[:chunk])
            nodes = self._renewed(level, nodes, ids)
            ids = list(self._terms.ids)
            ended = nodes.used >= self._left_at_root - self._resolves
            if self._resolves and self._of.priced:
                ended |= self._bound_of(level, nodes, 2) >= problem.cutoff  # two more moves do not pay
            if self._of.sized:
                ended &= nodes.width == 0
            if ended.any() and (self._resolves or self._nested):
                if self._resolves:
                    self._try_last_moves(level, nodes.take(ended))
                else:
                    self._try(level, nodes.take(ended))
                if problem.late:
                    return _least_bound([*pending, _pending(level, nodes, ids)])
                nodes = self._renewed(level, nodes.take(~ended), ids)
                if not len(nodes.bound):
                    continue
                ids = list(self._terms.ids)
            children, made = children_of(level, nodes, problem)
            if made is not None:
                self._try(level + 1, made if level + 1 == n or not self._nested else self._first(made))
                if problem.late:
                    # These nodes bound their descendants, those just tried among them.
                    return _least_bound([*pending, _pending(level, nodes, ids)])
            if level + 1 == n:
                continue
            children = self._growable(level, children)
            if len(children.bound):
                children = trimmed(children)
                if self._squares.orthogonal:
                    children = worked_out(level + 1, children, self._squares, self._terms)
                else:
                    children = self._renewed(level + 1, children, ids)
                children = self._bounded(level + 1, children)
                children = self._sharpened(level + 1, children.below(problem.cutoff)).below(problem.cutoff)
            if len(children.bound):
                pending.append(_pending(level + 1, children, list(self._terms.ids)))
        return np.inf

    def _renewed(self, level: int, nodes: Nodes, ids: list[int]) -> Nodes:
        """The nodes, whose columns belong to the terms `ids`, with those of the terms there are now."""
        now = self._terms.ids
        if ids == now:
            return nodes
        if self._squares.orthogonal:
            return worked_out(level, nodes, self._squares, self._terms)
        columns = [k for k in range(len(now)) if k >= len(ids) or ids[k] != now[k]]
        return renewed(level, nodes, columns, self._squares, self._terms)

    def _bounded(self, level: int, nodes: Nodes) -> Nodes:
        """The nodes, which have decided `level` moves and will make another one, with their bounds."""
        return nodes._replace(bound=np.maximum(nodes.bound, self._bound_of(level, nodes, 1)))

    def _bound_of(self, level: int, nodes: Nodes, more: int) -> Array:
        """What nodes, which have decided `level` moves, cost with at least so many more, shape (N,)."""
        paid = nodes.now > 0 if self._of.simultaneous else None
        value = nodes.value + self._terms.later(level, self._left_at_root - nodes.used, paid, more)
        if self._of.sized:
            value += lift(nodes.low, nodes.high, nodes.d, variance_of(nodes.root))
        return np.asarray(value.max(axis=1) + nodes.charge)

    def _sharpened(self, level: int, nodes: Nodes) -> Nodes:
        """The nodes bounded with the multipliers of the most promising one, where limits matter and it may pay."""
        if len(self._terms.ids) == 1 or len(nodes.bound) < SEVERAL:
            return nodes
        domain, row = self._problem.domain, int(nodes.bound.argmin())
        undecided = np.arange(len(self._order)) >= level
        low, high = self._intervals(nodes.chosen[row], nodes.low[row], nodes.high[row])
        found = self._problem.relaxation.solve_priced(
            np.where(undecided, domain.low, low), np.where(undecided, domain.high, high),
            np.where(undecided, domain.up, 0.0), np.where(undecided, domain.down, 0.0),
        )  # fmt: skip
        if not found.solved or not found.active:
            return nodes
        ids = list(self._terms.ids)
        self._terms.add(found)
        return self._bounded(level, self._renewed(level, nodes, ids))

    def _intervals(self, chosen: Indices, low: Array, high: Array) -> tuple[Array, Array]:
        """The intervals of all moves, shape (n,), where those `chosen` are made and the others are not."""
        made, domain = chosen[chosen >= 0], self._problem.domain
        least, most = np.zeros(len(self._order)), np.zeros(len(self._order))
        if self._of.sized:
            least[made], most[made] = low[: len(made)], high[: len(made)]
        else:
            least[made], most[made] = domain.low[made], domain.high[made]
        return least, most

    def _growable(self, level: int, nodes: Nodes) -> Nodes:
        """The nodes that may still get a move after this level, with `now` for the next move."""
        of = self._of
        if self._order[level + 1] // of.n_inputs != self._order[level] // of.n_inputs:
            nodes = nodes._replace(now=np.zeros_like(nodes.now))
        spent = nodes.used >= self._left_at_root
        if of.simultaneous:
            spent &= nodes.now == 0
        return nodes.take(~spent) if spent.any() else nodes

    def _first(self, made: Nodes) -> Nodes:
        """The most promising of those that have spent their budget."""
        rows = np.flatnonzero(made.used >= self._left_at_root)
        if len(rows) > FIRST:
            rows = rows[np.argpartition(made.value[rows].max(axis=1), FIRST)[:FIRST]]
        return made.take(rows)

    def _try(self, level: int, made: Nodes) -> None:
        """Try the patterns of these nodes with no further move."""
        if not len(made.bound):
            return
        made = trimmed(made)
        if self._squares.orthogonal:
            leaves = Leaves(made.chosen, made.charge, made.low, made.high, made.bound)
            leaves = appraised(leaves, self._squares, self._terms, list(range(len(self._terms.ids))))
        else:
            leaves, _ = finished(level, made, self._squares, self._terms)
        self._try_all(leaves)

    def _try_last_moves(self, level: int, nodes: Nodes) -> None:
        """Try the patterns of these nodes with one more move, as far as they may beat the best plan."""
        of, order, nodes = self._of, self._order[level:], trimmed(nodes)
        leaves, rest = finished(level, nodes, self._squares, self._terms)
        j, a = order // of.n_inputs, order % of.n_inputs
        charge = leaves.charge[:, None] + of.price[a]
        may = j >= nodes.last[:, a] + of.rules.dwell
        if of.per_step < of.n_inputs:
            may &= (j > j[0]) | (nodes.now[:, None] < of.per_step)
        limit = np.where(may, self._problem.cutoff - charge, -np.inf)
        bound = with_one_more(level, nodes, rest, self._squares, self._terms, limit) + charge
        rows, columns = np.nonzero(may & (bound < self._problem.cutoff))
        chosen = np.full((len(rows), int(nodes.width.max(initial=0)) + 1), -1)
        chosen[:, : leaves.chosen.shape[1]] = leaves.chosen[rows]
        chosen[np.arange(len(rows)), nodes.width[rows]] = level + columns
        bound = np.maximum(bound[rows, columns], nodes.bound[rows])
        low, high = leaves.low[rows], leaves.high[rows]
        if of.sized:
            low, high = (of_move[chosen] for of_move in (self._problem.domain.low, self._problem.domain.high))
        self._try_all(Leaves(chosen, charge[rows, columns], low, high, bound))

    def _try_all(self, leaves: Leaves) -> None:
        """Try these patterns, some at once."""
        if len(leaves.bound) > TOGETHER:
            leaves = leaves.take(np.argsort(leaves.bound, kind="stable"))
        for first in range(0, len(leaves.bound), TOGETHER):
            if not self._try_leaves(leaves.take(slice(first, first + TOGETHER))):
                return

    def _try_leaves(self, leaves: Leaves) -> bool:
        """Try these patterns, best bound first; says whether others of larger bounds may be worth it."""
        problem, terms = self._problem, self._terms
        left = leaves.bound < problem.cutoff
        if not left.any():
            return False
        while leaves.bound[row := int(leaves.bound.argmin())] < problem.cutoff:
            if problem.late:
                return False
            left = leaves.bound < problem.cutoff
            if not left.all():
                leaves = leaves.take(left)
                row = int(leaves.bound.argmin())
            if limited := len(terms.ids) > 1:
                relaxed = problem.relaxation.solve(
                    *self._intervals(leaves.chosen[row], leaves.low[row], leaves.high[row])
                )
                if relaxed.infeasible:
                    leaves.bound[row] = np.inf
                    continue
                leaves = self._priced(leaves, relaxed)
            if not limited or leaves.bound[row] < problem.cutoff:
                before, within = problem.best.objective, None
                positions = leaves.chosen[row][leaves.chosen[row] >= 0]
                if self._of.sized:
                    low, high = leaves.low[row, : len(positions)], leaves.high[row, : len(positions)]
                    size = self._of.min_size[self._order[positions]]
                    within = None if ((low < size) & (high > -size) & (size > 0)).any() else (low, high)
                found = problem.offer(problem.pattern(positions), within)
                leaves.bound[row] = np.inf
                leaves = self._priced(leaves, found)
                if problem.best.objective < before:
                    continue
            left = leaves.bound < problem.cutoff
            if left.sum() > 1 and len(terms.ids) > 1:
                leaves = self._priced(leaves, self._of_all(leaves, left))
        return True

    def _of_all(self, leaves: Leaves, rows: BoolArray) -> Multipliers:
        """Multipliers with the moves of all these patterns: those of one say little of moves that it does not make."""
        made = np.zeros(len(self._order), dtype=bool)
        chosen = leaves.chosen[rows]
        made[chosen[chosen >= 0]] = True
        domain = self._problem.domain
        return self._problem.relaxation.solve(
            np.where(made, domain.low, 0.0), np.where(made, domain.high, 0.0)
        )

    def _priced(self, leaves: Leaves, found: Multipliers | None) -> Leaves:
        """The leaves bounded with one more term."""
        if found is None or not found.solved or not found.active:
            return leaves
        self._terms.add(found)
        return appraised(leaves, self._squares, self._terms, [self._terms.latest])


def _best_of(pending: list[_Pending]) -> int:
    """Which of them has the least bound; the deepest of several."""
    return min(range(len(pending)), key=lambda k: (pending[k].least, -pending[k].level))


def _least_bound(pending: list[_Pending]) -> float:
    return min(nodes.least for nodes in pending)
