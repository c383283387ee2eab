"""What a plan's later moves gain from later measurements, and what a pattern forgoes of that.

Moves planned for the sample j are chosen at the sample j, when the estimate has changed by the innovations since. An
innovation at j shifts the estimated state and disturbances by G w, w white with variance one. With the tracking problem
from j on, |U d - target|^2 in the moves d at j and later, it shifts the target by T G w; moves at j or later that
the pattern S holds make up for what of it lies in the span of their columns U_S, Q an orthonormal basis of them:

    forgone(S) = sum_{j=1..nc-1} |(I - Q Q') T G|^2

beside a plan with every move free. As innovations are white and the pattern is fixed, the expected cost of choosing its
later moves with later data is, limits aside, the cost of its plan and forgone(S), but for a constant that all patterns
share. It is a sum of squares and falls with every move that a pattern gains, so that it is a price as any other.

Hypotheses about the loads have a G each; their weights mix what is forgone under each. All of it grows with the
variance of the noise, and so may the price: then what it costs for the noise told is scaled by the sum of the weights,
1 where the noise is as told.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import MampcError, MampcWarning
from mampc.program.condensing import CondensedQP
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.restriction import by_count

MOST_KEPT = 30_000  # patterns


class Information:
    """What every pattern forgoes; see the module.

    Args:
        problem: the tracking problem.
        shifts: G of each hypothesis and each of the samples 1 .. nc - 1, of (x, d_u, d_y),
            shape (B, nc - 1, n + m + l, l).
        price_of: of a pattern for the noise told, where prices follow the noise; None where they do not.
    """

    def __init__(
        self,
        problem: TrackingProblem,
        shifts: Array,
        price_of: Callable[[BoolArray], float] | None = None,
    ) -> None:
        if problem.zoned.any():
            raise MampcError(
                "problem: expected set points where plans count on later data, received outputs with a zone"
            )
        self._price_of = price_of
        self._m, self.hypotheses = problem.model.n_inputs, len(shifts)
        self._n_moves = problem.control_horizon * self._m
        self._later: list[tuple[Array, Array]] = []  # U, and T G of all hypotheses side by side
        for j in range(1, problem.control_horizon):
            from_then_on = replace(
                problem, prediction_horizon=problem.prediction_horizon - j,
                control_horizon=problem.control_horizon - j, limits=Limits(), weigh_first_move=True,
                u_cost=0.0,
            )  # fmt: skip
            with warnings.catch_warnings():  # the whole problem has warned of its condition
                warnings.simplefilter("ignore", MampcWarning)
                condensed = CondensedQP(from_then_on)
            target = condensed.target_map
            place = condensed.parameter
            of_estimate = np.hstack(
                [target[:, place.x], target[:, place.input_disturbance], target[:, place.output_disturbance]]
            )
            shifted = np.matmul(of_estimate, shifts[:, j - 1])  # (B, moves, l)
            self._later.append((condensed.U, shifted.swapaxes(0, 1).reshape(len(of_estimate), -1)))
        self._known: dict[bytes, Array] = {}
        self._parts: dict[tuple[int, bytes], Array] = {}
        self._tables: dict[int, tuple[BoolArray, Array, Array]] = {}

    def forgone(self, pattern: BoolArray) -> Array:
        """Of a pattern, shape (n_moves,), under each hypothesis, shape (B,)."""
        key = pattern.tobytes()
        known = self._known.get(key)
        if known is None:
            if len(self._known) > MOST_KEPT:
                self._known.clear()
            known = self._known[key] = sum(
                (self._part(j, pattern[(j + 1) * self._m :]) for j in range(len(self._later))),
                np.zeros(self.hypotheses),
            )
        return known

    def forgone_by(self, patterns: BoolArray) -> Array:
        """Of each of many patterns, shape (K, n_moves), under each hypothesis, shape (K, B)."""
        rows = np.zeros((len(patterns), self.hypotheses))
        for j in range(len(self._later)):
            later = patterns[:, (j + 1) * self._m :]
            packed = np.packbits(later, axis=1)
            _, first, place = np.unique(packed, axis=0, return_index=True, return_inverse=True)
            rows += self._missed(j, later[first])[place.ravel()]
        return rows

    def _part(self, j: int, later: BoolArray) -> Array:
        """By what a pattern has at the samples from j + 1 on, which many have alike."""
        key = j, later.tobytes()
        known = self._parts.get(key)
        if known is None:
            if len(self._parts) > MOST_KEPT:
                self._parts.clear()
            known = self._parts[key] = self._missed(j, later[None])[0]
        return known

    def price(self, pattern: BoolArray) -> float:
        """Of a pattern, shape (n_moves,), where prices follow the noise; else 0."""
        return 0.0 if self._price_of is None else self._price_of(pattern)

    def charges(self, patterns: BoolArray, weights: Array) -> Array:
        """What patterns (K, n_moves) cost beside their prices with weights (..., B), shape (..., K).

        The array of patterns is taken to stay as it is.
        """
        known = self._tables.get(id(patterns))
        if known is None:
            prices = np.array([self.price(pattern) for pattern in patterns])
            rows = self.forgone_by(patterns) + prices[:, None]
            known = self._tables[id(patterns)] = patterns, rows.T, prices
        charges: Array = weights @ known[1] - known[2]
        return charges

    @property
    def steady(self) -> InformationNow:
        """Under the hypothesis of the steadiest loads alone, by which later data tell least; the noise is as told."""
        told = self.forgone(np.zeros(self._n_moves, dtype=bool))
        return self.at(np.eye(self.hypotheses)[told.argmin()])

    def at(self, weights: Array) -> InformationNow:
        """With these weights of the hypotheses, shape (B,)."""
        return InformationNow(self, weights)

    def _missed(self, j: int, later: BoolArray) -> Array:
        """What patterns of the moves from sample j + 1 on, shape (K, n_later), miss of it: shape (K, B)."""
        (U, shifted), missed = self._later[j], np.zeros((len(later), self.hypotheses))
        for which, moves in by_count(later):
            Q = np.linalg.qr(U[:, moves].transpose(1, 0, 2), mode="complete")[0]
            rest = Q[:, :, moves.shape[1] :].transpose(0, 2, 1) @ shifted
            missed[which] = np.square(rest).sum(axis=1).reshape(len(which), self.hypotheses, -1).sum(axis=2)
        return missed


class InformationNow(NamedTuple):
    """`Information` with the weights of one sample, shape (B,)."""

    information: Information
    weights: Array

    def charge(self, pattern: BoolArray) -> float:
        """What a pattern, shape (n_moves,), costs beside its price."""
        forgone = float(self.information.forgone(pattern).dot(self.weights))
        return forgone + self.information.price(pattern) * float(self.weights.sum() - 1)

    def charges(self, patterns: BoolArray) -> Array:
        """The same of patterns (K, n_moves) that are asked at every sample, shape (K,)."""
        return self.information.charges(patterns, self.weights)

    def each(self, patterns: BoolArray) -> Array:
        """The same of patterns (K, n_moves) that are asked once, shape (K,)."""
        prices = np.array([self.information.price(pattern) for pattern in patterns])
        charges: Array = self.information.forgone_by(patterns) @ self.weights + prices * (
            self.weights.sum() - 1
        )
        return charges
