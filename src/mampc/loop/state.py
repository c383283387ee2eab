"""What a regulator remembers between samples, and how it is kept as text."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, as_whole
from mampc.base.errors import MampcError, shown
from mampc.base.identity import equal_only_to_itself
from mampc.controllers.decision import ControllerState
from mampc.loop.actuators import LATEST, ActuatorState
from mampc.loop.estimator import Estimate
from mampc.loop.mixing import BankEstimate
from mampc.loop.sensors import SensorState
from mampc.program.daqp import active_flags

if TYPE_CHECKING:
    from mampc.loop.gain_learner import Learnt

FORMAT = "mampc-regulator-state-1"


@equal_only_to_itself
class RegulatorState(NamedTuple):
    """What a regulator remembers between samples; plain numbers, which JSON carries to the last bit.

    Attributes:
        controller: inputs applied so far, and where the method starts next.
        estimate: state and disturbances, corrected with the last measurement.
        measured_disturbance: as last reported, shape (d,).
        sensors: what the sensor checks remember.
        actuators: what is remembered of the actuators.
        reference: tracked last, shape (l,), or the ends of a zone, shape (2, l), where a reference filter leads to what
            is asked for; else None.
        command: inputs decided last, shape (m,), where valves are compensated, whose positions the controller has in
            place of them; else None.
        learnt: of the gains of the model, where the regulator learns them; else None.
    """

    controller: ControllerState
    estimate: Estimate
    measured_disturbance: Array
    sensors: SensorState
    actuators: ActuatorState
    reference: Array | None = None
    command: Array | None = None
    learnt: Learnt | None = None

    def to_json(self) -> str:
        """The state as JSON text; `Regulator.state_from_json` gives the same numbers back."""
        return json.dumps({"format": FORMAT, **self._asdict(), **self._parts()}, default=np.ndarray.tolist)

    def _parts(self) -> dict[str, dict[str, Any]]:
        """What each part remembers, by name."""
        return {
            "controller": self.controller._asdict(), "estimate": vars(self.estimate),
            "sensors": self.sensors._asdict(), "actuators": self.actuators._asdict(),
            **({} if self.learnt is None else {"learnt": self.learnt._asdict()}),
        }  # fmt: skip

    @classmethod
    def from_json(cls, text: str) -> RegulatorState:
        """Read what `to_json` wrote; raises `MampcError` for other text and for numbers that are not finite."""
        try:
            content = json.loads(text)
            if content.pop("format") != FORMAT:
                raise MampcError(f"state: expected the format {FORMAT!r}")
            numbers = {part: _numbers(part, values) for part, values in content.items()}
            actuators, sensors, estimate = (numbers.pop(p) for p in ("actuators", "sensors", "estimate"))
            kind = BankEstimate if "weights" in estimate else Estimate
            learnt = numbers.pop("learnt", None)
            return cls(
                ControllerState(**numbers.pop("controller")),
                kind(**estimate),
                sensors=SensorState(**sensors),
                actuators=ActuatorState(tuple(actuators.pop("commands")), **actuators),
                learnt=None if learnt is None else _learnt(learnt),
                **numbers,
            )
        except MampcError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError, OverflowError):
            raise MampcError(
                f"state: expected what RegulatorState.to_json writes, received {shown(text)}"
            ) from None

    def shapes(self) -> dict[str, tuple[int, ...] | None]:
        """The shape of every array, by its place; None where there is none."""
        places = {
            f"{part}.{name}": value for part, held in self._parts().items() for name, value in held.items()
        }
        places["measured_disturbance"] = self.measured_disturbance
        places["reference"], places["command"] = self.reference, self.command
        return {place: None if value is None else np.shape(value) for place, value in places.items()}


def _learnt(numbers: dict[str, Any]) -> Learnt:
    from mampc.loop.gain_learner import Learnt

    return Learnt(**numbers)


def _numbers(place: str, value: Any) -> Any:
    """Lists of numbers as arrays; dictionaries entry by entry; counts and None as they are."""
    if isinstance(value, dict):
        return {name: _numbers(f"{place}.{name}", entry) for name, entry in value.items()}
    if value is None:
        return None
    if not isinstance(value, list):
        return as_whole(f"state: {place}", value, 0)
    array = np.array(value, dtype=np.float64)
    if not np.isfinite(array).all():
        raise MampcError(f"state: expected finite numbers at {place}, received {value}")
    return array


def fitting_state(text: str, usual: RegulatorState, further: dict[str, tuple[int, ...]]) -> RegulatorState:
    """The state that `RegulatorState.to_json` wrote, as one of the regulator of another state.

    Args:
        text: JSON.
        usual: what is expected, by the shapes of its arrays.
        further: shapes of what there may be besides, by place.

    Raises:
        MampcError: anything that does not fit.
    """
    state, expected = RegulatorState.from_json(text), usual.shapes() | further
    if type(state.estimate) is not type(usual.estimate):
        raise MampcError(
            f"state: expected an estimate of the kind {type(usual.estimate).__name__}, received another estimator's"
        )
    if (state.learnt is None) is not (usual.learnt is None):
        raise MampcError("state: expected gains learnt where the regulator learns them, and none elsewhere")
    for place, shape in state.shapes().items():
        if place == "controller.memory":  # what a rule around a controller keeps; it knows what fits
            continue
        may_be_none = place in further
        zone = (
            place == "reference" and expected[place] is not None and shape == (2, *np.shape(usual.sensors.y))
        )
        if shape != expected[place] and not (may_be_none and shape is None) and not zone:
            raise MampcError(f"state: expected {place} of shape {expected[place]}, received {shape}")
    for part, held in (("estimate", state.estimate), ("learnt", state.learnt)):
        for name in ("weights", "usual", "usual_weights"):
            shares = getattr(held, name, np.ones(1))
            if (shares < 0).any() or not abs(shares.sum() - 1) < 1e-9:
                raise MampcError(f"state: expected {part}.{name} that sum up to 1, received {shares}")
    if state.learnt is not None:
        from mampc.loop.corrected_gains import MOST

        if not (np.abs(state.learnt.factors - 1) <= MOST).all():
            raise MampcError(
                f"state: expected learnt.factors within {MOST:g} of 1, received {state.learnt.factors}"
            )
    scale = getattr(state.estimate, "scale", np.ones(1))
    if not (scale > 0).all():
        raise MampcError(f"state: expected positive numbers at estimate.scale, received {scale}")
    squares = getattr(state.estimate, "hindsight", np.empty(0))[1:2]
    if (squares < 0).any():
        raise MampcError(f"state: expected a sum of squares at estimate.hindsight, received {squares}")
    if not active_flags(state.controller.active):
        raise MampcError(f"state: expected flags at controller.active, received {state.controller.active}")
    late = state.actuators.late
    if not np.isin(late, np.arange(LATEST + 1)).all():
        raise MampcError(f"state: expected whole numbers up to {LATEST} at actuators.late, received {late}")
    return state
