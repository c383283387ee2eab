"""Controllers: one algorithm a file, behind one `step`."""

from mampc.controllers.alternating import Alternating
from mampc.controllers.decision import ControllerState, Decision, Status
from mampc.controllers.mampc import MAMPC
from mampc.controllers.mpc import MPC

__all__ = ["MAMPC", "MPC", "Alternating", "ControllerState", "Decision", "Status"]
