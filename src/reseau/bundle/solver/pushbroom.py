"""Approximate pose and velocity of an image of a line camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...core.data import Array

# Smallest singular value of the equations, relative to the largest, with which they have one solution only.
_RANK = 1e-6
# Six points give eleven equations for the quotient and six for the lines.
_LEAST = 6


class Pushbroom(NamedTuple):
    """Rotation (3, 3), projection centre (3,) at time 0, and velocity (3,) along the axes of the camera."""

    rotation: Array
    x0: Array
    velocity: Array


def resect_line(xyz: Array, u: Array, t: Array) -> Pushbroom | None:
    """Compute the pose and the velocity of a line camera that moves straight, from known points.

    A point is seen when it is in the plane of the line: with (a, b, c) = R(X − X0), at the time t = b/vy, and
    there u = (a − vx·t)/(c − vz·t). So t is linear in X, and u is a quotient of linear functions: both follow
    from linear equations (Gupta & Hartley 1997, sect. 4). Here u is known, as the camera is, and the twelve
    numbers give R, X0 and v in closed form.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Points, at least six, not in one plane.
    u : ndarray (k,)
        Ideal directions along the line.
    t : ndarray (k,)
        Times of the lines on which the points are seen.

    Returns
    -------
    Pushbroom or None
        None where the points do not determine it.

    Examples
    --------
    >>> xyz = np.random.default_rng(1).uniform(-1, 1, (8, 3))
    >>> found = resect_line(xyz, xyz[:, 0] / (xyz[:, 2] + 5.0), xyz[:, 1] / 0.5)
    >>> found.x0.round(6) + 0.0, found.velocity.round(6) + 0.0
    (array([ 0.,  0., -5.]), array([0. , 0.5, 0. ]))
    """
    centre = xyz.mean(axis=0)
    size = float(np.abs(xyz - centre).max()) or 1.0
    x = (xyz - centre) / size
    if len(x) < _LEAST:
        return None
    design = np.column_stack([x, np.ones(len(x))])
    singular = np.linalg.svd(design, compute_uv=False)
    if singular[-1] < _RANK * singular[0]:
        return None
    line = np.linalg.lstsq(design, t, rcond=None)[0]
    # a − vx·t − u·(c − vz·t) = 0, homogeneous in eight numbers.
    _, singular, vt = np.linalg.svd(np.column_stack([design, -u[:, None] * design]))
    if singular[-2] < _RANK * singular[0] or not np.linalg.norm(line[:3]) > 0:
        return None
    above, below = vt[-1, :4], vt[-1, 4:]
    speed = 1.0 / np.linalg.norm(line[:3])
    y = speed * line[:3]
    # Above and below are r1 − (vx/vy) r2 and r3 − (vz/vy) r2, times a factor of either sign.
    z = below[:3] - (below[:3] @ y) * y
    factor = np.linalg.norm(z)
    if not factor > 0:
        return None
    # Points are in front of the camera.
    if np.median(design @ below) < 0:
        above, below, z = -above, -below, -z
    above, below, z = above / factor, below / factor, z / factor
    rotation = np.stack([np.cross(y, z), y, z])
    velocity = speed * np.array([-(above[:3] @ y), 1.0, -(below[:3] @ y)])
    # The constants are those of −R X0.
    shift = np.array([0.0, speed * line[3], 0.0])
    shift[0] = above[3] + velocity[0] * line[3]
    shift[2] = below[3] + velocity[2] * line[3]
    return Pushbroom(rotation, centre - size * (rotation.T @ shift), size * velocity)
