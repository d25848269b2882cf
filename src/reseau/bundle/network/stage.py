"""A stage that moves the object, or the camera, along or about one axis, which is the same in all poses.

A linear stage shifts the object by the reading s along the unit vector d of its axis, a rotary stage (a
turntable) rotates it by the reading α about the line through p along d. Images of one pose differ by the
reading only: with the orientation R, X of the pose at the reading zero, the camera images the moved object as
a camera at another place images the object at rest,

    linear:  R_i = R,          X_i = X − s d
    rotary:  R_i = R A(α),     X_i = p + A(α)ᵀ (X − p),    A(α) = exp(α [d]×).

A stage that carries the camera, while the object is at rest, has −s and −α instead. The adjustment is
described in :mod:`reseau.bundle.solver.stage_constraints`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from ...optics.poses import rotation_matrix

# Iterations of the approximate axis, and change of its direction (rad) at which they end.
_STEPS, _STILL = 50, 1e-12


class StageValues(NamedTuple):
    """Values of a stage.

    Readings (m,) of the images, displacements in the unit of object space or angles (rad); unit vector (3,)
    of its axis; point (3,) of a rotary axis.
    """

    reading: Array
    axis: Array
    point: Array

    def transformed(self, scale: float, turn: Array, shift: Array) -> StageValues:
        """Return the values in another coordinate system, X' = scale · turn · X + shift."""
        return StageValues(self.reading, turn @ self.axis, scale * turn @ self.point + shift)

    def foot(self, of: Array) -> Array:
        """Return the point (3,) of a rotary axis nearest to a point (3,)."""
        return np.asarray(self.point + self.axis * (self.axis @ (of - self.point)))


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage and its readings.

    Parameters
    ----------
    pose : ndarray of int (m,)
        Pose of each image; images with the same pose differ by their readings only. −1 for images that were
        not taken with the stage.
    reading : ndarray (m,)
        Displacement in each image, in the unit of object space, or angle (rad); NaN where it is not known.
    sigma : float or ndarray (m,)
        Standard deviations of the readings: 0 for a reading that is known, NaN for one that is estimated
        only.
    axis : ndarray (3,), optional
        Nominal direction of the axis in the system of the object; required for a linear stage.
    axis_sigma : float
        Standard deviation (rad) of each of the two angles between the axis and its nominal direction; 0 holds
        the direction, infinity estimates it only.
    kind : {"linear", "rotary"}
        How the stage moves.
    carries : {"object", "camera"}
        What the stage moves.
    point : ndarray (3,), optional
        Nominal position of a point of a rotary axis.
    point_sigma : float
        Standard deviation of the position of the axis in two directions; 0 holds it, infinity estimates it
        only.

    Examples
    --------
    >>> stage = Stage(np.array([0, 0]), np.array([0.0, 10.0]), 0.01, np.array([0.0, 0.0, 1.0]), 1e-3)
    >>> x0 = np.array([[0.0, 0.0, 500.0], [0.3, 0.1, 489.0]])
    >>> _, _, x0 = stage.approximate(np.tile(np.eye(3), (2, 1, 1)), x0)
    >>> x0
    array([[  0.,   0., 500.],
           [  0.,   0., 490.]])

    Four images from a camera at 500 mm while the object turns about the z-axis:

    >>> stage = Stage(np.zeros(4, np.intp), np.radians([0.0, 30.0, 60.0, 90.0]), 0.0, kind="rotary")
    >>> turn = rotation_matrix(stage.reading[:, None] * [0.0, 0.0, 1.0])
    >>> found, _, _ = stage.approximate(turn, np.swapaxes(turn, 1, 2) @ [500.0, 0.0, 0.0])
    >>> found.axis.round(9) + 0.0, bool(np.abs(found.point[:2]).max() < 1e-9)
    (array([0., 0., 1.]), True)
    """

    pose: Rows
    reading: Array
    sigma: Array | float
    axis: Array | None = None
    axis_sigma: float = np.inf
    kind: Literal["linear", "rotary"] = "linear"
    carries: Literal["object", "camera"] = "object"
    point: Array | None = None
    point_sigma: float = np.inf

    def __post_init__(self) -> None:
        if self.pose.shape != self.reading.shape or np.shape(self.sigma) not in ((), self.reading.shape):
            raise UsageError("requires a pose and a reading for every image", where="Stage")
        on = self.pose >= 0
        if not on.any():
            raise UsageError("requires an image that was taken with it", where="Stage")
        sigma = self.sigmas[on]
        if (sigma < 0).any() or np.isinf(sigma).any():
            raise UsageError(
                "must be 0, above 0, or NaN", where="standard deviation of the reading of a stage"
            )
        if (~np.isfinite(self.reading[on]) & ~np.isnan(sigma)).any():
            raise UsageError(
                "must be given where they have a standard deviation", where="readings of a stage"
            )
        for what, given, size in (
            ("direction of the axis", self.axis, self.axis_sigma), ("axis", self.point, self.point_sigma),
        ):  # fmt: skip
            if not size >= 0:
                raise UsageError(
                    "must be 0, above 0, or infinite", where=f"standard deviation of the {what} of a stage"
                )
            if given is None and np.isfinite(size):
                raise UsageError("has a standard deviation, but is not given", where=f"{what} of a stage")
        if np.isfinite(self.point_sigma) and self.axis is None:
            raise UsageError("requires its direction", where="position of the axis of a stage")
        if self.axis is not None and not np.linalg.norm(self.axis) > 0:
            raise UsageError("must have a length", where="axis of a stage")
        if not self.rotary and (self.axis is None or self.point is not None):
            raise UsageError("requires a direction of its axis, and no point", where="linear stage")

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the readings (m,)."""
        return np.broadcast_to(np.asarray(self.sigma, dtype=np.float64), self.reading.shape)

    @property
    def rotary(self) -> bool:
        """Whether the stage is a turntable."""
        return self.kind == "rotary"

    @property
    def sign(self) -> float:
        """+1 where the stage moves the object, −1 where it moves the camera."""
        return 1.0 if self.carries == "object" else -1.0

    @property
    def tied(self) -> bool:
        """Whether direction or position of the axis are known in the system of the object."""
        return not self.rotary or np.isfinite(self.axis_sigma) or np.isfinite(self.point_sigma)

    def turns(self, moved: StageValues, images: Rows) -> Array:
        """Rotations A (k, 3, 3) of a rotary stage in some images."""
        return rotation_matrix(self.sign * moved.reading[images, None] * moved.axis)

    def at_rest(self, moved: StageValues, images: Rows, rotation: Array, x0: Array) -> tuple[Array, Array]:
        """Orientations (k, 3, 3) and (k, 3) at the reading zero, from those of some images."""
        if not self.rotary:
            return rotation, x0 + self.sign * moved.reading[images, None] * moved.axis
        turn = self.turns(moved, images)
        away = (turn @ (x0 - moved.point)[:, :, None])[:, :, 0]
        return rotation @ np.swapaxes(turn, 1, 2), moved.point + away

    def images(self, moved: StageValues, images: Rows, rotation: Array, x0: Array) -> tuple[Array, Array]:
        """Orientations (k, 3, 3) and (k, 3) of some images, from those at the reading zero."""
        if not self.rotary:
            return rotation, x0 - self.sign * moved.reading[images, None] * moved.axis
        turn = self.turns(moved, images)
        away = ((x0 - moved.point)[:, None, :] @ turn)[:, 0]
        return rotation @ turn, moved.point + away

    def approximate(
        self, rotation: Array, x0: Array, camera: Rows | None = None
    ) -> tuple[StageValues, Array, Array]:
        """Approximate values from the orientations of the images (m, 3, 3) and (m, 3), NaN where unknown.

        Each pose takes the orientation of its first image that is known, of a linear stage, or the mean one.
        Images that were not oriented follow from the others.

        Parameters
        ----------
        camera : ndarray of int (m,), optional
            Cameras on a rig: images of different cameras have different orientations in one pose.
        """
        rotation, x0 = rotation.copy(), x0.copy()
        known = np.isfinite(x0).all(axis=1) & (self.pose >= 0)
        key = self.pose if camera is None else self.pose * (int(camera.max()) + 1) + camera
        key = np.where(self.pose >= 0, key, -1).astype(np.intp)
        if self.rotary:
            moved = self._rotary(rotation, x0, known, key)
        else:
            axis = np.eye(3)[2] if self.axis is None else self.axis
            moved = StageValues(self.reading, axis / np.linalg.norm(axis), np.zeros(3))
        for pose in np.unique(key[known]):
            rows = np.flatnonzero((key == pose) & np.isfinite(moved.reading))
            seen = rows[known[rows]][: None if self.rotary else 1]
            turn, at = self.at_rest(moved, seen, rotation[seen], x0[seen])
            count = len(rows)
            rotation[rows], x0[rows] = self.images(
                moved,
                rows,
                np.tile(nearest_rotation(turn.mean(axis=0)), (count, 1, 1)),
                np.tile(at.mean(axis=0), (count, 1)),
            )
        return moved, rotation, x0

    def _rotary(self, rotation: Array, x0: Array, known: Mask, key: Rows) -> StageValues:
        """Approximate readings, direction and position of a rotary axis."""
        axis = self.direction(rotation, known, key)
        reading = self.angles(rotation, known, key, axis)
        moved = StageValues(reading, axis, np.zeros(3))
        if self.point is not None and self.point_sigma == 0:
            return moved._replace(point=self.point)
        # p (I − A) − X = −A X_i, with one X for each pose.
        poses = np.unique(key[known])
        rows = np.flatnonzero(known & np.isfinite(reading))
        turn = self.turns(moved, rows)
        design = np.zeros((len(rows), 3, 3 + 3 * len(poses)))
        design[:, :, :3] = np.eye(3) - turn
        number = np.searchsorted(poses, key[rows])
        design[np.arange(len(rows))[:, None], np.arange(3), 3 + 3 * number[:, None] + np.arange(3)] = -1.0
        middle = x0[rows].mean(axis=0) if len(rows) else np.zeros(3)
        side = -(turn @ (x0[rows] - middle)[:, :, None])[:, :, 0]
        found = np.linalg.lstsq(design.reshape(-1, design.shape[2]), side.ravel(), rcond=1e-8)[0]
        return moved._replace(point=middle + found[:3])

    def pairs(self, known: Mask, key: Rows) -> tuple[Rows, Rows]:
        """Pairs of known images of one pose: each with the first of its pose, and with the one before it."""
        one, other = list[int](), list[int]()
        for pose in np.unique(key[known]):
            rows = np.flatnonzero(known & (key == pose))
            one += [int(rows[0])] * (len(rows) - 1) + rows[1:-1].tolist()
            other += rows[1:].tolist() + rows[2:].tolist()
        return np.array(one, dtype=np.intp), np.array(other, dtype=np.intp)

    def direction(
        self, rotation: Array, known: Mask, key: Rows, *, factor: float = 1.0, free: bool = False
    ) -> Array:
        """Direction (3,) of a rotary axis about which the images of a pose are rotated by their readings.

        It maximises the sum of tr(A(α)ᵀ M) over pairs with the relative rotations M, that is of
        dᵀv sin α + dᵀMd (1 − cos α) with the axial vector v of M.

        Parameters
        ----------
        factor : float
            Of the readings.
        free : bool
            Whether to find the direction where it is held as well.
        """
        if self.axis is not None and self.axis_sigma == 0 and not free:
            return np.asarray(self.axis / np.linalg.norm(self.axis))
        a, b = self.pairs(known, key)
        matrix = np.swapaxes(rotation[a], 1, 2) @ rotation[b]
        axial = np.stack([matrix[:, 2, 1] - matrix[:, 1, 2], matrix[:, 0, 2] - matrix[:, 2, 0],
                          matrix[:, 1, 0] - matrix[:, 0, 1]], axis=1)  # fmt: skip
        alpha = factor * self.sign * (self.reading[b] - self.reading[a])
        read = np.isfinite(alpha) & ~np.isnan(self.sigmas[a]) & ~np.isnan(self.sigmas[b])
        if not read.any():
            # Without readings: the common axis of the rotations, in the nominal sense.
            _, vectors = np.linalg.eigh(axial.T @ axial)
            axis = vectors[:, 2]
            towards = (
                axis @ self.axis if self.axis is not None else float(axial.sum(axis=0) @ axis) * self.sign
            )
            return np.asarray(axis if towards >= 0 else -axis)
        linear = (np.sin(alpha[read])[:, None] * axial[read]).sum(axis=0)
        square = ((1 - np.cos(alpha[read]))[:, None, None] * matrix[read]).sum(axis=0)
        square = square + square.T
        _, vectors = np.linalg.eigh(square)
        starts = [linear / (np.linalg.norm(linear) or 1.0), vectors[:, 2], -vectors[:, 2]]
        best, least = starts[1], -np.inf
        for start in starts:
            axis = start
            for _ in range(_STEPS):
                slope = linear + square @ axis + 2.0 * np.abs(square).max() * axis
                new = slope / (np.linalg.norm(slope) or 1.0)
                done = np.linalg.norm(new - axis) < _STILL
                axis = new
                if done:
                    break
            value = float(linear @ axis + axis @ square @ axis / 2)
            if value > least:
                best, least = axis, value
        if not len(a) and self.axis is not None:
            return np.asarray(self.axis / np.linalg.norm(self.axis))
        return np.asarray(best)

    def angles(self, rotation: Array, known: Mask, key: Rows, axis: Array) -> Array:
        """Readings (m,) as given, or, where they are estimated only, of the rotations about the axis."""
        reading = self.reading.copy()
        open_ = (self.pose >= 0) & np.isnan(self.sigmas)
        for pose in np.unique(key[known & open_]):
            rows = np.flatnonzero(known & (key == pose))
            given = rows[~open_[rows]]
            first = given[0] if len(given) else rows[0]
            start = reading[first] if np.isfinite(reading[first]) else 0.0
            for row in rows[open_[rows]]:
                off = rotation[first].T @ rotation[row]
                axial = np.array([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]])
                turn = float(np.arctan2(axial @ axis, np.trace(off) - axis @ off @ axis))
                near = reading[row] if np.isfinite(reading[row]) else start
                angle = start + self.sign * turn
                reading[row] = angle + 2 * np.pi * np.round((near - angle) / (2 * np.pi))
            if not np.isfinite(reading[first]):
                reading[first] = start
        return reading


def perpendicular(axis: Array) -> Array:
    """Return two unit vectors perpendicular to an axis and to each other, as columns (3, 2)."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    one = np.cross(axis, start)
    one /= np.linalg.norm(one)
    return np.column_stack([one, np.cross(axis, one)])


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation (3, 3) next to a mean of rotations."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt)
