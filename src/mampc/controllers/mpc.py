"""Plain model predictive control: every move is free, one quadratic program a sample."""

from __future__ import annotations

from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.method import Plan
from mampc.program.sample import Sample


class MPC(Controller):
    """Model predictive control of a `TrackingProblem`; see there for the cost and the limits.

    Example:
        >>> import mampc
        >>> model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=1.0)
        >>> problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=3)
        >>> mpc = mampc.MPC(problem)
        >>> decision = mpc.step(mpc.initial_state(), x=[0.0], reference=[1.0])
        >>> decision.status.value
        'optimal'
    """

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        return self._unrestricted(sample, state)
