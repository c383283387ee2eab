"""The tracking problem: what is predicted, how far, at what weights and within what limits."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from mampc.base.checks import (
    Array,
    BoolArray,
    as_instance,
    as_limit,
    as_number,
    as_vector,
    as_weight,
    as_whole,
)
from mampc.base.errors import MampcError, shown
from mampc.systems.state_space import StateSpace, as_discrete

MOST_PREDICTIONS = 5000  # future values of all outputs together; their weights take the square of it
MOST_MOVES = 1000  # future moves of all inputs together
LARGEST_LIMIT_WEIGHT = 1e8
RANK_RATIO = 100.0  # of the weights of two ranks that follow each other
LONGEST_HORIZON = 2000  # samples; a condensed problem beyond it is a mistake rather than a wish


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits in engineering units, each None, a scalar or one value per signal.

    Args:
        u_min, u_max: bounds of the inputs, always kept.
        du_max: largest change of each input from one sample to the next, always kept.
        y_min, y_max: bounds of the outputs, kept where possible (see `TrackingProblem`).
    """

    u_min: Any = None
    u_max: Any = None
    du_max: Any = None
    y_min: Any = None
    y_max: Any = None

    def __repr__(self) -> str:
        """Only the limits that there are."""
        there = {field.name: getattr(self, field.name) for field in fields(self)}
        told = {name: _short(limit) for name, limit in there.items() if limit is not None}
        return f"Limits({', '.join(f'{k}={v}' for k, v in told.items() if v not in ('inf', '-inf'))})"

    def checked(self, n_inputs: int, n_outputs: int) -> Limits:
        """The same limits as arrays, infinite where there is none; raises `MampcError` if they cross."""
        limits = Limits(
            u_min=as_limit("u_min", self.u_min, n_inputs, -np.inf),
            u_max=as_limit("u_max", self.u_max, n_inputs, np.inf),
            du_max=as_limit("du_max", self.du_max, n_inputs, np.inf),
            y_min=as_limit("y_min", self.y_min, n_outputs, -np.inf),
            y_max=as_limit("y_max", self.y_max, n_outputs, np.inf),
        )
        for low, high in (("u_min", "u_max"), ("y_min", "y_max")):
            lower, upper = getattr(limits, low), getattr(limits, high)
            if (lower > upper).any():
                raise MampcError(f"limits: expected {low} <= {high}, received {lower} and {upper}")
        if (limits.du_max < 0).any():
            raise MampcError(f"limits: expected du_max >= 0, received {limits.du_max}")
        for name in ("u_min", "u_max", "du_max", "y_min", "y_max"):
            getattr(limits, name).flags.writeable = False
        return limits


