"""How large an offset a price can leave for good, and the price that follows from it where nothing is simulated.

In steady state with an offset e = r - y, an exact controller that does not move now costs at least (L + 1) |e|^2_Q, L
being the `tail_horizon`: it holds, which costs (np + 1 + L) |e|^2_Q, or it plans to move later; and then the same
plan one sample earlier would cost no less only if the offset at its end were no smaller than e, so that its
tail alone costs L |e|^2_Q. Moving every input to its target at once costs the prices of all inputs and e' M e, M being
the transient. What the optimum does not remove therefore satisfies

    e' ((L + 1) Q - M) e <= sum of prices.

Where plans count on later data, a pattern S costs c(S), its price and what it forgoes of these, and waiting may gain:
the same plan one sample earlier, S', forgoes more. Then the tail of a plan that waits costs L (|e|^2_Q + c(S) - b(S'))
at least, b(S') being the least that S' or a pattern with more moves costs, and with F for the first moves of all
inputs,

    e' ((L + 1) Q - M) e <= max_S b(F) - c(S) + L (b(S') - c(S))

over all patterns S without moves now. Without later data this is the sum of prices again.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray, as_instance
from mampc.controllers.controller import Controller
from mampc.controllers.mampc import MAMPC
from mampc.controllers.mpc import MPC
from mampc.methods.exact.search import Exact
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.information import InformationNow
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.problem import TrackingProblem
from mampc.program.tail import square_root

HIGHEST_PRICE = 1 / 16  # of what moves save after a change: changes of a quarter of it are still worth them
FEW = 15  # planned moves, up to which all patterns are listed beside later data
LEFT = 0.5  # of a change of reference: the largest offset that a price may leave for good


def largest_offset(problem: TrackingProblem, rules: MoveRules) -> Array:
    """The largest offset of each output, shape (l,), that the price can leave for good, in output units.

    It holds for `method="exact"` in steady state, model and disturbances constant, wherever limits leave room to
    remove the offset, and plans that do not count on later data; `Regulator.largest_offset` is that of plans as a
    regulator makes them. It is infinite where nothing is promised: the tail horizon is short against the transient,
    the model has fewer inputs than outputs (or poles at one), inputs have targets or a cost, outputs a zone, or the
    rules may forbid to move all inputs at once (`max_moves`, `max_moves_per_step`), by less than `min_size`, or at any
    sample (`blocks`).
    """
    problem = as_instance("problem", problem, TrackingProblem)
    return _offset(problem, as_instance("rules", rules, MoveRules), None, None)


def offset_of(controller: Controller, hypotheses: Array | None) -> Array:
    """`largest_offset` of a controller, whose plans count on later data with these weights of hypotheses.

    Their shape is (B,); None for loads that are steady.
    """
    if type(controller) is MAMPC and not controller.is_plain and isinstance(controller.method, Exact):
        information, later_data = controller.information, None
        if information is not None:
            later_data = information.steady if hypotheses is None else information.at(hypotheses)
        return _offset(controller.problem, controller.rules, controller.condensed, later_data)
    if type(controller) is MPC or (type(controller) is MAMPC and controller.is_plain):
        return _offset(controller.problem, MoveRules(), controller.condensed, None)
    return np.full(controller.problem.model.n_outputs, np.inf)


def _offset(
    problem: TrackingProblem,
    rules: MoveRules,
    condensed: CondensedQP | None,
    later_data: InformationNow | None,
) -> Array:
    model, L = problem.model, problem.tail_horizon
    m, l = model.n_inputs, model.n_outputs
    admissible = AdmissiblePatterns(rules, m, problem.control_horizon)
    nothing = np.full(l, np.inf)
    all_at_once = np.zeros(admissible.n_moves, dtype=bool)
    all_at_once[:m] = True
    unmoved = admissible.allowance(np.zeros((rules.memory, m)))
    promised = (
        admissible.allows(all_at_once, unmoved)
        and not (admissible.sized or admissible.on_levels)
        and rules.blocks is None
    )
    stable = np.max(np.abs(np.linalg.eigvals(model.A)), initial=0.0) < 1 - 1e-9
    if not promised or not stable or m < l or problem.prices_inputs or problem.zoned.any():
        return nothing
    weighted = square_root(problem.output_weight)
    gain = weighted @ model.dc_gain()[:, :m]
    unit = np.linalg.norm(gain, axis=0)
    unit = np.where(unit > 0, 1 / np.where(unit > 0, unit, 1.0), 0.0)  # so that no input's unit counts
    if np.linalg.matrix_rank(gain * unit) < l:
        return nothing
    to_target = unit[:, None] * np.linalg.pinv(gain * unit) @ weighted  # moves per unit of offset
    condensed = CondensedQP(problem) if condensed is None else condensed
    residual = condensed.error_of_reference - condensed.weighted_theta[:, :m] @ to_target
    M = residual.T @ residual + to_target.T @ condensed.R[:m, :m] @ to_target
    kept = (L + 1) * problem.output_weight - M
    if not np.linalg.eigvalsh(kept)[0] > 0:
        return nothing
    charge = admissible.charge(all_at_once)
    if later_data is not None:
        charge = _of_waiting(admissible, all_at_once, later_data, L)
    offset: Array = np.sqrt(charge * np.diag(np.linalg.inv(kept)))
    return offset


def _of_waiting(
    admissible: AdmissiblePatterns, first: BoolArray, later_data: InformationNow, L: float
) -> float:
    """The right-hand side of the bound; see the module. `first`: the first moves of all inputs, shape (n_moves,)."""
    m, n = admissible.n_inputs, admissible.n_moves
    if n > FEW:  # b(S') - c(S) is at most what no moves forgo, and b(F) - c(S) at most c(F)
        nothing = np.zeros(n, dtype=bool)
        return admissible.charge(first) + later_data.charge(first) + L * later_data.charge(nothing)
    patterns = (np.arange(2**n)[:, None] >> np.arange(n)) & 1 == 1
    cost = np.full(2**n, np.inf)
    listed = admissible.listed(2**n)
    assert listed is not None
    place = listed @ 2 ** np.arange(n)
    cost[place] = admissible.charges(listed) + later_data.each(listed)
    least = cost.copy()  # of a pattern and all with more moves
    for i in range(n):
        without = ~patterns[:, i]
        least[without] = np.minimum(least[without], least[patterns[:, i]])
    waiting = place[~listed[:, :m].any(axis=1)]
    sooner = waiting >> m
    gained = least[first @ 2 ** np.arange(n)] - cost[waiting] + L * (least[sooner] - cost[waiting])
    return float(gained.max())


def largest_saving(condensed: CondensedQP, change: Array) -> float:
    """The most cost that any moves can save in steady state after the reference changes by `change`, shape (l,).

    It is what the optimum without limits and prices saves of the cost of holding the inputs. Where a single move
    is priced higher, none is ever made.
    """
    held = condensed.error_of_reference @ change
    theta = condensed.weighted_theta
    H = theta.T @ theta + condensed.R
    size = np.sqrt(np.diag(H))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)  # so that no input's unit counts
    g = unit * (theta.T @ held)
    return float(g @ np.linalg.lstsq(unit[:, None] * H * unit, g)[0])


def highest_price(problem: TrackingProblem, changes: Array) -> float:
    """A price that pays after every change of the reference, rows of (k, l), to two digits.

    It leaves at most half of a change for good where `largest_offset` promises anything; plans that count on later data
    may leave more. `mampc.tune` finds prices by simulation instead.
    """
    price = HIGHEST_PRICE * min(largest_saving(CondensedQP(problem), change) for change in changes)
    price /= problem.model.n_inputs
    offset = largest_offset(problem, MoveRules(price=price))
    asked = np.where(changes != 0, np.abs(changes), np.inf).min(axis=0)
    share = offset[np.isfinite(asked)] / asked[np.isfinite(asked)]
    if np.isfinite(share).all() and share.max() > LEFT:
        price *= float(LEFT / share.max()) ** 2
    return float(f"{price:.2g}")
