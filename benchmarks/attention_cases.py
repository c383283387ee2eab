"""The plants of the attention benchmark, with the models that controllers have of them, their loads and references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import mampc
from mampc import loads
from mampc.compare.fronts import Point

STEPS = 200
LOADS = ("none", "steps", "wandering", "coloured", "sinusoidal")


@dataclass(frozen=True)
class Case:
    """A plant, the model that controllers have of it, and its usual noise and set-point changes, in output units."""

    plant: object
    model: mampc.StateSpace
    noise: np.ndarray
    changes: np.ndarray
    limits: mampc.Limits
    horizon: int


def cases() -> dict[str, Case]:
    """The plants by name, in the order of the tables."""
    tank, leaky = mampc.plants.QuadrupleTank(), Leaky()
    cell, reactor, level = mampc.plants.SolidOxideFuelCell(), mampc.plants.VanDeVusse(), mampc.plants.Level()
    column, third = mampc.plants.wood_berry(), mampc.plants.ogunnaike_ray()
    off = mampc.Mismatch(gain=0.1, lag=0.1)

    def case(plant, model, noise, changes, low, high, horizon):
        return Case(
            plant, model, np.array(noise), np.array(changes), mampc.Limits(u_min=low, u_max=high), horizon
        )

    tank_model = mampc.linearise(tank).discretise(10.0)
    return {
        "tank": case(tank, tank_model, [0.1, 0.1], [2.0, 2.0], 0.0, 100.0, 15),
        "tank with leak": case(leaky, tank_model, [0.1, 0.1], [2.0, 2.0], 0.0, 100.0, 15),
        "fuel cell": case(
            cell, mampc.linearise(cell).discretise(0.5), [0.2], [4.0], [80.0, 50.0], [120.0, 150.0], 15
        ),
        "Wood-Berry": case(column, column, [0.05, 0.05], [0.5, 0.5], 0.0, [3.9, 3.42], 30),
        "van de Vusse": case(reactor, mampc.linearise(reactor).discretise(7.2), [0.005], [0.05], 0.0, 70.0, 20),
        "level": case(
            mampc.plants.Level(capacity=0.115), mampc.linearise(level).discretise(10.0), [0.01], [0.1], 0.0, 100.0, 30
        ),
        "3 x 3 column": case(
            off.drawn(third, 1), third, [0.001, 0.001, 0.1], [0.01, 0.01, 1.0], 0.0, [0.36, 0.092, 40.0], 40
        ),
    }  # fmt: skip


class Leaky(mampc.plants.QuadrupleTank):
    """The tank with a leak in its first lower tank, which the model does not know."""

    def derivative(self, x, u):
        rates = np.array(super().derivative(x, u), dtype=float)
        rates[..., 0] -= 0.004 * np.sqrt(np.maximum(np.asarray(x)[..., 0], 0.0))
        return rates


def per_input(case: Case) -> np.ndarray:
    """The input change that moves the outputs by their noise, over the horizon, shape (m,)."""
    response = case.model.step_response(case.horizon + 1)[-1][:, : case.model.n_inputs]
    return 1 / np.sqrt(np.mean((response / case.noise[:, None]) ** 2, axis=0))


def load_of(kind: str, case: Case) -> tuple:
    unit, dt = per_input(case), case.model.dt
    return {
        "none": (),
        "steps": (loads.RandomSteps(size=tuple(8 * unit), every=60 * dt),),
        "wandering": (loads.RandomWalk(size=tuple(0.4 * unit)),),
        "coloured": (loads.Coloured(size=tuple(3 * unit), time_constant=10 * dt),),
        "sinusoidal": (loads.Sinusoid(size=tuple(6 * unit), period=100 * dt, phase=None),),
    }[kind]


def reference_of(case: Case) -> np.ndarray:
    y = case.model.y_op
    return mampc.steps(STEPS, y, [(20, y + case.changes), (110, y)])


def problem_of(
    case: Case, *, lighter: float = 1.0, tail: float = 0.0, moves: int = 5
) -> mampc.TrackingProblem:
    """Weights in units of the noise; moves weigh a tenth of what they do to the outputs."""
    weight = 0.1 * lighter / per_input(case) ** 2
    return mampc.TrackingProblem(
        case.model, prediction_horizon=case.horizon, control_horizon=moves, output_weight=1 / case.noise**2,
        move_weight=weight, limits=case.limits, tail_horizon=tail,
    )  # fmt: skip


def points_of(
    case: Case,
    kind: str,
    method: str,
    regulators: Sequence[mampc.Regulator],
    seeds: range,
    *,
    knobs: Sequence[float] | None = None,
    sized_for: Case | None = None,
) -> list[Point]:
    """Moves and errors of regulators, each at its knob, in the same scenarios; loads sized for this case or another."""
    batch = mampc.simulate_batch(
        case.plant, [own for own in regulators for _ in seeds], reference_of(case), seeds=[*seeds] * len(regulators),
        noise=case.noise, loads=load_of(kind, sized_for or case), progress=False,
    )  # fmt: skip
    moves = np.count_nonzero(np.abs(np.diff(batch.u, axis=1)) > 1e-9, axis=(1, 2)).reshape(-1, len(seeds))
    error = np.mean(((batch.y - batch.r) / case.noise) ** 2, axis=(1, 2)).reshape(-1, len(seeds))
    knobs = range(len(regulators)) if knobs is None else knobs
    return [
        Point(method, float(knob), m.astype(float), e) for knob, m, e in zip(knobs, moves, error, strict=True)
    ]


def plain_mpc(case: Case, kind: str, seeds: range) -> Point:
    """Plain MPC, which others are compared with."""
    estimator = mampc.KalmanFilter.offset_free(
        case.model, measurement_noise=case.noise, drift=0.3 * case.noise
    )
    return points_of(case, kind, "MPC", [mampc.Regulator(mampc.MPC(problem_of(case)), estimator)], seeds)[0]
