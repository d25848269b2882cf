"""Gross errors in image coordinates: robust estimation, data snooping, images left out as a whole.

Rejection hides a wrong model: good points look bad then, and where most of them are dropped, the rest fits. A
board that is bent is therefore recognised before single points are tested.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...adjust import data_snooping
from ...adjust.mixture import Mixture
from ...adjust.outliers import TUNING, Rejection, SnoopingStep, robust
from ...adjust.reliability import critical_tau
from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...optics.poses import matrix_to_vector
from ..diagnostics.checks import listed
from ..diagnostics.control_check import control_shape
from ..network.network import Network, finite
from ..solver.approximation import approximate
from ..solver.problem import BundleFit, BundleProblem
from .startup import adjusted_in_steps, lost_images

MANY = 50_000
"""Maximum number of observations for the search for gross errors, because of its computing time."""

# Weight of a robust adjustment below which an observation is a gross error, and tolerance of its iteration.
_GROSS_ERROR, _ROBUST_TOLERANCE = 0.2, 0.05
# Relative offset at which adjustments end whose test values are compared with critical values.
_ROUGHLY = 1e-2
# Part of the points of an image above which it is left out as a whole.
_MOSTLY = 0.5
# Rounds in which good image points and gross errors are told apart, iterations in each, and relative change
# of the standard deviation of good ones that ends them.
_ROUNDS, _STEPS, _SETTLED = 15, 4, 0.02
# Probability of a good image point below which it is suspected where nothing is rejected.
_CERTAIN = 1e-3
# Times the number of test values that are expected above the critical value, from which on the shape of the
# control is compared with the images before single points are rejected.
_MORE = 2.0
# Part of the image points that are rejected above which the model is suspected.
_MANY_REJECTED = 0.05


def without_gross_errors(
    problem: BundleProblem, alpha: float, max_fraction: float
) -> tuple[BundleFit, tuple[SnoopingStep, ...], list[Remark]] | Failure:
    """Adjust robustly, then by data snooping, which may restore rejected observations.

    Images most of whose points are rejected are left out as a whole: the few that remain may fit by chance.
    Where the approximate values do not suffice, the adjustment of all observations gives better ones.
    """
    trimmed = _trimmed(problem, alpha)
    first = _careful(trimmed, alpha, max_fraction)
    if not isinstance(first, Failure) and (first[2] or _given(trimmed) < _given(problem)):
        # Better estimates restore what looked wrong with the approximate values.
        again = _careful(_trimmed(problem.continued(first[0]), alpha), alpha, max_fraction)
        if not isinstance(again, Failure) and _used(again[0]) > _used(first[0]):
            first = again
    if isinstance(first, Failure) or first[2]:
        plain = adjusted_in_steps(problem)
        if not isinstance(plain, Failure):
            begun = problem.continued(plain)
            second = _careful(_trimmed(begun, alpha), alpha, max_fraction)
            if isinstance(second, Failure):
                # What remains after trimming can be too weak for an adjustment.
                second = _careful(begun, alpha, max_fraction)
            if not isinstance(second, Failure) and (
                isinstance(first, Failure) or _used(second[0]) > _used(first[0])
            ):
                first = second
    if isinstance(first, Failure):
        return first
    fit, steps, left = first
    steps = (*_of_gross_errors(problem, fit, steps, alpha), *steps)
    # Images that no pose explains are not even begun with.
    left = sorted({*left, *lost_images(problem.network, fit.values.x0, fit.values.xyz).tolist()})
    if not left:
        return fit, steps, []
    names = listed(problem.network.images[i] for i in left)
    text = f"most points of image{'s' * (len(left) > 1)} {names} contradict the others: left out as a whole"
    return fit, steps, [Remark(text, Code.GROSS_ERRORS)]


def _of_gross_errors(
    problem: BundleProblem, fit: BundleFit, steps: tuple[SnoopingStep, ...], alpha: float
) -> list[SnoopingStep]:
    """Test values of image points that were left out before data snooping, by their misfits in the end."""
    n = 2 * len(problem.network.xy)
    given = np.ones(n) if problem.weights is None else problem.weights[:n]
    gross = np.asarray(fit.rejected[:n]) & (given > 0) & np.isfinite(fit.residuals[:n])
    gross[[step.index[0] for step in steps if step.index[0] < n]] = False
    rows = np.flatnonzero(gross.reshape(-1, 2).all(axis=1))
    if not len(rows) or fit.redundancy < 2:
        return []
    v = fit.residuals[:n].reshape(-1, 2)[rows]
    v = np.abs(np.einsum("nij,nj->ni", np.linalg.inv(np.linalg.cholesky(problem.network.cov[rows])), v))
    worst, critical = v.argmax(axis=1), critical_tau(alpha, fit.redundancy)
    return [
        SnoopingStep((int(2 * row + k),), float(size[k] / fit.sigma0), critical, restored=False)
        for row, size, k in zip(rows, v, worst, strict=True)
    ]


def _used(fit: BundleFit) -> int:
    """Number of image points in an adjustment."""
    return int(fit.usable.observations.sum())


def _given(problem: BundleProblem) -> int:
    """Number of image points that may be used."""
    n = len(problem.network.xy)
    return n if problem.weights is None else int((problem.weights[: 2 * n : 2] > 0).sum())


def _careful(
    problem: BundleProblem, alpha: float, max_fraction: float
) -> tuple[BundleFit, tuple[SnoopingStep, ...], list[int]] | Failure:
    """Adjust with data snooping, and again without the images most of whose points are rejected."""
    found = _snooped(problem, alpha, max_fraction)
    if isinstance(found, Failure):
        return found
    left: list[int] = []
    while bad := _bad_images(problem, found):
        network = problem.network
        weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
        weights[: 2 * len(network.xy)][np.repeat(np.isin(network.image_of, bad), 2)] = 0.0
        problem = problem.continued(found.adjustment).with_weights(weights)
        again = _snooped(problem, alpha, max_fraction)
        if isinstance(again, Failure):
            break
        found = again
        left += bad
    return found.adjustment, found.steps, left


def _snooped(problem: BundleProblem, alpha: float, max_fraction: float) -> Rejection[BundleFit] | Failure:
    """Adjust robustly, then by data snooping; only the last adjustment needs to converge to many digits.

    On a bent board only what robust estimation shows to be gross errors is left out: points that fit badly
    would be those where the board is bent most.
    """
    rough = replace(problem, tolerance=max(problem.tolerance, _ROUGHLY))
    first_fit = robust(rough, "huber", max_iterations=50, tolerance=_ROBUST_TOLERANCE)
    first: BundleFit | Failure = Failure("", Code.NOT_CONVERGED)
    if not isinstance(first_fit, Failure):
        weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights
        start = rough.continued(first_fit.adjustment)
        first = start.with_weights(np.where(first_fit.factors < _GROSS_ERROR, 0.0, weights)).adjusted()
        rough = start if isinstance(first, Failure) else start.continued(first)
        if not isinstance(first, Failure) and _is_bent(problem, first, alpha):
            return _only_gross(problem, first, first_fit.factors)
    found = data_snooping(rough, alpha, "tau", max_fraction, groups=problem.groups)
    if isinstance(found, Failure):
        # With all gross errors there may be no adjustment to begin with.
        found = _beside_gross(
            rough, found, None if isinstance(first, Failure) else first, alpha, max_fraction
        )
    if isinstance(found, Failure):
        return found
    last = problem.continued(found.adjustment).with_weights(found.adjustment.problem.weights).adjusted()
    # In a very flat valley the rough one is the result; that it is rough is a warning.
    return found if isinstance(last, Failure) else replace(found, adjustment=last)


def _beside_gross(
    problem: BundleProblem, failed: Failure, fit: BundleFit | None, alpha: float, max_fraction: float
) -> Rejection[BundleFit] | Failure:
    """Data snooping without the observations that robust estimation has left out, which are rejected."""
    if fit is None or failed.code is Code.TOO_MANY_OUTLIERS or fit.problem.weights is None:
        return failed
    given = np.ones(len(problem.observations)) if problem.weights is None else problem.weights
    gross = (fit.problem.weights == 0) & (given > 0)
    if gross.sum() > max_fraction * (given > 0).sum():
        return failed
    found = data_snooping(
        problem.with_weights(fit.problem.weights), alpha, "tau", max_fraction, groups=problem.groups
    )
    return found if isinstance(found, Failure) else replace(found, rejected=found.rejected | gross)


def _is_bent(problem: BundleProblem, fit: BundleFit, alpha: float) -> bool:
    """Whether more points fit badly than chance explains, on a board that is bent in the images."""
    network, n = problem.network, 2 * len(problem.network.xy)
    plane = network.datum == "control" and network.held.all(axis=1).sum() > 0
    tau = np.abs(fit.w[:n]) / max(fit.sigma0, 1e-300)
    used = np.repeat(fit.usable.observations, 2)
    if not plane or n > MANY or fit.redundancy < 2:
        return False
    if not (tau[used] > critical_tau(alpha, fit.redundancy)).sum() > _MORE * alpha * used.sum():
        return False
    shape = control_shape(network, fit.usable.observations, fit.values)
    return shape is not None and shape.bent() > 0


def _only_gross(problem: BundleProblem, fit: BundleFit, factors: Array) -> Rejection[BundleFit] | Failure:
    """Adjust without the observations that robust estimation, with these factors, has left out."""
    last = problem.continued(fit).with_weights(fit.problem.weights).adjusted()
    if isinstance(last, Failure):
        return last
    given = np.zeros(len(last.rejected), dtype=bool) if problem.weights is None else problem.weights == 0
    out = last.rejected & ~given
    tuning = TUNING["huber"]
    steps = [
        SnoopingStep(
            (int(k),), tuning / max(float(factors[k]), 1e-300), tuning / _GROSS_ERROR, restored=False
        )
        for k in np.flatnonzero(out & (factors < _GROSS_ERROR))
    ]
    return Rejection(last, out, tuple(steps), 1)


def _bad_images(problem: BundleProblem, found: Rejection[BundleFit]) -> list[int]:
    """Images most of whose points are rejected, which are not left out yet."""
    network, n = problem.network, len(problem.network.xy)
    out = found.rejected[: 2 * n].reshape(n, 2).any(axis=1)
    used = out | found.adjustment.usable.observations
    count = np.bincount(network.image_of[used], minlength=len(network.images))
    gone = np.bincount(network.image_of[out], minlength=len(network.images))
    return [int(i) for i in np.flatnonzero((count > 0) & (gone > _MOSTLY * count))]


def _trimmed(problem: BundleProblem, alpha: float) -> BundleProblem:
    """Return the problem with estimates from good image points, and without certain gross errors.

    Least squares may not converge with many gross errors. Good image points and gross errors are two
    explanations of each misfit (:class:`~reseau.adjust.mixture.Mixture`); their probabilities are weights of
    the next estimates. Points are intersected anew, as wrong rays hide in what they have pulled. What is good
    with a probability below `alpha` has weight zero in the problem returned; the rest is left to tests.
    """
    network, n = problem.network, len(problem.network.xy)
    given = np.ones(len(problem.observations)) if problem.weights is None else problem.weights
    plain = network.rig is None and network.stage is None and not network.shutters.any()
    extent = max(float(np.hypot(camera.width, camera.height)) for camera in network.cameras)
    sigma = np.sqrt(np.trace(network.cov, axis1=1, axis2=2) / 2)
    reach, mixture = extent / float(np.median(sigma)), None
    for k in range(_ROUNDS):
        if plain and mixture is not None:
            problem = _begun_anew(problem, mixture)
        size = np.sqrt((problem.misfits_at_start() ** 2).sum(axis=1))
        known = np.isfinite(size) & (given[: 2 * n : 2] > 0)
        if not known.any():
            break
        if mixture is None:
            middle = float(np.median(size[known])) / np.sqrt(np.log(4))
            mixture = Mixture(min(max(middle, 1e-9 * reach), reach), 0.2, reach)
        free = max(1 - (3 * finite(problem.start.xyz).sum()) / (2 * known.sum()), 0.25)
        before, mixture = mixture, mixture.fitted(size[known], free)
        good = np.where(known, mixture.good(size), 0.0)
        weights = given.copy()
        weights[: 2 * n] *= np.repeat(good, 2)
        if k and abs(mixture.sigma / before.sigma - 1) < _SETTLED:
            break
        values = problem.with_weights(weights).approached(_STEPS)
        if values is None:
            break
        problem = replace(problem, start=values)
    if mixture is None:
        return problem
    size = np.sqrt((problem.misfits_at_start() ** 2).sum(axis=1))
    weights = given.copy()
    weights[: 2 * n][np.repeat(np.isfinite(size) & (mixture.good(size) < alpha), 2)] = 0.0
    return problem.with_weights(weights) if (weights < given).any() else problem


def _begun_anew(problem: BundleProblem, mixture: Mixture) -> BundleProblem:
    """The problem with points intersected anew, and images resected most of whose points contradict them."""
    network, start = problem.network, problem.start
    cameras = tuple(
        replace(camera, values=start.cameras[c, : len(camera.values)])
        for c, camera in enumerate(network.cameras)
    )
    size = np.sqrt((problem.misfits_at_start() ** 2).sum(axis=1))
    of, known = network.image_of, np.isfinite(size)
    good = np.bincount(of[known], mixture.good(size[known]), len(network.images))
    kept = finite(start.x0) & (good > _MOSTLY * np.bincount(of[known], minlength=len(network.images)))
    if not kept.any():
        return problem
    rotation = np.full(start.x0.shape, np.nan)
    rotation[kept] = matrix_to_vector(start.rotation[kept])
    x0 = np.where(kept[:, None], start.x0, np.nan)
    found = approximate(replace(network, cameras=cameras, x0=x0, rotation=rotation, motion=start.motion))
    given = finite(network.xyz)[:, None] & finite(start.xyz)[:, None]
    xyz = np.where(given | ~finite(found.xyz)[:, None], start.xyz, found.xyz)
    return replace(
        problem, start=replace(start, rotation=found.rotation, x0=found.x0, motion=found.motion, xyz=xyz)
    )


def suspects(problem: BundleProblem) -> Rows:
    """Image points with very small weights in a robust adjustment, the smallest first."""
    nothing: Rows = np.zeros(0, dtype=np.intp)
    trimmed = replace(_trimmed(problem, _CERTAIN), tolerance=max(problem.tolerance, _ROUGHLY))
    off = robust(trimmed, "huber", max_iterations=30, tolerance=0.3)
    if isinstance(off, Failure):
        return nothing
    n = len(problem.network.xy)
    factors = off.factors if trimmed.weights is None else np.where(trimmed.weights > 0, off.factors, 0.0)
    if problem.weights is not None:
        factors = np.where(problem.weights > 0, factors, 1.0)
    weight = factors[: 2 * n].reshape(n, 2).min(axis=1)
    rows = np.argsort(weight, kind="stable")
    return np.asarray(rows[weight[rows] < _GROSS_ERROR], dtype=np.intp)


def many_rejected(network: Network, rejected: Mask) -> list[Remark]:
    """Return a remark where so many image points are rejected that the model may be wrong instead.

    Parameters
    ----------
    network : Network
        The network.
    rejected : ndarray of bool (n,)
        Rejected image points.
    """
    share = float(rejected.sum()) / max(1, len(rejected))
    if not share > _MANY_REJECTED:
        return []
    return [
        Remark(
            f"{int(rejected.sum())} of {len(rejected)} image points ({100 * share:.1f} %) are rejected: a "
            "camera model without enough terms, or wrong coordinates, look like this; look at the residuals "
            "without rejection",
            Code.UNMODELLED,
        )
    ]


def bent_plane(deflection: float, unit: str) -> str:
    """Return what to say of control points in a plane that is bent in the images.

    Parameters
    ----------
    deflection : float
        See :meth:`~reseau.bundle.diagnostics.ControlShape.bent`.
    unit : str
        Unit of object space.
    """
    return (
        f"the control points are given in a plane, but the images show them bent by {deflection:.2g} {unit}: "
        "estimate their coordinates (`--datum free`, of a target `--target free`), or give them standard "
        "deviations of this size; "
        "until then only gross errors can be rejected"
    )
