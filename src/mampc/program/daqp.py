"""The daqp back end: a dual active-set solver, warm-started, a few microseconds a solve at MPC sizes.

daqp (Arnström, Bemporad, Axehill, IEEE Trans. Automatic Control 67, 2022) is fast and bare. This class
stands between its sharp edges and the controllers; tests/test_qp_daqp.py has a test for each edge.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.program.qp import UNBOUNDED, QPSolution, QPStatus, QuadraticProgram

Senses = np.ndarray[tuple[int, ...], np.dtype[np.intc]]
_STATUS = {
    1: QPStatus.OPTIMAL,
    2: QPStatus.OPTIMAL,  # daqp's "soft optimal"; no soft rows are used here
    -1: QPStatus.INFEASIBLE,
    -4: QPStatus.ITERATION_LIMIT,
    -7: QPStatus.TIME_LIMIT,
}
ACTIVE_ABOVE, ACTIVE_BELOW = 1.0, 3.0  # daqp's flags: 1 for active, and 2 for at its lower bound
ROUNDING = 5e-9  # relative to the sizes of the data: how far an optimum may miss its conditions
ORDINARY = 1e8  # length of f: up to here what daqp calls an optimum is one, and only longer ones are checked
GONE = 1e18  # a bound beyond it is none, in whatever units
EVEN = 5  # powers of two: units of variables and rows that are this near to even ones are left alone
LONGEST = 1e3  # of an optimum in daqp's coordinates that its tolerance suits
CROSSED = -1  # what an update says of bounds that cross
_BAD_DATA = QPSolution(None, None, QPStatus.BAD_DATA, 0)
# Bounds that leave one value each, of rows that are nearly parallel, are more than daqp can start from.
_NOT_BEGUN = QPSolution(None, None, QPStatus.FAILED, 0)


class DaqpSolver:
    """Solves one `QuadraticProgram` again and again for new f and bounds.

    Safe to share between threads (each gets its own daqp workspace) and to pickle (the workspace is
    rebuilt). A failed solve throws the workspace away, so that it cannot spoil the next one. By itself a
    solve starts from the active bounds of the last one, which shows in the last digits of its answer. `start`,
    which every method calls, begins a sequence of solves whose answers depend on their data alone.

    Args:
        program: the constant part.
        time_limit: seconds a solve may take, None for no limit.
        iteration_limit: active-set changes a solve may take.
        tolerance: to within which bounds are kept, in daqp's units.
        keeps_data: whether the arrays given to `solve` are contiguous and nobody else's, so that it may keep them.

    Raises:
        MampcError: daqp refuses the program.
    """

    def __init__(
        self,
        program: QuadraticProgram,
        *,
        time_limit: float | None = None,
        iteration_limit: int = 10_000,
        tolerance: float = 1e-9,
        keeps_data: bool = False,
    ) -> None:
        self.program = program
        self._settings = {
            "primal_tol": tolerance,
            "iter_limit": iteration_limit,
            "time_limit": 0.0 if time_limit is None else time_limit,
        }
        self._units, self._per_unit = _even_units(program)
        self._keeps_data = keeps_data and self._units is None
        self._inactive = np.zeros(program.n_bounds, dtype=np.intc)
        self._f_shape = (program.n_variables,)
        self._bound_shape = (program.n_bounds,)
        self._local = threading.local()
        self._local.model = self._fresh_model() if program.n_bounds else None
        self._local.active = None

    def solve(self, f: Array, lower: Array, upper: Array) -> QPSolution:
        """Minimise for the linear term f, shape (n,), and bounds, shape (n_simple + rows,).

        Non-finite f, not-a-number bounds and lower > upper give the status BAD_DATA.

        Raises:
            MampcError: wrong shapes.
        """
        if f.shape != self._f_shape or lower.shape != self._bound_shape or upper.shape != self._bound_shape:
            raise MampcError(
                f"solve: expected f {self._f_shape} and bounds {self._bound_shape}, "
                f"received {f.shape}, {lower.shape}, {upper.shape}"
            )
        # Both comparisons are false for not-a-number; f beyond 1e154 is as good as infinite.
        square, apart = f.dot(f), lower <= upper
        if not square < np.inf:
            return _BAD_DATA
        if not len(lower):  # daqp wants at least one row
            return QPSolution(-np.linalg.solve(self.program.H, f), lower, QPStatus.OPTIMAL, 0)
        if not apart[apart.argmin()]:
            return _BAD_DATA
        model = getattr(self._local, "model", None)
        if model is None:
            model = self._local.model = self._fresh_model()
            self._local.active = getattr(self._local, "active", None)
        changed = self._changed(f, lower, upper)
        active, self._local.active = self._local.active, None
        if active is self._inactive:
            changed["sense"] = active
        elif active is not None:
            changed["sense"] = there(active, lower, upper)
        flag = model.update(**changed)
        if flag < 0:
            return self._refused(flag)
        z, _, flag, info = model.solve()
        if flag > 0:
            solution = self._solution(z, info)
            if square <= ORDINARY**2 or self._is_optimal(solution, f, lower, upper):
                return solution
        return self._failed(flag, info, f, lower, upper)

    def solve_anew(self, f: Array, lower: Array, upper: Array, sense: Senses | None = None) -> QPSolution:
        """`start` and `solve`, for contiguous arrays of the right shape that are nobody else's.

        f is no longer than ORDINARY, and the active bounds are those that are `there`.
        """
        model = getattr(self._local, "model", None)
        if model is None or self._units is not None:
            self.start(sense)
            return self.solve(f, lower, upper)
        flag = model.update(f=f, blower=lower, bupper=upper, sense=self._inactive if sense is None else sense)
        if flag < 0:
            return self._refused(flag)
        z, _, flag, info = model.solve()
        if flag > 0:
            return QPSolution(z, info["lam"], QPStatus.OPTIMAL, info["iterations"])
        return self._failed(flag, info, f, lower, upper)

    def _refused(self, flag: int) -> QPSolution:
        """What is left to say of data that daqp did not take."""
        self._local.model = None
        return _BAD_DATA if flag == CROSSED else _NOT_BEGUN

    def _failed(self, flag: int, info: dict[str, Any], f: Array, lower: Array, upper: Array) -> QPSolution:
        """What is left to say of a program without an optimum that counts."""
        self._local.model = None
        status = QPStatus.FAILED if flag > 0 else _STATUS.get(flag, QPStatus.FAILED)
        scale = self._scale(f)
        if scale > 1 and status is not QPStatus.TIME_LIMIT:
            return self._solve_scaled(f, lower, upper, scale)
        return QPSolution(None, None, status, info["iterations"])

    def _scale(self, f: Array) -> float:
        """A power of two by which to divide z, where its numbers are too large for an absolute tolerance, else 1.

        daqp keeps bounds to within `primal_tol` in the coordinates in which H is the unit matrix; an optimum
        that is too long there (outputs in Pa and inputs in kg/s, say) looks infeasible to it.
        """
        length = float(np.max(np.abs(f) / np.sqrt(np.diag(self.program.H)), initial=0.0))
        return float(2.0 ** np.ceil(np.log2(length / LONGEST))) if length > LONGEST else 1.0

    def _solve_scaled(self, f: Array, lower: Array, upper: Array, scale: float) -> QPSolution:
        """The same program in z / scale, which has the same H and A."""
        model = self._fresh_model()
        flag = model.update(**self._changed(f / scale, lower / scale, upper / scale))
        if flag < 0:
            return _BAD_DATA if flag == CROSSED else _NOT_BEGUN
        z, _, flag, info = model.solve()
        if flag <= 0:
            return QPSolution(None, None, _STATUS.get(flag, QPStatus.FAILED), info["iterations"])
        solution = self._solution(z, info, scale)
        if self._is_optimal(solution, f, lower, upper):
            return solution
        return QPSolution(None, None, QPStatus.FAILED, info["iterations"])

    def _changed(self, f: Array, lower: Array, upper: Array) -> dict[str, Any]:
        """The data in daqp's units. It reads contiguous doubles and keeps references: these are its own copies."""
        if self._keeps_data:
            return {"f": f, "blower": lower, "bupper": upper}
        if self._units is None:
            return {"f": _own(f), "blower": _own(lower), "bupper": _own(upper)}
        return {"f": f * self._units, "blower": lower * self._per_unit, "bupper": upper * self._per_unit}

    def _solution(self, z: Array, info: dict[str, Any], scale: float = 1.0) -> QPSolution:
        """An optimum in daqp's units, divided by `scale`, in the program's."""
        pull = info["lam"]
        if self._units is not None:
            z, pull = z * self._units, pull * self._per_unit
        if scale != 1.0:
            z, pull = z * scale, pull * scale
        return QPSolution(z, pull, QPStatus.OPTIMAL, info["iterations"])

    def _is_optimal(self, solution: QPSolution, f: Array, lower: Array, upper: Array) -> bool:
        """Whether the optimality conditions hold but for rounding: data beyond double precision give others."""
        z, pull, program = solution.z, solution.multipliers, self.program
        if z is None or pull is None:
            return False
        size = max(1.0, float(np.abs(program.rows(z)).max()))
        gradient = max(float(np.abs(f).max()), float(np.abs(pull).max()))
        return (
            program.primal_residual(lower, upper, solution) <= ROUNDING * size
            and program.dual_residual(f, solution) <= ROUNDING * gradient
            and program.duality_gap(lower, upper, solution) <= ROUNDING * gradient * size
        )

    def start(self, active: Array | Senses | None = None) -> None:
        """Begin anew: the next solve starts from these active bounds, default none.

        They are flags, shape (n_bounds,): 1 at an upper, 3 at a lower bound, else 0.
        """
        self._local.active = self._inactive if active is None else active

    def _fresh_model(self) -> Any:
        import daqp

        program = self.program
        H, A = program.H, program.A
        if self._units is not None:
            H = H * np.outer(self._units, self._units)
            A = A * np.outer(self._per_unit[program.n_simple :], self._units)
        model = daqp.Model()
        model.settings = self._settings
        bound = np.full(program.n_bounds, UNBOUNDED)
        flag, _ = model.setup(
            np.ascontiguousarray(H), np.zeros(program.n_variables), np.ascontiguousarray(A),
            bound, -bound, np.zeros(program.n_bounds, dtype=np.intc),
        )  # fmt: skip
        if flag < 0:
            raise MampcError(f"daqp: expected a strictly convex program, received setup flag {flag}")
        return model

    def __getstate__(self) -> dict[str, Any]:
        return {"program": self.program, "settings": self._settings, "keeps_data": self._keeps_data}

    def __setstate__(self, state: dict[str, Any]) -> None:
        settings = state["settings"]
        self.__init__(  # type: ignore[misc]
            state["program"],
            time_limit=settings["time_limit"] or None,
            iteration_limit=settings["iter_limit"],
            tolerance=settings["primal_tol"],
            keeps_data=state["keeps_data"],
        )


