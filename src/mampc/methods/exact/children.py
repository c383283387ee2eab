"""Children of nodes: the next move left out or made, as rules, least sizes and limits allow."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import BoolArray
from mampc.base.tolerances import SMALLER
from mampc.methods.exact.nodes import Nodes, Row, joined, row_of, with_free, with_known, without
from mampc.methods.exact.sample_problem import SampleProblem

KNOWN = 1e-12  # of the least size: an interval no wider is one value


def children_of(level: int, nodes: Nodes, problem: SampleProblem) -> tuple[Nodes, Nodes | None]:
    """All children, and those among them with the level's move made, None if there are none."""
    of = problem.admissible
    row = row_of(level, nodes, problem.squares, problem.terms)
    j, a = divmod(int(problem.order[level]), of.n_inputs)
    counts = (nodes.now == 0) | (not of.simultaneous)
    may = (
        (nodes.used + counts <= problem.allowance.left)
        & (nodes.now < of.per_step)
        & (j >= nodes.last[:, a] + of.rules.dwell)
    )
    left_out = without(nodes, row)
    if not may.any():
        return left_out, None
    last = nodes.last.copy()
    last[:, a] = j
    counted = nodes._replace(
        used=nodes.used + counts, charge=nodes.charge + of.price[a] * counts, last=last, now=nodes.now + 1
    )
    if not of.sized:
        made = with_free(level, counted, row, problem.squares)
        made = made._replace(value=made.value - problem.terms.support[level])
        if not may.all():
            made = made.take(may)
    else:
        signs = (-1, 1) if of.min_size[problem.order[level]] else (0,)
        parts = [part for sign in signs for part in _in_direction(level, counted, row, may, sign, problem)]
        if not parts:
            return left_out, None
        made = joined(parts)
    return joined([left_out, made]), made


def _in_direction(
    level: int, nodes: Nodes, row: Row, may: BoolArray, sign: int, problem: SampleProblem
) -> list[Nodes]:
    """The nodes with the level's move made, up, down or either way; first those where limits leave one value."""
    domain, a = problem.domain, int(problem.order[level]) % problem.admissible.n_inputs
    size = problem.admissible.min_size[problem.order[level]]
    low, high = domain.low[level], domain.high[level]
    if sign:
        low, high = (max(low, size), high) if sign > 0 else (low, min(high, -size))
    first, second = nodes.place[:, a, 0], nodes.place[:, a, 1]
    least = np.maximum(low, domain.input_low[level] - second)
    most = np.minimum(high, domain.input_high[level] - first)
    may = may & (least <= most + SMALLER * problem.prefix[level])
    # What rounding makes too short is as large as limits allow.
    least, most = (np.minimum(least, most), most) if sign >= 0 else (least, np.maximum(least, most))
    known = may & (most - least <= KNOWN * size)
    place = nodes.place.copy()
    place[:, a, 0] = np.maximum(first + low, domain.input_low[level])
    place[:, a, 1] = np.minimum(second + high, domain.input_high[level])
    s = problem.terms.s[level]
    value = nodes.value - np.maximum(s * least[:, None], s * most[:, None])
    nodes = nodes._replace(place=place, value=value)
    made = []
    for rows, one_value in ((known, True), (may & ~known, False)):
        if not rows.any():
            continue
        some, of_some = nodes.take(rows), Row._make([array[rows] for array in row])
        if one_value:
            child = with_known(level, some, of_some, problem.squares, least[rows])
        else:
            child = with_free(level, some, of_some, problem.squares)
        low_of, high_of = np.zeros(child.chosen.shape), np.zeros(child.chosen.shape)
        low_of[:, : some.low.shape[1]], high_of[:, : some.high.shape[1]] = some.low, some.high
        at = np.arange(len(child.width)), child.width - 1
        low_of[at], high_of[at] = least[rows], most[rows]
        made.append(child._replace(low=low_of, high=high_of))
    return made
