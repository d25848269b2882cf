"""Other solutions of an adjusted network: those beside its estimates, and those from other starts.

Two images have up to ten relative orientations by five points (Nistér 2004), of which a plane leaves two for
all its points; four or fewer images of it may have other minima. An image has up to four poses by three
points (Grunert 1841), of which a small plane leaves two for all. Each is adjusted with the same observations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...core.data import Array
from ...core.failure import Failure
from ...optics.poses import matrix_to_vector
from ..diagnostics.other_solutions import OtherSolution, before_images, comparable, followed, in_datum
from ..network.network import Network, finite
from ..solver.approximation import approximate
from ..solver.datum import Similarity
from ..solver.problem import BundleFit
from ..solver.several import poses_of, relative_orientations
from ..solver.spatial import directions
from ..solver.values import Values

# Images up to which relative orientations of a pair are tried, relative orientations, and times that a better
# solution is taken.
_IMAGES, _PAIRS, _ROUNDS = 4, 4, 3
# Iterations of an adjustment from another start: one that creeps leads to points at infinity.
_STEPS = 40
# Poses of an image by its points, angle (rad) between different ones, and images that are turned.
_POSES, _SAME, _TURNED = 3, 1e-3, 8
# Excess (variances) of an image that is turned alone from which the whole network is not adjusted with it.
_ALONE = 100.0


@np.errstate(all="ignore")
def compared(fit: BundleFit) -> tuple[BundleFit, tuple[OtherSolution, ...]]:
    """Return the best solution, and others that the observations allow and standard deviations exclude.

    Parameters
    ----------
    fit : BundleFit
        An adjustment.
    """
    # Starts may be where no ray is.
    if not comparable(fit):
        return fit, ()
    fits = [fit, *_from_other_starts(fit)]
    fit = min(fits, key=lambda each: _excess(each, fit))
    beside = followed(fit)
    for _ in range(_ROUNDS):
        best = min(beside, key=lambda other: other.excess, default=None)
        again = (
            None
            if best is None or not best.better
            else _adjusted(fit, best.values, fit.problem.max_iterations)
        )
        if again is None or _excess(again, fit) >= 0:
            break
        fit, beside = again, followed(again)
    others = [
        *beside,
        *(OtherSolution(in_datum(fit, each.values), _excess(each, fit), minimum=True) for each in fits),
    ]
    return fit, tuple(
        other for other in others if other.allowed and any(part.any() for part in other.excluded(fit))
    )


def _adjusted(fit: BundleFit, start: Values, steps: int) -> BundleFit | None:
    """The observations adjusted from another start; None where that fails."""
    at = fit.problem.continued(fit).start
    images, points = (finite(part) for part in (start.x0, start.xyz))
    start = replace(
        start,
        rotation=np.where(images[:, None, None], start.rotation, at.rotation),
        x0=np.where(images[:, None], start.x0, at.x0),
        xyz=np.where(points[:, None], start.xyz, at.xyz),
    )
    found = replace(fit.problem, start=start, rounds=0, max_iterations=steps).adjusted()
    return None if isinstance(found, Failure) else found


def _from_other_starts(fit: BundleFit) -> Iterator[BundleFit]:
    """Adjustments from other starts."""
    for start in (*_other_pairs(fit), *_other_poses(fit)):
        found = _adjusted(fit, start, _STEPS)
        if found is not None and before_images(fit, found.values):
            yield found


def _excess(found: BundleFit, fit: BundleFit) -> float:
    """−2 times the logarithm of the likelihood ratio: of vᵀPv, and of image points that are left out.

    These may be anywhere in their images.
    """
    network, used = fit.problem.network, fit.usable.observations
    camera = network.camera_of[network.image_of]
    area = np.array([each.width * each.height for each in network.cameras], dtype=np.float64)[camera]
    density = 2 * np.pi * np.sqrt(np.linalg.det(network.cov)) * fit.variance / area
    more = used.astype(int) - found.usable.observations.astype(int)
    return (found.cost - fit.cost) / fit.variance - 2 * float(more @ np.log(density))


def _other_pairs(fit: BundleFit) -> Iterator[Values]:
    """Blocks grown from other relative orientations of the two images with the most common points."""
    network = _with_estimates(fit)
    images = np.flatnonzero(fit.usable.images)
    given = (network.held | network.observed)[fit.usable.points].any()
    if given or network.parallel.any() or not 2 <= len(images) <= _IMAGES:
        return
    used = fit.usable.observations
    rows = [own[used[own]] for own in network.rays_of_images]
    shared = {
        (a, b): np.intersect1d(network.point_of[rows[a]], network.point_of[rows[b]], return_indices=True)[1:]
        for k, a in enumerate(images.tolist())
        for b in images[k + 1 :].tolist()
    }
    (a, b), (left, right) = max(shared.items(), key=lambda each: len(each[1][0]))
    uv = directions(network)
    for pair in relative_orientations(uv[rows[a][left]], uv[rows[b][right]], _PAIRS):
        x0, rotation = np.full((2, len(network.images), 3), np.nan)
        x0[a], x0[b], rotation[a], rotation[b] = 0.0, pair.x0, 0.0, matrix_to_vector(pair.rotation)
        # Approximate coordinates belong to the other orientation.
        alone = replace(network.select(used), xyz=np.full_like(network.xyz, np.nan))
        found = approximate(replace(alone, x0=x0, rotation=rotation))
        yield _scaled(fit, replace(fit.values, rotation=found.rotation, x0=found.x0, xyz=found.xyz))


def _scaled(fit: BundleFit, values: Values) -> Values:
    """Values in the size of the estimates."""
    one, other = (
        float(np.linalg.norm(np.nanstd(part[fit.usable.points], axis=0)))
        for part in (fit.values.xyz, values.xyz)
    )
    return Similarity(one / max(other, 1e-300), np.eye(3), np.zeros(3))(values)


def _other_poses(fit: BundleFit) -> Iterator[Values]:
    """Single images in other poses in which they see their points about where they are."""
    network, values = _with_estimates(fit), fit.values
    uv, own = directions(network), _squares(fit, values)
    rotation, x0 = (
        np.tile(part, (_POSES, *np.ones(part.ndim, int))) for part in (values.rotation, values.x0)
    )
    for i in np.flatnonzero(fit.usable.images & ~network.parallel).tolist():
        rows = network.rays_of_images[i]
        rows = rows[fit.usable.observations[rows] & finite(uv[rows])]
        if len(rows) < 3:
            continue
        for k, pose in enumerate(poses_of(values.xyz[network.point_of[rows]], uv[rows], _POSES)):
            rotation[k, i], x0[k, i] = pose.rotation, pose.x0
    tried = [replace(values, rotation=rotation[k], x0=x0[k]) for k in range(_POSES)]
    more = np.array([_squares(fit, each) - own for each in tried]) / fit.variance
    turned = np.einsum("kmij,mij->km", rotation, np.nan_to_num(values.rotation)) < 1 + 2 * np.cos(_SAME)
    order = np.argwhere(turned & (more < _ALONE))
    for k, i in order[np.argsort(more[tuple(order.T)])][:_TURNED].tolist():
        at = values.rotation.copy(), values.x0.copy()
        at[0][i], at[1][i] = rotation[k, i], x0[k, i]
        yield replace(values, rotation=at[0], x0=at[1])


def _squares(fit: BundleFit, values: Values) -> Array:
    """Sums of the squares of the misfits of each image (m,)."""
    square = (replace(fit.problem, start=values).misfits_at_start() ** 2).sum(axis=1)
    used = fit.usable.observations
    sums: Array = np.zeros(len(values.x0))
    np.add.at(sums, fit.problem.network.image_of[used], square[used])
    return sums


def _with_estimates(fit: BundleFit) -> Network:
    """The network with its cameras as estimated."""
    network, cameras = fit.problem.network, fit.values.cameras
    return replace(
        network,
        cameras=tuple(
            replace(camera, values=cameras[c, : len(camera.values)])
            for c, camera in enumerate(network.cameras)
        ),
    )
