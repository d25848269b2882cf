"""Choice of a camera model: which of several describes a camera well enough, without parameters too many.

Every candidate is adjusted with the same observations. The description length (Schwarz 1978, *Estimating the
dimension of a model*, Annals of Statistics 6; Rissanen 1978, Modeling by shortest data description,
Automatica 14) weighs residuals against the number of parameters. Those that come close are compared by
cross-validation over images: an image that did not contribute is predicted. The difference of the image
coordinates from those of the chosen model, after the best rotation, says what the choice matters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any

import numpy as np
import scipy.special

from ...calibration.camera import CameraMapping, projection_field
from ...calibration.compare import calibration_difference
from ...core.data import Array, Mask
from ...core.display import Display
from ...core.errors import UsageError
from ...core.executors import Executor, Here
from ...core.failure import Code, Failure
from ...optics import PixelGrid, PlaneMapping
from ...optics.cameras import SplineGrid, camera_model, convert
from ..diagnostics import Result, camera_mapping
from ..diagnostics.checks import unmodelled_pattern
from ..network import Additional, Camera, Network
from ..network.network import finite
from ..solver import BundleFit, BundleProblem
from .adjustment import Options, adjust_network

__all__ = ["Candidate", "Compared", "ModelChoice", "camera_candidates", "choose_model"]

# Description lengths within this of the least are not worse (Kass & Raftery 1995, Bayes factors, JASA 90,
# table on p. 777: "not worth more than a bare mention"); beyond the second no cross-validation is needed.
_EQUAL, _HOPELESS = 2.0, 30.0
# Candidates that are cross-validated at most, and level of the test of their differences.
_VALIDATED, _LEVEL = 6, 0.01
# Places along the longer side at which the projection is looked at.
_ACROSS = 9
# Iterations of a candidate, which begins close to its solution, and decrease that makes a better start.
_STEPS, _BETTER = 60, 0.02
# Least number of images for which images can be left out, and of points by which one is predicted.
_LEAST_IMAGES, _LEAST_POINTS = 4, 5
# Standard deviation of a projection that is determined, and residuals that practically do not differ, pixels.
_DETERMINED_PX, _PRACTICAL_PX = 2.0, 0.02
# Ratio of standard deviations of two projections from which the larger is not determined.
_TIMES = 10.0
# Size of the reciprocal of a focal length, in standard deviations, above which there is perspective.
_SIGNIFICANT = 2.6


@dataclass(frozen=True)
class Candidate:
    """A camera model with the parameters that it is allowed.

    Parameters
    ----------
    model : str
        Name in the registry.
    free : tuple of str
        Parameters to estimate.
    options : mapping
        Options of the model.
    additional : str, optional
        Model of additional parameters, all of which are estimated.

    Examples
    --------
    >>> Candidate("opencv", ("fx", "fy", "cx", "cy", "k1")).label
    'opencv: k1'
    """

    model: str
    free: tuple[str, ...]
    options: Mapping[str, str | float] = field(default_factory=dict)
    additional: str | None = None

    @property
    def label(self) -> str:
        """Model, and parameters other than those of the interior orientation."""
        model = camera_model(self.model)
        if model.priors(self.free):
            return f"{self.model}: {len(self.free)} parameters"
        plain = model.of_role("scale", "centre")
        more = [name for name in self.free if name not in plain]
        more += [] if self.additional is None else [self.additional]
        return f"{self.model}: {' '.join(more) or 'no distortion'}"

    def within(self, other: Candidate) -> bool:
        """Whether it is the other candidate without some of its parameters."""
        if (self.model, self.options) != (other.model, other.options):
            return False
        if self.additional not in (None, other.additional):
            return False
        own, all_ = ({*c.free, *([] if c.additional is None else [c.additional])} for c in (self, other))
        return own < all_


# Series contain the terms of the lens of low degree; of the affinity a Fourier series has none.
_SERIES = (
    Candidate("brown", ("c", "x0", "y0"), additional="chebyshev5"),
    Candidate("brown", ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2"), additional="fourier1"),
)


@dataclass(frozen=True, eq=False)
class Compared:
    """A candidate, compared with the one that was chosen.

    Parameters
    ----------
    candidate : Candidate
        Model and free parameters.
    reason : str
        Why it was not chosen, or why it was.
    sigma0 : float
        Standard deviation of unit weight; NaN where the adjustment failed.
    cost : float
        vᵀPv.
    length : float
        Description length −2 ln L + u ln N with the variance estimated, less that of the best candidate.
    predicted : float
        Root mean square of predicted image coordinates, in their standard deviations, by cross-validation
        over images; NaN where this was not needed.
    p : float
        Probability of the test against the chosen model where one is a part of the other; NaN otherwise.
    rms_px, corner_px : float
        Difference from the chosen model over the image, and the largest one at a corner.
    corner_sigma_px : float
        Standard deviation there, of the model of the two with more parameters.
    share : float
        Part of the image where the difference is significant at 1 %.

    Examples
    --------
    >>> Compared(Candidate("opencv", ("fx", "fy")), "chosen", 1.0, 10.0, 0.0).candidate.label
    'opencv: no distortion'
    """

    candidate: Candidate
    reason: str
    sigma0: float
    cost: float
    length: float
    predicted: float = np.nan
    p: float = np.nan
    rms_px: float = np.nan
    corner_px: float = np.nan
    corner_sigma_px: float = np.nan
    share: float = np.nan


@dataclass(frozen=True, eq=False, repr=False)
class ModelChoice(Display):
    """The chosen camera model and the others, also those that were not adjusted and why; truthy.

    Parameters
    ----------
    camera : Camera
        The chosen camera, with its estimates as approximate values.
    compared : tuple of Compared
        All candidates, by description length; those that failed last.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> names = ("c", "x0", "y0")
    >>> found = choose_model(
    ...     example_network(), [Candidate("brown", (*names, *more)) for more in ((), ("K1",), ("K1", "K2"))]
    ... )
    >>> found.chosen.candidate.label
    'brown: K1'
    """

    camera: Camera
    compared: tuple[Compared, ...]

    def __bool__(self) -> bool:
        return True

    @property
    def chosen(self) -> Compared:
        """The chosen candidate."""
        return next(each for each in self.compared if each.reason.startswith("chosen"))

    @property
    def alternatives(self) -> tuple[Compared, ...]:
        """The others."""
        return tuple(each for each in self.compared if each is not self.chosen)

    def entries(self) -> list[dict[str, Any]]:
        """Return the comparison as JSON values for the calibration document; unknown numbers are null."""

        def number(value: float) -> float | None:
            return value if np.isfinite(value) else None

        return [
            {
                "model": each.candidate.model,
                "free": list(each.candidate.free),
                "additional": each.candidate.additional,
                "reason": each.reason,
                "sigma0": number(each.sigma0),
                "length": number(each.length),
                "predicted": number(each.predicted),
                "p": number(each.p),
                "rms_px": number(each.rms_px),
                "corner_px": number(each.corner_px),
                "corner_sigma_px": number(each.corner_sigma_px),
                "significant_share": number(each.share),
            }
            for each in self.compared
        ]

    def _facts(self) -> list[tuple[str, str]]:
        return [(self.chosen.candidate.label, ""), (f"of {len(self.compared)} candidates", "")]

    def _columns(self) -> dict[str, list[object]]:
        return {
            "model": [each.candidate.label for each in self.compared],
            "sigma0": [f"{each.sigma0:.4f}" for each in self.compared],
            "length": [f"{each.length:.1f}" for each in self.compared],
            "predicted": [f"{each.predicted:.4f}" for each in self.compared],
            "corners / px": [f"{each.corner_px:.2g}" for each in self.compared],
            "reason": [each.reason for each in self.compared],
        }


def camera_candidates(*, pitch_known: bool) -> tuple[Candidate, ...]:
    """Return the usual candidates: from no distortion to twelve coefficients, and projections of wide lenses.

    Parameters
    ----------
    pitch_known : bool
        Whether the size of a pixel is known: Brown's model then takes the place of OpenCV's.

    Examples
    --------
    >>> [candidate.label for candidate in camera_candidates(pitch_known=True)][:3]
    ['brown: no distortion', 'brown: K1', 'brown: K1 B1']
    """
    # Brown's B1 stands for what OpenCV's cameras have two focal lengths for.
    if pitch_known:
        steps = [
            ("brown", more.split())
            for more in (
                "", "K1", "K1 B1", "K1 K2", "K1 K2 B1", "K1 K2 P1 P2", "K1 K2 P1 P2 B1", "K1 K2 K3 P1 P2",
                "K1 K2 K3 P1 P2 B1 B2",
            )
        ]  # fmt: skip
        steps.append(("brown_higher", ["K1", "K2", "K3", "P1", "P2", "B1", "B2", "K4", "K5"]))
    else:
        radial = ("", "k1", "k1 k2", "k1 k2 p1 p2", "k1 k2 p1 p2 k3", "k1 k2 p1 p2 k3 k4 k5 k6")
        steps = [("opencv", more.split()) for more in radial]
        steps.append(("opencv_full", f"{radial[-1]} s1 s2 s3 s4".split()))
    steps += [
        (name, more.split())
        for name, several in (
            ("fisheye", ("", "k1 k2", "k1 k2 k3 k4", "k1 k2 k3 k4 p1 p2")),
            ("equisolid", ("k1 k2",)),
            ("orthographic", ("k1 k2",)),
            ("stereographic", ("k1 k2",)),
            ("omni", ("xi", "xi k1 k2 p1 p2")),
            ("double_sphere", ("xi alpha",)),
            ("division", ("lambda", "lambda p1 p2")),
        )
        for more in several
    ]
    return tuple(
        Candidate(name, (*camera_model(name).of_role("scale", "centre"), *more)) for name, more in steps
    )


def choose_model(
    network: Network,
    candidates: Sequence[Candidate] | None = None,
    options: Options | None = None,
    *,
    folds: int = 5,
    seed: int = 0,
    executor: Executor | None = None,
) -> ModelChoice | Failure:
    """Choose the model of the only camera of a network.

    Parameters
    ----------
    network : Network
        Network with one camera, of any registered model.
    candidates : sequence of Candidate, optional
        By default :func:`camera_candidates`. Where the best of these leaves a residual pattern that the
        images have in common, a spline surface and, with a pixel size, series of additional parameters are
        compared too; where perspective is not significant, the telecentric camera.
    options : Options, optional
        Options of the adjustments. Gross errors are rejected with the candidate of least residuals, so that
        no good observation is rejected because a model is too simple; all are then compared without them.
    folds : int
        Number of parts of the images, each left out once.
    seed : int
        Seed of the random division.
    executor : Executor, optional
        What adjusts the network without each part of the images; by default this process.

    Returns
    -------
    ModelChoice or Failure
        A failure when no candidate can be adjusted.

    Raises
    ------
    UsageError
        For a network with several cameras, additional or observed parameters, or without candidates.

    Notes
    -----
    Chosen is the candidate with the fewest parameters of those whose description length is within 2 of the
    least, and which predict images not significantly worse than another. Residuals alone never decide. A
    candidate whose projection has a standard deviation of more than 2 px in a corner of the image is left out
    where another one, with residuals larger by less than 0.02 px, is determined ten times as well.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> names = ("c", "x0", "y0")
    >>> found = choose_model(
    ...     example_network(), [Candidate("brown", (*names, *more)) for more in ((), ("K1",), ("K1", "K2"))]
    ... )
    >>> [(each.candidate.label, each.p < 0.01) for each in found.alternatives]
    [('brown: K1 K2', False), ('brown: no distortion', True)]
    """
    if len(network.cameras) != 1 or network.cameras[0].additional is not None or network.cameras[0].sigma:
        raise UsageError(
            "needs a network of one camera without additional or observed parameters",
            where="choice of a model",
        )
    camera = network.cameras[0]
    own = camera.registered
    usual, pitch_known = candidates is None, own is not None and own.needs_pitch
    candidates = camera_candidates(pitch_known=pitch_known) if candidates is None else list(candidates)
    if not candidates:
        raise UsageError("there are none", where="candidates of the choice of a model")
    options = options or Options()
    first = _first(network, candidates, options)
    fits = [first] * len(candidates) if isinstance(first, Failure) else _adjusted(first, candidates)
    if options.outliers == "reject" and (best := _least(fits)) is not None:
        result = adjust_network(best.problem.network, options)
        if isinstance(result, Failure):
            return result
        weights = result.fit.problem.weights
        first = best.problem.continued(best).with_weights(weights)
        fits = _adjusted(first, candidates)
    more = _further(network, _least(fits), options, pitch_known=pitch_known) if usual else []
    candidates = [*candidates, *(candidate for candidate, _ in more)]
    fits = [*fits, *(fit for _, fit in more)]
    if _least(fits) is None:
        reason = first.reason if isinstance(first, Failure) else "no camera model can be adjusted"
        return Failure(reason, Code.NOT_CONVERGED)
    return _chosen(network, candidates, fits, folds, seed, executor or Here())


def _least(fits: Sequence[BundleFit | Failure]) -> BundleFit | None:
    """The adjustment with the least residuals."""
    good = [fit for fit in fits if isinstance(fit, BundleFit)]
    return min(good, key=lambda fit: fit.cost, default=None)


def _first(network: Network, candidates: Sequence[Candidate], options: Options) -> BundleProblem | Failure:
    """The problem from the first model that can be adjusted; that of the network, then the usual ones."""
    found: BundleFit | Failure = Failure("no candidate", Code.NOT_CONVERGED)
    camera, plain = network.cameras[0], replace(options, outliers="keep")
    f = float(camera.bare_mapping(distorted=False).derivatives([[0.0, 0.0]]).d_xy[0, 0, 0])
    names = dict.fromkeys(candidate.model for candidate in candidates)
    for model in (None, *names):
        own = camera if model is None else _started(camera, Candidate(model, camera_model(model).usual), f)
        result = adjust_network(replace(network, cameras=(own,)), plain)
        if not isinstance(result, Failure):
            return result.fit.problem.continued(result.fit)
        found = result
    assert isinstance(found, Failure)
    return found


def _started(camera: Camera, candidate: Candidate, f: float) -> Camera:
    """A camera of the candidate's model for a focal length of f pixels."""
    model = camera_model(candidate.model)
    grid = PixelGrid(camera.width, camera.height, camera.pitch_mm)
    values = model.start_values(f, grid)
    return replace(
        camera, model=candidate.model, values=values, free=candidate.free, options=candidate.options,
        covariance=None,
    )  # fmt: skip


