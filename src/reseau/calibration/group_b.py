"""Group B of an oscilloscope's photographs: from pixels to the plane of the object, both groups together.

Equations (7a, b) of Wishahy's paper as they are applied and stored; :mod:`reseau.refine` fits them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import numpy as np

from ..core.data import Array, ImagePoints
from ..core.errors import FormatError, UsageError
from ..core.failure import Estimated
from ..core.provenance import canonical_json
from ..io import ReseauDesign, ReseauMeasurement
from ..optics import RationalPolynomial
from ..optics.composition import Similarity
from .document import Calibration, Covariance, Quantity, readable_as
from .entries import system_from_dict, system_to_dict, unit_of, with_stored_values
from .group_a import GROUPS_A_AND_B, CameraCorrection, FitRecord
from .local_model import LocalModel
from .mapping import BEYOND, CalibratedMapping, Target, beyond, outside

_ROUNDS = 12


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


@dataclass(frozen=True, eq=False)
class InstrumentCorrection(Estimated, CalibratedMapping):
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
            "name": GROUPS_A_AND_B,
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


@readable_as("oscilloscope")
def mapping_of_oscilloscope(calibration: Calibration) -> CameraCorrection | InstrumentCorrection:
    """Groups A and B where the calibration has both, else group A."""
    if "instrument" in calibration.model:
        return InstrumentCorrection.from_calibration(calibration)[0]
    return CameraCorrection.from_calibration(calibration)
