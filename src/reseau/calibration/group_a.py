"""Group A of an oscilloscope's photographs: from pixels to the plane of the reseau.

Equations (5a, b) of Wishahy's paper as they are applied and stored; :mod:`reseau.refine` fits them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol, Self, cast

import numpy as np

from ..adjust import Adjustment
from ..core.data import Array, ImagePoints
from ..core.errors import FormatError, UsageError
from ..core.failure import Estimated
from ..optics import RationalPolynomial
from ..optics.composition import Similarity
from .document import Calibration, Covariance, OscilloscopeModel, Quantity
from .entries import system_from_dict, system_to_dict, unit_of, with_stored_values
from .mapping import CalibratedMapping, Target, carried, extent_of, reasons

GROUP_A: Final = "oscilloscope group A"
GROUPS_A_AND_B = f"{GROUP_A} and group B"
"""Names of the models in calibration files."""


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
        return cross + cross.T + self.influence @ self.covariance @ self.influence.T

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
class CameraCorrection(Estimated, CalibratedMapping):
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
            "name": GROUP_A,
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
        if not isinstance(content, dict) or content.get("name") not in (GROUP_A, GROUPS_A_AND_B):
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
        except (KeyError, TypeError, ValueError, UsageError, FormatError) as error:
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