def _adjusted(first: BundleProblem, candidates: Sequence[Candidate]) -> list[BundleFit | Failure]:
    """Adjust all candidates, each from the best before it, converted to its model."""
    found: list[BundleFit | Failure] = []
    start, least, begun = replace(first, max_iterations=_STEPS), np.inf, 0
    for k, candidate in enumerate(candidates):
        fit = _from(start, candidate)
        if isinstance(fit, BundleFit) and fit.cost < (1 - _BETTER) * least:
            start, least, begun = fit.problem.continued(fit), fit.cost, k
        found.append(fit)
    # The earlier ones once more from the best of all: a poor start may end in a poor minimum.
    for k in range(begun):
        again, before = _from(start, candidates[k]), found[k]
        if isinstance(again, BundleFit) and (isinstance(before, Failure) or again.cost < before.cost):
            found[k] = again
    return found


def _from(problem: BundleProblem, candidate: Candidate) -> BundleFit | Failure:
    """Adjust a candidate from the estimates of another model."""
    network = problem.network
    old = network.cameras[0]
    given = replace(old, values=problem.start.cameras[0, : len(old.values)])
    try:
        converted = convert(
            given.plane_mapping(), given.grid, candidate.model, candidate.options, free=candidate.free
        )
        values = converted.mapping.values
    except UsageError:
        # The other model has no directions in most of the image.
        slope = given.bare_mapping().derivatives([[0.0, 0.0]]).d_xy[0, 0, 0]
        values = _started(given, candidate, float(slope)).values
    model = camera_model(candidate.model)
    full = np.zeros(len(model.names))
    full[: len(values)] = values
    sigma = model.priors(candidate.free)
    extra = None
    if candidate.additional is not None:
        longer = max(given.width * given.pitch_mm[0], given.height * given.pitch_mm[1])
        extra = Additional(longer / 2, model=candidate.additional)
    # Corrections that are observed, are observed as zero.
    observed = np.where([name in sigma for name in model.names], 0.0, full)
    camera = replace(
        given, model=candidate.model, values=observed, free=candidate.free, options=candidate.options,
        sigma=sigma, additional=extra,
    )  # fmt: skip
    series = np.zeros((1, 0 if extra is None else len(extra.names)))
    start = replace(problem.start, cameras=full[None], extra=series)
    trial = replace(problem, network=replace(network, cameras=(camera,)), start=start, rounds=0)
    if len(trial.observations) != len(problem.observations):
        trial = replace(trial, weights=_with_priors(problem, trial))
    fit = trial.adjusted()
    if isinstance(fit, BundleFit):
        return _checked(fit)
    return fit


