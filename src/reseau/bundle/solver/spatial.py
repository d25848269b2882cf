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
from ...optics.refraction import RefractedRays, Refraction
from ..network import Camera, Network

__all__ = [
    "Pair",
    "Resection",
    "behind_ports",
    "directions",
    "intersect",
    "relative_orientation",
    "resect",
    "resect_through",
]


# Distance of points that count as distant, in the largest dimension of a window.
_DISTANT = 1e4
# Newton steps to the direction behind a window, and the steps (tangents) at which it is found, and close.
_STEPS, _SHORT, _ROUGH = 20, 1e-9, 1e-3


# Rays closer than this (sine) to the plane across the middle of all rays are not used in a resection.
_GRAZING = 0.1
# Steps of a resection through windows, and its cost of a point that has no ray.
_POSE_STEPS, _MISSED = 60, 10.0


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


def directions(network: Network, wanted: Mask | None = None) -> Array:
    """Compute ideal directions u = xc/zc, v = yc/zc (n, 2) of image coordinates; NaN for those not wanted."""
    found = np.full((len(network.xy), 2), np.nan)
    for entry, own in zip(network.cameras, network.rays_of_cameras, strict=True):
        rows = own if wanted is None else own[wanted[own]]
        if len(rows):
            xy = network.xy[rows]
            if entry.shutter is not None and entry.shutter.mode == "line":
                xy = np.column_stack([xy[:, 0], np.full(len(xy), entry.shutter.row)])
            found[rows] = _inverse(entry, xy)
    return found


def _inverse(camera: Camera, xy: Array) -> Array:
    found = camera.bare_mapping().inverse(xy)
    if camera.registered is not None:
        # Where a roughly known distortion has no inverse, the direction without distortion is close enough.
        beyond = ~np.isfinite(found).all(axis=1)
        found[beyond] = camera.bare_mapping(distorted=False).inverse(xy[beyond])
    return found


def behind_ports(refraction: Refraction, uv: Array, image_of: Rows) -> Array:
    """Compute the directions of rays behind the windows on the camera.

    Parameters
    ----------
    refraction : Refraction
        Windows.
    uv : ndarray (n, 2)
        Ideal directions.
    image_of : ndarray of int (n,)
        Image of each ray.

    Returns
    -------
    ndarray (n, 2)
        Directions of distant points that are seen in the directions `uv`.
    """
    only = refraction.ports()
    rows = np.flatnonzero((only.path_of[image_of] >= 0) & np.isfinite(uv).all(axis=1))
    found = uv.copy()
    if not len(rows):
        return found
    values = np.abs(only.values[: only.starts[-1]])
    far = _DISTANT * float(values.max(initial=1.0))
    columns, image, every = only.columns(only.values), image_of[rows], np.arange(len(rows))
    poses = np.tile(np.eye(3), (len(only.path_of), 1, 1)), np.zeros((len(only.path_of), 3))
    out = uv[rows].copy()
    for _ in range(_STEPS):
        xyz = far * np.column_stack([out, np.ones(len(out))])
        rays = RefractedRays.of(columns, only.path_of, *poses, xyz, image, every, derivatives=True)
        step = np.linalg.solve(far * rays.by[:, :, 6:8], (uv[rows] - rays.uv)[:, :, None])[:, :, 0]
        out += np.clip(step, -0.5, 0.5)
        if np.abs(step).max() < _SHORT:
            break
    good = rays.reached & (np.abs(step).max(axis=1) < _ROUGH)
    found[rows[good]] = out[good]
    return found


