"""The inverse of reduced normal equations without forming them, where they are nearly singular.

The rows F = A − B V⁻¹ Wᵀ of all observations, points eliminated, have FᵀF = S. Their QR factors know S to the
root of its condition: what S loses to rounding, F keeps (Golub & Van Loan, *Matrix Computations*, ch. 5).
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Mask
from .arrow import Singular
from .normal import SEGMENTS
from .system import Linear, Normal

__all__ = ["careful_inverse", "is_small"]

# Entries of F that are still a matter of a second.
_ENTRIES = 20_000_000
# Singular values below this part of the largest count as zero, as in :mod:`reseau.adjust`.
_RANK = 1e-13


def is_small(linear: Linear) -> bool:
    """Whether the rows of all observations can be held as a full matrix."""
    return 2 * len(linear.misfits) * linear.system.unknowns.size <= _ENTRIES


def careful_inverse(normal: Normal, held: Mask) -> Array:
    """S⁻¹ (u, u) from the rows of the observations; zero for what is held.

    Parameters
    ----------
    normal : Normal
        Undamped normal equations, whose V⁻¹ are used.
    held : ndarray of bool (u,)
        Reduced unknowns that are held.

    Raises
    ------
    Singular
        When the rows do not determine the others.
    """
    rows = _rows(normal)[:, ~held]
    length = np.sqrt((rows**2).sum(axis=0))
    if not (length > 0).all():
        raise Singular
    triangle = np.linalg.qr(rows / length, mode="r")
    _, singular, vt = np.linalg.svd(triangle)
    if len(singular) < len(length) or singular[-1] <= _RANK * singular[0]:
        raise Singular
    factor = (vt.T / singular) / length[:, None]
    inverse = np.zeros((len(held), len(held)))
    inverse[np.ix_(~held, ~held)] = factor @ factor.T
    return inverse


def _rows(normal: Normal) -> Array:
    """F (N, u): all observations by the reduced unknowns, points eliminated."""
    linear, system = normal.linear, normal.linear.system
    pattern, last, u = system.pattern, linear.rows.shape[2] - 3, system.unknowns.size
    point = system.seen.point
    a = np.zeros((len(point), 2, u))
    for s in range(SEGMENTS):
        wide = int(pattern.width[:, s].max(initial=0))
        for i in range(wide):
            at = np.flatnonzero(pattern.width[:, s] > i)
            a[at, :, pattern.start[at, s] + i] = linear.rows[at, :, pattern.column[at, s] + i]
    b = linear.rows[:, :, last:]
    cross = np.zeros((len(linear.prior), 3, u))
    np.add.at(cross, point, np.swapaxes(b, 1, 2) @ a)
    through = normal.inverse @ cross
    through[pattern.eliminated == 0] = 0.0
    image = (a - b @ through[point]).reshape(-1, u)
    j, axis = system.further.coordinate.T
    _, coordinates, _ = system.further.slices
    root = system.sigma_root
    # An observed coordinate is a row with B alone, or a column of its own where its point is kept.
    observed = -root[coordinates][:, None] * through[j, axis]
    own = np.zeros((len(root), u))
    rows_kept, columns_kept, rows_interior, columns_interior = system.prior_column
    own[rows_kept, columns_kept] = root[rows_kept]
    own[rows_interior, columns_interior] = root[rows_interior]
    for k, column, slope in linear.distance_slopes():
        own[k, column] = slope
    own[coordinates] += observed
    return np.concatenate([image, own])
