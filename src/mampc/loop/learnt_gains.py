"""Gains of a model, input by input and output by output, corrected from records of the plant under control.

With x_j the model's response to input j alone, and states x_d and loads w that nobody measured,

    y_i - y_op = sum_j (1 + theta_ij) (C_i x_j + D_ij u_j) + C_i x_d + (loads at the outputs)_i + noise

is linear in theta: a Kalman filter for x_d, w and the constant theta learns it, whatever feedback made the inputs.
Inputs count from their first values, and what they did before belongs to x_d. How far loads walk in a sample is left
open: filters for small and large steps are mixed by how likely the measurements make them.

The correction counts only where it predicts better than the gains as they are, each measurement predicted before
anything was learnt from it.

Source of the latter: Dawid, J. Royal Statistical Society A 147 (1984), the prequential approach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_vector, require_finite
from mampc.base.errors import MampcError
from mampc.identification.data import IOData
from mampc.loop.disturbances import response_within_reach
from mampc.loop.hypotheses import INPUT_NOISE, Loads
from mampc.loop.run import Run
from mampc.program.sample import Indices
from mampc.systems.noise import white_noise
from mampc.systems.state_space import StateSpace, as_discrete

PRIOR = 0.15  # standard deviation of a gain's share that is not known
WALKS = (0.1, 0.3, 1.0, 5.0)  # of loads a sample, in loads that show in the outputs like their noise
CHANGES = 0.01  # chance that loads begin to walk in another way from one sample to the next
UNKNOWN = 100.0  # size, in such loads, of what is not known at first
CLEARLY = 3.0  # by which the log-likelihood has to rise
MOST = 0.5  # share of a gain beyond which the model is not one to correct
FEWEST = 60  # samples of all records together
ALIKE = 20.0  # condition of the gains, inputs and outputs scaled alike, from which on inputs are redundant


@dataclass(frozen=True, eq=False)
class LearntGains:
    """What `learn_gains` found.

    Attributes:
        model: with its gains corrected where that predicts better; else the one given.
        accepted: whether they are.
        reason: in words.
        factors: of each gain, (l, m), as learnt from all records, accepted or not.
        deviation: their standard deviations, shape (l, m).
        gained: by how much the log-likelihood of the measurements rises, each predicted before it was learnt from.
    """

    model: StateSpace = field(repr=False)
    accepted: bool
    reason: str
    factors: Array
    deviation: Array
    gained: float

    def __str__(self) -> str:
        return self.reason


def learn_gains(
    model: StateSpace, records: IOData | Run | Sequence[IOData | Run], *, noise: Any = None
) -> LearntGains:
    """Correct the gains of a model from records of the plant, under control or not.

    Args:
        model: a discrete model with at most as many inputs as outputs, whose gains no two inputs share.
        records: of inputs and measured outputs, at least 60 samples together.
        noise: standard deviation of the measurement noise, scalar or (l,), output units; default `model.noise`.

    Raises:
        MampcError: redundant inputs, records of other signals, sample time or too few samples, or no noise.
    """
    as_discrete("model", model)
    l, m = model.n_outputs, model.n_inputs
    given = list(records) if isinstance(records, Sequence) else [records]
    if not given:
        raise MampcError("records: expected at least one, received none")
    known = [_signals(record, model) for record in given]
    noise = white_noise(model.noise) if noise is None else noise
    if noise is None:
        raise MampcError(
            "noise: expected the standard deviation of each output's measurement noise, received none"
        )
    sizes = as_vector("noise", noise, l, 0.0, exclusive=True)
    _require_apart(model, sizes)
    total = sum(len(y) for _, y in known)
    if total < FEWEST:
        raise MampcError(f"records: expected at least {FEWEST} samples together, received {total}")
    loads = Loads.of(model, sizes)
    learnt, usual = (_Bank(loads, learns).through(known) for learns in (True, False))
    factors, gained = 1 + learnt.theta, learnt.likelihood - usual.likelihood
    answer = LearntGains(model, False, "", factors, learnt.deviation, gained)
    words = f"log-likelihood {gained:+.1f} over {total} samples, each predicted before it was learnt from"
    if not np.abs(learnt.theta).max() <= MOST:
        i, j = divmod(int(np.abs(learnt.theta).argmax()), m)
        return replace(answer, reason=(
            f"gains stay: that from {model.names.inputs[j]} to {model.names.outputs[i]} would become "
            f"{factors[i, j]:.2f} times itself, which calls for another model"
        ))  # fmt: skip
    if not gained > CLEARLY:
        return replace(answer, reason=f"gains stay: corrected they predict no better ({words})")
    return replace(
        answer,
        model=with_gains(model, factors),
        accepted=True,
        reason=f"gains corrected: they predict better ({words})",
    )


def with_gains(model: StateSpace, factors: Array) -> StateSpace:
    """The model with the gain from each input to each output multiplied, shape (l, m); further inputs as they are."""
    columns = model.B.shape[1]
    shares = np.ones((model.n_outputs, columns))
    shares[:, : model.n_inputs] = factors
    parts = []
    for j in range(columns):
        own = _reached(model.A, model.B[:, j])
        parts.append((model.A[np.ix_(own, own)], model.B[own, j], shares[:, j, None] * model.C[:, own]))
    n = sum(len(A) for A, _, _ in parts)
    A, B, C, at = np.zeros((n, n)), np.zeros((n, columns)), np.zeros((model.n_outputs, n)), 0
    for j, (own_A, own_B, own_C) in enumerate(parts):
        own_rows = slice(at, at := at + len(own_A))
        A[own_rows, own_rows], B[own_rows, j], C[:, own_rows] = own_A, own_B, own_C
    return replace(
        model, A=A, B=B, C=C, D=shares * model.D, names=replace(model.names, states=()), evidence=None
    )


def _reached(A: Array, b: Array) -> Indices:
    """The states that an input moves at all, by the places of zeros alone."""
    reached = b != 0
    for _ in range(len(A)):
        further = reached | (A[:, reached] != 0).any(axis=1)
        if (further == reached).all():
            break
        reached = further
    return np.flatnonzero(reached)


def _signals(record: Any, model: StateSpace) -> tuple[Array, Array]:
    """Inputs (N, m + d) and outputs (N, l) of a record as differences from the operating point."""
    if isinstance(record, Run):
        u, y, dt = np.hstack([record.u, record.v]), record.y_measured, record.dt
    elif isinstance(record, IOData):
        u, y, dt = record.u, record.y, record.dt
    else:
        raise MampcError(f"records: expected IOData or runs, received {type(record).__name__}")
    if u.shape[1] != model.B.shape[1] or y.shape[1] != model.n_outputs:
        raise MampcError(
            f"records: expected {model.B.shape[1]} inputs and {model.n_outputs} outputs, "
            f"received {u.shape[1]} and {y.shape[1]}"
        )
    if not np.isclose(dt, model.dt, rtol=1e-6):
        raise MampcError(f"records: expected the model's sample time of {model.dt:g} s, received {dt:g} s")
    return require_finite("records", u) - model.all_inputs_op, require_finite("records", y) - model.y_op


def _require_apart(model: StateSpace, noise: Array) -> None:
    """Inputs that can stand in for each other have no gains of their own to learn."""
    gain = response_within_reach(model) / noise[:, None]
    for _ in range(20):  # rows and columns of length one
        for axis in (0, 1):
            size = np.linalg.norm(gain, axis=axis, keepdims=True)
            gain = gain / np.where(size > 0, size, 1.0)
    if model.n_inputs > model.n_outputs or not np.linalg.cond(gain) < ALIKE:
        raise MampcError(
            f"learn_gains: expected inputs that act each in a way of its own, received {model.n_inputs} inputs and "
            f"{model.n_outputs} outputs with gains of condition {np.linalg.cond(gain):.0f}: where inputs can stand "
            "in for each other a record does not tell whose gain is off"
        )


class _Bank:
    """Kalman filters for (x_d, w, theta), one for each way that loads may walk, mixed as in a `LoadBank`.

    Attributes:
        theta, deviation: as known in the end, shape (l, m); zeros where nothing is learnt.
        likelihood: its logarithm, of every measurement given those before.
    """

    def __init__(self, loads: Loads, learns: bool) -> None:
        model, k, self._loads = loads.model, loads.count, loads
        n = self._n_states = model.n_states + k
        self._shape = model.n_outputs, model.n_inputs
        size = model.n_outputs * model.n_inputs if learns else 0
        self.theta: Array = np.zeros(self._shape)
        self.deviation: Array = np.full(self._shape, PRIOR)
        self.likelihood = 0.0
        self._P_theta: Array = PRIOR**2 * np.eye(size)
        self._A = np.eye(n + size)
        self._A[: model.n_states, :n] = np.hstack([model.A, loads.on_states])
        self._C = np.zeros((model.n_outputs, n + size))
        self._C[:, :n] = np.hstack([model.C, loads.on_outputs])
        driven = INPUT_NOISE * loads.on_states
        of_loads, of_states = slice(model.n_states, n), slice(model.n_states)
        self._Q = np.zeros((len(WALKS), n + size, n + size))
        self._Q[:, of_states, of_states] = driven @ driven.T
        for Q, walk in zip(self._Q, WALKS, strict=True):
            Q[of_loads, of_loads] = walk**2 * np.eye(k)
        # At first: what loads of unknown size did before.
        state: Array = np.zeros((model.n_states, model.n_states))
        unknown = UNKNOWN**2 * loads.on_states @ loads.on_states.T
        for _ in range(3 * model.n_states + 10):
            state = model.A @ state @ model.A.T + unknown
        self._start = np.zeros((n, n))
        self._start[of_states, of_states] = state
        self._start[of_loads, of_loads] = UNKNOWN**2 * np.eye(k)

    def through(self, records: list[tuple[Array, Array]]) -> _Bank:
        """This bank after all records, one by one."""
        for u, y in records:
            self._through(u - u[0], y)
        return self

    def _through(self, u: Array, y: Array) -> None:
        model, n, (l, m) = self._loads.model, self._n_states, self._shape
        size, count = len(self._P_theta), len(WALKS)
        R, C = np.diag(self._loads.noise**2), self._C.copy()
        z: Array = np.tile(np.concatenate([np.zeros(n), self.theta.ravel()[:size]]), (count, 1))
        P: Array = np.zeros((count, n + size, n + size))
        P[:, :n, :n], P[:, n:, n:] = self._start, self._P_theta
        weights: Array = np.full(count, 1 / count)
        x: Array = np.zeros((model.n_states, model.B.shape[1]))  # responses to each input alone
        for t in range(len(y)):
            if t:
                x = model.A @ x + model.B * u[t - 1]
                weights, z, P = _mixed(weights, z, P)
                z, P = z @ self._A.T, self._A @ P @ self._A.T + self._Q
            each = model.C @ x + model.D * u[t]  # (l, m + d)
            for i in range(l if size else 0):
                C[i, n + i * m : n + (i + 1) * m] = each[i, :m]
            e = y[t] - each.sum(axis=1) - z @ C.T
            V = C @ P @ C.T + R
            root = np.linalg.cholesky((V + V.swapaxes(1, 2)) / 2)
            white = np.linalg.solve(root, e[:, :, None])[:, :, 0]
            likelihood = -0.5 * np.square(white).sum(axis=1)
            likelihood -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
            most = float(likelihood.max())
            weights = weights * np.exp(likelihood - most)
            if t > n:  # before it knows the states, a filter's surprise says little
                self.likelihood += most + float(np.log(weights.sum()))
            weights = weights / weights.sum()
            K = np.linalg.solve(V, C @ P).swapaxes(1, 2)
            z = z + np.matmul(K, e[:, :, None])[:, :, 0]
            rest = np.eye(n + size) - K @ C
            P = rest @ P @ rest.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
        if size:
            theta, self._P_theta = _moments(weights, z[:, n:], P[:, n:, n:])
            self.theta = theta.reshape(l, m)
            self.deviation = np.sqrt(np.diag(self._P_theta)).reshape(l, m)


def _mixed(weights: Array, z: Array, P: Array) -> tuple[Array, Array, Array]:
    """How likely each filter is at the next sample, and where it starts: loads may begin to walk in another way."""
    count = len(weights)
    chances = np.full((count, count), CHANGES / (count - 1)) + (1 - CHANGES - CHANGES / (count - 1)) * np.eye(
        count
    )
    joint = np.maximum(weights[:, None], 1e-12) * chances
    after = joint.sum(axis=0)
    starts = [_moments(joint[:, b] / after[b], z, P) for b in range(count)]
    return after, np.array([mean for mean, _ in starts]), np.array([spread for _, spread in starts])


def _moments(weights: Array, z: Array, P: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture."""
    mean: Array = weights @ z
    off = z - mean
    spread: Array = np.einsum("b,bij->ij", weights, P) + np.einsum("b,bi,bj->ij", weights, off, off)
    return mean, spread
