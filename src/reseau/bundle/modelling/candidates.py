"""Candidates of the choice of a camera model, and their adjustment with the same observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...optics import PixelGrid
from ...optics.cameras.convert import roughly
from ...optics.cameras.registry import additional_model, camera_model
from ...optics.cameras.splined import SplineGrid
from ..network.camera import Additional, Camera
from ..network.network import Network, finite
from ..solver.problem import BundleFit
from .adjustment import Options, adjust_network, problem_of
from .determined import whole_camera
from .left_out import with_camera
from .startup import adjusted_in_steps

# Iterations of a candidate, which begins close to its solution, and the correction (relative to standard
# deviations) that remains: predictions contain it.
_STEPS, _ENOUGH = 40, 1e-3
# Coefficients of the distortion with which a family begins: as many as OpenCV's default has.
_MODERATE = 5
# Least number of points by which a telecentric camera is begun.
_LEAST_POINTS = 5
# Models whose parameters are the first ones of another.
_WIDER = {"opencv": "opencv_full", "brown": "brown_higher"}


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

    def __hash__(self) -> int:
        return hash((self.model, self.free, self.additional))

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

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """The candidate that describes a camera."""
        extra = None if camera.additional is None else camera.additional.model
        return cls(camera.model, camera.free, camera.options, extra)

    def within(self, other: Candidate) -> bool:
        """Whether it is the other candidate without some of its parameters."""
        if (wider_model(self.model), self.options) != (wider_model(other.model), other.options):
            return False
        if self.additional not in (None, other.additional):
            return False
        return self.parts < other.parts

    def describes(self, camera: Camera) -> bool:
        """Whether a camera has this model, and these parameters are estimated of it."""
        extra = None if camera.additional is None else camera.additional.model
        model = camera_model(self.model)
        return (self.model, set(self.free), self.additional) == (camera.model, set(camera.free), extra) and (
            model.checked_options(self.options) == camera.options
        )

    def alike(self, other: Candidate) -> bool:
        """Whether the parameters of both are parts of the same ones."""
        one, two = ((wider_model(c.model), c.options, c.additional) for c in (self, other))
        return one == two

    @property
    def estimated(self) -> tuple[str, ...]:
        """All free parameters, with the additional ones."""
        more = () if self.additional is None else additional_model(self.additional).names
        return (*self.free, *more)

    @property
    def parts(self) -> frozenset[str]:
        """Free parameters, and the name of the additional ones."""
        return frozenset(self.free if self.additional is None else (*self.free, self.additional))

    @property
    def coefficients(self) -> int:
        """Number of free parameters beyond those of the interior orientation."""
        return len(self.free) - len(camera_model(self.model).of_role("scale", "centre"))


# Series contain the terms of the lens of low degree; of the affinity a Fourier series has none.
SERIES = (
    Candidate("brown", ("c", "x0", "y0"), additional="chebyshev5"),
    Candidate("brown", ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2"), additional="fourier1"),
)


PARALLEL = tuple(Candidate("telecentric", names) for names in (("m",), camera_model("telecentric").usual))


def wider_model(name: str) -> str:
    """The model with the most parameters of which a model is the first part.

    Examples
    --------
    >>> wider_model("opencv"), wider_model("fisheye")
    ('opencv_full', 'fisheye')
    """
    return _WIDER.get(name, name)


def camera_candidates(*, pitch_known: bool) -> tuple[Candidate, ...]:
    """Return the usual candidates: from no distortion to a tilted sensor, and projections of wide lenses.

    Parameters
    ----------
    pitch_known : bool
        Whether the size of a pixel is known: Brown's model then takes the place of OpenCV's, where it can.

    Examples
    --------
    >>> [candidate.label for candidate in camera_candidates(pitch_known=True)][:3]
    ['brown: no distortion', 'brown: K1', 'brown: K1 B1']
    """
    plain, rational, tilt = "k1 k2 p1 p2 k3", "k1 k2 p1 p2 k3 k4 k5 k6", "tau_x tau_y"
    # Brown's B1 stands for what OpenCV's cameras have two focal lengths for.
    brown = ("", "K1", "K1 B1", "K1 K2", "K1 K2 B1", "K1 K2 P1 P2", "K1 K2 P1 P2 B1", "K1 K2 K3 P1 P2",
             "K1 K2 K3 P1 P2 B1", "K1 K2 K3 P1 P2 B1 B2")  # fmt: skip
    opencv = ("", "k1", "k1 k2", "k1 k2 p1 p2", plain)
    steps: list[tuple[str, tuple[str, ...]]] = []
    if pitch_known:
        steps += [("brown", brown), ("brown_higher", (f"{brown[-1]} K4 K5",))]
    else:
        steps += [("opencv", opencv)]
    prism = "s1 s2 s3 s4"
    steps += [
        ("opencv", (rational,)),
        ("opencv_full", tuple(f"{a} {b}" for a in (plain, rational) for b in (tilt, prism))),
        ("fisheye", ("", "k1 k2", "k1 k2 k3 k4", "k1 k2 k3 k4 p1 p2")),
        ("equisolid", ("k1 k2",)),
        ("orthographic", ("k1 k2",)),
        ("stereographic", ("k1 k2",)),
        ("omni", ("xi", "xi k1 k2 p1 p2")),
        ("double_sphere", ("xi alpha",)),
        ("division", ("lambda", "lambda p1 p2")),
    ]
    return tuple(
        Candidate(name, (*camera_model(name).of_role("scale", "centre"), *more.split()))
        for name, several in steps
        for more in several
    )


def families(candidates: Iterable[Candidate]) -> list[tuple[Candidate, ...]]:
    """Candidates whose parameters are parts of the same ones; each family begins with that to adjust first.

    This is the richest of those with a moderate number of coefficients.

    Examples
    --------
    >>> [family[0].label for family in families(camera_candidates(pitch_known=False))][:2]
    ['opencv: k1 k2 p1 p2 k3', 'fisheye: k1 k2 k3 k4']
    """
    found: dict[object, list[Candidate]] = {}
    for each in candidates:
        key = wider_model(each.model), tuple(sorted(each.options.items())), each.additional
        found.setdefault(key, []).append(each)
    several = []
    for family in found.values():
        few = [each for each in family if each.coefficients <= _MODERATE]
        first = (
            max(few, key=lambda each: len(each.free)) if few else min(family, key=lambda each: len(each.free))
        )
        several.append((first, *(each for each in family if each is not first)))
    return several


def first_fit(
    network: Network, starts: Sequence[Candidate], options: Options, *, anew: bool = False
) -> BundleFit | Failure:
    """Adjust the only camera of a network: the first of several candidates with which this can be done.

    With `anew` only these candidates, without what is known of the camera but its focal length.
    """
    found: BundleFit | Failure = Failure("no candidate", Code.NOT_CONVERGED)
    camera, plain = network.cameras[0], replace(options, outliers="keep")
    f = float(camera.bare_mapping(distorted=False).derivatives([[0.0, 0.0]]).d_xy[0, 0, 0])
    alike = wider_model(camera.model) == wider_model(starts[0].model)
    given = [*([_camera(camera, starts[0], camera.values)] if alike else []), camera]
    rest = [_started(camera, start, f) for start in starts[alike and not anew :]]
    for own in [*([] if anew else given), *rest]:
        if isinstance(own, Failure):
            continue
        problem, _ = problem_of(replace(network, cameras=(own,)), plain)
        found = adjusted_in_steps(problem)
        if not isinstance(found, Failure):
            return found
    return found


def _started(camera: Camera, candidate: Candidate, f: float) -> Camera | Failure:
    """A camera of the candidate's model for a focal length of f pixels."""
    model = camera_model(candidate.model)
    grid = PixelGrid(camera.width, camera.height, camera.pitch_mm)
    return _camera(camera, candidate, model.start_values(f, grid))


