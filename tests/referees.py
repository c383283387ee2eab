"""Independent re-computations: the move rules by their definitions, sparse optima by brute force and by SCIP."""

from itertools import product
from typing import NamedTuple

import clarabel
import numpy as np
import pyscipopt
from scipy import sparse

import mampc
from builders import cost_of, cost_of_inputs, fading, predicted, violation_scale

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


def keeps_timings(rules, problem, past, plan):
    """Whether courses of on/off inputs (nc, m), after the past inputs (h, m), keep their times and starts."""
    levels = rules.levels if isinstance(rules.levels, tuple) else (rules.levels,) * plan.shape[1]
    dt, course, first = problem.model.dt, np.vstack([past, plan]), len(past)
    for a, entry in enumerate(levels):
        if not isinstance(entry, mampc.OnOff):
            continue
        on = problem.limits.u_max[a] if entry.on is None else entry.on
        is_on = course[:, a] == on
        switched = np.flatnonzero(is_on[1:] != is_on[:-1]) + 1
        for before, now in zip([None, *switched], switched, strict=False):
            least = entry.min_off if is_on[now] else entry.min_on
            if now >= first and before is not None and (now - before) * dt < least:
                return False
            starts = [t for t in switched if is_on[t] and 0 <= (now - t) * dt < 3600.0]
            most = entry.starts_per_hour
            if now >= first and is_on[now] and most is not None and len(starts) > most:
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


class Program(NamedTuple):
    """The tracking problem of one sample as a dense program in z = (a, d), by simulating unit moves.

    minimise constant + 1/2 z' H z + f' z  subject to  rows z <= bounds; a are the outputs' scaled violations
    and d the moves, time-major.
    """

    H: np.ndarray
    f: np.ndarray
    constant: float
    rows: np.ndarray
    bounds: np.ndarray


def program_of(problem, x, u_previous, reference):
    """The dense program, from `predicted` outputs alone."""
    model, limits, n_c, n_p = (
        problem.model,
        problem.limits,
        problem.control_horizon,
        problem.prediction_horizon,
    )
    m, l, n = model.n_inputs, model.n_outputs, n_c * model.n_inputs
    rest = np.tile(u_previous, (n_c, 1))
    free = predicted(model, x, rest, n_p + 1)
    to_inputs = np.kron(np.tri(n_c), np.eye(m))  # u - u_previous = to_inputs d
    theta = np.array(
        [(predicted(model, x, rest + unit.reshape(n_c, m), n_p + 1) - free).ravel() for unit in to_inputs.T]
    ).T
    zoned = np.tile((problem.zone_below > 0) | (problem.zone_above > 0), n_p + 1)
    q = np.tile(np.diag(problem.output_weight), n_p + 1)
    Q, R = np.kron(np.eye(n_p + 1), problem.output_weight), np.kron(np.eye(n_c), problem.move_weight)
    Q[zoned] *= problem.zone_pull
    error = (np.broadcast_to(reference, free.shape) - free).ravel()
    scale, w = violation_scale(problem), problem.output_limit_weight
    H = np.zeros((l + n, l + n))
    H[:l, :l] = w * np.eye(l)
    H[l:, l:] = 2 * (theta.T @ Q @ theta + R)
    f = np.concatenate([np.full(l, w), -2 * theta.T @ Q @ error])
    samples = np.minimum(np.arange(n_p + 1), n_c - 1)
    held = np.tile(u_previous, (n_p + 1, 1))
    over_horizon = to_inputs.reshape(n_c, m, n)[samples].reshape(-1, n)
    W = np.kron(np.eye(n_p + 1), problem.u_target_weight)
    apart = held.ravel() - np.tile(np.zeros(m) if problem.u_target is None else problem.u_target, n_p + 1)
    H[l:, l:] += 2 * over_horizon.T @ W @ over_horizon
    f[l:] += over_horizon.T @ (2 * W @ apart + np.tile(problem.u_cost, n_p + 1))
    none, violation = np.zeros((n, l)), np.kron(fading(n_p)[:, None], np.diag(1 / scale))
    rows = np.block([
        [none, to_inputs], [none, -to_inputs], [none, np.eye(n)], [none, -np.eye(n)],
        [-violation, theta[l:]], [-violation, -theta[l:]], [-np.eye(l), np.zeros((l, n))],
    ])  # fmt: skip
    predicted_free = free[1:].ravel()
    bounds = np.concatenate([
        np.tile(limits.u_max - u_previous, n_c), np.tile(u_previous - limits.u_min, n_c),
        np.tile(limits.du_max, 2 * n_c),
        np.tile(limits.y_max, n_p) - predicted_free, predicted_free - np.tile(limits.y_min, n_p), np.zeros(l),
    ])  # fmt: skip
    limited = np.isfinite(bounds)
    constant = float(error @ Q @ error) + cost_of_inputs(problem, held)
    rows, bounds = rows[limited], bounds[limited]
    if zoned.any():  # an error of either sign for each value, between the violations and the moves
        k = int(zoned.sum())
        of_zones = np.diag(2 * (1 - problem.zone_pull) * q[zoned])
        H = np.block([
            [H[:l, :l], np.zeros((l, k)), H[:l, l:]], [np.zeros((k, l)), of_zones, np.zeros((k, n))],
            [H[l:, :l], np.zeros((n, k)), H[l:, l:]],
        ])  # fmt: skip
        f = np.concatenate([f[:l], np.zeros(k), f[l:]])
        rows = np.hstack([rows[:, :l], np.zeros((len(rows), k)), rows[:, l:]])
        away = error[zoned]  # of the free outputs, from the reference
        above, below = (np.tile(width, n_p + 1)[zoned] for width in (problem.zone_above, problem.zone_below))
        for sign, room in ((1.0, away + above), (-1.0, below - away)):
            finite = np.isfinite(room)
            wide = np.hstack([np.zeros((k, l)), -sign * np.eye(k), sign * theta[zoned]])
            rows, bounds = np.vstack([rows, wide[finite]]), np.concatenate([bounds, room[finite]])
    return Program(H, f, constant, rows, bounds)


