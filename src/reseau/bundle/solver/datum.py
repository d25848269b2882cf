"""The datum: similarity transformations that a network leaves free, and how the datum fixes them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...optics.poses import cross_matrix
from ..network.camera import Camera
from ..network.stage import perpendicular
from .arrow import Singular
from .system import System
from .unknowns import Unknowns
from .values import Values

# Names of the seven parameters.
_NAMES = ("position in X", "position in Y", "position in Z", "rotation about X", "rotation about Y",
          "rotation about Z", "scale")  # fmt: skip


class Similarity(NamedTuple):
    """X' = scale · turn · X + shift."""

    scale: float
    turn: Array
    shift: Array

    def __call__(self, values: Values) -> Values:
        """Transform poses and points; image coordinates do not change."""
        return replace(
            values,
            rotation=values.rotation @ self.turn.T,
            x0=self.scale * values.x0 @ self.turn.T + self.shift,
            xyz=self.scale * values.xyz @ self.turn.T + self.shift,
            stage=None if values.stage is None else values.stage.transformed(*self),
            rig=None if values.rig is None else values.rig.scaled(self.scale),
            cameras=values.cameras.copy(),
            motion=values.motion * np.repeat([self.scale, 1.0], 3),
        )

    def about(self, origin: Array) -> Similarity:
        """Return the same similarity for coordinates that are larger by `origin` (3,)."""
        return Similarity(self.scale, self.turn, self.shift + origin - self.scale * self.turn @ origin)


@dataclass(frozen=True, eq=False)
class Freedom:
    """Changes of position, orientation and scale that no observation determines.

    Parameters
    ----------
    reduced : ndarray (u, d)
        Changes of the reduced unknowns.
    points : ndarray (p, 3, d)
        Changes of the eliminated points.
    names : tuple of str
        Names of the free parameters.
    basis : ndarray (7, d)
        The same changes as combinations of shift, rotation and scale.
    """

    reduced: Array
    points: Array
    names: tuple[str, ...]
    basis: Array

    @property
    def defect(self) -> int:
        """Number of free parameters."""
        return int(self.reduced.shape[1])


def _similarity_changes(
    unknowns: Unknowns, values: Values, taking_part: Mask, windows: Array
) -> tuple[Array, Array]:
    """Changes of reduced unknowns (u, 7) and points (p, 3, 7) by a small similarity: shift, rotation, scale.

    `windows` (r, 7) are those of all parameters of windows and media.

    X' = X + t + ω × X + μX; a camera rotates by −R ω about its own axes.
    """

    def moved(x: Array) -> Array:
        d = np.zeros((*x.shape, 7))
        d[:, :, :3] = np.eye(3)
        d[:, :, 3:6], d[:, :, 6] = -cross_matrix(x), x
        return d

    reduced = np.zeros((unknowns.size, 7))
    images = np.flatnonzero(unknowns.pose >= 0)
    at = unknowns.pose[images, None] + np.arange(3)
    reduced[at, 3:6] = -values.rotation[images]
    centres = moved(values.x0[images])
    along = unknowns.network.parallel[images]
    centres[along] = values.rotation[images][along] @ centres[along]
    # No ray depends on the distance of parallel rays.
    centres[along, 2] = 0.0
    reduced[at + 3] = centres
    for c in np.flatnonzero(unknowns.camera >= 0):
        camera = unknowns.network.cameras[c]
        for k, name in enumerate(camera.free):
            if camera.parallel and name in _magnification(camera):
                reduced[unknowns.camera[c] + k, 6] = -values.cameras[c, camera.names.index(name)]
    moving = np.flatnonzero(unknowns.motion >= 0)
    reduced[unknowns.motion[moving, None] + np.arange(3), 6] = values.motion[moving, :3]
    reduced[unknowns.refraction_columns] = windows[unknowns.refracting]
    for c in np.flatnonzero(unknowns.mount >= 0):
        if values.rig is not None:
            reduced[unknowns.mount[c] + np.arange(3, 6), 6] = values.rig.base[c]
    points = moved(values.xyz)
    points[~taking_part] = 0.0
    kept, columns = unknowns.kept_points
    reduced[columns] = points[kept]
    points[kept] = 0.0
    return reduced, points


