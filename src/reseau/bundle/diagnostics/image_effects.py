"""What displaces the points of an image together, as random effects: a field, the focus, the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core.data import Array
from ..solver.problem import BundleFit
from ..solver.system import residuals
from .evidence import Effect, places_seen, used_rows

_LENGTHS = (0.3, 0.6, 1.2)
"""Distances, in half the diagonal of the image or target, over which displacements of an image are alike."""
_DEGREE, _NODES = 4, 12
"""Degree of the polynomials that describe a smooth field, and nodes of the integration over the image."""
_OF_CREASES = 6
"""Degree of the polynomials that describe smooth displacements over a target."""


def smooth_effects(fit: BundleFit, degree: int = _DEGREE) -> tuple[Effect, dict[str, Array]]:
    """Smooth displacements of each image, and their forms by length, (images, q, q).

    The coefficients of polynomials that are orthonormal over the image have the covariance that follows from
    that of the field.
    """
    powers = _powers(degree)
    count = len(powers)
    network, rows = fit.problem.network, used_rows(fit)
    image = network.image_of[rows]
    xy = places_seen(fit)
    slope = np.zeros((len(rows), 2, 2 * count))
    sizes = np.array([[camera.width, camera.height] for camera in network.cameras])[network.camera_of]
    values = _polynomials(2 * (xy + 0.5) / sizes[image] - 1, powers)
    slope[:, 0, :count] = slope[:, 1, count:] = values
    halves, of = np.unique(sizes / np.hypot(*sizes.T)[:, None], axis=0, return_inverse=True)
    forms = {}
    for length in _LENGTHS:
        both = np.zeros((len(halves), 2 * count, 2 * count))
        for k, half in enumerate(halves):
            both[k, :count, :count] = both[k, count:, count:] = _root(half, length, powers)
        forms[f"{length:g}"] = both[of.ravel()]
    return Effect(slope, image, len(network.images)), forms


def creases(fit: BundleFit, flat: Array, slope: Array) -> tuple[Effect, dict[str, Array]]:
    """Smooth displacements over a plane target, others in each image, and their forms, (images, q, q).

    `flat` are the used image points in the plane of the target (n, 2), and `slope` what one unit of each kind
    of displacement there does to them (n, 2, k).
    """
    powers = _powers(_OF_CREASES)
    network = fit.problem.network
    low, high = flat.min(axis=0), flat.max(axis=0)
    over = _polynomials(2 * (flat - low) / (high - low) - 1, powers)
    kinds, half, images = slope.shape[2], (high - low) / np.hypot(*(high - low)), len(network.images)
    columns = (slope[:, :, :, None] * over[:, None, None, :]).reshape(len(flat), 2, -1)
    roots = {f"{length:g}": np.kron(np.eye(kinds), _root(half, length, powers)) for length in _LENGTHS}
    forms = {name: np.tile(root, (images, 1, 1)) for name, root in roots.items()}
    return Effect(columns, network.image_of[used_rows(fit)], images), forms


def distance_effects(fit: BundleFit) -> Effect:
    """Displacements of the points of each image by a relative change of its principal distance.

    They are those from the principal point, but for what the distortion changes.
    """
    network, rows = fit.problem.network, used_rows(fit)
    image = network.image_of[rows]
    xy = places_seen(fit)
    slope = np.zeros((len(rows), 2, 1))
    for c, camera in enumerate(network.cameras):
        own = np.flatnonzero(network.camera_of[image] == c)
        values = fit.values.cameras[c, : len(camera.values)]
        centre = camera.bare_mapping(values)(np.zeros((1, 2)))[0] if camera.has_plane_mapping else None
        centre = np.array([camera.width, camera.height]) / 2 if centre is None else centre
        slope[own, :, 0] = xy[own] - centre
    return Effect(slope, image, len(network.images))


def point_effects(fit: BundleFit) -> Effect | None:
    """Displacements of image points by shifts of object points; None where these are unknowns."""
    network, rows = fit.problem.network, used_rows(fit)
    seen, group = np.unique(network.point_of[rows], return_inverse=True)
    if not network.held[seen].all():
        return None
    slope = np.zeros((len(rows), 2, 3))
    step = 1e-4 * float(np.ptp(fit.values.xyz[seen], axis=0).max())
    for axis in range(3):
        for sign in (1.0, -1.0):
            moved = replace(fit.values, xyz=fit.values.xyz + sign * step * np.eye(3)[axis])
            slope[:, :, axis] += sign * residuals(network, fit.unknowns, rows, moved) / (2 * step)
    return Effect(slope, group, len(seen))


def _powers(degree: int) -> list[tuple[int, int]]:
    """Degrees along both axes of the polynomials of two coordinates."""
    return [(i, d - i) for d in range(degree + 1) for i in range(d + 1)]


def _polynomials(at: Array, powers: Sequence[tuple[int, int]]) -> Array:
    """Products of Legendre polynomials, orthonormal over the square from −1 to 1 (n, k)."""
    degree = max(i + j for i, j in powers)
    x, y = (np.polynomial.legendre.legvander(np.clip(axis, -1.5, 1.5), degree) for axis in at.T)
    norm = np.sqrt(2 * np.arange(degree + 1) + 1)
    return np.stack([x[:, i] * norm[i] * y[:, j] * norm[j] for i, j in powers], axis=1)


def _root(half: Array, length: float, powers: Sequence[tuple[int, int]]) -> Array:
    """Root (k, k) of the covariance of the coefficients; `half` is the size of the image by its diagonal."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    x, y = (axis.ravel() for axis in np.meshgrid(nodes, nodes))
    weight = np.outer(weights, weights).ravel() / 4
    at = np.column_stack([x, y]) * half
    distance = ((at[:, None] - at) ** 2).sum(axis=2)
    weighted = _polynomials(np.column_stack([x, y]), powers) * weight[:, None]
    cov = weighted.T @ np.exp(-0.5 * distance / length**2) @ weighted
    return np.asarray(np.linalg.cholesky(cov + 1e-12 * np.eye(len(powers))))
