"""Drifts, trends, dead times and several records: the gain is the plant's, whatever lies over it."""

import numpy as np
import pytest
from scipy.signal import lfilter

from mampc import IOData, MampcError, StateSpace, n4sid, prbs
from mampc.identification.delays import find_delays
from seeds import deep, examples, seeds

UNITS = [(1e-4, 1e5), *deep((1.0, 1.0))]


def first_order(u, time_constant, gain=2.0, delay=0):
    """A plant of one input sampled every second, dead time in samples."""
    pole = np.exp(-1 / time_constant)
    late = np.concatenate([np.zeros(delay + 1), u])[: len(u)]
    return gain * lfilter([1 - pole], [1.0, -pole], late)


def record_with(disturbance, *, seed=0, samples=1500, time_constant=20, noise=0.1, units=(1.0, 1.0)):
    """PRBS through a plant of gain 2 under a disturbance, a function of a random generator and N."""
    rng = np.random.default_rng(seed)
    u = prbs(order=9, hold=10, samples=samples, seed=seed)[:, 0]
    y = first_order(u, time_constant) + noise * rng.standard_normal(samples) + disturbance(rng, samples)
    return IOData((u + 3) * units[0], (y + 7) * units[1], 1.0)


def gain_of(fitted, units=(1.0, 1.0)):
    return fitted.model.dc_gain().item() * units[0] / units[1]


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("time_constant", [20, 60])
@pytest.mark.parametrize("slope", [5.0, 100.0, *deep(-20.0, 20.0)])
def test_a_ramp_does_not_change_the_gain(slope, time_constant, units):
    record = record_with(
        lambda rng, N: slope * np.arange(N) / N, time_constant=time_constant, units=units, seed=1
    )
    fitted = n4sid(record, feedthrough=False)
    assert fitted.integrators == 0
    assert fitted.detrend in ("linear", "differences")
    assert "line in time" in fitted.notes[0] or "changes" in fitted.notes[0]
    assert gain_of(fitted, units) == pytest.approx(2.0, abs=0.1)
    assert (fitted.fit > 75).all()


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("step", [0.05, 0.2])
@pytest.mark.parametrize("seed", [0, *deep(2, 3)])
def test_a_random_walk_leaves_the_gain_roughly_right(seed, step, units):
    record = record_with(
        lambda rng, N: step * np.cumsum(rng.standard_normal(N)), seed=seed, samples=2000, noise=0.02, units=units
    )  # fmt: skip
    assert gain_of(n4sid(record, feedthrough=False), units) == pytest.approx(2.0, rel=0.3)


def test_slow_and_fast_channels_keep_their_states_under_coloured_noise():
    """Six lags of 3 to 40 samples and noise of a pole at 0.9: the error stays small beside the gains."""
    rng = np.random.default_rng(1)
    gain = rng.uniform(0.3, 2.0, (3, 2)) * rng.choice([-1, 1], (3, 2))
    plant = StateSpace.from_first_order(
        gain=gain, time_constant=np.exp(rng.uniform(np.log(3), np.log(40), (3, 2))), dead_time=0.0, dt=1.0
    )
    u = prbs(order=10, hold=8, inputs=2, samples=3000, seed=0)
    clean = plant.response(plant.u_op + u)
    noise = lfilter(
        [np.sqrt(1 - 0.81)], [1.0, -0.9], np.random.default_rng(5).standard_normal(clean.shape), axis=0
    )
    fitted = n4sid(IOData(u, clean + 0.3 * clean.std(axis=0) * noise, 1.0), feedthrough=False)
    error = np.abs(fitted.model.step_response(100) - plant.step_response(100)).max(axis=(0, 2))
    assert (error < 0.2 * np.abs(gain).max(axis=1)).all()


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("periods", [0.6, 2.0, *deep(0.9, 6.0)])
@pytest.mark.parametrize("size", [20.0, *deep(2.0)])
def test_a_slow_wave_does_not_change_the_gain(size, periods, units):
    record = record_with(
        lambda rng, N: size * np.sin(2 * np.pi * periods * np.arange(N) / N + 1.0), units=units, seed=1
    )
    fitted = n4sid(record, feedthrough=False)
    assert "slow waves" in fitted.notes[0]
    assert gain_of(fitted, units) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("seed", seeds(4, quick=1))
