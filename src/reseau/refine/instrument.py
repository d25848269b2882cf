"""The correction of an ultrasonic instrument by one frame of a test object: group B of Wishahy's procedure.

The rods' images, refined of group A, are held against the rods' coordinates, scaled to the photograph (λ1,
λ2) and carried into the common system by the rods M and N. What the two differ by is the instrument's doing:
the beam, the electronics, the display.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..adjust import Adjustment, Elimination, Options
from ..calibration.document import Calibration, Covariance, Quantity
from ..core.data import Array, ImagePoints
from ..core.errors import FormatError, UsageError
from ..core.failure import Code, Failure
from ..core.provenance import canonical_json
from ..io import ReseauDesign, ReseauMeasurement
from ..measure.fitting import carried, reduce_mapping, residual_field, tests_of
from ..optics import RationalPolynomial, wong_display
from ..optics.field import SmoothField
from .camera import CameraCorrection, system_from_dict, system_to_dict, unit_of, with_stored_values
from .local import LocalModel
from .plane import ObjectPlane, object_plane
from .rivals import Rivalry, rivals

__all__ = ["InstrumentCorrection", "InstrumentFit", "correct_instrument"]

_DATUM = ("A0", "A1", "A2", "B0", "B1", "B2")
"""Coefficients that take up the errors of M, N and the scales by which the systems are joined: they stay."""


@dataclass(frozen=True, eq=False)
class InstrumentFit:
    """How the correction of an instrument came about.

    Parameters
    ----------
    elimination : Elimination
        The record of the tests of all coefficients; what is left of them is the reduced model.
    points : ImagePoints
        Photo-coordinates of the rods in the common system, refined of group A; covariances of the measurement
        alone.
    target : ndarray (n, 2)
        The rods' coordinates there.
    check : ImagePoints
        Rods held out, in object coordinates.
    check_target : ndarray (c, 2)
        Their designed object coordinates.
    monomials : Elimination or None
        The same with a coefficient for every monomial (``A6.x3``, ``A6.xy2``): what remains is the reduced
        model of the paper's end. None where there are too few rods.
    local : SmoothField or None
        What the model leaves; see :func:`reseau.measure.fitting.residual_field`.
    displays : Rivalry or None
        The polynomials (first) beside Wong's display model (second), both with all their coefficients; None
        where there are too few rods for them.
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
class InstrumentCorrection:
    """From pixels to the object's plane, refined of group A and group B.

    Parameters
    ----------
    camera : CameraCorrection
        Group A.
    model : RationalPolynomial
        Group B: refined photo-coordinates to coordinates of the object, both in the common system. With all
        its coefficients: rods good to a quarter of a millimetre make many insignificant that are there all
        the same, and a coordinate without them would be wrong by more than its standard deviation says.
    plane : ObjectPlane
        Between the common system and object coordinates.
    covariance : ndarray (a + b, a + b)
        Of the coefficients of both groups, those of the camera first. Group B was fitted behind group A: what
        is wrong in the one is in part taken up by the other, and their covariance says how much.
    unit : str
        Of object coordinates.
    pins : ImagePoints
        Images of the rods that group B was made from, in pixels of PHOTO I: what a later photograph of the
        same rods is held against.
    local : LocalModel, optional
        What the rods show beyond the model, in the common system; None where it is not significant.
    fit : InstrumentFit, optional
        How the model came about; None for one read from a calibration.
    """

    camera: CameraCorrection
    model: RationalPolynomial
    plane: ObjectPlane
    covariance: Array
    unit: str
    pins: ImagePoints
    local: LocalModel | None = None
    fit: InstrumentFit | None = None

    def __bool__(self) -> bool:
        return True

    def required(self) -> InstrumentCorrection:
        """The correction itself; see :meth:`~reseau.core.failure.Failure.required`."""
        return self

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """Object coordinates of points in pixels (n, 2), and their derivatives without a local model's.

        Returns
        -------
        value : ndarray (n, 2)
        slope : ndarray (n, 2, 2)
            By the points.
        by_coefficients : ndarray (n, 2, a + b)
            By the coefficients of both groups, those of the camera first.
        """
        photo, by_pixel, _ = self.camera.photo_system.derivatives(xy)
        refined, by_photo, by_a = self.camera.model.derivatives(photo)
        common, by_refined, by_b = self.model.derivatives(refined)
        by_both = np.concatenate([by_refined @ by_a, by_b], axis=2)
        common = common if self.local is None else self.local.take_off(common)
        plane = self.plane.slope
        slope = plane @ by_refined @ by_photo @ by_pixel
        return self.plane.from_common(common), slope, plane @ by_both

    def apply(self, points: ImagePoints) -> ImagePoints:
        """True object coordinates of points in pixels (Wishahy, step viii), with propagated covariances."""
        value, slope, by_coefficients = self.derivatives(points.xy)
        cov = slope @ points.cov @ np.swapaxes(slope, 1, 2)
        cov = cov + by_coefficients @ self.covariance @ np.swapaxes(by_coefficients, 1, 2)
        if self.local is not None:
            cov = cov + self.plane.slope @ np.diag(self.local.variance) @ self.plane.slope.T
        return ImagePoints(points.names, value, cov)

    def calibration(
        self,
        reseau: ReseauDesign,
        rods: ReseauDesign,
        *,
        name: str,
        provenance: dict[str, Any] | None = None,
        times: dict[str, str] | None = None,
    ) -> Calibration:
        """The calibration file of both groups, with the designs that refer further photographs to it."""
        camera = self.camera.calibration(name=name, provenance=provenance, times=times)
        names = self.camera.model.names + self.model.names
        values = np.concatenate([self.camera.model.values, self.model.values])
        sigma = np.sqrt(np.diagonal(self.covariance))
        free = [i for i, s in enumerate(sigma) if s > 0]
        units = [camera.parameters[key].unit for key in self.camera.model.names]
        units += [unit_of(self.model, key, self.unit) for key in self.model.names]
        parameters = {
            key: Quantity(value=float(value), sigma=float(s), unit=unit)
            for key, value, s, unit in zip(names, values, sigma, units, strict=True)
        }
        matrix = tuple(tuple(map(float, row)) for row in self.covariance[np.ix_(free, free)])
        assert isinstance(camera.model, dict)
        instrument = {
            "mapping": self.model.to_dict(values=False),
            "unit": self.unit,
            "axes": system_to_dict(self.plane.axes),
            "scale": [float(s) for s in self.plane.scale],
            "system": system_to_dict(self.plane.system),
            "local": None if self.local is None else self.local.to_dict(),
            "rods": rods.to_dict(),
            "pins": ReseauMeasurement.from_image_points(self.pins, image="PHOTO II", sha256="").to_dict(),
        }
        both = camera.model | {
            "name": f"{camera.model['name']} and group B",
            "reseau": reseau.to_dict(),
            "instrument": instrument,
        }
        fit = self.fit
        return camera.model_copy(
            update={
                "model": both,
                "parameters": parameters,
                "covariance": Covariance(names=tuple(names[i] for i in free), matrix=matrix),
                "sigma0": camera.sigma0 if fit is None else float(fit.adjustment.sigma0),
                "redundancy": camera.redundancy if fit is None else fit.adjustment.redundancy,
                "tests": camera.tests + (() if fit is None else fit.tests()),
            }
        )

    @classmethod
    def from_calibration(
        cls, calibration: Calibration
    ) -> tuple[InstrumentCorrection, ReseauDesign, ReseauDesign]:
        """Read both groups back, with the designs of the reseau and of the rods.

        Raises
        ------
        FormatError
            When the calibration is not one of both groups.
        """
        camera, where = CameraCorrection.from_calibration(calibration), f"calibration {calibration.name}"
        content = calibration.model
        if not isinstance(content, dict) or "instrument" not in content:
            raise FormatError(
                "holds the camera alone", where=where, do="make it with a PHOTO II and its test object"
            )
        try:
            part = content["instrument"]
            model = with_stored_values(RationalPolynomial.from_dict(part["mapping"]), calibration)
            axes, system = (system_from_dict(part[key]) for key in ("axes", "system"))
            plane = ObjectPlane(axes, np.array([float(s) for s in part["scale"]]), system)
            row_of = {key: i for i, key in enumerate(calibration.parameters)}
            order = [row_of[key] for key in camera.model.names + model.names]
            unit = str(part["unit"])
            local = None if part["local"] is None else LocalModel.from_dict(part["local"])
            pins = ReseauMeasurement.parse(canonical_json(part["pins"]), where=where).image_points()
            designs = [
                ReseauDesign.parse(canonical_json(holder[key]), where=where)
                for holder, key in ((content, "reseau"), (part, "rods"))
            ]
        except (KeyError, TypeError, ValueError, UsageError) as error:
            raise FormatError(f"lacks or misstates {error}", where=f"model of {where}") from None
        covariance = calibration.matrix()[np.ix_(order, order)]
        return cls(camera, model, plane, covariance, unit, pins, local), designs[0], designs[1]


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
) -> InstrumentCorrection | Failure:
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

    Returns
    -------
    InstrumentCorrection or Failure
        A failure when there are too few rods, or the adjustment fails.
    """
    model = RationalPolynomial.ultrasonic() if model is None else model
    coordinates = {p.id: (p.x, p.y, p.sigma or 0.0) for p in design.points if p.x is not None}
    known = [name for name in points.names if name in coordinates]
    if len(known) < 4:
        return Failure(
            f"{len(known)} of {len(points)} points are rods with coordinates in design {design.name!r}; "
            "four are needed at least",
            Code.TOO_FEW_POINTS,
        )
    rods = points.select(known)
    table = np.array([coordinates[name] for name in known], dtype=np.float64)
    # (vi) refined of group A; (iv, v) object coordinates scaled, and into the common system
    refined = carried(camera.model, carried(camera.photo_system, rods))
    plane = object_plane(refined, table[:, :2], design)
    if isinstance(plane, Failure):
        return plane
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
    covariance = _joint_covariance(camera, rods.select(used), full, fit)
    left = residual_field(full, fitted, target[used], full(fitted.xy) - target[used], sigma, trials)
    correction = InstrumentCorrection(
        camera,
        full,
        plane,
        covariance,
        design.unit,
        rods.select(used),
        LocalModel.where_needed(left),
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
    camera: CameraCorrection, rods: ImagePoints, model: RationalPolynomial, fit: Adjustment
) -> Array:
    """Covariance of the coefficients of both groups.

    Group B's estimates follow an error δ of group A's by −Q Aᵀ W G δ, with A and W the design and the weights
    of its adjustment, Q its cofactor matrix and G the derivatives of its conditions by group A's
    coefficients.
    """
    photo = camera.photo_system(rods.xy)
    refined, _, by_a = camera.model.derivatives(photo)
    _, by_refined, by_b = model.derivatives(refined)
    conditions = by_refined @ by_a
    cofactors = by_refined @ np.asarray(fit.problem.covariance) @ np.swapaxes(by_refined, 1, 2)
    weights = np.linalg.inv(cofactors)
    q_b = fit.cofactor
    moved = -q_b @ np.einsum("nib,nij,nja->ba", by_b, weights, conditions)
    q_a = camera.cofactor
    cross = moved @ q_a
    return np.block([[q_a, cross.T], [cross, q_b + cross @ moved.T]])
