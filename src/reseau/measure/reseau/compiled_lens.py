"""Images of a plane behind a lens, compiled; see :mod:`reseau.measure.reseau.lens_mapping`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["distorted", "projected"]

Floats = NDArray[Any]


@compiled
def projected(source: Floats, matrix: Floats) -> tuple[Floats, Floats]:
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
    u, by_matrix = np.empty((len(source), 2)), np.zeros((len(source), 2, 8))
    for k in range(len(source)):
        point = source[k]
        depth = matrix[6] * point[0] + matrix[7] * point[1] + point[2]
        for i in range(2):
            along = matrix[3 * i] * point[0] + matrix[3 * i + 1] * point[1] + matrix[3 * i + 2] * point[2]
            u[k, i] = along / depth
            for j in range(3):
                by_matrix[k, i, 3 * i + j] = point[j] / depth
            for j in range(2):
                by_matrix[k, i, 6 + j] = -u[k, i] * point[j] / depth
    return u, by_matrix


@compiled
def distorted(u: Floats, by_others: Floats, x: Floats) -> tuple[Floats, Floats]:
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
    (count, _, others), a, p1, p2 = by_others.shape, 1.0 + x[5], x[6], x[7]
    images, by_all = np.empty((count, 2)), np.empty((count, 2, others + 8))
    scale, off, d, q = np.array([1.0, a]), np.empty(2), np.empty(2), np.empty(2)
    by_d, by_p, by_u = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for k in range(count):
        for i in range(2):
            off[i] = u[k, i] - x[3 + i]
            d[i] = off[i] * scale[i]
        r2 = d[0] * d[0] + d[1] * d[1]
        radial = r2 * (x[0] + r2 * (x[1] + r2 * x[2]))
        rate = 2 * (x[0] + r2 * (2 * x[1] + 3 * x[2] * r2))
        by_p[0, 0] = by_p[1, 1] = 2 * d[0] * d[1]
        by_p[0, 1], by_p[1, 0] = r2 + 2 * d[0] * d[0], r2 + 2 * d[1] * d[1]
        cross = 2 * (p1 * d[0] + p2 * d[1])
        by_d[0, 0] = radial + rate * d[0] * d[0] + 2 * p1 * d[1] + 6 * p2 * d[0]
        by_d[1, 1] = radial + rate * d[1] * d[1] + 6 * p1 * d[1] + 2 * p2 * d[0]
        by_d[0, 1] = by_d[1, 0] = rate * d[0] * d[1] + cross
        for i in range(2):
            q[i] = d[i] * radial + by_p[i, 0] * p1 + by_p[i, 1] * p2
            images[k, i] = u[k, i] + q[i] / scale[i]
            power = r2
            for j in range(3):
                by_all[k, i, others + j] = d[i] * power / scale[i]
                power *= r2
            for j in range(2):
                by_u[i, j] = by_d[i, j] * scale[j] / scale[i]
                by_all[k, i, others + 3 + j] = -by_u[i, j]
                by_all[k, i, others + 6 + j] = by_p[i, j] / scale[i]
            by_all[k, i, others + 5] = by_d[i, 1] * off[1] / scale[i]
        by_all[k, 1, others + 5] -= q[1] / (a * a)
        for i in range(2):
            for m in range(others):
                total = by_others[k, i, m]
                for j in range(2):
                    total += by_u[i, j] * by_others[k, j, m]
                by_all[k, i, m] = total
    return images, by_all
