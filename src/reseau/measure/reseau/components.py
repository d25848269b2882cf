"""Connected components of a mask and their sums, compiled: one pass over its pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["part_sums"]


@compiled
def part_sums(mask: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Moments and extents of the components of a mask whose pixels are connected by their sides.

    Runs of pixels are numbered, and components joined where a run touches one of the row before (Rosenfeld
    and Pfaltz 1966, Journal of the ACM 13).

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
    h, w = mask.shape
    count, parent = 0, np.zeros(256, np.int64)
    sums, extent = np.zeros((len(parent), 6)), np.zeros((len(parent), 4), np.int64)
    # First column, column after the last, and component of the runs of two rows.
    runs = np.empty((2, 3, w // 2 + 1), np.int64)
    before = 0
    for y in range(h):
        above, here = runs[(y + 1) % 2], runs[y % 2]
        x, found, at = 0, 0, 0
        row = mask[y]
        while True:
            first = _run(row, x, False)
            if first == w:
                break
            x = _run(row, first, True)
            while at < before and above[1, at] <= first:
                at += 1
            part, touched = -1, at
            while touched < before and above[0, touched] < x:
                other = _root(parent, above[2, touched])
                if part < 0:
                    part = other
                elif other != part:
                    part, other = min(part, other), max(part, other)
                    parent[other] = part
                touched += 1
            if part < 0:
                if count == len(parent):
                    sums, extent, parent = _longer(sums), _longer(extent), _longer(parent)
                part, parent[count] = count, count
                extent[count] = first, x - 1, y, y
                count += 1
            here[0, found], here[1, found], here[2, found] = first, x, part
            found += 1
            # A run of n pixels around m: their squares make n (m² + (n² − 1)/12).
            n, middle = float(x - first), 0.5 * (first + x - 1)
            each, box = sums[part], extent[part]
            each[0] += n
            each[1] += n * middle
            each[2] += n * y
            each[3] += n * (middle * middle + (n * n - 1) / 12)
            each[4] += n * middle * y
            each[5] += n * y * y
            box[0], box[1], box[3] = min(box[0], first), max(box[1], x - 1), y
        before = found
    kept = 0
    for part in range(count):
        root = _root(parent, part)
        if root == part:
            continue
        for k in range(6):
            sums[root, k] += sums[part, k]
        extent[root, 0] = min(extent[root, 0], extent[part, 0])
        extent[root, 1] = max(extent[root, 1], extent[part, 1])
        extent[root, 2] = min(extent[root, 2], extent[part, 2])
        extent[root, 3] = max(extent[root, 3], extent[part, 3])
    for part in range(count):
        if parent[part] == part:
            sums[kept], extent[kept] = sums[part], extent[part]
            kept += 1
    return sums[:kept].T, extent[:kept].T


@compiled
def _run(row: NDArray[Any], x: int, inside: bool) -> int:
    """Index of the first pixel from `x` on that differs from `inside`; the length of the row without one."""
    while x < len(row) and row[x] == inside:
        x += 1
    return x


@compiled
def _root(parent: NDArray[Any], part: int) -> int:
    """The component that another one has become part of."""
    while parent[part] != part:
        parent[part] = parent[parent[part]]
        part = parent[part]
    return part


@compiled
def _longer(rows: NDArray[Any]) -> NDArray[Any]:
    """Twice as many rows, the new ones of zeros."""
    return np.concatenate((rows, np.zeros_like(rows)))
