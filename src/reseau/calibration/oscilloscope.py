"""Groups A and B of an oscilloscope's photographs: from pixels to the reseau and to the object's plane.

Equations (5a, b) and (7a, b) of Wishahy's paper as they are applied and stored;
:mod:`reseau.refine` fits them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, cast

import numpy as np

from ..adjust import Adjustment, Elimination
from ..core.data import Array, ImagePoints
from ..core.errors import FormatError, UsageError
from ..core.provenance import canonical_json
from ..io import ReseauDesign, ReseauMeasurement
from ..optics import RationalPolynomial, Similarity
from ..optics.field import SmoothField
from ..optics.polynomials import monomials
from .document import Calibration, Covariance, OscilloscopeModel, Quantity, readable_as
from .mapping import BEYOND, CalibratedMapping, Target, beyond, carried, extent_of, outside, reasons

__all__ = [
    "CameraCorrection",
    "Datum",
    "FitRecord",
    "InstrumentCorrection",
    "LocalModel",
    "ObjectPlane",
    "tests_of",
    "unit_of",
]

_MODEL = "oscilloscope group A"
_MODELS = (_MODEL, f"{_MODEL} and group B")
_ROUNDS = 12


class FitRecord(Protocol):
    """How a correction was fitted, as far as its calibration file says."""

    @property
    def adjustment(self) -> Adjustment:
        """With the coefficients that are applied."""

    @property
    def target(self) -> Array:
        """Coordinates (n, 2) of the marks that it was fitted to, in the common system."""

    def tests(self) -> tuple[dict[str, Any], ...]:
        """Tests of the coefficients as in the calibration file."""


@dataclass(frozen=True, eq=False)
class Datum:
    """Errors δ of the marks O and S, which define the common system, and their effect on the coefficients.

    Coefficients refer to the system of the *measured* O and S, in which their errors have the covariance Q.
    Compared with the coefficients of the system of the true O and S, they are also off by J δ:
    Q + J Kᵀ + K Jᵀ + J Σ Jᵀ is the covariance matrix of all these errors. Corrected coordinates do not depend
    on δ.

    Parameters
    ----------
    influence : ndarray (u, 4)
        J, derivatives of the coefficients by the positions of O and S in the common system.
    shared : ndarray (u, 4)
        K, covariance of the coefficients' errors in the measured system with δ.
    covariance : ndarray (4, 4)
        Σ, of δ.

    Examples
    --------
    >>> datum = Datum(np.eye(4), np.zeros((4, 4)), 0.01 * np.eye(4))
    >>> datum.added.diagonal()
    array([0.01, 0.01, 0.01, 0.01])
    """

    influence: Array
    shared: Array
    covariance: Array

    @property
    def added(self) -> Array:
        """What it adds to the covariance matrix of the coefficients, (u, u)."""
        cross = self.influence @ self.shared.T
        added: Array = cross + cross.T + self.influence @ self.covariance @ self.influence.T
        return added

    def to_dict(self) -> dict[str, Any]:
        """As JSON-ready data."""
        return {
            "influence": self.influence.tolist(),
            "shared": self.shared.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Read back; KeyError, TypeError or ValueError where something is missing or wrong."""
        keys = ("influence", "shared", "covariance")
        return cls(*(np.array(content[key], dtype=np.float64).reshape(-1, 4) for key in keys))


