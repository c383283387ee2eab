"""A filter for the gains of a model, together with the states and loads that nobody measured.

With x_j the model's response to input j alone, and states x_d and loads w that nobody measured,

    y_i - y_op = sum_j (1 + theta_ij) (C_i x_j + D_ij u_j) + C_i x_d + (loads at the outputs)_i + noise

is linear in theta: a Kalman filter for x_d, w and theta learns it, whatever feedback made the inputs. Dead times and
lags that are off would pass for gains: what input j did to output i since the last sample, times delta_ij, belongs to
inputs that act delta_ij samples later than in the model, and is found beside theta, but not used. How far loads
walk in a sample is left open: filters for small and large steps are mixed by how likely the measurements make them.
Plants change, so that theta goes back to what is known of it at first, within some `REMEMBERED` samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.identity import equal_only_to_itself
from mampc.loop.hypotheses import INPUT_NOISE, Loads

PRIOR = 0.15  # standard deviation of a gain's share that is not known
LATE = 2.0  # standard deviation, in samples, of how much later inputs act than in the model
REMEMBERED = 10_000.0  # samples within which what was learnt is forgotten
WALKS = (0.1, 0.3, 1.0, 5.0)  # of loads a sample, in loads that show in the outputs like their noise
CHANGES = 0.01  # chance that loads begin to walk in another way from one sample to the next
UNKNOWN = 100.0  # size, in such loads, of what is not known at first


@equal_only_to_itself
class Belief(NamedTuple):
    """What the filters know of z = (x_d, w, delta, theta).

    Attributes:
        weights: how likely each way that loads may walk is, shape (F,), with sum 1.
        z: mean of each filter, shape (F, N).
        P: covariance of each filter, shape (F, N, N).
    """

    weights: Array
    z: Array
    P: Array

    @property
    def mean(self) -> Array:
        """Of z, shape (N,)."""
        mean: Array = self.weights @ self.z
        return mean


class GainFilter:
    """Kalman filters for (x_d, w, delta, theta), one for each way that loads may walk, mixed as in a `LoadBank`; pure.

    Args:
        loads: of the model.
        learns: whether theta is learnt; else it is zero, and no part of z.
    """

    def __init__(self, loads: Loads, learns: bool = True) -> None:
        model, k = loads.model, loads.count
        n = self.n_states = model.n_states + k
        self._shape = model.n_outputs, model.n_inputs
        channels = model.n_outputs * model.n_inputs
        known = np.concatenate([np.full(channels, LATE), np.full(channels if learns else 0, PRIOR)])
        size, self._known = len(known), np.diag(known**2)
        self._of_theta = slice(n + channels, n + size)
        self._R = np.diag(loads.noise**2)
        kept = np.exp(-1 / REMEMBERED)
        self._A = np.eye(n + size)
        self._A[: model.n_states, :n] = np.hstack([model.A, loads.on_states])
        self._A[n:, n:] *= kept
        self._C = np.zeros((model.n_outputs, n + size))
        self._C[:, :n] = np.hstack([model.C, loads.on_outputs])
        driven = INPUT_NOISE * loads.on_states
        of_states, of_loads = slice(model.n_states), slice(model.n_states, n)
        self._Q = np.zeros((len(WALKS), n + size, n + size))
        self._Q[:, of_states, of_states] = driven @ driven.T
        self._Q[:, n:, n:] = (1 - kept**2) * self._known
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
        self._chances = np.full((len(WALKS), len(WALKS)), CHANGES / (len(WALKS) - 1))
        np.fill_diagonal(self._chances, 1 - CHANGES)

    def initial(self, theta: Array | None = None, P_theta: Array | None = None) -> Belief:
        """Before the first measurement, with what is known of theta, shape (l m,), and its covariance."""
        n, size, count, of_theta = self.n_states, len(self._known), len(WALKS), self._of_theta
        z, P = np.zeros((count, n + size)), np.zeros((count, n + size, n + size))
        P[:, :n, :n], P[:, n:, n:] = self._start, self._known
        if theta is not None and P_theta is not None:
            z[:, of_theta], P[:, of_theta, of_theta] = theta, P_theta
        return Belief(np.full(count, 1 / count), z, P)

    def predicted(self, belief: Belief) -> Belief:
        """One sample on; loads may begin to walk in another way."""
        joint = np.maximum(belief.weights[:, None], 1e-12) * self._chances
        after = joint.sum(axis=0)
        starts = [_moments(share / weight, belief) for share, weight in zip(joint.T, after, strict=True)]
        z, P = np.array([mean for mean, _ in starts]), np.array([spread for _, spread in starts])
        return Belief(after, z @ self._A.T, self._A @ P @ self._A.T + self._Q)

    def corrected(
        self, belief: Belief, surplus: Array, each: Array, since: Array, believed: BoolArray | None = None
    ) -> tuple[Belief, float]:
        """What is known after a measurement, and the logarithm of its likelihood before.

        Args:
            belief: predicted.
            surplus: outputs beside what the inputs do to them by the model, shape (l,).
            each: what each input does to each output by the model, shape (l, m).
            since: what of it came since the last sample, shape (l, m).
            believed: outputs that count, default all.

        Raises:
            numpy.linalg.LinAlgError: numbers too far apart.
        """
        n, (l, m), C = self.n_states, self._shape, self._C.copy()
        weights, z, P = belief
        for i in range(l):
            C[i, n + i * m : n + (i + 1) * m] = -since[i]
            if self._of_theta.start < len(C.T):
                C[i, n + (l + i) * m : n + (l + i + 1) * m] = each[i]
        if believed is not None:
            C, surplus = C * believed[:, None], np.where(believed, surplus, 0.0)
        e = surplus - z @ C.T
        V = C @ P @ C.T + self._R
        root = np.linalg.cholesky((V + V.swapaxes(1, 2)) / 2)
        white = np.linalg.solve(root, e[:, :, None])[:, :, 0]
        likelihood = -0.5 * np.square(white).sum(axis=1)
        likelihood -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        most = float(likelihood.max())
        weights = weights * np.exp(likelihood - most)
        total = float(weights.sum())
        K = np.linalg.solve(V, C @ P).swapaxes(1, 2)
        z = z + np.matmul(K, e[:, :, None])[:, :, 0]
        rest = np.eye(z.shape[1]) - K @ C
        P = rest @ P @ rest.swapaxes(1, 2) + K @ self._R @ K.swapaxes(1, 2)
        return Belief(weights / total, z, P), most + float(np.log(total))

    def delta(self, belief: Belief) -> tuple[Array, Array]:
        """Mean, shape (l m,), and covariance of delta."""
        return self._part(belief, slice(self.n_states, self._of_theta.start))

    def theta(self, belief: Belief) -> tuple[Array, Array]:
        """Mean, shape (l m,), and covariance of theta."""
        return self._part(belief, self._of_theta)

    def _part(self, belief: Belief, own: slice) -> tuple[Array, Array]:
        return _moments(belief.weights, Belief(belief.weights, belief.z[:, own], belief.P[:, own, own]))

    def given(self, belief: Belief, theta: Array) -> Belief:
        """What a filter that learns no theta knows, were this theta, shape (l m,), the right one."""
        n = self._of_theta.start
        z, of_theta = belief.z[:, :n], belief.P[:, :n, n:]
        share = np.linalg.solve(belief.P[:, n:, n:], of_theta.swapaxes(1, 2)).swapaxes(1, 2)
        z = z + np.matmul(share, (theta - belief.z[:, n:])[:, :, None])[:, :, 0]
        P = belief.P[:, :n, :n] - share @ of_theta.swapaxes(1, 2)
        return Belief(belief.weights, z, (P + P.swapaxes(1, 2)) / 2)


def _moments(weights: Array, belief: Belief) -> tuple[Array, Array]:
    """Mean and covariance of a mixture with other weights, shape (F,)."""
    mean: Array = weights @ belief.z
    off = belief.z - mean
    spread: Array = np.tensordot(weights, belief.P, 1) + (weights * off.T) @ off
    return mean, spread