def _with_priors(problem: BundleProblem, trial: BundleProblem) -> Array | None:
    """Weights of a problem with observed parameters, from those of one without."""
    if problem.weights is None:
        return None
    n = 2 * len(problem.network.xy)
    weights = np.ones(len(trial.observations))
    weights[:n] = problem.weights[:n]
    return weights


def _checked(fit: BundleFit) -> BundleFit | Failure:
    """The adjustment, unless its camera folds within the observations or is not determined."""
    xy = fit.problem.network.xy[fit.usable.observations]
    if not np.isfinite(_whole(fit).inverse(xy)).all():
        return Failure("the image folds within the observations", Code.NOT_IDENTIFIED)
    return fit


def _whole(fit: BundleFit) -> PlaneMapping:
    """The adjusted camera with its additional parameters."""
    camera = fit.problem.network.cameras[0]
    camera = replace(camera, values=fit.values.cameras[0, : len(camera.values)])
    extra = camera.additional
    if extra is None:
        return camera.plane_mapping()
    series = extra.mapping(fit.values.extra[0, : len(extra.names)])
    return camera_model(camera.model).mapping(camera.values, camera.grid, camera.options, series)


def _further(
    network: Network, best: BundleFit | None, options: Options, *, pitch_known: bool
) -> list[tuple[Candidate, BundleFit | Failure]]:
    """Candidates beyond the usual ones, adjusted where these give a reason to, or why they were left out."""
    found: list[tuple[Candidate, BundleFit | Failure]] = []
    if best is not None:
        pattern = unmodelled_pattern(_result(best), 0)
        why = "not needed: the usual models leave no residual pattern that the images have in common"
        surface = _surface(best)
        flexible = [*([] if surface is None else [surface]), *(_SERIES if pitch_known else ())]
        start = best.problem.continued(best)
        unneeded = Failure(why, Code.NOT_CONSIDERED)
        found += [(each, unneeded if pattern is None else _from(start, each)) for each in flexible]
        if pattern is not None and not pitch_known:
            why = "needs the size of a pixel"
            found += [(candidate, Failure(why, Code.NOT_CONSIDERED)) for candidate in _SERIES]
    parallel = camera_model("telecentric")
    size = _perspective(best)
    for candidate in (Candidate("telecentric", names) for names in (("m",), parallel.usual)):
        if size > _SIGNIFICANT:
            why = f"perspective is significant: 1/focal length is {size:.3g} times its sigma"
            found.append((candidate, Failure(why, Code.NOT_CONSIDERED)))
        elif not pitch_known:
            found.append((candidate, Failure("needs the size of a pixel", Code.NOT_CONSIDERED)))
        else:
            weights = None if best is None else best.problem.weights
            found.append((candidate, _with_parallel_rays(network, candidate, options, weights)))
    return found


