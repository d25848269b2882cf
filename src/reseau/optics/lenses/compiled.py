"""Sequential tracing of rays, compiled.

Rays are processed in blocks that stay in the cache, surface by surface, in loops without branches, so that
the compiler turns each of them into instructions for several rays at once. A ray that is lost keeps finite
values; a code says why and where.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["COEFFICIENTS", "traced"]

F = TypeVar("F", bound=Callable[..., Any])
Numbers = NDArray[np.float64]

COEFFICIENTS = 10
"""Largest number of coefficients of an asphere."""
_BLOCK = 256
_MOST = 30
"""Largest number of Newton steps towards an asphere."""
_EXACT = 1e-13
"""Newton's method ends with steps of all rays below this, relative to their distance from the vertex."""

# No NaN occurs; sums are not reordered, so that results do not depend on the block.
_FREE = {"nnan", "ninf", "nsz"}


def _compiled(function: F) -> F:
    """Compile with Numba, cached on disk, releasing the GIL."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": _FREE}
    return cast(F, numba.njit(**options)(function))


@_compiled
def _into(place: Numbers, rays: Numbers) -> None:
    """Rays in the axes of a surface; `place` holds shift (3), rotation (9) and whether there is one."""
    if place[12] == 0:
        for i in range(rays.shape[1]):
            rays[0, i] += place[0]
            rays[1, i] += place[1]
            rays[2, i] += place[2]
        return
    a, b, c, d, e, f, g, h, k = place[3:12]
    for i in range(rays.shape[1]):
        u, v, w = rays[0, i], rays[1, i], rays[2, i]
        rays[0, i] = a * u + b * v + c * w + place[0]
        rays[1, i] = d * u + e * v + f * w + place[1]
        rays[2, i] = g * u + h * v + k * w + place[2]
    for i in range(rays.shape[1]):
        u, v, w = rays[3, i], rays[4, i], rays[5, i]
        rays[3, i] = a * u + b * v + c * w
        rays[4, i] = d * u + e * v + f * w
        rays[5, i] = g * u + h * v + k * w


@_compiled
def _to_plane(rays: Numbers, lost: Numbers, code: float) -> None:
    """Rays to the plane z = 0."""
    for i in range(rays.shape[1]):
        none = abs(rays[5, i]) < 1e-12
        t = -rays[2, i] / (1.0 if none else rays[5, i])
        rays[0, i] += rays[3, i] * t
        rays[1, i] += rays[4, i] * t
        rays[2, i] = 0.0
        lost[i] = code if (none and lost[i] == 0) else lost[i]


@_compiled
def _to_conic(curvature: float, conic: float, rays: Numbers, lost: Numbers, code: float) -> None:
    """Rays from the plane z = 0 to a conic (Welford 1986, equation 4.32, for any direction)."""
    c, k = curvature, conic
    for i in range(rays.shape[1]):
        f = c * (rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i])
        g = rays[5, i] - c * (rays[3, i] * rays[0, i] + rays[4, i] * rays[1, i])
        root = g * g - c * f * (1.0 + k * rays[5, i] * rays[5, i])
        lost[i] = code if (root < 0.0 and lost[i] == 0) else lost[i]
        root = np.sqrt(max(root, 0.0))
        t = f / (g + (root if rays[5, i] >= 0 else -root))
        rays[0, i] += rays[3, i] * t
        rays[1, i] += rays[4, i] * t
        rays[2, i] = rays[5, i] * t


@_compiled
def _profile(surface: Numbers, square: float) -> tuple[float, float, float]:
    """Sag of an asphere, its derivative by r², and whether it exists there."""
    c, k = surface[1], surface[2]
    inside = 1.0 - (1.0 + k) * c * c * square
    root = np.sqrt(max(inside, 1e-30))
    sag = c * square / (1.0 + root)
    slope = 0.5 * c / root
    a, b = 0.0, 0.0
    for j in range(int(surface[3]) - 1, -1, -1):
        # Horner's scheme for Σ a r^(2j) and its derivative.
        b = b * square + a
        a = a * square + surface[4 + j]
    return sag + a * square * square, slope + b * square * square + 2.0 * a * square, inside


@_compiled
def _to_asphere(surface: Numbers, rays: Numbers, lost: Numbers, code: float) -> None:
    """Rays from near an even asphere to it, by Newton's method."""
    for _ in range(_MOST):
        far = 0
        for i in range(rays.shape[1]):
            square = rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i]
            sag, slope, inside = _profile(surface, square)
            miss = rays[2, i] - sag
            t = -miss / (rays[5, i] - 2.0 * slope * (rays[3, i] * rays[0, i] + rays[4, i] * rays[1, i]))
            rays[0, i] += rays[3, i] * t
            rays[1, i] += rays[4, i] * t
            rays[2, i] += rays[5, i] * t
            far += 1 if (t * t > _EXACT * _EXACT * (square + 1.0) and lost[i] == 0) else 0
        if far == 0:
            break
    for i in range(rays.shape[1]):
        square = rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i]
        sag, slope, inside = _profile(surface, square)
        missed = inside <= 0.0 or abs(rays[2, i] - sag) > 1e-9 * (1.0 + abs(rays[2, i]))
        lost[i] = code if (missed and lost[i] == 0) else lost[i]


