"""Linear models: what they accept, and agreement with python-control and scipy.signal."""

from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.signal

from builders import random_model
from mampc import MampcError, Names, StateSpace

A, B, C, D = np.diag([0.5, 0.8]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))
CONTINUOUS = [[-1.0, 0.5], [0.0, -3.0]], [[1.0], [2.0]], [[1.0, 0.0]], [[0.0]]
SEEDS = range(8)


def random_continuous(seed, n=4, m=2, l=2):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A -= (np.max(np.linalg.eigvals(A).real) + 0.2) * np.eye(n)
    D = rng.standard_normal((l, m)) * (seed % 2)
    return StateSpace(A, rng.standard_normal((n, m)), rng.standard_normal((l, n)), D, 0.0)


def in_control(model):
    return control.ss(model.A, model.B, model.C, model.D, model.dt)


def assert_same_set(received, expected):
    assert received.shape == expected.shape
    distance = np.abs(received[:, None] - expected[None, :]) / np.maximum(1, np.abs(expected))
    np.testing.assert_allclose(distance.min(axis=0), 0, atol=1e-7)
    np.testing.assert_allclose(distance.min(axis=1), 0, atol=1e-7)


@pytest.mark.parametrize(
    ("changes", "expected", "received"),
    [
        ({"A": np.ones((2, 3))}, r"A.*\(2, 2\)", r"\(2, 3\)"),
        ({"A": np.ones(2)}, r"A.*\(any, any\)", r"\(2,\)"),
        ({"A": np.full((2, 2), np.nan)}, "A.*finite", "nan"),
        ({"A": [[1, 2], [3]]}, "A.*real numbers", r"\[\[1, 2\], \[3\]\]"),
        ({"A": [["a", "b"], ["c", "d"]]}, "A.*real numbers", "'a'"),
        ({"A": A * 1j}, "A.*real numbers", "j"),
        ({"B": np.ones((3, 1))}, r"B.*\(2, any\)", r"\(3, 1\)"),
        ({"B": np.ones((2, 0)), "D": None}, "at least one input", "0"),
        ({"B": [[np.inf], [1.0]]}, "B.*finite", "inf"),
        ({"C": np.ones((1, 3))}, r"C.*\(any, 2\)", r"\(1, 3\)"),
        ({"C": np.ones((0, 2)), "D": None}, "at least one input and output", "0"),
        ({"D": np.ones((2, 1))}, r"D.*\(1, 1\)", r"\(2, 1\)"),
        ({"D": [[np.nan]]}, "D.*finite", "nan"),
        ({"dt": -1.0}, "dt.*of at least 0", "-1"),
        ({"dt": np.nan}, "dt.*finite", "nan"),
        ({"dt": "fast"}, "dt.*finite number", "fast"),
        ({"dt": True}, "dt.*finite number", "True"),
        ({"u_op": [1.0, 2.0]}, "u_op.*1 values", r"\(2,\)"),
        ({"y_op": [np.nan]}, "y_op.*finite", "nan"),
        ({"names": Names(("a", "b"), ("y",))}, "names.inputs.*1 names", "2"),
        ({"names": Names(("a",), ("y", "z"))}, "names.outputs.*1 names", "2"),
        ({"names": Names(("a",), ("y",), ("x",))}, "names.states.*2 names", "1"),
    ],
)
def test_what_does_not_fit_is_refused_with_what_was_expected_and_received(changes, expected, received):
    with pytest.raises(MampcError, match=f"{expected}.*received.*{received}"):
        StateSpace(**({"A": A, "B": B, "C": C, "D": D, "dt": 1.0} | changes))


@pytest.mark.parametrize("names", [("a", "a"), ("", "b"), (1, 2)])
def test_names_are_distinct_words(names):
    with pytest.raises(MampcError, match=r"names\.inputs: expected .* received"):
        Names(names, ("y",))


def test_a_model_does_not_share_memory_and_cannot_be_changed():
    own = A.copy()
    model = StateSpace(own, B, C, None, 1.0)
    own[0, 0] = 99.0
    assert model.A[0, 0] == 0.5
    assert np.array_equal(model.D, D)
    with pytest.raises(ValueError, match="read-only"):
        model.A[0, 0] = 1.0


