"""Normal equations with a stage: all images of a pose have the same exterior orientation.

The unknowns are R and X0 of each pose, the observed reading of each image, and the direction d of the axis
(two small angles). The normal equations are first formed with a separate orientation for every image. Its
corrections are y = T q with the independent unknowns q, and Tᵀ S T q = −Tᵀ s is solved (constraints by
elimination: Förstner & Wrobel 2016, sect. 4.8.2); the cofactors of y are T Q Tᵀ.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...core.data import Array, Mask, Rows
from ..network import Stage
from ..network.stage import StageValues, perpendicular
from .unknowns import Unknowns

__all__ = ["Constrained", "StageConstraints"]


class Constrained(NamedTuple):
    """Normal equations of the independent unknowns.

    `back` is T (u, size), `matrix` is (size, size); `own` is the gradient (size,) of readings and axis only,
    `gradient` that of all observations.
    """

    back: Array
    matrix: Array
    own: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class StageConstraints:
    """Reduced unknowns of images as functions of the independent unknowns of poses and stage.

    The independent unknowns are, in this order: all that belong to no image, six for each pose, the readings,
    and two for the axis.

    Parameters
    ----------
    unknowns : Unknowns
        Columns of the reduced normal equations, with an orientation for each image.
    stage : Stage
        The stage.
    """

    unknowns: Unknowns
    stage: Stage

    @cached_property
    def images(self) -> Rows:
        """Adjusted images (a,)."""
        return np.flatnonzero(self.unknowns.pose >= 0).astype(np.intp)

    @cached_property
    def pose(self) -> Rows:
        """First column of the pose of each adjusted image (a,)."""
        _, number = np.unique(self.stage.pose[self.images], return_inverse=True)
        return np.asarray(len(self.others) + 6 * number, dtype=np.intp)

    @cached_property
    def others(self) -> Rows:
        """Reduced unknowns that belong to no image."""
        own = np.ones(self.unknowns.size, dtype=bool)
        own[self.unknowns.pose[self.images, None] + np.arange(6)] = False
        return np.flatnonzero(own).astype(np.intp)

    @property
    def readings(self) -> Rows:
        """Columns of the readings (a,)."""
        return self.size - 2 - len(self.images) + np.arange(len(self.images), dtype=np.intp)

    @cached_property
    def size(self) -> int:
        """Number of independent unknowns."""
        return int(self.pose.max()) + 6 + len(self.images) + 2

    def matrix(self, moved: StageValues) -> Array:
        """Compute T (u, size) at given values."""
        t = np.zeros((self.unknowns.size, self.size))
        t[self.others, np.arange(len(self.others))] = 1.0
        row = self.unknowns.pose[self.images, None] + np.arange(6)
        t[row, self.pose[:, None] + np.arange(6)] = 1.0
        t[row[:, 3:], self.readings[:, None]] = -moved.axis
        bends = -moved.reading[self.images, None, None] * perpendicular(moved.axis)
        t[row[:, 3:, None], self.size - 2 + np.arange(2)] = bends
        return t

    def slopes(self, moved: StageValues, nominal: Array, root: Array) -> Array:
        """Derivatives (a + 2, size) of readings and axis angles, times roots (a + 2,) of weights."""
        slopes, a = np.zeros((len(root), self.size)), len(self.images)
        slopes[np.arange(a), self.readings] = 1.0
        slopes[a:, -2:] = nominal.T @ perpendicular(moved.axis)
        return slopes * root[:, None]

    def stepped(self, moved: StageValues, x0: Array, y: Array, q: Array) -> tuple[StageValues, Array]:
        """Return readings and axis, and projection centres (m, 3), after a correction y = T q."""
        images, by_axis = self.images, perpendicular(moved.axis) @ q[-2:]
        reading = moved.reading.copy()
        reading[images] += q[self.readings]
        axis = moved.axis + by_axis
        axis /= np.linalg.norm(axis)
        # The correction of the pose is the part of y that does not come from the stage.
        rest = x0[images] + y[self.unknowns.pose[images, None] + np.arange(3, 6)]
        rest += reading[images, None] * moved.axis + moved.reading[images, None] * by_axis
        x0 = x0.copy()
        x0[images] = rest - reading[images, None] * axis
        return StageValues(reading, axis), x0

    def held(self, columns: Mask) -> Mask:
        """Return the held independent unknowns (size,) from the held reduced unknowns (u,)."""
        held = np.zeros(self.size, dtype=bool)
        held[: len(self.others)] = columns[self.others]
        return held
