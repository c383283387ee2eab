"""Problems at any conditioning, and their optimum in 60 digits: brute force over patterns, signs and active limits."""

from itertools import product
from typing import NamedTuple

import mpmath
import numpy as np

import mampc
from referees import all_patterns, charge, keeps_rules

mpmath.mp.dps = 60
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


def case_of(seed):
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
    rules = mampc.MoveRules(**{name: options[name] for name in used})
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_p, control_horizon=n_c, output_weight=weight, move_weight=move_weight,
        limits=mampc.Limits(**limits), tail_horizon=float(rng.choice([0, 0, 10.0])) if pole <= 1 else 0.0,
    )  # fmt: skip
    x = rng.standard_normal(model.n_states) * (rng.random() < 0.5)
    reference = model.y_op + unit * rng.choice([-1.0, 1.0, 0.3], 1)
    return Case(kind, problem, rules, np.tile(u, (rules.memory, 1)), x, reference)


def matrix(array):
    return mpmath.matrix(np.atleast_2d(array).tolist())


class Referee:
    """The cost of one case as a quadratic form in 60 digits, with the tail summed up until it vanishes."""

    def __init__(self, case):
        problem, model = case.problem, case.problem.model
        n_p, n_c, m = problem.prediction_horizon, problem.control_horizon, model.n_inputs
        n = n_c * m
        A, B, C, D = (matrix(a) for a in (model.A, model.B, model.C, model.D))
        q, y_op = mpmath.mpf(float(problem.output_weight[0, 0])), mpmath.mpf(float(model.y_op[0]))
        r = mpmath.mpf(float(case.reference[0])) - y_op
        u = [
            mpmath.mpf(float(a)) - mpmath.mpf(float(b))
            for a, b in zip(case.past[-1], model.u_op, strict=True)
        ]
        L = mpmath.mpf(problem.tail_horizon)
        gamma = L / (1 + L)
        # Per column: a state under each unit move, and last that without moves.
        X = mpmath.zeros(model.n_states, n + 1)
        for i in range(model.n_states):
            X[i, n] = mpmath.mpf(float(case.x[i]))
        U = mpmath.zeros(m, n + 1)
        for a in range(m):
            U[a, n] = u[a]
        self.H, weight, i = mpmath.zeros(n + 1, n + 1), mpmath.mpf(1), 0
        while True:
            if i < n_c:
                for a in range(m):
                    U[a, i * m + a] = mpmath.mpf(1)
            row = -(C * X + D * U)
            row[0, n] += r
            self.H += (q * weight) * (row.T * row)
            if i >= n_p:
                weight = gamma ** (i + 1 - n_p)
                size = max(abs(entry) for entry in row)
                if weight * size**2 < mpmath.mpf(10) ** -30:
                    break
            X, i = A * X + B * U, i + 1
        R = problem.move_weight
        for j in range(n_c if problem.weigh_first_move else 0):
            for a, b in product(range(m), repeat=2):
                self.H[j * m + a, j * m + b] += mpmath.mpf(float(R[a, b]))
        self.case, self.n = case, n

    def cost(self, plan):
        """The cost of planned inputs, price aside."""
        at = [mpmath.mpf(float(v)) for v in self.case.past[-1]]
        d = []
        for row in plan:
            now = [mpmath.mpf(float(v)) for v in row]
            d += [b - a for a, b in zip(at, now, strict=True)]
            at = now
        z = matrix([*d, mpmath.mpf(1)]).T
        return (z.T * self.H * z)[0]

    def optimum(self):
        """The least objective of all admissible plans."""
        problem, rules, past = self.case.problem, self.case.rules, self.case.past
        found = [
            (self._rough(pattern.ravel()), charge(rules, pattern), pattern.ravel())
            for pattern in all_patterns(problem.control_horizon, problem.model.n_inputs)
            if keeps_rules(rules, past, pattern)
        ]
        # A pattern costs at least its optimum without limits, which is worked out in full one after another.
        found.sort(key=lambda entry: entry[0] + entry[1])
        best = mpmath.inf
        for rough, price, pattern in found:
            if rough + price >= best:
                continue
            best = min(best, self._on(pattern) + mpmath.mpf(float(price)))
        return best

    def _rough(self, pattern):
        return self._solve(np.flatnonzero(pattern).tolist(), [])[0]

    def _solve(self, moves, rows):
        """Least cost, moves and multipliers where rows a'd = b hold, each a dict of the moves and b."""
        k, e = len(moves), len(rows)
        constant = self.H[self.n, self.n]
        if not k:
            return constant, [], []
        K, h = mpmath.zeros(k + e, k + e), mpmath.zeros(k + e, 1)
        for i, a in enumerate(moves):
            h[i] = -self.H[a, self.n]
            for j, b in enumerate(moves):
                K[i, j] = self.H[a, b]
        for i, (row, value) in enumerate(rows):
            for j, a in enumerate(moves):
                K[k + i, j] = K[j, k + i] = mpmath.mpf(row.get(a, 0))
            h[k + i] = value
        z = mpmath.lu_solve(K, h)
        d = [z[i] for i in range(k)]
        quadratic = sum(d[i] * self.H[a, b] * d[j] for i, a in enumerate(moves) for j, b in enumerate(moves))
        linear = sum(d[i] * self.H[a, self.n] for i, a in enumerate(moves))
        return constant + 2 * linear + quadratic, d, [z[k + i] for i in range(e)]

    def _on(self, pattern):
        """The least cost on one pattern, by trying all signs of moves with a least size."""
        problem, rules = self.case.problem, self.case.rules
        m, limits = problem.model.n_inputs, problem.limits
        moves = np.flatnonzero(pattern).tolist()
        size = np.broadcast_to(np.asarray(rules.min_size, float), m)
        bounds = []
        for i in moves:
            a = i % m
            u = mpmath.mpf(float(self.case.past[-1][a]))
            row = {k: 1 for k in moves if k <= i and k % m == a}
            for sign, limit in ((1, limits.u_max[a]), (-1, limits.u_min[a])):
                if np.isfinite(limit):
                    value = sign * (mpmath.mpf(float(limit)) - u)
                    bounds.append((dict.fromkeys(row, sign), value))
        best = mpmath.inf
        sized = [i for i in moves if size[i % m] > 0]
        for signs in product((1, -1), repeat=len(sized)):
            least = [
                ({i: -sign}, -mpmath.mpf(float(size[i % m]))) for i, sign in zip(sized, signs, strict=True)
            ]
            best = min(best, self._within(moves, bounds + least, best))
        return best

    def _within(self, moves, bounds, cutoff):
        """The least cost with a'd <= b for all bounds, or one of at least the cutoff; infinite if there is none.

        The dual active-set method of Goldfarb and Idnani: each point is the optimum of a relaxation.
        """
        near = mpmath.mpf(10) ** -30
        active = []
        while True:
            cost, d, _ = self._solve(moves, [bounds[i] for i in active])
            if cost >= cutoff:
                return cost
            at = dict(zip(moves, d, strict=True))
            excess = [sum(v * at[k] for k, v in row.items()) - b for row, b in bounds]
            worst = max(range(len(bounds)), key=lambda i: excess[i], default=None)
            if worst is None or excess[worst] <= near:
                return cost
            row, left, pulls = bounds[worst][0], excess[worst], None
            while True:
                if pulls is None:
                    pulls = self._solve(moves, [bounds[i] for i in active])[2]
                step, change = self._direction(moves, [bounds[i][0] for i in active], row)
                gain = -sum(v * step[k] for k, v in row.items())
                full = left / gain if gain > near else mpmath.inf
                ratios = [
                    -pull / by if by < -near else mpmath.inf for pull, by in zip(pulls, change, strict=True)
                ]
                at = min(range(len(ratios)), key=lambda i: ratios[i], default=None)
                length = full if at is None else min(full, ratios[at])
                if length == mpmath.inf:
                    return mpmath.inf
                pulls = [pull + length * by for pull, by in zip(pulls, change, strict=True)]
                left -= length * gain
                if length == full:
                    active.append(worst)
                    break
                del active[at], pulls[at]

    def _direction(self, moves, rows, row):
        """How moves and multipliers of the active rows change per unit of pull of one more row."""
        k, e = len(moves), len(rows)
        K, h = mpmath.zeros(k + e, k + e), mpmath.zeros(k + e, 1)
        for i, a in enumerate(moves):
            h[i] = -mpmath.mpf(row.get(a, 0))
            for j, b in enumerate(moves):
                K[i, j] = self.H[a, b]
            for j, other in enumerate(rows):
                K[k + j, i] = K[i, k + j] = mpmath.mpf(other.get(a, 0))
        z = mpmath.lu_solve(K, h)
        return dict(zip(moves, z[:k], strict=True)), list(z[k:])
