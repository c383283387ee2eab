"""Replay: states as text, recorded runs decided again, and runs that are killed."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from builders import identified_tank, same_decision, tank_problem, tank_reference
from mampc.cli import app
from mampc.report.output import run_and_write, trajectories
from mampc.study import parse_study, template
from seeds import deep, examples

TANK = mampc.plants.QuadrupleTank()
RULES = mampc.MoveRules(max_moves=3, sparsity_horizon=3, price=0.1)
CONTROLLERS = {
    "mpc": lambda problem: mampc.MPC(problem),
    **{
        method: lambda problem, method=method: mampc.MAMPC(problem, RULES, method=method)
        for method in mampc.METHODS
    },
}


def tight_regulator(method):
    """With limits that are often active, so that the solver has something to do."""
    model = identified_tank()
    limits = mampc.Limits(u_min=40.0, u_max=60.0, du_max=3.0, y_max=model.y_op + 2.0)
    return mampc.Regulator(CONTROLLERS[method](tank_problem(model, limits=limits)))


@pytest.mark.usefixtures("either_estimator")
@pytest.mark.parametrize("method", CONTROLLERS)
def test_a_state_kept_as_text_leads_to_the_same_decisions_to_the_bit(method):
    regulator, elsewhere = tight_regulator(method), tight_regulator(method)
    state, rng = regulator.initial_state(), np.random.default_rng(0)
    model = regulator.controller.problem.model
    for k in range(examples(25, quick=8)):
        y = model.y_op + rng.standard_normal(2)
        reference = model.y_op + 4.0 * (k > 5)
        text = state.to_json()
        decision = regulator.step(state, y, reference)
        again = elsewhere.step(elsewhere.state_from_json(text), y, reference)
        assert again.state.to_json() == decision.state.to_json()
        assert same_decision(again, decision, atol=0)
        state = decision.state


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda content: "no json", "received"),
        (lambda content: "[1, 2]", "received"),
        (lambda content: json.dumps(content | {"format": "other"}), "format"),
        (lambda content: json.dumps(content | {"estimate": {}}), "received"),
        (lambda content: json.dumps(content | {"measured_disturbance": [1.0]}), "shape"),
        (lambda content: json.dumps(content | {"estimate": content["estimate"] | {"x": [1.0]}}), "shape"),
        (lambda content: json.dumps(content | {"estimate": content["estimate"] | {"x": [np.nan] * 4}}), "finite"),
        (lambda content: json.dumps(content | {"controller": {"inputs": [["a", 1]]}}), "received"),
        (lambda content: json.dumps(content | {"controller": {"inputs": [[1, 1]], "active": [0.0]}}), "shape"),
        (lambda content: json.dumps(content | {"controller": {"inputs": [[1, 1]], "active": [9.0] * 42}}), "flags"),
        (lambda content: json.dumps(content | {"controller": {"inputs": None}}), "shape"),
        (lambda content: json.dumps(content | {"controller": {"inputs": [[1, 1]], "samples": "5"}}), "whole"),
        (lambda content: "[" * 100_000, "received"),
        (lambda content: json.dumps(content | {"measured_disturbance": [10**400]}), "received"),
        (lambda content: None, "received"),
    ],
)  # fmt: skip
def test_a_text_that_is_no_state_of_this_regulator_is_refused(spoil, expected):
    regulator = tight_regulator("mpc")
    content = json.loads(regulator.initial_state().to_json())
    with pytest.raises(mampc.MampcError, match=f"state: .*{expected}"):
        regulator.state_from_json(spoil(content))


@pytest.mark.usefixtures("either_estimator")
@pytest.mark.parametrize("preview", [False, *deep(True)])
@pytest.mark.parametrize("method", CONTROLLERS)
def test_a_simulated_run_replays_to_the_same_bits(method, preview):
    regulator, reference = tight_regulator(method), tank_reference(examples(60, quick=20))
    run = mampc.simulate(TANK, regulator, reference, noise=0.1, preview=preview)
    state = regulator.initial_state(run.u_initial, TANK.output(TANK.steady_state()))
    recording = mampc.Recording.of(run)
    again = tight_regulator(method)
    assert mampc.replay(again, state, recording, preview=preview, tolerance=0.0) is None


def test_a_replay_finds_the_first_decision_that_differs():
    regulator = tight_regulator("exact")
    run = mampc.simulate(TANK, regulator, tank_reference(40), noise=0.1)
    state = regulator.initial_state(run.u_initial, TANK.output(TANK.steady_state()))
    recording = mampc.Recording.of(run)
    for quantity, array in (("u2", recording.u), ("the objective", recording.objective[:, None])):
        kept = array[17, -1]
        array[17, -1] += 1e-6 * max(1.0, abs(kept))
        found = mampc.replay(regulator, state, recording)
        assert (found.sample, found.quantity) == (17, quantity)
        array[17, -1] = kept
    recording.y[23] = np.nan
    found = mampc.replay(regulator, state, recording)
    assert (found.sample, found.quantity, found.replayed) == (23, "the status", "held_bad_measurement")
    assert "sample 23 (t = 230 s)" in str(found)


def test_a_replay_finds_what_was_changed_in_the_words_of_a_decision_and_in_its_time(tmp_path):
    regulator = tight_regulator("exact")
    run = mampc.simulate(TANK, regulator, tank_reference(40), noise=0.1)
    state = regulator.initial_state(run.u_initial, TANK.output(TANK.steady_state()))
    run.to_csv(tmp_path / "run.csv")
    header, *rows = (line.split(",") for line in (tmp_path / "run.csv").read_text().splitlines())

    def replayed(column, value):
        changed = [list(row) for row in rows]
        changed[17][header.index(column)] = value
        (tmp_path / "run.csv").write_text("\n".join(",".join(row) for row in [header, *changed]))
        return mampc.replay(regulator, state, mampc.Recording.from_csv(tmp_path / "run.csv", TANK.names))

    assert replayed("time", rows[17][0]) is None
    for column, value, quantity, now in (
        ("time", "171.0", "the time", "170.0"),
        ("remarks", "back_inside", "the remarks", "none"),
        ("ignored", "y1:missing", "the ignored outputs", "none"),
    ):
        found = replayed(column, value)
        assert (found.sample, found.quantity, found.replayed) == (17, quantity, now)


def test_a_run_that_is_not_there_is_refused_before_anything_is_identified(tmp_path):
    outcome = CliRunner().invoke(app, ["replay", str(tmp_path / "noisy_mpc.csv"), "-s", "quadruple-tank"])
    assert "where there is none" in str(outcome.exception)
    assert "identifying" not in outcome.output


SHORT = (
    template()
    .replace("steps = 145", "steps = 30")
    .replace("skip = 15", "skip = 5")
    .replace("prbs_order = 8", "prbs_order = 6")
)


def test_every_trajectory_of_a_study_replays_from_the_command_line(tmp_path, few_figures):
    study = tmp_path / "study.toml"
    start, end = SHORT.index("[[scenarios]]"), SHORT.rindex("[[scenarios]]")
    noisy = SHORT[:start] + SHORT[end:]
    study.write_text(noisy)
    run_and_write(parse_study(noisy), tmp_path / "out")
    for _, _, name in trajectories(parse_study(noisy)):
        outcome = CliRunner().invoke(
            app, ["replay", str(tmp_path / "out" / name), "--study", str(study), "--tolerance", "0"]
        )
        assert outcome.exit_code == 0, outcome.output
        assert "all 30 decisions" in outcome.output
    # Without the model beside it, the model is identified again.
    (tmp_path / "out" / "model.json").unlink()
    path = tmp_path / "out" / "noisy_exact-price.csv"
    assert CliRunner().invoke(app, ["replay", str(path), "-s", str(study)]).exit_code == 0
    lines = path.read_text().splitlines()
    lines[12] = lines[12].replace(",optimal,", ",held_infeasible,")
    path.write_text("\n".join(lines) + "\n")
    outcome = CliRunner().invoke(app, ["replay", str(path), "-s", str(study)])
    assert outcome.exit_code == 1
    assert "sample 11" in outcome.output.replace("\n", " ")


def test_a_file_that_is_not_of_the_study_is_refused(tmp_path):
    (tmp_path / "other.csv").write_text("a\n1\n")
    outcome = CliRunner().invoke(app, ["replay", str(tmp_path / "other.csv"), "-s", "quadruple-tank"])
    assert isinstance(outcome.exception, mampc.MampcError)
    assert "noisy_mpc.csv" in str(outcome.exception)


def test_a_killed_run_loses_no_finished_controller_and_leaves_nothing_half_written(tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "mampc", "run", "quadruple-tank", "--out", str(out)],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    began = []
    for line in process.stderr:
        if line.startswith(("noise-free: ", "noisy: ")):
            began.append(line.strip())
        if len(began) == 4:
            time.sleep(0.05)
            break
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stderr.close()
    finished = ["noise-free_mpc.csv", "noise-free_mampc-ns-1.csv", "noise-free_mampc-ns-3.csv"]
    for name in finished:
        assert len((out / name).read_text().splitlines()) == 146
    for path in out.glob("[!.]*.csv"):
        if path.name != "identification.csv":
            assert len(path.read_text().splitlines()) == 146
    assert not (out / "summary.json").exists()
    assert mampc.StateSpace.load(out / "model.json").n_states == 4
    outcome = CliRunner().invoke(app, ["replay", str(out / finished[1]), "-s", "quadruple-tank"])
    assert outcome.exit_code == 0