def similarity_changes(system: System, values: Values) -> Array:
    """Changes of the reduced unknowns (u, 7) by a small shift, rotation and scale of object space."""
    network = system.unknowns.network
    windows = _changes_of_windows(system, values)
    return _similarity_changes(system.unknowns, values, np.ones(len(network.points), dtype=bool), windows)[0]


def _changes_of_windows(system: System, values: Values) -> Array:
    bent = system.unknowns.network.refraction
    return np.zeros((0, 7)) if bent is None else bent.changes(values.refraction, system.origin)


def freedom_of(system: System, values: Values, taking_part: Mask, *, windows: bool = True) -> Freedom:
    """Find the similarity transformations not determined by coordinates, distances, bases and stage readings.

    Parameters
    ----------
    taking_part : ndarray of bool (p,)
        Points that are adjusted.
    windows : bool
        Whether known parameters of windows are counted.
    """
    unknowns, network = system.unknowns, system.unknowns.network
    bent = network.refraction
    moving = _changes_of_windows(system, values)
    reduced, points = _similarity_changes(unknowns, values, taking_part, moving)
    whole = points.copy()
    kept, columns = unknowns.kept_points
    whole[kept] = reduced[columns]
    counted = np.zeros(network.sigma.shape, dtype=bool)
    at = system.others.slices[1]
    j, axis = system.others.coordinate[system.sigma_root[at] > 0].T
    counted[j, axis] = True
    rows = [*_known_axis(system, values)]
    rows += [whole[(network.held | counted) & taking_part[:, None]]]
    for a, b in system.others.ends[system.sigma_root[system.others.slices[0]] > 0]:
        along = values.xyz[b] - values.xyz[a]
        rows.append(along[None] @ (whole[b] - whole[a]))
    if bent is not None and windows:
        known = bent.used & ~bent.free
        known[system.others.refraction[system.sigma_root[system.others.windows] > 0]] = True
        rows.append(moving[known])
    bases = system.sigma_root[system.others.base_lengths]
    linear = network.stage is not None and not network.stage.rotary
    if linear or (bases > 0).any() or _scaled_by_cameras(unknowns, values):
        rows.append(np.eye(7)[6:])
    size = float(np.sqrt((values.xyz[taking_part] ** 2).sum(axis=1).mean())) or 1.0
    scale = np.array([1.0, 1.0, 1.0, 1 / size, 1 / size, 1 / size, 1 / size])
    fixed = np.concatenate(rows) * scale
    length = np.linalg.norm(fixed, axis=1, keepdims=True)
    fixed = fixed / np.where(length > 0, length, 1.0)
    _, singular, vt = np.linalg.svd(np.vstack([fixed, np.zeros((7, 7))]), full_matrices=False)
    free = vt[singular < 1e-6 * max(1.0, singular[0])].T
    names = tuple(
        name for name, part in zip(_NAMES, free, strict=True) if np.abs(part).max(initial=0.0) > 0.1
    )
    basis = scale[:, None] * free
    points *= system.movable[:, :, None]
    return Freedom(reduced @ basis, points @ basis, names, basis)


def _known_axis(system: System, values: Values) -> list[Array]:
    """Changes (k, 7) of the components of the axis of a stage that are held or observed."""
    stage, at = system.unknowns.network.stage, values.stage
    if stage is None or at is None:
        return []
    across, rows = perpendicular(at.axis).T, list[Array]()
    roots = system.sigma_root[system.others.tilts]
    tilts = system.others.tilt.shape[1]
    if stage.axis_sigma == 0 or (roots[:tilts] > 0).any():
        turned = np.zeros((3, 7))
        turned[:, 3:6] = -cross_matrix(at.axis)
        rows.append(across @ turned)
    if stage.rotary and (stage.point_sigma == 0 or (roots[tilts:] > 0).any()):
        point = at.foot(system.others.nominal)
        moved = np.concatenate([np.eye(3), -cross_matrix(point), point[:, None]], axis=1)
        rows.append(across @ moved)
    return rows


