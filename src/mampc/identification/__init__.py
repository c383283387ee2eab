"""From an input-output record to a validated model."""

from mampc.identification.data import IOData, excite
from mampc.identification.n4sid import Identified, choose_order, n4sid
from mampc.identification.validation import Validation, validate

__all__ = ["IOData", "Identified", "Validation", "choose_order", "excite", "n4sid", "validate"]
