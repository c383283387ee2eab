"""`mampc tune`: the study and the page that it writes, and what it says."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from mampc.cli import app
from mampc.compare import tuning
from mampc.compare.scenarios import even_weight
from mampc.compare.tuned_study import rules_of
from mampc.study import load_study, parse_study
from mampc.study.running import run_study
from small_tuning import few_and_short, lag


@pytest.fixture(scope="module", autouse=True)
def _few_and_short():
    with few_and_short():
        yield


STUDY = """
name = "small"
steps = 40
dt = 10.0
plant = { kind = "model" }
model = { file = "model.json" }
problem = { prediction_horizon = 12, control_horizon = 4, limits = { u_min = -10.0, u_max = 10.0 } }
reference = { initial = [0.0], changes = [{ at = 2, value = [3.0] }] }
scenarios = [{ name = "walk", noise = 0.05, loads = [{ kind = "random_walk", size = 0.02 }] }]
controllers = [{ name = "MPC", method = "mpc" }]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lag().save("model.json")
    (tmp_path / "small.toml").write_text(STUDY)
    return tmp_path


def command(*arguments):
    return CliRunner().invoke(app, ["tune", "--jobs", "1", *arguments])


def test_outputs_of_a_model_file_weigh_alike_in_any_units():
    """The command has no place for weights, and a mole fraction would not count beside a temperature."""
    gain, units = np.array([[1.0, 0.5], [-0.3, 2.0]]), np.array([1e3, 1e-4])
    weights = []
    for unit in (np.ones(2), units):
        model = mampc.StateSpace.from_first_order(
            gain=gain * unit[:, None], time_constant=50.0, dead_time=0.0, dt=10.0
        )
        weights.append(even_weight(model, mampc.Limits(u_min=-1.0, u_max=1.0)) * unit**2)
    np.testing.assert_allclose(weights[1] / weights[1][0], weights[0] / weights[0][0])


@pytest.mark.parametrize(
    "source",
    [["small.toml"], ["model.json", "--u-min", "-10", "--u-max", "10"]],
    ids=["study", "model"],
)
def test_the_command_writes_a_study_that_runs(folder, source):
    pytest.importorskip("matplotlib")
    result = command(*source, "--max-error-increase", "25%", "--out", "out")
    assert result.exit_code == 0, result.output
    assert "standard error" in result.output
    assert "means over 8 scenarios" in result.output
    assert "a day" in result.output
    assert (folder / "out" / "front.png").exists()
    study = load_study(folder / "out" / "tuned.toml")
    assert study.controllers[0].rules.price > 0
    run = run_study(study).runs[study.scenarios[0].name]["tuned"]
    assert 0 < run.metrics().moves.sum() < 0.5 * len(run.t)


def test_the_page_shows_the_front_with_a_run_at_every_price(folder):
    pytest.importorskip("plotly")
    result = command("model.json", "--u-min", "-10", "--u-max", "10", "--out", "out")
    assert result.exit_code == 0, result.output
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    content = json.loads(re.search(r'<script id="content" type="application/json">(.*?)</script>', page)[1])
    assert [scenario["name"] for scenario in content["scenarios"]] == [
        "random steps", "random walk", "coloured", "no load",
    ]  # fmt: skip
    study = load_study(folder / "out" / "tuned.toml")
    for scenario in content["scenarios"]:
        first, base = scenario["choices"][scenario["first"]], scenario["choices"][scenario["base"]]
        assert base["name"] == "plain MPC"
        assert first["name"] == f"tuned, price {study.controllers[0].rules.price:.3g}"
        assert first["x"] < base["x"]
        assert len(scenario["choices"]) >= 3
        assert all(len(choice["signals"]) == 2 for choice in scenario["choices"])
    assert "Kept: an error of at most 1.25 times that of plain MPC" in page


RULED = """
[[controllers]]
name = "on or off"
method = "exact"
rules = { levels = [{ min_on = "30 s" }], price = 2.0 }
"""


