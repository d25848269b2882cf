"""Images of a lattice, and the light of its lines.

A mapping is given as `(matrix, coefficients, normal)`: the projectivity (3, 3); the polynomials of x and y
(2, m) of the monomials 1, u, v, u², u v, v², … up to a degree; and the offset and scale that give u and v,
with the strength of a fisheye between both (4,). See :mod:`reseau.measure.plane.lattice_mapping`.
"""

from __future__ import annotations

from functools import cache
from math import isqrt
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Rows

Mapped = tuple[Array, Array, Array]

_FLAT = 1e-3
"""Argument of the fisheye up to which its series is used."""


@cache
def _exponents(degree: int) -> tuple[Rows, Rows]:
    """Exponents (m,) of u and v in the monomials."""
    order = np.repeat(np.arange(degree + 1), np.arange(1, degree + 2))
    second = np.concatenate([np.arange(n + 1) for n in range(degree + 1)])
    return order - second, second


def _powers(u: Array, degree: int) -> Array:
    """Powers of u (n,), their first and their second derivatives (3, degree + 1, n)."""
    table = np.zeros((3, degree + 1, len(u)))
    table[0, 0] = 1.0
    for i in range(1, degree + 1):
        table[0, i] = u * table[0, i - 1]
        table[1:, i] = i * table[:2, i - 1]
    return table


def _equidistant(square: Array, strength: float) -> tuple[Array, Array, Array]:
    """The factors atan(√(w s)) / √(w s) of points at squared distances s, and their derivatives by s."""
    z = strength * square
    near = z < _FLAT
    far = np.where(near, 1.0, z)
    root, share = np.sqrt(far), 1 / (1 + far)
    factor = np.arctan(root) / root
    first = (share - factor) / (2 * far)
    return (
        np.where(near, 1 - z * (1 / 3 - z * (1 / 5 - z / 7)), factor),
        strength * np.where(near, -1 / 3 + z * (2 / 5 - z * 3 / 7), first),
        strength**2 * np.where(near, 2 / 5 - z * 6 / 7, (-share * share - 3 * first) / (2 * far)),
    )


def _through_fisheye(seen: Array, first: Array, inner: Array, strength: float) -> tuple[Array, Array, Array]:
    """Points (2, n) and their derivatives (2, 2, n), (2, 2, 2, n) after a fisheye."""
    factor, by_s, by_ss = _equidistant((seen**2).sum(axis=0), strength)
    # Of s = p² + q², by the lattice coordinates.
    s_i = np.einsum("dn,din->in", 2 * seen, first)
    s_ij = 2 * np.einsum("din,djn->ijn", first, first) + np.einsum("dn,dijn->ijn", 2 * seen, inner)
    bent = factor * inner + seen[:, None, None] * (by_s * s_ij + by_ss * s_i[:, None] * s_i)
    bent += by_s * (s_i[:, None] * first[:, None] + s_i * first[:, :, None])
    return factor * seen, factor * first + by_s * s_i * seen[:, None], bent


def images(mapping: Mapped, at: Array, order: int = 0) -> tuple[Array, Array, Array]:
    """Images of lattice coordinates, and derivatives up to an order.

    Parameters
    ----------
    at : ndarray (n, 2)
        Lattice coordinates.
    order : int
        0, 1 or 2.

    Returns
    -------
    value, slope, bend : ndarray (n, 2), (n, 2, 2), (n, 2, 2, 2)
        Images, and first and second derivatives; zeros beyond the order.
    """
    matrix, coefficients, normal = mapping
    n, degree = len(at), isqrt(2 * coefficients.shape[1]) - 1
    i, j = _exponents(degree)
    x, y, depth = matrix[:, :2] @ at.T + matrix[:, 2:]
    depth = np.where(depth == 0, np.nan, depth)  # on the horizon is no image
    plane = np.stack([x, y]) / depth
    seen = (plane - normal[:2, None]) / normal[2]
    if not order:
        if normal[3] > 0:
            seen = _equidistant((seen**2).sum(axis=0), normal[3])[0] * seen
        u, v = _powers(seen[0], degree)[0], _powers(seen[1], degree)[0]
        return (coefficients @ (u[i] * v[j])).T, np.zeros((n, 2, 2)), np.zeros((n, 2, 2, 2))
    first = (matrix[:2, :2, None] - plane[:, None] * matrix[2, :2, None]) / (depth * normal[2])
    # The second derivative of a quotient of linear functions.
    turned = first[:, :, None] * matrix[2, None, :2, None] / depth
    inner = -(turned + np.swapaxes(turned, 1, 2))
    if normal[3] > 0:
        seen, first, inner = _through_fisheye(seen, first, inner, normal[3])
    u, v = _powers(seen[0], degree), _powers(seen[1], degree)
    by = np.stack([coefficients @ (u[1, i] * v[0, j]), coefficients @ (u[0, i] * v[1, j])], axis=1)
    slope, bend = np.einsum("cdn,din->nci", by, first), np.zeros((n, 2, 2, 2))
    if order > 1:
        one, both, two = (coefficients @ (u[2 - k, i] * v[k, j]) for k in range(3))
        twice = np.stack([np.stack([one, both], axis=1), np.stack([both, two], axis=1)], axis=1)
        bend = np.einsum("cden,din,ejn->ncij", twice, first, first)
        bend += np.einsum("cdn,dijn->ncij", by, inner)
    return (coefficients @ (u[0, i] * v[0, j])).T, slope, bend


