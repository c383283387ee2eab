"""How large an offset a price can leave for good, and the price that follows from it where nothing is simulated.

In steady state with an offset e = r - y, an exact controller that does not move now costs at least (L + 1) |e|^2_Q, L
being the `tail_horizon`: it holds, which costs (np + 1 + L) |e|^2_Q, or it plans to move later; and then the same
plan one sample earlier would cost no less only if the offset at its end were no smaller than e, so that its
tail alone costs L |e|^2_Q. Moving every input to its target at once costs the prices of all inputs and e' M e, M being
the transient. What the optimum does not remove therefore satisfies

    e' ((L + 1) Q - M) e <= sum of prices.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, as_instance
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.problem import TrackingProblem
from mampc.program.tail import square_root

HIGHEST_PRICE = 1 / 16  # of what moves save after a change: changes of a quarter of it are still worth them
LEFT = 0.5  # of a change of reference: the largest offset that a price may leave for good


def largest_offset(problem: TrackingProblem, rules: MoveRules) -> Array:
    """The largest offset of each output, shape (l,), that the price can leave for good, in output units.

    It holds for `method="exact"` in steady state, model and disturbances constant, wherever limits leave room to
    remove the offset. It is infinite where nothing is promised: the tail horizon is short against the transient,
    the model has fewer inputs than outputs (or poles at one), inputs have targets or a cost, outputs a zone, or the
    rules may forbid to move all inputs at once (`max_moves`, `max_moves_per_step`), by less than `min_size`, or at any
    sample (`blocks`).
    """
    problem = as_instance("problem", problem, TrackingProblem)
    rules = as_instance("rules", rules, MoveRules)
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
    condensed = CondensedQP(problem)
    residual = condensed.error_of_reference - condensed.weighted_theta[:, :m] @ to_target
    M = residual.T @ residual + to_target.T @ condensed.R[:m, :m] @ to_target
    kept = (L + 1) * problem.output_weight - M
    if not np.linalg.eigvalsh(kept)[0] > 0:
        return nothing
    offset: Array = np.sqrt(admissible.charge(all_at_once) * np.diag(np.linalg.inv(kept)))
    return offset


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

    It leaves at most half of a change for good where `largest_offset` promises anything. `mampc.tune` finds prices by
    simulation instead.
    """
    price = HIGHEST_PRICE * min(largest_saving(CondensedQP(problem), change) for change in changes)
    price /= problem.model.n_inputs
    offset = largest_offset(problem, MoveRules(price=price))
    asked = np.where(changes != 0, np.abs(changes), np.inf).min(axis=0)
    share = offset[np.isfinite(asked)] / asked[np.isfinite(asked)]
    if np.isfinite(share).all() and share.max() > LEFT:
        price *= float(LEFT / share.max()) ** 2
    return float(f"{price:.2g}")