def test_rules_of_a_study_are_those_of_its_actuators_or_of_the_controller_that_is_named(folder):
    text = (
        STUDY.replace("controllers = [", "# [").strip() + '\n[[controllers]]\nname = "MPC"\nmethod = "mpc"\n'
    )
    assert rules_of(parse_study(text)) is None
    study = parse_study(text + RULED)
    on_off = mampc.OnOff(min_on=30.0)
    assert rules_of(study) == mampc.MoveRules(levels=(on_off,))
    assert rules_of(study, "on or off") == mampc.MoveRules(levels=(on_off,), price=2.0)
    two = parse_study(
        text
        + RULED
        + RULED.replace("on or off", "any")
        .replace("levels", "#")
        .replace('rules = { # = [{ min_on = "30 s" }], price', "rules = { price")
    )
    with pytest.raises(mampc.MampcError, match="--controller 'on or off'"):
        rules_of(two)
    assert rules_of(two, "any") == mampc.MoveRules(price=2.0)


def test_a_study_is_compared_with_its_own_mpc(folder):
    study = load_study("small.toml")
    result = command("small.toml", "--max-moves-per-hour", "40", "--out", "out")
    assert result.exit_code == 0, result.output
    assert "at most 40 moves of all inputs together per hour" in result.output
    tuned = load_study(folder / "out" / "tuned.toml")
    assert tuned.scenarios == study.scenarios
    assert tuned.reference == study.reference
    assert tuned.problem.move_weight == pytest.approx([0.01])
    assert tuned.problem.prediction_horizon == study.problem.prediction_horizon
    assert tuned.estimator.measurement_noise == pytest.approx([0.05])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["small.toml", "--max-error-increase", "25"], "here 25%"),
        (["small.toml", "--max-error-increase", "1e9"], "such as 25%"),
        (["small.toml", "--max-error-increase", "0"], "above 0, such as 25%"),
        (["small.toml", "--max-error-increase", "-5%"], "above 0, such as 25%"),
        (["small.toml", "--max-error-increase", "5"], "expected 5% or 500%"),
        (["small.toml", "--max-error-increase", "much"], "such as 25%"),
        (["small.toml", "--max-moves-per-hour", "-1"], "max_moves_per_hour: expected"),
        (["small.toml", "--controller", "MPC"], "--controller: expected one with rules, among none"),
        (["model.json", "--u-min", "0", "--u-max", "1", "--controller", "MPC"], "with a study only"),
        (["small.toml", "--max-error-increase", "5%", "--max-moves-per-hour", "3"], "one of"),
        (["model.json"], "--u-min and --u-max"),
        (["model.json", "--u-min", "low", "--u-max", "1"], "--u-min: expected numbers"),
        (["model.json", "--u-min", "0", "--u-max", "100%"], "--u-max: expected numbers in"),
        (["small.toml", "--u-min", "0"], "a study has limits"),
        (["none.json", "--u-min", "0", "--u-max", "1"], "none.json"),
        (["none.toml"], "TOML"),
    ],
)
def test_the_command_says_in_a_sentence_what_does_not_fit(folder, arguments, words):
    result = command(*arguments)
    assert isinstance(result.exception, mampc.MampcError)
    assert words in str(result.exception)


def test_a_folder_that_cannot_be_written_is_told_before_the_search(tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "tune", lambda *_, **__: pytest.fail("searched"))
    mampc.StateSpace.from_first_order(gain=[[2.0]], time_constant=50.0, dt=10.0).save(tmp_path / "model.json")
    (tmp_path / "taken").write_text("a file")
    result = command(
        str(tmp_path / "model.json"), "--u-min", "0", "--u-max", "1", "--out", str(tmp_path / "taken")
    )
    assert result.exit_code != 0
    assert "--out: expected a folder that can be written" in str(result.exception) + result.output
