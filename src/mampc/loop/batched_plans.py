"""First inputs of many loops at once, where plain MPC or the exact search need no solver.

Everything a sample needs is affine in its parameter p, so one product per quantity serves all loops: the optimum
with every move free, and that on any one pattern. Its map is read off on unit vectors. The best pattern comes from a
table of what patterns cost more than the free optimum d*: with E the moves that a pattern leaves out,

    |T d*_E|^2 + price of the pattern,    T the lower right block of a QR of U with E's columns last,

linear in the products d*_i d*_k. A loop is left undecided, for an ordinary step, where an optimum breaks a limit, where
another pattern is as good up to rounding, or where anything else asks for a closer look.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray
from mampc.base.tolerances import INSIDE, ROUNDING, SAME, TIE
from mampc.controllers import MAMPC, MPC, ControllerBank
from mampc.controllers.controller import Controller
from mampc.methods import Exact
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.condensing import CondensedQP
from mampc.program.restriction import excess_table
from mampc.program.sample import Optimum, Sample
from mampc.rivals.rules import DeadBand, Rounded, Rule

LARGEST_TABLE = 1_000_000  # entries
BLOCK = 1_000_000  # entries of the costs of all patterns in some loops that are looked at together
MOST_KEPT = 1000  # maps of patterns, and pasts


class Maps:
    """What one optimum without limits gives, by its map: margins, moves and first inputs of many loops."""

    def __init__(self, optima: list[Optimum], m: int) -> None:
        """From the values at each unit vector."""
        self._margins = np.array([optimum.margins for optimum in optima])
        self._moves = np.array([optimum.moves for optimum in optima])
        self._inputs = np.array([optimum.inputs[:m] for optimum in optima])

    def at(self, parameters: Array) -> tuple[BoolArray, Array, Array]:
        """For parameters (S, p): whether all limits are kept (S,), moves (S, n_moves), first inputs (S, m)."""
        margins = parameters @ self._margins
        inside: BoolArray = margins.min(axis=1, initial=np.inf) > INSIDE
        return inside, parameters @ self._moves, parameters @ self._inputs


class BatchedPlans:
    """The plans of many loops under one controller; see `batched_plans` for those that there are."""

    def __init__(self, controller: Controller, preview: bool) -> None:
        problem, condensed = controller.problem, controller.condensed
        model, self._condensed = problem.model, condensed
        limits = problem.limits
        self._m = m = model.n_inputs
        self._low, self._high = np.maximum(limits.u_min, -LARGEST / 2), np.minimum(limits.u_max, LARGEST / 2)
        reference = np.zeros(
            (problem.prediction_horizon + 1, model.n_outputs) if preview else model.n_outputs
        )
        size = len(condensed.parameter.vector(np.zeros(model.n_states), np.zeros(m), reference))
        self._units: list[Sample] = [condensed.sample(unit, np.zeros(m)) for unit in np.eye(size)]
        self._free = Maps(list(self._units), m)
        self.memory = controller.memory

    def decide(
        self, parameters: Array, inputs: Array, hypotheses: Array | None = None
    ) -> tuple[BoolArray, Array]:
        """Which loops are decided, shape (S,), and their inputs, shape (S, m).

        Args:
            parameters: of `Parameter`, shape (S, p).
            inputs: applied so far, latest last, shape (S, h, m).
            hypotheses: how likely each one is, shape (S, B), for plans that count on later data.
        """
        decided, _, first = self._free.at(parameters)
        return decided & ((first >= self._low) & (first <= self._high)).all(axis=1), first

    def under(self, variant: str | None) -> BatchedPlans:
        """The plans under a variant of a bank."""
        return self


class PatternTable:
    """What every pattern costs and leads to, whatever the price."""

    def __init__(self, condensed: CondensedQP, patterns: BoolArray, units: list[Sample], m: int) -> None:
        self.patterns = patterns
        self._condensed, self._units, self._m = condensed, units, m
        U = condensed.U
        self.size = np.linalg.norm(U, axis=0)
        U = U / self.size  # in units that make all moves alike
        self._rows, self._columns = np.triu_indices(len(U))
        self._table = np.ascontiguousarray(excess_table(U, patterns).T)
        # Of the sum of |d*_i d*_k| in those units: what rounding may do to a cost.
        self.rounding = 1e-13 + 100 * np.finfo(float).eps * float(np.linalg.cond(U))
        self._maps: OrderedDict[int, Maps] = OrderedDict()

    def excess(self, d: Array) -> Array:
        """What each pattern costs more than the free optimum d (S, n_moves) in units of `size`, shape (S, K)."""
        product: Array = (d.take(self._rows, axis=1) * d.take(self._columns, axis=1)) @ self._table
        return product

    def map(self, index: int) -> Maps:
        """The optimum on a pattern."""
        known = self._maps.get(index)
        if known is None:
            optimum = self._condensed.optimum_on(self.patterns[index])
            known = self._maps[index] = Maps([optimum.at(unit) for unit in self._units], self._m)
            if len(self._maps) > MOST_KEPT:
                self._maps.popitem(last=False)
        return known


class BatchedExact(BatchedPlans):
    """The exact search of many loops, by a table of all patterns.

    Args:
        controller: of the problem and the model of `like`, if that is given.
        preview: as in `batched_plans`.
        admissible, patterns: of its rules.
        like: whose table is shared where it is of the same patterns.
    """

    def __init__(
        self, controller: MAMPC, preview: bool, admissible: AdmissiblePatterns, patterns: BoolArray,
        like: BatchedPlans | None = None,
    ) -> None:  # fmt: skip
        super().__init__(controller, preview)
        self._admissible, self._patterns = admissible, patterns
        self._information = controller.information
        self._counts = admissible.counts(patterns)
        self._charge = admissible.charges(patterns)
        table: PatternTable | None = like.table if isinstance(like, BatchedExact) else None
        if table is None or not np.array_equal(table.patterns, patterns):
            table = PatternTable(self._condensed, patterns, self._units, self._m)
        self.table: PatternTable = table
        self._allowances: dict[bytes, Allowance] = {}
        self._costs: dict[Allowance, Array] = {}

    def decide(
        self, parameters: Array, inputs: Array, hypotheses: Array | None = None
    ) -> tuple[BoolArray, Array]:
        first = inputs[:, -1].copy()
        decided: BoolArray = ((first >= self._low) & (first <= self._high)).all(axis=1)
        optima = self._free.at(parameters)[1] * self.table.size
        best, clear = self._best(optima, inputs, hypotheses)
        decided &= clear
        order = np.argsort(best, kind="stable")
        ends = np.flatnonzero(np.diff(best[order], append=-1))
        for group in np.split(order, ends[:-1] + 1):
            inside, moves, u = self.table.map(int(best[group[0]])).at(parameters[group])
            small = np.abs(moves)
            decided[group] &= inside & ~((small > 0) & (small <= ROUNDING * self._condensed.move_prefix)).any(
                axis=1
            )
            decided[group] &= ((u >= self._low) & (u <= self._high)).all(axis=1)
            first[group] = u
        return decided, first

    def _best(
        self, optima: Array, inputs: Array, hypotheses: Array | None
    ) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], BoolArray]:
        """The best pattern of each loop, shape (S,), and whether no other is as good."""
        best, clear = np.empty(len(optima), dtype=np.intp), np.empty(len(optima), dtype=bool)
        costs = self._pattern_costs(inputs)
        if self._information is not None and hypotheses is not None:
            costs = costs + self._information.charges(self._patterns, hypotheses)
        block = max(1, BLOCK // len(self._patterns))
        for start in range(0, len(optima), block):
            part = slice(start, start + block)
            d = optima[part]
            values = self.table.excess(d)
            values += costs[part] if len(costs) > 1 else costs
            each = np.arange(len(d))
            chosen = values.argmin(axis=1)
            least = values[each, chosen]
            values[each, chosen] = np.inf
            second = values.min(axis=1, initial=np.inf)
            doubt = self.table.rounding * np.abs(d).sum(axis=1) ** 2 + TIE * np.abs(least)
            best[part], clear[part] = chosen, second - least > doubt
        return best, clear

    def _pattern_costs(self, inputs: Array) -> Array:
        """The price of each pattern, infinite where the inputs so far (S, h, m) forbid it; (S, K) or (1, K)."""
        if inputs.shape[1] == 1:
            return self._cost(self._admissible.allowance(inputs[0]))[None]
        moved = np.packbits(
            (np.abs(np.diff(inputs, axis=1)) > SAME * self._condensed.input_prefix).reshape(len(inputs), -1),
            axis=1,
        )
        kinds, which = np.unique(moved, axis=0, return_inverse=True)
        firsts = [int(np.flatnonzero(which == kind)[0]) for kind in range(len(kinds))]
        costs = np.array([self._cost(self._allowance(moved[s].tobytes(), inputs[s])) for s in firsts])
        return costs[which.ravel()]

    def _allowance(self, moved: bytes, inputs: Array) -> Allowance:
        """What inputs (h, m) allow, which depends on nothing but on which of them moved when."""
        known = self._allowances.get(moved)
        if known is None:
            if len(self._allowances) > MOST_KEPT:
                self._allowances.clear()
            known = self._allowances[moved] = self._admissible.allowance(inputs)
        return known

    def _cost(self, allowance: Allowance) -> Array:
        known = self._costs.get(allowance)
        if known is None:
            if len(self._costs) > MOST_KEPT:
                self._costs.clear()
            forbidden = self._counts > allowance.left
            if any(allowance.frozen):
                forbidden |= (self._patterns & ~self._admissible.open(allowance)).any(axis=1)
            known = self._costs[allowance] = np.where(forbidden, np.inf, self._charge)
        return known


class BatchedRule(BatchedPlans):
    """A rule around a controller, each input by itself."""

    def __init__(self, rule: Rule, preview: bool, inner: BatchedPlans) -> None:
        super().__init__(rule, preview)
        self._rule, self._inner, self._du_max = rule, inner, rule.problem.limits.du_max

    def decide(
        self, parameters: Array, inputs: Array, hypotheses: Array | None = None
    ) -> tuple[BoolArray, Array]:
        decided, wanted = self._inner.decide(parameters, inputs, hypotheses)
        last = inputs[:, -1]
        first = self._rule.chosen(wanted, last)
        kept = (first >= self._low) & (first <= self._high) & (np.abs(first - last) <= self._du_max)
        return decided & kept.all(axis=1), first


class BatchedBank(BatchedPlans):
    """The plans of the variants of a bank, all loops under the same one at a sample."""

    def __init__(self, bank: ControllerBank, variants: dict[str, BatchedPlans]) -> None:
        self._variants, self._usual, self.memory = variants, bank.usual, bank.memory

    def under(self, variant: str | None) -> BatchedPlans:
        return self._variants[self._usual if variant is None else variant]


class EachPlans:
    """The plans of loops that have a controller each."""

    def __init__(self, each: Sequence[BatchedPlans]) -> None:
        self._groups = [
            (plans, np.array([s for s, own in enumerate(each) if own is plans]))
            for plans in dict.fromkeys(each)
        ]

    def decide(
        self, parameters: Array, inputs: Array, hypotheses: Array | None = None, variant: str | None = None
    ) -> tuple[BoolArray, Array]:
        """As in `BatchedPlans`, under a variant of banks."""
        if len(self._groups) == 1:
            return self._groups[0][0].under(variant).decide(parameters, inputs, hypotheses)
        decided, first = np.empty(len(inputs), dtype=bool), np.empty_like(inputs[:, -1])
        for plans, loops in self._groups:
            likely = None if hypotheses is None else hypotheses[loops]
            decided[loops], first[loops] = plans.under(variant).decide(
                parameters[loops], inputs[loops], likely
            )
        return decided, first


def batched_plans(controllers: Sequence[Controller], preview: bool) -> list[BatchedPlans] | None:
    """The plans of loops under these controllers, which share problem and model, one for each.

    None where one of them is stepped loop by loop, or where they remember unlike numbers of inputs.
    """
    made: dict[Controller, BatchedPlans] = {}
    last = None
    for controller in dict.fromkeys(controllers):
        plans = _plans_of(controller, preview, last)
        if plans is None or (last is not None and plans.memory != last.memory):
            return None
        made[controller] = last = plans
    return [made[controller] for controller in controllers]


def _plans_of(controller: Controller, preview: bool, like: BatchedPlans | None) -> BatchedPlans | None:
    if type(controller) is MPC:
        return BatchedPlans(controller, preview)
    if type(controller) is Rounded or (type(controller) is DeadBand and controller.kind == "each"):
        inner = _plans_of(controller.controller, preview, None)
        return None if inner is None else BatchedRule(controller, preview, inner)
    if isinstance(controller, ControllerBank):
        return _plans_of_bank(controller, preview)
    if type(controller) is not MAMPC or type(controller.method) is not Exact:
        return None
    problem = controller.problem
    admissible = AdmissiblePatterns(
        controller.rules, problem.model.n_inputs, problem.control_horizon, controller.condensed.input_prefix
    )
    if admissible.unrestricted:
        return BatchedPlans(controller, preview)
    if admissible.sized or admissible.on_levels:
        return None
    n = controller.condensed.n_moves
    patterns = admissible.listed(LARGEST_TABLE // (n * (n + 1) // 2))
    return None if patterns is None else BatchedExact(controller, preview, admissible, patterns, like)


def _plans_of_bank(bank: ControllerBank, preview: bool) -> BatchedPlans | None:
    """None where a variant is stepped loop by loop, or has zones of its own."""
    first, found = bank.problem, dict[str, BatchedPlans]()
    for name, controller in bank.variants.items():
        own = controller.problem
        names = ("zone_below", "zone_above", "zone_pull")
        alike = all(np.array_equal(getattr(own, name), getattr(first, name)) for name in names)
        plans = _plans_of(controller, preview, None) if alike else None
        if plans is None:
            return None
        found[name] = plans
    return BatchedBank(bank, found)
