"""Methods by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from mampc.base.checks import as_choice
from mampc.base.errors import MampcError
from mampc.methods.admm import ADMM
from mampc.methods.alternating import Alternating
from mampc.methods.exact.search import Exact
from mampc.methods.greedy import Greedy
from mampc.methods.hard_thresholding import HardThresholding
from mampc.methods.l1 import L1, ReweightedL1
from mampc.methods.method import Method
from mampc.methods.penalty_decomposition import PenaltyDecomposition

METHODS: dict[str, type] = {
    "exact": Exact,
    "alternating": Alternating,
    "greedy": Greedy,
    "penalty_decomposition": PenaltyDecomposition,
    "hard_thresholding": HardThresholding,
    "admm": ADMM,
    "l1": L1,
    "reweighted_l1": ReweightedL1,
}


def method_of(method: str | Method, settings: Mapping[str, Any]) -> Method:
    """A method object from its name and settings, or the object itself; raises `MampcError`."""
    if isinstance(method, str):
        as_choice("method", method, METHODS)
        known = [field.name for field in fields(METHODS[method])]
        unknown = sorted(set(settings) - set(known))
        if unknown:
            raise MampcError(
                f"method {method!r}: expected settings among {', '.join(known)}, received {', '.join(unknown)}"
            )
        chosen: Method = METHODS[method](**settings)
        return chosen
    if not hasattr(method, "prepare") or isinstance(method, type):
        raise MampcError(f"method: expected a name or a method object, received {method!r}")
    if settings:
        raise MampcError(
            f"method: expected settings inside the method object, received {', '.join(settings)} beside it"
        )
    return method
