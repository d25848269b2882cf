"""Image points and their derivatives from pose, point and camera: the compiled cameras.

This is the door through which a camera enters the adjustment: of every observation the misfit v (px), its
derivatives by the pose (rotation about the camera's axes, projection centre), by the parameters of the camera
and by the object point. Cameras are those of :mod:`reseau.optics`, written for one point.

With Brown's distortion on the *image* side the misfit is that of the corrected image point,
v = xs − (xm + Δ(xm)), as PhotoModeler and DBAT reckon; on the object side it is that of the measured one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...core.data import Array, Rows
from ...optics import PlaneMapping
from ...optics.poses import Pose, matrix_to_vector, project
from .compiled import compiled

__all__ = [
    "BROWN_IMAGE", "BROWN_OBJECT", "CAMERA_WIDTH", "EBNER", "MAPPING", "OPENCV", "Interior", "Orientation",
    "Seen", "derive", "mapped", "misfit",
]  # fmt: skip

BROWN_OBJECT, BROWN_IMAGE, OPENCV, MAPPING = 0, 1, 2, 3
# Greatest number of parameters of a camera, and of additional parameters.
CAMERA_WIDTH, EBNER = 12, 12


class Seen(NamedTuple):
    """Image observations in columns (n, …): rows of image, point, camera and additional set (−1 for none).

    `xy` in pixels; `root` (n, 2, 2) the lower triangle W with P = Wᵀ W.
    """

    image: Rows
    point: Rows
    camera: Rows
    extra: Rows
    xy: Array
    root: Array


class Orientation(NamedTuple):
    """Rotations (m, 3, 3), projection centres (m, 3) and object points (p, 3)."""

    rotation: Array
    x0: Array
    xyz: Array


class Interior(NamedTuple):
    """Cameras and sets of additional parameters in columns.

    `kind` (c,), `values` (c, 12 or more), `balance` (c, 3) with R0², R0⁴, R0⁶, `grid` (c, 4) with the centre
    (px) and the pitch (mm), `extra` (e, 12), `base` (e,) in mm.
    """

    kind: Rows
    values: Array
    balance: Array
    grid: Array
    extra: Array
    base: Array


@compiled
def _distortion(x: float, y: float, c: int, p: Array, balance: Array, slope: Array, d: Array) -> None:
    """Brown's Δ into d[:, 22], its derivatives by x, y into `slope`, by K1…B2 into d[:, 3:10]."""
    s = x * x + y * y
    q1, q2, q3 = s - balance[c, 0], s * s - balance[c, 1], s * s * s - balance[c, 2]
    radial = p[c, 3] * q1 + p[c, 4] * q2 + p[c, 5] * q3
    by_s = 2.0 * (p[c, 3] + s * (2.0 * p[c, 4] + 3.0 * p[c, 5] * s))
    xx, yy, xy = s + 2.0 * x * x, s + 2.0 * y * y, 2.0 * x * y
    d[0, 22] = x * radial + p[c, 6] * xx + p[c, 7] * xy + p[c, 8] * x + p[c, 9] * y
    d[1, 22] = y * radial + p[c, 7] * yy + p[c, 6] * xy
    cross = x * y * by_s + 2.0 * p[c, 6] * y + 2.0 * p[c, 7] * x
    slope[0, 0] = radial + x * x * by_s + 6.0 * p[c, 6] * x + 2.0 * p[c, 7] * y + p[c, 8]
    slope[0, 1] = cross + p[c, 9]
    slope[1, 0] = cross
    slope[1, 1] = radial + y * y * by_s + 6.0 * p[c, 7] * y + 2.0 * p[c, 6] * x
    d[0, 3], d[1, 3], d[0, 4], d[1, 4], d[0, 5], d[1, 5] = x * q1, y * q1, x * q2, y * q2, x * q3, y * q3
    d[0, 6], d[1, 6], d[0, 7], d[1, 7] = xx, xy, xy, yy
    d[0, 8], d[1, 8], d[0, 9], d[1, 9] = x, 0.0, y, 0.0


