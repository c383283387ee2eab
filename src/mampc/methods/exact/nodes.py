"""Nodes of the search tree, many of one level at a time, and their least squares.

A node has decided the moves up to some level: those of S are made, the others are zero, and all later moves are
free. With later moves free only the rows of L up to the level are left (see `terms`), each a row of least squares in
d_S: that of a move made only says what this move is, that of a move left out adds to the cost. With P = Z Z' the
inverse of the normal matrix of d_S, u the row's entries on S and e = c - u d_S its residual, leaving the move out
adds e^2 / alpha with alpha = 1 + |Z' u|^2, and

    d_S += Z phi e / alpha,    Z -= Z phi phi' / (alpha + sqrt(alpha)),    phi = Z' u.

Making it appends (c - u d_S) / l to d_S and the row (-phi', 1) / l to Z, l being the row's own entry. A move whose
value is known, v, is one that is left out of c - l v. Z is shared by all terms, which have a column each in d_S.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.terms import Squares, Terms
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.sample import Indices


class Nodes(NamedTuple):
    """Nodes of one level, one a row.

    Attributes:
        chosen: positions of the moves made, padded with -1, shape (N, w).
        d: their best values in each term, shape (N, w, K).
        root: Z, shape (N, w, q); its columns belong to the moves whose value is not known.
        value: relaxed optimum in each term, without prices, shape (N, K).
        low, high: least and largest values of the moves made, shape (N, w).
        width, rank: moves made, and those of them whose value is not known, shape (N,).
        used: moves made, as the budget counts them.
        charge: their price.
        last: sample of each input's last move, negative in the past, shape (N, m).
        now: moves made at the sample of the next move to decide.
        place: least and largest value that each input has now, shape (N, m, 2).
        bound: on all that a node leads to, prices included.
    """

    chosen: Indices
    d: Array
    root: Array
    value: Array
    low: Array
    high: Array
    width: Indices
    rank: Indices
    used: Indices
    charge: Array
    last: Indices
    now: Indices
    place: Array
    bound: Array

    def take(self, rows: Indices | BoolArray) -> Nodes:
        return Nodes._make([array[rows] for array in self])

    def below(self, cutoff: float) -> Nodes:
        """Those whose bound is below the cutoff."""
        rows = self.bound < cutoff
        return self if rows.all() else self.take(rows)


def root_of(terms: Terms, allowance: Allowance, admissible: AdmissiblePatterns) -> Nodes:
    """The node that has decided nothing."""
    m, K = admissible.n_inputs, len(terms.ids)
    none, nothing = np.zeros(1, np.intp), np.zeros((1, 0))
    last = np.array(allowance.frozen, dtype=np.intp) - admissible.rules.dwell
    return Nodes(
        chosen=np.full((1, 0), -1), d=np.zeros((1, 0, K)), root=np.zeros((1, 0, 0)),
        value=terms.rest[None].copy(), low=nothing, high=nothing, width=none, rank=none, used=none,
        charge=np.zeros(1), last=last[None], now=none, place=np.zeros((1, m, 2)), bound=np.full(1, -np.inf),
    )  # fmt: skip


class Row(NamedTuple):
    """The row of one move, seen from nodes: phi (N, q), alpha (N,), Z phi (N, w) and residuals (N, K)."""

    phi: Array
    alpha: Array
    gain: Array
    residual: Array


def row_of(level: int, nodes: Nodes, squares: Squares, terms: Terms) -> Row:
    u = squares.L[level][nodes.chosen][:, None, :]
    phi = (u @ nodes.root)[:, 0]
    residual = terms.c[level] - (u @ nodes.d)[:, 0]
    alpha = 1.0 + np.einsum("nq,nq->n", phi, phi)
    return Row(phi, alpha, (nodes.root @ phi[:, :, None])[:, :, 0], residual)


def without(nodes: Nodes, row: Row) -> Nodes:
    """The nodes with the row's move left out."""
    step = row.residual / row.alpha[:, None]
    share = row.phi / (row.alpha + np.sqrt(row.alpha))[:, None]
    return nodes._replace(
        d=nodes.d + row.gain[:, :, None] * step[:, None, :],
        root=nodes.root - row.gain[:, :, None] * share[:, None, :],
        value=nodes.value + row.residual * step,
    )