def monomials(mapping: Mapped, at: Array, degree: int) -> tuple[Array, Array]:
    """Monomials (n, m) of the polynomial, and images (n, 2) without it."""
    matrix, _, normal = mapping
    x, y, depth = matrix[:, :2] @ at.T + matrix[:, 2:]
    seen = (np.stack([x, y]) / depth - normal[:2, None]) / normal[2]
    if normal[3] > 0:
        seen = _equidistant((seen**2).sum(axis=0), normal[3])[0] * seen
    (i, j), (u, v) = _exponents(degree), (_powers(each, degree)[0] for each in seen)
    return np.ascontiguousarray((u[i] * v[j]).T), (normal[:2, None] + normal[2] * seen).T


class _Crossings:
    """Crossings of a line, of which `nodes` (m, 2) were computed, with the rows or columns of a frame.

    `axis` is 0 where it crosses columns, 1 where it crosses rows; `at` (n,) are those crossed, up to `beyond`
    pixels from the ends of the line; `place` (n,) is the other coordinate there, `normal` (n, 2) the unit
    vector across, `along` (n,) the index of the node, not rounded, and `half` (n,) half the line's width.
    """

    def __init__(self, nodes: Array, beside: Array, shape: tuple[int, ...], beyond: float = 0.0) -> None:
        m = len(nodes)
        ends = np.arange(m)
        chord = nodes[np.minimum(ends + 1, m - 1)] - nodes[np.maximum(ends - 1, 0)]
        across = np.column_stack([-chord[:, 1], chord[:, 0]])
        across /= np.maximum(np.hypot(*chord.T), 1e-12)[:, None]
        right, down = np.abs(chord).sum(axis=0)
        self.axis = axis = int(down > right)
        way = slice(None, None, -1 if nodes[-1, axis] < nodes[0, axis] else 1)
        self.ends = nodes[way][[0, -1], axis]
        lowest = max(0, int(np.ceil(self.ends[0] - beyond)))
        self.at = np.arange(lowest, min(shape[1 - axis] - 1, int(np.floor(self.ends[1] + beyond))) + 1)
        self.size = shape[axis]

        def between(values: Array) -> Array:
            return np.interp(self.at, nodes[way, axis], values[way])

        self.place, self.along = between(nodes[:, 1 - axis]), between(ends.astype(float))
        self.normal = np.column_stack([between(across[:, 0]), between(across[:, 1])])
        node = np.rint(self.along).astype(np.intp)
        self.half = 0.5 * np.abs(((beside[node] - nodes[node]) * self.normal).sum(axis=1))

    def pixels(self, rows: Rows, reach: int) -> tuple[tuple[Rows, Rows], Array]:
        """Rows and columns (k, 2 · reach + 1) of pixels around some crossings; distances from the line."""
        i = np.rint(self.place[rows]).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
        at = np.broadcast_to(self.at[rows, None], i.shape)
        distance = (i - self.place[rows, None]) * self.normal[rows, 1 - self.axis, None]
        return ((i, at) if self.axis == 0 else (at, i)), distance


def shade_lines(
    free: NDArray[Any], nodes: Array, beside: Array, path: tuple[Array, Array], longest: float, blur: float
) -> None:
    """Multiply the free share of pixels by that which blurred lines leave.

    Parameters
    ----------
    free : ndarray (h, w)
        Share of each pixel that is not covered, changed in place.
    nodes, beside : ndarray (l, m, 2)
        Points on the lines, and beside them at the distance of their width.
    path : (ndarray (s, 2), ndarray (s,))
        Places along the path of the camera, and their weights.
    longest : float
        Largest distance of these places from their middle.
    blur : float
        Width (one sigma) of a blurred edge.
    """
    margin = int(5 * blur + longest + 3)
    cdf = scipy.special.ndtr
    for one, other in zip(nodes, beside, strict=True):
        met = _Crossings(one, other, free.shape, 4 * blur)
        rows = np.flatnonzero((met.place > -margin) & (met.place < met.size + margin))
        if not len(rows):
            continue
        half, normal = met.half[rows, None], met.normal[rows]
        # A line may run at 45° to the rows or columns along which it is followed.
        steepest = max(np.abs(normal[:, 1 - met.axis]).min(), 1e-3)
        reach = int(min(np.ceil((3.5 * blur + longest + half.max()) / steepest), met.size))
        pixels, distance = met.pixels(rows, reach)
        share = np.zeros(distance.shape)
        for place, weight in zip(*path, strict=True):
            off = distance - (normal @ place)[:, None]
            share += weight * (cdf((off + half) / blur) - cdf((off - half) / blur))
        # The ends are blurred, too.
        end = cdf((met.at[rows] - met.ends[0]) / blur) * cdf((met.ends[1] - met.at[rows]) / blur)
        inside = (pixels[met.axis] >= 0) & (pixels[met.axis] < met.size)
        free[pixels[0][inside], pixels[1][inside]] *= (1 - share * end[:, None])[inside]
