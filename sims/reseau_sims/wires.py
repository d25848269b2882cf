"""Upright grids of wires as disjoint rectangles; those of any direction are :mod:`reseau.optics.grids`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reseau.core.data import Array, Mask
from reseau.core.errors import UsageError
from reseau.optics.formation import Outline, rectangles


class LineGrid(NamedTuple):
    """The pieces of a grid of wires in its own plane, which do not overlap.

    Parameters
    ----------
    crossings : Outline (k, j, 2)
        The squares in which wires cross.
    upright, level : Outline (m, i, 2)
        Pieces of the wires along y and along x, each from a crossing half way to the next, and beyond the
        outermost crossings.
    """

    crossings: Outline
    upright: Outline
    level: Outline


def line_grid(
    columns: ArrayLike,
    rows: ArrayLike,
    line_width: float,
    spacing: float,
    *,
    beyond: float = 0.0,
    broken: Mask | None = None,
) -> LineGrid:
    """Divide wires along y at `columns` and along x at `rows` into pieces that do not overlap.

    A crossing of two wires hides no more light than one wire: a sum of whole wires would be wrong in every
    crossing, which is the measured point. Pieces share their ends, where integrals in opposite directions
    cancel.

    Parameters
    ----------
    columns, rows : array_like (c,), (r,)
        Positions of the wires along x and along y, ascending.
    line_width : float
        Width of the wires.
    spacing : float
        Largest distance of two nodes of the quadrature; see :meth:`Outline.polygon`.
    beyond : float
        Length of the wires beyond the outermost crossings.
    broken : ndarray of bool (r, c), optional
        Missing crossings, with their wires up to half way to the next.

    Raises
    ------
    UsageError
        When positions do not ascend, wires overlap, or nothing is left.
    """
    x, y = np.asarray(columns, dtype=np.float64), np.asarray(rows, dtype=np.float64)
    half = line_width / 2
    if min(len(x), len(y)) < 1 or min(np.diff(x).min(initial=np.inf), np.diff(y).min(initial=np.inf)) <= (
        line_width
    ):
        raise UsageError("must ascend, by more than their width", where="wires of a line grid")
    whole = np.ones((len(y), len(x)), dtype=bool) if broken is None else ~broken
    if whole.shape != (len(y), len(x)) or not whole.any():
        raise UsageError(f"has no crossing; `broken` has the shape {whole.shape}", where="line grid")
    row, column = np.nonzero(whole)
    crossings = np.stack([x[column] - half, y[row] - half, x[column] + half, y[row] + half], axis=1)
    along, start, end = _between(y, whole, half, beyond)
    upright = np.stack([x[along] - half, start, x[along] + half, end], axis=1)
    along, start, end = _between(x, whole.T, half, beyond)
    level = np.stack([start, y[along] - half, end, y[along] + half], axis=1)
    return LineGrid(*(rectangles(pieces, spacing) for pieces in (crossings, upright, level)))


def _between(at: Array, whole: Mask, half: float, beyond: float) -> tuple[NDArray[np.intp], Array, Array]:
    """Pieces of the wires between their crossings.

    Parameters
    ----------
    at : ndarray (n,)
        Positions of the crossings along the wires.
    whole : ndarray of bool (n, wires)
        Which crossings exist.

    Returns
    -------
    wire : ndarray of int (m,)
    start, end : ndarray (m,)
    """
    middle, reach = (at[1:] + at[:-1]) / 2, max(beyond, half)
    nothing = np.zeros((1, whole.shape[1]), dtype=bool)
    before, after = np.concatenate([nothing, whole]), np.concatenate([whole, nothing])
    # One piece before each crossing and one after the last; at a missing crossing it ends half way.
    start = np.where(
        before,
        np.append(at[0], at + half)[:, None],
        np.append(at[0] - reach, np.append(middle, 0.0))[:, None],
    )
    end = np.where(
        after,
        np.append(at - half, at[-1])[:, None],
        np.append(np.append(0.0, middle), at[-1] + reach)[:, None],
    )
    place, wire = np.nonzero((before | after) & (end > start))
    return wire, start[place, wire], end[place, wire]
