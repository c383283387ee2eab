"""What stands between decided and real inputs: valves that stick, slip and have play.

With f_S = (band + jump) / 2 the static and f_D = (band - jump) / 2 the kinetic friction, a stem stays where it is while
the force e that has built up since, e+ = e + du, is within f_S; beyond it the stem slips to u - f_D sign(e), and
e = f_D sign(e) is left. So e is always what the decided input and the stem are apart, and a stem at p goes to q where

    |q - p| > jump    and    u = q + f_D sign(q - p):

smaller moves are not executed, and a reversal takes band - jump = 2 f_D more.

Source: He, Wang, Pottmann, Qin: A curve fitting method for detecting valve stiction in oscillating control loops,
Industrial & Engineering Chemistry Research 46 (2007). The two parameters are those of Choudhury, Thornhill, Shah:
Modelling valve stiction, Control Engineering Practice 13 (2005): S = band, J = jump.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_array, as_instance, as_one_or_each, as_vector
from mampc.base.errors import MampcError
from mampc.controllers.controller import Controller
from mampc.controllers.mampc import MAMPC


@dataclass(frozen=True, kw_only=True)
class Valves:
    """Actuators with dead-band and stiction, in input units, each a number or one per input.

    Args:
        band: by how much the decided input has to come back before the actuator follows (dead-band and
            stickband together); 0 for an actuator that follows at once.
        jump: by how much it slips when it starts, at most `band`; an actuator that has stopped does not
            follow a smaller change. 0 for play alone.

    Raises:
        MampcError: negative numbers, or a jump above the band.
    """

    band: Any = 0.0
    jump: Any = 0.0

    def __post_init__(self) -> None:
        for name in ("band", "jump"):
            object.__setattr__(self, name, as_one_or_each(name, getattr(self, name), 0.0))
        band, jump = np.asarray(self.band), np.asarray(self.jump)
        if band.ndim and jump.ndim and band.shape != jump.shape:
            raise MampcError(f"jump: expected as many values as band, {len(band)}, received {len(jump)}")
        if (jump > band).any():
            raise MampcError(f"jump: expected at most the band of {self.band}, received {self.jump}")

    def initial(self, u: Any) -> Stems:
        """The actuators at rest at the inputs u, shape (..., m)."""
        u = as_array("u", u)
        band, jump = (as_vector(name, getattr(self, name), u.shape[-1]) for name in ("band", "jump"))
        return Stems((band + jump) / 2, (band - jump) / 2, u, np.zeros_like(u), u)


@dataclass(frozen=True, eq=False)
class Stems:
    """Where actuators are.

    Attributes:
        static, kinetic: friction, shape (m,).
        position: shape (..., m), as is what follows.
        force: that has built up while they stay.
        decided: the last inputs.
    """

    static: Array
    kinetic: Array
    position: Array
    force: Array
    decided: Array

    def moved(self, u: Array) -> Stems:
        """After the inputs u, shape (..., m), were decided."""
        force = self.force + (u - self.decided)
        slips, left = np.abs(force) > self.static, self.kinetic * np.sign(force)
        return replace(
            self,
            position=np.where(slips, u - left, self.position),
            force=np.where(slips, left, force),
            decided=u,
        )


class Compensation:
    """Decided inputs that bring stems where they are planned.

    Args:
        valves: what is known of them.
        n_inputs: how many there are.
    """

    def __init__(self, valves: Valves, n_inputs: int) -> None:
        stems = valves.initial(np.zeros(n_inputs))
        self._static, self._kinetic = stems.static, stems.kinetic
        self.jump = stems.static - stems.kinetic

    def decided(
        self, planned: Array, position: Array, last: Array, low: Array, high: Array
    ) -> tuple[Array, Array]:
        """The inputs, within their limits, and where the stems come to be, all of shape (m,).

        Args:
            planned: where they are to go.
            position: where they are; those that are to stay there keep their last input.
            last: inputs decided last.
            low, high: limits of the inputs.
        """
        # Where the last input would move a stem, somebody else has moved it since.
        last = np.where(np.abs(last - position) > self._static * (1 + 1e-9), position, last)
        way = np.sign(planned - position)
        u = np.minimum(np.maximum(np.where(way == 0, last, planned + self._kinetic * way), low), high)
        force = u - position
        slips = np.abs(force) > self._static
        # Where limits do not cut the input short, the stem is where it was planned, to the last digit.
        reached = np.where(u == planned + self._kinetic * way, planned, u - self._kinetic * np.sign(force))
        return u, np.where(slips, reached, position)


def compensation_of(valves: Valves, controller: Controller) -> Compensation:
    """That of a controller's valves; raises `MampcError` where its moves are not executed."""
    compensation = Compensation(as_instance("valves", valves, Valves), controller.problem.model.n_inputs)
    for one in controller.each:
        if type(one) is not MAMPC or one.levels is not None:
            raise MampcError(
                f"valves: expected a MAMPC of inputs without levels, or a bank of them, received {type(one).__name__}"
            )
        size = as_vector("min_size", one.rules.min_size, controller.problem.model.n_inputs)
        if ((size <= compensation.jump) & (compensation.jump > 0)).any():
            raise MampcError(
                f"valves: expected rules with a min_size above the jump of {compensation.jump}, since smaller moves "
                f"are not executed, received {size}"
            )
    return compensation
