"""What the moves of a study wear: starts beyond the actuators' dead-band, beside what their maker says they stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_vector
from mampc.base.errors import said_at
from mampc.study.schema import Study

HOURS_A_YEAR = 8766.0


@dataclass(frozen=True, eq=False)
class Ratings:
    """What is known of the actuators, shape (m,) each.

    Attributes:
        dead_band: changes that they do not answer, in input units.
        most_per_hour: starts that they stand for long, None where unknown.
        most: starts in their life, None where unknown.
    """

    dead_band: Array
    most_per_hour: Array | None
    most: Array | None

    def life_years(self, starts_per_hour: Array) -> list[float | None] | None:
        """How long actuators last that go on like that; None where they never start, or nothing is known."""
        if self.most is None:
            return None
        return [
            float(most / (HOURS_A_YEAR * rate)) if rate > 0 else None
            for most, rate in zip(self.most, starts_per_hour, strict=True)
        ]

    def load(self, starts_per_hour: Array) -> list[float] | None:
        """Starts as shares of what the actuators stand for long; None where that is not known."""
        return None if self.most_per_hour is None else np.divide(starts_per_hour, self.most_per_hour).tolist()


def ratings_of(study: Study, n_inputs: int) -> Ratings:
    """What the study says of the actuators.

    Raises:
        StudyError: not one value, or one per input.
    """
    table = study.actuators
    if table is None:
        return Ratings(np.zeros(n_inputs), None, None)
    arrays = {}
    for name in ("dead_band", "starts_per_hour", "million_starts"):
        value = getattr(table, name)
        with said_at("actuators."):
            arrays[name] = None if value is None else as_vector(name, value, n_inputs)
    millions, band = arrays["million_starts"], arrays["dead_band"]
    assert band is not None
    return Ratings(band, arrays["starts_per_hour"], None if millions is None else 1e6 * millions)
