"""The modes that responses are sums of, and input fits that use them, against simulation and the filters in a row."""

import numpy as np
import pytest

from mampc.identification.modes import modes
from mampc.identification.scaling import Scaled
from mampc.identification.simulation_error import fit_inputs, residuals
from seeds import seeds


def system(seed, n, l, integrators):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    A[:integrators], A[:, :integrators] = 0.0, 0.0
    A[:integrators, :integrators] = np.eye(integrators)
    return A, rng.standard_normal((l, n))


@pytest.mark.parametrize("integrators", [0, 2])
@pytest.mark.parametrize("seed", seeds(20, quick=3))
def test_signals_and_shares_are_the_response_to_each_state(seed, integrators):
    A, C = system(seed, 5, 3, integrators)
    w = np.random.default_rng(seed).standard_normal((40, 2))
    found = modes(A, C, integrators)
    last, pieces = np.zeros((len(found.poles), 2)), []
    for start in (0, 13):
        piece, last = found.signals(w[start : 13 if start == 0 else 40], last)
        pieces.append(piece)
    made = np.einsum("krp,lrs->klsp", np.concatenate(pieces).reshape(40, 5, 2), found.shares)
    for k in (0, 12, 13, 39):
        true = sum(np.einsum("ls,p->lsp", C @ np.linalg.matrix_power(A, k - j), w[j]) for j in range(k + 1))
        np.testing.assert_allclose(made[k], true, atol=1e-9 * max(np.abs(true).max(), 1.0))


def test_eigenvectors_that_are_too_alike_are_not_used():
    assert modes(0.9 * np.eye(3) + np.eye(3, k=1), np.eye(3), 0) is None


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("degree", [-1, 0, 1])
@pytest.mark.parametrize("integrators", [0, 1])
def test_shared_signals_give_the_fit_of_filters_in_a_row(monkeypatch, degree, integrators, feedthrough):
    A, C = system(1, 4, 3, integrators)
    rng = np.random.default_rng(0)
    u = tuple(np.repeat(rng.standard_normal((N // 5, 2)), 5, axis=0) for N in (200, 300))
    y = tuple(np.cumsum(rng.standard_normal((len(one), 3)), axis=0) / 10 for one in u)
    records = Scaled(u, y, np.zeros(2), (np.zeros(3),) * 2, np.ones(2), np.ones(3))
    options = {"feedthrough": feedthrough, "degree": degree, "integrators": integrators}
    one = fit_inputs(A, C, records, **options)
    monkeypatch.setattr("mampc.identification.simulation_error.modes", lambda *_: None)
    other = fit_inputs(A, C, records, **options)
    np.testing.assert_allclose(one.B, other.B, atol=1e-9)
    np.testing.assert_allclose(one.error, other.error, rtol=1e-9)
    left = np.concatenate(residuals(A, C, one, records))
    np.testing.assert_allclose(np.linalg.norm(left), one.error, rtol=1e-9)
