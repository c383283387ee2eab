"""Zones: outputs that cost nothing within a range, and outside the squared distance to it.

    sum_k q_k dist(g_k, [low_k, high_k])^2

over predicted values g_k of zoned outputs: at the samples i = 0..np, and with a tail its means over the samples np + 1,
np + 2..3, np + 4..7 and so on, each weighted as much as the tail weighs its samples.
With a pull a each g_k counts twice: at (1 - a) q_k with its zone, and at a q_k with what it is drawn to.
In the program each g_k has an error s_k of either sign, low_k <= g_k - s_k <= high_k, which costs q_k s_k^2.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.program.parameter import Parameter
from mampc.program.prediction import Prediction
from mampc.program.problem import TrackingProblem
from mampc.program.sample import Indices
from mampc.program.tail import beyond_horizon, end_of_horizon, shrink

LONGEST = 4  # tail horizons, from which on one mean stands for all samples


class ZoneRows:
    """The values g of a problem's zoned outputs, and the ends of their zones.

    Attributes:
        theta: g per move, shape (k, n_moves).
        low, high: ends less g without moves, as maps of p, shape (k, its size).
        root: sqrt(q) of each, shape (k,).
        lengths: of g times that per move, shape (n_moves,).
        weighted_free: g without moves times that, as a map of p.
    """

    def __init__(self, problem: TrackingProblem, prediction: Prediction, parameter: Parameter) -> None:
        zoned, n_p = problem.zoned, problem.prediction_horizon
        rows = np.tile(zoned, n_p + 1)
        theta, free = prediction.theta[rows], prediction.free[rows]
        own = np.diag(problem.output_weight)[zoned] * problem.rank_weights[zoned]
        weight = np.tile(own, n_p + 1)
        low, high = (_ends_at(of, parameter) for of in (parameter.lower_ends, parameter.upper_ends))
        pull = problem.zone_pull
        aims = (
            [_ends_at(of, parameter) for of in (parameter.lower_aims, parameter.upper_aims)]
            if pull > 0
            else []
        )
        if problem.tail_horizon > 0 and zoned.any():
            means, of_moves, weights = _tail_means(problem, prediction, parameter)
            last, pieces = int(zoned.sum()), len(weights)
            theta, free = np.vstack([theta, of_moves]), np.vstack([free, means])
            low, high, *aims = (
                np.vstack([ends, np.tile(ends[len(ends) - last :], (pieces, 1))])
                for ends in (low, high, *aims)
            )
            weight = np.concatenate([weight, np.outer(weights, own).ravel()])
        if aims:
            theta, free = np.vstack([theta, theta]), np.vstack([free, free])
            low, high = np.vstack([low, aims[0]]), np.vstack([high, aims[1]])
            weight = np.concatenate([(1 - pull) * weight, pull * weight])
        self.theta, self.root = theta, np.sqrt(weight)
        self.lengths = np.linalg.norm(self.root[:, None] * theta, axis=0)
        self.low, self.high = low - free, high - free
        self.weighted_free = self.root[:, None] * free


def _ends_at(places: Indices, parameter: Parameter) -> Array:
    """Ends that stand at these places of p, as maps of it."""
    ends = parameter.no_map(len(places))
    ends[np.arange(len(places)), places] = 1.0
    return ends


def _tail_means(
    problem: TrackingProblem, prediction: Prediction, parameter: Parameter
) -> tuple[Array, Array, Array]:
    """Means of the zoned outputs over 1, 2, 4, ... samples of the tail: maps of p, per move, and their weights."""
    model, gamma = problem.model, shrink(problem)
    n, l = model.n_states, model.n_outputs
    zeta, of_moves = end_of_horizon(problem, prediction, parameter)
    F = gamma * beyond_horizon(model)
    E = np.hstack([model.C, np.zeros((l, n)), np.eye(l)])[problem.zoned]  # zeta ends with y - C x
    power: Array = F
    total: Array = np.eye(len(F))
    length, sums, weights = 1, [], []
    while True:  # power = F^length, total = sum of F^k over k < length; the piece is length .. 2 length - 1
        last = length >= LONGEST * problem.tail_horizon
        if last:
            total, rest = _all_of(power, total), gamma**length / (1 - gamma)
        else:
            rest = gamma**length * (1 - gamma**length) / (1 - gamma)
        sums.append(E @ power @ total / rest)
        weights.append(rest)
        if last:
            break
        total, power, length = total + power @ total, power @ power, 2 * length
    rows = np.vstack(sums)
    return rows @ zeta, rows @ of_moves, np.array(weights)


def _all_of(power: Array, total: Array) -> Array:
    """The sum over all k, from that over k < length and the power at length."""
    while np.abs(power).max() > 1e-17:
        total, power = total + power @ total, power @ power
    return total
