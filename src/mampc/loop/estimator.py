"""What every estimator gives and takes: the states of the model and the loads that measurements show."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray, is_usable
from mampc.base.words import LoadKind
from mampc.systems.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class Estimate:
    """The model state (n,) and the constant disturbances seen at its outputs (l,) and inputs (m,)."""

    x: Array
    output_disturbance: Array
    input_disturbance: Array

    @property
    def is_usable(self) -> bool:
        """Whether all numbers are."""
        return all(is_usable(part.ravel()) for part in vars(self).values())

    @property
    def flat(self) -> Array:
        """x, d_y and d_u in a row, shape (n + l + m,)."""
        return np.concatenate((self.x, self.output_disturbance, self.input_disturbance))


class Updated(NamedTuple):
    """One sample's estimate with every measurement believed, and what the sensor checks need to judge them.

    Attributes:
        estimate: predicted and corrected.
        innovation: measured less predicted outputs, shape (l,).
        movement: how far the model moved the outputs since the last sample, shape (l,).
    """

    estimate: Estimate
    innovation: Array
    movement: Array


class Estimator(ABC):
    """What a `Regulator` needs of an estimator; all of it is pure.

    Attributes:
        model: the discrete model of the plant.
        noise: standard deviation of the measurement noise of each output, shape (l,), in output units; None where only
            ratios count.
        noise_told: the same where it was told, or the model's record did; None where it is a guess or not known.
    """

    model: StateSpace
    noise: Array | None = None
    noise_told: Array | None = None

    @property
    def planning_model(self) -> StateSpace:
        """The model whose states `Estimate.x` holds; by default that of the plant."""
        return self.model

    @abstractmethod
    def initial(self, u: Array, y: Any = None, v: Array | None = None) -> Estimate:
        """In a steady state under inputs u (m,) and measured disturbances v (d,), default those of the operating
        point; with measurements y (l,) the disturbances explain them.
        """

    @abstractmethod
    def update(self, last: Estimate, u: Array, y: Array, v_last: Array, v: Array) -> Updated | None:
        """Predict and correct with every output believed; None if some number is not usable.

        Args:
            last: the estimate at the last sample.
            u: inputs applied since, shape (m,).
            y: measurements, shape (l,), taken just before the inputs are replaced.
            v_last, v: measured disturbances at the last sample and now, shape (d,).
        """

    @abstractmethod
    def predict(self, last: Estimate, u: Array, v: Array | None = None) -> Estimate:
        """One sample on, with the inputs u (m,) and disturbances v (d,) since."""

    @abstractmethod
    def innovation(self, predicted: Estimate, u: Array, y: Array, v: Array | None = None) -> Array:
        """Measured less predicted outputs, shape (l,), for measurements taken as in `update`."""

    @abstractmethod
    def corrected(
        self, predicted: Estimate, innovation: Array, believed: BoolArray | None = None
    ) -> Estimate:
        """Correct with the innovation (l,), of which only the outputs `believed` count (default all)."""

    @abstractmethod
    def loads_of(self, estimate: Estimate) -> Array:
        """What is estimated of loads, shape (k,), for the sensor checks to keep."""

    @abstractmethod
    def with_loads(self, estimate: Estimate, stuck: BoolArray, loads: Array) -> Estimate:
        """The estimate without what measurements of stuck sensors made of the loads.

        Args:
            estimate: predicted.
            stuck: which outputs, shape (l,), at least one.
            loads: `loads_of` the estimate when the number that is stuck first came, shape (l, k).
        """

    def shifts(self, samples: int) -> Array | None:
        """What innovations at the samples 1 .. `samples` will do to the estimate; None where that is not known.

        Of (x, d_u, d_y) at that sample, per unit of white innovations and under each of B hypotheses,
        shape (B, samples, n + m + l, l).
        """
        return None

    def weights_of(self, estimate: Estimate) -> Array | None:
        """How much the `shifts` of each hypothesis count now, shape (B,), or loops first, (S, B); None without any."""
        return None

    def load(self, estimate: Estimate) -> LoadKind | None:
        """What loads seem to do, in words; None for estimators that do not ask."""
        return None
