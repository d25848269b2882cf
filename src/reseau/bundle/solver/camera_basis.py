"""Well-conditioned combinations of the parameters of a camera, for the normal equations.

The coefficients of a polynomial, and more so of a quotient of polynomials, act on an image almost alike: the
normal equations have the square of the condition number of the derivatives, and lose the digits that tell
the coefficients apart. With the QR factors J = Q R of the derivatives of the image coordinates by the
parameters of one camera, the corrections z = R y have derivatives with orthonormal columns (Golub & Van Loan,
*Matrix Computations*, ch. 5). The normal equations are formed for z; corrections and cofactors are returned
for y. Damping remains that of the parameters themselves.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import NamedTuple

import numpy as np
import scipy

from ...core.data import Array, Rows, rows_of_groups
from .unknowns import Unknowns

# Least eigenvalue of the normal equations of a camera with unit diagonal for which its parameters are used as
# they are, and least singular value of its derivatives that is not rounding.
_GOOD, _RANK = 1e-6, 1e-12


class CameraBasis(NamedTuple):
    """Combinations of the parameters of one camera.

    Parameters
    ----------
    columns : ndarray of int (k,)
        Reduced unknowns of the parameters.
    turn : ndarray (k, k)
        y = turn · z.
    diagonal : ndarray (k,)
        Diagonal of the normal equations of y.
    """

    columns: Rows
    turn: Array
    diagonal: Array


def in_blocks(bases: Sequence[CameraBasis], blocks: Sequence[Array], others: Array) -> scipy.sparse.csr_array:
    """A matrix (u, u) with a block (k, k) for each basis, and `others` (u,) on the rest of its diagonal."""
    rest = np.ones(len(others), dtype=bool)
    rest[[column for basis in bases for column in basis.columns]] = False
    free = np.flatnonzero(rest)
    parts = [(others[free], free, free)]
    for basis, block in zip(bases, blocks, strict=True):
        at = np.meshgrid(basis.columns, basis.columns, indexing="ij")
        parts.append((block.ravel(), at[0].ravel(), at[1].ravel()))
    values, rows, columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    return scipy.sparse.csr_array((values, (rows, columns)), shape=(len(others), len(others)))


def damping_of(bases: Sequence[CameraBasis], damping: float, diagonal: Array) -> scipy.sparse.csr_array:
    """The damping (u, u) of the parameters, for the normal equations of the combinations."""
    own = [damping * (basis.turn.T * basis.diagonal) @ basis.turn for basis in bases]
    return in_blocks(bases, own, damping * np.where(diagonal > 0, diagonal, 1.0))


def camera_bases(
    unknowns: Unknowns, camera_of: Rows, observed: Set[int], derivatives: Array
) -> tuple[CameraBasis, ...]:
    """Return the combinations for the cameras that need them.

    Parameters
    ----------
    unknowns : Unknowns
        Columns.
    camera_of : ndarray of int (n,)
        Camera of each image point.
    observed : set of int
        Cameras whose parameters are observed as well: these are left as they are.
    derivatives : ndarray (n, 2, w)
        Weighted derivatives of the image coordinates; those by the camera begin in the seventh column.
    """
    found, rays = [], rows_of_groups(camera_of, len(unknowns.count))
    every = products_of(derivatives, camera_of, unknowns.count)
    weakest = _least_eigenvalues(every, unknowns.count)
    for c in np.flatnonzero((unknowns.camera >= 0) & (unknowns.count > 1) & ~(weakest > _GOOD)).tolist():
        if c in observed:
            continue
        own, count = rays[c], int(unknowns.count[c])
        j = derivatives[own, :, 6 : 6 + count].reshape(-1, count)
        diagonal = np.einsum("ni,ni->i", j, j)
        if len(j) < j.shape[1] or not (diagonal > 0).all() or not np.isfinite(diagonal).all():
            continue
        length = np.sqrt(diagonal)
        triangle = np.linalg.qr(j / length, mode="r")
        if np.linalg.svd(triangle, compute_uv=False)[-1] < _RANK:
            continue
        turn = scipy.linalg.solve_triangular(triangle, np.eye(len(length))) / length[:, None]
        columns = (unknowns.camera[c] + np.arange(len(length))).astype(np.intp)
        found.append(CameraBasis(columns, turn, diagonal))
    return tuple(found)


def products_of(derivatives: Array, camera_of: Rows, count: Rows) -> Array:
    """Compute JᵀJ of the parameters of each camera (c, k, k), padded with zeros."""
    most, order = max(count, default=0), np.argsort(camera_of, kind="stable")
    products = np.zeros((len(count), most, most))
    each = np.split(order, np.searchsorted(camera_of[order], np.arange(1, len(count))))
    for c, (rows, n) in enumerate(zip(each, count, strict=True)):
        j = derivatives[rows, :, 6 : 6 + n].reshape(2 * len(rows), n)
        products[c, :n, :n] = j.T @ j
    return products


def _least_eigenvalues(products: Array, count: Rows) -> Array:
    """Least eigenvalue (c,) of the products with unit diagonal; zero where one is not positive and finite."""
    least = np.zeros(len(count))
    for size in np.unique(count[count > 1]):
        rows = np.flatnonzero(count == size)
        own = products[rows, :size, :size]
        diagonal = np.diagonal(own, axis1=1, axis2=2)
        good = (diagonal > 0).all(axis=1) & np.isfinite(own).all(axis=(1, 2))
        length = np.sqrt(diagonal[good])
        scaled = own[good] / (length[:, :, None] * length[:, None, :])
        least[rows[good]] = np.linalg.eigvalsh(scaled)[:, 0]
    return least


def with_bases(
    derivatives: Array, unknowns: Unknowns, camera_of: Rows, bases: tuple[CameraBasis, ...]
) -> Array:
    """Return the derivatives (n, 2, w) of the image coordinates by the combinations."""
    if not bases:
        return derivatives
    rows, rays = derivatives.copy(), rows_of_groups(camera_of, len(unknowns.count))
    camera_at = {int(column): c for c, column in enumerate(unknowns.camera)}
    for basis in bases:
        own, part = rays[camera_at[int(basis.columns[0])]], slice(6, 6 + len(basis.columns))
        rows[own, :, part] = rows[own, :, part] @ basis.turn
    return rows
