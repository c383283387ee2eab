"""A live loop is recorded as it runs, with whatever it was told, and replays to the same bits."""

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from builders import random_model
from mampc.cli import app
from seeds import seeds
from studies import study_of_a_model
from test_live import random_limits

HORIZON, CONTROL = 8, 3


def with_disturbance(seed):
    """A model of two inputs, two outputs and a measured disturbance."""
    model, rng = random_model(seed), np.random.default_rng(seed)
    B = np.hstack([model.B, rng.standard_normal((3, 1))])
    D = np.zeros((2, 3))
    names = mampc.Names(("u1", "u2"), ("y1", "y2"), (), ("v1",))
    return mampc.StateSpace(model.A, B, model.C, D, 1.0, model.u_op, model.y_op, names=names, v_op=[0.5])


def problem_of(model, **changes):
    limits = mampc.Limits(
        u_min=model.u_op - 1, u_max=model.u_op + 1, du_max=0.8, y_min=model.y_op - 9, y_max=model.y_op + 9
    )
    settings = {"zone_below": [0.2, 0.0], "zone_above": [0.3, 0.0], "limits": limits} | changes
    return mampc.TrackingProblem(model, prediction_horizon=HORIZON, control_horizon=CONTROL, **settings)


def everything(model):
    """A bank of tunings with a filter, whose zones, prices and rules differ."""
    rules = mampc.MoveRules(price=0.02, max_moves=3, sparsity_horizon=4)
    bank = mampc.ControllerBank({
        "calm": mampc.MAMPC(problem_of(model), rules),
        "brisk": mampc.MAMPC(problem_of(model, move_weight=0.01), mampc.MoveRules(price=0.005, dwell=2)),
        "plain": mampc.MPC(problem_of(model)),
    })  # fmt: skip
    smooth = mampc.ReferenceFilter(time_constant=3.0)
    return mampc.Regulator(bank, mampc.LoadBank(model, noise=0.05), reference_filter=smooth)


def said(rng, model, problem, k):
    """What one sample is told: now this, now that, now nothing."""
    u, y = model.u_op, model.y_op
    asked = [y + 0.3, np.tile(y, (HORIZON + 1, 1)) + rng.standard_normal((HORIZON + 1, 1))]
    for rows in ((), (HORIZON + 1,)):
        low = np.broadcast_to(y - [0.1, 0.0], (*rows, 2))
        asked.append(mampc.Zone(low, low + np.array([np.inf if k % 3 else 0.5, 0.0])))
    told = {"variant": ["calm", "brisk", "plain", None][rng.integers(4)]}
    if rng.random() < 0.5:
        told["u_applied"] = u + rng.choice([0.0, 0.02, 0.5, np.nan, 1e300], 2)
        if rng.random() < 0.3:
            told["u_applied"] = np.ma.masked_array(told["u_applied"], rng.random(2) < 0.5)
    if rng.random() < 0.4:
        told["manual"] = (rng.random(2) < 0.5).tolist()
    if rng.random() < 0.7:
        told["measured_disturbance"] = [rng.choice([0.4, 0.9, np.nan])]
    if rng.random() < 0.5:
        told["limits"] = random_limits(rng, problem)
    elif rng.random() < 0.3:
        told["limits"] = mampc.Limits(u_max=u + 0.3, du_max=0.1)
    measured = y + 0.05 * rng.standard_normal(2)
    if rng.random() < 0.2:
        measured = np.ma.masked_array(measured, [True, False])
    return measured, asked[rng.integers(4)], told


@pytest.mark.parametrize("seed", seeds(12, quick=2))
def test_a_loop_that_used_everything_at_once_replays_to_the_same_bits(tmp_path, seed):
    model, rng = with_disturbance(seed), np.random.default_rng(seed)
    regulator = everything(model)
    with mampc.Recorder(tmp_path / "loop.csv", regulator) as recorder:
        state = regulator.initial_state(model.u_op + 0.1, model.y_op, measured_disturbance=[0.5])
        for k in range(40):
            measured, reference, told = said(rng, model, regulator.controller.problem, k)
            state = recorder.step(state, measured, reference, **told).state
            if k == 20:  # started again from what was stored
                state = regulator.state_from_json(state.to_json())
    recording = mampc.Recording.from_csv(tmp_path / "loop.csv", model.names)
    assert mampc.replay(everything(model), None, recording, tolerance=0.0) is None
    assert sum(bool(row.state) for row in recording.live) == 2
    assert {word for row in recording.live for word in row.told} == {"u_applied", "manual", "limits"}


@pytest.mark.parametrize("word", ["u_applied", "manual", "limits"])
def test_a_replay_that_is_not_told_the_same_differs(tmp_path, word):
    model = random_model(3)
    regulator = mampc.Regulator(mampc.MPC(problem_of(model)))
    told = {
        "u_applied": model.u_op + 0.3,
        "manual": [True, False],
        "limits": mampc.Limits(u_max=model.u_op + 0.1),
    }
    with mampc.Recorder(tmp_path / "loop.csv", regulator) as recorder:
        state = regulator.initial_state()
        for k in range(6):
            state = recorder.step(
                state, model.y_op, model.y_op + 1.0, **({word: told[word]} if k == 3 else {})
            ).state
    recording = mampc.Recording.from_csv(tmp_path / "loop.csv", model.names)
    assert mampc.replay(regulator, None, recording, tolerance=0.0) is None
    recording.live[3].told.clear()
    assert mampc.replay(regulator, None, recording).sample == 3


