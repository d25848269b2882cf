"""Lines of a testfield, compiled: where ridge points support them, and the light that they take."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["add_windows", "near_line", "shade", "supported"]


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


@numba.njit(cache=True, nogil=True)
def _normal(z: float) -> float:
    """Distribution function of the normal distribution."""
    return 0.5 * math.erfc(-0.7071067811865476 * z)


@numba.njit(cache=True, nogil=True)
def shade(
    free: NDArray[Any],
    axis: int,
    step: NDArray[Any],
    place: NDArray[Any],
    normal: NDArray[Any],
    half: NDArray[Any],
    ends: NDArray[Any],
    path: tuple[NDArray[Any], NDArray[Any]],
    blur: float,
    reach: int,
) -> None:
    """Multiply the free share of pixels by that which a blurred line leaves.

    Parameters
    ----------
    free : ndarray (h, w)
        Share of each pixel that is not covered, changed in place.
    axis, step, place, normal
        As in :class:`reseau.measure.testfield.line_profiles.Crossings`.
    half : ndarray (n,)
        Half the width of the line at each crossing, pixels.
    ends : ndarray (2,)
        First and last place of the line, in steps.
    path : (ndarray (s, 2), ndarray (s,))
        Places along the path of the camera, and their weights.
    blur : float
        Width (one sigma) of a blurred edge.
    reach : int
        Pixels to either side of the line.
    """
    places, weights = path
    size = free.shape[axis]
    for i in range(len(step)):
        end = _normal((step[i] - ends[0]) / blur) * _normal((ends[1] - step[i]) / blur)
        middle, across = int(np.rint(place[i])), normal[i, 1 - axis]
        for k in range(max(middle - reach, 0), min(middle + reach + 1, size)):
            distance, share = (k - place[i]) * across, 0.0
            for m in range(len(weights)):
                off = distance - normal[i, 0] * places[m, 0] - normal[i, 1] * places[m, 1]
                share += weights[m] * (_normal((off + half[i]) / blur) - _normal((off - half[i]) / blur))
            if axis == 0:
                free[k, step[i]] *= 1 - share * end
            else:
                free[step[i], k] *= 1 - share * end


@numba.njit(cache=True, nogil=True)
def near_line(
    xy: NDArray[Any],
    normal: NDArray[Any],
    across: NDArray[Any],
    distance: float,
    near: float,
    parallel: float,
) -> NDArray[Any]:
    """Indices of the ridge points on a line; parameters as in :func:`supported`, of one line."""
    found, count = np.empty(len(xy), np.intp), 0
    for i in range(len(xy)):
        off = xy[i, 0] * across[0] + xy[i, 1] * across[1] - distance
        if abs(off) < near and abs(normal[i, 0] * across[0] + normal[i, 1] * across[1]) > parallel:
            found[count] = i
            count += 1
    return found[:count].copy()


@numba.njit(cache=True, nogil=True)
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
