"""Pixels of a testfield, compiled: ridge points of lines, and windows that are added to a frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["add_windows", "ridges"]


@compiled
def add_windows(
    total: NDArray[Any], seen: NDArray[Any], first: NDArray[Any], images: NDArray[Any], wanted: bool
) -> None:
    """Add images (k, r, c), of which the first pixel is at column and row `first` (k, 2), to a frame (h, w).

    Where `wanted`, their pixels are marked in `seen`.
    """
    h, w = total.shape
    for k in range(len(images)):
        left, top = first[k, 0], first[k, 1]
        for r in range(max(0, -top), min(images.shape[1], h - top)):
            for c in range(max(0, -left), min(images.shape[2], w - left)):
                total[top + r, left + c] += images[k, r, c]
                if wanted:
                    seen[top + r, left + c] = True


@compiled
def ridges(
    xx: NDArray[Any], yy: NDArray[Any], xy: NDArray[Any], x: NDArray[Any], y: NDArray[Any], least: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Ridge points (n, 2) and their normals (n, 2) from the derivatives (h, w) of a smoothed frame.

    The curvature across is at least `least`, that along less than half of it, and the slope across vanishes
    within 0.7 pixels.
    """
    points, normals, count = np.empty((16384, 2)), np.empty((16384, 2)), 0
    for r in range(xx.shape[0]):
        for c in range(xx.shape[1]):
            half, mean = (xx[r, c] - yy[r, c]) / 2, (xx[r, c] + yy[r, c]) / 2
            square, lack = half * half + xy[r, c] * xy[r, c], least - mean
            if not (square > lack * lack or lack < 0):
                continue
            root = math.sqrt(square)
            across = mean + root
            if not (across > least and abs(mean - root) < across / 2):
                continue
            # The direction across has half the angle of (half, xy).
            if half > 0:
                u = math.sqrt(0.5 + 0.5 * half / root)
                v = 0.5 * xy[r, c] / (root * u)
            else:
                v = math.copysign(math.sqrt(0.5 - 0.5 * half / root), xy[r, c])
                u = 0.5 * xy[r, c] / (root * v)
            step = -(x[r, c] * u + y[r, c] * v) / across
            if abs(step) < 0.7:
                if count == len(points):
                    points = np.concatenate((points, np.empty_like(points)))
                    normals = np.concatenate((normals, np.empty_like(normals)))
                points[count, 0], points[count, 1] = c + step * u, r + step * v
                normals[count, 0], normals[count, 1] = u, v
                count += 1
    return points[:count].copy(), normals[:count].copy()
