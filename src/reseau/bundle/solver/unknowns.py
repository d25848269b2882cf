"""Columns of the unknowns of a network in the normal equations, and the rays that depend on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from ...core.data import Mask, Rows
from ..network.network import Network
from ..network.shutter import MOTION
from .conjugate import Blocks
from .normal import SEGMENTS, Pattern, locals_of

# A matrix of more unknowns than the first number is factorised as a band where this is narrower than the part
# of them that follows: above many unknowns, and above few.
_BANDS = ((1500, 1 / 4), (200, 1 / 16))
# Copies of the matrix that are in memory at once: of this step, of the one before it, and their factors.
_COPIES = 6
_POINT = ("X", "Y", "Z")
_POSE = ("dx", "dy", "dz", "X0", "Y0", "Z0")
# With parallel rays the projection centre moves along the axes of the camera.
_PARALLEL_POSE = ("dx", "dy", "dz", "shift x", "shift y", "distance")


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Columns of the reduced normal equations: unknowns of single images first, then shared unknowns.

    Parameters
    ----------
    network : Network
        The network.
    active : ndarray of bool (m,)
        Adjusted images.
    pose : ndarray of int (m,)
        First of the six columns of each image: rotation about the camera axes, projection centre.
    camera : ndarray of int (c,)
        First column of the free parameters of each camera.
    extra : ndarray of int (e,)
        First column of each set of additional parameters; −1 for a set that is held.
    extra_of : ndarray of int (m,)
        Set of each image, −1 for none.
    extra_names : tuple of (int, str) (e,)
        Camera and label of each set.
    refraction : int
        First column of the free parameters of windows and media; −1 without any.
    mount : ndarray of int (c,)
        First of the six columns of the place of each camera on a rig on which the rays through a window of
        the rig depend: rotation about the axes of the camera, projection centre; −1 for the others. They
        follow the parameters of windows and media.
    motion : ndarray of int (m,)
        First of the six columns of velocity and rotation rates of each image, −1 for none.
    kept : ndarray of int (p,)
        First of three columns of points that are not eliminated, −1 for the others: those of distances, and
        all where these are few.
    size, bands, bandwidth : int
        Number of columns, number of columns in the band, and number of subdiagonals of the band.
    """

    network: Network
    active: Mask
    pose: Rows
    camera: Rows
    extra: Rows
    extra_of: Rows
    extra_names: tuple[tuple[int, str], ...]
    refraction: int
    mount: Rows
    motion: Rows
    kept: Rows
    size: int
    bands: int
    bandwidth: int

    @classmethod
    def of(cls, network: Network, active: Mask) -> Unknowns:
        """Create the columns for a network with the active images."""
        extra_of, extra_names = _extra_sets(network, active)
        users = np.bincount(network.camera_of[active], minlength=len(network.cameras))
        extra_users = np.bincount(extra_of[active & (extra_of >= 0)], minlength=len(extra_names))
        counts = np.array([len(camera.free) for camera in network.cameras])
        sets = [network.cameras[c].additional for c, _ in extra_names]
        free_extra: Mask = np.array([a is not None and a.free for a in sets], dtype=np.bool_)
        widths = [0 if a is None else len(a.names) for a in sets]
        few = _kept(network, active)
        order, reach = _ordered(network, active, few)
        m = len(network.images)
        pose, camera, motion = np.full(m, -1), np.full(len(users), -1), np.full(m, -1)
        moving: Mask = np.asarray(network.motion_free.any(axis=1))
        extra, at, ends = np.full(len(extra_names), -1), 0, []
        for i in order:
            pose[i] = at
            at += 6
            if moving[i]:
                motion[i] = at
                at += 6
            c, e = network.camera_of[i], extra_of[i]
            if users[c] == 1:
                camera[c] = at
                at += counts[c]
            if e >= 0 and extra_users[e] == 1 and free_extra[e]:
                extra[e] = at
                at += widths[e]
            ends.append(at)
        begins = np.array([0, *ends[:-1]])
        bandwidth = int(max((ends[b] - 1 - begins[a] for a, b in enumerate(reach)), default=0))
        bands = at if any(at > least and bandwidth < part * at for least, part in _BANDS) else 0
        for c in np.flatnonzero(users > 1):
            camera[c] = at
            at += counts[c]
        for e in np.flatnonzero((extra_users > 1) & free_extra):
            extra[e] = at
            at += widths[e]
        bent = 0 if network.refraction is None else int(network.refraction.free.sum())
        mounted = _mounted(network, active)
        refraction, at = at if bent or mounted.any() else -1, at + bent
        mount = np.full(len(users), -1)
        for c in np.flatnonzero(mounted):
            mount[c] = at
            at += 6
        kept = np.full(len(network.points), -1)
        for j in few:
            kept[j] = at
            at += 3
        return cls(
            network, active, pose, camera, extra, extra_of, extra_names, refraction, mount, motion, kept,
            int(at), int(bands), bandwidth if bands else 0,
        )  # fmt: skip

    @cached_property
    def order(self) -> Rows:
        """Observations sorted by points (n,)."""
        return np.argsort(self.network.point_of, kind="stable")

    @cached_property
    def first(self) -> Rows:
        """First ray of each point (p + 1,)."""
        return np.concatenate([[0], np.cumsum(self.network.rays)])

    @cached_property
    def free(self) -> Rows:
        """Rows of the free parameters of each camera (c, p), padded with zeros to the longest."""
        widest = max(len(camera.names) for camera in self.network.cameras)
        rows = np.zeros((len(self.network.cameras), widest), dtype=np.intp)
        for row, camera in zip(rows, self.network.cameras, strict=True):
            row[: len(camera.free)] = [camera.names.index(name) for name in camera.free]
        return rows

    @cached_property
    def count(self) -> Rows:
        """Number of the free parameters of each camera (c,)."""
        return np.array([len(camera.free) for camera in self.network.cameras], dtype=np.intp)

    @cached_property
    def extra_count(self) -> Rows:
        """Number of parameters of each set of additional parameters (e,)."""
        sets = (self.network.cameras[c].additional for c, _ in self.extra_names)
        return np.array([0 if a is None else len(a.names) for a in sets], dtype=np.intp)

    @property
    def extra_width(self) -> int:
        """Greatest number of parameters of a set of additional parameters; 0 without any."""
        return int(self.extra_count.max(initial=0))

    @cached_property
    def refracting(self) -> Rows:
        """Rows of the free parameters of windows and media (f,)."""
        bent = self.network.refraction
        return np.flatnonzero(np.zeros(0) if bent is None else bent.free).astype(np.intp)

    @property
    def refraction_columns(self) -> slice:
        """Columns of the free parameters of windows and media."""
        return slice(max(self.refraction, 0), max(self.refraction, 0) + len(self.refracting))

    @property
    def mounts(self) -> Rows:
        """Number (c,) of each camera among those with columns of their places; −1 for the others."""
        start = self.refraction_columns.stop
        return np.where(self.mount >= 0, (self.mount - start) // 6, -1).astype(np.intp)

    @property
    def bent_width(self) -> int:
        """Number of derivatives of a ray by windows, media and places of cameras before windows of a rig."""
        return len(self.refracting) + 6 * int((self.mount >= 0).sum())

    @property
    def moving_width(self) -> int:
        """Number of derivatives of a ray by velocity and rotation rates."""
        return 6 * int((self.motion >= 0).any())

    @cached_property
    def distances(self) -> Rows:
        """Columns (k,) of the distances of cameras with parallel rays, which no ray depends on."""
        images = (self.pose >= 0) & self.network.parallel
        return (self.pose[images] + 5).astype(np.intp)

    @cached_property
    def kept_points(self) -> tuple[Rows, Rows]:
        """Points (k,) that are not eliminated, and their columns (k, 3)."""
        points = np.flatnonzero(self.kept >= 0).astype(np.intp)
        return points, self.kept[points, None] + np.arange(3)

    @cached_property
    def dropped(self) -> Mask:
        """Mask of the columns (u,) that are held.

        These are additional parameters held at zero, components of the motion that are not estimated, and
        distances of cameras with parallel rays.
        """
        held = np.zeros(self.size, dtype=bool)
        held[self.distances] = True
        for i in np.flatnonzero(self.motion >= 0):
            held[self.motion[i] + np.flatnonzero(~self.network.motion_free[i])] = True
        for (c, label), at in zip(self.extra_names, self.extra, strict=True):
            extra = self.network.cameras[c].additional
            if at >= 0 and extra is not None and extra.dropped:
                count = len(extra.names)
                held[at : at + count] = [extra.name(k, label) in extra.dropped for k in range(count)]
        return held

    @cached_property
    def blocks(self) -> Blocks:
        """Diagonal blocks: the unknowns of each image, and each set of shared unknowns."""
        users = np.bincount(self.network.camera_of[self.active], minlength=len(self.camera))
        extra_users = np.bincount(
            self.extra_of[self.active & (self.extra_of >= 0)], minlength=len(self.extra)
        )
        starts = (
            self.pose, self.camera[users > 1], self.extra[extra_users > 1], [self.refraction], self.mount[:1],
            self.kept,
        )  # fmt: skip
        return Blocks.of(np.concatenate([np.asarray(own)[np.asarray(own) >= 0] for own in starts]), self.size)

    @property
    def bytes_of_factors(self) -> int:
        """Memory that the matrix of the normal equations, its factors and its inverse take."""
        band = self.bands * (self.bandwidth + 1)
        return 8 * _COPIES * (band + (self.size - self.bands) * self.size)

    @property
    def width(self) -> int:
        """Number of derivatives of a ray."""
        return 6 + int(self.count.max()) + self.moving_width + self.bent_width + self.extra_width + 3

    @cached_property
    def pattern(self) -> Pattern:
        """Unknowns of each ray, in the order of points."""
        return self._pattern(self.pose, self.motion, np.arange(self.size), self.width, self.moving_width)

    def pattern_through(self, pose: Rows, place: Rows, column: Rows) -> Pattern:
        """Return the pattern for other unknowns of the images, with six more derivatives of a ray.

        Parameters
        ----------
        pose, place : ndarray of int (m,)
            First of six unknowns that replace the pose of each image, and of six more, −1 for none. The
            latter take the columns of the motion of cameras.
        column : ndarray of int (u,)
            New number of each of the other unknowns.
        """
        return self._pattern(pose, place, column, self.width + 6, 6)

    def _pattern(self, pose: Rows, motion: Rows, to: Rows, whole: int, moving_width: int) -> Pattern:
        """Pattern with these unknowns of images, others renumbered, of `whole` derivatives of a ray."""

        # A camera without free parameters may begin behind the last column.
        numbers = np.append(to, -1)

        def renumbered(start: Rows) -> Rows:
            return np.where(start >= 0, numbers[np.maximum(start, 0)], -1)

        image, point = self.network.image_of[self.order], self.network.point_of[self.order]
        camera, extra = self.network.camera_of[image], self.extra_of[image]
        n = len(image)
        start, width = np.full((n, SEGMENTS), -1, dtype=np.intp), np.zeros((n, SEGMENTS), dtype=np.intp)
        column = np.zeros((n, SEGMENTS), dtype=np.intp)
        start[:, 0], width[:, 0] = pose[image], 6
        start[:, 1], width[:, 1], column[:, 1] = renumbered(self.camera[camera]), self.count[camera], 6
        if self.extra_names:
            start[:, 2] = renumbered(np.where(extra >= 0, self.extra[extra], -1))
            width[:, 2] = np.where(start[:, 2] >= 0, self.extra_count[extra], 0)
            column[:, 2] = whole - 3 - self.extra_width
        bent = self.network.refraction
        if bent is not None and self.refraction >= 0:
            start[:, 3] = renumbered(np.where(bent.path_of[image] >= 0, self.refraction, -1))
            width[:, 3] = np.where(start[:, 3] >= 0, self.bent_width, 0)
            column[:, 3] = whole - 3 - self.extra_width - self.bent_width
        start[:, 5] = motion[image]
        width[:, 5] = np.where(start[:, 5] >= 0, 6, 0)
        column[:, 5] = whole - 3 - self.extra_width - self.bent_width - moving_width
        start[:, 4] = renumbered(self.kept[point])
        width[:, 4], column[:, 4] = np.where(start[:, 4] >= 0, 3, 0), whole - 3
        # A camera with one image follows its pose: both are one segment.
        alone = np.bincount(self.network.camera_of[self.active], minlength=len(self.camera)) == 1
        joined = alone[camera] & (start[:, 1] == start[:, 0] + 6) & (width[:, 1] > 0)
        width[:, 0] += np.where(joined, width[:, 1], 0)
        width[joined, 1], start[joined, 1] = 0, -1
        place, number, table = locals_of(self.first, start, width)
        at, size, offset = (np.ascontiguousarray(each) for each in table.T)
        local = np.concatenate([[0], np.cumsum(number)])
        # Points with held coordinates have no unknowns: to eliminate them would couple all their images.
        eliminated = ((self.kept < 0) & ~self.network.held.all(axis=1)).astype(np.intp)
        return Pattern(self.first, start, width, column, place, local, at, size, offset, eliminated)

    @cached_property
    def by_rays(self) -> Mask:
        """Points (p,) that their rays and observed coordinates determine, and no distance."""
        chosen: Mask = ~np.asarray(self.network.held.all(axis=1))
        chosen[self.network.distance_of.ravel()] = False
        return chosen

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each column for messages."""
        names = [""] * self.size
        for i, at in enumerate(self.pose):
            if at >= 0:
                own_pose = _PARALLEL_POSE if self.network.parallel[i] else _POSE
                names[at : at + 6] = [f"{name} of image {self.network.images[i]}" for name in own_pose]
            if self.motion[i] >= 0:
                own = [f"{name} of image {self.network.images[i]}" for name in MOTION]
                names[self.motion[i] : self.motion[i] + 6] = own
        for camera, at in zip(self.network.cameras, self.camera, strict=True):
            if at >= 0:
                names[at : at + len(camera.free)] = [f"{name} of camera {camera.id}" for name in camera.free]
        for (c, label), at in zip(self.extra_names, self.extra, strict=True):
            additional = self.network.cameras[c].additional
            if at >= 0 and additional is not None:
                own = [f"{name} of {label}" for name in additional.names]
                names[at : at + len(own)] = own
        if self.network.refraction is not None:
            own = [self.network.refraction.names[row] for row in self.refracting]
            names[self.refraction_columns] = own
        for camera, at in zip(self.network.cameras, self.mount, strict=True):
            if at >= 0:
                names[at : at + 6] = [f"{name} of {camera.label} on the rig" for name in _POSE]
        for j in np.flatnonzero(self.kept >= 0):
            at = self.kept[j]
            names[at : at + 3] = [f"{name} of point {self.network.points[j]}" for name in _POINT]
        return tuple(names)


def _kept(network: Network, active: Mask) -> Rows:
    """Return the points that are not eliminated: those of distances, or all where these are few.

    To eliminate points couples all images that see them. Where there are fewer points than images, as on a
    board, it is cheaper to have the points as unknowns below a band of single images.
    """
    free = np.flatnonzero(~network.held.all(axis=1) & (network.rays > 0))
    images = int(active.sum())
    if (
        _BANDS[-1][0] < 6 * images
        and 0 < len(free) <= images
        and network.rig is None
        and network.stage is None
    ):
        return np.union1d(free, network.distance_of).astype(np.intp)
    return np.unique(network.distance_of)


def _mounted(network: Network, active: Mask) -> Mask:
    """Return the cameras (c,) whose unknown places on a rig move the windows of the rig before them."""
    mounted, bent, rig = np.zeros(len(network.cameras), dtype=bool), network.refraction, network.rig
    if bent is None or rig is None or not bent.on_rig.any():
        return mounted
    used = np.unique(network.camera_of[active & (bent.path_of >= 0) & bent.on_rig[bent.path_of]])
    mounted[used] = rig.references(active)[used] != used
    return mounted


def _extra_sets(network: Network, active: Mask) -> tuple[Rows, tuple[tuple[int, str], ...]]:
    """Return the set of additional parameters of each image, and camera and label of each set."""
    sets: dict[tuple[int, str], int] = {}
    rows = np.full(len(network.images), -1)
    for i in np.flatnonzero(active):
        camera = network.cameras[network.camera_of[i]]
        if camera.additional is None:
            continue
        label = {
            "camera": f"camera {camera.id}",
            "group": f"group {network.groups[i]}",
            "image": f"image {network.images[i]}",
        }[camera.additional.per]
        rows[i] = sets.setdefault((int(network.camera_of[i]), label), len(sets))
    return rows, tuple(sets)


def _ordered(network: Network, active: Mask, kept: Rows) -> tuple[Rows, Rows]:
    """Order the active images for a small bandwidth; return also the last neighbour of each in this order."""
    images = np.flatnonzero(active)
    if 6 * len(images) <= min(least for least, _ in _BANDS):
        return images, np.full(len(images), len(images) - 1)
    # Points that are held or not eliminated couple no images.
    eliminated: Mask = ~np.asarray(network.held.all(axis=1))
    eliminated[kept] = False
    rows = np.flatnonzero(eliminated[network.point_of])
    at = (network.image_of[rows], network.point_of[rows])
    shape = (len(network.images), len(network.points))
    sees = scipy.sparse.csr_array((np.ones(len(rows), np.int32), at), shape=shape)
    common = scipy.sparse.csr_array(sees @ sees.T)[images][:, images]
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(scipy.sparse.csr_matrix(common), symmetric_mode=True)
    turned = scipy.sparse.coo_array(common[order][:, order])
    reach = np.arange(len(images))
    np.maximum.at(reach, turned.col, turned.row)
    return images[order], reach
