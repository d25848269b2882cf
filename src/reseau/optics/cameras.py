"""Cameras: from the ideal direction of a ray to its image point, and back.

A camera is a plane mapping whose first plane is that of the ideal directions u = xc/zc, v = yc/zc (camera
axes: x right, y down, z along the view) and whose second is the image. :mod:`reseau.optics.poses` puts it in
space.
"""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike

from ..core.data import Array, Mask
from ..core.errors import UsageError
from .composition import Inverted
from .distortions import BrownDistortion, Radial, first_root
from .mapping import Derivatives, PlaneMapping, as_points, as_values

__all__ = ["Brown", "OpenCV", "PixelGrid"]


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of an image and the photo-coordinates they stand for.

    Pixels have their origin at the centre of the top-left pixel, y down; photo-coordinates theirs at the
    centre of the image, y up.

    Parameters
    ----------
    width, height : int
        Number of columns and rows.
    pitch_mm : (float, float)
        Distance of neighbouring columns and of neighbouring rows, in millimetres.

    Examples
    --------
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> grid.to_photo([[0.0, 0.0]])
    array([[-3.195,  2.395]])
    """

    width: int
    height: int
    pitch_mm: tuple[float, float]

    def __post_init__(self) -> None:
        if not (min(self.width, self.height) > 0 and min(self.pitch_mm) > 0):
            raise UsageError(
                f"has {self.width}×{self.height} pixels of {self.pitch_mm} mm", where="pixel grid"
            )

    @property
    def centre(self) -> Array:
        """Centre of the image in pixels, (2,)."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    @property
    def pixels_per_mm(self) -> Array:
        """Derivative of the pixels by the photo-coordinates, the diagonal (2,); that of y is negative."""
        return np.array([1 / self.pitch_mm[0], -1 / self.pitch_mm[1]])

    def to_photo(self, pixels: ArrayLike) -> Array:
        """Photo-coordinates (n, 2) in mm of pixels (n, 2)."""
        photo: Array = (as_points(pixels) - self.centre) / self.pixels_per_mm
        return photo

    def to_pixels(self, photo: ArrayLike) -> Array:
        """Pixels (n, 2) of photo-coordinates (n, 2) in mm."""
        pixels: Array = as_points(photo) * self.pixels_per_mm + self.centre
        return pixels


