"""Wide-angle cameras: a projection that is symmetric about the axis, then distortion of its plane.

One family: ``fisheye`` (the equidistant projection, OpenCV's fisheye), ``equisolid``, ``orthographic``,
``stereographic``, ``omni`` (the unified sphere of Mei, OpenCV's omnidir), ``double_sphere``, ``eucm`` (the
enhanced unified model) and ``division``; mappings, kernel and registrations.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Final, Literal

import numpy as np

from ...core.compiled import kernel
from ...core.data import Array
from ..mapping import Derivatives, as_values
from .grid import PixelGrid
from .kernels import CameraColumns, either, evaluated
from .radial import Radial, first_root
from .registry import CameraModel, Parameter, register_camera

# Kinds of projection; the first constant of the kernel. The second is the number of parameters of the shape.
EQUIDISTANT, EQUISOLID, ORTHOGRAPHIC, STEREOGRAPHIC, SPHERE, TWO_SPHERES, ELLIPSOID, DIVISION = range(8)
KIND, SHAPES = 0, 1
FX, FY, CX, CY, SHAPE = range(5)
# Parameters of the plane, after those of the shape.
K1, K2, K3, K4, P1, P2, SX1, SY1 = range(8)
PLANE: Final = ("k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1")
# Below this s the quotient θ/r is a series, which loses no digits.
_SMALL = 1e-4
# Of a lens that is not wide, α and β act alike; usual values of β are 1 within this.
_PRIORS = {"beta": 0.3}
# Tangent of the largest angle at which the inverse starts.
_WIDEST = 50.0


@dataclass(frozen=True, eq=False)
class Projected(Radial):
    """Base of the family: from the ideal direction to pixels.

    With s = u² + v², a projection g(s), and its plane m = g·(u, v), t = mx² + my²::

        x' = mx·L + 2·p1·mx·my + p2(t + 2mx²) + sx1·t,   L = 1 + k1t + k2t² + k3t³ + k4t⁴
        y' = my·L + p1(t + 2my²) + 2·p2·mx·my + sy1·t,   x = fx·x' + cx,  y = fy·y' + cy

    A direction outside the domain of the projection has no image: NaN. Rays at 90° from the axis and beyond
    have no ideal direction.

    Parameters
    ----------
    values : array_like
        fx, fy, cx, cy (px), the parameters of the shape, k1 … k4, p1, p2, sx1, sy1; those that are missing at
        the end are zero. Default: fx = fy = 1, no distortion.
    """

    values: Array = field(default_factory=lambda: np.zeros(0))

    kind: ClassVar[int]
    names: ClassVar[tuple[str, ...]]
    shape_start: ClassVar[tuple[float, ...]] = ()
    """Shape of a camera of which nothing is known."""

    def __post_init__(self) -> None:
        given = np.atleast_1d(np.asarray(self.values, dtype=np.float64))
        if not given.size:
            given = np.array([1.0, 1.0, 0.0, 0.0, *self.shape_start])
        if SHAPE + len(self.shape_start) <= len(given) < len(self.names):
            given = np.concatenate([given, np.zeros(len(self.names) - len(given))])
        object.__setattr__(self, "values", as_values(self.names, given))

    @property
    def _shape(self) -> Array:
        return self.values[SHAPE : SHAPE + len(self.shape_start)]

    @property
    def _plane(self) -> Array:
        return self.values[SHAPE + len(self.shape_start) :]

    def _tangent(self, size: Array) -> Array:
        """Tangents of the angles from the axis at radii (n,) of the plane; NaN where there are none."""
        raise NotImplementedError

    def _limit(self) -> float:
        """Square of the tangent at which the domain of the projection ends."""
        return np.inf

    @cached_property
    def fold(self) -> float:
        """See :class:`~reseau.optics.cameras.radial.Radial`."""
        t = first_root([1.0, *(self._plane[:4] * [3, 5, 7, 9])])
        if not np.isfinite(t):
            return self._limit()
        with np.errstate(all="ignore"):
            r = float(self._tangent(np.array([np.sqrt(t)]))[0])
        return min(r * r, self._limit()) if np.isfinite(r) else self._limit()

    def _evaluated(self, xy: Array, *, parameters: bool = True) -> Derivatives:
        inside = np.where(((xy**2).sum(axis=1) < self._limit())[:, None], xy, np.nan)
        constants = [self.kind, len(self.shape_start)]
        return evaluated(_projected, self.values, inside, constants, parameters=parameters)

    def _start(self, xy: Array) -> Array:
        image = (xy - self.values[2:4]) / self.values[:2]
        size = np.hypot(image[:, 0], image[:, 1])
        k = self._plane[:4]
        with np.errstate(all="ignore"):
            most = np.sqrt(first_root([1.0, *(k * [3, 5, 7, 9])]))
            m = np.fmin(size, 0.95 * most)
            for _ in range(8):
                powers = (m * m)[:, None] ** np.arange(1, 5)
                step = (m * (1 + powers @ k) - size) / (1 + powers @ (k * [3, 5, 7, 9]))
                m = np.clip(m - np.clip(step, -0.3, 0.3), 0.0, 0.98 * most)
            r = self._tangent(m)
            r = np.where(r >= 0, np.fmin(r, _WIDEST), _WIDEST)
            part = np.where(size > 0, r / size, 1.0)
        return self.within(image * part[:, None])


@dataclass(frozen=True, eq=False)
class Fisheye(Projected):
    """The equidistant projection with a polynomial, OpenCV's fisheye: m = θ·(u, v)/r.

    ::

        θd = θ (1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸),  θ = arctan r,  r² = u² + v²
        x = fx·u·θd/r + cx,  y = fy·v·θd/r + cy

    Kannala, J. & Brandt, S. (2006), A generic camera model and calibration method for conventional,
    wide-angle, and fish-eye lenses, PAMI 28(8), in the form of OpenCV's module calib3d/fisheye; with p1, p2,
    sx1, sy1 of :class:`Projected` it is COLMAP's ``THIN_PRISM_FISHEYE``.

    Examples
    --------
    >>> Fisheye([800.0, 800.0, 319.5, 239.5])([[np.tan(0.5), 0.0]]).round(3)
    array([[719.5, 239.5]])
    """

    kind: ClassVar[int] = EQUIDISTANT
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", *PLANE)

    def _tangent(self, size: Array) -> Array:
        return np.where(size < np.pi / 2, np.tan(size), np.nan)


@dataclass(frozen=True, eq=False)
class Equisolid(Projected):
    """The equisolid-angle projection with a polynomial: m = 2 sin(θ/2)·(u, v)/r.

    Projection and corrections in its plane after Schneider, D., Schwalbe, E. & Maas, H.-G. (2009), Validation
    of geometric models for fisheye lenses, ISPRS J. Photogrammetry and Remote Sensing 64(3), eq. (9).

    Examples
    --------
    >>> Equisolid([800.0, 800.0, 319.5, 239.5])([[np.tan(0.5), 0.0]]).round(3)
    array([[715.346, 239.5  ]])
    """

    kind: ClassVar[int] = EQUISOLID
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", *PLANE)

    def _tangent(self, size: Array) -> Array:
        return np.where(size < np.sqrt(2), np.tan(2 * np.arcsin(size / 2)), np.nan)


@dataclass(frozen=True, eq=False)
class Orthographic(Projected):
    """The orthographic projection of the sphere of directions, with a polynomial: m = sin θ·(u, v)/r.

    Source as for :class:`Equisolid`. A camera of rays that are parallel is not this one.

    Examples
    --------
    >>> Orthographic([800.0, 800.0, 319.5, 239.5])([[np.tan(0.5), 0.0]]).round(3)
    array([[703.04, 239.5 ]])
    """

    kind: ClassVar[int] = ORTHOGRAPHIC
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", *PLANE)

    def _tangent(self, size: Array) -> Array:
        return size / np.sqrt(1 - size * size)


@dataclass(frozen=True, eq=False)
class Stereographic(Projected):
    """The stereographic projection with a polynomial: m = 2 tan(θ/2)·(u, v)/r.

    Source as for :class:`Equisolid`.

    Examples
    --------
    >>> Stereographic([800.0, 800.0, 319.5, 239.5])([[np.tan(0.5), 0.0]]).round(3)
    array([[728.047, 239.5  ]])
    """

    kind: ClassVar[int] = STEREOGRAPHIC
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", *PLANE)

    def _tangent(self, size: Array) -> Array:
        return np.where(size < 2, np.tan(2 * np.arctan(size / 2)), np.nan)


@dataclass(frozen=True, eq=False)
class Omni(Projected):
    """The unified sphere with distortion, OpenCV's omnidir without skew: m = (u, v)/(1 + ξ√(1 + r²)).

    Mei, C. & Rives, P. (2007), Single view point omnidirectional camera calibration from planar grids, ICRA,
    eq. (1)–(4). fx and fy are those of the publication: the focal length on the axis is fx/(1 + ξ).

    Examples
    --------
    >>> Omni([1600.0, 1600.0, 319.5, 239.5, 1.0])([[np.tan(0.5), 0.0]]).round(3)
    array([[728.047, 239.5  ]])
    """

    kind: ClassVar[int] = SPHERE
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", "xi", *PLANE)
    shape_start: ClassVar[tuple[float, ...]] = (0.6,)

    def _limit(self) -> float:
        xi = self._shape[0]
        return float(1 / xi**2 - 1) if -1 < xi < 0 else np.inf if xi >= 0 else 0.0

    def _tangent(self, size: Array) -> Array:
        xi, t = self._shape[0], size * size
        k = (xi + np.sqrt(1 + (1 - xi * xi) * t)) / (1 + t)
        return _positive(size * k, k - xi)


@dataclass(frozen=True, eq=False)
class DoubleSphere(Projected):
    """Two spheres with distortion: with h = √(1 + r²), w = 1 + ξh, m = (u, v)/(α√(r² + w²) + (1 − α)w).

    Usenko, V., Demmel, N. & Cremers, D. (2018), The double sphere camera model, 3DV, eq. (40)–(52). With
    ξ = 0 focal length and α act alike: α and ξ are those of a wide lens at the start. The focal length on the
    axis is fx/(1 + ξ).

    Examples
    --------
    >>> DoubleSphere([800.0, 800.0, 319.5, 239.5, 0.0, 0.5])([[np.tan(0.5), 0.0]]).round(3)
    array([[728.047, 239.5  ]])
    """

    kind: ClassVar[int] = TWO_SPHERES
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", "xi", "alpha", *PLANE)
    shape_start: ClassVar[tuple[float, ...]] = (-0.2, 0.55)

    def _limit(self) -> float:
        xi, alpha = self._shape
        if not (0 <= alpha <= 1 and xi > -1):
            return 0.0
        w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        w2 = (w1 + xi) / np.sqrt(2 * w1 * xi + xi * xi + 1)
        return float(1 / w2**2 - 1) if w2 < 0 else np.inf

    def _tangent(self, size: Array) -> Array:
        xi, alpha = self._shape
        t = size * size
        z = (1 - alpha * alpha * t) / (alpha * np.sqrt(1 - (2 * alpha - 1) * t) + 1 - alpha)
        k = (z * xi + np.sqrt(z * z + (1 - xi * xi) * t)) / (z * z + t)
        return _positive(size * k, k * z - xi)


@dataclass(frozen=True, eq=False)
class EnhancedUnified(Projected):
    """The enhanced unified model with distortion: with d = √(1 + βr²), m = (u, v)/(αd + 1 − α).

    Khomutenko, B., Garcia, G. & Martinet, P. (2016), An enhanced unified camera model, IEEE Robotics and
    Automation Letters 1(1), eq. (8), Kalibr's and Basalt's ``eucm``. With β = 1 it is the unified sphere with
    ξ = α/(1 − α); the focal length on the axis is fx.

    Examples
    --------
    >>> EnhancedUnified([800.0, 800.0, 319.5, 239.5, 0.5, 1.0])([[np.tan(0.5), 0.0]]).round(3)
    array([[728.047, 239.5  ]])
    """

    kind: ClassVar[int] = ELLIPSOID
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", "alpha", "beta", *PLANE)
    shape_start: ClassVar[tuple[float, ...]] = (0.55, 1.0)

    def _limit(self) -> float:
        alpha, beta = self._shape
        if not beta > 0:
            return 0.0
        # Beyond d the denominator is below zero, or the image shrinks.
        d = 1 - 1 / alpha if alpha < 0 else alpha / (alpha - 1) if alpha > 1 else np.inf
        return float((d * d - 1) / beta)

    def _tangent(self, size: Array) -> Array:
        alpha, beta = self._shape
        t = beta * size * size
        below = (1 - alpha * alpha * t) / (alpha * np.sqrt(1 - (2 * alpha - 1) * t) + 1 - alpha)
        return _positive(size, below)


@dataclass(frozen=True, eq=False)
class Division(Projected):
    """The division model with distortion: m = 2(u, v)/(1 + √(1 − 4λr²)), so that ``r = |m|/(1 + λ|m|²)``.

    Fitzgibbon, A. (2001), Simultaneous linear estimation of multiple view geometry and lens distortion, CVPR;
    with fx, fy and λ it is COLMAP's ``DIVISION``.

    Examples
    --------
    >>> Division([800.0, 800.0, 319.5, 239.5, -0.25])([[np.tan(0.5), 0.0]]).round(3)
    array([[728.047, 239.5  ]])
    """

    kind: ClassVar[int] = DIVISION
    names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", "lambda", *PLANE)
    shape_start: ClassVar[tuple[float, ...]] = (0.0,)

    def _limit(self) -> float:
        bend = self._shape[0]
        return float(1 / (4 * bend)) if bend > 0 else np.inf

    def _tangent(self, size: Array) -> Array:
        return _positive(size, 1 + self._shape[0] * size * size)


def _positive(above: Array, below: Array) -> Array:
    """Quotient (n,), NaN where the denominator is not above zero."""
    return np.where(below > 0, above / below, np.nan)


@kernel
def _projected(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`."""
    p, kind = cameras.values, cameras.constants[c, KIND]
    first = SHAPE + int(cameras.constants[c, SHAPES])
    s = u * u + v * v
    h = np.sqrt(1.0 + s)
    g, by_s, by_a, by_b = 1.0, 0.0, 0.0, 0.0
    if kind == EQUIDISTANT:
        r = np.sqrt(s)
        g = either(s < _SMALL, 1.0 - s * (1.0 / 3.0 - s * (0.2 - s / 7.0)), np.arctan(r) / r)
        by_s = either(s < _SMALL, -1.0 / 3.0 + s * (0.4 - s * 3.0 / 7.0), (1.0 / (1.0 + s) - g) / (2.0 * s))
    elif kind == EQUISOLID:
        g = np.sqrt(2.0 / (h * (h + 1.0)))
        by_s = -(2.0 * h + 1.0) / (2.0 * h * g * (h * h + h) ** 2)
    elif kind == ORTHOGRAPHIC:
        g = 1.0 / h
        by_s = -0.5 * g * g * g
    elif kind == STEREOGRAPHIC:
        g = 2.0 / (1.0 + h)
        by_s = -0.25 * g * g / h
    elif kind == SPHERE:
        a = p[c, SHAPE]
        below = 1.0 + a * h
        g = either(below > 0.0, 1.0 / below, np.nan)
        by_s, by_a = -a * g * g / (2.0 * h), -h * g * g
    elif kind == TWO_SPHERES:
        a, b = p[c, SHAPE], p[c, SHAPE + 1]
        w = 1.0 + a * h
        far = np.sqrt(s + w * w)
        below = b * far + (1.0 - b) * w
        g = either(below > 0.0, 1.0 / below, np.nan)
        by_h = a / (2.0 * h)
        by_s = -(b * (1.0 + 2.0 * w * by_h) / (2.0 * far) + (1.0 - b) * by_h) * g * g
        by_a, by_b = -h * (b * w / far + 1.0 - b) * g * g, (w - far) * g * g
    elif kind == ELLIPSOID:
        a, b = p[c, SHAPE], p[c, SHAPE + 1]
        far = np.sqrt(1.0 + b * s) if b > 0.0 else np.nan
        below = 1.0 + a * (far - 1.0)
        g = either(below > 0.0, 1.0 / below, np.nan)
        by_b = -a * g * g / (2.0 * far)
        by_s, by_a, by_b = b * by_b, (1.0 - far) * g * g, s * by_b
    else:
        a = p[c, SHAPE]
        inside = 1.0 - 4.0 * a * s
        root = np.sqrt(either(inside > 0.0, inside, np.nan))
        g = 2.0 / (1.0 + root)
        by_s, by_a = a * g * g / root, s * g * g / root
    x, y = u * g, v * g
    t = x * x + y * y
    k1, k2, k3, k4 = p[c, first + K1], p[c, first + K2], p[c, first + K3], p[c, first + K4]
    p1, p2, sx1, sy1 = p[c, first + P1], p[c, first + P2], p[c, first + SX1], p[c, first + SY1]
    bend = 1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))
    by_t = 2.0 * (k1 + t * (2.0 * k2 + t * (3.0 * k3 + t * 4.0 * k4)))
    xx, yy, xy2 = t + 2.0 * x * x, t + 2.0 * y * y, 2.0 * x * y
    fx, fy = p[c, FX], p[c, FY]
    image_x = x * bend + p1 * xy2 + p2 * xx + sx1 * t
    image_y = y * bend + p1 * yy + p2 * xy2 + sy1 * t
    cross = x * y * by_t + 2.0 * p1 * x + 2.0 * p2 * y
    mxx = fx * (bend + x * x * by_t + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * sx1 * x)
    mxy = fx * (cross + 2.0 * sx1 * y)
    myx = fy * (cross + 2.0 * sy1 * x)
    myy = fy * (bend + y * y * by_t + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * sy1 * y)
    along_x, along_y = mxx * u + mxy * v, myx * u + myy * v
    by_uv[0, 0], by_uv[0, 1] = mxx * g + 2.0 * by_s * u * along_x, mxy * g + 2.0 * by_s * v * along_x
    by_uv[1, 0], by_uv[1, 1] = myx * g + 2.0 * by_s * u * along_y, myy * g + 2.0 * by_s * v * along_y
    d[:, :] = 0.0
    d[0, FX], d[1, FY], d[0, CX], d[1, CY] = image_x, image_y, 1.0, 1.0
    if first > SHAPE:
        d[0, SHAPE], d[1, SHAPE] = along_x * by_a, along_y * by_a
    if first > SHAPE + 1:
        d[0, SHAPE + 1], d[1, SHAPE + 1] = along_x * by_b, along_y * by_b
    power = 1.0
    for i in range(first, first + P1):
        power *= t
        d[0, i], d[1, i] = fx * x * power, fy * y * power
    d[0, first + P1], d[1, first + P1] = fx * xy2, fy * yy
    d[0, first + P2], d[1, first + P2] = fx * xx, fy * xy2
    d[0, first + SX1], d[1, first + SY1] = fx * t, fy * t
    off[0] = fx * image_x + p[c, CX] - xy[k, 0]
    off[1] = fy * image_y + p[c, CY] - xy[k, 1]


