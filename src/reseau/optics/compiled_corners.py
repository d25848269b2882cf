"""Images of corners, compiled; see :mod:`reseau.optics.corners`."""

from __future__ import annotations

from math import exp, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.compiled import compiled
from .compiled import PER_SIGMA, normal_table

Floats = NDArray[Any]

_FAR = 5.5
"""Widths of the point-spread function beyond which an edge has no influence; 2e-8 of the light."""
_SHARPEST = 0.05
"""Width in pixels below which a point-spread function is none."""
_RULES = ((0.3, 4), (0.7, 6), (1.0, 10))
"""Numbers of nodes of the integral over the correlation, by its largest absolute value: errors below 2e-7."""
_NODE = np.zeros((len(_RULES), _RULES[-1][1]))
_WEIGHT = np.zeros_like(_NODE)
for _k, (_, _count) in enumerate(_RULES):
    _NODE[_k, :_count], _WEIGHT[_k, :_count] = np.polynomial.legendre.leggauss(_count)
_LIMIT, _COUNT = np.array([rule[0] for rule in _RULES]), np.array([rule[1] for rule in _RULES])
_TABLE = 8.0
"""End of the table of the normal distribution in standard deviations; 1e-15 of the light is outside."""
_STEP, _BELL = normal_table(_TABLE)
_NOTHING = 34.0
"""Square of a distance, in widths over 1 + |correlation|, beyond which densities are below 5e-8."""


@compiled
def _normal(z: float) -> tuple[float, float]:
    """Normal distribution and density, from a table with two more terms of the series; errors below 1e-9."""
    z = min(max(z, -_TABLE), _TABLE)
    i = np.uint32((z + _TABLE) * PER_SIGMA + 0.5)
    m = np.float64(i) * (1.0 / PER_SIGMA) - _TABLE
    d, bell = z - m, _BELL[i]
    step = _STEP[i] + bell * d * (1.0 - d * (0.5 * m - d * (m * m - 1.0) * (1 / 6)))
    return step, bell * (1.0 - d * (m - d * (0.5 * (m * m - 1.0) - d * m * (m * m - 3.0) * (1 / 6))))


@compiled
def _near_edge(z: float) -> tuple[float, float]:
    """Normal distribution and density; exactly 0 or 1, and 0, far from an edge, where most pixels are."""
    if abs(z) < _FAR:
        return _normal(z)
    return (1.0, 0.0) if z > 0 else (0.0, 0.0)


@compiled
def _rule(rho: float, at: Floats, inverse: Floats, weight: Floats) -> int:
    """Fill nodes of the integral of the density of two normal variables over their correlation."""
    kind = 0
    while abs(rho) > _LIMIT[kind]:
        kind += 1
    for k in range(_COUNT[kind]):
        r = 0.5 * rho * (1 + _NODE[kind, k])
        at[k], inverse[k] = r, 0.5 / (1 - r * r)
        weight[k] = _WEIGHT[kind, k] * 0.5 * rho / (2 * pi) / sqrt(1 - r * r)
    return int(_COUNT[kind])


@compiled
def _distances(
    x: Floats, x0: float, tx: float, ty: float, nx: float, ny: float, bend: float, scale: float, d: Floats
) -> None:
    """Fill the signed distances (c,) of the pixels of a row from a bent edge, in widths."""
    for j in range(len(d)):
        along = tx * (x[j] - x0) + ty
        d[j] = (nx * (x[j] - x0) + ny - bend * along * along) * scale


@compiled
def _fill_sectors(first: Floats, second: Floats, two: bool, row: Floats) -> None:
    """Fill the share (c,) of the light of the pixels of a row that are far from both edges."""
    if two:
        for j in range(len(row)):
            row[j] = 1.0 if (first[j] > 0) == (second[j] > 0) else 0.0
    else:
        for j in range(len(row)):
            row[j] = 1.0 if first[j] > 0 and second[j] > 0 else 0.0


