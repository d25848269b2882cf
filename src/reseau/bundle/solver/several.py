"""The several solutions of a resection and of a relative orientation, each by as few points as possible."""

from __future__ import annotations

import cv2
import numpy as np

from ...core.data import Array
from ...optics.poses import rotation_matrix
from .spatial import Pair, Poses, Resection, beside, towards

# Sets of three and of five points that are tried, and angle (rad) between solutions that are not the same.
_TRIPLES, _FIVES, _APART = 12, 30, 0.1


def poses_of(xyz: Array, uv: Array, count: int) -> list[Resection]:
    """Compute poses from which an image sees its points in about these directions, the best first.

    They begin with those of three points, of which up to four see these alike, and are refined by all.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Object points, at least three.
    uv : ndarray (k, 2)
        Ideal directions.
    count : int
        Number of poses at most.

    Examples
    --------
    >>> xyz = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.2]])
    >>> seen = xyz + [0.1, 0.2, 3.0]
    >>> sorted(pose.x0.round(3).tolist() for pose in poses_of(xyz, seen[:, :2] / seen[:, 2:], 4))
    [[-0.1, -0.2, -3.0], [0.025, 2.603, -1.592]]
    """
    turn = towards(uv)
    ray = np.column_stack([uv, np.ones(len(uv))]) @ turn.T
    if beside(ray).any():
        return []
    centre = xyz.mean(axis=0)
    size = float(np.abs(xyz - centre).max()) or 1.0
    points, plane = ((part + 0.0) for part in ((xyz - centre) / size, ray[:, :2] / ray[:, 2:]))
    search, rng = Poses(points, plane, 1.0, 1.0), np.random.default_rng(0)
    triples = [rng.choice(len(xyz), 3, replace=False) for _ in range(_TRIPLES if len(xyz) > 3 else 1)]
    poses = np.concatenate([search.of_three(rows) for rows in triples])
    poses = poses[np.isfinite(poses).all(axis=1)]
    found = list[Array]()
    for pose in poses[np.argsort(np.median(search.misfits(poses), axis=1), kind="stable")]:
        if len(found) < count and all(_angle(pose[:3], each[:3]) > _APART for each in found):
            found.append(pose)
    if len(xyz) > 3:
        found = [np.ravel(_refined(points, plane, pose)) for pose in found]
    every = np.ones(len(xyz), dtype=bool)
    return [
        Resection(turn.T @ rotation, centre - size * rotation.T @ pose[3:], every)
        for pose in found
        for rotation in [rotation_matrix(pose[:3])]
    ]


def _refined(xyz: Array, uv: Array, pose: Array) -> Array:
    """A pose refined by all points."""
    begin = (pose[:3].reshape(3, 1).copy(), pose[3:].reshape(3, 1).copy())
    return np.array(cv2.solvePnPRefineLM(xyz, uv, np.eye(3), np.zeros(0), *begin), dtype=np.float64)


def _angle(one: Array, other: Array) -> float:
    """Angle (rad) between the rotations of two vectors."""
    trace = float((rotation_matrix(one) * rotation_matrix(other)).sum())
    return float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)))


def relative_orientations(first: Array, second: Array, count: int) -> list[Pair]:
    """Compute relative orientations of two images by five of their points, those that fit most best first.

    Parameters
    ----------
    first, second : ndarray (k, 2)
        Ideal directions of the same points.
    count : int
        Number of relative orientations at most.

    Examples
    --------
    >>> xyz = np.random.default_rng(1).uniform(-1, 1, (8, 3)) + [0, 0, 5]
    >>> moved = xyz - [1, 0, 0]
    >>> found = relative_orientations(xyz[:, :2] / xyz[:, 2:], moved[:, :2] / moved[:, 2:], 1)
    >>> found[0].x0.round(6) + 0.0
    array([1., 0., 0.])
    """
    known = np.isfinite(first + second).all(axis=1)
    a, b = (np.ascontiguousarray(uv[known]) for uv in (first, second))
    rng, found = np.random.default_rng(0), list[tuple[float, Pair]]()
    for _ in range(_FIVES if len(a) > 5 else len(a) // 5):
        rows = rng.choice(len(a), 5, replace=False)
        essential = cv2.findEssentialMat(a[rows], b[rows], np.eye(3), cv2.RANSAC, 0.999, 1.0)[0]
        for e in np.zeros((0, 3, 3)) if essential is None else essential.reshape(-1, 3, 3):
            before, rotation, shift, agree = cv2.recoverPose(e, a, b, np.eye(3))
            # Most points are before both images.
            if 2 * before > len(a):
                x0 = -np.asarray(rotation.T @ shift, dtype=np.float64).ravel()
                pair = Pair(np.asarray(rotation, dtype=np.float64), x0, np.asarray(agree).ravel() > 0)
                found.append((_from_lines(np.asarray(e, dtype=np.float64), a, b), pair))
    best = list[Pair]()
    for _, pair in sorted(found, key=lambda each: each[0]):
        if len(best) < count and all(_differ(pair, each) for each in best):
            best.append(pair)
    return best


def _differ(one: Pair, other: Pair) -> bool:
    turned = (one.rotation * other.rotation).sum() < 1 + 2 * np.cos(_APART)
    return bool(turned or one.x0 @ other.x0 < np.cos(_APART))


def _from_lines(e: Array, a: Array, b: Array) -> float:
    """Median distance of points from their epipolar lines (Sampson 1982)."""
    one, other = (np.column_stack([uv, np.ones(len(uv))]) for uv in (a, b))
    right, left = one @ e.T, other @ e
    off = np.abs((other * right).sum(axis=1))
    size = np.sqrt((right[:, :2] ** 2).sum(axis=1) + (left[:, :2] ** 2).sum(axis=1))
    return float(np.median(off / np.maximum(size, 1e-300)))
