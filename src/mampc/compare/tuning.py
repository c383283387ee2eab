"""One knob: the controller with the fewest moves at an error that one allows, found on stand-ins for the plant.

Every candidate has a load bank for an estimator and counts on later data; they differ in move weight and tail. They are
run over a grid of prices; the best go on with more prices in fresh scenarios; the best of these is confirmed in
scenarios that nothing was chosen by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mampc.base.checks import as_instance, as_jobs, as_whole
from mampc.base.errors import MampcError
from mampc.base.workers import in_parallel
from mampc.compare.candidates import Candidate, candidates, is_dear
from mampc.compare.fronts import Point, non_dominated
from mampc.compare.promise import PLAIN, RULES_ALONE, Expected, Goal, moves_per_hour, ratio_over_kinds
from mampc.compare.rounds import DEAR_ROUNDS, FINALISTS, HIGHER, ROUNDS, Work
from mampc.compare.scenarios import Scenarios, Surroundings, cautions
from mampc.compare.tuned import REFINE_SPAN, FrontPoint, Tuned
from mampc.controllers import MAMPC, MPC
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.regulator import Regulator
from mampc.moves.rules import MoveRules
from mampc.program.problem import Limits
from mampc.program.usual import usual_problem
from mampc.systems.state_space import StateSpace, as_discrete

SEARCH_SPAN = (3e-3, 3.0)  # prices over the error of plain MPC in a prediction horizon
STEPS = (1, 2, 3, -1, -2, -3, *range(4, 16))  # it goes back where it does not, below zero up


def tune(
    model: StateSpace,
    *,
    limits: Limits | None = None,
    max_error_increase: float | None = None,
    max_moves_per_hour: float | None = None,
    output_weight: Any = 1.0,
    noise: Any = None,
    reference_changes: Any = None,
    loads: Any = None,
    baseline: Regulator | None = None,
    rules: MoveRules | None = None,
    seed: int = 0,
    jobs: int = -1,
    progress: bool | None = None,
    on_task: Callable[[int, int], None] = lambda done, total: None,
) -> Tuned:
    """The controller that moves least often at an error that one allows, from a model and limits.

    The promise is a mean over scenarios, with its standard error: on plants off the model by up to 15 % in each gain,
    lag and dead time, with set-points, noise and loads as told or assumed, the tracking error over that of plain MPC
    in the same scenarios, plus one standard error, is at most 1 + `max_error_increase`. Kinds of load count alike, and
    one under which the error is less than plain MPC's makes up for no other. A single run, and all runs under one kind
    of load, may exceed it: `expected.by_load` says by how much.

    Args:
        model: a discrete model.
        limits: of inputs and outputs; those of `baseline` where that is given.
        max_error_increase: 0.25 for a quarter more than plain MPC's mean of e' Q e, e being y - r or how far y is
            from its zone; the default, 0.25, unless moves per hour are given.
        max_moves_per_hour: of all inputs together, in place of it; the error is then as small as they allow.
        output_weight: Q; see `TrackingProblem`.
        noise: standard deviation of the measurement noise, scalar or (l,); default `model.noise`, else a 500th of
            what the inputs' whole range does to an output.
        reference_changes: set-points differ from the operating point by up to these, scalar or (l,), output units;
            default ten times the noise, as far as the inputs reach.
        loads: of `mampc.loads`, all in every scenario, or lists of them, which scenarios take in turn; () for none.
            Default steps, a random walk, coloured noise and none in turn, sized by noise and gain.
        baseline: a regulator with plain MPC to compare with, whose horizons, weights and limits hold; default from
            the model's settling time.
        rules: to keep at any price, such as least sizes, dwell times and levels; errors are then compared with those of
            the same rules without a price.
        seed: equal seeds give equal results.
        jobs: processes, -1 for one a core.
        progress: as in `simulate`.
        on_task: called with the number of closed loops that are done, and of all.

    Raises:
        MampcError: values that do not fit, two goals, or inputs without limits where sizes are derived from them.
    """
    goal = Goal.asked(max_error_increase, max_moves_per_hour)
    as_whole("seed", seed, 0)
    as_jobs(jobs)
    plain = _plain(model, limits, output_weight, baseline, rules)
    problem = plain.controller.problem
    rules = MoveRules() if rules is None else replace(rules, price=0.0)
    around = Surroundings.of(problem, noise, reference_changes, loads)
    found = candidates(problem, around.noise, around.guessed, rules)
    counts = DEAR_ROUNDS if is_dear(problem, rules) else ROUNDS
    work = Work(counts, len(found), progress, on_task)
    first, base = _drawn(plain, around, counts.searched, (seed, 1), work)
    goal = replace(goal, hours=first.hours, kinds=len(around.loads))
    scale = float(base.error.mean()) * problem.prediction_horizon
    prices = [scale * factor for factor in np.geomspace(*SEARCH_SPAN, counts.search_prices).tolist()]
    ranked: list[tuple[float, int, float]] = []
    for number, points in enumerate(_each([(c, prices) for c in found], first, jobs, work)):
        worth, price = goal.at_aim(points, base)
        ranked.append((worth, number, price))
    ranked.sort()
    second, base = _drawn(plain, around, counts.refined, (seed, 2), work)
    span = np.geomspace(1 / REFINE_SPAN, REFINE_SPAN, counts.refine_prices)
    tasks = [(found[number], (price * span).tolist()) for _, number, price in ranked[:FINALISTS]]
    finalists = []
    for (candidate, _), points in zip(tasks, _each(tasks, second, jobs, work), strict=True):
        finalists.append((*goal.at_aim(points, base), candidate, points))
    finalists.sort(key=lambda finalist: finalist[0])
    last, last_base = _drawn(plain, around, counts.confirmed, (seed, 3), work)
    chosen, price, point, reached = _confirmed(goal, finalists, last, last_base, jobs, work)
    expected = Expected.of(point, last_base, goal, around.loads)
    front: tuple[FrontPoint, ...] = ()
    runs = [base, *(point for *_, points in finalists for point in points)]
    if chosen is not None:
        own = next(points for *_, candidate, points in finalists if candidate is chosen)
        at_price = _at_price(chosen, price, second, jobs)  # beside the others, in the same scenarios
        front = _front([*own, at_price], base, goal)
        runs.append(at_price)
    work.end()
    rows = rows_of(runs, base.method, second.hours)
    return Tuned(
        problem if chosen is None else chosen.problem, replace(rules, price=price), expected, front, reached, plain,
        around.noise, chosen is not None and chosen.guessed, plain.estimator if chosen is None else chosen.estimator,
        around.loads, rows, base.method if chosen is None else chosen.name, cautions(problem, around),
    )  # fmt: skip


def _plain(
    model: StateSpace,
    limits: Limits | None,
    output_weight: Any,
    baseline: Regulator | None,
    rules: MoveRules | None,
) -> Regulator:
    """Plain MPC to compare with, or what keeps the rules and has no price."""
    as_discrete("model", model)
    if baseline is None:
        if limits is None:
            raise MampcError("limits: expected mampc.Limits with u_min and u_max, received none")
        problem = usual_problem(model, limits, output_weight)
        return _under(rules, Regulator(MPC(problem), KalmanFilter.offset_free(model)))
    if not isinstance(baseline, Regulator) or type(baseline.controller) is not MPC:
        raise MampcError(f"baseline: expected a mampc.Regulator with plain MPC, received {baseline!r}")
    if baseline.controller.problem.model is not model:
        raise MampcError("baseline: expected a regulator of the same model, received one of another")
    if limits is not None:
        raise MampcError("limits: expected those of the baseline, received others beside it")
    return _under(rules, baseline)


def _under(rules: MoveRules | None, plain: Regulator) -> Regulator:
    if rules is None:
        return plain
    rules = replace(as_instance("rules", rules, MoveRules), price=0.0)
    controller = MAMPC(plain.controller.problem, rules)
    return plain if controller.is_plain else Regulator(controller, plain.estimator)


def _drawn(
    plain: Regulator, around: Surroundings, count: int, seed: tuple[int, int], work: Work
) -> tuple[Scenarios, Point]:
    """Scenarios, and plain MPC in them."""
    scenarios = Scenarios.drawn(plain, around, count, seed)
    base = Point(PLAIN if type(plain.controller) is MPC else RULES_ALONE, 0.0, *scenarios.run(plain))
    if not np.isfinite(base.error).all() or not base.error.mean() > 0:
        raise MampcError(
            f"tune: expected a model that {base.method} with these horizons, weights and limits can control, received "
            "one on which it runs away; give a baseline that works"
        )
    work.add(count)
    return scenarios, base


def _each(
    tasks: Sequence[tuple[Candidate, list[float]]], scenarios: Scenarios, jobs: int, work: Work
) -> Iterator[list[Point]]:
    """The points of each task, in their order.

    Prices of one candidate are run together where that makes them cheaper, else apart.
    """
    apart = 1 if tasks[0][0].dear else len(tasks[0][1])
    parts = [
        (candidate, prices[k : k + apart])
        for candidate, prices in tasks
        for k in range(0, len(prices), apart)
    ]
    done, found = _run(parts, scenarios, jobs), list[Point]()
    for _, prices in tasks:
        found = []
        while len(found) < len(prices):
            found += next(done)
            work.add(min(apart, len(prices)) * len(scenarios))
        yield found


def _run(
    parts: Sequence[tuple[Candidate, list[float]]], scenarios: Scenarios, jobs: int
) -> Iterator[list[Point]]:
    if jobs == 1 or len(parts) == 1:
        for candidate, prices in parts:
            yield candidate.points(prices, scenarios)
        return
    from joblib import delayed

    calls = (delayed(candidate.points)(prices, scenarios) for candidate, prices in parts)
    yield from in_parallel(calls, jobs, max_nbytes=None)


def _confirmed(
    goal: Goal, finalists: Sequence[Any], scenarios: Scenarios, base: Point, jobs: int, work: Work
) -> tuple[Candidate | None, float, Point, bool]:
    """The first finalist that keeps what is allowed in scenarios that it was not chosen by; else the calmest."""
    calmest: tuple[Candidate | None, float, Point] = (None, 0.0, base)
    for _, price, candidate, _ in finalists:

        def run(price: float, candidate: Candidate = candidate) -> Point:
            point = _at_price(candidate, price, scenarios, jobs)
            work.add(len(scenarios))
            return point

        price, point, kept = _nearest(goal, price, run, base)
        if kept and point.moves.mean() < base.moves.mean():
            return candidate, price, point, True
        if goal.max_error_increase is None and point.moves.mean() < calmest[2].moves.mean():
            calmest = candidate, price, point
    return *calmest, False


def _at_price(candidate: Candidate, price: float, scenarios: Scenarios, jobs: int) -> Point:
    """The runs of one price; in parallel where each is dear."""
    if jobs == 1 or not candidate.dear:
        return candidate.points([price], scenarios)[0]
    from joblib import delayed

    calls = (delayed(candidate.points)([price], scenarios.only([loop])) for loop in range(len(scenarios)))
    runs = [point for (point,) in in_parallel(calls, jobs, max_nbytes=None)]
    moves, error = (np.concatenate([getattr(point, name) for point in runs]) for name in ("moves", "error"))
    return Point(candidate.name, price, moves, error)


def _nearest(
    goal: Goal, price: float, run: Callable[[float], Point], base: Point
) -> tuple[float, Point, bool]:
    """A price from which one step further would use more than is allowed, its runs, and whether it keeps that.

    One that keeps it is raised a few times, as long as it does; for another, ever farther ones are tried.
    """
    point = run(price)
    if goal.keeps(point, base):
        for _ in range(HIGHER):
            further = run(price / goal.back)
            if not goal.keeps(further, base):
                break
            price, point = price / goal.back, further
        return price, point, True
    tried = price
    for steps in STEPS:
        tried = price * goal.back**steps
        point = run(tried)
        if goal.keeps(point, base):
            return tried, point, True
    return tried, point, False


def _front(points: Sequence[Point], base: Point, goal: Goal) -> tuple[FrontPoint, ...]:
    """Those that no other beats, and the last one, by rising error."""
    ratios = [ratio_over_kinds(point, base, goal.kinds) for point in points]
    moves, errors = np.array([p.moves.mean() for p in points]), np.array([r.value for r in ratios])
    kept = sorted(
        {*non_dominated(moves, errors).tolist(), len(points) - 1}, key=lambda i: (errors[i], -moves[i])
    )
    return tuple(FrontPoint(points[i].value, moves_per_hour(points[i], goal.hours), ratios[i]) for i in kept)


def rows_of(points: Sequence[Point], plain: str, hours: float) -> list[dict[str, Any]]:
    """Runs as a sweep writes them, of points of which one is plain MPC."""
    return [
        {
            "scenario": "tuning", "controller": point.method,
            "method": "mpc" if point.method == plain else "exact", "value": point.value, "seed": loop,
            "moves": moves, "error": error, "moves_per_hour": moves / hours,
        }
        for point in points
        for loop, (moves, error) in enumerate(zip(point.moves.tolist(), point.error.tolist(), strict=True))
    ]  # fmt: skip