def _even_units(program: QuadraticProgram) -> tuple[Array | None, Array]:
    """Units of the variables, shape (n,), that make the diagonal of H even, and factors of the bounds, (n_bounds,).

    daqp cycles, and misses bounds, where variables or rows are of very different sizes. Powers of two leave
    every digit as it is. The units are None where the program is even as it is.
    """
    units = 2.0 ** -np.round(0.5 * np.log2(np.diag(program.H)))
    units /= max(1.0, units.min(initial=1.0))  # a small cost makes no variable small
    rows = np.sqrt(np.square(program.A * units).sum(axis=1))
    per_unit = np.concatenate(
        (1 / units[: program.n_simple], 2.0 ** -np.round(np.log2(np.where(rows > 0, rows, 1.0))))
    )
    uneven = np.abs(np.log2(np.concatenate((units, per_unit)))).max(initial=0.0) > EVEN
    return (units if uneven else None), per_unit


def active_bounds(multipliers: Array) -> Array:
    """Which bounds hold a solution with these multipliers, as flags of `DaqpSolver.start`."""
    active: Array = ACTIVE_ABOVE * (multipliers > 0) + ACTIVE_BELOW * (multipliers < 0)
    return active


def there(active: Array, lower: Array, upper: Array) -> Senses:
    """The active bounds but for those that went away since, which cannot be started from."""
    flags = active.astype(np.intc)
    at = flags.nonzero()[0]
    limits = zip(at.tolist(), active[at].tolist(), lower[at].tolist(), upper[at].tolist(), strict=True)
    for i, flag, low, high in limits:
        if low <= -GONE if flag == ACTIVE_BELOW else high >= GONE:
            flags[i] = 0
    return flags


def each_there(active: Array, lower: Array, upper: Array) -> Senses:
    """`there` of K programs, shape (K, n_bounds)."""
    flags = active.astype(np.intc)
    flags[(flags == ACTIVE_BELOW) & (lower <= -GONE) | (flags == ACTIVE_ABOVE) & (upper >= GONE)] = 0
    return flags


def active_flags(active: Array | None) -> bool:
    """Whether an array holds flags as `DaqpSolver.start` takes them, or is None."""
    return active is None or bool(np.isin(active, (0.0, ACTIVE_ABOVE, ACTIVE_BELOW)).all())


def _own(array: Array) -> Array:
    return np.array(array, dtype=np.float64, order="C")
