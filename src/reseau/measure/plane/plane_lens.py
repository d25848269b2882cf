"""Images of a plane behind a lens; see :mod:`reseau.measure.plane.lens_mapping`."""

from __future__ import annotations

import numpy as np

from ...core.data import Array


def projected(source: Array, matrix: Array) -> tuple[Array, Array]:
    """Images of points by a projectivity, and their derivatives by its elements.

    Parameters
    ----------
    source : ndarray (n, 3)
        Points in homogeneous coordinates.
    matrix : ndarray (8,)
        Elements of the projectivity; the ninth is 1.

    Returns
    -------
    u : ndarray (n, 2)
    by_matrix : ndarray (n, 2, 8)
    """
    rows = np.append(matrix, 1.0).reshape(3, 3)
    image = source @ rows.T
    depth = image[:, 2:]
    u, by_matrix = image[:, :2] / depth, np.zeros((len(source), 2, 8))
    by_matrix[:, 0, :3] = by_matrix[:, 1, 3:6] = source / depth
    by_matrix[:, :, 6:] = -u[:, :, None] * by_matrix[:, :1, :2]
    return u, by_matrix


def distorted(u: Array, by_others: Array, x: Array) -> tuple[Array, Array]:
    """Distorted images of points, and their derivatives.

    Parameters
    ----------
    u : ndarray (n, 2)
        Points without distortion.
    by_others : ndarray (n, 2, m)
        Their derivatives by other parameters.
    x : ndarray (8,)
        k1, k2, k3, both coordinates of the centre, the ratio of the scales less 1, p1 and p2.

    Returns
    -------
    images : ndarray (n, 2)
    by_all : ndarray (n, 2, m + 8)
        Derivatives by the other parameters, and by those of the distortion.
    """
    (k1, k2, k3), p, scale = x[:3], x[6:], np.array([1.0, 1.0 + x[5]])
    off = u - x[3:5]
    d = off * scale
    r2 = (d * d).sum(axis=1)[:, None]
    radial, rate = r2 * (k1 + r2 * (k2 + r2 * k3)), 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    outer = d[:, :, None] * d[:, None]
    by_p = 2 * outer[:, :, ::-1]
    by_p[:, 0, 1] = r2[:, 0] + 2 * outer[:, 0, 0]
    by_p[:, 1, 0] = r2[:, 0] + 2 * outer[:, 1, 1]
    by_p[:, 0, 0] = by_p[:, 1, 1] = 2 * outer[:, 0, 1]
    cross = 2 * d @ p
    by_d = rate[:, :, None] * outer
    by_d[:, 0, 0] += radial[:, 0] + 2 * p[0] * d[:, 1] + 6 * p[1] * d[:, 0]
    by_d[:, 1, 1] += radial[:, 0] + 6 * p[0] * d[:, 1] + 2 * p[1] * d[:, 0]
    by_d[:, 0, 1] += cross
    by_d[:, 1, 0] += cross
    q = d * radial + by_p @ p
    by_u = by_d * scale / scale[:, None]
    by_radial = (d / scale)[:, :, None] * r2[:, :, None] ** np.arange(1, 4)
    by_ratio = by_d[:, :, 1] * off[:, 1:] / scale
    by_ratio[:, 1] -= q[:, 1] / scale[1] ** 2
    own = by_others + by_u @ by_others
    return u + q / scale, np.concatenate(
        [own, by_radial, -by_u, by_ratio[:, :, None], by_p / scale[:, None]], axis=2
    )


def moving(u: Array, row: Array, motion: Array) -> tuple[Array, Array, Array]:
    """Images of points of a plane that moves while the rows of an image are read one by one.

    Parameters
    ----------
    u : ndarray (n, 2)
        Images while the middle row is read, without distortion.
    row : ndarray (n,)
        Rows in which the points are seen, from the middle one.
    motion : ndarray (8,)
        Change of the projectivity with the row v: u becomes (u + v (A u + b)) / (1 + v c · u); the elements
        of A, b and c in this order.

    Returns
    -------
    images : ndarray (n, 2)
    by_u : ndarray (n, 2, 2)
        Their derivatives in a row.
    by_motion : ndarray (n, 2, 8)
    """
    a, c, one = motion[:4].reshape(2, 2), motion[6:], np.eye(2)
    depth = (1 + row * (u @ c))[:, None, None]
    moved = (u + row[:, None] * (u @ a.T + motion[4:6])) / depth[..., 0]
    by_motion = np.zeros((len(u), 2, 8))
    by_motion[:, 0, :2] = by_motion[:, 1, 2:4] = u
    by_motion[:, :, 4:6] = one
    by_motion[:, :, 6:] = -moved[:, :, None] * u[:, None]
    by_motion *= row[:, None, None] / depth
    by_u = (one + row[:, None, None] * (a - moved[:, :, None] * c)) / depth
    return moved, by_u, by_motion
