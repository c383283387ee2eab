"""mampc: minimum-attention model predictive control, which tracks with few actuator moves.

See README.md for ten lines that run, docs/ for the rest.
"""

from mampc import plants
from mampc.controllers import (
    ADMM,
    L1,
    MAMPC,
    METHODS,
    MPC,
    Alternating,
    ControllerState,
    Decision,
    Exact,
    Greedy,
    HardThresholding,
    PenaltyDecomposition,
    Remark,
    ReweightedL1,
    Status,
)
from mampc.errors import MampcError, StudyError
from mampc.estimation import KalmanFilter
from mampc.identification import Identified, IOData, Validation, excite, n4sid, validate
from mampc.lti import StateSpace, linearise
from mampc.metrics import Metrics
from mampc.names import Names
from mampc.offset import largest_offset
from mampc.patterns import MoveRules
from mampc.problem import Limits, TrackingProblem
from mampc.regulator import Regulator
from mampc.regulator_state import RegulatorState
from mampc.replay import Difference, Recording, replay
from mampc.sensors import Fault, SensorChecks
from mampc.signals import prbs, steps
from mampc.simulation import Run, simulate

__version__ = "0.1.0"

__all__ = [
    "ADMM",
    "L1",
    "MAMPC",
    "METHODS",
    "MPC",
    "Alternating",
    "ControllerState",
    "Decision",
    "Difference",
    "Exact",
    "Fault",
    "Greedy",
    "HardThresholding",
    "IOData",
    "Identified",
    "KalmanFilter",
    "Limits",
    "MampcError",
    "Metrics",
    "MoveRules",
    "Names",
    "PenaltyDecomposition",
    "Recording",
    "Regulator",
    "RegulatorState",
    "Remark",
    "ReweightedL1",
    "Run",
    "SensorChecks",
    "StateSpace",
    "Status",
    "StudyError",
    "TrackingProblem",
    "Validation",
    "excite",
    "largest_offset",
    "linearise",
    "n4sid",
    "plants",
    "prbs",
    "replay",
    "simulate",
    "steps",
    "validate",
]
