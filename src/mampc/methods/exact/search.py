"""The sparse problem solved exactly, with a proof.

Every admissible pattern has a lower bound that needs no solver: its optimum without limits. Patterns are
taken best bound first; where the optimum keeps every limit, it is the pattern's own and the search is over;
otherwise a quadratic program on the pattern gives its best moves and, as a by-product, multipliers of the
limits. Any multipliers turn the limits into a change of the linear term (Lagrangian relaxation), so that all
patterns can be ranked again with limits priced in, first by those of plain MPC. The search ends when no bound beats
the best plan.

Few patterns are listed in a table (`ranking`, `open_patterns`); more are searched as a tree (`tree`) by the same
bounds.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from mampc.base.checks import Array, BoolArray, as_number
from mampc.base.errors import MampcError
from mampc.base.tolerances import INSIDE, TIE, tie
from mampc.base.words import Remark, Status
from mampc.methods.exact.open_patterns import OpenPatterns
from mampc.methods.exact.ranking import LARGEST_BESIDE_DATA, Ranking, ranking_of
from mampc.methods.exact.relaxation import Relaxation
from mampc.methods.exact.tree import PatternTree
from mampc.methods.method import HELD_BY, Plan, shifted
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.pattern_solver import Incumbent, OnPattern, PatternSolver
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample

MOST_BESIDE_LEVELS = 1000  # patterns of inputs without levels that are tried one by one
FINE = 0.1  # of a move's price: what it costs at most, on average, to round a move to a level of a fine grid
TOGETHER = 3  # patterns of the table whose limits are priced together


@dataclass(frozen=True, kw_only=True)
class Exact:
    """Settings of the exact search.

    Args:
        time_limit: seconds a sample may take; then the best plan so far is given with a valid lower bound
            and the status `time_limit`. Problems of some dozen moves take milliseconds; None searches on until
            the optimum is proven, whatever it takes.
    """

    time_limit: float | None = 1.0

    def __post_init__(self) -> None:
        if self.time_limit is not None:
            as_number("time_limit", self.time_limit, 0.0, exclusive=True)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> ExactSearch:
        """The search for one problem and one set of rules."""
        return ExactSearch(self, condensed, rules)


class ExactSearch:
    """The exact search, prepared for one condensed problem."""

    warm_up = 0

    def __init__(self, settings: Exact, condensed: CondensedQP, rules: MoveRules) -> None:
        problem = condensed.problem
        self.settings, self.condensed = settings, condensed
        self.admissible = AdmissiblePatterns(
            rules, problem.model.n_inputs, problem.control_horizon, condensed.input_prefix
        )
        # After a move of more than half its range an input can only go back; the tree knows where inputs are.
        limits, size = problem.limits, self.admissible.min_size[: problem.model.n_inputs]
        coarse = bool((2 * size > limits.u_max - limits.u_min).any())
        self._solver = PatternSolver(condensed, self.admissible)
        self._ranking: Ranking | None = None
        self._free = self._patterns_beside_levels()
        if self._free is not None:
            return
        # Zones give patterns no bound that needs no solver.
        zoned = condensed.bounds.zones is not None and not self.admissible.sized
        if zoned and self.admissible.on_levels:
            raise MampcError(
                f"levels: expected at most {MOST_BESIDE_LEVELS} patterns of the inputs without levels where outputs "
                "have zones, received more; shorten the control horizon"
            )
        self._ranking = None if coarse or zoned else ranking_of(condensed, self.admissible)
        if self._ranking is None:
            self._tree = PatternTree(condensed, self.admissible, settings.time_limit)
        self._relaxation: Relaxation | None = None
        if self._ranking is not None and condensed.bounds.every_move:
            self._relaxation = Relaxation(condensed, np.arange(condensed.n_moves), condensed.U)

    def beside_later_data(self) -> ExactSearch:
        """This search for plans that count on later data: by a table where a tree would find no proof in time."""
        searched_as_tree = self._free is None and self._ranking is None and not self.admissible.sized
        if not searched_as_tree or self.condensed.bounds.zones is not None:
            return self
        ranking = ranking_of(self.condensed, self.admissible, LARGEST_BESIDE_DATA)
        if ranking is None:
            return self
        listing = copy(self)
        listing._ranking = ranking
        return listing

    @property
    def has_table(self) -> bool:
        """Whether all patterns are listed."""
        return self._ranking is not None

    def _patterns_beside_levels(self) -> BoolArray | None:
        """The patterns, shape (K, n_moves), of inputs without levels where others have some, if they are few.

        None too where levels are fine beside prices: then patterns decide, and hardly what levels leave of their plans.
        """
        free = self._solver.free
        if free is None or (self.condensed.bounds.zones is None and self._solver.rounding_cost < FINE):
            return None
        if self.admissible.nested and self.admissible.rules.max_moves is None:
            return (self.admissible.candidates & free)[None]
        return self.admissible.listed(MOST_BESIDE_LEVELS, free)

    def plan(self, sample: Sample, inputs: Array, guess: Array | None = None) -> Plan:
        """The best moves of all admissible patterns for one sample; a tree tries those of the `guess` early."""
        past, solver = self.admissible.allowance(inputs, sample.frozen), self._solver.after(inputs)
        if past.exceeded:
            plan = self._search(sample, past, solver, guess)
            return plan._replace(remarks=(Remark.BUDGET_EXCEEDED, *plan.remarks))
        return self._search(sample, past, solver, guess)

    def _search(self, sample: Sample, past: Allowance, solver: PatternSolver, guess: Array | None) -> Plan:
        if self._free is not None:
            return self._search_levels(self._free, sample, past, solver)
        ranking = self._ranking
        if ranking is None:
            return self._search_tree(sample, past, solver, guess)
        bounds = ranking.bounds(sample.moves, sample.cost, past, sample.later_data)
        best = int(bounds.argmin())
        if not (self.admissible.sized or self.admissible.on_levels):
            at = ranking.rows(past).start + best
            optimum = ranking.optimum(at, sample)
            margins = optimum.margins
            if not len(margins) or margins[margins.argmin()] > INSIDE:
                objective = optimum.cost + float(ranking.charge[at])
                if sample.later_data is not None:
                    objective += sample.charge(ranking.patterns[at])
                if objective - bounds[best] <= TIE * objective:
                    return Plan(
                        optimum.moves, Status.OPTIMAL, 1, None, None, optimum.inputs, objective,
                    )  # fmt: skip
        return self._search_ranking(ranking, bounds, sample, past, solver)

    def _deadline(self) -> float:
        limit = self.settings.time_limit
        return np.inf if limit is None else perf_counter() + 0.95 * limit

    def _search_levels(
        self, patterns: BoolArray, sample: Sample, past: Allowance, solver: PatternSolver
    ) -> Plan:
        """All courses of inputs on levels beside each pattern of the others."""
        best, deadline, limits, open_bound = Incumbent(), self._deadline(), None, np.inf
        if self.condensed.bounds.zones is not None or sample.margins.min(initial=np.inf) < 0:
            plain = self.condensed.plain.solve(sample.moves, sample.lower, sample.upper)
            limits = solver.priced(sample, plain.multipliers)
        allowed = self.admissible.open(past)
        for free in patterns:
            if len(patterns) == 1:
                free = free & allowed
            elif (free & ~allowed).any() or self.admissible.count(free) > past.left:
                continue
            if best.moves is not None and perf_counter() > deadline:
                open_bound = min(open_bound, sample.cost)
                break
            found = solver.best_course(sample, past, free, limits, best.objective, deadline)
            status = QPStatus.OPTIMAL if found.complete else QPStatus.TIME_LIMIT
            best.offer(OnPattern(found.moves, found.objective, status, None, found.visited))
            if not found.complete:
                open_bound = min(open_bound, found.bound)
        if open_bound < best.objective:
            return self._plan(sample, best, open_bound, Status.TIME_LIMIT)
        return self._plan(sample, best, best.objective)

    def _search_ranking(
        self, ranking: Ranking, bounds: Array, sample: Sample, past: Allowance, solver: PatternSolver
    ) -> Plan:
        """Patterns of the table best bound first, bounded anew whenever a program shows other multipliers."""
        best, deadline, condensed = Incumbent(), self._deadline(), self.condensed
        rounding, open_ = condensed.rounding(sample), OpenPatterns(ranking, sample, past, bounds)
        cutoff, margins = np.inf, sample.margins
        if len(margins) and margins[margins.argmin()] < 0:
            plain = condensed.nearest(sample)
            first = solver.priced(sample, plain.multipliers)
            if first is not None:
                open_.price(first, cutoff)
        relaxation = None if self._relaxation is None else self._relaxation.at(sample, sample.moves)
        at, bound = open_.best()
        while not bound >= cutoff:
            if perf_counter() > deadline:
                return self._plan(sample, best, bound, Status.TIME_LIMIT)
            pattern = ranking.patterns[open_.rows[at]]
            solved = solver.solve(sample, pattern, best.objective, deadline, paid=self.admissible.priced)
            if best.offer(solved, bound):
                cutoff = best.objective - tie(best.objective, rounding)
            if solved.status is QPStatus.TIME_LIMIT:
                return self._plan(sample, best, bound, Status.TIME_LIMIT)
            open_.close(at)
            at, bound = open_.best()
            if bound >= cutoff:
                break
            limits = solver.priced(sample, solved.multipliers)
            if limits is not None:
                open_.price(limits, cutoff)
                # What limits moves that this pattern does not make shows with those of the best ones left together.
                if relaxation is not None and len(few := open_.first(TOGETHER)):
                    made = np.asarray(ranking.patterns[few].any(axis=0))
                    together = solver.priced(sample, relaxation.with_moves(sample, made))
                    if together is not None:
                        open_.price(together, cutoff)
                at, bound = open_.best()
        return self._plan(sample, best, best.objective)

    def _search_tree(
        self, sample: Sample, past: Allowance, solver: PatternSolver, guess: Array | None
    ) -> Plan:
        best, first = Incumbent(), None if guess is None else guess.ravel() != 0
        open_bound = self._tree.search(sample, past, best, self._deadline(), solver, first)
        status = Status.TIME_LIMIT if open_bound < best.objective else Status.OPTIMAL
        plan = self._plan(sample, best, min(open_bound, best.objective), status)
        return (
            plan if best.moves is None else plan._replace(guess=shifted(best.moves, self.admissible.n_inputs))
        )

    def _plan(self, sample: Sample, best: Incumbent, bound: float, status: Status = Status.OPTIMAL) -> Plan:
        remarks: tuple[Remark, ...] = ()
        if best.failure is not None and best.unproven < best.objective:
            bound, remarks = min(bound, best.unproven), (Remark.ROUNDING,)
            status = Status.FEASIBLE if status is Status.OPTIMAL else status
        if best.moves is None:
            if status is Status.OPTIMAL:
                return Plan(None, Status.HELD_INFEASIBLE, best.solved)
            if best.failure is not None:
                return Plan(None, HELD_BY[best.failure], best.solved)
            hold = np.zeros(self.condensed.n_moves)
            if sample.bounds_now is not None and sample.bounds_now.on(hold != 0) is None:
                return Plan(None, Status.HELD_INFEASIBLE, best.solved)
            return Plan(hold, status, best.solved, bound, remarks=remarks)
        lower = None if status is Status.OPTIMAL else min(bound, best.objective)
        return Plan(best.moves, status, best.solved, lower, None, None, best.objective, remarks)