def _magnification(camera: Camera) -> tuple[str, ...]:
    return () if camera.registered is None else camera.registered.of_role("scale")


def _scaled_by_cameras(unknowns: Unknowns, values: Values) -> bool:
    """Whether a known magnification of parallel rays, or a known velocity of an image, gives the scale."""
    network = unknowns.network
    for c in np.unique(network.camera_of[unknowns.pose >= 0]):
        camera = network.cameras[c]
        free = {name for name in camera.free if name not in camera.sigma and camera.covariance is None}
        if camera.parallel and not set(_magnification(camera)) <= free:
            return True
    given = ~network.motion_free[:, :3] & (values.motion[:, :3] != 0) & network.shutters[:, None]
    observed = network.motion_sigma[:, :3] > 0
    return bool((given | observed)[unknowns.pose >= 0].any())


def scaled_by_windows(system: System, values: Values, taking_part: Mask) -> bool:
    """Whether the scale is determined by the dimensions of windows alone."""
    one, other = (freedom_of(system, values, taking_part, windows=known) for known in (True, False))
    return "scale" in other.names and "scale" not in one.names


def held_for(freedom: Freedom, unknowns: Unknowns, diagonal: Array) -> Rows:
    """Choose well-conditioned reduced unknowns that fix the datum when they are held.

    Parameters
    ----------
    diagonal : ndarray (u,)
        Diagonal of the normal equations, to compare unknowns with different units.
    """
    if not freedom.defect:
        return np.zeros(0, dtype=np.intp)
    scaled = freedom.reduced * np.sqrt(diagonal)[:, None]
    scaled = scaled / np.linalg.norm(scaled, axis=0)
    if not np.isfinite(scaled).all():
        raise Singular("the datum has no effect on the unknowns")
    # Orthogonalise first: some columns may be nearly parallel.
    basis, _ = np.linalg.qr(scaled)
    _, _, order = scipy.linalg.qr(basis.T, mode="economic", pivoting=True)
    return np.sort(order[: freedom.defect]).astype(np.intp)


def similarity_onto(a: Array, b: Array, *, scaled: bool) -> Similarity:
    """Compute the least-squares similarity from points to others (Horn 1987; Umeyama 1991).

    Parameters
    ----------
    a, b : ndarray (p, 3)
        Coordinates, and those to which they are transformed.
    scaled : bool
        Whether the scale is free.
    """
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    u, s, vt = np.linalg.svd((b - centre_b).T @ (a - centre_a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = (u * sign) @ vt
    spread = float(((a - centre_a) ** 2).sum())
    scale = float(s @ sign) / spread if scaled and spread > 0 else 1.0
    return Similarity(scale, turn, centre_b - scale * turn @ centre_a)


def held_minimally(freedom: Freedom, unknowns: Unknowns, values: Values) -> Rows:
    """Choose minimal constraints: the pose of the first image and the largest component of a base from it.

    Where fewer parameters are free, choose well-conditioned unknowns instead.
    """
    images = np.flatnonzero(unknowns.pose >= 0)
    first: Rows = np.asarray(unknowns.pose[images[0]] + np.arange(6), dtype=np.intp)
    if freedom.defect < 6 or len(images) < 2 or len(unknowns.distances):
        return held_for(freedom, unknowns, np.ones(unknowns.size))
    if freedom.defect == 6:
        return first
    base = np.abs(values.x0[images] - values.x0[images[0]])
    far, axis = np.unravel_index(int(np.argmax(base)), base.shape)
    return np.concatenate([first, [unknowns.pose[images[far]] + 3 + int(axis)]])
