"""What is said of a model: properties with known values, in any units; `print`, `plot` and `mampc show`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import mampc
from mampc import StateSpace
from mampc.cli import app
from mampc.report.showing import model_tables, model_words
from mampc.systems.evidence import Evidence
from mampc.systems.noise import Noise
from mampc.systems.properties import properties

K = np.array([[12.8, -18.9], [6.6, -19.4]])
TAU = 60 * np.array([[16.7, 21.0], [10.9, 14.4]])
THETA = 60 * np.array([[1.0, 3.0], [7.0, 3.0]])


@pytest.fixture(scope="module")
def column():
    return StateSpace.from_first_order(gain=K, time_constant=TAU, dead_time=THETA, dt=60.0)


def test_first_order_channels_are_read_back(column):
    found = properties(column)
    np.testing.assert_allclose(found.gain, K)
    np.testing.assert_allclose(found.time_constant, TAU, rtol=1e-3)
    np.testing.assert_allclose(found.dead_time, THETA)
    np.testing.assert_allclose(found.relative_gain[0, 0], 2.009, atol=1e-3)  # in the literature 2.01
    assert (found.integrators, found.unstable) == (0, 0)
    assert 4 * 21 * 60 < found.settling_time < 5 * 21 * 60


@pytest.mark.parametrize("units", [1e-7, 1e9])
def test_units_decide_nothing(column, units):
    rows, columns = np.array([[1.0], [units]]), np.array([units, 1.0])
    scaled = StateSpace(column.A, column.B * columns, rows * column.C, None, 60.0)
    one, other = properties(column), properties(scaled)
    np.testing.assert_allclose(other.gain, rows * one.gain * columns)
    for name in ("time_constant", "dead_time", "settling_time", "relative_gain", "condition"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=1e-6)


def test_levels_integrate_and_share_their_row_with_nothing_else():
    model = StateSpace.from_first_order(
        gain=[[0.02, -0.01], [0.0, 3.0]],
        time_constant=[[np.inf, np.inf], [1.0, 100.0]],
        dead_time=[[0, 40.0], [0, 20.0]],
        dt=10.0,
    )
    found = properties(model)
    np.testing.assert_allclose(found.gain, [[0.02, -0.01], [0.0, 3.0]])
    assert found.integrating.tolist() == [[True, True], [False, False]]
    np.testing.assert_allclose(found.dead_time, [[0, 40], [0, 20]])
    np.testing.assert_allclose(found.relative_gain, np.eye(2), atol=1e-9)
    assert found.integrators == 1


@pytest.mark.parametrize(("gamma", "limited"), [(0.3, True), (0.7, False)])
def test_the_tank_is_limited_where_its_zero_is_in_the_right_half_plane(gamma, limited):
    """Johansson (2000): a zero in the right half plane where gamma_1 + gamma_2 < 1."""
    continuous = mampc.linearise(mampc.plants.QuadrupleTank(gamma=(gamma, gamma)))
    found = properties(continuous.discretise(5.0)).limiting_zeros
    assert bool(len(found)) == limited
    if limited:
        expected = 1 / continuous.zeros().real.max()
        np.testing.assert_allclose(found[0], expected, rtol=0.15)


def test_dead_times_alone_are_no_zeros(column):
    assert not len(properties(column).limiting_zeros)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_zero_of_one_channel_is_told(scale):
    # (1 - 20 s) / ((60 s + 1) (20 s + 1)), alone and twice beside each other
    A, B, C = np.diag([-1 / 60, -1 / 20]), np.array([[1 / 60], [1 / 20]]), np.array([[2.0, -1.0]])
    alone = mampc.StateSpace(A, B, scale * C, None, 0.0).discretise(5.0)
    twice = mampc.StateSpace(
        np.kron(np.eye(2), A), np.kron(np.eye(2), B), np.kron(np.diag([1.0, scale]), C), None, 0.0
    ).discretise(5.0)
    for model, count in ((alone, 1), (twice, 2)):
        found = properties(model).limiting_zeros
        assert len(found) == count
        np.testing.assert_allclose(found, 20.0, rtol=0.1)


def test_what_grows_is_told():
    model = StateSpace([[1.1, 0.0], [0.0, 0.5]], [[1.0], [1.0]], np.eye(2), None, 1.0)
    found = properties(model)
    assert found.unstable == 1
    assert not any("settles" in sentence for sentence in model_words(model))
    assert np.isinf(found.gain[0, 0])
    np.testing.assert_allclose(found.gain[1, 0], 2.0)
    assert found.relative_gain is None


def test_odd_models_are_no_trouble():
    for model in (
        StateSpace(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), [[1.0, 0.0]], 1.0),
        StateSpace([[0.5]], [[0.0]], [[0.0]], None, 1.0),
        StateSpace([[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]], [[1.0, 0.0]], None, 1.0),
    ):
        properties(model)
        assert "StateSpace" in str(model)
    with pytest.raises(mampc.MampcError, match="discrete"):
        properties(StateSpace([[-1.0]], [[1.0]], [[1.0]], None, 0.0))


@pytest.mark.parametrize(
    ("unit", "shown"), [("t/h", "mm/(t/h)"), ("kW", "mm/kW"), ("°C", "mm/°C"), ("N m", "mm/(N m)")]
)
def test_units_of_gains_say_what_is_below_the_line(unit, shown):
    names = mampc.Names(("u",), ("y",), units={"u": unit, "y": "mm"})
    model = StateSpace.from_first_order(gain=1.0, time_constant=60.0, dt=10.0, names=names)
    [unit_column] = [c for c in model_tables(model)[0].columns if c.header == "unit"]
    assert list(unit_column.cells) == [shown]


def test_print_is_short(column):
    assert str(column).splitlines()[1] == "  y1 from u1: gain 12.8, time constant 16.7 min, dead time 60 s"
    many = StateSpace.from_first_order(
        gain=np.ones((12, 5)), time_constant=np.arange(1.0, 61).reshape(12, 5), dt=1.0
    )
    assert len(str(many).splitlines()) == 11


def test_step_responses_are_drawn_with_their_band(column):
    deviation = 0.1 * np.abs(column.step_response(50))
    evidence = Evidence([[0, 1], [0, 1]], [[0, 1], [0, 1]], deviation)
    for figure in (
        column.plot(),
        column.plot(deviation=deviation),
        replace(column, evidence=evidence).plot(),
    ):
        assert len(figure.axes) == 4
    assert figure.axes[0].collections
    with pytest.raises(mampc.MampcError, match="deviation: expected shape"):
        column.plot(deviation=deviation[:, :1])


def test_show_says_what_is_known(column, tmp_path):
    deviation = np.ones((150, 2, 2)) * [[0.5, 10.0], [0.1, 0.2]]
    model = replace(
        column,
        names=mampc.Names(("reflux", "steam"), ("top", "bottom"), units={"top": "%", "reflux": "kg/h"}),
        noise=Noise([0.1, 0.2], [0.0, 0.01]),
        evidence=Evidence([[0, 1], [0, 1]], [[0, 1], [0, 1]], deviation),
    )
    model.save(tmp_path / "model.json")
    loaded = StateSpace.load(tmp_path / "model.json")
    assert np.array_equal(loaded.evidence.deviation, deviation)
    figure = tmp_path / "steps.png"
    outcome = CliRunner().invoke(app, ["show", str(tmp_path / "model.json"), "--figure", str(figure)])
    assert outcome.exit_code == 0, outcome.output
    for text in ("12.8", "0.5", "%/(kg/h)", "16.7 min", "noise of the outputs: top 0.1, bottom 0.2", "2.01"):
        assert text in outcome.output
    assert "sign of the gain is uncertain: top from steam" in outcome.output  # 18.9 and 10 of deviation
    assert figure.exists()


@pytest.mark.parametrize(
    "evidence",
    [
        {"inputs": [[0, 1]], "outputs": [[0, 1]]},
        {"inputs": [[0, 1], [0, 1]], "outputs": [[0], [1]]},
        {"inputs": [[0, 1], [0, 1]], "outputs": [[0, 1], [0, 1]], "deviation": [[1.0]]},
        {"inputs": [[0, 1], [0, None]], "outputs": [[0, 1], [0, 1]]},
        {"what": 1},
        7,
    ],
)
def test_evidence_that_does_not_fit_is_refused(column, tmp_path, evidence):
    path = tmp_path / "model.json"
    column.save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"evidence": evidence}))
    with pytest.raises(mampc.MampcError, match=r"model\.json"):
        StateSpace.load(path)
