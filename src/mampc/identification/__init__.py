"""From an input-output record to a validated model."""

from mampc.identification.data import IOData, excite
from mampc.identification.export import Export, read_export
from mampc.identification.n4sid import Identified, n4sid
from mampc.identification.plant_test import PlannedTest, plan_test
from mampc.identification.validation import Validation, validate

__all__ = [
    "Export",
    "IOData",
    "Identified",
    "PlannedTest",
    "Validation",
    "excite",
    "n4sid",
    "plan_test",
    "read_export",
    "validate",
]
