"""Approximate pose of an image with parallel rays, and what such an image does not determine."""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Mask, Rows
from .spatial import Resection

# Points are in a plane where their extent across it is this part of the largest.
_FLAT = 1e-4
# Distance of the camera from the points, in their largest extent: any would do.
_AWAY = 3.0
# Subsets of four points that are tried, and points that are consistent with the best one at least.
_TRIES, _LEAST = 200, 4


def resect_parallel(xyz: Array, uv: Array, tolerance: float) -> Resection | None:
    """Compute the pose of an image with parallel rays from the largest consistent set of points.

    An affine mapping of the points to the image is fitted; the nearest scaled orthographic projection has the
    rotation (Huang & Lee 1989). The scale is not used: the magnification may be known roughly only. Points in
    a plane leave two rotations, mirrored at the image plane, that no single image tells apart; one is
    returned. The distance along the axis is not determined; it is three times the extent of the points.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Object points.
    uv : ndarray (k, 2)
        xc, yc of their rays.
    tolerance : float
        Largest misfit of a consistent point, in the extent of the image points.

    Returns
    -------
    Resection or None
        None where fewer than four points are consistent.

    Examples
    --------
    >>> xyz = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
    >>> found = resect_parallel(xyz, xyz[:, 1::-1] * [1, -1], 0.01)
    >>> found.rotation.round(6) + 0.0
    array([[ 0.,  1.,  0.],
           [-1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    size = float(np.ptp(uv, axis=0).max()) or 1.0
    agree = _consistent(xyz, uv, tolerance * size)
    if agree is None:
        return None
    centre, middle = xyz[agree].mean(axis=0), uv[agree].mean(axis=0)
    _, extent, axes = np.linalg.svd(xyz[agree] - centre)
    flat = extent[2] <= _FLAT * extent[0]
    if extent[1] <= _FLAT * extent[0]:
        return None
    used = axes[:2] if flat else axes
    affine = np.linalg.lstsq((xyz[agree] - centre) @ used.T, uv[agree] - middle, rcond=None)[0].T
    if flat:
        # U diag(1, cos τ) Vᵀ of a plane tilted by τ; across it, sin τ of one sign or the other.
        u, s, vt = np.linalg.svd(affine)
        tilt = u @ np.array([0.0, np.sqrt(max(0.0, 1.0 - (s[1] / s[0]) ** 2))])
        two = np.column_stack([u @ np.diag([1.0, s[1] / s[0]]) @ vt, tilt]) @ axes
    else:
        u, _, vt = np.linalg.svd(affine, full_matrices=False)
        two = (u @ vt) @ axes
    rotation = np.vstack([two, np.cross(two[0], two[1])])
    x0 = centre - rotation.T @ [*middle, _AWAY * max(float(np.ptp(xyz, axis=0).max()), size)]
    return Resection(rotation, x0, agree)


def _consistent(xyz: Array, uv: Array, limit: float) -> Mask | None:
    """Points (k,) that agree with the affine mapping of most of them."""
    design = np.column_stack([xyz - xyz.mean(axis=0), np.ones(len(xyz))])

    def fits(rows: Rows | Mask) -> Mask:
        mapping = np.linalg.lstsq(design[rows], uv[rows], rcond=1e-9)[0]
        return np.asarray(np.linalg.norm(design @ mapping - uv, axis=1) < limit)

    best = fits(np.ones(len(xyz), dtype=bool))
    if not best.all():
        rng = np.random.default_rng(0)
        for _ in range(_TRIES):
            agree = fits(rng.choice(len(xyz), min(5, len(xyz)), replace=False))
            if agree.sum() > best.sum():
                best = agree
    if best.sum() < _LEAST:
        return None
    again = fits(best)
    return again if again.sum() >= _LEAST else None
