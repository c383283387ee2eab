"""Random loops and the faults that befall them, for tests/test_fuzz.py."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

import mampc

MOST = 3  # inputs and outputs
LARGEST = 1e12  # beyond it no number is believed
SPARSE = {
    "exact": {"time_limit": 0.1},
    "alternating": {"polish": True, "warm_up": 0},
    "greedy": {},
    "penalty_decomposition": {},
    "hard_thresholding": {},
    "admm": {"starts": 2, "iterations": 10},
    "l1": {},
    "reweighted_l1": {"reweightings": 1, "bisections": 6},
}
EXTREMES = (
    np.nan, np.inf, -np.inf, 1e308, -1.7e308, 1e300, 1e12, -1e12, 9.9e11, -9.9e11, 4e11, 1e9, -1e6, 5e-324, -0.0
)  # fmt: skip
NUMBERS = st.one_of(st.sampled_from(EXTREMES), st.floats(), st.floats(-1e3, 1e3), st.floats(-3.0, 3.0))


def same_to_the_bit(a, b):
    return a.status is b.status and all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("u", "plan", "changes", "objective", "lower_bound", "violations")
    )


@dataclass(frozen=True)
class Loop:
    """What a regulator is built from; every call of `build` gives a fresh one."""

    problem: mampc.TrackingProblem
    rules: mampc.MoveRules | None
    method: str
    settings: dict[str, Any]
    estimator: mampc.KalmanFilter | mampc.LoadBank
    sensors: mampc.SensorChecks
    max_blind_steps: int
    reference_filter: mampc.ReferenceFilter | None = None
    counts: bool = False  # on later data, where that can be
    follows: bool = False  # the noise, with its price, where that can be
    learns: bool = False  # gains, where that can be
    other: tuple[Any, ...] | None = None  # problem, rules, method and settings of a second variant

    @property
    def exactly_sparse(self):
        """Whether moves that the rules forbid are exactly zero."""
        return self.rules is not None and (self.method != "alternating" or self.settings["polish"])

    def of(self, variant):
        """The rules and method of a variant, as a loop of its own."""
        if variant != "other":
            return self
        return replace(
            self, **dict(zip(("problem", "rules", "method", "settings"), self.other, strict=True)), other=None
        )

    def controller(self):
        if self.rules is None:
            return mampc.MPC(self.problem)
        return mampc.MAMPC(self.problem, self.rules, method=self.method, **self.settings)

    def build(self):
        controller = self.controller()
        if self.other is not None:
            controller = mampc.ControllerBank({"first": controller, "other": self.of("other").controller()})
        settings = {
            "sensors": self.sensors, "max_blind_steps": self.max_blind_steps, "reference_filter": self.reference_filter
        }  # fmt: skip
        on = {"value_of_information": True, "price_follows_noise": True}
        told = (
            ([on] if self.follows else []) + ([{"value_of_information": True}] if self.counts else []) + [{}]
        )
        for learns in (True, False) if self.learns else (False,):
            for tried in told:
                try:
                    return mampc.Regulator(
                        controller, self.estimator, learn_gains=learns, **settings, **tried
                    )
                except mampc.MampcError:  # another estimator or method, inputs on levels, or inputs alike
                    if tried == {} and not learns:
                        raise
        return None


@st.composite
def models(draw):
    """Stable, integrating and mildly unstable models; with and without feedthrough and measured disturbances."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m, l, d = draw(st.integers(1, MOST)), draw(st.integers(1, MOST)), draw(st.integers(0, 2))
    n = max(l, draw(st.integers(1, 4)))
    kind = draw(st.sampled_from(["stable", "stable", "integrating", "unstable"]))
    poles = rng.uniform(-0.4, 0.95, n)
    poles[0] = {"stable": poles[0], "integrating": 1.0, "unstable": rng.uniform(1.01, 1.15)}[kind]
    modes = np.linalg.qr(rng.standard_normal((n, n)))[0]
    scale = draw(st.sampled_from([1.0, 1.0, 1e-3, 1e3]))  # engineering units of the outputs
    B, C = rng.standard_normal((n, m + d)), scale * rng.standard_normal((l, n))
    D = scale * rng.standard_normal((l, m + d)) if draw(st.booleans()) else None
    names = [
        tuple(f"{letter}{i}" for i in range(count))
        for letter, count in (("u", m), ("y", l), ("x", n), ("v", d))
    ]
    model = mampc.StateSpace(
        modes @ np.diag(poles) @ modes.T, B, C, D, 1.0, rng.uniform(-2, 2, m), scale * rng.uniform(-2, 2, l),
        names=mampc.Names(*names), v_op=rng.uniform(-2, 2, d),
    )  # fmt: skip
    integrating = kind == "integrating"
    assume(not integrating or m >= l)
    disturbance = "input" if integrating or (m >= l and draw(st.booleans())) else "output"
    try:
        if draw(st.booleans()):
            estimator = mampc.LoadBank(model, noise=scale * draw(st.sampled_from([1e-3, 0.1, 0.1, 10.0])))
        else:
            estimator = mampc.KalmanFilter.offset_free(model, disturbance=disturbance)
    except mampc.MampcError:
        assume(False)
    return model, estimator, scale


