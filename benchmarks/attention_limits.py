"""Two limits of the attention benchmark: how few moves would do for who knows what no controller knows.

Clairvoyant: knows the whole record, loads and references included, and chooses all moves at once. Non-anticipative:
knows at each sample state, plant and load exactly as they are, and what the load will be on average; chooses all later
moves and makes the first. References change as unexpectedly for it as for the controllers. How far it plans is the
better one of two: long plans suit loads that stay, short ones loads that wander.

Both have a price a move and search locally: single moves are added, dropped and shifted until nothing gets better, and
an input whose plan would leave its limits is held in that plan. So the true limits may be lower still. Nonlinear
plants are predicted by their linear model and what it missed, which the clairvoyant repeats about each plan.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import mampc
from mampc.compare.fronts import Point
from mampc.loop.motion import motions_of
from mampc.loop.simulation import Course, acting_on
from mampc.systems.state_space import StateSpace

HORIZONS = (10, 60)  # samples that the non-anticipative plans moves in; errors count for a third more
ROUNDS = 2  # of the clairvoyant about its plan, on a nonlinear plant
LIGHT = 0.1  # weight of moves, times plain MPC's
PRICES = np.geomspace(10.0, 1e-3, 17)  # over the error of plain MPC in the whole record
ENOUGH = 1.1  # times the error of plain MPC: below it no lower price is tried
SCENARIOS = range(4)  # seeds


class Search:
    """Minimises |target - G d|^2 + d' R d + price times the non-zeros of d, by single exchanges."""

    def __init__(self, G: np.ndarray, R: np.ndarray) -> None:
        self._G, self._B = G, G.T @ G + np.diag(R)
        self._held = np.zeros(len(R), dtype=bool)

    def within(
        self, target: np.ndarray, price: float, support: list[int], u: np.ndarray, limits: Any
    ) -> tuple[np.ndarray, list[int]]:
        """`moves` that keep inputs, now u (m,), within limits; one that would not stay within them is held."""
        self._held = np.zeros(len(self._B), dtype=bool)
        for _ in range(len(u) + 1):
            d, support = self.moves(target, price, [j for j in support if not self._held[j]])
            levels = u + d.reshape(-1, len(u)).cumsum(axis=0)
            beyond = ((levels > np.add(limits.u_max, 1e-9)) | (levels < np.subtract(limits.u_min, 1e-9))).any(
                axis=0
            )
            if not beyond.any():
                break
            self._held |= np.tile(beyond, len(d) // len(u))
        return d, support

    def moves(self, target: np.ndarray, price: float, support: list[int]) -> tuple[np.ndarray, list[int]]:
        """d, and where it is not zero; `support` is where to start."""
        c, chosen = self._G.T @ target, list(support)
        for _ in range(1000):
            values, worth, loss = self._state(c, chosen)
            add = int(worth.argmax())
            drop = int(loss.argmin()) if chosen else 0
            gains = [worth[add] - price, price - loss[drop] if chosen else -np.inf]
            if max(gains) > 1e-9 * price:
                if gains[0] >= gains[1]:
                    chosen.append(add)
                else:
                    chosen.pop(drop)
                continue
            shifted = self._shifted(c, chosen, loss, price)
            if shifted is None:
                break
            chosen = shifted
        d = np.zeros(len(c))
        d[chosen] = values
        return d, chosen

    def _state(self, c: np.ndarray, chosen: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The best values, what each further move would gain, and what each chosen one is worth."""
        B = self._B
        inverse = np.linalg.inv(B[np.ix_(chosen, chosen)])
        values = inverse @ c[chosen]
        across = B[:, chosen]
        left = np.maximum(np.diag(B) - np.einsum("ij,ij->i", across @ inverse, across), 1e-9 * np.diag(B))
        worth = (c - across @ values) ** 2 / left
        worth[chosen] = -np.inf
        worth[self._held] = -np.inf
        return values, worth, values**2 / np.diag(inverse)

    def _shifted(self, c: np.ndarray, chosen: list[int], loss: np.ndarray, price: float) -> list[int] | None:
        """One move elsewhere, where that is better."""
        for i in np.argsort(loss).tolist():
            others = chosen[:i] + chosen[i + 1 :]
            _, worth, _ = self._state(c, others)
            if worth.max() - loss[i] > 1e-6 * price:
                return [*others, int(worth.argmax())]
        return None


class Loops:
    """The scenarios of one case: courses, the plant's motion, and its linear model."""

    def __init__(self, case: Any, loads: tuple, reference: np.ndarray, seeds: range) -> None:
        problem = mampc.TrackingProblem(
            case.model, prediction_horizon=1, control_horizon=1, limits=case.limits
        )
        self.case, self.limits = case, case.limits
        acting = acting_on(
            case.plant, mampc.Regulator(mampc.MPC(problem)), reference, steps=None, noise=case.noise,
            input_disturbance=None, output_disturbance=None, measured_disturbance=None, loads=loads, valves=None,
            u_initial=None,
        )  # fmt: skip
        self.courses: list[Course] = [acting.drawn(seed) for seed in seeds]
        first = self.courses[0]
        both = np.concatenate([first.u_initial, first.v[0]])
        self.rest = np.asarray(case.plant.steady_state(both))
        self.T, self.u, self.v = len(first), first.u_initial, first.v[0]
        self.reference = first.reference[: self.T]
        self.load = np.array([course.at_inputs for course in self.courses])  # (S, T, m)
        x, applied = np.tile(self.rest, (len(seeds), 1)), np.tile(both, (len(seeds), 1))
        self.motion = motions_of([case.plant] * len(seeds), case.model.dt, x, applied)
        self.is_linear = isinstance(case.plant, StateSpace)
        if self.is_linear:
            self.model = case.plant
        else:  # a leak has no steady state of its own
            leaks = isinstance(case.plant, mampc.plants.QuadrupleTank)
            plant = mampc.plants.QuadrupleTank() if leaks else case.plant
            self.model = mampc.linearise(plant).discretise(case.model.dt)
        self.y_rest = self.motion.output(x, applied)[0]

    def applied(self, u: np.ndarray, k: int) -> np.ndarray:
        return np.concatenate([u + self.load[:, k], np.tile(self.v, (len(u), 1))], axis=1)

    def outputs(self, u: np.ndarray) -> np.ndarray:
        """Under inputs (S, T, m), shape (S, T, l)."""
        x, y = np.tile(self.rest, (len(u), 1)), []
        for k in range(self.T):
            y.append(self.motion.output(x, self.applied(u[:, k - 1] if k else u[:, 0] * 0 + self.u, k)))
            x = self.motion.move(x, self.applied(u[:, k], k))
        return np.array(y).swapaxes(0, 1)

    def point(self, name: str, price: float, u: np.ndarray, y: np.ndarray) -> Point:
        moves = np.count_nonzero(np.abs(np.diff(u, axis=1)) > 1e-9, axis=(1, 2))
        error = np.mean(((y - self.reference) / self.case.noise) ** 2, axis=(1, 2))
        return Point(name, price, moves.astype(float), error)

    def effect(self, rows: int, columns: int) -> np.ndarray:
        """Of moves at samples 0 .. columns - 1 on outputs at 0 .. rows - 1, in units of noise."""
        m, noise = self.model.n_inputs, self.case.noise
        S = self.model.step_response(rows)[:, :, :m] / noise[:, None]
        G = np.zeros((rows, S.shape[1], columns, m))
        for j in range(columns):
            G[j:, :, j] = S[: rows - j]
        return G.reshape(rows * S.shape[1], columns * m)


def limit(
    name: str, case: Any, kind: str, loads: tuple, reference: np.ndarray, weight: np.ndarray, baseline: Point
) -> list[Point]:
    """Moves and errors of a limit over the price, in the `SCENARIOS` of the baseline."""
    loops = Loops(case, loads, reference, SCENARIOS)
    prices = PRICES * baseline.error.mean() * loops.reference.size
    enough = ENOUGH * float(baseline.error.mean())
    if name == "clairvoyant":
        return clairvoyant(loops, weight, prices, enough)
    return [
        point for ahead in HORIZONS for point in non_anticipative(loops, kind, weight, prices, enough, ahead)
    ]


def clairvoyant(loops: Loops, weight: np.ndarray, prices: np.ndarray, enough: float) -> list[Point]:
    """All moves of a record at once."""
    T, m, S = loops.T, loops.model.n_inputs, len(loops.courses)
    G = loops.effect(T, T)
    search = Search(G, np.tile(LIGHT * weight, T))
    supports: list[list[int]] = [[] for _ in range(S)]
    d, u, points = np.zeros((S, T * m)), np.tile(loops.u, (S, T, 1)), []
    y = loops.outputs(u)
    for price in prices:
        for _ in range(1 if loops.is_linear else ROUNDS):
            missing = ((loops.reference - y) / loops.case.noise).reshape(S, -1)
            for s in range(S):
                whole = missing[s] + G @ d[s]
                d[s], supports[s] = search.within(whole, price, supports[s], loops.u, loops.limits)
            planned = loops.u + d.reshape(S, T, m).cumsum(axis=1)
            u = np.clip(planned, loops.limits.u_min, loops.limits.u_max)
            y = loops.outputs(u)
        points.append(loops.point("clairvoyant", price, u, y))
        if points[-1].error.mean() < enough:
            break
    return points


def non_anticipative(
    loops: Loops, kind: str, weight: np.ndarray, prices: np.ndarray, enough: float, ahead: int
) -> list[Point]:
    """Sample by sample, with everything known that has happened."""
    model, T, S = loops.model, loops.T, len(loops.courses)
    m, l, rows = model.n_inputs, model.n_outputs, ahead + ahead // 3
    search = Search(loops.effect(rows, ahead), np.tile(LIGHT * weight, ahead))
    B, D = model.B[:, :m], model.D[:, :m]
    powers = [np.eye(model.n_states)]
    for _ in range(rows):
        powers.append(model.A @ powers[-1])
    seen = np.array([model.C @ power for power in powers[:rows]])  # of the state now, by sample
    pulse = np.array([D, *(model.C @ power @ B for power in powers[: rows - 1])])  # of an input at 0
    held = pulse.cumsum(axis=0)
    states = np.concatenate([np.zeros((1, l, model.n_states)), seen[:-1]]).cumsum(axis=0)
    points = []
    for price in prices:
        x, u = np.tile(loops.rest, (S, 1)), np.tile(loops.u, (S, 1))
        missed = np.zeros((S, model.n_states))
        supports: list[list[int]] = [[] for _ in range(S)]
        decided = np.empty((S, T, m))
        for k in range(T):
            coming = forecast(loops.load, k, rows, kind)  # (S, rows, m)
            free = (x - loops.rest) @ seen.swapaxes(1, 2)  # (rows, S, l)
            free = free.swapaxes(0, 1) + np.einsum("rlm,sm->srl", held, u - loops.u)
            free += np.einsum("rln,sn->srl", states, missed)
            for i in range(rows):
                free[:, i:] += np.einsum("rlm,sm->srl", pulse[: rows - i], coming[:, i])
            target = ((loops.reference[k] - loops.y_rest - free) / loops.case.noise).reshape(S, -1)
            for s in range(S):
                earlier = [j - m for j in supports[s] if j >= m]
                d, supports[s] = search.within(target[s], price, earlier, u[s], loops.limits)
                u[s] = np.clip(u[s] + d[:m], loops.limits.u_min, loops.limits.u_max)
            decided[:, k] = u
            after = loops.motion.move(x, loops.applied(u, k))
            expected = (x - loops.rest) @ model.A.T + (u + loops.load[:, k] - loops.u) @ B.T
            missed, x = after - loops.rest - expected, after
        points.append(loops.point("non-anticipative", price, decided, loops.outputs(decided)))
        if points[-1].error.mean() < enough:
            break
    return points


def forecast(load: np.ndarray, k: int, rows: int, kind: str) -> np.ndarray:
    """The load on average, shape (S, rows, m): a sinusoid goes on, a coloured one dies away, all others stay."""
    now = load[:, k]
    if kind == "sinusoidal":
        places = np.minimum(np.arange(k, k + rows), load.shape[1] - 1)
        return load[:, places]
    keeps = np.exp(-np.arange(rows) / 10.0) if kind == "coloured" else np.ones(rows)
    return keeps[:, None] * now[:, None]
