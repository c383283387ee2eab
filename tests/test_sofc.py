"""The fuel-cell stack against figures worked out from the paper's equations, and at its limits."""

import dataclasses

import numpy as np
import pytest

import mampc
from mampc.plants import SolidOxideFuelCell, advance

STACK = SolidOxideFuelCell()
NOMINAL = np.array([100.0, 100.0])


def test_the_steady_state_is_the_published_one():
    x = STACK.steady_state(NOMINAL)
    np.testing.assert_allclose(x, [24.05e3, 77.56e3, 15.46e3, 93.69e3], rtol=1e-3)
    np.testing.assert_allclose(STACK.output(x, NOMINAL), [224.9], rtol=1e-3)
    np.testing.assert_allclose(STACK.derivative(x, NOMINAL), 0.0, atol=1e-6)


def test_gains_and_modes_are_the_published_ones():
    model = mampc.linearise(STACK)
    np.testing.assert_allclose(model.dc_gain()[0, :2], [0.77, 0.071], rtol=0.01)
    poles = model.poles()
    np.testing.assert_allclose(poles.imag, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.sort(-1 / poles.real), [0.018, 0.12, 0.90, 3.2], rtol=0.01)


def test_a_larger_current_lowers_the_voltage_at_once_and_for_good():
    model = mampc.linearise(STACK)
    assert model.names.disturbances == ("current",)
    assert model.D[0, 2] < 0
    assert model.dc_gain()[0, 2] < model.D[0, 2]


@pytest.mark.parametrize("u", [[100.0, 100.0], [95.0, 110.0, 380.0], [110.0, 80.0, 430.0]])
def test_the_mass_balance_closes(u):
    """At rest every atom that comes in goes out: hydrogen, oxygen and nitrogen, to 1e-8 of the flow."""
    x, current = STACK.steady_state(u), u[2] if len(u) == 3 else STACK.current
    fuel, air = STACK.fuel_flow * u[0] / 100, STACK.air_flow * u[1] / 100
    C = STACK.discharge_coefficient / np.sqrt(1 - STACK.diameter_ratio**4)
    RT = STACK.gas_constant * STACK.temperature
    M = np.array(STACK.molar_masses)

    def outflow(p, masses, area):
        return C * area * p * np.sqrt(2 * (p.sum() - STACK.atmosphere) / (RT * (p @ masses)))

    h2, steam = outflow(x[:2], M[:2], STACK.anode_orifice)
    o2, n2 = outflow(x[2:], M[2:], STACK.cathode_orifice)
    used = STACK.n_cells * current / (4 * STACK.faraday)  # O2
    assert h2 + steam == pytest.approx(fuel, rel=1e-8)
    assert h2 == pytest.approx(0.9 * fuel - 2 * used, rel=1e-8)
    assert o2 == pytest.approx(0.21 * air - used, rel=1e-8)
    assert n2 == pytest.approx(0.79 * air, rel=1e-8)


def test_batches_equal_one_by_one():
    rng = np.random.default_rng(0)
    x = STACK.steady_state() * rng.uniform(0.8, 1.2, (7, 4))
    u = np.hstack([rng.uniform(80, 120, (7, 2)), rng.uniform(350, 450, (7, 1))])
    for method in (STACK.derivative, STACK.output):
        np.testing.assert_allclose(method(x, u), [method(a, b) for a, b in zip(x, u, strict=True)])
    np.testing.assert_allclose(STACK.steady_state(u), [STACK.steady_state(v) for v in u])


@pytest.mark.parametrize(
    ("u", "word"), [([73.0, 100.0], "H2"), ([100.0, 37.0], "O2"), ([100.0, 100.0, 2500.0], "current")]
)
def test_no_steady_state_without_gas_or_beyond_the_limiting_current(u, word):
    with pytest.raises(mampc.MampcError, match=word):
        STACK.steady_state(u)


@pytest.mark.parametrize(
    ("u", "fault"),
    [
        ([20.0, 100.0, 400.0], "H2 starvation"),
        ([100.0, 5.0, 400.0], "O2 starvation"),
        ([100.0, 100.0, 3000.0], "limiting current density"),
        ([0.0, 0.0, 0.0], None),
    ],
)
def test_outside_its_range_the_stack_stays_finite_and_says_so(u, fault):
    x, u = STACK.steady_state(NOMINAL), np.array(u)
    for _ in range(40):
        x = advance(STACK, x, u, 0.5)
        assert np.isfinite(x).all()
        assert np.isfinite(STACK.output(x, u)).all()
    if fault is not None:
        assert fault in STACK.faults(x, u)
    assert STACK.faults(STACK.steady_state(NOMINAL), NOMINAL) == ()
    assert "pressure below atmospheric" in STACK.faults(np.array([2e4, 5e4, 2e4, 9e4]), NOMINAL)


