"""Blurred targets behind apertures, drawn by counting rays: a tracer of its own, from sensor to object.

Every pixel sends rays from places spread over its area to places spread over the rear of the lens. Those
that pass all apertures see the target or the ground; each counts by the fourth power of the cosine, as light
of an even radiance does. Nothing is shared with the project: neither rays, nor indices, nor the formation of
images.

Axes of a lens: z along the light, millimetres, origin at the first vertex. The image is upside down.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["DOUBLE_GAUSS", "GLASSES", "TRIPLET", "WATER", "Design", "View", "drawn"]

Array = NDArray[Any]

GLASSES = {
    "N-SSK2": ((1.4306027, 0.153150554, 1.01390904), (0.00823982975, 0.0333736841, 106.870822)),
    "N-SK2": ((1.28189012, 0.257738258, 0.96818604), (0.0072719164, 0.0242823527, 110.377773)),
    "F5": ((1.3104463, 0.19603426, 0.96612977), (0.00958633048, 0.0457627627, 115.011883)),
    "N-SK16": ((1.34317774, 0.241144399, 0.994317969), (0.00704687339, 0.0229005, 92.7508526)),
    "F2": ((1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764)),
    "N-BK7": ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
}
"""B and C (µm²) as published by Schott."""
WATER = (
    (5.684027565e-1, 1.726177391e-1, 2.086189578e-2, 1.130748688e-1),
    (5.101829712e-3, 1.821153936e-2, 2.620722293e-2, 1.069792721e1),
)
"""Distilled water of 20 °C: A and C (µm²) of Daimon and Masumura (2007)."""


@dataclass(frozen=True)
class Design:
    """A lens: rows of curvature (1/mm), distance to the next surface (mm), medium behind, radius of its rim.

    `stop` is the row of the stop, whose rim limits the light on the axis; the last row is the last surface.
    """

    name: str
    rows: tuple[tuple[float, float, str, float], ...]
    stop: int
    focal_length: float
    half_diagonal: float


DOUBLE_GAUSS = Design(
    "double Gauss f/4.2",
    (
        (0.0889642047045771, 1.75, "N-SSK2", 5.62),
        (0.0328330026846278, 0.1, "", 5.36),
        (0.132687164733549, 2.5, "N-SK2", 4.78),
        (0.0, 0.76, "F5", 4.34),
        (0.206344643928504, 3.273888987305, "", 3.4),
        (0.0, 2.749591392778, "", 1.58305),
        (-0.176197132721454, 0.76, "F5", 2.96),
        (0.0, 2.2, "N-SK16", 3.44),
        (-0.131837541432885, 0.1, "", 3.8),
        (0.0281830247587427, 1.4, "N-SK16", 4.08),
        (-0.062963229295288, 12.720218435203, "", 4.16),
    ),
    5,
    20.0,
    7.5,
)
TRIPLET = Design(
    "triplet f/6",
    (
        (1 / 22.01359, 3.258956, "N-SK16", 7.0),
        (-1 / 435.7604, 6.007551, "", 7.0),
        (-1 / 22.21328, 0.9999746, "F2", 5.0),
        (1 / 20.29192, 0.75, "", 5.0),
        (0.0, 4.000409, "", 3.4),
        (1 / 79.6836, 2.952076, "N-SK16", 5.6),
        (-1 / 18.39533, 42.20778, "", 5.6),
    ),
    4,
    50.0,
    18.2,
)
"""Cooke's triplet of 50 mm, with its stop behind the second element."""


