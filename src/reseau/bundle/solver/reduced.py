"""Cofactors of the reduced unknowns: those that observations have in common are stored, others solved for.

Observations need the cofactors of unknowns that a point has in common only. With a band these are the entries
of the inverse inside the band and the full rows (selected inverse; Takahashi, Fagan & Chen 1973; Erisman &
Tinney 1975), which need no more memory than the factors. Without factors, by conjugate gradients, none are
stored. Any other entries follow from the factors, column by column.

If Q⁻ is the cofactor matrix in some datum, that of inner constraints is Q = Q⁻ − G N Hᵀ − H N Gᵀ + G M Gᵀ
(see :mod:`~reseau.bundle.solver.posterior`); each block needs only its own rows of G and H.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from .datum import Freedom

# Columns of the inverse that are solved for at once.
_AT_ONCE = 256


class Factors(Protocol):
    """What solves the reduced normal equations."""

    def solve(self, sides: Array) -> Array:
        """Return the inverse of the matrix times right-hand sides (u,) or (u, s)."""
        ...


@dataclass(frozen=True, eq=False)
class Referral:
    """Terms of the transformation of cofactors to inner constraints: Q = Q⁻ − G N Hᵀ − H N Gᵀ + G M Gᵀ.

    N = (GᵀEG)⁻¹ (d, d) is `weight`; H = Q⁻EG of reduced unknowns (u, d) and points (p, 3, d); M = N GᵀE H N
    is `m`; `before` is Q⁻ of the reduced unknowns.
    """

    freedom: Freedom
    before: Reduced
    weight: Array
    h: Array
    h_points: Array
    m: Array


@dataclass(frozen=True, eq=False)
class Reduced:
    """Cofactors of the reduced unknowns (u,).

    Parameters
    ----------
    held : ndarray of bool (u,)
        Held unknowns: their cofactors are zero.
    band : ndarray (b, w + 1)
        Entries inside the band, column by column from the diagonal down; of the combinations `turn`.
    border : ndarray (u − b, u), optional
        Entries of the full rows, both triangles; None where nothing is stored.
    factors : Factors, optional
        Solves for what is not stored; not needed where everything is.
    turn : sparse array (u, u), optional
        Unknowns from the combinations for which the normal equations were formed.
    referral : Referral, optional
        Transformation to inner constraints.
    """

    held: Mask
    band: Array
    border: Array | None
    factors: Factors | None = None
    turn: scipy.sparse.csr_array | None = None
    referral: Referral | None = None

    @classmethod
    def of_matrix(cls, matrix: Array, held: Mask) -> Reduced:
        """Create them from the whole matrix (u, u), which is overwritten."""
        matrix[held] = 0.0
        matrix[:, held] = 0.0
        return cls(held, np.zeros((0, 1)), matrix)

    def referred(self, referral: Referral) -> Reduced:
        """Return the cofactors with inner constraints."""
        return replace(self, referral=referral)

    @property
    def known(self) -> bool:
        """Whether cofactors of all images and points were computed; those of single ones always are."""
        return self.border is not None

    @cached_property
    def full(self) -> Array:
        """The whole matrix (u, u)."""
        every = np.arange(len(self.held))
        return self.block(every, every)

    @property
    def diagonal(self) -> Array:
        """Diagonal (u,); NaN where nothing is stored."""
        return self.blocks(np.arange(len(self.held))[:, None])[:, 0, 0]

    def block(self, rows: Rows, columns: Rows) -> Array:
        """Return cofactors (k, l) of some unknowns (k,) with others (l,)."""
        one, left = self._combined(np.asarray(rows))
        two, right = self._combined(np.asarray(columns))
        if self.border is not None and self._stored(one[:, None], two[None, :]).all():
            found = self._entries(one[:, None], two[None, :])
        elif len(one) < len(two):
            found = self._solved(one)[two].T
        else:
            found = self._solved(two)[one]
        if left is not None and right is not None:
            found = left @ (right @ found.T).T
        if self.referral is not None:
            found = found + self._change(np.asarray(rows)[None], np.asarray(columns)[None])[0]
        return found

    def blocks(self, columns: Rows) -> Array:
        """Return the cofactors (g, k, k) of groups of unknowns (g, k); NaN where nothing is stored."""
        if self.border is None:
            return np.full((*columns.shape, columns.shape[1]), np.nan)
        if self.turn is not None:
            plain = replace(self, referral=None)
            g, k = columns.shape
            found = np.array([plain.block(own, own) for own in columns]).reshape(g, k, k)
        else:
            found = self._entries(columns[:, :, None], columns[:, None, :])
        return found if self.referral is None else found + self._change(columns, columns)

    def times(self, sides: Array) -> Array:
        """Return the cofactor matrix times (u, s)."""
        free = np.where(self.held[:, None], 0.0, sides)
        if self.turn is not None:
            free = self.turn.T @ free
        if self.factors is not None:
            found = self.factors.solve(free)
        elif self.border is not None:
            found = self.border @ free
        else:
            raise AssertionError("nothing is stored, and nothing solves for it")
        if self.turn is not None:
            found = self.turn @ found
        found[self.held] = 0.0
        if self.referral is not None:
            r, g = self.referral, self.referral.freedom.reduced
            found = found - g @ (r.weight @ (r.h.T @ sides)) - r.h @ (r.weight @ (g.T @ sides))
            found += g @ (r.m @ (g.T @ sides))
        return found

    def rows(self, columns: Rows) -> Array:
        """Return whole rows (k, u) of some unknowns (k,)."""
        unit = np.zeros((len(self.held), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        return self.times(unit).T

    def _combined(self, rows: Rows) -> tuple[Rows, scipy.sparse.csr_array | None]:
        """Combinations on which some unknowns depend, and these unknowns from them."""
        if self.turn is None:
            return rows, None
        own = self.turn[rows]
        at, place = np.unique(own.indices, return_inverse=True)
        own = scipy.sparse.csr_array((own.data, place, own.indptr), shape=(len(rows), len(at)))
        return at.astype(np.intp), own

    def _stored(self, i: Rows, o: Rows) -> Mask:
        bands, width = self.band.shape
        return np.asarray((np.maximum(i, o) >= bands) | (np.abs(i - o) < width))

    def _entries(self, i: Rows, o: Rows) -> Array:
        """Stored entries, of indices that are broadcast."""
        bands, border = len(self.band), self.border
        if border is None:
            raise AssertionError("nothing is stored")
        low, high = np.minimum(i, o), np.maximum(i, o)
        if not bands:
            return np.asarray(border[high, low])
        found = np.asarray(border[np.maximum(high - bands, 0), low]) if len(border) else np.zeros(low.shape)
        inside = high < bands
        near = np.minimum(high - low, self.band.shape[1] - 1)
        return np.where(inside, self.band[np.minimum(low, bands - 1), near], found)

    def _solved(self, columns: Rows) -> Array:
        """Columns (u, k) of the inverse for the combinations."""
        if self.factors is None:
            raise AssertionError("everything is stored without factors")
        found = np.empty((len(self.held), len(columns)))
        for begin in range(0, len(columns), _AT_ONCE):
            some = columns[begin : begin + _AT_ONCE]
            unit = np.zeros((len(self.held), len(some)))
            unit[some, np.arange(len(some))] = 1.0
            unit[self.held] = 0.0
            found[:, begin : begin + len(some)] = self.factors.solve(unit)
        found[self.held] = 0.0
        return found

    def _change(self, rows: Rows, columns: Rows) -> Array:
        """What inner constraints add to the blocks (g, k, l) of unknowns (g, k) and (g, l)."""
        r = self.referral
        if r is None:
            raise AssertionError("without inner constraints")
        g, h = r.freedom.reduced, r.h
        one = g[rows] @ r.weight @ np.swapaxes(h[columns], 1, 2)
        two = h[rows] @ r.weight @ np.swapaxes(g[columns], 1, 2)
        return np.asarray(g[rows] @ r.m @ np.swapaxes(g[columns], 1, 2) - one - two)
