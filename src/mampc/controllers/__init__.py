"""Controllers: what decides at every sample, behind one `step`."""

from mampc.controllers.bank import ControllerBank
from mampc.controllers.decision import ControllerState, Decision
from mampc.controllers.mampc import MAMPC
from mampc.controllers.mpc import MPC

__all__ = ["MAMPC", "MPC", "ControllerBank", "ControllerState", "Decision"]
