"""What the record that a model was identified from says of the plant beyond the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mampc.base.checks import Array, as_array, as_matrix, require_finite
from mampc.base.errors import MampcError


@dataclass(frozen=True, eq=False)
class Evidence:
    """The ranges of a record's signals, and how uncertain the step response is.

    Args:
        inputs: lowest and highest value of each input and measured disturbance, shape (m + d, 2).
        outputs: the same of each output, shape (l, 2).
        deviation: standard deviations of the step response, shape (samples, l, m + d), or None.

    Raises:
        MampcError: shapes that do not fit together, negative deviations, numbers that are not finite.
    """

    inputs: Array
    outputs: Array
    deviation: Array | None = None

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            name: as_matrix(f"evidence.{name}", getattr(self, name), None, 2)
            for name in ("inputs", "outputs")
        }
        if self.deviation is not None:
            values = require_finite("evidence.deviation", as_array("evidence.deviation", self.deviation))
            shape = (len(checked["outputs"]), len(checked["inputs"]))
            if values.ndim != 3 or values.shape[1:] != shape or not len(values) or (values < 0).any():
                raise MampcError(
                    f"evidence.deviation: expected positive numbers of shape (samples, {shape[0]}, {shape[1]}), "
                    f"received shape {values.shape}"
                )
            checked["deviation"] = values
        for name, value in checked.items():
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def matches(self, l: int, columns: int) -> bool:
        """Whether it is of a model of l outputs and so many inputs and measured disturbances."""
        return (len(self.outputs), len(self.inputs)) == (l, columns)
