"""The regulator: estimator and controller behind one pure step from measurements to inputs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from mampc.arrays import Array
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState, Decision
from mampc.errors import MampcError
from mampc.estimation import Estimate, KalmanFilter
from mampc.qp import is_usable


@dataclass(frozen=True, eq=False)
class RegulatorState:
    """What a regulator remembers between samples."""

    controller: ControllerState
    estimate: Estimate


class Regulator:
    """Output feedback: a controller fed by an estimator.

    Args:
        controller: `MPC` or `MAMPC`.
        estimator: default `KalmanFilter.offset_free` of the controller's model.

    Raises:
        MampcError: arguments of other types, or an estimator of a model of other dimensions.
    """

    def __init__(self, controller: Controller, estimator: KalmanFilter | None = None) -> None:
        if not isinstance(controller, Controller):
            raise MampcError(f"controller: expected MPC or MAMPC, received {type(controller).__name__}")
        if not isinstance(estimator, KalmanFilter | None):
            raise MampcError(f"estimator: expected a KalmanFilter, received {type(estimator).__name__}")
        model = controller.problem.model
        self.controller = controller
        self._y_shape = (model.n_outputs,)
        self.estimator = KalmanFilter.offset_free(model) if estimator is None else estimator
        received = self.estimator.model
        if (received.n_states, received.n_inputs, received.n_outputs) != (
            model.n_states,
            model.n_inputs,
            model.n_outputs,
        ):
            raise MampcError(
                f"estimator: expected {model.n_states} states, {model.n_inputs} inputs, {model.n_outputs} "
                f"outputs, received {received.n_states}, {received.n_inputs}, {received.n_outputs}"
            )

    def initial_state(self, u_previous: Any = None, y: Any = None) -> RegulatorState:
        """At rest under the inputs applied so far.

        Args:
            u_previous: shape (m,) or (h, m), latest last; default the operating point.
            y: measurements at that rest, shape (l,); the estimator takes what the model does not
                explain for a constant disturbance, so that the first step has no jump.
        """
        controller = self.controller.initial_state(u_previous)
        return RegulatorState(controller, self.estimator.initial(controller.inputs[-1], y))

    def step(self, state: RegulatorState, y: Any, reference: Any, *, u_applied: Any = None) -> Decision:
        """Decide the inputs of this sample from its measurements.

        Args:
            state: from `initial_state` or the previous decision.
            y: measured outputs, shape (l,); numbers that are not finite lead to a held input.
            reference: absolute outputs to track, shape (l,), or (np + 1, l) when known ahead.
            u_applied: what the plant really got since the last step, shape (m,), if not what was decided.

        Raises:
            MampcError: arrays of the wrong shape.
        """
        start = perf_counter()
        y = np.asarray(y, dtype=np.float64)
        if y.shape != self._y_shape:
            raise MampcError(f"y: expected shape {self._y_shape}, received {y.shape}")
        memory = state.controller
        if u_applied is not None:
            memory = self._applied(memory, u_applied)
        u_previous = memory.inputs[-1]
        estimate = self.estimator.predict(state.estimate, u_previous)
        usable = is_usable(y)
        if usable:
            estimate = self.estimator.correct(estimate, u_previous, y)
        decision = self.controller.step(
            memory,
            estimate.x if usable else np.full_like(estimate.x, np.nan),  # without a measurement: hold
            reference,
            output_disturbance=estimate.output_disturbance,
            input_disturbance=estimate.input_disturbance,
        )
        return replace(
            decision,
            state=RegulatorState(decision.state, estimate),
            solve_time=perf_counter() - start,
        )

    def _applied(self, memory: ControllerState, u_applied: Any) -> ControllerState:
        u: Array = np.asarray(u_applied, dtype=np.float64)
        if u.shape != memory.inputs[-1].shape:
            raise MampcError(f"u_applied: expected shape {memory.inputs[-1].shape}, received {u.shape}")
        if not np.isfinite(u).all():
            return memory
        return replace(memory, inputs=np.concatenate([memory.inputs[:-1], u[None]]))
