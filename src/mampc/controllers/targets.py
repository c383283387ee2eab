"""The steady state that a loop finds: the inputs, outputs and limits at which plain MPC moves no more.

A steady state is one of a family, z -> (x, u), affine in z, and the first moves that plain MPC decides there are
piecewise affine in z. Newton's method finds the z at which they are zero, from where a simulated loop has come to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_instance, as_vector
from mampc.base.errors import MampcError
from mampc.controllers.mpc import MPC
from mampc.program.problem import TrackingProblem
from mampc.program.steady import SteadyStates

ROUNDS = 12  # of simulation, each twice as long as the last
FIRST_ROUND = 20  # samples
NEWTON_STEPS = 12
DONE = 1e-9  # of the size of the numbers, in units that make inputs alike: a first move that is none
AT_LIMIT = 1e-6  # of the range of a signal, or of its unit: how near a limit binds
DISTURBANCES = ("input_disturbance", "output_disturbance", "measured_disturbance")


@dataclass(frozen=True, eq=False)
class Targets:
    """A steady state of a loop, in engineering units.

    Attributes:
        u: inputs, shape (m,).
        y: outputs, shape (l,).
        x: state of the model, a deviation, shape (n,).
        binding: the limits that hold it there, in words such as "u_max of pump".
    """

    u: Array
    y: Array
    x: Array
    binding: tuple[str, ...]


def targets(problem: TrackingProblem, disturbances: Any = None, reference: Any = None) -> Targets:
    """The steady state that plain MPC of a problem leads to, its model exact and disturbances known and constant.

    Where inputs have targets or a cost, it says what these come to. It begins at the operating point, which matters
    where nothing determines some input.

    Args:
        problem: what is controlled.
        disturbances: None; or shape (l,), added to the outputs; or a mapping of `input_disturbance` (m,),
            `output_disturbance` (l,) and `measured_disturbance` (d,), as `MPC.step` takes them.
        reference: shape (l,), or what else `MPC.step` takes; default the outputs of the operating point.

    Raises:
        MampcError: arrays of other shapes, or a loop that does not settle.
    """
    problem = as_instance("problem", problem, TrackingProblem)
    model = problem.model
    m, l = model.n_inputs, model.n_outputs
    if disturbances is not None and not isinstance(disturbances, Mapping):
        disturbances = {"output_disturbance": disturbances}
    given = dict(disturbances or {})
    if unknown := sorted(map(str, given.keys() - set(DISTURBANCES))):
        raise MampcError(f"disturbances: expected {', '.join(DISTURBANCES)}, received {', '.join(unknown)}")
    sizes = dict(zip(DISTURBANCES, (m, l, len(model.v_op)), strict=True))
    known: dict[str, Any] = {
        name: as_vector(name, value, sizes[name]) for name, value in given.items() if value is not None
    }
    loop = _Loop(MPC(problem), model.y_op if reference is None else reference, known)
    x, u = loop.start()
    samples = FIRST_ROUND
    for _ in range(ROUNDS):
        found = loop.settled(x, u)
        if found is not None:
            return loop.described(*found)
        x, u = loop.simulated(x, u, samples)
        samples *= 2
    raise MampcError(
        "targets: expected a loop that settles, received one whose inputs still move after "
        f"{samples - FIRST_ROUND} samples; give every input a u_target_weight, or the problem a longer horizon"
    )


class _Loop:
    """Plain MPC on its own model, with constant disturbances."""

    def __init__(self, controller: MPC, reference: Any, disturbances: dict[str, Any]) -> None:
        problem = controller.problem
        self._controller, self._reference, self._disturbances = controller, reference, disturbances
        self._model = model = problem.model
        m = model.n_inputs
        v = disturbances.get("measured_disturbance", model.v_op) - model.v_op
        self._forcing = np.concatenate([disturbances.get("input_disturbance", np.zeros(m)), v])
        states = SteadyStates(problem)
        self._unit, self._size, self._basis = states.unit, states.size, states.basis
        self._particular = states.particular(model.B @ self._forcing)

    def start(self) -> tuple[Array, Array]:
        """The steady state nearest to the operating point."""
        n = self._model.n_states
        if not self._basis.shape[1]:
            return self._size * self._particular[:n], self._model.u_op.copy()
        return self._steady(-self._basis.T[:, n:] @ self._particular[n:])

    def settled(self, x: Array, u: Array) -> tuple[Array, Array] | None:
        """The steady state near (x, u) at which no input moves, if Newton's method finds it."""
        both = np.concatenate([x / self._size, (u - self._model.u_op) / self._unit]) - self._particular
        z = np.linalg.lstsq(self._basis, both)[0]
        for _ in range(NEWTON_STEPS):
            moves = self._first_moves(z)
            if moves is None:
                return None
            size = float(np.abs(moves).max(initial=0.0))
            scale = max(float(np.abs(z).max(initial=0.0)), 1e-12)
            if size <= DONE * scale:
                return self._steady(z)
            near, columns = max(1e-3 * size, 1e-8 * scale), []
            for unit in np.eye(len(z)):
                other = self._first_moves(z + near * unit)
                if other is None:
                    return None
                columns.append((other - moves) / near)
            z = z - np.linalg.lstsq(np.array(columns).T, moves, rcond=1e-9)[0]
        return None

    def simulated(self, x: Array, u: Array, samples: int) -> tuple[Array, Array]:
        """State and inputs so many samples later."""
        model, state = self._model, self._controller.initial_state(u)
        for _ in range(samples):
            decision = self._controller.step(state, x, self._reference, **self._disturbances)
            state, u = decision.state, decision.u
            x = model.A @ x + model.B @ (self._forcing + np.pad(u - model.u_op, (0, len(model.v_op))))
            if not np.isfinite(x).all():
                raise MampcError("targets: expected a loop that settles, received one that is not stable")
        return x, u

    def described(self, x: Array, u: Array) -> Targets:
        """A steady state with its outputs and the limits it stands at."""
        model, limits = self._model, self._controller.problem.limits
        of_inputs = self._forcing + np.pad(u - model.u_op, (0, len(model.v_op)))
        y = model.y_op + model.C @ x + model.D @ of_inputs
        y = y + self._disturbances.get("output_disturbance", 0.0)
        binding = []
        for values, names, sides in (
            (u, model.names.inputs, ("u_min", "u_max")),
            (y, model.names.outputs, ("y_min", "y_max")),
        ):
            low, high = (getattr(limits, side) for side in sides)
            ranged = np.isfinite(high - low) & (high > low)
            near = AT_LIMIT * np.where(ranged, high - low, np.maximum(np.abs(values), 1e-12))
            for side, at in zip(sides, (values <= low + near, values >= high - near), strict=True):
                binding += [f"{side} of {names[i]}" for i in np.flatnonzero(at)]
        for array in (x, u, y):
            array.setflags(write=False)
        return Targets(u, y, x, tuple(binding))

    def _steady(self, z: Array) -> tuple[Array, Array]:
        both, n = self._particular + self._basis @ z, self._model.n_states
        return self._size * both[:n], self._model.u_op + self._unit * both[n:]

    def _first_moves(self, z: Array) -> Array | None:
        """The first moves that plain MPC decides in a steady state, in units that make inputs alike."""
        x, u = self._steady(z)
        state = self._controller.initial_state(u)
        decision = self._controller.step(state, x, self._reference, **self._disturbances)
        return None if decision.held else (decision.u - u) / self._unit