def test_changes_are_not_explained_where_coloured_noise_does_not_walk(seed):
    """A plant that answers the wrong way first: from changes its gain would err by a quarter."""
    poles = np.poly([np.exp(-0.1)] * 2)
    zeros = np.array([1.0, -1.12]) * poles.sum() * 2.0 / -0.12
    plant = StateSpace([[-poles[1], 1.0], [-poles[2], 0.0]], zeros[:, None], [[1.0, 0.0]], None, 1.0)
    u = prbs(order=10, hold=6, samples=2000, seed=seed)
    clean = plant.response(u)
    rng = np.random.default_rng(seed)
    noise = lfilter([np.sqrt(1 - 0.81)], [1.0, -0.9], rng.standard_normal(clean.shape), axis=0)
    noise = noise + 0.1 * rng.standard_normal(clean.shape)
    fitted = n4sid(IOData(u, clean + 0.3 * clean.std() * noise, 1.0), feedthrough=False)
    error = np.abs(fitted.model.step_response(80) - plant.step_response(80)).max()
    assert fitted.detrend != "differences"
    assert error < 0.1 * 2.0


@pytest.mark.parametrize("detrend", ["whitened", "differences", "linear"])
def test_any_trend_may_be_asked_of_a_record_with_white_noise(detrend):
    fitted = n4sid(record_with(lambda rng, N: 0.0), feedthrough=False, detrend=detrend)
    assert fitted.detrend == detrend
    assert gain_of(fitted) == pytest.approx(2.0, abs=0.1)


def test_a_record_that_does_not_drift_is_not_detrended():
    for seed in range(examples(4, quick=2)):
        fitted = n4sid(record_with(lambda rng, N: 0.0, seed=seed), feedthrough=False)
        assert fitted.detrend == "constant"
        assert gain_of(fitted) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("detrend", ["none", "constant", "linear", "differences"])
def test_what_is_asked_for_is_done(detrend):
    rng = np.random.default_rng(0)
    u = prbs(order=9, hold=10, samples=1500)[:, 0]
    record = IOData(u, first_order(u, 20) + 0.02 * rng.standard_normal(1500), 1.0)
    fitted = n4sid(record, feedthrough=False, detrend=detrend)
    assert fitted.detrend == detrend
    assert gain_of(fitted) == pytest.approx(2.0, abs=0.1)
    if detrend == "none":
        assert np.array_equal(fitted.model.y_op, [0.0])
        assert np.array_equal(fitted.model.u_op, [0.0])


def delayed_record(delays, time_constants, seed, *, noise=0.05, samples=2500, units=(1.0, 1.0)):
    rng = np.random.default_rng(seed)
    l, m = np.shape(delays)
    u = prbs(order=10, hold=10, inputs=m, samples=samples, seed=seed)
    gains = rng.uniform(0.5, 2.0, (l, m)) * rng.choice([-1, 1], (l, m))
    y = np.array(
        [
            sum(first_order(u[:, j], time_constants[i], gains[i, j], delays[i][j]) for j in range(m))
            for i in range(l)
        ]
    ).T
    noisy = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    return IOData(u * units[0], noisy * units[1], 1.0), IOData(u * units[0], y * units[1], 1.0)


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("noise", [0.1, *deep(0.02)])
@pytest.mark.parametrize(
    "delays", [[[150]], [[45, 5], [12, 30]], *deep([[45]], [[45, 45], [44, 46]])],
    ids=["long", "four", "one", "alike"],
)  # fmt: skip
def test_dead_times_are_found_and_cost_no_fit(delays, noise, units):
    time_constants = [20, 40][: len(delays)]
    record, clean = delayed_record(delays, time_constants, 1, noise=noise, units=units)
    fitted = n4sid(record, feedthrough=False)
    assert np.abs(fitted.delays - delays).max() <= 3
    by_hand = n4sid(record, feedthrough=False, delays=delays)
    assert (fitted.validate(clean).fit > 97).all()
    assert (fitted.validate(clean).fit > by_hand.validate(clean).fit - 1.5).all()
    response = fitted.model.step_response(int(np.min(delays)))
    assert np.array_equal(response[:-4], np.zeros_like(response[:-4]))
    assert any("Dead times" in note for note in fitted.notes)


def test_a_plant_without_dead_time_gets_none():
    record, _ = delayed_record([[0, 1], [2, 0]], [20, 40], 2, samples=1200)
    assert np.array_equal(n4sid(record, feedthrough=False).delays, np.zeros((2, 2)))


@pytest.mark.parametrize("delays", [-1, 2.5, 1000, [[1, 2]]])
def test_dead_times_that_cannot_be_are_refused(delays):
    with pytest.raises(MampcError, match="delays: expected"):
        n4sid(delayed_record([[3]], [5], 0)[0], delays=delays)


# Several records


