"""Independent re-computations: the move rules by their definitions, sparse optima by brute force and by SCIP."""

from itertools import product

import numpy as np

TINY = 1e-9  # changes below are rounding


def moved(inputs, tolerance=TINY):
    """Which inputs change from one row to the next, shape (h - 1, m)."""
    return np.abs(np.diff(inputs, axis=0)) > tolerance


def counted(moves, counting):
    """How many moves a boolean array (samples, m) holds."""
    return int(moves.any(axis=1).sum() if counting == "simultaneous" else moves.sum())


def keeps_dwell(moves, dwell):
    """Whether moves (samples, m) of each input are at least `dwell` samples apart."""
    return all((np.diff(np.flatnonzero(of_input)) >= dwell).all() for of_input in moves.T)


def keeps_rules(rules, past, moves):
    """Whether future moves (nc, m) are admissible after the past inputs (h, m), word for word."""
    n_c, m = moves.shape
    before = moved(past)
    if rules.blocks is not None:
        starts = {sum(rules.blocks[:i]) for i in range(len(rules.blocks))}
        if any(moves[j].any() for j in range(n_c) if j not in starts):
            return False
    if rules.max_moves_per_step is not None and (moves.sum(axis=1) > rules.max_moves_per_step).any():
        return False
    if rules.max_moves is not None and moves.any():
        window = np.vstack([before[len(before) - (rules.sparsity_horizon - 1) :], moves])
        if counted(window, rules.counting) > rules.max_moves:
            return False
    for a in range(m):
        times = [-age for age in range(1, len(before) + 1) if before[-age, a]] + list(
            np.flatnonzero(moves[:, a])
        )
        if any(abs(t - j) < rules.dwell for j in np.flatnonzero(moves[:, a]) for t in times if t != j):
            return False
    return True


def charge(rules, moves):
    """The price of moves (nc, m)."""
    if rules.counting == "simultaneous":
        return rules.price * moves.any(axis=1).sum()
    return float((moves * np.broadcast_to(rules.price, moves.shape[1])).sum())


def all_patterns(n_c, m):
    """Every boolean array (nc, m)."""
    return [np.array(bits, dtype=bool).reshape(n_c, m) for bits in product((False, True), repeat=n_c * m)]
