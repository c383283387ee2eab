"""Dense quadratic programs with two-sided rows, and solutions that certify themselves.

    minimise   1/2 z' H z + f' z
    subject to lower <= [z[:n_simple]; A z] <= upper

The first `n_simple` variables have simple bounds; the rows of A follow. H and A stay; f, lower and
upper come with each solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError

UNBOUNDED = 1e30  # what stands for infinity in bounds


class QPStatus(Enum):
    """How a solve ended."""

    OPTIMAL = "optimal"
    INFEASIBLE = "infeasible"
    ITERATION_LIMIT = "iteration limit"
    TIME_LIMIT = "time limit"
    BAD_DATA = "non-finite data or crossed bounds"
    FAILED = "failed"


class QPSolution(NamedTuple):
    """The minimiser z, shape (n,), its multipliers (positive at upper bounds), status and iterations.

    z and the multipliers are None unless the status is OPTIMAL.
    """

    z: Array | None
    multipliers: Array | None
    status: QPStatus
    iterations: int


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """The part of a quadratic program that stays: H (n, n) positive definite, A (rows, n), n_simple.

    Raises:
        MampcError: shapes that do not fit, numbers that are not finite, or H not positive definite.
    """

    H: Array
    A: Array
    n_simple: int

    def __post_init__(self) -> None:
        n = self.H.shape[0]
        if self.H.shape != (n, n) or self.A.shape[1:] != (n,) or not 0 <= self.n_simple <= n:
            raise MampcError(
                f"QuadraticProgram: expected H (n, n), A (rows, n), 0 <= n_simple <= n, "
                f"received {self.H.shape}, {self.A.shape}, {self.n_simple}"
            )
        if not (np.isfinite(self.H).all() and np.isfinite(self.A).all()):
            raise MampcError("QuadraticProgram: expected finite numbers in H and A, received others")
        # Of unit diagonal, so that the units of the variables do not matter.
        size = np.sqrt(np.maximum(np.diag(self.H), 1e-300))
        eigenvalues = np.linalg.eigvalsh(self.H / np.outer(size, size)) if n else np.ones(1)
        if not eigenvalues[0] > 1e-13 * eigenvalues[-1]:
            raise MampcError(
                "QuadraticProgram: expected a positive definite Hessian, received smallest and largest "
                f"eigenvalues {eigenvalues[0]:.3g} and {eigenvalues[-1]:.3g} (of unit diagonal); give every move a "
                "weight"
            )

    @property
    def n_variables(self) -> int:
        return len(self.H)

    @property
    def n_bounds(self) -> int:
        return self.n_simple + len(self.A)

    def rows(self, z: Array) -> Array:
        """The bounded quantities [z[:n_simple]; A z]."""
        return np.concatenate([z[: self.n_simple], self.A @ z])

    def primal_residual(self, lower: Array, upper: Array, solution: QPSolution) -> float:
        """Largest violation of a bound, over the length of its row if above 1; infinite without a solution."""
        if solution.z is None:
            return np.inf
        rows = self.rows(solution.z)
        excess = np.maximum(lower - rows, rows - upper)
        excess[self.n_simple :] /= np.maximum(1.0, np.linalg.norm(self.A, axis=1))
        return float(np.max(excess, initial=0.0))

    def dual_residual(self, f: Array, solution: QPSolution) -> float:
        """Largest entry of the gradient of the Lagrangian; infinite without a solution."""
        if solution.z is None or solution.multipliers is None:
            return np.inf
        gradient = self.H @ solution.z + f + self.A.T @ solution.multipliers[self.n_simple :]
        gradient[: self.n_simple] += solution.multipliers[: self.n_simple]
        return float(np.max(np.abs(gradient), initial=0.0))

    def duality_gap(self, lower: Array, upper: Array, solution: QPSolution) -> float:
        """Sum of |multiplier| times the distance to its bound; infinite without a solution."""
        if solution.z is None or solution.multipliers is None:
            return np.inf
        rows, pull = self.rows(solution.z), solution.multipliers
        distance = np.where(pull > 0, upper - rows, rows - lower)
        active = pull != 0  # a bound without pull may be infinite
        return float(np.sum(np.abs(pull[active] * distance[active])))