def two_by_two():
    return StateSpace(
        [[0.95, 0.02], [0.0, 0.9]], [[0.1, 0.02], [0.03, 0.2]], np.eye(2), None, 10.0, [5.0, 6.0], [1.0, 2.0]
    )


def pieces(count, *, samples=400, offset=0.0, noise=0.02):
    """Records of one plant, each from a state and with constants of its own."""
    plant, records = two_by_two(), []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        u = plant.u_op + prbs(order=8, hold=6, inputs=2, samples=samples, seed=seed)
        y = plant.response(u, rng.standard_normal(2)) + offset * rng.standard_normal(2)
        records.append(IOData(u, y + noise * rng.standard_normal(y.shape), plant.dt))
    return records


@pytest.mark.parametrize("offset", [5.0, *deep(0.0)])
def test_several_records_make_one_model_whatever_their_levels(offset):
    plant, records = two_by_two(), pieces(4, offset=offset)
    fitted = n4sid(records, feedthrough=False)
    np.testing.assert_allclose(fitted.model.dc_gain(), plant.dc_gain(), atol=0.1)
    alone = n4sid(records[0], feedthrough=False)
    true = plant.step_response(100)

    def miss(found):
        return np.abs(found.model.step_response(100) - true).max()

    assert miss(fitted) < miss(alone)


@pytest.mark.parametrize("first", [5, 41, 60])
def test_dead_times_may_be_longer_than_a_piece_of_the_record(first):
    plant = StateSpace.from_first_order(gain=2.0, time_constant=8.0, dead_time=40.0, dt=1.0)
    u = prbs(order=10, hold=8, samples=600, seed=0)
    data = IOData(u, plant.response(u) + 0.1 * np.random.default_rng(0).standard_normal((600, 1)), 1.0)
    fitted = n4sid([data[:first], data[first:]], delays=40, feedthrough=False, detrend="constant")
    assert fitted.delays.item() == 40
    assert gain_of(fitted) == pytest.approx(2.0, abs=0.1)


def test_a_record_cut_in_two_is_nearly_the_whole():
    (whole,) = pieces(1, samples=1000)
    cut = n4sid([whole[:450], whole[450:]], feedthrough=False)
    np.testing.assert_allclose(
        cut.model.step_response(60), n4sid(whole, feedthrough=False).model.step_response(60), atol=0.05
    )


def test_records_that_do_not_belong_together_are_refused():
    first, second = pieces(2)
    other = IOData(second.u, second.y, 5.0)
    with pytest.raises(MampcError, match="one sample time"):
        n4sid([first, other])
    with pytest.raises(MampcError, match="expected a record"):
        n4sid([])


def test_stages_are_told():
    told = []
    n4sid(pieces(2, samples=150), feedthrough=False, progress=told.append)
    assert told[0] == "looking for dead times"
    assert "all of the record" in told[-1]
    assert any("ARX" in stage for stage in told)


@pytest.mark.parametrize("samples", [2, 3, 9])
def test_a_record_too_short_to_make_white_does_no_harm(samples):
    rng, plant = (
        np.random.default_rng(0),
        StateSpace.from_first_order(gain=2.0, time_constant=5.0, dt=1.0),
    )
    records = []
    for N in (200, samples):
        u = np.repeat(rng.choice([-1.0, 1.0], (N // 5 + 1, 1)), 5, axis=0)[:N]
        records.append(IOData(u, plant.response(u) + 0.02 * rng.standard_normal((N, 1)), 1.0))
    model = n4sid(records, detrend="whitened").model
    assert model.dc_gain()[0, 0] == pytest.approx(2.0, rel=0.05)


def test_an_order_that_is_asked_for_is_kept_where_disturbances_are_made_white():
    rng, plant = (
        np.random.default_rng(0),
        StateSpace.from_first_order(gain=2.0, time_constant=5.0, dt=1.0),
    )
    u = np.repeat(rng.choice([-1.0, 1.0], (100, 1)), 5, axis=0)
    data = IOData(u, plant.response(u) + 0.1 * rng.standard_normal((500, 1)), 1.0)
    assert n4sid(data, detrend="whitened", order=2).order == 2


def test_an_input_that_stands_still_has_no_dead_time():
    rng = np.random.default_rng(0)
    u = np.column_stack([rng.standard_normal(500), np.zeros(500)])
    y = lfilter([0.0] * 8 + [1.0], [1.0, -0.8], u[:, :1], axis=0)
    delays = find_delays([u], [y + 0.01 * rng.standard_normal(y.shape)])
    assert abs(delays[0, 0] - 7) <= 1
    assert delays[0, 1] == 0
