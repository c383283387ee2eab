"""Controllers: one algorithm a file, behind one `step`."""

from mampc.controllers.admm import ADMM
from mampc.controllers.alternating import Alternating
from mampc.controllers.decision import ControllerState, Decision, Remark, Status
from mampc.controllers.exact import Exact
from mampc.controllers.greedy import Greedy
from mampc.controllers.hard_thresholding import HardThresholding
from mampc.controllers.l1 import L1, ReweightedL1
from mampc.controllers.mampc import MAMPC, METHODS
from mampc.controllers.mpc import MPC
from mampc.controllers.penalty_decomposition import PenaltyDecomposition

__all__ = [
    "ADMM",
    "L1",
    "MAMPC",
    "METHODS",
    "MPC",
    "Alternating",
    "ControllerState",
    "Decision",
    "Exact",
    "Greedy",
    "HardThresholding",
    "PenaltyDecomposition",
    "Remark",
    "ReweightedL1",
    "Status",
]