def _perspective(fit: BundleFit | None) -> float:
    """The reciprocal of a focal length in its standard deviations; 0 where there is none."""
    if fit is None:
        return 0.0
    camera, result = fit.problem.network.cameras[0], _result(fit)
    names, _, values = result.camera_columns(0)
    sigma = np.sqrt(np.diag(result.camera_covariance(0)))
    scales = () if camera.registered is None else camera.registered.of_role("scale")
    ratios = [abs(v) / s for name, v, s in zip(names, values, sigma, strict=True) if name in scales]
    return float(min(ratios, default=np.inf))


def _surface(fit: BundleFit) -> Candidate | None:
    """A spline surface over the angle of view; None where the camera has no image at the edges."""
    network = fit.problem.network
    width, height = network.cameras[0].width, network.cameras[0].height
    x, y = (width - 1) / 2, (height - 1) / 2
    uv = _whole(fit).inverse([[0.0, y], [width - 1.0, y], [x, 0.0], [x, height - 1.0]])
    if not np.isfinite(uv).all() or fit.problem.network.cameras[0].parallel:
        return None
    half = np.arctan(np.hypot(*uv.T))
    fov = int(np.ceil(np.degrees(2 * half[:2].max()))) + 1
    order, across = 3, 8
    per_u = SplineGrid(order, across, across, fov).per_u
    down = int(np.ceil(4 * np.tan(half[2:].max() / 2) * per_u)) + order
    name = SplineGrid(order, across, down, fov).name
    return Candidate(name, camera_model(name).usual)


