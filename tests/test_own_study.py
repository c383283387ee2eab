"""`mampc new --model`: a study of one's own that runs at once; and what a study warns of."""

import errno
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from mampc import StateSpace
from mampc.cli import app
from mampc.program.condensing import CondensedQP
from mampc.study import load_study, parse_study, template
from mampc.study.cautions import cautions
from mampc.study.draft import draft
from mampc.study.own import own_study
from mampc.study.regulators import problem_of, regulator_of
from mampc.study.running import run_study
from mampc.systems.evidence import Evidence
from mampc.systems.noise import Noise
from mampc.systems.properties import properties
from seeds import examples

lags = StateSpace.from_first_order
MODELS = {
    "delayed": lags(
        gain=[[12.8, -18.9], [6.6, -19.4]],
        time_constant=[[16.7, 21.0], [10.9, 14.4]],
        dead_time=[[1, 3], [7, 3]],
        dt=3.0,
    ),
    "level": lags(
        gain=[[1e-3, -1e-3]], time_constant=np.inf, dead_time=[[60.0, 0.0]], dt=30.0, u_op=50.0, y_op=3.0,
        names=mampc.Names(("feed",), ('level "A"\\',), disturbances=("draw",)),
    ),
    "unstable": StateSpace([[1.05]], [[0.5]], [[1.0]], None, 1.0),
    "unstable beside a slow lag": StateSpace([[1.15, 0.3], [0.0, 0.98]], [[0.5], [0.1]], [[1.0, 0.0]], None, 1.0),
    "fewer inputs": lags(gain=[[1.0], [-2.0], [0.0]], time_constant=[[10.0], [30.0], [1.0]], dt=4.0),
    "more inputs": lags(gain=[[1.0, 2.0, 0.0]], time_constant=[[10.0, 20.0, 30.0]], dt=4.0),
    "level beside a lag": lags(
        gain=[[0.01], [1.5]], time_constant=[[np.inf], [40.0]], dead_time=[[15.0], [0.0]], dt=5.0
    ),
    "position": StateSpace([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], [[1.0, 0.0]], None, 1.0),
    "at once": StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[3.0]], 1.0),
}  # fmt: skip


def ran(model, folder):
    model.save(folder / "model.json")
    study = parse_study(own_study(model, "model.json", "own"), folder=folder)
    some = study.scenarios[: examples(len(study.scenarios), quick=1)]
    return run_study(study.model_copy(update={"scenarios": some}))


def test_plans_count_on_later_data_but_where_the_plant_runs_away():
    for name, counts in (("delayed", True), ("unstable", False)):
        study = parse_study(own_study(MODELS[name], "m.json", "own"))
        price = next(table for table in study.controllers if table.name == "price")
        assert regulator_of(study, MODELS[name], price).value_of_information is counts


def test_filters_expect_the_noise_of_the_scenarios_where_the_model_knows_none():
    """A guess by the inputs' range is beyond every change where inputs act against each other, and plans would wait."""
    model = lags(
        gain=[[2.5e4, -1e4], [3e-6, 8e-6]], time_constant=[[5.0, 8.0], [20.0, 30.0]], dt=1.0, u_op=[50.0, 0.3]
    )
    study = parse_study(own_study(model, "m.json", "own"))
    assert study.estimator.measurement_noise == study.scenarios[1].noise
    changes = np.array([change.value for change in study.reference.changes])
    price = next(table for table in study.controllers if table.name == "price")
    offset = regulator_of(study, model, price).largest_offset()
    assert (offset < 0.5 * np.abs(changes).max(axis=0)).all()
    known = parse_study(own_study(replace(model, noise=Noise([100.0, 1e-8], [0.0, 0.0])), "m.json", "own"))
    assert known.estimator.measurement_noise is None


