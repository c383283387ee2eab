"""The way back of inputs that are outside their limits, after manual operation or where limits became narrower.

They go inside at once, whatever `du_max` says, and plans start from there. The way back is a move like any other:
it stands in the window of the rules as the latest one, and in the plan as part of the first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.words import Remark, Status
from mampc.controllers.decision import ControllerState
from mampc.methods.method import Plan
from mampc.program.condensing import CondensedQP
from mampc.program.limits_now import LimitsNow, UsualLimits
from mampc.program.sample import Sample


class WayBack(NamedTuple):
    """Where plans start once the inputs are back.

    Attributes:
        state: as if the inputs inside had been the last ones applied.
        sample: the data of the sample from there.
        change: of each input on its way back, shape (m,).
    """

    state: ControllerState
    sample: Sample
    change: Array

    def joined(self, plan: Plan) -> Plan:
        """The plan from inside, with the way back as a part of its first moves; nothing is proven of the whole."""
        if plan.moves is None:
            return plan
        moves, inside = plan.moves.copy(), self.state.inputs[-1:]
        # Sums in this order leave an input that does not move any more exactly where it is.
        inputs = np.concatenate((inside, plan.moves.reshape(-1, len(self.change)))).cumsum(axis=0)[1:]
        moves[: len(self.change)] += self.change
        return plan._replace(
            moves=moves,
            status=Status.FEASIBLE if plan.status is Status.OPTIMAL else plan.status,
            lower_bound=-np.inf,
            inputs=inputs,
            objective=None,
            remarks=(*plan.remarks, Remark.BACK_INSIDE),
        )


def way_back(
    state: ControllerState, sample: Sample, limits: UsualLimits | LimitsNow, condensed: CondensedQP
) -> WayBack:
    """The way back of the inputs that were applied last."""
    applied, problem = state.inputs[-1], condensed.problem
    inside = limits.inputs.nearest(applied)
    change = inside - applied
    parameter = sample.parameter.copy()
    parameter[condensed.parameter.u_previous] = inside
    parameter[condensed.parameter.u_deviation] = inside - problem.model.u_op
    frozen = sample.frozen
    # Where moves are limited the way back is all that an input moves by at once.
    spent = (change != 0) & np.isfinite(problem.limits.du_max)
    if spent.any():
        frozen = np.maximum(0 if frozen is None else frozen, spent.astype(np.intp))
    remembered = np.concatenate([state.inputs[1:], inside[None]])
    return WayBack(
        state._replace(inputs=remembered),
        limits.applied_to(condensed.sample(parameter, inside, frozen)),
        change,
    )
