"""The admissible patterns of `MoveRules`, given the moves already made.

A pattern says for every future move du_j of every input whether it may differ from zero. Patterns are
boolean arrays of shape (nc m,), time-major like the moves themselves.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray, as_vector
from mampc.base.errors import MampcError
from mampc.base.tolerances import SAME
from mampc.moves.rules import MoveRules
from mampc.program.sample import Indices


class Allowance(NamedTuple):
    """What the moves already made allow.

    Attributes:
        left: moves of the budget that are left.
        frozen: for how many samples from now on each input may not move, m of them.
        exceeded: whether the window holds more moves than the budget already.
    """

    left: int
    frozen: tuple[int, ...]
    exceeded: bool


class AdmissiblePatterns:
    """The admissible patterns of `MoveRules` for m inputs over nc samples.

    The prefix of each input, (m,), see `tolerances`, tells its past moves from rounding.

    Attributes:
        candidates: moves that some admissible pattern holds, shape (n_moves,).
        price: of each input, shape (m,); with simultaneous counting the price of a sample.
        min_size: of each move, shape (n_moves,).
        sized: whether any min_size is above zero, and no input has levels, which say more.
        on_levels: whether some input has levels.
        simple: whether moves compete for the budget alone, one for one.
    """

    def __init__(
        self, rules: MoveRules, n_inputs: int, control_horizon: int, input_prefix: Array | float = 1.0
    ) -> None:
        self.rules, self.n_inputs, self.control_horizon = rules, n_inputs, control_horizon
        m, n_c = n_inputs, control_horizon
        self.n_moves = n_c * m
        self.simultaneous = rules.counting == "simultaneous"
        self.price = as_vector("price", rules.price, m)
        self.priced = bool(self.price.any())
        self.min_size: Array = np.tile(as_vector("min_size", rules.min_size, m), n_c)
        self.on_levels = rules.levels is not None
        self.sized = bool(self.min_size.any()) and not self.on_levels
        self.per_step = m if rules.max_moves_per_step is None else min(m, rules.max_moves_per_step)
        starts = np.ones(n_c, dtype=bool)
        if rules.blocks is not None:
            if sum(rules.blocks) > n_c:
                raise MampcError(
                    f"blocks: expected lengths that sum to at most the control horizon of {n_c}, "
                    f"received {rules.blocks}"
                )
            starts[:] = False
            starts[np.cumsum([0, *rules.blocks[:-1]])] = True
        self.candidates: BoolArray = np.repeat(starts, m)
        self.simple = rules.dwell == 1 and self.per_step == m and not self.simultaneous
        self._most = n_c if self.simultaneous else self.n_moves
        self._all_free = (0,) * m
        self._price_of_moves = np.tile(self.price, n_c)
        self._same = SAME * input_prefix

    @property
    def nested(self) -> bool:
        """Whether one move more never costs anything: only patterns that spend the whole budget are of interest."""
        return self.simple and not self.priced and not self.sized

    @property
    def unrestricted(self) -> bool:
        """Whether there are no rules at all: every pattern is admissible, at no price and with moves of any size."""
        bounded = self.rules.max_moves is not None or self.rules.dwell > 1 or self.per_step < self.n_inputs
        bounded |= not bool(self.candidates.all())
        return not (bounded or self.priced or self.sized or self.on_levels)

    def allowance(self, inputs: Array, frozen: Any = None) -> Allowance:
        """What the applied inputs, shape (h, m) with the latest last, allow.

        `frozen`: for how many samples each input may not move in any case, shape (m,), or None.
        """
        rules = self.rules
        left, exceeded, until = self._most, False, self._all_free
        if rules.max_moves is not None:
            left = rules.max_moves
            if rules.sparsity_horizon > 1:
                left -= self._count(self._moved(inputs[-rules.sparsity_horizon :]))
                exceeded = left < 0
            left = min(max(left, 0), self._most)
        if rules.dwell > 1:
            moved = self._moved(inputs[-rules.dwell :])[::-1]  # moved[t]: t + 1 samples before the decision
            since = np.where(moved.any(axis=0), moved.argmax(axis=0) + 1, rules.dwell)
            until = tuple((rules.dwell - since).tolist())
        if frozen is not None:
            until = tuple(np.maximum(frozen, until).tolist())
        return Allowance(left, until, exceeded)

    def _moved(self, inputs: Array) -> BoolArray:
        """Which inputs changed between successive rows, shape (h - 1, m)."""
        moved: BoolArray = np.abs(inputs[1:] - inputs[:-1]) > self._same
        return moved

    def open(self, allowance: Allowance) -> BoolArray:
        """The moves of inputs that are not frozen, at the starts of blocks, shape (n_moves,)."""
        if not any(allowance.frozen):
            return self.candidates
        moving = np.arange(self.control_horizon)[:, None] >= np.array(allowance.frozen)
        return self.candidates & moving.ravel()

    def count(self, pattern: BoolArray) -> int:
        """How many moves a pattern, shape (n_moves,), holds, as budget and price count them."""
        return self._count(pattern.reshape(-1, self.n_inputs))

    def _count(self, moved: BoolArray) -> int:
        return int(np.count_nonzero(moved.any(axis=1) if self.simultaneous else moved))

    def charge(self, pattern: BoolArray) -> float:
        """The price of a pattern, shape (n_moves,)."""
        if not self.priced:
            return 0.0
        moved = pattern.reshape(-1, self.n_inputs)
        if self.simultaneous:
            return float(self.price[0] * moved.any(axis=1).sum())
        return float(moved.sum(axis=0) @ self.price)

    def counts(self, patterns: BoolArray) -> Indices:
        """`count` of each of many patterns, shape (K, n_moves)."""
        moved = patterns.reshape(len(patterns), -1, self.n_inputs)
        counts: Indices = (moved.any(axis=2) if self.simultaneous else patterns).sum(axis=1)
        return counts

    def charges(self, patterns: BoolArray) -> Array:
        """`charge` of each of many patterns, shape (K, n_moves)."""
        moved = patterns.reshape(len(patterns), -1, self.n_inputs)
        charges: Array = (
            self.price[0] * moved.any(axis=2).sum(axis=1)
            if self.simultaneous
            else moved.sum(axis=1) @ self.price
        )
        return charges

    def allows(self, pattern: BoolArray, allowance: Allowance) -> bool:
        """Whether a pattern, shape (n_moves,), is admissible."""
        if self.simple:
            within = not (pattern & ~self.open(allowance)).any()
            return within and int(np.count_nonzero(pattern)) <= allowance.left
        builder = PatternBuilder(self, allowance)
        return all(builder.add(int(i)) for i in np.flatnonzero(pattern))

    def select(self, worth: Array, allowance: Allowance) -> BoolArray:
        """A pattern of large total worth less price, shape (n_moves,): best moves first, as rules allow.

        The best pattern under budgets, prices and limits per sample; a greedy choice where dwell times bind.
        """
        m, worth = self.n_inputs, np.where(self.open(allowance), worth, 0.0)
        if self.simple:
            rank = worth - self._price_of_moves
            pattern = np.zeros(self.n_moves, dtype=bool)
            pattern[(-rank).argsort(kind="stable")[: allowance.left]] = True
            return pattern & (rank > 0)
        builder = PatternBuilder(self, allowance)
        if self.simultaneous:
            by_sample = worth.reshape(-1, m)
            kept = by_sample if self.per_step == m else np.sort(by_sample, axis=1)[:, -self.per_step :]
            rank = np.repeat(kept.sum(axis=1), m)
            order = np.lexsort((-worth, np.arange(self.n_moves) // m, -rank))
        else:
            rank = worth - self._price_of_moves
            order = (-rank).argsort(kind="stable")
        threshold = self.price[0] if self.simultaneous else 0.0
        for i in order.tolist():
            if builder.full or rank[i] <= threshold:
                break
            if worth[i] > 0:
                builder.add(i)
        if self.simultaneous and self.rules.dwell > 1:  # a sample may have got less than it was ranked by
            got = (worth * builder.pattern).reshape(-1, m).sum(axis=1)
            builder.pattern &= np.repeat(got > threshold, m)
        return builder.pattern

    def listed(self, most: int, among: BoolArray | None = None) -> BoolArray | None:
        """All patterns admissible in steady state, shape (K, n_moves); None if there are more than `most`.

        `among`: the moves that they may hold, shape (n_moves,); None for all.
        """
        candidates = self.candidates if among is None else self.candidates & among
        left = self._most if self.rules.max_moves is None else min(self.rules.max_moves, self._most)
        patterns: BoolArray = np.zeros((1, self.n_moves), dtype=bool)
        # From the last move on: no move, those that hold this one, and those of later ones alone.
        for i in np.flatnonzero(candidates)[::-1].tolist():
            added = patterns[self._open_to(i, patterns, left)]
            added[:, i] = True
            patterns = np.concatenate((patterns[:1], added, patterns[1:]))
            if len(patterns) > most:
                return None
        return patterns

    def _open_to(self, i: int, patterns: BoolArray, left: int) -> BoolArray:
        """Which patterns of later moves, shape (K, n_moves), may hold move i too, shape (K,)."""
        (j, a), moved = divmod(i, self.n_inputs), patterns.reshape(len(patterns), -1, self.n_inputs)
        at_once = moved[:, j].sum(axis=1)
        counts = self.counts(patterns) + (at_once == 0 if self.simultaneous else 1)
        soon = moved[:, j + 1 : j + self.rules.dwell, a].any(axis=1)
        open_to: BoolArray = (counts <= left) & (at_once < self.per_step) & ~soon
        return open_to


class PatternBuilder:
    """A pattern to which moves are added one by one, as long as the rules allow."""

    def __init__(self, admissible: AdmissiblePatterns, allowance: Allowance) -> None:
        self._of, self._allowance = admissible, allowance
        self.pattern: BoolArray = np.zeros(admissible.n_moves, dtype=bool)
        self._at = [0] * admissible.control_horizon  # moves at each sample
        self._when: list[list[int]] = [[] for _ in range(admissible.n_inputs)]  # samples at which each moves
        self._used = 0

    @property
    def full(self) -> bool:
        """Whether the budget is spent (with simultaneous counting, samples that move may still hold more)."""
        return self._used >= self._allowance.left and not self._of.simultaneous

    def add(self, i: int) -> bool:
        """Add move i if that is admissible; says whether it was."""
        of, allowance = self._of, self._allowance
        j, a = divmod(i, of.n_inputs)
        counts = not of.simultaneous or self._at[j] == 0
        dwell = of.rules.dwell
        if (
            self.pattern[i]
            or (counts and self._used >= allowance.left)
            or self._at[j] >= of.per_step
            or not of.candidates[i]
            or j < allowance.frozen[a]
            or (dwell > 1 and any(abs(j - other) < dwell for other in self._when[a]))
        ):
            return False
        self.pattern[i] = True
        self._at[j] += 1
        self._when[a].append(j)
        self._used += counts
        return True

    def remove(self, i: int) -> None:
        """Take move i out again."""
        j, a = divmod(i, self._of.n_inputs)
        self.pattern[i] = False
        self._at[j] -= 1
        self._when[a].remove(j)
        self._used -= not self._of.simultaneous or self._at[j] == 0
