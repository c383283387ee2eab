"""Methods that search the move patterns, one a file behind the interface of `method`."""

from mampc.methods.admm import ADMM
from mampc.methods.alternating import Alternating
from mampc.methods.exact.search import Exact
from mampc.methods.greedy import Greedy
from mampc.methods.hard_thresholding import HardThresholding
from mampc.methods.l1 import L1, ReweightedL1
from mampc.methods.penalty_decomposition import PenaltyDecomposition
from mampc.methods.registry import METHODS

__all__ = [
    "ADMM",
    "L1",
    "METHODS",
    "Alternating",
    "Exact",
    "Greedy",
    "HardThresholding",
    "PenaltyDecomposition",
    "ReweightedL1",
]
