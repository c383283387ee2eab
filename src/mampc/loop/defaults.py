"""What a regulator estimates with unless it is told.

Where moves cost something or are few, each one made for noise, or late for a load, counts: there a `LoadBank` makes the
better use of them, and plans count on what later measurements will tell. Plain MPC moves at every sample anyway, a rule
around it is what one would use instead, and the paper's method stays as it is published: these have a `KalmanFilter`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.errors import MampcError
from mampc.controllers.bank import ControllerBank
from mampc.controllers.controller import Controller
from mampc.controllers.mampc import MAMPC
from mampc.controllers.offset import FEW
from mampc.loop.doubt import runs_away
from mampc.loop.estimator import Estimator
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.methods.alternating import Alternating
from mampc.methods.exact.search import Exact

FEW_SIZED = 12  # planned moves with least sizes, up to which all patterns are soon searched


def has_scarce_moves(controller: Controller) -> bool:
    """Whether a controller, or each of its variants, prices or bounds moves by another method than the paper's."""
    return all(
        type(one) is MAMPC and not one.is_plain and not isinstance(one.method, Alternating)
        for one in controller.each
    )


def default_estimator(controller: Controller, noise: Any = None) -> Estimator:
    """What a regulator estimates with unless told otherwise.

    A `LoadBank` where `has_scarce_moves` and there are sizes of the noise: `noise`, the model's own, or a guess from
    limits of all inputs. Else, or where the model's numbers allow no bank, `KalmanFilter.offset_free`.

    Args:
        controller: of the regulator.
        noise: standard deviation of the measurement noise of each output, scalar or (l,), where it is known.
    """
    if has_scarce_moves(controller):
        try:
            return LoadBank.for_problem(controller.problem, noise=noise)
        except MampcError:
            pass
    return KalmanFilter.offset_free(controller.problem.model, measurement_noise=noise)


def counts_on_later_data(controller: Controller, estimator: Estimator) -> bool:
    """Whether plans count on later measurements unless told otherwise.

    They do with a `LoadBank` where moves have a price and what these will tell is known: for the exact search of a few
    moves, about set points. A plant that runs away cannot wait.
    """
    priced = [one for one in controller.each if type(one) is MAMPC and not one.is_plain]
    return (
        isinstance(estimator, LoadBank)
        and bool(priced)
        and all(_knows_what_they_tell(one) for one in priced)
        and not runs_away(controller.problem.model)
    )


def _knows_what_they_tell(controller: MAMPC) -> bool:
    rules = controller.rules
    return bool(
        isinstance(controller.method, Exact)
        and controller.condensed.n_moves <= (FEW_SIZED if np.any(rules.min_size) else FEW)
        and np.min(rules.price) > 0
        and rules.levels is None
        and not controller.problem.zoned.any()
    )


def with_information(planner: Controller, estimator: Estimator, price_follows_noise: bool) -> Controller:
    """The controller with plans that count on later data.

    Raises:
        MampcError: another controller than `MAMPC`, or an estimator that does not know its noise in output units.
    """
    if type(planner) not in (MAMPC, ControllerBank) or not any(type(one) is MAMPC for one in planner.each):
        raise MampcError(
            f"value_of_information: expected a controller MAMPC, or a bank of them, received {type(planner).__name__}"
        )
    assert isinstance(planner, MAMPC | ControllerBank)
    shifts = estimator.shifts(planner.problem.control_horizon - 1)
    if shifts is None:
        raise MampcError(
            "value_of_information: expected an estimator that knows the noise in output units, such as a LoadBank, "
            f"received {type(estimator).__name__}"
        )
    return planner.with_information(shifts, price_follows_noise=price_follows_noise)
