"""The regulator: estimator and controller behind one pure step from measurements to inputs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from mampc.arrays import Array, as_shaped, as_vector, is_usable
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState, Decision
from mampc.errors import MampcError
from mampc.estimation import Estimate, KalmanFilter
from mampc.lti import StateSpace


@dataclass(frozen=True, eq=False)
class RegulatorState:
    """What a regulator remembers between samples."""

    controller: ControllerState
    estimate: Estimate
    measured_disturbance: Array  # shape (d,), as last told


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
        self._v_shape = (model.n_disturbances,)
        expected, received = _sizes(model), _sizes(self.estimator.model)
        if received != expected:
            raise MampcError(f"estimator: expected a model with {expected}, received {received}")

    def initial_state(
        self, u_previous: Any = None, y: Any = None, measured_disturbance: Any = None
    ) -> RegulatorState:
        """At rest under the inputs applied so far.

        Args:
            u_previous: shape (m,) or (h, m), latest last; default the operating point.
            y: measurements at that rest, shape (l,); the estimator takes what the model does not
                explain for a constant disturbance, so that the first step has no jump.
            measured_disturbance: at that rest, shape (d,); default the operating point.

        Raises:
            MampcError: arrays of the wrong shape, or numbers that are not finite.
        """
        controller = self.controller.initial_state(u_previous)
        v = self.controller.problem.model.v_op
        if measured_disturbance is not None:
            v = as_vector("measured_disturbance", measured_disturbance, len(v))
        return RegulatorState(controller, self.estimator.initial(controller.inputs[-1], y, v), v)

    def step(
        self,
        state: RegulatorState,
        y: Any,
        reference: Any,
        *,
        u_applied: Any = None,
        measured_disturbance: Any = None,
    ) -> Decision:
        """Decide the inputs of this sample from its measurements.

        Args:
            state: from `initial_state` or the previous decision.
            y: measured outputs, shape (l,); numbers that are not usable lead to a held input.
            reference: absolute outputs to track, shape (l,), or (np + 1, l) when known ahead.
            u_applied: what the plant really got since the last step, shape (m,), if not what was decided.
            measured_disturbance: now, shape (d,), in engineering units; predicted to stay as it is.
                Left out or not usable, the last one holds on.

        Raises:
            MampcError: arguments that are no numbers or of the wrong shape.
        """
        start = perf_counter()
        y = as_shaped("y", y, self._y_shape)
        memory, v_last = state.controller, state.measured_disturbance
        if u_applied is not None:
            memory = self._applied(memory, u_applied)
        v = v_last
        if measured_disturbance is not None:
            told = as_shaped("measured_disturbance", measured_disturbance, self._v_shape)
            v = told if len(told) and is_usable(told) else v_last
        u_previous = memory.inputs[-1]
        estimate = self.estimator.predict(state.estimate, u_previous, v_last)
        usable = is_usable(y)
        if not is_usable(estimate.x):  # it ran away without measurements: start again
            estimate = self.estimator.initial(u_previous, y if usable else None, v_last)
        if usable:
            estimate = self.estimator.correct(estimate, u_previous, y, v)  # y shows v at once, u later
        decision = self.controller.step(
            memory,
            estimate.x if usable else np.full_like(estimate.x, np.nan),  # without a measurement: hold
            reference,
            output_disturbance=estimate.output_disturbance,
            input_disturbance=estimate.input_disturbance,
            measured_disturbance=v,
        )
        return replace(
            decision,
            state=RegulatorState(decision.state, estimate, v),
            solve_time=perf_counter() - start,
        )

    def _applied(self, memory: ControllerState, u_applied: Any) -> ControllerState:
        """The memory with the latest inputs put right; not-usable numbers change nothing."""
        u = as_shaped("u_applied", u_applied, memory.inputs[-1].shape)
        if not is_usable(u):
            return memory
        return replace(memory, inputs=np.concatenate([memory.inputs[:-1], u[None]]))


def _sizes(model: StateSpace) -> str:
    return (
        f"{model.n_states} states, {model.n_inputs} inputs, {model.n_outputs} outputs, "
        f"{model.n_disturbances} measured disturbances"
    )
