"""Images of many small shapes in single precision, compiled.

The sums are those of :mod:`reseau.optics.formation`; here they are computed shape by shape, so that they fit
into a cache, the normal distribution comes from a table, and a node of an outline is evaluated only in the
rows within its reach.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

__all__ = ["formed"]

F = TypeVar("F", bound=Callable[..., Any])
Single = NDArray[Any]

_SIDE = 5.5
"""End of the table of the normal distribution in standard deviations; 2e-8 of the light is outside."""
_PER_SIGMA = 64
"""Entries per standard deviation; with two more terms of the series in between, accurate to 1e-7."""


def _table() -> tuple[Single, Single]:
    """Distribution and density of the normal distribution at steps of 1/64 from −5.5 to 5.5."""
    z = np.arange(-_SIDE * _PER_SIGMA, _SIDE * _PER_SIGMA + 1) / _PER_SIGMA
    return ndtr(z).astype(np.float32), (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)).astype(np.float32)


_STEP, _BELL = _table()
f32 = np.float32

_FREE = {"nnan", "ninf", "nsz"}
"""Assumptions allowed to the compiler. Sums must not be reordered, and products not be fused into sums: both
would make the last bits depend on the compilation.
"""


def _compiled(function: F) -> F:
    """Compile with Numba, cached on disk, releasing the GIL."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FREE}
    return cast(F, numba.njit(**options)(function))


@_compiled
def _edges(
    first: np.float32, inverse: np.float32, n: int, count: int, jump: np.float32, step: Single, bell: Single
) -> None:
    """Distribution and density at (first + k) · inverse, shifted by `jump` from k = n."""
    for k in range(count):
        z = first + f32(k) + (jump if k >= n else f32(0))
        z = min(max(z * inverse, f32(-_SIDE)), f32(_SIDE))
        # An unsigned index needs no check for negative values, so that the loop is vectorised.
        i = np.uint32((z + f32(_SIDE)) * f32(_PER_SIGMA) + f32(0.5))
        middle = f32(i) * f32(1 / _PER_SIGMA) - f32(_SIDE)
        d = z - middle
        b = _BELL[i]
        step[k] = _STEP[i] + b * d * (f32(1) - f32(0.5) * d * middle)
        bell[k] = b * (f32(1) - d * (middle - f32(0.5) * d * (middle * middle - f32(1))))


@_compiled
def _responses(
    point: np.float32, count: int, sigma: np.float32, half: np.float32, work: Single, out: Single
) -> tuple[int, int]:
    """Integral, value and derivative (3, last − first) of the response of pixels to light at a point.

    Pixels are at 0, 1, … Returns the first pixel with a response, and the first one after the last. The
    integral is 0 before and 1 after them.
    """
    reach = f32(_SIDE) * sigma + half
    first = min(max(0, int(np.ceil(point - reach))), count)
    n = min(count, int(np.floor(point + reach)) + 1) - first
    if n <= 0:
        return first, first
    per, inverse, begin, lag = f32(0.5) / half, f32(1) / sigma, f32(first) - point - half, 1
    if half == f32(0.5):  # adjacent pixels share an edge
        _edges(begin, inverse, n + 1, n + 1, f32(0), work[0], work[1])
    else:
        lag = n
        _edges(begin, inverse, n, 2 * n, f32(2) * half - f32(n), work[0], work[1])
    before, beyond, bell, bells = work[0, :n], work[0, lag : lag + n], work[1, :n], work[1, lag : lag + n]
    integral, value, slope = out[0], out[1], out[2]
    # Loops over few arrays each, so that the compiler can prove that these do not overlap.
    for k in range(n):
        value[k] = (beyond[k] - before[k]) * per
    for k in range(n):
        slope[k] = (bells[k] - bell[k]) * (inverse * per)
    for k in range(n):
        integral[k] = (begin + f32(k)) * value[k] + beyond[k] + sigma * sigma * slope[k]
    return first, first + n


@_compiled
def _add_node(
    at: tuple[int, int, int, int],
    tangent: tuple[np.float32, np.float32],
    normals: Single,
    sigma: np.float32,
    responses: tuple[Single, Single],
    parts: Single,
) -> None:
    """Add the contribution of a node of an outline to share and derivatives (4 + m, r, c) in its reach."""
    (top, bottom, left, right), (dx, dy), (down, across) = at, tangent, responses
    n = right - left
    integral, value, slope = across[0], across[1], across[2]
    for r in range(top, bottom):
        h, d = down[1, r - top], down[2, r - top]
        of_share = -h * dy
        share = parts[0, r, left:right]
        for c in range(n):
            share[c] += of_share * integral[c]
        if len(parts) == 1:
            continue
        of_y, of_width, bent = -h * dx, sigma * of_share, sigma * d * dx
        along_x, along_y, width = (
            parts[1, r, left:right],
            parts[2, r, left:right],
            parts[3, r, left:right],
        )
        for c in range(n):
            along_x[c] -= of_share * value[c]
            along_y[c] += of_y * value[c]
        for c in range(n):
            width[c] += of_width * slope[c] + bent * value[c]
        for m in range(len(normals)):
            of_form, form = h * normals[m], parts[4 + m, r, left:right]
            for c in range(n):
                form[c] += of_form * value[c]


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
    half, (high, wide) = f32(max(fill, 1e-6) / 2), parts.shape[2:]
    down, across = np.empty((3, high), f32), np.empty((3, wide), f32)
    work, normals = np.empty((2, 2 * max(high, wide) + 1), f32), np.empty(len(generators), f32)
    behind, grown = np.empty((high, wide + 1), f32), np.empty((2, 2), f32)
    for k in range(len(at)):
        parts[k], behind[:], grown[:] = f32(0), f32(0), f32(0)
        grown[0, 0], grown[1, 1] = f32(1), f32(1)
        for m in range(len(generators)):
            grown += form[k, m] * generators[m]
        for j in range(nodes.shape[1]):
            u, v = tangents[at[k], j, 0], tangents[at[k], j, 1]
            if u == 0 and v == 0:
                continue
            dx, dy = grown[0, 0] * u + grown[0, 1] * v, grown[1, 0] * u + grown[1, 1] * v
            u, v = nodes[at[k], j, 0], nodes[at[k], j, 1]
            x = grown[0, 0] * u + grown[0, 1] * v + place[k, 0]
            y = grown[1, 0] * u + grown[1, 1] * v + place[k, 1]
            top, bottom = _responses(y, high, sigma[k], half, work, down)
            if top == bottom:
                continue
            left, right = _responses(x, wide, sigma[k], half, work, across)
            for m in range(len(generators)):
                f = generators[m]
                normals[m] = (f[0, 0] * u + f[0, 1] * v) * dy - (f[1, 0] * u + f[1, 1] * v) * dx
            _add_node((top, bottom, left, right), (dx, dy), normals, sigma[k], (down, across), parts[k])
            for r in range(top, bottom):
                behind[r, right] -= down[1, r - top] * dy
        # Outside the reach of a node its integral is 1: add all nodes at once.
        for r in range(high):
            total = f32(0)
            for c in range(wide):
                total += behind[r, c]
                parts[k, 0, r, c] += total
