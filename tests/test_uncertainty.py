"""What a model knows of its own errors: noise kept with it, and step responses with standard deviations."""

import numpy as np
import pytest

import mampc
from mampc import IOData, MampcError, Noise, StateSpace, n4sid, prbs
from mampc.identification.drift import noise_and_walk, white_and_walk
from mampc.identification.scaling import scaled
from mampc.identification.uncertainty import telling
from seeds import deep

PLANT = StateSpace(
    [[0.9, 0.05], [0.0, 0.8]], [[0.1, 0.05], [0.0, 0.3]], np.eye(2), None, 10.0, [5.0, 6.0], [1.0, 2.0]
)


def record(seed, *, samples=800, noise=0.05, walk=0.0, units=(1.0, 1.0)):
    rng = np.random.default_rng(seed)
    u = PLANT.u_op + prbs(order=8, hold=5, inputs=2, samples=samples, seed=seed)
    y = PLANT.response(u)
    y = y + noise * rng.standard_normal(y.shape) + walk * np.cumsum(rng.standard_normal(y.shape), axis=0)
    return IOData(u * units[0], y * units[1], PLANT.dt)


@pytest.mark.parametrize(("white", "walk"), [(1.0, 0.0), (1.0, 0.3), (0.1, 1.0), (0.0, 1.0)])
def test_white_noise_and_a_random_walk_are_told_apart(white, walk):
    rng = np.random.default_rng(0)
    both = white * rng.standard_normal((20000, 3)) + walk * np.cumsum(rng.standard_normal((20000, 3)), axis=0)
    found = white_and_walk([both[:12000], both[12000:]])
    np.testing.assert_allclose(found, np.tile([[white], [walk]], 3), atol=0.15)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("walk", [0.0, 0.1, 0.3])
def test_a_walk_is_told_only_where_there_is_one(walk, unit):
    rng = np.random.default_rng(1)
    both = rng.standard_normal((1200, 4)) + walk * np.cumsum(rng.standard_normal((1200, 4)), axis=0)
    white, found = noise_and_walk([unit * both[:700], unit * both[700:]])
    np.testing.assert_allclose(white / unit, 1.0, rtol=0.1)
    np.testing.assert_allclose(found / unit, walk, rtol=0.5)


@pytest.mark.parametrize("unit", [1.0, 1e5])
def test_the_noise_of_a_record_is_kept_with_the_model(unit, tmp_path):
    model = n4sid(record(0, noise=np.array([0.05, 0.1]), units=(1.0, unit)), feedthrough=False).model
    np.testing.assert_allclose(model.noise.output / unit, [0.05, 0.1], rtol=0.2)
    assert (model.noise.drift / unit < 0.03).all()
    model.save(tmp_path / "model.json")
    again = StateSpace.load(tmp_path / "model.json").noise
    assert np.array_equal(again.output, model.noise.output)
    assert np.array_equal(again.drift, model.noise.drift)


def test_the_estimator_starts_from_the_noise_of_the_model():
    noisy = mampc.StateSpace(
        PLANT.A, PLANT.B, PLANT.C, None, 10.0, PLANT.u_op, PLANT.y_op, noise=Noise([0.05, 0.5], [0.0, 0.0])
    )
    found = mampc.KalmanFilter.offset_free(noisy).gain
    np.testing.assert_allclose(
        found, mampc.KalmanFilter.offset_free(PLANT, measurement_noise=[0.05, 0.5]).gain, rtol=1e-9
    )


@pytest.mark.parametrize(
    "options", [{"output": [-1.0], "drift": [0.0]}, {"output": [1.0], "drift": [np.nan]}]
)
def test_noise_that_cannot_be_is_refused(options):
    with pytest.raises(MampcError, match=r"noise\..*: expected"):
        Noise(**options)


