"""Normal equations with a stage: images of a pose differ by the reading of the stage only.

The unknowns are R and X0 of each pose at the reading zero, the readings that are not known, the direction d
of the axis (two small angles) and, of a rotary stage, its position p (two shifts). The normal equations are
first formed with a separate orientation for every image. Its corrections are y = T q with the independent
unknowns q, and Tᵀ S T q = −Tᵀ s is solved (constraints by elimination: Förstner & Wrobel 2016, sect. 4.8.2);
the cofactors of y are T Q Tᵀ.

With small rotations ω about the axes of the camera, of the pose and of an image, a rotary stage at the angle
α gives ω_i = ω + R_i ζ and dX_i = A(α)ᵀ dX − ζ × (X_i − p) + (I − A(α)ᵀ) dp, with ζ = d dα for a change of
the angle, and ζ = α J_r(α d) δ = sin α δ − (1 − cos α) d × δ for one of the direction by δ, perpendicular to
d (J_r is the right Jacobian of the rotation group).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...core.data import Array, Mask, Rows
from ...optics.poses import cross_matrix, rotation_matrix
from ..network.stage import Stage, StageValues, perpendicular


class Frames(NamedTuple):
    """Orientations that a stage moves: those of images, or of the exposures of a rig.

    `image` (f,) is an image of each, `column` (f,) the first of its six unknowns among `size`. Frames with
    the same `pose` (f,) differ by their readings, those with the same `key` (f,) have one reading. `key_of`
    (m,) is the key of each image.
    """

    image: Rows
    column: Rows
    size: int
    pose: Rows
    key: Rows
    key_of: Rows


@dataclass(frozen=True, eq=False)
class StageConstraints:
    """Unknowns of frames as functions of the independent unknowns of poses and stage.

    The independent unknowns are, in this order: all that belong to no frame on the stage, six for each pose,
    the readings that are not known, two for the direction of the axis and two for its position.

    Parameters
    ----------
    frames : Frames
        Frames on the stage, and their unknowns.
    stage : Stage
        The stage.
    """

    frames: Frames
    stage: Stage

    @cached_property
    def rows(self) -> Rows:
        """Unknowns (f, 6) of the frames."""
        return np.asarray(self.frames.column[:, None] + np.arange(6), dtype=np.intp)

    @cached_property
    def others(self) -> Rows:
        """Unknowns that belong to no frame on the stage."""
        own = np.ones(self.frames.size, dtype=bool)
        own[self.rows] = False
        return np.flatnonzero(own).astype(np.intp)

    @cached_property
    def _poses(self) -> tuple[Rows, Rows]:
        """First frame of each pose, and number of the pose (f,) of each frame."""
        _, first, number = np.unique(self.frames.pose, return_index=True, return_inverse=True)
        return first.astype(np.intp), np.asarray(number.ravel(), dtype=np.intp)

    @cached_property
    def pose(self) -> Rows:
        """First column of the pose of each frame (f,)."""
        return np.asarray(len(self.others) + 6 * self._poses[1], dtype=np.intp)

    @cached_property
    def reading(self) -> Rows:
        """Column of the reading of each frame (f,); −1 for one that is known.

        Where no reading of a pose is known or observed, that of its first frame is held: only differences of
        readings have an effect.
        """
        key, number = self.frames.key, self._poses[1]
        sigma = self.stage.sigmas[self.frames.image]
        open_: Mask = sigma != 0
        for pose in range(len(self._poses[0])):
            own = np.flatnonzero(number == pose)
            if np.isnan(sigma[own]).all():
                open_[key == key[own[0]]] = False
        columns = np.full(len(key), -1, dtype=np.intp)
        start = len(self.others) + 6 * len(self._poses[0])
        at = np.unique(key[open_], return_inverse=True)[1]
        columns[open_] = start + at.ravel()
        return columns

    @cached_property
    def readings(self) -> int:
        """Number of unknown readings."""
        return len(np.unique(self.reading[self.reading >= 0]))

    @cached_property
    def direction(self) -> int:
        """First column of the direction of the axis; −1 where it is held."""
        if self.stage.axis_sigma == 0:
            return -1
        return len(self.others) + 6 * len(self._poses[0]) + self.readings

    @cached_property
    def position(self) -> int:
        """First column of the position of a rotary axis; −1 without one, or where it is held."""
        if not self.stage.rotary or self.stage.point_sigma == 0:
            return -1
        return len(self.others) + 6 * len(self._poses[0]) + self.readings + 2 * (self.direction >= 0)

    @cached_property
    def size(self) -> int:
        """Number of independent unknowns."""
        start = len(self.others) + 6 * len(self._poses[0]) + self.readings
        return start + 2 * (self.direction >= 0) + 2 * (self.position >= 0)

    @property
    def own(self) -> slice:
        """Columns of readings and axis."""
        return slice(len(self.others) + 6 * len(self._poses[0]), self.size)

    def names(self, others: tuple[str, ...], images: tuple[str, ...]) -> tuple[str, ...]:
        """Names (size,) of the independent unknowns, from those of the others and of the images."""
        names = [others[k] for k in self.others]
        for first in self._poses[0]:
            image = images[self.frames.image[first]]
            names += [f"{name} of the pose of image {image}" for name in ("dx", "dy", "dz", "X0", "Y0", "Z0")]
        names += [""] * (self.size - len(names))
        for k, column in enumerate(self.reading.tolist()):
            if column >= 0:
                names[column] = f"reading of image {images[self.frames.image[k]]}"
        for start, what in ((self.direction, "direction"), (self.position, "position")):
            if start >= 0:
                names[start : start + 2] = [f"{what} of the axis"] * 2
        return tuple(names)

    def matrix(self, moved: StageValues, rotation: Array, x0: Array) -> Array:
        """Compute T (u, size) at given values, with the orientations (f, 3, 3) and (f, 3) of the frames."""
        t = np.zeros((self.frames.size, self.size))
        t[self.others, np.arange(len(self.others))] = 1.0
        row, stage = self.rows, self.stage
        at = self.pose[:, None] + np.arange(6)
        t[row[:, :3], at[:, :3]] = 1.0
        angle = stage.sign * moved.reading[self.frames.image]
        across, read = perpendicular(moved.axis), np.flatnonzero(self.reading >= 0)
        if not stage.rotary:
            t[row[:, 3:], at[:, 3:]] = 1.0
            t[row[read, 3:], self.reading[read, None]] = -stage.sign * moved.axis
            if self.direction >= 0:
                columns = self.direction + np.arange(2)
                t[row[:, 3:, None], columns] = -angle[:, None, None] * across
            return t
        back = np.swapaxes(stage.turns(moved, self.frames.image), 1, 2)
        t[row[:, 3:, None], at[:, None, 3:]] = back
        away = x0 - moved.point
        t[row[read, :3], self.reading[read, None]] = stage.sign * (rotation[read] @ moved.axis)
        t[row[read, 3:], self.reading[read, None]] = stage.sign * np.cross(away[read], moved.axis)
        if self.direction >= 0:
            columns = self.direction + np.arange(2)
            zeta = np.sin(angle)[:, None, None] * across
            zeta = zeta - (1 - np.cos(angle))[:, None, None] * np.cross(moved.axis, across, axisb=0, axisc=0)
            t[row[:, :3, None], columns] = rotation @ zeta
            t[row[:, 3:, None], columns] = np.cross(away[:, None, :], np.swapaxes(zeta, 1, 2)).swapaxes(1, 2)
        if self.position >= 0:
            columns = self.position + np.arange(2)
            t[row[:, 3:, None], columns] = (np.eye(3) - back) @ across
        return t

    def slopes(self, moved: StageValues, reading: Rows, tilt: Array, shift: Array, nominal: Array) -> Array:
        """Derivatives (a, size) of the observed readings, and of the observed components of the axis.

        Parameters
        ----------
        reading : ndarray of int (r,)
            Images of the observed readings.
        tilt, shift : ndarray (3, 2) or (3, 0)
            Directions along which components of direction and position of the axis are observed.
        nominal : ndarray (3,)
            Nominal position of the axis.
        """
        slopes = np.zeros((len(reading) + tilt.shape[1] + shift.shape[1], self.size))
        column_of = dict(zip(self.frames.key.tolist(), self.reading.tolist(), strict=True))
        for k, image in enumerate(reading.tolist()):
            column = column_of.get(int(self.frames.key_of[image]), -1)
            if column >= 0:
                slopes[k, column] = 1.0
        across, k = perpendicular(moved.axis), len(reading)
        if tilt.shape[1] and self.direction >= 0:
            slopes[k : k + 2, self.direction : self.direction + 2] = tilt.T @ across
        k += tilt.shape[1]
        if shift.shape[1] and self.position >= 0:
            along = float(moved.axis @ (moved.point - nominal))
            slopes[k : k + 2, self.position : self.position + 2] = shift.T @ across
            if self.direction >= 0:
                bend = np.outer(shift.T @ moved.axis, (nominal - moved.point) @ across)
                slopes[k : k + 2, self.direction : self.direction + 2] = bend - along * (shift.T @ across)
        return slopes

    def stepped(
        self, moved: StageValues, rotation: Array, x0: Array, q: Array
    ) -> tuple[StageValues, Array, Array]:
        """Return values, and orientations (f, 3, 3) and (f, 3) of the frames, after a correction."""
        image, (first, number) = self.frames.image, self._poses
        turn, at = self.stage.at_rest(moved, image[first], rotation[first], x0[first])
        step = q[len(self.others) : len(self.others) + 6 * len(first)].reshape(-1, 6)
        turn, at = rotation_matrix(step[:, :3]) @ turn, at + step[:, 3:]
        by_key = {
            int(key): float(q[column])
            for key, column in zip(self.frames.key, self.reading, strict=True)
            if column >= 0
        }
        change = np.array([by_key.get(int(key), 0.0) for key in self.frames.key_of])
        across, axis, point = perpendicular(moved.axis), moved.axis, moved.point
        if self.position >= 0:
            point = point + across @ q[self.position : self.position + 2]
        if self.direction >= 0:
            axis = axis + across @ q[self.direction : self.direction + 2]
            axis = axis / np.linalg.norm(axis)
        new = StageValues(moved.reading + change, axis, point)
        if self.position >= 0:
            # The point next to the origin of reduced coordinates: the position is best determined there.
            new = new._replace(point=new.foot(np.zeros(3)))
        return new, *self.stage.images(new, image, turn[number], at[number])

    def changes(self, moved: StageValues) -> Array:
        """Changes (k, 7) of the unknowns of the stage, :attr:`own`, by a small shift, rotation and scale."""
        change = np.zeros((self.size, 7))
        across = perpendicular(moved.axis).T
        if self.direction >= 0:
            change[self.direction : self.direction + 2, 3:6] = across @ -cross_matrix(moved.axis)
        if self.position >= 0:
            rows = slice(self.position, self.position + 2)
            change[rows, :3] = across
            change[rows, 3:6] = across @ -cross_matrix(moved.point)
            change[rows, 6] = across @ moved.point
        if not self.stage.rotary:
            read = self.reading >= 0
            change[self.reading[read], 6] = moved.reading[self.frames.image[read]]
        return change[self.own]

    def held(self, columns: Mask) -> Mask:
        """Return the held independent unknowns (size,) from the held unknowns (u,) of frames and others."""
        held = np.zeros(self.size, dtype=bool)
        held[: len(self.others)] = columns[self.others]
        at = self.pose[:, None] + np.arange(6)
        held[at[columns[self.rows]]] = True
        return held
