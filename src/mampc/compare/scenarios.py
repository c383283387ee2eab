"""Closed loops to tune on: stand-ins for the plant, references, noise and loads, all drawn from a model by seeds.

Sizes come from the model and its limits alone, so that units decide nothing: noise from `model.noise` or a share of
what the whole range does, references from the noise, loads from what shows in the outputs like their noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_vector
from mampc.base.errors import MampcError
from mampc.loop.batch import simulate_batch
from mampc.loop.disturbances import input_units, response_within_reach
from mampc.loop.guessed_noise import guessed_noise
from mampc.loop.loads import Coloured, Load, RandomSteps, RandomWalk, drawn
from mampc.loop.regulator import Regulator
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.usual import dead_samples, usual_problem
from mampc.systems.mismatch import Mismatch
from mampc.systems.noise import white_noise
from mampc.systems.state_space import StateSpace

LEAST_GAIN = 1e-3  # of the largest: directions that answer less are not asked for
CHANGE = 10.0  # times the noise: how far set-points go, either way
CHANGES = 4  # set-point changes of a scenario
LENGTHS = (160, 300)  # fewest and most samples of a scenario
HORIZONS_LONG = 5  # a scenario lasts that many prediction horizons, within these

STAND_IN = Mismatch(gain=0.15, lag=0.15, dead_time=0.15)
HALVED = 3  # times that a stand-in's shares are halved where plain MPC does not cope with it
COPES = 5.0  # times its error on the model that plain MPC may have on a stand-in

STEP, WALK, COLOURED, LAG = 10.0, 0.4, 3.0, 10  # sizes of loads, times noise over gain; the last in samples


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is known, or assumed, of everything around the controller.

    Attributes:
        noise: standard deviations of the measurement noise, shape (l,).
        guessed: whether nobody told the noise, nor a record.
        reference_changes: set-points differ from the operating point by up to these, shape (l,).
        reach: whether set-points are only those that the inputs can hold.
        loads: kinds of scenarios, each a tuple of loads; scenarios take them in turn.
    """

    noise: Array
    guessed: bool
    reference_changes: Array
    reach: bool
    loads: tuple[tuple[Load, ...], ...]

    @classmethod
    def of(cls, problem: TrackingProblem, noise: Any, reference_changes: Any, loads: Any) -> Surroundings:
        """What is told, and what the model and its limits say in place of the rest.

        Raises:
            MampcError: values that do not fit the model, or inputs without limits where these are needed.
        """
        model = problem.model
        l = model.n_outputs
        noise = white_noise(model.noise) if noise is None else noise
        guessed = noise is None
        if noise is None:
            noise = guessed_noise(problem)
        sizes = as_vector("noise", noise, l, 0.0, exclusive=True)
        changes = CHANGE * sizes
        if reference_changes is not None:
            changes = as_vector("reference_changes", reference_changes, l, 0.0)
        kinds = every_kind(model, sizes, scenario_length(problem)) if loads is None else _given(loads)
        return cls(sizes, guessed, changes, reference_changes is None, kinds)


def _given(loads: Any) -> tuple[tuple[Load, ...], ...]:
    """Loads as told: a list for all scenarios, or lists that they take in turn."""
    if not isinstance(loads, Sequence):
        raise MampcError(f"loads: expected a list of mampc.loads, received {type(loads).__name__}")
    if loads and all(isinstance(kind, Sequence) for kind in loads):
        return tuple(tuple(kind) for kind in loads)
    return (tuple(loads),)


def every_kind(model: StateSpace, noise: Array, samples: int) -> tuple[tuple[Load, ...], ...]:
    """Loads of every kind at the inputs, the last of them none."""
    unit = input_units(response_within_reach(model), noise)
    return (
        (RandomSteps(size=STEP * unit, every=samples * model.dt / 2),),
        (RandomWalk(size=WALK * unit),),
        (Coloured(size=COLOURED * unit, time_constant=LAG * model.dt),),
        (),
    )


