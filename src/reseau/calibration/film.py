"""A scanned film frame: from pixels of the scan to photo-coordinates in millimetres, by its four corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import numpy as np

from ..core.data import Array, Mask
from ..core.errors import FormatError, UsageError
from ..io import CORNERS, FrameOrientation
from ..optics import RationalPolynomial
from .document import Calibration, Covariance, FilmFrameModel, Quantity, readable_as
from .mapping import CalibratedMapping, Target, reasons

_STEP_PX = 1e-3
"""Of the central differences by the corners; the coordinates are almost linear in them."""
TRANSFORMS = {
    "similarity": RationalPolynomial.similarity(),
    "affine": RationalPolynomial.affine(),
    "projective": RationalPolynomial.projective(),
    "bilinear": RationalPolynomial.bilinear(),
}
"""Transformations to the calibrated coordinates of a camera's frame or fiducial marks, by kind."""


def photo_coordinates(xy: Array, corners: Array, px_per_mm: tuple[float, float]) -> Array:
    """Photo-coordinates of pixels: origin at the intersection of the diagonals, x along the lower edge.

    The y-axis points to the upper edge, also in a scan from the wrong side (Cruz et al., fig. 1).

    Parameters
    ----------
    xy : ndarray (n, 2)
        Pixels.
    corners : ndarray (4, 2)
        ul, ur, lr, ll in pixels.
    px_per_mm : (float, float)
        Scale along x and along y of the frame.

    Returns
    -------
    ndarray (n, 2)
        Millimetres.

    Examples
    --------
    >>> corners = np.array([[10.0, 20.0], [370.0, 20.0], [370.0, 260.0], [10.0, 260.0]])
    >>> photo_coordinates(corners[:1], corners, (10.0, 10.0))
    array([[-18.,  12.]])
    """
    crossing, along, up = _axes(corners)
    rest = xy - crossing
    return np.stack([rest @ along / px_per_mm[0], rest @ up / px_per_mm[1]], axis=1)


def _axes(corners: Array) -> tuple[Array, Array, Array]:
    """Origin in pixels, and the directions of x and y in the scan."""
    ul, ur, lr, ll = corners
    crossing = np.cross(np.cross([*ul, 1.0], [*lr, 1.0]), np.cross([*ur, 1.0], [*ll, 1.0]))
    along = (lr - ll) / np.hypot(*(lr - ll))
    up = np.array([along[1], -along[0]])
    if (ul - ll) @ up < 0:
        up = -up
    return crossing[:2] / crossing[2], along, up


