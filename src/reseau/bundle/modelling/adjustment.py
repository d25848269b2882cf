"""From a network to its result: approximate values, adjustment, detection of gross errors, warnings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...adjust.outliers import SnoopingStep
from ...core import vocabulary as v
from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure, Remark
from ...core.threads import one_thread
from ..diagnostics import ControlShape, checks
from ..diagnostics.causes import (
    causes,
    given_poses_that_do_not_fit,
    motion_of_narrow_lens,
    outside_image,
    seen_frontally,
)
from ..diagnostics.checks import in_images, listed
from ..diagnostics.control_check import (
    ControlCheck,
    checked_control,
    control_shape,
    suspected,
    without_control,
)
from ..diagnostics.result import Result
from ..diagnostics.stage_check import checked_readings, without_readings
from ..diagnostics.suspects import (
    contradicting,
    doubtful_parameters,
    grouped,
    uneven_axes,
    without_false_bars,
)
from ..network.network import Network, finite
from ..network.rig import RigValues
from ..network.stage import Stage
from ..solver.approximation import approximate
from ..solver.datum import Similarity
from ..solver.problem import LAST_ROUND, BundleFit, BundleProblem
from ..solver.unknowns import Unknowns
from ..solver.values import Values
from .one_station import one_station
from .other_starts import compared
from .rejection import MANY, bent_plane, many_rejected, suspects, without_gross_errors
from .startup import RETRIED, adjusted_in_steps, lost_images, settled

# Relative sigma of a principal distance that is hardly determined.
_WEAK = 3e-3
# Iterations of an adjustment with values that are not plausible.
_FEW = 30
# Median angle (rad) between the orientations of an exposure by its images that were not taken at once.
_NOT_AT_ONCE = 0.05
# Part of the points of an image above which it is left out as a whole.
_MOSTLY = 0.5
# Sigma0 above which control points and single observations are checked.
_DOUBT = 3.0


@dataclass(frozen=True)
class Options:
    """How to adjust a network.

    Parameters
    ----------
    outliers : {"keep", "reject"}
        Whether to reject image points by data snooping, after a robust start. With ``keep``, image points
        with large test values are named in the warnings.
    alpha : float
        Significance level of a single test of data snooping.
    max_fraction : float
        Largest fraction of the observations that may be rejected.
    max_iterations : int
        Maximum number of iterations of one adjustment.
    tolerance : float
        Relative offset at which the iteration has converged.
    watch : callable, optional
        Called with the number of iterations and vᵀPv after each iteration.
    memory_gb : float, optional
        Memory (GB) that normal equations and their factors may take; by default half of what is available.
        Where they need more, they are solved by conjugate gradients: the estimates are the same, covariances
        of single images and cameras are computed when asked for, other statistics are not.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> adjust_network(example_network(), Options(max_iterations=20)).fit.iterations < 20
    True
    """

    outliers: Literal["keep", "reject"] = "keep"
    alpha: v.Alpha = 0.001
    max_fraction: float = 0.25
    max_iterations: int = 200
    tolerance: float = 1e-6
    watch: Callable[[int, float], None] | None = None
    memory_gb: v.MemoryGb | None = None

    def __post_init__(self) -> None:
        if self.outliers not in ("keep", "reject"):
            raise UsageError(f"is {self.outliers!r}, not `keep` or `reject`", where="Options.outliers")
        if not 0 < self.alpha < 1 or not 0 < self.max_fraction < 1:
            raise UsageError("must be between 0 and 1", where="alpha and max_fraction")
        if self.memory_gb is not None and not self.memory_gb >= 0:
            raise UsageError(f"is {self.memory_gb!r}, not a number of GB", where="Options.memory_gb")


def problem_of(network: Network, options: Options | None = None) -> tuple[BundleProblem, tuple[Remark, ...]]:
    """Return the network with approximate values as a problem of :mod:`reseau.adjust`, and remarks.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> problem, notes = problem_of(example_network())
    >>> problem, notes
    (<BundleProblem: 8 images, 20 points, 320 observations>, ())
    """
    problem, notes, doubts = _begun(network, options or Options(), settle=True)
    return problem, (*notes, *doubts)


def _begun(
    network: Network, options: Options, *, settle: bool
) -> tuple[BundleProblem, tuple[Remark, ...], tuple[Remark, ...]]:
    """Return the problem, what approximate values tell, and what is doubtful about the network."""
    found, doubts = approximate(network), tuple[Remark, ...]()
    unknowns = Unknowns.of(network, finite(found.x0))
    start = Values.of_cameras(unknowns, found.rotation, found.x0, found.xyz)
    start = replace(start, motion=found.motion)
    stage = network.stage
    if stage is not None and network.rig is None:
        if stage.rotary and not finite(network.x0[stage.pose >= 0]).all():
            start = _apart(network, options, start)
        stage, doubts = _with_right_readings(network, stage, options, start)
        network = replace(network, stage=stage)
        moved, rotation, x0 = stage.approximate(start.rotation, start.x0)
        start = replace(start, rotation=rotation, x0=x0, stage=moved)
    if network.rig is not None:
        if not finite(network.x0[network.rig.exposure >= 0]).all():
            start = _apart(network, options, start)
        odd, typical = network.rig.apart(start.rotation, start.x0)
        if len(odd) or typical > _NOT_AT_ONCE:
            network, doubts = _not_at_once(network, odd, typical, apart=options.outliers == "reject")
    if network.rig is not None:
        places, rotation, x0 = network.rig.approximate(start.rotation, start.x0)
        if network.stage is not None:
            stage, more = _with_right_readings(network, network.stage, options, start)
            doubts = (*doubts, *more)
            moved, rotation, x0 = stage.approximate(rotation, x0, network.camera_of)
            places, rotation, x0 = network.rig.approximate(rotation, x0)
            network, start = replace(network, stage=stage), replace(start, stage=moved)
        start = replace(start, rotation=rotation, x0=x0, rig=places)
        scale = _scale_of_bases(network, places)
        start, found = Similarity(scale, np.eye(3), np.zeros(3))(start), replace(found, xyz=scale * found.xyz)
    problem = BundleProblem(
        network, start, found.xyz, None, options.max_iterations, options.tolerance, options.watch,
        memory=None if options.memory_gb is None else 1e9 * options.memory_gb,
    )  # fmt: skip
    if not settle:
        return replace(problem, rounds=LAST_ROUND), found.notes, doubts
    if len(lost_images(network, start.x0, start.xyz)):
        problem = settled(problem)
    return problem, found.notes, doubts


def _with_right_readings(
    network: Network, stage: Stage, options: Options, start: Values
) -> tuple[Stage, tuple[Remark, ...]]:
    """Return the stage, without wrong readings where outliers are rejected, and what to say of them."""
    remarks, odd = checked_readings(network, start.rotation, start.x0)
    if not len(odd) or options.outliers != "reject":
        return stage, remarks
    done = [
        replace(remark, text=f"{remark.text}; estimated from the images") if remark is remarks[-1] else remark
        for remark in remarks
    ]
    return without_readings(stage, odd), tuple(done)


def _scale_of_bases(network: Network, places: RigValues) -> float:
    """Factor that gives a network its scale by the known bases, where nothing else does; otherwise 1."""
    rig = network.rig
    others = len(network.distance) or network.observed.any() or network.held.any()
    if rig is None or not len(rig.base) or others:
        return 1.0
    length = places.lengths(rig.base_of)
    return float(np.median(rig.base[length > 0, 0] / length[length > 0])) if (length > 0).any() else 1.0


def _apart(network: Network, options: Options, start: Values) -> Values:
    """Return the values of an adjustment in which every image has an orientation of its own.

    Orientations by approximate cameras would make a poor rig or axis of a stage, and not show which images do
    not belong together. Where there is no such adjustment, the values remain. Windows of the rig are held
    before each camera where the approximate values have them.
    """
    bent = network.refraction
    if bent is not None and network.rig is not None and bent.on_rig.any():
        places, _, _ = network.rig.approximate(start.rotation, start.x0)
        bent = bent.on_cameras(network.camera_of, *places)
    problem = _begun(replace(network, rig=None, stage=None, refraction=bent), options, settle=True)[0]
    fit = adjusted_in_steps(problem)
    return start if isinstance(fit, Failure) else replace(fit.values, refraction=start.refraction)


def _not_at_once(
    network: Network, odd: Rows, typical: float, *, apart: bool
) -> tuple[Network, tuple[Remark, ...]]:
    """Return what to say of images that were not taken at once, and the network with them apart."""
    if typical > _NOT_AT_ONCE:
        text = (
            f"the relative orientation of the cameras differs from exposure to exposure, in the median by "
            f"{np.degrees(typical):.2g} deg: were the images of an exposure taken at once?"
        )
        return network, (Remark(text, Code.INCONSISTENT),)
    names = listed(network.images[i] for i in odd)
    bent = network.refraction
    through = bent is not None and bool(bent.on_rig[bent.path_of[odd]][bent.path_of[odd] >= 0].any())
    done = "; left out" if apart and through else "; adjusted apart from the rig" if apart else ""
    text = f"images {names} were not taken at once with the others of their exposure{done}"
    rig = network.rig
    if apart and rig is not None:
        if bent is not None and through:
            # Where the window of the rig was, is not known.
            path_of = bent.path_of.copy()
            path_of[odd] = -1
            network = network.select(~np.isin(network.image_of, odd))
            network = replace(network, refraction=replace(bent, path_of=path_of))
        stage = network.stage
        if stage is not None:
            pose = stage.pose.copy()
            pose[odd] = -1
            stage = replace(stage, pose=pose)
        network = replace(network, rig=rig.without(odd), stage=stage)
    return network, (Remark(text, Code.INCONSISTENT),)


@one_thread()
def adjust_network(network: Network, options: Options | None = None) -> Result | Failure:
    """Adjust a network of images.

    Parameters
    ----------
    network : Network
        Cameras, images, points, observations.
    options : Options, optional
        Options of the adjustment.

    Returns
    -------
    Result or Failure
        A failure is falsy and says what is missing or wrong.

    Notes
    -----
    Self-calibrating bundle adjustment (Brown 1971; Förstner & Wrobel 2016, ch. 15); see
    ``docs/mathematics/bundle.md``.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> result = adjust_network(example_network())
    >>> result.cameras["camera"]
    <CameraEstimate: camera, c 8.00... mm, ...>
    >>> adjust_network(replace(example_network(), datum="control")).code.value
    'no-datum'
    """
    options = options or Options()
    found = causes(network)
    grave = [remark for remark in found if remark.code is Code.IMPLAUSIBLE]
    if grave:
        # Far from any solution many iterations lead nowhere.
        options = replace(options, max_iterations=min(options.max_iterations, _FEW))
    problem, notes, doubts = _begun(network, options, settle=not grave)
    network = problem.network
    for remark in doubts:
        if remark.code is Code.READINGS:
            return Failure(remark.text, remark.code)
    found += doubts
    if options.outliers == "reject":
        large = problem.too_large
        if large:
            return Failure(
                f"{large}; without them gross errors cannot be rejected: keep them, allow more memory, or "
                "adjust parts of the network",
                Code.TOO_LARGE,
            )
        problem = _within_the_images(problem)
    problem, false_bars = without_false_bars(problem)
    found += false_bars
    found += given_poses_that_do_not_fit(network, _misfits_px(problem))
    steps: tuple[SnoopingStep, ...] = ()
    if options.outliers == "reject":
        careful = _rejecting(problem, options)
        if isinstance(careful, Failure):
            return _explained(careful, problem, found)
        (fit, steps, left), of_control = careful
        given = _given_weights(problem, fit)
        problem = replace(problem, network=fit.problem.network, weights=fit.problem.weights)
        network = problem.network
        notes = (*notes, *left)
    else:
        plain = problem.adjusted() if grave else adjusted_in_steps(problem)
        if isinstance(plain, Failure):
            return _explained(plain, problem, found)
        fit, given = plain, problem.weights
        if not fit.cofactors.reduced.known:
            found += [_without_statistics(problem), *notes]
            return Result(network, fit, np.zeros(len(network.xy), dtype=bool), (), tuple(found))
        _, of_control = (None, []) if grave else _control(problem, fit)
    n = len(network.xy)
    rejected = np.asarray(fit.rejected[: 2 * n].reshape(n, 2).any(axis=1))
    fit, others = (fit, ()) if grave else compared(fit)
    without_depth = None if grave else one_station(problem, fit)
    if without_depth is not None:
        return without_depth
    bare = Result(network, fit, rejected, steps, others=others)
    if not grave:
        found += _doubts(problem, fit, of_control, given)
        found += [] if of_control else _rejected_control(network, rejected)
        found += _frontal(network, bare)
    found += many_rejected(network, rejected)
    return replace(bare, warnings=(*found, *notes, *_checked(bare, found)))


def _checked(result: Result, found: list[Remark]) -> list[Remark]:
    """What checks find; no gross errors where the standard deviations of an axis make them."""
    wrong = any(remark.code is Code.SIGMAS_DOUBTFUL for remark in found)
    return [each for each in checks(result) if not (wrong and each.code is Code.GROSS_ERRORS)]


def _without_statistics(problem: BundleProblem) -> Remark:
    """Return what to say of an adjustment by conjugate gradients."""
    return Remark(
        f"{problem.too_large}: solved by conjugate gradients; covariances of single images and cameras are "
        "computed when asked for, those of all images and points, redundancy numbers, tests and checks are "
        "not; allow more memory for them",
        Code.TOO_LARGE,
    )


def _within_the_images(problem: BundleProblem) -> BundleProblem:
    """Return the problem without image points outside their images."""
    rows = outside_image(problem.network)
    if not len(rows):
        return problem
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    weights[2 * rows] = weights[2 * rows + 1] = 0.0
    return problem.with_weights(weights)


def _rejected_control(network: Network, rejected: Mask) -> list[Remark]:
    """Control points most of whose rays are rejected: their coordinates are wrong, not the rays."""
    gone = np.bincount(network.point_of[rejected], minlength=len(network.points))
    bad = network.held.all(axis=1) & (gone > 1) & (gone > _MOSTLY * network.rays)
    if not bad.any():
        return []
    names = listed(network.points[j] for j in np.flatnonzero(bad))
    several = int(bad.sum()) > 1
    return [
        Remark(
            f"the control point{'s' * several} {names} contradict{'s' * (not several)} the images: most rays "
            "are rejected; are the coordinates right?",
            Code.DOUBTFUL_CONTROL,
        )
    ]


def _misfits_px(problem: BundleProblem) -> Array:
    """Misfits (n,) of the image coordinates at the approximate values, in pixels."""
    size = np.sqrt(np.trace(problem.network.cov, axis1=1, axis2=2) / 2)
    weighted: Array = np.sqrt((problem.misfits_at_start() ** 2).sum(axis=1)) * size
    return weighted


def _frontal(network: Network, result: Result) -> list[Remark]:
    """A principal distance that a plane seen frontally leaves uncertain."""
    fit = result.fit
    found = seen_frontally(network, fit.values.rotation, fit.values.xyz, fit.usable.images)
    if not found:
        return []
    for c, camera in enumerate(network.cameras):
        names, _, values = result.camera_columns(c)
        model = camera.registered
        sigma = np.sqrt(np.diag(result.formal_camera_covariance(c)))
        scale = () if model is None else model.of_role("scale")
        weak = [
            name for name, v, s in zip(names, values, sigma, strict=True) if name in scale and s > _WEAK * v
        ]
        if weak:
            return found
    return []


def _rejecting(
    problem: BundleProblem, options: Options
) -> tuple[tuple[BundleFit, tuple[SnoopingStep, ...], list[Remark]], list[Remark]] | Failure:
    """Adjust without gross errors and without wrong control points, and say which these are."""
    level = options.alpha, options.max_fraction
    first = without_gross_errors(problem, *level)
    shape = None
    if isinstance(first, Failure):
        shape = _partly_wrong(problem)
        if shape is None:
            return first
        again = without_gross_errors(without_control(problem, shape.points[~shape.agree]), *level)
        if isinstance(again, Failure):
            return first
        check, said = _control(problem, again[0], shape)
        if not check:
            # A ray of the point may be wrong, not its coordinates.
            rays = (
                Failure("", Code.GROSS_ERRORS)
                if check is None
                else without_gross_errors(problem.continued(again[0]), *level)
            )
            if not isinstance(rays, Failure):
                return rays, []
            return again, [Remark(f"{shape.doubt()}: left out", Code.DOUBTFUL_CONTROL)]
        first = again
    else:
        check, said = _control(problem, first[0])
    seen = set[bytes]()
    while check and not check.undecided and check.wrong.tobytes() not in seen:
        seen.add(check.wrong.tobytes())
        again = without_gross_errors(without_control(problem, check.points[check.wrong]), *level)
        if isinstance(again, Failure):
            break
        first, said = again, check.remarks(problem.network, left_out=True)
        # Without the largest errors smaller ones show.
        check = checked_control(
            _with_rays_of(problem, again[0]), again[0], left_out=check.points[check.wrong]
        )
    return first, said


def _with_rays_of(problem: BundleProblem, fit: BundleFit) -> BundleProblem:
    """Return the problem without the image points of tie points that an adjustment has rejected."""
    network, n = problem.network, 2 * len(problem.network.xy)
    tie: Mask = ~np.asarray((network.observed | network.held).any(axis=1))[network.point_of]
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights.copy()
    if fit.problem.weights is not None:
        weights[:n] = np.where(np.repeat(tie, 2), fit.problem.weights[:n], weights[:n])
    return problem.with_weights(weights)


def _partly_wrong(problem: BundleProblem) -> ControlShape | None:
    """The control points compared with a free network, where some of them do not agree."""
    if problem.network.datum != "control" or len(problem.observations) > MANY:
        return None
    n = 2 * len(problem.network.xy)
    shape = control_shape(problem.network, None if problem.weights is None else problem.weights[:n:2] > 0)
    return None if shape is None or shape.agree.all() or shape.as_a_whole else shape


def _control(
    problem: BundleProblem, fit: BundleFit, shape: ControlShape | None = None
) -> tuple[ControlCheck | None, list[Remark]]:
    """Test the control points where they, or their rays, do not fit; what to say of them.

    With a given `shape` the adjustment is one without the points that do not agree with it.
    """
    network, n = problem.network, 2 * len(problem.network.xy)
    if shape is None and not suspected(problem, fit):
        return None, []
    # Rays of control points are judged with their coordinates, not before.
    begun = _with_rays_of(problem, fit)
    weights = np.ones(len(problem.observations)) if begun.weights is None else begun.weights
    tie: Mask = ~np.asarray((network.observed | network.held).any(axis=1))[network.point_of]
    if (
        fit.problem.weights is None
        and tie.any()
        and fit.sigma0 > _DOUBT
        and len(problem.observations) <= MANY
    ):
        gross = np.isin(np.arange(len(tie)), suspects(problem))
        weights[:n] = np.where(np.repeat(tie & gross, 2), 0.0, weights[:n])
    if shape is None and len(problem.observations) <= MANY:
        shape = control_shape(network, np.asarray(weights[:n:2] > 0), fit.values)
        rejected = np.asarray(fit.rejected[:n].reshape(-1, 2).any(axis=1))
        if many_rejected(network, rejected):
            # Rays were perhaps rejected because of the control: the images alone must say what is wrong.
            used = None if problem.weights is None else np.asarray(problem.weights[:n:2] > 0)
            whole = control_shape(network, used)
            if whole is not None and whole.as_a_whole:
                return None, [Remark(whole.doubt(), Code.DOUBTFUL_CONTROL)]
        deflection = 0.0 if shape is None else shape.bent()
        if deflection:
            return None, [Remark(bent_plane(deflection, network.unit), Code.DOUBTFUL_CONTROL)]
        poor = fit.sigma0 > _DOUBT or bool(_rejected_control(network, rejected))
        if poor and shape is not None and shape.as_a_whole:
            return None, [Remark(shape.doubt(), Code.DOUBTFUL_CONTROL)]
    out = None if shape is None or shape.as_a_whole else shape.points[~shape.agree]
    check = checked_control(problem.with_weights(weights), fit, out)
    return check, [] if check is None else check.remarks(network)


def _given_weights(problem: BundleProblem, fit: BundleFit) -> Array | None:
    """Weights before the rejection that led to an adjustment, perhaps without some control points."""
    lost = (problem.network.observed & ~fit.problem.network.observed).any(axis=1)
    return without_control(problem, np.flatnonzero(lost).astype(np.intp)).weights


def _doubts(
    problem: BundleProblem, fit: BundleFit, of_control: list[Remark], given: Array | None
) -> list[Remark]:
    """Return remarks on what contradicts the rest, in a network that fits badly.

    `given` are the weights before rejection.
    """
    n, weights, every = len(problem.network.xy), fit.problem.weights, fit
    if weights is not None and (weights[2 * n :] == 0).any():
        # Elements are named one by one, also those of which data snooping left out coordinates.
        before = np.ones(len(weights)) if given is None else given
        weights = np.concatenate([weights[: 2 * n], before[2 * n :]])
        again = problem.continued(fit).with_weights(weights).adjusted()
        every = fit if isinstance(again, Failure) else again
    current = problem.with_weights(weights)
    doubts = [*contradicting(current, every)[1], *of_control]
    if not fit.sigma0 > _DOUBT:
        return doubts
    if len(problem.observations) <= MANY:
        # Held values that are wrong make points and control look wrong.
        held = doubtful_parameters(current, fit)
        doubts = [*held, *doubts]
        # Rays of control points are suspected with them.
        tie: Mask = np.asarray(np.isnan(problem.network.sigma).any(axis=1))[problem.network.point_of]
        rows = suspects(problem) if not of_control or tie.any() else np.zeros(0, dtype=np.intp)
        rows = rows[tie[rows]] if of_control else rows
        uneven = uneven_axes(problem, rows) if len(rows) and not held else []
        if uneven:
            # What else contradicts does so by these weights.
            return uneven
        if len(rows) and not held:
            doubts += [*grouped(problem.network, rows), _gross(problem.network, rows)]
    return doubts


def _gross(network: Network, rows: Rows) -> Remark:
    where = in_images(network, rows)
    return Remark(f"unless image points deviate together, gross errors are likely {where}", Code.GROSS_ERRORS)


def _worst_images(network: Network, size: Array) -> list[Remark]:
    """Name the images with the largest misfits (px), where nothing else can be said."""
    each = [size[rows] for rows in network.rays_of_images]
    median = [float(np.median(own)) if (own := v[np.isfinite(v)]).size else 0.0 for v in each]
    order = np.argsort(-np.array(median), kind="stable")[:3]
    names = listed(f"{network.images[i]} ({median[i]:.3g} px)" for i in order if median[i] > 0)
    return [Remark(f"the largest median misfits are in image {names}", Code.NOT_CONVERGED)] if names else []


def _control_of_failed(problem: BundleProblem) -> list[Remark]:
    """What is wrong with the control points of an adjustment that failed."""
    shape = control_shape(problem.network)
    if shape is None or shape.agree.all():
        return []
    if not shape.as_a_whole:
        fit = without_control(problem, shape.points[~shape.agree]).adjusted()
        if not isinstance(fit, Failure):
            check, said = _control(problem, fit, shape)
            if check:
                return said
    return [Remark(shape.doubt(), Code.DOUBTFUL_CONTROL)]


def _focal_length(problem: BundleProblem) -> list[Remark]:
    """Focal lengths that the images do not determine: held as given, they predict all image points."""
    scales = [() if c.registered is None else c.registered.of_role("scale") for c in problem.network.cameras]
    cameras = tuple(
        replace(camera, free=tuple(name for name in camera.free if name not in names))
        for camera, names in zip(problem.network.cameras, scales, strict=True)
    )
    held = [
        f"{old.label} {name} {old.parameters[name]:g} {old.unit_of(name)}"
        for old, new in zip(problem.network.cameras, cameras, strict=True)
        for name in old.free
        if name not in new.free
    ]
    if not held:
        return []
    fit = replace(problem, network=replace(problem.network, cameras=cameras)).adjusted()
    if isinstance(fit, Failure) or fit.redundancy < 1 or not fit.global_test().passed:
        return []
    return [
        Remark(
            f"with {listed(held)} held, all image points are explained (sigma0 {fit.sigma0:.3g}): images do "
            "not determine it; take images from nearer, or tilted against each other, or hold it",
            Code.NOT_IDENTIFIED,
        )
    ]


def _explained(failure: Failure, problem: BundleProblem, found: list[Remark]) -> Failure:
    """Add the cause to the reason of a failure, or say that there is no depth."""
    network = problem.network
    if not found:
        without_depth = one_station(problem, None)
        if without_depth is not None:
            return without_depth
    if failure.code is Code.NO_DATUM and not found:
        return failure
    if failure.code in RETRIED and not found:
        found = motion_of_narrow_lens(network)
    if not found:
        start = problem.start
        found = seen_frontally(network, start.rotation, start.xyz, finite(start.x0))
    if failure.code in RETRIED and not found:
        found = _focal_length(problem)
    if not found and network.datum == "control":
        found = _control_of_failed(problem)
    if not found and failure.code is not Code.TOO_FEW_POINTS and len(problem.observations) <= MANY:
        rows = suspects(problem)
        if len(rows):
            share = 100 * len(rows) / max(len(network.xy), 1)
            said = f"{len(rows)} of {len(network.xy)} image points ({share:.0f} %) contradict the others"
            first = Remark(f"{said}: reject them (`--reject`)", Code.GROSS_ERRORS)
            found = uneven_axes(problem, rows) or [first, *grouped(network, rows), _gross(network, rows)]
        elif failure.code in (Code.NOT_CONVERGED, Code.NOT_FINITE):
            found = _worst_images(network, _misfits_px(problem))
    if not found:
        return failure
    reason = "; ".join([failure.reason, *(remark.text for remark in found)])
    code = failure.code if found[0].code is Code.GROSS_ERRORS else found[0].code
    return replace(failure, reason=reason, code=code)
