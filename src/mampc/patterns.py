"""Move rules: which patterns of future moves are admissible, given the moves already made.

A pattern says for every future move du_j of every input whether it may differ from zero. Patterns are
boolean arrays of shape (nc m,), time-major like the moves themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mampc.arrays import Array, BoolArray, as_array, as_vector, as_whole, require_finite
from mampc.errors import MampcError

SAME = 1e-9  # in input units: inputs nearer than this are the same, so that rounding is no move
COUNTINGS = ("elementwise", "simultaneous")


@dataclass(frozen=True, kw_only=True)
class MoveRules:
    """What moves cost, and which patterns of moves are allowed; the rules combine.

    The window of the budget holds the sparsity_horizon - 1 latest past changes and the nc future ones
    (the paper's P0), so that no window of sparsity_horizon samples ever holds more than max_moves.

    Args:
        max_moves: s >= 0, how many moves the window may hold; None for no budget.
        sparsity_horizon: ns >= 1, how many past inputs the window holds.
        price: >= 0, added to the objective for every future move; a scalar or one per input. The unit is
            that of the tracking cost.
        counting: "elementwise" counts every change of a single input, "simultaneous" the samples at
            which any input changes (and then has one price). Budget and price count alike.
        min_size: >= 0, in input units; a move is zero or at least this large. A scalar or one per input.
        dwell: >= 1, samples an input keeps a new value for at least; 1 allows a move at every sample.
        max_moves_per_step: >= 1, how many inputs may move at one sample; None for all.
        blocks: a fixed blocking pattern, lengths in samples: moves are allowed only at the first sample of
            each block of the control horizon, such as (1, 2, 2): at j = 0, 1 and 3. The sum is at most nc;
            after the last block the inputs stay.

    Raises:
        MampcError: values out of range.
    """

    max_moves: int | None = None
    sparsity_horizon: int = 1
    price: Any = 0.0
    counting: str = "elementwise"
    min_size: Any = 0.0
    dwell: int = 1
    max_moves_per_step: int | None = None
    blocks: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.max_moves is not None:
            as_whole("max_moves", self.max_moves, 0)
        as_whole("sparsity_horizon", self.sparsity_horizon, 1, 10_000)
        if self.counting not in COUNTINGS:
            raise MampcError(f"counting: expected one of {COUNTINGS}, received {self.counting!r}")
        as_whole("dwell", self.dwell, 1, 10_000)
        if self.max_moves_per_step is not None:
            as_whole("max_moves_per_step", self.max_moves_per_step, 1)
        for name in ("price", "min_size"):
            given = getattr(self, name)
            value = require_finite(name, as_array(name, given))
            if value.ndim > 1 or (value < 0).any():
                raise MampcError(f"{name}: expected one value >= 0 or one per input, received {given!r}")
            # Plain numbers: out of the caller's reach, and comparable.
            object.__setattr__(self, name, tuple(value.tolist()) if value.ndim else float(value))
        if self.counting == "simultaneous" and np.ndim(self.price):
            raise MampcError(
                "price: expected one price per sample with counting='simultaneous', received one per input"
            )
        if self.blocks is not None:
            lengths = self.blocks if np.iterable(self.blocks) else [self.blocks]
            object.__setattr__(self, "blocks", tuple(as_whole("blocks", length, 1) for length in lengths))
            if not self.blocks:
                raise MampcError("blocks: expected at least one block, received none")

    def past_changes(self, inputs: Array) -> Array:
        """Changes inside the window between the applied inputs (h, m), shape (ns - 1, m)."""
        changes: Array = np.diff(inputs[-self.sparsity_horizon :], axis=0)
        return changes

    @property
    def memory(self) -> int:
        """How many past inputs the rules look back on."""
        return max(self.sparsity_horizon, self.dwell)

    def fitted(self, n_inputs: int, control_horizon: int) -> Admissible:
        """The rules for one problem."""
        return Admissible(self, n_inputs, control_horizon)


class Past(NamedTuple):
    """What the moves already made leave: moves of the budget, and samples each input must still rest."""

    left: int
    rest: tuple[int, ...]
    exceeded: bool  # the window holds more moves than the budget already


class Admissible:
    """The admissible patterns of `MoveRules` for m inputs over nc samples.

    Attributes:
        candidates: moves that some admissible pattern holds, shape (n_moves,).
        price: of each input, shape (m,); with simultaneous counting the price of a sample.
        min_size: of each move, shape (n_moves,).
        sized: whether any min_size is above zero.
        simple: whether moves compete for the budget alone, one for one.
    """

    def __init__(self, rules: MoveRules, n_inputs: int, control_horizon: int) -> None:
        self.rules, self.n_inputs, self.control_horizon = rules, n_inputs, control_horizon
        m, n_c = n_inputs, control_horizon
        self.n_moves = n_c * m
        self.simultaneous = rules.counting == "simultaneous"
        self.price = as_vector("price", rules.price, m)
        self.priced = bool(self.price.any())
        self.min_size: Array = np.tile(as_vector("min_size", rules.min_size, m), n_c)
        self.sized = bool(self.min_size.any())
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
        self._at_rest = (0,) * m

    @property
    def unrestricted(self) -> bool:
        """Whether there are no rules at all: every pattern is admissible, at no price and with moves of any size."""
        free = self.rules.max_moves is None and self.rules.dwell == 1 and self.per_step == self.n_inputs
        return free and bool(self.candidates.all()) and not self.priced and not self.sized

    def past(self, inputs: Array, resting: Any = None) -> Past:
        """What the applied inputs, shape (h, m) with the latest last, leave.

        `resting`: samples that each input has to rest for besides, shape (m,), or None.
        """
        rules = self.rules
        left, exceeded, rest = self._most, False, self._at_rest
        if rules.max_moves is not None:
            left = rules.max_moves
            if rules.sparsity_horizon > 1:
                left -= self._count(_moved(inputs[-rules.sparsity_horizon :]))
                exceeded = left < 0
            left = min(max(left, 0), self._most)
        if rules.dwell > 1:
            moved = _moved(inputs[-rules.dwell :])[::-1]  # moved[t]: t + 1 samples before the next decision
            since = np.where(moved.any(axis=0), moved.argmax(axis=0) + 1, rules.dwell)
            rest = tuple((rules.dwell - since).tolist())
        if resting is not None:
            rest = tuple(np.maximum(resting, rest).tolist())
        return Past(left, rest, exceeded)

    def open(self, past: Past) -> BoolArray:
        """The moves that neither blocks nor rest forbid, shape (n_moves,)."""
        if not any(past.rest):
            return self.candidates
        j = np.arange(self.n_moves) // self.n_inputs
        return self.candidates & (j >= np.tile(past.rest, self.control_horizon))

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

    def allows(self, pattern: BoolArray, past: Past) -> bool:
        """Whether a pattern, shape (n_moves,), is admissible."""
        growing = Growing(self, past)
        return all(growing.add(int(i)) for i in np.flatnonzero(pattern))

    def select(self, worth: Array, past: Past) -> BoolArray:
        """A pattern of large total worth less price, shape (n_moves,): best moves first, as rules allow.

        The best pattern under budgets, prices and limits per sample; a greedy choice where dwell times bind.
        """
        m, growing = self.n_inputs, Growing(self, past)
        worth = np.where(self.open(past), worth, 0.0)
        if self.simple:
            rank = worth - np.tile(self.price, self.control_horizon)
            pattern = np.zeros(self.n_moves, dtype=bool)
            pattern[np.argsort(-rank, kind="stable")[: past.left]] = True
            return pattern & (rank > 0)
        if self.simultaneous:
            by_sample = worth.reshape(-1, m)
            kept = by_sample if self.per_step == m else np.sort(by_sample, axis=1)[:, -self.per_step :]
            rank = np.repeat(kept.sum(axis=1), m)
            order = np.lexsort((-worth, np.arange(self.n_moves) // m, -rank))
        else:
            rank = worth - np.tile(self.price, self.control_horizon)
            order = np.argsort(-rank, kind="stable")
        threshold = self.price[0] if self.simultaneous else 0.0
        for i in order.tolist():
            if growing.full or rank[i] <= threshold:
                break
            if worth[i] > 0:
                growing.add(i)
        if self.simultaneous and self.rules.dwell > 1:  # a sample may have got less than it was ranked by
            got = (worth * growing.pattern).reshape(-1, m).sum(axis=1)
            growing.pattern &= np.repeat(got > threshold, m)
        return growing.pattern

    def listed(self, most: int) -> BoolArray | None:
        """All patterns admissible from rest, shape (K, n_moves); None if there are more than `most`."""
        found: list[list[int]] = []
        past = Past(
            self._most if self.rules.max_moves is None else min(self.rules.max_moves, self._most),
            self._at_rest,
            False,
        )
        for chosen in self._grown([], np.flatnonzero(self.candidates).tolist(), Growing(self, past)):
            found.append(chosen)
            if len(found) > most:
                return None
        patterns = np.zeros((len(found), self.n_moves), dtype=bool)
        for row, chosen in zip(patterns, found, strict=True):
            row[chosen] = True
        return patterns

    def _grown(self, chosen: list[int], further: list[int], growing: Growing) -> Iterator[list[int]]:
        yield chosen
        for at, i in enumerate(further):
            if growing.add(i):
                yield from self._grown([*chosen, i], further[at + 1 :], growing)
                growing.remove(i)


class Growing:
    """A pattern to which moves are added one by one, as long as the rules allow."""

    def __init__(self, admissible: Admissible, past: Past) -> None:
        self._of, self._past = admissible, past
        self.pattern: BoolArray = np.zeros(admissible.n_moves, dtype=bool)
        self._at = [0] * admissible.control_horizon  # moves at each sample
        self._when: list[list[int]] = [[] for _ in range(admissible.n_inputs)]  # samples at which each moves
        self._used = 0

    @property
    def full(self) -> bool:
        """Whether the budget is spent (with simultaneous counting, samples that move may still hold more)."""
        return self._used >= self._past.left and not self._of.simultaneous

    def add(self, i: int) -> bool:
        """Add move i if that is admissible; says whether it was."""
        of, past = self._of, self._past
        j, a = divmod(i, of.n_inputs)
        counts = not of.simultaneous or self._at[j] == 0
        dwell = of.rules.dwell
        if (
            self.pattern[i]
            or (counts and self._used >= past.left)
            or self._at[j] >= of.per_step
            or not of.candidates[i]
            or j < past.rest[a]
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


class Exchanges:
    """Which single moves a pattern may gain, lose or exchange, and what that changes in price.

    Attributes:
        pattern: shape (n_moves,); always admissible.
        held: indices of its moves, in order.
    """

    def __init__(self, admissible: Admissible, past: Past, pattern: BoolArray | None = None) -> None:
        self._of, self._past = admissible, past
        n, m, dwell = admissible.n_moves, admissible.n_inputs, admissible.rules.dwell
        self._open = admissible.open(past)
        self._sample = np.arange(n) // m
        self._price: Array = np.tile(admissible.price, admissible.control_horizon)
        self._near = None  # pairs of moves that the dwell time keeps apart
        if dwell > 1:
            moves = np.arange(n)
            self._near = (np.abs(moves[:, None] - moves) < dwell * m) & ((moves[:, None] - moves) % m == 0)
        self.pattern: BoolArray = np.zeros(n, dtype=bool) if pattern is None else pattern.copy()
        self._refresh()

    def _refresh(self) -> None:
        self.held = np.flatnonzero(self.pattern)
        if not self._of.simple:
            at = np.bincount(self._sample[self.held], minlength=self._of.control_horizon)
            self._at = at[self._sample]  # moves at each move's sample
        self._used = self._of.count(self.pattern)

    def change(self, dropped: int | None = None, added: int | None = None) -> None:
        """Drop a move, add one, or exchange one for the other."""
        if dropped is not None:
            self.pattern[dropped] = False
        if added is not None:
            self.pattern[added] = True
        self._refresh()

    def additions(self) -> BoolArray:
        """Moves that may be added, shape (n_moves,)."""
        room = self._used < self._past.left
        allowed = self._open & ~self.pattern
        if self._of.simple:
            return allowed if room else np.zeros_like(allowed)
        allowed &= self._at < self._of.per_step
        if self._near is not None:
            allowed &= ~self._near[self.held].any(axis=0)
        if not room:
            allowed &= (self._at > 0) if self._of.simultaneous else False
        return allowed

    def swaps(self) -> BoolArray:
        """Whether each held move (row) may be exchanged for each other move, shape (k, n_moves)."""
        allowed = np.repeat((self._open & ~self.pattern)[None], len(self.held), axis=0)
        if self._of.simple:
            return allowed
        at = self._at_without()
        allowed &= at < self._of.per_step
        if self._near is not None:
            near = self._near[self.held]
            allowed &= near.sum(axis=0) - near == 0
        if self._of.simultaneous:
            used = self._used - (self._at[self.held] == 1)
            allowed &= (at > 0) | (used < self._past.left)[:, None]
        return allowed

    def _at_without(self) -> Array:
        """Moves at each move's sample (column) without each held move (row), shape (k, n_moves)."""
        without: Array = self._at - (self._sample[self.held][:, None] == self._sample)
        return without

    def added_price(self) -> Array:
        """What adding each move costs, shape (n_moves,)."""
        return np.where(self._at > 0, 0.0, self._price) if self._of.simultaneous else self._price

    def dropped_price(self) -> Array:
        """What dropping each held move saves, shape (k,)."""
        price: Array = self._price[self.held]
        return np.where(self._at[self.held] == 1, price, 0.0) if self._of.simultaneous else price

    def swapped_price(self) -> Array:
        """What exchanging each held move for each other costs, shape (k, n_moves)."""
        added = np.where(self._at_without() > 0, 0.0, self._price) if self._of.simultaneous else self._price
        return added - self.dropped_price()[:, None]


def _moved(inputs: Array) -> BoolArray:
    """Which inputs changed between successive rows, shape (h - 1, m)."""
    moved: BoolArray = np.abs(inputs[1:] - inputs[:-1]) > SAME
    return moved
