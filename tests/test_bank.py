"""Variants of a controller are switched while the loop runs: bumpless, pure, and recorded so that replay follows."""

import numpy as np
import pytest

import mampc
from builders import identified_tank, tank_problem
from mampc.study import parse_study, run_study
from studies import short_study

TANK = mampc.plants.QuadrupleTank()
PRICES = {"calm": 2.0, "brisk": 0.05}
ESTIMATOR = mampc.KalmanFilter.offset_free(identified_tank())  # of a variant and of its controller alone


def variants(model=None):
    problem = tank_problem(model or identified_tank())
    made = {
        name: mampc.MAMPC(problem, mampc.MoveRules(price=price, max_moves=4, sparsity_horizon=n))
        for (name, price), n in zip(PRICES.items(), (3, 6), strict=True)
    }
    return made | {"plain": mampc.MPC(problem)}


def reference(steps=60):
    y_op = TANK.output(TANK.steady_state())
    return mampc.steps(steps, y_op, [(5, y_op + 2.0), (30, y_op - 1.0)])


def switched(steps=60):
    return ["brisk" if k < 25 else "plain" if k < 40 else "calm" for k in range(steps)]


def run(**settings):
    regulator = mampc.Regulator(mampc.ControllerBank(variants()), ESTIMATOR)
    return regulator, mampc.simulate(TANK, regulator, reference(), noise=0.1, progress=False, **settings)


@pytest.mark.parametrize("name", ["calm", "brisk", "plain"])
def test_a_variant_decides_as_its_controller_alone(name):
    _, ours = run(variant=name)
    alone = mampc.simulate(
        TANK, mampc.Regulator(variants()[name], ESTIMATOR), reference(), noise=0.1, progress=False
    )
    np.testing.assert_array_equal(ours.u, alone.u)
    assert {decision.variant for decision in ours.decisions} == {name}


def test_the_first_variant_decides_where_none_is_named():
    assert {decision.variant for decision in run()[1].decisions} == {"calm"}


def test_a_switch_plans_from_the_inputs_that_are_there():
    _, ours = run(variant=switched())
    before = np.vstack([ours.u_initial, ours.u[:-1]])
    planned = np.array([decision.plan[0] - decision.changes[0] for decision in ours.decisions])
    np.testing.assert_allclose(planned, before, atol=1e-9)
    moves = ours.metrics().moves.sum()
    assert (
        run(variant="calm")[1].metrics().moves.sum() < moves < run(variant="plain")[1].metrics().moves.sum()
    )


def test_moves_made_under_another_variant_count_in_a_budget():
    bank = mampc.ControllerBank(variants())
    state = bank.initial_state()
    x, r = np.zeros(bank.problem.model.n_states), bank.problem.model.y_op
    for k in range(3):  # every sample moves both inputs
        state = bank.step(state, x, r + 3.0 * (-1) ** k, variant="plain").state
    decision = bank.step(state, x, r + 3.0, variant="brisk")
    assert mampc.Remark.BUDGET_EXCEEDED in decision.remarks
    assert not decision.moves.any()


def test_a_recorded_run_is_replayed_with_the_variants_that_decided(tmp_path):
    regulator, ours = run(variant=switched())
    ours.to_csv(tmp_path / "run.csv")
    recording = mampc.Recording.from_csv(tmp_path / "run.csv", TANK.names)
    assert list(recording.variant) == switched()
    start = regulator.initial_state(ours.u_initial, ours.y[0])
    again = mampc.Regulator(mampc.ControllerBank(variants()))
    assert mampc.replay(again, start, recording) is None


def test_many_loops_are_each_as_one_loop():
    regulator, ours = run(variant=switched(), seed=1)
    batch = mampc.simulate_batch(
        TANK, regulator, reference(), seeds=[0, 1], noise=0.1, variant=switched(), progress=False
    )
    np.testing.assert_allclose(batch.u[1], ours.u, atol=1e-9)


STUDY = """
[[scenarios]]
name = "switched"
noise = 0.1
switches = [{ at = 30, variant = "calm" }, { at = 10, variant = "plain" }]

[[controllers]]
name = "calm"
method = "exact"
rules = { price = 2.0 }

[[controllers]]
name = "plain"
method = "mpc"

[[controllers]]
name = "both"
method = "bank"
variants = ["calm", "plain"]
"""


def study(old="", new=""):
    return parse_study(short_study(STUDY.replace(old, new, 1), steps=40, until="[[scenarios]]", skip=(15, 0)))


