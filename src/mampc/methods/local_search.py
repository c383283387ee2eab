"""Local search over patterns: forward selection of moves, then exchanges of one for another.

Symbols: S the pattern, d_S = -W f_S its optimum without limits with W = H_SS^-1, B = W H_S:, and for every
move j off S the gradient r_j = f_j + H_jS d_S and the curvature q_j = H_jj - H_jS B_:j that is left when S adapts.
Adding j gains r_j^2 / (2 q_j), dropping p loses d_p^2 / (2 W_pp), and after dropping p

    r'_j = r_j - B_pj d_p / W_pp,    q'_j = q_j + B_pj^2 / W_pp

so that all exchanges of one move for another are priced at once.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from time import perf_counter

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.exchanges import PatternNeighbours
from mampc.moves.pattern_solver import Incumbent, OnPattern, PatternSolver
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Sample

LEAST_GAIN = 1e-9  # of the cost without moves: smaller gains are not worth another exchange
LEAST_CURVATURE = 1e-14  # of a move's own: what others leave of it cannot be told from less
MOST_EXCHANGES = 200
TAKEN = 1e200  # curvature of a move that is on the pattern already: nothing to gain
ROUNDS = 3  # of local search, with limits priced in by the multipliers of the last


class LocalSearch:
    """Forward selection and exchanges on the quadratic 1/2 d' H d + f' d, under the rules; limits aside."""

    def __init__(self, condensed: CondensedQP, admissible: AdmissiblePatterns) -> None:
        self.condensed, self.admissible = condensed, admissible
        self._H, self._diagonal = condensed.H, np.diag(condensed.H).copy()

    def forward(self, f: Array, past: Allowance) -> BoolArray:
        """The pattern, shape (n_moves,), that adding the best move again and again leads to."""
        H = self._H
        exchanges = PatternNeighbours(self.admissible, past)
        r, q = f.copy(), self._diagonal.copy()
        rows = np.empty((0, len(f)))  # of a partial Cholesky factor
        while True:
            gain = np.where(exchanges.additions(), self._gain(r, q) - exchanges.added_price(), 0.0)
            best = int(gain.argmax())
            if not gain[best] > 0:
                return exchanges.pattern
            exchanges.change(added=best)
            pivot = 1 / np.sqrt(max(q[best], LEAST_CURVATURE * self._diagonal[best]))
            row = (H[best] - rows[:, best] @ rows) * pivot
            r -= row * (r[best] * pivot)
            q -= row * row
            q[best] = TAKEN
            rows = np.vstack([rows, row])

    def exchange(self, f: Array, past: Allowance, pattern: BoolArray, least_gain: float) -> BoolArray:
        """The pattern that the best addition, loss or exchange of a move leads to, again and again."""
        H, exchanges = self._H, PatternNeighbours(self.admissible, past, pattern)
        for _ in range(MOST_EXCHANGES):
            held = exchanges.held
            rows = H[held]
            try:
                W = np.linalg.inv(rows[:, held])
            except np.linalg.LinAlgError:  # moves that rounding cannot tell apart
                break
            d, B, w = -(W @ f[held]), W @ rows, np.diag(W)
            if not (w > 0).all():
                break
            r, q = f + d @ rows, self._diagonal - (rows * B).sum(axis=0)
            q[held] = TAKEN
            loss = 0.5 * d * d / w
            added = np.where(exchanges.additions(), self._gain(r, q) - exchanges.added_price(), 0.0)
            gains = [added.max()]
            choices: list[tuple[int | None, int | None]] = [(None, int(added.argmax()))]
            if len(held):
                dropped = exchanges.dropped_price() - loss
                gains.append(dropped.max())
                choices.append((int(held[dropped.argmax()]), None))
                to = self._gain(r - B * (d / w)[:, None], q + B * B / w[:, None])
                swapped = np.where(exchanges.swaps(), to - loss[:, None] - exchanges.swapped_price(), 0.0)
                row, column = divmod(int(swapped.argmax()), len(f))
                gains.append(swapped[row, column])
                choices.append((int(held[row]), column))
            best = int(np.argmax(gains))
            if not gains[best] > least_gain:
                break
            exchanges.change(*choices[best])
        return exchanges.pattern

    def offer(
        self,
        solver: PatternSolver,
        sample: Sample,
        f: Array,
        past: Allowance,
        best: Incumbent,
        deadline: float = np.inf,
    ) -> None:
        """Offer the plans of a local search, as `patterns` proposes them, to the incumbent.

        After the deadline, of `perf_counter`, none where there is a plan.
        """
        patterns, solved = self.patterns(sample, f, past), None
        with suppress(StopIteration):
            while True:
                pattern = next(patterns) if solved is None else patterns.send(solved)
                if best.moves is not None and perf_counter() > deadline:
                    return
                solved = solver.offer(sample, pattern, best, deadline, first=True)

    def patterns(self, sample: Sample, f: Array, past: Allowance) -> Generator[BoolArray, OnPattern, int]:
        """Patterns, each from the last, whose multipliers price the limits in; is sent the best moves on each.

        The first takes the linear term f, shape (n_moves,): best with limits priced in that plain MPC runs into.
        Returns how many there were.
        """
        least_gain = LEAST_GAIN * sample.constant
        pattern = self.forward(f, past)
        for number in range(ROUNDS):
            last, pattern = pattern, self.exchange(f, past, pattern, least_gain)
            if number and (pattern == last).all():
                return number
            solved = yield pattern
            if solved.multipliers is None or not solved.multipliers.any():
                return number + 1
            f, _ = self.condensed.relaxed_limits(sample, solved.multipliers)
        return ROUNDS

    def _gain(self, r: Array, q: Array) -> Array:
        """What a move gains, given its gradient and curvature, when it has at least its least size."""
        q = np.maximum(q, LEAST_CURVATURE * self._diagonal)
        if not self.admissible.sized:
            gain: Array = 0.5 * r * r / q
            return gain
        size = np.maximum(np.abs(r) / q, self.admissible.min_size)
        return np.asarray(np.abs(r) * size - 0.5 * q * size * size)
