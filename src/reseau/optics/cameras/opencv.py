"""OpenCV's camera model, ``opencv``, and with thin prism and tilt, ``opencv_full``: mapping and kernel."""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.polynomial import polynomial as poly

from ...core.compiled import kernel
from ...core.data import Array
from ...core.errors import UsageError
from ..mapping import Derivatives, as_values
from .grid import PixelGrid
from .kernels import CameraColumns, either, evaluated
from .radial import Radial, first_root
from .registry import CameraModel, Parameter, register_camera

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
FULL_PARAMETERS = (
    *PARAMETERS,
    *(Parameter(f"s{i}") for i in range(1, 5)),
    Parameter("tau_x", "rad"),
    Parameter("tau_y", "rad"),
)
FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6, S1, S2, S3, S4, TAU_X, TAU_Y = range(len(FULL_PARAMETERS))
# Number of values of the plain model, the rational one, and that with thin prism and tilt.
_PLAIN, _RATIONAL, _FULL = 9, len(PARAMETERS), len(FULL_PARAMETERS)
# Radial terms of numerator and denominator, by ascending powers of r².
_RADIAL = ((K1, K4), (K2, K5), (K3, K6))


def opencv_coefficients(values: Named[str, float]) -> list[float]:
    """The shortest list of coefficients (5, 8, 12 or 14), in the order of OpenCV; those missing are 0.

    Examples
    --------
    >>> opencv_coefficients({"fx": 800.0, "k1": -0.2, "k2": 0.05})
    [-0.2, 0.05, 0.0, 0.0, 0.0]
    """
    every = [float(values.get(each.name, 0.0)) for each in FULL_PARAMETERS[K1:]]
    return every[: next(count for count in (5, 8, 12, 14) if not any(every[count:]))]


