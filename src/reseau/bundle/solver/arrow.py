"""Factorisation of an arrow matrix: a band with full rows below it, or only full rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ...core.data import Array


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
        return (np.concatenate([head, tail]).T * self.scale).T

    def inverse(self) -> tuple[Array, Array]:
        """Compute the entries of the inverse inside the band (b, w + 1), and its full rows (r, u).

        With L the factor in blocks of the width of the band, the inverse Z has the blocks
        Z₂₁ = −Z₂₂ L₂₁ L₁₁⁻¹ and Z₁₁ = L₁₁⁻ᵀ L₁₁⁻¹ − (L₂₁ L₁₁⁻¹)ᵀ Z₂₁, from the last to the first; only the
        factor is needed besides them (Takahashi, Fagan & Chen 1973).
        """
        b, r = self.coupling.shape
        corner = scipy.linalg.lapack.dpotri(self.corner, lower=1)[0] if r else np.zeros((0, 0))
        _mirror(corner)
        if not b:
            corner *= self.scale[:, None]
            corner *= self.scale
            return np.zeros((0, 1)), corner
        across = _backward(self.band, self.coupling) if r else np.zeros((b, 0))
        rows = np.concatenate([-(across @ corner).T, corner], axis=1)
        rows *= self.scale[b:, None] * self.scale
        return self._inside(across, corner), rows

    def _inside(self, across: Array, corner: Array) -> Array:
        """Entries of the inverse inside the band; `across` (b, r) is A⁻¹ times the full rows' columns."""
        b, width = self.band.shape
        size = max(width - 1, 1)
        inside = np.zeros((b, width))
        padded = np.concatenate([self.scale[:b], np.zeros(width)])
        down = np.arange(width)
        after, later, below = np.zeros((0, 0)), 0, slice(b, b)
        for begin in range((b - 1) // size * size, -1, -size):
            end = min(begin + size, b)
            k = end - begin
            own = _dense(self.band[begin:end], 0, k)
            inverse = scipy.linalg.solve_triangular(own, np.eye(k), lower=True, check_finite=False)
            first = inverse.T @ inverse
            # Z without the part by the full rows, which is added last.
            second = np.zeros((later, k))
            if later:
                through = _dense(self.band[begin:end], k, later) @ inverse
                second = -after @ through
                first -= through.T @ second
            whole = np.concatenate([first, second])
            if across.shape[1]:
                part = across[begin:end] @ corner
                whole = whole + np.concatenate([across[begin:end], across[below]]) @ part.T
            whole = np.concatenate([whole, np.zeros((width, k))])
            at = np.arange(k)[:, None]
            own_scale = np.lib.stride_tricks.sliding_window_view(padded[begin:], width)[:k]
            inside[begin:end] = whole[at + down, at] * own_scale * self.scale[begin:end, None]
            after, later, below = first, k, slice(begin, end)
        return inside

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


def add(band: Array, border: Array, matrix: scipy.sparse.csr_array) -> None:
    """Add a symmetric matrix (u, u), whose entries are inside the band or in full rows; lower triangles."""
    low = scipy.sparse.tril(matrix).tocoo()
    inside = low.row < len(band)
    band[low.col[inside], (low.row - low.col)[inside]] += low.data[inside]
    border[low.row[~inside] - len(band), low.col[~inside]] += low.data[~inside]


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


def _dense(band: Array, below: int, rows: int) -> Array:
    """Part (rows, k) of the columns (k, w + 1) of a factor, which begins `below` rows under the first."""
    k, width = band.shape
    down = np.arange(below, below + rows)[:, None] - np.arange(k)
    inside = (down >= 0) & (down < width)
    return np.where(inside, band[np.arange(k), np.clip(down, 0, width - 1)], 0.0)


def _mirror(matrix: Array) -> None:
    """Copy the lower triangle of a matrix to the upper one, in pieces."""
    for begin in range(0, len(matrix), 512):
        end = min(begin + 512, len(matrix))
        own = matrix[begin:end, begin:end]
        own[:] = np.tril(own) + np.tril(own, -1).T
        matrix[begin:end, end:] = matrix[end:, begin:end].T
