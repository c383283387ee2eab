"""What a record leaves open: inputs that hardly move or move together, and effects that do not stand out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import counted, listed
from mampc.identification.data import IOData
from mampc.systems.properties import doubtful_gains, properties, time_in_words
from mampc.systems.state_space import StateSpace

BLOCK = 50_000  # samples looked at together
FEW_MOVES = 10  # of an input; fewer say little about anything but the largest of them
TOGETHER = 0.9  # correlation of moves from which two inputs cannot be told apart
SHORT = 5.0  # settling times: a shorter record has hardly one step of each kind
LONG_ENOUGH = 12  # settling times


def missing_movement(names: Sequence[str], pieces: Sequence[Array]) -> list[str]:
    """What is missing in the movement of inputs, a sentence each with what to do.

    Args:
        names: of the m inputs.
        pieces: their values, shape (N, m) or with further columns behind them, not-a-number where there is none.
    """
    m = len(names)
    counts, samples, products = np.zeros(m, dtype=int), np.zeros(m, dtype=int), np.zeros((m, m))
    # The last sample of a block begins the next one.
    for values in (piece[at : at + BLOCK + 1, :m] for piece in pieces for at in range(0, len(piece), BLOCK)):
        moves = np.nan_to_num(np.diff(values, axis=0))
        counts += np.count_nonzero(moves, axis=0)
        samples += np.count_nonzero(~np.isnan(values[:BLOCK]), axis=0)
        products += moves.T @ moves
    said = [
        f"{name} moves {counted(count, 'time')} in {n} samples: move it up and down at least {FEW_MOVES} times"
        for name, count, n in zip(names, counts.tolist(), samples.tolist(), strict=True)
        if count < FEW_MOVES
    ]
    sizes = np.sqrt(products.diagonal())
    for i, j in combinations(range(m), 2):
        together = products[i, j] / (sizes[i] * sizes[j]) if sizes[i] and sizes[j] else 0.0
        if abs(together) > TOGETHER:
            said.append(
                f"{names[i]} and {names[j]} move together (correlation of moves {together:.2f}): their effects cannot "
                "be told apart; move them at different times"
            )
    return said


def movement_of(records: Sequence[IOData]) -> list[str]:
    """The same of all records together; measured disturbances are not asked to move."""
    return missing_movement(records[0].names.inputs, [record.u for record in records])


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