def test_integers_become_floats():
    model = StateSpace([[0]], [[1]], [[2]], None, 1, u_op=3, y_op=[4])
    assert {a.dtype for a in (model.A, model.B, model.C, model.D, model.u_op, model.y_op)} == {
        np.dtype(float)
    }
    assert model.u_op.shape == model.y_op.shape == (1,)


@pytest.mark.parametrize("kind", [control.ss, lambda *matrices: control.ss2tf(control.ss(*matrices))])
@pytest.mark.parametrize(
    ("own", "asked", "received"),
    [(0, None, 0.0), (None, 0.5, 0.5), (True, 0.5, 0.5), (0.5, None, 0.5), (0.5, 0.5, 0.5)],
)
def test_python_control_systems_keep_their_response(kind, own, asked, received):
    system = kind(*CONTINUOUS, own)
    model = StateSpace.from_any(system, dt=asked)
    assert model.dt == received
    points = [0.3j, 1.0 + 0.2j]
    for point in points:
        response = model.C @ np.linalg.solve(point * np.eye(2) - model.A, model.B) + model.D
        np.testing.assert_allclose(response.squeeze(), system(point), rtol=1e-9)


@pytest.mark.parametrize("own", [None, True])
def test_an_unstated_sample_time_must_be_given(own):
    with pytest.raises(MampcError, match="expected a sample time, received a system that states none"):
        StateSpace.from_any(control.ss(*CONTINUOUS, own))


def test_a_continuous_system_is_sampled_when_a_sample_time_is_asked_for():
    model = StateSpace.from_any(control.ss(*CONTINUOUS), dt=0.2)
    expected = control.c2d(control.ss(*CONTINUOUS), 0.2)
    np.testing.assert_allclose(model.A, expected.A, rtol=1e-12)
    np.testing.assert_allclose(model.B, expected.B, rtol=1e-12)


@pytest.mark.parametrize(
    "system",
    [
        control.ss(A, B, C, D, 0.5),
        scipy.signal.dlti(A, B, C, D, dt=0.5),
        (A, B, C, D, 0.5),
        StateSpace(A, B, C, D, 0.5),
    ],
)
def test_a_stated_sample_time_must_agree(system):
    assert StateSpace.from_any(system, dt=0.5).dt == 0.5
    with pytest.raises(MampcError, match=r"expected a sample time of 0\.4 s, received a system with 0\.5 s"):
        StateSpace.from_any(system, dt=0.4)


@pytest.mark.filterwarnings("ignore::scipy.signal.BadCoefficients")
@pytest.mark.parametrize("form", ["to_ss", "to_tf", "to_zpk"])
@pytest.mark.parametrize(
    ("system", "asked", "received"),
    [
        (scipy.signal.lti(*CONTINUOUS), None, 0.0),
        (scipy.signal.dlti(A, B, C, D, dt=0.5), None, 0.5),
        (scipy.signal.dlti(A, B, C, D), 0.3, 0.3),
    ],
    ids=["continuous", "discrete", "discrete of unstated step"],
)
def test_scipy_systems_keep_their_response(form, system, asked, received):
    model = StateSpace.from_any(getattr(system, form)(), dt=asked)
    assert model.dt == received
    point = 0.4 + 0.7j
    response = model.C @ np.linalg.solve(point * np.eye(2) - model.A, model.B) + model.D
    transfer = system.to_tf()
    np.testing.assert_allclose(
        response[0, 0], np.polyval(transfer.num, point) / np.polyval(transfer.den, point), rtol=1e-9
    )


def test_a_discrete_scipy_system_of_unstated_step_needs_one():
    with pytest.raises(MampcError, match="expected a sample time"):
        StateSpace.from_any(scipy.signal.dlti(A, B, C, D))


@pytest.mark.parametrize(
    ("fifth", "dt"), [((), 0.0), ((None,), 0.0), ((0,), 0.0), ((0.5,), 0.5), ((np.float64(2),), 2.0)]
)
def test_tuples_state_the_sample_time_in_fifth_place(fifth, dt):
    model = StateSpace.from_any((A, B, C, D, *fifth))
    assert model.dt == dt
    assert np.array_equal(model.A, A)
    assert np.array_equal(StateSpace.from_any([A, B, C, None, *fifth]).D, D)


