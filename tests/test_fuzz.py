"""Whatever the data: the regulator does not raise, keeps the limits, and recovers.

`make fuzz` runs more and longer sequences than the test suite does.
"""

from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

import fuzzing
import mampc
from fuzzing import LARGEST, same_to_the_bit
from mampc import Fault, Remark, Status
from referees import keeps_rules

STEPPED: Counter[str] = Counter()  # steps of the regulator by status; `conftest` prints them
SANE = 1e8  # of estimates
UNRULED = {Remark.BACK_INSIDE, Remark.RULES_SUSPENDED}
SETTLE = 6  # healthy samples after the sensor checks believe again


class Ranges:
    """The input limits that hold at one sample, read off the arguments anew."""

    def __init__(self, problem, present):
        usual, n_c = problem.limits, problem.control_horizon
        told = mampc.Limits() if present is None else present

        def rows(name, usual):
            value = getattr(told, name)
            value = np.full(1, np.nan) if value is None else np.asarray(value, dtype=float)
            return np.broadcast_to(np.where(np.isnan(value), usual, value), (n_c, len(usual)))

        low, high = np.maximum(usual.u_min, -LARGEST / 2), np.minimum(usual.u_max, LARGEST / 2)
        self.low, self.high = np.maximum(rows("u_min", low), low), np.minimum(rows("u_max", high), high)
        crossing = (self.low > self.high).any(axis=0)
        self.low, self.high = np.where(crossing, low, self.low), np.where(crossing, high, self.high)
        self.du_max = np.clip(rows("du_max", usual.du_max), 0.0, usual.du_max)[0]


def on_level(at, low, high, values):
    """The nearest value within limits, on the nearest level where some is within them."""
    within = [] if values is None else [value for value in values if low <= value <= high]
    return min(within, key=lambda value: abs(value - at)) if within else np.clip(at, low, high)


def read(values):
    """The numbers told, not-a-number where they are missing or masked."""
    return np.ma.filled(np.ma.array(values, dtype=float), np.nan)


def is_usable(values):
    """Which of the values told may be believed."""
    return np.abs(np.nan_to_num(read(values), nan=np.inf)) < LARGEST


