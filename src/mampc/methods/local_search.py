"""Local search over patterns: forward selection of moves, then exchanges of one for another.

Symbols: S the pattern, d_S = -W f_S its optimum without limits with W = H_SS^-1, B = W H_S:, and for every
move j off S the gradient r_j = f_j + H_jS d_S and the curvature q_j = H_jj - H_jS B_:j that is left when S adapts.
Adding j gains r_j^2 / (2 q_j), dropping p loses d_p^2 / (2 W_pp), and after dropping p

    r'_j = r_j - B_pj d_p / W_pp,    q'_j = q_j + B_pj^2 / W_pp

so that all exchanges of one move for another are priced at once.

Multipliers say nothing of a limit that a pattern has not run into yet: where moves are bounded, one that does the work
of three looks as good. So a plan that runs into limits is exchanged move by move, with those at a bound held there, and
each exchange is made sure of by its program.
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
TRIALS = 3  # exchanges that are tried before a plan with limits counts as the best of its neighbours
MOST_TRIALS = 60


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
        pattern, best, tried = self.forward(f, past), None, 0
        for _ in range(ROUNDS):
            last, pattern = pattern, self.exchange(f, past, pattern, least_gain)
            if tried and (pattern == last).all():
                break
            tried += 1
            solved = yield pattern
            if solved.moves is not None:
                best = pattern, solved
            if solved.multipliers is None or not solved.multipliers.any():
                break
            f, _ = self.condensed.relaxed_limits(sample, solved.multipliers)
        if best is not None and best[1].multipliers is not None and best[1].multipliers.any():
            tried += yield from self._one_by_one(sample, past, *best, least_gain)
        return tried

    def _one_by_one(
        self, sample: Sample, past: Allowance, pattern: BoolArray, solved: OnPattern, least_gain: float
    ) -> Generator[BoolArray, OnPattern, int]:
        """Patterns from one whose plan runs into limits to ever better neighbours; returns how many were tried."""
        tried = 0
        while True:
            for better in self._neighbours(sample, past, pattern, solved, least_gain):
                if tried == MOST_TRIALS:
                    return tried
                tried += 1
                answer = yield better
                if answer.moves is not None:  # it is better than all before
                    pattern, solved = better, answer
                    break
            else:
                return tried

    def _neighbours(
        self, sample: Sample, past: Allowance, pattern: BoolArray, solved: OnPattern, least_gain: float
    ) -> list[BoolArray]:
        """The neighbours of a pattern that seem the best, moves at their bounds held there."""
        assert solved.moves is not None
        d, f, H, v = solved.moves, sample.f_moves, self._H, self.condensed.n_violations
        r = g = f + H @ d
        low, high = np.full(len(d), -np.inf), np.full(len(d), np.inf)
        bounded = self.condensed.bounds.n_simple - v
        low[:bounded], high[:bounded] = sample.lower[v : v + bounded], sample.upper[v : v + bounded]
        at_bound = np.zeros(len(d), dtype=bool)
        if solved.multipliers is not None:
            r = self.condensed.relaxed_limits(sample, solved.multipliers)[0] + H @ d
            at_bound[:bounded] = solved.multipliers[v : v + bounded] != 0
        exchanges = PatternNeighbours(self.admissible, past, pattern)
        held = exchanges.held
        free = held[~at_bound[held]]
        try:
            W = np.linalg.inv(H[np.ix_(free, free)])
        except np.linalg.LinAlgError:  # moves that rounding cannot tell apart
            return []
        if not (np.diag(W) > 0).all():
            return []
        B = W @ H[free]
        left = H - H[:, free] @ B  # curvature once free moves adapt, all pairs
        q, w = np.diag(left).copy(), np.ones(len(d))
        q[free], w[free] = 1.0, np.diag(W)
        loss = np.where(at_bound, 0.5 * q * d * d - g * d, 0.5 * d * d / w)[held]
        step = np.where(at_bound, d, d / w)[held]
        toward = left[held]
        toward[~at_bound[held]] = B
        more = np.where(at_bound[held, None], 0.0, toward**2 / w[held, None])

        added = self._gain(r, q, np.where(r < 0, high, -low)) - exchanges.added_price()
        added = np.where(exchanges.additions(), added, 0.0)
        dropped = exchanges.dropped_price() - loss
        r_left = r - toward * step[:, None]
        swapped = self._gain(r_left, q + more, np.where(r_left < 0, high, -low)) - loss[:, None]
        swapped = np.where(exchanges.swaps(), swapped - exchanges.swapped_price(), 0.0)
        gains = np.concatenate([added, dropped, swapped.ravel()])
        found = []
        for choice in np.argsort(-gains, kind="stable")[:TRIALS].tolist():
            if not gains[choice] > least_gain:
                break
            better, n = pattern.copy(), len(d)
            if choice < n:
                better[choice] = True
            elif choice < n + len(held):
                better[held[choice - n]] = False
            else:
                row, column = divmod(choice - n - len(held), n)
                better[held[row]], better[column] = False, True
            found.append(better)
        return found

    def _gain(self, r: Array, q: Array, room: Array | None = None) -> Array:
        """What a move gains, given its gradient and curvature, of at least its least size and at most its room."""
        q = np.maximum(q, LEAST_CURVATURE * self._diagonal)
        if not self.admissible.sized and room is None:
            gain: Array = 0.5 * r * r / q
            return gain
        size = np.maximum(np.abs(r) / q, self.admissible.min_size)
        if room is not None:
            size = np.minimum(size, room)
        return np.asarray(np.abs(r) * size - 0.5 * q * size * size)