def _with_parallel_rays(
    network: Network, candidate: Candidate, options: Options, weights: Array | None
) -> BundleFit | Failure:
    """Adjust a telecentric camera, from its magnification by affine mappings of known points."""
    scales = []
    for image in range(len(network.images)):
        own = (network.image_of == image) & finite(network.xyz)[network.point_of]
        if own.sum() >= _LEAST_POINTS:
            points = network.xyz[network.point_of[own]]
            mapping = np.linalg.pinv(points - points.mean(axis=0)) @ (
                network.xy[own] - network.xy[own].mean(axis=0)
            )
            scales.append(float(np.linalg.svd(mapping, compute_uv=False)[0]))
    if not scales:
        return Failure("no image shows enough points with known coordinates", Code.TOO_FEW_POINTS)
    camera = _started(network.cameras[0], candidate, float(np.median(scales)))
    trial = replace(network, cameras=(camera,))
    result = adjust_network(trial, replace(options, outliers="keep"))
    if isinstance(result, Failure):
        return result
    if weights is None:
        return result.fit
    n, problem = 2 * len(network.xy), result.fit.problem.continued(result.fit)
    kept = np.ones(len(problem.observations))
    kept[:n] = weights[:n]
    return problem.with_weights(kept).adjusted()


def _chosen(
    network: Network,
    candidates: Sequence[Candidate],
    fits: Sequence[BundleFit | Failure],
    folds: int,
    seed: int,
    executor: Executor,
) -> ModelChoice:
    """Compare the adjusted candidates."""
    good = [k for k, fit in enumerate(fits) if isinstance(fit, BundleFit)]
    length, number = np.full(len(fits), np.inf), np.zeros(len(fits))
    for k in good:
        fit = fits[k]
        assert isinstance(fit, BundleFit)
        count = 2 * int(fit.usable.observations.sum())
        number[k] = _determined(fit)
        length[k] = count * np.log(fit.cost / count) + number[k] * np.log(count)
    order = sorted(range(len(fits)), key=lambda k: (length[k], k))
    vague = _undetermined({k: fit for k in order if isinstance(fit := fits[k], BundleFit)})
    length -= min(length[k] for k in good if k not in vague)
    close = [k for k in order if k not in vague and length[k] < _HOPELESS][:_VALIDATED]
    squares = _predicted([fits[k] for k in close], folds, seed, executor) if len(close) > 1 else None
    worse = _worse(squares)
    equal = [k for row, k in enumerate(close) if length[k] <= _EQUAL and row not in worse] or close[:1]
    best = min(equal, key=lambda k: (number[k], length[k], k))
    fit = fits[best]
    assert isinstance(fit, BundleFit)
    found = []
    for k in order:
        other = fits[k]
        if isinstance(other, Failure):
            why = "" if other.code is Code.NOT_CONSIDERED else "not adjusted: "
            found.append(Compared(candidates[k], f"{why}{other.reason}", np.nan, np.nan, np.nan))
            continue
        row = close.index(k) if k in close else None
        predicted = np.nan if squares is None or row is None else float(np.sqrt(_mean(squares[row])))
        one = Compared(
            candidates[k], "", other.sigma0, other.cost, float(length[k]), predicted,
            _test(candidates[k], other, candidates[best], fit), **_difference(fit, other),
        )  # fmt: skip
        reason = _reason(one, k == best, row in worse, candidates[best], len(equal))
        if k in vague:
            if np.isfinite(vague[k]):
                reason = (
                    f"its projection is not determined ({vague[k]:.2g} px in a corner), that of others is"
                )
            else:
                reason = "its projection is folded before a corner, that of others is not"
        found.append(replace(one, reason=reason))
    camera = fit.problem.network.cameras[0]
    observed = np.array([name in camera.sigma for name in camera.names])
    camera = replace(camera, values=np.where(observed, camera.values, fit.values.cameras[0, : len(observed)]))
    return ModelChoice(replace(camera, id=network.cameras[0].id), tuple(found))