def test_step_responses_err_by_about_their_standard_deviations():
    true = PLANT.step_response(40)[1:]
    ratios = []
    for seed in range(10):
        fitted = n4sid(record(seed), order=2, feedthrough=False, detrend="constant", delays=0)
        error = fitted.model.step_response(40)[1:] - true
        ratios.append(error / fitted.uncertainty(40)[1:])
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-5, 1e4)])
def test_what_a_model_lacks_is_uncertain(units):
    """Forced to one state, a model lacks a mode, which leaving out segments does not show."""
    plant = StateSpace.from_first_order(
        gain=[[1.0, 0.5], [0.4, 2.0]], time_constant=[[2.0, 50.0], [60.0, 3.0]], dead_time=0.0, dt=1.0
    )
    u = prbs(order=9, hold=6, inputs=2, samples=2000, seed=1)
    y = plant.response(plant.u_op + u)
    y = y + 0.1 * np.random.default_rng(1).standard_normal(y.shape)
    fitted = n4sid(
        IOData(u * units[0], y * units[1], 1.0), order=2, detrend="constant", feedthrough=False, delays=0
    )
    error = fitted.model.step_response(150)[-1] * units[0] / units[1] - plant.step_response(150)[-1]
    ratio = error / (fitted.uncertainty(150)[-1] * units[0] / units[1])
    assert np.abs(error).max() > 0.05
    assert np.abs(ratio).max() < 3


def test_uncertainty_falls_with_the_length_of_the_record_and_grows_with_noise():
    def typical(**options):
        fitted = n4sid(record(3, **options), order=2, feedthrough=False, detrend="constant", delays=0)
        return np.sqrt(np.mean(fitted.uncertainty(40) ** 2))

    usual = typical()
    assert typical(samples=3200) < 0.8 * usual
    assert typical(noise=0.2) > 2 * usual


def test_units_of_the_uncertainty_are_those_of_the_response():
    u_unit, y_unit = np.array([1e-4, 1e5]), np.array([1e3, 1e-6])
    plain = n4sid(record(1), feedthrough=False).uncertainty(20)
    other = n4sid(record(1, units=(u_unit, y_unit)), feedthrough=False).uncertainty(20)
    np.testing.assert_allclose(other * u_unit / y_unit[:, None], plain, rtol=1e-4, atol=1e-7)


def test_a_record_too_short_for_segments_is_told():
    signals = np.random.default_rng(0).standard_normal((2, 20, 2))
    fitted = n4sid(IOData(*signals, 1.0), feedthrough=False, order=1)
    with pytest.raises(MampcError, match=r"uncertainty: expected records"):
        fitted.uncertainty(10)


@pytest.mark.parametrize("unit", [1e6, *deep(1.0)])
def test_a_part_of_a_long_record_says_how_certain_all_of_it_is(monkeypatch, unit):
    fitted = n4sid(record(3, samples=4000, units=(unit, 1.0)), feedthrough=False)
    whole = fitted.uncertainty(60)[-1]
    monkeypatch.setattr("mampc.identification.uncertainty.PLENTY", 1000)
    told = []
    few = fitted.uncertainty(60, progress=told.append)[-1]
    assert told == list(range(8))
    ratio = np.linalg.norm(few) / np.linalg.norm(whole)
    assert 0.4 < ratio < 2.5


def test_the_part_is_one_in_which_every_input_moves(monkeypatch):
    monkeypatch.setattr("mampc.identification.uncertainty.PLENTY", 1200)
    data = record(4, samples=6000)
    u = data.u.copy()
    u[:, 0] = np.where(np.arange(6000) < 4500, u[0, 0], u[:, 0])  # still at first
    [rows] = telling(scaled([IOData(u, data.y, data.dt)]))
    assert rows.start >= 4200
    assert rows.stop - rows.start == 1200


def test_of_many_short_records_the_longest_are_looked_at():
    records = scaled([record(5, samples=50 + k) for k in range(100)])
    few = records.shortened(1000)
    assert [len(u) for u in few.u] == list(range(144 - len(few.u) + 6, 150))
    assert len(few.y_mean) == len(few.u)
    assert 1000 <= few.samples < 1150


def test_an_input_that_stays_in_one_record_hides_no_movement_of_another_input():
    rng = np.random.default_rng(0)
    late, early = np.zeros((40_000, 2)), np.zeros((40_000, 2))
    late[30_000:35_000, 0] = np.sign(rng.standard_normal(5000))
    early[:, 1] = np.sign(rng.standard_normal(40_000))
    records = scaled([IOData(u, rng.standard_normal((40_000, 1)), 1.0) for u in (late, early)])
    where = telling(records)
    assert where[0].start <= 30_000
    assert where[0].stop >= 35_000
