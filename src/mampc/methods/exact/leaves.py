"""Leaves of the search tree: patterns without any further move, many at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.nodes import Nodes, least_squares, lift, variance_of
from mampc.methods.exact.terms import Squares, Terms
from mampc.program.sample import Indices


class Leaves(NamedTuple):
    """Patterns, one a row.

    Attributes:
        chosen: positions of their moves, padded with -1, shape (N, w).
        charge: prices.
        low, high: least and largest values of the moves, shape (N, w), or (N, 0) without least sizes.
        bound: on what each costs, price included.
    """

    chosen: Indices
    charge: Array
    low: Array
    high: Array
    bound: Array

    def take(self, rows: Indices | BoolArray | slice) -> Leaves:
        return Leaves._make([array[rows] for array in self])


class Rest(NamedTuple):
    """What nodes leave when no move follows, in each term.

    Attributes:
        value: the cost without prices, shape (N, K).
        residual: of the rows after the node's, shape (N, n - level, K).
        inverse: of the normal matrix in the coordinates of the nodes' root, shape (N, q, q).
    """

    value: Array
    residual: Array
    inverse: Array


def finished(level: int, nodes: Nodes, squares: Squares, terms: Terms) -> tuple[Leaves, Rest]:
    """The nodes, which have decided `level` moves, with all later ones left out."""
    d, root = nodes.d, nodes.root
    A = squares.L[level:][:, nodes.chosen].transpose(1, 0, 2)
    residual = terms.c[level:] - A @ d
    M = A @ root
    across = M.transpose(0, 2, 1)
    normal = across @ M
    diagonal = np.arange(root.shape[2])
    normal[:, diagonal, diagonal] += 1.0
    inverse = inverse_of(normal)
    x = inverse @ (across @ residual)
    residual -= M @ x
    if squares.refined:
        step = inverse @ (across @ residual - x)
        x, residual = x + step, residual - M @ step
    value = nodes.value + np.square(x).sum(axis=1) + np.square(residual).sum(axis=1)
    if nodes.low.shape[1]:
        variance = ((root @ inverse) * root).sum(axis=2)
        value += lift(nodes.low, nodes.high, d + root @ x, variance)
    bound = np.maximum(nodes.bound, value.max(axis=1) + nodes.charge)
    leaves = Leaves(nodes.chosen, nodes.charge, nodes.low, nodes.high, bound)
    return leaves, Rest(value, residual, inverse)


def with_one_more(
    level: int, nodes: Nodes, rest: Rest, squares: Squares, terms: Terms, limit: Array
) -> Array:
    """What nodes without least sizes cost with one more move from `level` on alone, shape (N, n - level).

    Without prices. With r_t the gradient when no move follows and q_t the curvature left when the others adapt, t gains
    r_t^2 / q_t. Terms that say more of a node come first, others only where a move is below its limit, (N, n - level).
    """
    across = squares.normal[level:-1][:, nodes.chosen].transpose(1, 0, 2) @ nodes.root
    q = squares.curvature[level:] - ((across @ rest.inverse) * across).sum(axis=2)
    q = np.maximum(q, 1e-12 * squares.curvature[level:])
    bound = np.full(q.shape, -np.inf)
    for term in np.argsort(-rest.value, axis=1).T:
        rows = np.flatnonzero((bound < limit).any(axis=1))
        if not len(rows):
            break
        term = term[rows]
        gradient = rest.residual[rows, :, term] @ squares.L[level:, level:-1]
        # The value is one of several that cancel here, so rounding counts.
        value = rest.value[rows, term][:, None] * (1 - 1e-12) - terms.support[level:-1, term].T
        bound[rows] = np.maximum(bound[rows], value - gradient * gradient / q[rows])
    return bound


def inverse_of(normal: Array) -> Array:
    """Inverses of normal equations, shape (..., k, k); of moves that rounding cannot tell apart, the pseudo-inverse."""
    try:
        return np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(normal, hermitian=True)


def appraised(leaves: Leaves, squares: Squares, terms: Terms, columns: list[int]) -> Leaves:
    """The leaves bounded with these terms."""
    chosen = leaves.chosen
    none: BoolArray = chosen < 0
    A = squares.L[:, chosen].transpose(1, 0, 2)
    residual: Array = np.repeat(terms.c[None, :, columns], len(chosen), axis=0)
    variance: Array
    if squares.orthogonal:
        d, root, residual = least_squares(A, residual, none)
        variance = variance_of(root)
    else:
        diagonal = np.arange(chosen.shape[1])
        normal = squares.normal[chosen[:, :, None], chosen[:, None, :]]
        normal[:, diagonal, diagonal] += none
        inverse = inverse_of(normal)
        d = np.zeros((*chosen.shape, len(columns)))
        for _ in range(2 if squares.refined else 1):
            step = inverse @ (A.transpose(0, 2, 1) @ residual)
            d += step
            residual -= A @ step
        variance = np.where(none, 0.0, np.diagonal(inverse, axis1=1, axis2=2))
    value = np.square(residual).sum(axis=1) + terms.rest[columns] + leaves.charge[:, None]
    if leaves.low.shape[1]:
        value += lift(leaves.low, leaves.high, d, variance)
        s = terms.s[:, columns][chosen]
        value -= np.maximum(s * leaves.low[:, :, None], s * leaves.high[:, :, None]).sum(axis=1)
    else:
        value -= terms.support[:, columns][chosen].sum(axis=1)
    return leaves._replace(bound=np.maximum(leaves.bound, value.max(axis=1)))
