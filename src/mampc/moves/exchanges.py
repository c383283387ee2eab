"""The neighbours of a pattern: what a local search may add to it, drop from it, or exchange in it."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.moves.admissible import AdmissiblePatterns, Allowance


class PatternNeighbours:
    """Which single moves a pattern may gain, lose or exchange, and what that changes in price.

    Attributes:
        pattern: shape (n_moves,); always admissible.
        held: indices of its moves, in order.
    """

    def __init__(
        self, admissible: AdmissiblePatterns, allowance: Allowance, pattern: BoolArray | None = None
    ) -> None:
        self._of, self._allowance = admissible, allowance
        n, m, dwell = admissible.n_moves, admissible.n_inputs, admissible.rules.dwell
        self._open = admissible.open(allowance)
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
        room = self._used < self._allowance.left
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
            allowed &= (at > 0) | (used < self._allowance.left)[:, None]
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