@dataclass(frozen=True)
class View:
    """A lens with its sensor, and what it looks through.

    Parameters
    ----------
    design : Design
    wavelengths, weights : tuple of float
        nm, and their share of the light.
    pitch : float
        mm; the axis pierces the sensor at the pixel (0, 0).
    defocus : float
        Place of the sensor behind that of far objects, mm.
    water : float, optional
        Distance of a window of 8 mm, with water behind it, from the first vertex, mm; by default air.
    """

    design: Design
    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]
    pitch: float
    defocus: float
    water: float | None = None

    @cached_property
    def rows(self) -> tuple[tuple[float, float, str, float], ...]:
        """All surfaces that light passes, without the image."""
        if self.water is None:
            return self.design.rows
        return ((0.0, 8.0, "N-BK7", np.inf), (0.0, self.water, "", np.inf), *self.design.rows)

    @property
    def stop(self) -> int:
        """Row of the stop."""
        return self.design.stop + len(self.rows) - len(self.design.rows)

    @cached_property
    def z(self) -> Array:
        """Vertices of all surfaces and of the image; that of the first one of the lens is 0."""
        along = np.concatenate([[0.0], np.cumsum([row[1] for row in self.rows])])
        along[-1] += self.defocus
        return np.asarray(along - along[len(self.rows) - len(self.design.rows)])

    def media(self, wavelength_nm: float) -> Array:
        """Indices in front of the first surface and behind each."""
        first = "" if self.water is None else "water"
        return np.array([_index(name, wavelength_nm) for name in (first, *(row[2] for row in self.rows))])

    def table(self, *, rims: bool = True) -> tuple[Array, Array, Array]:
        """Curvatures, vertices (one more) and radii of rims."""
        rim = np.array([row[3] for row in self.rows]) if rims else np.full(len(self.rows), np.inf)
        return np.array([row[0] for row in self.rows]), self.z, rim

    def principal_pixel(self, point: Array, wavelength_nm: float) -> Array:
        """Pixel of the ray from a point (3,) through the centre of the stop, by Newton's method there."""
        table, media = self.table(rims=False), self.media(wavelength_nm)

        def ends(slope: Array) -> tuple[Array, Array]:
            away = np.array([*slope, 1.0]) / np.sqrt(1 + slope @ slope)
            start = np.array([0.0, 0.0, self.z[self.stop]])
            found = []
            for side in (-1.0, 1.0):
                p, d = start.copy(), side * away
                if side < 0:
                    _backward(p, d, *table, media, self.stop - 1)
                else:
                    _forward(p, d, *table, media, self.stop + 1)
                z = point[2] if side < 0 else self.z[-1]
                found.append((p + (z - p[2]) / d[2] * d)[:2])
            return found[0] - point[:2], found[1]

        slope = np.zeros(2)
        for _ in range(30):
            miss, h = ends(slope)[0], 1e-7
            by = np.stack([(ends(slope + step)[0] - miss) / h for step in h * np.eye(2)], axis=1)
            slope = slope - np.linalg.solve(by, miss)
        return np.asarray(ends(slope)[1] * [-1, 1] / self.pitch)


def _index(medium: str, wavelength_nm: float) -> float:
    if not medium:
        return 1.0
    b, c = WATER if medium == "water" else GLASSES[medium]
    square = (wavelength_nm / 1000) ** 2
    return float(np.sqrt(1 + sum(x * square / (square - y) for x, y in zip(b, c, strict=True))))


@numba.njit(cache=True)
def _bent(p: Any, d: Any, c: float, z: float, ratio: float) -> bool:
    """Follow a ray to a sphere, and refract it."""
    depth = p[2] - z
    if c == 0.0:
        t = -depth / d[2]
    else:
        half = c * (p[0] * d[0] + p[1] * d[1] + depth * d[2]) - d[2]
        rest = c * (p[0] * p[0] + p[1] * p[1] + depth * depth) - 2 * depth
        root = half * half - c * rest
        if root < 0:
            return False
        t = rest / (-half + np.sqrt(root)) if d[2] > 0 else rest / (-half - np.sqrt(root))
    for k in range(3):
        p[k] += t * d[k]
    nx, ny, nz = -c * p[0], -c * p[1], 1 - c * (p[2] - z)
    cosine = d[0] * nx + d[1] * ny + d[2] * nz
    under = 1 - ratio * ratio * (1 - cosine * cosine)
    if under < 0:
        return False
    step = (np.sqrt(under) if cosine > 0 else -np.sqrt(under)) - ratio * cosine
    d[0], d[1], d[2] = ratio * d[0] + step * nx, ratio * d[1] + step * ny, ratio * d[2] + step * nz
    return True


@numba.njit(cache=True)
def _backward(p: Any, d: Any, bend: Any, z: Any, rim: Any, n: Any, first: int) -> bool:
    for k in range(first, -1, -1):
        if not _bent(p, d, bend[k], z[k], n[k + 1] / n[k]) or p[0] ** 2 + p[1] ** 2 > rim[k] ** 2:
            return False
    return True


@numba.njit(cache=True)
def _forward(p: Any, d: Any, bend: Any, z: Any, rim: Any, n: Any, first: int) -> bool:
    for k in range(first, len(bend)):
        if not _bent(p, d, bend[k], z[k], n[k] / n[k + 1]) or p[0] ** 2 + p[1] ** 2 > rim[k] ** 2:
            return False
    return True


