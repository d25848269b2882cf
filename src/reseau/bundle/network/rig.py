"""Cameras that are fixed to each other: a rig.

Each exposure has one exterior orientation R_e, X_e (from object space to the rig). A camera has its place on
the rig, a rotation R_c and a projection centre b_c in the axes of the rig, so that its image is taken from

    R = R_c R_e,    X0 = X_e + R_eᵀ b_c .

The rig has the axes of its first camera; where cameras never share an exposure with it, directly or by
others, they form a rig of their own. The adjustment is described in
:mod:`reseau.bundle.solver.constraints`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from .stage import nearest_rotation

# An image was not taken at once with the others of its exposure: the difference of its orientation in the
# median difference, and at least this angle (rad) or this part of the extent of the projection centres.
_FACTOR, _TURNED, _SHIFTED = 8.0, 0.02, 0.1


class RigValues(NamedTuple):
    """Places of the cameras on a rig: rotations (c, 3, 3) and projection centres (c, 3) in its axes."""

    rotation: Array
    base: Array

    def scaled(self, scale: float) -> RigValues:
        """Return the values in another scale of object space."""
        return RigValues(self.rotation, scale * self.base)

    def lengths(self, cameras: Rows) -> Array:
        """Distances (b,) between the projection centres of pairs of cameras (b, 2)."""
        a, b = cameras.T
        return np.asarray(np.linalg.norm(self.base[b] - self.base[a], axis=1))


@dataclass(frozen=True, eq=False)
class Rig:
    """Which images were taken at once by cameras that are fixed to each other.

    Parameters
    ----------
    camera : ndarray of int (m,)
        Number of the camera of each image.
    exposure : ndarray of int (m,)
        Number of the exposure of each image; −1 for images that were not taken on the rig.
    base_of : ndarray of int (b, 2)
        Pairs of cameras whose projection centres have a known distance.
    base : ndarray (b, 2)
        These distances and their standard deviations.

    Raises
    ------
    UsageError
        When a camera has two images of an exposure, or no exposures connect the cameras of a known base.

    Examples
    --------
    >>> rig = Rig(np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]))
    >>> rig.references(np.ones(4, dtype=bool))
    array([0, 0])
    """

    camera: Rows
    exposure: Rows
    base_of: Rows = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    base: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        if self.base_of.shape != (len(self.base), 2) or self.base.shape != (len(self.base_of), 2):
            raise UsageError("requires two cameras, a length and a sigma", where="base of a rig")
        if not (self.base > 0).all():
            raise UsageError("requires a length and a sigma above zero", where="base of a rig")
        if self.camera.shape != self.exposure.shape:
            raise UsageError("requires a camera and an exposure for every image", where="Rig")
        on = self.exposure >= 0
        both = np.stack([self.camera[on], self.exposure[on]], axis=1)
        if len(np.unique(both, axis=0)) < len(both):
            raise UsageError("a camera has two images of one exposure", where="rig")
        reference = self.references(on)
        if any(a == b or reference[a] != reference[b] for a, b in self.base_of):
            raise UsageError("requires two cameras that exposures connect", where="base of a rig")

    def references(self, used: Mask) -> Rows:
        """Camera (c,) whose axes the place of each refers to: the first that exposures lead to.

        Parameters
        ----------
        used : ndarray of bool (m,)
            Images that count.
        """
        _, label = scipy.sparse.csgraph.connected_components(self._shared(used), directed=False)
        first = [int(np.flatnonzero(label == own)[0]) for own in label]
        return np.array(first, dtype=np.intp)

    def _shared(self, known: Mask) -> scipy.sparse.coo_array:
        """Number of exposures (c, c) that two cameras have in common, of known images."""
        count = int(self.camera.max(initial=-1)) + 1
        on = np.flatnonzero((self.exposure >= 0) & known)
        seen = np.zeros((count, int(self.exposure.max(initial=-1)) + 1))
        seen[self.camera[on], self.exposure[on]] = 1.0
        return scipy.sparse.coo_array(seen @ seen.T)

    def approximate(self, rotation: Array, x0: Array) -> tuple[RigValues, Array, Array]:
        """Approximate values from those of the images (m, 3, 3) and (m, 3), NaN where unknown.

        The relative orientation of two cameras is the median one of the exposures they share. An exposure
        takes its orientation from its images. Images that were not oriented follow from the others.
        """
        known = np.isfinite(x0).all(axis=1) & (self.exposure >= 0)
        count = int(self.camera.max()) + 1
        values = RigValues(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))
        shared, reference = self._shared(known), self.references(known)
        for first in np.unique(reference):
            order, before = scipy.sparse.csgraph.breadth_first_order(shared, int(first), directed=False)
            for camera in order[1:]:
                turn, base = self._relative(int(before[camera]), int(camera), known, rotation, x0)
                at = int(before[camera])
                values.rotation[camera] = turn @ values.rotation[at]
                values.base[camera] = values.base[at] + values.rotation[at].T @ base
        rotation, x0 = rotation.copy(), x0.copy()
        for exposure in np.unique(self.exposure[self.exposure >= 0]):
            rows = np.flatnonzero(self.exposure == exposure)
            for own in np.unique(reference[self.camera[rows]]):
                those = rows[reference[self.camera[rows]] == own]
                seen = those[known[those]]
                if not len(seen):
                    continue
                of_rig, centre = self.of_exposure(values, rotation[seen], x0[seen], self.camera[seen])
                rotation[those], x0[those] = self.images(values, of_rig, centre, self.camera[those])
        return values, rotation, x0

    def apart(self, rotation: Array, x0: Array) -> tuple[Rows, float]:
        """Find images that were not taken at once with the others of their exposure.

        Parameters
        ----------
        rotation, x0 : ndarray (m, 3, 3) and (m, 3)
            Orientation of each image by itself; NaN where unknown.

        Returns
        -------
        ndarray of int (k,)
            Images whose orientation is not that of their exposure; of two images both.
        float
            Median angle (rad) between the orientations of an exposure that its images give.
        """
        values, *_ = self.approximate(rotation, x0)
        known = np.isfinite(x0).all(axis=1) & (self.exposure >= 0)
        reference = self.references(known)[self.camera]
        angle, away = np.full(len(known), np.nan), np.full(len(known), np.nan)
        for exposure in np.unique(self.exposure[known]):
            rows = np.flatnonzero(known & (self.exposure == exposure))
            for own in np.unique(reference[rows]):
                those = rows[reference[rows] == own]
                if len(those) < 2:
                    continue
                of_camera = self.camera[those]
                turn = np.swapaxes(values.rotation[of_camera], 1, 2) @ rotation[those]
                at = x0[those] - (values.base[of_camera][:, None, :] @ turn)[:, 0]
                off = turn @ nearest_rotation(np.median(turn, axis=0)).T
                cosine = (np.trace(off, axis1=1, axis2=2) - 1) / 2
                angle[those] = np.arccos(np.clip(cosine, -1.0, 1.0))
                away[those] = np.linalg.norm(at - np.median(at, axis=0), axis=1)
        compared = np.isfinite(angle)
        if not compared.any():
            return np.zeros(0, dtype=np.intp), 0.0
        typical, usual = float(np.median(angle[compared])), float(np.median(away[compared]))
        spread = np.linalg.norm(x0[known] - np.median(x0[known], axis=0), axis=1)
        far = max(_FACTOR * usual, _SHIFTED * float(np.median(spread)))
        with np.errstate(invalid="ignore"):
            odd = (angle > max(_FACTOR * typical, _TURNED)) | (away > far)
        return np.flatnonzero(odd).astype(np.intp), typical

    def without(self, images: Rows) -> Rig:
        """Return the rig with orientations of their own for some images."""
        exposure = self.exposure.copy()
        exposure[images] = -1
        return replace(self, exposure=exposure)

    def _relative(self, one: int, other: int, known: Mask, rotation: Array, x0: Array) -> tuple[Array, Array]:
        """Rotation (3, 3) and centre (3,) of a camera in the axes of another."""
        rows = [np.flatnonzero((self.camera == camera) & known) for camera in (one, other)]
        _, a, b = np.intersect1d(self.exposure[rows[0]], self.exposure[rows[1]], return_indices=True)
        first, second = rows[0][a], rows[1][b]
        turn = rotation[second] @ np.swapaxes(rotation[first], 1, 2)
        base = np.einsum("nij,nj->ni", rotation[first], x0[second] - x0[first])
        return nearest_rotation(np.median(turn, axis=0)), np.asarray(np.median(base, axis=0))

    @staticmethod
    def of_exposure(values: RigValues, rotation: Array, x0: Array, camera: Rows) -> tuple[Array, Array]:
        """Orientation (3, 3) and (3,) of an exposure from images (k, 3, 3) and (k, 3) of it: their mean."""
        turn = nearest_rotation((np.swapaxes(values.rotation[camera], 1, 2) @ rotation).mean(axis=0))
        return turn, np.asarray((x0 - values.base[camera] @ turn).mean(axis=0))

    @staticmethod
    def images(values: RigValues, turn: Array, at: Array, camera: Rows) -> tuple[Array, Array]:
        """Rotations (k, 3, 3) and centres (k, 3) of images of exposures (…, 3, 3) and (…, 3)."""
        base = (values.base[camera][:, None, :] @ turn)[:, 0]
        return np.asarray(values.rotation[camera] @ turn), np.asarray(at + base)
