"""Connected components of a mask and their sums, from runs of its pixels."""

from __future__ import annotations

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows


def part_sums(mask: Mask) -> tuple[Array, Rows]:
    """Moments and extents of the components of a mask whose pixels are connected by their sides.

    Components are joined where a run of pixels touches one of the row before (Rosenfeld and Pfaltz 1966,
    Journal of the ACM 13).

    Parameters
    ----------
    mask : ndarray (h, w) of bool
        Pixels of the components.

    Returns
    -------
    sums : ndarray (6, m)
        Sums of 1, x, y, x², xy, y² over the pixels of each component, in the order of their first pixels.
    extent : ndarray (4, m) of int
        First and last column, first and last row of each.
    """
    w = mask.shape[1]
    change = np.diff(np.pad(mask.view(np.int8), ((0, 0), (1, 1))), axis=1)
    (y, first), after = np.nonzero(change == 1), np.nonzero(change == -1)[1]
    count, row = len(y), y * (w + 1)
    if not count:
        return np.zeros((6, 0)), np.zeros((4, 0), np.int64)
    # Runs of the row before that end behind the first pixel, and begin before the last one.
    low = np.searchsorted(row + after, row - (w + 1) + first, side="right")
    touching = np.maximum(np.searchsorted(row + first, row - (w + 1) + after) - low, 0)
    run = np.repeat(np.arange(count), touching)
    above = np.arange(len(run)) + np.repeat(low - np.cumsum(touching) + touching, touching)
    graph = scipy.sparse.coo_array((np.ones(len(run), bool), (run, above)), shape=(count, count))
    parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    # A run of n pixels around m: their squares make n (m² + (n² − 1)/12).
    n, middle = (after - first).astype(np.float64), 0.5 * (first + after - 1)
    squares = n * (middle * middle + (n * n - 1) / 12)
    each = n, n * middle, n * y, squares, n * middle * y, n * y * y
    order = np.argsort(part, kind="stable")
    begin = np.searchsorted(part[order], np.arange(parts))
    lowest, highest = (
        [of.reduceat(values[order], begin) for values in some]
        for of, some in ((np.minimum, (first, y)), (np.maximum, (after - 1, y)))
    )
    extent = np.stack([lowest[0], highest[0], lowest[1], highest[1]])
    return np.stack([np.bincount(part, values, parts) for values in each]), extent