@compiled
def _clear(needed: Floats, row: Floats) -> None:
    for j in range(len(row)):
        row[j] = row[j] if needed[j] else 0.0


@compiled
def formed(
    normal: Floats,
    bend: Floats,
    opposite: Floats,
    xy: Floats,
    sigma: Floats,
    form: Floats,
    columns: Floats,
    rows: Floats,
    fill: float,
    needed: Floats,
    images: Floats,
) -> None:
    """Fill images (k, 1, 6 or 8, r, c) of corners; see :func:`reseau.optics.corners.corner_images`."""
    derived, curved, every = images.shape[1] > 1, form.shape[1] > 2, len(needed) == 0
    box, fourth = fill**2 / 12, -(fill**4) / 120 / 24
    at, inverse, weight = np.empty(10), np.empty(10), np.empty(10)
    first, second = np.empty(images.shape[3]), np.empty(images.shape[3])
    for k in range(len(normal)):
        width = max(sigma[k], _SHARPEST)
        s = sqrt(width * width + box)
        c1, s1, c2, s2 = np.cos(form[k, 0]), np.sin(form[k, 0]), np.cos(form[k, 1]), np.sin(form[k, 1])
        bend1, bend2 = bend[k, 0], bend[k, 1]
        if curved:
            bend1, bend2 = bend1 + form[k, 2], bend2 + form[k, 3]
        n1x, n1y = c1 * normal[k, 0, 0] - s1 * normal[k, 0, 1], s1 * normal[k, 0, 0] + c1 * normal[k, 0, 1]
        n2x, n2y = c2 * normal[k, 1, 0] - s2 * normal[k, 1, 1], s2 * normal[k, 1, 0] + c2 * normal[k, 1, 1]
        rho = min(max(n1x * n2x + n1y * n2y, -0.999), 0.999)
        free = 1 / sqrt(1 - rho * rho)
        nodes, nothing = _rule(rho, at, inverse, weight), _NOTHING * (1 + abs(rho))
        # A normal turned by 90°: both the tangent of its edge and the derivative by its turn.
        t1x, t1y, t2x, t2y = -n1y, n1x, -n2y, n2x
        by_turn1, by_turn2 = t1x * n2x + t1y * n2y, t2x * n1x + t2y * n1y
        sharp1, sharp2 = fourth * (n1x**4 + n1y**4) / s**4, fourth * (n2x**4 + n2y**4) / s**4
        two = opposite[k]
        for i in range(images.shape[2]):
            y = rows[k, i] - xy[k, 1]
            # Most pixels are far from both edges: what they have in common is done for a whole row at once.
            _distances(columns[k], xy[k, 0], t1x, t1y * y, n1x, n1y * y, 0.5 * bend1, 1 / s, first)
            _distances(columns[k], xy[k, 0], t2x, t2y * y, n2x, n2y * y, 0.5 * bend2, 1 / s, second)
            _fill_sectors(first, second, two, images[k, 0, i])
            for p in range(1, images.shape[1]):
                images[k, p, i] = 0.0
            if not every:
                _clear(needed[k, i], images[k, 0, i])
            for j in range(images.shape[3]):
                a, b = first[j], second[j]
                near1, near2 = abs(a) < _FAR, abs(b) < _FAR
                if not (near1 or near2) or not (every or needed[k, i, j]):
                    continue
                x = columns[k, j] - xy[k, 0]
                along1, along2 = t1x * x + t1y * y, t2x * x + t2y * y
                pa, bell_a = _near_edge(a)
                pb, bell_b = _near_edge(b)
                share = pa * pb + (1 - pa) * (1 - pb) if two else pa * pb
                by_rho = 0.0
                if near1 and near2 and a * a + b * b < nothing:
                    added, squares, product = 0.0, a * a + b * b, 2 * a * b
                    for m in range(nodes):
                        added += weight[m] * exp(-(squares - at[m] * product) * inverse[m])
                    share += 2 * added if two else added
                    by_rho = exp(-0.5 * (a * a - 2 * rho * a * b + b * b) * free * free) * free / (2 * pi)
                    if two:
                        by_rho *= 2
                by_a, by_b = 0.0, 0.0
                if near1:
                    side, bell = _near_edge((b - rho * a) * free)[0], bell_a
                    beside = 2 * side - 1 if two else side
                    by_a = bell * beside
                    share += sharp1 * (3 * a - a * a * a) * bell * beside
                if near2:
                    side, bell = _near_edge((a - rho * b) * free)[0], bell_b
                    beside = 2 * side - 1 if two else side
                    by_b = bell * beside
                    share += sharp2 * (3 * b - b * b * b) * bell * beside
                images[k, 0, i, j] = share
                if not derived:
                    continue
                slope1, slope2 = bend1 * along1, bend2 * along2
                images[k, 1, i, j] = -(by_a * (n1x - slope1 * t1x) + by_b * (n2x - slope2 * t2x)) / s
                images[k, 2, i, j] = -(by_a * (n1y - slope1 * t1y) + by_b * (n2y - slope2 * t2y)) / s
                images[k, 3, i, j] = -(a * by_a + b * by_b) * width / (s * s)
                # A tangent turned by 90° is the negative normal.
                images[k, 4, i, j] = by_a * along1 * (1 + bend1 * a * s) / s + by_rho * by_turn1
                images[k, 5, i, j] = by_b * along2 * (1 + bend2 * b * s) / s + by_rho * by_turn2
                if curved:
                    images[k, 6, i, j] = -0.5 * by_a * along1 * along1 / s
                    images[k, 7, i, j] = -0.5 * by_b * along2 * along2 / s


