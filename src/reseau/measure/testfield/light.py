"""Light of a testfield: how it is illuminated, and what other targets and lines attenuate or add."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows


def without_own(
    total: NDArray[Any], first: Rows, own: NDArray[Any], sign: float, others: NDArray[Any]
) -> None:
    """Fill the light (k, r, c) of other marks in windows: `sign` times the total (h, w) without the own.

    `first` (k, 2) are column and row of the first pixels; the border of the frame continues beyond it.
    """
    (h, w), (_, high, wide) = total.shape, own.shape
    rows = np.clip(first[:, 1:] + np.arange(high), 0, h - 1)
    columns = np.clip(first[:, :1] + np.arange(wide), 0, w - 1)
    np.subtract(total[rows[:, :, None], columns[:, None]], own, out=others)
    others *= sign


def attenuate(free: NDArray[Any], contrast: Array, size: Array) -> None:
    """Replace the free share of pixels (h, w) by the light that is missing there.

    Parameters
    ----------
    contrast : ndarray (6,)
        Coefficients of 1, u, v, u², u v, v², with u and v from −1 to 1 over the frame.
    size : ndarray (2,)
        Width and height of the frame.
    """
    rows, columns = np.nonzero(free != 1.0)
    u, v = 2 * columns / size[0] - 1, 2 * rows / size[1] - 1
    light = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1) @ contrast
    missing = light * (1.0 - free[rows, columns])
    free[:] = 0.0
    free[rows, columns] = missing


def bends(grey: NDArray[Any], total: NDArray[Any], near: Mask, sign: float, limit: float) -> Array:
    """Differences (n,) of pixels from the mean of both neighbours in the row, where the formed image is flat.

    Parameters
    ----------
    grey, total : ndarray (h, w)
        Grey values; light that marks attenuate or add.
    near : ndarray (h, w) of bool
        Pixels to look at.
    sign : float
        Factor with which `total` is added to the grey values.
    limit : float
        Largest difference of the formed image at the two neighbours.
    """
    flat = near[:, 1:-1] & (np.abs(total[:, 2:] - total[:, :-2]) < limit)
    rows, columns = np.nonzero(flat)
    here = [grey[rows, columns + k] + sign * total[rows, columns + k] for k in range(3)]
    return np.asarray(np.abs(here[1] - (here[0] + here[2]) / 2), np.float64)


def curved(
    nodes: Array,
    tangents: Array,
    kind: Rows,
    ways: Array,
    xy: Array,
    dxy: Array,
    reach: Array,
) -> None:
    """Images of outlines under mappings of second degree, their interior on the left.

    Parameters
    ----------
    nodes, tangents : ndarray (m, j, 2)
        Flat outlines of the kinds; see :class:`reseau.optics.formation.Outline`.
    kind : ndarray of int (k,)
        Kind of each target.
    ways : ndarray (k, 5, 2)
        Images of x, y, x², x y and y².
    xy, dxy, reach : ndarray (k, j, 2), (k, j, 2), (k, 2)
        Filled: images of nodes and tangents; largest distances from the origin along x and y.
    """
    (x, y), (u, v) = nodes[kind].transpose(2, 0, 1), tangents[kind].transpose(2, 0, 1)
    np.matmul(np.stack([x, y, x * x, x * y, y * y], axis=2), ways, out=xy)
    np.matmul(np.stack([u, v, 2 * x * u, x * v + y * u, 2 * y * v], axis=2), ways, out=dxy)
    area = (xy[..., 0] * dxy[..., 1] - xy[..., 1] * dxy[..., 0]).sum(axis=1)
    dxy[area < 0] *= -1.0
    reach[:] = np.abs(xy).max(axis=1)


def illumination(design: Array, values: Array, undetermined: float) -> Array:
    """Coefficients (b, m) of b sets of values at n points, adjusted three times without outliers.

    Parameters
    ----------
    design : ndarray (n, m)
        Monomials at the points.
    values : ndarray (b, n)
        Values; those that are not finite are left out.
    undetermined : float
        Weight of the coefficients as observations of zero, relative to that of the points: a few points, or
        points on a line, do not determine all of them.
    """
    found = np.zeros((len(values), design.shape[1]))
    for b, each in enumerate(values):
        finite = np.isfinite(each)
        keep = finite
        for _ in range(3):
            used = design[keep]
            normal = used.T @ used
            normal.flat[:: len(normal) + 1] += undetermined * (1.0 + np.trace(normal))
            found[b] = np.linalg.solve(normal, used.T @ each[keep])
            off = np.abs(each - design @ found[b])
            limit = 4 * np.median(off[keep]) + 1e-9 if keep.any() else 0.0
            now = finite & (off <= limit)
            if (now == keep).all():
                break
            keep = now
    return found
