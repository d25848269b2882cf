"""Approximate values from the observations alone: resection, relative orientation, growing of the block."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from ...adjust.mixture import Mixture
from ...core.data import Array, Mask, Rows
from ...core.display import Display
from ...core.failure import Code, Remark
from ...optics.poses import rotation_matrix
from ...optics.refraction import RefractedRays
from ...optics.refraction.windows import Refraction
from ..network.network import Network, finite
from .datum import similarity_onto
from .intersection import Rays
from .spatial import (
    Resection,
    behind_ports,
    directions,
    field_of,
    intersect,
    relative_orientation,
    resect,
    resect_through,
)
from .values import Values

# Points are in a plane where their extent across it is this part of the largest.
_FLAT = 1e-4
# Distance of the camera from the points, in their largest extent: any would do.
_AWAY = 3.0
# Subsets of four points that are tried, and points that are consistent with the best one at least.
_TRIES, _FEWEST = 200, 4


def resect_parallel(xyz: Array, uv: Array, tolerance: float) -> Resection | None:
    """Compute the pose of an image with parallel rays from the largest consistent set of points.

    An affine mapping of the points to the image is fitted; the nearest scaled orthographic projection has the
    rotation (Huang & Lee 1989). The scale is not used: the magnification may be known roughly only. Points in
    a plane leave two rotations, mirrored at the image plane, that no single image tells apart; one is
    returned. The distance along the axis is not determined; it is three times the extent of the points.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Object points.
    uv : ndarray (k, 2)
        xc, yc of their rays.
    tolerance : float
        Largest misfit of a consistent point, in the extent of the image points.

    Returns
    -------
    Resection or None
        None where fewer than four points are consistent.

    Examples
    --------
    >>> xyz = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
    >>> found = resect_parallel(xyz, xyz[:, 1::-1] * [1, -1], 0.01)
    >>> found.rotation.round(6) + 0.0
    array([[ 0.,  1.,  0.],
           [-1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    size = float(np.ptp(uv, axis=0).max()) or 1.0
    agree = _consistent(xyz, uv, tolerance * size)
    if agree is None:
        return None
    centre, middle = xyz[agree].mean(axis=0), uv[agree].mean(axis=0)
    _, extent, axes = np.linalg.svd(xyz[agree] - centre)
    flat = extent[2] <= _FLAT * extent[0]
    if extent[1] <= _FLAT * extent[0]:
        return None
    used = axes[:2] if flat else axes
    affine = np.linalg.lstsq((xyz[agree] - centre) @ used.T, uv[agree] - middle, rcond=None)[0].T
    if flat:
        # U diag(1, cos τ) Vᵀ of a plane tilted by τ; across it, sin τ of one sign or the other.
        u, s, vt = np.linalg.svd(affine)
        tilt = u @ np.array([0.0, np.sqrt(max(0.0, 1.0 - (s[1] / s[0]) ** 2))])
        two = np.column_stack([u @ np.diag([1.0, s[1] / s[0]]) @ vt, tilt]) @ axes
    else:
        u, _, vt = np.linalg.svd(affine, full_matrices=False)
        two = (u @ vt) @ axes
    rotation = np.vstack([two, np.cross(two[0], two[1])])
    x0 = centre - rotation.T @ [*middle, _AWAY * max(float(np.ptp(xyz, axis=0).max()), size)]
    return Resection(rotation, x0, agree)


def _consistent(xyz: Array, uv: Array, limit: float) -> Mask | None:
    """Points (k,) that agree with the affine mapping of most of them."""
    design = np.column_stack([xyz - xyz.mean(axis=0), np.ones(len(xyz))])

    def fits(rows: Rows | Mask) -> Mask:
        mapping = np.linalg.lstsq(design[rows], uv[rows], rcond=1e-9)[0]
        return np.asarray(np.linalg.norm(design @ mapping - uv, axis=1) < limit)

    best = fits(np.ones(len(xyz), dtype=bool))
    if not best.all():
        rng = np.random.default_rng(0)
        for _ in range(_TRIES):
            agree = fits(rng.choice(len(xyz), min(5, len(xyz)), replace=False))
            if agree.sum() > best.sum():
                best = agree
    if best.sum() < _FEWEST:
        return None
    again = fits(best)
    return again if again.sum() >= _FEWEST else None


# Smallest singular value of the equations, relative to the largest, with which they have one solution only.
_RANK = 1e-6
# Six points give eleven equations for the quotient and six for the lines.
_LEAST = 6


class Pushbroom(NamedTuple):
    """Rotation (3, 3), projection centre (3,) at time 0, and velocity (3,) along the axes of the camera."""

    rotation: Array
    x0: Array
    velocity: Array


def resect_line(xyz: Array, u: Array, t: Array) -> Pushbroom | None:
    """Compute the pose and the velocity of a line camera that moves straight, from known points.

    A point is seen when it is in the plane of the line: with (a, b, c) = R(X − X0), at the time t = b/vy, and
    there u = (a − vx·t)/(c − vz·t). So t is linear in X, and u is a quotient of linear functions: both follow
    from linear equations (Gupta & Hartley 1997, sect. 4). Here u is known, as the camera is, and the twelve
    numbers give R, X0 and v in closed form.

    Parameters
    ----------
    xyz : ndarray (k, 3)
        Points, at least six, not in one plane.
    u : ndarray (k,)
        Ideal directions along the line.
    t : ndarray (k,)
        Times of the lines on which the points are seen.

    Returns
    -------
    Pushbroom or None
        None where the points do not determine it.

    Examples
    --------
    >>> xyz = np.random.default_rng(1).uniform(-1, 1, (8, 3))
    >>> found = resect_line(xyz, xyz[:, 0] / (xyz[:, 2] + 5.0), xyz[:, 1] / 0.5)
    >>> found.x0.round(6) + 0.0, found.velocity.round(6) + 0.0
    (array([ 0.,  0., -5.]), array([0. , 0.5, 0. ]))
    """
    centre = xyz.mean(axis=0)
    size = float(np.abs(xyz - centre).max()) or 1.0
    x = (xyz - centre) / size
    if len(x) < _LEAST:
        return None
    design = np.column_stack([x, np.ones(len(x))])
    singular = np.linalg.svd(design, compute_uv=False)
    if singular[-1] < _RANK * singular[0]:
        return None
    line = np.linalg.lstsq(design, t, rcond=None)[0]
    # a − vx·t − u·(c − vz·t) = 0, homogeneous in eight numbers.
    _, singular, vt = np.linalg.svd(np.column_stack([design, -u[:, None] * design]))
    if singular[-2] < _RANK * singular[0] or not np.linalg.norm(line[:3]) > 0:
        return None
    above, below = vt[-1, :4], vt[-1, 4:]
    speed = 1.0 / np.linalg.norm(line[:3])
    y = speed * line[:3]
    # Above and below are r1 − (vx/vy) r2 and r3 − (vz/vy) r2, times a factor of either sign.
    z = below[:3] - (below[:3] @ y) * y
    factor = np.linalg.norm(z)
    if not factor > 0:
        return None
    # Points are in front of the camera.
    if np.median(design @ below) < 0:
        above, below, z = -above, -below, -z
    above, below, z = above / factor, below / factor, z / factor
    rotation = np.stack([np.cross(y, z), y, z])
    velocity = speed * np.array([-(above[:3] @ y), 1.0, -(below[:3] @ y)])
    # The constants are those of −R X0.
    shift = np.array([0.0, speed * line[3], 0.0])
    shift[0] = above[3] + velocity[0] * line[3]
    shift[2] = below[3] + velocity[2] * line[3]
    return Pushbroom(rotation, centre - size * (rotation.T @ shift), size * velocity)


# Largest misfit of a direction (rad) that is not a gross error while distortion and principal distance are
# only roughly known.
_LOOSE = 0.03
# Minimum intersection angle (rad) of the rays of a point that is used to orient another image.
_CUT = 0.03
# Pairs of images tried as the first pair.
_PAIRS = 12
# The same while the bend of rays through windows on the object is not known.
_BENT = 0.3
# Number of times the bend is computed anew for points that have just been intersected.
_SETTLING = 6
# Scales at which a free block is compared with the dimensions of its windows.
_SCALES = np.geomspace(1e-4, 1e4, 161)


@dataclass(frozen=True, eq=False, repr=False)
class Approximate(Display):
    """Approximate poses and points.

    Parameters
    ----------
    rotation : ndarray (m, 3, 3)
        Rotations, NaN where none was found.
    x0 : ndarray (m, 3)
        Projection centres, NaN likewise.
    xyz : ndarray (p, 3)
        Points, NaN likewise.
    motion : ndarray (m, 6)
        Velocities and rotation rates, as given or found.
    notes : tuple of Remark
        Warnings about the approximate values.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> approximate(example_network())
    <Approximate: 8 of 8 images, 20 of 20 points>
    """

    rotation: Array
    x0: Array
    xyz: Array
    motion: Array
    notes: tuple[Remark, ...] = ()

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{int(finite(self.x0).sum())} of {len(self.x0)} images", ""),
            (f"{int(finite(self.xyz).sum())} of {len(self.xyz)} points", ""),
        ]


def approximate(network: Network) -> Approximate:
    """Compute approximate values of poses and points.

    Parameters
    ----------
    network : Network
        The network, with known poses and coordinates.

    Returns
    -------
    Approximate
        Given poses are kept. Others are resected from known and intersected points. Where nothing is known,
        the block grows from the pair of images with the most points and the best intersection angles, and is
        transformed to the control points by a similarity.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> np.abs(approximate(example_network()).x0[0].round(2))
    array([2.2, 0. , 4. ])
    """
    block = _Block(network)
    found, begun = block.grown(), finite(network.x0).any()
    if not begun and block.known.sum() > 2 and block.gross().any():
        # Few control points in an image may agree with a wrong pose: the block that explains more is right.
        other = _Block(network)
        again = other.grown(by_control=False)
        if other.evidence() > block.evidence():
            return again
    return found


def _with_windows_on_cameras(network: Network) -> Network:
    """The network with windows of a rig on each camera, where the approximate poses have it.

    Without poses, the window is as far before each camera as before the first.
    """
    bent, rig = network.refraction, network.rig
    if bent is None or rig is None or not bent.on_rig.any():
        return network
    rotation, x0 = np.tile(np.eye(3), (len(network.images), 1, 1)), np.full_like(network.x0, np.nan)
    posed = network.posed
    rotation[posed], x0[posed] = rotation_matrix(network.rotation[posed]), network.x0[posed]
    places, _, _ = rig.approximate(rotation, x0)
    return replace(network, refraction=bent.on_cameras(network.camera_of, places.rotation, places.base))


class _Block:
    """A block to which images are added one by one."""

    def __init__(self, network: Network) -> None:
        self.network = network = _with_windows_on_cameras(network)
        self.known = finite(network.xyz)
        # Where all poses are known, only rays to unknown points are intersected.
        ready = network.posed.all() and network.refraction is None
        self.seen = directions(network, ~(ready & self.known[network.point_of]))
        self.uv = self.seen
        self.xyz = network.xyz.copy()
        self.rotation = np.full((len(network.images), 3, 3), np.nan)
        self.x0 = network.x0.copy()
        posed = network.posed
        self.rotation[posed] = rotation_matrix(network.rotation[posed])
        self.x0[~posed] = np.nan
        self.refused: set[int] = set()
        self.motion = network.motions.copy()
        lines = np.array([c.shutter is not None and c.shutter.mode == "line" for c in network.cameras])
        self.lines: Mask = lines[network.camera_of]
        shutter = np.array([c.shutter_columns for c in network.cameras])[network.camera_of[network.image_of]]
        self.time = (network.xy[:, 1] - shutter[:, 1]) * shutter[:, 0]
        self.angle = np.where(self.known, np.pi / 2, 0.0)
        self.good = np.ones(len(network.image_of), dtype=bool)
        self.mixture: Mixture | None = None
        self.reach = field_of(self.seen)
        self._straighten()

    @property
    def posed(self) -> Mask:
        """Images that have a pose (m,)."""
        return finite(self.x0)

    def grown(self, *, by_control: bool = True) -> Approximate:
        """Return all poses and points that can be computed; without control, from a pair of images."""
        known, notes = self.known.copy(), list[Remark]()
        if by_control and not self.posed.any():
            self._resect_all()
        if self.posed.sum() < 2 and not self.posed.all():
            control = self.xyz.copy()
            self.rotation[:], self.x0[:], self.xyz[:] = np.nan, np.nan, np.nan
            self.known = np.zeros(len(self.xyz), dtype=bool)
            if self._orient_first_pair():
                self._grow()
                notes += self._transform_to(control, known)
            else:
                self.known, self.xyz = known, control
        self._grow()
        if self.network.refraction is not None and not self.known.any() and not self.network.posed.any():
            self._scale_to_windows(self.network.refraction)
        return self.result(tuple(notes))

    def result(self, notes: tuple[Remark, ...] = ()) -> Approximate:
        """Return all poses and points; given points as they are given."""
        given = finite(self.network.xyz)
        xyz = np.where(given[:, None], self.network.xyz, self.xyz)
        # Points whose rays contradict each other are where these are nearest.
        lost = ~finite(xyz)
        rows = np.flatnonzero(
            self.posed[self.network.image_of] & lost[self.network.point_of] & finite(self.uv)
        )
        near, _ = self._rays(rows).nearest(len(xyz))
        return Approximate(self.rotation, self.x0, np.where(lost[:, None], near, xyz), self.motion, notes)

    def _judged(self) -> tuple[Rows, Array, Mixture]:
        """Rays with a pose and a point, their misfits, and how these are distributed."""
        network = self.network
        known = self.posed[network.image_of] & finite(self.xyz)[network.point_of] & finite(self.uv)
        rows = np.flatnonzero(known)
        off = self._rays(rows).misfits(self.xyz[network.point_of[rows]])
        mixture = Mixture(_LOOSE, 0.2, self.reach) if self.mixture is None else self.mixture
        return rows, off, mixture.fitted(off)

    def gross(self) -> Mask:
        """Image points with a pose and a point that are gross errors; all without."""
        rows, off, mixture = self._judged()
        found = np.ones(len(self.uv), dtype=bool)
        found[rows] = mixture.gross(off)
        return found

    def evidence(self) -> float:
        """Return what poses and points explain, less the price of their parameters."""
        rows, off, mixture = self._judged()
        images = len(np.unique(self.network.image_of[rows]))
        points = len(np.unique(self.network.point_of[rows]))
        return float(mixture.evidence(off).sum()) - (6 * images + 3 * points) * mixture.price

    def _grow(self) -> None:
        """Intersect points and resect images in turn until nothing is added."""
        while True:
            if self.network.refraction is not None:
                # The straight lines to points that have just been intersected; only then rays agree.
                for _ in range(_SETTLING):
                    self.intersect(plain=True)
                    self._straighten()
            self.intersect()
            if self.posed.all() or not self._resect_all():
                return

    def intersect(self, *, plain: bool = False) -> None:
        """Intersect the good rays, or all, of the points in two or more images, except of known points."""
        network, free = self.network, ~self.known
        rows = np.flatnonzero(self.posed[network.image_of] & free[network.point_of] & finite(self.uv))
        rays = self._rays(rows)
        if plain:
            xyz, angle = rays.nearest(len(self.xyz))
        else:
            xyz, angle, self.good[rows], self.mixture = rays.intersected(
                len(self.xyz), self.good[rows], self.mixture, self.reach
            )
        self.xyz[free] = xyz[free]
        self.angle = np.where(self.known, np.pi / 2, angle)

    def _rays(self, rows: Rows) -> Rays:
        """Rays of some image points, with the poses of their images."""
        image = self.network.image_of[rows]
        return Rays(
            self.network.point_of[rows], self.uv[rows], *self._poses(image, self.time[rows]),
            self.network.parallel[image],
        )  # fmt: skip

    def _poses(self, image: Rows, time: Array) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and projection centres (n, 3) at the times of rays."""
        rotation, x0, motion = self.rotation[image], self.x0[image], time[:, None] * self.motion[image]
        x0 = x0 + np.einsum("nji,nj->ni", rotation, motion[:, :3])
        return (rotation_matrix(motion[:, 3:]) @ rotation if motion[:, 3:].any() else rotation), x0

    def _resect_all(self) -> bool:
        """Orient every image with at least four known points; return whether any was oriented."""
        network, before = self.network, int(self.posed.sum())
        usable = finite(self.xyz)
        if before:
            usable &= self.angle > _CUT
        # Only images with many points: in the next round the points are better determined.
        count = np.bincount(network.image_of[usable[network.point_of]], minlength=len(network.images))
        waiting = np.flatnonzero(~self.posed & (count >= 4))
        waiting = waiting[count[waiting] >= 0.5 * count[waiting].max(initial=0)]
        for i in waiting.tolist():
            self._resect(i, self._seeing(i, usable))
        if (
            int(self.posed.sum()) == before
            and len(waiting)
            and waiting.size < (~self.posed & (count >= 4)).sum()
        ):
            return self._resect_one_by_one(usable, count)
        return int(self.posed.sum()) > before

    def _resect_one_by_one(self, usable: Mask, count: Rows) -> bool:
        """Orient one of the other images when those with the most points fail."""
        for i in np.flatnonzero(~self.posed & (count >= 4)).tolist():
            if self._resect(i, self._seeing(i, usable)):
                return True
        return False

    def _seeing(self, i: int, usable: Mask) -> Rows:
        """Rays of an image with a direction, to points that are usable (p,)."""
        rows = self.network.rays_of_images[i]
        return rows[usable[self.network.point_of[rows]] & finite(self.uv[rows])]

    def _resect(self, i: int, rows: Rows) -> bool:
        """Orient an image by some of its points; return whether it could be oriented."""
        refraction, xyz = self.network.refraction, self.xyz[self.network.point_of[rows]]
        if self.lines[i]:
            return self._resect_line(i, rows)
        if self.network.parallel[i]:
            straight = resect_parallel(xyz, self.uv[rows], _LOOSE)
            if straight is None or straight.agree.sum() < max(4, 0.5 * len(rows)):
                return False
            self.rotation[i], self.x0[i] = straight.rotation, straight.x0
            return True
        bent = refraction is not None and refraction.path_of[i] >= 0
        found = resect(xyz, self.uv[rows], _BENT if bent else _LOOSE)
        if found is not None and bent and refraction is not None:
            # The bend of the rays depends on the pose.
            only = replace(refraction, path_of=refraction.path_of[[i]])
            found = resect_through(only, found, xyz, self.seen[rows], _LOOSE)
        if found is None or (bent and found.agree.sum() < max(4, 0.5 * len(rows))):
            return False
        self.rotation[i], self.x0[i] = found.rotation, found.x0
        return True

    def _resect_line(self, i: int, rows: Rows) -> bool:
        """Orient an image of a line camera, and find its velocity; return whether it could be oriented."""
        if self.network.parallel[i]:
            return False
        point = self.network.point_of[rows]
        found = resect_line(self.xyz[point], self.uv[rows][:, 0], self.time[rows])
        if found is None:
            return False
        self.rotation[i], self.x0[i] = found.rotation, found.x0
        free = self.network.motion_free[i]
        self.motion[i] = np.where(free, [*found.velocity, 0.0, 0.0, 0.0], self.motion[i])
        return True

    def _scale_to_windows(self, refraction: Refraction) -> None:
        """Give a free block the scale of its distances, or that with which the rays pass the windows best."""
        network = self.network
        rows = self.posed[network.image_of] & finite(self.xyz)[network.point_of] & finite(self.seen)
        if not rows.any():
            return
        image, point = network.image_of[rows], network.point_of[rows]
        rotation = np.where(self.posed[:, None, None], self.rotation, np.eye(3))
        x0, xyz = np.nan_to_num(self.x0), np.nan_to_num(self.xyz)
        columns = refraction.columns(refraction.values)

        def cost(scale: float) -> float:
            rays = RefractedRays.of(
                columns, refraction.path_of, rotation, scale * x0, scale * xyz, image, point
            )
            square = ((rays.uv - self.seen[rows]) ** 2).sum(axis=1) / _LOOSE**2
            return float(np.where(rays.reached, np.log1p(square), square + 1.0).sum())

        a, b = network.distance_of.T
        length = np.linalg.norm(self.xyz[b] - self.xyz[a], axis=1)
        known = np.isfinite(length) & (length > 0)
        if known.any():
            scale = float(np.median(network.distance[known, 0] / length[known]))
        else:
            scale = float(_SCALES[np.argmin([cost(scale) for scale in _SCALES])])
        self.x0, self.xyz = scale * self.x0, scale * self.xyz

    def _bend(self, rows: Rows, rotation: Array, x0: Array, xyz: Array) -> Array:
        """Directions of rays through windows less those of straight lines (k, 2), for one image."""
        refraction, network = self.network.refraction, self.network
        assert refraction is not None
        every = np.arange(len(rows))
        rays = RefractedRays.of(
            refraction.columns(refraction.values), refraction.path_of[network.image_of[rows[:1]]],
            rotation[None], x0[None], xyz, np.zeros(len(rows), np.intp), every,
        )  # fmt: skip
        x = (xyz - x0) @ rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(rays.reached[:, None], rays.uv - x[:, :2] / x[:, 2:], 0.0)

    def _straighten(self) -> None:
        """Compute the directions of straight lines to the points, as far as poses and points are known.

        For other rays only the windows on the camera are taken into account, for distant points.
        """
        refraction, network = self.network.refraction, self.network
        if refraction is None:
            return
        uv, known = behind_ports(refraction, self.seen, network.image_of), finite(self.xyz)
        for i in np.flatnonzero(self.posed & (refraction.path_of >= 0)).tolist():
            rows = self.network.rays_of_images[i]
            rows = rows[known[network.point_of[rows]]]
            if len(rows):
                bend = self._bend(rows, self.rotation[i], self.x0[i], self.xyz[network.point_of[rows]])
                uv[rows] = self.seen[rows] - bend
        self.uv = uv

    def _orient_first_pair(self) -> bool:
        """Orient the pair of images with many common points and the largest intersection angles."""
        network = self.network
        n = len(network.image_of)
        sees = scipy.sparse.csr_array(
            (np.ones(n, np.int32), (network.image_of, network.point_of)),
            shape=(len(network.images), len(network.points)),
        )
        common = scipy.sparse.triu(scipy.sparse.coo_array(sees @ sees.T), k=1)
        order = np.argsort(-common.data, kind="stable")
        # Neighbours have the most common points but the shortest bases: try pairs with fewer points as well.
        good = order[: max(1, int((common.data >= 0.3 * common.data.max(initial=0)).sum()))]
        picked = good[np.unique(np.linspace(0, len(good) - 1, _PAIRS).astype(int))] if len(good) else good
        best, score = None, 0.0
        for k in picked:
            a, b = int(common.row[k]), int(common.col[k])
            found = self._pair(a, b)
            if found is not None and found[0] > score:
                score, best = found[0], (a, b, found[1], found[2])
        if best is None:
            return False
        a, b, rotation, x0 = best
        self.rotation[a], self.x0[a] = np.eye(3), np.zeros(3)
        self.rotation[b], self.x0[b] = rotation, x0
        return True

    def _pair(self, a: int, b: int) -> tuple[float, Array, Array] | None:
        """Return the score of a pair and its relative orientation."""
        network = self.network
        if network.parallel[[a, b]].any() or self.lines[[a, b]].any():
            # Two images with parallel rays do not determine their angle.
            return None
        in_a, in_b = network.rays_of_images[a], network.rays_of_images[b]
        _, left, right = np.intersect1d(
            network.point_of[in_a], network.point_of[in_b], assume_unique=True, return_indices=True
        )
        first, second = self.uv[in_a[left]], self.uv[in_b[right]]
        found = relative_orientation(first, second, 0.2 * _LOOSE)
        if found is None:
            return None
        k = len(first)
        poses = np.stack([np.eye(3), found.rotation]), np.stack([np.zeros(3), found.x0])
        rays = np.repeat([0, 1], k)
        points = np.concatenate([np.arange(k), np.arange(k)])
        _, angle = intersect(points, np.concatenate([first, second]), poses[0][rays], poses[1][rays], k)
        agree = found.agree
        score = float(agree.sum()) * min(float(np.median(angle[agree])), 0.5) if agree.any() else 0.0
        return score, found.rotation, found.x0

    def _transform_to(self, control: Array, known: Mask) -> list[Remark]:
        """Transform the block to the known points; return a remark where they are too few."""
        common = known & finite(self.xyz)
        if common.sum() < 3:
            self.known = np.zeros(len(known), dtype=bool)
            text = "too few known points in the block to transform it to their coordinate system"
            return [Remark(text, Code.TOO_FEW_POINTS)] if known.any() else []
        nothing = np.zeros((1, 12))
        values = Values(self.rotation, self.x0, self.xyz, nothing, nothing)
        moved = similarity_onto(values.xyz[common], control[common], scaled=True)(values)
        self.rotation, self.x0, self.xyz = moved.rotation, moved.x0, moved.xyz
        self.xyz[known], self.known = control[known], known
        return []