@st.composite
def limits(draw, model, scale):
    """No limits, some, or all of them; inputs that cannot move at all."""
    m, l = model.n_inputs, model.n_outputs
    widths = st.lists(st.sampled_from([0.0, 0.3, 1.0, 5.0, 5.0, 50.0, np.inf]), min_size=m, max_size=m)
    told = {}
    if draw(st.integers(0, 3)):
        told["u_min"] = model.u_op - draw(widths)
        told["u_max"] = model.u_op + draw(widths)
    if draw(st.booleans()):
        told["du_max"] = draw(st.lists(st.sampled_from([0.0, 0.1, 0.5, 2.0, np.inf]), min_size=m, max_size=m))
    for name, sign in (("y_min", -1.0), ("y_max", 1.0)):
        if draw(st.booleans()):
            width = st.sampled_from([0.0, 0.5, 2.0, np.inf])
            told[name] = model.y_op + sign * scale * np.array(draw(st.lists(width, min_size=l, max_size=l)))
    return mampc.Limits(**told)


@st.composite
def input_costs(draw, limits, model):
    """Costs of inputs, towards limits that there are."""
    checked = limits.checked(model.n_inputs, model.n_outputs)
    costs = [draw(st.sampled_from([0.0, 0.0, 0.01, -1.0])) for _ in range(model.n_inputs)]
    sides = zip(costs, checked.u_min, checked.u_max, strict=True)
    return [cost if np.isfinite(low if cost > 0 else high) else 0.0 for cost, low, high in sides]


@st.composite
def move_rules(draw, n_c):
    """Move rules in any combination; least sizes that fit the limits are drawn with these."""
    return {
        "max_moves": draw(st.one_of(st.none(), st.integers(0, 4))),
        "sparsity_horizon": draw(st.integers(1, 6)),
        "price": draw(st.sampled_from([0.0, 0.0, 0.1, 3.0])),
        "counting": draw(st.sampled_from(["elementwise", "simultaneous"])),
        "dwell": draw(st.sampled_from([1, 1, 2, 4])),
        "max_moves_per_step": draw(st.sampled_from([None, None, 1, 2])),
        "blocks": draw(st.sampled_from([None, None, (1,), (1, n_c - 1) if n_c > 1 else (1,)])),
    }


def levels(kind, limits):
    """Levels that fit the limits; None without a kind, and for limits that leave no range."""
    apart = limits.u_max - limits.u_min
    if kind is None or not (np.isfinite(apart) & (apart > 0)).all():
        return None
    entries = {
        "step": [0.05 * width for width in apart],
        "list": [np.linspace(low, high, 4).tolist() for low, high in zip(limits.u_min, limits.u_max, strict=True)],
        "on/off": [mampc.OnOff(min_on=2.0, min_off=3.0) for _ in apart],
    }  # fmt: skip
    entries["mixed"] = [None, *entries["list"][1:]]
    return entries[kind]


@st.composite
def second_rules(draw, n_c):
    """Rules, method and settings of the second variant of a bank."""
    method = draw(st.sampled_from(["mpc", "exact", "greedy"]))
    rules = None if method == "mpc" else mampc.MoveRules(**draw(move_rules(n_c)))
    return rules, method, SPARSE.get(method, {})