def cautions(problem: TrackingProblem, around: Surroundings) -> tuple[str, ...]:
    """What was assumed and may be far off, a sentence each: noise, measured disturbances, where scenarios rest."""
    model, limits = problem.model, problem.limits
    found = []
    if around.guessed:
        sizes = ", ".join(
            f"{size:.3g} of {name}" for size, name in zip(around.noise, model.names.outputs, strict=True)
        )
        found.append(
            f"nobody told the noise: guessed {sizes}, by the inputs' range; set-point changes and loads are sized by "
            "it, so tell it where you know it (noise of a study's scenarios; `mampc new --model` writes one)"
        )
    if model.n_disturbances and not any(load.at == "measured" for kind in around.loads for load in kind):
        found.append(
            f"measured disturbances ({', '.join(model.names.disturbances)}) rest in all scenarios, since nobody told "
            'how they move; tell it in loads with at = "measured"'
        )
    outside = (model.u_op < limits.u_min) | (model.u_op > limits.u_max)
    found += [
        f"the limits of {name}, {low:.5g} to {high:.5g}, exclude the model's operating point, {at:.5g}: scenarios rest "
        "at the nearest limit instead, from which this input can move one way only; put in limits of the actuator, in "
        "the model's units and not as deviations, or use a model of where the plant is run"
        for name, low, high, at, out in zip(
            model.names.inputs, limits.u_min, limits.u_max, model.u_op, outside, strict=True
        )
        if out
    ]
    return tuple(found)


def even_weight(model: StateSpace, limits: Limits) -> Array:
    """Q of outputs whose errors count alike beside their noise, shape (l,), with 1 for one output or equal noises."""
    noise = Surroundings.of(usual_problem(model, limits, 1.0), None, None, None).noise
    weight: Array = (np.exp(np.log(noise).mean()) / noise) ** 2
    return weight


def scenario_length(problem: TrackingProblem) -> int:
    """Samples of a scenario, in which set-points last twice the longest dead time at least."""
    usual = int(np.clip(HORIZONS_LONG * problem.prediction_horizon, *LENGTHS))
    return max(usual, 2 * CHANGES * dead_samples(problem.model))


