"""Many closed loops as arrays: each is what `simulate` makes of its seed."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import random_model, tank_problem, tank_reference
from mampc import loads
from mampc.loop.batched_plans import BatchedExact
from seeds import deep, seeds

TANK = mampc.plants.QuadrupleTank()
SEEDS = (0, 1, 2, 7)
RULES = {
    "plain": None,
    "no rules": mampc.MoveRules(),
    "price": mampc.MoveRules(price=0.5),
    "prices": mampc.MoveRules(price=(0.2, 1.0)),
    "budget": mampc.MoveRules(max_moves=2, sparsity_horizon=4),
    "budget and price": mampc.MoveRules(max_moves=3, sparsity_horizon=3, price=0.3),
    "dwell": mampc.MoveRules(price=0.1, dwell=3),
    "together": mampc.MoveRules(price=0.3, counting="simultaneous", max_moves=2, sparsity_horizon=5),
    "one a step": mampc.MoveRules(price=0.1, max_moves_per_step=1),
    "blocks": mampc.MoveRules(price=0.1, blocks=(1, 2)),
}


def regulator(problem, rules=None, disturbance="output", **settings):
    if rules is None:
        controller = mampc.MPC(problem)
    else:  # without a limit of time, which a busy machine would reach in one run and not in the other
        controller = mampc.MAMPC(problem, rules, **(settings or {"time_limit": None}))
    estimator = mampc.KalmanFilter.offset_free(problem.model, disturbance=disturbance)
    return mampc.Regulator(controller, estimator)


def assert_equal_to_single_runs(plant, loop, reference, *, seeds=SEEDS, plant_tolerance=1e-8, **options):
    batch = mampc.simulate_batch(plant, loop, reference, seeds=seeds, **options)
    for s, seed in enumerate(seeds):
        own = plant[s] if isinstance(plant, list) else plant
        run = mampc.simulate(own, loop, reference, seed=seed, **options)
        unit = max(1.0, np.abs(run.u).max())
        np.testing.assert_allclose(batch.u[s], run.u, atol=1e-9 * unit, rtol=0)
        np.testing.assert_allclose(batch[s].y_measured, run.y_measured, rtol=1e-8, atol=plant_tolerance)
        np.testing.assert_allclose(batch.position[s], run.position, atol=1e-9 * unit, rtol=0)
        np.testing.assert_array_equal(batch.metrics()[s].moves, run.metrics().moves)
        np.testing.assert_array_equal(batch.r[s], run.r)
        np.testing.assert_array_equal(batch.v[s], run.v)
        assert batch.faults[s] == run.faults
    return batch


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("seed", seeds(3, quick=1))
def test_each_loop_equals_its_single_run(name, seed):
    rng = np.random.default_rng(seed)
    model = random_model(seed, n=2 + seed, m=2, l=1 + seed % 2, feedthrough=seed == 2)
    n_c = int(rng.integers(3, 5))
    limits = mampc.Limits(
        u_min=model.u_op - 1.0, u_max=model.u_op + 1.0, du_max=None if seed else 0.8,
        y_max=None if seed != 1 else model.y_op + 1.5,
    )  # fmt: skip
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=n_c, move_weight=0.05, limits=limits,
        tail_horizon=5.0 * (seed == 2),
    )  # fmt: skip
    plant = replace(model, B=1.2 * model.B)
    reference = mampc.steps(60, model.y_op, [(5, model.y_op + 1.0), (30, model.y_op - 0.5)])
    assert_equal_to_single_runs(
        plant, regulator(problem, RULES[name], "output" if seed else "input" if model.n_outputs == 2 else "output"),
        reference, noise=0.05, preview=seed == 1,
        loads=[loads.RandomWalk(size=0.05), loads.RandomSteps(size=0.3, every=20.0, at="output")],
    )  # fmt: skip


@pytest.mark.parametrize("name", ["plain", "price", "budget and price"])
def test_each_loop_of_a_nonlinear_plant_equals_its_single_run(name):
    loop = regulator(tank_problem(), RULES[name])
    batch = assert_equal_to_single_runs(TANK, loop, tank_reference(80), noise=0.1)
    assert len(batch) == len(SEEDS)
    assert batch.u.shape == batch.y.shape == (4, 80, 2)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_loops_without_noise_and_sensors_that_repeat_their_numbers_are_judged_alike(noise):
    loop = regulator(tank_problem(), RULES["price"])
    assert_equal_to_single_runs(TANK, loop, tank_reference(60), noise=noise, seeds=(0, 1))


@pytest.mark.parametrize("scale", [1e-5, 1e4])
def test_units_of_the_signals_decide_nothing(scale):
    model = random_model(4, n=3)
    scaled = replace(
        model, B=model.B / scale, C=model.C * scale, u_op=model.u_op * scale, y_op=model.y_op * scale
    )
    batches = []
    for unit, own in ((1.0, model), (scale, scaled)):
        problem = mampc.TrackingProblem(
            own, prediction_horizon=10, control_horizon=4, output_weight=1 / unit**2, move_weight=0.1 / unit**2,
            limits=mampc.Limits(u_min=own.u_op - unit, u_max=own.u_op + unit),
        )  # fmt: skip
        loop = regulator(problem, RULES["price"])
        batches.append(assert_equal_to_single_runs(own, loop, own.y_op + unit, steps=40, noise=0.05 * unit))
    np.testing.assert_allclose(batches[1].u, batches[0].u * scale, rtol=1e-6, atol=1e-8 * scale)


@pytest.mark.parametrize(
    "loop",
    [
        regulator(tank_problem(), mampc.MoveRules(max_moves=3), method="greedy"),
        regulator(tank_problem(), mampc.MoveRules(price=0.5, min_size=0.5)),
        regulator(tank_problem(control_horizon=10), mampc.MoveRules(price=0.5)),
    ],
    ids=["another method", "least sizes", "too many patterns for a table"],
)
def test_what_cannot_be_batched_is_simulated_one_by_one(loop):
    assert_equal_to_single_runs(TANK, loop, tank_reference(12), noise=0.1, seeds=(3, 4))


def test_each_loop_may_have_its_own_regulator():
    problem = tank_problem()
    bank = mampc.Regulator(mampc.MPC(problem), mampc.LoadBank(problem.model, noise=0.1))
    rule = mampc.Regulator(mampc.rivals.DeadBand(mampc.MPC(problem), size=1.0))
    price = regulator(problem, RULES["price"])
    own = [price, bank, rule]
    batch = mampc.simulate_batch(
        TANK, own, tank_reference(40), seeds=(0, 3, 3), noise=0.1, keep_decisions=True
    )
    for s, (loop, seed) in enumerate(zip(own, (0, 3, 3), strict=True)):
        run = mampc.simulate(TANK, loop, tank_reference(40), seed=seed, noise=0.1)
        np.testing.assert_allclose(batch.u[s], run.u, atol=1e-9, rtol=0)
        assert [d.status for d in batch.decisions[s]] == [d.status for d in run.decisions]
    with pytest.raises(mampc.MampcError, match="one per seed"):
        mampc.simulate_batch(TANK, own, tank_reference(4), seeds=range(2))


def test_values_of_a_setting_are_stepped_together_as_one_by_one(monkeypatch):
    problem, estimator = tank_problem(), mampc.KalmanFilter.offset_free(tank_problem().model)
    mpc = mampc.MPC(problem)
    controllers = [
        mpc, mampc.rivals.DeadBand(mpc, size=(0.5, 1.0)), mampc.rivals.Rounded(mpc, step=1.0, hysteresis=0.3),
        mampc.MAMPC(problem, mampc.MoveRules(price=0.3)), mampc.MAMPC(problem, mampc.MoveRules(price=3.0)),
    ]  # fmt: skip
    for bank in (False, True):
        own = mampc.LoadBank(problem.model, noise=0.1) if bank else estimator
        loops = [mampc.Regulator(controller, own) for controller in controllers]
        every = [loop for loop in loops for _ in range(2)]
        options = {"noise": 0.1, "loads": [loads.RandomSteps(size=1.0, every=200.0)]}
        seeds = [0, 1] * len(loops)
        with monkeypatch.context() as patch:
            patch.setattr("mampc.loop.batch.closed_loops", None)  # nothing is left for it
            batch = mampc.simulate_batch(TANK, every, tank_reference(60), seeds=seeds, **options)
        for s, loop in enumerate(every):
            run = mampc.simulate(TANK, loop, tank_reference(60), seed=seeds[s], **options)
            np.testing.assert_allclose(batch.u[s], run.u, atol=1e-8, rtol=0)


def test_limits_of_moves_stop_rounded_inputs_too():
    problem = tank_problem(limits=mampc.Limits(u_min=0.0, u_max=100.0, du_max=1.3))
    rule = mampc.rivals.Rounded(mampc.MPC(problem), step=2.0)
    batch = assert_equal_to_single_runs(
        TANK, mampc.Regulator(rule), tank_reference(30), noise=0.1, seeds=(0,)
    )
    moves = np.abs(np.diff(batch.u, axis=1))
    assert 1.29 < moves.max() <= 1.3 + 1e-9


def test_a_plant_with_measured_disturbances_and_faults():
    plant = mampc.plants.SolidOxideFuelCell()
    model = mampc.linearise(plant).discretise(0.5)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=4,
        limits=mampc.Limits(u_min=[70.0, 50.0], u_max=[120.0, 150.0]),
    )  # fmt: skip
    batch = assert_equal_to_single_runs(
        plant, regulator(problem, RULES["price"]), model.y_op - 8.0, steps=25, noise=0.2, seeds=(0, 1),
        plant_tolerance=1e-5,  # of the integrator, while gases run out
        loads=[loads.Steps(sizes=[300.0], times=[5.0], at="measured")],
    )  # fmt: skip
    assert batch.faults[0]


class Scalar:
    """A plant whose methods take one state only."""

    names = mampc.Names(("u",), ("y",), ("x",))
    u_op = (1.0,)

    def derivative(self, x, u):
        return np.array([float(u[0]) - float(x[0]) * abs(float(x[0]))])

    def output(self, x, u=None):
        return np.array([float(x[0])])

    def steady_state(self, u=None):
        return np.sqrt(np.asarray(self.u_op if u is None else u, dtype=float))


def test_a_plant_made_for_one_state_is_moved_loop_by_loop():
    model = mampc.linearise(Scalar()).discretise(0.5)
    problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=3)
    assert_equal_to_single_runs(Scalar(), regulator(problem, RULES["price"]), [1.3], steps=20, noise=0.02)


def test_each_loop_may_have_its_own_plant_reference_and_disturbance():
    model = random_model(1)
    plants = [replace(model, B=gain * model.B) for gain in (0.8, 1.0, 1.2)]
    loop = regulator(tank_problem(model), RULES["price"])
    references = model.y_op + np.arange(3.0)[:, None, None] * np.ones((3, 30, 2))
    load = 0.1 * np.random.default_rng(0).standard_normal((3, 30, 2))
    batch = mampc.simulate_batch(
        plants, loop, references, seeds=(5, 6, 7), noise=0.1, output_disturbance=load, u_initial=model.u_op
    )
    for s in range(3):
        run = mampc.simulate(
            plants[s], loop, references[s], seed=5 + s, noise=0.1, output_disturbance=load[s], u_initial=model.u_op
        )  # fmt: skip
        np.testing.assert_allclose(batch.u[s], run.u, atol=1e-9)


def test_decisions_are_kept_only_when_asked_for(tmp_path):
    loop = regulator(tank_problem(), RULES["price"])
    lean, full = (
        mampc.simulate_batch(TANK, loop, tank_reference(8), seeds=(0, 1), noise=0.1, keep_decisions=keep)
        for keep in (False, True)
    )
    np.testing.assert_allclose(lean.u, full.u, atol=1e-9)
    assert lean.decisions == ((), ())
    assert [len(decisions) for decisions in full.decisions] == [8, 8]
    full[1].to_csv(tmp_path / "loop.csv")
    with pytest.raises(mampc.MampcError, match="keep_decisions=True"):
        lean[1].to_csv(tmp_path / "loop.csv")


def test_metrics_of_all_loops_are_arrays_too():
    loop = regulator(tank_problem())
    metrics = mampc.simulate_batch(TANK, loop, tank_reference(20), seeds=range(5), noise=0.1).metrics(skip=5)
    assert len(metrics) == 5
    assert metrics.tracking_error.shape == (5,)
    assert metrics.moves.shape == (5, 2)
    assert metrics.tracking_error[2] == metrics[2].tracking_error


def test_most_loops_are_stepped_as_arrays(monkeypatch):
    loop, steps = regulator(tank_problem(), RULES["price"]), []
    monkeypatch.setattr(loop, "step", lambda *a, **k: steps.append(1) or mampc.Regulator.step(loop, *a, **k))
    mampc.simulate_batch(TANK, loop, tank_reference(50), seeds=range(20), noise=0.1)
    assert len(steps) < 0.02 * 50 * 20


def test_the_best_pattern_is_that_of_the_search():
    problem = tank_problem(random_model(2), limits=mampc.Limits())
    controller = mampc.MAMPC(problem, RULES["prices"])
    patterns = controller.condensed
    rng, m, n = np.random.default_rng(0), 2, 3
    from mampc.loop.batched_plans import batched_plans

    [plans] = batched_plans([controller], preview=False)
    assert isinstance(plans, BatchedExact)
    x, u = rng.standard_normal((50, n)), np.tile(problem.model.u_op, (50, 1))
    r = problem.model.y_op + rng.standard_normal((50, 2))
    parameters = np.array([patterns.parameter.vector(*row) for row in zip(x, u, r, strict=True)])
    decided, first = plans.decide(parameters, u[:, None])
    assert decided.mean() > 0.9
    for s in np.flatnonzero(decided):
        decision = controller.step(controller.initial_state(u[s]), x[s], r[s])
        np.testing.assert_allclose(first[s], decision.u, atol=1e-9)
    assert first.shape == (50, m)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": []}, "seeds: expected at least one"),
        ({"seeds": [-1]}, "seeds: expected a whole number"),
        ({"seeds": 5}, "seeds: expected whole numbers"),
        ({"seeds": [0], "plant": None}, "plant: expected a plant"),
        ({"seeds": [0], "reference": [[1.0], [1.0, 2.0]]}, "reference: expected real numbers"),
        ({"seeds": [0], "output_disturbance": "much"}, "output_disturbance: expected real numbers"),
        ({"seeds": [0], "valves": 1.0}, "valves: expected a mampc.Valves"),
        (
            {"seeds": [0, 1], "output_disturbance": np.zeros((3, 20, 2))},
            "output_disturbance: expected a course",
        ),
        ({"seeds": [0], "loads": loads.RandomWalk(size=1.0)}, "loads: expected a list"),
        ({"seeds": [0], "loads": [3]}, "loads: expected mampc.loads"),
        ({"seeds": [0], "loads": [loads.RandomWalk(size=1.0, at="measured")]}, "measured disturbances"),
        ({"seeds": [0], "keep_decisions": "no"}, "keep_decisions: expected true or false"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(options, message):
    with pytest.raises(mampc.MampcError, match=message):
        mampc.simulate_batch(
            **{"plant": TANK, "regulator": regulator(tank_problem()), "reference": tank_reference(20)}
            | options
        )


def test_a_list_of_plants_needs_one_per_seed():
    with pytest.raises(mampc.MampcError, match="plant: expected one, or one per seed"):
        mampc.simulate_batch([TANK] * 3, regulator(tank_problem()), tank_reference(20), seeds=[0, 1])


def bank_regulator(problem, rules, noise):
    bank = mampc.LoadBank(problem.model, noise=noise)
    if rules is None:
        return mampc.Regulator(mampc.MPC(problem), bank)
    return mampc.Regulator(mampc.MAMPC(problem, rules), bank, value_of_information=True)


@pytest.mark.parametrize("name", ["plain", "price", "budget and price"])
@pytest.mark.parametrize("seed", [1, *deep(0)])
def test_each_loop_with_a_load_bank_equals_its_single_run(name, seed):
    model = random_model(seed, n=2 + seed, m=2, l=1 + seed, feedthrough=seed == 1)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=3, move_weight=0.05,
        limits=mampc.Limits(u_min=model.u_op - 1.0, u_max=model.u_op + 1.0),
    )  # fmt: skip
    reference = mampc.steps(60, model.y_op, [(5, model.y_op + 1.0), (30, model.y_op - 0.5)])
    assert_equal_to_single_runs(
        replace(model, B=1.2 * model.B), bank_regulator(problem, RULES[name], 0.05), reference,
        noise=0.05, preview=seed == 1, loads=[loads.RandomSteps(size=0.3, every=20.0)],
    )  # fmt: skip


def test_a_load_bank_on_a_nonlinear_plant_with_outputs_doubted_equals_its_single_runs():
    loop = bank_regulator(tank_problem(), RULES["price"], 0.1)
    jump = np.zeros((80, 2))
    jump[40, 0] = 500.0
    assert_equal_to_single_runs(TANK, loop, tank_reference(80), noise=0.1, output_disturbance=jump)