@pytest.mark.parametrize("kind", MODELS)
def test_it_runs_at_once_and_its_price_pays(kind, tmp_path):
    result = ran(MODELS[kind], tmp_path)
    assert result.warnings == ()
    runs = result.runs["noise-free"]
    assert all(status in ("optimal", "feasible") for run in runs.values() for status in run.statuses)
    mpc, price = (runs[name].metrics() for name in ("MPC", "price"))
    assert 0 < np.sum(price.moves) <= np.sum(mpc.moves)
    weight = np.asarray(result.study.problem.output_weight)
    still, of_mpc, of_price = (
        np.sum(weight * (y - runs["MPC"].r) ** 2) for y in (MODELS[kind].y_op, runs["MPC"].y, runs["price"].y)
    )
    assert of_mpc < 0.8 * still
    assert of_price < 0.9 * still


def test_a_level_that_first_answers_the_wrong_way_gets_a_stable_loop():
    model = StateSpace([[1.0, 0.0], [0.0, 0.9]], [[0.026], [-0.321]], [[1.0, 1.0]], None, 10.0, 50.0, 20.0)
    plan = draft(model, properties(model))
    assert np.abs(CondensedQP(plan.problem).closed_loop_poles()).max() < 1
    run = mampc.simulate(
        model, mampc.Regulator(mampc.MPC(plan.problem)), model.y_op + plan.changes[0], steps=2000
    )
    assert abs(run.y[-1] - run.r[-1]) < 0.01 * np.abs(plan.changes).max()


def test_what_rests_only_where_a_level_does_is_asked_of_no_change():
    plan = draft(MODELS["level beside a lag"], properties(MODELS["level beside a lag"]))
    assert (plan.changes[:, 0] > 0).all()
    assert (plan.changes[:, 1] == 0).all()
    two = lags(gain=[[0.01, 0.01], [1.5, 0.0]], time_constant=[[np.inf, np.inf], [40.0, 40.0]], dt=5.0)
    changes = draft(two, properties(two)).changes
    assert (changes != 0).tolist() == [[True, False], [False, True]]


def test_placeholders_of_limits_are_round_numbers():
    model = lags(gain=[[2.0]], time_constant=9.0, dt=1.0, u_op=40.0098)
    limits = draft(model, properties(model)).problem.limits
    assert (limits.u_min[0], limits.u_max[0]) == (20.0, 61.0)


def test_a_change_lasts_until_outputs_behind_a_dead_time_have_settled():
    late = lags(gain=[[2.0]], time_constant=100.0, dead_time=500.0, dt=10.0)
    plan = draft(late, properties(late))
    assert plan.every >= 50 + 40


def test_the_usual_price_costs_little_error_though_the_model_is_fast_and_slow():
    poles = np.exp([-1.0, -0.01])
    model = StateSpace(np.diag(poles), (1 - poles)[:, None], [[0.5, 0.5]], None, 1.0)
    plan = draft(model, properties(model))
    reference = np.repeat([plan.changes[0], [0.0]], 200, axis=0)
    mpc, usual = (
        mampc.simulate(model, mampc.Regulator(controller), reference, steps=400).metrics()
        for controller in (
            mampc.MPC(plan.problem),
            mampc.MAMPC(plan.problem, mampc.MoveRules(price=plan.usual)),
        )
    )
    assert usual.tracking_error < 1.3 * mpc.tracking_error
    assert np.sum(usual.moves) < 0.1 * np.sum(mpc.moves)


@pytest.mark.parametrize("units", [1e-8, 1e-3, 1e6])
def test_units_decide_nothing(units, tmp_path):
    model = MODELS["delayed"]
    rows, columns = np.array([[1.0], [units]]), np.array([units, 1.0])
    span = np.array([[0.0, 4.0], [-1.0, 2.0]])
    ranges = Evidence(span, [[0.0, 9.0], [0.0, 9.0]])
    scaled_ranges = Evidence(span / columns[:, None], [[0.0, 9.0], [0.0, 9.0 * units]])
    scaled = StateSpace(
        model.A, model.B * columns, rows * model.C, None, 3.0, [1.0 / units, 0.5], evidence=scaled_ranges
    )
    plain = replace(model, u_op=[1.0, 0.5], evidence=ranges)
    one, other = (tomllib.loads(own_study(m, "m.json", "own")) for m in (plain, scaled))
    for key in ("prediction_horizon", "control_horizon"):
        assert one["problem"][key] == other["problem"][key]
    for a, b in zip(one["reference"]["changes"], other["reference"]["changes"], strict=True):
        np.testing.assert_allclose(b["value"], rows[:, 0] * a["value"], rtol=0.02)
    prices = [
        study["controllers"][1]["rules"]["price"] / study["problem"]["output_weight"][0]
        for study in (one, other)
    ]
    np.testing.assert_allclose(*prices, rtol=0.15)  # numbers are rounded to two digits


