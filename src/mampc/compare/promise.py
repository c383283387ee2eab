"""What tuning is asked for, how much of it a setting uses, and what is promised of the one found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.base.errors import MampcError
from mampc.compare.fronts import FEWEST, Estimate, Point
from mampc.loop.loads import Load

PLAIN, RULES_ALONE = "plain MPC", "the rules alone"  # what errors are compared with
AIM = 0.9  # share of the allowance that the first two rounds aim at
BACK = 0.8  # factor of the price where a confirmation fails
FEWEST_LOOPS = 2  # of one kind of load, below which kinds are not told apart


@dataclass(frozen=True)
class Goal:
    """What is allowed: an increase of the error over that of plain MPC, or moves per hour."""

    max_error_increase: float | None
    max_moves_per_hour: float | None
    hours: float = field(default=0.0, kw_only=True)
    kinds: int = field(default=1, kw_only=True)

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
            ratio = ratio_over_kinds(point, baseline, self.kinds)
            return Estimate(
                (ratio.value - 1) / self.max_error_increase, ratio.standard_error / self.max_error_increase
            )
        assert self.max_moves_per_hour is not None
        moves = moves_per_hour(point, self.hours)
        return Estimate(moves.value / self.max_moves_per_hour, moves.standard_error / self.max_moves_per_hour)

    def at_aim(self, points: Sequence[Point], baseline: Point) -> tuple[float, float]:
        """How good a candidate is where it uses `AIM` of what is allowed, lower being better, and the price there.

        Errors need not rise with the price: where plants are off the model, cheap moves can drive them to and fro.
        Infinite where no price uses so little; then with the price that uses least.
        """
        by_error = self.max_error_increase is not None
        order = sorted(points, key=lambda point: point.value, reverse=not by_error)  # towards what uses more
        used = np.array([self.used(point, baseline).value for point in order])
        logs = np.log([point.value for point in order])
        if by_error:
            worth = np.log([max(point.moves.mean(), FEWEST) for point in order])
        else:
            worth = np.log([max(point.error.mean(), 1e-300) for point in order])
        if used.min() > AIM:
            return np.inf, float(np.exp(logs[used.argmin()]))
        best = int(np.where(used <= AIM, worth, np.inf).argmin())
        further = best + 1
        if further == len(order) or used[further] <= AIM or not np.isfinite(worth[further]):
            return float(worth[best]), float(np.exp(logs[best]))
        share = (AIM - used[best]) / (used[further] - used[best])
        at = [float(line[best] + share * (line[further] - line[best])) for line in (worth, logs)]
        return at[0], float(np.exp(at[1]))

    def keeps(self, point: Point, baseline: Point) -> bool:
        """Whether the mean plus one standard error is within what is allowed."""
        used = self.used(point, baseline)
        return bool(used.value + np.nan_to_num(used.standard_error) <= 1)

    @property
    def back(self) -> float:
        """The factor by which a price uses less."""
        return BACK if self.max_error_increase is not None else 1 / BACK


def ratio_over_kinds(point: Point, baseline: Point, kinds: int = 1) -> Estimate:
    """The error over that of plain MPC in the same loops, a mean over the kinds of load that loops take in turn.

    A kind under which it is below 1 counts as 1, so that it makes up for no other.
    """
    ratios = by_kind(point, baseline, kinds) or (_ratio_of_means(point, baseline),)
    value = float(np.mean([max(ratio.value, 1.0) for ratio in ratios]))
    return Estimate(value, float(np.linalg.norm([ratio.standard_error for ratio in ratios]) / len(ratios)))


def by_kind(point: Point, baseline: Point, kinds: int) -> tuple[Estimate, ...]:
    """Mean error over that of plain MPC under each kind of load; none where a kind has too few loops."""
    if len(point.error) < FEWEST_LOOPS * kinds:
        return ()
    return tuple(_ratio_of_means(_part(point, k, kinds), _part(baseline, k, kinds)) for k in range(kinds))


def _ratio_of_means(point: Point, baseline: Point) -> Estimate:
    """Mean error over that of plain MPC, with the standard error of this ratio."""
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
        error_ratio: tracking error over that of plain MPC in the same scenarios, a mean over the kinds of load; a kind
            that comes out below 1 counts as 1.
        plain_moves_per_hour: of plain MPC.
        scenarios: how many they are means over.
        loads: the kinds of load in words.
        by_load: error ratios under each of them; empty where a kind has fewer than two scenarios.
        allowed: the error ratio asked for; None where moves per hour were.
        beside: what errors are compared with, in words.
    """

    moves_per_hour: Estimate
    error_ratio: Estimate
    plain_moves_per_hour: Estimate
    scenarios: int
    loads: tuple[str, ...] = ()
    by_load: tuple[Estimate, ...] = ()
    allowed: float | None = None
    beside: str = PLAIN

    @classmethod
    def of(cls, point: Point, baseline: Point, goal: Goal, loads: Sequence[Sequence[Load]]) -> Expected:
        """From runs in scenarios, which take these kinds of load in turn."""
        allowed = None if goal.max_error_increase is None else 1 + goal.max_error_increase
        return cls(
            moves_per_hour(point, goal.hours), ratio_over_kinds(point, baseline, len(loads)),
            moves_per_hour(baseline, goal.hours), len(point.error), tuple(map(in_words, loads)),
            by_kind(point, baseline, len(loads)), allowed, baseline.method,
        )  # fmt: skip

    def __str__(self) -> str:
        moves, error, plain = self.moves_per_hour, self.error_ratio, self.plain_moves_per_hour
        over = f"{self.scenarios} scenarios"
        kinds = list(zip(self.loads, self.by_load, strict=True)) if len(self.by_load) > 1 else []
        text = (
            f"{_short(moves.value)} moves per hour of all inputs together, {_short(24 * moves.value)} a day (standard "
            f"error {_short(moves.standard_error)} per hour; {self.beside} {_short(plain.value)}), at "
            f"{error.value:.3f} times the error of {self.beside} (standard error {error.standard_error:.2g}): means "
            f"over {over}, from which a single run may differ"
        )
        if kinds:
            each = ", ".join(f"{name} {ratio.value:.2f}" for name, ratio in kinds)
            text += f". By kind of load, which count alike: {each}"
            above = [name for name, ratio in kinds if self.allowed and ratio.value > self.allowed]
            if above:
                text += (
                    f". More than the {self.allowed:g} allowed under {' and '.join(above)}: where your plant has no "
                    "other loads, tell tune which it has"
                )
        return text


def in_words(kind: Sequence[Load]) -> str:
    """A kind of load, such as "random walk and steps"."""
    names = [re.sub(r"(?<!^)(?=[A-Z])", " ", type(load).__name__).lower() for load in kind]
    return " and ".join(names) or "no load"


def _part(point: Point, kind: int, kinds: int) -> Point:
    """The runs under one kind of load."""
    return Point(point.method, point.value, point.moves[kind::kinds], point.error[kind::kinds])
