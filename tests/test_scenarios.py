"""Scenarios of a study: loads, valves, mismatch, and what they wear."""

import csv
import io
import json
from importlib.resources import files

import numpy as np
import pytest
from rich.console import Console

import mampc
from builders import tank_model
from mampc.report.summary import summarise
from mampc.report.tables import comparison_tables
from mampc.study import load_study, parse_study, run_study, template
from mampc.study.regulators import regulator_of
from mampc.study.running import initial_state, prepare

SHORT = (
    template()
    .replace("steps = 145", "steps = 30")
    .replace("at = 50", "at = 12")
    .replace("at = 100", "at = 20")
    .replace("prbs_order = 8", "prbs_order = 6")
)
HEAD, _ = SHORT.split("[[scenarios]]", 1)
TAIL = """
[[controllers]]
name = "MPC"
method = "mpc"

[[controllers]]
name = "price"
method = "exact"
rules = { price = 1.0 }
"""
MODEL = HEAD[: HEAD.index("[plant]")] + '[plant]\nkind = "model"\n[model]\nfile = "model.json"\n\n' + (
    HEAD[HEAD.index("[problem]") :]
)  # fmt: skip
ACTUATORS = "[actuators]\ndead_band = [0.5, 1.0]\nstarts_per_hour = 60.0\nmillion_starts = 1.0\n\n"


def study(tmp_path, scenario, head=MODEL, tail=TAIL):
    tank_model().save(tmp_path / "model.json")
    text = head + '[[scenarios]]\nname = "one"\nseed = 4\n' + scenario + tail
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    return load_study(tmp_path / "study.toml")


def test_loads_of_a_scenario_are_those_of_simulate(tmp_path):
    scenario = """
noise = 0.1
loads = [
  { kind = "random_walk", size = 0.5 },
  { kind = "steps", at = "output", sizes = [1.0, [0.5, 0.0]], times = ["1 min", 120] },
  { kind = "coloured", size = [0.2, 0.1], time_constant = "2 min" },
  { kind = "sinusoid", size = 0.3, period = "5 min", phase = "random" },
  { kind = "random_steps", size = 1.0, every = "2 min" },
]
valves = { band = 1.0, jump = 0.5 }
"""
    checked = study(tmp_path, scenario)
    run, model, loads = run_study(checked).runs["one"]["MPC"], tank_model(), mampc.loads
    twin = mampc.simulate(
        model, regulator_of(checked, model, checked.controllers[0]), run.r, noise=0.1, seed=4, u_initial=[50.0, 50.0],
        loads=[
            loads.RandomWalk(size=0.5),
            loads.Steps(at="output", sizes=[1.0, [0.5, 0.0]], times=[60.0, 120.0]),
            loads.Coloured(size=[0.2, 0.1], time_constant=120.0),
            loads.Sinusoid(size=0.3, period=300.0, phase=None),
            loads.RandomSteps(size=1.0, every=120.0),
        ],
        valves=mampc.Valves(band=1.0, jump=0.5),
    )  # fmt: skip
    np.testing.assert_array_equal(run.u, twin.u)
    np.testing.assert_array_equal(run.position, twin.position)


def test_residuals_come_from_a_record_within_the_studys_folder(tmp_path):
    model = tank_model()
    u = mampc.prbs(order=6, inputs=2, mean=model.u_op, amplitude=10.0)
    drift = np.random.default_rng(0).standard_normal((len(u), 2)).cumsum(axis=0)
    record = mampc.IOData(u, model.response(u, model.steady_state(u[0])) + drift, model.dt, model.names)
    record.to_csv(tmp_path / "record.csv")
    scenario = 'loads = [{ kind = "residuals", file = "record.csv" }]\n'
    run = run_study(study(tmp_path, scenario)).runs["one"]["MPC"]
    seen = run.y - model.response(run.u)
    assert np.abs(np.diff(seen, axis=0)).max() <= np.abs(np.diff(drift, axis=0)).max() + 1e-6
    assert np.ptp(seen) > 1.0
    with pytest.raises(mampc.StudyError, match=r"scenarios\.loads\.file: expected a path within"):
        run_study(study(tmp_path, scenario.replace("record.csv", "../record.csv")))


def test_a_mismatch_draws_another_plant_and_needs_a_model(tmp_path):
    right, wrong = (
        run_study(study(tmp_path, extra)).runs["one"]["MPC"].y
        for extra in ("", "mismatch = { gain = 0.15, lag = 0.1, dead_time = 0.2 }\n")
    )
    assert not np.allclose(right, wrong)
    with pytest.raises(mampc.StudyError, match="mismatch: expected a plant that is a model"):
        run_study(study(tmp_path, "mismatch = { gain = 0.1 }\n", head=HEAD))


