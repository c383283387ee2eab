"""What operators do while a loop is simulated: limits of single samples, and inputs that they move by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, as_read
from mampc.base.errors import MampcError, shown
from mampc.controllers.controller import Controller
from mampc.program.limits_now import LimitsNow
from mampc.program.problem import Limits


@dataclass(frozen=True, eq=False)
class Interventions:
    """What is done at each of T samples.

    Attributes:
        limits: of each sample; None for those of the problem.
        manual: where inputs are put by hand, shape (T, m), not-a-number where they are in automatic.
    """

    limits: Sequence[Limits | None]
    manual: Array

    @classmethod
    def of(cls, limits: Any, manual: Any, T: int, controller: Controller) -> Interventions | None:
        """What `simulate` takes, checked; None where nothing is done."""
        if limits is None and manual is None:
            return None
        each = [limits] * T if isinstance(limits, Limits | None) else limits
        if not isinstance(each, Sequence) or not all(isinstance(one, Limits | None) for one in each):
            raise MampcError(
                f"limits: expected mampc.Limits, or one or None a sample, received {shown(limits)}"
            )
        if len(each) != T:
            raise MampcError(f"limits: expected one for each of {T} samples, received {len(each)}")
        for one in {id(one): one for one in each if one is not None}.values():
            for variant in controller.each:
                LimitsNow(one, variant.condensed, variant.levels)  # complains where it does not fit
        m = controller.problem.model.n_inputs
        rows = np.full((T, m), np.nan) if manual is None else as_read("manual", manual)
        if rows.shape not in ((m,), (T, m)) or (np.abs(rows) >= LARGEST).any():
            raise MampcError(
                f"manual: expected inputs of shape ({m},) or ({T}, {m}), not-a-number in automatic, received shape "
                f"{rows.shape}"
            )
        return cls(each, np.broadcast_to(rows, (T, m)))

    def told(self, k: int) -> Mapping[str, Any]:
        """What the regulator is told at sample k, as `Regulator.step` takes it."""
        told: dict[str, Any] = {}
        if self.limits[k] is not None:
            told["limits"] = self.limits[k]
        now, before = self.manual[k], self.manual[k - 1] if k else np.full_like(self.manual[k], np.nan)
        by_hand = np.isfinite(now)
        if by_hand.any():
            told["manual"] = by_hand
        if np.isfinite(before).any():
            told["u_applied"] = before
        return told

    def moved(self, k: int, position: Array) -> Array:
        """Where actuators are that were to be at a position (m,), at sample k."""
        now = self.manual[k]
        return np.where(np.isfinite(now), now, position)
