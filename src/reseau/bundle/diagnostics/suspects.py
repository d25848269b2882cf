"""What contradicts the others: scale bars, bases, held parameters, points and images by their rays.

Each is the largest of its kind in test value while those found before are left out, as in data snooping:
errors of one element appear in the residuals of its neighbours as well.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...adjust.reliability import critical_w
from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ..network.camera import Camera
from ..network.network import Network, finite
from ..solver.problem import BundleFit, BundleProblem
from .checks import listed
from .evidence import ODDS

_ALPHA, _MOST = 1e-4, 12
# Times by which a false distance is too long or too short at the approximate values.
_FALSE = 1.5
# Times by which sigma0 falls when held parameters are estimated, where their values are wrong.
_FALLS, _SIGMAS = 2.0, 5.0
# Part of the rays of a point, or of the points of an image, that must be suspected for a common cause.
_SHARE = 0.4


def contradicting(problem: BundleProblem, fit: BundleFit) -> tuple[BundleProblem, list[Remark]]:
    """Find distances and bases that contradict the other observations.

    They are tested with observed control points as data snooping does; control points are found by
    :func:`~reseau.bundle.diagnostics.control_check.checked_control`.

    Parameters
    ----------
    problem : BundleProblem
        The problem, with weights.
    fit : BundleFit
        Its adjustment.

    Returns
    -------
    BundleProblem, list of Remark
        The problem without them, and their names, the foremost first; none where all agree.
    """
    network, others, n = problem.network, problem.others, 2 * len(problem.network.xy)
    bars, coordinates, _ = others.slices
    bases = np.arange(len(others.bases))
    # Distances and bases are numbered first, then points.
    lengths = bars.stop + len(bases)
    element = np.concatenate([np.arange(bars.stop), lengths + others.coordinate[:, 0], bars.stop + bases])
    own = n + np.concatenate([np.arange(coordinates.stop), others.base_lengths.start + bases])
    if not lengths:
        return problem, []
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    critical = critical_w(_ALPHA / len(element))
    found: list[tuple[int, float, float]] = []
    current = fit
    for _ in range(_MOST):
        seen = np.abs(current.w[:n])
        seen = seen[np.isfinite(seen) & (seen > 0)]
        # Gross errors of image points must not hide those of other observations.
        unit = max(1.0, float(np.median(seen)) / 0.6745) if len(seen) else 1.0
        w = np.where(weights[own] > 0, np.nan_to_num(np.abs(current.w[own])), 0.0) / unit
        worst = int(np.argmax(w))
        if not w[worst] > critical:
            break
        trial = weights.copy()
        trial[own[element == element[worst]]] = 0.0
        again = problem.continued(current).with_weights(trial).adjusted()
        if isinstance(again, Failure):
            # The datum depends on it, so that it cannot be said which is wrong.
            found.append((int(element[worst]), float(w[worst]), np.nan))
            break
        instead = _instead(problem, current, weights, again, own, element, w > critical, worst)
        if instead:
            # One of them is wrong; without a further observation it cannot be said which.
            alike = [int(element[worst]), *instead]
            found += [(each, float(w[element == each].max()), np.nan) for each in alike]
            break
        off = float(np.abs(again.residuals[own[worst]]))
        found.append((int(element[worst]), float(w[worst]), off))
        weights, current = trial, again
    named = [one for one in found if one[0] < lengths]
    false = [k for k, _, off in named if np.isfinite(off)]
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    weights[own[np.isin(element, false)]] = 0.0
    return problem.with_weights(weights) if false else problem, _lengths(network, named)


def _instead(
    problem: BundleProblem,
    fit: BundleFit,
    weights: Array,
    without: BundleFit,
    own: Rows,
    element: Rows,
    suspected: Mask,
    worst: int,
) -> list[int]:
    """Elements that explain as well as the worst, where they are left out in its stead."""
    found = []
    for other in np.unique(element[suspected & (element != element[worst])]).tolist():
        trial = weights.copy()
        trial[own[element == other]] = 0.0
        again = problem.continued(fit).with_weights(trial).adjusted()
        if not isinstance(again, Failure) and 0.5 * (again.cost - without.cost) / without.variance < ODDS:
            found.append(int(other))
    return found


def without_false_bars(problem: BundleProblem) -> tuple[BundleProblem, list[Remark]]:
    """Leave out distances that are far from the others, or from the control points, at the start.

    With a wrong unit or a lost decimal point the adjustment would not converge.

    Parameters
    ----------
    problem : BundleProblem
        Problem with approximate values.

    Returns
    -------
    BundleProblem, list of Remark
        The problem with zero weights for these distances, and what was left out.
    """
    network, n = problem.network, 2 * len(problem.network.xy)
    if not len(network.distance) or network.refraction is not None:
        return problem, []
    a, b = network.distance_of.T
    length = np.linalg.norm(problem.start.xyz[b] - problem.start.xyz[a], axis=1)
    known = np.isfinite(length) & (length > 0)
    ratio = np.where(known, network.distance[:, 0] / np.where(known, length, 1.0), np.nan)
    fixed = finite(network.xyz).sum() >= 3 or network.posed.sum() >= 2
    if not fixed and known.sum() < 3:
        return problem, []
    scale = 1.0 if fixed else float(np.nanmedian(ratio))
    with np.errstate(invalid="ignore"):
        false = np.flatnonzero(known & (np.abs(np.log(ratio / scale)) > np.log(_FALSE)))
    if not len(false) or (not fixed and len(false) > 0.5 * known.sum()):
        return problem, []
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    weights[n + false] = 0.0
    names = [
        f"{network.points[a[k]]} to {network.points[b[k]]} ({network.distance[k, 0]:g} {network.unit}, "
        f"{ratio[k] / scale:.3g} times as long)"
        for k in false
    ]
    several = len(false) > 1
    return problem.with_weights(weights), [
        Remark(
            f"the distance{'s' * several} {listed(names)} contradict{'s' * (not several)} the other "
            "observations: left out",
            Code.DOUBTFUL_CONTROL,
        )
    ]


def _lengths(network: Network, found: list[tuple[int, float, float]]) -> list[Remark]:
    """Name distances of points, and bases of a rig, by their numbers."""
    ends = [tuple(network.points[j] for j in pair) for pair in network.distance_of]
    length = network.distance[:, 0].tolist()
    if network.rig is not None:
        ends += [tuple(network.cameras[c].label for c in pair) for pair in network.rig.base_of]
        length += network.rig.base[:, 0].tolist()
    names, alike = [], []
    for k, w, off in found:
        if k >= len(ends):
            continue
        by = "" if np.isnan(off) else f", by {off:.3g} {network.unit} from the others"
        alike += [f"{ends[k][0]} to {ends[k][1]} ({length[k]:g} {network.unit})"] if np.isnan(off) else []
        names.append(f"{ends[k][0]} to {ends[k][1]} ({length[k]:g} {network.unit}{by}, w {w:.1f})")
    if not names:
        return []
    if len(alike) > 1:
        return [
            Remark(
                f"the distances {listed(alike)} contradict each other, and without any one of them all "
                "agrees: which is wrong cannot be decided; measure one more",
                Code.DOUBTFUL_CONTROL,
            )
        ]
    verb = "contradicts" if len(names) == 1 else "contradict"
    return [
        Remark(
            f"the distance{'s' * (len(names) > 1)} {listed(names)} {verb} the other observations",
            Code.DOUBTFUL_CONTROL,
        )
    ]


def doubtful_parameters(problem: BundleProblem, fit: BundleFit) -> list[Remark]:
    """Find held parameters of cameras whose values do not fit: sigma0 falls when they are estimated.

    Parameters
    ----------
    problem : BundleProblem
        The adjusted problem.
    fit : BundleFit
        Its adjustment.
    """
    network, again, cameras = problem.network, fit, problem.network.cameras
    tried = [camera.free for camera in cameras]
    for usual in (True, False):
        freed = tuple(_freed(camera, usual=usual) for camera in network.cameras)
        if (free := [camera.free for camera in freed]) != tried:
            tried = free
            trial = replace(
                problem.continued(fit), network=replace(network, cameras=freed), rounds=0
            ).adjusted()
            if not isinstance(trial, Failure) and trial.sigma0 * _FALLS < again.sigma0:
                again, cameras = trial, freed
    found = []
    for c, (new, old) in enumerate(zip(cameras, network.cameras, strict=True)):
        at, count = int(again.unknowns.camera[c]), len(new.free)
        if at < 0:
            continue
        columns = np.arange(at, at + count)
        sigma = np.sqrt(np.diag(again.cofactors.reduced.block(columns, columns)) * again.variance)
        rows = again.unknowns.free[c, :count]
        change = np.abs(again.values.cameras[c, rows] - old.values[rows])
        named = [
            f"{name} {old.values[k]:g} → {again.values.cameras[c, k]:.6g}"
            for name, k, s, d in zip(new.free, rows, sigma, change, strict=True)
            if name not in old.free and d > _SIGMAS * s
        ]
        if named:
            found.append(f"{old.label}: {', '.join(named)}")
    if not found:
        return []
    return [
        Remark(
            f"held parameters do not fit: sigma0 falls from {fit.sigma0:.3g} to {again.sigma0:.3g} "
            f"when they are estimated ({'; '.join(found)})",
            Code.INCONSISTENT,
        )
    ]


def uneven_axes(problem: BundleProblem, gross: Rows) -> list[Remark]:
    """Find standard deviations of x and y that are wrong: equal ones explain more than gross errors do.

    Two explanations of all image points are compared: the given standard deviations, with gross errors that
    are anywhere in their images, and those of the less precise axis for both, times an unknown factor.

    Parameters
    ----------
    problem : BundleProblem
        The problem.
    gross : ndarray of int
        Image points that would be gross errors.
    """
    network, every = problem.network, np.arange(len(problem.network.xy))
    size = np.sqrt(np.diagonal(network.cov, axis1=1, axis2=2))
    even = size.max(axis=1)[:, None, None] ** 2 * np.eye(2)
    times = float((size.max(axis=1) / size.min(axis=1)).max())
    if np.allclose(network.cov, even, rtol=1e-6, atol=0.0):
        return []
    fit = replace(problem, network=replace(network, cov=even), rounds=0).adjusted()
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    weights[2 * gross], weights[2 * gross + 1] = 0.0, 0.0
    without = problem.with_weights(weights).adjusted()
    camera = network.camera_of[network.image_of[gross]]
    area = np.array([entry.width * entry.height for entry in network.cameras])[camera]
    given = _log_likelihood(without, np.setdiff1d(every, gross)) - float(np.log(area).sum())
    if isinstance(fit, Failure) or not _log_likelihood(fit, every) > given + ODDS:
        return []
    return [
        Remark(
            f"standard deviations of x and y differ by up to {times:.3g} times: with the larger for both, "
            f"{len(gross)} image points that would be gross errors agree with the others (sigma0 "
            f"{fit.sigma0:.3g}). The standard deviations are wrong, not the image points: give others",
            Code.SIGMAS_DOUBTFUL,
        )
    ]


def _log_likelihood(fit: BundleFit | Failure, rows: Rows) -> float:
    """Logarithm of the likelihood of image points, with the variance factor that is most probable."""
    if isinstance(fit, Failure) or not fit.sigma0 > 0:
        return -np.inf
    spread = fit.sigma0**2 * fit.problem.network.cov[rows]
    return float(-np.linalg.slogdet(2 * np.pi * spread)[1].sum() / 2 - fit.redundancy / 2)


def _freed(camera: Camera, *, usual: bool) -> Camera:
    """The camera with its usual or all parameters estimated; as it is, where they are already."""
    model = camera.registered
    if model is None or camera.covariance is not None:
        return camera
    wanted = model.usual if usual else model.names
    free = tuple(name for name in model.names if name in {*camera.free, *wanted})
    return camera if set(free) == set(camera.free) else replace(camera, free=free)


def grouped(network: Network, rows: Rows | Sequence[int]) -> list[Remark]:
    """Name points and images to which many of the suspected image points belong.

    Parameters
    ----------
    network : Network
        The network.
    rows : sequence of int
        Suspected image points.

    Returns
    -------
    list of Remark
        A point most of whose rays disagree may have two identities; an image, that of another scene.
    """
    rows = np.asarray(rows, dtype=np.intp)
    found = []
    images = Counter(network.image_of[rows].tolist())
    whole = [i for i, count in images.items() if count > 3 and count >= _SHARE * network.seen[i]]
    rest = rows[~np.isin(network.image_of[rows], whole)]
    points = Counter(network.point_of[rest].tolist())
    twice = [j for j, count in points.items() if count > 1 and count >= _SHARE * network.rays[j]]
    if whole and len(whole) <= 0.5 * len(network.images):
        names = listed(network.images[i] for i in sorted(whole))
        found.append(
            f"many points of image{'s' * (len(whole) > 1)} {names} contradict the others: names of another "
            "image, another camera, or a mirrored image?"
        )
    if twice:
        names = listed(network.points[j] for j in sorted(twice))
        found.append(
            f"the rays of point{'s' * (len(twice) > 1)} {names} contradict each other: one name for two "
            "points?"
        )
    return [Remark(text, Code.GROSS_ERRORS) for text in found]