@pytest.mark.parametrize(
    "system",
    [
        3.0,
        None,
        "plant",
        (A, B, C),
        (A, B, C, D, "fast"),
        (A, B, C, D, -1.0),
        control.tf([1, 2, 3], [1, 2]),
        scipy.signal.TransferFunction([1, 2, 3], [1, 2]),
        control.frd([1.0, 2.0], [1.0, 2.0]),
    ],
    ids=repr,
)
def test_what_is_no_state_space_system_is_refused(system):
    with pytest.raises(MampcError, match=r"expected .* received"):
        StateSpace.from_any(system, dt=1.0)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dt", [0.01, 1.0])
def test_zero_order_hold_is_that_of_scipy(seed, dt):
    model = random_continuous(seed)
    sampled = model.discretise(dt)
    expected = scipy.signal.cont2discrete((model.A, model.B, model.C, model.D), dt, method="zoh")
    for name, matrix in zip("ABCD", expected, strict=False):
        np.testing.assert_allclose(getattr(sampled, name), matrix, rtol=1e-9, atol=1e-12)
    assert sampled.dt == dt


def test_sampling_in_two_half_steps_is_sampling_in_one():
    model, half = random_continuous(1).discretise(1.0), random_continuous(1).discretise(0.5)
    np.testing.assert_allclose(half.A @ half.A, model.A, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(half.A @ half.B + half.B, model.B, rtol=1e-10, atol=1e-12)


def test_sampling_keeps_operating_point_and_names():
    names = Names(("valve",), ("level",), ("a", "b"))
    sampled = StateSpace(*CONTINUOUS, 0.0, u_op=3.0, y_op=4.0, names=names).discretise(0.1)
    assert (sampled.u_op, sampled.y_op, sampled.names) == (3.0, 4.0, names)


@pytest.mark.parametrize("dt", [0.0, -1.0, np.inf, "1"])
def test_sampling_needs_a_positive_step(dt):
    with pytest.raises(MampcError, match="dt: expected a finite number above 0, received"):
        random_continuous(0).discretise(dt)


def test_a_discrete_model_is_not_sampled_again():
    with pytest.raises(MampcError, match="expected a continuous model"):
        StateSpace(A, B, C, D, 1.0).discretise(0.5)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("build", [random_continuous, random_model])
def test_poles_zeros_and_gain_are_those_of_python_control(build, seed):
    model = build(seed)
    reference = in_control(model)
    assert_same_set(model.poles(), reference.poles())
    assert_same_set(model.zeros(), reference.zeros())
    np.testing.assert_allclose(model.dc_gain(), reference.dcgain(), rtol=1e-9)
    assert model.is_stable()


@pytest.mark.parametrize("denominator", [[1, 3, 2], [1, 6, 11, 6], [1, 6, 11, 6, 1, 2]])
def test_transfer_functions_have_the_zeros_of_their_numerator(denominator):
    assert_same_set(StateSpace.from_any(control.tf([1, -2], denominator)).zeros(), np.array([2.0]))
    assert len(StateSpace.from_any(control.tf([1], denominator)).zeros()) == 0


def test_zeros_need_as_many_inputs_as_outputs():
    with pytest.raises(MampcError, match="received 2 and 3"):
        random_model(0, m=2, l=3).zeros()


@pytest.mark.parametrize(("pole", "dt", "stable"), [(1.0, 1.0, False), (-0.99, 1.0, True), (0.5, 0.0, False)])
def test_stability_means_the_unit_disc_or_the_left_half_plane(pole, dt, stable):
    assert StateSpace([[pole]], [[1]], [[1]], None, dt).is_stable() is stable


@pytest.mark.parametrize(
    ("A", "dt"), [(np.diag([1.0, 0.5]), 1.0), (np.diag([0.0, -1.0]), 0.0), ([[1, 1], [0, 1]], 1.0)]
)
def test_an_integrator_has_no_gain(A, dt):
    rotation = np.array([[0.6, 0.8], [-0.8, 0.6]])
    model = StateSpace(rotation @ A @ rotation.T, B, C, D, dt)
    with pytest.raises(MampcError, match="expected a model without integrators"):
        model.dc_gain()


def test_a_model_without_states_is_its_feedthrough():
    model = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]], 1.0)
    assert model.dc_gain() == 2.0
    assert len(model.poles()) == len(model.zeros()) == 0
    assert np.array_equal(model.response([[1.0], [3.0]]), [[2.0], [6.0]])


