"""The mapping of a lattice and the light of its lines, compiled.

A mapping is given as `(matrix, coefficients, normal)`: the projectivity (3, 3); the polynomials of x and y
(2, m) of the monomials 1, u, v, u², u v, v², … up to a degree; and the offset and scale that give u and v,
with the strength of a fisheye between both (4,). See :mod:`reseau.measure.plane.lattice_mapping`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.assign import assign
from ...core.compiled import compiled

__all__ = ["images", "monomials", "shade_lines"]

Floats = NDArray[Any]
Mapped = tuple[Floats, Floats, Floats]

_FAR, _PER_SIGMA = 8.0, 64
"""End of the table of the normal distribution, and entries per standard deviation; accurate to 1e-10."""
_FLAT = 1e-3
"""Argument of the fisheye up to which its series is used."""
_AT = np.arange(-_FAR * _PER_SIGMA, _FAR * _PER_SIGMA + 1) / _PER_SIGMA
_STEP, _BELL = scipy.special.ndtr(_AT), np.exp(-0.5 * _AT * _AT) / np.sqrt(2 * np.pi)


@compiled
def _degree(coefficients: Floats) -> int:
    degree = 0
    while (degree + 1) * (degree + 2) // 2 < coefficients.shape[1]:
        degree += 1
    return degree


@compiled
def _powers(u: float, degree: int, table: Floats) -> None:
    """Powers of u, their first and their second derivatives (3, degree + 1)."""
    table[0, 0], table[1, 0], table[2, 0] = 1.0, 0.0, 0.0
    for i in range(1, degree + 1):
        table[0, i] = u * table[0, i - 1]
        table[1, i] = i * table[0, i - 1]
        table[2, i] = i * table[1, i - 1]


@compiled
def _equidistant(square: float, strength: float) -> tuple[float, float, float]:
    """The factor atan(√(w s)) / √(w s) of points at the squared distance s, and its derivatives by s."""
    z = strength * square
    if z < _FLAT:
        return (
            1 - z * (1 / 3 - z * (1 / 5 - z / 7)),
            strength * (-1 / 3 + z * (2 / 5 - z * 3 / 7)),
            strength * strength * (2 / 5 - z * 6 / 7),
        )
    root, share = math.sqrt(z), 1 / (1 + z)
    factor = math.atan(root) / root
    first = (share - factor) / (2 * z)
    return factor, strength * first, strength * strength * (-share * share - 3 * first) / (2 * z)


@compiled
def _through_fisheye(seen: Floats, first: Floats, inner: Floats, strength: float, before: Floats) -> None:
    """Replace a point (2,) and its derivatives (2, 2), (2, 2, 2) by those of its image; `before` is space."""
    p, q = seen
    factor, by_s, by_ss = _equidistant(p * p + q * q, strength)
    for d in range(2):
        assign(before[d], first[d])
    for i in range(2):
        for j in range(2):
            # Of s = p² + q², by the lattice coordinates.
            one, two = p * before[0, i] + q * before[1, i], p * before[0, j] + q * before[1, j]
            s_ij = 2 * (before[0, i] * before[0, j] + before[1, i] * before[1, j])
            s_ij += 2 * (p * inner[0, i, j] + q * inner[1, i, j])
            for d in range(2):
                at = seen[d]
                inner[d, i, j] = factor * inner[d, i, j] + at * (by_s * s_ij + 4 * by_ss * one * two)
                inner[d, i, j] += 2 * by_s * (one * before[d, j] + two * before[d, i])
    for i in range(2):
        s_i = 2 * (p * before[0, i] + q * before[1, i])
        for d in range(2):
            first[d, i] = factor * before[d, i] + by_s * s_i * seen[d]
    seen[0], seen[1] = factor * p, factor * q


@compiled
def images(mapping: Mapped, at: Floats, value: Floats, slope: Floats, bend: Floats) -> None:
    """Images of lattice coordinates `at` (n, 2), and derivatives.

    Parameters
    ----------
    value, slope, bend : ndarray (n, 2), (n, 2, 2), (n, 2, 2, 2)
        Filled: images, and first and second derivatives; a derivative of length 0 is not computed.
    """
    matrix, coefficients, normal = mapping
    degree, order = _degree(coefficients), (len(slope) > 0) + (len(bend) > 0)
    x, y, first, second = (
        np.empty((3, degree + 1)),
        np.empty((3, degree + 1)),
        np.empty((2, 2)),
        np.empty(4),
    )
    by_u, by_uu, terms = np.empty(2), np.empty(3), coefficients.shape[1]
    inner, seen, before, strength = np.empty((2, 2, 2)), np.empty(2), np.empty((2, 2)), normal[3]
    for k in range(len(at)):
        a, b = at[k, 0], at[k, 1]
        depth = 1.0 / (matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2])
        u = (matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2]) * depth
        v = (matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2]) * depth
        if not order:
            # Powers of u and v in place, then their products, as they are needed most often.
            p, q = (u - normal[0]) / normal[2], (v - normal[1]) / normal[2]
            if strength > 0:
                factor = _equidistant(p * p + q * q, strength)[0]
                p, q = factor * p, factor * q
            x[0, 0], y[0, 0] = 1.0, 1.0
            for i in range(1, degree + 1):
                x[0, i], y[0, i] = p * x[0, i - 1], q * y[0, i - 1]
            right, down, n, j = 0.0, 0.0, 0, 0
            for m in range(terms):
                product = x[0, n - j] * y[0, j]
                right += coefficients[0, m] * product
                down += coefficients[1, m] * product
                j += 1
                if j > n:
                    n, j = n + 1, 0
            value[k, 0], value[k, 1] = right, down
            continue
        for i in range(2):
            first[0, i] = (matrix[0, i] - u * matrix[2, i]) * depth / normal[2]
            first[1, i] = (matrix[1, i] - v * matrix[2, i]) * depth / normal[2]
        if order > 1:
            # The second derivative of a quotient of linear functions.
            for d in range(2):
                for i in range(2):
                    for j in range(2):
                        both = first[d, i] * matrix[2, j] + first[d, j] * matrix[2, i]
                        inner[d, i, j] = -both * depth
        seen[0], seen[1] = (u - normal[0]) / normal[2], (v - normal[1]) / normal[2]
        if strength > 0:
            _through_fisheye(seen, first, inner, strength, before)
        _powers(seen[0], degree, x)
        _powers(seen[1], degree, y)
        for c in range(2):
            total, m = 0.0, 0
            by_u[:], by_uu[:] = 0.0, 0.0
            for n in range(degree + 1):
                for j in range(n + 1):
                    factor, i = coefficients[c, m], n - j
                    m += 1
                    total += factor * x[0, i] * y[0, j]
                    by_u[0] += factor * x[1, i] * y[0, j]
                    by_u[1] += factor * x[0, i] * y[1, j]
                    if order > 1:
                        by_uu[0] += factor * x[2, i] * y[0, j]
                        by_uu[1] += factor * x[1, i] * y[1, j]
                        by_uu[2] += factor * x[0, i] * y[2, j]
            value[k, c] = total
            for i in range(2):
                slope[k, c, i] = by_u[0] * first[0, i] + by_u[1] * first[1, i]
            if order > 1:
                for i in range(2):
                    for j in range(2):
                        second[0] = by_uu[0] * first[0, i] * first[0, j]
                        second[1] = by_uu[1] * (first[0, i] * first[1, j] + first[0, j] * first[1, i])
                        second[2] = by_uu[2] * first[1, i] * first[1, j]
                        second[3] = by_u[0] * inner[0, i, j] + by_u[1] * inner[1, i, j]
                        bend[k, c, i, j] = second[0] + second[1] + second[2] + second[3]


@compiled
def monomials(mapping: Mapped, at: Floats, degree: int) -> tuple[Floats, Floats]:
    """Monomials (n, m) of the polynomial, and images (n, 2) without it."""
    matrix, _, normal = mapping
    found, straight = np.empty((len(at), (degree + 1) * (degree + 2) // 2)), np.empty(at.shape)
    x, y = np.empty((3, degree + 1)), np.empty((3, degree + 1))
    for k in range(len(at)):
        a, b = at[k]
        depth = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2]
        straight[k, 0] = (matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2]) / depth
        straight[k, 1] = (matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2]) / depth
        p, q = (straight[k, 0] - normal[0]) / normal[2], (straight[k, 1] - normal[1]) / normal[2]
        if normal[3] > 0:
            factor = _equidistant(p * p + q * q, normal[3])[0]
            p, q = factor * p, factor * q
            straight[k, 0], straight[k, 1] = normal[0] + normal[2] * p, normal[1] + normal[2] * q
        _powers(p, degree, x)
        _powers(q, degree, y)
        m = 0
        for n in range(degree + 1):
            for j in range(n + 1):
                found[k, m] = x[0, n - j] * y[0, j]
                m += 1
    return found, straight


@compiled
def _normal(z: float) -> float:
    """Distribution function of the normal distribution: an entry of a table and three terms of the series."""
    if not abs(z) < _FAR:
        return 1.0 if z > 0 else 0.0
    i = int((z + _FAR) * _PER_SIGMA + 0.5)
    middle = i / _PER_SIGMA - _FAR
    d = z - middle
    share: float = _STEP[i] + _BELL[i] * d * (1.0 - d * (middle / 2 - d * (middle * middle - 1.0) / 6))
    return share


@compiled
def _crossings(nodes: Floats, high: int, wide: int, beyond: float) -> tuple[int, int, Floats, Floats, Floats]:
    """Crossings of a line, of which `nodes` (m, 2) were computed, with the rows or columns of a frame.

    Returns
    -------
    axis : int
        0 where it crosses columns, 1 where it crosses rows.
    first : int
        The first of them; the others follow, up to `beyond` pixels from the ends of the line.
    place, normal, along : ndarray (n,), (n, 2), (n,)
        The other coordinate there, the unit vector across, and the index of the node, not rounded.
    """
    m, right, down = len(nodes), 0.0, 0.0
    across = np.empty((m, 2))
    for i in range(m):
        low, up = max(i - 1, 0), min(i + 1, m - 1)
        x, y = nodes[up, 0] - nodes[low, 0], nodes[up, 1] - nodes[low, 1]
        right, down = right + abs(x), down + abs(y)
        length = max(math.hypot(x, y), 1e-12)
        across[i, 0], across[i, 1] = -y / length, x / length
    axis = int(down > right)
    backwards = nodes[m - 1, axis] < nodes[0, axis]
    begin, end = nodes[0, axis], nodes[m - 1, axis]
    if backwards:
        begin, end = end, begin
    size = high if axis else wide
    lowest, highest = max(0.0, math.ceil(begin - beyond)), min(size - 1.0, math.floor(end + beyond))
    count = int(highest - lowest) + 1 if lowest <= highest else 0
    place, normal, along = np.empty(count), np.empty((count, 2)), np.empty(count)
    for k in range(count):
        at, low, up = lowest + k, 0, m - 1
        while up - low > 1:
            middle = (low + up) // 2
            if nodes[m - 1 - middle if backwards else middle, axis] <= at:
                low = middle
            else:
                up = middle
        one, two = (m - 1 - low, m - 1 - up) if backwards else (low, up)
        length = nodes[two, axis] - nodes[one, axis]
        part = min(max((at - nodes[one, axis]) / length, 0.0), 1.0) if length > 0 else 0.0
        place[k] = nodes[one, 1 - axis] + part * (nodes[two, 1 - axis] - nodes[one, 1 - axis])
        for c in range(2):
            normal[k, c] = across[one, c] + part * (across[two, c] - across[one, c])
        along[k] = one + part * (two - one)
    return axis, int(lowest), place, normal, along


@compiled
def shade_lines(
    free: Floats, nodes: Floats, beside: Floats, path: tuple[Floats, Floats], longest: float, blur: float
) -> None:
    """Multiply the free share of pixels by that which blurred lines leave.

    Parameters
    ----------
    free : ndarray (h, w)
        Share of each pixel that is not covered, changed in place.
    nodes, beside
        As in :func:`profiles`.
    path : (ndarray (s, 2), ndarray (s,))
        Places along the path of the camera, and their weights.
    longest : float
        Largest distance of these places from their middle.
    blur : float
        Width (one sigma) of a blurred edge.
    """
    (high, wide), (places, weights) = free.shape, path
    margin = int(5 * blur + longest + 3)
    for line in range(len(nodes)):
        axis, first, place, normal, along = _crossings(nodes[line], high, wide, 4 * blur)
        size, half = free.shape[axis], np.zeros(len(place))
        ends = np.array([nodes[line, 0, axis], nodes[line, -1, axis]])  # they are blurred, too
        ends.sort()
        steepest, widest = 1.0, 0.0
        for k in range(len(place)):
            if not (place[k] > -margin and place[k] < size + margin):
                continue
            node = int(np.rint(along[k]))
            half[k] = (beside[line, node, 0] - nodes[line, node, 0]) * normal[k, 0]
            half[k] += (beside[line, node, 1] - nodes[line, node, 1]) * normal[k, 1]
            half[k] = 0.5 * abs(half[k])
            steepest = min(steepest, abs(normal[k, 1 - axis]))
            widest = max(widest, half[k])
        # A line may run at 45° to the rows or columns along which it is followed.
        reach = int(min(math.ceil((3.5 * blur + longest + widest) / max(steepest, 1e-3)), size))
        for k in range(len(place)):
            if not (place[k] > -margin and place[k] < size + margin):
                continue
            end = _normal((first + k - ends[0]) / blur) * _normal((ends[1] - first - k) / blur)
            middle = int(np.rint(place[k]))
            for i in range(max(middle - reach, 0), min(middle + reach + 1, size)):
                distance, share = (i - place[k]) * normal[k, 1 - axis], 0.0
                for m in range(len(weights)):
                    off = distance - normal[k, 0] * places[m, 0] - normal[k, 1] * places[m, 1]
                    share += weights[m] * (_normal((off + half[k]) / blur) - _normal((off - half[k]) / blur))
                if axis == 0:
                    free[i, first + k] *= 1 - share * end
                else:
                    free[first + k, i] *= 1 - share * end
