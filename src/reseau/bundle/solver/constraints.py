"""Orientations of images as functions of fewer unknowns: those of a rig, of a stage, or of a rig on a stage.

The unknowns of the images are y = T q. Of a rig on a stage T is the product of that of the rig, from
exposures to images, and that of the stage, from poses to exposures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ..network.network import Network
from ..network.rig import RigValues
from ..network.stage import StageValues
from .rig_constraints import RigConstraints
from .stage_constraints import Frames, StageConstraints
from .unknowns import Unknowns


class Constrained(NamedTuple):
    """Normal equations of the independent unknowns.

    `back` is T (u, size), `matrix` is (size, size); `own` is the gradient (size,) of the observations of rig
    and stage only, `gradient` that of all observations.
    """

    back: Array
    matrix: Array
    own: Array
    gradient: Array


class Placed(NamedTuple):
    """Orientations (m, 3, 3) and (m, 3) of the images, and values of a rig and of a stage."""

    rotation: Array
    x0: Array
    rig: RigValues | None
    stage: StageValues | None


@dataclass(frozen=True, eq=False)
class Constraints:
    """Reduced unknowns of images as functions of the independent unknowns of a rig, of a stage, or of both.

    Parameters
    ----------
    rig : RigConstraints, optional
        Of a rig.
    stage : StageConstraints, optional
        Of a stage that moves images, or exposures of the rig.
    """

    rig: RigConstraints | None
    stage: StageConstraints | None

    @classmethod
    def of(cls, unknowns: Unknowns) -> Self | None:
        """Create the constraints of a network; None without a rig and a stage."""
        network = unknowns.network
        rig = None if network.rig is None else RigConstraints(unknowns, network.rig)
        frames = None if network.stage is None else _frames(network, unknowns, rig)
        stage = None
        if network.stage is not None and frames is not None and len(frames.image):
            stage = StageConstraints(frames, network.stage)
        return None if rig is None and stage is None else cls(rig, stage)

    @property
    def size(self) -> int:
        """Number of independent unknowns."""
        if self.stage is not None:
            return self.stage.size
        return 0 if self.rig is None else self.rig.size

    @cached_property
    def exposures(self) -> Rows:
        """Exposures (f,) of a rig that are on the stage, by number."""
        if self.rig is None or self.stage is None:
            return np.zeros(0, dtype=np.intp)
        return np.searchsorted(self.rig.exposures[1], self.stage.frames.column).astype(np.intp)

    def _on_stage(self, at: Placed) -> tuple[Array, Array]:
        """Orientations (f, 3, 3) and (f, 3) of the frames on the stage."""
        if self.rig is not None and at.rig is not None:
            turn, x0 = self.rig.orientations(at.rig, at.rotation, at.x0)
            return turn[self.exposures], x0[self.exposures]
        rows = np.zeros(0, dtype=np.intp) if self.stage is None else self.stage.frames.image
        return at.rotation[rows], at.x0[rows]

    def matrix(self, at: Placed) -> Array:
        """Compute T (u, size) at given values."""
        t = None
        if self.rig is not None and at.rig is not None:
            t = self.rig.matrix(at.rig, at.rotation, at.x0)
        if self.stage is not None and at.stage is not None:
            own = self.stage.matrix(at.stage, *self._on_stage(at))
            t = own if t is None else t @ own
        return np.eye(self.size) if t is None else t

    def stepped(self, at: Placed, q: Array) -> Placed:
        """Return the values after a correction of the independent unknowns."""
        given, stage = None, at.stage
        rotation, x0 = at.rotation.copy(), at.x0.copy()
        if self.stage is not None and stage is not None:
            stage, turn, centre = self.stage.stepped(stage, *self._on_stage(at), q)
            if self.rig is None:
                rows = self.stage.frames.image
                rotation[rows], x0[rows] = turn, centre
                return Placed(rotation, x0, at.rig, stage)
            given = (self.exposures, turn, centre)
            step = np.zeros(self.rig.size)
            step[self.stage.others] = q[: len(self.stage.others)]
            q = step
        rig = at.rig
        if self.rig is not None and rig is not None:
            rig, rotation, x0 = self.rig.stepped(rig, at.rotation, at.x0, q, given)
        return Placed(rotation, x0, rig, stage)

    @property
    def sparse(self) -> RigConstraints | None:
        """The rig, where each ray depends on one exposure and one camera, so that T is not needed."""
        if self.stage is not None or self.rig is None or (self.rig.unknowns.mount >= 0).any():
            return None
        return self.rig

    @cached_property
    def images(self) -> Rows:
        """Adjusted images that depend on the constraints."""
        if self.rig is not None:
            return self.rig.images
        return np.zeros(0, dtype=np.intp) if self.stage is None else self.stage.frames.image

    def held(self, columns: Mask) -> Mask:
        """Return the held independent unknowns (size,) from the held reduced unknowns (u,)."""
        if self.rig is not None:
            columns = self.rig.held(columns)
        return columns if self.stage is None else self.stage.held(columns)

    @staticmethod
    def held_for(freedom: Array, t: Array, slopes: Array, diagonal: Array) -> Rows:
        """Choose well-conditioned independent unknowns that fix the datum when they are held.

        Parameters
        ----------
        freedom : ndarray (u, d)
            Changes of the reduced unknowns that no observation determines.
        t : ndarray (u, size)
            See :meth:`matrix`.
        slopes : ndarray (a, size)
            Derivatives of the observations of rig and stage, which these changes do not change.
        diagonal : ndarray (size,)
            Diagonal of the normal equations, to compare unknowns with different units.
        """
        side = np.concatenate([freedom, np.zeros((len(slopes), freedom.shape[1]))])
        changes = np.linalg.lstsq(np.concatenate([t, slopes]), side, rcond=None)[0]
        changes *= np.sqrt(diagonal)[:, None]
        basis, _ = np.linalg.qr(changes / np.linalg.norm(changes, axis=0))
        _, _, order = scipy.linalg.qr(basis.T, mode="economic", pivoting=True)
        return np.sort(order[: freedom.shape[1]]).astype(np.intp)

    def names(self, unknowns: Unknowns) -> tuple[str, ...]:
        """Names (size,) of the independent unknowns, for messages."""
        names, network = unknowns.names, unknowns.network
        if self.rig is not None:
            names = self.rig.names(network.images, tuple(camera.label for camera in network.cameras), names)
        return names if self.stage is None else self.stage.names(names, network.images)


def _frames(network: Network, unknowns: Unknowns, rig: RigConstraints | None) -> Frames:
    """Frames on the stage of a network: its images, or the exposures of its rig."""
    stage, key_of = network.stage, network.same_reading
    pose = np.zeros(0, dtype=np.intp) if stage is None else stage.pose
    if rig is None:
        image = np.flatnonzero((unknowns.pose >= 0) & (pose >= 0)).astype(np.intp)
        column, size, part = unknowns.pose[image], unknowns.size, np.zeros(len(image), dtype=np.intp)
    else:
        image, column = rig.exposures
        on = pose[image] >= 0
        image, column, size = image[on], column[on], rig.size
        part = rig.references[network.camera_of[image]]
    # Cameras that are not connected with each other have poses of their own.
    key = pose[image] * (int(part.max(initial=0)) + 1) + part
    return Frames(image, np.asarray(column, dtype=np.intp), size, key.astype(np.intp), key_of[image], key_of)
