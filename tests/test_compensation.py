"""Valves that stick and have play, and are known: only moves that they execute, reversals larger by their play."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import same_decision, tank_model, tank_problem
from mampc.study import parse_study, run_study
from mampc.study.regulators import regulator_of
from referees import moved
from seeds import examples

STICKING = {"play": (2.0, 0.0), "both": (2.0, 1.0), "stiction": (2.0, 2.0)}
each_valve = pytest.mark.parametrize(("band", "jump"), STICKING.values(), ids=STICKING)
SAMPLES = examples(40, quick=14)
MODEL = tank_model()
SETTINGS = {"control_horizon": 3, "tail_horizon": 10.0}  # least sizes cost time, and more moves more
PROBLEM = tank_problem(MODEL, move_weight=0.03, **SETTINGS)


def loop(valves, jump=0.0, *, price=0.1, problem=PROBLEM, method="exact"):
    settings = {"polish": True, "warm_up": 0} if method == "alternating" else {}
    rules = mampc.MoveRules(price=price, min_size=1.05 * np.asarray(jump))
    return mampc.Regulator(mampc.MAMPC(problem, rules, method=method, **settings), valves=valves)


def run_of(regulator, valves, *, noise=0.0, steps=200, seed=0):
    reference = mampc.steps(steps, MODEL.y_op, [(5, MODEL.y_op + 1.0)])
    return mampc.simulate(
        MODEL, regulator, reference, noise=noise, seed=seed, valves=valves, input_disturbance=3.0
    )


@each_valve
def test_there_is_no_limit_cycle_and_fewer_moves_at_a_smaller_error(band, jump):
    valves = mampc.Valves(band=band, jump=jump)
    problem = PROBLEM if jump else replace(PROBLEM, control_horizon=5)  # the short one rests by chance
    without, compensated = (
        run_of(loop(*known, problem=problem), valves) for known in ((None,), (valves, jump))
    )
    assert not moved(compensated.u[100:]).any()
    assert moved(compensated.u).sum() < 0.7 * moved(without.u).sum()
    errors = [run.metrics(skip=10).tracking_error for run in (compensated, without)]
    assert errors[0] < 0.6 * errors[1]
    if jump:
        assert moved(without.u[100:]).sum() > 5  # it hunts


@each_valve
def test_under_noise_fewer_moves_do_at_no_larger_error(band, jump):
    valves = mampc.Valves(band=band, jump=jump)
    moves, errors = np.zeros(2), np.zeros(2)
    for seed in range(examples(3, quick=2)):
        for k, regulator in enumerate((loop(None), loop(valves, jump, price=0.4))):
            run = run_of(regulator, valves, noise=0.1, seed=seed)
            moves[k] += moved(run.u).sum()
            errors[k] += run.metrics(skip=10).tracking_error
    assert moves[1] < 0.8 * moves[0]
    assert errors[1] < errors[0]


@each_valve
@pytest.mark.parametrize("method", ["exact", "greedy", "alternating"])
def test_stems_are_where_they_are_planned_and_every_move_is_executed(band, jump, method):
    valves = mampc.Valves(band=band, jump=jump)
    run = run_of(loop(valves, jump, method=method), valves, noise=0.1, steps=60)
    planned = np.array([decision.plan[0] for decision in run.decisions])
    np.testing.assert_allclose(run.position, planned, atol=1e-9)
    np.testing.assert_array_equal(moved(run.u), moved(run.position))


def test_inputs_stay_within_their_limits_and_stems_are_known_where_these_cut_them_short():
    valves = mampc.Valves(band=4.0, jump=1.0)
    limits = mampc.Limits(u_min=MODEL.u_op - 3.0, u_max=MODEL.u_op + 3.0)
    problem = tank_problem(MODEL, limits=limits, **SETTINGS)
    regulator = loop(valves, 1.0, problem=problem)
    state, stems = regulator.initial_state(), valves.initial(MODEL.u_op)
    for k in range(30):
        decision = regulator.step(state, MODEL.y_op, MODEL.y_op + 5.0 * (-1) ** (k // 5))
        state, stems = decision.state, stems.moved(decision.u)
        assert (decision.u >= limits.u_min).all()
        assert (decision.u <= limits.u_max).all()
        np.testing.assert_allclose(state.controller.inputs[-1], stems.position, atol=1e-9)


def test_after_manual_operation_the_last_input_is_not_sent_again():
    valves = mampc.Valves(band=2.0, jump=1.0)
    regulator = loop(valves, 1.0, price=1e3)
    y, elsewhere = MODEL.y_op, MODEL.u_op + np.array([10.0, -5.0])
    state = regulator.step(regulator.initial_state(), y, y).state
    decision = regulator.step(state, y, y, u_applied=elsewhere, manual=[True, True])
    np.testing.assert_array_equal(decision.u, elsewhere)
    again = regulator.step(decision.state, y, y)
    np.testing.assert_array_equal(again.u, elsewhere)
    stuck = regulator.step(state, y, y, u_applied=elsewhere)  # nor where nobody said that it is in manual
    np.testing.assert_array_equal(stuck.u, elsewhere)


@each_valve
def test_units_decide_nothing(band, jump):
    inputs, scale = [], np.array([1e4, 1e-4])
    for unit in (np.ones(2), scale):
        model = replace(MODEL, B=MODEL.B / unit, u_op=unit * MODEL.u_op)
        limits = mampc.Limits(u_min=0.0 * unit, u_max=100.0 * unit)
        problem = tank_problem(model, move_weight=0.03 / unit**2, limits=limits, **SETTINGS)
        valves = mampc.Valves(band=band * unit, jump=jump * unit)
        regulator = loop(valves, jump * unit, problem=problem)
        reference = mampc.steps(SAMPLES, MODEL.y_op, [(5, MODEL.y_op + 1.0)])
        run = mampc.simulate(model, regulator, reference, valves=valves, input_disturbance=3.0 * unit)
        inputs.append(run.u / unit)
    np.testing.assert_allclose(*inputs, atol=1e-6)


def test_a_run_replays_and_comes_out_the_same_among_many():
    valves = mampc.Valves(band=2.0, jump=1.0)
    run = run_of(loop(valves, 1.0), valves, noise=0.1, steps=40)
    state = loop(valves, 1.0).initial_state(MODEL.u_op, MODEL.y_op)
    start = mampc.simulate(MODEL, loop(valves, 1.0), [*MODEL.y_op], steps=1).y[0]
    state = loop(valves, 1.0).initial_state(MODEL.u_op, start)
    assert mampc.replay(loop(valves, 1.0), state, mampc.Recording.of(run)) is None
    reference = mampc.steps(40, MODEL.y_op, [(5, MODEL.y_op + 1.0)])
    settings = {"noise": 0.1, "valves": valves, "input_disturbance": 3.0}
    batch = mampc.simulate_batch(MODEL, loop(valves, 1.0), reference, seeds=[0], **settings)
    np.testing.assert_array_equal(batch.u[0], run.u)
    regulator, y = loop(valves, 1.0), MODEL.y_op
    decision = regulator.step(state, y, y + 2.0)
    kept = regulator.state_from_json(decision.state.to_json())
    assert same_decision(regulator.step(kept, y, y - 1.0), regulator.step(decision.state, y, y - 1.0), atol=0)


def test_variants_of_a_bank_are_compensated_alike_each_within_its_limits():
    valves = mampc.Valves(band=4.0, jump=1.0)
    narrow = tank_problem(
        MODEL, tail_horizon=10.0, limits=mampc.Limits(u_min=MODEL.u_op - 2.0, u_max=MODEL.u_op + 2.0)
    )
    rules = mampc.MoveRules(price=0.1, min_size=1.05)
    wide = replace(narrow, limits=PROBLEM.limits)
    bank = mampc.ControllerBank({"narrow": mampc.MAMPC(narrow, rules), "wide": mampc.MAMPC(wide, rules)})
    regulator = mampc.Regulator(bank, valves=valves)
    names = ["narrow"] * 10 + ["wide"] * 10 + ["narrow"] * 10
    reference = mampc.steps(30, MODEL.y_op, [(2, MODEL.y_op + 4.0)])
    run = mampc.simulate(MODEL, regulator, reference, valves=valves, variant=names)
    planned = np.array([decision.plan[0] for decision in run.decisions])
    apart = np.abs(run.u - MODEL.u_op).max(axis=1)
    assert (apart[:10] <= 2.0).all()
    assert (apart[10:20] > 2.0).any()
    np.testing.assert_allclose(run.position[10:20], planned[10:20], atol=1e-9)
    with pytest.raises(mampc.MampcError, match="or a bank of them, received MPC"):
        mampc.Regulator(
            mampc.ControllerBank({"own": mampc.MAMPC(wide, rules), "plain": mampc.MPC(wide)}), valves=valves
        )


def test_what_valves_would_not_execute_is_refused():
    valves = mampc.Valves(band=2.0, jump=1.0)
    with pytest.raises(mampc.MampcError, match="min_size above the jump"):
        mampc.Regulator(mampc.MAMPC(PROBLEM, mampc.MoveRules(price=1.0, min_size=1.0)), valves=valves)
    with pytest.raises(mampc.MampcError, match="without levels"):
        mampc.Regulator(mampc.MAMPC(PROBLEM, mampc.MoveRules(levels=5.0, min_size=2.0)), valves=valves)
    with pytest.raises(mampc.MampcError, match="expected a MAMPC"):
        mampc.Regulator(mampc.MPC(PROBLEM), valves=valves)
    with pytest.raises(mampc.MampcError, match="valves"):
        mampc.Regulator(mampc.MAMPC(PROBLEM, mampc.MoveRules(price=1.0)), valves=2.0)
    other = loop(None).initial_state()
    with pytest.raises(mampc.MampcError, match="with valves"):
        loop(valves, 1.0).step(other, MODEL.y_op, MODEL.y_op)


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_inputs_stay_within_their_limits_and_states_go_to_text_and_back(seed):
    rng, valves = np.random.default_rng(seed), mampc.Valves(band=[2.0, 0.5], jump=[1.0, 0.0])
    regulator = loop(valves, [1.0, 0.0])
    state = regulator.initial_state()
    for _ in range(60):
        spoilt = [np.nan, 1e300, -np.inf, *rng.uniform(0, 100, 3)]
        told = {
            "u_applied": rng.choice(spoilt, 2) if rng.random() < 0.3 else None,
            "manual": rng.random(2) < 0.3 if rng.random() < 0.3 else None,
            "limits": mampc.Limits(u_min=rng.uniform(0, 60, 2), u_max=60.0) if rng.random() < 0.3 else None,
        }
        y = MODEL.y_op + rng.standard_normal(2) + (np.nan if rng.random() < 0.2 else 0.0)
        decision = regulator.step(state, y, MODEL.y_op + rng.uniform(-2, 2), **told)
        low, high = regulator.controller.range_now(told["limits"])
        assert (decision.u >= low).all()
        assert (decision.u <= high).all()
        state = decision.state
        assert regulator.state_from_json(state.to_json()).to_json() == state.to_json()


BANK = """
name = "bank"
steps = 12
dt = 10.0
plant = { kind = "model" }
model = { file = "model.json" }
actuators = { band = 2.0, jump = 1.0 }
[problem]
prediction_horizon = 8
control_horizon = 2
limits = { u_min = 0.0, u_max = 100.0 }
[reference]
initial = [0.0, 0.0]
changes = [{ at = 2, value = [2.0, 2.0] }]
[[scenarios]]
name = "one"
valves = { band = 2.0, jump = 1.0 }
switches = [{ at = 4, variant = "brisk" }]
[[controllers]]
name = "calm"
method = "exact"
rules = { price = 1.0 }
[[controllers]]
name = "brisk"
method = "exact"
rules = { price = 0.1 }
[[controllers]]
name = "both"
method = "bank"
variants = ["calm", "brisk"]
compensate = true
"""


def test_a_study_compensates_the_valves_of_a_bank(tmp_path):
    MODEL.save(tmp_path / "model.json")
    run = run_study(parse_study(BANK, folder=tmp_path)).runs["one"]["both"]
    np.testing.assert_allclose(run.position, [decision.plan[0] for decision in run.decisions], atol=1e-9)
    text = BANK.replace(
        'name = "calm"\nmethod = "exact"\nrules = { price = 1.0 }', 'name = "calm"\nmethod = "mpc"'
    )
    with pytest.raises(mampc.StudyError, match="'calm': compensate: expected rules"):
        run_study(parse_study(text, folder=tmp_path))


def test_a_compensated_controller_keeps_the_price_that_a_sweep_gives_it(tmp_path):
    alone = BANK[: BANK.index('[[controllers]]\nname = "both"')]
    study = parse_study(alone.replace("switches", "# switches") + "compensate = true\n", folder=tmp_path)
    brisk = study.controllers[-1]
    priced = brisk.model_copy(update={"rules": brisk.rules.model_copy(update={"price": 7.0})})
    assert regulator_of(study, MODEL, priced).controller.rules.price == 7.0
