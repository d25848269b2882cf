"""Cross-validation of adjusted cameras: how well they predict images that did not contribute."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.special

from ...core.data import Array, Mask
from ...core.executors import Executor
from ...core.failure import Failure
from ..network.network import finite
from ..solver import BundleFit, BundleProblem
from .determined import whole_camera

__all__ = ["LEVEL", "mean_square", "predicted_images", "worse_predictions"]

LEVEL = 0.01
"""Level of the test of differences."""
# Least number of images for which images can be left out, and of points by which one is predicted.
_LEAST_IMAGES, _LEAST_POINTS = 4, 5


def predicted_images(
    fits: Sequence[BundleFit | Failure], folds: int, seed: int, executor: Executor
) -> Array | None:
    """Sums of squares of predicted coordinates and their number (k, m, 2), of each image left out once."""
    first = fits[0]
    assert isinstance(first, BundleFit)
    images = np.flatnonzero(first.usable.images)
    if len(images) < _LEAST_IMAGES:
        return None
    parts = np.full(len(first.usable.images), -1)
    parts[images] = np.random.default_rng(seed).permutation(len(images)) % min(folds, len(images))
    found = np.zeros((len(fits), len(parts), 2))
    jobs = [
        (f"model {row}, part {part}", (replace(fit.problem.continued(fit), watch=None), parts == part))
        for row, fit in enumerate(fits)
        if isinstance(fit, BundleFit)
        for part in range(int(parts.max()) + 1)
    ]
    rows = np.repeat(np.arange(len(fits)), int(parts.max()) + 1)
    for row, (_, left) in zip(rows, executor.outcomes(_left_out, jobs), strict=True):
        for image, square, count in [] if isinstance(left, Failure) else left:
            found[row, image] = square, count
    # Images that one of the models cannot predict are not compared.
    found[:, (found[:, :, 1] == 0).any(axis=0)] = 0.0
    return found


def _left_out(job: tuple[BundleProblem, Mask]) -> list[tuple[int, float, int]]:
    """Adjust without some images (m,), then each of these alone with camera and points held.

    Returned are numbers of images, and sum of squares and number of their predicted coordinates.
    """
    problem, out = job
    network = problem.network
    n = len(network.xy)
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    used = np.asarray((weights[: 2 * n].reshape(n, 2) > 0).all(axis=1))
    weights[: 2 * n][np.repeat(out[network.image_of], 2)] = 0.0
    without = problem.with_weights(weights).adjusted()
    if isinstance(without, Failure):
        return []
    camera = network.cameras[0]
    held = replace(camera, values=without.values.cameras[0, : len(camera.values)], free=(), sigma={})
    if camera.additional is not None:
        whole = whole_camera(without)
        held = replace(
            held, model="mapping", mapping=whole, values=np.array(whole.values), options={}, additional=None
        )
    known = finite(without.values.xyz)
    mine = network.select(out[network.image_of] & used & known[network.point_of])
    if not len(mine.xy):
        return []
    control = replace(
        mine, cameras=(held,), xyz=without.values.xyz,
        sigma=np.where(known, 0.0, np.nan)[:, None] * np.ones(3),
        datum="control", distance_of=network.distance_of[:0], distance=network.distance[:0],
    )  # fmt: skip
    start = replace(problem.start, cameras=held.values[None], xyz=without.values.xyz, extra=np.zeros((1, 0)))
    again = replace(problem, network=control, start=start, weights=None).adjusted()
    if isinstance(again, Failure):
        return []
    v = again.residuals[: 2 * len(mine.xy)].reshape(-1, 2) / np.sqrt(np.diagonal(mine.cov, axis1=1, axis2=2))
    found = []
    for image in np.flatnonzero(out).tolist():
        own = v[(mine.image_of == image) & np.isfinite(v).all(axis=1)]
        if len(own) >= _LEAST_POINTS:
            found.append((image, float((own**2).sum()), 2 * len(own)))
    return found


def mean_square(squares: Array) -> float:
    """Mean square over all images."""
    total = float(squares[:, 1].sum())
    return float(squares[:, 0].sum()) / total if total else np.nan


def worse_predictions(squares: Array | None) -> set[int]:
    """Rows that predict images significantly worse than the best, by differences of the same images."""
    if squares is None:
        return set()
    seen = squares[0, :, 1] > 0
    if seen.sum() < _LEAST_IMAGES:
        return set()
    each = squares[:, seen, 0]
    best = int(each.sum(axis=1).argmin())
    off = each - each[best]
    spread = off.std(axis=1, ddof=1) * np.sqrt(off.shape[1])
    limit = scipy.special.stdtrit(off.shape[1] - 1, 1 - LEVEL)
    return {int(row) for row in np.flatnonzero(off.sum(axis=1) > limit * spread)} - {best}
