"""Warnings about an adjustment; each names the points, images or parameters that it concerns."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import scipy

from ...adjust.reliability import critical_w
from ...core.data import Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Remark
from ..network.network import LEAST_POINTS, Network
from ..solver.problem import BundleFit
from .patterns import CommonPattern, by_place, common_pattern
from .regularisation import regularised
from .result import Result

LISTED = 8
SHOWN = 3
"""Names of points where the images that see them say more."""
_CORRELATED, _WEAK, _ALPHA = 0.95, 5.0, 1e-4
# Size of the next correction, in standard deviations, that counts as converged.
_NEAR = 1e-3
# Minimum redundancy of an image for comparing its scatter with that of the other images.
_MIN_REDUNDANCY = 5.0
# Minimum number of images of a camera for the search for a common residual pattern.
_MIN_IMAGES = 3
# Size of a corner as a fraction of width and height.
_CORNER = 0.2
# Millimetres in a unit of object space.
_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
# Points are in a plane where their extent across it is this part of the largest.
_PLANE = 1e-4


def listed(names: Iterable[object], most: int = LISTED) -> str:
    """Join names with commas; of many names only the first, and the number of the others."""
    every = [str(name) for name in names]
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more


def in_images(network: Network, rows: Rows, said: Callable[[int], str] = lambda row: "") -> str:
    """Name image points by their images, in the order of the first of each; of many only the first.

    `said` is written after a point.
    """
    points = dict[str, list[str]]()
    for k in rows[:LISTED].tolist():
        image = network.images[network.image_of[k]]
        points.setdefault(image, []).append(f"{network.points[network.point_of[k]]}{said(k)}")
    words = [
        f"in image {image}: point{'s' * (len(names) > 1)} {', '.join(names)}"
        for image, names in points.items()
    ]
    return "; ".join([*words, *([f"and {len(rows) - LISTED} more"] if len(rows) > LISTED else [])])


def _gaps(result: Result) -> list[Remark]:
    """Return remarks on points, images and cameras that were left out, with the reasons.

    Images whose points data snooping rejected are reported where that is decided.
    """
    network, fit = result.network, result.fit
    part, rays = fit.usable.points, network.rays
    kept = np.bincount(network.image_of[~result.rejected], minlength=len(network.images))
    images = np.flatnonzero(~fit.usable.images & ((kept > 0) | (network.seen == 0)))
    found = _lost_images(network, images, part)
    lost = ~part & ~network.held.all(axis=1)
    nowhere = np.flatnonzero(lost & (rays == 0))
    if len(nowhere):
        defect = int((~network.held & ~network.observed)[nowhere].sum())
        found.append(
            Remark(
                f"rank defect {defect}: {_points(network, nowhere)} in no image; left out", Code.RANK_DEFECT
            )
        )
    single = np.flatnonzero(lost & (rays == 1))
    if len(single):
        alone = np.isin(network.point_of, single)
        where = listed(network.images[i] for i in np.unique(network.image_of[alone]))
        found.append(
            Remark(
                f"rank defect {len(single)}: {_points(network, single, SHOWN)} in one image only ({where}); "
                "a single ray does not determine a point; left out, until a second image shows "
                f"{'it' if len(single) == 1 else 'them'} from another place",
                Code.RANK_DEFECT,
            )
        )
    lit = np.bincount(network.point_of[fit.usable.images[network.image_of]], minlength=len(part))
    parallel = np.flatnonzero(lost & (rays > 1) & (lit > 1))
    if len(parallel):
        names = listed(network.points[j] for j in parallel)
        found.append(
            Remark(
                f"{_plural('point', parallel)} {names} left out: rays are parallel or have gross errors",
                Code.NOT_IDENTIFIED,
            )
        )
    few = np.flatnonzero(lost & (rays > 1) & (lit <= 1))
    if len(few):
        found.append(
            Remark(
                f"{_points(network, few)} in fewer than two oriented images; left out",
                Code.NOT_IDENTIFIED,
            )
        )
    used = np.bincount(network.camera_of[fit.usable.images], minlength=len(network.cameras))
    for c in np.flatnonzero(used == 0):
        found.append(
            Remark(
                f"{network.cameras[c].label} has no image; its parameters are unchanged",
                Code.TOO_FEW_IMAGES,
            )
        )
    return found


def _lost_images(network: Network, images: Rows, adjusted: Mask) -> list[Remark]:
    """Images that were left out: too few points, no points in common with the others, or wrong names.

    `adjusted` are the points (p,) that have coordinates.
    """
    common = np.bincount(network.image_of[adjusted[network.point_of]], minlength=len(network.images))
    few = network.seen[images] < LEAST_POINTS
    apart = ~few & (common[images] < LEAST_POINTS)
    said = [
        (few, "fewer than three points; left out"),
        (
            apart,
            "fewer than three points in common with the others: another network; left out; adjust it "
            "apart, or measure points that both show",
        ),
        (
            ~few & ~apart,
            "points that agree with no position; left out; are their names those of another image?",
        ),
    ]
    return [
        Remark(
            f"{_plural('image', images[of])} {listed(network.images[i] for i in images[of])} "
            f"{'has' if of.sum() == 1 else 'have'} {what}",
            Code.TOO_FEW_POINTS,
        )
        for of, what in said
        if of.any()
    ]


def checks(result: Result) -> list[Remark]:
    """Check an adjustment: what was left out, convergence, global test, weak points, residual patterns.

    Parameters
    ----------
    result : Result
        The adjustment.

    Returns
    -------
    list of Remark
        A text and a code for each finding; empty where nothing was found.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> [remark.code.value for remark in checks(result)]
    ['coverage']
    """
    network, fit = result.network, result.fit
    return [
        *_several(result),
        *_too_near(result),
        *_without_perspective(result),
        *_gaps(result),
        *_not_converged(result),
        *_global(result),
        *_large(result),
        *_correlations(result),
        *_refraction(result),
        *_weak(result),
        *_datum(result),
        *_scatter(result),
        *_patterns(result),
        *_behind(network, fit),
        *_parallel(network, fit),
        *_corners(network, fit),
        *_regularised(result),
    ]


def _plural(word: str, rows: Rows) -> str:
    return word if len(rows) == 1 else f"{word}s"


def _points(network: Network, rows: Rows, most: int = LISTED) -> str:
    verb = "is" if len(rows) == 1 else "are"
    return f"{_plural('point', rows)} {listed((network.points[int(j)] for j in rows), most)} {verb}"


def _global(result: Result) -> list[Remark]:
    test = result.global_test()
    if test is None:
        return [
            Remark(
                "no redundant observations: no checks are possible, and sigmas are a priori",
                Code.NO_REDUNDANCY,
            )
        ]
    few = _few(result)
    if test.passed:
        return few
    return [
        Remark(
            f"global test: residuals are {_times(result.sigma0)} what input sigmas say (sigma0 "
            f"{result.sigma0:.4g}), which chance does not explain",
            Code.SIGMAS_DOUBTFUL,
        ),
        *few,
    ]


def _few(result: Result) -> list[Remark]:
    """That few redundant observations do not say how large sigma0 is, where that matters."""
    if not result.fit.variance > 1.1 * result.sigma0**2:
        return []
    return [
        Remark(
            f"redundancy {result.redundancy} hardly shows how large residuals are (sigma0 "
            f"{result.sigma0:.3g}): input sigmas count too, and uncertainties are those of sigma0 "
            f"{np.sqrt(result.fit.variance):.2g}",
            Code.SIGMAS_DOUBTFUL,
        )
    ]


def _times(ratio: float) -> str:
    """A ratio in words."""
    return f"{100 * ratio:.3g} % of" if ratio < 2 else f"{ratio:.2g} times"


def _not_converged(result: Result) -> list[Remark]:
    if result.fit.offset < _NEAR:
        return []
    return [
        Remark(
            f"not fully converged: the next correction would be {result.fit.offset:.2g} standard deviations",
            Code.NOT_CONVERGED,
        )
    ]


def _large(result: Result) -> list[Remark]:
    """Image points whose test value exceeds the critical value for the maximum of all test values."""
    w = np.nan_to_num(result.test_values).max(axis=1)
    critical = critical_w(_ALPHA / max(1, 2 * len(w)))
    rows = np.flatnonzero(w > critical)
    if not len(rows):
        return []
    rows = rows[np.argsort(-w[rows], kind="stable")]
    network = result.network
    names = in_images(network, rows, lambda k: f" (w {w[k]:.1f})")
    return [
        Remark(
            f"{len(rows)} image {_plural('point', rows)} deviate{'s' * (len(rows) == 1)} more than chance "
            f"explains (test value w above {critical:.1f}) {names}",
            Code.GROSS_ERRORS,
        )
    ]


def _correlations(result: Result) -> list[Remark]:
    found = []
    for c, camera in enumerate(result.network.cameras):
        names, _, _ = result.camera_columns(c)
        if not names:
            continue
        q = result.formal_camera_covariance(c)
        size = np.sqrt(np.diag(q))
        size = np.where(size > 0, size, 1.0)
        r = q / np.outer(size, size)
        at = list(zip(*np.nonzero(np.abs(np.tril(r, -1)) > _CORRELATED), strict=True))
        if at:
            pairs = listed(f"{names[k]} and {names[i]} (correlation {r[i, k]:.3f})" for i, k in at)
            found.append(
                Remark(
                    f"{camera.label}: {pairs} can hardly be distinguished; use them together",
                    Code.CORRELATED,
                )
            )
    q = result.pose_covariance[result.fit.usable.images]
    size = np.sqrt(np.maximum(np.diagonal(q, axis1=1, axis2=2), 0.0))
    size = np.where(size > 0, size, 1.0)
    r = np.abs(np.tril(q / (size[:, :, None] * size[:, None, :]), -1)).max(axis=(1, 2), initial=0.0)
    images = np.flatnonzero(result.fit.usable.images)[r > _CORRELATED]
    if len(images):
        names_of = listed(result.network.images[i] for i in images)
        found.append(
            Remark(
                f"{_plural('image', images)} {names_of}: position and rotation can hardly be distinguished "
                f"(correlation above {_CORRELATED}); use them together",
                Code.CORRELATED,
            )
        )
    return found


def _refraction(result: Result) -> list[Remark]:
    """Parameters of windows and media that are hardly determined, and rays that miss windows."""
    found, named = list[Remark](), result.refraction
    if named is not None:
        pairs = [
            f"{name} with {partner} ({r:.3f})"
            for name, (partner, r) in zip(named.parameters, named.partners, strict=True)
            if abs(r) > _CORRELATED
        ]
        if pairs:
            found.append(Remark(f"windows and media: correlated are {listed(pairs)}", Code.CORRELATED))
        xyz = result.points.xyz
        size = float(np.nanmax(np.abs(xyz - np.nanmean(xyz, axis=0))))
        loose = [
            f"{name} (± {sigma:.2g}{' ' * bool(unit)}{unit})"
            for name, value, sigma, unit in zip(
                named.parameters, named.values.tolist(), named.sigma.tolist(), named.units, strict=True
            )
            if sigma > _known_to(name, value, size)
        ]
        if loose:
            found.append(
                Remark(
                    f"images from one side hardly determine {listed(loose)}: hold it, or give it a sigma",
                    Code.NOT_IDENTIFIED,
                )
            )
    rows, network = result.misses_windows, result.network
    if len(rows):
        names = [
            f"{network.points[network.point_of[k]]} in image {network.images[network.image_of[k]]}"
            for k in rows
        ]
        found.append(
            Remark(
                f"no ray through the windows leads to {_plural('point', rows)} {listed(names)}: computed as "
                "in air",
                Code.INCONSISTENT,
            )
        )
    return found


def _known_to(name: str, value: float, size: float) -> float:
    """How well a parameter of windows or media is known before any adjustment of a network of this size."""
    if name.startswith("index of"):
        return 0.5
    if name.startswith(("thickness of", "radius of")):
        return abs(value)
    # Tangents, curvatures and lengths.
    return 1.0 if name.startswith("tilt") else 1 / size if name.startswith("curvature") else size


def _weak(result: Result) -> list[Remark]:
    """Points with much larger standard deviations than the others."""
    network = result.network
    sigma = np.sqrt((result.point_sigma**2).sum(axis=1))
    free = np.isfinite(sigma) & ~network.held.all(axis=1)
    if not free.any():
        return []
    median = float(np.median(sigma[free]))
    rows = np.flatnonzero(free & (sigma > _WEAK * median))
    if not len(rows) or median == 0:
        return []
    rows = rows[np.argsort(-sigma[rows], kind="stable")]
    names = [f"{network.points[j]} ({sigma[j]:.3g} {network.unit}, {network.rays[j]} rays)" for j in rows]
    return [
        Remark(
            f"weak {_plural('point', rows)}, sigma above {_WEAK:g} times the median: {listed(names)}",
            Code.WEAK_GEOMETRY,
        )
    ]


def _datum(result: Result) -> list[Remark]:
    """Weak points that inner constraints over all points leave out."""
    network, fit = result.network, result.fit
    if fit.datum is None or network.datum_chosen or not network.datum_points.all():
        return []
    rows = np.flatnonzero(fit.usable.points & ~fit.datum)
    if not len(rows):
        return []
    names = listed(network.points[j] for j in rows)
    return [
        Remark(
            f"{len(rows)} weak {_plural('point', rows)} left out of the datum: {names}", Code.WEAK_GEOMETRY
        )
    ]


def _scatter(result: Result) -> list[Remark]:
    """Images, and the axis, whose coordinates scatter more than the others."""
    if not result.redundancy > 0 or not result.sigma0 > 0:
        return []
    squares, number = result.scatter
    own, r = squares.sum(axis=1), number.sum(axis=1)
    others, rest = own.sum() - own, r.sum() - r
    rows = np.flatnonzero(
        result.fit.usable.images & (r > _MIN_REDUNDANCY) & (rest > _MIN_REDUNDANCY) & (others > 0)
    )
    ratio = own[rows] / r[rows] / (others[rows] / rest[rows])
    more = scipy.special.fdtrc(r[rows], rest[rows], ratio) < _ALPHA / max(1, len(rows))
    rows, size = rows[more], np.sqrt(ratio[more])
    order, found = np.argsort(-size, kind="stable"), []
    names = [f"{result.network.images[i]} ({s:.2g})" for i, s in zip(rows[order], size[order], strict=True)]
    if names:
        found.append(
            Remark(
                f"image coordinates scatter more than in other images, by the factor in brackets, in "
                f"{_plural('image', rows)} {listed(names)}",
                Code.SIGMAS_DOUBTFUL,
            )
        )
    total, count = squares.sum(axis=0), number.sum(axis=0)
    if count.min() > _MIN_REDUNDANCY and total.min() > 0:
        mean = total / count
        a = int(mean.argmax())
        times = mean[a] / mean[1 - a]
        if scipy.special.fdtrc(count[a], count[1 - a], times) < _ALPHA:
            found.append(
                Remark(
                    f"{'xy'[a]} scatters {np.sqrt(times):.2f} times as much as "
                    f"{'xy'[1 - a]}, relative to the input sigmas",
                    Code.SIGMAS_DOUBTFUL,
                )
            )
    return found


def unmodelled_pattern(result: Result, camera: int) -> CommonPattern | None:
    """Return the residual pattern that the images of a camera have in common, where it is significant.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> unmodelled_pattern(adjust_network(example_network()), 0) is None
    True
    """
    if (result.network.camera_of[result.fit.usable.images] == camera).sum() < _MIN_IMAGES:
        return None
    try:
        pattern = common_pattern(result, by_place(result, camera))
    except UsageError:
        return None
    return pattern if pattern.p < _ALPHA and pattern.rms > 0 else None


def _patterns(result: Result) -> list[Remark]:
    """Cameras whose images have a common residual pattern, by position in the image."""
    cameras = result.network.cameras
    patterns = [(camera, unmodelled_pattern(result, c)) for c, camera in enumerate(cameras)]
    found = [
        Remark(
            f"{camera.label}: common residual pattern of its images (F {pattern.statistic:.1f}, "
            f"{pattern.rms:.2g} px rms), which the model does not describe",
            Code.UNMODELLED,
        )
        for camera, pattern in patterns
        if pattern is not None
    ]
    return found[:LISTED]


def _behind(network: Network, fit: BundleFit) -> list[Remark]:
    rows = np.flatnonzero(fit.usable.observations)
    i, j = network.image_of[rows], network.point_of[rows]
    depth = np.einsum("nk,nk->n", fit.values.rotation[i, 2], fit.values.xyz[j] - fit.values.x0[i])
    wrong = rows[(depth <= 0) & ~network.parallel[i]]
    if not len(wrong):
        return []
    names = [
        f"{network.points[network.point_of[k]]} in image {network.images[network.image_of[k]]}" for k in wrong
    ]
    return [Remark(f"{_plural('point', wrong)} behind the camera: {listed(names)}", Code.GROSS_ERRORS)]


def _parallel(network: Network, fit: BundleFit) -> list[Remark]:
    """What images with parallel rays do not determine."""
    images = np.flatnonzero(fit.usable.images & network.parallel)
    if not len(images):
        return []
    names = listed(network.images[i] for i in images)
    text = (
        f"rank defect of each image with parallel rays: the distance of the camera along its axis is not "
        f"determined, and held, in {names}"
    )
    found = [Remark(text, Code.NOT_IDENTIFIED)]
    points = fit.values.xyz[fit.usable.points]
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[2] < _PLANE * extent[0]:
        text = (
            "all points are in a plane: two tilts of an image with parallel rays, mirrored at its image "
            "plane, have the same image points; one of them was chosen for each image"
        )
        found.append(Remark(text, Code.NOT_IDENTIFIED))
    return found


def _several(result: Result) -> list[Remark]:
    """Other solutions that the observations allow, and how much they differ."""
    network, fit, unknowns = result.network, result.fit, result.fit.unknowns
    if not result.others:
        return []
    turned, moved = np.zeros(len(network.images)), np.zeros(len(network.points))
    for other in result.others:
        change, points = other.change(fit)
        angle = np.linalg.norm(change[unknowns.pose[:, None] + np.arange(3)], axis=1)
        turned = np.maximum(turned, np.where(unknowns.pose >= 0, np.degrees(angle), 0.0))
        moved = np.fmax(moved, np.linalg.norm(points, axis=1))
    i, j = int(np.argmax(turned)), int(np.argmax(moved))
    extent = np.linalg.norm(np.std(fit.values.xyz[fit.usable.points], axis=0))
    free = "scale" in fit.freedom.names
    by = f"{100 * moved[j] / extent:.2g} % of their extent" if free else f"{moved[j]:.2g} {network.unit}"
    said = [
        *([f"image {network.images[i]} is turned by up to {turned[i]:.2g} deg"] * bool(turned[i])),
        *([f"point {network.points[j]} is up to {by} away"] * bool(moved[j])),
        *(
            unknowns.names[k]
            for k in np.flatnonzero(result.in_doubt[0])
            if " of camera " in unknowns.names[k]
        ),
    ]
    most = max(0.0, *(other.excess for other in result.others))
    return [
        Remark(
            f"other solutions explain the observations as well (vᵀPv larger by at most {most:.2g} σ0²): "
            f"{listed(said)} in them. What differs has no standard deviation. Points near a quadric "
            "through the projection centres, points in a plane and few control points leave this open: add "
            "control points, distances, or images from other places",
            Code.AMBIGUOUS,
        )
    ]


def _without_perspective(result: Result) -> list[Remark]:
    """Cameras of which parallel rays predict the image points as well."""
    return [
        Remark(
            f"{camera.label}: parallel rays predict the image points as well as perspective (the reciprocal "
            f"of the focal length is {size:.2g} times its sigma): neither focal length nor distances are "
            "determined; take images from nearer, or tilted against each other, or hold the focal length",
            Code.NOT_IDENTIFIED,
        )
        for c, camera in enumerate(result.network.cameras)
        for size, seen in [result.perspective(c)]
        if not seen
    ]


def _too_near(result: Result) -> list[Remark]:
    """Points nearer than the principal distance: no lens forms an image of them."""
    network, values, found = result.network, result.fit.values, list[Remark]()
    if not (network.held.any() or network.observed.any() or len(network.distance)):
        return []
    for c, camera in enumerate(network.cameras):
        model, unit = camera.registered, _MM.get(network.unit)
        if model is None or unit is None or not model.needs_pitch or camera.in_pixels or camera.parallel:
            continue
        own = result.fit.usable.observations & (network.camera_of[network.image_of] == c)
        image, point = network.image_of[own], network.point_of[own]
        away = np.einsum("ni,ni->n", values.rotation[image, 2], values.xyz[point] - values.x0[image])
        scales = model.of_role("scale")
        focal = [v for name, v in zip(camera.names, values.cameras[c], strict=False) if name in scales]
        near = float(np.median(away)) if len(away) else np.inf
        if unit * near < min(focal, default=0.0):
            found.append(
                Remark(
                    f"{camera.label}: the points are {near:.3g} {network.unit} away, nearer than the "
                    f"principal distance ({min(focal):.3g} mm): no lens forms an image of them; are the "
                    "coordinates in another unit?",
                    Code.IMPLAUSIBLE,
                )
            )
    return found


def _corners(network: Network, fit: BundleFit) -> list[Remark]:
    """Image corners without points, for cameras with free parameters."""
    found, used = [], fit.usable.observations
    for camera, rays in zip(network.cameras, network.rays_of_cameras, strict=True):
        rows = rays[used[rays]]
        if not camera.free or not len(rows):
            continue
        x, y = (network.xy[rows] / [camera.width, camera.height]).T
        corners = {
            "upper left": (x < _CORNER) & (y < _CORNER),
            "upper right": (x > 1 - _CORNER) & (y < _CORNER),
            "lower left": (x < _CORNER) & (y > 1 - _CORNER),
            "lower right": (x > 1 - _CORNER) & (y > 1 - _CORNER),
        }
        empty = [name for name, inside in corners.items() if not inside.any()]
        if empty:
            found.append(
                Remark(f"{camera.label}: no points in the {', '.join(empty)} of its images", Code.COVERAGE)
            )
    return found[:LISTED]


def _regularised(result: Result) -> list[Remark]:
    """Parts of the image where a camera is as it is because of its regularisation."""
    remarks = []
    for c, camera in enumerate(result.network.cameras):
        found = regularised(result, c)
        if found is None or not found.mostly.any():
            continue
        order = sorted(found.regions, key=lambda name: -found.regions[name])
        regions = listed(f"{name} ({100 * found.regions[name]:.0f} % of that ninth)" for name in order)
        remarks.append(
            Remark(
                f"{camera.label}: the regularisation, not the image points, determines most of the camera in "
                f"{100 * found.area:.0f} % of its images: {regions}; the projection there has a sigma of up "
                f"to {found.largest:.2g} px. Where there are image points, it causes "
                f"{100 * found.where_observed:.0f} % of the variance in the median",
                Code.COVERAGE,
            )
        )
    return remarks[:LISTED]
