"""Linear models of nonlinear plants are those of derivatives by hand, in any unit."""

import numpy as np
import pytest

from mampc import linearise


class Pendulum:
    """A damped pendulum driven by a torque; at rest it hangs where gravity balances the torque."""

    def derivative(self, x, u):
        return np.array([x[1], u[0] - np.sin(x[0]) - 0.1 * x[1]])

    def output(self, x, u):
        return np.array([x[0] ** 2 + 3 * u[0]])

    def steady_state(self, u=None):
        return np.array([np.arcsin(u[0]), 0.0])


def test_linearisation_matches_derivatives_by_hand():
    angle = 0.5
    model = linearise(Pendulum(), [np.sin(angle)])
    np.testing.assert_allclose(model.A, [[0, 1], [-np.cos(angle), -0.1]], atol=1e-9)
    np.testing.assert_allclose(model.B, [[0], [1]], atol=1e-9)
    np.testing.assert_allclose(model.C, [[2 * angle, 0]], atol=1e-9)
    np.testing.assert_allclose(model.D, [[3]], atol=1e-9)
    np.testing.assert_allclose([model.u_op[0], model.y_op[0]], [np.sin(angle), 0.25 + 3 * np.sin(angle)])
    assert not model.is_discrete


class Neutralisation:
    """A stirred tank in which acid and base meet: its state is a surplus of charge in mol/l, its output the pH."""

    def __init__(self, unit=1.0):
        self.unit = unit

    def derivative(self, x, u):
        return self.unit * (1.2e-6 - 1e-4 * u) - 1e-3 * x

    def output(self, x, u):
        half = x / self.unit / 2
        acid = np.hypot(half, 1e-7)
        return -np.log10(acid + half) if half[0] >= 0 else np.log10(acid - half) + 14.0

    def steady_state(self, u=None):
        return self.unit * (1.2e-3 - 0.1 * np.asarray(u))


@pytest.mark.parametrize("u", [0.011, 0.012, 0.012 - 1e-7, 0.013])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e6])
def test_linearisation_does_not_depend_on_units(u, unit):
    model = linearise(Neutralisation(unit), [u])
    surplus = 1.2e-3 - 0.1 * u
    slope = -1 / (2 * np.log(10) * np.hypot(surplus / 2, 1e-7))
    np.testing.assert_allclose(model.C, [[slope / unit]], rtol=1e-8)
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], [-1e-3, -1e-4 * unit], rtol=1e-9)


def test_linearisation_takes_no_step_out_of_a_function_s_range():
    class Narrow(Pendulum):
        def output(self, x, u):
            if abs(x[0]) > 1e-3:
                raise ValueError("broken")
            return np.array([np.sin(x[0])])

    np.testing.assert_allclose(linearise(Narrow(), [0.0]).C, [[1.0, 0.0]], rtol=1e-8)
