"""Interior orientation that noise alone determines.

Three photographs of a plane do not determine c, x0 and y0: m of them give 2m conditions for the parameters
of the camera and four of the plane (Triggs 1998, *Autocalibration from planar scenes*). The adjusted points
are not in a plane, however, and an estimated distortion is not zero: they have the noise of the images. The
derivatives at the estimates have full rank, and a small singular value that is as large as this noise.
Standard deviations of first order follow from it; they would not become smaller with more precise image
coordinates.

With A the derivatives at the true values and E what noise adds to them, the expectation of ‖(A + E) v‖² is
‖A v‖² + ⟨‖E v‖²⟩. As much noise again adds ⟨‖E v‖²⟩ once more. At estimates that are moved by it to both
sides, what is linear in the noise cancels: the increase of 1 / q, the inverse of a cofactor, relative to
1 / q at the estimates, is the part of it that is due to noise. Cameras are moved along the combinations of
their parameters that are determined well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.data import Array, Mask, Rows
from .arrow import Singular
from .direct import Normal
from .implicit import normal_of
from .linear import Linear, linearised
from .posterior import Cofactors

# Variance of a parameter, relative to that with all others known, from which on it is looked at, and above
# which cameras are not moved along a combination of their parameters.
_INFLATED, _WEAK = 1e5, 1e4
# Part of the inverse of a cofactor that noise may be: standard deviations are too small by less than 1.4.
_NOISE = 0.5
# In place of variances of zero.
_NONE = 1e-300
# Points with more noise, relative to the distance of the nearest image, are not moved.
_FAR = 0.05


def determined_by_noise(linear: Linear, cofactors: Cofactors, part: Mask, sigma0: float) -> list[str]:
    """Return the names of the parameters of interior orientations that noise determines.

    These are principal distances and principal points, and what stands for them.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates.
    cofactors : Cofactors
        At the estimates.
    part : ndarray of bool (p,)
        Adjusted points.
    sigma0 : float
        Standard deviation of unit weight.
    """
    names = linear.system.unknowns.names
    columns, noise = part_by_noise(linear, cofactors, part, sigma0)
    return [names[column] for column in columns[noise > _NOISE]]


def part_by_noise(linear: Linear, cofactors: Cofactors, part: Mask, sigma0: float) -> tuple[Rows, Array]:
    """Return weakly determined parameters of interior orientations (k,), and the part of 1 / q by noise."""
    system, unknowns = linear.system, linear.system.unknowns
    own = [c for c in range(len(unknowns.count)) if unknowns.camera[c] >= 0 and unknowns.count[c]]
    if system.constraints is not None or not cofactors.reduced.known or not own:
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    columns = np.concatenate([_interior(linear, c) for c in own])
    now = cofactors.reduced.blocks(columns[:, None])[:, 0, 0]
    weak = now * cofactors.normal.sums.diagonal[columns] > _INFLATED
    columns, now = columns[weak], now[weak]
    if not len(columns):
        return columns, np.zeros(0)
    points, cameras = _noise_of_points(linear, cofactors, part, sigma0), np.zeros_like(linear.values.cameras)
    for c in own:
        some = unknowns.camera[c] + np.arange(unknowns.count[c])
        alone = 1.0 / np.sqrt(np.maximum(cofactors.normal.sums.diagonal[some], _NONE))
        draw = _draw(cofactors.reduced.block(some, some)[None], alone[None], _WEAK)
        cameras[c, unknowns.free[c, : len(some)]] = sigma0 * draw[0]
    inverse = np.zeros(len(columns))
    for sign in (1.0, -1.0):
        at = linear.values
        at = replace(at, xyz=at.xyz + sign * points, cameras=at.cameras + sign * cameras)
        normal = normal_of(linearised(system, at), 0.0)
        normal.hold(cofactors.reduced.held)
        try:
            inverse += 0.5 / _variances(normal, columns)
        except Singular:
            continue
    return columns, now * inverse - 1.0


def _variances(normal: Normal, columns: Rows) -> Array:
    """Cofactors (k,) of some unknowns."""
    unit = np.zeros((normal.linear.system.unknowns.size, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    sides = unit if normal.turn is None else normal.turn.T @ unit
    found = normal.in_parameters(normal.factorise().solve(sides))
    return np.asarray(found[columns, np.arange(len(columns))])


def _interior(linear: Linear, camera: int) -> Rows:
    """Columns of principal distance and principal point of a camera, and of what stands for them."""
    unknowns = linear.system.unknowns
    own, free = unknowns.network.cameras[camera], unknowns.free[camera, : unknowns.count[camera]]
    roles = () if own.registered is None else own.registered.of_role("scale", "centre")
    at = [k for k, row in enumerate(free) if own.names[row] in roles]
    return np.asarray(unknowns.camera[camera] + np.array(at, dtype=np.intp), dtype=np.intp)


def _noise_of_points(linear: Linear, cofactors: Cofactors, part: Mask, sigma0: float) -> Array:
    """Noise (p, 3) of the points from their own rays."""
    system, xyz, seen = linear.system, linear.values.xyz, linear.system.seen
    movable = (system.pattern.eliminated == 1) & part & (system.movable > 0).all(axis=1)
    own = np.where(movable[:, None, None], cofactors.normal.inverse, 0.0)
    size = np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), _NONE))
    moved = sigma0 * _draw(own, size)
    away = np.full(len(xyz), np.inf)
    np.minimum.at(away, seen.point, np.linalg.norm(xyz[seen.point] - linear.values.x0[seen.image], axis=1))
    moved[np.linalg.norm(moved, axis=1) > _FAR * away] = 0.0
    return moved


def _draw(cofactors: Array, size: Array, most: float = np.inf) -> Array:
    """Vectors (n, k) with cofactors (n, k, k): one sigma along each principal axis, always the same.

    The axes are those for unknowns that are divided by `size` (n, k); along those with a variance above
    `most` there is nothing.
    """
    values, axes = np.linalg.eigh(cofactors / (size[:, :, None] * size[:, None, :]))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=values.shape)
    along = signs * np.sqrt(np.where(values > most, 0.0, np.maximum(values, 0.0)))
    return np.asarray(size * (axes @ along[:, :, None])[:, :, 0])
