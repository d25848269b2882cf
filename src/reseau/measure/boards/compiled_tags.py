"""Search for edges from corner to corner, compiled; see :mod:`reseau.measure.boards.tags`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["next_corners", "seen_edges"]

Floats = NDArray[Any]


@compiled
def _apart(a: float, b: float) -> float:
    """Angle between directions, 0 to π."""
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


@compiled
def _level(grey: Floats, x: float, y: float) -> float:
    """Grey value between pixels; that of the border beyond it."""
    x, y = min(max(x, 0.0), grey.shape[1] - 1.001), min(max(y, 0.0), grey.shape[0] - 1.001)
    i, j = int(y), int(x)
    u, v = x - j, y - i
    above = (1 - u) * grey[i, j] + u * grey[i, j + 1]
    return float((1 - v) * above + v * ((1 - u) * grey[i + 1, j] + u * grey[i + 1, j + 1]))


@compiled
def _is_edge(grey: Floats, start: Floats, end: Floats, along: int, beside: float, least: float) -> bool:
    """Whether a line is dark on the right, seen in the image, and bright on the left, all along."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    off = max(beside, 1.5 / math.hypot(dx, dy))
    contrast = np.empty(along)
    for k in range(along):
        share = 0.12 + 0.76 * k / (along - 1)
        x, y = start[0] + share * dx, start[1] + share * dy
        # A quarter turn of x into y: to the right in the image.
        contrast[k] = _level(grey, x + off * dy, y - off * dx) - _level(grey, x - off * dy, y + off * dx)
        if contrast[k] <= 0:
            return False
    return bool(contrast.min() > least * np.median(contrast))


@compiled
def seen_edges(grey: Floats, xy: Floats, edges: Floats, radius: float, count: int) -> Floats:
    """Directions of the edges (n, 2) of saddles by where a circle around them crosses their own grey value.

    Second derivatives of a blurred corner are those of a right angle, whatever its angle is. Where the circle
    does not cross four times, the given directions remain.
    """
    found, level, at = edges.copy(), np.empty(count + 1), np.empty(4)
    for k in range(len(xy)):
        middle, crossings, rises = _level(grey, xy[k, 0], xy[k, 1]), 0, 0
        for i in range(count + 1):
            angle = 2 * np.pi * i / count
            place = xy[k, 0] + radius * math.cos(angle), xy[k, 1] + radius * math.sin(angle)
            level[i] = _level(grey, place[0], place[1]) - middle
        for i in range(count):
            if (level[i] > 0) != (level[i + 1] > 0):
                if crossings < 4:
                    at[crossings] = 2 * np.pi * (i + level[i] / (level[i] - level[i + 1])) / count
                    if crossings == 0:
                        rises = level[i + 1] > 0
                crossings += 1
        if crossings != 4:
            continue
        for side in range(2):
            # Both crossings of one line, half a turn apart; the first line is where bright begins.
            one, other = at[side], at[side + 2] - np.pi
            line = one + ((other - one + np.pi) % (2 * np.pi) - np.pi) / 2
            # The bright sector extends from the first to the second, less than half a turn.
            found[k, side if rises else 1 - side] = line if rises or side == 0 else line - np.pi
    return found


@compiled
def next_corners(
    grey: Floats,
    xy: Floats,
    strength: Floats,
    leaves: Floats,
    arrives: Floats,
    near: Floats,
    limits: tuple[float, float, float],
    edge: tuple[int, float, float],
) -> Floats:
    """The corner (2 n,) to which the edge of each sector leads, -1 for none.

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values.
    xy : ndarray (n, 2)
        Saddles; each is a corner twice, with one dark sector and the other.
    strength : ndarray (n,)
        Their strength.
    leaves, arrives : ndarray (2 n,)
        Directions of the edges of the sectors, x into y.
    near : ndarray of int (n, k)
        Saddles around each, the nearest first.
    limits : (float, float, float)
        Largest angles between an edge and the direction to the next corner, and between both ends of an edge;
        least strength of the next corner, as a share of that of a corner.
    edge : (int, float, float)
        Places at which the sides of an edge are compared, their distance from it, and the least contrast.
    """
    n, after = len(xy), np.full(len(leaves), -1, np.intp)
    for i in range(len(leaves)):
        at = xy[i % n]
        for j in near[i % n]:
            if strength[j] < limits[2] * strength[i % n]:
                continue
            direction = math.atan2(xy[j, 1] - at[1], xy[j, 0] - at[0])
            if _apart(direction, leaves[i]) > limits[0]:
                continue
            for to in (j, j + n):
                towards = _apart(direction + np.pi, arrives[to]) < limits[0]
                if not (towards and _apart(leaves[i] + np.pi, arrives[to]) < limits[1]):
                    continue
                if after[i] < 0 and _is_edge(grey, at, xy[j], *edge):
                    after[i] = to
            if after[i] >= 0:
                break
    return after
