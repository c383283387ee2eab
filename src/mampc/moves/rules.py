"""Move rules: what moves cost, and which patterns of them the user allows; `admissible` applies them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_choice, as_one_or_each, as_whole
from mampc.base.errors import MampcError
from mampc.program.levels import as_levels

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
        levels: what inputs can be. A step (inputs are multiples of it), a `mampc.OnOff`, or one entry per input, each
            a step, a list of levels, an OnOff, or None for an input that takes any value: levels=[[0, 40, 100], 0.5].

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
    levels: Any = None

    def __post_init__(self) -> None:
        if self.max_moves is not None:
            as_whole("max_moves", self.max_moves, 0)
        as_whole("sparsity_horizon", self.sparsity_horizon, 1, 10_000)
        as_choice("counting", self.counting, COUNTINGS)
        as_whole("dwell", self.dwell, 1, 10_000)
        if self.max_moves_per_step is not None:
            as_whole("max_moves_per_step", self.max_moves_per_step, 1)
        for name in ("price", "min_size"):
            object.__setattr__(self, name, as_one_or_each(name, getattr(self, name), 0.0))
        if self.counting == "simultaneous" and np.ndim(self.price):
            raise MampcError(
                "price: expected one price per sample with counting='simultaneous', received one per input"
            )
        if self.blocks is not None:
            lengths = self.blocks if np.iterable(self.blocks) else [self.blocks]
            object.__setattr__(self, "blocks", tuple(as_whole("blocks", length, 1) for length in lengths))
            if not self.blocks:
                raise MampcError("blocks: expected at least one block, received none")
        object.__setattr__(self, "levels", as_levels(self.levels))

    def __repr__(self) -> str:
        """Only what is not the default."""
        values = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        return f"MoveRules({', '.join(f'{k}={v!r}' for k, (v, usual) in values.items() if v != usual)})"

    def past_changes(self, inputs: Array) -> Array:
        """Changes inside the window between the applied inputs (h, m), shape (ns - 1, m)."""
        changes: Array = np.diff(inputs[-self.sparsity_horizon :], axis=0)
        return changes

    @property
    def memory(self) -> int:
        """How many past inputs the rules look back on."""
        return max(self.sparsity_horizon, self.dwell)
