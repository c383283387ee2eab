"""The modes of a system: first-order filters whose signals all its responses are sums of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array

WORST = 1e6  # condition of the eigenvectors, up to which modes stand for the system


class Modes(NamedTuple):
    """Real parts of the powers of all poles, then imaginary parts of those of complex ones, are n signals.

    Attributes:
        poles: real ones, and one of each complex pair.
        shares: of each signal in each output after an impulse on each state, C A^k e_s, shape (l, n, n).
    """

    poles: Array
    shares: Array

    def signals(self, w: Array, last: Array) -> tuple[Array, Array]:
        """What the modes make of w, shape (N, p).

        Args:
            last: where they were a sample ago, shape (poles, p).

        Returns:
            the n signals of each of w, signal by signal, shape (N, n p), and where the modes are now.
        """
        from scipy.signal import lfilter

        z = np.empty((len(self.poles), *w.shape), dtype=complex)
        for k, pole in enumerate(self.poles):
            own = pole if pole.imag else pole.real  # real filters take a third of the time
            start = own * (last[k] if pole.imag else last[k].real)
            z[k], _ = lfilter([1.0], [1.0, -own], w, axis=0, zi=start[None])
        both = np.concatenate([z.real, z.imag[self.poles.imag > 0]])
        return both.transpose(1, 0, 2).reshape(len(w), -1), z[:, -1].copy()


def modes(A: Array, C: Array, integrators: int) -> Modes | None:
    """The modes of A and C, of which the first states only integrate; None where eigenvectors are too alike."""
    q, n = integrators, len(A)
    poles, vectors = np.ones(n, dtype=complex), np.eye(n, dtype=complex)
    poles[q:], vectors[q:, q:] = np.linalg.eig(A[q:, q:])
    if np.linalg.cond(vectors) > WORST:
        return None
    each = np.einsum("lr,rs->lrs", C @ vectors, np.linalg.inv(vectors))
    kept, swinging = poles.imag >= 0, poles.imag > 0
    real = np.where(swinging, 2.0, 1.0)[kept, None] * each[:, kept].real
    return Modes(poles[kept], np.concatenate([real, -2 * each[:, swinging].imag], axis=1))
