"""Planned tests: what they promise of the gains is kept, whatever the units; what a poor record leaves open is said."""

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from mampc import MampcError, StateSpace, plan_test
from mampc.cli import app
from mampc.identification.plant_test import _Guess, first_guess

lags = StateSpace.from_first_order
COLUMN = {
    "gain": [[12.8, -18.9], [6.6, -19.4]],
    "settling_time": [[4000.0, 5000.0], [2600.0, 3500.0]],
    "noise": [0.1, 0.2],
    "dead_time": [[60.0, 180.0], [420.0, 180.0]],
}


def plant_of(gain, settling_time, dt, dead_time=0.0, integrating=False):
    gain = np.array(gain)
    lag = (np.broadcast_to(settling_time, gain.shape) - dead_time) / 4
    constant = np.where(integrating, np.inf, lag)
    return lags(gain=gain, time_constant=constant, dead_time=np.broadcast_to(dead_time, gain.shape), dt=dt)


@pytest.mark.parametrize(
    "guess",
    [
        {"gain": [[2.0]], "settling_time": 600.0, "noise": 0.1},
        {"gain": [[2.0]], "settling_time": 600.0, "noise": 0.1, "max_amplitude": 0.15},
        COLUMN,
        {"gain": [[1e-3, -1e-3]], "settling_time": 1800.0, "noise": 0.01, "integrating": True},
        {"gain": [[1.0, 0.2, -3.0], [0.5, 2.0, 0.0]], "settling_time": 3000.0, "noise": 0.05},
    ],
    ids=["one", "longer", "column", "level", "three inputs"],
)
def test_models_from_the_planned_test_are_as_certain_as_promised(guess):
    plan = plan_test(**guess)
    acts = np.array(guess["gain"]) != 0
    assert np.nanmax(plan.uncertainty) <= 0.0525
    assert np.isnan(plan.uncertainty[~acts]).all()
    rest = {name: value for name, value in guess.items() if name not in ("noise", "max_amplitude")}
    plant = plant_of(**rest, dt=plan.dt)
    samples = int(np.max(guess["settling_time"]) / plan.dt) + 1
    truth = plant.step_response(samples)[-1]
    errors = []
    for seed in range(3):
        data = mampc.excite(plant, plan.u, dt=plan.dt, noise=guess["noise"], seed=seed)
        found = mampc.n4sid(data, feedthrough=False).model.step_response(samples)[-1]
        errors.append((found - truth)[acts] / truth[acts])
    assert np.sqrt(np.mean(np.square(errors))) < 2 * 0.025
    quiet = mampc.excite(plant, plan.u, dt=plan.dt).y
    np.testing.assert_allclose(np.abs(quiet).max(axis=0), plan.swing, rtol=0.2)


@pytest.mark.parametrize("wandering", [0.0, 0.001, 0.02, 0.3])
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_what_outputs_that_wander_tell_is_what_generalised_least_squares_finds(wandering, unit):
    plan = plan_test(
        gain=2.0 * unit, settling_time=600.0, noise=0.1 * unit, wandering=wandering * unit, max_amplitude=1.0
    )
    k = np.arange(len(plan.u))
    one = np.ones((1, 1))
    guess = _Guess(one, 150.0 * one, np.zeros((1, 1), dtype=int), one < 0, plan.dt, np.ones(1))
    moved = plan.u - plan.around
    columns = [guess.response(moved, 0, 0, *other) for other in ((1.0, 0), (1.0, 1), (1.1, 0))]
    X = np.column_stack(
        [columns[0], columns[1] - columns[0], columns[2] - columns[0], k / len(k), np.ones(len(k))]
    )
    covariance = 0.1**2 * np.eye(len(k)) + wandering**2 * np.minimum.outer(k, k)
    deviation = np.sqrt(np.linalg.inv(X.T @ np.linalg.solve(covariance, X))[0, 0])
    np.testing.assert_allclose(plan.uncertainty[0, 0], 2 * deviation / 2.0, rtol=0.05)


@pytest.mark.parametrize("units", [1e-6, 1e4])
def test_units_decide_nothing(units):
    plain = plan_test(**COLUMN)
    scaled = plan_test(
        **COLUMN
        | {
            "gain": np.array(COLUMN["gain"]) * units * np.array([1.0, 10.0]),
            "noise": [0.1 * units, 0.2 * units],
        }
    )
    np.testing.assert_allclose(
        scaled.amplitude * [1.0, 10.0], plain.amplitude, rtol=0.15
    )  # two digits upwards
    assert (scaled.hold, scaled.dt, len(scaled.u)) == (plain.hold, plain.dt, len(plain.u))


def test_less_amplitude_takes_longer_and_what_cannot_be_met_is_said():
    free = plan_test(gain=2.0, settling_time=600.0, noise=0.1)
    held = plan_test(gain=2.0, settling_time=600.0, noise=0.1, max_amplitude=free.amplitude / 1.5)
    assert held.duration > 2 * free.duration
    assert np.nanmax(held.uncertainty) <= 0.0525
    least = plan_test(gain=2.0, settling_time=600.0, noise=0.1, max_amplitude=free.amplitude / 10)
    assert any("less certain than asked for" in note for note in least.notes)
    assert least.amplitude == free.amplitude / 10


