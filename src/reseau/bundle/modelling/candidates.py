"""Candidates of the choice of a camera model, and their adjustment with the same observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...optics import PixelGrid
from ...optics.cameras import SplineGrid, camera_model, convert
from ..diagnostics.checks import unmodelled_pattern
from ..network import Additional, Camera, Network
from ..network.network import finite
from ..solver import BundleFit, BundleProblem
from .adjustment import Options, adjust_network
from .determined import result_of, whole_camera

__all__ = [
    "Candidate",
    "adjusted_candidates",
    "best_fit",
    "camera_candidates",
    "first_problem",
    "further_candidates",
]

# Iterations of a candidate, which begins close to its solution, and decrease that makes a better start.
_STEPS, _BETTER = 60, 0.02
# Least number of points by which a telecentric camera is begun.
_LEAST_POINTS = 5
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


def best_fit(fits: Sequence[BundleFit | Failure]) -> BundleFit | None:
    """The adjustment with the least residuals."""
    good = [fit for fit in fits if isinstance(fit, BundleFit)]
    return min(good, key=lambda fit: fit.cost, default=None)


def first_problem(
    network: Network, candidates: Sequence[Candidate], options: Options
) -> BundleProblem | Failure:
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


def adjusted_candidates(first: BundleProblem, candidates: Sequence[Candidate]) -> list[BundleFit | Failure]:
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
    if not np.isfinite(whole_camera(fit).inverse(xy)).all():
        return Failure("the image folds within the observations", Code.NOT_IDENTIFIED)
    return fit


def further_candidates(
    network: Network, best: BundleFit | None, options: Options, *, pitch_known: bool
) -> list[tuple[Candidate, BundleFit | Failure]]:
    """Candidates beyond the usual ones, adjusted where these give a reason to, or why they were left out."""
    found: list[tuple[Candidate, BundleFit | Failure]] = []
    if best is not None:
        pattern = unmodelled_pattern(result_of(best), 0)
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
    camera, result = fit.problem.network.cameras[0], result_of(fit)
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
    uv = whole_camera(fit).inverse([[0.0, y], [width - 1.0, y], [x, 0.0], [x, height - 1.0]])
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