def best_on(program, pattern, n_violations, at_least=None, at_most=None):
    """The least cost with moves on a pattern (n_moves,) alone, price aside; infinite where there is none.

    `at_least` and `at_most`, (n_moves,), bound the moves of the pattern further.
    """
    kept = np.concatenate([np.ones(n_violations, dtype=bool), pattern])
    rows, bounds = [program.rows[:, kept]], [program.bounds]
    for sign, limit in ((-1.0, at_least), (1.0, at_most)):
        if limit is not None and np.isfinite(limit[pattern]).any():
            unit = sign * np.eye(len(kept))[n_violations:][pattern][:, kept]
            finite = np.isfinite(limit[pattern])
            rows.append(unit[finite])
            bounds.append(sign * limit[pattern][finite])
    A, b = np.vstack(rows), np.concatenate(bounds)
    idle = ~A.any(axis=1)
    if (b[idle] < -1e-12).any():
        return np.inf
    A, b = A[~idle], b[~idle]
    H, f = program.H[np.ix_(kept, kept)], program.f[kept]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    settings.max_threads = 1
    for settings.equilibrate_enable in (True, False):  # either way a few of our programs do not converge
        cones = [clarabel.NonnegativeConeT(len(b))]
        P, C = sparse.csc_matrix(np.triu(H)), sparse.csc_matrix(A)
        solution = clarabel.DefaultSolver(P, f, C, b, cones, settings).solve()
        if solution.status == clarabel.SolverStatus.PrimalInfeasible:
            return np.inf
        if solution.status == clarabel.SolverStatus.Solved:
            return program.constant + solution.obj_val
    raise AssertionError(f"clarabel: {solution.status}")


def best_on_every_pattern(problem, rules, x, u_previous, reference):
    """The least cost, price aside, on every pattern of `all_patterns`, least sizes kept by trying all signs."""
    program = program_of(problem, x, u_previous, reference)
    n_c, m = problem.control_horizon, problem.model.n_inputs
    v = len(program.f) - n_c * m
    size = np.tile(np.broadcast_to(rules.min_size, m), n_c)
    values = []
    for pattern in all_patterns(n_c, m):
        sized = np.flatnonzero(pattern.ravel() & (size > 0))
        best = np.inf
        for signs in product((-1, 1), repeat=len(sized)):
            at_least, at_most = np.full(n_c * m, -np.inf), np.full(n_c * m, np.inf)
            for i, sign in zip(sized, signs, strict=True):
                (at_least if sign > 0 else at_most)[i] = sign * size[i]
            best = min(best, best_on(program, pattern.ravel(), v, at_least, at_most))
        values.append(best)
    return np.array(values)


def objective_of(problem, rules, x, past, reference, plan):
    """The objective of planned inputs by simulation, price included."""
    return cost_of(problem, x, past[-1], reference, plan) + charge(rules, moved(np.vstack([past[-1:], plan])))


def assert_best_of_all_patterns(problem, rules, x, reference):
    """The exact method proves the plan that costs least on any pattern, and says what it costs."""
    sparse = mampc.MAMPC(problem, rules)
    past = sparse.initial_state().inputs
    decision = sparse.step(sparse.initial_state(), x, reference)
    assert decision.status is mampc.Status.OPTIMAL
    objective = objective_of(problem, rules, x, past, reference, decision.plan)
    np.testing.assert_allclose(decision.objective, objective, rtol=1e-9)
    patterns = all_patterns(problem.control_horizon, problem.model.n_inputs)
    prices = [charge(rules, p) if keeps_rules(rules, past, p) else np.inf for p in patterns]
    costs = best_on_every_pattern(problem, rules, x, past[-1], reference)
    np.testing.assert_allclose(decision.objective, min(costs + prices), rtol=1e-6)


