"""The mount of a testfield on a turntable: predicts the orientation of the camera from the axis positions.

The mount of Vosselman and Förstner: the board is rotated by κ in its plane, then tilted by φ about an axis of
the mount; the camera rotates about its own axis. The signs of the axes and the orientation of the camera in
the mount are determined from adjusted poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from ..core.data import Array
from ..core.failure import Code, Failure
from ..optics import Pose
from ..optics.poses import matrix_to_vector, rotation_matrix

TILT, ROLL, CAMERA_ROLL, HEIGHT = "tilt", "roll", "camera_roll", "z"
_WORST_DEG = 5.0
"""Largest rms deviation of poses from the mount; predictions need no better accuracy."""


@dataclass(frozen=True, eq=False)
class Mount:
    """Geometry of the mount.

    Parameters
    ----------
    about : int
        Tilt axis of the board in the mount: 0 for x, 1 for y.
    signs : (float, float, float)
        Signs of tilt, roll and camera roll.
    lifts : float
        Direction of z along the normal of the board: towards the camera (1) or away from it (−1).
    looks : ndarray (3, 3)
        Rotation from the mount to the camera with all axes at zero.
    centre : ndarray (3,)
        Projection centre in the system of the mount (mm).
    off_deg : float
        Rms angle between the given rotations and those of the mount (degrees).

    Examples
    --------
    >>> positions = [{"tilt": 0.0}, {"tilt": 30.0}, {"tilt": 30.0, "roll": 90.0}]
    >>> boards = [_rotations(position, 0, (1.0, 1.0, 1.0))[0] for position in positions]
    >>> x0 = np.array([board.T @ [0.0, 0.0, 500.0] for board in boards])
    >>> mount = Mount.of(positions, np.array(boards), x0)
    >>> mount.about, round(mount.off_deg, 3), round(float(mount.centre[2]), 3)
    (0, 0.0, 500.0)
    """

    about: int
    signs: tuple[float, float, float]
    lifts: float
    looks: Array
    centre: Array
    off_deg: float

    @classmethod
    def of(cls, positions: Sequence[Mapping[str, float]], rotations: Array, x0: Array) -> Self | Failure:
        """Determine the mount that fits given poses best.

        Parameters
        ----------
        positions : sequence of mapping
            Positions of the axes `tilt`, `roll`, `camera_roll` (degrees) and `z` (mm); missing axes are zero.
        rotations : ndarray (m, 3, 3)
            Rotations from the board to the camera.
        x0 : ndarray (m, 3)
            Projection centres in the system of the board (mm).

        Returns
        -------
        Mount or Failure
            A failure if no mount fits within 5 degrees.
        """
        found: list[Self] = []
        for about, *signs in itertools.product((1, 0), (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)):
            turns = [_rotations(position, about, tuple(signs)) for position in positions]
            boards = np.array([board for board, _ in turns])
            cameras = np.array([camera for _, camera in turns])
            # Each rotation is camera · looks · board; the rotation nearest to the mean (Horn et al. 1988).
            back = np.swapaxes(cameras, 1, 2) @ rotations @ np.swapaxes(boards, 1, 2)
            u, _, vt = np.linalg.svd(back.sum(axis=0))
            looks = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            off = cameras @ looks @ boards @ np.swapaxes(rotations, 1, 2)
            cosine = np.clip((np.trace(off, axis1=1, axis2=2) - 1) / 2, -1, 1)
            lifts, centre = _in_mount(boards, x0, positions)
            rms = float(np.rad2deg(np.sqrt(np.mean(np.arccos(cosine) ** 2))))
            found.append(cls(int(about), (signs[0], signs[1], signs[2]), lifts, looks, centre, rms))
        best = min(found, key=lambda mount: mount.off_deg)  # the first of equals: signs without effect are +
        if best.off_deg > _WORST_DEG:
            return Failure(
                f"the axes {TILT}, {ROLL} and {CAMERA_ROLL} do not match the mount of a testfield: "
                f"rms deviation of the poses {best.off_deg:.0f}°",
                Code.INCONSISTENT,
            )
        return best

    def pose(self, position: Mapping[str, float]) -> Pose:
        """Return the pose of the camera in the system of the board, for a position of the axes."""
        board, camera = _rotations(position, self.about, self.signs)
        lift = np.array([0.0, 0.0, self.lifts * position.get(HEIGHT, 0.0)])
        return Pose(matrix_to_vector(camera @ self.looks @ board), board.T @ self.centre - lift)


def _in_mount(boards: Array, x0: Array, positions: Sequence[Mapping[str, float]]) -> tuple[float, Array]:
    """Sign of z, and projection centre in the mount with z at zero, from poses (m)."""
    up = np.array([[0.0, 0.0, position.get(HEIGHT, 0.0)] for position in positions])
    found = {sign: (boards @ (x0 + sign * up)[:, :, None])[:, :, 0] for sign in (1.0, -1.0)}
    lifts = min(found, key=lambda sign: float(found[sign].var(axis=0).sum()))
    return lifts, found[lifts].mean(axis=0)


def _rotations(position: Mapping[str, float], about: int, signs: tuple[float, ...]) -> tuple[Array, Array]:
    """Rotations of the board in the mount and of the camera about its axis."""
    axes = np.eye(3)
    tilt, roll, camera = (
        rotation_matrix(axes[axis] * np.deg2rad(sign * position.get(name, 0.0)))
        for axis, sign, name in zip((about, 2, 2), signs, (TILT, ROLL, CAMERA_ROLL), strict=True)
    )
    return tilt @ roll, camera
