"""Factorisation of an arrow matrix: a band with full rows below it, or only full rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ...core.data import Array

__all__ = ["Arrow", "Singular", "full"]


class Singular(Exception):
    """The matrix is numerically not positive definite."""


@dataclass(frozen=True, eq=False)
class Arrow:
    """Cholesky factors of a symmetric positive definite arrow matrix.

    Parameters
    ----------
    band : ndarray (b, w + 1)
        Factor of the band, column by column from the diagonal down.
    coupling : ndarray (b, r)
        L⁻¹ times the columns of the full rows.
    corner : ndarray (r, r)
        Factor of the Schur complement of the full rows.
    scale : ndarray (u,)
        Scale factors that give a unit diagonal.
    """

    band: Array
    coupling: Array
    corner: Array
    scale: Array

    @classmethod
    def factorise(cls, band: Array, border: Array) -> Arrow:
        """Factorise an arrow matrix; the arrays are overwritten.

        Parameters
        ----------
        band : ndarray (b, w + 1)
            Lower triangle of the band, column by column.
        border : ndarray (r, b + r)
            The full rows; only the lower triangle of the corner is read.

        Raises
        ------
        Singular
            When the matrix is not positive definite.
        """
        b, r = len(band), len(border)
        diagonal = np.concatenate([band[:, 0], np.diagonal(border[:, b:])])
        if not (diagonal > 0).all():
            raise Singular
        scale = 1.0 / np.sqrt(diagonal)
        try:
            lower, coupling = np.zeros((0, 1)), np.zeros((b, r))
            corner = border[:, b:] * scale[b:, None] * scale[b:]
            if b:
                width = band.shape[1]
                padded = np.concatenate([scale[:b], np.zeros(width)])
                below = np.lib.stride_tricks.sliding_window_view(padded, width)[:b]
                band *= scale[:b, None] * below
                lower = scipy.linalg.cholesky_banded(
                    band.T, overwrite_ab=True, lower=True, check_finite=False
                ).T
                if r:
                    sides = (border[:, :b] * scale[b:, None] * scale[:b]).T
                    coupling = _forward(lower, sides)
                    corner -= coupling.T @ coupling
            corner = scipy.linalg.cholesky(corner, lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:
            raise Singular from None
        return cls(lower, coupling, corner, scale)

    def solve(self, sides: Array) -> Array:
        """Return the inverse of the matrix times right-hand sides (u,) or (u, s)."""
        b = len(self.band)
        x = (sides.T * self.scale).T
        head, tail = x[:b], x[b:]
        if b:
            head = _forward(self.band, head)
            tail = tail - self.coupling.T @ head
        tail = scipy.linalg.cho_solve((self.corner, True), tail, check_finite=False)
        if b:
            head = _backward(self.band, head - self.coupling @ tail)
        solved: Array = (np.concatenate([head, tail]).T * self.scale).T
        return solved

    def inverse(self) -> Array:
        """Return the inverse (u, u)."""
        if len(self.band):
            u = len(self.scale)
            whole = np.empty((u, u))
            # In pieces, so that not all right-hand sides of a large block are in memory at once.
            for begin in range(0, u, 512):
                unit = np.zeros((u, min(512, u - begin)))
                unit[np.arange(begin, begin + unit.shape[1]), np.arange(unit.shape[1])] = 1.0
                whole[:, begin : begin + unit.shape[1]] = self.solve(unit)
            return whole
        inverse, _ = scipy.linalg.lapack.dpotri(self.corner, lower=1)
        lower = np.tril(inverse)
        full: Array = lower + np.tril(lower, -1).T
        full *= self.scale[:, None]
        full *= self.scale
        return full

    @property
    def weakest(self) -> float:
        """Square of the smallest pivot of the matrix with unit diagonal; tiny for a singular matrix."""
        pivots = np.concatenate([self.band[:, 0], np.diagonal(self.corner)])
        return float(pivots.min(initial=1.0) ** 2)


def full(band: Array, border: Array) -> Array:
    """Return an arrow matrix as a full symmetric matrix."""
    b, u = len(band), len(band) + len(border)
    full = np.zeros((u, u))
    for k in range(band.shape[1] if b else 0):
        at = np.arange(b - k)
        full[at + k, at] = band[: b - k, k]
    full[b:] = border
    lower = np.tril(full)
    return lower + np.tril(lower, -1).T


def _forward(lower: Array, sides: Array) -> Array:
    """L⁻¹ times right-hand sides, L a band."""
    solved: Array = scipy.linalg.lapack.dtbtrs(lower.T, _columns(sides), uplo="L", trans="N")[0]
    return solved.reshape(sides.shape)


def _backward(lower: Array, sides: Array) -> Array:
    """L⁻ᵀ times right-hand sides, L a band."""
    solved: Array = scipy.linalg.lapack.dtbtrs(lower.T, _columns(sides), uplo="L", trans="T")[0]
    return solved.reshape(sides.shape)


def _columns(sides: Array) -> Array:
    return np.asfortranarray(sides[:, None] if sides.ndim == 1 else sides)