@dataclass(frozen=True, eq=False)
class Scenarios:
    """S closed loops; see the module. Equal for every regulator that is run in them.

    Attributes:
        plants: stand-ins, one a loop.
        seeds: of their noise.
        reference, at_inputs, at_outputs, measured: courses, loops first: (S, T, l), (S, T, m), (S, T, l), (S, T, d).
        noise: standard deviations, shape (l,).
        weight: of the outputs' errors, shape (l, l).
        u_initial: inputs at rest, shape (m,).
    """

    plants: tuple[StateSpace, ...]
    seeds: tuple[int, ...]
    reference: Array
    at_inputs: Array
    at_outputs: Array
    measured: Array
    noise: Array
    weight: Array
    u_initial: Array

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def hours(self) -> float:
        """Length of one."""
        return float(self.reference.shape[1] * self.plants[0].dt / 3600)

    @classmethod
    def drawn(
        cls, regulator: Regulator, around: Surroundings, count: int, seed: tuple[int, int]
    ) -> Scenarios:
        """Scenarios on stand-ins with which this regulator, plain MPC, copes."""
        problem = regulator.controller.problem
        model, T = problem.model, scenario_length(problem)
        rng = np.random.default_rng(seed)
        seeds = tuple(rng.integers(2**31, size=count).tolist())
        start = np.clip(model.u_op, problem.limits.u_min, problem.limits.u_max)
        signals = {"input": model.n_inputs, "output": model.n_outputs, "measured": model.n_disturbances}
        courses = {place: np.zeros((count, T, width)) for place, width in signals.items()}
        courses["measured"] += model.v_op
        for s, own in enumerate(seeds):
            for place, load in drawn(around.loads[s % len(around.loads)], T, model.dt, own, signals):
                courses[place][s] += load
        reference = np.array([_reference(problem, around, start, T, own) for own in seeds])
        on_model = cls(
            (model,) * count, seeds, reference, courses["input"], courses["output"], courses["measured"],
            around.noise, problem.output_weight, start,
        )  # fmt: skip
        return on_model._with_stand_ins(regulator, model)

    def _with_stand_ins(self, regulator: Regulator, model: StateSpace) -> Scenarios:
        usual, plants, share = self.run(regulator)[1], list(self.plants), 1.0
        missing = list(range(len(self)))
        for _ in range(HALVED + 1):
            off = Mismatch(**{name: share * part for name, part in vars(STAND_IN).items()})
            tried = replace(
                self.only(missing), plants=tuple(_stand_in(off, model, self.seeds[s]) for s in missing)
            )
            error = tried.run(regulator)[1]
            fine = error <= COPES * usual[missing]
            for s, plant in zip(np.array(missing)[fine].tolist(), np.flatnonzero(fine).tolist(), strict=True):
                plants[s] = tried.plants[plant]
            missing = np.array(missing)[~fine].tolist()
            share /= 2
            if not missing:
                break
        return replace(self, plants=tuple(plants))

    def only(self, loops: Sequence[int]) -> Scenarios:
        """Some of them."""
        parts = {
            name: getattr(self, name)[list(loops)]
            for name in ("reference", "at_inputs", "at_outputs", "measured")
        }
        return replace(
            self,
            plants=tuple(self.plants[s] for s in loops),
            seeds=tuple(self.seeds[s] for s in loops),
            **parts,
        )

    def run(self, regulator: Regulator) -> tuple[Array, Array]:
        """Moves of all inputs together and tracking error, mean of e' Q e, of each loop, shapes (S,).

        e is y - r, of an output with a zone how far it is from that.
        """
        (answer,) = self.run_each([regulator])
        return answer

    def run_each(self, regulators: Sequence[Regulator]) -> list[tuple[Array, Array]]:
        """The same under several regulators, such as values of a setting, which are stepped together."""
        count = len(regulators)
        at_inputs, at_outputs, measured, reference = (
            np.tile(course, (count, 1, 1))
            for course in (self.at_inputs, self.at_outputs, self.measured, self.reference)
        )
        batch = simulate_batch(
            self.plants * count, [own for own in regulators for _ in self.seeds], reference,
            seeds=self.seeds * count, noise=self.noise, input_disturbance=at_inputs, output_disturbance=at_outputs,
            measured_disturbance=measured if measured.shape[2] else None, u_initial=self.u_initial, progress=False,
        )  # fmt: skip
        changes = np.abs(np.diff(np.concatenate([batch.u_initial[:, None], batch.u], axis=1), axis=1))
        moves = (changes > batch.resolution[:, None]).sum(axis=(1, 2)).astype(float)
        with np.errstate(over="ignore", invalid="ignore"):
            off = batch.y - batch.r
            if zones := [zone for zone in batch.zone if zone is not None]:  # all of one problem
                low, high = (np.stack([getattr(zone, end) for zone in zones]) for end in ("low", "high"))
                off = np.maximum(low - batch.y, 0.0) + np.maximum(batch.y - high, 0.0)
            error = np.einsum("sti,ij,stj->s", off, self.weight, off) / off.shape[1]
        error = np.where(np.isfinite(error), error, np.inf)
        return list(zip(moves.reshape(count, -1), error.reshape(count, -1), strict=True))


def _stand_in(off: Mismatch, model: StateSpace, seed: int) -> StateSpace:
    """A plant off the model; the model itself where its pairs cannot be taken apart."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return off.drawn(model, seed)
    except (MampcError, np.linalg.LinAlgError):
        return model


def _reference(problem: TrackingProblem, around: Surroundings, start: Array, T: int, seed: int) -> Array:
    """Set-points of one scenario, shape (T, l): levels that change all at once, a few times."""
    model, limits = problem.model, problem.limits
    rng = np.random.default_rng([seed, 0x52])
    gain = _steady_gain(model)
    rest = model.y_op + model.C @ model.steady_state(start) + model.D[:, : len(start)] @ (start - model.u_op)
    rows, period = np.tile(rest, (T, 1)), T / CHANGES
    unit = np.where(around.noise > 0, around.noise, 1.0)
    needed = np.linalg.pinv(gain / unit[:, None], rcond=LEAST_GAIN) / unit  # of inputs, per change of outputs
    for number in range(CHANGES):
        at = int((number + 0.5 * rng.random()) * period)
        change = around.reference_changes * rng.uniform(-1, 1, len(rest))
        if around.reach:
            change = gain @ (np.clip(start + needed @ change, limits.u_min, limits.u_max) - start)
        level = rest + change
        rows[at:] = np.clip(level, limits.y_min, limits.y_max)
    return rows


def _steady_gain(model: StateSpace) -> Array:
    """Output changes per unit of input, shape (l, m): steady, or after 10 samples where the model integrates."""
    try:
        gain = model.dc_gain()
    except MampcError:
        gain = model.step_response(11)[-1]
    return gain[:, : model.n_inputs]
