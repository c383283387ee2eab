"""Who needs the fewest moves at equal tracking error: seven plants, five kinds of load, ours and the rivals.

    python benchmarks/attention.py [--quick] [--jobs 2] [--plants tank level]

Every method has one knob and three structures (how fast the estimator's loads drift). On tuning seeds each structure is
run over the knob for every plant and load; the one that needs the fewest moves at 1.25 times plain MPC's error is run
over the knob again on other seeds. All methods are tuned alike, with the same number of simulations. Results and what
made them go to benchmarks/results/attention.json; `--draw` makes the heat map and the tables of docs/comparison.md.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

import mampc
from mampc import loads, rivals
from mampc.compare.fronts import RATIOS, Point, moves_at
from mampc.loop.batch import simulate_batch

RESULTS = Path(__file__).parent / "results"
TUNING, EVALUATION = range(1000, 1003), range(6)
STEPS = 200
KNOB = np.geomspace(1 / 30, 30, 9)
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


def estimator_of(case: Case, drift: float) -> mampc.KalmanFilter:
    return mampc.KalmanFilter.offset_free(case.model, measurement_noise=case.noise, drift=drift * case.noise)


def regulator_of(case: Case, method: str, structure: tuple, knob: float) -> mampc.Regulator:
    """One method with one structure at one value of its knob, which counts in units of noise."""
    drift, tail, lighter = structure
    unit, sigma = per_input(case), case.noise
    mpc = mampc.MPC(problem_of(case))
    made = {
        "MPC": lambda: mpc,
        "dead-band": lambda: rivals.DeadBand(mpc, size=knob * unit),
        "rounding": lambda: rivals.Rounded(mpc, step=knob * unit),
        "rounding, hysteresis": lambda: rivals.Rounded(mpc, step=knob * unit, hysteresis=0.4),
        "event-triggered": lambda: rivals.EventTriggered(mpc, threshold=knob * sigma),
        "quiet zone": lambda: rivals.QuietZone(mpc, band=knob * sigma),
        "l1 on moves": lambda: rivals.Penalised(problem_of(case), penalty=rivals.L1(weight=knob, size=unit)),
        "exact price": lambda: mampc.MAMPC(
            problem_of(case, lighter=lighter, tail=tail, moves=3), mampc.MoveRules(price=10 * knob)
        ),
    }[method]()
    return mampc.Regulator(made, estimator_of(case, drift))


RIVAL_STRUCTURES = tuple((drift, 0.0, 1.0) for drift in (0.1, 0.3, 1.0))
STRUCTURES = {
    "MPC": ((0.3, 0.0, 1.0),),
    **dict.fromkeys(
        ("dead-band", "rounding", "rounding, hysteresis", "event-triggered", "quiet zone", "l1 on moves"),
        RIVAL_STRUCTURES,
    ),
    "exact price": tuple((drift, 20.0, 0.1) for drift in (0.1, 0.3, 1.0)),
}


def measured(name: str, kind: str, method: str, structure: tuple, knobs, seeds) -> list[Point]:
    """Moves and errors over the knob."""
    case, points = cases()[name], []
    for knob in knobs:
        regulator = regulator_of(case, method, structure, float(knob))
        batch = simulate_batch(
            case.plant, regulator, reference_of(case), seeds=seeds, noise=case.noise, loads=load_of(kind, case),
            progress=False,
        )  # fmt: skip
        moves = np.count_nonzero(np.abs(np.diff(batch.u, axis=1)) > 1e-9, axis=(1, 2))
        error = np.mean(((batch.y - batch.r) / case.noise) ** 2, axis=(1, 2))
        points.append(Point(method, float(knob), moves.astype(float), error))
    return points


def cell(name: str, kind: str, quick: bool) -> dict:
    """One plant under one kind of load: every method tuned, then measured on other seeds."""
    knobs = KNOB[::2] if quick else KNOB
    tuning, evaluation = (TUNING[:1], EVALUATION[:2]) if quick else (TUNING, EVALUATION)
    base = {
        seeds: measured(name, kind, "MPC", STRUCTURES["MPC"][0], [1.0], seeds)[0]
        for seeds in (tuning, evaluation)
    }
    found: dict = {"plant": name, "load": kind, "moves of MPC": float(base[evaluation].moves.mean())}
    for method, structures in STRUCTURES.items():
        if method == "MPC":
            continue
        tried = {s: measured(name, kind, method, s, knobs, tuning) for s in structures}
        at = {s: moves_at(points, base[tuning], 1.25).value for s, points in tried.items()}
        best = min(structures, key=lambda s: at[s] if np.isfinite(at[s]) else np.inf)
        points = measured(name, kind, method, best, knobs, evaluation)
        found[method] = {
            "structure": best,
            **{f"{ratio:g}": list(moves_at(points, base[evaluation], ratio)) for ratio in RATIOS},
        }
    return found


def run(quick: bool, jobs: int, plants: list[str]) -> None:
    work = [(name, kind) for name in cases() if not plants or name in plants for kind in LOADS]
    began, found = time.time(), []
    parallel = Parallel(n_jobs=jobs, return_as="generator_unordered")
    for number, result in enumerate(parallel(delayed(cell)(*w, quick) for w in work), 1):
        found.append(result)
        left = (time.time() - began) / number * (len(work) - number)
        print(
            f"{number} of {len(work)} cells, {left / 60:.0f} min left: {result['plant']}, {result['load']}",
            file=sys.stderr,
        )
    order = {w: i for i, w in enumerate(work)}
    found.sort(key=lambda r: order[r["plant"], r["load"]])
    RESULTS.mkdir(exist_ok=True)
    made_by = {
        "command": "python " + " ".join(["benchmarks/attention.py", *sys.argv[1:]]),
        "python": platform.python_version(),
        "numpy": np.__version__, "mampc": mampc.__version__, "machine": platform.machine(),
        "steps": STEPS, "tuning seeds": 1 if quick else len(TUNING),
        "evaluation seeds": 2 if quick else len(EVALUATION),
        "minutes": round((time.time() - began) / 60, 1),
    }  # fmt: skip
    (RESULTS / "attention.json").write_text(json.dumps({"made by": made_by, "cells": found}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer seeds and settings, to see that it runs")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--plants", nargs="*", default=[], help="only these")
    parser.add_argument(
        "--draw", action="store_true", help="tables and the heat map from the results there are"
    )
    given = parser.parse_args()
    if not given.draw:
        run(given.quick, given.jobs, given.plants)
    import attention_report

    attention_report.write(RESULTS / "attention.json")


if __name__ == "__main__":
    main()
