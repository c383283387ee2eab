"""Plants that differ from their model: gains, lags and dead times off by given shares, input by output.

Every pair of input and output is taken apart: its dead time, as many samples as it does not answer; and a state-space
realisation of the rest from its pulse response (Ho and Kalman), whose time is stretched by way of continuous time. Put
together again with the dead times as states, they are a model of the same kind.

Source: Ho, Kalman, Regelungstechnik 14 (1966).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.base.errors import MampcError
from mampc.systems.modes import apart
from mampc.systems.pairs import NEGLIGIBLE, SLOWEST_FREE, Pair, delayed, joined
from mampc.systems.state_space import StateSpace, as_discrete


@dataclass(frozen=True, kw_only=True)
class Mismatch:
    """By what shares a plant's gains, lags and dead times may differ from the model's: 0.15 for up to 15 % either way.

    Args:
        gain: of the gains.
        lag: of the time constants, below 1.
        dead_time: of the dead times, below 1; in whole or parts of samples.

    Each pair of input and output draws its own, evenly between the extremes. Poles that belong to no lag, such as
    negative ones, stay.

    Raises:
        MampcError: shares out of range.
    """

    gain: float = 0.0
    lag: float = 0.0
    dead_time: float = 0.0

    def __post_init__(self) -> None:
        for name in ("gain", "lag", "dead_time"):
            share = as_number(name, getattr(self, name), 0.0)
            if share >= 1:
                raise MampcError(f"{name}: expected a share below 1, such as 0.15, received {share:g}")
            object.__setattr__(self, name, share)

    def drawn(self, model: StateSpace, seed: int) -> StateSpace:
        """A plant off the model by random shares; equal seeds give equal plants.

        Measured disturbances count as inputs. The states are not those of the model.

        Raises:
            MampcError: a continuous model.
        """
        as_discrete("Mismatch", model)
        rng = np.random.default_rng([as_whole("seed", seed, 0), 0x4D49])
        l, columns = model.D.shape
        shares = rng.uniform(-1.0, 1.0, (3, l, columns))
        gains, lags, delays = (
            1 + share * part
            for share, part in zip((self.gain, self.lag, self.dead_time), shares, strict=True)
        )
        pairs = [
            [_off(_pair(model, i, j), lags[i, j], delays[i, j]) for j in range(columns)] for i in range(l)
        ]
        A, B, C, D = joined(pairs, gains)
        names = replace(model.names, states=())
        return StateSpace(A, B, C, D, model.dt, model.u_op, model.y_op, names, model.v_op)


def _off(pair: Pair, lag: float, dead_time: float) -> Pair:
    """A pair of whole dead time, with time constants and dead time multiplied."""
    A, B, C = _stretched(pair.A, pair.early, pair.C, lag)
    return delayed(A, B, C, pair.D, pair.delay * dead_time)


def _pair(model: StateSpace, i: int, j: int) -> Pair:
    """Output i and input j of a model, by as few states as it takes."""
    n = model.n_states
    pulses, column = [], model.B[:, j]
    for _ in range(3 * n + 2):
        pulses.append(float(model.C[i] @ column))
        column = model.A @ column
    response = np.array(pulses)
    answers = np.abs(response) > NEGLIGIBLE * np.abs(response).max(initial=0.0)
    dead = int(answers.argmax()) if answers.any() and model.D[i, j] == 0 else 0
    response = response[dead:]
    rows = len(response) // 2
    hankel = np.array([response[k : k + rows] for k in range(rows)])
    shifted = np.array([response[k + 1 : k + 1 + rows] for k in range(rows)])
    left, size, right = np.linalg.svd(hankel)
    order = int((size > NEGLIGIBLE * size.max(initial=0.0)).sum()) if answers.any() else 0
    root = np.sqrt(size[:order])
    A = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
    B, C = root * right[:order, 0], left[0, :order] * root
    return Pair(A, B, np.zeros(order), C, float(model.D[i, j]), float(dead))


def _stretched(A: Array, B: Array, C: Array, lag: float) -> tuple[Array, Array, Array]:
    """The same with all time constants multiplied; poles that belong to no lag stay."""
    if lag == 1.0 or not len(A):
        return A, B, C
    from scipy.linalg import expm, logm

    A, T, count = apart(
        A, lambda pole: abs(pole) > SLOWEST_FREE and (pole.real > 0 or abs(pole.imag) > SLOWEST_FREE)
    )
    B, C = np.linalg.solve(T, B), C @ T
    if count:
        # Over one sample with an input held: exp(F) = [[A, B], [0, 1]], and time runs by 1 / lag of it.
        held = np.eye(count + 1)
        held[:count, :count], held[:count, count] = A[:count, :count], B[:count]
        slowed = np.real(expm(np.real(logm(held)) / lag))
        A[:count, :count], B[:count] = slowed[:count, :count], slowed[:count, count]
    return A, B, C
