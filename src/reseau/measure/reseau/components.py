"""Sums over connected components of a frame, compiled: one pass over its pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["part_sums"]


@compiled
def part_sums(labels: NDArray[Any], count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Moments and extents of connected components.

    Parameters
    ----------
    labels : ndarray (h, w) of int
        Component of each pixel; 0 is the background.
    count : int
        Number of components, including the background.

    Returns
    -------
    sums : ndarray (6, count)
        Sums of 1, x, y, x², xy, y² over the pixels of each component; 0 for the background.
    extent : ndarray (4, count) of int
        First and last column, first and last row of each.
    """
    h, w = labels.shape
    sums, extent = np.zeros((count, 6)), np.empty((count, 4), np.int64)
    extent[:, 0], extent[:, 1], extent[:, 2], extent[:, 3] = w, -1, h, -1
    for y in range(h):
        x = 0
        while x < w:
            part, first = labels[y, x], x
            x += 1
            while x < w and labels[y, x] == part:
                x += 1
            if part == 0:
                continue
            # A run of n pixels around m: their squares make n (m² + (n² − 1)/12).
            n, middle = float(x - first), 0.5 * (first + x - 1)
            each, box = sums[part], extent[part]
            each[0] += n
            each[1] += n * middle
            each[2] += n * y
            each[3] += n * (middle * middle + (n * n - 1) / 12)
            each[4] += n * middle * y
            each[5] += n * y * y
            box[0], box[1] = min(box[0], first), max(box[1], x - 1)
            box[2], box[3] = min(box[2], y), y
    return sums.T, extent.T
