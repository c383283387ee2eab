"""The regulator: sensor checks, estimator and controller behind one pure step from measurements to inputs."""

from __future__ import annotations

from copy import copy
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import (
    LARGEST,
    Array,
    as_flag,
    as_instance,
    as_shaped,
    as_vector,
    as_whole,
)
from mampc.base.errors import MampcError
from mampc.controllers.bank import ControllerBank
from mampc.controllers.controller import Controller
from mampc.controllers.decision import Decision
from mampc.controllers.mampc import MAMPC
from mampc.controllers.offset import offset_of
from mampc.loop.actuators import Actuators
from mampc.loop.defaults import counts_on_later_data, default_estimator, with_information
from mampc.loop.estimator import Estimate, Estimator
from mampc.loop.reference_filter import ReferenceFilter
from mampc.loop.sensors import Judged, SensorChecks, SensorState
from mampc.loop.state import RegulatorState, fitting_state
from mampc.loop.valves import Valves, compensation_of
from mampc.program.problem import Limits
from mampc.systems.state_space import StateSpace

if TYPE_CHECKING:
    from mampc.loop.online_gains import Gains, OnlineGains

USUAL_CHECKS = SensorChecks()


class Regulator:
    """Output feedback: a controller fed by an estimator, which believes what passes the sensor checks.

    Args:
        controller: `MPC` or `MAMPC`.
        estimator: default a `LoadBank` where moves are priced or bounded by another method than the paper's, and
            `KalmanFilter.offset_free` of the controller's model elsewhere (`loop.defaults` says it all).
        sensors: when a measurement is believed; default `SensorChecks()`.
        max_blind_steps: samples in a row that inputs are still planned, on predictions, though no output at
            all is believed; from then on they are held until one is. 0 holds at once.
        value_of_information: plan with what later measurements will tell (see docs/how-it-decides.md): needs `MAMPC`
            and an estimator that knows the noise in output units, a `LoadBank`. Objectives of decisions hold it
            then, and offsets up to `Regulator.largest_offset` may stay, which is more than `mampc.largest_offset`.
            Default where moves have a price, these are few, and nothing runs away (`loop.defaults`).
        price_follows_noise: the price is for the noise that the estimator was told, and is scaled by the variance of
            what it finds; for noise that was guessed. Needs `value_of_information` and an exact search by a table.
        applied_tolerance: an applied input this near to the decided one is the decided one: valves and their
            position feedback are never exact. In input units, a scalar or (m,); default a hundredth of the
            input's range, or 1e-6 of the input itself where that is not finite.
        reference_filter: lags and ramps between the references given and those tracked; default none. They start
            from the outputs, also when the last input comes back from manual.
        valves: what is known of valves that stick or have play. Then positions of their stems are planned, and inputs
            decided that bring them there: a reversal is larger by `band - jump`. `u_applied` are positions, and so are
            plan and changes of decisions. Moves of less than `jump` are not executed, so that rules have at least that
            for `min_size`, and some more.
        learn_gains: correct the gains of the model while the loop runs, where that predicts better (see
            docs/models.md). Needs an estimator that was told the noise. States then belong to one input each.

    Raises:
        MampcError: arguments of other types, an estimator of a model of other dimensions, gains that cannot be learnt.
    """

    def __init__(
        self,
        controller: Controller,
        estimator: Estimator | None = None,
        *,
        sensors: SensorChecks | None = None,
        max_blind_steps: int = 0,
        value_of_information: bool | None = None,
        price_follows_noise: bool = False,
        applied_tolerance: Any = None,
        reference_filter: ReferenceFilter | None = None,
        valves: Valves | None = None,
        learn_gains: bool = False,
    ) -> None:
        if not isinstance(controller, Controller):
            raise MampcError(f"controller: expected MPC or MAMPC, received {type(controller).__name__}")
        if not isinstance(estimator, Estimator | None):
            raise MampcError(
                f"estimator: expected a KalmanFilter or a LoadBank, received {type(estimator).__name__}"
            )
        estimator = default_estimator(controller) if estimator is None else estimator
        model = controller.problem.model
        expected, received = _sizes(model), _sizes(estimator.model)
        if received != expected:
            raise MampcError(f"estimator: expected a model with {expected}, received {received}")
        if as_flag("learn_gains", learn_gains):
            from mampc.loop.online_gains import OnlineGains, made_to_learn

            controller, estimator = made_to_learn(controller, estimator)
            model = controller.problem.model
        self.controller, self.estimator = controller, estimator
        self.max_blind_steps = as_whole("max_blind_steps", max_blind_steps, 0)
        self._y_shape, self._u_shape = (model.n_outputs,), (model.n_inputs,)
        self.sensors = as_instance("sensors", USUAL_CHECKS if sensors is None else sensors, SensorChecks)
        self._sensors = self.sensors.fitted(controller.problem, self.estimator.noise)
        self._v_shape = (model.n_disturbances,)
        tolerance = None
        if applied_tolerance is not None:
            tolerance = as_vector("applied_tolerance", applied_tolerance, model.n_inputs, 0.0)
        self._actuators = Actuators(controller.problem.limits, tolerance)
        self.reference_filter, self._filter = reference_filter, None
        if reference_filter is not None:
            smooth = as_instance("reference_filter", reference_filter, ReferenceFilter)
            self._filter = smooth.fitted(model.n_outputs, model.dt)
        self._samples = controller.problem.prediction_horizon + 1
        self.valves, self._compensation = valves, None
        if valves is not None:
            self._compensation = compensation_of(valves, controller)
        # What plans predict with may have more states than the plant.
        self._planner = controller
        if self.estimator.planning_model is not self.estimator.model:
            self._planner = controller.with_model(self.estimator.planning_model)
        self.value_of_information = counts_on_later_data(controller, self.estimator)
        if value_of_information is not None:
            self.value_of_information = as_flag("value_of_information", value_of_information)
        self.price_follows_noise = as_flag("price_follows_noise", price_follows_noise)
        if self.price_follows_noise and not self.value_of_information:
            raise MampcError("price_follows_noise: expected value_of_information=True beside it")
        if self.value_of_information:
            self._planner = with_information(self._planner, self.estimator, self.price_follows_noise)
        self._counts_on_data = any(
            isinstance(one, MAMPC) and one.information is not None for one in self._planner.each
        )
        self._online: OnlineGains | None = None
        if learn_gains:
            own = partial(
                Regulator, sensors=sensors, max_blind_steps=max_blind_steps, applied_tolerance=applied_tolerance,
                value_of_information=self.value_of_information, price_follows_noise=price_follows_noise,
                reference_filter=reference_filter, valves=valves,
            )  # fmt: skip
            self._online = OnlineGains(copy(self), own)

    def __repr__(self) -> str:
        counts = ", value_of_information=True" if self.value_of_information else ""
        learns = ", learn_gains=True" if self.learns_gains else ""
        return f"Regulator({type(self.controller).__name__}, {self.estimator!r}{counts}{learns})"

    def largest_offset(self, state: RegulatorState | None = None) -> Array:
        """The largest offset of each output, shape (l,), that can stay for good, in output units.

        See `mampc.largest_offset` for when it holds and where it is infinite. Plans that count on later data may wait
        for these at every sample anew, with an offset of some times the noise, and this is part of it.

        Args:
            state: whose estimate says how loads behave, and how large the noise is; default steady loads, and the noise
                as told.
        """
        weights = None if state is None else self.estimator.weights_of(state.estimate)
        planner = self._planner
        if self._online is not None and state is not None and state.learnt is not None:
            planner = self._online.regulator(state.learnt.factors)._planner
        largest: Array = np.max([offset_of(one, weights) for one in planner.each], axis=0)
        return largest

    @property
    def learns_gains(self) -> bool:
        """Whether gains of the model are corrected while the loop runs."""
        return self._online is not None

    def gains(self, state: RegulatorState) -> Gains:
        """What is learnt of the gains, and which are in force; raises `MampcError` where none are learnt."""
        if self._online is None or state.learnt is None:
            raise MampcError("gains: expected a regulator with learn_gains=True and a state of it")
        return self._online.gains(state.learnt)

    def initial_state(
        self, u_previous: Any = None, y: Any = None, measured_disturbance: Any = None
    ) -> RegulatorState:
        """In a steady state under the inputs applied so far.

        Args:
            u_previous: shape (m,) or (h, m), latest last; default the operating point.
            y: measurements in that steady state, shape (l,); the estimator takes what the model does not
                explain for a constant disturbance, so that the first step has no jump.
            measured_disturbance: in that steady state, shape (d,); default the operating point.

        Raises:
            MampcError: arrays of the wrong shape, or numbers that are not finite.
        """
        controller, l = self.controller.initial_state(u_previous), self._y_shape[0]
        v = self.controller.problem.model.v_op
        if measured_disturbance is not None:
            v = as_vector("measured_disturbance", measured_disturbance, len(v))
        estimate = self.estimator.initial(controller.inputs[-1], y, v)
        actuators = self._actuators.initial(controller.inputs)
        sensors = self._sensors.initial(self.estimator.loads_of(estimate))
        tracked = None
        if self._filter is not None:
            tracked = self._outputs(estimate, controller.inputs[-1], v) if y is None else as_vector("y", y, l)
        command = None if self._compensation is None else controller.inputs[-1]
        learnt = (
            None if self._online is None else self._online.initial(np.concatenate((controller.inputs[-1], v)))
        )
        return RegulatorState(controller, estimate, v, sensors, actuators, tracked, command, learnt)

    def state_from_json(self, text: str) -> RegulatorState:
        """The state that `RegulatorState.to_json` wrote; raises `MampcError` for anything that does not fit."""
        problem = self.controller.problem
        fits = {
            "controller.guess": (problem.control_horizon, problem.model.n_inputs),
            "controller.active": (self.controller.condensed.bounds.size,),
        }
        state = fitting_state(text, self.initial_state(), fits)
        if self._online is not None and state.learnt is not None:
            self._online.regulator(state.learnt.factors)
        return state

    def step(
        self,
        state: RegulatorState,
        y: Any,
        reference: Any,
        *,
        u_applied: Any = None,
        measured_disturbance: Any = None,
        limits: Limits | None = None,
        manual: Any = None,
        variant: str | None = None,
    ) -> Decision:
        """Decide the inputs of this sample from its measurements.

        Args:
            state: from `initial_state` or the previous decision.
            y: measured outputs, shape (l,). Those not believed (not-a-number, masked, or refused by the sensor
                checks) do not correct the estimate; `decision.ignored_outputs` names them. With none left the
                inputs are held (see `max_blind_steps`).
            reference: absolute outputs to track, shape (l,), or (np + 1, l) when known ahead, or a `Zone`; where
                there is a reference filter, what it leads to.
            u_applied: what the plant really got since the last step, shape (m,), if not what was decided:
                a saturated, stuck or late actuator, or one in manual. Not-a-number means as decided, and so do
                a value within `applied_tolerance` and one a hundred times further outside its limits than these
                are apart. What an actuator does later than decided, by up to 10 samples, counts as decided as
                soon as it shows (see docs/safety.md); so does what is read with a constant offset.
            measured_disturbance: now, shape (d,), in engineering units; predicted to stay as it is.
                Left out or not usable, the last one holds on.
            limits, manual: see `Controller.step`. Report `u_applied` while an input is in manual; when it is
                back in automatic, the first plan starts from there.
            variant: of a `ControllerBank`, by name.

        Raises:
            MampcError: arguments that are no numbers or of the wrong shape.
        """
        start = perf_counter()
        if not isinstance(state, RegulatorState):
            raise MampcError(f"state: expected a RegulatorState, received {type(state).__name__}")
        y = as_shaped("y", y, self._y_shape)
        if (state.learnt is None) is not (self._online is None):
            kind = "does not learn" if self._online is None else "learns"
            raise MampcError(f"state: expected one of a regulator that {kind} gains, received another's")
        if self._online is not None:
            decision = self._online.step(
                state, y, reference, u_applied=u_applied, measured_disturbance=measured_disturbance,
                limits=limits, manual=manual, variant=variant,
            )  # fmt: skip
            return decision._replace(solve_time=perf_counter() - start)
        memory, actuators, v_last = state.controller, state.actuators, state.measured_disturbance
        in_manual = self.controller.manual_inputs(manual)
        if u_applied is not None:
            reported = as_shaped("u_applied", u_applied, self._u_shape)
            inputs, actuators = self._actuators.update(actuators, memory.inputs, reported, in_manual)
            if inputs is not memory.inputs:
                memory = memory._replace(inputs=inputs)
        u_previous = memory.inputs[-1]
        v = v_last
        if measured_disturbance is not None:
            v = _where_usable(as_shaped("measured_disturbance", measured_disturbance, self._v_shape), v_last)
        estimate, judged, sensors = self._estimate(state, u_previous, y, v)
        tracked = state.reference
        if (tracked is None) is not (self._filter is None):
            kind = "without a" if self._filter is None else "with a"
            raise MampcError(
                f"state: expected one of a regulator {kind} reference filter, received another's"
            )
        if (state.command is None) is not (self._compensation is None):
            kind = "without" if self._compensation is None else "with"
            raise MampcError(f"state: expected one of a regulator {kind} valves, received another's")
        if tracked is not None and self._filter is not None:
            reference, tracked = self._filter.update(
                tracked, reference, self._samples, self._outputs(estimate, u_previous, v),
                restart=in_manual is not None and bool(in_manual.all()),
            )  # fmt: skip
        chosen: dict[str, Any] = {}
        if variant is not None:
            if not isinstance(self._planner, ControllerBank):
                raise MampcError(f"variant: expected none without a ControllerBank, received {variant!r}")
            chosen["variant"] = variant
        blind = sensors.blind > self.max_blind_steps
        decision = self._planner.step(
            memory,
            np.full_like(estimate.x, np.nan) if blind else estimate.x,  # not-a-number: hold
            reference,
            output_disturbance=estimate.output_disturbance,
            input_disturbance=estimate.input_disturbance,
            measured_disturbance=v,
            limits=limits,
            manual=manual,
            hypotheses=self.estimator.weights_of(estimate) if self._counts_on_data else None,
            **chosen,
        )
        command, positions, memory = None, decision.u, decision.state
        if self._compensation is not None and state.command is not None:
            last = state.command if in_manual is None else np.where(in_manual, u_previous, state.command)
            deciding = self._planner
            if isinstance(deciding, ControllerBank):
                deciding = deciding.variants[variant or deciding.usual]
            command, positions = self._compensation.decided(
                positions, u_previous, last, *deciding.range_now(limits)
            )
            memory = memory._replace(inputs=np.concatenate((memory.inputs[:-1], positions[None])))
            decision = decision._replace(u=command)
        return decision._replace(
            state=RegulatorState(
                memory, estimate, v, sensors, actuators.decided(positions), tracked, command
            ),
            ignored_outputs=judged.faults,
            load=self.estimator.load(estimate),
            solve_time=perf_counter() - start,
        )

    def inputs_since(self, state: RegulatorState, u_applied: Any, manual: Any) -> Array:
        """Inputs that count as applied since a state, shape (m,), for those reported as `step` takes them."""
        inputs = state.controller.inputs
        if u_applied is not None:
            reported = as_shaped("u_applied", u_applied, self._u_shape)
            by_hand = self.controller.manual_inputs(manual)
            inputs, _ = self._actuators.update(state.actuators, inputs, reported, by_hand)
        applied: Array = inputs[-1]
        return applied

    def _outputs(self, estimate: Estimate, u: Array, v: Array) -> Array:
        """The outputs estimated, shape (l,)."""
        return -self.estimator.innovation(estimate, u, np.zeros(self._y_shape), v)

    def _estimate(
        self, state: RegulatorState, u: Array, y: Array, v: Array
    ) -> tuple[Estimate, Judged, SensorState]:
        """The estimate after the measurements y (l,), what is believed of these, and the sensors' next state.

        Args:
            state: of the last sample.
            u: inputs applied since, shape (m,).
            y: measurements, finite or not.
            v: measured disturbances now, shape (d,); outputs show them at once, and inputs u later.
        """
        estimator, last, v_last = self.estimator, state.estimate, state.measured_disturbance
        loads = estimator.loads_of(last)
        updated = estimator.update(last, u, y, v_last, v)
        if updated is not None:
            judged, sensors = self._sensors.update(
                state.sensors, y, updated.innovation, updated.movement, loads
            )
            if not judged.faults:  # the everyday case
                return updated.estimate, judged, sensors
        estimate = estimator.predict(last, u, v_last)
        if not estimate.is_usable:
            # It ran away without measurements: start again.
            last = estimate = estimator.initial(u, None, v_last)
        innovation = estimator.innovation(estimate, u, y, v)
        C = estimator.model.C
        movement = C @ (estimate.x - last.x)[: C.shape[1]]
        judged, sensors = self._sensors.update(state.sensors, y, innovation, movement, loads)
        if judged.newly_stuck.any():
            estimate = estimator.with_loads(estimate, judged.newly_stuck, sensors.loads)
        if judged.believed.any():
            estimate = estimator.corrected(estimate, innovation, judged.believed)
        return estimate, judged, sensors


def _where_usable(reported: Array, otherwise: Array) -> Array:
    """The numbers reported, and the others where they are not usable."""
    return np.where((reported > -LARGEST) & (reported < LARGEST), reported, otherwise)


def _sizes(model: StateSpace) -> str:
    return (
        f"{model.n_states} states, {model.n_inputs} inputs, {model.n_outputs} outputs, "
        f"{model.n_disturbances} measured disturbances"
    )