@dataclass(frozen=True, eq=False)
class Brown(PlaneMapping):
    """Camera with Brown's distortion: ideal direction to photo-coordinates (mm), or to pixels with a grid.

    With xs = c·u, ys = −c·v and Δ of :class:`BrownDistortion`: ``side="object"`` (AICON, the direction of
    OpenCV) adds the distortion of the ideal point, x' = x0 + xs + Δx(xs, ys). ``side="image"`` (PhotoModeler,
    Australis) reckons with that of the measured point: xm = x' − x0, xm + Δx(xm, ym) = xs; a point beyond
    the fold of this polynomial has no image, and its image is NaN.

    Parameters
    ----------
    values : array_like (10,)
        c, x0, y0 (mm), then the parameters of the distortion. Default: c = 1, nothing else.
    side : {"image", "object"}
        Whose coordinates the distortion is a function of.
    balance_radius_mm : float
        R0.
    grid : PixelGrid, optional
        Given, the image is in pixels; otherwise in photo-coordinates.

    Examples
    --------
    >>> camera = Brown(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0, "K1": 1e-3})
    >>> camera([[0.1, 0.0]]).round(3)
    array([[399.449, 239.5  ]])
    """

    names: ClassVar[tuple[str, ...]] = ("c", "x0", "y0", *BrownDistortion.names)
    values: Array = field(default_factory=lambda: np.array([1.0] + 9 * [0.0]))
    side: Literal["image", "object"] = "image"
    balance_radius_mm: float = 0.0
    grid: PixelGrid | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))
        if self.side not in ("image", "object"):
            raise UsageError(f"is {self.side!r}", where="side of a camera", do="write `image` or `object`")

    @cached_property
    def distortion(self) -> BrownDistortion:
        """The distortion alone, about the principal point."""
        return BrownDistortion(self.values[3:], self.balance_radius_mm)

    @cached_property
    def _lens(self) -> PlaneMapping:
        return self.distortion if self.side == "object" else Inverted(self.distortion)

    @property
    def _ideal(self) -> Array:
        ideal: Array = self.values[0] * np.array([1.0, -1.0])
        return ideal

    def _from_photo(self, photo: Array) -> Array:
        return photo if self.grid is None else self.grid.to_pixels(photo)

    def _value(self, xy: Array) -> Array:
        return self._from_photo(self._lens(xy * self._ideal) + self.values[1:3])

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        photo, d_xy = self._lens._slope(xy * self._ideal)
        scale = np.ones(2) if self.grid is None else self.grid.pixels_per_mm
        return self._from_photo(photo + self.values[1:3]), scale[:, None] * d_xy * self._ideal

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        photo, d_xy, d_lens = self._lens.derivatives(points * self._ideal)
        scale = np.ones(2) if self.grid is None else self.grid.pixels_per_mm
        d = np.empty((len(points), 2, 10))
        d[:, :, 0] = (d_xy @ (points * [1.0, -1.0])[:, :, None])[:, :, 0]
        d[:, :, 1:3] = np.eye(2)
        d[:, :, 3:] = d_lens
        value = self._from_photo(photo + self.values[1:3])
        return Derivatives(value, scale[:, None] * d_xy * self._ideal, scale[:, None] * d)

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the distortion is, at these directions."""
        return self._lens.one_to_one(as_points(xy) * self._ideal)

    def _inverse(self, xy: Array) -> Array:
        photo = xy if self.grid is None else self.grid.to_photo(xy)
        if self.values[0] == 0:
            return np.full(xy.shape, np.nan)
        directions: Array = self._lens.inverse(photo - self.values[1:3]) / self._ideal
        return directions

    def to_opencv(self) -> OpenCV:
        """The same camera as OpenCV writes it.

        Raises
        ------
        UsageError
            When there is no such camera: distortion on the image side, affinity, or no grid.
        """
        c, x0, y0, k1, k2, k3, p1, p2, b1, b2 = self.values
        if self.side == "image" or self.grid is None or b1 or b2:
            raise UsageError(
                "has no equal among the cameras of OpenCV",
                where="Brown camera",
                do="it needs the object side, a grid, and B1 = B2 = 0",
            )
        balance = 1 - float(self.values[3:6] @ self.distortion.balance)
        scale = c * balance * np.abs(self.grid.pixels_per_mm)
        centre = self.grid.to_pixels([[x0, y0]])[0]
        radial = np.array([k1 * c**2, k2 * c**4, k3 * c**6]) / balance
        decentering = np.array([-p2 * c, p1 * c]) / balance
        return OpenCV(np.array([*scale, *centre, *radial[:2], *decentering, radial[2]]))


@dataclass(frozen=True, eq=False)
class OpenCV(Radial):
    """OpenCV's camera: ideal direction to pixels.

    ::

        u'' = u·q + 2·p1·uv + p2(r²+2u²),  q = (1 + k1r² + k2r⁴ + k3r⁶)/(1 + k4r² + k5r⁴ + k6r⁶)
        v'' = v·q + p1(r²+2v²) + 2·p2·uv,  x = fx·u'' + cx,  y = fy·v'' + cy

    Definition in OpenCV's documentation of its module calib3d.

    Parameters
    ----------
    values : array_like (9,) or (12,)
        fx, fy, cx, cy (px), k1, k2, p1, p2, k3 and, in the rational model, k4, k5, k6.
        Default: fx = fy = 1, nothing else.
    """

    values: Array = field(default_factory=lambda: np.array([1.0, 1.0] + 7 * [0.0]))

    ALL_NAMES: ClassVar[tuple[str, ...]] = (
        "fx",
        "fy",
        "cx",
        "cy",
        "k1",
        "k2",
        "p1",
        "p2",
        "k3",
        "k4",
        "k5",
        "k6",
    )

    def __post_init__(self) -> None:
        count = 12 if np.size(self.values) == 12 else 9
        object.__setattr__(self, "values", as_values(self.ALL_NAMES[:count], self.values))

    @property
    def names(self) -> tuple[str, ...]:
        """The nine names, or twelve in the rational model."""
        return self.ALL_NAMES[: len(self.values)]

    @classmethod
    def from_parameters(cls, parameters: Named[str, float]) -> Self:
        """A camera by named parameters, the others zero; rational when it has one of k4, k5, k6.

        Raises
        ------
        UsageError
            When a name is unknown, or fx or fy is missing.
        """
        missing = [name for name in ("fx", "fy") if name not in parameters]
        if missing:
            raise UsageError("is missing", where=f"parameter {missing[0]} of an OpenCV camera")
        rational = any(name in parameters for name in cls.ALL_NAMES[9:])
        return cls(np.zeros(12 if rational else 9)).with_values(parameters)

    @cached_property
    def _quotient(self) -> tuple[Array, Array]:
        """Numerator and denominator of q as coefficients by powers of r²."""
        _, _, _, _, k1, k2, _, _, k3, *rest = self.values
        return np.array([1.0, k1, k2, k3]), np.array([1.0, *(rest or 3 * [0.0])])

    @cached_property
    def fold(self) -> float:
        """See :class:`~reseau.optics.distortions.Radial`."""
        n, m = self._quotient
        # d/dr of r·n/m is (n·m + 2s(n'm − nm'))/m² with s = r².
        cross = poly.polysub(poly.polymul(poly.polyder(n), m), poly.polymul(n, poly.polyder(m)))
        growth = poly.polyadd(poly.polymul(n, m), poly.polymulx(2 * cross))
        return first_root(growth, m)

    def _distorted(self, xy: Array) -> tuple[Array, Array, Array, Array]:
        """Distorted direction, its derivatives by the direction, 1/m and q."""
        p1, p2 = self.values[6:8]
        u, v = xy[:, 0], xy[:, 1]
        s = u * u + v * v
        n, m = self._quotient
        with np.errstate(divide="ignore", invalid="ignore"):
            one_by_m = 1 / poly.polyval(s, m)
            q = poly.polyval(s, n) * one_by_m
            by_s = 2 * (poly.polyval(s, poly.polyder(n)) - q * poly.polyval(s, poly.polyder(m))) * one_by_m
        value = np.stack(
            [
                u * q + 2 * p1 * u * v + p2 * (s + 2 * u * u),
                v * q + p1 * (s + 2 * v * v) + 2 * p2 * u * v,
            ],
            axis=1,
        )
        d_xy = np.empty((len(xy), 2, 2))
        d_xy[:, 0, 0] = q + u * u * by_s + 2 * p1 * v + 6 * p2 * u
        d_xy[:, 0, 1] = d_xy[:, 1, 0] = u * v * by_s + 2 * p1 * u + 2 * p2 * v
        d_xy[:, 1, 1] = q + v * v * by_s + 6 * p1 * v + 2 * p2 * u
        return value, d_xy, one_by_m, q

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        value, d_xy, *_ = self._distorted(xy)
        focal = self.values[:2]
        return value * focal + self.values[2:4], d_xy * focal[:, None]

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        value, d_xy, one_by_m, q = self._distorted(points)
        focal = self.values[:2]
        u, v = points[:, 0], points[:, 1]
        s = u * u + v * v
        d = np.zeros((len(points), 2, len(self.values)))
        d[:, [0, 1], [0, 1]] = value
        d[:, [0, 1], [2, 3]] = 1.0
        powers = points[:, :, None] * (np.stack([s, s**2, s**3], axis=1) * one_by_m[:, None])[:, None, :]
        d[:, :, [4, 5, 8]] = powers * focal[:, None]
        d[:, 0, 6], d[:, 1, 6] = focal[0] * 2 * u * v, focal[1] * (s + 2 * v * v)
        d[:, 0, 7], d[:, 1, 7] = focal[0] * (s + 2 * u * u), focal[1] * 2 * u * v
        if len(self.values) == 12:
            d[:, :, 9:] = -powers * q[:, None, None] * focal[:, None]
        return Derivatives(value * focal + self.values[2:4], d_xy * focal[:, None], d)

    def _start(self, xy: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.within((xy - self.values[2:4]) / self.values[:2])

    def to_brown(self, width: int, height: int, *, c_mm: float) -> Brown:
        """The same camera as a Brown camera, object side, on pixels whose pitch follows from c.

        Raises
        ------
        UsageError
            When the model is rational with k4, k5 or k6 other than zero.
        """
        fx, fy, cx, cy, k1, k2, p1, p2, k3, *rest = self.values
        if any(rest):
            raise UsageError("has no equal among Brown cameras", where="rational OpenCV camera")
        grid = PixelGrid(width, height, (c_mm / fx, c_mm / fy))
        x0, y0 = grid.to_photo([[cx, cy]])[0]
        radial = [k1 / c_mm**2, k2 / c_mm**4, k3 / c_mm**6]
        return Brown(np.array([c_mm, x0, y0, *radial, p2 / c_mm, -p1 / c_mm, 0.0, 0.0]), "object", grid=grid)