def with_known(level: int, nodes: Nodes, row: Row, squares: Squares, value: Array) -> Nodes:
    """The nodes with the row's move at a known value, shape (N,)."""
    row = row._replace(residual=row.residual - (squares.L[level, level] * value)[:, None])
    nodes = _widened(without(nodes, row), level, 0)
    at = np.arange(len(value)), nodes.width - 1
    nodes.d[at] = value[:, None]
    return nodes


def with_free(level: int, nodes: Nodes, row: Row, squares: Squares) -> Nodes:
    """The nodes with the row's move made, at a value that is not known."""
    pivot = 1.0 / squares.L[level, level]
    q = row.phi.shape[1]
    nodes = _widened(nodes, level, 1)
    every, at = np.arange(len(row.phi)), nodes.width - 1
    nodes.d[every, at] = row.residual * pivot
    nodes.root[every, at, :q] = row.phi * -pivot
    nodes.root[every, at, nodes.rank] = pivot
    return nodes._replace(rank=nodes.rank + 1)


def _widened(nodes: Nodes, level: int, columns: int) -> Nodes:
    """Room for one move more, the one of `level`, and for columns of Z."""
    size, w, K = nodes.d.shape
    q = nodes.root.shape[2]
    full = int(nodes.width.max(initial=0)) + 1
    wider = int(nodes.rank.max(initial=0)) + columns if columns else q
    chosen = np.full((size, max(full, w)), -1)
    chosen[:, :w] = nodes.chosen
    chosen[np.arange(size), nodes.width] = level
    d = np.zeros((size, max(full, w), K))
    d[:, :w] = nodes.d
    root = np.zeros((size, max(full, w), max(wider, q)))
    root[:, :w, :q] = nodes.root
    return nodes._replace(chosen=chosen, d=d, root=root, width=nodes.width + 1)


def joined(parts: list[Nodes]) -> Nodes:
    """Several batches of one level in one."""
    if len(parts) == 1:
        return parts[0]
    size = sum(len(part.bound) for part in parts)
    w = max(part.chosen.shape[1] for part in parts)
    q = max(part.root.shape[2] for part in parts)
    intervals = w if any(part.low.shape[1] for part in parts) else 0
    chosen, d = np.full((size, w), -1), np.zeros((size, w, parts[0].d.shape[2]))
    root, low, high = np.zeros((size, w, q)), np.zeros((size, intervals)), np.zeros((size, intervals))
    at = 0
    for part in parts:
        rows, own = slice(at, at + len(part.bound)), part.chosen.shape[1]
        chosen[rows, :own], d[rows, :own] = part.chosen, part.d
        root[rows, :own, : part.root.shape[2]] = part.root
        if intervals:
            low[rows, : part.low.shape[1]], high[rows, : part.high.shape[1]] = part.low, part.high
        at = rows.stop
    value, *others = [
        np.concatenate(arrays) for arrays in zip(*[part[3:4] + part[6:] for part in parts], strict=True)
    ]
    return Nodes(chosen, d, root, value, low, high, *others)


def trimmed(nodes: Nodes) -> Nodes:
    """The same without columns that none of them uses."""
    w, q = int(nodes.width.max(initial=0)), int(nodes.rank.max(initial=0))
    if nodes.chosen.shape[1] == w and nodes.root.shape[2] == q:
        return nodes
    sized = bool(nodes.low.shape[1])
    return nodes._replace(
        chosen=nodes.chosen[:, :w], d=nodes.d[:, :w], root=nodes.root[:, :w, :q],
        low=nodes.low[:, :w] if sized else nodes.low, high=nodes.high[:, :w] if sized else nodes.high,
    )  # fmt: skip