def test_it_moves_about_the_levels_given_between_two_levels_after_a_rest():
    plan = plan_test(**COLUMN, around=[50.0, 40.0], names=mampc.Names(("R", "S"), ("D", "B")))
    rest = int(np.ceil(2500 / plan.dt))
    assert (plan.u[:rest] == [50.0, 40.0]).all()
    moved = plan.u[rest:]
    for j, middle in enumerate((50.0, 40.0)):
        np.testing.assert_allclose(
            np.unique(moved[:, j]), [middle - plan.amplitude[j], middle + plan.amplitude[j]]
        )
        assert np.count_nonzero(np.diff(moved[:, j])) >= 10
    assert abs(np.corrcoef(np.diff(moved, axis=0).T)[0, 1]) < 0.5


def test_a_poor_model_plans_its_better_record():
    plant = lags(gain=[[2.0, -1.0]], time_constant=[[300.0, 400.0]], dt=30.0, u_op=[50.0, 20.0], y_op=7.0)
    u = mampc.prbs(order=6, amplitude=1.0, hold=10, mean=[50.0, 20.0], samples=300)
    model = mampc.n4sid(mampc.excite(plant, u, dt=30.0, noise=0.5, seed=1), feedthrough=False).model
    plan = plan_test(**first_guess(model))
    assert plan.dt == 30.0
    np.testing.assert_allclose(plan.around, [50.0, 20.0], atol=0.5)
    better = mampc.n4sid(mampc.excite(plant, plan.u, dt=30.0, noise=0.5, seed=2), feedthrough=False).model
    np.testing.assert_allclose(better.dc_gain(), [[2.0, -1.0]], rtol=0.15)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gain": [[1.0, 0.0]]}, "zeros of input 2"),
        ({"gain": [[np.nan]]}, "gain"),
        ({"noise": 0.0}, "noise: expected more than 0"),
        (
            {"settling_time": 10.0, "dead_time": 20.0},
            "settling_time: expected more than the dead time, received 10",
        ),
        ({"dead_time": -1.0}, "dead_time: expected no negative"),
        ({"accuracy": 0.0}, "accuracy"),
        ({"max_amplitude": 0.0}, "max_amplitude"),
        ({"dt": 1e-3}, "at most 200000 samples"),
        ({"names": mampc.Names(("a", "b"), ("c",))}, "names.inputs: expected 1 names"),
        ({"settling_time": [[1.0, 2.0]]}, r"settling_time: expected a number or shape \(1, 1\)"),
    ],
)
def test_wrong_guesses_are_refused_by_name(wrong, message):
    with pytest.raises(MampcError, match=message):
        plan_test(**{"gain": 2.0, "settling_time": 600.0, "noise": 0.1} | wrong)


def test_the_command_writes_a_signal_that_can_be_played(tmp_path):
    target = tmp_path / "test.csv"
    outcome = CliRunner().invoke(
        app,
        [
            "plan-test", str(target), "--gain", "12.8,-18.9; 6.6,-19.4", "--settling-time", "1.5 h", "--noise", "0.1",
            "--around", "40,60", "--inputs", "R,S", "--outputs", "D,B", "--accuracy", "10%", "--dt", "2 min",
        ],
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    assert "samples of 120 s" in outcome.output
    with target.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["time", "R", "S"]
    assert float(rows[1]["time"]) == 120.0
    assert len({row["R"] for row in rows}) == 3


def test_the_command_says_what_it_misses(tmp_path):
    for arguments, message in (
        ([], "--gain, --settling-time, --noise"),
        (["--gain", "x"], "--gain: expected numbers"),
        (["--gain", "1,2;3"], "rows of one length"),
    ):
        with pytest.raises(MampcError, match=message):
            CliRunner().invoke(
                app, ["plan-test", str(tmp_path / "t.csv"), *arguments], catch_exceptions=False
            )


def identified(tmp_path, u, noise=0.05, code=0):
    plant = lags(gain=[[2.0, -1.0]], time_constant=[[300.0, 400.0]], dt=30.0)
    mampc.excite(plant, u, dt=30.0, noise=noise, seed=1).to_csv(tmp_path / "r.csv")
    arguments = ["identify", str(tmp_path / "r.csv"), "--inputs", "u1,u2", "--outputs", "y1"]
    outcome = CliRunner().invoke(app, arguments)
    assert (outcome.exit_code == 0) == (code == 0), outcome.output
    return " ".join((outcome.output + str(outcome.exception or "")).split())


def test_identify_says_what_a_poor_record_leaves_open(tmp_path, few_figures):
    u = mampc.prbs(order=8, amplitude=1, hold=10, inputs=2, samples=1200)
    assert "plan-test" not in identified(tmp_path, u)
    alike = u[:, [0, 0]] + 0.02 * np.random.default_rng(0).standard_normal((1200, 2))
    said = identified(tmp_path, alike)
    assert "u1 and u2 move together" in said
    assert "mampc plan-test test.csv --model" in said
    assert "the sign of the gain is uncertain" in identified(tmp_path, u[:400], noise=20.0)
    assert "u2 moves 1 time in" in identified(tmp_path, np.column_stack([u[:, 0], np.arange(1200) > 300]))
    assert "to settle: record" in identified(
        tmp_path, mampc.prbs(order=7, amplitude=1, hold=1, inputs=2, samples=127)
    )


def test_what_cannot_be_identified_says_what_to_record(tmp_path):
    u = mampc.prbs(order=8, amplitude=1, hold=10, inputs=2, samples=600)
    said = identified(tmp_path, u[:, [0, 0]], code=2)
    assert "u1 and u2 move together" in said
    assert "`mampc plan-test` says" in said
