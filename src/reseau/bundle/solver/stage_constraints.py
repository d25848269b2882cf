"""The normal equations of images on a stage: those of one pose share their exterior orientation.

Unknown are R and X0 of each pose, the reading of each image, which was observed, and the direction d of the
axis by two small angles. The normal equations are formed as if every image had an orientation of its own.
Changes y of these are y = T q of the unknowns q proper, and Tᵀ S T q = −Tᵀ s is what is solved (constraints
by elimination: Förstner & Wrobel 2016, sect. 4.8.2); cofactors go back by T Q Tᵀ.
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

    T (u, size) is `back`; then come the matrix (size, size), and gradients (size,): the readings', and all.
    """

    back: Array
    matrix: Array
    own: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class StageConstraints:
    """The reduced unknowns of images as functions of the unknowns of poses and stage.

    The independent unknowns are those that belong to no pose, six for each pose, the readings, and two for
    the axis.

    Parameters
    ----------
    unknowns : Unknowns
        Columns of the reduced normal equations, an orientation for each image.
    stage : Stage
        What moves the field.
    """

    unknowns: Unknowns
    stage: Stage

    @cached_property
    def images(self) -> Rows:
        """Images that take part (a,)."""
        return np.flatnonzero(self.unknowns.pose >= 0).astype(np.intp)

    @cached_property
    def pose(self) -> Rows:
        """First column of the pose of each image that takes part (a,)."""
        _, number = np.unique(self.stage.pose[self.images], return_inverse=True)
        return np.asarray(len(self.others) + 6 * number, dtype=np.intp)

    @cached_property
    def others(self) -> Rows:
        """Reduced unknowns that belong to no pose."""
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
        """T (u, size) at some values."""
        t = np.zeros((self.unknowns.size, self.size))
        t[self.others, np.arange(len(self.others))] = 1.0
        row = self.unknowns.pose[self.images, None] + np.arange(6)
        t[row, self.pose[:, None] + np.arange(6)] = 1.0
        t[row[:, 3:], self.readings[:, None]] = -moved.axis
        bends = -moved.reading[self.images, None, None] * perpendicular(moved.axis)
        t[row[:, 3:, None], self.size - 2 + np.arange(2)] = bends
        return t

    def constrained(
        self,
        moved: StageValues | None,
        s: Array,
        gradient: Array,
        slopes: Array,
        misfits: Array,
        held: Mask | None,
    ) -> Constrained:
        """Normal equations of the independent unknowns.

        Parameters
        ----------
        moved : StageValues
            Values of the stage.
        s, gradient : ndarray (u, u), (u,)
            Reduced normal equations of the images as if the images were independent.
        slopes : ndarray (a + 2, size)
            Weighted derivatives of readings and angles of the axis, see :meth:`slopes`.
        misfits : ndarray (a + 2,)
            Their weighted misfits.
        held : ndarray of bool (size,), optional
            Unknowns that are held.
        """
        assert moved is not None
        t, own = self.matrix(moved), slopes.T @ misfits
        matrix = t.T @ s @ t + slopes.T @ slopes
        if held is not None:
            matrix[held], matrix[:, held] = 0.0, 0.0
            matrix[held, held] = 1.0
        return Constrained(t, matrix, own, t.T @ gradient + own)

    def slopes(self, moved: StageValues | None, nominal: Array, root: Array) -> Array:
        """Derivatives (a + 2, size) of readings and angles of the axis, times roots (a + 2,) of weights."""
        assert moved is not None
        slopes, a = np.zeros((len(root), self.size)), len(self.images)
        slopes[np.arange(a), self.readings] = 1.0
        slopes[a:, -2:] = nominal.T @ perpendicular(moved.axis)
        return slopes * root[:, None]

    def stepped(self, moved: StageValues, x0: Array, y: Array, q: Array) -> tuple[StageValues, Array]:
        """Readings, axis and projection centres (m, 3) after a correction y = T q."""
        images, by_axis = self.images, perpendicular(moved.axis) @ q[-2:]
        reading = moved.reading.copy()
        reading[images] += q[self.readings]
        axis = moved.axis + by_axis
        axis /= np.linalg.norm(axis)
        # What the pose itself is moved by is the part of y that is not the stage's.
        rest = x0[images] + y[self.unknowns.pose[images, None] + np.arange(3, 6)]
        rest += reading[images, None] * moved.axis + moved.reading[images, None] * by_axis
        x0 = x0.copy()
        x0[images] = rest - reading[images, None] * axis
        return StageValues(reading, axis), x0

    def held(self, columns: Mask) -> Mask:
        """Return which independent unknowns (size,) are held, from the held reduced unknowns (u,)."""
        held = np.zeros(self.size, dtype=bool)
        held[: len(self.others)] = columns[self.others]
        return held
