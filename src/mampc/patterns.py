"""Move rules: which patterns of future moves are admissible, given the moves already made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.arrays import Array, as_whole

SAME = 1e-9  # in input units: inputs nearer than this are the same, so that rounding is no move


@dataclass(frozen=True, kw_only=True)
class MoveRules:
    """A budget of moves in a window that looks back over past inputs (the paper's P0).

    The window holds the sparsity_horizon - 1 latest past changes and the nc future ones; every change
    of a single input counts as one move.

    Args:
        max_moves: s >= 0, how many moves the window may hold; None for no budget.
        sparsity_horizon: ns >= 1, how many past inputs the window holds.

    Raises:
        MampcError: s < 0, ns < 1, or numbers that are not whole.
    """

    max_moves: int | None = None
    sparsity_horizon: int = 1

    def __post_init__(self) -> None:
        if self.max_moves is not None:
            as_whole("max_moves", self.max_moves, 0)
        as_whole("sparsity_horizon", self.sparsity_horizon, 1, 10_000)

    def past_changes(self, inputs: Array) -> Array:
        """Changes inside the window between the applied inputs (h, m), shape (ns - 1, m)."""
        changes: Array = np.diff(inputs[-self.sparsity_horizon :], axis=0)
        return changes

    def moves_left(self, inputs: Array, available: int) -> int:
        """How many of the `available` future moves the budget still allows: max(0, s - past moves)."""
        if self.max_moves is None:
            return available
        past = int(np.count_nonzero(np.abs(self.past_changes(inputs)) > SAME))
        return min(available, max(0, self.max_moves - past))
