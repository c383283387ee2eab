"""Problems at any conditioning, and their optimum in 120 digits: brute force over patterns, signs and active limits.

The digits are Arb's, which encloses every result in a ball that holds the truth. mpmath's 60 digits, at a thirtieth of
the speed, check them.
"""

from collections.abc import Callable
from itertools import pairwise, product
from math import inf
from typing import Any, NamedTuple

import flint
import mpmath
import numpy as np

import mampc
from referees import all_patterns, charge, keeps_rules

mpmath.mp.dps, flint.ctx.dps = 60, 120
TINY = 1e-30
KINDS = ("double integrator", "triple integrator", "unstable", "slow", "ordinary")
RULES = ("max_moves", "price", "dwell", "max_moves_per_step", "blocks", "min_size")


class Case(NamedTuple):
    kind: str
    problem: mampc.TrackingProblem
    rules: mampc.MoveRules
    past: np.ndarray
    x: np.ndarray
    reference: np.ndarray


def model_of(kind, rng, m):
    """A model of one kind with m inputs, feedthrough and operating point in turn, outputs in any unit."""
    pole = 1.0
    if kind == "double integrator":
        A, B = [[1, 1], [0, 1]], [[0.5], [1]]
    elif kind == "triple integrator":
        A, B = [[1, 1, 0.5], [0, 1, 1], [0, 0, 1]], [[1 / 6], [0.5], [1]]
    elif kind == "unstable":
        pole = float(rng.choice([1.01, 1.05, 1.1, 1.2, 1.4, 1.8]))
        A, B = [[pole, 0], [0, 0.6]], [[1], [0.5]]
    elif kind == "slow":
        pole = 1 - float(rng.choice([1e-6, 1e-4, 1e-2]))
        A, B = [[pole, 0], [0, 0.8]], [[0.1], [0.3]]
    else:
        A, B = [[0.9, 0.2], [0, 0.7]], [[0.4], [0.6]]
    A, B = np.array(A, float), np.array(B, float)
    n = len(A)
    if m > 1:
        B = np.hstack([B, rng.uniform(-1, 1, (n, m - 1))])
    unit = float(10.0 ** rng.choice([-6, -3, 0, 0, 3, 6]))
    C = np.zeros((1, n))
    C[0, 0] = unit
    if kind in ("unstable", "slow", "ordinary"):
        C[0, 1] = unit
    D = unit * rng.uniform(0.1, 1, (1, m)) if rng.random() < 0.25 else None
    u_op = rng.uniform(-50, 50, m) if rng.random() < 0.5 else np.zeros(m)
    return mampc.StateSpace(A, B, C, D, 1.0, u_op, unit * rng.uniform(-5, 5, 1)), unit, pole