@dataclass(frozen=True, eq=False)
class CameraCorrection(CalibratedMapping):
    """From pixels to the plane of the reseau, corrected for lens distortion and film deformation.

    Parameters
    ----------
    model : RationalPolynomial
        Photo-coordinates to coordinates of the reseau, both in the common system, mm.
    cofactor : ndarray (u, u)
        Covariance matrix of the model's parameters in `photo_system`, which counts as free of error: a priori
        after χ² tests, else a posteriori. Corrected coordinates have it.
    photo_system : Similarity
        Pixels into the common system: scaled to the reseau, of the handedness of its design.
    object_system : Similarity
        Coordinates of the design into the common system.
    unit : str
        Of the design.
    fit : FitRecord, optional
        How the model was fitted; None for one read from a calibration.
    extent : tuple of float, optional
        Left, low, right and high end of the marks it was fitted to, in the common system.
    size : (int, int), optional
        Width and height of the photograph in pixels.
    datum : Datum, optional
        Errors of the marks that define `photo_system`; None where they are not known.

    Examples
    --------
    >>> model = RationalPolynomial.camera().with_values({"k": 1e-6})
    >>> into_mm = Similarity(np.array([-50.0, 40.0, 0.1, 0.0]), mirrored=True)
    >>> camera = CameraCorrection(model, np.zeros((13, 13)), into_mm, Similarity(), "mm")
    >>> camera.apply(ImagePoints.with_sigma(["a"], [[900.0, 400.0]], 0.1)).xy.round(3)
    array([[40.064,  0.   ]])
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("points", "images")
    system: ClassVar[str] = "common"

    model: RationalPolynomial
    cofactor: Array
    photo_system: Similarity
    object_system: Similarity
    unit: str
    fit: FitRecord | None = None
    extent: tuple[float, ...] | None = None
    size: tuple[int, int] | None = None
    datum: Datum | None = None

    def __bool__(self) -> bool:
        return True

    def required(self) -> Self:
        """The correction itself; see :meth:`reseau.core.failure.Failure.required`."""
        return self

    @property
    def parameter_covariance(self) -> Array:
        """That of the model's parameters in the system of the measured O and S."""
        return self.cofactor

    @property
    def coefficient_covariance(self) -> Array:
        """Covariance matrix (u, u) of the coefficients with the errors of the marks O and S."""
        return self.cofactor if self.datum is None else self.cofactor + self.datum.added

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """See :meth:`CalibratedMapping.derivatives`."""
        photo, by_pixel, _ = self.photo_system.derivatives(xy)
        value, slope, by_parameters = self.model.derivatives(photo)
        return value, slope @ by_pixel, by_parameters

    def apply(self, points: ImagePoints) -> ImagePoints:
        """Correct measured points.

        Parameters
        ----------
        points : ImagePoints
            In pixels.

        Returns
        -------
        ImagePoints
            In the common system, in the unit of the design. The covariances contain those of the points and
            of the model. For points that the model was fitted to, the two are correlated, which is left out.
            What the model cannot follow is not included: see `CorrectionFit.local` and the global test.
        """
        photo = carried(self.photo_system, points)
        value, slope, by_parameter = self.model.derivatives(photo.xy)
        cov = slope @ photo.cov @ np.swapaxes(slope, 1, 2)
        cov = cov + by_parameter @ self.cofactor @ np.swapaxes(by_parameter, 1, 2)
        return ImagePoints(points.names, value, cov)

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) at which points of the common system appear; NaN where the model has no inverse."""
        return self.photo_system.inverse(self.model.inverse(xy))

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        one = self.model.one_to_one(self.photo_system(xy))
        return reasons(self.extent, mapped, np.where(one[:, None], mapped, np.nan), "the marks")

    def calibration(
        self, *, name: str, provenance: dict[str, Any] | None = None, times: dict[str, str] | None = None
    ) -> Calibration:
        """The calibration file; `CameraCorrection.from_calibration` reads it back."""
        covariance = self.coefficient_covariance
        sigma = np.sqrt(np.diagonal(covariance))
        free = [i for i, s in enumerate(sigma) if s > 0]
        names = self.model.names
        model: OscilloscopeModel = {
            "name": "oscilloscope group A",
            "unit": self.unit,
            "mapping": self.model.to_dict(values=False),
            "photo_system": system_to_dict(self.photo_system),
            "object_system": system_to_dict(self.object_system),
        }
        if self.datum is not None:
            model["datum"] = self.datum.to_dict() | {"in_system": self.cofactor.tolist()}
        parameters = {
            key: Quantity(value=float(value), sigma=float(s), unit=unit_of(self.model, key, self.unit))
            for key, value, s in zip(names, self.model.values, sigma, strict=True)
        }
        matrix = covariance[np.ix_(free, free)]
        return Calibration(
            kind="oscilloscope",
            name=name,
            model=model,
            parameters=parameters,
            covariance=Covariance(
                names=tuple(names[i] for i in free), matrix=tuple(tuple(map(float, row)) for row in matrix)
            ),
            sigma0=None if self.fit is None else float(self.fit.adjustment.sigma0),
            redundancy=0 if self.fit is None else self.fit.adjustment.redundancy,
            tests=() if self.fit is None else self.fit.tests(),
            validity=self.validity,
            provenance=provenance or {},
            times=times or {},
        )

    @property
    def validity(self) -> dict[str, Any]:
        """Where the correction holds, as in the calibration file."""
        found: dict[str, Any] = {}
        if self.extent is not None:
            found["extent"] = list(self.extent)
        if self.fit is not None:
            found["marks"] = len(self.fit.target)
        if self.size is not None:
            found["size"] = list(self.size)
        return found

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """Read a correction back from its file.

        Raises
        ------
        FormatError
            When the calibration is of another kind.
        """
        content = cast(dict[str, Any], calibration.model)
        if not isinstance(content, dict) or content.get("name") not in _MODELS:
            raise FormatError(calibration.not_of("oscilloscope"), where=f"calibration {calibration.name}")
        try:
            model = with_stored_values(RationalPolynomial.from_dict(content["mapping"]), calibration)
            systems = [system_from_dict(content[key]) for key in ("photo_system", "object_system")]
            unit = str(content["unit"])
            row_of = {name: i for i, name in enumerate(calibration.parameters)}
            order = [row_of[name] for name in model.names]
            datum, cofactor = None, calibration.matrix()[np.ix_(order, order)]
            if content.get("datum") is not None:
                u = len(order)
                datum = Datum.from_dict(content["datum"])
                cofactor = np.array(content["datum"]["in_system"], dtype=np.float64)[:u, :u]
                if cofactor.shape != (u, u) or len(datum.influence) != u:
                    raise ValueError(f"datum of {len(datum.influence)} instead of {u} coefficients")
        except (KeyError, TypeError, ValueError, UsageError) as error:
            raise FormatError(
                f"has a damaged or missing entry: {error}", where=f"model of calibration {calibration.name}"
            ) from None
        size = calibration.validity.get("size")
        return cls(
            model,
            cofactor,
            systems[0],
            systems[1],
            unit,
            extent=extent_of(calibration.validity),
            size=None if size is None else (int(size[0]), int(size[1])),
            datum=datum,
        )


@dataclass(frozen=True, eq=False)
class ObjectPlane:
    """Coordinates of the test object and the common system.

    Parameters
    ----------
    axes : Similarity
        Object coordinates into the system of the rods M (origin) and N (on the axis), unscaled.
    scale : ndarray (2,)
        λ1 and λ2: of the photograph along that axis and across it.
    system : Similarity
        The scaled system into the common one: M to its image M', N to N'.

    Examples
    --------
    >>> plane = ObjectPlane(Similarity(), np.array([0.5, 0.4]), Similarity())
    >>> plane.to_common(np.array([[10.0, 10.0]]))
    array([[5., 4.]])
    """

    axes: Similarity
    scale: Array
    system: Similarity

    def to_common(self, xy: Array) -> Array:
        """Object coordinates (n, 2) in the common system."""
        return self.system(self.axes(xy) * self.scale)

    def from_common(self, xy: Array) -> Array:
        """Coordinates of the common system (n, 2) as object coordinates."""
        return self.axes.inverse(self.system.inverse(xy) / self.scale)

    @property
    def slope(self) -> Array:
        """Derivatives of `from_common`, (2, 2); the same everywhere."""
        ends = self.from_common(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return np.stack([ends[1] - ends[0], ends[2] - ends[0]], axis=1)

    @property
    def rotation(self) -> float:
        """Angle (rad) from the x-axis of the common system to that of the object."""
        along = self.to_common(np.array([[0.0, 0.0], [1.0, 0.0]]))
        return float(np.arctan2(*(along[1] - along[0])[::-1]))


_ALPHA = 0.01
"""Level, per axis, at which a local model must be significant: subtracted without need, it adds noise."""


@dataclass(frozen=True, eq=False)
class LocalModel:
    """Collocation of the residuals of a mapping: what a polynomial leaves and is not noise.

    Parameters
    ----------
    field : SmoothField
        Mapped minus target, over the targets.
    needed : (bool, bool)
        The axes in which it is subtracted.

    Examples
    --------
    >>> at = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    >>> left = LocalModel.from_dict({"at": at.tolist(), "left": (0 * at + 0.1).tolist(), "degree": 0,
    ...                              "needed": [True, False]})
    >>> left.subtract(np.array([[2.0, 2.0]])).round(3)
    array([[1.9, 2. ]])
    """

    field: SmoothField
    needed: tuple[bool, bool]

    @classmethod
    def where_needed(cls, field: SmoothField | None, alpha: float = _ALPHA) -> Self | None:
        """The model if it is significant in at least one axis, else None."""
        if field is None or not (field.need < alpha).any():
            return None
        return cls(field, (bool(field.need[0] < alpha), bool(field.need[1] < alpha)))

    def subtract(self, xy: Array) -> Array:
        """Mapped points (n, 2) minus the local model there."""
        return xy - self.field(xy) * self.needed

    @property
    def variance(self) -> Array:
        """Variance (2,) of what is subtracted: of a prediction from the other points, without their noise."""
        _, sigma = self.field.leave_one_out()
        noise = self.field.noise * self.field.sigma[:, None]
        variance: Array = np.maximum(sigma**2 - noise**2, 0).mean(axis=0) * self.needed
        return variance

    def to_dict(self) -> dict[str, Any]:
        """The points that it interpolates; fitted again, they give the same field."""
        return {
            "at": self.field.source.tolist(),
            "left": self.field.target.tolist(),
            "sigma": self.field.sigma.tolist(),
            "degree": self.field.degree,
            "needed": list(self.needed),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Read back; KeyError, TypeError or ValueError where something is missing or wrong."""
        at, left = (np.array(content[key], dtype=np.float64).reshape(-1, 2) for key in ("at", "left"))
        sigma = np.array(content.get("sigma", np.ones(len(at))), dtype=np.float64)  # earlier files have none
        x, y = (bool(axis) for axis in content["needed"])
        return cls(SmoothField.fit(at, left, sigma=sigma, degree=int(content["degree"])), (x, y))


