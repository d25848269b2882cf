"""The correction of a camera by one frame of a reseau: group A of Wishahy's procedure.

Photo-coordinates and coordinates of the reseau are referred to one **common system**, with its origin in the
mark O and its x-axis through the mark S. The remaining differences are the errors of camera and film.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..adjust import Adjustment, Options
from ..adjust.elimination import Elimination
from ..calibration import CameraCorrection, Datum
from ..calibration.entries import tests_of
from ..calibration.mapping import carried
from ..core.data import Array, ImagePoints, Mask
from ..core.failure import Code, Failure
from ..io import ReseauDesign
from ..measure.fitting import (
    fit_mapping,
    gross_errors,
    is_mirrored,
    on_one_line,
    reduce_mapping,
    residual_field,
)
from ..optics import RationalPolynomial
from ..optics.composition import Similarity
from ..optics.field import SmoothField


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
        Residuals of the significant coefficients as a smooth field; `local.need` is the probability, per
        axis, of a field as large from white noise alone. None with fewer than 20 marks.

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
        """With all coefficients, as the correction applies them."""
        return self.elimination.full

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
    gross : tuple of str
        Marks that contradict the others, and were left out.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(4, 4, 10.0, Mark(shape="disk", size=1.0))
    >>> seen = ImagePoints.with_sigma(reseau.ids, reseau.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> camera = correct_camera(seen, reseau, model=RationalPolynomial.affine()).required()
    >>> len(camera.apply(seen)), camera.fit.adjustment.redundancy
    (16, 26)
    """

    fit: CorrectionFit | None = None
    gross: tuple[str, ...] = ()


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
        Level of the tests of the coefficients; the record drops those not significant one by one. The
        correction keeps them all: what is not significant is not zero, and its sigma says what it may be.
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
    Derived in ``docs/mathematics/group-a.md``.

    The common system is a choice of coordinates, fixed by the measured images of O and S. Their errors
    shift, rotate and scale it; a, b and c absorb that. `cofactor` is the covariance of the coefficients in
    this system, which corrected coordinates have; `coefficient_covariance` contains the errors of O and S,
    and is for comparisons of coefficients with those of another photograph or with true ones.

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
    photo_system, object_system, base = systems
    photo, target = carried(photo_system, marks), object_system(plane)
    wrong = gross_errors(model, photo, target, sigma[:, None])
    if wrong.any():  # O or S may be one of them
        gross = tuple(name for name, bad in zip(known, wrong, strict=True) if bad)
        sound = points.select(~np.isin(points.names, gross))
        found = correct_camera(
            sound, design, model=model, alpha=alpha, criterion=criterion, check=check, trials=trials
        )
        return found if isinstance(found, Failure) else replace(found, gross=gross + found.gross)
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
    fit = elimination.full
    full = model.with_values(fit.values)
    datum = _datum(marks, plane, design, photo_system, full, used, sigma, fit, base)
    correction = FittedCamera(
        full,
        fit.covariance,
        photo_system,
        object_system,
        design.unit,
        extent=_extent(target[used]),
        datum=datum,
    )
    corrected, seen = correction.apply(marks), photo.select(used)
    # Whether a local model is needed is asked of what is significant: further terms would take off its power.
    reduced = model.with_values(elimination.adjustment.values).without(*elimination.dropped)
    left = reduced(seen.xy) - target[used]
    local = residual_field(reduced, seen, target[used], left, sigma[used, None], trials)
    record = CorrectionFit(
        elimination,
        seen,
        target[used],
        corrected.select(used),
        corrected.select(~used),
        target[~used],
        local,
    )
    return replace(correction, fit=record)


