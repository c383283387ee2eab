"""Where integrating disturbances act, so that an estimator with them leaves no offset.

A disturbance at an output that a slow mode moves can hardly be told from that mode, and not at all from an
integrator: what loads do must then enter through the inputs. Elsewhere disturbances at the outputs are the
simplest and recover fastest from what happens there.

Source: Pannocchia and Rawlings, AIChE Journal 49 (2003).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array
from mampc.systems.modes import apart
from mampc.systems.state_space import StateSpace

REACH = 20  # samples within which an input shows what it does, for estimators that filter over up to ten
RUNAWAY = 1.01  # size of the poles from which a response within reach says more of them than of the input
SLOW = 0.025  # distance from one, of the poles of modes that a load must be seen to enter
_NOTHING = 1e-6  # of the largest: a direction in which inputs do nothing


@dataclass(frozen=True, eq=False)
class Directions:
    """How integrating disturbances act: at the inputs (m, count) and at the outputs (l, count).

    Each column is of a size that shows in the outputs like their noise; `at_outputs` is in output units.
    """

    at_inputs: Array
    at_outputs: Array
    noise: Array

    def sizes(self, relative: Array) -> Array:
        """Per disturbance, shape (count,): the sizes `relative` to the noise (l,) of the outputs it shows in."""
        share = (self.at_outputs / self.noise[:, None]) ** 2
        at_inputs = ~share.any(axis=0)
        sizes: Array = np.sqrt(relative**2 @ share)
        return np.where(at_inputs, np.sqrt(np.mean(relative**2)), sizes)


def response_within_reach(model: StateSpace) -> Array:
    """The largest change of each output within `REACH` samples after a unit step of each input, shape (l, m).

    It is the gain of what settles within that time, and finite for what does not. A mode that runs away counts as one
    that settles as fast (its pole p as 1/p), which is what feedback at least effort makes of it.
    """
    m = model.n_inputs
    A, T, count = apart(model.A, lambda pole: abs(pole) > RUNAWAY)
    if count > 0:
        A[:count, :count] = np.linalg.inv(A[:count, :count])
        model = StateSpace(A, np.linalg.solve(T, model.B), model.C @ T, model.D, model.dt)
    response = model.step_response(model.n_states + 2 * REACH + 1)[:, :, :m]
    before = np.concatenate([np.zeros((1, *response.shape[1:])), response])[: len(response)]
    change = np.concatenate([response[:1], response[REACH:] - before[:-REACH]])
    largest = np.abs(change).argmax(axis=0)
    picked: Array = np.take_along_axis(change, largest[None], axis=0)[0]
    return picked


def input_units(reach: Array, noise: Array) -> Array:
    """Changes of the inputs, shape (m,), that show in the outputs like their noise; 0 where an input does nothing.

    Args:
        reach: of `response_within_reach`, shape (l, m).
        noise: sizes of the outputs, shape (l,).
    """
    effect = np.linalg.norm(reach / noise[:, None], axis=0) / np.sqrt(len(noise))
    return np.where(effect > 0, 1 / np.where(effect > 0, effect, 1.0), 0.0)


def state_sizes(A: Array, driven: Array, C: Array) -> Array:
    """Units of the states, shape (n,), in which the units that a model happens to have do not count.

    Each is how far what drives the states (n, inputs) takes it within `REACH` samples; where it does not, the change
    that shows in outputs C (l, n), in units of their noise, by one.
    """
    size, seen, moved, shown = np.zeros(len(A)), np.zeros(len(A)), driven, C
    for _ in range(len(A) + REACH):
        size, seen = size + np.square(moved).sum(axis=1), seen + np.square(shown).sum(axis=0)
        moved, shown = A @ moved, shown @ A
    found = (size > 0) & np.isfinite(size)
    visible = (seen > 0) & np.isfinite(seen)
    otherwise = np.where(visible, 1 / np.where(visible, seen, 1.0), 1.0)
    sizes: Array = np.sqrt(np.where(found, size, otherwise))
    return sizes


def driving_noise(driven: Array, sizes: Array) -> Array:
    """Covariance (n, n) of what drives the states: `driven` (n, inputs) by white noise, and next to nothing at each."""
    every = 1e-10 * float(np.square(driven / sizes[:, None]).sum())
    covariance: Array = driven @ driven.T + every * np.diag(sizes**2)
    return covariance


def alike(response: Array) -> Array:
    """Sizes of the outputs, shape (l,), that are alike beside what the inputs do to them; in output units.

    The logarithms of a response (l, m) are fitted by a sum of one number per output and one per input, so that
    no unit decides.
    """
    seen = response != 0
    logs = np.log(np.abs(np.where(seen, response, 1.0)))
    rows, columns = np.zeros(len(response)), np.zeros(response.shape[1])
    for _ in range(50):
        rows = np.sum((logs - columns) * seen, axis=1) / np.maximum(seen.sum(axis=1), 1)
        columns = np.sum((logs - rows[:, None]) * seen, axis=0) / np.maximum(seen.sum(axis=0), 1)
    sizes: Array = np.exp(rows)
    return sizes


def directions_of(model: StateSpace, disturbance: str, reach: Array, noise: Array, unit: Array) -> Directions:
    """The directions for `KalmanFilter.offset_free`.

    Args:
        disturbance: "auto", "output" or "input".
        reach: of `response_within_reach`, shape (l, m).
        noise, unit: sizes of outputs (l,) and of inputs (m,).
    """
    m, l = model.n_inputs, model.n_outputs
    at_outputs = Directions(np.zeros((m, l)), np.diag(noise), noise)
    if disturbance == "output":
        return at_outputs
    scaled = reach / noise[:, None] * unit
    if disturbance == "input":
        return _at_inputs(np.eye(m) if m == l else _range(scaled.T)[:, :l], scaled, unit, noise)
    _, T, count = apart(model.A, lambda pole: abs(pole - 1.0) < SLOW or abs(pole) >= 1.0)
    if count == 0:
        return at_outputs
    seen = model.C @ T[:, :count] / noise[:, None]
    seen = seen / np.maximum(np.linalg.norm(seen, axis=0), 1e-300)
    moved = seen @ np.linalg.solve(T, model.B[:, :m])[:count] * unit
    inputs, outputs = _range(moved.T), _range(seen)
    rest = _complement(outputs)
    if inputs.shape[1] >= l:
        return _at_inputs(np.eye(m) if m == l else _range(scaled.T)[:, :l], scaled, unit, noise)
    if inputs.shape[1] + rest.shape[1] < l and np.abs(np.linalg.eigvals(model.A)).max() < 1 - 1e-6:
        return at_outputs
    entering = _at_inputs(inputs, scaled, unit, noise)
    return Directions(
        np.hstack([entering.at_inputs, np.zeros((m, rest.shape[1]))]),
        np.hstack([entering.at_outputs, noise[:, None] * rest]),
        noise,
    )


def _at_inputs(combinations: Array, scaled: Array, unit: Array, noise: Array) -> Directions:
    """Combinations (m, count) of inputs in their units, made as large as noise in what they do."""
    effect = np.linalg.norm(scaled @ combinations, axis=0) / np.sqrt(len(scaled))
    sized = combinations / np.where(effect > 0, effect, 1.0)
    return Directions(unit[:, None] * sized, np.zeros((len(noise), combinations.shape[1])), noise)


def _range(matrix: Array) -> Array:
    """An orthonormal basis of the range, as columns."""
    left, size, _ = np.linalg.svd(matrix)
    return left[:, : np.count_nonzero(size > _NOTHING * max(size.max(initial=0.0), 1e-300))]


def _complement(basis: Array) -> Array:
    """An orthonormal basis of what an orthonormal one leaves."""
    return np.linalg.svd(basis)[0][:, basis.shape[1] :]
