"""Estimators of a plant whose model changes while the loop runs: made anew, and begun where the last one was.

The models have the same A and B, so that states go on; C and D differ. Estimated outputs stay as they are: what the
states show in them otherwise is taken for loads that last.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.loop.estimator import Estimate, Estimator
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.loop.mixing import bank_estimate
from mampc.systems.state_space import StateSpace


def made_anew(estimator: Estimator, model: StateSpace) -> KalmanFilter | LoadBank:
    """The same estimator for another model of the same signals; raises `MampcError` where there is none."""
    if type(estimator) is LoadBank:
        return LoadBank(
            model, noise=estimator.noise, guessed=estimator.guessed, hypotheses=estimator.hypotheses
        )
    if isinstance(estimator, KalmanFilter) and estimator.settings is not None:
        return KalmanFilter.offset_free(model, **estimator.settings)
    raise MampcError(
        "estimator: expected a LoadBank or what KalmanFilter.offset_free makes, which can be made for another model, "
        f"received another {type(estimator).__name__}"
    )


def taken_over(estimate: Estimate, before: Estimator, after: Estimator, u: Array, v: Array) -> Estimate:
    """An estimate of one estimator as one of another, which `made_anew` made of it.

    Args:
        estimate: of `before`.
        before, after: the estimators.
        u: inputs applied last, shape (m,).
        v: measured disturbances, shape (d,).
    """
    if isinstance(before, LoadBank) and isinstance(after, LoadBank):
        return _of_bank(estimate, before, after, u, v)
    assert isinstance(before, KalmanFilter)
    assert isinstance(after, KalmanFilter)
    return _of_filter(estimate, before, after, u, v)


def _of_filter(estimate: Estimate, before: KalmanFilter, after: KalmanFilter, u: Array, v: Array) -> Estimate:
    nothing, model = np.zeros(len(before.C)), after.model
    off = after.innovation(estimate, u, nothing, v) - before.innovation(estimate, u, nothing, v)
    rest = after.initial(model.u_op, model.y_op + off, model.v_op)
    return Estimate(
        estimate.x + rest.x,
        estimate.output_disturbance + rest.output_disturbance,
        estimate.input_disturbance + rest.input_disturbance,
    )


def _of_bank(estimate: Estimate, before: LoadBank, after: LoadBank, u: Array, v: Array) -> Estimate:
    bank, model, n = bank_estimate(estimate), after.model, after.model.n_states
    change = np.concatenate([u, v]) - model.all_inputs_op
    # The same loads in other sizes.
    sizes = [np.vstack([loads.at_inputs, loads.at_outputs]) for loads in (before.loads, after.loads)]
    units = np.abs(sizes[0]).max(axis=1, keepdims=True)
    units[units == 0] = 1.0
    resized = np.linalg.lstsq(sizes[1] / units, sizes[0] / units)[0]
    x, w, s = np.split(bank.members, [n, n + before.loads.count], axis=1)
    members = np.hstack([x, w @ resized.T, s @ resized.T])
    off = before.seen(bank.members) - after.seen(members) + (before.model.D - model.D) @ change
    for member, more in zip(members, off, strict=True):
        rest = np.concatenate(after.loads.at_rest(model.all_inputs_op, model.y_op + more))
        member[: len(rest)] += rest
    plain = _of_filter(before.plain_of(bank), before.plain, after.plain, u, v)
    return after.with_parts(bank, members, plain)
