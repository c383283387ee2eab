"""The controllers that tuning compares: all have a load bank and keep the same rules; move weight and tail differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.compare.fronts import Point
from mampc.compare.scenarios import Scenarios
from mampc.controllers import MAMPC
from mampc.loop.load_bank import LoadBank
from mampc.loop.regulator import Regulator
from mampc.moves.rules import MoveRules
from mampc.program.problem import TrackingProblem

MOVE_WEIGHTS = (0.1, 0.3, 1.0)  # times those of plain MPC
USUAL_WEIGHT = 0.3  # alone where runs are dear
TAILS = (0.0, 0.25)  # times the prediction horizon
PULLS = (0.0, 0.1)  # to the middle of zones, where plain MPC has none
CONTROL_HORIZONS = (2, 3)  # fewest and most samples; with one alone, plans cannot aim and catch
MOST_MOVES = 9  # of all inputs together, within these, which keeps the patterns to a few hundred


@dataclass(frozen=True, eq=False)
class Candidate:
    """A controller but for its price.

    Attributes:
        name: in tables.
        problem: what it solves.
        rules: that it keeps whatever the price.
        estimator: with the noise that it expects.
        guessed: whether nobody told this noise, so that the price follows what is found of it.
    """

    name: str
    problem: TrackingProblem
    rules: MoveRules
    estimator: LoadBank
    guessed: bool = False

    @property
    def counts(self) -> bool:
        """Whether plans count on later data, which zones and levels forbid."""
        return not self.problem.zoned.any() and self.rules.levels is None

    @property
    def dear(self) -> bool:
        """Whether its loops are stepped one by one, which takes long."""
        return is_dear(self.problem, self.rules)

    def regulator(self, price: float) -> Regulator:
        """It, with a price."""
        controller = MAMPC(self.problem, replace(self.rules, price=price))
        return Regulator(
            controller, self.estimator, value_of_information=self.counts, price_follows_noise=self.guessed
        )

    def points(self, prices: Sequence[float], scenarios: Scenarios) -> list[Point]:
        """Its moves and errors in every scenario, price by price."""
        found = scenarios.run_each([self.regulator(price) for price in prices])
        return [Point(self.name, price, *run) for price, run in zip(prices, found, strict=True)]


def is_dear(problem: TrackingProblem, rules: MoveRules) -> bool:
    """Whether loops are stepped one by one: about zones, and where moves have least sizes or inputs levels."""
    return bool(problem.zoned.any() or rules.levels is not None or np.any(rules.min_size))


def candidates(
    problem: TrackingProblem, noise: Array, guessed: bool = False, rules: MoveRules | None = None
) -> list[Candidate]:
    """All that are compared, for a problem of plain MPC and noise (l,) that was told or guessed."""
    rules = MoveRules() if rules is None else rules
    m, n_p = problem.model.n_inputs, problem.prediction_horizon
    n_c = min(int(np.clip(MOST_MOVES // m, *CONTROL_HORIZONS)), n_p)
    if rules.levels is not None or rules.blocks is not None:  # of which plans hold as many as they are told
        n_c = problem.control_horizon
    estimator, found = LoadBank(problem.model, noise=noise, guessed=guessed), []
    pulls = PULLS if problem.zoned.any() and problem.zone_pull == 0 else (problem.zone_pull,)
    weights = (USUAL_WEIGHT,) if is_dear(problem, rules) else MOVE_WEIGHTS
    for share, tail, pull in product(weights, TAILS, pulls):
        sparse = replace(
            problem, control_horizon=n_c, move_weight=share * problem.move_weight, tail_horizon=tail * n_p,
            zone_pull=pull,
        )  # fmt: skip
        name = f"move weight x {share:g}, tail {tail * n_p:g}" + (
            f", pull {pull:g}" if len(pulls) > 1 else ""
        )
        candidate = Candidate(name, sparse, rules, estimator, guessed)
        for one in (candidate, replace(candidate, guessed=False)):
            try:
                one.regulator(1.0)
            except MampcError:  # such as a tail that an unstable model does not have, or too many patterns
                continue
            found.append(one)
            break
    if not found:
        raise MampcError("tune: expected a model and rules that a sparse controller can be built for")
    return found
