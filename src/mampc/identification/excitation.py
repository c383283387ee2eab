"""What a record leaves open: inputs that hardly move or move together, and effects that do not stand out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import listed
from mampc.identification.data import IOData
from mampc.systems.properties import doubtful_gains, properties, time_in_words
from mampc.systems.state_space import StateSpace

FEW_MOVES = 10  # of an input; fewer say little about anything but the largest of them
TOGETHER = 0.9  # correlation of moves from which two inputs cannot be told apart
SHORT = 5.0  # settling times: a shorter record has hardly one step of each kind
LONG_ENOUGH = 12  # settling times


def missing_movement(inputs: Mapping[str, Array]) -> list[str]:
    """What is missing in the movement of inputs, a sentence each with what to do.

    Args:
        inputs: values by name, shape (N,), not-a-number where there is none.
    """
    moves = {name: np.nan_to_num(np.diff(values)) for name, values in inputs.items()}
    said = []
    for name, own in moves.items():
        count = int(np.count_nonzero(own))
        if count < FEW_MOVES:
            times, samples = "time" if count == 1 else "times", int(np.count_nonzero(~np.isnan(inputs[name])))
            said.append(
                f"{name} moves {count} {times} in {samples} samples: move it up and down at least {FEW_MOVES} times"
            )
    for (one, a), (other, b) in combinations(moves.items(), 2):
        size = float(np.linalg.norm(a) * np.linalg.norm(b))
        together = float(a @ b) / size if size else 0.0
        if abs(together) > TOGETHER:
            said.append(
                f"{one} and {other} move together (correlation of moves {together:.2f}): their effects cannot be told "
                "apart; move them at different times"
            )
    return said


def movement_of(records: Sequence[IOData]) -> list[str]:
    """The same of all records together; measured disturbances are not asked to move."""
    gap = np.full((1, records[0].u.shape[1]), np.nan)
    u = np.concatenate([part for record in records for part in (record.u, gap)])
    return missing_movement(dict(zip(records[0].names.inputs, u.T, strict=False)))


def left_open(model: StateSpace, records: Sequence[IOData]) -> list[str]:
    """What records cannot say of a model that was identified from them, a sentence each with what to record next."""
    found = properties(model)
    said = movement_of(records)
    doubtful = doubtful_gains(model, found)
    if doubtful:
        said.append(
            f"the sign of the gain is uncertain: {listed(doubtful)}; move these inputs further, for longer and one "
            "without the other, unless no effect is to be expected"
        )
    lasted = max(map(len, records)) * model.dt
    if found.settling_time > 0 and lasted < SHORT * found.settling_time:
        said.append(
            f"the longest piece lasts {time_in_words(lasted)}, the model takes {time_in_words(found.settling_time)} to "
            f"settle: record {time_in_words(LONG_ENOUGH * found.settling_time)} or more"
        )
    return said
