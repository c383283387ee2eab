"""Random linear systems, and records of them with and without noise."""

from functools import lru_cache

import numpy as np

from mampc import IOData, StateSpace, prbs


def real_form(poles):
    """A matrix with the given poles; a complex one stands for its conjugate too."""
    blocks = [[[p.real, p.imag], [-p.imag, p.real]] if p.imag else [[p.real]] for p in map(complex, poles)]
    size = sum(map(len, blocks))
    A, at = np.zeros((size, size)), 0
    for block in blocks:
        A[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return A


def system_with(poles, seed, m=2, l=2, *, feedthrough=True):
    rng = np.random.default_rng(seed)
    A = real_form(poles)
    n = len(A)
    T = np.eye(n) + 0.3 * rng.standard_normal((n, n))
    B, C = rng.standard_normal((n, m)), rng.standard_normal((l, n))
    D = rng.standard_normal((l, m)) if feedthrough else None
    return StateSpace(T @ A @ np.linalg.inv(T), B, C, D, 1.0, u_op=rng.standard_normal(m))


@lru_cache
def random_system(seed, n, m, l, feedthrough):
    rng = np.random.default_rng([seed, n])
    poles = []
    while n > 0:
        radius, angle = rng.uniform(0.4, 0.95), rng.uniform(0.3, 2.5)
        paired = n > 1 and rng.random() < 0.5
        poles.append(radius * np.exp(1j * angle) if paired else radius * rng.choice([1, 1, -1]))
        n -= 2 if paired else 1
    return system_with(poles, seed, m, l, feedthrough=feedthrough)


def markov(model, count=20):
    """D, CB, CAB, ...: the same in all state coordinates."""
    parameters, column = [model.D], model.B
    for _ in range(count):
        parameters.append(model.C @ column)
        column = model.A @ column
    return np.array(parameters)


def noise_free(system, seed, *, samples=600, at_rest_on_average=True):
    """A record with a transient from a random initial state.

    The means of a record are an operating point only where its transient sums to none; this is arranged
    here by correcting the initial state, unless `at_rest_on_average` is False.
    """
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, system.n_inputs))
    u += system.u_op - u.mean(axis=0)
    x0 = 3 * rng.standard_normal(system.n_states)
    if at_rest_on_average:
        free = sum(system.C @ np.linalg.matrix_power(system.A, k) for k in range(samples))
        x0 -= np.linalg.pinv(free) @ (system.response(u, x0) - system.y_op).sum(axis=0)
    return IOData(u, system.response(u, x0), system.dt)


def noisy_record(system, seed, *, samples=1500):
    """An estimation record at 20 dB signal to noise and a noise-free one to hold out."""
    rng = np.random.default_rng(seed)
    n, m = system.n_states, system.n_inputs
    u = prbs(order=9, hold=3, inputs=m, samples=samples, seed=seed)
    y = system.response(u, 3 * rng.standard_normal(n))
    y += 0.1 * y.std(axis=0) * rng.standard_normal(y.shape)
    unseen = prbs(order=10, hold=3, inputs=m, samples=samples, seed=seed)
    held_out = IOData(unseen, system.response(unseen, 3 * rng.standard_normal(n)), system.dt)
    return IOData(u, y, system.dt), held_out
