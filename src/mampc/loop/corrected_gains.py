"""Models whose gains are corrected, input by input and output by output, and which corrections there can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.loop.disturbances import response_within_reach
from mampc.program.sample import Indices
from mampc.systems.state_space import StateSpace

CLEARLY = 3.0  # by which the log-likelihood has to rise
SURELY = 8.0  # by which it has to rise in a loop, where it is asked at every sample
MOST = 0.5  # share of a gain beyond which the model is not one to correct
OFF_TIME = 0.5  # samples later or sooner, beside a deviation, from which on times of the model count as off
FEWEST = 60  # samples between corrections, and of all records together
ALIKE = 20.0  # condition of the gains, inputs and outputs scaled alike, from which on inputs are redundant


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


def another_model(model: StateSpace, factors: Array) -> str:
    """Why gains with these factors, (l, m), are those of another model and not corrected ones; empty if they are not.

    None changes by more than `MOST`, and what all inputs together do to the outputs neither turns round nor becomes
    what fewer inputs could do as well.
    """
    names, gain = model.names, response_within_reach(model)
    if not np.abs(factors - 1).max() <= MOST:
        i, j = divmod(int(np.abs(factors - 1).argmax()), model.n_inputs)
        return (
            f"that from {names.inputs[j]} to {names.outputs[i]} would become {factors[i, j]:.2f} times itself"
        )
    if not np.linalg.det(_alike(gain).T @ _alike(factors * gain)) > 0:
        return "all together they would act the other way round"
    if not np.linalg.cond(_alike(factors * gain)) < ALIKE:
        return "inputs could stand in for each other"
    return ""


def another_time(model: StateSpace, delay: Array, deviation: Array) -> str:
    """Why inputs act at other times than in the model, which gains cannot correct; empty if they do not.

    Args:
        model: of the plant.
        delay: samples by which each output answers each input later, shape (l, m).
        deviation: standard deviations of these, shape (l, m).
    """
    sure = np.abs(delay) - deviation
    if not sure.max() > OFF_TIME:
        return ""
    i, j = divmod(int(sure.argmax()), model.n_inputs)
    when, names = "later" if delay[i, j] > 0 else "sooner", model.names
    return (
        f"{names.outputs[i]} answers {names.inputs[j]} by {abs(delay[i, j]):.1f} samples {when} than in the model, "
        f"give or take {deviation[i, j]:.1f}"
    )


def require_apart(model: StateSpace, noise: Array) -> None:
    """Inputs that can stand in for each other have no gains of their own to learn; raises `MampcError`."""
    condition = np.linalg.cond(_alike(response_within_reach(model) / noise[:, None]))
    if model.n_inputs > model.n_outputs or not condition < ALIKE:
        raise MampcError(
            f"learn_gains: expected inputs that act each in a way of its own, received {model.n_inputs} inputs and "
            f"{model.n_outputs} outputs with gains of condition {condition:.0f}: where inputs can stand "
            "in for each other a record does not tell whose gain is off"
        )


def _alike(gain: Array) -> Array:
    """Gains (l, m) with rows and columns of length one."""
    for _ in range(20):
        for axis in (0, 1):
            size = np.linalg.norm(gain, axis=axis, keepdims=True)
            gain = gain / np.where(size > 0, size, 1.0)
    return gain
