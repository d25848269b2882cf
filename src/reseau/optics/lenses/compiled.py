"""Sequential tracing of rays, compiled.

Rays are processed in blocks that stay in the cache, surface by surface, in loops without branches, so that
the compiler turns each of them into instructions for several rays at once. A ray that is lost keeps finite
values; a code says why and where.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled
from .prescription import COEFFICIENTS

Numbers = NDArray[np.float64]

_BLOCK = 256
_MOST = 30
"""Largest number of Newton steps towards an asphere."""
_NEAR = 1e-8
"""Newton's method ends with steps of all rays below this, relative to their distance from the vertex: what is
left is the square of it."""

# Products and sums may be one instruction; sums are not reordered: results do not depend on the block.
_FREE = frozenset({"contract", "nsz"})


@compiled(fastmath=_FREE)
def _turn(turn: Numbers, rays: Numbers) -> None:
    """Turn rays by a rotation (9,)."""
    a, b, c, d, e, f, g, h, k = turn
    for first in (0, 3):
        for i in range(rays.shape[1]):
            u, v, w = rays[first, i], rays[first + 1, i], rays[first + 2, i]
            rays[first, i] = a * u + b * v + c * w
            rays[first + 1, i] = d * u + e * v + f * w
            rays[first + 2, i] = g * u + h * v + k * w


@compiled(fastmath=_FREE)
def _to_plane(shift: Numbers, rays: Numbers, lost: Numbers, code: float) -> None:
    """Shift rays, and follow them to the plane z = 0."""
    right, up, along = shift[0], shift[1], shift[2]
    for i in range(rays.shape[1]):
        none = abs(rays[5, i]) < 1e-12
        t = -(rays[2, i] + along) / (1.0 if none else rays[5, i])
        rays[0, i] += right + rays[3, i] * t
        rays[1, i] += up + rays[4, i] * t
        rays[2, i] = 0.0
        lost[i] = code if none & (lost[i] == 0) else lost[i]


@compiled(fastmath=_FREE)
def _to_conic(shift: Numbers, c: float, k: float, rays: Numbers, lost: Numbers, code: float) -> None:
    """Shift rays, and follow them to a conic (Welford 1986, section 4.5, for any direction).

    From the point of the ray nearest to the vertex: it is found without a division, and distances from there
    are small.
    """
    branch = c * (1.0 + k) if k < -1.0 else 0.0
    k1, right, up, along = 1.0 + k, shift[0], shift[1], shift[2]
    for i in range(rays.shape[1]):
        x, y, z = rays[0, i] + right, rays[1, i] + up, rays[2, i] + along
        l, m, n = rays[3, i], rays[4, i], rays[5, i]  # noqa: E741
        t = -(x * l + y * m + z * n)
        x, y, z = x + t * l, y + t * m, z + t * n
        f = c * (x * x + y * y + k1 * z * z) - 2.0 * z
        g = n - c * (x * l + y * m + k1 * z * n)
        square = g * g - c * f * (1.0 + k * n * n)
        root = np.sqrt(square if square > 0.0 else 0.0)
        below = g + (root if n >= 0.0 else -root)
        t = f / (below if below != 0.0 else 1.0)
        rays[0, i], rays[1, i], z = x + t * l, y + t * m, z + t * n
        rays[2, i] = z
        # Behind the second branch of a hyperboloid there is nothing.
        missed = (square < 0.0) | (below == 0.0) | (branch * z > 1.0)
        lost[i] = code if missed & (lost[i] == 0) else lost[i]


@compiled(fastmath=_FREE)
def _slope(surface: Numbers, square: float) -> float:
    """Derivative by r² of the sag of an asphere."""
    inside = 1.0 - (1.0 + surface[2]) * surface[1] * surface[1] * square
    a, b = 0.0, 0.0
    for j in range(COEFFICIENTS - 1, -1, -1):
        b = b * square + a
        a = a * square + surface[4 + j]
    root = np.sqrt(inside if inside > 1e-30 else 1e-30)
    slope: float = 0.5 * surface[1] / root + (b * square + 2.0 * a) * square
    return slope


@compiled(fastmath=_FREE)
def _to_asphere(surface: Numbers, rays: Numbers, lost: Numbers, code: float, bad: Numbers) -> None:
    """Rays from near an even asphere to it, by Newton's method; `bad` is memory for a block."""
    c, k1 = surface[1], 1.0 + surface[2]
    for _ in range(_MOST):
        for i in range(rays.shape[1]):
            square = rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i]
            inside = 1.0 - k1 * c * c * square
            root = np.sqrt(inside if inside > 1e-30 else 1e-30)
            # Horner's scheme for Σ a r^(2j) and its derivative; their number is constant, to be unrolled.
            a, b = 0.0, 0.0
            for j in range(COEFFICIENTS - 1, -1, -1):
                b = b * square + a
                a = a * square + surface[4 + j]
            both = c / (root * (1.0 + root))
            slope = 0.5 * both * (1.0 + root) + (b * square + 2.0 * a) * square
            miss = rays[2, i] - (both * root + a * square) * square
            t = -miss / (rays[5, i] - 2.0 * slope * (rays[3, i] * rays[0, i] + rays[4, i] * rays[1, i]))
            rays[0, i] += rays[3, i] * t
            rays[1, i] += rays[4, i] * t
            rays[2, i] += rays[5, i] * t
            # Also true where the step is no number.
            bad[i] = 0.0 if (inside > 0.0) & (t * t <= _NEAR * _NEAR * (square + 1.0)) else 1.0
        far = 0
        for i in range(rays.shape[1]):
            far += 1 if (bad[i] != 0.0) & (lost[i] == 0) else 0
        if far == 0:
            break
    for i in range(rays.shape[1]):
        lost[i] = code if (bad[i] != 0.0) & (lost[i] == 0) else lost[i]


