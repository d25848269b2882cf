"""What every calibration is read back to: a mapping with covariance, its validity, and what it applies to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from ..core.data import Array, ImagePoints, Mask
from ..core.errors import UsageError
from ..optics.mapping import PlaneMapping

if TYPE_CHECKING:
    from matplotlib.axes import Axes


Target = Literal["points", "images", "scans", "frames"]

BEYOND = 0.08
"""Distance beyond the calibrated extent, in units of its sides, up to which a correction is still used."""


def carried(mapping: PlaneMapping, points: ImagePoints) -> ImagePoints:
    """Map points with their covariances; the mapping itself counts as free of error.

    Parameters
    ----------
    mapping : PlaneMapping
        The mapping.
    points : ImagePoints
        Points in its first plane.

    Returns
    -------
    ImagePoints
        The points in its second plane.
    """
    value, slope, _ = mapping.derivatives(points.xy)
    return ImagePoints(points.names, value, slope @ points.cov @ np.swapaxes(slope, 1, 2))


def beyond(extent: tuple[float, ...] | None, xy: Array) -> Array:
    """Distance (n,) of points beyond an extent (left, low, right, high), in units of its sides; 0 inside."""
    if extent is None:
        return np.zeros(len(xy))
    low, high = np.array(extent[:2]), np.array(extent[2:])
    sides = np.maximum(high - low, np.finfo(float).tiny)
    past: Array = np.maximum(np.maximum(low - xy, xy - high) / sides, 0.0).max(axis=1)
    return past


class CalibratedMapping(ABC):
    """A calibration in use.

    Points are given in pixels of the calibrated instrument. A subclass gives :meth:`derivatives`,
    :meth:`to_pixels` and `parameter_covariance`; the propagation of covariances and the check of the validity
    follow.

    Examples
    --------
    >>> from reseau.calibration import CameraMapping
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5})
    >>> mapping: CalibratedMapping = CameraMapping(lens, 640, 480, np.array([0]), np.array([[0.25]]))
    >>> points = ImagePoints.with_sigma(["a"], [[719.5, 239.5]], 0.1)
    >>> mapping.apply(points).xy, mapping.why_not(points)
    (array([[0.5, 0. ]]), ('lies outside the image',))
    """

    applies_to: ClassVar[tuple[Target, ...]]
    """What it can be applied to."""
    system: ClassVar[str]
    """Name of the system that it maps to."""

    if TYPE_CHECKING:  # a subclass may have them as fields, which a property here would hide

        @property
        def unit(self) -> str:
            """Unit of the mapped points."""

        @property
        def size(self) -> tuple[int, int] | None:
            """Width and height in pixels of the images it applies to; None where they are not known."""

    @abstractmethod
    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """Map points and differentiate.

        Parameters
        ----------
        xy : ndarray (n, 2)
            Pixels.

        Returns
        -------
        value : ndarray (n, 2)
            NaN where the mapping has no value.
        slope : ndarray (n, 2, 2)
            Derivatives by the points.
        by_parameters : ndarray (n, 2, u)
            Derivatives by the parameters that `parameter_covariance` belongs to.
        """

    @property
    @abstractmethod
    def parameter_covariance(self) -> Array:
        """Covariance matrix (u, u) of the parameters."""

    @abstractmethod
    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) at which mapped points appear; NaN where the mapping has no inverse."""

    @abstractmethod
    def _why(self, xy: Array, mapped: Array) -> list[str]:
        """For each point why the mapping does not hold there; empty where it does."""

    def apply(self, points: ImagePoints) -> ImagePoints:
        """Map measured points.

        Parameters
        ----------
        points : ImagePoints
            In pixels.

        Returns
        -------
        ImagePoints
            The mapped points; covariances contain those of the points and of the calibration. What the
            calibration has in common for all points correlates them, which is left out.
        """
        value, slope, by_parameters = self.derivatives(points.xy)
        cov = slope @ points.cov @ np.swapaxes(slope, 1, 2)
        cov = cov + by_parameters @ self.parameter_covariance @ np.swapaxes(by_parameters, 1, 2)
        return ImagePoints(points.names, value, cov)

    def inverse(self, points: ImagePoints) -> ImagePoints:
        """Map points back to pixels, with the covariances of the points and of the calibration.

        Parameters
        ----------
        points : ImagePoints
            In the system of :meth:`apply`.

        Returns
        -------
        ImagePoints
            In pixels; NaN where the mapping has no inverse.
        """
        xy = self.to_pixels(points.xy)
        cov = np.full((len(points), 2, 2), np.nan)
        known = np.isfinite(xy).all(axis=1)
        _, slope, by_parameters = self.derivatives(xy[known])
        own = by_parameters @ self.parameter_covariance @ np.swapaxes(by_parameters, 1, 2)
        back = np.linalg.inv(slope)
        cov[known] = back @ (points.cov[known] + own) @ np.swapaxes(back, 1, 2)
        return ImagePoints(points.names, xy, cov)

    def why_not(self, points: ImagePoints) -> tuple[str, ...]:
        """Check measured points against the validity of the calibration.

        Parameters
        ----------
        points : ImagePoints
            In pixels.

        Returns
        -------
        tuple of str (n,)
            For each point the reason why the calibration does not hold there; empty where it does.
        """
        return tuple(self._why(points.xy, self.derivatives(points.xy)[0]))

    def plot(self, axes: Axes | None = None, across: int = 25) -> Axes:
        """Draw the standard deviation of mapped points, worst direction, over the image, with matplotlib.

        The points themselves are taken as free of error.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        across : int
            Number of places across the image.

        Raises
        ------
        UsageError
            When the size of the images is not known.
        """
        from ..core.figures import draw_contours

        if self.size is None:
            raise UsageError("does not contain the size of its images", where="calibration")
        width, height = self.size
        down = max(2, round(across * height / width))
        grid = np.stack(
            np.meshgrid(np.linspace(0, width - 1, across), np.linspace(0, height - 1, down)), axis=-1
        )
        _, _, by_parameters = self.derivatives(grid.reshape(-1, 2))
        cov = by_parameters @ self.parameter_covariance @ np.swapaxes(by_parameters, 1, 2)
        known = np.isfinite(cov).all(axis=(1, 2))
        sigma = np.full(len(cov), np.nan)
        sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(cov[known])[:, 1], 0.0))
        unit = "" if self.unit == "1" else f" / {self.unit}"
        title = f"σ of the {self.system} coordinates{unit}"
        return draw_contours(axes, grid, sigma.reshape(down, across), title)

    def check_size(self, width: int, height: int, where: object) -> None:
        """Refuse an image of another size than the calibrated one.

        Raises
        ------
        UsageError
            When the size differs.
        """
        if self.size is not None and self.size != (width, height):
            raise UsageError(
                f"has {width}×{height} pixels, the calibrated images {self.size[0]}×{self.size[1]}",
                where=where,
                do="use an image of that size, or calibrate this size",
            )


def outside(of: str, past: float) -> str:
    """The reason for a point that lies beyond what a calibration was determined by."""
    return f"lies {100 * past:.0f} % of the extent beyond {of}: the correction is unreliable there"


def reasons(extent: tuple[float, ...] | None, at: Array, mapped: Array, of: str) -> list[str]:
    """Reasons (n) by the extent in which a calibration was determined, and by points without a value."""
    past = beyond(extent, at)
    known: Mask = np.asarray(np.isfinite(mapped).all(axis=1))
    return [
        "has no image under the model" if not k else outside(of, p) if p > BEYOND else ""
        for p, k in zip(past.tolist(), known.tolist(), strict=True)
    ]


def extent_of(validity: dict[str, Any]) -> tuple[float, ...] | None:
    """Extent (left, low, right, high) in a calibration's validity; None where there is none."""
    found = validity.get("extent")
    return tuple(map(float, found)) if isinstance(found, (list, tuple)) and len(found) == 4 else None
