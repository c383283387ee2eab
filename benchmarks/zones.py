"""Zones against set points: moves at equal time outside the zone.

    python benchmarks/zones.py            # prints the figures of docs/methods.md; some minutes
    python benchmarks/zones.py --figure   # and draws docs/images/zones.svg
    python benchmarks/zones.py --plant tank    # the same on the quadruple tank; or level
    python benchmarks/zones.py --kalman   # with one Kalman filter in place of the load bank
    python benchmarks/zones.py --times    # only how long steps take, against those with set points, on the tank

A first-order plant, its model exact (or the quadruple tank as identified, or the level as linearised, which
integrates), with measurement noise sigma and loads at its output that jump at random. Outputs are to be within
two sigma of their reference. Set point, zone of that width, the same with a pull to the middle, and one of half the
width with it, each with a price per move, over the same seeds; the price goes through the values of `PRICES`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import mampc
from measuring import closed_loop, interleaved, options, steps_of, tank_problem

SIGMA = 0.1
PRICES = (0.03, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0)
PULL = 0.1
SEEDS = 40
STEPS = 200
LOAD = mampc.loads.RandomSteps(at="output", size=0.5, every=60.0)
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "zones.svg"


class Outcome(NamedTuple):
    """Means over the seeds: moves a run, share of samples outside the zone and its standard error."""

    name: str
    price: float
    moves: float
    outside: float
    error: float


class Case(NamedTuple):
    """A plant with its model, noise, and unmeasured loads that jump at random."""

    plant: object
    model: mampc.StateSpace
    sigma: float
    load: mampc.loads.RandomSteps
    limits: mampc.Limits
    seeds: int
    horizon: int = 20
    move_weight: float = 0.01


def case(name: str) -> Case:
    """A case by the name of its plant."""
    if name == "tank":
        model, plant = tank_problem().model, mampc.plants.QuadrupleTank()
        load = mampc.loads.RandomSteps(at="input", size=2.0, every=600.0)
        return Case(plant, model, 0.1, load, mampc.Limits(u_min=0.0, u_max=100.0), 6, 15, 0.03)
    if name == "level":
        plant = mampc.plants.Level()
        model = mampc.linearise(plant).discretise(plant.dt)
        load = mampc.loads.RandomSteps(at="input", size=4.0, every=900.0)
        return Case(plant, model, 0.01, load, mampc.Limits(u_min=0.0, u_max=100.0), 12, 20, 1e-6)
    model = mampc.StateSpace.from_first_order(gain=[[1.0]], time_constant=[[8.0]], dt=1.0)
    return Case(model, model, SIGMA, LOAD, mampc.Limits(u_min=-10.0, u_max=10.0), SEEDS)


def outcome(of: Case, name: str, price: float, width: float, pull: float, kalman: bool) -> Outcome:
    """One controller over all seeds, with a zone of so many sigma, at a price in units of a hundred sigma squared."""
    problem = mampc.TrackingProblem(
        of.model, prediction_horizon=of.horizon, control_horizon=3, tail_horizon=of.horizon, limits=of.limits,
        move_weight=of.move_weight, zone_below=width * of.sigma, zone_above=width * of.sigma, zone_pull=pull,
    )  # fmt: skip
    rules = mampc.MoveRules(price=100 * price * of.sigma**2)
    estimator = mampc.KalmanFilter.offset_free(of.model) if kalman else None
    regulator = mampc.Regulator(mampc.MAMPC(problem, rules), estimator, value_of_information=False)
    batch = mampc.simulate_batch(
        of.plant, regulator, of.model.y_op, steps=STEPS, seeds=range(of.seeds),
        noise=of.sigma, loads=[of.load], progress=False,
    )  # fmt: skip
    inputs = np.concatenate([batch.u_initial[:, None], batch.u], axis=1)
    moves = (np.abs(np.diff(inputs, axis=1)) > 1e-9).sum(axis=(1, 2))
    outside = (np.abs(batch.y - batch.r) > 2 * of.sigma).mean(axis=(1, 2))
    return Outcome(
        name, price, float(moves.mean()), float(outside.mean()), float(outside.std() / np.sqrt(of.seeds))
    )


def moves_at(outcomes: list[Outcome], outside: float) -> float:
    """Moves of a front at a share of time outside, their logarithm being even between its points; nan beyond them."""
    by_time = sorted((o.outside, o.moves) for o in outcomes)
    times, moves = np.array(by_time).T
    return float(np.exp(np.interp(outside, times, np.log(moves), left=np.nan, right=np.nan)))


def draw(fronts: dict[str, list[Outcome]]) -> None:
    """All fronts in one figure."""
    import matplotlib.pyplot as plt

    from mampc.base.drawing import BLUE, GREEN, GREY, VERMILION, styled

    with styled():
        figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
        for (name, outcomes), color in zip(fronts.items(), (GREY, VERMILION, BLUE, GREEN), strict=True):
            axes.errorbar(
                [100 * o.outside for o in outcomes], [o.moves for o in outcomes],
                xerr=[100 * o.error for o in outcomes], marker="o", color=color, label=name,
            )  # fmt: skip
        axes.set(xlabel="time outside two sigma, %", ylabel=f"moves in {STEPS} samples", yscale="log")
        axes.set_yticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
        axes.minorticks_off()
        axes.legend()
        figure.savefig(FIGURE, metadata={"Date": None})


def times() -> None:
    """Steps with zones against steps with set points, on the samples of the loop with zones."""
    point, rules = tank_problem(), mampc.MoveRules(price=1.0)
    for pull in (0.0, PULL):
        zone = replace(point, zone_below=2 * SIGMA, zone_above=2 * SIGMA, zone_pull=pull)
        for name, made in (("MPC", mampc.MPC), ("exact price", lambda problem: mampc.MAMPC(problem, rules))):
            with_zone, with_point = made(zone), made(point)
            asked = closed_loop(with_zone)
            blocks = [(steps_of(with_zone, asked), steps_of(with_point, asked)) for _ in range(3)]
            found = interleaved(blocks)
            print(f"{name}, pull {pull:g}: {found} with set points, {found.ratio:.1f} times as long")


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--figure", action="store_true", help="draw docs/images/zones.svg as well")
    parser.add_argument("--times", action="store_true", help="only compare times of steps")
    parser.add_argument("--kalman", action="store_true", help="one Kalman filter in place of the load bank")
    parser.add_argument("--plant", choices=["first-order", "tank", "level"], default="first-order")
    arguments = parser.parse_args()
    if arguments.times:
        times()
        return
    kinds = {
        "set point": (0.0, 0.0), "zone of two sigma": (2.0, 0.0), f"two sigma, pull {PULL:g}": (2.0, PULL),
        f"one sigma, pull {PULL:g}": (1.0, PULL),
    }  # fmt: skip
    of = case(arguments.plant)
    every = [(name, price) for name in kinds for price in PRICES]
    found = [
        outcome(of, name, price, *kinds[name], arguments.kalman)
        for name, price in track(every, "zones", console=Console(stderr=True))
    ]
    fronts = {name: [o for o in found if o.name == name] for name in kinds}
    table = Table("controller", "price", "moves", "outside", "moves of the set point at equal time")
    points = fronts["set point"]
    for o in found:
        equal = "" if o in points else f"{moves_at(points, o.outside):.1f}"
        outside = f"{100 * o.outside:.1f} +- {100 * o.error:.1f} %"
        table.add_row(o.name, f"{o.price:g}", f"{o.moves:.1f}", outside, equal)
    Console(width=110).print(table)
    if arguments.figure:
        draw(fronts) if arguments.plant == "first-order" else parser.error(
            "the figure is of the first-order plant"
        )


if __name__ == "__main__":
    main()
