"""The correction of an ultrasonic instrument by one frame of a test object: group B of Wishahy's procedure.

The images of the rods, corrected for group A, are compared with the coordinates of the rods, scaled to the
photograph (λ1, λ2) and transformed into the common system by the rods M and N. The differences are the errors
of the instrument: of its beam, its electronics and its display.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..adjust import Adjustment, Options
from ..adjust.elimination import Elimination
from ..calibration import CameraCorrection, InstrumentCorrection, LocalModel, ObjectPlane
from ..calibration.entries import tests_of
from ..calibration.mapping import carried
from ..core.data import Array, ImagePoints
from ..core.failure import Code, Failure
from ..io import ReseauDesign
from ..measure.fitting import beyond_chance, gross_errors, is_mirrored, reduce_mapping, residual_field
from ..optics import RationalPolynomial
from ..optics.composition import Similarity
from ..optics.displays import wong_display
from ..optics.field import SmoothField
from .camera import defining_marks
from .registration import Registration
from .rivals import Rivalry, rivals

_DATUM = ("A0", "A1", "A2", "B0", "B1", "B2")
"""Coefficients that absorb the errors of M, N and of the scales between the systems; never dropped."""


@dataclass(frozen=True, eq=False)
class InstrumentFit:
    """How the correction of an instrument was fitted.

    Parameters
    ----------
    elimination : Elimination
        The record of the tests of all coefficients; the remaining ones form the reduced model.
    points : ImagePoints
        Photo-coordinates of the rods in the common system, corrected for group A; the covariances are those
        of the measurement alone.
    target : ndarray (n, 2)
        The rods' coordinates there.
    check : ImagePoints
        Rods held out, in object coordinates.
    check_target : ndarray (c, 2)
        Their designed object coordinates.
    monomials : Elimination or None
        The same with one coefficient for every monomial (``A6.x3``, ``A6.xy2``): the reduced model at the end
        of the paper. None with too few rods.
    local : SmoothField or None
        Remaining residuals; see :func:`reseau.measure.fitting.residual_field`.
    displays : Rivalry or None
        Comparison of the polynomials (first) with Wong's display model (second), both with all coefficients;
        None with too few rods.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.refine import correct_camera
    >>> rods = regular_reseau(4, 4, 15.0, Mark(shape="disk", size=0.75))
    >>> images = ImagePoints.with_sigma(rods.ids, rods.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> camera = correct_camera(images, rods, model=RationalPolynomial.affine()).required()
    >>> fit = correct_instrument(images, rods, camera).required().fit
    >>> fit.adjustment.redundancy, len(fit.points), fit.local is None
    (16, 16, True)
    """

    elimination: Elimination
    points: ImagePoints
    target: Array
    check: ImagePoints
    check_target: Array
    monomials: Elimination | None
    local: SmoothField | None
    displays: Rivalry | None

    @property
    def adjustment(self) -> Adjustment:
        """With all coefficients, as the correction applies them."""
        return self.elimination.full

    def tests(self) -> tuple[dict[str, Any], ...]:
        """Tests of all coefficients as in the calibration file."""
        return tests_of(self.elimination)


@dataclass(frozen=True, eq=False)
class FittedInstrument(InstrumentCorrection):
    """The correction of an instrument, with the record of its fit.

    Parameters
    ----------
    fit : InstrumentFit, optional
        How the model was fitted.
    gross : tuple of str
        Rods that contradict the others, and were left out.
    enlarged : float
        Factor by which standard deviations of group B are larger than those of the rods make them, where
        residuals are beyond chance and no gross errors.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.refine import correct_camera
    >>> rods = regular_reseau(4, 4, 15.0, Mark(shape="disk", size=0.75))
    >>> images = ImagePoints.with_sigma(rods.ids, rods.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> camera = correct_camera(images, rods, model=RationalPolynomial.affine()).required()
    >>> instrument = correct_instrument(images, rods, camera).required()
    >>> bool(abs(instrument.apply(images).xy - rods.xy).max() < 1e-6), instrument.fit is None
    (True, False)
    """

    fit: InstrumentFit | None = None
    gross: tuple[str, ...] = ()
    enlarged: float = 1.0


def correct_instrument(
    points: ImagePoints,
    design: ReseauDesign,
    camera: CameraCorrection,
    *,
    model: RationalPolynomial | None = None,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "F",
    check: Iterable[str] = (),
    trials: int = 499,
    registration: Registration | None = None,
    shared: Array | None = None,
) -> FittedInstrument | Failure:
    """Correct an instrument by the rods of a test object (Wishahy, steps iv–vii).

    Parameters
    ----------
    points : ImagePoints
        Images of the rods in pixels, referred to PHOTO I.
    design : ReseauDesign
        The rods; `origin` and `axis` name M and N. The sigmas of its points are the rods' tolerance.
    camera : CameraCorrection
        Group A.
    model : RationalPolynomial, optional
        By default equations (7a, b).
    alpha : float
        Level of the tests of the coefficients; those not significant are dropped one by one.
    criterion : {"t", "chi2", "F"}
        The test.
    check : iterable of str
        Rods held out, for an independent check.
    trials : int
        Simulated sets of residuals for the test whether a local model is needed on top.
    registration : Registration, optional
        How the images were referred to PHOTO I; its errors, which they share, are part of the covariance.
    shared : ndarray (n, 2, k), optional
        Derivatives of the images by k errors of unit variance that all have in common, which their own
        covariances contain; see :class:`reseau.measure.PinDetections`.

    Returns
    -------
    FittedInstrument or Failure
        A failure when there are too few rods, or the adjustment fails.

    Notes
    -----
    Derived in ``docs/mathematics/group-b.md``.

    Examples
    --------
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> from reseau.refine import correct_camera
    >>> reseau, rods = (regular_reseau(5, 4, 15.0, Mark(shape="disk", size=1.0)) for _ in range(2))
    >>> seen = ImagePoints.with_sigma(reseau.ids, reseau.xy * [9.0, -9.0] + [800.0, 600.0], 0.01)
    >>> camera = correct_camera(seen, reseau, model=RationalPolynomial.affine()).required()
    >>> images = ImagePoints.with_sigma(rods.ids, rods.xy * [9.1, -9.2] + [790.0, 610.0], 0.01)
    >>> instrument = correct_instrument(images, rods, camera, trials=0).required()
    >>> bool(abs(instrument.apply(images).xy - rods.xy).max() < 1e-6)
    True
    """
    model = RationalPolynomial.ultrasonic() if model is None else model
    coordinates = {p.id: (p.x, p.y, p.sigma or 0.0) for p in design.points if p.x is not None}
    known = [name for name in points.names if name in coordinates]
    if shared is None:
        shared = np.zeros((len(points), 2, 0))
    all_shared = shared
    shared = shared[[name in coordinates for name in points.names]]
    if len(known) < 4:
        return Failure(
            f"{len(known)} of {len(points)} points are rods with coordinates in design {design.name!r}; "
            "four are needed at least",
            Code.TOO_FEW_POINTS,
        )
    rods = points.select(known)
    table = np.array([coordinates[name] for name in known], dtype=np.float64)
    # (vi) corrected for group A; (iv, v) object coordinates scaled, and into the common system
    refined = carried(camera.model, carried(camera.photo_system, rods))
    plane = object_plane(refined, table[:, :2], design)
    if isinstance(plane, Failure):
        return plane
    wrong = gross_errors(model, refined, plane.to_common(table[:, :2]), table[:, 2:] * plane.scale)
    if wrong.any():  # M or N may be one of them
        gross = tuple(name for name, bad in zip(known, wrong, strict=True) if bad)
        sound = ~np.isin(points.names, gross)
        found = correct_instrument(
            points.select(sound), design, camera, model=model, alpha=alpha, criterion=criterion, check=check,
            trials=trials, registration=registration, shared=all_shared[sound],
        )  # fmt: skip
        return found if isinstance(found, Failure) else replace(found, gross=gross + found.gross)
    target = plane.to_common(table[:, :2])
    used = ~np.isin(known, list(check))
    # (vii) equations (7a, b)
    fitted, sigma = refined.select(used), table[used, 2:] * plane.scale

    def reduced(model: RationalPolynomial) -> Elimination | Failure:
        return reduce_mapping(
            model,
            fitted,
            target[used],
            sigma,
            alpha=alpha,
            criterion=criterion,
            keep=[name for name in _DATUM if name in model.names],
            options=Options(scale="a-priori"),
        )

    elimination = reduced(model)
    if isinstance(elimination, Failure):
        return elimination
    monomials = reduced(model.split())
    fit = elimination.full
    full = model.with_values(fit.values)
    enlarged = max(fit.sigma0, 1.0) if beyond_chance(fit) else 1.0
    covariance = _joint_covariance(camera, rods.select(used), full, fit, registration, shared[used], enlarged)
    left = residual_field(full, fitted, target[used], full(fitted.xy) - target[used], sigma, trials)
    correction = FittedInstrument(
        camera,
        full,
        plane,
        covariance,
        design.unit,
        rods.select(used),
        LocalModel.where_needed(left),
        enlarged=enlarged,
    )
    displays = rivals(RationalPolynomial.ultrasonic(), wong_display(), fitted, target[used], sigma)
    record = InstrumentFit(
        elimination,
        fitted,
        target[used],
        correction.apply(rods.select(~used)),
        table[~used, :2],
        None if isinstance(monomials, Failure) else monomials,
        left,
        None if isinstance(displays, Failure) else displays,
    )
    return replace(correction, fit=record)


def _joint_covariance(
    camera: CameraCorrection,
    rods: ImagePoints,
    model: RationalPolynomial,
    fit: Adjustment,
    registration: Registration | None,
    shared: Array,
    enlarged: float,
) -> Array:
    """Covariance of the coefficients of both groups; the own errors of group B are enlarged by a factor.

    An error δ of the coefficients of group A changes the estimates of group B by −Q Aᵀ W G δ, with A and W
    the design matrix and the weights of its adjustment, Q its cofactor matrix and G the derivatives of its
    conditions by the coefficients of group A. The registration of the photograph follows them, which is part
    of G, and has errors of its own, which act in the same way. So do errors that the images share; Q contains
    them as if every image had its own.
    """
    photo, by_pixel, _ = camera.photo_system.derivatives(rods.xy)
    refined, by_photo, by_a = camera.model.derivatives(photo)
    _, by_refined, by_b = model.derivatives(refined)
    by_image = by_photo @ by_pixel
    cofactors = by_refined @ np.asarray(fit.problem.covariance) @ np.swapaxes(by_refined, 1, 2)
    weights = np.linalg.inv(cofactors)
    q_b = enlarged**2 * fit.cofactor

    def responses(conditions: Array) -> Array:
        return -fit.cofactor @ (by_b.swapaxes(1, 2) @ weights @ by_refined @ conditions)

    def response(conditions: Array) -> Array:
        return np.asarray(responses(conditions).sum(axis=0))

    common = None if registration is None else registration.moves(rods.xy)
    moved = response(by_a if common is None else by_a + by_image @ common)
    if registration is not None and registration.similar:
        own = response(by_image @ registration.by_parameters(rods.xy))
        q_b = q_b + own @ registration.cofactor @ own.T
    each = responses(by_image @ shared)
    together = each.sum(axis=0)
    q_b = q_b + together @ together.T - np.einsum("nbk,nck->bc", each, each)
    q_a = camera.cofactor
    cross = moved @ q_a
    return np.block([[q_a, cross.T], [cross, q_b + cross @ moved.T]])


def object_plane(refined: ImagePoints, plane: Array, design: ReseauDesign) -> ObjectPlane | Failure:
    """Scales λ1, λ2 and the system that M and N define."""
    ends = defining_marks(refined, plane, design)
    if isinstance(ends, Failure):
        return ends
    (m_image, m), (n_image, n) = ends
    mirrored = is_mirrored(plane, refined.xy)
    axes = Similarity.common_system(m, n, mirrored=mirrored)
    inverse = Similarity.common_system(m_image, n_image)
    local, seen = axes(plane), inverse(refined.xy)
    across = float(local[:, 1] @ local[:, 1])
    if not across > 0:
        return Failure(
            f"the rods of design {design.name!r} lie on one line with M and N; λ2 is undetermined",
            Code.COLLINEAR,
        )
    scale = np.array([np.hypot(*(n_image - m_image)) / np.hypot(*(n - m)), local[:, 1] @ seen[:, 1] / across])
    a, b = inverse.values[2:]
    system = Similarity(np.array([*m_image, a, -b]))
    return ObjectPlane(axes, scale, system)