def _short(values: Any) -> str:
    """A weight or limit in a few words: one number where one says it all, a diagonal, or the first entries."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return shown(values)  # not checked yet
    if array.ndim == 2 and array.shape[0] == array.shape[1] and not (array - np.diag(np.diag(array))).any():
        array = np.diag(array)
    if array.size and (array == array.flat[0]).all() and array.ndim < 2:
        return f"{array.flat[0]:g}"
    return np.array2string(array, precision=4, threshold=12, edgeitems=2, separator=", ").replace("\n", "")


@dataclass(frozen=True, eq=False)
class TrackingProblem:
    """Track references with a linear model over a receding horizon (the paper's eqs. 1 to 3).

        minimise   sum_{i=0..np} |r_i - y_i|^2_Q + sum_{j=0..nc-1} |du_j|^2_R + penalty(y limits) [+ tail]
                   [+ sum_{i=0..np} |u_i - u_target|^2_W + c' u_i, with its own tail]
        subject to u_min <= u_j <= u_max, |du_j| <= du_max     j = 0..nc-1
                   y_min - rho_i e <= y_i <= y_max + rho_i e   i = 1..np

    with du_j = u_j - u_{j-1} and the input held at its last value beyond the control horizon. The
    violation e >= 0, one value per output for the whole horizon, costs w (a + a^2 / 2) with a = sqrt(q) e, q
    being the output's own weight (at least R of the input that moves it most cheaply): an exact penalty,
    zero whenever the limits can be kept and w is large enough. rho falls evenly from 1 at i = 1 to 1/2 at np, so
    that an output that is outside already is worth bringing back.

    An output with a zone has a range r_i - zone_below .. r_i + zone_above instead of the reference r_i: its error is
    the distance to that range, nothing inside.

    Args:
        model: a discrete-time `StateSpace`.
        prediction_horizon: np >= 1, in samples.
        control_horizon: nc, 1 <= nc <= np, in samples.
        output_weight: Q; a scalar, one value per output, or an (l, l) matrix.
        move_weight: R (the paper's lambda); a scalar, one value per input, or an (m, m) matrix.
        limits: input, move and output limits, in engineering units.
        weigh_first_move: False leaves du_0 without weight, as the paper prints it (sum from j = 1).
        output_limit_weight: w, up to 1e8: how many times tracking a violation counts.
        output_rank: whole numbers, one per output, 1 for the most important one; default the same for all. Limits and
            zones of each rank weigh `RANK_RATIO` = 100 times what those of the next one weigh, the last one as said.
        tail_horizon: L >= 0, in samples. Beyond the prediction horizon, inputs held, errors go on to count,
            weighted gamma, gamma^2, ... with gamma = L / (1 + L), so that an error that stays costs L
            samples more. With prices it decides how long an offset is looked at (see docs/methods.md).
        u_target: values that inputs rest at where tracking leaves them free, a scalar or one per input; default the
            operating point.
        u_target_weight: W; a scalar, one value per input, or an (m, m) matrix. Small against tracking, for what it
            weighs against Q an output's offset pays for. Inputs count on in the tail, L samples at their last value.
        u_cost: c, the cost of a unit of each input at each sample, a scalar or one per input, counted from the limit
            towards which it pulls: u_min where positive, u_max where negative, which has to be there.
        zone_below, zone_above: how far outputs may be below and above their reference at no cost, in output units, a
            scalar or one per output, infinite for no end at that side; 0 and 0 (the default) for a set point. The
            reference moves the zone; `Zone` gives another one for a sample. Outputs with a zone need an output_weight
            without products with others.
        zone_pull: share of its weight, 0 <= zone_pull < 1, with which an output with a zone is drawn to its reference,
            inside too: q ((1 - pull) dist^2 + pull (y - r)^2); of a `Zone` to its middle. A little of it (0.03) lets
            moves that have a price go to the middle once they are made, and not to the edge.

    Raises:
        MampcError: anything that does not fit the model or the horizons.
    """

    model: StateSpace
    prediction_horizon: int = field(kw_only=True)
    control_horizon: int = field(kw_only=True)
    output_weight: Any = field(default=1.0, kw_only=True)
    move_weight: Any = field(default=0.1, kw_only=True)
    limits: Limits = field(default=Limits(), kw_only=True)
    weigh_first_move: bool = field(default=True, kw_only=True)
    output_limit_weight: float = field(default=1e4, kw_only=True)
    tail_horizon: float = field(default=0.0, kw_only=True)
    u_target: Any = field(default=None, kw_only=True)
    u_target_weight: Any = field(default=0.0, kw_only=True)
    u_cost: Any = field(default=0.0, kw_only=True)
    zone_below: Any = field(default=0.0, kw_only=True)
    zone_above: Any = field(default=0.0, kw_only=True)
    zone_pull: float = field(default=0.0, kw_only=True)
    output_rank: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        as_discrete("model", self.model)
        n_p = as_whole("prediction_horizon", self.prediction_horizon, 1, LONGEST_HORIZON)
        n_c = as_whole("control_horizon", self.control_horizon, 1, LONGEST_HORIZON)
        if n_c > n_p:
            raise MampcError(
                f"control_horizon: expected at most the prediction horizon of {n_p}, received {n_c}"
            )
        m, l = self.model.n_inputs, self.model.n_outputs
        Q = as_weight("output_weight", self.output_weight, l)
        limits = as_instance("limits", self.limits, Limits).checked(m, l)
        weight = as_number("output_limit_weight", self.output_limit_weight, 0.0, exclusive=True)
        if weight > LARGEST_LIMIT_WEIGHT:
            raise MampcError(
                f"output_limit_weight: expected at most {LARGEST_LIMIT_WEIGHT:g}, received {weight:g}"
            )
        if n_p * l > MOST_PREDICTIONS:
            raise MampcError(
                f"prediction_horizon: expected at most {MOST_PREDICTIONS} predicted outputs, "
                f"received {n_p} x {l} outputs"
            )
        if n_c * m > MOST_MOVES:
            raise MampcError(
                f"control_horizon: expected at most {MOST_MOVES} future moves, received {n_c} x {m} inputs"
            )
        for name, value in {
            "prediction_horizon": n_p,
            "control_horizon": n_c,
            "output_weight": Q,
            "move_weight": as_weight("move_weight", self.move_weight, m),
            "limits": limits,
            "output_limit_weight": weight,
            "tail_horizon": as_number("tail_horizon", self.tail_horizon, 0.0),
            "u_target_weight": as_weight("u_target_weight", self.u_target_weight, m),
            "u_target": None if self.u_target is None else as_vector("u_target", self.u_target, m),
            "u_cost": as_vector("u_cost", self.u_cost, m),
            "zone_below": as_limit("zone_below", self.zone_below, l, np.inf),
            "zone_above": as_limit("zone_above", self.zone_above, l, np.inf),
            "zone_pull": as_number("zone_pull", self.zone_pull, 0.0),
        }.items():
            object.__setattr__(self, name, value)
        self._check_input_cost()
        self._check_zones()
        self._check_ranks()
        for array in vars(self).values():
            if isinstance(array, np.ndarray):
                array.flags.writeable = False

    def _check_input_cost(self) -> None:
        weighted = bool(self.u_target_weight.any())
        if self.u_target is None and weighted:
            object.__setattr__(self, "u_target", self.model.u_op.copy())
        if self.u_target is not None and not weighted:
            raise MampcError(
                "u_target: expected a u_target_weight above zero beside it, which says what a distance from the "
                f"target costs, received {shown(self.u_target.tolist())} without"
            )
        for side, pulled in (("u_min", self.u_cost > 0), ("u_max", self.u_cost < 0)):
            limit = getattr(self.limits, side)
            if not np.isfinite(limit[pulled]).all():
                raise MampcError(
                    f"u_cost: expected a finite {side} of every input that it pulls there, received u_cost "
                    f"{self.u_cost} and {side} {limit}"
                )

    def _check_ranks(self) -> None:
        if self.output_rank is None:
            return
        l = self.model.n_outputs
        ranks = as_vector("output_rank", self.output_rank, l)
        if not ((ranks >= 1) & (ranks == np.round(ranks))).all():
            raise MampcError(
                f"output_rank: expected whole numbers of at least 1, received {self.output_rank!r}"
            )
        object.__setattr__(self, "output_rank", ranks.astype(int))
        if not self.output_limit_weights.max() <= LARGEST_LIMIT_WEIGHT:
            raise MampcError(
                f"output_rank: expected output_limit_weight x {RANK_RATIO:g}^(ranks - 1) of at most "
                f"{LARGEST_LIMIT_WEIGHT:g}, received {self.output_limit_weight:g} and ranks {self.output_rank}"
            )

    @property
    def rank_weights(self) -> Array:
        """How many times its weights the limits and the zone of each output weigh for its rank, shape (l,)."""
        if self.output_rank is None:
            return np.ones(self.model.n_outputs)
        weights: Array = RANK_RATIO ** np.asarray(self.output_rank.max() - self.output_rank, dtype=np.float64)
        return weights

    @property
    def output_limit_weights(self) -> Array:
        """w of each output, its rank included, shape (l,)."""
        return self.output_limit_weight * self.rank_weights

    def _check_zones(self) -> None:
        for name in ("zone_below", "zone_above"):
            width = getattr(self, name)
            if (width < 0).any():
                raise MampcError(f"{name}: expected at least 0, received {width}")
        if not self.zone_pull < 1:
            raise MampcError(
                f"zone_pull: expected a share below 1, where zones are set points, received {self.zone_pull:g}"
            )
        zoned = self.zoned
        off_diagonal = self.output_weight - np.diag(np.diag(self.output_weight))
        if off_diagonal[zoned].any():
            raise MampcError(
                "output_weight: expected no products of outputs that have a zone with others, received "
                f"{shown(self.output_weight.tolist())}; give them a diagonal weight"
            )

    @property
    def zoned(self) -> BoolArray:
        """Which outputs have a zone and count, shape (l,)."""
        wide: BoolArray = (self.zone_below > 0) | (self.zone_above > 0)
        return wide & (np.diag(self.output_weight) > 0)

    @property
    def set_point_weight(self) -> Array:
        """Q of the outputs without a zone, zero elsewhere, shape (l, l)."""
        single = ~self.zoned
        return np.where(np.outer(single, single), self.output_weight, 0.0)

    @property
    def prices_inputs(self) -> bool:
        """Whether inputs cost something where they are, by a target or a price."""
        return bool(self.u_target_weight.any() or self.u_cost.any())

    def __repr__(self) -> str:
        """One line; weights and limits of many signals in short."""
        values = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        told = [f"{self.model!r}", f"prediction_horizon={self.prediction_horizon}"]
        told += [f"control_horizon={self.control_horizon}"]
        told += [f"{name}={_short(values[name][0])}" for name in ("output_weight", "move_weight")]
        told += [f"limits={self.limits!r}"]
        for name in ("weigh_first_move", "output_limit_weight", "tail_horizon"):
            value, usual = values[name]
            told += [f"{name}={value!r}"] if value != usual else []
        if self.u_target is not None:
            told += [f"{name}={_short(getattr(self, name))}" for name in ("u_target", "u_target_weight")]
        if self.output_rank is not None:
            told += [f"output_rank={self.output_rank.tolist()}"]
        for name in ("u_cost", "zone_below", "zone_above"):
            told += [f"{name}={_short(getattr(self, name))}"] if getattr(self, name).any() else []
        return f"TrackingProblem({', '.join(told)})"