@st.composite
def loops(draw):
    """A regulator: problem, rules and method, estimator and sensor checks."""
    model, estimator, scale = draw(models())
    n_c, told = draw(st.integers(1, 4)), draw(limits(model, scale))
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + draw(st.integers(0, 6)), control_horizon=n_c,
        output_weight=1 / scale**2, move_weight=draw(st.sampled_from([0.01, 0.1, 1.0])), limits=told,
        tail_horizon=draw(st.sampled_from([0.0, 0.0, 2.0])),
        output_limit_weight=draw(st.sampled_from([1e2, 1e4])),
        u_target_weight=draw(st.sampled_from([0.0, 0.0, 1e-3, 0.1])), u_cost=draw(input_costs(told, model)),
        zone_below=scale * draw(st.sampled_from([0.0, 0.0, 0.1, np.inf])),
        zone_above=scale * draw(st.sampled_from([0.0, 0.0, 0.1, 1.0])), zone_pull=draw(st.sampled_from([0.0, 0.1])),
        output_rank=draw(st.sampled_from([None, None, list(range(1, model.n_outputs + 1))])),
    )  # fmt: skip
    rules, method, settings = None, draw(st.sampled_from(["mpc", "alternating", "exact", *SPARSE])), {}
    if method != "mpc":
        settings = dict(SPARSE[method])
        if method == "alternating" and draw(st.booleans()):
            settings = {"polish": False, "max_iterations": draw(st.sampled_from([3, 500]))}
        settings["on_limit_violation"] = draw(st.sampled_from(["keep_budget", "ignore_budget"]))
        size, checked = draw(st.sampled_from([0.0, 0.0, 0.05, 0.4])), problem.limits
        most = np.minimum(checked.du_max, checked.u_max - checked.u_min).min()
        on_levels = draw(st.sampled_from([None, None, None, "step", "list", "mixed", "on/off"]))
        told = levels(on_levels, checked)
        if told is not None:
            settings["on_limit_violation"] = "keep_budget"
            if method == "alternating":
                settings = {"polish": True, "warm_up": 0, "on_limit_violation": "keep_budget"}
        rules = mampc.MoveRules(
            **draw(move_rules(n_c)), min_size=size if size <= most and on_levels != "mixed" else 0.0, levels=told
        )  # fmt: skip
    other = None
    if draw(st.integers(0, 3)) == 0:
        other = replace(problem, move_weight=0.3 * problem.move_weight), *draw(second_rules(n_c))
    with_range = draw(st.booleans())
    sensors = mampc.SensorChecks(
        y_low=model.y_op - 20 * scale if with_range else None,
        y_high=model.y_op + 20 * scale if with_range else None,
        largest_jump=draw(st.sampled_from([None, None, np.inf, scale, 0.1 * scale])),
        confirm=draw(st.integers(1, 4)), stuck_after=draw(st.sampled_from([None, 2, 4])),
    )  # fmt: skip
    smooth = draw(st.sampled_from([None, None, {"time_constant": 3.0}, {"rate": scale}]))
    smooth = None if smooth is None else mampc.ReferenceFilter(**smooth)
    blind = draw(st.sampled_from([0, 0, 2, 5]))
    counts = draw(st.booleans())
    follows = counts and draw(st.booleans())
    learns = draw(st.booleans())
    return Loop(
        problem, rules, method, settings, estimator, sensors, blind, smooth, counts, follows, learns, other
    )


# Faults. Each is drawn for as many signals as there can be, and cut to those that there are.


def per_signal(strategy):
    return st.tuples(*[strategy] * MOST)


# How a healthy value is spoilt: (kind, number).
SPOILT = per_signal(
    st.one_of(
        st.just(("healthy", 0.0)),
        st.tuples(st.sampled_from(["value", "added", "masked"]), NUMBERS),
        st.sampled_from([("stuck", 0.0), ("none", 0.0), ("value", np.nan)]),
    )
)


def spoilt(healthy, faults, last):
    """Healthy values (k,) with faults, as a list or masked array, and the numbers that are to be read from it."""
    read, given, masked = [], [], []
    for value, (kind, number), before in zip(healthy.tolist(), faults[: len(healthy)], last, strict=True):
        with np.errstate(over="ignore"):
            told = {
                "healthy": value, "value": number, "masked": number, "stuck": before, "none": None,
                "added": float(np.float64(value) + number),
            }[kind]  # fmt: skip
        given.append(told)
        masked.append(kind == "masked")
        read.append(np.nan if told is None or masked[-1] else told)
    if any(masked):
        given = np.ma.masked_array([np.nan if v is None else v for v in given], masked)
    return given, np.array(read)


