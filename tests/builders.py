"""Models, problems and plain re-computations that several tests share."""

from functools import lru_cache

import numpy as np

import mampc

PAPER_STEPS = ((5, (2.0, 2.0)), (50, (-1.0, -1.5)), (100, (1.0, 0.5)))  # deviations from the operating point


def random_model(seed, n=3, m=2, l=2, *, feedthrough=False, radius=0.9):
    """A stable model with an operating point; its slowest pole has the given radius."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    B, C = rng.standard_normal((n, m)), rng.standard_normal((l, n))
    D = rng.standard_normal((l, m)) if feedthrough else None
    return mampc.StateSpace(A, B, C, D, 1.0, rng.uniform(-2, 2, m), rng.uniform(-2, 2, l))


def random_weight(rng, size, low=0.1):
    """A positive definite weight, now a scalar, now a diagonal, now a full matrix."""
    kind = rng.integers(3)
    if kind == 0:
        return float(rng.uniform(low, 2))
    if kind == 1:
        return rng.uniform(low, 2, size)
    root = rng.standard_normal((size, size))
    return root @ root.T / size + low * np.eye(size)


def tank_model(dt=10.0):
    """The exact linear model of the quadruple tank."""
    return mampc.linearise(mampc.plants.QuadrupleTank()).discretise(dt)


def tank_problem(model=None, **changes):
    """The paper's horizons and weights on the tank."""
    settings = {
        "prediction_horizon": 10, "control_horizon": 5, "move_weight": 0.1,
        "limits": mampc.Limits(u_min=0.0, u_max=100.0),
    }  # fmt: skip
    return mampc.TrackingProblem(tank_model() if model is None else model, **(settings | changes))


@lru_cache
def identified_tank():
    """A fourth-order model of the tank from noisy pseudo-random binary inputs."""
    u = mampc.prbs(order=8, amplitude=25.0, hold=5, mean=[50.0, 50.0])
    data = mampc.excite(mampc.plants.QuadrupleTank(), u, dt=10.0, noise=0.1, seed=1)
    return mampc.n4sid(data, order=4, feedthrough=False).model


def tank_reference(samples=145):
    """The staircase of the tank study, absolute."""
    plant = mampc.plants.QuadrupleTank()
    y_op = plant.output(plant.steady_state())
    return mampc.steps(samples, y_op, [(k, y_op + change) for k, change in PAPER_STEPS])


def predicted(model, x, plan, samples, input_disturbance=0.0, output_disturbance=0.0):
    """Outputs y_0 .. y_{samples-1} of the model under planned inputs, held after the last one."""
    outputs = []
    for i in range(samples):
        u = plan[min(i, len(plan) - 1)] + input_disturbance - model.u_op
        outputs.append(model.y_op + model.C @ x + model.D @ u + output_disturbance)
        x = model.A @ x + model.B @ u
    return np.array(outputs)


def violation_scale(problem):
    """Per output the square root of its weight, or of that of the cheapest move, by its largest step response."""
    model, n_p = problem.model, problem.prediction_horizon
    rest = np.tile(model.u_op, (n_p + 1, 1))
    steps = [model.response(rest + unit) - model.y_op for unit in np.eye(model.n_inputs)]
    reach = np.abs(steps).max(axis=1)
    moving = (np.diag(problem.move_weight)[:, None] / np.maximum(reach, 1e-12) ** 2).min(axis=0)
    return np.sqrt(np.maximum(np.abs(np.diag(problem.output_weight)), moving))


def fading(n_p):
    """rho_1 .. rho_np: how much of the violation each sample may have."""
    return 1 - 0.5 * np.arange(n_p) / max(n_p - 1, 1)