def scip_bounds(problem, rules, x, u_previous, reference, seconds):
    """Lower and upper bound of the sparse optimum from rest, by SCIP on the big-M form; price and budget alike.

    Every move needs finite limits; blocks, least sizes and limits per sample are left to brute force.
    """
    n_c, m = problem.control_horizon, problem.model.n_inputs
    program, n = program_of(problem, x, u_previous, reference), n_c * m
    l = len(program.f) - n  # violations
    scip = pyscipopt.Model()
    scip.hideOutput()
    for name, value in {
        "limits/time": seconds,
        "timing/clocktype": 1,
        "limits/gap": 0.0,
        "numerics/feastol": 1e-9,
    }.items():
        scip.setParam(name, value)
    z = [scip.addVar(lb=None) for _ in range(l + n)]
    on = [scip.addVar(vtype="B") for _ in range(n)]
    most = np.tile(np.minimum(problem.limits.du_max, problem.limits.u_max - problem.limits.u_min), n_c)
    for row, bound in zip(program.rows, program.bounds, strict=True):
        scip.addCons(pyscipopt.quicksum(row[i] * z[i] for i in np.flatnonzero(row)) <= bound)
    for d, moves, size in zip(z[l:], on, most, strict=True):
        scip.addCons(d <= size * moves)
        scip.addCons(-d <= size * moves)
    counted_ = on
    if rules.counting == "simultaneous":
        counted_ = [scip.addVar(vtype="B") for _ in range(n_c)]
        for i in range(n):
            scip.addCons(on[i] <= counted_[i // m])
    if rules.max_moves is not None:
        scip.addCons(pyscipopt.quicksum(counted_) <= rules.max_moves)
    for first in range(n - (rules.dwell - 1) * m):
        if rules.dwell > 1:
            scip.addCons(pyscipopt.quicksum(on[first + k * m] for k in range(rules.dwell)) <= 1)
    # 1/2 z' H z = 1/2 |L' z|^2 <= curved
    curved, roots = scip.addVar(lb=None), [scip.addVar(lb=None) for _ in z]
    for column, root in zip(np.linalg.cholesky(program.H).T, roots, strict=True):
        scip.addCons(pyscipopt.quicksum(column[i] * z[i] for i in np.flatnonzero(column)) == root)
    scip.addCons(pyscipopt.quicksum(0.5 * root * root for root in roots) <= curved)
    linear = pyscipopt.quicksum(program.f[i] * z[i] for i in range(l + n))
    scip.setObjective(curved + linear + rules.price * pyscipopt.quicksum(counted_))
    scip.optimize()
    return program.constant + scip.getDualbound(), program.constant + scip.getObjVal()


def scip_on_levels(problem, rules, levels, x, u_previous, reference, seconds):
    """Lower and upper bound of the optimum of one input on levels, by SCIP with a binary for each level."""
    n_c, l = problem.control_horizon, problem.model.n_outputs
    program = program_of(problem, x, np.asarray(u_previous), reference)
    scip = pyscipopt.Model()
    scip.hideOutput()
    for name, value in {"limits/time": seconds, "timing/clocktype": 1, "limits/gap": 0.0}.items():
        scip.setParam(name, value)
    z = [scip.addVar(lb=None) for _ in range(l + n_c)]
    at = [[scip.addVar(vtype="B") for _ in levels] for _ in range(n_c)]
    on = [scip.addVar(vtype="B") for _ in range(n_c)]
    most = max(levels) - min(levels)
    for row, bound in zip(program.rows, program.bounds, strict=True):
        scip.addCons(pyscipopt.quicksum(row[i] * z[i] for i in np.flatnonzero(row)) <= bound)
    u = [
        float(u_previous[0]),
        *(pyscipopt.quicksum(v * b for v, b in zip(levels, row, strict=True)) for row in at),
    ]
    for j in range(n_c):
        scip.addCons(pyscipopt.quicksum(at[j]) == 1)
        scip.addCons(z[l + j] == u[j + 1] - u[j])
        scip.addCons(z[l + j] <= most * on[j])
        scip.addCons(-z[l + j] <= most * on[j])
    if rules.max_moves is not None:
        scip.addCons(pyscipopt.quicksum(on) <= rules.max_moves)
    for first in range(n_c - rules.dwell + 1):
        if rules.dwell > 1:
            scip.addCons(pyscipopt.quicksum(on[first : first + rules.dwell]) <= 1)
    curved, roots = scip.addVar(lb=None), [scip.addVar(lb=None) for _ in z]
    for column, root in zip(np.linalg.cholesky(program.H).T, roots, strict=True):
        scip.addCons(pyscipopt.quicksum(column[i] * z[i] for i in np.flatnonzero(column)) == root)
    scip.addCons(pyscipopt.quicksum(0.5 * root * root for root in roots) <= curved)
    linear = pyscipopt.quicksum(program.f[i] * z[i] for i in range(l + n_c))
    scip.setObjective(curved + linear + rules.price * pyscipopt.quicksum(on))
    scip.optimize()
    return program.constant + scip.getDualbound(), program.constant + scip.getObjVal()
