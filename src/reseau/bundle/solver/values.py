"""Values of all unknowns of a network, and their correction."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ...core.data import Array, Rows
from ...optics.poses import rotation_matrix
from ..network.rig import RigValues
from ..network.stage import StageValues
from .constraints import Constraints, Placed
from .imaging import Orientation
from .unknowns import Unknowns


@dataclass(frozen=True, eq=False)
class Correction:
    """A correction of the unknowns and the decrease it predicts.

    Parameters
    ----------
    reduced : ndarray (u,)
        Correction of the reduced unknowns.
    points : ndarray (p, 3)
        Correction of the eliminated points.
    predicted : float
        Decrease of the weighted sum of squares, to first order.
    length : float
        Length of the correction, in the metric of the damping.
    independent : ndarray, optional
        Correction of the independent unknowns, with a stage or a rig.
    complete : bool
        Whether the normal equations were solved as accurately as asked for.
    """

    reduced: Array
    points: Array
    predicted: float
    length: float = 0.0
    independent: Array | None = None
    complete: bool = True

    def times(self, factor: float) -> Correction:
        """Return a part of the correction."""
        own = None if self.independent is None else factor * self.independent
        return replace(
            self, reduced=factor * self.reduced, points=factor * self.points, independent=own,
            length=abs(factor) * self.length,
        )  # fmt: skip

    def plus(self, other: Correction) -> Correction:
        """Return the sum of two corrections, with the decrease that the first predicts."""
        own = None
        if self.independent is not None and other.independent is not None:
            own = self.independent + other.independent
        return replace(
            self, reduced=self.reduced + other.reduced, points=self.points + other.points, independent=own
        )


@dataclass(frozen=True, eq=False)
class Values:
    """Values of the unknowns.

    Parameters
    ----------
    rotation : ndarray (m, 3, 3)
        Rotations from object to camera.
    x0 : ndarray (m, 3)
        Projection centres.
    xyz : ndarray (p, 3)
        Object points.
    cameras : ndarray (c, p)
        Parameters of the cameras, padded to the longest.
    extra : ndarray (e, a)
        Sets of additional parameters; at least one row.
    stage : StageValues, optional
        Readings and axis of a stage.
    refraction : ndarray (r,)
        Parameters of all windows and media.
    rig : RigValues, optional
        Places of the cameras on a rig.
    motion : ndarray (m, 6)
        Velocities and rotation rates of the images.
    """

    rotation: Array
    x0: Array
    xyz: Array
    cameras: Array
    extra: Array
    stage: StageValues | None = None
    refraction: Array = field(default_factory=lambda: np.zeros(0))
    rig: RigValues | None = None
    motion: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @classmethod
    def of_cameras(cls, unknowns: Unknowns, rotation: Array, x0: Array, xyz: Array) -> Values:
        """Create values with the parameters of cameras, windows and media of the network."""
        network = unknowns.network
        cameras = np.zeros(unknowns.free.shape)
        for row, camera in zip(cameras, network.cameras, strict=True):
            row[: len(camera.values)] = camera.values
        extra = np.zeros((max(1, len(unknowns.extra)), unknowns.extra_width))
        bent = network.refraction
        refraction = np.zeros(0) if bent is None else bent.values
        return cls(rotation, x0, xyz, cameras, extra, refraction=refraction, motion=network.motions)

    @property
    def orientation(self) -> Orientation:
        """Poses and points for the compiled loops."""
        return Orientation(self.rotation, self.x0, self.xyz, self.motion)

    @property
    def placed(self) -> Placed:
        """Orientations of the images, and values of a rig and of a stage."""
        return Placed(self.rotation, self.x0, self.rig, self.stage)

    def shifted(self, by: Array) -> Values:
        """Return the values with coordinates that are larger by a vector (3,)."""
        stage = self.stage
        if stage is not None:
            stage = stage._replace(point=stage.point + by)
        return replace(self, x0=self.x0 + by, xyz=self.xyz + by, stage=stage)

    def beyond(self, radius: float) -> Rows:
        """Return the points farther than `radius` from the origin."""
        return np.flatnonzero(~(np.linalg.norm(self.xyz, axis=1) <= radius)).astype(np.intp)

    def confined(self, points: Rows, radius: float) -> Values:
        """Return the values with these points moved to the distance `radius` from the origin."""
        xyz = self.xyz.copy()
        xyz[points] *= radius / np.linalg.norm(xyz[points], axis=1, keepdims=True)
        return replace(self, xyz=xyz)

    def moved(
        self,
        unknowns: Unknowns,
        step: Correction,
        constraints: Constraints | None = None,
    ) -> Values:
        """Return the values after a correction; rotations are about the camera axes."""
        y = step.reduced
        images = unknowns.pose >= 0
        pose = np.zeros((len(images), 6))
        pose[images] = y[unknowns.pose[images, None] + np.arange(6)]
        # Projection centres of parallel rays move along the axes of the camera.
        along = images & unknowns.network.parallel
        pose[along, 3:] = np.einsum("nji,nj->ni", self.rotation[along], pose[along, 3:])
        rotation = self.rotation.copy()
        rotation[images] = rotation_matrix(pose[images, :3]) @ self.rotation[images]
        cameras, extra, xyz = self.cameras.copy(), self.extra.copy(), self.xyz + step.points
        for c in np.flatnonzero(unknowns.camera >= 0):
            count = unknowns.count[c]
            cameras[c, unknowns.free[c, :count]] += y[unknowns.camera[c] : unknowns.camera[c] + count]
        for e in np.flatnonzero(unknowns.extra >= 0):
            count = unknowns.extra_count[e]
            extra[e, :count] += y[unknowns.extra[e] : unknowns.extra[e] + count]
        kept, columns = unknowns.kept_points
        xyz[kept] += y[columns]
        x0, stage, rig = self.x0 + pose[:, 3:], self.stage, self.rig
        if constraints is not None and step.independent is not None:
            at, own = constraints.stepped(self.placed, step.independent), constraints.images
            rotation[own], x0[own] = at.rotation[own], at.x0[own]
            rig, stage = at.rig, at.stage
        refraction = self.refraction.copy()
        refraction[unknowns.refracting] += y[unknowns.refraction_columns]
        motion = self.motion.copy()
        moving = unknowns.motion >= 0
        motion[moving] += y[unknowns.motion[moving, None] + np.arange(6)]
        return Values(rotation, x0, xyz, cameras, extra, stage, refraction, rig, motion)
