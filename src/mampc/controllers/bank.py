"""Several tunings of one controller, prepared once and switched while the loop runs."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

from mampc.base.checks import Array, as_choice
from mampc.base.errors import MampcError
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState, Decision
from mampc.controllers.mampc import MAMPC
from mampc.controllers.mpc import MPC
from mampc.methods.method import Plan
from mampc.program.sample import Sample


class ControllerBank(Controller):
    """Variants of a controller by name, one of which decides each sample: gain scheduling, or an operator's choice.

    Weights, prices, rules, methods and limits may differ. All variants share one state, the inputs applied so far, and
    each plans from these: so a switch is bumpless, and moves made under one variant count in the budgets of another.

    Args:
        variants: `MPC` or `MAMPC` by name, of the same model and horizons; the first decides where none is named.

    Raises:
        MampcError: no variants, other controllers, or models or horizons that differ.

    Example:
        >>> import mampc
        >>> model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=1.0)
        >>> problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=3)
        >>> price = {"calm": 0.5, "brisk": 0.01}
        >>> bank = mampc.ControllerBank(
        ...     {name: mampc.MAMPC(problem, mampc.MoveRules(price=p)) for name, p in price.items()}
        ... )
        >>> bank.step(bank.initial_state(), [0.0], [1.0], variant="brisk").variant
        'brisk'
    """

    def __init__(self, variants: Mapping[str, Controller]) -> None:
        if not isinstance(variants, Mapping) or not variants:
            raise MampcError(f"variants: expected controllers by name, received {variants!r}")
        for name, controller in variants.items():
            if not isinstance(name, str) or type(controller) not in (MPC, MAMPC):
                raise MampcError(
                    f"variants: expected names with MPC or MAMPC, received {name!r} with {type(controller).__name__}"
                )
        first = next(iter(variants.values()))
        for name, controller in variants.items():
            if controller.problem.model is not first.problem.model:
                raise MampcError(
                    f"variants: expected controllers of one model, received {name!r} with another"
                )
            if _horizons(controller) != _horizons(first):
                raise MampcError(
                    f"variants: expected prediction and control horizons {_horizons(first)}, "
                    f"received {_horizons(controller)} of {name!r}"
                )
        super().__init__(first.problem, condensed=first.condensed)
        self._memory = max(controller.memory for controller in variants.values())
        self.variants = {
            name: _looking_back(controller, self._memory) for name, controller in variants.items()
        }
        self.usual = next(iter(variants))

    def __repr__(self) -> str:
        return f"ControllerBank({self.variants!r})"

    @property
    def each(self) -> tuple[Controller, ...]:
        return tuple(self.variants.values())

    def step(
        self, state: ControllerState, x: Any, reference: Any, *, variant: str | None = None, **now: Any
    ) -> Decision:
        """Decide the inputs of this sample.

        Args:
            state, x, reference, now: see `Controller.step`.
            variant: which one decides, by name; default the first.

        Raises:
            MampcError: a name that there is not, or arrays of the wrong shape.
        """
        name = self.usual if variant is None else variant
        controller = self.variants[as_choice("variant", name, self.variants)]
        # Active bounds are a start for programs with as many; others begin anew.
        alike = controller.condensed.bounds.size == self.condensed.bounds.size
        if not alike and isinstance(state, ControllerState):
            state = state._replace(active=None)
        decision = controller.step(state, x, reference, **now)
        after = decision.state if alike else decision.state._replace(active=None)
        return decision._replace(variant=name, state=after)

    def with_information(self, shifts: Array, *, price_follows_noise: bool = False) -> ControllerBank:
        """This bank with plans of its `MAMPC` that count on later data; see `MAMPC.with_information`."""
        counting = copy(self)
        counting.variants = {
            name: one.with_information(shifts, price_follows_noise=price_follows_noise)
            if isinstance(one, MAMPC)
            else one
            for name, one in self.variants.items()
        }
        return counting

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        return self.variants[self.usual].plan(sample, state)


def _horizons(controller: Controller) -> tuple[int, int]:
    return controller.problem.prediction_horizon, controller.problem.control_horizon


def _looking_back(controller: Controller, memory: int) -> Controller:
    """The same controller, given more past inputs than it looks at."""
    same = copy(controller)
    same._memory = memory
    return same
