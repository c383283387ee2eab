"""mampc: minimum-attention model predictive control, which tracks with few actuator moves.

See README.md for ten lines that run, docs/ for the rest.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mampc import plants
from mampc.base.errors import MampcError, MampcWarning, StudyError
from mampc.base.names import Names
from mampc.base.words import Fault, LoadKind, Remark, Status
from mampc.controllers import MAMPC, MPC, ControllerBank, ControllerState, Decision
from mampc.controllers.offset import largest_offset
from mampc.controllers.targets import Targets, targets
from mampc.loop.hypotheses import Hypothesis
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.loop.metrics import Metrics
from mampc.loop.reference_filter import ReferenceFilter
from mampc.loop.regulator import Regulator
from mampc.loop.run import Run
from mampc.loop.sensors import SensorChecks
from mampc.loop.simulation import simulate
from mampc.loop.state import RegulatorState
from mampc.loop.valves import Valves
from mampc.methods import (
    ADMM,
    L1,
    METHODS,
    Alternating,
    Exact,
    Greedy,
    HardThresholding,
    PenaltyDecomposition,
    ReweightedL1,
)
from mampc.moves.rules import MoveRules
from mampc.program.levels import OnOff
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.zone import Zone
from mampc.systems.linearisation import linearise
from mampc.systems.mismatch import Mismatch
from mampc.systems.noise import Noise
from mampc.systems.signals import prbs, steps
from mampc.systems.state_space import StateSpace

if TYPE_CHECKING:
    from mampc import identification, rivals
    from mampc.compare.tuned import Tuned
    from mampc.compare.tuning import tune
    from mampc.identification import (
        Export,
        Identified,
        IOData,
        PlannedTest,
        Validation,
        excite,
        n4sid,
        plan_test,
        read_export,
        validate,
    )
    from mampc.loop import loads
    from mampc.loop.batch import Batch, simulate_batch
    from mampc.loop.learnt_gains import LearntGains, learn_gains
    from mampc.loop.recorder import Recorder
    from mampc.loop.replay import Difference, Recording, replay

# What no controller in a loop needs is imported where it is first asked for.
_LATER = {
    "compare.tuned": ("Tuned",),
    "compare.tuning": ("tune",),
    "identification": (
        "Export", "IOData", "Identified", "PlannedTest", "Validation", "excite", "n4sid", "plan_test", "read_export",
        "validate",
    ),
    "loop.batch": ("Batch", "simulate_batch"),
    "loop.learnt_gains": ("LearntGains", "learn_gains"),
    "loop.recorder": ("Recorder",),
    "loop.replay": ("Difference", "Recording", "replay"),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _LATER.items() for name in names}
_MODULES = {"identification": "identification", "loads": "loop.loads", "rivals": "rivals"}

__version__ = "0.1.0"

__all__ = [
    "ADMM",
    "L1",
    "MAMPC",
    "METHODS",
    "MPC",
    "Alternating",
    "Batch",
    "ControllerBank",
    "ControllerState",
    "Decision",
    "Difference",
    "Exact",
    "Export",
    "Fault",
    "Greedy",
    "HardThresholding",
    "Hypothesis",
    "IOData",
    "Identified",
    "KalmanFilter",
    "LearntGains",
    "Limits",
    "LoadBank",
    "LoadKind",
    "MampcError",
    "MampcWarning",
    "Metrics",
    "Mismatch",
    "MoveRules",
    "Names",
    "Noise",
    "OnOff",
    "PenaltyDecomposition",
    "PlannedTest",
    "Recorder",
    "Recording",
    "ReferenceFilter",
    "Regulator",
    "RegulatorState",
    "Remark",
    "ReweightedL1",
    "Run",
    "SensorChecks",
    "StateSpace",
    "Status",
    "StudyError",
    "Targets",
    "TrackingProblem",
    "Tuned",
    "Validation",
    "Valves",
    "Zone",
    "excite",
    "identification",
    "largest_offset",
    "learn_gains",
    "linearise",
    "loads",
    "n4sid",
    "plan_test",
    "plants",
    "prbs",
    "read_export",
    "replay",
    "rivals",
    "simulate",
    "simulate_batch",
    "steps",
    "targets",
    "tune",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"mampc.{_MODULES[name]}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'mampc' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"mampc.{_MODULE_OF[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
