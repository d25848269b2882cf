"""Covariances of observations as diagonal blocks: standard deviations, full matrices, and blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array, Mask
from ..core.errors import UsageError

# Sigmas or blocks or a full matrix, or several of them one after the other, in the order of the observations.
Covariance = ArrayLike | Sequence[ArrayLike] | None


@dataclass(frozen=True, eq=False)
class Blocks:
    """b matrices (k, l) along the diagonal, whose rows begin at `row` and whose columns begin at `column`."""

    row: int
    column: int
    matrices: Array  # (b, k, l)

    @property
    def rows(self) -> slice:
        """Rows the blocks span."""
        b, k, _ = self.matrices.shape
        return slice(self.row, self.row + b * k)

    @property
    def columns(self) -> slice:
        """Columns the blocks span."""
        b, _, m = self.matrices.shape
        return slice(self.column, self.column + b * m)

    def times(self, dense: Array) -> Array:
        """Product with the rows `columns` of a vector (n,) or a matrix (n, u)."""
        b, k, m = self.matrices.shape
        part = dense[self.columns]
        if k == m == 1:
            flat = self.matrices[:, 0, 0]
            return flat * part if part.ndim == 1 else flat[:, None] * part
        return (self.matrices @ part.reshape(b, m, -1)).reshape(b * k, *part.shape[1:])

    @property
    def transposed(self) -> Blocks:
        """The transpose."""
        return Blocks(self.column, self.row, np.swapaxes(self.matrices, 1, 2))


def blocks_of(covariance: Covariance, shape: tuple[int, ...], where: str = "covariance") -> list[Array]:
    """The diagonal blocks (b, k, k) of a covariance, one array for each run of equal size.

    Parameters
    ----------
    covariance : array_like or sequence of ndarray or None
        None for unit weights; a number or an array of the observations' shape for standard deviations; (n, n)
        for a full matrix; (m, k, k) for blocks with m·k = n; or a list of ndarrays of these kinds.
    shape : tuple of int
        Shape of the observations, n in all.
    where : str
        Name used in error messages.

    Raises
    ------
    UsageError
        When its size does not match the observations, or it is not symmetric or not positive.
    """
    n = int(np.prod(shape))
    if covariance is None:
        return [np.ones((n, 1, 1))]
    if isinstance(covariance, list | tuple) and all(isinstance(part, np.ndarray) for part in covariance):
        parts = [_one_kind(np.asarray(part, dtype=np.float64), None, where) for part in covariance]
    else:
        try:
            whole = np.asarray(covariance, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(
                "is no array of numbers", where=where, do="give several parts as ndarrays"
            ) from None
        parts = [_one_kind(whole, shape, where)]
    size = sum(part.shape[0] * part.shape[1] for part in parts)
    if size != n:
        raise UsageError(f"is for {size} observations, but there are {n}", where=where)
    return parts


def _one_kind(given: Array, shape: tuple[int, ...] | None, where: str) -> Array:
    if not np.isfinite(given).all():
        raise UsageError("is not finite", where=where)
    if (shape is not None and (given.ndim == 0 or given.shape == shape)) or given.ndim == 1:
        try:
            sigma = given.ravel() if shape is None else np.broadcast_to(given, shape).ravel()
        except ValueError:
            raise UsageError(f"has the shape {given.shape} for observations {shape}", where=where) from None
        if not (sigma > 0).all():
            raise UsageError("sigmas must be above zero", where=where, do="leave observations out by weights")
        return (sigma**2)[:, None, None]
    if given.ndim == 2 and given.shape[0] == given.shape[1]:
        given = given[None]
    if given.ndim != 3 or given.shape[1] != given.shape[2]:
        raise UsageError(f"has the shape {given.shape}", where=where, do="give (n,), (n, n) or (m, k, k)")
    scale = np.abs(given).max(axis=(1, 2))
    if (np.abs(given - np.swapaxes(given, 1, 2)).max(axis=(1, 2)) > 1e-9 * scale).any():
        raise UsageError("is not symmetric", where=where)
    return given


class Weighting:
    """Whitening: makes observations uncorrelated and of unit weight.

    W is the inverse of the lower Cholesky factor of the covariance, so that P = Wᵀ W.

    Parameters
    ----------
    blocks : list of ndarray (b, k, k)
        Covariance, as from :func:`blocks_of`.
    factors : ndarray (n,), optional
        Factors on the weights; zero leaves an observation out (its row and column of the covariance).
    """

    def __init__(self, blocks: list[Array], factors: Array | None = None, where: str = "covariance") -> None:
        self.roots: list[Blocks] = []
        self.cofactors: list[Blocks] = []
        start = 0
        for matrices in blocks:
            b, k, _ = matrices.shape
            part = np.ones((b, k)) if factors is None else factors[start : start + b * k].reshape(b, k)
            root, cofactor = _root(matrices, part, where)
            self.roots.append(Blocks(start, start, root))
            self.cofactors.append(Blocks(start, start, cofactor))
            start += b * k
        self.n = start

    def whiten(self, dense: Array) -> Array:
        """W times a vector (n,) or a matrix (n, u)."""
        if len(self.roots) == 1:
            return self.roots[0].times(dense)
        return np.concatenate([root.times(dense) for root in self.roots])


def _root(matrices: Array, factors: Array, where: str) -> tuple[Array, Array]:
    """Inverse Cholesky factors of blocks, and the blocks themselves, after the factors on the weights."""
    out: Mask = factors == 0
    widen = 1.0 / np.sqrt(np.where(out, 1.0, factors))
    cofactor = matrices * widen[:, :, None] * widen[:, None, :]
    if out.any():
        # Remove an observation of weight zero from its block; the marginal of the others remains.
        cofactor = np.where(out[:, :, None] | out[:, None, :], 0.0, cofactor)
    k = matrices.shape[1]
    index = np.arange(k)
    regular = cofactor.copy()
    regular[:, index, index] += out
    try:
        root = np.linalg.inv(np.linalg.cholesky(regular)) if k > 1 else 1.0 / np.sqrt(regular)
    except np.linalg.LinAlgError:
        raise UsageError("is not positive definite", where=where) from None
    return np.where(out[:, :, None], 0.0, root), cofactor
