"""OpenCV's camera model, ``opencv``: mapping, kernel and registration."""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike

from ...core.data import Array
from ...core.errors import UsageError
from ..mapping import Derivatives, as_points, as_values
from .grid import PixelGrid
from .kernels import CameraColumns, kernel
from .radial import Radial, first_root
from .registry import CameraModel, Parameter, register_camera

__all__ = ["OpenCV"]

PARAMETERS = (
    Parameter("fx", "px", "scale", usual=True, required=True),
    Parameter("fy", "px", "scale", usual=True, required=True),
    Parameter("cx", "px", "centre", usual=True, required=True),
    Parameter("cy", "px", "centre", usual=True, required=True),
    Parameter("k1", usual=True),
    Parameter("k2", usual=True),
    Parameter("p1", usual=True),
    Parameter("p2", usual=True),
    Parameter("k3"),
    Parameter("k4"),
    Parameter("k5"),
    Parameter("k6"),
)
FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6 = range(len(PARAMETERS))
# Radial terms of numerator and denominator, by ascending powers of r².
_RADIAL = ((K1, K4), (K2, K5), (K3, K6))


@dataclass(frozen=True, eq=False)
class OpenCV(Radial):
    """OpenCV's camera: from the ideal direction to pixels.

    ::

        u'' = u·q + 2·p1·uv + p2(r²+2u²),  q = (1 + k1r² + k2r⁴ + k3r⁶)/(1 + k4r² + k5r⁴ + k6r⁶)
        v'' = v·q + p1(r²+2v²) + 2·p2·uv,  x = fx·u'' + cx,  y = fy·v'' + cy

    As defined in OpenCV's documentation of its module calib3d.

    Parameters
    ----------
    values : array_like (9,) or (12,)
        fx, fy, cx, cy (px), k1, k2, p1, p2, k3; in the rational model k4, k5, k6 too.
        Default: fx = fy = 1, all others zero.

    Examples
    --------
    >>> OpenCV([800.0, 800.0, 319.5, 239.5, -0.2, 0, 0, 0, 0])([[0.1, 0.0]]).round(3)
    array([[399.34, 239.5 ]])
    """

    values: Array = field(default_factory=lambda: np.array([1.0, 1.0] + 7 * [0.0]))

    ALL_NAMES: ClassVar[tuple[str, ...]] = tuple(p.name for p in PARAMETERS)

    def __post_init__(self) -> None:
        count = 12 if np.size(self.values) == 12 else 9
        object.__setattr__(self, "values", as_values(self.ALL_NAMES[:count], self.values))

    @property
    def names(self) -> tuple[str, ...]:
        """The nine names, or twelve in the rational model."""
        return self.ALL_NAMES[: len(self.values)]

    @classmethod
    def from_parameters(cls, parameters: Named[str, float]) -> Self:
        """A camera from named parameters, the others zero; rational when it has one of k4, k5, k6.

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
        """See :class:`~reseau.optics.cameras.radial.Radial`."""
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


@kernel
def _opencv(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`."""
    p = cameras.values
    s = u * u + v * v
    n = 1.0 + s * (p[c, K1] + s * (p[c, K2] + s * p[c, K3]))
    m = 1.0 + s * (p[c, K4] + s * (p[c, K5] + s * p[c, K6]))
    q = n / m
    by_s = (
        2.0
        * (
            p[c, K1]
            + s * (2.0 * p[c, K2] + 3.0 * s * p[c, K3])
            - q * (p[c, K4] + s * (2.0 * p[c, K5] + 3.0 * s * p[c, K6]))
        )
        / m
    )
    uu, vv, uv = s + 2.0 * u * u, s + 2.0 * v * v, 2.0 * u * v
    x = u * q + p[c, P1] * uv + p[c, P2] * uu
    y = v * q + p[c, P1] * vv + p[c, P2] * uv
    cross = u * v * by_s + 2.0 * p[c, P1] * u + 2.0 * p[c, P2] * v
    by_uv[0, 0] = p[c, FX] * (q + u * u * by_s + 2.0 * p[c, P1] * v + 6.0 * p[c, P2] * u)
    by_uv[0, 1] = p[c, FX] * cross
    by_uv[1, 0] = p[c, FY] * cross
    by_uv[1, 1] = p[c, FY] * (q + v * v * by_s + 6.0 * p[c, P1] * v + 2.0 * p[c, P2] * u)
    d[:, :] = 0.0
    d[0, FX], d[1, FY], d[0, CX], d[1, CY] = x, y, 1.0, 1.0
    power = 1.0 / m
    for i, j in _RADIAL:
        power *= s
        d[0, i], d[1, i] = p[c, FX] * u * power, p[c, FY] * v * power
        d[0, j], d[1, j] = -q * d[0, i], -q * d[1, i]
    d[0, P1], d[1, P1] = p[c, FX] * uv, p[c, FY] * vv
    d[0, P2], d[1, P2] = p[c, FX] * uu, p[c, FY] * uv
    off[0] = p[c, FX] * x + p[c, CX] - xy[k, 0]
    off[1] = p[c, FY] * y + p[c, CY] - xy[k, 1]


def _build(values: Array, grid: PixelGrid, options: Named[str, Any]) -> OpenCV:
    return OpenCV(values)


def _start(f: float, grid: PixelGrid) -> dict[str, float]:
    return {"fx": f, "fy": f, "cx": (grid.width - 1) / 2, "cy": (grid.height - 1) / 2}


register_camera(CameraModel("opencv", PARAMETERS, _build, _start, kernel=_opencv))
