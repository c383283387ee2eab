"""What a regulator remembers between samples, and how it is kept as text."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, as_whole
from mampc.base.errors import MampcError, shown
from mampc.base.identity import equal_only_to_itself
from mampc.controllers.decision import ControllerState
from mampc.loop.actuators import ActuatorState
from mampc.loop.estimator import Estimate
from mampc.loop.mixing import BankEstimate
from mampc.loop.sensors import SensorState

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
    """

    controller: ControllerState
    estimate: Estimate
    measured_disturbance: Array
    sensors: SensorState
    actuators: ActuatorState
    reference: Array | None = None
    command: Array | None = None

    def to_json(self) -> str:
        """The state as JSON text; `Regulator.state_from_json` gives the same numbers back."""
        return json.dumps({"format": FORMAT, **self._asdict(), **self._parts()}, default=np.ndarray.tolist)

    def _parts(self) -> dict[str, dict[str, Any]]:
        """What each part remembers, by name."""
        return {
            "controller": self.controller._asdict(), "estimate": vars(self.estimate),
            "sensors": self.sensors._asdict(), "actuators": self.actuators._asdict(),
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
            return cls(
                ControllerState(**numbers.pop("controller")),
                kind(**estimate),
                sensors=SensorState(**sensors),
                actuators=ActuatorState(tuple(actuators.pop("commands")), **actuators),
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
