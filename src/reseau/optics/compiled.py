"""Images of many small shapes in single precision; in double precision responses, and gridded images.

The sums are those of :mod:`reseau.optics.formation`; here they are computed shape by shape, so that they fit
into a cache, the normal distribution comes from a table, and a node of an outline is evaluated only in the
rows and columns within its reach, all nodes of a shape in one loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

__all__ = ["filtered", "formed", "gathered", "responses"]

F = TypeVar("F", bound=Callable[..., Any])
Single = NDArray[Any]
Double = NDArray[Any]

_SIDE = 5.5
"""End of the table of the normal distribution in standard deviations; 2e-8 of the light is outside."""
_PER_SIGMA = 64
"""Entries per standard deviation; with two more terms of the series in between, accurate to 1e-7."""


def _table() -> tuple[Single, Single]:
    """Distribution and density of the normal distribution at steps of 1/64 from −5.5 to 5.5."""
    z = np.arange(-_SIDE * _PER_SIGMA, _SIDE * _PER_SIGMA + 1) / _PER_SIGMA
    return ndtr(z).astype(np.float32), (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)).astype(np.float32)


_STEP, _BELL = _table()
_FAR = 8.5
"""The same for double precision; 1e-17 of the light is outside."""


def _fine_table() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distribution and density at steps of 1/64 from −8.5 to 8.5, in double precision."""
    z = np.arange(-_FAR * _PER_SIGMA, _FAR * _PER_SIGMA + 1) / _PER_SIGMA
    return ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)


_FINE_STEP, _FINE_BELL = _fine_table()
f32 = np.float32
_TOGETHER, _SMALL = 24, 600
"""Number of nodes that are summed together; of pixels of a window up to which all are."""

_FREE = {"nnan", "ninf", "nsz"}
"""Assumptions allowed to the compiler. Sums must not be reordered, and products not be fused into sums: both
would make the last bits depend on the compilation. (Products of matrices are left to BLAS.)
"""


