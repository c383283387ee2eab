"""l0 on the inputs at each instant (Aguilera et al. 2014, 2017): at most s of m inputs differ from their steady target.

A pattern problem in v = u - u_s with one pattern a sample. More non-zero entries never cost more, so the patterns with
exactly s at every sample are enough; they are taken best bound first, the bound being the optimum without limits, and
a program is solved only where that optimum breaks a limit. The optimum is exact. It says nothing of moves.
"""

from __future__ import annotations

from itertools import combinations, product
from math import comb

import numpy as np

from mampc.base.checks import as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Status
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.method import HELD_BY, Plan
from mampc.program.daqp import DaqpSolver
from mampc.program.problem import TrackingProblem
from mampc.program.qp import QPStatus, QuadraticProgram
from mampc.program.sample import Sample
from mampc.program.steady import SteadyTarget

MOST_PATTERNS = 5000
ROUNDED = 1e-12  # of the size of an input: a change that is none


class SparseInputs(Controller):
    """MPC in which at most `most` inputs differ from their steady target at every sample of the horizon.

    Args:
        problem: see `TrackingProblem`.
        most: s, 1 <= s <= m.

    Raises:
        MampcError: more patterns than a table holds: C(m, s)^nc.
    """

    starts_inside = True

    def __init__(self, problem: TrackingProblem, *, most: int) -> None:
        super().__init__(problem)
        m, n_c = problem.model.n_inputs, problem.control_horizon
        self._most = as_whole("most", most, 1, m)
        count = comb(m, self._most) ** n_c
        if count > MOST_PATTERNS:
            raise MampcError(
                f"most: expected at most {MOST_PATTERNS} patterns, received C({m}, {self._most})^{n_c} = {count}; "
                "shorten the control horizon"
            )
        choices = [np.isin(np.arange(m), chosen) for chosen in combinations(range(m), self._most)]
        self._patterns = [np.concatenate(rows) for rows in product(choices, repeat=n_c)]
        self._target = SteadyTarget(problem, self.condensed.parameter)
        n = self.condensed.n_moves
        self._difference = np.linalg.inv(self.condensed.cumulate)  # d = difference (v - v_previous)
        self._moving = self.condensed.U @ self._difference
        self._factors = [np.linalg.qr(self._moving[:, pattern]) for pattern in self._patterns]
        self._solvers: dict[int, DaqpSolver] = {}
        self._n = n

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """The best plan of all patterns, best bound first."""
        if sample.frozen is not None:  # plain MPC while inputs are in manual
            return self._unrestricted(sample, state)
        condensed, v = self.condensed, self.condensed.n_violations
        u_s = self._target.at(sample.parameter).u
        start = np.tile(sample.u_previous - u_s, self.problem.control_horizon)
        target = sample.target + self._moving @ start
        missed = [target - Q @ (Q.T @ target) for Q, _ in self._factors]
        bounds = np.array([rest @ rest for rest in missed])
        best, least, failure, solved = None, np.inf, QPStatus.INFEASIBLE, 0
        for index in np.argsort(bounds, kind="stable").tolist():
            if bounds[index] >= least:
                break
            pattern, (Q, R) = self._patterns[index], self._factors[index]
            inputs = np.zeros(self._n)
            inputs[pattern] = np.linalg.solve(R, Q.T @ target)
            moves = self._difference @ (inputs - start)
            rows = condensed.bounds.of_moves @ moves
            if v or (rows < sample.lower[v:]).any() or (rows > sample.upper[v:]).any():
                solver, columns = self._solver_on(index), condensed.program
                solver.start()
                # d = difference (v_S - start): the program in (violations, v_S)
                offset = self._difference @ start
                shift = condensed.program.A[:, v:] @ offset
                f = np.concatenate([
                    sample.f[:v],
                    (self._difference.T @ (sample.f[v:] - condensed.H @ offset))[pattern],
                ])  # fmt: skip
                n_simple = columns.n_simple
                low, high = sample.lower.copy(), sample.upper.copy()
                low[v:n_simple] += offset[: n_simple - v]
                high[v:n_simple] += offset[: n_simple - v]
                low[n_simple:] += shift
                high[n_simple:] += shift
                solution = solver.solve(f, low, high)
                solved += 1
                if solution.z is None:
                    failure = solution.status
                    continue
                inputs = np.zeros(self._n)
                inputs[pattern] = solution.z[v:]
                moves = self._difference @ (inputs - start)
            cost = condensed.cost(sample, moves) - sample.cost
            if cost < least:
                best, least = moves, cost
        if best is None:
            return Plan(None, HELD_BY[failure], solved)
        each = best.reshape(-1, self.problem.model.n_inputs)  # what is rounding beside the input's own values
        size = np.maximum(np.abs(start.reshape(each.shape)), np.abs(each)).max(axis=0)
        each[np.abs(each) <= ROUNDED * size] = 0.0
        return Plan(best, Status.OPTIMAL, solved, None)

    def _solver_on(self, index: int) -> DaqpSolver:
        """The program on one pattern, in (violations, the free entries of v)."""
        if index not in self._solvers:
            full, v, pattern = self.condensed.program, self.condensed.n_violations, self._patterns[index]
            to_moves = self._difference[:, pattern]
            moving = self._moving[:, pattern]
            k = moving.shape[1]
            H = np.zeros((v + k, v + k))
            H[:v, :v], H[v:, v:] = full.H[:v, :v], 2 * moving.T @ moving
            simple = np.hstack([np.zeros((full.n_simple - v, v)), to_moves[: full.n_simple - v]])
            A = np.vstack([simple, np.hstack([full.A[:, :v], full.A[:, v:] @ to_moves])])
            self._solvers[index] = DaqpSolver(QuadraticProgram(H, A, v))
        return self._solvers[index]