@compiled(fastmath=_FREE)
def _bent(ratio: float, q: float, square: float) -> tuple[float, float]:
    """Return by how much of its normal a refracted ray differs, and what is under its root.

    By Snell's law, for a normal with the square of its length and its product q with the ray.
    """
    under = square * (1.0 - ratio * ratio) + ratio * ratio * q * q
    root = np.sqrt(under if under > 0.0 else 0.0)
    return (root if q >= 0.0 else -root) - ratio * q, under


@compiled(fastmath=_FREE)
def _bend_conic(c: float, k: float, ratio: float, rays: Numbers, lost: Numbers, code: float) -> None:
    """Refract rays at a conic; its normal (-c x, -c y, 1 - c (1 + k) z) has the length 1 on a sphere."""
    if k == 0.0:
        for i in range(rays.shape[1]):
            u, v, w = -c * rays[0, i], -c * rays[1, i], 1.0 - c * rays[2, i]
            step, under = _bent(ratio, rays[3, i] * u + rays[4, i] * v + rays[5, i] * w, 1.0)
            lost[i] = code if (under < 0.0) & (lost[i] == 0) else lost[i]
            rays[3, i] = ratio * rays[3, i] + step * u
            rays[4, i] = ratio * rays[4, i] + step * v
            rays[5, i] = ratio * rays[5, i] + step * w
        return
    for i in range(rays.shape[1]):
        u, v, w = -c * rays[0, i], -c * rays[1, i], 1.0 - c * (1.0 + k) * rays[2, i]
        square = u * u + v * v + w * w
        step, under = _bent(ratio, rays[3, i] * u + rays[4, i] * v + rays[5, i] * w, square)
        step /= square
        lost[i] = code if (under < 0.0) & (lost[i] == 0) else lost[i]
        rays[3, i] = ratio * rays[3, i] + step * u
        rays[4, i] = ratio * rays[4, i] + step * v
        rays[5, i] = ratio * rays[5, i] + step * w


@compiled(fastmath=_FREE)
def _mirror_conic(c: float, k: float, rays: Numbers) -> None:
    """Reflect rays at a conic."""
    for i in range(rays.shape[1]):
        u, v, w = -c * rays[0, i], -c * rays[1, i], 1.0 - c * (1.0 + k) * rays[2, i]
        step = -2.0 * (rays[3, i] * u + rays[4, i] * v + rays[5, i] * w) / (u * u + v * v + w * w)
        rays[3, i] += step * u
        rays[4, i] += step * v
        rays[5, i] += step * w


@compiled(fastmath=_FREE)
def _bend_asphere(
    surface: Numbers,
    ratio: float,
    mirror: bool,
    rays: Numbers,
    lost: Numbers,
    code: float,
) -> None:
    """Refract or reflect rays at an even asphere."""
    for i in range(rays.shape[1]):
        slope = -2.0 * _slope(surface, rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i])
        u, v = slope * rays[0, i], slope * rays[1, i]
        square = u * u + v * v + 1.0
        q = rays[3, i] * u + rays[4, i] * v + rays[5, i]
        step, under = _bent(ratio, q, square)
        step = (-2.0 * q if mirror else step) / square
        lost[i] = code if (under < 0.0) & (lost[i] == 0) else lost[i]
        rays[3, i] = ratio * rays[3, i] + step * u
        rays[4, i] = ratio * rays[4, i] + step * v
        rays[5, i] = ratio * rays[5, i] + step


@compiled(fastmath=_FREE)
def _stop_at(aperture: Numbers, corners: Numbers, rays: Numbers, lost: Numbers, code: float) -> None:
    """Mark rays that an aperture does not let pass; see :class:`reseau.optics.lenses.Aperture`."""
    shape, a, b, cx, cy, c, s, blocks = aperture[1:9]
    if shape == 0:
        for i in range(rays.shape[1]):
            u, v = rays[0, i] - cx, rays[1, i] - cy
            square = u * u + v * v
            inside = (square <= a * a) & (square >= b * b)
            lost[i] = code if (inside == (blocks != 0)) & (lost[i] == 0) else lost[i]
        return
    if shape == 1:
        for i in range(rays.shape[1]):
            u, v = rays[0, i] - cx, rays[1, i] - cy
            inside = (abs(c * u + s * v) <= a) & (abs(c * v - s * u) <= b)
            lost[i] = code if (inside == (blocks != 0)) & (lost[i] == 0) else lost[i]
        return
    first, last = int(aperture[9]), int(aperture[10])
    for i in range(rays.shape[1]):
        u, v, inside = rays[0, i] - cx, rays[1, i] - cy, False
        for j in range(first, last):
            k = j + 1 if j + 1 < last else first
            y0, y1 = corners[j, 1], corners[k, 1]
            if (y0 > v) != (y1 > v):
                x0, x1 = corners[j, 0], corners[k, 0]
                inside = inside != (u < x0 + (v - y0) * (x1 - x0) / (y1 - y0))
        lost[i] = code if (inside == (blocks != 0)) & (lost[i] == 0) else lost[i]