@dataclass(frozen=True, eq=False)
class FilmFrameMapping(CalibratedMapping):
    """The inner orientation of a scanned film frame.

    Parameters
    ----------
    corners : ndarray (4, 2)
        ul, ur, lr, ll in pixels of the scan.
    covariance : ndarray (8, 8)
        Of x and y of the corners in this order.
    format_mm : (float, float)
        Width and height of the frame, which give the scale.
    transform : RationalPolynomial, optional
        From photo-coordinates to those of the calibrated corners of the camera, both in mm.
    transform_covariance : ndarray (u, u), optional
        Of its parameters; None where four corners leave no redundancy.
    size : (int, int), optional
        Width and height of the scan in pixels, where they are known.

    Notes
    -----
    Without a transformation, or with one of eight parameters, the covariance of the mapping is that of the
    corners. A transformation with redundancy has the covariance of its residuals: they contain the errors of
    the corners and those of film, scanner and gate.

    Examples
    --------
    >>> corners = np.array([[10.0, 20.0], [370.0, 20.0], [370.0, 260.0], [10.0, 260.0]])
    >>> frame = FilmFrameMapping(corners, 0.01 * np.eye(8), (36.0, 24.0))
    >>> from reseau.core.data import ImagePoints
    >>> found = frame.apply(ImagePoints.with_sigma(["p"], [[190.0, 140.0]], 0.0))
    >>> bool(abs(found.xy).max() < 1e-9), found.sigma.round(4)
    (True, array([[0.009, 0.006]]))
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("points", "images", "scans")
    system: ClassVar[str] = "photo"
    unit: ClassVar[str] = "mm"

    corners: Array
    covariance: Array
    format_mm: tuple[float, float]
    transform: RationalPolynomial | None = None
    transform_covariance: Array | None = None
    size: tuple[int, int] | None = None

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """Scale along x and y, by the mean sides of the frame and its format."""
        return _scale(self.corners, self.format_mm)

    @property
    def extent(self) -> tuple[float, ...]:
        """Left, low, right and high end of the frame, mm."""
        mm = self._mapped(self.corners)
        return (*map(float, mm.min(axis=0)), *map(float, mm.max(axis=0)))

    @property
    def parameter_covariance(self) -> Array:
        """Of the corners; of the transformation's parameters where it has redundancy."""
        return self.covariance if self.transform_covariance is None else self.transform_covariance

    def _photo(self, xy: Array, corners: Array) -> Array:
        return photo_coordinates(xy, corners, _scale(corners, self.format_mm))

    def _mapped(self, xy: Array) -> Array:
        photo = self._photo(xy, self.corners)
        return photo if self.transform is None else self.transform(photo)

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """See :meth:`CalibratedMapping.derivatives`."""
        photo = self._photo(xy, self.corners)
        slope = np.broadcast_to(self._linear, (len(xy), 2, 2))
        if self.transform is None:
            return photo, slope, self._by_corners(xy)
        value, by_photo, by_transform = self.transform.derivatives(photo)
        if self.transform_covariance is not None:
            return value, by_photo @ slope, by_transform
        # The transformation goes through the calibrated corners exactly: it follows every error of the
        # measured ones.
        _, at_corners, design = self.transform.derivatives(self._photo(self.corners, self.corners))
        moved = np.zeros((4, 2, 8))
        moved[np.arange(4)[:, None], np.arange(2), 2 * np.arange(4)[:, None] + np.arange(2)] = 1.0
        moved = self._linear @ moved + self._by_corners(self.corners)
        follows = -np.linalg.solve(design.reshape(8, 8), (at_corners @ moved).reshape(8, 8))
        return value, by_photo @ slope, by_photo @ self._by_corners(xy) + by_transform @ follows

    @property
    def _linear(self) -> Array:
        """Derivatives (2, 2) of photo-coordinates by pixels; the same everywhere."""
        _, along, up = _axes(self.corners)
        linear: Array = np.stack([along, up]) / np.array(self.px_per_mm)[:, None]
        return linear

    def _by_corners(self, xy: Array) -> Array:
        """Derivatives (n, 2, 8) of the photo-coordinates of fixed pixels by the corners."""
        found = np.empty((len(xy), 2, 8))
        for k in range(8):
            step = np.zeros(8)
            step[k] = _STEP_PX
            more, less = (self._photo(xy, self.corners + sign * step.reshape(4, 2)) for sign in (1, -1))
            found[:, :, k] = (more - less) / (2 * _STEP_PX)
        return found

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) of photo-coordinates (n, 2) in mm; NaN where the transformation has no inverse."""
        photo = xy if self.transform is None else self.transform.inverse(xy)
        return photo @ np.linalg.inv(self._linear).T + _axes(self.corners)[0]

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        return reasons(self.extent, mapped, mapped, "the frame")

    def check_size(self, width: int, height: int, where: object) -> None:
        """Refuse a scan of another size, or one that does not contain the frame.

        Raises
        ------
        UsageError
            When the size differs from that of the oriented scan; where that is not known, when the centre of
            the frame or more than two of its corners lie outside.
        """
        super().check_size(width, height, where)
        places = np.vstack([_axes(self.corners)[0], self.corners])
        inside: Mask = np.asarray(
            ((places >= -0.5) & (places <= np.array([width, height]) - 0.5)).all(axis=1)
        )
        if not inside[0] or inside[1:].sum() < 2:
            raise UsageError(
                f"has {width}×{height} pixels and does not contain the frame",
                where=where,
                do="use the scan that was oriented",
            )

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """Read the orientation of a frame from its calibration.

        Raises
        ------
        FormatError
            When the calibration is of another kind, or damaged.
        """
        where = f"calibration {calibration.name}"
        if calibration.kind != "film_frame":
            raise FormatError(calibration.not_of("film_frame"), where=where)
        model, values = cast(dict[str, Any], calibration.model), calibration.values()
        try:
            corners = np.array([[values[f"{name}.x"], values[f"{name}.y"]] for name in CORNERS])
            row = {name: i for i, name in enumerate(calibration.parameters)}
            at = [row[f"{name}.{axis}"] for name in CORNERS for axis in "xy"]
            w, h = model["format_mm"]
            found = _transform(model["transform"], corners, (w, h))
            size = calibration.validity.get("size")
        except (KeyError, TypeError, ValueError, UsageError) as error:
            raise FormatError(f"has a damaged or missing entry: {error}", where=where) from None
        cov = calibration.matrix()[np.ix_(at, at)]
        return cls(corners, cov, (w, h), *found, None if size is None else (int(size[0]), int(size[1])))


readable_as("film_frame")(FilmFrameMapping.from_calibration)


def _scale(corners: Array, format_mm: tuple[float, float]) -> tuple[float, float]:
    side = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(*side.T)
    w, h = format_mm
    return float((length[0] + length[2]) / (2 * w)), float((length[1] + length[3]) / (2 * h))


def _transform(
    content: dict[str, Any] | None, corners: Array, format_mm: tuple[float, float]
) -> tuple[RationalPolynomial | None, Array | None]:
    """The transformation of a document, and the covariance of its parameters where it has redundancy."""
    if content is None:
        return None, None
    model = TRANSFORMS[content["kind"]]
    entries = [content["parameters"][name] for name in model.names]
    model = model.with_values(np.array([float(entry["value"]) for entry in entries]))
    if content["sigma_mm"] is None:
        return model, None
    # The document has the sigmas; the correlations follow from the corners, which have equal weights.
    photo = photo_coordinates(corners, corners, _scale(corners, format_mm))
    design = model.derivatives(photo).d_parameters.reshape(8, -1)
    q = np.linalg.inv(design.T @ design)
    scale = np.array([float(entry["sigma"]) for entry in entries]) / np.sqrt(np.diagonal(q))
    return model, scale[:, None] * q * scale


def calibration_of_frame(
    orientation: FrameOrientation,
    *,
    name: str | None = None,
    covariance: Array | None = None,
    size: tuple[int, int] | None = None,
    provenance: dict[str, Any] | None = None,
) -> Calibration:
    """The calibration file of a film frame, from its inner orientation.

    Parameters
    ----------
    orientation : FrameOrientation
        A frame that was oriented (``reseau-orientation/1``).
    name : str, optional
        Name of the calibration; by default that of the scan.
    covariance : ndarray (8, 8), optional
        Of the corners together; by default that of each corner, as the orientation has it.
    size : (int, int), optional
        Width and height of the scan in pixels.
    provenance : dict, optional
        Its inputs, options and version.

    Raises
    ------
    FormatError
        When the frame was declined.

    Examples
    --------
    >>> corner = {"sx": 0.1, "sy": 0.1, "rho": 0.0}
    >>> at = {"ul": (10.0, 20.0), "ur": (370.0, 20.0), "lr": (370.0, 260.0), "ll": (10.0, 260.0)}
    >>> oriented = FrameOrientation.model_validate({
    ...     "image": "scan.tif", "status": "oriented", "why": "", "format_mm": (36.0, 24.0),
    ...     "channel": "grey",
    ...     "corners": {name: corner | {"x": x, "y": y} for name, (x, y) in at.items()},
    ...     "principal_point": corner | {"x": 190.0, "y": 140.0}, "angle_deg": 0.0, "angle_sigma_deg": 0.01,
    ...     "px_per_mm": (10.0, 10.0), "edges": {}})
    >>> calibration_of_frame(oriented).mapping().px_per_mm
    (10.0, 10.0)
    """
    if orientation.corners is None or orientation.format_mm is None:
        why = orientation.why or "has no format"
        raise FormatError(f"the frame was not oriented: {why}", where=orientation.image)
    points = orientation.image_points()
    if covariance is None:
        covariance = np.zeros((8, 8))
        for k, cov in enumerate(points.cov):
            covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = cov
    names = [f"{corner}.{axis}" for corner in CORNERS for axis in "xy"]
    sigma = np.sqrt(np.diagonal(covariance))
    transform = None if orientation.transform is None else orientation.transform.model_dump(mode="json")
    model: FilmFrameModel = {
        "type": "film_frame",
        "image": orientation.image,
        "format_mm": list(orientation.format_mm),
        "transform": transform,
    }
    validity: dict[str, Any] = {"status": orientation.status, "why": orientation.why, "unit": "mm"}
    validity["extent"] = list(FilmFrameMapping(points.xy, covariance, orientation.format_mm).extent)
    return Calibration(
        kind="film_frame",
        name=orientation.image if name is None else name,
        model=model,
        parameters={
            key: Quantity(value=float(value), sigma=float(s), unit="px")
            for key, value, s in zip(names, points.xy.ravel(), sigma, strict=True)
        },
        covariance=Covariance(names=tuple(names), matrix=tuple(tuple(map(float, row)) for row in covariance)),
        sigma0=None,
        redundancy=0,
        validity=validity | ({} if size is None else {"size": list(size)}),
        provenance=provenance or {},
    )
