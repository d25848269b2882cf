"""Where a camera stands in the system of a board, told by the axes of the table that turns both.

The mount of Vosselman and Förstner: the board is turned by κ in its own plane, then tilted by φ about an axis
of the mount; the camera turns about its own axis. What is not known of it, which way each axis counts, how
the camera looked at the mount to begin with and from where, follows from some adjusted poses.
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

__all__ = ["Mount"]

TILT, ROLL, CAMERA_ROLL, HEIGHT = "tilt", "roll", "camera_roll", "z"
_WORST_DEG = 5.0
"""How far poses may be from those that the axes tell; a prediction needs no better."""


@dataclass(frozen=True, eq=False)
class Mount:
    """How the axes turn board and camera.

    Parameters
    ----------
    about : int
        Axis of the mount about which the board is tilted: 0 for x, 1 for y.
    signs : (float, float, float)
        Which way tilt, roll and camera roll count.
    lifts : float
        Whether z moves the board along its normal towards the camera (1) or away from it (−1).
    looks : ndarray (3, 3)
        From the mount to the camera with all axes at zero.
    centre : ndarray (3,)
        Projection centre in the system of the mount (mm).
    off_deg : float
        Rms angle between the poses that the axes tell and those it was made of.
    """

    about: int
    signs: tuple[float, float, float]
    lifts: float
    looks: Array
    centre: Array
    off_deg: float

    @classmethod
    def of(cls, positions: Sequence[Mapping[str, float]], rotations: Array, x0: Array) -> Self | Failure:
        """The mount that fits some poses best.

        Parameters
        ----------
        positions : sequence of mapping
            Of the axes `tilt`, `roll`, `camera_roll` (degrees) and `z` (mm); what is not named is zero.
        rotations : ndarray (m, 3, 3)
            From the board to the camera.
        x0 : ndarray (m, 3)
            Projection centres in the system of the board (mm).

        Returns
        -------
        Mount or Failure
            A failure when none fits within 5 degrees.
        """
        found: list[Self] = []
        for about, *signs in itertools.product((1, 0), (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)):
            turns = [_turns(position, about, tuple(signs)) for position in positions]
            boards = np.array([board for board, _ in turns])
            cameras = np.array([camera for _, camera in turns])
            # Each pose is camera · looks · board; the rotation nearest the mean of all (Horn et al. 1988).
            back = np.swapaxes(cameras, 1, 2) @ rotations @ np.swapaxes(boards, 1, 2)
            u, _, vt = np.linalg.svd(back.sum(axis=0))
            looks = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            off = cameras @ looks @ boards @ np.swapaxes(rotations, 1, 2)
            cosine = np.clip((np.trace(off, axis1=1, axis2=2) - 1) / 2, -1, 1)
            lifts, centre = _stands(boards, x0, positions)
            rms = float(np.rad2deg(np.sqrt(np.mean(np.arccos(cosine) ** 2))))
            found.append(cls(int(about), (signs[0], signs[1], signs[2]), lifts, looks, centre, rms))
        best = min(
            found, key=lambda mount: mount.off_deg
        )  # the first of equals: signs that do not show are +
        if best.off_deg > _WORST_DEG:
            return Failure(
                f"the axes {TILT}, {ROLL} and {CAMERA_ROLL} do not turn board and camera as they should: "
                f"poses are {best.off_deg:.0f}° off",
                Code.INCONSISTENT,
            )
        return best

    def pose(self, position: Mapping[str, float]) -> Pose:
        """Of the camera in the system of the board, with the axes at a position."""
        board, camera = _turns(position, self.about, self.signs)
        lift = np.array([0.0, 0.0, self.lifts * position.get(HEIGHT, 0.0)])
        return Pose(matrix_to_vector(camera @ self.looks @ board), board.T @ self.centre - lift)


def _stands(boards: Array, x0: Array, positions: Sequence[Mapping[str, float]]) -> tuple[float, Array]:
    """Which way z counts, and where the camera stands in the mount with z at zero, from poses (m)."""
    up = np.array([[0.0, 0.0, position.get(HEIGHT, 0.0)] for position in positions])
    found = {sign: (boards @ (x0 + sign * up)[:, :, None])[:, :, 0] for sign in (1.0, -1.0)}
    lifts = min(found, key=lambda sign: float(found[sign].var(axis=0).sum()))
    return lifts, found[lifts].mean(axis=0)


def _turns(position: Mapping[str, float], about: int, signs: tuple[float, ...]) -> tuple[Array, Array]:
    """Rotations of the board in the mount, and of the camera about its axis."""
    axes = np.eye(3)
    tilt, roll, camera = (
        rotation_matrix(axes[axis] * np.deg2rad(sign * position.get(name, 0.0)))
        for axis, sign, name in zip((about, 2, 2), signs, (TILT, ROLL, CAMERA_ROLL), strict=True)
    )
    return tilt @ roll, camera
