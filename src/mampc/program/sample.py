"""One sample's data of the condensed program, and its optimum without limits on a pattern.

All of it is affine in the sample's parameter p (see `condensing`), so that one matrix-vector product gives
everything; the classes here are views into its result.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import KEPT

Indices = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


class Parts(NamedTuple):
    """Where each quantity stands in the data of an optimum or a sample."""

    margins: slice
    moves: slice
    inputs: slice
    residual: slice
    target: slice = slice(0)
    f: slice = slice(0)
    f_moves: slice = slice(0)
    lower: slice = slice(0)
    upper: slice = slice(0)
    price: int | None = None  # what inputs cost that are priced per unit, beside the squares of the residual


class LeastSquares(NamedTuple):
    """The cost of moves d as |U d - target|^2 + least, with U of `CondensedQP`; target has shape (n_moves,).

    `least` is the cost of the free optimum U^-1 target; with limits priced in both may be anything.
    """

    target: Array
    least: float


class Optimum:
    """One sample's optimum without limits on some pattern, as views into one array.

    How far it stays from each bound (negative where it breaks one), its moves d, its inputs
    u_0 .. u_{nc-1}, and its cost: the squared length of a residual and, where inputs have a price, one number more.
    """

    __slots__ = ("_margins", "cost", "data", "parts")

    def __init__(self, data: Array, parts: Parts, margins: Array | None = None) -> None:
        self.data, self.parts, self._margins = data, parts, margins
        self.cost = _cost(data, parts)

    @property
    def margins(self) -> Array:
        return self.data[self.parts.margins] if self._margins is None else self._margins

    @property
    def moves(self) -> Array:
        return self.data[self.parts.moves]

    @property
    def inputs(self) -> Array:
        return self.data[self.parts.inputs]


def _cost(data: Array, parts: Parts) -> float:
    residual, price = data[parts.residual], parts.price
    cost = float(residual.dot(residual))
    return cost if price is None else cost + float(data[price])


class LaterData(Protocol):
    """What patterns cost beside their prices, for what later measurements will tell; see `moves.information`."""

    def charge(self, pattern: BoolArray) -> float: ...

    def charges(self, patterns: BoolArray) -> Array: ...


class Sample(Optimum):
    """One sample's data; symbols as in `condensing`. As an `Optimum`: that with every move free.

    Attributes:
        parameter: p.
        u_previous: shape (m,).
        frozen: for how many samples each input may not move, whatever the rules say, shape (m,); None for none.
        bounds_now: the bounds, where they are those of this sample alone; else None.
        later_data: what patterns forgo of later measurements, where plans count on these; else None.
    """

    __slots__ = (
        "_constant",
        "bounds_now",
        "distances",
        "frozen",
        "later_data",
        "parameter",
        "u_previous",
    )

    def __init__(
        self,
        data: Array,
        parts: Parts,
        parameter: Array,
        u_previous: Array,
        frozen: Indices | None = None,
        bounds_now: BoundsNow | None = None,
    ) -> None:
        self.data, self.parts, self.parameter, self.u_previous = data, parts, parameter, u_previous
        self.frozen, self.bounds_now = frozen, bounds_now
        self.later_data: LaterData | None = None
        self._margins: Array | None = None
        self._constant: float | None = None
        self.cost = _cost(data, parts)
        self.distances: Array | None = None
        if bounds_now is not None:
            data[parts.lower], data[parts.upper] = bounds_now.lower, bounds_now.upper
            self._margins = bounds_now.margins(data[parts.moves])
        data.setflags(write=False)  # and with it every view that is handed out

    @property
    def target(self) -> Array:
        """What U d should be, shape (n_moves,): moves d cost |U d - target|^2 more than the free optimum."""
        return self.data[self.parts.target]

    @property
    def least_squares(self) -> LeastSquares:
        """The cost of any moves, limits of outputs aside."""
        return LeastSquares(self.target, self.cost)

    @property
    def f(self) -> Array:
        """Linear term of the program, shape (n_variables,)."""
        return self.data[self.parts.f]

    @property
    def f_moves(self) -> Array:
        """Its entries for the moves, shape (n_moves,)."""
        return self.data[self.parts.f_moves]

    def charge(self, pattern: BoolArray) -> float:
        """What a pattern, shape (n_moves,), costs beside its price, 0 where plans do not count on later data."""
        return 0.0 if self.later_data is None else self.later_data.charge(pattern)

    @property
    def constant(self) -> float:
        """The cost of no moves."""
        if self._constant is None:
            self._constant = self.cost + float(self.target.dot(self.target))
        return self._constant

    @property
    def lower(self) -> Array:
        """Lower bounds of the program, shape (n_bounds,)."""
        return self.data[self.parts.lower]

    @property
    def upper(self) -> Array:
        """Upper bounds of the program, shape (n_bounds,)."""
        return self.data[self.parts.upper]

    @property
    def both_bounds(self) -> Array:
        """Lower bounds, and behind them the upper ones."""
        return self.data[self.parts.lower.start : self.parts.upper.stop]


class BoundsNow:
    """The bounds of one sample, where inputs have limits that vary over the horizon.

    Args:
        lower, upper: bounds of the program, shape (n_bounds,).
        bounded_rows: the bounded quantities per move, those of the violations left out.
        low, high: least and largest u_j - u_previous, shape (nc, m).
        bound_of_move: which bound limits the input after each move, shape (n_moves,); -1 for none.
        input_prefix: see `tolerances`, shape (m,).
    """

    def __init__(
        self,
        lower: Array,
        upper: Array,
        bounded_rows: Array,
        low: Array,
        high: Array,
        bound_of_move: Indices,
        input_prefix: Array,
    ) -> None:
        self._kept = KEPT * input_prefix
        self.lower, self.upper, self._rows = lower, upper, bounded_rows
        self.low, self.high, self._bound_of_move = low, high, bound_of_move.reshape(low.shape)

    def margins(self, moves: Array) -> Array:
        """How far moves, shape (n_moves,), keep from each lower bound and, behind that, each upper one."""
        rows, first = self._rows @ moves, len(self.lower) - len(self._rows)
        return np.concatenate([rows - self.lower[first:], self.upper[first:] - rows])

    def on(self, pattern: BoolArray) -> tuple[Array, Array] | None:
        """The bounds for a pattern; None where it cannot keep them.

        An input that does not move at some samples has to keep, from its last move on, the limits of all of
        them.
        """
        lower, upper, moved = self.lower.copy(), self.upper.copy(), pattern.reshape(self.low.shape)
        low, high = self.low[-1].copy(), self.high[-1].copy()
        for j in range(len(moved) - 1, -1, -1):
            low, high = np.maximum(low, self.low[j]), np.minimum(high, self.high[j])
            now = moved[j]
            at, known = self._bound_of_move[j][now], self._bound_of_move[j][now] >= 0
            lower[at[known]], upper[at[known]] = low[now][known], high[now][known]
            low[now], high[now] = -np.inf, np.inf
        return (lower, upper) if (low <= self._kept).all() and (high >= -self._kept).all() else None


class PatternOptimum:
    """The optimum without limits on one pattern, ready to be evaluated sample by sample."""

    def __init__(self, preview_map: Array, constant_map: Array, parts: Parts) -> None:
        self._maps, self.parts = {m.shape[1]: m for m in (preview_map, constant_map)}, parts

    def at(self, sample: Sample) -> Optimum:
        """Its values for one sample; margins belong to the bounds that a `Restriction` keeps, or
        to all of them where they are this sample's own.
        """
        parameter, bounds_now = sample.parameter, sample.bounds_now
        data = self._maps[len(parameter)].dot(parameter)
        return Optimum(
            data, self.parts, None if bounds_now is None else bounds_now.margins(data[self.parts.moves])
        )