def _camera(given: Camera, candidate: Candidate, values: Array) -> Camera | Failure:
    """The camera with the model of a candidate; a failure where that does not support what the camera has."""
    model = camera_model(candidate.model)
    sigma, extra = model.priors(candidate.free), None
    if candidate.additional is not None:
        longer = max(given.width * given.pitch_mm[0], given.height * given.pitch_mm[1])
        extra = Additional(longer / 2, model=candidate.additional)
    full = np.zeros(len(model.names))
    full[: len(values)] = values
    # Corrections that are observed, are observed as zero.
    observed = np.where([name in sigma for name in model.names], 0.0, full)
    try:
        return replace(
            given, model=candidate.model, values=observed, free=candidate.free, options=candidate.options,
            sigma=sigma, covariance=None, additional=extra,
        )  # fmt: skip
    except UsageError as error:
        return Failure(str(error), Code.NOT_CONSIDERED)


def adjusted_to(fit: BundleFit, candidate: Candidate, camera: int) -> BundleFit | Failure:
    """Adjust a candidate from the estimates of another model of the camera."""
    old = fit.problem.network.cameras[camera]
    given = replace(old, values=fit.values.cameras[camera, : len(old.values)])
    model = camera_model(candidate.model)
    try:
        if wider_model(old.model) == wider_model(candidate.model) and set(old.free) <= set(candidate.free):
            # More of the same parameters begin at zero.
            values = given.values[: len(model.names)]
        else:
            values = roughly(
                given.plane_mapping(), given.grid, candidate.model, candidate.options, free=candidate.free
            ).values
    except UsageError:
        # The other model has no directions in most of the image.
        slope = given.bare_mapping().derivatives([[0.0, 0.0]]).d_xy[0, 0, 0]
        values = model.mapping(
            model.start_values(float(slope), given.grid), given.grid, candidate.options
        ).values
    own = _camera(given, candidate, values)
    if isinstance(own, Failure):
        return own
    problem = with_camera(fit, camera, own, values)
    with np.errstate(all="ignore"):
        return _checked(replace(problem, max_iterations=_STEPS, tolerance=_ENOUGH).adjusted(), camera)


