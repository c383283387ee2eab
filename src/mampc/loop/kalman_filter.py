"""State estimation: a Kalman filter with integrating disturbances, so that tracking has no offset.

Source: Pannocchia and Rawlings, AIChE Journal 49 (2003): as many integrating disturbances as outputs,
estimated with the state, remove steady offset under any constant model error or load.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from mampc.base.checks import Array, BoolArray, as_choice, as_vector, is_usable
from mampc.base.errors import MampcError
from mampc.loop.disturbances import (
    Directions,
    alike,
    directions_of,
    driving_noise,
    input_units,
    response_within_reach,
    state_sizes,
)
from mampc.loop.estimator import Estimate, Estimator, Updated
from mampc.systems.noise import white_noise
from mampc.systems.riccati import predicted_covariance, seen_covariance
from mampc.systems.state_space import StateSpace, as_discrete

_ONE = np.ones(1)


class KalmanFilter(Estimator):
    """A stationary Kalman filter for a model augmented with integrating disturbances.

    Build it with `offset_free`. Outputs that are missing drop out of the correction: those that are left
    correct with the gain that the same covariances give them, no larger than in every-day operation, so that
    the return of a measurement makes no jump beyond what it justifies.

    Args:
        model: the discrete model.
        directions: how the disturbances act.
        covariance: of the predicted state and disturbances, stationary, in that order.
        noise: covariance of the measurement noise, shape (l, l).

    Attributes:
        A, C: of the model with the disturbances as further states.
        gain: from innovation to these, with every output believed.
        settings: what `offset_free` was told; None for filters made otherwise.
    """

    def __init__(self, model: StateSpace, directions: Directions, covariance: Array, noise: Array) -> None:
        self.model, self.directions = model, directions
        self._covariance, self._noise = covariance, noise
        self.A, self.C = _augmented(model, directions)
        self._gains: dict[bytes, Array] = {}
        self.gain = self.gain_with(np.ones(model.n_outputs, dtype=bool))
        self.map, self._parts = self._everyday()
        self.settings: dict[str, Any] | None = None

    def __repr__(self) -> str:
        at_inputs = int(self.directions.at_inputs.any(axis=0).sum())
        count = self.directions.at_inputs.shape[1]
        return f"KalmanFilter({self.model!r}, {count} disturbances, {at_inputs} of them at inputs)"

    @classmethod
    def offset_free(
        cls,
        model: StateSpace,
        *,
        disturbance: str = "auto",
        measurement_noise: Any = None,
        drift: Any = None,
        input_noise: Any = None,
        unseen: bool = False,
    ) -> KalmanFilter:
        """A filter with as many integrating disturbances as outputs, where the inputs can make up for them.

        Only ratios of the three standard deviations matter. The defaults suit any units and filter noise over
        some three to ten samples.

        Args:
            model: a discrete model.
            disturbance: "output" for steps at the outputs, which recover from loads as slowly as the plant
                does by itself; "input" for steps at the inputs (needs at least as many inputs as outputs;
                with more of them, disturbances act along the inputs' combinations that move the outputs);
                "auto" for steps at the inputs that drive slow, integrating and unstable modes, and at the
                outputs that these leave.
            measurement_noise: standard deviation of the noise of each output, scalar or (l,), in output
                units; default what `model.noise` says, else sizes that are alike beside what inputs do.
            drift: standard deviation by which each disturbance wanders in a sample, in output units (at the
                inputs: as it shows in the outputs within `REACH` samples), scalar or (l,); default 0.3 times
                the measurement noise.
            input_noise: standard deviation of noise at the inputs, scalar or (m,), in input units; the
                default is what moves the outputs within `REACH` samples by the measurement noise.
            unseen: whether the model may have lasting modes that no output shows; what is estimated of these says
                nothing.

        Raises:
            MampcError: a continuous model, or one whose disturbances cannot be told apart from its
                states with these outputs.
        """
        as_discrete("model", model)
        as_choice("disturbance", disturbance, ("auto", "output", "input"))
        n, m, l = model.n_states, model.n_inputs, model.n_outputs
        if disturbance == "input" and m < l:
            raise MampcError(f"offset_free: expected at least {l} inputs for {l} outputs, received {m}")
        reach = response_within_reach(model)
        noise = white_noise(model.noise) if measurement_noise is None else measurement_noise
        noise = (
            alike(reach) if noise is None else as_vector("measurement_noise", noise, l, 0.0, exclusive=True)
        )
        unit = input_units(reach, noise)
        directions = directions_of(model, disturbance, reach, noise, unit)
        A, C = _augmented(model, directions)
        wander = 0.3 * noise if drift is None else as_vector("drift", drift, l, 0.0, exclusive=True)
        moving = (
            unit if input_noise is None else as_vector("input_noise", input_noise, m, 0.0, exclusive=True)
        )
        driven = model.B[:, :m] * moving
        Q = np.zeros((len(A), len(A)))
        sizes = state_sizes(model.A, driven, model.C / noise[:, None])
        Q[:n, :n] = driving_noise(driven, sizes)
        Q[n:, n:] = np.diag(directions.sizes(wander / noise) ** 2)
        R = np.diag(noise**2)
        of_all = np.concatenate([sizes, np.ones(len(A) - n)])
        units = np.outer(of_all, of_all)
        scaled = A * of_all / of_all[:, None], C * of_all, Q / units, R
        covariance = seen_covariance if unseen else predicted_covariance
        if not unseen:
            _require_detectable(scaled[0], C * of_all / noise[:, None], disturbance)
        try:
            P = units * covariance(*scaled)
        except MampcError as error:
            raise MampcError(f"offset_free: {error}") from None
        made = cls(model, directions, P, R)
        if measurement_noise is not None or white_noise(model.noise) is not None:
            made.noise_told = noise
        made.settings = {
            "disturbance": disturbance, "measurement_noise": measurement_noise, "drift": drift,
            "input_noise": input_noise, "unseen": unseen,
        }  # fmt: skip
        return made

    def gain_with(self, believed: BoolArray) -> Array:
        """From innovation to state and disturbances, shape (n + l, l), where only some outputs count.

        Columns of the others are zero. Should the rest be too little to keep the estimate from running
        away, nothing is corrected.
        """
        key = believed.tobytes()
        gain = self._gains.get(key)
        if gain is None:
            C, P = self.C[believed], self._covariance
            gain = np.zeros((len(P), len(believed)))
            gain[:, believed] = np.linalg.solve(
                C @ P @ C.T + self._noise[np.ix_(believed, believed)], C @ P
            ).T
            error = self.A - gain @ self.C @ self.A
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
        A, C, noise = self.A, self.C, np.sqrt(np.diag(self._noise))
        at_rest = np.vstack([np.eye(n, len(A)) - A[:n], C / noise[:, None]])
        explained = as_vector("y", y, l) - model.y_op - model.D @ change
        rest = np.linalg.lstsq(at_rest, np.concatenate([model.B @ change, explained / noise]))[0]
        return self._disturbed(none, rest[:n], rest[n:])

    def update(self, last: Estimate, u: Array, y: Array, v_last: Array, v: Array) -> Updated | None:
        """Predict and correct in one matrix product; see `Estimator`."""
        known = np.concatenate(
            (last.x, last.output_disturbance, last.input_disturbance, u, v_last, v, y, _ONE)
        )
        if not is_usable(known):
            return None
        data = self.map.dot(known)
        x, at_outputs, at_inputs, innovation, movement = self._parts
        return Updated(Estimate(data[x], data[at_outputs], data[at_inputs]), data[innovation], data[movement])

    def updates(self, last: Estimate, u: Array, y: Array, v_last: Array, v: Array) -> Updated:
        """`update` for many loops, whose arrays have these first; what is not usable comes out as it may."""
        ones = np.ones((len(y), 1))
        known = (last.x, last.output_disturbance, last.input_disturbance, u, v_last, v, y, ones)
        data = np.concatenate(known, axis=1) @ self.map.T
        x, at_outputs, at_inputs, innovation, movement = (data[:, part] for part in self._parts)
        return Updated(Estimate(x, at_outputs, at_inputs), innovation, movement)

    def _everyday(self) -> tuple[Array, list[slice]]:
        """The matrix of `update`, and where the parts of its result stand."""
        model = self.model
        n, m, l, d = model.n_states, model.n_inputs, model.n_outputs, model.n_disturbances
        sizes = (n, l, m, m, d, d, l, 1)
        # Each of these is a map from all that is known to one part of it.
        unit = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
        x, at_outputs, at_inputs, u, v_last, v, y, one = unit
        moved = np.vstack([u + at_inputs, v_last]) - np.outer(model.all_inputs_op, one)
        seen = np.vstack([u + at_inputs, v]) - np.outer(model.all_inputs_op, one)
        predicted = model.A @ x + model.B @ moved
        innovation = y - np.outer(model.y_op, one) - model.C @ predicted - model.D @ seen - at_outputs
        correction = self.gain @ innovation
        at_outputs = at_outputs + self.directions.at_outputs @ correction[n:]
        at_inputs = at_inputs + self.directions.at_inputs @ correction[n:]
        rows = (predicted + correction[:n], at_outputs, at_inputs, innovation, model.C @ (predicted - x))
        ends = np.cumsum([0, *map(len, rows)]).tolist()
        return np.vstack(rows), [slice(*pair) for pair in pairwise(ends)]

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

    def loads_of(self, estimate: Estimate) -> Array:
        """Disturbances at the outputs and inputs, shape (l + m,)."""
        return np.concatenate((estimate.output_disturbance, estimate.input_disturbance), axis=-1)

    def with_loads(self, estimate: Estimate, stuck: BoolArray, loads: Array) -> Estimate:
        """The disturbances of stuck outputs are put back, and those of inputs with the first of them."""
        l = len(stuck)
        at_outputs = np.where(stuck, np.diag(loads[:, :l]), estimate.output_disturbance)
        return Estimate(estimate.x, at_outputs, loads[int(stuck.argmax())][l:])

    def _disturbed(self, estimate: Estimate, x: Array, further: Array) -> Estimate:
        """The estimate with another state x, shape (n,), and further disturbances along the directions."""
        at_inputs, at_outputs = self.directions.at_inputs @ further, self.directions.at_outputs @ further
        return Estimate(x, estimate.output_disturbance + at_outputs, estimate.input_disturbance + at_inputs)

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


def _augmented(model: StateSpace, directions: Directions) -> tuple[Array, Array]:
    """A and C of the model with integrating disturbances as further states."""
    n, m = model.n_states, model.n_inputs
    at_inputs, at_outputs = directions.at_inputs, directions.at_outputs
    count = at_inputs.shape[1]
    A = np.block([[model.A, model.B[:, :m] @ at_inputs], [np.zeros((count, n)), np.eye(count)]])
    return A, np.hstack([model.C, at_outputs + model.D[:, :m] @ at_inputs])


def _require_detectable(A: Array, C: Array, disturbance: str) -> None:
    """Every mode that does not decay must show in the outputs (Hautus test)."""
    n = len(A)
    scale = max(1.0, float(np.abs(C).max()))
    tested: list[complex] = []
    for pole in np.linalg.eigvals(A):
        if abs(pole) >= 1 - 1e-9 and all(abs(pole - other) > 1e-9 for other in tested):
            tested.append(pole)
            shown = np.vstack([A - pole * np.eye(n), C / scale])
            length = np.linalg.norm(shown, axis=0)  # a disturbance at an input has the input's units
            seen = np.linalg.svd(shown / np.where(length > 0, length, 1.0), compute_uv=False)[-1]
            if seen < 1e-9:
                hint = "; for an integrating model use disturbance='input', or the default"
                raise MampcError(
                    "offset_free: expected states and disturbances observable from the outputs, received a model "
                    f"whose mode at {pole:.4g} cannot be told from a disturbance"
                    f"{hint if disturbance == 'output' else ''}"
                )
