"""Reduced normal equations solved by preconditioned conjugate gradients, without forming their matrix.

The product of S = Σ AᵀA − Σ W V⁻¹ Wᵀ with a vector is formed from the derivatives of the observations
(Agarwal, Snavely, Seitz & Szeliski 2010, *Bundle adjustment in the large*). The preconditioner is the inverse
of the diagonal blocks of S, one for each image and one for each set of shared unknowns.

A step of the iteration reduces the squared length of the error in the metric of S, that is in standard
deviations, by α rᵀM⁻¹r. The sum of these terms over the last steps is a lower bound of the squared length of
the error before them, and is what ends the iteration (Hestenes & Stiefel 1952; Strakoš & Tichý 2002, *On
error estimation in the conjugate gradient method*).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...core.data import Array, Mask, Rows
from .arrow import Singular

# Steps of which the error is estimated, at least and as a part of all; most steps.
_DELAY, _PART, _MOST = 10, 4, 5000
# Length of the error of a solution, relative to its own: errors of correlations.
_ACCURATE = 1e-8
# Least quotient of S and of its diagonal blocks along a direction that is not rounding; squared length of a
# residual, relative to that of the right-hand side, that is.
_RANK, _ROUNDING = 1e-15, 1e-30


class Blocks(NamedTuple):
    """Diagonal blocks of a matrix of u unknowns, in ascending order.

    `first` (u,) is the first unknown of the block of each unknown, `base` (u,) where the row of each unknown
    begins among the entries of all blocks, `total` the number of these entries.
    """

    first: Rows
    base: Rows
    total: int

    @classmethod
    def of(cls, starts: Rows, size: int) -> Blocks:
        """Create blocks that begin at some unknowns."""
        starts = np.unique(np.concatenate([[0], starts]))
        starts = starts[starts < size]
        width = np.diff(np.append(starts, size))
        begin = np.concatenate([[0], np.cumsum(width**2)])
        number = np.repeat(np.arange(len(starts)), width)
        first = starts[number]
        base = begin[number] + (np.arange(size) - first) * width[number]
        return cls(first.astype(np.intp), base.astype(np.intp), int(begin[-1]))

    def add(self, near: Array, rows: Rows, columns: Rows, values: Array) -> None:
        """Add entries of a symmetric matrix to the lower triangles of the blocks, where they are in them."""
        own = (self.first[rows] == self.first[columns]) & (columns <= rows)
        np.add.at(near, self.base[rows[own]] + columns[own] - self.first[rows[own]], values[own])

    def inverted(self, near: Array, held: Mask) -> list[tuple[Rows, Array]]:
        """Return unknowns (g, k) and inverse blocks (g, k, k), for each size k.

        Raises
        ------
        Singular
            When a block is not positive definite.
        """
        starts = np.unique(self.first)
        width = np.diff(np.append(starts, len(self.first)))
        found = []
        for k in np.unique(width):
            at = starts[width == k, None] + np.arange(k)
            block = near[self.base[at][:, :, None] + np.arange(k)]
            block = np.tril(block) + np.swapaxes(np.tril(block, -1), 1, 2)
            still = held[at]
            block[still] = 0.0
            np.swapaxes(block, 1, 2)[still] = 0.0
            diagonal = np.where(still, 1.0, np.diagonal(block, axis1=1, axis2=2))
            if not (diagonal > 0).all():
                raise Singular
            scale = 1.0 / np.sqrt(diagonal)
            block *= scale[:, :, None] * scale[:, None, :]
            block[:, np.arange(k), np.arange(k)] = 1.0
            try:
                lower = np.linalg.inv(np.linalg.cholesky(block))
            except np.linalg.LinAlgError:
                raise Singular from None
            inverse = np.swapaxes(lower, 1, 2) @ lower
            found.append((at, inverse * scale[:, :, None] * scale[:, None, :]))
        return found


class Conjugate:
    """Solves S x = b.

    Parameters
    ----------
    product : callable
        Product of S with a vector (u,); unit rows for held unknowns.
    inverses : list of (ndarray of int (g, k), ndarray (g, k, k))
        Unknowns and inverses of the diagonal blocks.

    Attributes
    ----------
    steps : int
        Number of products in all solutions so far.
    complete : bool
        Whether all solutions so far have reached their accuracy.
    """

    def __init__(self, product: Callable[[Array], Array], inverses: list[tuple[Rows, Array]]) -> None:
        self.product, self.inverses = product, inverses
        self.steps, self.complete = 0, True

    def solve(self, sides: Array, relative: float = _ACCURATE, absolute: float = 0.0) -> Array:
        """Solve for right-hand sides (u,) or (u, s).

        Parameters
        ----------
        relative, absolute : float
            The error may have this part of the length of the solution, or this length, in the metric of S.

        Raises
        ------
        Singular
            When S is not positive definite.
        """
        if sides.ndim == 1:
            return self._solved(sides, relative, absolute)
        solved = np.empty(sides.shape)
        for k in range(sides.shape[1]):
            solved[:, k] = self._solved(sides[:, k], relative, absolute)
        return solved

    def _solved(self, side: Array, relative: float, absolute: float) -> Array:
        x, r = np.zeros(len(side)), side.astype(np.float64)
        z = self._preconditioned(r)
        p, rz, whole, terms = z.copy(), float(r @ z), 0.0, list[float]()
        if rz == 0.0:
            return x
        # pᵀMp, by recurrence: the residual is orthogonal to the directions before it.
        size, least = rz, _ROUNDING * rz
        for k in range(1, _MOST + 1):
            s = self.product(p)
            curvature = float(p @ s)
            if not curvature > _RANK * size:
                raise Singular
            step = rz / curvature
            x += step * p
            r -= step * s
            terms.append(step * rz)
            whole += terms[-1]
            self.steps += 1
            delay = _DELAY + k // _PART
            if k > delay and sum(terms[-delay:]) <= max(relative**2 * whole, absolute**2):
                return x
            z = self._preconditioned(r)
            before, rz = rz, float(r @ z)
            if not rz > least:
                return x
            p = z + (rz / before) * p
            size = rz + (rz / before) ** 2 * size
        self.complete = False
        return x

    def _preconditioned(self, r: Array) -> Array:
        z = np.empty(len(r))
        for at, inverse in self.inverses:
            z[at] = (inverse @ r[at][:, :, None])[:, :, 0]
        return z