def _datum(
    marks: ImagePoints,
    plane: Array,
    design: ReseauDesign,
    photo_system: Similarity,
    model: RationalPolynomial,
    used: Mask,
    sigma: Array,
    fit: Adjustment,
    base: float,
) -> Datum:
    """Errors of O and S, and their effect on the coefficients.

    With the errors ε of all marks in photo-coordinates, the coefficients are off by H ε in the system of the
    measured O and S, H = −Q Aᵀ W F with F the derivatives of the conditions by the photo-coordinates. Errors
    δ = E ε of O and S, at the distance D, move a point z of the photograph (as a complex number) by
    −(1 − z/D) δ_O − (z/D) δ_S. The coefficients follow with the same H.
    """
    photo = carried(photo_system, marks)
    _, slope, by_coefficient = model.derivatives(photo.xy)
    spread = sigma[:, None, None] ** 2 * np.eye(2)
    weights = np.linalg.inv(slope @ photo.cov @ np.swapaxes(slope, 1, 2) + spread) * used[:, None, None]
    response = -np.einsum("pq,niq,nij,njk->pnk", fit.cofactor, by_coefficient, weights, slope)
    x, y = photo.xy.T / base
    of_o, of_s = (
        -np.stack([np.stack([re, -im], axis=-1), np.stack([im, re], axis=-1)], axis=1)
        for re, im in ((1 - x, -y), (x, y))
    )
    shares = _shares(marks, plane, design, photo_system)
    influence = np.einsum("pnk,nkj->pj", response, np.concatenate([of_o, of_s], axis=2))
    shared = np.einsum("pni,nij,qnj->pq", response, photo.cov, shares)
    covariance = np.einsum("pni,nij,qnj->pq", shares, photo.cov, shares)
    scale = float(fit.covariance[0, 0] / fit.cofactor[0, 0])  # a posteriori, the marks are as good as that
    return Datum(influence, scale * shared, scale * covariance)


def _shares(marks: ImagePoints, plane: Array, design: ReseauDesign, photo_system: Similarity) -> Array:
    """Derivatives E of the positions of O and S by those of all marks, in photo-coordinates, (4, n, 2).

    A measured one depends on itself, a predicted one on the projectivity through the others.
    """
    shares = np.zeros((4, len(marks), 2))
    linear = photo_system.derivatives(marks.xy[:1]).d_xy[0]
    back = np.linalg.inv(linear)
    centre = plane.mean(axis=0)
    for k, name in enumerate(_origin_and_axis(marks, plane, design)):
        if name in marks.names:
            shares[2 * k : 2 * k + 2, marks.names.index(name)] = np.eye(2)
            continue
        projective = _projective(marks, plane)
        assert not isinstance(projective, Failure)  # asked by `defining_marks`
        at = next(p for p in design.points if p.id == name)
        _, slope, by_parameter = projective.derivatives(plane - centre)
        _, _, there = projective.derivatives(np.array([[at.x, at.y]], dtype=np.float64) - centre)
        weights = np.linalg.inv(slope @ np.swapaxes(slope, 1, 2))
        normal = np.einsum("nip,nij,njq->pq", by_parameter, weights, by_parameter)
        size = np.sqrt(np.diagonal(normal))
        cofactor = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
        found = np.einsum("ip,pq,njq,njk->ink", there[0], cofactor, by_parameter, weights)
        shares[2 * k : 2 * k + 2] = np.einsum("ij,jnk,kl->inl", linear, found, back)
    return shares


def _extent(xy: Array) -> tuple[float, float, float, float]:
    """Left, low, right and high end of points (n, 2)."""
    (left, low), (right, high) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return left, low, right, high


def _common_system(
    marks: ImagePoints, plane: Array, design: ReseauDesign
) -> tuple[Similarity, Similarity, float] | Failure:
    """Pixels and design into the system of O and S, at the scale of the design, and their distance."""
    ends = defining_marks(marks, plane, design)
    if isinstance(ends, Failure):
        return ends
    (o, o1), (s, s1) = ends
    object_system = Similarity.common_system(o1, s1)
    mirrored = is_mirrored(plane, marks.xy)
    turned = Similarity.common_system(o, s, mirrored=mirrored)
    base = float(np.hypot(*(s1 - o1)))
    photo_system = Similarity(turned.values * (base / np.hypot(*(s - o))), mirrored=mirrored)
    return photo_system, object_system, base


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
        projective = _projective(marks, plane)
        if isinstance(projective, Failure):
            return projective
        ends.append((projective((designed - plane.mean(axis=0))[None])[0] + marks.xy.mean(axis=0), designed))
    return ends[0], ends[1]


def _projective(marks: ImagePoints, plane: Array) -> RationalPolynomial | Failure:
    """Projectivity from the plane to the image, both reduced to the centres of the marks."""
    model = RationalPolynomial.projective()
    reduced = ImagePoints.with_sigma(marks.names, plane - plane.mean(axis=0), 1.0)
    fitted = fit_mapping(model, reduced, marks.xy - marks.xy.mean(axis=0))
    return fitted if isinstance(fitted, Failure) else model.with_values(fitted.values)


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