@compiled
def _ebner(x: float, y: float, e: int, b: Array, base: float, slope: Array, d: Array) -> None:
    """Ebner's Δ (1976) added to d[:, 22] and `slope`, its derivatives by b1…b12 into d[:, 10:22]."""
    k, m = 2.0 * base * base / 3.0, 4.0 * base * base / 3.0
    xk, yk = x * x - k, y * y - k
    d[:, 10:22] = 0.0
    d[0, 10], d[1, 10] = x, -y
    d[0, 11], d[1, 11] = y, x
    d[0, 12], d[1, 12] = m - 2.0 * x * x, x * y
    d[0, 13], d[1, 13] = x * y, m - 2.0 * y * y
    d[0, 14], d[1, 15] = yk, xk
    d[0, 16], d[1, 17] = x * yk, y * xk
    d[0, 18], d[1, 19] = y * xk, x * yk
    d[0, 20], d[1, 21] = xk * yk, xk * yk
    for i in range(12):
        d[0, 22] += b[e, i] * d[0, 10 + i]
        d[1, 22] += b[e, i] * d[1, 10 + i]
    slope[0, 0] += (
        b[e, 0]
        - 4.0 * b[e, 2] * x
        + b[e, 3] * y
        + b[e, 6] * yk
        + 2.0 * b[e, 8] * x * y
        + 2.0 * b[e, 10] * x * yk
    )
    slope[0, 1] += (
        b[e, 1]
        + b[e, 3] * x
        + 2.0 * b[e, 4] * y
        + 2.0 * b[e, 6] * x * y
        + b[e, 8] * xk
        + 2.0 * b[e, 10] * xk * y
    )
    slope[1, 0] += (
        b[e, 1]
        + b[e, 2] * y
        + 2.0 * b[e, 5] * x
        + 2.0 * b[e, 7] * x * y
        + b[e, 9] * yk
        + 2.0 * b[e, 11] * x * yk
    )
    slope[1, 1] += (
        -b[e, 0]
        + b[e, 2] * x
        - 4.0 * b[e, 3] * y
        + b[e, 7] * xk
        + 2.0 * b[e, 9] * x * y
        + 2.0 * b[e, 11] * xk * y
    )


@compiled
def _brown(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: Interior, by_uv: Array, slope: Array,
    d: Array,
) -> None:  # fmt: skip
    """Misfit into d[:, 22] (px), its derivatives by u, v into `by_uv`, by the parameters into d[:, :22]."""
    p, balance, grid = cameras.values, cameras.balance, cameras.grid
    kind, base = cameras.kind[c], cameras.base[e] if e >= 0 else 0.0
    f = p[c, 0]
    px, py = 1.0 / grid[c, 2], -1.0 / grid[c, 3]
    xp, yp = (xy[k, 0] - grid[c, 0]) * grid[c, 2], -(xy[k, 1] - grid[c, 1]) * grid[c, 3]
    if kind == 0:
        x, y, sign = f * u, -f * v, 1.0
    else:
        x, y, sign = xp - p[c, 1], yp - p[c, 2], -1.0
    _distortion(x, y, c, p, balance, slope, d)
    if base > 0.0:
        _ebner(x, y, e, cameras.extra, base, slope, d)
    sxx, sxy, syx, syy = 1.0 + slope[0, 0], slope[0, 1], slope[1, 0], 1.0 + slope[1, 1]
    if kind == 0:
        d[0, 22] += x + p[c, 1] - xp
        d[1, 22] += y + p[c, 2] - yp
        by_uv[0, 0], by_uv[0, 1], by_uv[1, 0], by_uv[1, 1] = f * sxx, -f * sxy, f * syx, -f * syy
        d[0, 0], d[1, 0] = sxx * u - sxy * v, syx * u - syy * v
        d[0, 1], d[1, 1], d[0, 2], d[1, 2] = 1.0, 0.0, 0.0, 1.0
    else:
        d[0, 22] = f * u - x - d[0, 22]
        d[1, 22] = -f * v - y - d[1, 22]
        by_uv[0, 0], by_uv[0, 1], by_uv[1, 0], by_uv[1, 1] = f, 0.0, 0.0, -f
        d[0, 0], d[1, 0] = u, -v
        d[0, 1], d[1, 1], d[0, 2], d[1, 2] = sxx, syx, sxy, syy
    last = 22 if base > 0.0 else 10
    for i in range(3, last):
        d[0, i] *= sign * px
        d[1, i] *= sign * py
    for i in range(3):
        d[0, i] *= px
        d[1, i] *= py
    d[0, 22] *= px
    d[1, 22] *= py
    by_uv[0, 0] *= px
    by_uv[0, 1] *= px
    by_uv[1, 0] *= py
    by_uv[1, 1] *= py