class Believed:
    """What is believed of the inputs, word for word.

    Attributes:
        applied: inputs that count as applied, oldest first.
        commands: inputs decided, oldest first.
    """

    def __init__(self, applied, limits):
        self.applied, self._remembered = [row.copy() for row in applied], len(applied)
        self.commands = [applied[0].copy() for _ in range(12)] + [row.copy() for row in applied]
        self._last, self._answers = applied[-1].copy(), [(0, 0.0)] * len(applied[0])
        self._by_hand = [False] * len(applied[0])
        self._apart, self._limits = limits.u_max - limits.u_min, limits

    def decided(self, u):
        self.applied.append(u.copy())
        self.commands.append(u.copy())

    def told(self, told, manual):
        for i, value in enumerate(told):
            by_hand, apart = manual is not None and manual[i], self._apart[i]
            by_hand, self._by_hand[i] = by_hand or self._by_hand[i], by_hand  # also just after it
            beyond = 100.0 * apart if apart > 0 else np.inf
            low, high = self._limits.u_min[i] - beyond, self._limits.u_max[i] + beyond
            if abs(value) < 5e11 and low < value < high:
                late, offset = self._answers[i]
                expected = self.commands[-1 - late][i] + offset
                tolerance = 0.01 * apart if np.isfinite(apart) else 1e-6 * abs(expected)
                answer = self._answer(i, value, tolerance)
                if by_hand:
                    answer = None if abs(value - self.commands[-1][i]) > 0.1 * tolerance else (0, 0.0)
                if answer is None:
                    self.applied[-1][i] = value
                elif answer not in (self._answers[i], (0, 0.0)):
                    for age in range(1, 1 + min(self._remembered, 12)):
                        self.applied[-age][i] = self.commands[-age][i]
                self._last[i], self._answers[i] = value, answer or (0, 0.0)
            if by_hand:
                for row in self.commands[-12:]:
                    row[i] = self.applied[-1][i]
                self._answers[i] = 0, 0.0

    def _answer(self, i, value, tolerance):
        """Samples by which the input is late, and the offset of its reading; None where it did not obey."""
        commands, last, (late, offset) = [row[i] for row in self.commands], self._last[i], self._answers[i]
        if (late or offset) and abs(value - (commands[-1 - late] + offset)) <= tolerance:
            return late, offset
        if changed := abs(value - last) > tolerance:
            for late in range(11):
                if max(abs(last - commands[-2 - late]), abs(value - commands[-1 - late])) <= tolerance:
                    return late, 0.0
        if abs(value - commands[-1]) <= tolerance:
            return 0, 0.0
        if changed and abs((value - last) - (commands[-1] - commands[-2])) <= tolerance:
            return 0, value - commands[-1]
        return None


# Limits told at run time: for each of the five how (None: not at all) and numbers relative to the operating point.
SHAPES = st.sampled_from([None, None, None, "scalar", "signals", "rows"])
NEAR = st.one_of(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), NUMBERS)
PRESENT = st.fixed_dictionaries(
    {
        name: st.tuples(SHAPES, st.tuples(NEAR, NEAR, NEAR, NEAR))
        for name in ("u_min", "u_max", "du_max", "y_min", "y_max")
    }
)


def present_limits(problem, told):
    """Limits of one sample, for signals that have such limits in the problem, as `Controller.step` asks."""
    usual, given = problem.limits, {}
    inputs = np.isfinite(usual.u_min) | np.isfinite(usual.u_max)
    moves = np.full(len(inputs), bool(np.isfinite(usual.du_max).any()))
    for name, (shape, numbers) in told.items():
        own = getattr(usual, name)
        known = {"u": inputs, "d": moves}.get(name[0], np.isfinite(own))
        if shape is None or not known.any():
            continue
        centre = {"u": problem.model.u_op, "d": np.zeros(len(own)), "y": problem.model.y_op}[name[0]]
        side = {"min": -1.0, "max": 1.0}[name[-3:]]
        rows = problem.prediction_horizon if name[0] == "y" else problem.control_horizon
        varied = np.resize(np.array(numbers), (rows, len(own)))
        with np.errstate(over="ignore"):
            values = np.where(np.abs(varied) <= 2.0, centre + side + varied, varied)
        values = np.where(known, values, np.nan)
        if shape == "rows":
            given[name] = values
        elif shape == "signals" or not known.all():
            given[name] = values[0]
        else:
            given[name] = float(values[0, 0])
    return mampc.Limits(**given)