def test_each_row_is_on_disk_before_the_decision_comes_back(tmp_path):
    model = random_model(3)
    regulator = mampc.Regulator(mampc.MPC(problem_of(model)))
    recorder = mampc.Recorder(tmp_path / "loop.csv", regulator)
    state = regulator.initial_state()
    for k in range(3):
        state = recorder.step(state, model.y_op, model.y_op).state
        assert len((tmp_path / "loop.csv").read_text().splitlines()) == k + 2
    with pytest.raises(mampc.MampcError, match="expected a new file"):
        mampc.Recorder(tmp_path / "loop.csv", regulator)
    recorder.close()
    assert recorder.step(state, model.y_op, model.y_op).u.shape == (2,)


def test_a_row_that_was_cut_off_is_left_out(tmp_path):
    model = with_disturbance(0)
    regulator = everything(model)
    with mampc.Recorder(tmp_path / "loop.csv", regulator) as recorder:
        state = regulator.initial_state()
        for _ in range(3):
            state = recorder.step(state, model.y_op, model.y_op).state
    content = (tmp_path / "loop.csv").read_bytes()
    (tmp_path / "loop.csv").write_bytes(content[:-9])
    recording = mampc.Recording.from_csv(tmp_path / "loop.csv", model.names)
    assert len(recording.t) == 2
    assert mampc.replay(regulator, None, recording, tolerance=0.0) is None


def test_limits_of_another_type_are_refused():
    regulator = everything(with_disturbance(0))
    with pytest.raises(mampc.MampcError, match=r"limits: expected a mampc\.Limits"):
        regulator.step(regulator.initial_state(), [0.0, 0.0], [0.0, 0.0], limits=5)


def test_a_loop_goes_on_where_the_disk_fails(tmp_path):
    model = random_model(3)
    regulator = mampc.Regulator(mampc.MPC(problem_of(model)))
    recorder = mampc.Recorder(tmp_path / "loop.csv", regulator)
    state = regulator.initial_state()

    class Full:
        def writerow(self, row):
            raise OSError("no space left")

    recorder._writer = Full()
    with pytest.warns(mampc.MampcWarning, match="no space left; nothing is recorded from here on"):
        state = recorder.step(state, model.y_op, model.y_op).state
    assert recorder.step(state, model.y_op, model.y_op).u.shape == (2,)


@pytest.mark.parametrize(
    ("cell", "value"), [("limits", "{"), ("limits", '{"u_least": 1}'), ("asked", '{"low": [1]}'), ("u1_applied", "x")]
)  # fmt: skip
def test_cells_that_no_recorder_writes_are_refused(tmp_path, cell, value):
    model = random_model(3)
    regulator = mampc.Regulator(mampc.MPC(problem_of(model)))
    with mampc.Recorder(tmp_path / "loop.csv", regulator) as recorder:
        recorder.step(regulator.initial_state(), model.y_op, model.y_op)
    header, row = csv.reader((tmp_path / "loop.csv").read_text().splitlines())
    row[header.index(cell)] = value
    with (tmp_path / "loop.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, row])
    with pytest.raises(mampc.MampcError, match="expected what a Recorder writes in sample 0"):
        mampc.Recording.from_csv(tmp_path / "loop.csv", model.names)


STUDY = study_of_a_model(
    """
[[scenarios]]
name = "one"
[[controllers]]
name = "MPC"
method = "mpc"
[[controllers]]
name = "sparse"
method = "exact"
rules = { price = 0.05 }
""",
    steps=8,
)


def test_a_live_loop_replays_from_the_command_line(tmp_path):
    from mampc.study import load_study
    from mampc.study.regulators import regulator_of

    random_model(3).save(tmp_path / "model.json")
    (tmp_path / "study.toml").write_text(STUDY)
    study = load_study(tmp_path / "study.toml")
    regulator = regulator_of(study, mampc.StateSpace.load(tmp_path / "model.json"), study.controllers[1])
    with mampc.Recorder(tmp_path / "shift.csv", regulator) as recorder:
        state = regulator.initial_state()
        for k in range(5):
            told = {"limits": mampc.Limits(u_max=0.5)} if k > 2 else {}
            state = recorder.step(state, [0.1 * k, 0.0], [1.0, 0.5], **told).state
    asked = ["replay", str(tmp_path / "shift.csv"), "-s", str(tmp_path / "study.toml"), "--tolerance", "0"]
    outcome = CliRunner().invoke(app, [*asked, "--controller", "sparse"])
    assert "all 5 decisions" in outcome.output
    assert CliRunner().invoke(app, [*asked, "-c", "MPC"]).exit_code == 1
    assert "expected one of MPC, sparse" in str(CliRunner().invoke(app, [*asked, "-c", "other"]).exception)
    assert "--controller" in str(CliRunner().invoke(app, asked).exception)
