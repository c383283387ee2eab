"""What tuning is asked for, how much of it a setting uses, and what is promised of the one found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.base.errors import MampcError
from mampc.compare.fronts import FEWEST, Estimate, Point

AIM = 0.9  # share of the allowance that the first two rounds aim at
BACK = 0.8  # factor of the price where a confirmation fails


@dataclass(frozen=True)
class Goal:
    """What is allowed: an increase of the error over that of plain MPC, or moves per hour."""

    max_error_increase: float | None
    max_moves_per_hour: float | None
    hours: float = field(default=0.0, kw_only=True)

    @classmethod
    def asked(cls, max_error_increase: float | None, max_moves_per_hour: float | None) -> Goal:
        """What `tune` is asked for; an increase of a quarter where nothing is."""
        if max_moves_per_hour is None:
            given = 0.25 if max_error_increase is None else max_error_increase
            return cls(as_number("max_error_increase", given, 0.0, exclusive=True), None)
        if max_error_increase is not None:
            raise MampcError("tune: expected one of max_error_increase and max_moves_per_hour, received both")
        return cls(None, as_number("max_moves_per_hour", max_moves_per_hour, 0.0, exclusive=True))

    def used(self, point: Point, baseline: Point) -> Estimate:
        """The share of what is allowed that a setting uses, 1 for all of it."""
        if self.max_error_increase is not None:
            ratio = error_ratio(point, baseline)
            return Estimate(
                (ratio.value - 1) / self.max_error_increase, ratio.standard_error / self.max_error_increase
            )
        assert self.max_moves_per_hour is not None
        moves = moves_per_hour(point, self.hours)
        return Estimate(moves.value / self.max_moves_per_hour, moves.standard_error / self.max_moves_per_hour)

    def at_aim(self, points: Sequence[Point], baseline: Point) -> tuple[float, float]:
        """How good a candidate is where it uses `AIM` of what is allowed, lower being better, and the price there.

        Infinite where no price uses so little.
        """
        order = sorted(points, key=lambda point: point.value)
        used = np.array([self.used(point, baseline).value for point in order])
        if self.max_error_increase is not None:  # a higher price uses more of it
            used = np.maximum.accumulate(used)
            worth = np.log([max(point.moves.mean(), FEWEST) for point in order])
        else:
            used, order = np.maximum.accumulate(used[::-1]), order[::-1]
            worth = np.log([max(point.error.mean(), 1e-300) for point in order])
        logs = np.log([point.value for point in order])
        if used[0] > AIM:
            return np.inf, float(np.exp(logs[0]))
        return float(np.interp(AIM, used, worth)), float(np.exp(np.interp(AIM, used, logs)))

    @property
    def back(self) -> float:
        """The factor by which a price uses less."""
        return BACK if self.max_error_increase is not None else 1 / BACK


def error_ratio(point: Point, baseline: Point) -> Estimate:
    """Mean error over that of plain MPC in the same loops, with the standard error of this ratio of means."""
    mean = float(baseline.error.mean())
    ratio = float(point.error.mean()) / mean
    if not np.isfinite(ratio):
        return Estimate(np.inf, np.inf)
    return Estimate(ratio, _standard_error(point.error - ratio * baseline.error) / mean)


def moves_per_hour(point: Point, hours: float) -> Estimate:
    """Mean moves of all inputs together in an hour."""
    return Estimate(float(point.moves.mean()) / hours, _standard_error(point.moves) / hours)


def _short(number: float) -> str:
    return f"{number:.0f}" if abs(number) >= 100 else f"{number:.3g}"


def _standard_error(values: Array) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


@dataclass(frozen=True)
class Expected:
    """What tuning promises: means over scenarios, with their standard errors.

    Attributes:
        moves_per_hour: of all inputs together.
        error_ratio: mean tracking error over that of plain MPC in the same scenarios.
        plain_moves_per_hour: of plain MPC.
        scenarios: how many they are means over.
        by_load: error ratios under each kind of load, in the order of `Tuned.loads`; the promise is about their mean.
            Empty where a kind has fewer than two scenarios.
    """

    moves_per_hour: Estimate
    error_ratio: Estimate
    plain_moves_per_hour: Estimate
    scenarios: int
    by_load: tuple[Estimate, ...] = ()

    @classmethod
    def of(cls, point: Point, baseline: Point, hours: float, kinds: int) -> Expected:
        """From runs in scenarios of this length, which take so many kinds of load in turn."""
        enough = kinds if len(point.error) >= 2 * kinds else 0
        parts = [(_part(point, k, kinds), _part(baseline, k, kinds)) for k in range(enough)]
        return cls(
            moves_per_hour(point, hours), error_ratio(point, baseline), moves_per_hour(baseline, hours),
            len(point.error), tuple(error_ratio(*part) for part in parts),
        )  # fmt: skip

    def __str__(self) -> str:
        moves, error, plain = self.moves_per_hour, self.error_ratio, self.plain_moves_per_hour
        ratios = [ratio.value for ratio in self.by_load]
        each = f"; by kind of load {min(ratios):.2f} to {max(ratios):.2f}" if len(ratios) > 1 else ""
        return (
            f"{_short(moves.value)} moves per hour (standard error {_short(moves.standard_error)}; plain MPC "
            f"{_short(plain.value)}) at {error.value:.3f} times the error of plain MPC (standard error "
            f"{error.standard_error:.2g}): means over {self.scenarios} scenarios, from which a single run may "
            f"differ{each}"
        )


def _part(point: Point, kind: int, kinds: int) -> Point:
    """The runs under one kind of load."""
    return Point(point.method, point.value, point.moves[kind::kinds], point.error[kind::kinds])
