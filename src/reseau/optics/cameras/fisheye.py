"""OpenCV's fisheye camera (Kannala–Brandt), ``fisheye``: mapping, kernel and registration."""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ...core.data import Array
from .grid import PixelGrid
from .kernels import CameraColumns, kernel
from .radial import first_root
from .registry import CameraModel, Parameter, register_camera
from .symmetric import FRAME, Symmetric, placed, start_of

__all__ = ["Fisheye"]

PARAMETERS = (*FRAME, *(Parameter(f"k{i}", usual=True) for i in range(1, 5)))
K1, K2, K3, K4 = range(4, 8)
# Below this s the quotient θd/r is a series, which loses no digits.
_SMALL = 1e-4


@dataclass(frozen=True, eq=False)
class Fisheye(Symmetric):
    """OpenCV's fisheye: the image radius is a polynomial of the angle θ from the axis.

    ::

        θd = θ (1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸),  θ = arctan r,  r² = u² + v²
        x = fx·u·θd/r + cx,  y = fy·v·θd/r + cy

    Kannala, J. & Brandt, S. (2006), A generic camera model and calibration method for conventional,
    wide-angle, and fish-eye lenses, PAMI 28(8), in the form of OpenCV's module calib3d/fisheye. Rays at 90°
    from the axis and beyond have no ideal direction (u, v).

    Parameters
    ----------
    values : array_like (8,)
        fx, fy, cx, cy (px), k1, k2, k3, k4. Default: fx = fy = 1, all others zero: the equidistant lens.

    Examples
    --------
    >>> Fisheye([800.0, 800.0, 319.5, 239.5, 0, 0, 0, 0])([[np.tan(0.5), 0.0]]).round(3)
    array([[719.5, 239.5]])
    """

    names: ClassVar[tuple[str, ...]] = tuple(p.name for p in PARAMETERS)

    @cached_property
    def fold(self) -> float:
        """See :class:`~reseau.optics.cameras.radial.Radial`."""
        k1, k2, k3, k4 = self.values[4:]
        square = first_root([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
        return float(np.tan(np.sqrt(square)) ** 2) if square < (np.pi / 2) ** 2 else np.inf

    def factor(self, s: Array) -> tuple[Array, Array, Array]:
        """See :class:`~reseau.optics.cameras.symmetric.Symmetric`."""
        k = self.values[4:]
        near = s < _SMALL
        r = np.sqrt(np.where(near, 1.0, s))
        angle = np.arctan(r)
        t = angle * angle
        powers = t[:, None] ** np.arange(1, 5)
        bent = 1 + powers @ k
        by_angle = 1 + powers @ (k * [3, 5, 7, 9])
        q = np.where(near, 1 + s * (k[0] - 1 / 3 + s * (0.2 - k[0] + k[1])), angle * bent / r)
        full = (by_angle / (1 + r * r) - angle * bent / r) / (2 * r * r)
        by_s = np.where(near, k[0] - 1 / 3 + 2 * s * (0.2 - k[0] + k[1]), full)
        small = np.where(near, s, 0.0)
        series = np.stack([small * (1 - small), small**2, 0 * small, 0 * small], axis=1)
        return q, by_s, np.where(near[:, None], series, (angle / r)[:, None] * powers)

    def outwards(self, m: Array) -> Array:
        """See :class:`~reseau.optics.cameras.symmetric.Symmetric`."""
        k, angle = self.values[4:], np.minimum(m, 1.5)
        for _ in range(8):
            t = angle * angle
            powers = t[:, None] ** np.arange(1, 5)
            step = (angle * (1 + powers @ k) - m) / (1 + powers @ (k * [3, 5, 7, 9]))
            angle = np.clip(angle - np.clip(step, -0.2, 0.2), 0.0, 1.55)
        found: Array = np.tan(angle)
        return found


@kernel
def _fisheye(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`."""
    p = cameras.values
    s = u * u + v * v
    k1, k2, k3, k4 = p[c, K1], p[c, K2], p[c, K3], p[c, K4]
    if s < _SMALL:
        q = 1.0 + s * (k1 - 1.0 / 3.0 + s * (0.2 - k1 + k2))
        by_s = k1 - 1.0 / 3.0 + 2.0 * s * (0.2 - k1 + k2)
        placed(k, c, u, v, q, by_s, xy, cameras, by_uv, d, off)
        d[0, K1], d[1, K1] = p[c, 0] * u * s * (1.0 - s), p[c, 1] * v * s * (1.0 - s)
        d[0, K2], d[1, K2] = p[c, 0] * u * s * s, p[c, 1] * v * s * s
        return
    r = np.sqrt(s)
    angle = np.arctan(r)
    t = angle * angle
    q = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) / r
    by_angle = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    by_s = (by_angle / (1.0 + s) - q) / (2.0 * s)
    placed(k, c, u, v, q, by_s, xy, cameras, by_uv, d, off)
    power = angle / r
    for i in range(4):
        power *= t
        d[0, K1 + i], d[1, K1 + i] = p[c, 0] * u * power, p[c, 1] * v * power


def _build(values: Array, grid: PixelGrid, options: Named[str, Any]) -> Fisheye:
    return Fisheye(values)


register_camera(CameraModel("fisheye", PARAMETERS, _build, start_of, kernel=_fisheye))
