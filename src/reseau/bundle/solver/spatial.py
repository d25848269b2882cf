"""Orientation of single images and pairs, and intersection of rays, as approximate values.

The minimal solvers (resection, five-point essential matrix) and the search for the largest set of consistent
points are those of OpenCV, applied to directions corrected for distortion.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from ...core.data import Array, Mask, Rows
from ...optics.poses import rotation_matrix
from ..network import Camera, Network

__all__ = ["Pair", "Resection", "directions", "intersect", "relative_orientation", "resect"]


class Resection(NamedTuple):
    """Pose of an image: rotation matrix, projection centre, and the points consistent with it (k,)."""

    rotation: Array
    x0: Array
    agree: Mask


class Pair(NamedTuple):
    """Relative orientation: the second image's rotation and centre in the system of the first, base 1."""

    rotation: Array
    x0: Array
    agree: Mask


def directions(network: Network) -> Array:
    """Compute ideal directions u = xc/zc, v = yc/zc (n, 2) of all image coordinates."""
    found = np.full((len(network.xy), 2), np.nan)
    camera = network.camera_of[network.image_of]
    for c, entry in enumerate(network.cameras):
        rows = camera == c
        if rows.any():
            found[rows] = _inverse(entry, network.xy[rows])
    return found


def _inverse(camera: Camera, xy: Array) -> Array:
    found = camera.bare_mapping().inverse(xy)
    if camera.registered is not None:
        # Where a roughly known distortion has no inverse, the direction without distortion is close enough.
        beyond = ~np.isfinite(found).all(axis=1)
        found[beyond] = camera.bare_mapping(distorted=False).inverse(xy[beyond])
    return found


def intersect(
    image: Rows, point: Rows, uv: Array, rotation: Array, x0: Array, points: int
) -> tuple[Array, Array]:
    """Compute the points nearest to all their rays, and the intersection angles of the rays.

    Parameters
    ----------
    image, point : ndarray of int (n,)
        Rays.
    uv : ndarray (n, 2)
        Ideal directions.
    rotation, x0 : ndarray (m, 3, 3), (m, 3)
        Poses.
    points : int
        Number of points p.

    Returns
    -------
    ndarray (p, 3), ndarray (p,)
        Points, NaN with fewer than two rays; intersection angles (rad), 0 for parallel rays.
    """
    ray = np.einsum("nji,nj->ni", rotation[image], np.column_stack([uv, np.ones(len(uv))]))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    begin = x0[image]
    centre = begin.mean(axis=0) if len(begin) else np.zeros(3)
    normal, side = np.zeros((points, 3, 3)), np.zeros((points, 3))
    np.add.at(normal, point, across)
    np.add.at(side, point, np.einsum("nij,nj->ni", across, begin - centre))
    count = np.bincount(point, minlength=points)
    # For two rays that intersect at an angle θ the smallest eigenvalue is 1 − cos θ.
    least = np.linalg.eigvalsh(normal)[:, 0]
    angle = np.where(count > 1, np.arccos(np.clip(1.0 - 2.0 * least / np.maximum(count, 2), -1.0, 1.0)), 0.0)
    good = (count > 1) & (least > 1e-12)
    xyz = np.full((points, 3), np.nan)
    xyz[good] = np.linalg.solve(normal[good], side[good][:, :, None])[:, :, 0] + centre
    return xyz, angle


def resect(xyz: Array, uv: Array, tolerance: float) -> Resection | None:
    """Compute the pose of an image from the largest consistent set of at least four points.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Object points.
    uv : ndarray (k, 2)
        Ideal directions.
    tolerance : float
        Largest misfit of the ideal direction of a consistent point.

    Returns
    -------
    Resection or None
        None where fewer than four points are consistent.
    """
    if len(xyz) < 4:
        return None
    centre = xyz.mean(axis=0)
    size = float(np.abs(xyz - centre).max()) or 1.0
    local = np.ascontiguousarray((xyz - centre) / size)
    image = np.ascontiguousarray(uv)
    try:
        best = _best_pose(local, image, tolerance)
    except cv2.error:
        return None
    if best is None:
        return None
    rotation, shift, agree = best
    return Resection(rotation, centre - size * rotation.T @ shift, agree)


def _best_pose(xyz: Array, uv: Array, tolerance: float) -> tuple[Array, Array, Mask] | None:
    eye, none = np.eye(3), np.zeros(0)
    agree = np.ones(len(xyz), dtype=bool)
    if len(xyz) > 4:
        found, _, _, inliers = cv2.solvePnPRansac(
            xyz, uv, eye, none, reprojectionError=tolerance, iterationsCount=500, confidence=0.9999,
            flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if found and inliers is not None and len(inliers) >= 4:
            agree = np.zeros(len(xyz), dtype=bool)
            agree[inliers.ravel()] = True
    count, vectors, shifts, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(xyz[agree]), np.ascontiguousarray(uv[agree]), eye, none, flags=cv2.SOLVEPNP_SQPNP
    )
    best = None
    for k in range(count):
        refined, shift = cv2.solvePnPRefineLM(
            np.ascontiguousarray(xyz[agree]),
            np.ascontiguousarray(uv[agree]),
            eye,
            none,
            vectors[k],
            shifts[k],
        )
        rotation = rotation_matrix(refined.ravel())
        x = xyz @ rotation.T + shift.ravel()
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.linalg.norm(x[:, :2] / x[:, 2:] - uv, axis=1)
        fits = (off < tolerance) & (x[:, 2] > 0)
        score = (int(fits.sum()), -float(np.median(off)))
        if best is None or score > best[0]:
            best = (score, rotation, shift.ravel(), fits)
    if best is None or best[0][0] < 4:
        return None
    return best[1], np.asarray(best[2], dtype=np.float64), best[3]


def relative_orientation(first: Array, second: Array, tolerance: float) -> Pair | None:
    """Compute the relative orientation of two images by the five-point algorithm (Nistér 2004).

    Parameters
    ----------
    first, second : ndarray (k, 2)
        Ideal directions of the same points.
    tolerance : float
        Largest distance of a consistent point from its epipolar line.
    """
    if len(first) < 6:
        return None
    a, b = np.ascontiguousarray(first), np.ascontiguousarray(second)
    try:
        essential, inliers = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.9999, tolerance, 1000)
        if essential is None or essential.shape != (3, 3):
            return None
        count, rotation, shift, agree = cv2.recoverPose(essential, a, b, np.eye(3), mask=inliers.copy())
    except cv2.error:
        return None
    if count < 6:
        return None
    x0 = -np.asarray(rotation.T @ shift, dtype=np.float64).ravel()
    return Pair(np.asarray(rotation, dtype=np.float64), x0, np.asarray(agree).ravel() > 0)
