"""Columns with dead times, the van de Vusse reactor, an integrating level: right, and ready to be controlled."""

import numpy as np
import pytest

import mampc
from mampc.plants import Level, VanDeVusse, advance, ogunnaike_ray, wood_berry
from mampc.study import parse_study, run_study, template

REACTOR, LEVEL = VanDeVusse(), Level()
WOOD_BERRY = [  # gain, time constant and dead time in minutes
    [(12.8, 16.7, 1.0), (-18.9, 21.0, 3.0), (3.8, 14.9, 8.1)],
    [(6.6, 10.9, 7.0), (-19.4, 14.4, 3.0), (4.9, 13.2, 3.4)],
]


@pytest.mark.parametrize("dt", [7.0, 60.0, 90.0, 600.0])
def test_the_samples_of_the_column_are_those_of_its_transfer_functions(dt):
    response = wood_berry(dt).step_response(200)
    minutes = dt / 60.0 * np.arange(200)
    for i, row in enumerate(WOOD_BERRY):
        for j, (gain, time_constant, dead_time) in enumerate(row):
            exact = gain * -np.expm1(-np.maximum(minutes - dead_time, 0.0) / time_constant)
            np.testing.assert_allclose(response[:, i, j], exact, atol=1e-9)


def test_the_column_with_a_side_stream_has_the_response_of_its_transfer_functions():
    response = ogunnaike_ray(20.0).step_response(900)
    minutes = np.arange(900) / 3
    late = np.maximum(minutes - 2.6, 0.0)
    np.testing.assert_allclose(response[:, 0, 0], 0.66 * -np.expm1(-late / 6.7), atol=1e-9)
    # 0.87 (11.61 s + 1) / ((3.89 s + 1) (18.8 s + 1)) by partial fractions
    late = np.maximum(minutes - 1.0, 0.0)
    first, second = (3.89 - 11.61) / (18.8 - 3.89), (18.8 - 11.61) / (3.89 - 18.8)
    exact = 0.87 * (1 + first * np.exp(-late / 3.89) + second * np.exp(-late / 18.8))
    np.testing.assert_allclose(response[:, 2, 2], exact, atol=1e-9)
    np.testing.assert_allclose(response[-1, 1], [1.11, -2.36, -0.012, 0.53, -0.0032], rtol=1e-3)


def test_the_reactor_rests_where_its_source_says():
    np.testing.assert_allclose(REACTOR.steady_state(), [3.0, 1.12], atol=0.005)
    u = np.stack([np.linspace(0, 200, 41), np.full(41, 9.0)], axis=-1)
    np.testing.assert_allclose(REACTOR.derivative(REACTOR.steady_state(u), u), 0.0, atol=1e-12)


def test_the_reactor_has_the_linear_model_that_its_source_prints():
    model = mampc.linearise(REACTOR, [240 / 7])  # 4/7 of the volume a minute
    minutes = 60.0  # from rates per second; the input is printed per minute, here it is per hour
    np.testing.assert_allclose(model.A * minutes, [[-2.4048, 0.0], [0.8333, -2.2381]], atol=1e-4)
    np.testing.assert_allclose(model.B[:, 0] * minutes * 60.0, [7.0, -1.117], atol=1e-3)


def test_the_reactor_answers_the_wrong_way_first_below_its_maximum():
    rates = np.linspace(1, 200, 2000)[:, None]
    best = rates[REACTOR.steady_state(rates)[:, 1].argmax(), 0]
    assert best == pytest.approx(77.5, abs=0.5)
    for u, minimum_phase in ((34.3, False), (120.0, True)):
        model = mampc.linearise(REACTOR, [u])
        one_input = mampc.StateSpace(model.A, model.B[:, :1], model.C, None, 0.0)
        assert (one_input.zeros().real < 0).all() == minimum_phase


def test_a_level_integrates_the_difference_and_stops_when_full():
    x = LEVEL.steady_state()
    after = advance(LEVEL, x, np.array([60.0]), 1000.0)
    assert after[1] - x[1] == pytest.approx(0.01 / 10.0 * (1000.0 - 20.0), rel=1e-4)
    full = advance(LEVEL, x, np.array([100.0]), 5000.0)
    assert LEVEL.output(full) == pytest.approx(4.0)
    assert LEVEL.faults(full) == ("overflow",)
    assert LEVEL.faults(np.array([x, full])) == ("overflow",)
    assert LEVEL.faults(x) == ()
    with pytest.raises(mampc.MampcError, match="an inflow equal to the demand"):
        LEVEL.steady_state([60.0])