def test_wear_stands_in_the_summary_and_in_a_table_of_its_own(tmp_path):
    head = MODEL.replace("[reference]", ACTUATORS + "[reference]")
    result = run_study(study(tmp_path, "noise = 0.1\n", head=head))
    summary = json.loads(json.dumps(summarise(result)))
    for entry in summary["scenarios"][0]["controllers"]:
        run = result.runs["one"][entry["name"]]
        metrics = run.metrics(dead_band=[0.5, 1.0])
        assert entry["starts_per_input"] == metrics.starts.tolist()
        assert entry["dead_band_per_input"] == [0.5, 1.0]
        for share, years, rate in zip(
            entry["share_of_rated_starts_per_input"], entry["life_years_per_input"],
            entry["starts_per_hour_per_input"], strict=True,
        ):  # fmt: skip
            assert share == pytest.approx(rate / 60.0)
            assert years is None if rate == 0 else years == pytest.approx(1e6 / (8766 * rate))
    console = Console(file=io.StringIO(), width=120)
    for table in comparison_tables(result.study, summary):
        console.print(table)
    shown = console.file.getvalue()
    assert "wear of the actuators" in shown
    assert "per hour" in shown


def test_without_a_table_of_actuators_nothing_is_said_of_their_life(tmp_path):
    result = run_study(study(tmp_path, "noise = 0.1\n"))
    summary = summarise(result)
    assert summary["scenarios"][0]["controllers"][0]["life_years_per_input"] is None
    assert len(comparison_tables(result.study, summary)) == 2


def test_a_trajectory_says_where_valves_were(tmp_path):
    run = run_study(study(tmp_path, "valves = { band = 1.0 }\n")).runs["one"]["MPC"]
    run.to_csv(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_array_equal([float(row["u2_position"]) for row in rows], run.position[:, 1])


def test_a_run_starts_at_rest_under_the_measured_load_of_its_first_sample():
    text = files("mampc.studies").joinpath("sofc.toml").read_text(encoding="utf-8")
    text = text.replace("steps = 145", "steps = 20").replace("prbs_order = 8", "prbs_order = 6")
    text = text.replace("at = 50", "at = 10").replace("at = 100", "at = 15")
    text = text.replace(
        'name = "noise-free"',
        'name = "noise-free"\nloads = [{ kind = "sinusoid", at = "measured", size = 5.0, period = 5, phase = 1.0 }]',
    )
    checked = parse_study(text)
    prepared = prepare(checked)
    regulator = regulator_of(checked, prepared.model, checked.controllers[0])
    state = initial_state(checked, prepared, checked.scenarios[0], regulator)
    np.testing.assert_allclose(state.measured_disturbance, 400.0 + 5.0 * np.sin(1.0))


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        ('loads = [{ kind = "gust", size = 1.0 }]', r"scenarios\[0\]\.loads\[0\]\.kind"),
        ('loads = [{ kind = "random_walk" }]', "size for a load of kind 'random_walk'"),
        ('loads = [{ kind = "random_walk", size = 1.0, period = 3 }]', "no period for a load of kind"),
        ('loads = [{ kind = "random_walk", size = -1.0 }]', "size: expected"),
        ('loads = [{ kind = "random_walk", sise = 1.0 }]', "did you mean 'size'"),
        ('loads = [{ kind = "random_walk", size = [1.0, 2.0, 3.0] }]', "scenarios, 'one': size: expected"),
        ('loads = [{ kind = "random_walk", at = "measured", size = 1.0 }]', "measured disturbances"),
        ('loads = [{ kind = "residuals", size = 1.0 }]', "a file for a load of kind 'residuals'"),
        ("valves = { band = 1.0, jump = 2.0 }", "jump: expected at most the band"),
        ("valves = { band = [1.0, 2.0, 3.0] }", "band: expected"),
        ("mismatch = { gain = 1.5 }", "mismatch.gain"),
    ],
)
def test_what_a_scenario_cannot_mean_is_refused_before_anything_runs(tmp_path, scenario, message):
    ran = []
    with pytest.raises(mampc.StudyError, match=message):
        run_study(study(tmp_path, scenario + "\n"), on_run=lambda *run: ran.append(run))
    assert not ran


def test_ratings_are_one_value_or_one_per_input(tmp_path):
    head = MODEL.replace("[reference]", "[actuators]\ndead_band = [1.0, 2.0, 3.0]\n\n[reference]")
    with pytest.raises(mampc.StudyError, match=r"actuators\.dead_band: expected"):
        run_study(study(tmp_path, "", head=head))
