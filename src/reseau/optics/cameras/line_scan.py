"""The camera with one line of sensor elements, ``line_scan``: mapping, kernel and registration."""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import kernel
from ...core.data import Array
from ..mapping import Derivatives, PlaneMapping, as_points, as_values
from .grid import PixelGrid
from .kernels import CameraColumns, evaluated
from .opencv import OpenCV
from .registry import CameraModel, Parameter, register_camera

PARAMETERS = (
    Parameter("f", "px", "scale", usual=True, required=True),
    Parameter("cx", "px", "centre", usual=True, required=True),
    Parameter("cy", "px", "centre"),
    Parameter("k1", usual=True),
    Parameter("k2", usual=True),
    Parameter("k3"),
    Parameter("p1"),
    Parameter("p2"),
)
F, CX, CY, K1, K2, K3, P1, P2 = range(len(PARAMETERS))
# Places of these parameters among those of OpenCV's camera: fx, fy, cx, cy, k1, k2, p1, p2, k3.
_OPENCV = (F, F, CX, CY, K1, K2, P1, P2, K3)


@dataclass(frozen=True, eq=False)
class LineScan(PlaneMapping):
    """Camera with one line of sensor elements: from the ideal direction to the element and across the line.

    It is OpenCV's camera with five coefficients and square pixels: x counts the elements, y is the distance
    from their line, both in pixels. (cx, cy) is the principal point: cy is the distance of the principal
    point from the line, not the middle of the image. A point is in the image when it is on the line, y = 0;
    see :class:`reseau.bundle.network.shutter.Shutter` for the time of a line. Without a shutter it is a
    camera with a plane of pixels.

    Parameters
    ----------
    values : array_like (8,)
        f, cx, cy (px), k1, k2, k3, p1, p2. Default: f = 1, all others zero.

    Examples
    --------
    >>> LineScan([2000.0, 1023.5, 0, 0, 0, 0, 0, 0])([[0.1, 0.0]])
    array([[1223.5,    0. ]])
    """

    names: ClassVar[tuple[str, ...]] = tuple(p.name for p in PARAMETERS)
    values: Array = field(default_factory=lambda: np.array([1.0] + 7 * [0.0]))

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    @cached_property
    def _frame(self) -> OpenCV:
        return OpenCV(self.values[list(_OPENCV)])

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        return evaluated(_line_scan, self.values, as_points(xy))

    def one_to_one(self, xy: ArrayLike) -> Any:
        """See :meth:`PlaneMapping.one_to_one`."""
        return self._frame.one_to_one(xy)

    def _inverse(self, xy: Array) -> Array:
        return self._frame.inverse(xy)


@kernel
def _line_scan(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`."""
    p = cameras.values
    f, p1, p2 = p[c, F], p[c, P1], p[c, P2]
    s = u * u + v * v
    q = 1.0 + s * (p[c, K1] + s * (p[c, K2] + s * p[c, K3]))
    by_s = 2.0 * (p[c, K1] + s * (2.0 * p[c, K2] + s * 3.0 * p[c, K3]))
    uu, vv, uv = s + 2.0 * u * u, s + 2.0 * v * v, 2.0 * u * v
    x, y = u * q + p1 * uv + p2 * uu, v * q + p1 * vv + p2 * uv
    cross = u * v * by_s + 2.0 * p1 * u + 2.0 * p2 * v
    by_uv[0, 0] = f * (q + u * u * by_s + 2.0 * p1 * v + 6.0 * p2 * u)
    by_uv[0, 1] = by_uv[1, 0] = f * cross
    by_uv[1, 1] = f * (q + v * v * by_s + 6.0 * p1 * v + 2.0 * p2 * u)
    d[:, :] = 0.0
    d[0, F], d[1, F], d[0, CX], d[1, CY] = x, y, 1.0, 1.0
    power = f
    for i in range(K1, K3 + 1):
        power *= s
        d[0, i], d[1, i] = u * power, v * power
    d[0, P1], d[1, P1], d[0, P2], d[1, P2] = f * uv, f * vv, f * uu, f * uv
    off[0] = f * x + p[c, CX] - xy[k, 0]
    off[1] = f * y + p[c, CY] - xy[k, 1]


def _build(values: Array, grid: PixelGrid, options: Named[str, Any]) -> LineScan:
    return LineScan(values)


def _start(f: float, grid: PixelGrid) -> dict[str, float]:
    # For calibrations and conversions without a shutter, which have a plane of pixels.
    return {"f": f, "cx": (grid.width - 1) / 2, "cy": (grid.height - 1) / 2}


register_camera(CameraModel("line_scan", PARAMETERS, _build, _start, kernel=_line_scan))
