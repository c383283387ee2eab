"""The regulator that a study's tables describe: problem, controller, estimator, sensor checks and valves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mampc.base.checks import as_vector
from mampc.base.errors import MampcError, said_at
from mampc.controllers import MAMPC, MPC, ControllerBank
from mampc.controllers.controller import Controller
from mampc.loop.defaults import default_estimator
from mampc.loop.estimator import Estimator
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.loop.regulator import Regulator
from mampc.loop.sensors import SensorChecks
from mampc.loop.valves import Valves
from mampc.program.problem import Limits, TrackingProblem
from mampc.rivals.registry import RIVALS, rival
from mampc.study.schema import BANK, ControllerTable, EstimatorTable, Study
from mampc.systems.state_space import StateSpace

EXECUTED = 1.05  # of what a valve does not answer: the least move, since nobody knows that exactly


def regulator_of(study: Study, model: StateSpace, table: ControllerTable) -> Regulator:
    """The regulator that a study's tables describe."""
    problem = problem_of(study, model)
    valves = None
    tables = [table if other.name == table.name else other for other in study.controllers]  # at another price
    if table.compensate and study.actuators is not None:
        valves = study.actuators.valves()
        names = table.variants or [table.name]
        tables = [
            _executed(other, valves, model.n_inputs) if other.name in names else other for other in tables
        ]
        table = next(other for other in tables if other.name == table.name)
    controller = _controller(problem, table, tables)
    estimator = _estimator(study.estimator, controller)
    counts = study.estimator.value_of_information
    if counts:
        counts = isinstance(estimator, LoadBank) and any(type(one) is MAMPC for one in controller.each)
    smooth = None if table.reference_filter is None else table.reference_filter.made()
    with said_at(f"controllers, {table.name!r}: "):
        return Regulator(
            controller, estimator, reference_filter=smooth, valves=valves, value_of_information=counts,
            price_follows_noise=bool(counts) and study.estimator.price_follows_noise,
            learn_gains=table.learn_gains, **_sensors(study),
        )  # fmt: skip


def _executed(table: ControllerTable, valves: Valves, n_inputs: int) -> ControllerTable:
    """The controller with moves that valves execute, and some more."""
    with said_at(f"controllers, {table.name!r}: "):
        if table.rules is None:
            raise MampcError(
                f"compensate: expected rules, received the method {table.method!r}, which has none"
            )
        least = EXECUTED * as_vector("actuators.jump", valves.jump, n_inputs)
        size = np.maximum(as_vector("min_size", table.rules.min_size, n_inputs), least)
    return table.model_copy(update={"rules": table.rules.model_copy(update={"min_size": size.tolist()})})


def problem_of(study: Study, model: StateSpace) -> TrackingProblem:
    """The tracking problem that a study's table describes."""
    table = study.problem
    with said_at("[problem] "):
        return TrackingProblem(
            model, **table.model_dump(exclude={"limits"}), limits=Limits(**table.limits.model_dump())
        )


def _controller(
    problem: TrackingProblem, table: ControllerTable, tables: Sequence[ControllerTable]
) -> Controller:
    with said_at(f"controllers, {table.name!r}: "):
        if table.method == BANK:
            named = {other.name: other for other in tables}
            return ControllerBank(
                {name: _controller(problem, named[name], tables) for name in table.variants}
            )
        if table.method in RIVALS:
            around = None if table.around == "mpc" else _sparse(problem, table, table.around, {})
            return rival(table.method, problem, table.settings, around=around)
        if table.method == "mpc":
            return MPC(problem)
        return _sparse(problem, table, table.method, table.settings)


def _sparse(problem: TrackingProblem, table: ControllerTable, method: str, settings: dict[str, Any]) -> MAMPC:
    assert table.rules is not None
    return MAMPC(
        problem, table.rules.made(), method=method,
        on_limit_violation=table.on_limit_violation, violation_margin=table.violation_margin, **settings,
    )  # fmt: skip


def _estimator(table: EstimatorTable, controller: Controller) -> Estimator:
    problem = controller.problem
    with said_at("[estimator] "):
        if table.kind == "load_bank":
            if table.price_follows_noise and table.measurement_noise is not None:
                return LoadBank(problem.model, noise=table.measurement_noise, guessed=True)
            return LoadBank.for_problem(problem, noise=table.measurement_noise)
        if table.is_kalman_filter:
            told = table.model_dump(include={"disturbance", "measurement_noise", "drift", "input_noise"})
            return KalmanFilter.offset_free(problem.model, **told)
        return default_estimator(controller, table.measurement_noise)


def _sensors(study: Study) -> dict[str, Any]:
    checks = study.sensors.model_dump()
    blind = checks.pop("max_blind_steps")
    with said_at("[sensors] "):
        return {"sensors": SensorChecks(**checks), "max_blind_steps": blind}
