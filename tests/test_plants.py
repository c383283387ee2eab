"""The quadruple tank: its operating point, its zeros, and levels that cannot be negative."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from mampc import MampcError, Names, excite, linearise
from mampc.plants import Plant, QuadrupleTank, SolidOxideFuelCell, advance

TANK = QuadrupleTank()
PERCENT = st.floats(0, 100)
LEVELS = st.lists(st.floats(0, 40), min_size=4, max_size=4).map(np.array)


def test_the_tank_is_a_plant():
    assert isinstance(TANK, Plant)


def test_half_open_valves_give_the_levels_of_the_paper():
    np.testing.assert_allclose(TANK.steady_state([50, 50]), [16.36, 13.68, 5.92, 8.09], atol=0.1)
    np.testing.assert_allclose(TANK.steady_state(), [16.3, 13.7, 6.0, 8.1], atol=0.1)
    np.testing.assert_allclose(TANK.output(TANK.steady_state()), [32.6, 27.4], atol=0.2)


@given(PERCENT, PERCENT)
@settings(deadline=None)
def test_nothing_moves_at_the_steady_state(u1, u2):
    rate = TANK.derivative(TANK.steady_state([u1, u2]), [u1, u2])
    np.testing.assert_allclose(rate, 0, atol=1e-12)


@given(LEVELS, PERCENT, PERCENT)
@settings(deadline=None)
def test_volume_is_conserved(levels, u1, u2):
    """What the pumps deliver, less what leaves the lower tanks, is what the four tanks gain."""
    gained = np.sum(np.array(TANK.areas) * TANK.derivative(levels, [u1, u2]))
    delivered = TANK.k_pump[0] * u1 + TANK.k_pump[1] * u2
    left = np.sum(np.array(TANK.outlets)[:2] * np.sqrt(2 * TANK.gravity * levels[:2]))
    np.testing.assert_allclose(gained, delivered - left, atol=1e-9)


def test_batches_are_evaluated_as_one_by_one():
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0, 30, (3, 5, 4)), rng.uniform(0, 100, (3, 5, 2))
    rates, outputs, rests = TANK.derivative(x, u), TANK.output(x, u), TANK.steady_state(u)
    assert (rates.shape, outputs.shape, rests.shape) == ((3, 5, 4), (3, 5, 2), (3, 5, 4))
    for i in np.ndindex(3, 5):
        assert np.array_equal(rates[i], TANK.derivative(x[i], u[i]))
        assert np.array_equal(outputs[i], TANK.output(x[i], u[i]))
        assert np.array_equal(rests[i], TANK.steady_state(u[i]))


def test_one_input_serves_a_batch_of_states():
    x = np.random.default_rng(0).uniform(0, 30, (6, 4))
    u = np.array([40.0, 60.0])
    assert np.array_equal(TANK.derivative(x, u), TANK.derivative(x, np.tile(u, (6, 1))))


@pytest.mark.parametrize("dt", [0.5, 10.0, 100.0])
def test_levels_never_fall_below_zero_when_draining(dt):
    x = TANK.steady_state()
    lowest = []
    for _ in range(150):
        x = advance(TANK, x, np.zeros(2), dt)
        assert np.isfinite(x).all()
        lowest.append(x.min())
    assert min(lowest) >= 0
    assert (TANK.output(x) >= 0).all()


def test_an_empty_tank_stays_empty_and_a_negative_input_does_not_pump_back():
    assert np.array_equal(TANK.derivative(np.zeros(4), np.zeros(2)), np.zeros(4))
    assert np.array_equal(TANK.derivative(np.zeros(4), [-10.0, -10.0]), np.zeros(4))
    assert (TANK.derivative([-1e-9] * 4, [0.0, 0.0]) >= 0).all()


def test_two_half_steps_are_one_step():
    x, u = np.array([5.0, 10.0, 2.0, 3.0]), np.array([70.0, 30.0])
    halves = advance(TANK, advance(TANK, x, u, 5.0), u, 5.0)
    np.testing.assert_allclose(halves, advance(TANK, x, u, 10.0), rtol=1e-6)


def test_the_steady_state_is_reached_from_empty_tanks():
    x = advance(TANK, np.zeros(4), np.array([50.0, 50.0]), 3000.0)
    np.testing.assert_allclose(x, TANK.steady_state(), rtol=1e-3)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("rate", [np.square, lambda x: 200 * x, lambda x: x * np.nan, lambda x: x / 0.0])
def test_a_plant_that_blows_up_is_reported(rate):
    class Explosive(QuadrupleTank):
        def derivative(self, x, u):
            return rate(x)

    with pytest.raises(MampcError, match="Explosive: the integration failed"), np.errstate(all="ignore"):
        advance(Explosive(), np.ones(4), np.zeros(2), 10.0)


def test_most_flow_through_the_upper_tanks_makes_a_non_minimum_phase_zero():
    zeros = linearise(TANK).zeros()
    assert np.isreal(zeros).all()
    assert np.sum(zeros.real > 0) == 1
    np.testing.assert_allclose(zeros.real.max(), 0.034, atol=0.001)


@pytest.mark.parametrize(
    ("gamma", "minimum_phase"), [((0.7, 0.7), True), ((0.6, 0.5), True), ((0.5, 0.4), False)]
)
def test_the_sign_of_the_zero_follows_the_sum_of_the_splits(gamma, minimum_phase):
    zeros = linearise(replace(TANK, gamma=gamma)).zeros()
    assert (zeros.real < 0).all() == minimum_phase


@pytest.mark.parametrize("u", [(50.0, 50.0), (20.0, 80.0)])
def test_the_linearisation_matches_the_jacobian_by_hand(u):
    model = linearise(TANK, u)
    areas, (g1, g2), (k1, k2) = np.array(TANK.areas), TANK.gamma, TANK.k_pump
    leak = np.array(TANK.outlets) * np.sqrt(TANK.gravity / (2 * TANK.steady_state(u)))
    A = np.diag(-leak / areas)
    A[0, 2], A[1, 3] = leak[2] / areas[0], leak[3] / areas[1]
    B = np.array([[g1 * k1, 0], [0, g2 * k2], [0, (1 - g2) * k2], [(1 - g1) * k1, 0]]) / areas[:, None]
    np.testing.assert_allclose(model.A, A, atol=1e-9)
    np.testing.assert_allclose(model.B, B, atol=1e-9)
    np.testing.assert_allclose(model.C, TANK.k_c * np.eye(2, 4), atol=1e-8)
    np.testing.assert_allclose(model.D, np.zeros((2, 2)), atol=1e-12)
    np.testing.assert_allclose(model.u_op, u)
    np.testing.assert_allclose(model.y_op, TANK.output(TANK.steady_state(u)))
    assert model.names == TANK.names


@given(st.floats(10, 90), st.floats(10, 90))
@settings(max_examples=25, deadline=None)
def test_the_tank_is_stable_at_every_operating_point(u1, u2):
    assert linearise(TANK, [u1, u2]).is_stable()


@pytest.mark.parametrize(
    "parameters",
    [
        {"areas": (730.0, 730.0)},
        {"areas": (730.0, 730.0, 0.0, 730.0)},
        {"outlets": (2.0, 2.0, 2.0, -1.0)},
        {"outlets": (2.0, 2.0, 2.0, np.nan)},
        {"gravity": 0.0},
        {"gravity": "strong"},
        {"k_c": -2.0},
        {"k_c": np.inf},
        {"gamma": (1.2, 0.3)},
        {"gamma": (0.3, -0.1)},
        {"gamma": (0.3, 0.3, 0.3)},
        {"k_pump": (0.0, 7.0)},
        {"u_op": (50.0, 50.0, 50.0)},
        {"u_op": (-1.0, 50.0)},
    ],
    ids=repr,
)
def test_impossible_parameters_are_refused(parameters):
    with pytest.raises(MampcError, match=rf"{next(iter(parameters))}: expected .* received"):
        QuadrupleTank(**parameters)


@pytest.mark.parametrize("u", [[-1.0, 50.0], [np.nan, 50.0], [50.0], 50.0, [1.0, 2.0, 3.0]])
def test_no_steady_state_exists_for_impossible_inputs(u):
    with pytest.raises(MampcError, match=r"expected inputs .* received"):
        TANK.steady_state(u)


@pytest.mark.parametrize("parameter", fields(QuadrupleTank), ids=lambda parameter: parameter.name)
def test_every_parameter_documents_its_unit_and_source(parameter):
    assert parameter.metadata["unit"]
    assert len(parameter.metadata["source"]) > 10


@pytest.mark.parametrize("dt", [0.1, 1.0, 10.0, 60.0, 600.0])
def test_a_plant_is_advanced_as_exactly_as_by_an_integrator_of_higher_order(dt):
    rng = np.random.default_rng(3)
    for _ in range(10):
        x, u = TANK.steady_state(rng.uniform(20, 80, 2)), rng.uniform(20, 80, 2)
        exact = solve_ivp(
            lambda t, h, u=u: TANK.derivative(h, u), (0, dt), x, method="DOP853", rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(advance(TANK, x, u, dt), exact.y[:, -1], rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize(("plant", "dt"), [(TANK, 10.0), (TANK, 200.0), (SolidOxideFuelCell(), 0.5)])
def test_batches_are_advanced_as_one_by_one(plant, dt):
    rng = np.random.default_rng(5)
    x, u = np.array(plant.steady_state()), np.array(plant.u_op)
    states, inputs = x * rng.uniform(0.9, 1.1, (3, 4, len(x))), u * rng.uniform(0.9, 1.1, (3, 4, len(u)))
    states[0, 0], inputs[0, 0] = 1e-3 * x, 0.8 * u  # nearly empty: another number of steps
    ends = advance(plant, states, inputs, dt)
    for i in np.ndindex(3, 4):
        np.testing.assert_allclose(ends[i], advance(plant, states[i], inputs[i], dt), rtol=1e-12)


class Rescaled:
    """A plant with its states in another unit."""

    def __init__(self, plant, unit):
        self.plant, self.unit, self.names, self.u_op = plant, unit, plant.names, plant.u_op

    def derivative(self, x, u):
        return self.unit * self.plant.derivative(x / self.unit, u)

    def output(self, x, u):
        return self.plant.output(x / self.unit, u)

    def steady_state(self, u=None):
        return self.unit * self.plant.steady_state(u)


class RunawayReactor:
    """An exothermic reactor that ignites and goes out: dimensionless reactant and temperature, cooled by its input."""

    names = Names(inputs=("cooling",), outputs=("temperature",), states=("reactant", "temperature"))
    u_op = (1.0,)

    def derivative(self, x, u):
        rate = 60.0 * x[..., 0] * np.exp(-8.0 / np.maximum(x[..., 1], 0.1))
        return np.stack(
            [1 - x[..., 0] - rate, 1 - x[..., 1] + 4 * rate - (x[..., 1] - 1) * u[..., 0]], axis=-1
        )

    def output(self, x, u):
        return x[..., 1:]

    def steady_state(self, u=None):
        return np.array([0.05, 2.9])


@pytest.mark.parametrize("unit", [1e-9, 1e-4, 1e6])
def test_units_of_states_do_not_decide_how_exactly_a_plant_is_integrated(unit):
    plant = RunawayReactor()
    courses = []
    for one in (plant, Rescaled(plant, unit)):
        inputs = np.repeat([0.5, 3.0, 0.2, 6.0], 8)[:, None]
        courses.append(excite(one, inputs, dt=0.7).y)
    assert np.ptp(courses[0]) > 0.5
    np.testing.assert_allclose(courses[1], courses[0], rtol=1e-8)


class Deviation:
    """A lag and what its square drives, both at rest at zero, with states and output of a unit of their own."""

    names, u_op = Names(("u",), ("y",), ("fast", "slow")), np.array([1.0])

    def __init__(self, unit):
        self.unit = unit

    def derivative(self, x, u):
        a, b = x[..., 0] / self.unit, x[..., 1] / self.unit
        return self.unit * np.stack([np.asarray(u)[..., 0] - 1 - a, a + a * a - 50 * b], -1)

    def output(self, x, u):
        return x[..., 1:] / self.unit

    def steady_state(self, u=None):
        a = 0.0 if u is None else float(np.ravel(u)[0]) - 1.0
        return self.unit * np.array([a, (a + a * a) / 50])


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e6])
def test_states_at_rest_at_zero_are_integrated_alike_in_every_unit(unit):
    signal = np.repeat([[0.0], [2.0]], 5, axis=0)
    expected, found = (excite(Deviation(one), signal, dt=1.0).y for one in (1.0, unit))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)
