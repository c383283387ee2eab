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
MOVING = 0.75  # share of samples at which controllers move; tests of two levels move at half of them
TOGETHER = 0.9  # correlation of moves from which two inputs cannot be told apart
SHORT = 5.0  # settling times: a shorter record has hardly one step of each kind
LONG_ENOUGH = 12  # settling times
ANSWERS, LAGS, MOST = (
    0.99,
    10,
    20_000,
)  # share of an input that outputs explain; samples of their past, and of all


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


def answering(records: Sequence[IOData]) -> list[str]:
    """Which inputs do nothing but answer outputs, a sentence each: moved by a controller, with no test of their own.

    What the past of the inputs leaves of an input is explained by present and past outputs. Inputs that mostly stand
    still do not count: outputs may show them within a sample.
    """
    longest = max(records, key=len)[:MOST]
    u, y, N = longest.u, longest.y, len(longest) - LAGS
    m, l = u.shape[1], y.shape[1]
    if 10 * (LAGS + 1) * (m + l) > N:
        return []
    own = np.linalg.qr(
        np.hstack([np.ones((N, 1)), *(u[LAGS - i : LAGS - i + N] for i in range(1, LAGS + 1))])
    )[0]
    seen = np.hstack([y[LAGS - i : LAGS - i + N] for i in range(LAGS + 1)])
    spread = seen.std(axis=0)
    seen = (seen - seen.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    new, seen = u[LAGS:] - own @ (own.T @ u[LAGS:]), seen - own @ (own.T @ seen)
    left = new - seen @ np.linalg.lstsq(seen, new, rcond=1e-10)[0]
    moved = np.mean(np.diff(u, axis=0) != 0, axis=0) > MOVING
    answers = moved & (np.sum(left**2, axis=0) < (1 - ANSWERS) * np.sum(new**2, axis=0))
    return [
        f"{name} follows from the outputs but for 1 %: unless they show it within a sample, a controller moved it, and "
        "the model may say more of that and of loads than of the plant, whatever its fit and deviations; "
        "record a test, or changes of its set point"
        for name, follows in zip(longest.names.inputs, answers, strict=False)
        if follows
    ]


def left_open(model: StateSpace, records: Sequence[IOData]) -> list[str]:
    """What records cannot say of a model that was identified from them, a sentence each with what to record next."""
    found = properties(model)
    said = movement_of(records) + answering(records)
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