def _undetermined(fits: Mapping[int, BundleFit]) -> dict[int, float]:
    """Candidates that describe the images best, but are not determined beyond them, where others are.

    These others are determined ten times as well, and their residuals are in practice the same; or twice as
    large, where an image folds before a corner of the frame. Returned are standard deviations in the worst
    corner of candidates, which come by description length.
    """
    every = list(fits)
    rms = {k: _rms(fit) for k, fit in fits.items()}
    worst = {every[0]: projection_field(_mapping(fits[every[0]]), _ACROSS).worst_px}
    if worst[every[0]] <= _DETERMINED_PX:
        return {}
    near = [k for k in every if rms[k] < 2 * min(rms.values())]
    worst |= {k: projection_field(_mapping(fits[k]), _ACROSS).worst_px for k in near if k not in worst}
    found = dict(takewhile(lambda each: not np.isfinite(each[1]), ((k, worst[k]) for k in near)))
    rest = near[len(found) :]
    if not rest:
        return {}
    alike = [k for k in rest if rms[k] ** 2 - rms[rest[0]] ** 2 < _PRACTICAL_PX**2]
    limit = max(_DETERMINED_PX, _TIMES * min(worst[k] for k in alike))
    return found | dict(takewhile(lambda each: each[1] > limit, ((k, worst[k]) for k in alike)))