@dataclass(frozen=True, eq=False)
class InstrumentCorrection(CalibratedMapping):
    """From pixels to the object's plane, corrected for group A and group B.

    Parameters
    ----------
    camera : CameraCorrection
        Group A.
    model : RationalPolynomial
        Group B: photo-coordinates corrected for group A to coordinates of the object, both in the common
        system. It keeps all its coefficients: rods known to a quarter of a millimetre make many of them
        insignificant, but without them a coordinate would be wrong by more than its standard deviation.
    plane : ObjectPlane
        Between the common system and object coordinates.
    covariance : ndarray (a + b, a + b)
        Of the coefficients of both groups, those of the camera first, in the camera's `photo_system`. Group B
        was fitted after group A and absorbs part of its errors; their covariance says how much.
    unit : str
        Of object coordinates.
    pins : ImagePoints
        Images of the rods that group B was fitted to, in pixels of PHOTO I; a later photograph of the same
        rods is compared with them.
    local : LocalModel, optional
        What the rods show beyond the model, in the common system; None where it is not significant.
    fit : FitRecord, optional
        How the model was fitted; None for one read from a calibration.

    Examples
    --------
    >>> into_mm = Similarity(np.array([-50.0, 40.0, 0.1, 0.0]), mirrored=True)
    >>> camera = CameraCorrection(
    ...     RationalPolynomial.camera(), np.zeros((13, 13)), into_mm, Similarity(), "mm")
    >>> plane = ObjectPlane(Similarity(), np.array([0.5, 0.5]), Similarity())
    >>> pins = ImagePoints.with_sigma([], np.zeros((0, 2)), 0.0)
    >>> group_b = RationalPolynomial.ultrasonic()
    >>> instrument = InstrumentCorrection(camera, group_b, plane, np.zeros((29, 29)), "mm", pins)
    >>> instrument.apply(ImagePoints.with_sigma(["a"], [[900.0, 400.0]], 0.1)).xy.round(3)
    array([[80.,  0.]])
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("points",)
    system: ClassVar[str] = "object"

    camera: CameraCorrection
    model: RationalPolynomial
    plane: ObjectPlane
    covariance: Array
    unit: str
    pins: ImagePoints
    local: LocalModel | None = None
    fit: FitRecord | None = None

    def __bool__(self) -> bool:
        return True

    def required(self) -> Self:
        """The correction itself; see :meth:`reseau.core.failure.Failure.required`."""
        return self

    @property
    def size(self) -> tuple[int, int] | None:
        """That of the photograph that the camera was calibrated with."""
        return self.camera.size

    @property
    def parameter_covariance(self) -> Array:
        """That of the coefficients of both groups in the system of the measured O and S."""
        return self.covariance

    @property
    def coefficient_covariance(self) -> Array:
        """Covariance matrix of the coefficients of both groups with the errors of the marks O and S.

        Group B starts from corrected coordinates, which do not depend on these errors. With group A it has in
        common what it absorbed of the errors of PHOTO I.
        """
        datum, a = self.camera.datum, len(self.camera.model.names)
        if datum is None:
            return self.covariance
        found = self.covariance.copy()
        sigma = np.sqrt(np.diagonal(self.camera.cofactor))
        sigma = np.where(sigma > 0, sigma, 1.0)[
            :, None
        ]  # columns of one size: the smallest ones count as well
        correlation = self.camera.cofactor / (sigma * sigma.T)
        absorbed = np.linalg.pinv(correlation, hermitian=True) @ (found[:a, a:] / sigma) / sigma
        found[:a, a:] += datum.influence @ datum.shared.T @ absorbed
        found[a:, :a] = found[:a, a:].T
        found[:a, :a] += datum.added
        return found

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) at which points of the object appear; NaN where a model has no inverse."""
        common = self.plane.to_common(xy)
        if self.local is None:
            return self.camera.to_pixels(self.model.inverse(common))
        raised = common
        for _ in range(_ROUNDS):  # a local model is small and smooth: the iteration contracts
            raised = common + (raised - self.local.subtract(raised))
        return self.camera.to_pixels(self.model.inverse(raised))

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        of_the_camera = self.camera.why_not(ImagePoints.with_sigma(map(str, range(len(xy))), xy, 0.0))
        past = beyond(self._rods, mapped)
        return [
            why or (outside("the rods", p) if p > BEYOND else "")
            for why, p in zip(of_the_camera, past.tolist(), strict=True)
        ]

    @property
    def _rods(self) -> tuple[float, ...] | None:
        """Extent of the rods that it was fitted to, object coordinates."""
        if not len(self.pins):
            return None
        xy = self.apply(self.pins).xy
        return (*map(float, xy.min(axis=0)), *map(float, xy.max(axis=0)))

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """Object coordinates of pixels (n, 2), and their derivatives without those of a local model.

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
        common = common if self.local is None else self.local.subtract(common)
        plane = self.plane.slope
        slope = plane @ by_refined @ by_photo @ by_pixel
        return self.plane.from_common(common), slope, plane @ by_both

    def apply(self, points: ImagePoints, by_camera: Array | None = None) -> ImagePoints:
        """True object coordinates of points in pixels (Wishahy, step viii), with propagated covariances.

        Parameters
        ----------
        points : ImagePoints
            In pixels of PHOTO I.
        by_camera : ndarray (n, 2, a), optional
            Derivatives of the points by the coefficients of group A, where these referred them to PHOTO I.
        """
        value, slope, by_coefficients = self.derivatives(points.xy)
        if by_camera is not None:
            by_coefficients[:, :, : by_camera.shape[2]] += slope @ by_camera
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
        covariance = self.coefficient_covariance
        sigma = np.sqrt(np.diagonal(covariance))
        free = [i for i, s in enumerate(sigma) if s > 0]
        units = [camera.parameters[key].unit for key in self.camera.model.names]
        units += [unit_of(self.model, key, self.unit) for key in self.model.names]
        parameters = {
            key: Quantity(value=float(value), sigma=float(s), unit=unit)
            for key, value, s, unit in zip(names, values, sigma, units, strict=True)
        }
        matrix = tuple(tuple(map(float, row)) for row in covariance[np.ix_(free, free)])
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
        both = cast(dict[str, Any], camera.model) | {
            "name": _MODELS[1],
            "reseau": reseau.to_dict(),
            "instrument": instrument,
        }
        if self.camera.datum is not None:
            both["datum"] = self.camera.datum.to_dict() | {"in_system": self.covariance.tolist()}
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
    def from_calibration(cls, calibration: Calibration) -> tuple[Self, ReseauDesign, ReseauDesign]:
        """Read both groups back, with the designs of the reseau and of the rods.

        Raises
        ------
        FormatError
            When the calibration is not one of both groups.
        """
        camera, where = CameraCorrection.from_calibration(calibration), f"calibration {calibration.name}"
        content = cast(dict[str, Any], calibration.model)
        if "instrument" not in content:
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
            raise FormatError(f"has a damaged or missing entry: {error}", where=f"model of {where}") from None
        covariance = calibration.matrix()[np.ix_(order, order)]
        if camera.datum is not None:
            covariance = np.array(content["datum"]["in_system"], dtype=np.float64)
            if covariance.shape != (len(order), len(order)):
                raise FormatError(f"has a covariance of {covariance.shape}", where=f"datum of {where}")
        return cls(camera, model, plane, covariance, unit, pins, local), designs[0], designs[1]


def tests_of(elimination: Elimination) -> tuple[dict[str, Any], ...]:
    """Tests of every coefficient, dropped ones first in their order, as in a calibration file."""
    dropped = [(step.test, "dropped") for step in elimination.steps]
    kept = [(test, "kept") for test in elimination.kept]
    return tuple(
        {
            "parameter": test.name,
            "distribution": test.distribution,
            "statistic": float(test.statistic),
            "critical": float(test.critical),
            "p": float(test.p),
            "verdict": verdict,
        }
        for test, verdict in dropped + kept
    )


def with_stored_values(model: RationalPolynomial, calibration: Calibration) -> RationalPolynomial:
    """The model with its values in a calibration file, which may hold those of other models too."""
    values = calibration.values()
    return model.with_values(np.array([values[name] for name in model.names]))


def unit_of(model: RationalPolynomial, name: str, unit: str) -> str:
    """Unit of a coefficient: that of X over the power of its monomials."""
    part, text = next(iter(model.terms[name].items()))
    exponent = (0 if part == "D" else 1) - max(i + j for i, j in monomials(text))
    return "1" if exponent == 0 else unit if exponent == 1 else f"{unit}^{exponent}"


def system_to_dict(system: Similarity) -> dict[str, Any]:
    """A similarity as JSON-ready data."""
    values = dict(zip(system.names, map(float, system.values), strict=True))
    return values | {"mirrored": system.mirrored}


def system_from_dict(content: dict[str, Any]) -> Similarity:
    """Read what :func:`system_to_dict` wrote."""
    values = np.array([float(content[name]) for name in Similarity.names])
    return Similarity(values, bool(content["mirrored"]))


@readable_as("oscilloscope")
def mapping_of_oscilloscope(calibration: Calibration) -> CameraCorrection | InstrumentCorrection:
    """Groups A and B where the calibration has both, else group A."""
    if "instrument" in calibration.model:
        return InstrumentCorrection.from_calibration(calibration)[0]
    return CameraCorrection.from_calibration(calibration)