def case_of(seed, *, moves_limited=False):
    """A case of its own for each seed; with or without limits of the moves beside those of the inputs."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    n_c, m = [(5, 1), (4, 1), (3, 2), (2, 2)][rng.integers(4)]
    model, unit, pole = model_of(kind, rng, m)
    longest = 200 if pole <= 1 else max(20, min(200, int(30 / np.log(pole))))
    n_p = int(rng.integers(20, longest + 1))
    used = {RULES[seed // len(KINDS) % len(RULES)], *(name for name in RULES if rng.random() < 0.2)}
    limited = rng.random() < 0.5
    weight = unit**-2 * float(rng.choice([1.0, 1e-2]))
    move_weight = float(rng.choice([0.0, 1e-8, 1.0, 0.1]))
    if m > model.n_outputs:  # else not every move is determined
        move_weight = max(move_weight, 1e-8)
    options = {
        "max_moves": int(rng.integers(1, 3 + (n_c * m > 4))),
        "price": float(10 ** rng.uniform(-3, 0)),
        "dwell": 2,
        "max_moves_per_step": 1,
        "blocks": (1, n_c - 1),
        "min_size": float(10 ** rng.uniform(-2, 0)),
    }
    u = model.u_op + rng.uniform(-1, 1, m) * (rng.random() < 0.5)
    limits = {}
    if limited:
        size = 10 ** rng.uniform(-1.5, 0.5)
        limits = {"u_min": u - size * rng.uniform(0, 1, m), "u_max": u + size * rng.uniform(0.3, 1, m)}
    if limited:  # a larger move would never be possible
        options["min_size"] = min(options["min_size"], 0.9 * float((limits["u_max"] - limits["u_min"]).min()))
    if moves_limited:
        limits["du_max"] = 10 ** rng.uniform(-1.5, 0.5, m)
        options["min_size"] = min(options["min_size"], 0.9 * float(limits["du_max"].min()))
    rules = mampc.MoveRules(**{name: options[name] for name in used})
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_p, control_horizon=n_c, output_weight=weight, move_weight=move_weight,
        limits=mampc.Limits(**limits), tail_horizon=float(rng.choice([0, 0, 10.0])) if pole <= 1 else 0.0,
    )  # fmt: skip
    x = rng.standard_normal(model.n_states) * (rng.random() < 0.5)
    reference = model.y_op + unit * rng.choice([-1.0, 1.0, 0.3], 1)
    return Case(kind, problem, rules, np.tile(u, (rules.memory, 1)), x, reference)


class Arithmetic(NamedTuple):
    """Numbers of many digits: from floats, matrices of zeros, solutions of linear equations, and back to floats."""

    number: Callable[[Any], Any]
    zeros: Callable[[int, int], Any]
    solve: Callable[[Any, Any], Any]
    rounded: Callable[[Any], float]

    def matrix(self, rows):
        """The matrix of these rows."""
        found = self.zeros(len(rows), len(rows[0]))
        for i, row in enumerate(rows):
            for j, entry in enumerate(row):
                found[i, j] = self.number(entry)
        return found


def rounded(ball):
    """The double next to a ball, which has to tell it."""
    if ball != inf and ball.rel_accuracy_bits() < 60:
        raise ArithmeticError(f"expected digits that determine a double, received {ball}")
    return float(ball)


ARB = Arithmetic(flint.arb, flint.arb_mat, flint.arb_mat.solve, rounded)
MPMATH = Arithmetic(mpmath.mpf, mpmath.zeros, mpmath.lu_solve, float)


class Referee:
    """The cost of one case as a quadratic form in many digits, with the tail summed up until it vanishes."""

    def __init__(self, case, arithmetic=ARB):
        problem, model = case.problem, case.problem.model
        n_p, n_c, m = problem.prediction_horizon, problem.control_horizon, model.n_inputs
        self.case, self.arithmetic = case, arithmetic
        number, n = arithmetic.number, n_c * m
        A, B, C, D = (arithmetic.matrix(a) for a in (model.A, model.B, model.C, model.D))
        # Per column: a state, inputs and errors under each unit move, and last those without moves.
        X, U, r = (arithmetic.zeros(rows, n + 1) for rows in (model.n_states, m, 1))
        for i in range(model.n_states):
            X[i, n] = number(case.x[i])
        for a in range(m):
            U[a, n] = number(case.past[-1, a]) - number(model.u_op[a])
        r[0, n] = number(case.reference[0]) - number(model.y_op[0])
        q, L = number(problem.output_weight[0, 0]), number(problem.tail_horizon)
        gamma = L / (1 + L)
        self.n, self.H, i = n, arithmetic.zeros(n + 1, n + 1), 0
        while True:
            for a in range(m if i < n_c else 0):
                U[a, i * m + a] = number(1.0)
            error = r - C * X - D * U
            weight = gamma ** max(0, i - n_p)
            self.H += error.transpose() * error * (q * weight)
            if i > n_p and weight * max(abs(error[0, j]) for j in range(n + 1)) ** 2 < TINY:
                break
            X, i = A * X + B * U, i + 1
        R = problem.move_weight
        for j in range(n_c if problem.weigh_first_move else 0):
            for a, b in product(range(m), repeat=2):
                self.H[j * m + a, j * m + b] += number(R[a, b])

    def cost(self, plan):
        """The cost of planned inputs, price aside."""
        number, inputs = self.arithmetic.number, [self.case.past[-1], *plan]
        d = [
            number(b) - number(a)
            for last, now in pairwise(inputs)
            for a, b in zip(last.tolist(), now.tolist(), strict=True)
        ]
        z = self.arithmetic.matrix([[*d, 1.0]])
        return self.arithmetic.rounded((z * self.H * z.transpose())[0, 0])

    def optimum(self):
        """The least objective of all admissible plans, infinite if there is none."""
        problem, rules, past = self.case.problem, self.case.rules, self.case.past
        found = [
            (self._free(pattern.ravel()), charge(rules, pattern), pattern.ravel())
            for pattern in all_patterns(problem.control_horizon, problem.model.n_inputs)
            if keeps_rules(rules, past, pattern)
        ]
        # A pattern costs at least its optimum without limits, which is worked out in full one after another.
        found.sort(key=lambda entry: float(entry[0] + entry[1]))
        best = inf
        for free, price, pattern in found:
            if not free + price >= best:
                best = min(best, self._on(pattern) + self.arithmetic.number(price))
        return self.arithmetic.rounded(best)

    def _free(self, pattern):
        return self._solve(np.flatnonzero(pattern).tolist(), [])[0]

    def _stationary(self, moves, rows, linear, values):
        """Moves d and multipliers p with H d + A'p = linear and A d = values, each row of A a dict."""
        k, e = len(moves), len(rows)
        K, h = self.arithmetic.zeros(k + e, k + e), self.arithmetic.zeros(k + e, 1)
        for i, a in enumerate(moves):
            h[i, 0] = linear[i]
            for j, b in enumerate(moves):
                K[i, j] = self.H[a, b]
            for j, row in enumerate(rows):
                K[k + j, i] = K[i, k + j] = self.arithmetic.number(row.get(a, 0.0))
        for j, value in enumerate(values):
            h[k + j, 0] = value
        z = self.arithmetic.solve(K, h)
        z = [z[i, 0] for i in range(k + e)]
        return z[:k], z[k:]

    def _solve(self, moves, bounds):
        """Least cost, moves and multipliers where bounds, pairs of a row and its value, hold as equations."""
        constant = self.H[self.n, self.n]
        if not moves:
            return constant, [], []
        linear, values = [self.H[a, self.n] for a in moves], [value for _, value in bounds]
        d, pulls = self._stationary(moves, [row for row, _ in bounds], [-f for f in linear], values)
        cost = constant + sum(f * v for f, v in zip(linear, d, strict=True))
        return cost - sum(p * b for p, b in zip(pulls, values, strict=True)), d, pulls

    def _on(self, pattern):
        """The least cost on one pattern, by trying all signs of moves with a least size."""
        problem, rules, number = self.case.problem, self.case.rules, self.arithmetic.number
        m, limits = problem.model.n_inputs, problem.limits
        moves = np.flatnonzero(pattern).tolist()
        size = np.broadcast_to(np.asarray(rules.min_size, float), m)
        bounds = []
        for i in moves:
            a = i % m
            u = number(self.case.past[-1, a])
            for sign, limit in ((1.0, limits.u_max[a]), (-1.0, limits.u_min[a])):
                if np.isfinite(limit):
                    row = dict.fromkeys((k for k in moves if k <= i and k % m == a), sign)
                    bounds.append((row, sign * (number(limit) - u)))
            if np.isfinite(limits.du_max[a]):
                bounds += [({i: sign}, number(limits.du_max[a])) for sign in (1.0, -1.0)]
        best = inf
        sized = [i for i in moves if size[i % m] > 0]
        for signs in product((1.0, -1.0), repeat=len(sized)):
            least = [({i: -sign}, -number(size[i % m])) for i, sign in zip(sized, signs, strict=True)]
            best = min(best, self._within(moves, bounds + least, best))
        return best

    def _within(self, moves, bounds, cutoff):
        """The least cost with a'd <= b for all bounds, or one of at least the cutoff; infinite if there is none.

        The dual active-set method of Goldfarb and Idnani: each point is the optimum of a relaxation.
        """
        active = []
        while True:
            cost, d, pulls = self._solve(moves, [bounds[i] for i in active])
            if cost >= cutoff:
                return cost
            at = dict(zip(moves, d, strict=True))
            excess = [sum(v * at[k] for k, v in row.items()) - b for row, b in bounds]
            worst = max(set(range(len(bounds))) - set(active), key=lambda i: excess[i], default=None)
            if worst is None or excess[worst] <= TINY:
                return cost
            row, left = bounds[worst][0], excess[worst]
            while True:
                step, change = self._stationary(
                    moves,
                    [bounds[i][0] for i in active],
                    [-row.get(a, 0.0) for a in moves],
                    [0.0] * len(active),
                )
                gain = -sum(v * step[moves.index(k)] for k, v in row.items())
                full = left / gain if gain > TINY else inf
                ratios = [-p / by if by < -TINY else inf for p, by in zip(pulls, change, strict=True)]
                first = min(range(len(ratios)), key=lambda i: ratios[i], default=None)
                length = full if first is None else min(full, ratios[first])
                if length == inf:
                    return inf
                pulls = [p + length * by for p, by in zip(pulls, change, strict=True)]
                left -= length * gain
                if length is full:
                    active.append(worst)
                    break
                del active[first], pulls[first]