def test_outputs_and_inputs_of_tiny_numbers_make_a_study():
    for gain, u_op in ((1e-9, 0.0), (1.0, 1e-9), (1e-9, 1e-9)):
        model = lags(gain=[[gain]], time_constant=9.0, dt=1.0, u_op=u_op)
        study = parse_study(own_study(model, "m.json", "own"))
        assert study.controllers[1].rules.price > 0


def test_what_the_record_said_is_in_it():
    model = replace(
        MODELS["delayed"],
        u_op=[50.0, 40.0],
        noise=Noise([0.1, 0.2], [0.01, 0.02]),
        evidence=Evidence([[45.0, 55.0], [30.0, 41.0]], [[0.0, 9.0], [0.0, 9.0]]),
    )
    stages = []
    text = own_study(model, "m.json", "own", stages.append)
    assert stages[0] == "trying price 1 of 5 at most"
    study = parse_study(text)
    assert (study.problem.limits.u_min, study.problem.limits.u_max) == ([45.0, 30.0], [55.0, 41.1])
    assert study.scenarios[1].noise == [0.1, 0.2]
    assert study.scenarios[2].loads[0].size == [0.01, 0.02]
    assert "PLACEHOLDER" not in text
    assert "tank" not in text
    assert "PLACEHOLDER" in own_study(MODELS["delayed"], "m.json", "own")


def test_references_go_no_further_than_the_record_showed_outputs_to_go():
    slow = lags(gain=[[285.0]], time_constant=14000.0, dt=5.0)
    wide, narrow = (
        draft(replace(slow, evidence=Evidence([[-6.0, 6.0]], [[-most, most]])), properties(slow)).changes
        for most in (1e4, 100.0)
    )
    np.testing.assert_allclose(np.abs(wide), 510.0, rtol=0.02)
    np.testing.assert_allclose(np.abs(narrow), 100.0)


def test_names_of_any_kind_and_many_signals_make_a_study():
    names = mampc.Names(tuple(f"u\n{i}\x07" for i in range(15)), tuple(f'"y{i}' for i in range(20)))
    model = lags(gain=np.eye(20)[:, :15] * np.pi, time_constant=9.0, dt=1.0, names=names)
    study = parse_study(own_study(model, 'a "b"\\\n.json', "na\nme"))
    assert study.model.file == 'a "b"\\\n.json'


def test_models_that_make_no_study_are_refused(tmp_path):
    for model, message in (
        (StateSpace([[0.5]], [[0.0]], [[1.0]], None, 1.0), "none does"),
        (StateSpace([[-0.5]], [[1.0]], [[1.0]], None, 0.0), "discrete"),
    ):
        model.save(tmp_path / "model.json")
        outcome = CliRunner().invoke(
            app, ["new", str(tmp_path / "s.toml"), "--model", str(tmp_path / "model.json")]
        )
        assert message in str(outcome.exception)
        assert not (tmp_path / "s.toml").exists()


def test_the_command_names_the_model_from_the_study_s_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    MODELS["level"].save(tmp_path / "models" / "level.json")
    outcome = CliRunner().invoke(app, ["new", "level.toml", "-m", "models/level.json"])
    assert outcome.exit_code == 0, outcome.output
    assert "run: mampc run level.toml" in outcome.output
    assert load_study("level.toml").model.file == "models/level.json"
    again = CliRunner().invoke(app, ["new", "level.toml", "-m", "models/level.json"])
    assert "does not exist yet" in str(again.exception)
    (tmp_path / "deep").mkdir()
    assert CliRunner().invoke(app, ["new", "deep/level.toml", "-m", "models/level.json"]).exit_code == 0
    spaced = CliRunner().invoke(app, ["new", "deep/my level.toml", "-m", "models/level.json"])
    assert "run: mampc run 'deep/my level.toml'" in spaced.output
    assert Path(load_study("deep/level.toml").model.file).is_absolute()