def _rms(fit: BundleFit) -> float:
    """Root mean square of the residuals of the image points used, pixels."""
    v = fit.residuals[: 2 * len(fit.problem.network.xy)].reshape(-1, 2)[fit.usable.observations]
    return float(np.sqrt(np.nanmean(v**2)))


def _determined(fit: BundleFit) -> float:
    """Number of parameters of the camera that the images determine, without what is only regularised."""
    camera = fit.problem.network.cameras[0]
    extra = 0 if camera.additional is None else len(camera.additional.names)
    prior = _result(fit).priors(0)
    regularised = 0.0 if prior is None else len(prior.parameters) - prior.determined
    return len(camera.free) + extra - regularised


def _reason(one: Compared, best: bool, worse: bool, chosen: Candidate, equal: int) -> str:
    """Say why a candidate was chosen, or not."""
    own = one.candidate
    if best:
        text = "chosen: shortest description" if one.length == 0 else "chosen: fewest parameters"
        return text + (f" of {equal} that are as good" if equal > 1 else "")
    if one.length <= _EQUAL:
        if worse:
            return "predicts images significantly worse"
        return "as good, with more parameters" if len(own.free) > len(chosen.free) else "as good"
    if own.within(chosen):
        return f"too simple: the parameters that it lacks are significant, p = {one.p:.2g}"
    if chosen.within(own):
        size = "not " if one.p > _LEVEL else "hardly "
        return f"too many parameters: the others are {size}significant, p = {one.p:.2g}"
    return f"longer description by {one.length:.1f}" + (", and predicts images worse" if worse else "")