def _compiled(function: F) -> F:
    """Compile with Numba, cached on disk, releasing the GIL."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FREE}
    return cast(F, numba.njit(**options)(function))


@_compiled
def _edges(
    offset: Single, count: int, shift: np.float32, inverse: np.float32, step: Single, bell: Single
) -> None:
    """Distribution and density at (offset + shift) · inverse."""
    for k in range(count):
        z = (offset[k] + shift) * inverse
        z = min(max(z, f32(-_SIDE)), f32(_SIDE))
        # An unsigned index needs no check for negative values, so that the loop is vectorised.
        i = np.uint32((z + f32(_SIDE)) * f32(_PER_SIGMA) + f32(0.5))
        middle = f32(i) * f32(1 / _PER_SIGMA) - f32(_SIDE)
        d = z - middle
        b = _BELL[i]
        step[k] = _STEP[i] + b * d * (f32(1) - f32(0.5) * d * middle)
        bell[k] = b * (f32(1) - d * (middle - f32(0.5) * d * (middle * middle - f32(1))))


@_compiled
def _responses(
    points: Single, n: int, sigma: np.float32, half: np.float32, first: Single, work: Single, out: Single
) -> int:
    """Integral, value and derivative (3, j·s) of the response to light at points (j,), for s pixels each.

    Pixels are at 0, 1, … n − 1; `first` (j,) is filled with the first one with a response. Returns s; the
    last of these pixels has no meaning. The integral is 0 before and 1 after them. Loops over all points are
    much faster than loops over the pixels of each.
    """
    reach, lag = f32(_SIDE) * sigma + half, 1 if half == f32(0.5) else 0
    stride = int(min(f32(2) * reach, f32(n))) + 2
    count = len(points) * stride
    offset, per, inverse = work[4], f32(0.5) / half, f32(1) / sigma
    for j in range(len(points)):
        first[j] = min(max(int(np.ceil(points[j] - reach)), 0), n)
        begin = f32(first[j]) - points[j] - half
        for k in range(stride):
            offset[j * stride + k] = begin + f32(k)
    _edges(offset, count, f32(0), inverse, work[0], work[1])
    if lag == 0:  # otherwise adjacent pixels share an edge
        _edges(offset, count, f32(2) * half, inverse, work[2], work[3])
    count -= lag
    before, bell = work[0, :count], work[1, :count]
    beyond, bells = (
        (work[0, 1 : count + 1], work[1, 1 : count + 1]) if lag else (work[2, :count], work[3, :count])
    )
    integral, value, slope = out[0], out[1], out[2]
    # Loops over few arrays each, so that the compiler can prove that these do not overlap.
    for k in range(count):
        value[k] = (beyond[k] - before[k]) * per
    for k in range(count):
        slope[k] = (bells[k] - bell[k]) * (inverse * per)
    for k in range(count):
        integral[k] = offset[k] * value[k] + beyond[k] + sigma * sigma * slope[k]
    return stride


@_compiled
def _spread(
    responses: Single, some: tuple[int, int], first: Single, stride: int, begin: int, out: Single
) -> None:
    """Responses (p, j·s) of some of j points, of s − 1 pixels each, to pixels (p, m, n) from `begin` on."""
    n = out.shape[2]
    for p in range(len(out)):
        response, window = responses[p], out[p].reshape(-1)
        for k in range(len(window)):
            window[k] = f32(0)
        for j in range(some[0], some[1]):
            left, right = min(max(first[j] - begin, 0), n), min(max(first[j] + stride - 1 - begin, 0), n)
            source = response[j * stride + left + begin - first[j] : j * stride + right + begin - first[j]]
            target = window[(j - some[0]) * n + left : (j - some[0]) * n + right]
            for k in range(len(target)):
                target[k] = source[k]


@_compiled
def _extent(first: Single, stride: int, n: int) -> tuple[int, int]:
    """First pixel of n with a response to any of some points, and the one after the last."""
    low, high = n, 0
    for j in range(len(first)):
        low, high = min(low, first[j]), max(high, first[j] + stride - 1)
    return low, max(min(high, n), low)


@_compiled
def _add(values: Single, part: Single) -> None:
    for r in range(part.shape[0]):
        row, out = values[r], part[r]
        for c in range(len(out)):
            out[c] += row[c]


@_compiled
def _scaled(factor: np.float32, values: Single, out: Single) -> None:
    for k in range(len(out)):
        out[k] = factor * values[k]


@_compiled
def formed(
    nodes: Single,
    tangents: Single,
    generators: Single,
    at: Single,
    place: Single,
    form: Single,
    sigma: Single,
    fill: float,
    parts: Single,
) -> None:
    """Form share and derivatives of shapes whose outlines are multiplied by 1 + Σ p_i F_i.

    Parameters
    ----------
    nodes, tangents : ndarray (k, j, 2)
        Nodes of outlines, and tangents times weights; see :class:`reseau.optics.formation.Outline`.
    generators : ndarray (m, 2, 2)
        The generators F_i.
    at : ndarray of int (n,)
        Indices of the outlines.
    place : ndarray (n, 2)
        Positions of their origins, from the centre of the first pixel of each window.
    form : ndarray (n, m)
        The p_i.
    sigma : ndarray (n,)
        Widths of the point-spread function.
    fill : float
        Light-sensitive share of the pitch.
    parts : ndarray (n, 1, r, c) or (n, 4 + m, r, c)
        The share and, if there is space for them, its derivatives by shifts along x and y, width, and forms.
    """
    half, (high, wide), most = f32(max(fill, 1e-6) / 2), parts.shape[2:], nodes.shape[1]
    derived, forms = parts.shape[1] > 1, parts.shape[1] - 4
    size = most * (max(high, wide) + 2)
    work, of_x, of_y = np.empty((5, size), f32), np.empty((3, size), f32), np.empty((3, size), f32)
    x, y, dx, dy = np.empty(most, f32), np.empty(most, f32), np.empty(most, f32), np.empty(most, f32)
    first_x, first_y = np.empty(most, np.intp), np.empty(most, np.intp)
    normals, grown = np.empty((most, len(generators)), f32), np.empty((2, 2), f32)
    behind = np.empty((high, wide + 1), f32)
    for k in range(len(at)):
        grown[:] = f32(0)
        grown[0, 0], grown[1, 1] = f32(1), f32(1)
        for m in range(len(generators)):
            grown += form[k, m] * generators[m]
        n = 0
        for j in range(most):
            u, v = tangents[at[k], j, 0], tangents[at[k], j, 1]
            if u == 0 and v == 0:
                continue
            dx[n], dy[n] = grown[0, 0] * u + grown[0, 1] * v, grown[1, 0] * u + grown[1, 1] * v
            u, v = nodes[at[k], j, 0], nodes[at[k], j, 1]
            x[n] = grown[0, 0] * u + grown[0, 1] * v + place[k, 0]
            y[n] = grown[1, 0] * u + grown[1, 1] * v + place[k, 1]
            for m in range(len(generators)):
                f = generators[m]
                normals[n, m] = (f[0, 0] * u + f[0, 1] * v) * dy[n] - (f[1, 0] * u + f[1, 1] * v) * dx[n]
            n += 1
        parts[k], behind[:] = f32(0), f32(0)
        tall = _responses(y[:n], high, sigma[k], half, first_y, work, of_y)
        broad = _responses(x[:n], wide, sigma[k], half, first_x, work, of_x)
        # Nodes that follow each other are near each other: their light falls into a part of the window.
        together = _TOGETHER if high * wide > _SMALL else max(n, 1)
        for begin in range(0, n, together):
            some = begin, min(begin + together, n)
            top, bottom = _extent(first_y[begin : some[1]], tall, high)
            left, right = _extent(first_x[begin : some[1]], broad, wide)
            m, rows, columns = some[1] - begin, bottom - top, right - left
            down, along = (
                np.empty((1 + derived, m, rows), f32),
                np.empty((3 if derived else 1, m, columns), f32),
            )
            _spread(of_y[1:3], some, first_y, tall, top, down)
            _spread(of_x, some, first_x, broad, left, along)
            # Factors of the response along x: of its integral, and of its value for all derivatives.
            covered, moved = np.empty((m, rows), f32), np.empty((m, (3 + max(forms, 0)) * rows), f32)
            for j in range(m):
                beyond = along[0, j, min(max(first_x[begin + j] + broad - 1 - left, 0), columns) :]
                for c in range(len(beyond)):
                    beyond[c] = f32(1)
                _scaled(-dy[begin + j], down[0, j], covered[j])
                for r in range(rows):
                    behind[top + r, right] += covered[j, r]
            _add(np.dot(covered.T, along[0]), parts[k, 0, top:bottom, left:right])
            if not derived:
                continue
            for j in range(m):
                u, v = dx[begin + j], dy[begin + j]
                _scaled(v, down[0, j], moved[j, :rows])
                _scaled(-u, down[0, j], moved[j, rows : 2 * rows])
                _scaled(sigma[k] * u, down[1, j], moved[j, 2 * rows : 3 * rows])
                for f in range(forms):
                    _scaled(normals[begin + j, f], down[0, j], moved[j, (3 + f) * rows : (4 + f) * rows])
                _scaled(sigma[k], covered[j], covered[j])
            slopes = np.dot(moved.T, along[1])
            for f in range(3 + forms):
                _add(slopes[f * rows : (f + 1) * rows], parts[k, 1 + f, top:bottom, left:right])
            _add(np.dot(covered.T, along[2]), parts[k, 3, top:bottom, left:right])
        # Outside the reach of nodes their integral is 1: add all at once.
        for r in range(high):
            total = f32(0)
            for c in range(wide):
                total += behind[r, c]
                parts[k, 0, r, c] += total


@_compiled
def responses(points: Single, first: Single, sigma: Single, out: Single) -> None:
    """Integral, value and derivative of the response of adjacent pixels, in double precision.

    Between the entries of the table the distribution has six terms of its series and the density as many:
    their errors are below 1e-14.

    Parameters
    ----------
    points : ndarray (k, j)
        Coordinates of light along an axis.
    first : ndarray (k,)
        The first of the adjacent pixels.
    sigma : ndarray (k,)
        Widths of the point-spread function.
    out : ndarray (3, k, j, c)
        The responses of c pixels.
    """
    count = out.shape[3]
    step, bell, whole = np.empty(count + 1), np.empty(count + 1), np.empty(count + 1)
    for k in range(len(points)):
        inverse = 1.0 / sigma[k]
        for j in range(points.shape[1]):
            begin = first[k] - 0.5 - points[k, j]
            low = min(max(int(np.ceil(-_FAR * sigma[k] - begin)), 0), count + 1)
            high = min(max(int(np.floor(_FAR * sigma[k] - begin)) + 1, low), count + 1)
            for c in range(low):
                step[c], bell[c], whole[c] = 0.0, 0.0, 0.0
            for c in range(high, count + 1):
                step[c], bell[c], whole[c] = 1.0, 0.0, begin + c
            for c in range(low, high):
                t = begin + c
                z = t * inverse
                i = np.uint32((z + _FAR) * _PER_SIGMA + 0.5)
                m = np.float64(i) * (1.0 / _PER_SIGMA) - _FAR
                d, m2 = z - m, m * m
                # Hermite polynomials over factorials.
                h2, h3 = (m2 - 1.0) * (1 / 2), m * (m2 - 3.0) * (1 / 6)
                h4, h5 = (m2 * (m2 - 6.0) + 3.0) * (1 / 24), m * (m2 * (m2 - 10.0) + 15.0) * (1 / 120)
                b = _FINE_BELL[i]
                series = h3 * (1 / 4) - d * (h4 * (1 / 5) - d * (h5 * (1 / 6)))
                step[c] = _FINE_STEP[i] + b * d * (1.0 - d * (m * (1 / 2) - d * (h2 * (1 / 3) - d * series)))
                bell[c] = b * (1.0 - d * (m - d * (h2 - d * (h3 - d * (h4 - d * h5)))))
                whole[c] = t * step[c] + sigma[k] * bell[c]
            for c in range(count):
                out[0, k, j, c] = whole[c + 1] - whole[c]
            for c in range(count):
                out[1, k, j, c] = step[c + 1] - step[c]
            for c in range(count):
                out[2, k, j, c] = (bell[c + 1] - bell[c]) * inverse


@_compiled
def _basis(t: float, out: Double) -> None:
    """Values (6,) of the B-spline of fifth degree around a point, at t ∈ [0, 1) of its cell."""
    for side in range(2):
        u = t if side == 0 else 1.0 - t
        # Fifth powers of the distances from the ends of the spline's pieces, over 5!.
        a, b, c = (1.0 - u) ** 5 / 120, (2.0 - u) ** 5 / 120, (3.0 - u) ** 5 / 120
        out[5 * side] = a
        out[1 + 3 * side] = b - 6 * a
        out[2 + side] = c - 6 * b + 15 * a


@_compiled
def gathered(at: Double, weights: Double, cells: Double) -> None:
    """Add the weights (q, j) of nodes at (2, j), in cells, to the cells (q, r, c) around them."""
    of_x, of_y = np.empty(6), np.empty(6)
    for j in range(at.shape[1]):
        column, row = int(np.floor(at[0, j])), int(np.floor(at[1, j]))
        _basis(at[0, j] - column, of_x)
        _basis(at[1, j] - row, of_y)
        for q in range(len(weights)):
            for m in range(6):
                factor = weights[q, j] * of_y[m]
                line = cells[q, row - 2 + m, column - 2 : column + 4]
                for k in range(6):
                    line[k] += factor * of_x[k]


@_compiled
def filtered(cells: Double, taps: Double, low: int, per_px: int, summed: Double, out: Double) -> None:
    """Filter cells (g, m) with taps (q, t): out[i, q] = Σ taps[q, k] cells[per_px i − low − k].

    The first filter goes on with the value 1 to the left: sums (g + 1, m) of the cells there are added.
    """
    count, width = len(cells), taps.shape[1]
    backwards = np.ascontiguousarray(taps[:, ::-1])
    for i in range(len(out)):
        last = per_px * i - low + 1
        first = last - width
        a, b = min(max(first, 0), count), min(max(last, 0), count)
        if b > a:
            part = np.ascontiguousarray(backwards[:, a - first : b - first])
            out[i] = np.dot(part, cells[a:b])
        else:
            out[i] = 0.0
        if len(summed):
            out[i, 0] += summed[a]
