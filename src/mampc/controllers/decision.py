"""What a controller answers at every sample, and what it remembers until the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.identity import equal_only_to_itself
from mampc.base.words import Fault, LoadKind, Remark, Status


@equal_only_to_itself
class ControllerState(NamedTuple):
    """What a controller remembers: plain numbers, safe to copy and pickle. Equal only to itself.

    Attributes:
        inputs: the inputs applied so far, oldest first, shape (h, m); the last row is u_{k-1}.
        samples: how many samples have been decided.
        guess: a method's starting point for the next sample, shape (nc, m), or None.
        active: bounds that held the last plan of plain MPC with many moves, where the solver starts, (n_bounds,), or
            None. It is kept here and not in the solver so that equal states lead to equal decisions, to the bit.
        memory: what a rule of `mampc.rivals` remembers, one vector, or None.
    """

    inputs: Array
    samples: int = 0
    guess: Array | None = None
    active: Array | None = None
    memory: Array | None = None


@equal_only_to_itself
class Decision(NamedTuple):
    """One sample's decision, in engineering units; its arrays are read-only. Equal only to itself.

    Attributes:
        u: inputs to apply now, shape (m,); always finite and within the input limits.
        plan: planned inputs, shape (nc, m): the last inputs applied and the sum of `changes`. Its first row is `u`, but
            for inputs in manual that are held outside their limits: these are planned where they are. Where a
            `Regulator` knows its valves, plan and changes are those of the stems.
        changes: planned moves du, shape (nc, m); with an exact pattern (polish) zero off it.
        status: how the decision came about.
        objective: cost of the plan: tracking over i = 0..np, move weights over j = 0..nc-1, output-limit
            penalty, price of the planned moves, and for plans that count on later data what their pattern forgoes of
            these (`moves.information`); not-a-number where nothing was solved.
        lower_bound: no admissible plan costs less; minus infinity where nothing is proven.
        iterations: solver iterations (MPC; 1 where inputs that may not move are left out) or rounds of the method.
        solve_time: seconds from call to answer.
        state: the controller's state for the next sample.
        remarks: anything else worth knowing.
        violations: predicted excess of each output over its limits, the largest over i = 1..np, in output
            units, shape (l,); zeros without output limits, not-a-number where nothing could be predicted.
        resolution: changes up to here are rounding and no moves, in input units, shape (m,): 1e-9 for inputs of
            ordinary numbers.
        ignored_outputs: outputs whose measurement was not believed at this sample, by name, and why; filled by
            `Regulator`.
        load: what unmeasured loads seem to do, where the estimator asks; filled by `Regulator`.
        variant: which controller of a `ControllerBank` decided; else None.
    """

    u: Array
    plan: Array
    changes: Array
    status: Status
    objective: float
    lower_bound: float
    iterations: int
    solve_time: float
    state: Any
    remarks: tuple[Remark, ...]
    violations: Array
    resolution: Array
    ignored_outputs: Mapping[str, Fault] = {}
    load: LoadKind | None = None
    variant: str | None = None

    @property
    def gap(self) -> float:
        """objective - lower_bound, in units of cost: 0 when proven optimal, infinite without a bound."""
        gap = self.objective - self.lower_bound
        return max(0.0, gap) if gap == gap else np.inf

    @property
    def moves(self) -> BoolArray:
        """Which planned changes are moves (larger than rounding), shape (nc, m)."""
        moves: BoolArray = np.abs(self.changes) > self.resolution
        return moves

    @property
    def held(self) -> bool:
        """True when nothing could be planned and the previous inputs are held."""
        return self.status.held

    def __repr__(self) -> str:
        words = [f"u={np.array2string(self.u, precision=6, threshold=8)}", str(self.status)]
        words.append(f"{np.count_nonzero(self.moves)} of {self.moves.size} moves")
        if not self.held:
            words.append(f"objective={self.objective:.6g}")
            words.append("no bound" if self.gap == np.inf else f"gap={self.gap:.3g}")
        words += [str(remark) for remark in self.remarks]
        if self.variant is not None:
            words.append(f"variant={self.variant}")
        words += [f"{name} {fault}" for name, fault in self.ignored_outputs.items()]
        return f"Decision({', '.join(words)})"
