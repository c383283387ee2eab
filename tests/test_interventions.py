"""What operators do in simulated loops, limits of samples and inputs moved by hand: recorded, replayed, in batches."""

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from builders import random_model
from mampc.cli import app
from mampc.study import parse_study, run_study
from studies import study_of_a_model

STEPS = 24


def regulator(model, controller="price"):
    limits = mampc.Limits(u_min=model.u_op - 2, u_max=model.u_op + 2, y_max=model.y_op + 9)
    problem = mampc.TrackingProblem(model, prediction_horizon=8, control_horizon=3, limits=limits)
    made = {
        "mpc": lambda: mampc.MPC(problem),
        "price": lambda: mampc.MAMPC(problem, mampc.MoveRules(price=0.02)),
        "greedy": lambda: mampc.MAMPC(problem, mampc.MoveRules(price=0.02), method="greedy", certify=True),
        "rule": lambda: mampc.rivals.DeadBand(mampc.MPC(problem), size=0.05),
    }
    return mampc.Regulator(made[controller]())


def told(model):
    """Narrow limits for some samples, over the horizon for others, and the first input moved by hand meanwhile."""
    limits = [None] * STEPS
    limits[4:12] = [mampc.Limits(u_min=model.u_op - 0.2, u_max=model.u_op + 0.2)] * 8
    limits[15] = mampc.Limits(u_max=np.tile(model.u_op + 0.5, (3, 1)), y_max=model.y_op + 0.1)
    manual = np.full((STEPS, 2), np.nan)
    manual[8:14, 0] = model.u_op[0] + np.linspace(0.1, 0.4, 6)
    return {"limits": limits, "manual": manual}


def run_of(controller="price", **changes):
    model = random_model(3)
    reference = mampc.steps(STEPS, model.y_op, [(2, model.y_op + 1.0)])
    own = regulator(model, controller)
    return model, own, mampc.simulate(model, own, reference, noise=0.05, seed=1, **told(model) | changes)


def test_limits_hold_and_the_plant_gets_what_is_done_by_hand():
    model, _, run = run_of()
    assert (np.abs(run.u - model.u_op)[4:12] <= 0.2 + 1e-12).all()
    assert (np.abs(run.u - model.u_op)[12:15, 1] > 0.2).any()
    np.testing.assert_allclose(run.position[8:14, 0], model.u_op[0] + np.linspace(0.1, 0.4, 6))
    np.testing.assert_array_equal(run.position[:, 1], run.u[:, 1])
    # After manual, the input goes on from where it was.
    first = run.decisions[14]
    np.testing.assert_allclose(first.plan[0, 0] - first.changes[0, 0], run.position[13, 0], atol=1e-12)
    x, outputs = model.steady_state(model.u_op), []
    for u in run.position:
        outputs.append(model.y_op + model.C @ x + model.D @ (u - model.u_op))
        x = model.A @ x + model.B @ (u - model.u_op)
    np.testing.assert_allclose(run.y, outputs, atol=1e-9)


@pytest.mark.parametrize("controller", ["mpc", "price", "greedy", "rule"])
@pytest.mark.parametrize("preview", [False, True])
def test_runs_are_recorded_and_replay_to_the_bit(tmp_path, controller, preview):
    model, _, run = run_of(controller, preview=preview)
    run.to_csv(tmp_path / "run.csv")
    for recording in (mampc.Recording.from_csv(tmp_path / "run.csv", model.names), mampc.Recording.of(run)):
        again = regulator(model, controller)
        start = again.initial_state(model.u_op, model.y_op)
        assert mampc.replay(again, start, recording, preview=preview, tolerance=0.0) is None


@pytest.mark.parametrize("controller", ["mpc", "price"])
def test_batches_are_told_the_same(controller):
    model, own, _ = run_of(controller)
    reference = mampc.steps(STEPS, model.y_op, [(2, model.y_op + 1.0)])
    batch = mampc.simulate_batch(
        model, own, reference, seeds=[0, 1], noise=0.05, progress=False, **told(model)
    )
    for seed in range(2):
        run = mampc.simulate(model, own, reference, noise=0.05, seed=seed, **told(model))
        np.testing.assert_allclose(batch.u[seed], run.u, atol=1e-9)
        np.testing.assert_allclose(batch[seed].position, run.position, atol=1e-9)
        assert len(batch[seed].told) == STEPS


def test_one_limit_and_one_row_are_for_all_samples():
    model, _, run = run_of(limits=mampc.Limits(u_max=model_top()), manual=[np.nan, 0.0])
    assert (run.u[:, 0] <= model.u_op[0] + 0.1 + 1e-12).all()
    assert (run.position[:, 1] == 0.0).all()


def model_top():
    return random_model(3).u_op + 0.1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"limits": [None]}, "limits: expected one for each of 24 samples"),
        ({"limits": "narrow"}, "limits: expected mampc.Limits"),
        ({"limits": mampc.Limits(u_max=[1.0, 2.0, 3.0])}, "limits: expected u_max"),
        ({"manual": [1.0]}, "manual: expected inputs of shape"),
        ({"manual": [np.inf, 0.0]}, "manual: expected inputs of shape"),
        ({"valves": mampc.Valves(band=0.1)}, "manual: expected none beside valves"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_loop_begins(wrong, said):
    with pytest.raises(mampc.MampcError, match=said):
        run_of(**wrong)


STUDY = study_of_a_model(
    """
[[scenarios]]
name = "a shift"
noise = 0.05
limits = [{ at = 4, u_max = 0.5 }, { at = 10 }]
manual = [{ at = 6, until = 9, input = "u1", value = 0.25 }]
[[controllers]]
name = "price"
method = "exact"
rules = { price = 0.05 }
""",
    steps=20,
)


def test_a_study_says_what_operators_do_and_its_trajectory_replays(tmp_path):
    random_model(3).save(tmp_path / "model.json")
    (tmp_path / "study.toml").write_text(STUDY)
    run = run_study(parse_study(STUDY, folder=tmp_path)).runs["a shift"]["price"]
    run.to_csv(tmp_path / "a-shift_price.csv")
    assert (run.u[4:10] <= 0.5 + 1e-12).all()
    assert (run.position[6:9, 0] == 0.25).all()
    asked = [
        "replay",
        str(tmp_path / "a-shift_price.csv"),
        "-s",
        str(tmp_path / "study.toml"),
        "--tolerance",
        "0",
    ]
    outcome = CliRunner().invoke(app, asked)
    assert "all 20 decisions" in outcome.output, outcome.output
    with pytest.raises(mampc.StudyError, match="manual: expected one of u1, u2"):
        run_study(parse_study(STUDY.replace('"u1"', '"u9"'), folder=tmp_path))


def test_an_input_that_is_by_hand_at_no_sample_is_refused():
    with pytest.raises(mampc.StudyError, match="expected until beyond at, which is 6; received 6"):
        parse_study(STUDY.replace("until = 9", "until = 6"))
