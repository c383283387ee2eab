"""Self-triggered minimum attention by linear programs (Donkers, Tabuada and Heemels 2011, 2014).

When the inputs move, they are chosen to be held as long as possible: h is the largest of 1..h_max for which some
constant input keeps a control Lyapunov function below its decay at every sample of the hold,

    |P (x_{k+i} - x_s)|_inf <= beta rho^i |P (x_k - x_s)|_inf,    i = 1..h

and without beta at i = h, since else an input under which nothing decays might be held again and again; one linear
program per h. P comes from the closed loop of the LQ law: the real eigenvectors of a stable matrix give an
infinity norm that decays along it. Where not even h = 1 can be kept, one step of MPC is made.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Status
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.method import Plan
from mampc.program.problem import TrackingProblem
from mampc.program.sample import Sample
from mampc.program.steady import SteadyTarget
from mampc.rivals.rules import Rule

NEAR = 1e-6  # of the state's size in P at a unit input: nearer to the target there is nothing left to decay
UNREACHED = 1e-8  # of what an input of its size does to the mode that it moves the most: nothing
LASTS = 1e-3  # share that a mode keeps from sample to sample; faster ones are dead times or as good as gone


class SelfTriggered(Rule):
    """Inputs are held for as long as a Lyapunov function can be made to decay with them constant.

    Args:
        controller: what moves where the decay cannot be kept; its problem's weights give the LQ law.
        longest: h_max >= 1, samples.
        overshoot: beta >= 1, by how much the bound may start above the function.
        decay: rho below 1 per sample; None for the slowest that the LQ law keeps, and 0.99 at most.

    Raises:
        MampcError: a model that cannot be stabilised.
    """

    def __init__(
        self, controller: Controller, *, longest: int = 20, overshoot: float = 1.5, decay: float | None = None
    ) -> None:
        super().__init__(controller)
        self._longest = as_whole("longest", longest, 1, 1000)
        self._beta = as_number("overshoot", overshoot, 1.0)
        problem, model = self.problem, self.problem.model
        m = model.n_inputs
        self._P, slowest = _lyapunov_norm(problem)
        own = min(max(0.5 * (1 + slowest), 0.9), 0.99)
        self._rho = own if decay is None else as_number("decay", decay, 0.0, exclusive=True)
        if self._rho >= 1:
            raise MampcError(f"decay: expected below 1, received {decay}")
        self._target = SteadyTarget(problem, self.condensed.parameter)
        powers, sums = [np.eye(model.n_states)], [np.zeros((model.n_states, m))]
        for _ in range(self._longest):
            sums.append(model.A @ sums[-1] + model.B[:, :m])
            powers.append(model.A @ powers[-1])
        self._free, self._forced = self._P @ np.array(powers[1:]), self._P @ np.array(sums[1:])

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """The hold that was decided, as long as it lasts and the target stays; else the longest one anew."""
        p, memory = sample.parameter, state.memory
        steady = self._target.at(p)
        u, m = sample.u_previous, len(sample.u_previous)
        reference = p[self.condensed.parameter.reference.start :]
        if memory is not None and memory[0] > 0 and np.array_equal(memory[1:], reference):
            plan = self._only(np.zeros(m), Plan(None, Status.FEASIBLE, 0))
            return plan._replace(memory=np.concatenate([[memory[0] - 1], memory[1:]]))
        error = p[self.condensed.parameter.x] - steady.x
        held, chosen = self._longest_hold(error, u - steady.u, steady.u)
        if chosen is None or sample.frozen is not None:
            plan = self.controller.plan(sample, state)
            if plan.moves is None:
                return plan
            plan = self._only(plan.moves[:m], plan)
        else:
            plan = self._only(steady.u + chosen - u, Plan(None, Status.FEASIBLE, held))
        return plan._replace(memory=np.concatenate([[max(held, 1) - 1], reference]))

    def _longest_hold(self, error: Array, now: Array, u_s: Array) -> tuple[int, Array | None]:
        """h, and the input less its target that keeps the decay for so long: the applied one if it does."""
        size = float(np.abs(self._P @ error).max())
        reach = np.abs(self._forced).max()
        if size <= NEAR * max(reach, 1e-300):
            return self._longest, now
        end = size * self._rho ** np.arange(1, self._longest + 1)
        level, drift = self._beta * end, self._free @ error

        def kept(v: Array) -> int:
            largest = np.abs(drift + self._forced @ v).max(axis=1)
            beyond = np.flatnonzero(largest > level)
            within = beyond[0] if len(beyond) else len(level)
            holds = np.flatnonzero(largest[:within] <= end[:within])
            return int(holds[-1]) + 1 if len(holds) else 0

        best, chosen = kept(now), now
        if best == self._longest:
            return best, chosen
        low, high = max(best, 0), self._longest
        found: Array | None = chosen if best else None
        while low < high:
            middle = (low + high + 1) // 2
            v = self._program(drift[:middle], np.append(level[: middle - 1], end[middle - 1]), u_s)
            if v is None:
                high = middle - 1
            else:
                low, found = middle, v
        return low, found

    def _program(self, drift: Array, level: Array, u_s: Array) -> Array | None:
        """An input less its target that keeps |drift + forced v| <= level, the smallest; None if there is none."""
        from scipy.optimize import linprog

        h, n, m = len(level), self._forced.shape[1], self._forced.shape[2]
        rows = self._forced[:h].reshape(h * n, m)
        scale = np.repeat(level, n)
        limits = self.problem.limits
        low, high = limits.u_min - u_s, limits.u_max - u_s
        A = np.vstack([rows, -rows]) / np.tile(scale, 2)[:, None]
        b = np.concatenate([1 - drift.ravel() / scale, 1 + drift.ravel() / scale])
        # With t: the largest share of its level that anything takes.
        A = np.hstack([A, -np.ones((len(A), 1))])
        solution: Any = linprog(
            np.concatenate([np.zeros(m), [1.0]]), A_ub=A, b_ub=b - 1,
            bounds=[*zip(low, high, strict=True), (None, None)], method="highs",
        )  # fmt: skip
        if solution.status != 0 or solution.x[-1] > 1.0:
            return None
        return np.asarray(solution.x[:m])


def _lyapunov_norm(problem: TrackingProblem) -> tuple[Array, float]:
    """P of an infinity norm |P x| that decays along the LQ law's closed loop, and its rate.

    One row a mode that inputs reach; what is left of the modes, such as a load that fades, no input decides. Rows are
    in units of the LQ cost that a mode alone would have, the same whatever the units of states and signals.
    """
    from scipy.linalg import solve_discrete_are

    model = problem.model
    A, B = model.A, model.B[:, : model.n_inputs]
    Q = model.C.T @ problem.output_weight @ model.C
    Q = Q + 1e-6 * max(np.trace(Q), 1e-300) / len(Q) * np.eye(len(Q))
    try:
        S = solve_discrete_are(A, B, Q, problem.move_weight)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise MampcError(
            f"SelfTriggered: expected a model that an LQ law stabilises, received one with: {error}"
        ) from None
    closed = A - B @ np.linalg.solve(problem.move_weight + B.T @ S @ B, B.T @ S @ A)
    values, vectors = np.linalg.eig(closed)
    unit = 1 / np.sqrt(np.diag(B.T @ S @ B) + np.diag(problem.move_weight))
    left = _unreached(A, B * unit)
    reached = np.abs(left @ vectors).max(axis=0, initial=0.0) <= UNREACHED * np.abs(left).max(initial=0.0)
    slowest = float(np.abs(values[reached]).max(initial=0.0))
    # Complex pairs as their real and imaginary parts: their norm decays by |Re| + |Im| a sample.
    columns = [
        vectors[:, i].real if value.imag >= 0 else vectors[:, i].imag for i, value in enumerate(values)
    ]
    V = np.array(columns).T
    if np.linalg.cond(V) <= 1e10:
        cost = np.sqrt(np.maximum(np.einsum("in,ij,jn->n", vectors.conj(), S, vectors).real, 0.0))
        return (cost[:, None] * np.linalg.inv(V))[reached], slowest
    # A defective closed loop: the square root of its Lyapunov function instead.
    from mampc.program.tail import square_root

    own = vectors[:, ~reached]
    if len(left) != own.shape[1]:
        raise MampcError("SelfTriggered: expected a model whose inputs reach all of its lasting modes")
    P = square_root(S) @ (np.eye(len(A)) - (own @ np.linalg.solve(left @ own, left)).real)
    return P, slowest


def _unreached(A: Array, B: Array) -> Array:
    """Left eigenvectors of the lasting modes that inputs do not reach, one a row."""
    values, vectors = np.linalg.eig(A.T)
    reach = np.abs(vectors.T @ B).max(axis=1, initial=0.0)
    unreached = (reach <= UNREACHED * reach.max(initial=0.0)) & (np.abs(values) > LASTS)
    left: Array = vectors.T[unreached]
    return left
