"""How many closed loops the rounds of tuning run, and how many of them are done."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mampc.base.progress import watched

FINALISTS = 2
HIGHER = 3  # times that the price of a finalist goes up where it keeps what is allowed


class Rounds(NamedTuple):
    """How many scenarios are run: of the search and its second round with how many prices, and of the confirmation."""

    searched: int
    search_prices: int
    refined: int
    refine_prices: int
    confirmed: int


ROUNDS = Rounds(8, 6, 16, 11, 64)
DEAR_ROUNDS = Rounds(4, 3, 8, 4, 12)  # where loops are stepped one by one


class Work:
    """How many closed loops are done, told as they are."""

    def __init__(
        self, counts: Rounds, candidates: int, progress: bool | None, on_task: Callable[[int, int], None]
    ) -> None:
        searched = counts.searched * (1 + candidates * counts.search_prices)
        refined = counts.refined * (1 + min(FINALISTS, candidates) * counts.refine_prices)
        self.total = searched + refined + counts.confirmed * (2 + HIGHER)
        self.done = 0
        self._bar, self._on_task = iter(watched(self.total, progress)), on_task

    def add(self, loops: int) -> None:
        """So many more are done; confirmation may need more than was foreseen, and the last counts at the end."""
        self._tell(min(loops, self.total - 1 - self.done))

    def end(self) -> None:
        """All are done."""
        self._tell(self.total - self.done)
        next(self._bar, None)

    def _tell(self, more: int) -> None:
        for _ in range(more):
            next(self._bar, None)
        if more > 0:
            self.done += more
            self._on_task(self.done, self.total)
