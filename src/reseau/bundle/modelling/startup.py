"""A start from cameras that are hardly known: parameters are freed in steps, lost images are tried again.

Approximate poses and points are computed with the cameras as given. Where these are far from the truth (a
wide lens without distortion), images are lost, or fall into a wrong minimum. Each change of the cameras is
therefore followed by another attempt: first the principal distance and the leading distortion are adjusted,
then the usual parameters, then all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from ...optics.poses import matrix_to_vector
from ..network.camera import Camera
from ..network.network import Network, finite
from ..solver.approximation import approximate
from ..solver.problem import BundleFit, BundleProblem
from ..solver.values import Values

RETRIED = (Code.NOT_CONVERGED, Code.SINGULAR, Code.RANK_DEFECT, Code.NOT_FINITE, Code.NOT_IDENTIFIED)
"""Failures after which cameras are freed in steps."""

# Points from which a lost image can be expected to find its pose, attempts in each step, and iterations of
# each.
_ENOUGH, _ATTEMPTS, _STEPS = 6, 4, 25
# Times by which the largest coordinate grows in an iteration that leads nowhere.
_ASTRAY = 1e9
# Number of distortion parameters of the first step.
_LEADING = 1
# An image is tried again where its median misfit is this many times that of the other images, and takes the
# new pose where its median misfit becomes smaller by the second factor.
_OUTLYING, _BETTER = 4.0, 0.7


def lost_images(network: Network, x0: Array, xyz: Array) -> Rows:
    """Return the images without a pose that see enough known points, or points of other oriented images."""
    posed = finite(x0)
    lit = np.bincount(network.point_of[posed[network.image_of]], minlength=len(network.points)) > 0
    seen = (lit | finite(xyz))[network.point_of]
    count = np.bincount(network.image_of[seen], minlength=len(network.images))
    return np.flatnonzero(~posed & (count >= _ENOUGH)).astype(np.intp)


def settled(problem: BundleProblem) -> BundleProblem:
    """Return a problem with better approximate values of cameras, poses and points.

    Parameters
    ----------
    problem : BundleProblem
        Problem with approximate values.
    """
    network = problem.network
    for free in _steps(network):
        cameras = tuple(_with_free(camera, own) for camera, own in zip(network.cameras, free, strict=True))
        for _ in range(_ATTEMPTS):
            step = replace(problem, network=replace(network, cameras=cameras), rounds=0)
            values = step.approached(_STEPS)
            if values is None or _astray(values, problem.start):
                break
            problem = replace(problem, start=values)
            again = retried(problem)
            if again is None:
                break
            problem = again
    return problem


def adjusted_in_steps(problem: BundleProblem) -> BundleFit | Failure:
    """Adjust; where this fails, or images do not fit, with cameras that are freed in steps.

    Parameters
    ----------
    problem : BundleProblem
        Problem with approximate values.
    """
    fit = problem.adjusted()
    if isinstance(fit, Failure):
        if fit.code not in RETRIED:
            return fit
        again = settled(problem).adjusted()
        if isinstance(again, Failure):
            return fit
        fit = again
    return improved(problem, fit)


def _astray(values: Values, start: Values) -> bool:
    """Whether an iteration has driven images or points to where no network is."""
    pairs = (values.x0, start.x0), (values.xyz, start.xyz)
    sizes = [[float(np.nanmax(np.abs(part[finite(part)]), initial=0.0)) for part in pair] for pair in pairs]
    return any(after > _ASTRAY * max(before, 1.0) for after, before in sizes)


def _steps(network: Network) -> Iterator[list[tuple[str, ...]]]:
    """Free parameters of each camera in each step; steps without a difference are left out."""
    last = None
    for level in range(3):
        free = [_freed(camera, level) for camera in network.cameras]
        if free != last:
            yield free
        last = free


def _freed(camera: Camera, level: int) -> tuple[str, ...]:
    """Free parameters of a camera in a step."""
    model = camera.registered
    if model is None or level == 2:
        return camera.free
    bent = [name for name in model.of_role("shape", "distortion") if name in camera.free]
    usual = {*model.of_role("scale"), *bent[:_LEADING]}
    if level == 1:
        usual = {*model.usual, *model.of_role("scale", "centre"), *bent[:2]}
    return tuple(name for name in camera.free if name in usual)


def _with_free(camera: Camera, free: tuple[str, ...]) -> Camera:
    """Return a camera with other free parameters; with fewer, additional parameters are held."""
    if free == camera.free:
        return camera
    extra, sigma = camera.additional, {name: s for name, s in camera.sigma.items() if name in free}
    held = None if extra is None else replace(extra, free=False)
    return replace(camera, free=free, sigma=sigma, additional=held)


def retried(problem: BundleProblem) -> BundleProblem | None:
    """Try lost images and points, and images that do not fit, again with the present cameras.

    Parameters
    ----------
    problem : BundleProblem
        Problem with approximate values.

    Returns
    -------
    BundleProblem or None
        None where nothing changes.
    """
    network, start = problem.network, problem.start
    posed = finite(start.x0)
    if network.stage is not None or network.rig is not None or not posed.any():
        return None
    size = np.sqrt((problem.misfits_at_start() ** 2).sum(axis=1))
    median = _medians(network, size)
    typical = float(np.nanmedian(median[posed])) if np.isfinite(median[posed]).any() else 0.0
    outlying = posed & (median > _OUTLYING * typical)
    if outlying.sum() > 0.5 * posed.sum():
        outlying[:] = False
    lost = np.zeros(len(posed), dtype=bool)
    lost[lost_images(network, start.x0, start.xyz)] = True
    dim = ~finite(start.xyz) & (network.rays > 1)
    if not (outlying | lost).any() and not dim.any():
        return None
    kept = posed & ~outlying
    given = finite(start.xyz) & _seen_by(network, kept)
    cameras = tuple(
        replace(camera, values=start.cameras[c, : len(camera.values)])
        for c, camera in enumerate(network.cameras)
    )
    rotation = np.full(start.x0.shape, np.nan)
    rotation[kept] = matrix_to_vector(start.rotation[kept])
    # Points of the kept images are used as they have been adjusted.
    known = np.where(given[:, None], start.xyz, network.xyz)
    found = approximate(
        replace(network, cameras=cameras, x0=np.where(kept[:, None], start.x0, np.nan), rotation=rotation,
                xyz=known, motion=start.motion)
    )  # fmt: skip
    trial = replace(
        problem,
        start=replace(start, rotation=found.rotation, x0=found.x0, motion=found.motion,
                      xyz=np.where(finite(start.xyz)[:, None] & given[:, None], start.xyz, found.xyz)),
        rounds=0,
    )  # fmt: skip
    after = _medians(network, np.sqrt((trial.misfits_at_start() ** 2).sum(axis=1)))
    with np.errstate(invalid="ignore"):
        worse = outlying & ~(after < _BETTER * median)
    x0, turn = trial.start.x0.copy(), trial.start.rotation.copy()
    x0[worse], turn[worse] = start.x0[worse], start.rotation[worse]
    xyz = np.where(finite(trial.start.xyz)[:, None], trial.start.xyz, start.xyz)
    gained = (finite(x0) & ~posed).any() or (outlying & ~worse).any()
    gained |= bool((finite(xyz) & ~finite(start.xyz) & _seen_by(network, finite(x0), 2)).any())
    if not gained:
        return None
    motion = np.where(worse[:, None], start.motion, trial.start.motion)
    return replace(trial, start=replace(trial.start, x0=x0, rotation=turn, xyz=xyz, motion=motion))


def improved(problem: BundleProblem, fit: BundleFit) -> BundleFit:
    """Return the adjustment repeated with lost images that are found after all, where it becomes better.

    Parameters
    ----------
    problem : BundleProblem
        The adjusted problem.
    fit : BundleFit
        Its adjustment.
    """
    for _ in range(_ATTEMPTS):
        again = retried(problem.continued(fit))
        if again is None:
            return fit
        new = again.adjusted()
        if isinstance(new, Failure) or not _is_better(new, fit):
            return fit
        problem, fit = again, new
    return fit


def _is_better(new: BundleFit, old: BundleFit) -> bool:
    """Whether an adjustment has more images, or as many and a smaller sum of squares."""
    more = int(new.usable.observations.sum()) - int(old.usable.observations.sum())
    return more > 0 or (more == 0 and new.cost < old.cost * (1 - 1e-9))


def _seen_by(network: Network, images: Mask, least: int = 1) -> Mask:
    """Points that are in at least this number of some images (p,)."""
    count = np.bincount(network.point_of[images[network.image_of]], minlength=len(network.points))
    return np.asarray(count >= least)


def _medians(network: Network, size: Array) -> Array:
    """Median of each image (m,); NaN without values."""
    found = np.full(len(network.images), np.nan)
    rows = np.flatnonzero(np.isfinite(size))
    order = rows[np.lexsort((size[rows], network.image_of[rows]))]
    images, first, count = np.unique(network.image_of[order], return_index=True, return_counts=True)
    found[images] = size[order[first + count // 2]]
    return found