@numba.njit(cache=True)
def _counted(
    columns: Any, rows: Any, pitch: float, table: Any, media: Any, weights: Any, box: Any, target: Any,
    count: int, begin: Any, out: Any,
) -> None:  # fmt: skip
    """Light (2, r, c) of the target and of all that a pixel sees."""
    bend, z, rim = table
    centre, axes, square = target
    last, step = len(bend) - 1, np.empty(4)
    # A sequence that fills the four dimensions evenly; its step is a root of x⁵ = x + 1.
    for k in range(4):
        step[k] = 1.1673039782614187 ** -(k + 1.0)
    normal = np.cross(axes[:, 0], axes[:, 1])
    p, d, u = np.empty(3), np.empty(3), np.empty(4)
    for r in range(len(rows)):
        for c in range(len(columns)):
            for w in range(len(weights)):
                for i in range(count):
                    for k in range(4):
                        u[k] = (begin[w, r, c, k] + i * step[k]) % 1.0
                    p[0], p[1] = -(columns[c] + u[0] - 0.5) * pitch, (rows[r] + u[1] - 0.5) * pitch
                    p[2] = z[last + 1]
                    d[0] = box[0] + u[2] * (box[1] - box[0]) - p[0]
                    d[1] = box[2] + u[3] * (box[3] - box[2]) - p[1]
                    d[2] = z[last] - p[2]
                    away2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
                    light = weights[w] * d[2] * d[2] / (away2 * away2)
                    for k in range(3):
                        d[k] /= np.sqrt(away2)
                    if not _backward(p, d, bend, z, rim, media[w], last):
                        continue
                    above, along, a, b = 0.0, 0.0, 0.0, 0.0
                    for k in range(3):
                        above, along = above + (p[k] - centre[k]) * normal[k], along + d[k] * normal[k]
                    for k in range(3):
                        off = p[k] - centre[k] - above / along * d[k]
                        a, b = a + off * axes[k, 0], b + off * axes[k, 1]
                    out[1, r, c] += light
                    if a * a + b * b <= square:
                        out[0, r, c] += light


@numba.njit(cache=True)
def _box(ends: Any, table: Any, media: Any, half: float) -> Any:
    """Range of places in the plane of the last vertex through which light comes to places (n, 2)."""
    bend, z, rim = table
    box, last = np.array([1e9, -1e9, 1e9, -1e9]), len(bend) - 1
    p, d = np.empty(3), np.empty(3)
    for w in range(len(media)):
        for x, y in ends:
            for i in range(101):
                for j in range(101):
                    u, v = half * (i / 50 - 1), half * (j / 50 - 1)
                    p[0], p[1], p[2] = x, y, z[last + 1]
                    d[0], d[1], d[2] = u - x, v - y, z[last] - z[last + 1]
                    d /= np.sqrt(d @ d)
                    if _backward(p, d, bend, z, rim, media[w], last):
                        box[0], box[1] = min(box[0], u), max(box[1], u)
                        box[2], box[3] = min(box[2], v), max(box[3], v)
    margin = half / 50
    return box + np.array([-margin, margin, -margin, margin])


def drawn(
    view: View, centre: Array, axes: Array, radius: float, columns: Array, rows: Array, count: int, seed: int
) -> tuple[Array, Array]:
    """Light (r, c) of a disk and of all that each pixel sees, the disk included.

    Parameters
    ----------
    centre, axes : ndarray (3,), (3, 2)
        Of the disk, in the axes of the lens, mm.
    columns, rows : ndarray
        Adjacent pixels from the axis.
    count : int
        Rays of each pixel and wavelength.
    """
    table, media = view.table(), np.stack([view.media(w) for w in view.wavelengths])
    half = 1.05 * view.rows[-1][3]
    x, y = (-columns[[0, -1]] * view.pitch, rows[[0, -1]] * view.pitch)
    ends = np.array([[a, b] for a in (*x, x.mean()) for b in (*y, y.mean())])
    box = _box(ends, table, media, half)
    begin = np.random.default_rng(seed).random((len(media), len(rows), len(columns), 4))
    out = np.zeros((2, len(rows), len(columns)))
    target = centre, np.ascontiguousarray(axes), radius**2
    weights = np.array(view.weights)
    _counted(columns, rows, view.pitch, table, media, weights, box, target, count, begin, out)
    area = (box[1] - box[0]) * (box[3] - box[2]) / count
    return out[0] * area, out[1] * area
