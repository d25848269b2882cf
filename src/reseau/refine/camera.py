"""The correction of a camera by one frame of a reseau: group A of Wishahy's procedure.

Photo-coordinates and coordinates of the reseau are referred to one **common system**, with its origin in the
mark O and its x-axis through the mark S; what is left between them is the camera's and the film's doing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..adjust import Adjustment, Elimination, Options
from ..calibration.document import Calibration, Covariance, Quantity
from ..core.data import Array, ImagePoints
from ..core.errors import FormatError, UsageError
from ..core.failure import Code, Failure
from ..io import ReseauDesign
from ..measure.fitting import (
    carried,
    fit_mapping,
    is_mirrored,
    on_one_line,
    reduce_mapping,
    residual_field,
    tests_of,
)
from ..optics import RationalPolynomial, Similarity
from ..optics.field import SmoothField
from ..optics.polynomials import monomials

__all__ = ["CameraCorrection", "correct_camera"]

_MODEL = "oscilloscope group A"
_MODELS = (_MODEL, f"{_MODEL} and group B")


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """From pixels to the plane of the reseau, refined of lens distortion and film deformation.

    Parameters
    ----------
    model : RationalPolynomial
        Photo-coordinates to coordinates of the reseau, both in the common system, mm.
    cofactor : ndarray (u, u)
        Covariance matrix of the model's parameters: a priori where χ² tests decided, which take the points'
        covariances at their word, else a posteriori.
    photo_system : Similarity
        Pixels into the common system: scaled to the reseau, of the handedness of its design.
    object_system : Similarity
        Coordinates of the design into the common system.
    unit : str
        Of the design.
    fit : CorrectionFit, optional
        How the model came about; None for one read from a calibration.
    """

    model: RationalPolynomial
    cofactor: Array
    photo_system: Similarity
    object_system: Similarity
    unit: str
    fit: CorrectionFit | None = None

    def __bool__(self) -> bool:
        return True

    def required(self) -> CameraCorrection:
        """The correction itself; see :meth:`~reseau.core.failure.Failure.required`."""
        return self

    def apply(self, points: ImagePoints) -> ImagePoints:
        """Correct measured points.

        Parameters
        ----------
        points : ImagePoints
            In pixels.

        Returns
        -------
        ImagePoints
            In the common system, in the design's unit. The covariances contain the points' own and that of
            the model; for points that the model was fitted to, the two are correlated, which is left out.
            What the model cannot follow is no part of them: see `CorrectionFit.local` and the global test.
        """
        photo = carried(self.photo_system, points)
        value, slope, by_parameter = self.model.derivatives(photo.xy)
        cov = slope @ photo.cov @ np.swapaxes(slope, 1, 2)
        cov = cov + by_parameter @ self.cofactor @ np.swapaxes(by_parameter, 1, 2)
        return ImagePoints(points.names, value, cov)

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) at which points of the common system appear; NaN where the model has no inverse."""
        return self.photo_system.inverse(self.model.inverse(xy))

    def calibration(
        self, *, name: str, provenance: dict[str, Any] | None = None, times: dict[str, str] | None = None
    ) -> Calibration:
        """The calibration file; `CameraCorrection.from_calibration` reads it back."""
        sigma = np.sqrt(np.diagonal(self.cofactor))
        free = [i for i, s in enumerate(sigma) if s > 0]
        names = self.model.names
        parameters = {
            key: Quantity(value=float(value), sigma=float(s), unit=unit_of(self.model, key, self.unit))
            for key, value, s in zip(names, self.model.values, sigma, strict=True)
        }
        matrix = self.cofactor[np.ix_(free, free)]
        return Calibration(
            kind="oscilloscope",
            name=name,
            model={
                "name": _MODEL,
                "unit": self.unit,
                "mapping": self.model.to_dict(values=False),
                "photo_system": system_to_dict(self.photo_system),
                "object_system": system_to_dict(self.object_system),
            },
            parameters=parameters,
            covariance=Covariance(
                names=tuple(names[i] for i in free), matrix=tuple(tuple(map(float, row)) for row in matrix)
            ),
            sigma0=None if self.fit is None else float(self.fit.adjustment.sigma0),
            redundancy=0 if self.fit is None else self.fit.adjustment.redundancy,
            tests=() if self.fit is None else self.fit.tests(),
            validity={} if self.fit is None else self.fit.validity(),
            provenance=provenance or {},
            times=times or {},
        )

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> CameraCorrection:
        """Read a correction back from its file.

        Raises
        ------
        FormatError
            When the calibration is of another kind.
        """
        content = calibration.model
        if not isinstance(content, dict) or content.get("name") not in _MODELS:
            raise FormatError(f"is no calibration of {_MODEL}", where=f"calibration {calibration.name}")
        try:
            model = with_stored_values(RationalPolynomial.from_dict(content["mapping"]), calibration)
            systems = [system_from_dict(content[key]) for key in ("photo_system", "object_system")]
            unit = str(content["unit"])
            row_of = {name: i for i, name in enumerate(calibration.parameters)}
            order = [row_of[name] for name in model.names]
        except (KeyError, TypeError, ValueError, UsageError) as error:
            raise FormatError(
                f"lacks or misstates {error}", where=f"model of calibration {calibration.name}"
            ) from None
        return cls(model, calibration.matrix()[np.ix_(order, order)], systems[0], systems[1], unit)


