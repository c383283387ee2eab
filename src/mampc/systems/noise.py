"""What a record says of the disturbances of a plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mampc.base.checks import Array, as_array, as_vector


@dataclass(frozen=True, eq=False)
class Noise:
    """Disturbances at the outputs of a model, in output units.

    What a simulation leaves of a record is split into white noise and a random walk. The walk holds loads, drifts
    and what the model lacks.

    Args:
        output: standard deviation of the white noise of each output, shape (l,).
        drift: standard deviation of the steps of each output's random walk in one sample, shape (l,).

    Raises:
        MampcError: negative numbers, or others that are not finite.
    """

    output: Array
    drift: Array

    def __post_init__(self) -> None:
        size = as_array("noise.output", self.output).size
        for name in ("output", "drift"):
            value: Any = as_vector(f"noise.{name}", getattr(self, name), size, 0.0)
            value.flags.writeable = False
            object.__setattr__(self, name, value)


def white_noise(noise: Noise | None) -> Array | None:
    """Standard deviation of the white noise of each output, shape (l,), where a record showed it of all; else None."""
    return noise.output if noise is not None and (noise.output > 0).all() else None
