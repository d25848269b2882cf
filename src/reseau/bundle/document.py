"""The result of a bundle adjustment as a document, ``reseau-bundle/1``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import ConfigDict, Field

from ..core.data import Array
from ..core.data import Rows as Indices
from ..core.numbers import or_null
from ..core.provenance import Provenance
from ..io import Document, Strict
from ..optics.poses import matrix_to_vector
from ..optics.refraction.windows import Refraction
from .diagnostics.estimates import MotionEstimates, PriorInfluence, RigEstimate, StageEstimate
from .diagnostics.regularisation import Regularised, regularised
from .diagnostics.result import Result
from .network.network import finite
from .network.rig import Rig

Column = tuple[float | None, ...]
Rows = tuple[tuple[float, ...] | None, ...]
Matrix = tuple[tuple[float, ...], ...]
P = TypeVar("P", bound=Strict)


class Estimate(Strict):
    """A parameter with its standard deviation; zero for held parameters, null where it is not determined."""

    value: float
    sigma: float | None


class Correlation(Strict):
    """Correlation matrix of the estimated parameters."""

    names: tuple[str, ...]
    matrix: Matrix


class Significance(Strict):
    """Test of a distortion parameter against zero."""

    statistic: float | None
    critical: float
    p: float
    significant: bool


class RegularisationResult(Strict):
    """Influence of a regularisation over the image.

    `area` is the part of the image where most of the variance of the projection is that of the
    regularisation, `regions` the part of each ninth of the image; `sigma` the largest standard deviation
    there (px), and `where_observed` the median share of the variance where there are image points.
    """

    area: float
    regions: dict[str, float]
    sigma: float
    where_observed: float


class PriorResult(Strict):
    """Observed parameters of a camera in columns: their share in the estimates, and sigmas with and without.

    `sigma_images` is the part of `sigma` that the noise of all other observations causes; `determined` the
    number of parameters that these determine; `sigma0` that without these observations.
    """

    parameter: tuple[str, ...]
    given: tuple[float, ...]
    sigma_given: tuple[float, ...]
    share: tuple[float, ...]
    sigma: tuple[float, ...]
    sigma_images: tuple[float, ...]
    determined: float
    sigma0: float | None
    regularisation: RegularisationResult | None = None


class CameraResult(Strict):
    """A camera: parameters, correlation, tests.

    The standard deviations and the correlation contain what the points of an image have in common;
    `sigma_formal` presumes independent errors of all image points. `degrees_of_freedom` are those of the
    standard deviations, null without limit.
    """

    id: str
    parameters: dict[str, Estimate]
    sigma_formal: dict[str, float] | None = None
    degrees_of_freedom: dict[str, float | None] | None = None
    # Older documents only.
    sigma_between_images: dict[str, float | None] | None = None
    correlation: Correlation
    tests: dict[str, Significance]
    priors: PriorResult | None = None


class RefractionResult(Strict):
    """Windows and media: all parameters, given values, and tests of the estimates against these.

    `partners` are, for each estimated parameter, the unknown correlated most and the correlation.
    """

    parameters: dict[str, Estimate]
    given: dict[str, float]
    correlation: Correlation
    tests: dict[str, Significance]
    partners: dict[str, tuple[str, float]]


class RigResult(Strict):
    """Relative orientations of the cameras of a rig, in columns.

    `rotation` (vector, from the axes of the `reference` camera to those of the camera) and `base` (projection
    centre in the axes of the reference) have the standard deviations `sigma`: rad about the axes of the
    camera, then the base; `covariance` is the whole (6, 6).
    """

    camera: tuple[str, ...]
    reference: tuple[str, ...]
    rotation: Matrix
    base: Matrix
    sigma: Matrix
    length: tuple[float, ...]
    length_sigma: tuple[float, ...]
    covariance: tuple[Matrix, ...]


class TurntableResult(Strict):
    """Axis and angles of a turntable.

    The object turns anticlockwise about the unit vector `direction`, seen from where it points; `position` is
    the point of the axis next to the centroid of the object points. `covariance` (6, 6) is that of both, and
    their sigmas are the largest ones, across the axis. In columns: estimated angles, their sigmas (zero for
    held ones), and estimated minus given angles.
    """

    carries: str
    direction: tuple[float, ...]
    direction_sigma_deg: float
    position: tuple[float, ...]
    position_sigma: float
    covariance: Matrix
    image: tuple[str, ...]
    angle_deg: Column
    sigma_deg: Column
    residual_deg: Column


class MotionResult(Strict):
    """Motion of images of cameras with a shutter, in columns: vx, vy, vz (per second), wx, wy, wz (rad/s).

    `sigma` is zero for components that were not estimated; `tests` are against zero.
    """

    image: tuple[str, ...]
    motion: Matrix
    sigma: Matrix
    tests: dict[str, Significance]


class ImagesResult(Strict):
    """Images in columns; `sigma` is that of X0, Y0, Z0 and of the rotation vector (rad).

    `factors` are the factors by which the input standard deviations of x and y are too small.
    """

    id: tuple[str, ...]
    camera: tuple[str, ...]
    X0: Rows
    rotation: Rows
    sigma: Rows
    angles_deg: Rows
    angles_sigma_deg: Rows
    factors: Rows


class PointsResult(Strict):
    """Points in columns; `check` are differences at check points, estimated minus given."""

    id: tuple[str, ...]
    role: tuple[str, ...]
    xyz: Rows
    sigma: Rows
    rays: tuple[int, ...]
    cov: tuple[Matrix | None, ...] | None = None
    check: Rows | None = None


class ImagePointsResult(Strict):
    """Image coordinates in columns: residuals (px), redundancy numbers, test values, reliability.

    `mx`, `my` are minimal detectable errors (px); `ex`, `ey` the largest effect of errors of this size on any
    result, in its standard deviations.
    """

    image: tuple[str, ...]
    point: tuple[str, ...]
    vx: Column
    vy: Column
    rx: Column
    ry: Column
    wx: Column
    wy: Column
    rejected: tuple[bool, ...]
    mx: Column
    my: Column
    ex: Column
    ey: Column


class GlobalTestResult(Strict):
    """Test of the variance factor against one."""

    statistic: float
    redundancy: int
    lower: float
    upper: float
    p: float
    passed: bool


class LeftOut(Strict):
    """Image points that data snooping rejected, with the test values at rejection."""

    image: tuple[str, ...]
    point: tuple[str, ...]
    w: Column
    critical: Column


class DistancesResult(Strict):
    """Observed distances, or bases of a rig, in columns: residuals, redundancy numbers, test values."""

    model_config = ConfigDict(populate_by_name=True)

    from_: tuple[str, ...] = Field(alias="from")
    to: tuple[str, ...]
    v: Column
    r: Column
    w: Column


class ComponentsResult(Strict):
    """Variance components: factors on the standard deviations given."""

    names: tuple[str, ...]
    factors: tuple[float, ...]
    sigma: tuple[float, ...]
    redundancy: tuple[float, ...]


class EliminatedParameter(Strict):
    """A distortion parameter that was dropped, its test before, and sigma0 without it."""

    camera: str
    name: str
    statistic: float | None
    critical: float
    p: float
    sigma0: float | None


class CrossValidation(Strict):
    """Root mean square of predicted image coordinates, with all parameters and with those kept."""

    all: float
    kept: float


class ResultDocument(Document):
    """The result of a bundle adjustment, ``reseau-bundle/1``, in columns; null for undetermined values.

    Keys after `warnings` are omitted where they do not apply. Files of earlier versions have none of
    `warning_codes`, `status` and `provenance`.

    Examples
    --------
    >>> text = '{"schema": "reseau-bundle/1", "sigma0": null}'
    >>> ResultDocument.parse(text, where="result.json")
    Traceback (most recent call last):
    reseau.core.errors.FormatError: result.json: missing key `observations` (and ... more)
    """

    SCHEMA: ClassVar[str] = "reseau-bundle/1"
    LEFT_OUT: ClassVar[dict[str, Any]] = {"exclude_unset": True}
    sigma0: float | None
    observations: int
    unknowns: int
    constraints: int
    redundancy: int
    iterations: int
    cameras: tuple[CameraResult, ...]
    images: ImagesResult
    points: PointsResult
    image_points: ImagePointsResult
    global_test: GlobalTestResult | None
    warnings: tuple[str, ...]
    warning_codes: tuple[str, ...] | None = None
    status: Literal["ok", "contradictory"] | None = None
    left_out: LeftOut | None = None
    distances: DistancesResult | None = None
    bases: DistancesResult | None = None
    refraction: RefractionResult | None = None
    rig: RigResult | None = None
    turntable: TurntableResult | None = None
    motion: MotionResult | None = None
    variance_components: ComponentsResult | None = None
    eliminated: tuple[EliminatedParameter, ...] | None = None
    cross_validation: CrossValidation | None = None
    provenance: dict[str, Any] | None = None

    @classmethod
    def of(cls, result: Result, *, covariances: bool = False, provenance: Provenance | None = None) -> Self:
        """Create the document of a result.

        Parameters
        ----------
        result : Result
            Result of a bundle adjustment.
        covariances : bool
            Whether to include the full covariances of the points.
        provenance : Provenance, optional
            Inputs and options.
        """
        observations, unknowns, constraints = result.fit.counts
        test = result.global_test()
        more: dict[str, Any] = {}
        if result.rejected.any():
            more["left_out"] = _left_out(result)
        if len(result.network.distance):
            more["distances"] = _distances(result)
        if result.network.rig is not None and len(result.network.rig.base):
            more["bases"] = _bases(result, result.network.rig)
        if result.network.refraction is not None:
            more["refraction"] = _refraction(result, result.network.refraction)
        if result.rig is not None:
            more["rig"] = _rig(result.rig)
        if result.stage is not None and result.stage.kind == "rotary":
            more["turntable"] = _turntable(result.stage)
        if result.motion is not None:
            more["motion"] = _motion(result.motion)
        if provenance is not None:
            more["provenance"] = provenance.to_dict()
        return cls(
            sigma0=or_null(result.sigma0),
            observations=observations,
            unknowns=unknowns,
            constraints=constraints,
            redundancy=result.redundancy,
            iterations=result.fit.iterations,
            cameras=tuple(_camera(result, c) for c in range(len(result.network.cameras))),
            images=_images(result),
            points=_points(result, covariances),
            image_points=_image_points(result),
            global_test=None if test is None else _of(GlobalTestResult, test),
            warnings=tuple(remark.text for remark in result.warnings),
            warning_codes=tuple(remark.code.value for remark in result.warnings),
            status=result.status,
            **more,
            **_model_search(result),
        )  # fmt: skip


def model_search_entries(result: Result) -> dict[str, Any]:
    """Return the model search of a result as JSON values; empty where no model was searched.

    Examples
    --------
    >>> from reseau.bundle import example_network, search_model
    >>> entries = model_search_entries(search_model(example_network(), components="axes"))
    >>> entries["variance_components"]["names"]
    ['x', 'y']
    """

    def plain(entry: Any) -> Any:
        if isinstance(entry, tuple):
            return [plain(each) for each in entry]
        return entry.model_dump(mode="json")

    return {key: plain(entry) for key, entry in _model_search(result).items()}


def _model_search(result: Result) -> dict[str, Any]:
    """Entries of the model search; empty where no model was searched."""
    found: dict[str, Any] = {}
    components = result.components
    if components is not None:
        found["variance_components"] = _of(ComponentsResult, components)
    if result.eliminated is not None:
        found["eliminated"] = tuple(
            _of(EliminatedParameter, step.test, camera=step.camera, sigma0=step.sigma0)
            for step in result.eliminated
        )
    if result.validation is not None:
        found["cross_validation"] = CrossValidation(all=result.validation[0], kept=result.validation[1])
    return found


def _camera(result: Result, c: int) -> CameraResult:
    camera, found = result.network.cameras[c], result.camera(c)
    held = {name: Estimate(value=value, sigma=0.0) for name, value in camera.parameters.items()}
    estimated = {
        name: Estimate(value=value, sigma=or_null(s))
        for name, value, s in zip(found.parameters, found.values.tolist(), found.sigma.tolist(), strict=True)
    }
    degrees = _column(found.dof) if found.dof is not None else (None,) * len(found.parameters)
    influence = result.priors(c)
    more: dict[str, Any] = {} if influence is None else {"priors": _priors(influence, regularised(result, c))}
    return CameraResult(
        id=camera.id,
        parameters=held | estimated,
        sigma_formal=dict(zip(found.parameters, found.sigma_formal.tolist(), strict=True)),
        degrees_of_freedom=dict(zip(found.parameters, degrees, strict=True)),
        correlation=Correlation(names=found.parameters, matrix=_matrix(found.correlation)),
        tests={test.name: _of(Significance, test) for test in result.camera_tests(c)},
        **more,
    )


def _priors(found: PriorInfluence, over: Regularised | None) -> PriorResult:
    field = None if over is None else _of(RegularisationResult, over, sigma=over.largest)
    return _of(PriorResult, found, parameter=found.parameters, regularisation=field)


def _refraction(result: Result, bent: Refraction) -> RefractionResult:
    values, found = result.fit.values.refraction.tolist(), result.refraction
    sigma, names = dict.fromkeys(bent.names, 0.0), tuple[str, ...]()
    if found is not None:
        names = found.parameters
        sigma |= dict(zip(names, found.sigma.tolist(), strict=True))
    return RefractionResult(
        parameters={
            name: Estimate(value=value, sigma=sigma[name])
            for name, value in zip(bent.names, values, strict=True)
        },
        given=dict(zip(bent.names, bent.values.tolist(), strict=True)),
        correlation=Correlation(names=names, matrix=() if found is None else _matrix(found.correlation)),
        tests={} if found is None else {test.name: _of(Significance, test) for test in found.tests},
        partners={} if found is None else dict(zip(names, found.partners, strict=True)),
    )


def _rig(found: RigEstimate) -> RigResult:
    rotation = matrix_to_vector(found.rotation)
    return _of(
        RigResult,
        found,
        camera=found.cameras,
        reference=found.references,
        rotation=rotation,
        covariance=found.cov,
    )


def _turntable(found: StageEstimate) -> TurntableResult:
    return _of(
        TurntableResult,
        found,
        direction_sigma_deg=math.degrees(found.direction_sigma),
        covariance=found.cov,
        image=found.images,
        angle_deg=np.degrees(found.reading),
        sigma_deg=np.degrees(found.reading_sigma),
        residual_deg=np.degrees(found.residual),
    )


def _motion(found: MotionEstimates) -> MotionResult:
    tests = {test.name: _of(Significance, test) for test in found.tests}
    return _of(MotionResult, found, image=found.names, motion=found.values, tests=tests)


def _images(result: Result) -> ImagesResult:
    images = result.images
    return _of(
        ImagesResult,
        images,
        id=images.names,
        camera=images.cameras,
        X0=images.x0,
        angles_deg=np.degrees(result.angles),
        angles_sigma_deg=np.degrees(result.angle_sigma),
        factors=result.variance_factors,
    )


def _points(result: Result, covariances: bool) -> PointsResult:
    points, more = result.points, dict[str, Any]()
    if covariances:
        more["cov"] = tuple(
            _matrix(block) if known else None
            for block, known in zip(points.cov, result.fit.usable.points, strict=True)
        )
    rows, difference = result.check_points
    if len(rows):
        column: list[tuple[float, ...] | None] = [None] * len(points)
        for row, off in zip(rows, difference, strict=True):
            column[row] = tuple(off.tolist())
        more["check"] = tuple(column)
    return PointsResult(
        id=points.names,
        role=points.roles,
        xyz=_rows(points.xyz),
        sigma=_rows(points.sigma),
        rays=tuple(points.rays.tolist()),
        **more,
    )


def _image_points(result: Result) -> ImagePointsResult:
    network = result.network
    v, r, w = result.residuals, result.redundancy_numbers, result.test_values
    least, effect = result.minimal_detectable_errors(), result.external_reliability()
    return ImagePointsResult(
        image=tuple(network.images[i] for i in network.image_of),
        point=tuple(network.points[j] for j in network.point_of),
        vx=_column(v[:, 0]),
        vy=_column(v[:, 1]),
        rx=_column(r[:, 0]),
        ry=_column(r[:, 1]),
        wx=_column(w[:, 0]),
        wy=_column(w[:, 1]),
        rejected=tuple(result.rejected.tolist()),
        mx=_column(least[:, 0]),
        my=_column(least[:, 1]),
        ex=_column(effect[:, 0]),
        ey=_column(effect[:, 1]),
    )


def _left_out(result: Result) -> LeftOut:
    rows, network = np.flatnonzero(result.rejected), result.network
    tests = result.rejected_tests[rows]
    return LeftOut(
        image=tuple(network.images[i] for i in network.image_of[rows]),
        point=tuple(network.points[j] for j in network.point_of[rows]),
        w=_column(tests[:, 0]),
        critical=_column(tests[:, 1]),
    )


def _distances(result: Result) -> DistancesResult:
    network, at = result.network, 2 * len(result.network.xy)
    rows = slice(at, at + len(network.distance))
    return _lengths(result, network.distance_of, network.points, rows)


def _bases(result: Result, rig: Rig) -> DistancesResult:
    rows = slice(len(result.fit.residuals) - len(rig.base), len(result.fit.residuals))
    return _lengths(result, rig.base_of, [camera.id for camera in result.network.cameras], rows)


def _lengths(result: Result, ends: Indices, names: Sequence[str], rows: slice) -> DistancesResult:
    """Observed lengths between named ends, which are these rows of the observations."""
    sigma0 = result.sigma0 if result.redundancy > 0 and result.sigma0 > 0 else 1.0
    return DistancesResult(
        **{"from": tuple(names[j] for j in ends[:, 0])},
        to=tuple(names[j] for j in ends[:, 1]),
        v=_column(result.fit.residuals[rows]),
        r=_column(result.fit.redundancy_numbers[rows]),
        w=_column(np.abs(result.fit.w[rows]) / sigma0),
    )


def _of(part: type[P], source: object, **others: Any) -> P:
    """A part of the document: the attributes of the same names, and others."""
    same = part.model_fields.keys() - others.keys()
    found = {name: getattr(source, name) for name in same if hasattr(source, name)} | others
    return part(**{name: _plain(value) for name, value in found.items()})


def _plain(value: Any) -> Any:
    """A value as documents have it: arrays as tuples, and nothing in place of what is not finite."""
    if isinstance(value, np.ndarray):
        if value.ndim > 2:
            return tuple(map(_matrix, value))
        return _rows(value) if value.ndim == 2 else _column(value)
    return or_null(value) if isinstance(value, float) else value


def _column(values: Array) -> Column:
    return tuple(or_null(value) for value in values.tolist())


def _matrix(rows: Iterable[Array]) -> Matrix:
    return tuple(tuple(row.tolist()) for row in rows)


def _rows(values: Array) -> Rows:
    known = finite(values).tolist()
    return tuple(tuple(row) if k else None for row, k in zip(values.tolist(), known, strict=True))