def intersect(
    point: Rows, uv: Array, rotation: Array, x0: Array, points: int, parallel: Mask | None = None
) -> tuple[Array, Array]:
    """Compute the points nearest to all their rays, and the intersection angles of the rays.

    Parameters
    ----------
    point : ndarray of int (n,)
        Point of each ray.
    uv : ndarray (n, 2)
        Ideal directions.
    rotation, x0 : ndarray (n, 3, 3), (n, 3)
        Pose of the camera of each ray.
    points : int
        Number of points p.
    parallel : ndarray of bool (n,), optional
        Rays of cameras with parallel rays, whose `uv` are xc, yc.

    Returns
    -------
    ndarray (p, 3), ndarray (p,)
        Points, NaN with fewer than two rays; intersection angles (rad), 0 for parallel rays.
    """
    beside = np.zeros(len(uv), dtype=bool) if parallel is None else parallel
    uv3 = np.column_stack([uv, np.zeros(len(uv))])
    ray = np.where(beside[:, None], 0.0, uv3)
    ray[:, 2] = 1.0
    ray = np.einsum("nji,nj->ni", rotation, ray)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    begin = x0 + np.einsum("nji,nj->ni", rotation, np.where(beside[:, None], uv3, 0.0))
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
        Largest misfit of the direction of a consistent point (rad).

    Returns
    -------
    Resection or None
        None where fewer than four points are consistent.
    """
    # In a plane across the middle of the rays misfits are angles, even in the corners of a wide lens.
    turn = _towards(uv)
    ray = np.column_stack([uv, np.ones(len(uv))]) @ turn.T
    front = ray[:, 2] > _GRAZING * np.linalg.norm(ray, axis=1)
    if front.sum() < 4:
        return None
    uv, given, xyz = ray[front, :2] / ray[front, 2:], len(xyz), xyz[front]
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
    rotation, shift, consistent = best
    agree = np.zeros(given, dtype=bool)
    agree[front] = consistent
    return Resection(turn.T @ rotation, centre - size * rotation.T @ shift, agree)


def _towards(uv: Array) -> Array:
    """Rotation (3, 3) that turns the mean of the rays to the optical axis."""
    ray = np.column_stack([uv, np.ones(len(uv))])
    z = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).mean(axis=0)
    z /= np.linalg.norm(z)
    x = np.array([z[2], 0.0, -z[0]])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def resect_through(
    refraction: Refraction, start: Resection, xyz: Array, uv: Array, tolerance: float
) -> Resection | None:
    """Refine the pose of an image whose rays pass windows, by robust least squares with the exact rays.

    Parameters
    ----------
    refraction : Refraction
        Windows, with the path of this image only.
    start : Resection
        Pose with straight rays.
    xyz : ndarray (k, 3)
        Object points.
    uv : ndarray (k, 2)
        Ideal directions.
    tolerance : float
        Misfit of the ideal direction at which the weight of a point is one half; the largest misfit of a
        consistent point is three times this.

    Returns
    -------
    Resection or None
        None where rays cannot be computed.
    """
    columns, every = refraction.columns(refraction.values), np.arange(len(xyz))
    image = np.zeros(len(xyz), dtype=np.intp)

    def misfits(rotation: Array, x0: Array) -> tuple[Array, Array, Array, float]:
        rays = RefractedRays.of(
            columns, refraction.path_of, rotation[None], x0[None], xyz, image, every, derivatives=True
        )
        off = rays.uv - uv
        square = (off**2).sum(axis=1) / tolerance**2
        weight = np.where(rays.reached, 1.0 / (1.0 + square), 0.0)
        cost = float(np.where(rays.reached, np.log1p(square), _MISSED).sum())
        return off, rays.by[:, :, :6], weight, cost

    rotation, x0, damping = start.rotation, start.x0, 1e-3
    off, by, weight, cost = misfits(rotation, x0)
    for _ in range(_POSE_STEPS):
        normal = np.einsum("k,kia,kib->ab", weight, by, by)
        right = -np.einsum("k,kia,ki->a", weight, by, off)
        diagonal = np.diag(normal)
        if not (np.isfinite(normal).all() and (diagonal > 0).all()):
            return None
        step = np.linalg.solve(normal + damping * np.diag(diagonal), right)
        trial = rotation_matrix(step[:3]) @ rotation, x0 + step[3:]
        there = misfits(*trial)
        if there[3] <= cost:
            settled = cost - there[3] < 1e-9 * cost
            (rotation, x0), (off, by, weight, cost), damping = trial, there, damping / 5
            if settled:
                break
        else:
            damping *= 5
            if damping > 1e8:
                break
    agree = (np.linalg.norm(off, axis=1) < 3 * tolerance) & (weight > 0)
    return Resection(rotation, x0, agree)


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