@pytest.mark.parametrize("seed", SEEDS)
def test_the_response_is_that_of_scipy_about_the_operating_point(seed):
    model = random_model(seed, n=4, feedthrough=True)
    rng = np.random.default_rng(seed)
    u, x0 = rng.standard_normal((60, 2)), rng.standard_normal(4)
    _, expected, _ = scipy.signal.dlsim((model.A, model.B, model.C, model.D, 1.0), u - model.u_op, x0=x0)
    np.testing.assert_allclose(model.response(u, x0), expected + model.y_op, rtol=1e-10, atol=1e-12)


def test_at_the_operating_inputs_a_model_rests_at_the_operating_outputs():
    model = random_model(3)
    assert np.array_equal(model.steady_state(model.u_op), np.zeros(3))
    np.testing.assert_array_equal(
        model.response(np.tile(model.u_op, (5, 1))), np.broadcast_to(model.y_op, (5, 2))
    )


def test_from_its_steady_state_a_model_stays_at_its_gain():
    model = random_model(4)
    change = np.array([1.0, -2.0])
    u = model.u_op + change
    y = model.response(np.tile(u, (20, 1)), model.steady_state(u))
    expected = model.y_op + model.dc_gain() @ change
    np.testing.assert_allclose(y, np.broadcast_to(expected, y.shape), rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_step_response_is_that_of_a_simulation(seed):
    model = random_model(seed, m=3, l=2)
    model = replace(model, names=Names(("u1", "u2"), ("y1", "y2"), (), ("load",)), u_op=None, v_op=3.0)
    response = model.step_response(30)
    assert response.shape == (30, 2, 3)
    for j in range(3):
        stepped = model.response(np.tile(model.all_inputs_op + np.eye(3)[j], (30, 1)))
        np.testing.assert_allclose(response[:, :, j], stepped - model.y_op, rtol=1e-10, atol=1e-12)


def test_the_step_response_is_that_of_scipy_and_ends_at_the_gain():
    model = random_model(5, m=2, l=2)
    _, outputs = scipy.signal.dstep((model.A, model.B, model.C, model.D, model.dt), n=400)
    response = model.step_response(400)
    np.testing.assert_allclose(response, np.moveaxis(outputs, 0, 2), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(response[-1], model.dc_gain(), rtol=1e-6, atol=1e-9)


def test_the_step_response_of_an_integrator_keeps_its_feedthrough():
    np.testing.assert_array_equal(
        StateSpace([[1.0]], [[2.0]], [[1.0]], [[5.0]], 1.0).step_response(4).ravel(), [5.0, 7.0, 9.0, 11.0]
    )


def test_the_step_response_starts_at_once_and_needs_a_sampled_model():
    model = random_model(0)
    np.testing.assert_array_equal(model.step_response(1)[0], model.D)
    with pytest.raises(MampcError, match="n: expected a whole number of at least 1"):
        model.step_response(0)
    with pytest.raises(MampcError, match="discretise it first"):
        StateSpace([[-1.0]], [[1.0]], [[1.0]], None, 0.0).step_response(3)


def test_the_response_of_a_continuous_model_is_refused():
    with pytest.raises(MampcError, match="expected a discrete model, received dt = 0"):
        random_continuous(0).response(np.zeros((3, 2)))


@pytest.mark.parametrize("u", [np.zeros((5, 3)), np.zeros(5), np.full((5, 2), np.nan)])
def test_inputs_of_another_width_or_not_finite_are_refused(u):
    with pytest.raises(MampcError, match=r"u: expected .* received"):
        random_model(0).response(u)
