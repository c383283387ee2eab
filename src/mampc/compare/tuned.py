"""What tuning found: a controller at any price, what it promises, and the prices beside the one chosen."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from mampc.base.checks import Array, as_number, as_whole
from mampc.base.errors import MampcError
from mampc.compare.candidates import Candidate
from mampc.compare.fronts import Estimate
from mampc.compare.promise import Expected
from mampc.controllers import MAMPC, ControllerBank
from mampc.loop.estimator import Estimator
from mampc.loop.load_bank import LoadBank
from mampc.loop.regulator import Regulator
from mampc.moves.rules import MoveRules
from mampc.program.problem import TrackingProblem

REFINE_SPAN = 4.0  # prices up and down from where the first round led


@dataclass(frozen=True, eq=False)
class FrontPoint:
    """One price of the controller chosen: means over the scenarios of the second round, with standard errors."""

    price: float
    moves_per_hour: Estimate
    error_ratio: Estimate


@dataclass(frozen=True, eq=False)
class Tuned:
    """What `tune` found.

    Attributes:
        problem: what the controller solves.
        rules: its move rules, with those told; `rules.price` is the price chosen.
        expected: the promise, a mean over scenarios with its standard error.
        front: the price chosen, and those about it that no other beats in moves and error, by rising error.
        reached: whether what was asked for is kept by fewer moves than those of the baseline.
        baseline: what errors are compared with: plain MPC, or where rules were told these alone, without a price.
        noise: of the outputs, shape (l,), as assumed or told.
        noise_guessed: whether nobody told it; then the controller's price follows what its estimator finds of it.
        estimator: of the controller.
        loads: of the scenarios, which took them in turn.
        rows: every run of the second round, as a sweep writes them.
        setting: move weight and tail chosen, the name of its `rows`; the baseline's where nothing better was found.
        cautions: what should be known of the figures, a sentence each.
    """

    problem: TrackingProblem
    rules: MoveRules
    expected: Expected
    front: tuple[FrontPoint, ...] = field(repr=False)
    reached: bool
    baseline: Regulator = field(repr=False)
    noise: Array = field(repr=False)
    noise_guessed: bool = field(repr=False)
    estimator: Estimator = field(repr=False)
    loads: tuple[Any, ...] = field(repr=False)
    rows: list[dict[str, Any]] = field(repr=False)
    setting: str
    cautions: tuple[str, ...] = ()

    @property
    def regulator(self) -> Regulator:
        """The controller found, with its estimator."""
        return self.at_price(self.rules.price)

    def at_price(self, price: float) -> Regulator:
        """The same with another price; 0 for none."""
        if isinstance(self.estimator, LoadBank) and not self.is_plain:
            return self._candidate(self.estimator).regulator(price)
        return Regulator(MAMPC(self.problem, replace(self.rules, price=price)), self.estimator)

    def bank(self, positions: int = 5, *, span: float = REFINE_SPAN) -> Regulator:
        """An operator's slider from calm to brisk: a `ControllerBank` of prices about the one found.

        Args:
            positions: how many, an odd number; "tuned" is the middle one and decides where none is named, "calm 1",
                "calm 2", ... move less and "brisk 1", "brisk 2", ... track better.
            span: the calmest price over the one found, and that over the briskest.

        Raises:
            MampcError: an even number, or nothing better than plain MPC found.
        """
        side, span = as_whole("positions", positions, 3) // 2, as_number("span", span, 1.0, exclusive=True)
        if positions % 2 == 0:
            raise MampcError(
                f"positions: expected an odd number, with the one found in the middle, received {positions}"
            )
        if self.is_plain:
            raise MampcError(
                "bank: expected a price to go up and down from, received a controller without one"
            )
        ways = [("calm", span), ("brisk", 1 / span)]
        prices = {"tuned": self.rules.price} | {
            f"{word} {k}": self.rules.price * far ** (k / side)
            for word, far in ways
            for k in range(1, side + 1)
        }
        variants = {
            name: MAMPC(self.problem, replace(self.rules, price=price)) for name, price in prices.items()
        }
        assert isinstance(self.estimator, LoadBank)
        counts = self._candidate(self.estimator).counts
        return Regulator(
            ControllerBank(variants), self.estimator, value_of_information=counts,
            price_follows_noise=counts and self.noise_guessed,
        )  # fmt: skip

    def _candidate(self, estimator: LoadBank) -> Candidate:
        return Candidate("", self.problem, self.rules, estimator, self.noise_guessed)

    @property
    def is_plain(self) -> bool:
        """Whether nothing better than the baseline was found."""
        return self.problem is self.baseline.controller.problem
