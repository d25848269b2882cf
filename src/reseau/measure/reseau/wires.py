"""The wires of a line grid: lines through the marks of its rows and columns, whatever their direction.

A comparator gives the crossings of a grid in axes of its own, and no two wires are exactly parallel. A wire
is therefore not a line of constant x or y but the line through the crossings on it: crossings are linked with
their neighbours in the two prevailing directions, and a line is fitted to each chain of links.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Rows

_NEIGHBOURS = 24
"""Neighbours of a mark that may be the next on its wire; crossings in between may be missing."""
_APART = np.deg2rad(35.0)
"""Smallest angle between the two families of wires."""
_CONE = np.deg2rad(18.0)
"""Largest angle of a link against the direction of its family; that to a diagonal neighbour is larger."""
_TURN = np.deg2rad(6.0)
"""Angle at which a link counts as twice as long: the next mark straight ahead precedes one beside it."""


@dataclass(frozen=True, eq=False)
class GridWires:
    """The wires of a grid in two families.

    Parameters
    ----------
    marks : tuple of two tuples of ndarray of int
        Indices of the marks on each wire of the two families, in their order along it.
    directions : ndarray (n, 2, 2)
        Unit vectors along the two wires through each mark, as columns; of a mark that lies on no wire of a
        family, the mean direction of the family.

    Examples
    --------
    A grid of two by three crossings, turned by 30°:

    >>> c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    >>> upright = np.stack(np.meshgrid([0.0, 10, 20], [0.0, 10]), axis=-1).reshape(-1, 2)
    >>> wires = grid_wires(upright @ np.array([[c, s], [-s, c]]))
    >>> [len(family) for family in wires.marks], wires.directions[0].round(3).tolist()
    ([2, 3], [[0.866, -0.5], [0.5, 0.866]])
    """

    marks: tuple[tuple[Rows, ...], tuple[Rows, ...]]
    directions: Array


def grid_wires(xy: Array) -> GridWires:
    """Find the wires on which marks lie.

    Parameters
    ----------
    xy : ndarray (n, 2)
        Coordinates of the marks, four at least, in any axes.

    Returns
    -------
    GridWires
        The family whose direction is nearer to the x-axis comes first.
    """
    count = min(_NEIGHBOURS, len(xy) - 1)
    other = scipy.spatial.KDTree(xy).query(xy, k=count + 1)[1][:, 1:]
    step = xy[other] - xy[:, None]
    length, angle = np.hypot(*np.moveaxis(step, -1, 0)), np.arctan2(step[..., 1], step[..., 0])
    marks: list[tuple[Rows, ...]] = []
    directions = np.empty((len(xy), 2, 2))
    for family, along in enumerate(_prevailing(angle, length)):
        chains = _chains(xy, other, length, angle, along)
        mean = np.array([np.cos(along), np.sin(along)])
        directions[:, :, family] = mean
        for chain in chains:
            directions[chain, :, family] = _direction(xy[chain], mean)
        marks.append(chains)
    return GridWires((marks[0], marks[1]), directions)


def _prevailing(angle: Array, length: Array) -> tuple[float, float]:
    """The two directions, in (−π/2, π/2], in which most near neighbours lie; the one nearer to x first."""
    weight = np.where(length > 0, np.maximum(length, 1e-300) ** -3.0, 0.0) / (length**-3.0).max()
    votes = np.bincount(np.rint(np.rad2deg(angle)).astype(int).ravel() % 180, weight.ravel(), minlength=180)
    smooth = scipy.ndimage.gaussian_filter1d(votes, 2.0, mode="wrap")
    first = int(smooth.argmax())
    off = np.abs((np.arange(180) - first + 90) % 180 - 90)
    second = int(np.where(off >= np.rad2deg(_APART), smooth, -1.0).argmax())
    found = [_refined(degrees, angle, weight) for degrees in (first, second)]
    if abs(np.sin(found[0])) > abs(np.sin(found[1])):
        found.reverse()
    x, y = found
    # Both families keep the handedness of the axes.
    return x, y if np.sin(y - x) > 0 else y + np.pi


def _refined(degrees: int, angle: Array, weight: Array) -> float:
    """Weighted mean of the angles near a whole degree, in (−π/2, π/2]."""
    near = (np.rad2deg(angle) - degrees + 90) % 180 - 90
    close = np.abs(near) < 6
    mean = degrees + float((near * weight)[close].sum() / max(weight[close].sum(), 1e-300))
    return float(np.deg2rad((mean + 90) % 180 - 90))


def _chains(xy: Array, other: Rows, length: Array, angle: Array, along: float) -> tuple[Rows, ...]:
    """Marks on common wires of one family: chains of links from mark to mark in both senses."""
    ahead, behind = (
        _next(other, length, np.abs(_wrapped(angle - sense))) for sense in (along, along + np.pi)
    )
    each = np.arange(len(xy))
    mutual = (ahead >= 0) & (behind[np.maximum(ahead, 0)] == each)
    links = scipy.sparse.coo_array(
        (np.ones(int(mutual.sum())), (each[mutual], ahead[mutual])), shape=(len(xy),) * 2
    )
    count, of = scipy.sparse.csgraph.connected_components(links, directed=False)
    order = np.argsort(xy @ [np.cos(along), np.sin(along)], kind="stable")
    chains = [order[of[order] == k] for k in range(count)]
    return tuple(chain for chain in chains if len(chain) > 1)


def _next(other: Rows, length: Array, turn: Array) -> Rows:
    """The next mark (n,) within the cone of a direction, -1 where there is none."""
    cost = np.where(turn < _CONE, length * (1 + (turn / _TURN) ** 2), np.inf)
    best = cost.argmin(axis=1)
    each = np.arange(len(other))
    return np.where(np.isfinite(cost[each, best]), other[each, best], -1)


def _wrapped(angle: NDArray[np.float64]) -> Array:
    """Angles in (−π, π]."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _direction(xy: Array, towards: Array) -> Array:
    """Unit vector along the line through points, by total least squares."""
    vector = np.asarray(np.linalg.svd(xy - xy.mean(axis=0), full_matrices=False)[2][0], dtype=np.float64)
    return vector if vector @ towards > 0 else -vector


def cover(hidden: NDArray[np.uint8], line: Array, reach: float) -> None:
    """Set the pixels whose centres are nearer to a line than a given distance.

    Parameters
    ----------
    hidden : ndarray (h, w)
        The mask; changed.
    line : ndarray (n, 2)
        Points of a line without sharp bends, pixels.
    reach : float
        The distance, pixels.
    """
    across = int(np.ptp(line[:, 0]) > np.ptp(line[:, 1]))
    image = hidden.T if across else hidden  # a view: what is set there is set in `hidden`
    x, y = line[:, across], line[:, 1 - across]
    x, y = (x, y) if y[-1] > y[0] else (x[::-1], y[::-1])
    rows = np.arange(max(int(np.ceil(y[0])), 0), min(int(np.floor(y[-1])) + 1, len(image)))
    if not len(rows):
        return
    middle = np.interp(rows, y, x)
    half = reach * np.hypot(1, np.interp(rows, y, np.gradient(x, y)))
    offsets = np.arange(-int(np.ceil(half.max())) - 1, int(np.ceil(half.max())) + 2)
    columns = np.rint(middle).astype(np.intp)[:, None] + offsets
    near = np.abs(columns - middle[:, None]) < half[:, None]
    near &= (columns >= 0) & (columns < image.shape[1])
    row, at = np.nonzero(near)
    image[rows[row], columns[row, at]] = 1
