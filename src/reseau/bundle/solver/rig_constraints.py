"""Normal equations with a rig: images of an exposure are taken by cameras that are fixed to each other.

With small rotations ω about the axes of a camera (or of the rig), an image R = R_c R_e, X0 = X_e + R_eᵀ b_c
has the corrections

    ω = ω_c + R_c ω_e,    dX0 = dX_e + R_eᵀ ([b_c]× ω_e + db_c),

linear in the independent unknowns q of exposures and cameras: y = T q, and the normal equations that have
been formed with a separate orientation for every image become Tᵀ S T q = −Tᵀ s, as with a stage
(:mod:`reseau.bundle.solver.stage_constraints`). A ray through a window on the rig depends on ω_c and db_c
besides, by columns of its own: in T these are the same as the unknowns of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.data import Array, Mask, Rows
from ...optics.poses import rotation_matrix
from ..network.rig import Rig, RigValues
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
        own[:, 3:, :3] = back @ _cross(places.base[camera])
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

    def cofactors(self, t: Array, reduced: Array) -> Array:
        """Cofactors (k, 6, k, 6) of the places of the cameras, from those of the reduced unknowns (u, u).

        Rotations are about the axes of the camera, centres in those of the rig.
        """
        rows, count = self._rows.ravel(), len(self.cameras)
        back = np.linalg.pinv(t[rows][:, len(self.others) :])
        back = back[len(back) - 6 * count :]
        return np.asarray(back @ reduced[np.ix_(rows, rows)] @ back.T).reshape(count, 6, count, 6)


def _cross(vectors: Array) -> Array:
    """Matrices (n, 3, 3) of the vector product with vectors (n, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)