@dataclass(frozen=True, eq=False)
class CorrectionFit:
    """How a correction came about.

    Parameters
    ----------
    elimination : Elimination
        The record of the tests of all coefficients, with the full and the reduced adjustment.
    points : ImagePoints
        Photo-coordinates of the marks in the common system.
    target : ndarray (n, 2)
        Coordinates of the same marks in the design, in the common system.
    corrected : ImagePoints
        The photo-coordinates corrected.
    check : ImagePoints
        Marks held out, corrected.
    check_target : ndarray (c, 2)
        Their coordinates in the design.
    local : SmoothField or None
        What the model leaves, as a smooth field; `local.need` is the probability, per axis, that white noise
        alone would show as much. None with fewer than 20 marks.
    """

    elimination: Elimination
    points: ImagePoints
    target: Array
    corrected: ImagePoints
    check: ImagePoints
    check_target: Array
    local: SmoothField | None

    @property
    def adjustment(self) -> Adjustment:
        """With the coefficients that remained."""
        return self.elimination.adjustment

    @property
    def residuals(self) -> Array:
        """Corrected minus designed coordinates, (n, 2)."""
        return self.corrected.xy - self.target

    def tests(self) -> tuple[dict[str, Any], ...]:
        """Of every coefficient, dropped ones first and in their order, as in the calibration file."""
        return tests_of(self.elimination)

    def validity(self) -> dict[str, Any]:
        """Where the correction holds: the extent of its marks in the common system."""
        low, high = self.target.min(axis=0), self.target.max(axis=0)
        return {"extent": [*map(float, low), *map(float, high)], "marks": len(self.target)}


def correct_camera(
    points: ImagePoints,
    design: ReseauDesign,
    *,
    model: RationalPolynomial | None = None,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "chi2",
    check: Iterable[str] = (),
    trials: int = 499,
) -> CameraCorrection | Failure:
    """Correct a camera by the marks of a reseau (Wishahy, steps i–iii).

    Parameters
    ----------
    points : ImagePoints
        Measured marks in pixels.
    design : ReseauDesign
        The reseau; `origin` and `axis` name O and S. Without them the mark nearest to the middle is O and
        that farthest to the right of it S.
    model : RationalPolynomial, optional
        Any model whose terms are data; by default equations (5a, b).
    alpha : float
        Level of the tests of the coefficients; those not significant are dropped one by one.
    criterion : {"t", "chi2", "F"}
        The test.
    check : iterable of str
        Marks held out, for an independent check.
    trials : int
        Simulated fields for the test whether a local model is needed on top.

    Returns
    -------
    CameraCorrection or Failure
        A failure when there are too few marks, or the adjustment fails.

    Notes
    -----
    The common system is a choice of coordinates, frozen at the measured images of O and S: their errors turn,
    shift and scale it, and a, b and c take that up. Sigmas of the coefficients are given this system.
    """
    model = RationalPolynomial.camera() if model is None else model
    held = set(check)
    coordinates = {p.id: (p.x, p.y, p.sigma or 0.0) for p in design.points if p.x is not None}
    known = [name for name in points.names if name in coordinates]
    if len(known) < 4:
        return Failure(
            f"{len(known)} of {len(points)} points are marks with coordinates in design {design.name!r}; "
            "four are needed at least",
            Code.TOO_FEW_POINTS,
        )
    marks = points.select(known)
    plane = np.array([coordinates[name][:2] for name in known], dtype=np.float64)
    if on_one_line(plane):
        return Failure(
            f"the {len(known)} marks lie on one line and determine nothing across it", Code.COLLINEAR
        )
    sigma = np.array([coordinates[name][2] for name in known])
    systems = _common_system(marks, plane, design)
    if isinstance(systems, Failure):
        return systems
    photo_system, object_system = systems
    photo, target = carried(photo_system, marks), object_system(plane)
    used = np.array([name not in held for name in known])
    elimination = reduce_mapping(
        model,
        photo.select(used),
        target[used],
        sigma[used, None],
        alpha=alpha,
        criterion=criterion,
        keep=[name for name in ("a1", "b2") if name in model.names],
        options=Options(scale="a-priori" if criterion == "chi2" else "a-posteriori"),
    )
    if isinstance(elimination, Failure):
        return elimination
    fit = elimination.adjustment
    reduced = model.with_values(fit.values).without(*elimination.dropped)
    rows = [model.names.index(name) for name in reduced.names]
    cofactor = fit.covariance[np.ix_(rows, rows)]
    correction = CameraCorrection(reduced, cofactor, photo_system, object_system, design.unit)
    corrected = correction.apply(marks)
    residuals = (corrected.xy - target)[used]
    local = residual_field(reduced, photo.select(used), target[used], residuals, sigma[used, None], trials)
    record = CorrectionFit(
        elimination,
        photo.select(used),
        target[used],
        corrected.select(used),
        corrected.select(~used),
        target[~used],
        local,
    )
    return CameraCorrection(reduced, cofactor, photo_system, object_system, design.unit, record)