def renewed(level: int, nodes: Nodes, columns: list[int], squares: Squares, terms: Terms) -> Nodes:
    """The nodes, which have decided `level` moves, with these columns worked out from the start."""
    kept = nodes.d.shape[2]
    if columns[-1] >= kept:
        more = columns[-1] + 1 - kept
        nodes = nodes._replace(
            d=np.concatenate([nodes.d, np.zeros((*nodes.d.shape[:2], more))], axis=2),
            value=np.concatenate([nodes.value, np.zeros((len(nodes.value), more))], axis=1),
        )
    else:
        nodes = nodes._replace(d=nodes.d.copy(), value=nodes.value.copy())
    A = squares.L[:level][:, nodes.chosen].transpose(1, 0, 2)
    d = np.repeat(nodes.d[:, :, :1], len(columns), axis=2)
    residual = terms.c[:level, columns] - A @ d
    for _ in range(2 if squares.refined else 1):
        step = nodes.root @ (nodes.root.transpose(0, 2, 1) @ (A.transpose(0, 2, 1) @ residual))
        d += step
        residual -= A @ step
    s, chosen = terms.s[:, columns], nodes.chosen
    if nodes.low.shape[1]:
        support = np.maximum(s[chosen] * nodes.low[:, :, None], s[chosen] * nodes.high[:, :, None]).sum(
            axis=1
        )
    else:
        support = terms.support[:, columns][chosen].sum(axis=1)
    nodes.d[:, :, columns] = d
    nodes.value[:, columns] = (residual * residual).sum(axis=1) + terms.rest[columns] - support
    return nodes


def worked_out(level: int, nodes: Nodes, squares: Squares, terms: Terms) -> Nodes:
    """The nodes, which have decided `level` moves, worked out anew by a QR, which squares no condition.

    What rounding makes of nodes by rows does not add up then.
    """
    free: BoolArray = np.asarray(nodes.root.any(axis=2))
    none, known = ~free, (nodes.chosen >= 0) & ~free
    fixed = np.where(known, nodes.d[:, :, 0], 0.0)
    A = squares.L[:level][:, nodes.chosen].transpose(1, 0, 2)
    c = terms.c[:level] - (A @ fixed[:, :, None])
    d, inverse, residual = least_squares(np.where(free[:, None, :], A, 0.0), c, none)
    q = nodes.root.shape[2]
    columns = np.argsort(none, axis=1, kind="stable")[:, None, :q]
    s, chosen = terms.s, nodes.chosen
    if nodes.low.shape[1]:
        support = np.maximum(s[chosen] * nodes.low[:, :, None], s[chosen] * nodes.high[:, :, None]).sum(
            axis=1
        )
    else:
        support = terms.support[chosen].sum(axis=1)
    return nodes._replace(
        d=d + fixed[:, :, None],
        root=np.take_along_axis(inverse, columns, axis=2),
        value=np.square(residual).sum(axis=1) + terms.rest - support,
    )


def least_squares(A: Array, c: Array, none: BoolArray) -> tuple[Array, Array, Array]:
    """The optima of |A d - c|^2, the inverses of the triangular factors, and the residuals, by a QR.

    Args:
        A: shape (N, k, w), its columns `none` zero.
        c: shape (N, k, K).
        none: unknowns that are none, zero in the optima and in the inverses, shape (N, w).
    """
    N, k, w = A.shape
    rows = np.zeros((N, k + w, w))
    rows[:, :k] = A
    diagonal = np.arange(w)
    rows[:, k + diagonal, diagonal] = none
    Q, R = np.linalg.qr(rows)
    Q, across = Q[:, :k], Q[:, :k].transpose(0, 2, 1)
    inverse = np.where(none[:, :, None], 0.0, np.linalg.inv(R))
    reached = across @ c
    residual = c - Q @ reached
    lost = across @ residual  # what rounding left in the range
    return inverse @ (reached + lost), inverse, residual - Q @ lost


def variance_of(root: Array) -> Array:
    return np.asarray(np.einsum("nwq,nwq->nw", root, root))


def lift(low: Array, high: Array, d: Array, variance: Array) -> Array:
    """How much more a pattern costs at least because its best moves d leave their intervals, shape (N, K)."""
    beyond = np.maximum(np.maximum(low[:, :, None] - d, d - high[:, :, None]), 0.0)
    weight = np.where(variance > 0, 1.0 / np.where(variance > 0, variance, 1.0), 0.0)
    return np.asarray((beyond * beyond * weight[:, :, None]).max(axis=1, initial=0.0))