def test_a_run_into_starvation_is_flagged_and_finite():
    model = mampc.linearise(STACK).discretise(0.5)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=5, limits=mampc.Limits(u_min=60.0, u_max=120.0)
    )
    run = mampc.simulate(STACK, mampc.Regulator(mampc.MPC(problem)), [130.0], steps=60)
    assert np.isfinite(run.y).all()
    assert any("H2 starvation" in faults for faults in run.faults.values())


def test_a_step_of_the_measured_current_is_predicted():
    """Told of the current, the regulator loses less than one that must find out by itself."""
    model = mampc.linearise(STACK).discretise(0.5)
    limits = mampc.Limits(u_min=[80.0, 50.0], u_max=[120.0, 150.0])
    problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=5, limits=limits)
    blind = mampc.StateSpace(
        model.A, model.B[:, :2], model.C, model.D[:, :2], 0.5, model.u_op, model.y_op,
        mampc.Names(("fuel", "air"), ("voltage",)),
    )  # fmt: skip
    unaware = mampc.TrackingProblem(blind, prediction_horizon=10, control_horizon=5, limits=limits)
    current = mampc.steps(60, [400.0], [(10, [420.0])])
    errors = [
        mampc.simulate(
            STACK, mampc.Regulator(mampc.MPC(p)), model.y_op, steps=60, measured_disturbance=current
        ).metrics().tracking_error
        for p in (problem, unaware)
    ]  # fmt: skip
    assert errors[0] < 0.9 * errors[1]


def test_the_lean_variant_swings_over_the_papers_band():
    lean = SolidOxideFuelCell(variant="paper-band")
    assert lean.h2_fraction == 0.705
    signal = mampc.prbs(order=6, amplitude=[5.0, 10.0], hold=5, mean=lean.u_op)
    swing = mampc.excite(lean, signal, dt=0.5).y - lean.output(lean.steady_state())
    assert -60 < swing.min() < -25
    assert 5 < swing.max() < 30


def test_two_or_three_modes_are_found_and_more_only_where_they_predict_better():
    signal = mampc.prbs(order=8, amplitude=[5.0, 10.0], hold=5, mean=STACK.u_op, samples=640)
    noisy, clean = (mampc.excite(STACK, signal, dt=0.5, noise=noise, seed=1) for noise in (0.2, 0.0))
    assert mampc.n4sid(noisy, feedthrough=False).order in (2, 3)
    found = mampc.n4sid(clean, feedthrough=False)  # without noise what is not linear can be followed, too
    two = mampc.n4sid(clean, feedthrough=False, order=2)
    assert (found.fit >= two.fit).all()
    np.testing.assert_allclose(found.model.dc_gain(), two.model.dc_gain(), rtol=0.15)


def test_every_parameter_states_unit_and_source():
    for field in dataclasses.fields(SolidOxideFuelCell):
        if field.name != "variant":
            assert field.metadata["unit"]
            assert field.metadata["source"]


@pytest.mark.parametrize(
    "wrong",
    [{"variant": "rich"}, {"n_cells": 0}, {"h2_fraction": 1.2}, {"molar_masses": (1.0,)}, {"current": -1}],
)
def test_parameters_out_of_range_are_refused(wrong):
    with pytest.raises(mampc.MampcError, match="expected"):
        SolidOxideFuelCell(**wrong)


def test_a_record_that_moves_the_current_identifies_a_model_that_has_it(tmp_path):
    signal = mampc.prbs(order=7, amplitude=[5.0, 10.0, 10.0], hold=5, mean=[100.0, 100.0, 400.0])
    data = mampc.excite(STACK, signal, dt=0.5, noise=0.1)
    model = mampc.n4sid(data).model
    assert model.names.disturbances == ("current",)
    np.testing.assert_allclose(model.v_op, [400.0], atol=1.0)
    np.testing.assert_allclose(model.dc_gain(), mampc.linearise(STACK).dc_gain(), rtol=0.2)
    data.to_csv(tmp_path / "record.csv")
    again = mampc.IOData.from_csv(
        tmp_path / "record.csv", inputs=["fuel", "air"], disturbances=["current"], outputs=["voltage"]
    )
    np.testing.assert_array_equal(again.u, data.u)
    model.save(tmp_path / "model.json")
    assert mampc.StateSpace.load(tmp_path / "model.json").names == model.names
