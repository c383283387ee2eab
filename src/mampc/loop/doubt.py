"""What casts doubt on a model: the inputs' moves of the last samples, by what they did to the outputs."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.systems.pairs import NEGLIGIBLE
from mampc.systems.state_space import StateSpace

LATE = 3.0  # samples after a dead time within which moves make a model doubtful, of those that count less and less
FADED = 0.001  # share of what moves count for at first below which they are forgotten
LONG = 512  # samples after which what runs away has done so, where lags are short
SETTLED = 8.0  # time constants of the slowest lag after which many in a row have settled
INTEGRATES = 3e-4  # distance from one of a pole that may belong to integrators in a row, up to rounding


@np.errstate(over="ignore", invalid="ignore")
def moves_of_late(model: StateSpace) -> Array:
    """From `BankEstimate.late` and the inputs u (m,) applied since to the next one, both of l + N m + m numbers.

    A move du of a samples ago has done S_a du to an output, and counts in h for exp(-(a - d) / LATE) of that once the
    dead time d of this input and output is over: what comes later than expected shows no sooner.
    Integrators in a row, which nothing else holds, go far while plans wait: their moves cast no doubt.
    """
    m, l = model.n_inputs, model.n_outputs
    faded = int(np.ceil(-LATE * np.log(FADED)))
    done, dead = model.step_response(model.n_states + faded + 2)[1:, :, :m], dead_times(model)
    if runs_away(model) and np.abs(model.poles()).max() <= 1 + INTEGRATES:
        done[:] = dead[:] = 0
    count = int(dead.max(initial=0)) + faded
    since = np.arange(1, count + 1)[:, None, None] - dead
    counts = np.where((since > 0) & (since <= faded), np.exp(-since / LATE) * done[:count], 0.0)
    # Rows of the next one: h, N moves with the latest first, and u; columns of the last one, and u.
    _, moves, before, u = np.split(np.eye(l + (count + 2) * m), np.cumsum([l, count * m, m]))
    moves = np.vstack([u - before, moves[: (count - 1) * m]])
    return np.vstack([counts.transpose(1, 0, 2).reshape(l, -1) @ moves, moves, u])


@np.errstate(over="ignore", invalid="ignore")
def dead_times(model: StateSpace) -> Array:
    """Samples after which each output begins to answer each input, less one, shape (l, m); 0 where it never does."""
    n = model.n_states
    done = np.abs(model.step_response(n + 2)[1:, :, : model.n_inputs])
    answers = done > NEGLIGIBLE * done.max(axis=0)
    dead: Array = answers.argmax(axis=0)  # what does nothing for n samples never does, but for rounding
    return dead


def remembers(model: StateSpace) -> bool:
    """Whether outputs do not come back after a pulse at some input: modes that integrate or grow.

    What an estimate of these missed does not fade by itself.
    """
    return _lasts(model, 0.5)


def runs_away(model: StateSpace) -> bool:
    """Whether outputs go ever faster after a pulse at some input: modes that grow, or integrators in a row."""
    return _lasts(model, 1.5)


@np.errstate(over="ignore", invalid="ignore")
def _lasts(model: StateSpace, share: float) -> bool:
    """Whether twice as long after a pulse at an input an output is more than a share of where it was before.

    That is 1 for an integrator, 2 for two in a row, and next to nothing for lags.
    """
    pulse = model.B[:, : model.n_inputs]
    pulses = np.diff(model.step_response(model.n_states + 2)[:, :, : model.n_inputs], axis=0)
    early = np.abs(pulses).max(axis=0)
    # Of an input and an output in any units: what an input does not move at all is nothing but rounding.
    rows = early.max(axis=1, keepdims=True)
    size = rows * (early / np.where(rows > 0, rows, 1.0)).max(axis=0)
    sizes = np.abs(model.poles())
    slowest = sizes[sizes < 1 - INTEGRATES].max(initial=0.0)
    power = np.linalg.matrix_power(model.A, max(LONG, int(SETTLED / (1 - slowest))))
    once, twice = np.abs(model.C @ power @ pulse), np.abs(model.C @ power @ power @ pulse)
    # What is left of other modes may be rounding.
    slower = (twice <= share * np.maximum(once, 1e-6 * size)) & np.isfinite(twice)
    return not slower.all()