def _test(own: Candidate, fit: BundleFit, chosen: Candidate, best: BundleFit) -> float:
    """F test of the parameters in which one of two nested models exceeds the other."""
    if own.within(chosen):
        small, large = fit, best
    elif chosen.within(own):
        small, large = best, fit
    else:
        return np.nan
    more = small.redundancy - large.redundancy
    if more <= 0 or large.redundancy <= 0:
        return np.nan
    ratio = max(small.cost - large.cost, 0.0) / more / (large.cost / large.redundancy)
    return float(scipy.special.fdtrc(more, large.redundancy, ratio))


def _difference(best: BundleFit, other: BundleFit) -> dict[str, float]:
    """Difference of two cameras over the image, and what it means."""
    if best is other:
        return {"rms_px": 0.0, "corner_px": 0.0, "share": 0.0}
    one, two = (_mapping(fit) for fit in (best, other))
    try:
        field_ = calibration_difference(one, two)
    except UsageError:
        return {}
    size = np.hypot(field_.difference[..., 0], field_.difference[..., 1])
    sigma = projection_field(one if len(one.names) >= len(two.names) else two).sigma
    corners = [(0, 0), (0, -1), (-1, 0), (-1, -1)]
    known = [place for place in corners if np.isfinite(size[place])]
    worst = max(known, key=lambda place: float(size[place]), default=None)
    seen = np.isfinite(size) & np.isfinite(sigma)
    limit = np.sqrt(scipy.special.chdtri(2, 0.01))
    return {
        "rms_px": float(np.sqrt(np.nanmean(size**2))),
        "corner_px": np.nan if worst is None else float(size[worst]),
        "corner_sigma_px": np.nan if worst is None else float(sigma[worst]),
        "share": float((size[seen] > limit * sigma[seen]).mean()) if seen.any() else np.nan,
    }


def _mapping(fit: BundleFit) -> CameraMapping:
    """The camera with its covariance."""
    return camera_mapping(_result(fit), 0)


def _result(fit: BundleFit) -> Result:
    network = fit.problem.network
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())


def _predicted(
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
        whole = _whole(without)
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


def _mean(squares: Array) -> float:
    """Mean square over all images."""
    total = float(squares[:, 1].sum())
    return float(squares[:, 0].sum()) / total if total else np.nan


def _worse(squares: Array | None) -> set[int]:
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
    limit = scipy.special.stdtrit(off.shape[1] - 1, 1 - _LEVEL)
    return {int(row) for row in np.flatnonzero(off.sum(axis=1) > limit * spread)} - {best}
