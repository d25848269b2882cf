"""Pixels around corners, compiled; see :mod:`reseau.measure.boards.corners`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["pixels_around"]

Floats = NDArray[Any]


@compiled
def pixels_around(
    start: Floats, across: Floats, half: tuple[int, int], reach: float, along: float
) -> NDArray[np.bool_]:
    """Pixels (k, r, c) of windows that belong to corners: those near all edges, and along each of two.

    Parameters
    ----------
    start : ndarray (k, 2)
        Corners; windows are centred on the nearest pixels.
    across : ndarray (k, e, 2)
        Distances on the plane of the board from each edge, positive on its dark side, per pixel along x, y.
    half : (int, int)
        Half the width and height of the windows.
    reach, along : float
        Distance from the edges, and that along them on the dark side; `along` counts for two edges only,
        where it is larger.
    """
    right, down = half
    (count, edges, _), longer = across.shape, along > reach
    found = np.empty((count, 2 * down + 1, 2 * right + 1), np.bool_)
    for k in range(count):
        x0, y0 = np.rint(start[k, 0]) - right - start[k, 0], np.rint(start[k, 1]) - down - start[k, 1]
        for i in range(2 * down + 1):
            y = y0 + i
            for j in range(2 * right + 1):
                x, near = x0 + j, True
                for e in range(edges):
                    near &= abs(across[k, e, 0] * x + across[k, e, 1] * y) < reach
                if longer:
                    one = across[k, 0, 0] * x + across[k, 0, 1] * y
                    two = across[k, 1, 0] * x + across[k, 1, 1] * y
                    near |= abs(one) < reach and 0 < two < along
                    near |= abs(two) < reach and 0 < one < along
                found[k, i, j] = near
    return found