@_compiled
def _bend_conic(
    curvature: float,
    conic: float,
    ratio: float,
    rays: Numbers,
    lost: Numbers,
    code: float,
) -> None:
    """Refract rays at a conic, by the vector form of Snell's law; the normal points to +z."""
    c, k1 = curvature, 1.0 + conic
    for i in range(rays.shape[1]):
        u, v, w = -c * rays[0, i], -c * rays[1, i], 1.0 - c * k1 * rays[2, i]
        scale = 1.0 / np.sqrt(u * u + v * v + w * w)
        cosine = (rays[3, i] * u + rays[4, i] * v + rays[5, i] * w) * scale
        square = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        lost[i] = code if (square < 0.0 and lost[i] == 0) else lost[i]
        root = np.sqrt(max(square, 0.0))
        step = ((root if cosine >= 0 else -root) - ratio * cosine) * scale
        rays[3, i] = ratio * rays[3, i] + step * u
        rays[4, i] = ratio * rays[4, i] + step * v
        rays[5, i] = ratio * rays[5, i] + step * w


@_compiled
def _mirror_conic(
    curvature: float,
    conic: float,
    rays: Numbers,
) -> None:
    """Reflect rays at a conic."""
    c, k1 = curvature, 1.0 + conic
    for i in range(rays.shape[1]):
        u, v, w = -c * rays[0, i], -c * rays[1, i], 1.0 - c * k1 * rays[2, i]
        step = -2.0 * (rays[3, i] * u + rays[4, i] * v + rays[5, i] * w) / (u * u + v * v + w * w)
        rays[3, i] += step * u
        rays[4, i] += step * v
        rays[5, i] += step * w


@_compiled
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
        _, slope, _ = _profile(surface, rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i])
        u, v = -2.0 * slope * rays[0, i], -2.0 * slope * rays[1, i]
        scale = 1.0 / np.sqrt(u * u + v * v + 1.0)
        cosine = (rays[3, i] * u + rays[4, i] * v + rays[5, i]) * scale
        square = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        lost[i] = code if (square < 0.0 and lost[i] == 0) else lost[i]
        root = np.sqrt(max(square, 0.0))
        step = (-2.0 * cosine if mirror else (root if cosine >= 0 else -root) - ratio * cosine) * scale
        rays[3, i] = ratio * rays[3, i] + step * u
        rays[4, i] = ratio * rays[4, i] + step * v
        rays[5, i] = ratio * rays[5, i] + step


@_compiled
def _stop_at(aperture: Numbers, corners: Numbers, rays: Numbers, lost: Numbers, code: float) -> None:
    """Mark rays that an aperture does not let pass; see :class:`reseau.optics.lenses.Aperture`."""
    shape, a, b, cx, cy, c, s, blocks = aperture[1:9]
    if shape == 0:
        for i in range(rays.shape[1]):
            u, v = rays[0, i] - cx, rays[1, i] - cy
            square = u * u + v * v
            inside = square <= a * a and square >= b * b
            lost[i] = code if (inside == (blocks != 0) and lost[i] == 0) else lost[i]
        return
    if shape == 1:
        for i in range(rays.shape[1]):
            u, v = rays[0, i] - cx, rays[1, i] - cy
            inside = abs(c * u + s * v) <= a and abs(c * v - s * u) <= b
            lost[i] = code if (inside == (blocks != 0) and lost[i] == 0) else lost[i]
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
        lost[i] = code if (inside == (blocks != 0) and lost[i] == 0) else lost[i]


@_compiled
def _through(
    surfaces: Numbers,
    places: Numbers,
    apertures: Numbers,
    corners: Numbers,
    rays: Numbers,
    lost: Numbers,
    seen: Numbers,
) -> None:
    """Trace one block of rays (6, n) through all surfaces; see :func:`traced`."""
    at = 0
    for s in range(len(surfaces)):
        surface = surfaces[s]
        kind, c, k, ratio = surface[0], surface[1], surface[2], surface[4 + COEFFICIENTS]
        code = 4.0 * s + 1.0
        _into(places[s], rays)
        _to_plane(rays, lost, code)
        if c != 0:
            _to_conic(c, k, rays, lost, code)
        aspheric = surface[3] > 0
        if aspheric:
            _to_asphere(surface, rays, lost, code)
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


@_compiled
def traced(
    surfaces: Numbers,
    places: Numbers,
    apertures: Numbers,
    corners: Numbers,
    rays: Numbers,
    lost: Numbers,
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
    rays : ndarray (6, n)
        Positions and directions in the axes of the lens; afterwards in those of the last surface.
    lost : ndarray (n,)
        0; afterwards 4 s + 1, 2 or 3 for rays that miss surface s, are totally reflected, or are stopped.
    seen : ndarray (s, 6, n) or (0, 6, n)
        Takes the rays behind each surface, in its axes.
    """
    total = rays.shape[1]
    block, gone = np.empty((6, _BLOCK)), np.empty(_BLOCK)
    some = np.empty((len(seen), 6, _BLOCK))
    for first in range(0, total, _BLOCK):
        count = min(_BLOCK, total - first)
        block[:, :count] = rays[:, first : first + count]
        gone[:count] = lost[first : first + count]
        for i in range(count, _BLOCK):  # the rest of the last block repeats its first ray
            block[:, i] = block[:, 0]
            gone[i] = gone[0]
        _through(surfaces, places, apertures, corners, block, gone, some)
        rays[:, first : first + count] = block[:, :count]
        lost[first : first + count] = gone[:count]
        if len(seen):
            seen[:, :, first : first + count] = some[:, :, :count]
