"""Numbers that may be no measurements: short leaps away and back, and values kept where all else moves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array
from mampc.base.errors import counted
from mampc.identification.export.findings import Findings, rows_text

LEAP = 10.0  # times what is seldom exceeded from one sample to the next
LONGEST_LEAP = 20  # samples; what stays away longer may be a move
OFTEN = 0.05  # share of samples; what is away more often is moved so
SHORTEST_STAY = 10  # samples
CHANCE = 1e-6  # that a stay as long comes about by itself


def note_suspects(name: str, values: Array, numbers: npt.NDArray[np.int64], findings: Findings) -> None:
    """Tell of numbers of an output that only its owner can judge; they stay in the record.

    Args:
        name: of the output.
        values: in the order of time, not-a-number where there is none; shape (n,).
        numbers: of the rows in the file.
        findings: receives the notes.
    """
    known = np.flatnonzero(~np.isnan(values))
    values, numbers = values[known], numbers[known]
    steps = np.diff(values)
    if not steps.any():
        return
    away = _leaps(steps)
    rows = [int(numbers[at]) for start, end in away for at in range(start, end)]
    if 0 < len(rows) <= OFTEN * len(values) + 1:
        first = away[0][0]
        findings.note(
            f"{name}: {counted(len(rows), 'value')} far from those before and after, in {rows_text(rows)} (the first "
            f"is {values[first]:.6g} after {values[first - 1]:.6g}); if not measured, name them in bad (--bad) or "
            "state a range (--range)"
        )
    stays = _stays(steps == 0.0)
    if stays:
        start, end = max(stays, key=lambda stay: stay[1] - stay[0])
        more = f" ({counted(len(stays) - 1, 'time')} more)" if len(stays) > 1 else ""
        findings.note(
            f"{name}: keeps {values[start]:.10g} for {end - start + 1} samples from row {numbers[start]} on{more}, and "
            f"moves nearly always elsewhere; if its sensor was stuck or at its limit, name such values in bad (--bad)"
        )


def _leaps(steps: Array) -> list[tuple[int, int]]:
    """From which sample to before which one values are away from all others, for a few samples."""
    sizes = np.abs(steps)
    usual = max(float(np.quantile(sizes, 0.9)), float(np.median(sizes[sizes > 0])))
    large = np.flatnonzero(sizes > LEAP * usual)
    found: list[tuple[int, int]] = []
    for there, back in pairwise(large.tolist()):
        returns = abs(steps[there : back + 1].sum()) < 0.5 * min(sizes[there], sizes[back])
        if returns and back - there <= LONGEST_LEAP and not (found and found[-1][1] > there):
            found.append((there + 1, back + 1))
    return found


def _stays(kept: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """From which step to before which one a value is kept, where chance does not keep it so long."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], kept, [False]])))
    runs = [(int(start), int(end)) for start, end in edges.reshape(-1, 2) if end - start >= SHORTEST_STAY]
    inside = sum(end - start for start, end in runs)
    if not runs or inside > 0.5 * len(kept):  # what moves in steps stays by design
        return []
    share = (np.count_nonzero(kept) - inside) / (len(kept) - inside)
    if share > 0.5:
        return []
    return [(start, end) for start, end in runs if len(kept) * share ** (end - start) < CHANCE]