@compiled(fastmath=_FREE)
def _through(
    surfaces: Numbers,
    places: Numbers,
    apertures: Numbers,
    corners: Numbers,
    rays: Numbers,
    lost: Numbers,
    seen: Numbers,
    bad: Numbers,
) -> None:
    """Trace one block of rays (6, n) through all surfaces; see :func:`traced`."""
    at = 0
    for s in range(len(surfaces)):
        surface = surfaces[s]
        kind, c, k, ratio = surface[0], surface[1], surface[2], surface[4 + COEFFICIENTS]
        code = 4.0 * s + 1.0
        shift = places[s, :3]
        if places[s, 12] != 0:
            _turn(places[s, 3:12], rays)
        if c != 0:
            _to_conic(shift, c, k, rays, lost, code)
        else:
            _to_plane(shift, rays, lost, code)
        aspheric = surface[3] > 0
        if aspheric:
            _to_asphere(surface, rays, lost, code, bad)
        while at < len(apertures) and apertures[at, 0] == s:
            _stop_at(apertures[at], corners, rays, lost, code + 2.0)
            at += 1
        if aspheric and kind != 2:
            _bend_asphere(surface, 1.0 if kind == 1 else ratio, kind == 1, rays, lost, code + 1.0)
        elif kind == 1:
            _mirror_conic(c, k, rays)
        elif kind == 0 and ratio != 1.0:
            _bend_conic(c, k, ratio, rays, lost, code + 1.0)
        if len(seen):
            seen[s] = rays


@compiled(fastmath=_FREE)
def traced(
    surfaces: Numbers,
    places: Numbers,
    apertures: Numbers,
    corners: Numbers,
    points: Numbers,
    directions: Numbers,
    ends: Numbers,
    behind: Numbers,
    lost: NDArray[np.int64],
    seen: Numbers,
) -> None:
    """Trace rays through all surfaces.

    Parameters
    ----------
    surfaces : ndarray (s, 5 + COEFFICIENTS)
        Kind (0 refracting, 1 mirror, 2 plain), curvature, conic constant, number of coefficients, the
        coefficients, index in front divided by index behind.
    places : ndarray (s, 13)
        Shift and rotation from the axes of the surface before, and whether there is a rotation.
    apertures : ndarray (a, 11)
        Surface, shape, size (2), centre (2), cosine and sine of the turn, whether it blocks, first and last
        corner; in the order of the surfaces.
    corners : ndarray (c, 2)
        Corners of all polygons.
    points, directions : ndarray (n, 3)
        Rays in the axes of the lens. A ray that is not finite misses the first surface.
    ends, behind : ndarray (n, 3)
        Take points and directions of rays in the axes of the last surface; NaN for lost rays.
    lost : ndarray of int (n,)
        Takes 0, or 4 s + 1, 2 or 3 for rays that miss surface s, are totally reflected, or are stopped.
    seen : ndarray (s, 6, n) or (0, 6, n)
        Takes the rays behind each surface, in its axes.
    """
    total = len(points)
    block, gone, bad = np.empty((6, _BLOCK)), np.empty(_BLOCK), np.empty(_BLOCK)
    some = np.empty((len(seen), 6, _BLOCK))
    for first in range(0, total, _BLOCK):
        count = min(_BLOCK, total - first)
        gone[:] = 0.0
        for k in range(3):
            for i in range(count):
                p, d = points[first + i, k], directions[first + i, k]
                finite = (p - p == 0.0) & (d - d == 0.0)
                block[k, i], block[3 + k, i] = (p, d) if finite else (0.0, 0.0)
                gone[i] = gone[i] if finite else 1.0
            # The rest of the last block repeats its first ray.
            block[k, count:], block[3 + k, count:] = block[k, 0], block[3 + k, 0]
        gone[count:] = 1.0
        _through(surfaces, places, apertures, corners, block, gone, some, bad)
        for i in range(count):
            lost[first + i] = np.int64(gone[i])
        for k in range(3):
            for i in range(count):
                ends[first + i, k] = block[k, i] if gone[i] == 0.0 else np.nan
                behind[first + i, k] = block[3 + k, i] if gone[i] == 0.0 else np.nan
        if len(seen):
            seen[:, :, first : first + count] = some[:, :, :count]