def _common_system(
    marks: ImagePoints, plane: Array, design: ReseauDesign
) -> tuple[Similarity, Similarity] | Failure:
    """Pixels and design into the system of O and S, at the scale of the design."""
    ends = defining_marks(marks, plane, design)
    if isinstance(ends, Failure):
        return ends
    (o, o1), (s, s1) = ends
    object_system = Similarity.common_system(o1, s1)
    mirrored = is_mirrored(plane, marks.xy)
    turned = Similarity.common_system(o, s, mirrored=mirrored)
    scale = np.hypot(*(s1 - o1)) / np.hypot(*(s - o))
    photo_system = Similarity(turned.values * scale, mirrored=mirrored)
    return photo_system, object_system


def defining_marks(
    marks: ImagePoints, plane: Array, design: ReseauDesign
) -> tuple[tuple[Array, Array], tuple[Array, Array]] | Failure:
    """The two marks that define a system, `origin` and `axis` of the design.

    Parameters
    ----------
    marks : ImagePoints
        Measured marks.
    plane : ndarray (n, 2)
        Their designed coordinates.
    design : ReseauDesign
        Names the two; without names the mark nearest to the middle and that farthest to its right.

    Returns
    -------
    two pairs of ndarray (2,), or Failure
        For each of the two its place among the marks and its designed coordinates. A mark that was not
        measured lies where a projectivity through the others has it.
    """
    row_of = {name: i for i, name in enumerate(marks.names)}
    ends: list[tuple[Array, Array]] = []
    for name in _origin_and_axis(marks, plane, design):
        at = next(p for p in design.points if p.id == name)
        designed = np.array([at.x, at.y], dtype=np.float64)
        if not np.isfinite(designed).all():
            return Failure(
                f"mark {name!r} defines the common system and has no coordinates in the design", Code.NO_DATUM
            )
        if name in row_of:
            ends.append((marks.xy[row_of[name]], designed))
            continue
        fitted = fit_mapping(
            RationalPolynomial.projective(),
            ImagePoints.with_sigma(marks.names, plane - plane.mean(axis=0), 1.0),
            marks.xy - marks.xy.mean(axis=0),
        )
        if isinstance(fitted, Failure):
            return fitted
        projective = RationalPolynomial.projective().with_values(fitted.values)
        ends.append((projective((designed - plane.mean(axis=0))[None])[0] + marks.xy.mean(axis=0), designed))
    return ends[0], ends[1]


def _origin_and_axis(marks: ImagePoints, plane: Array, design: ReseauDesign) -> tuple[str, str]:
    """Names of O and S."""
    middle = plane - (plane.min(axis=0) + plane.max(axis=0)) / 2
    origin = design.origin
    if origin is None:
        origin = marks.names[int(np.hypot(*middle.T).argmin())]
    axis = design.axis
    if axis is None:
        at = next(p for p in design.points if p.id == origin)
        offset = plane - np.array([at.x, at.y], dtype=np.float64)
        axis = marks.names[int((offset[:, 0] - 2 * np.abs(offset[:, 1])).argmax())]
    return origin, axis


def with_stored_values(model: RationalPolynomial, calibration: Calibration) -> RationalPolynomial:
    """The model with its parameters' values of a calibration file, which may hold those of others too."""
    values = calibration.values()
    return model.with_values(np.array([values[name] for name in model.names]))


def unit_of(model: RationalPolynomial, name: str, unit: str) -> str:
    """Unit of a coefficient: that of X over the power of its monomials."""
    part, text = next(iter(model.terms[name].items()))
    exponent = (0 if part == "D" else 1) - max(i + j for i, j in monomials(text))
    return "1" if exponent == 0 else unit if exponent == 1 else f"{unit}^{exponent}"


def system_to_dict(system: Similarity) -> dict[str, Any]:
    values = dict(zip(system.names, map(float, system.values), strict=True))
    return values | {"mirrored": system.mirrored}


def system_from_dict(content: dict[str, Any]) -> Similarity:
    values = np.array([float(content[name]) for name in Similarity.names])
    return Similarity(values, bool(content["mirrored"]))
