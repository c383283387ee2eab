"""How the benchmarks measure, and the closed loop whose samples they measure on."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter
from typing import NamedTuple

import numpy as np

import mampc
from mampc.controllers.controller import Controller

SAMPLES = 145
LAMBDA = 0.1


def options(text: str | None) -> argparse.ArgumentParser:
    """A parser of the options of a benchmark, whose help is the text of its file as it stands."""
    return argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)


def three_inputs() -> mampc.StateSpace:
    """A plant of three inputs and outputs that interact, with dead times."""
    return mampc.StateSpace.from_first_order(
        gain=[[2.0, -0.7, 0.3], [0.5, 1.5, -0.4], [-0.3, 0.4, 1.2]],
        time_constant=[[120, 200, 80], [90, 150, 60], [100, 70, 180]],
        dead_time=[[20, 0, 10], [0, 30, 0], [10, 10, 0]], dt=10.0,
    )  # fmt: skip


class Row(NamedTuple):
    """One line of the table."""

    name: str
    target: str
    measured: str
    detail: str
    passed: bool


class Comparison(NamedTuple):
    """Median seconds per call of two series, and the median over blocks of the first over the second."""

    first: float
    second: float
    ratio: float

    def __str__(self) -> str:
        return f"{readable(self.first)} against {readable(self.second)}"


Calls = Sequence[Callable]


def interleaved(blocks: Sequence[tuple[Calls, Calls]]) -> Comparison:
    """Time two kinds of calls block by block, in alternating order; the first block also runs untimed."""
    medians = []
    for number, block in enumerate([blocks[0], *blocks]):
        times = {}
        for key in (0, 1) if number % 2 else (1, 0):
            times[key] = statistics.median(timed(call) for call in block[key])
        if number:
            medians.append((times[0], times[1]))
    return Comparison(
        statistics.median(a for a, _ in medians),
        statistics.median(b for _, b in medians),
        statistics.median(a / b for a, b in medians),
    )


def readable(seconds: float) -> str:
    return f"{seconds * 1e6:.1f} us" if seconds < 1e-3 else f"{seconds * 1e3:.1f} ms"


def timed(call: Callable) -> float:
    start = perf_counter()
    call()
    return perf_counter() - start


class Asked(NamedTuple):
    """What a controller is asked at one sample of a closed loop."""

    state: mampc.ControllerState
    x: np.ndarray
    reference: np.ndarray
    output_disturbance: np.ndarray


def tank_problem(**changes: object) -> mampc.TrackingProblem:
    """The paper's size and weights on a model identified from the noisy tank, with changes."""
    u = mampc.prbs(order=8, amplitude=25.0, hold=5, mean=[50.0, 50.0])
    data = mampc.excite(mampc.plants.QuadrupleTank(), u, dt=10.0, noise=0.1, seed=1)
    settings = {
        "prediction_horizon": 10, "control_horizon": 5, "move_weight": LAMBDA,
        "limits": mampc.Limits(u_min=0.0, u_max=100.0),
    }  # fmt: skip
    return mampc.TrackingProblem(mampc.n4sid(data, order=4, feedthrough=False).model, **settings | changes)


def closed_loop(controller: Controller) -> list[Asked]:
    """What the controller is asked in a noisy run of the nonlinear tank."""
    plant, asked, step = mampc.plants.QuadrupleTank(), [], controller.step

    def recording(state, x, reference, *, output_disturbance, **others):
        asked.append(Asked(state, x, reference, output_disturbance))
        return step(state, x, reference, output_disturbance=output_disturbance, **others)

    y_op = plant.output(plant.steady_state())
    changes = ((5, (2.0, 2.0)), (50, (-1.0, -1.5)), (100, (1.0, 0.5)))
    reference = mampc.steps(SAMPLES, y_op, [(k, y_op + change) for k, change in changes])
    controller.step = recording
    try:
        estimator = mampc.KalmanFilter.offset_free(controller.problem.model)
        mampc.simulate(plant, mampc.Regulator(controller, estimator), reference, noise=0.1, progress=False)
    finally:
        del controller.step
    return asked


def steps_of(controller: Controller, asked: Sequence[Asked]) -> list[Callable]:
    """One call of the controller per sample."""
    return [
        partial(controller.step, a.state, a.x, a.reference, output_disturbance=a.output_disturbance)
        for a in asked
    ]
