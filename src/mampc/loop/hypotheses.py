"""Hypotheses about the load, each as a model with states, and the Kalman filter that it asks for.

A load acts at every input, and at every output that no slow or integrating mode moves (there it can hardly be told
from one at the inputs). It is w now and will be w + s, w + s + a s, ... at the next samples: each hypothesis says how
w and s are driven by noise, per sample and in loads that show in the outputs like their measurement noise:

    z = (x, w, s)      w+ = w + s + walk xi + burst eta      s+ = a s + slope zeta - (1 - a) burst eta

so that a burst dies away by itself, and a slope goes on for a while. The long-term load w + s / (1 - a) is constant:
whatever hypothesis holds leaves no offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.errors import MampcError
from mampc.base.words import LoadKind
from mampc.loop.disturbances import (
    directions_of,
    driving_noise,
    input_units,
    response_within_reach,
    state_sizes,
)
from mampc.systems.riccati import seen_covariance
from mampc.systems.state_space import StateSpace

INPUT_NOISE = 0.1  # white noise at every input, which shows in the outputs as this share of their noise
RUNS_AWAY = 1e-5  # how much faster than the plant the error of an estimate may grow per sample, for rounding


@dataclass(frozen=True)
class Hypothesis:
    """One way that loads behave; see the module for the symbols.

    Attributes:
        load: what is said where it holds.
        walk, burst, slope: standard deviations per sample, in loads that show in the outputs like their noise.
        kept: a, the share of s that the next sample keeps; 0 for loads without s.
    """

    load: LoadKind
    walk: float
    burst: float = 0.0
    slope: float = 0.0
    kept: float = 0.0


HYPOTHESES = (
    Hypothesis(LoadKind.STEADY, walk=0.1),
    Hypothesis(LoadKind.WANDERS, walk=0.3),
    Hypothesis(LoadKind.WANDERS_FAR, walk=1.0),
    Hypothesis(LoadKind.DIES_AWAY, walk=0.1, burst=1.0, kept=0.9),
    Hypothesis(LoadKind.DRIFTS, walk=0.1, slope=0.05, kept=0.97),
    Hypothesis(LoadKind.JUMPS, walk=5.0),
)


@dataclass(frozen=True, eq=False)
class Loads:
    """Where the k loads of a model act, each of a size that shows in the outputs like their noise.

    Attributes:
        model: of the plant.
        noise: standard deviation of the measurement noise, shape (l,), in output units.
        at_inputs, at_outputs: shapes (m, k) and (l, k).
    """

    model: StateSpace
    noise: Array
    at_inputs: Array
    at_outputs: Array

    @classmethod
    def of(cls, model: StateSpace, noise: Array) -> Loads:
        m, l = model.n_inputs, model.n_outputs
        reach = response_within_reach(model)
        unit = input_units(reach, noise)
        outputs = directions_of(model, "auto", reach, noise, unit).at_outputs
        outputs = outputs[:, outputs.any(axis=0)]
        inputs = np.diag(unit)[:, unit > 0]
        return cls(
            model, noise,
            np.hstack([inputs, np.zeros((m, outputs.shape[1]))]),
            np.hstack([np.zeros((l, inputs.shape[1])), outputs]),
        )  # fmt: skip

    @property
    def count(self) -> int:
        """k."""
        return len(self.at_inputs.T)

    @property
    def on_states(self) -> Array:
        """What a load adds to the next state, shape (n, k)."""
        return self.model.B[:, : self.model.n_inputs] @ self.at_inputs

    @property
    def on_outputs(self) -> Array:
        """What a load adds to the outputs at once, shape (l, k)."""
        return self.at_outputs + self.model.D[:, : self.model.n_inputs] @ self.at_inputs

    @property
    def state_sizes(self) -> Array:
        """Units of the states that noise at the inputs gives them, shape (n,)."""
        return state_sizes(self.model.A, INPUT_NOISE * self.on_states, self.model.C / self.noise[:, None])

    def at_rest(self, all_inputs: Array, y: Array | None) -> tuple[Array, Array]:
        """States (n,) and the smallest loads (k,) with which outputs stay at y (l,) under inputs (m + d,).

        No loads where y is None.
        """
        if y is None:
            return self.model.steady_state(all_inputs), np.zeros(self.count)
        model, n, sizes = self.model, self.model.n_states, self.state_sizes[:, None]
        change = all_inputs - model.all_inputs_op
        # (I - A) x = B change + on_states w and C x = y - y_op - D change - on_outputs w
        of_x = np.vstack([(np.eye(n) - model.A) / sizes, model.C / self.noise[:, None]]) * sizes.T
        of_w = np.vstack([-self.on_states / sizes, self.on_outputs / self.noise[:, None]])
        surplus = (y - model.y_op - model.D @ change) / self.noise
        wanted = np.concatenate([model.B @ change / sizes[:, 0], surplus])
        left, size, _ = np.linalg.svd(of_x)
        free = left[:, np.count_nonzero(size > 1e-9 * size.max(initial=0.0)) :].T  # whatever x is
        w: Array = np.linalg.lstsq(free @ of_w, free @ wanted, rcond=1e-9)[0]
        return sizes[:, 0] * np.linalg.lstsq(of_x, wanted - of_w @ w)[0], w

    def with_fading(self, kept: tuple[float, ...]) -> StateSpace:
        """The model with loads that fade as further states, k for every share that a sample keeps."""
        model, count, fading = self.model, len(kept), np.repeat(kept, self.count)
        n, columns = model.n_states, model.B.shape[1]
        return replace(
            model,
            A=np.block(
                [
                    [model.A, np.tile(self.on_states, count)],
                    [np.zeros((len(fading), n)), np.diag(fading)],
                ]
            ),
            B=np.vstack([model.B, np.zeros((len(fading), columns))]),
            C=np.hstack([model.C, np.tile(self.on_outputs, count)]),
            names=replace(model.names, states=()),
        )


class Member:
    """The stationary Kalman filter of one hypothesis, state z = (x, w, s), in engineering units.

    Attributes:
        hypothesis: which.
        A, C: of z, shapes (n + 2k, n + 2k) and (l, n + 2k).
        covariance: of z before a measurement; what no output will ever show may be as good as unbounded.
        noise: covariance of the measurement noise, shape (l, l).
    """

    def __init__(self, hypothesis: Hypothesis, loads: Loads) -> None:
        self.hypothesis = hypothesis
        model, k, a = loads.model, loads.count, hypothesis.kept
        n, l, none, same = model.n_states, model.n_outputs, np.zeros((loads.count, loads.count)), np.eye(k)
        self.A = np.block(
            [
                [model.A, loads.on_states, np.zeros((n, k))],
                [np.zeros((k, n)), same, same if a > 0 else none],
                [np.zeros((k, n)), none, a * same],
            ]
        )
        self.C = np.hstack([model.C, loads.on_outputs, np.zeros((l, k))])
        driven = INPUT_NOISE * loads.on_states
        sizes = loads.state_sizes
        burst, fall = hypothesis.burst**2, -(1 - a) * hypothesis.burst**2
        Q = np.zeros_like(self.A)
        Q[:n, :n] = driving_noise(driven, sizes)
        Q[n:, n:] = np.kron(
            [[hypothesis.walk**2 + burst, fall], [fall, hypothesis.slope**2 - (1 - a) * fall]], same
        )
        # In units of the noise and of what drives the states, so that all numbers are alike.
        self.noise = np.diag(loads.noise**2)
        of_z = np.concatenate([sizes, np.ones(2 * k)])
        units = np.outer(of_z, of_z)
        scaled = self.A * of_z / of_z[:, None], self.C * of_z / loads.noise[:, None]
        self.covariance = units * seen_covariance(*scaled, Q / units, np.eye(l))
        self._gains: dict[bytes, Array] = {}
        self._fastest = max(1.0, float(np.abs(model.poles()).max(initial=0.0)))
        if not self._growth(self.gain(np.ones(l, dtype=bool))) <= 1 + RUNS_AWAY:
            raise MampcError("expected a model whose growing modes are all seen in its outputs")

    def gain(self, believed: BoolArray) -> Array:
        """From innovation to z, shape (n + 2k, l), with zero columns for outputs that are not believed.

        Should the rest be too little to keep the estimate from running away, nothing is corrected.
        """
        key = believed.tobytes()
        if key not in self._gains:
            C, P = self.C[believed], self.covariance
            gain = np.zeros((len(P), len(believed)))
            if believed.any():
                gain[:, believed] = np.linalg.solve(self.innovation_covariance(believed), C @ P).T
            stays = self._growth(gain) <= self._fastest + RUNS_AWAY
            self._gains[key] = gain if stays else np.zeros_like(gain)
        return self._gains[key]

    def _growth(self, gain: Array) -> float:
        """By what the error of the estimate grows from sample to sample, in the end, with a gain."""
        return float(np.abs(np.linalg.eigvals(self.A - gain @ self.C @ self.A)).max())

    def innovation_covariance(self, believed: BoolArray) -> Array:
        """Of the outputs believed, a square matrix."""
        C = self.C[believed]
        covariance: Array = C @ self.covariance @ C.T + self.noise[np.ix_(believed, believed)]
        return (covariance + covariance.T) / 2

    @property
    def posterior(self) -> Array:
        """Covariance of z after a measurement of all outputs, shape (n + 2k, n + 2k)."""
        everything = np.ones(len(self.noise), dtype=bool)
        posterior: Array = self.covariance - self.gain(everything) @ self.C @ self.covariance
        return (posterior + posterior.T) / 2
