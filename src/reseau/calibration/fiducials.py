"""A scanned photograph: from pixels of the scan to millimetres of its camera, by fiducial marks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import numpy as np

from ..core.data import Array
from ..core.errors import FormatError, UsageError
from ..io import FiducialOrientation
from ..optics import RationalPolynomial
from .document import Calibration, Covariance, FiducialModel, Quantity, readable_as
from .film import TRANSFORMS
from .mapping import CalibratedMapping, Target, reasons


def film_axes(rotation: int, mirrored: bool) -> Array:
    """Mapping (2, 2) from camera coordinates (x right, y up) to pixels (y down) at 1 px/mm.

    Parameters
    ----------
    rotation : {0, 90, 180, 270}
        Direction of the camera's x-axis in the scan, degrees counter-clockwise; in a mirrored scan, after
        left and right were exchanged.
    mirrored : bool
        Whether the scan shows the film from behind.

    Examples
    --------
    >>> film_axes(90, False)
    array([[ 0., -1.],
           [-1.,  0.]])
    """
    c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[rotation // 90]
    side = np.diag([-1.0 if mirrored else 1.0, -1.0])
    return np.asarray(side @ np.array([[c, -s], [s, c]]) + 0.0)


def scan_coordinates(
    xy: Array, size: tuple[int, int], px_per_mm: float, rotation: int, mirrored: bool
) -> Array:
    """Scan coordinates (mm) of pixels (n, 2): origin in the centre of the scan, axes as those of the camera.

    Examples
    --------
    >>> corner, size = np.array([[-0.5, -0.5]]), (200, 100)
    >>> scan_coordinates(corner, size, 10.0, 0, False), scan_coordinates(corner, size, 10.0, 90, False)
    (array([[-10.,   5.]]), array([[ 5., 10.]]))
    """
    centre = (np.array(size) - 1) / 2
    return np.asarray((xy - centre) @ film_axes(rotation, mirrored) / px_per_mm)


def scan_pixels(uv: Array, size: tuple[int, int], px_per_mm: float, rotation: int, mirrored: bool) -> Array:
    """Pixels of scan coordinates (n, 2) in mm: the inverse of :func:`scan_coordinates`.

    Examples
    --------
    >>> scan_pixels(np.array([[5.0, 10.0]]), (200, 100), 10.0, 90, False)
    array([[-0.5, -0.5]])
    """
    return np.asarray(uv @ (px_per_mm * film_axes(rotation, mirrored)).T + (np.array(size) - 1) / 2)


@dataclass(frozen=True, eq=False)
class FiducialMapping(CalibratedMapping):
    """The inner orientation of a scanned photograph by its fiducial marks.

    Parameters
    ----------
    transform : RationalPolynomial
        From scan coordinates to those of the camera, both in mm.
    covariance : ndarray (u, u)
        Of its parameters.
    size : (int, int)
        Width and height of the scan, pixels.
    scale : float
        Pixels per mm by which scan coordinates are defined.
    rotation, mirrored : int, bool
        See :func:`film_axes`.
    extent : (float, float, float, float)
        Left, low, right and high end of the picture, mm.

    Examples
    --------
    >>> identity = RationalPolynomial.affine().with_values(np.array([1.0, 0, 0, 0, 1.0, 0]))
    >>> extent = (-115.0, -115.0, 115.0, 115.0)
    >>> photo = FiducialMapping(identity, np.zeros((6, 6)), (2300, 2300), 10.0, 0, False, extent)
    >>> photo.to_pixels(np.array([[0.0, 0.0], [100.0, 50.0]]))
    array([[1149.5, 1149.5],
           [2149.5,  649.5]])
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("points", "images", "scans")
    system: ClassVar[str] = "photo"
    unit: ClassVar[str] = "mm"

    transform: RationalPolynomial
    covariance: Array
    size: tuple[int, int]
    scale: float
    rotation: int
    mirrored: bool
    extent: tuple[float, float, float, float]

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """Pixels of the scan per mm along the camera's axes, in the middle of the photograph."""
        slope = np.linalg.inv(self.derivatives(self.to_pixels(np.zeros((1, 2))))[1][0])
        x, y = np.hypot(*slope)
        return float(x), float(y)

    @property
    def parameter_covariance(self) -> Array:
        """Of the parameters of the transformation."""
        return self.covariance

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """See :meth:`CalibratedMapping.derivatives`."""
        uv = scan_coordinates(xy, self.size, self.scale, self.rotation, self.mirrored)
        value, by_scan, by_parameters = self.transform.derivatives(uv)
        return value, by_scan @ (film_axes(self.rotation, self.mirrored).T / self.scale), by_parameters

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) of camera coordinates (n, 2) in mm; NaN where the transformation has no inverse."""
        uv = np.asarray(self.transform.inverse(xy))
        return scan_pixels(uv, self.size, self.scale, self.rotation, self.mirrored)

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        return reasons(self.extent, mapped, mapped, "the picture")

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """Read the orientation from its calibration.

        Raises
        ------
        FormatError
            When the calibration is of another kind, or damaged.
        """
        where = f"calibration {calibration.name}"
        if calibration.kind != "fiducials":
            raise FormatError(calibration.not_of("fiducials"), where=where)
        model, values = cast(dict[str, Any], calibration.model), calibration.values()
        try:
            transform = TRANSFORMS[model["transform"]]
            transform = transform.with_values(np.array([values[name] for name in transform.names]))
            left, low, right, high = map(float, calibration.validity["extent"])
            width, height = map(int, calibration.validity["size"])
            return cls(
                transform,
                calibration.matrix(),
                (width, height),
                float(model["px_per_mm"]),
                int(model["rotation_deg"]),
                bool(model["mirrored"]),
                (left, low, right, high),
            )
        except (KeyError, TypeError, ValueError, UsageError) as error:
            raise FormatError(f"has a damaged or missing entry: {error}", where=where) from None


readable_as("fiducials")(FiducialMapping.from_calibration)


def calibration_of_fiducials(
    orientation: FiducialOrientation, *, name: str | None = None, provenance: dict[str, Any] | None = None
) -> Calibration:
    """The calibration file of a photograph, from its orientation by fiducial marks.

    Parameters
    ----------
    orientation : FiducialOrientation
        A photograph that was oriented (``reseau-fiducials/1``).
    name : str, optional
        Name of the calibration; by default that of the scan.
    provenance : dict, optional
        Its inputs, options and version.

    Raises
    ------
    FormatError
        When the photograph was declined.

    Examples
    --------
    >>> values = dict(a1=1.0, b1=0.0, c1=0.0, a2=0.0, b2=1.0, c2=0.0)
    >>> found = FiducialOrientation.model_validate({
    ...     "image": "7.tif", "sha256": "", "camera": "RC 10", "status": "oriented", "why": "",
    ...     "size": (2300, 2300), "px_per_mm": 10.0, "rotation_deg": 0, "mirrored": False, "marks": (),
    ...     "extent": (-115.0, -115.0, 115.0, 115.0), "transform": {
    ...         "kind": "affine", "residuals_mm": {}, "sigma_mm": None,
    ...         "parameters": {key: {"value": value, "sigma": None} for key, value in values.items()}}})
    >>> calibration_of_fiducials(found).mapping().px_per_mm
    (10.0, 10.0)
    """
    transform, extent = orientation.transform, orientation.extent
    if orientation.status == "declined" or transform is None or extent is None:
        raise FormatError(f"the photograph was not oriented: {orientation.why}", where=orientation.image)
    model: FiducialModel = {
        "type": "fiducials",
        "image": orientation.image,
        "camera": orientation.camera,
        "transform": transform.kind,
        "px_per_mm": float(orientation.px_per_mm or 0.0),
        "rotation_deg": int(orientation.rotation_deg or 0),
        "mirrored": bool(orientation.mirrored),
    }
    names = tuple(transform.parameters) if orientation.covariance is not None else ()
    sigma = (
        np.sqrt(np.diagonal(np.array(orientation.covariance)))
        if orientation.covariance is not None
        else np.zeros(len(transform.parameters))
    )
    return Calibration(
        kind="fiducials",
        name=orientation.image if name is None else name,
        model=model,
        parameters={
            key: Quantity(value=float(entry["value"] or 0.0), sigma=float(s), unit=_unit(key))
            for (key, entry), s in zip(transform.parameters.items(), sigma, strict=True)
        },
        covariance=Covariance(names=names, matrix=orientation.covariance or ()),
        sigma0=None,
        redundancy=max(0, 2 * sum(mark.ok for mark in orientation.marks) - len(transform.parameters)),
        validity={"extent": list(extent), "unit": "mm", "size": list(orientation.size)},
        provenance=provenance or {},
    )


def _unit(name: str) -> str:
    return "mm" if name in ("c1", "c2", "X0", "Y0") else "1"
