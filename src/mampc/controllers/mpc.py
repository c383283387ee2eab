"""Plain model predictive control: every move is free, one quadratic program a sample."""

from __future__ import annotations

from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.method import Plan
from mampc.program.problem import TrackingProblem
from mampc.program.sample import Sample


class MPC(Controller):
    """Model predictive control of a `TrackingProblem`; see there for the cost and the limits.

    Args:
        problem: what to track, over which horizons, at what weights and within what limits.
        time_limit: seconds that a sample may take; then the previous inputs are held. None for no limit.

    Raises:
        MampcError: something else than a problem, or a limit that is not positive.

    Example:
        >>> import mampc
        >>> model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=1.0)
        >>> problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=3)
        >>> mpc = mampc.MPC(problem)
        >>> decision = mpc.step(mpc.initial_state(), x=[0.0], reference=[1.0])
        >>> decision.status.value
        'optimal'
    """

    def __init__(self, problem: TrackingProblem, *, time_limit: float | None = None) -> None:
        super().__init__(problem, time_limit=time_limit)

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        return self._unrestricted(sample, state)
