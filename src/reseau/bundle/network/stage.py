"""A stage that moves the field along a straight line between images with one exterior orientation.

At a reading s the field is shifted by s along the unit vector d of the stage axis, which is the same in all
poses. A camera at X0 images the shifted field as a camera at X0 − s d images the field at rest:

    x_c = R (X + s d − X0).

The adjustment is described in :mod:`reseau.bundle.solver.stage_constraints`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.data import Array, Rows
from ...core.errors import UsageError

__all__ = ["Stage", "StageValues", "perpendicular"]


class StageValues(NamedTuple):
    """Values of a stage: readings (m,) of the images, and the unit vector (3,) of its axis."""

    reading: Array
    axis: Array

    def turned(self, turn: Array) -> StageValues:
        """Return the values in a rotated coordinate system."""
        return StageValues(self.reading, turn @ self.axis)


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage and its readings.

    Parameters
    ----------
    pose : ndarray of int (m,)
        Pose of each image; images with the same pose have the same exterior orientation.
    reading : ndarray (m,)
        Displacement of the field in each image, in the unit of object space.
    sigma : float
        Standard deviation of a reading.
    axis : ndarray (3,)
        Nominal direction of the axis in the system of the field.
    axis_sigma : float
        Standard deviation of each of the two angles between the axis and its nominal direction, rad.

    Examples
    --------
    >>> stage = Stage(np.array([0, 0]), np.array([0.0, 10.0]), 0.01, np.array([0.0, 0.0, 1.0]), 1e-3)
    >>> x0 = np.array([[0.0, 0.0, 500.0], [0.3, 0.1, 489.0]])
    >>> _, _, x0 = stage.approximate(np.tile(np.eye(3), (2, 1, 1)), x0)
    >>> x0
    array([[  0.,   0., 500.],
           [  0.,   0., 490.]])
    """

    pose: Rows
    reading: Array
    sigma: float
    axis: Array
    axis_sigma: float

    def __post_init__(self) -> None:
        for name, sigma in (("reading", self.sigma), ("axis", self.axis_sigma)):
            if not 0 < sigma < np.inf:
                raise UsageError(
                    "must be larger than 0", where=f"standard deviation of the {name} of a stage"
                )
        if self.pose.shape != self.reading.shape:
            raise UsageError("requires a pose and a reading for every image", where="Stage")

    def approximate(self, rotation: Array, x0: Array) -> tuple[StageValues, Array, Array]:
        """Approximate values; each pose takes the orientation of its first image with a known pose."""
        rotation, x0 = rotation.copy(), x0.copy()
        moved = StageValues(self.reading, self.axis / np.linalg.norm(self.axis))
        for pose in np.unique(self.pose):
            rows = np.flatnonzero((self.pose == pose) & np.isfinite(x0).all(axis=1))
            if len(rows):
                first = rows[0]
                rotation[rows] = rotation[first]
                x0[rows] = x0[first] + (self.reading[first] - self.reading[rows, None]) * moved.axis
        return moved, rotation, x0


def perpendicular(axis: Array) -> Array:
    """Return two unit vectors perpendicular to an axis and to each other, as columns (3, 2)."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    one = np.cross(axis, start)
    one /= np.linalg.norm(one)
    return np.column_stack([one, np.cross(axis, one)])
