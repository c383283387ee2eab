"""Rivals by name, as studies call them."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from mampc.base.checks import as_choice
from mampc.base.errors import MampcError
from mampc.controllers.controller import Controller
from mampc.controllers.mpc import MPC
from mampc.program.problem import TrackingProblem
from mampc.rivals.penalised import Penalised
from mampc.rivals.penalties import CLOT, L1, MCP, SCAD, ElasticNet, GroupL2, LogSum, Norms, Separable
from mampc.rivals.rules import DeadBand, EventTriggered, Periodic, QuietZone, Rounded, Rule
from mampc.rivals.self_triggered import SelfTriggered
from mampc.rivals.sparse_inputs import SparseInputs

RULES: dict[str, type[Rule]] = {
    "dead_band": DeadBand,
    "rounded": Rounded,
    "periodic": Periodic,
    "event_triggered": EventTriggered,
    "self_triggered": SelfTriggered,
    "quiet_zone": QuietZone,
}
PENALTIES: dict[str, type[Separable | Norms]] = {
    "l1": L1,
    "group_l2": GroupL2,
    "clot": CLOT,
    "elastic_net": ElasticNet,
    "scad": SCAD,
    "mcp": MCP,
    "log_sum": LogSum,
}
RIVALS = (*RULES, "penalised", "sparse_inputs")


def rival(
    method: str, problem: TrackingProblem, settings: Mapping[str, Any], *, around: Controller | None = None
) -> Controller:
    """A rival by name.

    Args:
        method: one of `RIVALS`.
        problem: what to track.
        settings: of the rival, by name; "penalised" takes `penalty` by name and that penalty's settings too.
        around: the controller that a rule is put around; default plain MPC.

    Raises:
        MampcError: an unknown name or setting.
    """
    check_settings(method, settings)
    if method in RULES:
        return RULES[method](MPC(problem) if around is None else around, **settings)
    if around is not None:
        raise MampcError(
            f"around: expected none for the method {method!r}, which plans by itself, received one"
        )
    if method == "sparse_inputs":
        return SparseInputs(problem, **settings)
    given, others = _apart(settings)
    return Penalised(problem, penalty=PENALTIES[settings["penalty"]](**given), **others)


def check_settings(method: str, settings: Mapping[str, Any]) -> None:
    """Raises `MampcError` for an unknown rival, and for settings that it does not have or that are missing."""
    as_choice("method", method, RIVALS)
    if method == "penalised":
        name = as_choice("penalty", settings.get("penalty"), PENALTIES)
        _require_known(f"{method}, {name}", PENALTIES[name], _apart(settings)[0])
    else:
        _require_known(method, RULES.get(method, SparseInputs), settings)


def _apart(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The settings of the penalty, and those of the controller."""
    own = {"penalty", *_known(Penalised)}
    return (
        {key: value for key, value in settings.items() if key not in own},
        {key: value for key, value in settings.items() if key in own and key != "penalty"},
    )


def _known(made: Any) -> list[str]:
    """The names of the keyword arguments of a class."""
    parameters = inspect.signature(made).parameters.values()
    return [p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY]


def _require_known(name: str, made: Any, settings: Mapping[str, Any]) -> None:
    unknown = sorted(set(settings) - set(_known(made)))
    missing = [
        p.name
        for p in inspect.signature(made).parameters.values()
        if p.kind is inspect.Parameter.KEYWORD_ONLY and p.default is p.empty and p.name not in settings
    ]
    if unknown or missing:
        raise MampcError(
            f"method {name!r}: expected settings among {', '.join(_known(made))}"
            f"{f', {missing[0]} always' if missing else ''}, received {', '.join(settings) or 'none'}"
        )