class FaultyLoop(RuleBasedStateMachine):
    """A loop on a linear plant, in which everything that comes from outside may be wrong."""

    @initialize(loop=fuzzing.loops(), seed=st.integers(0, 2**32 - 1), at_rest=st.booleans())
    def start(self, loop, seed, at_rest):
        self.loop, self.problem, self.model = loop, loop.problem, loop.problem.model
        self.rng, self.regulator = np.random.default_rng(seed), loop.build()
        self.scale = np.abs(self.regulator.estimator.model.C).max()
        self.state = self.regulator.initial_state(None, self.model.y_op if at_rest else None)
        self.believed = fuzzing.Believed(self.state.controller.inputs, self.problem.limits)
        self.x = np.zeros(self.model.n_states)
        self.y_last, self.v_last = self.model.y_op, self.model.v_op
        self.reference, self.present, self.manual = self.model.y_op, None, None
        self.held, self.fresh, self.variant = False, False, None
        self.recorder = None
        if seed % 3 == 0:
            self.folder = TemporaryDirectory()
            self.recorder = mampc.Recorder(Path(self.folder.name) / "loop.csv", self.regulator)
            self.statuses = set()

    @property
    def history(self):
        """The inputs that count as applied, oldest first."""
        return self.believed.applied

    # What stays until it changes

    @rule(size=st.floats(-3.0, 3.0), previewed=st.booleans(), faults=fuzzing.SPOILT, spoil=st.booleans())
    def change_reference(self, size, previewed, faults, spoil):
        reference = self.model.y_op + size * self.scale * self.rng.uniform(-1, 1, self.model.n_outputs)
        if spoil:
            reference, _ = fuzzing.spoilt(reference, faults, self.y_last)
        if previewed:
            n_p, at = self.problem.prediction_horizon, self.rng.integers(self.problem.prediction_horizon + 1)
            rows = np.ma.masked_array(np.tile(self.model.y_op, (n_p + 1, 1)), False)
            rows[at:] = np.ma.masked_invalid(np.ma.array(reference, dtype=float))
            reference = rows
        self.reference = reference

    @precondition(lambda self: self.loop.other is not None)
    @rule(variant=st.sampled_from(["first", "other"]))
    def switch_the_variant(self, variant):
        self.variant = variant

    @precondition(lambda self: self.problem.zoned.any())
    @rule(below=st.floats(0.0, 2.0), above=st.sampled_from([0.0, 0.5, np.inf, np.nan]), ahead=st.booleans())
    def ask_for_a_zone(self, below, above, ahead):
        zoned = self.problem.zoned
        ends = np.array([self.model.y_op - below * zoned, self.model.y_op + np.where(zoned, above, 0.0)])
        if ahead:
            ends = np.tile(ends[:, None], (1, self.problem.prediction_horizon + 1, 1))
        self.reference = mampc.Zone(*ends)

    @rule(told=fuzzing.PRESENT)
    def limit_now(self, told):
        self.present = fuzzing.present_limits(self.problem, told)

    @precondition(lambda self: self.present is not None)
    @rule()
    def limit_no_more(self):
        self.present = None

    @rule(flags=st.tuples(st.booleans(), st.booleans(), st.booleans()))
    def switch_to_manual(self, flags):
        self.manual = list(flags[: self.model.n_inputs])

    @precondition(lambda self: self.manual is not None)
    @rule()
    def switch_to_automatic(self):
        self.manual = None

    # Samples

    @rule(samples=st.integers(1, 5))
    def healthy_samples(self, samples):
        for _ in range(samples):
            self.step(self.measured())

    @rule(faults=fuzzing.SPOILT, samples=st.sampled_from([1, 1, 2, 6]))
    def faulty_measurements(self, faults, samples):
        for _ in range(samples):
            self.step(fuzzing.spoilt(self.measured(), faults, self.y_last)[0])

    @rule(faults=fuzzing.SPOILT)
    def faulty_actuators(self, faults):
        self.step(self.measured(), applied=faults)

    @rule(share=st.floats(-0.5, 1.5), samples=st.integers(1, 3))
    def moved_by_hand(self, share, samples):
        """Saturated, slow or in manual: the plant gets something else than was decided."""
        for _ in range(samples):
            towards = self.history[-2] if len(self.history) > 1 else self.model.u_op
            number = share * (towards - self.history[-1]) + 0.1 * self.rng.standard_normal(len(towards))
            self.step(self.measured(), applied=[("added", float(change)) for change in number])

    @rule(faults=fuzzing.SPOILT)
    def faulty_disturbance(self, faults):
        v = self.model.v_op + self.rng.uniform(-1, 1, self.model.n_disturbances)
        self.step(self.measured(), v=fuzzing.spoilt(v, faults, self.v_last)[0])

    @rule(measured=fuzzing.SPOILT, applied=fuzzing.SPOILT, disturbance=fuzzing.SPOILT)
    def everything_faulty(self, measured, applied, disturbance):
        v, _ = fuzzing.spoilt(self.model.v_op, disturbance, self.v_last)
        self.step(fuzzing.spoilt(self.measured(), measured, self.y_last)[0], applied, v)

    @rule()
    def compare_with_a_fresh_regulator(self):
        self.fresh = True
        self.step(self.measured())

    @rule()
    def recover(self):
        """Healthy samples at rest, nothing else wrong: inputs are decided again."""
        self.reference, self.present, self.manual = self.model.y_op, None, None
        self.x = np.zeros(self.model.n_states)
        noise = 0.01 * min(self.scale, self.regulator._sensors._jump.min())
        confirm, held, by_hand = self.loop.sensors.confirm, [], [("value", float(u)) for u in self.model.u_op]
        limits = self.problem.limits
        bounded = np.isfinite(
            limits.u_max - limits.u_min
        ).all()  # else inputs may be no healthier than the estimate
        for sample in range(confirm + SETTLE):
            y = self.model.y_op + noise * self.rng.uniform(-1, 1, self.model.n_outputs)
            decision = self.step(y, None if bounded and sample else by_hand, self.model.v_op)
            held.append(decision.held)
        estimate = decision.state.estimate
        if max(np.abs(part).max(initial=0.0) for part in vars(estimate).values()) > SANE:
            return  # beyond what a solver can tell from infeasible; it fades away like any other error
        # A prediction that passes by on its way back may have a measurement doubted, until it is confirmed.
        assert not all(held[-max(2, confirm) :])

    def teardown(self):
        if getattr(self, "sound", False):  # else a step failed half-way
            self.recover()
            if self.recorder is not None and Status.TIME_LIMIT not in self.statuses:
                recording = mampc.Recording.from_csv(self.recorder.path, self.model.names)
                differs = mampc.replay(self.loop.build(), None, recording, tolerance=0.0)
                assert differs is None or differs.replayed == Status.TIME_LIMIT
        if getattr(self, "recorder", None) is not None:
            self.recorder.close()
            self.folder.cleanup()

    def measured(self):
        """What healthy sensors show of the plant; a plant that ran away is started again."""
        u = np.clip(np.nan_to_num(self.history[-1]), -1e3, 1e3) - self.model.u_op
        self.x = self.model.A @ self.x + self.model.B[:, : len(u)] @ u
        if np.abs(self.x).max() > 1e4:
            self.x = np.zeros_like(self.x)
        noise = 0.01 * self.scale * self.rng.standard_normal(self.model.n_outputs)
        return self.model.y_op + self.model.C @ self.x + noise

    def step(self, y, applied=None, v=None):
        """One step of the regulator, and everything that must hold of its decision."""
        self.sound = False
        decided, u_applied = self.history[-1], None
        if applied is not None:
            before = self.history[-2] if len(self.history) > 1 else decided
            u_applied, told = fuzzing.spoilt(decided, applied, before)
            self.believed.told(told, self.manual)
        arguments = {
            "u_applied": u_applied, "measured_disturbance": v, "limits": self.present, "manual": self.manual,
            "variant": self.variant,
        }  # fmt: skip
        if self.recorder is None:
            decision = self.regulator.step(self.state, y, self.reference, **arguments)
        else:
            decision = self.recorder.step(self.state, y, self.reference, **arguments)
            self.statuses.add(decision.status)
        STEPPED[decision.status] += 1

        text = decision.state.to_json()
        assert self.regulator.state_from_json(text).to_json() == text
        if self.fresh and decision.status is not Status.TIME_LIMIT:
            other = self.loop.build()
            state = other.state_from_json(self.state.to_json())
            again = other.step(state, y, self.reference, **arguments)
            assert again.status is Status.TIME_LIMIT or same_to_the_bit(again, decision)
        self.fresh = decision.held and not self.held  # a failed solve does not show in the next one
        self.held = decision.held

        self.check(decision)
        self.check_belief(decision, y, v)
        self.state, self.y_last = decision.state, read(y)
        remembered = decision.state.controller.inputs
        self.believed.decided(decision.u)
        np.testing.assert_array_equal(remembered, self.history[-len(remembered) :])
        self.sound = True
        return decision

    def check(self, decision):
        ranges, last, u = Ranges(self.problem, self.present), self.history[-1], decision.u
        assert isinstance(decision.status, Status)
        assert np.isfinite(decision.plan).all()
        assert np.isfinite(decision.changes).all()
        by_hand = np.zeros(len(u), dtype=bool) if self.manual is None else np.array(self.manual)
        chosen = self.regulator.controller
        levels = (chosen if self.loop.other is None else chosen.variants[self.variant or "first"]).levels
        values = [None] * len(u) if levels is None else levels.values
        off = np.array(
            [known is not None and at not in known for at, known in zip(last, values, strict=True)]
        )
        left_alone = by_hand & (((last < ranges.low) | (last > ranges.high)).any(axis=0) | off)
        np.testing.assert_array_equal(decision.plan[0][~left_alone], u[~left_alone])
        assert (decision.plan >= ranges.low)[:, ~left_alone].all()
        assert (decision.plan <= ranges.high)[:, ~left_alone].all()
        assert (decision.plan == last)[:, by_hand].all()
        apart = np.abs(decision.plan - (last + decision.changes.cumsum(axis=0)))
        sizes = np.maximum(np.abs(decision.plan).max(axis=0), np.abs(last))
        assert (apart <= 1e-9 + 1e-14 * sizes).all()
        assert (ranges.low[0] <= u).all()
        assert (u <= ranges.high[0]).all()
        inside_now = np.array(list(map(on_level, last, ranges.low[0], ranges.high[0], values)))
        for at, low, high, known in zip(u, ranges.low[0], ranges.high[0], values, strict=True):
            if known is not None and ((known >= low) & (known <= high)).any():
                assert at in known
        inside = (last >= ranges.low[0]) & (last <= ranges.high[0]) & ~off
        rounding = 1e-9 + 4 * np.spacing(np.abs(last))
        assert (np.abs(u - last) <= ranges.du_max + rounding)[inside].all()
        if (np.abs(u - last) > ranges.du_max + rounding)[~by_hand].any():
            assert Remark.BACK_INSIDE in decision.remarks
        if self.manual is not None:
            np.testing.assert_array_equal(u[self.manual], inside_now[self.manual])
        if decision.held:
            np.testing.assert_array_equal(u, inside_now)
            assert np.isnan(decision.objective)
        else:
            assert np.isfinite(decision.objective)
            assert decision.objective >= decision.lower_bound - 1e-6 * max(1.0, abs(decision.objective))
        assert ((decision.violations >= 0) | np.isnan(decision.violations)).all()
        loop = self.loop.of(self.variant)
        rules = loop.rules
        if loop.exactly_sparse and not UNRULED & set(decision.remarks):
            past = np.array(self.history[-max(rules.sparsity_horizon, rules.dwell) :])
            assert keeps_rules(rules, past, decision.moves)
            own = np.abs(u - last)
            large = (own >= np.max(rules.min_size) - 1e-8) | (np.abs(u) == LARGEST / 2)
            assert ((own == 0) | large | by_hand).all()  # clipping what is held by hand is no move

    def check_belief(self, decision, y, v):
        """What is no usable number is never believed."""
        assert np.isfinite(decision.state.estimate.x).all()
        names, faults = self.model.names.outputs, decision.ignored_outputs
        missing = {name for name, usable in zip(names, is_usable(y), strict=True) if not usable}
        assert missing == {name for name, fault in faults.items() if fault is Fault.MISSING}
        zone, asked = isinstance(self.reference, mampc.Zone), self.reference
        if (np.isnan(asked.high).any() if zone else not is_usable(asked).all()) or (
            set(names) == set(faults) and not self.loop.max_blind_steps
        ):
            assert decision.status is Status.HELD_BAD_MEASUREMENT
        before = self.state.measured_disturbance
        believed = before if v is None else np.where(is_usable(v), read(v), before)
        np.testing.assert_array_equal(decision.state.measured_disturbance, believed)


LONG = settings.get_profile("long")
FaultyLoop.TestCase.settings = LONG if settings.default is LONG else settings.get_profile("short")
TestFaultyLoop = FaultyLoop.TestCase
