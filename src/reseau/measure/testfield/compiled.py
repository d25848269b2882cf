"""Where straight lines are supported by ridge points, compiled: one pass over the points for each line."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["supported"]


@numba.njit(cache=True, nogil=True)
def supported(
    xy: NDArray[Any],
    normal: NDArray[Any],
    across: NDArray[Any],
    distance: NDArray[Any],
    near: float,
    parallel: float,
    step: float,
    least: float,
) -> NDArray[Any]:
    """Part of each line on which ridge points are dense.

    A line is divided into steps. Those with enough points count 1, the others −1, and the part with the
    largest sum is taken (Bentley 1984): gaps within it are shorter than what is beyond them.

    Parameters
    ----------
    xy, normal : ndarray (n, 2)
        Ridge points and their normals.
    across, distance : ndarray (k, 2), (k,)
        Normals of the lines, and their distances from the origin.
    near : float
        Largest distance of a point from its line.
    parallel : float
        Least cosine of the angle between their normals.
    step : float
        Length of a step, pixels.
    least : float
        Number of points of a step from which it is supported.

    Returns
    -------
    ndarray (k, 2)
        Begin and end along (−y, x) of the normal; the end is before the begin where there is no such part.
    """
    reach = 0.0
    for i in range(len(xy)):
        reach = max(reach, abs(xy[i, 0]) + abs(xy[i, 1]))
    count, ends = int(2 * reach / step) + 2, np.empty((len(across), 2))
    points = np.empty(count)
    for k in range(len(across)):
        a, b = across[k, 0], across[k, 1]
        points[:] = 0
        for i in range(len(xy)):
            off = xy[i, 0] * a + xy[i, 1] * b - distance[k]
            if abs(off) < near and abs(normal[i, 0] * a + normal[i, 1] * b) > parallel:
                points[int((xy[i, 1] * a - xy[i, 0] * b + reach) / step)] += 1
        best, total, begin = 0.0, 0.0, 0
        ends[k, 0], ends[k, 1] = 0.0, -1.0
        for j in range(count):
            if total <= 0:
                total, begin = 0.0, j
            total += 1.0 if points[j] >= least else -1.0
            if total > best:
                best = total
                ends[k, 0], ends[k, 1] = begin * step - reach, (j + 1) * step - reach
    return ends
