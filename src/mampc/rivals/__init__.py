"""What one would use instead: rules of when to move around any controller, and penalties that make inputs sparse.

Most rivals differ in a rule or in a penalty, so there are few classes. Every one is a controller like `MPC`.
"""

from mampc.rivals.open_loop import hands_off, minimum_attention
from mampc.rivals.penalised import Penalised
from mampc.rivals.penalties import CLOT, L1, MCP, SCAD, ElasticNet, GroupL2, LogSum
from mampc.rivals.rules import DeadBand, EventTriggered, Periodic, QuietZone, Rounded, Rule
from mampc.rivals.self_triggered import SelfTriggered
from mampc.rivals.sparse_inputs import SparseInputs

__all__ = [
    "CLOT",
    "L1",
    "MCP",
    "SCAD",
    "DeadBand",
    "ElasticNet",
    "EventTriggered",
    "GroupL2",
    "LogSum",
    "Penalised",
    "Periodic",
    "QuietZone",
    "Rounded",
    "Rule",
    "SelfTriggered",
    "SparseInputs",
    "hands_off",
    "minimum_attention",
]