def test_a_full_disk_leaves_no_file(tmp_path, monkeypatch):
    def full(self, text, **_):
        self.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    outcome = CliRunner().invoke(app, ["new", str(tmp_path / "study.toml")])
    assert "No space left" in str(outcome.exception)
    assert list(tmp_path.iterdir()) == []


def warned(tmp_path, *replacements):
    model = lags(gain=[[2.0]], time_constant=30.0, dt=3.0)
    model.save(tmp_path / "model.json")
    text = own_study(model, "model.json", "own")
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    study = parse_study(text, folder=tmp_path)
    return study, run_study(study.model_copy(update={"controllers": study.controllers[:2]})).warnings


def test_a_price_that_can_never_pay_is_told_and_is_one(tmp_path):
    study, _ = warned(tmp_path)
    price = study.controllers[1].rules.price
    assert warned(tmp_path)[1] == ()
    saves = price * 64
    _, (warning,) = warned(tmp_path, (f"price = {price}", f"price = {1.1 * saves}"))
    assert "'price' can never move" in warning
    for factor, moves in ((1.05, False), (0.9, True)):  # the bound is sharp where no limit is near
        text = own_study(StateSpace.load(tmp_path / "model.json"), "model.json", "own")
        text = text.replace(f"price = {price}", f"price = {factor * saves}")
        run = run_study(parse_study(text, folder=tmp_path)).runs["noise-free"]["price"]
        assert (np.ptp(run.u) > 0) == moves


@pytest.mark.parametrize(("offset", "told"), [(0.59, False), (0.61, True)])
def test_an_offset_as_large_as_every_change_is_told_as_plans_of_the_regulator_leave_it(
    tmp_path, offset, told
):
    study, _ = warned(tmp_path)
    problem, reference = problem_of(study, StateSpace.load(tmp_path / "model.json")), np.array([[0.0], [0.6]])
    offsets = {
        table.name: np.array([offset if table.name == "price" else 0.0]) for table in study.controllers
    }
    found = cautions(study, problem, reference, offsets)
    assert [("'price' may leave every change" in one) for one in found] == [True] * told


def test_a_reference_out_of_reach_and_changes_too_late_are_told(tmp_path):
    _, (warning,) = warned(tmp_path, ("value = [0.6]", "value = [2.5]"))
    assert "the reference of y1 is up to 0.5 away" in warning
    _, (warning,) = warned(tmp_path, ("{ at = 5,", "{ at = 5000,"))
    assert "after the last sample" in warning
    assert "reference.changes at 5000" in warning
    limits = '[[scenarios]]\nname = "later"\nlimits = [{ at = 5000, u_max = [0.5] }]\n\n[[controllers]]\nname = "MPC"'
    _, (warning,) = warned(tmp_path, ('[[controllers]]\nname = "MPC"', limits))
    assert "limits of 'later' at 5000" in warning


def test_the_least_and_the_largest_of_many_references_are_looked_at(tmp_path):
    study, _ = warned(tmp_path)
    problem = problem_of(study, StateSpace.load(tmp_path / "model.json"))
    price = study.controllers[1].rules.price
    rules = study.controllers[1].rules.model_copy(
        update={"price": 50 * price}
    )  # of a change by 0.6, at most 64
    dear = study.controllers[1].model_copy(update={"rules": rules})
    study = study.model_copy(update={"controllers": [study.controllers[0], dear]})
    ramp = np.linspace(0.0, 0.6, 200)[:, None]
    offsets = {table.name: np.zeros(1) for table in study.controllers}
    assert cautions(study, problem, ramp, offsets) == ()


def test_the_example_study_has_nothing_to_warn_of():
    study = parse_study(template())
    short = study.model_copy(update={"controllers": study.controllers[:1], "scenarios": study.scenarios[:1]})
    assert run_study(short).warnings == ()