def _checked(fit: BundleFit | Failure, camera: int) -> BundleFit | Failure:
    """The adjustment, unless its camera folds within the observations or is not determined."""
    if not isinstance(fit, BundleFit):
        return fit
    network = fit.problem.network
    own = fit.usable.observations & (network.camera_of[network.image_of] == camera)
    if not np.isfinite(whole_camera(fit, camera).inverse(network.xy[own])).all():
        return Failure("the image folds within the observations", Code.NOT_IDENTIFIED)
    return fit


def surface(fit: BundleFit, camera: int) -> Candidate | None:
    """A spline surface over the angle of view; None where the camera has no image at the edges."""
    own = fit.problem.network.cameras[camera]
    width, height = own.width, own.height
    x, y = (width - 1) / 2, (height - 1) / 2
    uv = whole_camera(fit, camera).inverse([[0.0, y], [width - 1.0, y], [x, 0.0], [x, height - 1.0]])
    if not np.isfinite(uv).all() or own.parallel:
        return None
    half = np.arctan(np.hypot(*uv.T))
    fov = int(np.ceil(np.degrees(2 * half[:2].max()))) + 1
    order, across = 3, 8
    per_u = SplineGrid(order, across, across, fov).per_u
    down = int(np.ceil(4 * np.tan(half[2:].max() / 2) * per_u)) + order
    name = SplineGrid(order, across, down, fov).name
    return Candidate(name, camera_model(name).usual)


def with_parallel_rays(
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
    if isinstance(camera, Failure):
        return camera
    result = adjust_network(replace(network, cameras=(camera,)), replace(options, outliers="keep"))
    if isinstance(result, Failure):
        return result
    if weights is None:
        return result.fit
    n, problem = 2 * len(network.xy), result.fit.problem.continued(result.fit)
    kept = np.ones(len(problem.observations))
    kept[:n] = weights[:n]
    return problem.with_weights(kept).adjusted()
