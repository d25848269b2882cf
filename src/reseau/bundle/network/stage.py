"""A stage that moves the field along a straight line: images of one pose share their exterior orientation.

The field at a reading s is the field moved by s along the unit vector d of the stage's axis, the same in all
poses; a camera at X0 sees it as one at X0 − s d sees the field at rest:

    x_c = R (X + s d − X0).

How the adjustment treats it is said in :mod:`reseau.bundle.solver.ties`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.data import Array, Rows
from ...core.errors import UsageError

__all__ = ["Moved", "Stage", "across"]


class Moved(NamedTuple):
    """Values of a stage: readings (m,) of the images, and the unit vector (3,) of its axis."""

    reading: Array
    axis: Array

    def turned(self, turn: Array) -> Moved:
        """The same in a system that is turned."""
        return Moved(self.reading, turn @ self.axis)


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage, and what was read of it.

    Parameters
    ----------
    pose : ndarray of int (m,)
        Pose of each image; those of one pose share their exterior orientation.
    reading : ndarray (m,)
        By how much the field was moved in each image, in the unit of object space.
    sigma : float
        Standard deviation of a reading.
    axis : ndarray (3,)
        Unit vector that the axis should have in the system of the field.
    axis_sigma : float
        Standard deviation of each of the two angles by which it is off, rad.
    """

    pose: Rows
    reading: Array
    sigma: float
    axis: Array
    axis_sigma: float

    def __post_init__(self) -> None:
        for name, sigma in (("reading", self.sigma), ("axis", self.axis_sigma)):
            if not 0 < sigma < np.inf:
                raise UsageError("must be larger than 0", where=f"standard deviation of a stage's {name}")
        if self.pose.shape != self.reading.shape:
            raise UsageError("needs a pose and a reading of every image", where="Stage")

    def begun(self, rotation: Array, x0: Array) -> tuple[Moved, Array, Array]:
        """Approximate values with one orientation to a pose: that of its first image that has any."""
        rotation, x0 = rotation.copy(), x0.copy()
        moved = Moved(self.reading, self.axis / np.linalg.norm(self.axis))
        for pose in np.unique(self.pose):
            rows = np.flatnonzero((self.pose == pose) & np.isfinite(x0).all(axis=1))
            if len(rows):
                first = rows[0]
                rotation[rows] = rotation[first]
                x0[rows] = x0[first] + (self.reading[first] - self.reading[rows, None]) * moved.axis
        return moved, rotation, x0


def across(axis: Array) -> Array:
    """Two unit vectors at right angles to a third and to each other, as columns (3, 2)."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    one = np.cross(axis, start)
    one /= np.linalg.norm(one)
    return np.column_stack([one, np.cross(axis, one)])