@compiled
def _opencv(k: int, c: int, u: float, v: float, xy: Array, p: Array, by_uv: Array, d: Array) -> None:
    """The same for OpenCV's camera."""
    s = u * u + v * v
    n = 1.0 + s * (p[c, 4] + s * (p[c, 5] + s * p[c, 8]))
    m = 1.0 + s * (p[c, 9] + s * (p[c, 10] + s * p[c, 11]))
    q = n / m
    by_s = (
        2.0
        * (
            p[c, 4]
            + s * (2.0 * p[c, 5] + 3.0 * s * p[c, 8])
            - q * (p[c, 9] + s * (2.0 * p[c, 10] + 3.0 * s * p[c, 11]))
        )
        / m
    )
    uu, vv, uv = s + 2.0 * u * u, s + 2.0 * v * v, 2.0 * u * v
    x = u * q + p[c, 6] * uv + p[c, 7] * uu
    y = v * q + p[c, 6] * vv + p[c, 7] * uv
    cross = u * v * by_s + 2.0 * p[c, 6] * u + 2.0 * p[c, 7] * v
    by_uv[0, 0] = p[c, 0] * (q + u * u * by_s + 2.0 * p[c, 6] * v + 6.0 * p[c, 7] * u)
    by_uv[0, 1] = p[c, 0] * cross
    by_uv[1, 0] = p[c, 1] * cross
    by_uv[1, 1] = p[c, 1] * (q + v * v * by_s + 6.0 * p[c, 6] * v + 2.0 * p[c, 7] * u)
    d[:, :12] = 0.0
    d[0, 0], d[1, 1], d[0, 2], d[1, 3] = x, y, 1.0, 1.0
    power = 1.0 / m
    for i, j in ((4, 9), (5, 10), (8, 11)):
        power *= s
        d[0, i], d[1, i] = p[c, 0] * u * power, p[c, 1] * v * power
        d[0, j], d[1, j] = -q * d[0, i], -q * d[1, i]
    d[0, 6], d[1, 6] = p[c, 0] * uv, p[c, 1] * vv
    d[0, 7], d[1, 7] = p[c, 0] * uu, p[c, 1] * uv
    d[0, 22] = p[c, 0] * x + p[c, 2] - xy[k, 0]
    d[1, 22] = p[c, 1] * y + p[c, 3] - xy[k, 1]


@compiled
def _image(
    k: int, seen: Seen, at: Orientation, cameras: Interior, x: Array, by_uv: Array, slope: Array, d: Array
) -> None:
    """Point in the system of the camera into `x`, misfit and derivatives of the camera into `d`, `by_uv`.

    Rows are never taken out of the arrays: each would count its references, on two processors at once.
    """
    i, j, c = seen.image[k], seen.point[k], seen.camera[k]
    dx, dy, dz = at.xyz[j, 0] - at.x0[i, 0], at.xyz[j, 1] - at.x0[i, 1], at.xyz[j, 2] - at.x0[i, 2]
    for q in range(3):
        x[q] = at.rotation[i, q, 0] * dx + at.rotation[i, q, 1] * dy + at.rotation[i, q, 2] * dz
    u, v = x[0] / x[2], x[1] / x[2]
    if cameras.kind[c] == OPENCV:
        _opencv(k, c, u, v, seen.xy, cameras.values, by_uv, d)
    else:
        _brown(k, c, seen.extra[k], u, v, seen.xy, cameras, by_uv, slope, d)


@compiled
def misfit(begin: int, end: int, seen: Seen, at: Orientation, cameras: Interior, out: Array) -> None:
    """Weighted misfits of the observations begin…end into `out` (n, 2)."""
    by_uv, slope, d, x = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 23)), np.empty(3)
    root = seen.root
    for k in range(begin, end):
        if cameras.kind[seen.camera[k]] == MAPPING:
            continue
        _image(k, seen, at, cameras, x, by_uv, slope, d)
        out[k, 0] = root[k, 0, 0] * d[0, 22]
        out[k, 1] = root[k, 1, 0] * d[0, 22] + root[k, 1, 1] * d[1, 22]


