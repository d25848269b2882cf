"""A calibrated camera: its mapping from directions to pixels, with the covariance of its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import numpy as np

from ..core.data import Array, Mask, Rows
from ..core.errors import FormatError, UsageError
from ..optics import PixelGrid, PlaneMapping
from ..optics.cameras import additional_model, camera_model
from .document import Calibration, readable_as
from .mapping import CalibratedMapping, Target, extent_of, reasons

__all__ = ["CameraMapping"]

_KEYS = ("model", "width", "height", "pitch_mm", "additional")
"""Keys of the model in a file; the others are options of the camera model."""


@dataclass(frozen=True, eq=False)
class CameraMapping(CalibratedMapping):
    """A calibrated camera.

    As a calibration it maps pixels to ideal directions u = xc/zc, v = yc/zc, free of distortion.

    Parameters
    ----------
    mapping : PlaneMapping
        From ideal directions to pixels, with the estimates.
    width, height : int
        Size of the image in pixels.
    rows : ndarray of int (u,)
        Parameters of the mapping that were estimated.
    covariance : ndarray (u, u)
        Their covariance matrix, a posteriori.
    extent : tuple of float, optional
        Left, top, right and bottom of the observations that it was estimated from, in pixels.

    Examples
    --------
    >>> brown = camera_model("brown").mapping([8.0, *9 * [0.0]], PixelGrid(640, 480, (0.01, 0.01)))
    >>> camera = CameraMapping(brown, 640, 480, np.array([0]), np.array([[1e-6]]))
    >>> camera.names
    ('c',)
    >>> from reseau.core.data import ImagePoints
    >>> camera.apply(ImagePoints.with_sigma(["corner"], [[639.5, 479.5]], 0.1)).xy
    array([[0.4, 0.3]])
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("points", "images")
    system: ClassVar[str] = "direction"
    unit: ClassVar[str] = "1"

    mapping: PlaneMapping
    width: int
    height: int
    rows: Rows
    covariance: Array
    extent: tuple[float, ...] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(self.mapping.names[k] for k in self.rows)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.width, self.height

    @property
    def parameter_covariance(self) -> Array:
        """That of the parameters that were estimated."""
        return self.covariance

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """Directions of pixels; see :meth:`CalibratedMapping.derivatives`."""
        uv = self.mapping.inverse(xy)
        known = np.isfinite(uv).all(axis=1)
        seen = self.mapping.derivatives(uv[known])
        slope, by_parameters = np.full((len(xy), 2, 2), np.nan), np.full((len(xy), 2, len(self.rows)), np.nan)
        slope[known] = np.linalg.inv(seen.d_xy)
        by_parameters[known] = -slope[known] @ seen.d_parameters[:, :, self.rows]
        return uv, slope, by_parameters

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) of directions (n, 2); NaN where the model has no image of them."""
        inside = self.mapping.one_to_one(xy)
        return np.where(inside[:, None], self.mapping(xy), np.nan)

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        inside: Mask = np.asarray(((xy >= -0.5) & (xy <= np.array(self.size) - 0.5)).all(axis=1))
        found = reasons(self.extent, xy, mapped, "the observations")
        return [
            why if here or why == "has no image under the model" else "lies outside the image"
            for here, why in zip(inside.tolist(), found, strict=True)
        ]

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """Read a camera from its calibration.

        Raises
        ------
        FormatError
            When the calibration is of another kind or of an unknown camera model, or is damaged.
        """
        where = f"calibration {calibration.name}"
        if calibration.kind != "camera":
            raise FormatError(
                f"is a calibration of a {calibration.kind.replace('_', ' ')}, not of a camera", where=where
            )
        model = cast(dict[str, Any], calibration.model)
        extra: dict[str, Any] | None = model.get("additional")
        values = calibration.values()
        if extra is not None and extra["per"] != "camera":
            raise FormatError("has several sets of additional parameters", where=where)
        try:
            registered = camera_model(model["model"])
            more = None
            if extra is not None:
                additional = additional_model(extra["model"])
                more = additional.build(np.zeros(len(additional.names)), extra["base_mm"])
            mapping = registered.mapping(
                np.array([values.get(name, 0.0) for name in registered.names]),
                PixelGrid(model["width"], model["height"], (model["pitch_mm"][0], model["pitch_mm"][1])),
                {key: value for key, value in model.items() if key not in _KEYS},
                more,
            )
        except (UsageError, KeyError, IndexError) as error:
            raise FormatError(f"has a damaged or unknown model: {error}", where=where) from None
        names, n = calibration.covariance.names, len(calibration.covariance.names)
        matrix = np.array(calibration.covariance.matrix).reshape(n, n)
        size, extent = (model["width"], model["height"]), extent_of(calibration.validity)
        return cls.of_estimates(mapping, size, values, names, matrix, extent)

    @classmethod
    def of_estimates(
        cls,
        mapping: PlaneMapping,
        size: tuple[int, int],
        values: dict[str, float],
        names: tuple[str, ...],
        covariance: Array,
        extent: tuple[float, ...] | None = None,
    ) -> Self:
        """A camera with these values of its parameters, of which those named were estimated."""
        mapping = mapping.with_values({name: values[name] for name in mapping.names if name in values})
        rows = np.array([mapping.names.index(name) for name in names], dtype=np.intp)
        return cls(mapping, *size, rows, covariance, extent)


readable_as("camera")(CameraMapping.from_calibration)
