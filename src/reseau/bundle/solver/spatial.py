"""Orientation of single images and pairs, and intersection of rays, as approximate values.

The minimal solvers (resection, five-point essential matrix) and the search for the largest set of consistent
points are those of OpenCV, applied to directions corrected for distortion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, Self

import cv2
import numpy as np

from ...adjust.mixture import Mixture
from ...core.data import Array, Mask, Rows
from ...optics.poses import rotation_matrix
from ...optics.refraction import RefractedRays
from ...optics.refraction.windows import Refraction
from ..network.camera import Camera
from ..network.network import Network

# Distance of points that count as distant, in the largest dimension of a window.
_DISTANT = 1e4
# Newton steps to the direction behind a window, and the steps (tangents) at which it is found, and close.
_STEPS, _SHORT, _ROUGH = 20, 1e-9, 1e-3


# Rays closer than this (sine) to the plane across the middle of all rays are not used in a resection.
_GRAZING = 0.1
# Standard deviations that are tried in a resection, points by which poses are judged, poses from three points
# at first and at most, those that are refined, and rounds of this.
_SIGMAS, _SCORED, _TRIALS, _KEPT, _ROUNDS = 10, 200, (30, 1500), 3, 6
# Logarithm of the odds from which a pose is taken.
_ODDS = np.log(10.0)
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


def field_of(uv: Array) -> float:
    """Extent (rad) of the field of view of some directions (n, 2): twice their root mean square angle."""
    uv = uv[np.isfinite(uv).all(axis=1)]
    if not len(uv):
        return 1.0
    angle = np.arctan(np.linalg.norm(uv - np.median(uv, axis=0), axis=1))
    return max(2.0 * float(np.sqrt((angle**2).mean())), 1e-6)


def resect(xyz: Array, uv: Array, tolerance: float) -> Resection | None:
    """Compute the pose of an image that explains its points better than gross errors do.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Object points.
    uv : ndarray (k, 2)
        Ideal directions.
    tolerance : float
        Largest standard deviation (rad) of the directions of good points.

    Returns
    -------
    Resection or None
        None where no pose pays for its six parameters; see :class:`~reseau.adjust.mixture.Mixture`.
    """
    # In a plane across the middle of the rays misfits are angles, even in the corners of a wide lens.
    turn = towards(uv)
    ray = np.column_stack([uv, np.ones(len(uv))]) @ turn.T
    front = ~beside(ray)
    if front.sum() < 4:
        return None
    uv, given, xyz = ray[front, :2] / ray[front, 2:], len(xyz), xyz[front]
    centre = xyz.mean(axis=0)
    size = float(np.abs(xyz - centre).max()) or 1.0
    search = Poses(
        np.ascontiguousarray((xyz - centre) / size), np.ascontiguousarray(uv), field_of(uv), tolerance
    )
    try:
        best = search.best()
    except cv2.error:
        return None
    if best is None:
        return None
    rotation, shift, consistent = best
    agree = np.zeros(given, dtype=bool)
    agree[front] = consistent
    return Resection(turn.T @ rotation, centre - size * rotation.T @ shift, agree)


def beside(ray: Array) -> Mask:
    """Rays (k,) that are nearly in the plane across the middle of all, or behind it."""
    return np.asarray(ray[:, 2] <= _GRAZING * np.linalg.norm(ray, axis=1))


def towards(uv: Array) -> Array:
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


class Poses(NamedTuple):
    """Poses of an image from three of its points, judged by all: points (k, 3), directions, their extent."""

    xyz: Array
    uv: Array
    reach: float
    largest: float

    def misfits(self, poses: Array) -> Array:
        """Sizes (h, k) of the misfits of poses (h, 6); infinite behind the camera."""
        x = self.xyz @ np.swapaxes(rotation_matrix(poses[:, :3]), 1, 2) + poses[:, None, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.linalg.norm(x[..., :2] / x[..., 2:] - self.uv, axis=-1)
        return np.where(x[..., 2] > 0, off, np.inf)

    @property
    def sigmas(self) -> Array:
        """Standard deviations that are tried."""
        return np.geomspace(min(1e-5, self.largest), self.largest, _SIGMAS)

    def best(self) -> tuple[Array, Array, Mask] | None:
        """The pose that explains most, refined by its good points; None where none pays for itself."""
        k, rng = len(self.xyz), np.random.default_rng(0)
        some = self if k <= _SCORED else self._part(rng.permutation(k)[:_SCORED])
        begin = Mixture(self.largest, 0.5, self.reach)
        poses = self._of_all()
        done, wanted = 0, float(_TRIALS[0])
        while done < wanted:
            three = np.argsort(rng.random((_TRIALS[0], k)), axis=1)[:, :3] if k > 3 else np.arange(3)[None]
            poses = np.concatenate([poses, *(self.of_three(rows) for rows in three)])
            done += len(three)
            poses = poses[np.isfinite(poses).all(axis=1)]
            if not len(poses):
                continue
            gain, sigma = begin.at_best(some.misfits(poses), self.sigmas, 6)
            order = np.argsort(-gain, kind="stable")[:_KEPT]
            mixture, poses = replace(begin, sigma=float(sigma[order[0]])), poses[order]
            good = float(mixture.good(some.misfits(poses[:1])[0]).mean())
            # So many that three good points are among them.
            wanted = min(_TRIALS[1], np.log(1e-3) / np.log(max(1.0 - good**3, 1e-12) - 1e-13))
        found = [each for pose in poses if (each := self._refined(pose, begin)) is not None]
        best = max(found, key=lambda each: each[0], default=None)
        return best[1:] if best is not None and best[0] > _ODDS else None

    def _part(self, rows: Rows) -> Self:
        return self._replace(xyz=self.xyz[rows], uv=self.uv[rows])

    def _of_all(self) -> Array:
        """Poses (h, 6) from all points."""
        _, *found, _ = cv2.solvePnPGeneric(
            self.xyz, self.uv, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_SQPNP
        )
        return self._poses(found)

    def of_three(self, rows: Rows) -> Array:
        """Poses (h, 6) from three points."""
        _, *found = cv2.solveP3P(self.xyz[rows], self.uv[rows], np.eye(3), np.zeros(0), cv2.SOLVEPNP_AP3P)
        return self._poses(found)

    @staticmethod
    def _poses(found: list[Any]) -> Array:
        """Poses (h, 6) as OpenCV returns them: vectors of all rotations, then all shifts."""
        return np.array(found, dtype=np.float64).reshape(2, -1, 3).transpose(1, 0, 2).reshape(-1, 6)

    def _refined(self, pose: Array, begin: Mixture) -> tuple[float, Array, Array, Mask] | None:
        """A pose refined by its good points, and what it explains beyond the price of its parameters."""
        best = None
        for _ in range(_ROUNDS):
            off = self.misfits(pose[None])[0]
            _, sigma = begin.at_best(off, self.sigmas, 6)
            mixture = replace(begin, sigma=float(sigma)).fitted(off)
            good = ~mixture.gross(off)
            gain = float(mixture.evidence(off).sum()) - 6 * mixture.price
            if good.sum() < 4 or mixture.sigma > self.largest or (best is not None and gain <= best[0]):
                break
            best = gain, rotation_matrix(pose[:3]), pose[3:], good
            found = cv2.solvePnPRefineLM(
                np.ascontiguousarray(self.xyz[good]), np.ascontiguousarray(self.uv[good]), np.eye(3),
                np.zeros(0), pose[:3].reshape(3, 1).copy(), pose[3:].reshape(3, 1).copy(),
            )  # fmt: skip
            pose = np.array(found, dtype=np.float64).ravel()
        return best


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
        essential, inliers = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.9999, tolerance, 5000)
        if essential is None or essential.shape != (3, 3):
            return None
        count, rotation, shift, agree = cv2.recoverPose(essential, a, b, np.eye(3), mask=inliers.copy())
    except cv2.error:
        return None
    if count < 6:
        return None
    x0 = -np.asarray(rotation.T @ shift, dtype=np.float64).ravel()
    return Pair(np.asarray(rotation, dtype=np.float64), x0, np.asarray(agree).ravel() > 0)