@pytest.mark.parametrize("plant", [REACTOR, LEVEL], ids=["reactor", "level"])
def test_batches_are_evaluated_as_one_by_one(plant):
    rng = np.random.default_rng(0)
    x = plant.steady_state() * rng.uniform(0.9, 1.1, (3, 5, 2))
    both = np.concatenate([plant.u_op, plant.v_op])
    u = both * rng.uniform(0.9, 1.1, (3, 5, 2))
    rates, outputs = plant.derivative(x, u), plant.output(x, u)
    for i in np.ndindex(3, 5):
        np.testing.assert_array_equal(rates[i], plant.derivative(x[i], u[i]))
        np.testing.assert_array_equal(outputs[i], plant.output(x[i], u[i]))
    np.testing.assert_array_equal(plant.derivative(x, both[:1]), plant.derivative(x, both))


@pytest.mark.parametrize(
    ("plant", "dt", "load", "change"),
    [
        (wood_berry(), 60.0, [0.2], [0.5, -0.1]),
        (ogunnaike_ray(), 60.0, [0.05, 1.0], [0.01, 0.01, 0.5]),
        (REACTOR, REACTOR.dt, [0.3], [0.03]),
        (LEVEL, LEVEL.dt, [0.005], [0.2]),
    ],
    ids=["wood-berry", "ogunnaike-ray", "reactor", "level"],
)
def test_set_points_and_unmeasured_loads_leave_no_offset(plant, dt, load, change):
    whole = plant if isinstance(plant, mampc.StateSpace) else mampc.linearise(plant).discretise(dt)
    m = whole.n_inputs
    model = mampc.StateSpace(  # knows nothing of the load
        whole.A, whole.B[:, :m], whole.C, whole.D[:, :m], dt, whole.u_op, whole.y_op
    )
    u_op = np.asarray(whole.u_op)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=40, control_horizon=3, output_weight=np.asarray(change) ** -2.0,
        move_weight=0.1 * u_op**-2.0, limits=mampc.Limits(u_min=0.0, u_max=2 * u_op),
    )  # fmt: skip
    run = mampc.simulate(
        plant, mampc.Regulator(mampc.MPC(problem)), whole.y_op + change, steps=400,
        loads=[mampc.loads.Steps(sizes=[load], times=[100 * dt], at="measured")],
    )  # fmt: skip
    np.testing.assert_allclose((run.y[[95, -1]] - run.r[-1]) / change, 0.0, atol=0.02)
    assert not run.faults


@pytest.mark.parametrize(
    ("kind", "dt", "amplitude", "initial"),
    [
        ("wood-berry", 60, "0.1", [0.0, 0.0]),
        ("ogunnaike-ray", 60, "[0.02, 0.005, 1.0]", [0.0, 0.0, 0.0]),
        ("van-de-vusse", 7.2, "5.0", [0.0]),
        ("level", 10, "5.0", [0.0]),
    ],
)
def test_a_study_runs_on_each_of_them(kind, dt, amplitude, initial):
    text = template()
    text = text[: text.index("[problem]")].replace('"10 s"', str(dt)).replace('"quadruple-tank"', f'"{kind}"')
    text = text.replace("amplitude = 25.0", f"amplitude = {amplitude}").replace("steps = 145", "steps = 20")
    text = text.replace("prbs_order = 8 ", "prbs_order = 6 ").replace("noise = 0.1 ", "noise = 0.0 ")
    text = text.replace("\norder = 4 ", "\n# order = 4 ")
    text += f"""
[problem]
prediction_horizon = 20
control_horizon = 3
[reference]
initial = {initial}
[[scenarios]]
name = "one"
[[controllers]]
name = "MPC"
method = "mpc"
"""
    run = run_study(parse_study(text)).runs["one"]["MPC"]
    assert np.isfinite(run.u).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: VanDeVusse(k1=0.0), "k1: expected"),
        (lambda: VanDeVusse(u_op=(-1.0,)), "u_op: expected"),
        (lambda: VanDeVusse().steady_state([-1.0]), "steady_state: expected"),
        (lambda: Level(area=-1.0), "area: expected"),
        (lambda: Level(level=5.0), "level: expected at most 4"),
        (lambda: Level(demand=0.2), "demand: expected at most 0.1"),
        (lambda: wood_berry(0.0), "dt: expected"),
    ],
)
def test_impossible_parameters_are_refused(make, message):
    with pytest.raises(mampc.MampcError, match=message):
        make()