def _register(name: str, camera: type[Projected], usual: tuple[str, ...], *, bends: bool = False) -> None:
    """Register one of the family; `bends` where the shape is zero without distortion."""
    count = len(camera.shape_start)
    # Focal lengths over those on the axis.
    scale = 1.0 / float(camera().derivatives(np.zeros((1, 2))).d_xy[0, 0, 0])

    def build(values: Array, grid: PixelGrid, options: Named[str, Any]) -> Projected:
        return camera(values)

    def start(f: float, grid: PixelGrid) -> dict[str, float]:
        shape = dict(zip(camera.names[SHAPE:], camera.shape_start, strict=False))
        centre = {"cx": (grid.width - 1) / 2, "cy": (grid.height - 1) / 2}
        return {"fx": f * scale, "fy": f * scale, **centre, **shape}

    constants: Callable[[Named[str, Any]], list[float]] = lambda options: [camera.kind, count]  # noqa: E731
    parameters = [Parameter(each, "px", "scale", True, True) for each in ("fx", "fy")]
    parameters += [Parameter(each, "px", "centre", True, True) for each in ("cx", "cy")]
    for each in camera.names[SHAPE : SHAPE + count]:
        role: Literal["distortion", "shape"] = "distortion" if bends else "shape"
        parameters.append(Parameter(each, "", role, True, not bends, _PRIORS.get(each, 0.0)))
    parameters += [Parameter(each, usual=each in usual) for each in PLANE]
    register_camera(
        CameraModel(name, tuple(parameters), build, start, kernel=_projected, constants=constants)
    )


_register("fisheye", Fisheye, ("k1", "k2", "k3", "k4"))
_register("equisolid", Equisolid, ("k1", "k2"))
_register("orthographic", Orthographic, ("k1", "k2"))
_register("stereographic", Stereographic, ("k1", "k2"))
_register("omni", Omni, ("p1", "p2"))
_register("double_sphere", DoubleSphere, ())
_register("eucm", EnhancedUnified, ())
_register("division", Division, ("p1", "p2"), bends=True)
