"""State estimation: a Kalman filter with integrating disturbances, so that tracking has no offset.

Source: Pannocchia and Rawlings, AIChE Journal 49 (2003): as many integrating disturbances as outputs,
estimated with the state, remove steady offset under any constant model error or load.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mampc.base.checks import Array, BoolArray, as_vector
from mampc.base.errors import MampcError
from mampc.systems.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class Estimate:
    """The model state (n,) and the constant disturbances seen at its outputs (l,) and inputs (m,)."""

    x: Array
    output_disturbance: Array
    input_disturbance: Array


class KalmanFilter:
    """A stationary Kalman filter for a model augmented with one integrating disturbance per output.

    Build it with `offset_free`. Outputs that are missing drop out of the correction: those that are left
    correct with the gain that the same covariances give them, no larger than in every-day operation, so that
    the return of a measurement makes no jump beyond what it justifies.

    Args:
        model: the discrete model.
        directions: how the l disturbances act: (m, l) at the inputs, or None for at the outputs.
        covariance: of the predicted state and disturbances, stationary, shape (n + l, n + l).
        noise: covariance of the measurement noise, shape (l, l).
    """

    def __init__(self, model: StateSpace, directions: Array | None, covariance: Array, noise: Array) -> None:
        self.model, self.directions = model, directions
        self._covariance, self._noise = covariance, noise
        self._A, self._C = _augmented(model, directions)
        self._gains: dict[bytes, Array] = {}
        self.gain = self.gain_with(np.ones(model.n_outputs, dtype=bool))

    def __repr__(self) -> str:
        where = "outputs" if self.directions is None else "inputs"
        return f"KalmanFilter({self.model!r}, {self.model.n_outputs} disturbances at its {where})"

    @classmethod
    def offset_free(
        cls,
        model: StateSpace,
        *,
        disturbance: str = "output",
        measurement_noise: Any = 1.0,
        drift: Any = 0.3,
        input_noise: Any = None,
    ) -> KalmanFilter:
        """A filter with one integrating disturbance per output.

        Only ratios of the three standard deviations matter, so that the defaults suit any units: they
        filter noise over some three to ten samples.

        Args:
            model: a discrete model.
            disturbance: "output" for steps at the outputs (stable models), "input" for steps at the
                inputs (integrating models too; needs at least as many inputs as outputs; with more of
                them, disturbances act along the inputs' combinations that move the outputs).
            measurement_noise: standard deviation of the noise of each output, scalar or (l,).
            drift: standard deviation by which each disturbance wanders in a sample, in the unit of
                `measurement_noise` (for "input": as seen through the model's gain), scalar or (l,).
            input_noise: standard deviation of noise at the inputs, scalar or (m,), in input units; the
                default is what moves the outputs at rest by about the measurement noise.

        Raises:
            MampcError: a continuous model, or one whose disturbances cannot be told apart from its
                states with these outputs.
        """
        if not isinstance(model, StateSpace):
            raise MampcError(f"model: expected a mampc.StateSpace, received {type(model).__name__}")
        if not model.is_discrete:
            raise MampcError("offset_free: expected a discrete model, received dt = 0; discretise it first")
        if disturbance not in ("output", "input"):
            raise MampcError(f"disturbance: expected 'output' or 'input', received {disturbance!r}")
        n, m, l = model.n_states, model.n_inputs, model.n_outputs
        at_output = disturbance == "output"
        if not at_output and m < l:
            raise MampcError(f"offset_free: expected at least {l} inputs for {l} outputs, received {m}")
        response = static_response(model)
        size = float(np.sqrt(np.mean(response**2))) or 1.0
        directions = None if at_output else np.eye(m) if m == l else response.T / (size * np.sqrt(l))
        A, C = _augmented(model, directions)
        _require_detectable(A, C, at_output)
        noise = _positive("measurement_noise", measurement_noise, l)
        excitation = noise.mean() / size if input_noise is None else _positive("input_noise", input_noise, m)
        wander = _positive("drift", drift, l) * (1.0 if at_output else 1 / size)
        from scipy.linalg import solve_discrete_are

        driven = model.B[:, :m] * excitation
        Q = np.zeros((n + l, n + l))
        Q[:n, :n] = driven @ driven.T + 1e-10 * np.trace(driven @ driven.T) * np.eye(n)
        Q[n:, n:] = np.diag(wander**2)
        R = np.diag(noise**2)
        try:
            P = solve_discrete_are(A.T, C.T, Q, R)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise MampcError(
                f"offset_free: expected a detectable model, the Riccati equation failed: {error}"
            ) from None
        return cls(model, directions, P, R)

    def gain_with(self, believed: BoolArray) -> Array:
        """From innovation to state and disturbances, shape (n + l, l), where only some outputs count.

        Columns of the others are zero. Should the rest be too little to keep the estimate from running
        away, nothing is corrected.
        """
        key = believed.tobytes()
        gain = self._gains.get(key)
        if gain is None:
            C, P = self._C[believed], self._covariance
            gain = np.zeros((len(P), len(believed)))
            gain[:, believed] = np.linalg.solve(
                C @ P @ C.T + self._noise[np.ix_(believed, believed)], C @ P
            ).T
            error = self._A - gain @ self._C @ self._A
            allowed = max(1.0, float(np.max(np.abs(np.linalg.eigvals(self.model.A)), initial=0.0)))
            if not np.max(np.abs(np.linalg.eigvals(error))) <= allowed + 1e-9:
                gain = np.zeros_like(gain)
            self._gains[key] = gain
        return gain

    def initial(self, u: Array, y: Any = None, v: Array | None = None) -> Estimate:
        """At rest under inputs u (m,) and measured disturbances v (d,), default those of the operating
        point; with measurements y (l,) the disturbances explain them.
        """
        model = self.model
        n, m, l = model.n_states, model.n_inputs, model.n_outputs
        none = Estimate(np.zeros(n), np.zeros(l), np.zeros(m))
        change = self._change(none, u, v)
        if y is None:
            return replace(none, x=model.steady_state(np.concatenate([u, model.v_op if v is None else v])))
        # x = A x + B change + (disturbances), y = y_op + C x + D change + (disturbances)
        A, C = _augmented(model, self.directions)
        at_rest = np.vstack([np.eye(n, n + l) - A[:n], C])
        wanted = np.concatenate([model.B @ change, as_vector("y", y, l) - model.y_op - model.D @ change])
        rest = np.linalg.lstsq(at_rest, wanted)[0]
        return self._disturbed(none, rest[:n], rest[n:])

    def predict(self, last: Estimate, u: Array, v: Array | None = None) -> Estimate:
        """One sample on, with the inputs u (m,) and disturbances v (d,) since; what is estimated stays."""
        x = self.model.A @ last.x + self.model.B @ self._change(last, u, v)
        return Estimate(x, last.output_disturbance, last.input_disturbance)

    def innovation(self, predicted: Estimate, u: Array, y: Array, v: Array | None = None) -> Array:
        """Measured less predicted outputs, shape (l,).

        The measurements y (l,) are taken just before the inputs u (m,) are replaced and while the measured
        disturbances are v (d,).
        """
        innovation: Array = y - self._output(predicted, self._change(predicted, u, v))
        return innovation

    def correct(self, predicted: Estimate, u: Array, y: Array, v: Array | None = None) -> Estimate:
        """Correct with measurements y (l,), taken as `innovation` says."""
        return self.corrected(predicted, self.innovation(predicted, u, y, v))

    def corrected(
        self, predicted: Estimate, innovation: Array, believed: BoolArray | None = None
    ) -> Estimate:
        """Correct with the innovation (l,), of which only the outputs `believed` count (default all)."""
        gain = self.gain
        if believed is not None:
            gain, innovation = self.gain_with(believed), np.where(believed, innovation, 0.0)
        correction = gain @ innovation
        n = self.model.n_states
        return self._disturbed(predicted, predicted.x + correction[:n], correction[n:])

    def _disturbed(self, estimate: Estimate, x: Array, further: Array) -> Estimate:
        """The estimate with another state x, shape (n,), and further disturbances, shape (l,)."""
        at_outputs, at_inputs = estimate.output_disturbance, estimate.input_disturbance
        if self.directions is None:
            return Estimate(x, at_outputs + further, at_inputs)
        return Estimate(x, at_outputs, at_inputs + self.directions @ further)

    def _change(self, estimate: Estimate, u: Array, v: Array | None) -> Array:
        """All inputs of the model as differences from the operating point, shape (m + d,)."""
        model = self.model
        du = u - model.u_op + estimate.input_disturbance
        if model.n_disturbances == 0:
            return du
        return np.concatenate([du, np.zeros(model.n_disturbances) if v is None else v - model.v_op])

    def _output(self, estimate: Estimate, change: Array) -> Array:
        model = self.model
        y: Array = model.y_op + model.C @ estimate.x + model.D @ change + estimate.output_disturbance
        return y


def _augmented(model: StateSpace, directions: Array | None) -> tuple[Array, Array]:
    """A and C of the model with integrating disturbances as further states."""
    n, m, l = model.n_states, model.n_inputs, model.n_outputs
    at_states = np.zeros((n, l)) if directions is None else model.B[:, :m] @ directions
    at_outputs = np.eye(l) if directions is None else model.D[:, :m] @ directions
    A = np.block([[model.A, at_states], [np.zeros((l, n)), np.eye(l)]])
    return A, np.hstack([model.C, at_outputs])


def _require_detectable(A: Array, C: Array, at_output: bool) -> None:
    """Every mode that does not decay must show in the outputs (Hautus test)."""
    n = len(A)
    scale = max(1.0, float(np.abs(C).max()))
    for pole in np.linalg.eigvals(A):
        if abs(pole) >= 1 - 1e-9:
            seen = np.linalg.svd(np.vstack([A - pole * np.eye(n), C / scale]), compute_uv=False)[-1]
            if seen < 1e-9:
                hint = "; for an integrating model use disturbance='input'" if at_output else ""
                raise MampcError(
                    "offset_free: expected states and disturbances observable from the outputs, received a "
                    f"model whose mode at {pole:.4g} cannot be told from a disturbance{hint}"
                )


def static_response(model: StateSpace) -> Array:
    """Output changes per unit of input, shape (l, m): steady, or after 10 samples where the model integrates."""
    try:
        gain = model.dc_gain()
    except MampcError:
        gain = model.step_response(11)[-1]
    return gain[:, : model.n_inputs]


def _positive(name: str, value: Any, size: int) -> Array:
    values = as_vector(name, value, size)
    if (values <= 0).any():
        raise MampcError(f"{name}: expected positive numbers, received {values}")
    return values
