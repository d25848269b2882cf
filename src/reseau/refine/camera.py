"""The correction of a camera by one frame of a reseau: group A of Wishahy's procedure.

Photo-coordinates and coordinates of the reseau are referred to one **common system**, with its origin in the
mark O and its x-axis through the mark S. The remaining differences are the errors of camera and film.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..adjust import Adjustment, Elimination, Options
from ..calibration.mapping import carried
from ..calibration.oscilloscope import CameraCorrection, tests_of
from ..core.data import Array, ImagePoints
from ..core.failure import Code, Failure
from ..io import ReseauDesign
from ..measure.fitting import fit_mapping, is_mirrored, on_one_line, reduce_mapping, residual_field
from ..optics import RationalPolynomial, Similarity
from ..optics.field import SmoothField

__all__ = ["CorrectionFit", "FittedCamera", "correct_camera"]


@dataclass(frozen=True, eq=False)
class CorrectionFit:
    """How the correction of a camera was fitted.

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
        Remaining residuals as a smooth field; `local.need` is the probability, per axis, of a field as
        large from white noise alone. None with fewer than 20 marks.

    Examples
    --------
    See :func:`correct_camera`:

    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(4, 4, 10.0, Mark(shape="disk", size=1.0))
    >>> seen = ImagePoints.with_sigma(reseau.ids, reseau.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> fit = correct_camera(seen, reseau, model=RationalPolynomial.affine(), check=["A1"]).required().fit
    >>> fit.check.names, bool(abs(fit.residuals).max() < 1e-6), len(fit.tests())
    (('A1',), True, 4)
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
        """Tests of all coefficients as in the calibration file: dropped ones first, in their order."""
        return tests_of(self.elimination)


@dataclass(frozen=True, eq=False)
class FittedCamera(CameraCorrection):
    """The correction of a camera, with the record of its fit.

    Parameters
    ----------
    fit : CorrectionFit, optional
        How the model was fitted.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(4, 4, 10.0, Mark(shape="disk", size=1.0))
    >>> seen = ImagePoints.with_sigma(reseau.ids, reseau.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> camera = correct_camera(seen, reseau, model=RationalPolynomial.affine()).required()
    >>> len(camera.apply(seen)), camera.fit.adjustment.redundancy
    (16, 30)
    """

    fit: CorrectionFit | None = None


def correct_camera(
    points: ImagePoints,
    design: ReseauDesign,
    *,
    model: RationalPolynomial | None = None,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "chi2",
    check: Iterable[str] = (),
    trials: int = 499,
) -> FittedCamera | Failure:
    """Correct a camera by the marks of a reseau (Wishahy, steps i–iii).

    Parameters
    ----------
    points : ImagePoints
        Measured marks in pixels.
    design : ReseauDesign
        The reseau; `origin` and `axis` name O and S. By default O is the mark nearest to the centre, S the
        one farthest to its right.
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
    FittedCamera or Failure
        A failure when there are too few marks, or the adjustment fails.

    Notes
    -----
    The common system is a choice of coordinates, fixed by the measured images of O and S. Their errors
    shift, rotate and scale it; a, b and c absorb that. The sigmas of the coefficients are conditional on
    this system.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(5, 5, 15.0, Mark(shape="disk", size=1.0))
    >>> bent = reseau.xy * (1 + 1e-6 * (reseau.xy**2).sum(axis=1, keepdims=True))
    >>> seen = bent * [9.0, -9.0] + [800.0, 600.0]
    >>> camera = correct_camera(ImagePoints.with_sigma(reseau.ids, seen, 0.01), reseau, trials=0).required()
    >>> bool(abs(camera.fit.residuals).max() < 0.02)
    True
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
            f"the {len(known)} marks lie on one line; nothing is determined across it",
            Code.COLLINEAR,
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
    correction = FittedCamera(
        reduced, cofactor, photo_system, object_system, design.unit, extent=_extent(target[used])
    )
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
    return replace(correction, fit=record)


def _extent(xy: Array) -> tuple[float, float, float, float]:
    """Left, low, right and high end of points (n, 2)."""
    (left, low), (right, high) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return left, low, right, high


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
        Names the two marks; by default the one nearest to the centre and the one farthest to its right.

    Returns
    -------
    two pairs of ndarray (2,), or Failure
        For each of the two its measured and its designed coordinates. The position of a mark that was not
        measured is predicted by a projectivity through the others.
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