def cost_of(problem, x, u_previous, reference, plan, input_disturbance=0.0, output_disturbance=0.0):
    """The cost of planned inputs as `TrackingProblem` states it, by simulating the model."""
    n_p, limits = problem.prediction_horizon, problem.limits
    y = predicted(problem.model, x, plan, n_p + 1, input_disturbance, output_disturbance)
    error = distance(problem, y, reference)
    changes = np.diff(np.vstack([u_previous, plan]), axis=0)
    weighed = changes if problem.weigh_first_move else changes[1:]
    excess = np.maximum(0.0, np.maximum(y - limits.y_max, limits.y_min - y))[1:]
    scaled = violation_scale(problem) * (excess / fading(n_p)[:, None]).max(axis=0)
    ranked = problem.output_weight * np.sqrt(
        np.outer(*[np.where(problem.zoned, problem.rank_weights, 1.0)] * 2)
    )
    away = y - aims(problem, y, reference)
    drawn = np.where(problem.zoned, problem.zone_pull, 0.0) * np.diag(ranked) * (away**2 - error**2)
    return (
        np.einsum("ia,ab,ib", error, ranked, error)
        + drawn.sum()
        + np.einsum("ja,ab,jb", weighed, problem.move_weight, weighed)
        + np.sum(problem.output_limit_weights * (scaled + scaled**2 / 2))
        + cost_of_inputs(problem, plan[np.minimum(np.arange(n_p + 1), len(plan) - 1)])
    )


def distance(problem, y, reference):
    """How far outputs (T, l) are from their references or zones, (l,) or (T, l), or a `Zone` of that shape."""
    if isinstance(reference, mampc.Zone):
        low, high = reference.low, reference.high
    else:
        low, high = reference - problem.zone_below, reference + problem.zone_above
    return y - np.clip(y, np.broadcast_to(low, y.shape), np.broadcast_to(high, y.shape))


def aims(problem, y, reference):
    """What a `zone_pull` draws outputs (T, l) to: references, the middle of a `Zone`, or inside its only end."""
    if not isinstance(reference, mampc.Zone):
        return np.broadcast_to(reference, y.shape)
    inside = [np.where(np.isfinite(a), a, np.where(np.isfinite(b), b, 0.0)) for a, b in (
        (problem.zone_below, problem.zone_above), (problem.zone_above, problem.zone_below)
    )]  # fmt: skip
    low, high = (np.broadcast_to(end, y.shape) for end in (reference.low, reference.high))
    one_sided = np.clip(y, low + inside[0], np.maximum(high - inside[1], low + inside[0]))
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(low) & np.isfinite(high), (low + high) / 2, one_sided)


def cost_of_inputs(problem, u):
    """What inputs (T, m) cost where they are, as `TrackingProblem` states it."""
    c, limits = problem.u_cost, problem.limits
    cheapest = np.where(c > 0, limits.u_min, np.where(c < 0, limits.u_max, 0.0))
    apart = u - (0.0 if problem.u_target is None else problem.u_target)
    return np.einsum("ia,ab,ib", apart, problem.u_target_weight, apart) + np.sum((u - cheapest) @ c)


def same_decision(a, b, atol=1e-12):
    """Whether two decisions agree: to the rounding that a warm start leaves, or exactly with atol=0."""
    return a.status is b.status and all(
        np.allclose(getattr(a, name), getattr(b, name), rtol=atol, atol=atol, equal_nan=True)
        for name in ("plan", "changes", "objective", "lower_bound")
    )


def sample_data(condensed, u_previous, **parameter):
    """The condensed data of one sample."""
    return condensed.sample(condensed.parameter.vector(u_previous=u_previous, **parameter), u_previous)


def load_bank(problem):
    """A load bank for a problem, which guesses the noise where it can."""
    try:
        return mampc.LoadBank.for_problem(problem)
    except mampc.MampcError:
        return mampc.LoadBank(problem.model, noise=0.05)


def random_problem(seed, **changes):
    """A problem with limits of its inputs, a state, a reference and inputs applied, off their operating point."""
    model = random_model(seed, n=3, m=2, l=2)
    settings = {
        "prediction_horizon": 8, "control_horizon": 4,
        "limits": mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1),
    }  # fmt: skip
    rng = np.random.default_rng(seed)
    return (
        mampc.TrackingProblem(model, **(settings | changes)), rng.standard_normal(3),
        model.y_op + rng.standard_normal(2), model.u_op + rng.uniform(-1, 1, 2),
    )  # fmt: skip