@compiled
def derive(
    begin: int, end: int, seen: Seen, at: Orientation, cameras: Interior, free: Rows, count: Rows,
    movable: Array, r_out: Array, a_out: Array, b_out: Array,
) -> None:  # fmt: skip
    """Weighted misfits (n, 2) and their derivatives.

    By the pose into a_out[:, :, :6], by the `count` (c,) parameters `free` (c, 12) of the camera behind it,
    by the additional ones in the last columns, by the point into b_out (n, 2, 3); `movable` (p, 3) is 0 for
    coordinates that are held and 1 for others.
    """
    by_uv, slope, d, x = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 23)), np.empty(3)
    g, width, root, turn = np.empty((2, 3)), a_out.shape[2], seen.root, at.rotation
    for k in range(begin, end):
        if cameras.kind[seen.camera[k]] == MAPPING:
            continue
        _image(k, seen, at, cameras, x, by_uv, slope, d)
        w0, w1, w2 = root[k, 0, 0], root[k, 1, 0], root[k, 1, 1]
        for q in range(2):
            g[0, q] = w0 * by_uv[0, q] / x[2]
            g[1, q] = (w1 * by_uv[0, q] + w2 * by_uv[1, q]) / x[2]
        i, j, c = seen.image[k], seen.point[k], seen.camera[k]
        r_out[k, 0] = w0 * d[0, 22]
        r_out[k, 1] = w1 * d[0, 22] + w2 * d[1, 22]
        for q in range(2):
            g[q, 2] = -(g[q, 0] * x[0] + g[q, 1] * x[1]) / x[2]
            a_out[k, q, 0] = g[q, 2] * x[1] - g[q, 1] * x[2]
            a_out[k, q, 1] = g[q, 0] * x[2] - g[q, 2] * x[0]
            a_out[k, q, 2] = g[q, 1] * x[0] - g[q, 0] * x[1]
            for s in range(3):
                along = g[q, 0] * turn[i, 0, s] + g[q, 1] * turn[i, 1, s] + g[q, 2] * turn[i, 2, s]
                a_out[k, q, 3 + s] = -along
                b_out[k, q, s] = along * movable[j, s]
        for s in range(count[c]):
            f = free[c, s]
            a_out[k, 0, 6 + s] = w0 * d[0, f]
            a_out[k, 1, 6 + s] = w1 * d[0, f] + w2 * d[1, f]
        if seen.extra[k] >= 0:
            for s in range(EBNER):
                a_out[k, 0, width - EBNER + s] = w0 * d[0, 10 + s]
                a_out[k, 1, width - EBNER + s] = w1 * d[0, 10 + s] + w2 * d[1, 10 + s]


def mapped(
    camera: PlaneMapping, at: Orientation, image: Rows, point: Rows
) -> tuple[Array, Array, Array, Array]:
    """Image points of any camera, with derivatives in NumPy: the same door for what is not compiled.

    Parameters
    ----------
    camera : PlaneMapping
        From ideal directions to pixels.
    at : Orientation
        Poses and points.
    image, point : ndarray of int (n,)
        Rows of them.

    Returns
    -------
    ndarray (n, 2), ndarray (n, 2, 6), ndarray (n, 2, u), ndarray (n, 2, 3)
        Pixels, and derivatives by the pose (rotation about the axes of the camera, projection centre), by the
        parameters of the camera, and by the point.
    """
    turn, x0, xyz = at.rotation[image], at.x0[image], at.xyz[point]
    seen = project(camera, Pose(matrix_to_vector(turn), x0), xyz)
    by_x = seen.d_point @ np.swapaxes(turn, 1, 2)
    x = np.einsum("nij,nj->ni", turn, xyz - x0)
    # g·(δ × x) = δ·(x × g)
    by_turn = np.cross(x[:, None, :], by_x)
    return seen.xy, np.concatenate([by_turn, -seen.d_point], axis=2), seen.d_camera, seen.d_point