@compiled
def six_formed(
    normal: Floats,
    bend: Floats,
    xy: Floats,
    sigma: Floats,
    form: Floats,
    columns: Floats,
    rows: Floats,
    fill: float,
    needed: Floats,
    images: Floats,
) -> None:
    """Fill images (k, 7 or 10, r, c) of corners of three edges; see :mod:`reseau.optics.corners`."""
    derived, curved, every = images.shape[1] > 1, form.shape[1] > 3, len(needed) == 0
    box, fourth = fill**2 / 12, -(fill**4) / 120 / 24
    images[:] = 0.0
    for k in range(len(normal)):
        for i in range(images.shape[2]):
            for j in range(images.shape[3]):
                if every or needed[k, i, j]:
                    images[k, 0, i, j] = -1.0
        width = max(sigma[k], _SHARPEST)
        s = sqrt(width * width + box)
        for e in range(3):
            c, t = np.cos(form[k, e]), np.sin(form[k, e])
            nx, ny = c * normal[k, e, 0] - t * normal[k, e, 1], t * normal[k, e, 0] + c * normal[k, e, 1]
            bent = bend[k, e] + (form[k, 3 + e] if curved else 0.0)
            tx, ty = -ny, nx
            sharp = fourth * (nx**4 + ny**4) / s**4
            for i in range(images.shape[2]):
                y = rows[k, i] - xy[k, 1]
                for j in range(images.shape[3]):
                    if not (every or needed[k, i, j]):
                        continue
                    x = columns[k, j] - xy[k, 0]
                    along = tx * x + ty * y
                    a = (nx * x + ny * y - 0.5 * bent * along * along) / s
                    if abs(a) >= _FAR:
                        images[k, 0, i, j] += 1.0 if a > 0 else 0.0
                        continue
                    step, bell = _normal(a)
                    images[k, 0, i, j] += step + sharp * (3 * a - a * a * a) * bell
                    if not derived:
                        continue
                    slope = bent * along
                    images[k, 1, i, j] -= bell * (nx - slope * tx) / s
                    images[k, 2, i, j] -= bell * (ny - slope * ty) / s
                    images[k, 3, i, j] -= a * bell * width / (s * s)
                    images[k, 4 + e, i, j] = bell * along * (1 + bent * a * s) / s
                    if curved:
                        images[k, 7 + e, i, j] = -0.5 * bell * along * along / s