def test_a_study_switches_where_its_scenario_says_so():
    result = run_study(study())
    decided = [decision.variant for decision in result.runs["switched"]["both"].decisions]
    assert decided == ["calm"] * 10 + ["plain"] * 20 + ["calm"] * 10
    assert {decision.variant for decision in result.runs["switched"]["plain"].decisions} == {None}


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('variants = ["calm", "plain"]', 'variants = ["calm", "swift"]', "among calm, plain"),
        ('variants = ["calm", "plain"]', "", "names of other controllers"),
        ('variants = ["calm", "plain"]', 'variants = ["plain"]', "switches to calm, plain"),
        ('method = "mpc"', 'method = "mpc"\nreference_filter = { rate = 1.0 }', "a variant of a bank"),
        ('method = "bank"', 'method = "mpc"', "names of other controllers"),
        ('method = "bank"', 'method = "bank"\nrules = { price = 1.0 }', "neither rules nor settings"),
    ],
)
def test_a_study_says_what_is_wrong_with_a_bank(old, new, expected):
    with pytest.raises(mampc.StudyError, match=expected):
        study(old, new)


def test_states_are_kept_as_text():
    regulator, ours = run(variant=switched())
    state = regulator.initial_state(ours.u_initial)
    for k, name in enumerate(["plain", "calm", "brisk"]):
        decision = regulator.step(state, ours.y_measured[k], ours.r[-1], variant=name)
        state = regulator.state_from_json(decision.state.to_json())
        assert state.to_json() == decision.state.to_json()


def test_variants_with_other_bounds_share_a_state():
    """A limit of moves adds bounds to the program; active ones are kept where they belong to it."""
    problem = tank_problem(identified_tank(), limits=mampc.Limits(u_min=45.0, u_max=55.0))
    tight = tank_problem(problem.model, limits=mampc.Limits(u_min=45.0, u_max=55.0, du_max=1.0))
    bank = mampc.ControllerBank({"usual": mampc.MPC(problem), "gentle": mampc.MPC(tight)})
    regulator = mampc.Regulator(bank)
    names = ["usual", "gentle"] * 20
    ours = mampc.simulate(TANK, regulator, reference(40), variant=names, progress=False)
    assert set(ours.statuses) == {"optimal"}
    assert np.abs(np.diff(ours.u, axis=0))[::2].max() <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (lambda: mampc.ControllerBank({}), "by name"),
        (lambda: mampc.ControllerBank([mampc.MPC(tank_problem(identified_tank()))]), "by name"),
        (lambda: mampc.ControllerBank({"a": 1}), "MPC or MAMPC"),
        (lambda: mampc.ControllerBank(variants() | {"x": mampc.MPC(tank_problem(
            identified_tank(), prediction_horizon=30))}), "horizons"),
        (lambda: run(variant="fast"), "one of calm, brisk, plain"),
        (lambda: run(variant=["calm"]), "each of 60 samples"),
        (lambda: run(variant=3), "each of 60 samples"),
        (lambda: mampc.simulate(TANK, mampc.Regulator(variants()["plain"]), reference(), variant="calm"), "Bank"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_words(made, expected):
    with pytest.raises(mampc.MampcError, match=expected):
        made()


@pytest.mark.parametrize("estimator", ["kalman", "bank", "counting"])
def test_arrays_step_every_variant_as_one_loop_does(estimator, monkeypatch):
    """Loops under a bank go as arrays; the few ordinary steps are those that other controllers have too."""
    model = identified_tank()
    made = mampc.ControllerBank(variants(model))
    loads = None if estimator == "kalman" else mampc.LoadBank(model, noise=0.1)
    regulator = mampc.Regulator(made, loads, value_of_information=estimator == "counting")
    ours = mampc.simulate(
        TANK, regulator, reference(40), noise=0.1, variant=switched(40), seed=1, progress=False
    )
    stepped, step = [], mampc.Regulator.step
    monkeypatch.setattr(mampc.Regulator, "step", lambda *a, **k: stepped.append(1) or step(*a, **k))
    batch = mampc.simulate_batch(
        TANK, regulator, reference(40), seeds=[0, 1], noise=0.1, variant=switched(40), progress=False
    )
    np.testing.assert_allclose(batch.u[1], ours.u, atol=1e-9)
    assert len(stepped) < 40


def test_a_bank_without_sparse_variants_cannot_count_on_later_data():
    bank = mampc.ControllerBank({"plain": variants()["plain"]})
    with pytest.raises(mampc.MampcError, match="a bank of them"):
        mampc.Regulator(bank, mampc.LoadBank(bank.problem.model, noise=0.1), value_of_information=True)
