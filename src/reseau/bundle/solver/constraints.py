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
from ...optics.poses import cross_matrix, rotation_matrix
from ..network.network import Network
from ..network.rig import Rig, RigValues
from ..network.stage import StageValues
from .stage_constraints import Frames, StageConstraints
from .unknowns import Unknowns


@dataclass(frozen=True, eq=False)
class RigConstraints:
    """Reduced unknowns of images as functions of the independent unknowns of exposures and cameras.

    The independent unknowns are, in this order: all that belong to no image of the rig, six for each
    exposure, and six for each camera that is not a reference.

    Parameters
    ----------
    unknowns : Unknowns
        Columns of the reduced normal equations, with an orientation for each image.
    rig : Rig
        The rig.
    """

    unknowns: Unknowns
    rig: Rig

    @cached_property
    def images(self) -> Rows:
        """Adjusted images (a,) of the rig."""
        return np.flatnonzero((self.unknowns.pose >= 0) & (self.rig.exposure >= 0)).astype(np.intp)

    @cached_property
    def others(self) -> Rows:
        """Reduced unknowns that belong to no image of the rig."""
        own = np.ones(self.unknowns.size, dtype=bool)
        own[self._rows] = False
        own[self._mounted[0].ravel()] = False
        return np.flatnonzero(own).astype(np.intp)

    @cached_property
    def _rows(self) -> Rows:
        """Reduced unknowns (a, 6) of the images."""
        return np.asarray(self.unknowns.pose[self.images, None] + np.arange(6), dtype=np.intp)

    @cached_property
    def _numbers(self) -> tuple[Rows, Rows]:
        """Number of the exposure (a,) of each image, and the first image of each exposure.

        Cameras that are not connected with each other have exposures of their own.
        """
        reference = self.references[self.rig.camera[self.images]]
        key = np.stack([self.rig.exposure[self.images], reference], axis=1)
        _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        return np.asarray(number.ravel(), dtype=np.intp), np.asarray(first, dtype=np.intp)

    @cached_property
    def references(self) -> Rows:
        """Camera (c,) whose axes the place of each refers to."""
        return self.rig.references(self.unknowns.pose >= 0)

    @cached_property
    def cameras(self) -> Rows:
        """Cameras with unknown places: those of adjusted images that are no reference."""
        used = np.unique(self.rig.camera[self.images])
        return np.asarray(used[self.references[used] != used], dtype=np.intp)

    @cached_property
    def _camera_column(self) -> Rows:
        """First column of the place of the camera of each image (a,); −1 for a reference."""
        number = np.full(int(self.rig.camera.max()) + 1, -1, dtype=np.intp)
        exposures = len(self._numbers[1])
        number[self.cameras] = len(self.others) + 6 * (exposures + np.arange(len(self.cameras)))
        return np.asarray(number[self.rig.camera[self.images]], dtype=np.intp)

    @cached_property
    def _mounted(self) -> tuple[Rows, Rows]:
        """Cameras before windows on the rig: their columns (k, 6) among the reduced unknowns, and numbers."""
        cameras = np.flatnonzero(self.unknowns.mount >= 0)
        columns = self.unknowns.mount[cameras, None] + np.arange(6)
        return columns.astype(np.intp), np.searchsorted(self.cameras, cameras).astype(np.intp)

    @cached_property
    def size(self) -> int:
        """Number of independent unknowns."""
        return len(self.others) + 6 * (len(self._numbers[1]) + len(self.cameras))

    @property
    def exposures(self) -> tuple[Rows, Rows]:
        """First image (e,) of each exposure, and the first of its six independent unknowns (e,)."""
        first = self._numbers[1]
        return self.images[first], len(self.others) + 6 * np.arange(len(first), dtype=np.intp)

    def orientations(self, places: RigValues, rotation: Array, x0: Array) -> tuple[Array, Array]:
        """Orientations (e, 3, 3) and (e, 3) of the exposures, from their first images."""
        first = self.images[self._numbers[1]]
        camera = self.rig.camera[first]
        turn = np.swapaxes(places.rotation[camera], 1, 2) @ rotation[first]
        base = (places.base[camera][:, None, :] @ turn)[:, 0]
        return np.asarray(turn), np.asarray(x0[first] - base)

    def matrix(self, places: RigValues, rotation: Array, x0: Array) -> Array:
        """Compute T (u, size) at given values."""
        t = np.zeros((self.unknowns.size, self.size))
        t[self.others, np.arange(len(self.others))] = 1.0
        block, row = self.blocks(places, rotation, x0)[self.images], self._rows
        at = len(self.others) + 6 * self._numbers[0][:, None] + np.arange(6)
        t[row[:, :, None], at[:, None, :]] = block[:, :, :6]
        moving = self._camera_column >= 0
        at = self._camera_column[moving, None] + np.arange(6)
        t[row[moving, :, None], at[:, None, :]] = block[moving, :, 6:]
        columns, camera = self._mounted
        start = len(self.others) + 6 * len(self._numbers[1])
        t[columns, start + 6 * camera[:, None] + np.arange(6)] = 1.0
        return t

    def blocks(self, places: RigValues, rotation: Array, x0: Array) -> Array:
        """Derivatives (m, 6, 12) of the pose of each image by its exposure and by the place of its camera."""
        turn, _ = self.orientations(places, rotation, x0)
        number, camera = self._numbers[0], self.rig.camera[self.images]
        back = np.swapaxes(turn[number], 1, 2)
        block = np.zeros((len(self.unknowns.pose), 6, 12))
        block[:, np.arange(6), np.arange(6)] = 1.0
        own = np.zeros((len(self.images), 6, 12))
        own[:, :3, :3] = places.rotation[camera]
        own[:, 3:, :3] = back @ cross_matrix(places.base[camera])
        own[:, np.arange(3, 6), np.arange(3, 6)] = 1.0
        own[:, np.arange(3), np.arange(6, 9)] = 1.0
        own[:, 3:, 9:] = back
        block[self.images] = own
        return block

    @cached_property
    def columns(self) -> tuple[Rows, Rows, Rows]:
        """First independent unknown of the pose of each image (m,), and of the place of its camera (m,).

        For images that are not of the rig, that of their own pose, and −1 for none. Last the independent
        unknown (u,) that each reduced one is, −1 for those of images of the rig.
        """
        to = np.full(self.unknowns.size, -1, dtype=np.intp)
        to[self.others] = np.arange(len(self.others))
        pose = np.where(self.unknowns.pose >= 0, to[np.maximum(self.unknowns.pose, 0)], -1)
        pose[self.images] = len(self.others) + 6 * self._numbers[0]
        place = np.full(len(pose), -1, dtype=np.intp)
        place[self.images] = self._camera_column
        return pose, place, to

    def slopes(self, places: RigValues, cameras: Rows) -> Array:
        """Derivatives (b, size) of the distances of pairs of cameras (b, 2)."""
        slopes = np.zeros((len(cameras), self.size))
        start = len(self.others) + 6 * len(self._numbers[1]) + 3
        column = {int(camera): start + 6 * k for k, camera in enumerate(self.cameras)}
        for row, (a, b) in zip(slopes, cameras.tolist(), strict=True):
            along = places.base[b] - places.base[a]
            along = along / np.linalg.norm(along)
            for camera, slope in ((a, -along), (b, along)):
                if camera in column:
                    row[column[camera] : column[camera] + 3] = slope
        return slopes

    def stepped(
        self,
        places: RigValues,
        rotation: Array,
        x0: Array,
        q: Array,
        given: tuple[Rows, Array, Array] | None = None,
    ) -> tuple[RigValues, Array, Array]:
        """Return places, rotations and projection centres (m, …) after a correction.

        `given` are exposures with their new orientations, of a stage.
        """
        turn, at = self.orientations(places, rotation, x0)
        step = q[len(self.others) :].reshape(-1, 6)
        count = len(turn)
        by_base = step[count:, 3:]
        new = RigValues(places.rotation.copy(), places.base.copy())
        new.rotation[self.cameras] = rotation_matrix(step[count:, :3]) @ places.rotation[self.cameras]
        new.base[self.cameras] += by_base
        turn, at = rotation_matrix(step[:count, :3]) @ turn, at + step[:count, 3:]
        if given is not None:
            rows, turn[rows], at[rows] = given[0], given[1], given[2]
        rotation, x0 = rotation.copy(), x0.copy()
        number, camera = self._numbers[0], self.rig.camera[self.images]
        rotation[self.images], x0[self.images] = self.rig.images(new, turn[number], at[number], camera)
        return new, rotation, x0

    def held(self, columns: Mask) -> Mask:
        """Return the held independent unknowns (size,) from the held reduced unknowns (u,)."""
        held = np.zeros(self.size, dtype=bool)
        held[: len(self.others)] = columns[self.others]
        own = columns[self._rows]
        at = len(self.others) + 6 * self._numbers[0][:, None] + np.arange(6)
        held[at[own]] = True
        return held

    def names(
        self, images: tuple[str, ...], cameras: tuple[str, ...], others: tuple[str, ...]
    ) -> tuple[str, ...]:
        """Names (size,) of the independent unknowns, from those of images, cameras and other unknowns."""
        names = [others[k] for k in self.others]
        own = ("dx", "dy", "dz", "X0", "Y0", "Z0")
        for image in self.exposures[0]:
            names += [f"{name} of the exposure of image {images[image]}" for name in own]
        for camera in self.cameras:
            names += [f"{name} of {cameras[camera]} on the rig" for name in own]
        return tuple(names)

    def by_reduced(self, t: Array) -> Array:
        """Derivatives (k, 6, u) of the places of the cameras by the reduced unknowns.

        Rotations are about the axes of the camera, centres in those of the rig.
        """
        rows, count = self._rows.ravel(), len(self.cameras)
        back = np.linalg.pinv(t[rows][:, len(self.others) :])
        found = np.zeros((count, 6, len(t)))
        found[:, :, rows] = back[len(back) - 6 * count :].reshape(count, 6, len(rows))
        return found


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