@dataclass(frozen=True, eq=False)
class OpenCV(Radial):
    """OpenCV's camera: from the ideal direction to pixels.

    ::

        u'' = u·q + 2·p1·uv + p2(r²+2u²),  q = (1 + k1r² + k2r⁴ + k3r⁶)/(1 + k4r² + k5r⁴ + k6r⁶)
        v'' = v·q + p1(r²+2v²) + 2·p2·uv,  x = fx·u'' + cx,  y = fy·v'' + cy

    A thin prism adds s1r² + s2r⁴ and s3r² + s4r⁴ to (u'', v'') = (x, y). A sensor that is tilted by τx
    about x and then by τy about y has its point at::

        cos τx·x/w,  (cos τy·y − sin τx·sin τy·x)/w
        w = sin τy·x − cos τy·sin τx·y + cos τy·cos τx

    As defined in OpenCV's documentation of its module calib3d, with the product of the matrices of the tilt
    written out; the tilt is that of Louhichi, Fournel, Lavest & Ben Aissia (2007), Self-calibration of
    Scheimpflug cameras: an easy protocol, Meas. Sci. Technol. 18.

    Parameters
    ----------
    values : array_like (9,), (12,) or (18,)
        fx, fy, cx, cy (px), k1, k2, p1, p2, k3; in the rational model k4, k5, k6 too; with thin prism and
        tilt also s1, s2, s3, s4, τx, τy (rad). Default: fx = fy = 1, all others zero.

    Examples
    --------
    >>> OpenCV([800.0, 800.0, 319.5, 239.5, -0.2, 0, 0, 0, 0])([[0.1, 0.0]]).round(3)
    array([[399.34, 239.5 ]])
    """

    values: Array = field(default_factory=lambda: np.array([1.0, 1.0] + 7 * [0.0]))

    ALL_NAMES: ClassVar[tuple[str, ...]] = tuple(p.name for p in FULL_PARAMETERS)

    def __post_init__(self) -> None:
        count = np.size(self.values) if np.size(self.values) in (_RATIONAL, _FULL) else _PLAIN
        object.__setattr__(self, "values", as_values(self.ALL_NAMES[:count], self.values))

    @property
    def names(self) -> tuple[str, ...]:
        """The nine names, twelve in the rational model, or all eighteen."""
        return self.ALL_NAMES[: len(self.values)]

    @classmethod
    def from_parameters(cls, parameters: Named[str, float]) -> Self:
        """A camera from named parameters, the others zero; rational or full when it has one of these.

        Raises
        ------
        UsageError
            When a name is unknown, or fx or fy is missing.
        """
        missing = [name for name in ("fx", "fy") if name not in parameters]
        if missing:
            raise UsageError("is missing", where=f"parameter {missing[0]} of an OpenCV camera")
        last = max((cls.ALL_NAMES.index(name) for name in parameters if name in cls.ALL_NAMES), default=0)
        count = next(count for count in (_PLAIN, _RATIONAL, _FULL) if last < count)
        return cls(np.zeros(count)).with_values(parameters)

    @cached_property
    def _quotient(self) -> tuple[Array, Array]:
        """Numerator and denominator of q as coefficients by powers of r²."""
        _, _, _, _, k1, k2, _, _, k3, *rest = self.values[:_RATIONAL]
        return np.array([1.0, k1, k2, k3]), np.array([1.0, *(rest or 3 * [0.0])])

    @cached_property
    def fold(self) -> float:
        """See :class:`~reseau.optics.cameras.radial.Radial`."""
        n, m = self._quotient
        # d/dr of r·n/m is (n·m + 2s(n'm − nm'))/m² with s = r².
        cross = poly.polysub(poly.polymul(poly.polyder(n), m), poly.polymul(n, poly.polyder(m)))
        growth = poly.polyadd(poly.polymul(n, m), poly.polymulx(2 * cross))
        return first_root(growth, m)

    def _evaluated(self, xy: Array, *, parameters: bool = True) -> Derivatives:
        count = len(self.values)
        values = np.pad(self.values, (0, _FULL - count))
        found = evaluated(_opencv, values, xy, [float(count == _FULL)], parameters=parameters)
        return found._replace(d_parameters=found.d_parameters[:, :, :count])

    def _start(self, xy: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.within((xy - self.values[2:4]) / self.values[:2])


# Constant of the kernel.
IS_FULL = 0


@kernel
def _sensor(
    k: int, c: int, u: float, v: float, s: float, q: float, m: float, x: float, y: float, xu: float,
    cross: float, yv: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array, off: Array,
) -> None:  # fmt: skip
    """Add thin prism and tilt to the distorted direction x, y, and write all results."""
    p = cameras.values
    x += s * (p[c, S1] + s * p[c, S2])
    y += s * (p[c, S3] + s * p[c, S4])
    to_x, to_y = 2.0 * (p[c, S1] + 2.0 * s * p[c, S2]), 2.0 * (p[c, S3] + 2.0 * s * p[c, S4])
    xu, xv, yu, yv = xu + to_x * u, cross + to_x * v, cross + to_y * u, yv + to_y * v
    sx, sy, cx, cy = 0.0, 0.0, 1.0, 1.0
    if p[c, TAU_X] != 0.0 or p[c, TAU_Y] != 0.0:
        sx, cx = np.sin(p[c, TAU_X]), np.cos(p[c, TAU_X])
        sy, cy = np.sin(p[c, TAU_Y]), np.cos(p[c, TAU_Y])
    w = sy * x - cy * sx * y + cy * cx
    w = either(w > 0.0, 1.0 / w, np.nan)
    px, py = cx * x * w, (cy * y - sx * sy * x) * w
    fx, fy = p[c, FX], p[c, FY]
    ax, ay = fx * (cx - px * sy) * w, fx * px * cy * sx * w
    bx, by = fy * (-sx * sy - py * sy) * w, fy * (cy + py * cy * sx) * w
    by_uv[0, 0], by_uv[0, 1] = ax * xu + ay * yu, ax * xv + ay * yv
    by_uv[1, 0], by_uv[1, 1] = bx * xu + by * yu, bx * xv + by * yv
    d[:, :] = 0.0
    d[0, FX], d[1, FY], d[0, CX], d[1, CY] = px, py, 1.0, 1.0
    along, across = ax * u + ay * v, bx * u + by * v
    power = 1.0 / m
    for i, j in _RADIAL:
        power *= s
        d[0, i], d[1, i] = along * power, across * power
        d[0, j], d[1, j] = -q * d[0, i], -q * d[1, i]
    uu, vv, uv = s + 2.0 * u * u, s + 2.0 * v * v, 2.0 * u * v
    d[0, P1], d[1, P1] = ax * uv + ay * vv, bx * uv + by * vv
    d[0, P2], d[1, P2] = ax * uu + ay * uv, bx * uu + by * uv
    d[0, S1], d[1, S1], d[0, S2], d[1, S2] = ax * s, bx * s, ax * s * s, bx * s * s
    d[0, S3], d[1, S3], d[0, S4], d[1, S4] = ay * s, by * s, ay * s * s, by * s * s
    turn = cy * (cx * y + sx)
    d[0, TAU_X] = fx * (px * turn - sx * x) * w
    d[1, TAU_X] = fy * (py * turn - cx * sy * x) * w
    turn = cy * x + sy * (sx * y - cx)
    d[0, TAU_Y] = -fx * px * turn * w
    d[1, TAU_Y] = fy * (-sx * cy * x - sy * y - py * turn) * w
    off[0] = fx * px + p[c, CX] - xy[k, 0]
    off[1] = fy * py + p[c, CY] - xy[k, 1]


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
    xu = q + u * u * by_s + 2.0 * p[c, P1] * v + 6.0 * p[c, P2] * u
    yv = q + v * v * by_s + 6.0 * p[c, P1] * v + 2.0 * p[c, P2] * u
    if cameras.constants[c, IS_FULL] == 1.0:
        _sensor(k, c, u, v, s, q, m, x, y, xu, cross, yv, xy, cameras, by_uv, d, off)
        return
    by_uv[0, 0], by_uv[0, 1] = p[c, FX] * xu, p[c, FX] * cross
    by_uv[1, 0], by_uv[1, 1] = p[c, FY] * cross, p[c, FY] * yv
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


def _constants(options: Named[str, Any], full: bool) -> list[float]:
    return [float(full)]


for _name, _parameters in (("opencv", PARAMETERS), ("opencv_full", FULL_PARAMETERS)):
    register_camera(
        CameraModel(
            _name,
            _parameters,
            _build,
            _start,
            kernel=_opencv,
            constants=partial(_constants, full=_parameters is FULL_PARAMETERS),
        )
    )
