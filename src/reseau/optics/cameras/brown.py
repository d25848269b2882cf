"""Brown's camera model, ``brown``, and with higher radial terms, ``brown_higher``: mapping and kernel."""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import kernel
from ...core.data import Array, Mask
from ...core.errors import UsageError
from ..composition import Inverted
from ..mapping import Derivatives, PlaneMapping, as_points, as_values
from .grid import PixelGrid
from .kernels import CameraColumns, additional
from .radial import Radial, first_root
from .registry import CameraModel, Option, Parameter, register_camera

PARAMETERS = (
    Parameter("c", "mm", "scale", usual=True, required=True),
    Parameter("x0", "mm", "centre", usual=True),
    Parameter("y0", "mm", "centre", usual=True),
    Parameter("K1", "mm^-2", usual=True),
    Parameter("K2", "mm^-4", usual=True),
    Parameter("K3", "mm^-6"),
    Parameter("P1", "mm^-1", usual=True),
    Parameter("P2", "mm^-1", usual=True),
    Parameter("B1"),
    Parameter("B2"),
)
HIGHER_PARAMETERS = (*PARAMETERS, Parameter("K4", "mm^-8"), Parameter("K5", "mm^-10"))
C, X0, Y0, K1, K2, K3, P1, P2, B1, B2, K4, K5 = range(len(HIGHER_PARAMETERS))
# Constants of the kernel: one for the image side, powers of the balance radius, and one for higher terms.
SIDE, BALANCE2, BALANCE4, BALANCE6, BALANCE8, BALANCE10, IS_HIGHER = range(7)


@dataclass(frozen=True, eq=False)
class BrownDistortion(Radial):
    """Radial and decentering distortion with affinity, in the plane of the photo (mm): (x, y) + (Δx, Δy).

    ::

        Δx = x·[K1(r²−R0²) + K2(r⁴−R0⁴) + K3(r⁶−R0⁶)] + P1(r²+2x²) + 2·P2·xy + B1·x + B2·y
        Δy = y·[K1(r²−R0²) + K2(r⁴−R0⁴) + K3(r⁶−R0⁶)] + P2(r²+2y²) + 2·P1·xy

    Radial and decentering terms after Brown (1971), Close-range camera calibration, Photogrammetric
    Engineering 37(8); the balance radius R0, where the radial distortion vanishes, and the affinity as in
    Luhmann et al., Close-Range Photogrammetry and 3D Imaging. With nine values the radial terms go on with
    K4(r⁸−R0⁸) + K5(r¹⁰−R0¹⁰).

    Parameters
    ----------
    values : array_like (7,) or (9,)
        K1 (mm⁻²), K2 (mm⁻⁴), K3 (mm⁻⁶), P1, P2 (mm⁻¹), B1, B2; then K4 (mm⁻⁸), K5 (mm⁻¹⁰).
    balance_radius_mm : float
        R0.

    Examples
    --------
    >>> BrownDistortion([1e-3, 0, 0, 0, 0, 0, 0])([[2.0, 0.0]])
    array([[2.008, 0.   ]])
    """

    ALL_NAMES: ClassVar[tuple[str, ...]] = tuple(p.name for p in HIGHER_PARAMETERS[K1:])
    values: Array = field(default_factory=lambda: np.zeros(7))
    balance_radius_mm: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.ALL_NAMES) - 2 * (np.size(self.values) != len(self.ALL_NAMES))
        object.__setattr__(self, "values", as_values(self.ALL_NAMES[:count], self.values))

    @property
    def names(self) -> tuple[str, ...]:
        """The seven names, or nine with higher terms."""
        return self.ALL_NAMES[: len(self.values)]

    @cached_property
    def radial(self) -> Array:
        """K1, K2, K3, and with higher terms K4, K5."""
        return np.concatenate([self.values[:3], self.values[7:]])

    @cached_property
    def balance(self) -> Array:
        """R0², R0⁴, R0⁶ …, one for each radial term."""
        return self.balance_radius_mm ** np.array([2.0, 4.0, 6.0, 8.0, 10.0])[: len(self.radial)]

    @cached_property
    def fold(self) -> float:
        """See :class:`~reseau.optics.cameras.radial.Radial`."""
        k = self.radial
        at_centre = 1 - float(k @ self.balance)
        # d/dr of r·(1 + …) in powers of r².
        growth = [at_centre, *((2 * np.arange(len(k)) + 3) * k)]
        return first_root(growth) if at_centre > 0 else 0.0

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        k1, k2, k3, p1, p2, b1, b2, *more = self.values
        x, y = xy[:, 0], xy[:, 1]
        s = x * x + y * y
        radial = 1 - self.radial @ self.balance + s * (k1 + s * (k2 + s * k3))
        by_s = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
        if more:
            k4, k5 = more
            radial, by_s = radial + s**4 * (k4 + s * k5), by_s + 2 * s**3 * (4 * k4 + s * 5 * k5)
        value = np.stack(
            [
                x * radial + p1 * (s + 2 * x * x) + 2 * p2 * x * y + b1 * x + b2 * y,
                y * radial + p2 * (s + 2 * y * y) + 2 * p1 * x * y,
            ],
            axis=1,
        )
        d_xy = np.empty((len(xy), 2, 2))
        cross = x * y * by_s + 2 * p1 * y + 2 * p2 * x
        d_xy[:, 0, 0] = radial + x * x * by_s + 6 * p1 * x + 2 * p2 * y + b1
        d_xy[:, 0, 1] = cross + b2
        d_xy[:, 1, 0] = cross
        d_xy[:, 1, 1] = radial + y * y * by_s + 6 * p2 * y + 2 * p1 * x
        return value, d_xy

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        value, d_xy = self._slope(points)
        x, y = points[:, 0], points[:, 1]
        s = x * x + y * y
        d = np.zeros((len(points), 2, len(self.values)))
        powers = np.stack([s, s**2, s**3, s**4, s**5][: len(self.radial)], axis=1) - self.balance
        d[:, :, :3] = points[:, :, None] * powers[:, None, :3]
        d[:, :, 7:] = points[:, :, None] * powers[:, None, 3:]
        d[:, 0, 3], d[:, 1, 3] = s + 2 * x * x, 2 * x * y
        d[:, 0, 4], d[:, 1, 4] = 2 * x * y, s + 2 * y * y
        d[:, 0, 5], d[:, 0, 6] = x, y
        return Derivatives(value, d_xy, d)

    def _start(self, xy: Array) -> Array:
        return self.within(xy)


@dataclass(frozen=True, eq=False)
class Brown(PlaneMapping):
    """Camera with Brown's distortion: ideal direction to photo-coordinates (mm), or to pixels with a grid.

    With xs = c·u, ys = −c·v and Δ of :class:`BrownDistortion`: ``side="object"`` (AICON, the direction of
    OpenCV) adds the distortion of the ideal point, x' = x0 + xs + Δx(xs, ys). ``side="image"`` (PhotoModeler,
    Australis) uses that of the measured point: xm = x' − x0, xm + Δx(xm, ym) = xs; a point beyond the fold of
    this polynomial has no image, and its image is NaN.

    Parameters
    ----------
    values : array_like (10,) or (12,)
        c, x0, y0 (mm), then the parameters of the distortion. Default: c = 1, all others zero.
    side : {"object", "image"}
        Coordinates of which the distortion is a function: the ideal ones, or those in the image.
    balance_radius_mm : float
        R0.
    grid : PixelGrid, optional
        With it the image is in pixels, without it in photo-coordinates.

    Examples
    --------
    >>> camera = Brown(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0, "K1": 1e-3})
    >>> camera([[0.1, 0.0]]).round(3)
    array([[399.551, 239.5  ]])
    """

    ALL_NAMES: ClassVar[tuple[str, ...]] = tuple(p.name for p in HIGHER_PARAMETERS)
    values: Array = field(default_factory=lambda: np.array([1.0] + 9 * [0.0]))
    side: Literal["image", "object"] = "object"
    balance_radius_mm: float = 0.0
    grid: PixelGrid | None = None

    def __post_init__(self) -> None:
        count = len(self.ALL_NAMES) - 2 * (np.size(self.values) != len(self.ALL_NAMES))
        object.__setattr__(self, "values", as_values(self.ALL_NAMES[:count], self.values))
        if self.side not in ("image", "object"):
            raise UsageError(f"is {self.side!r}", where="side of a camera", do="write `image` or `object`")

    @property
    def names(self) -> tuple[str, ...]:
        """The ten names, or twelve with higher terms."""
        return self.ALL_NAMES[: len(self.values)]

    @cached_property
    def distortion(self) -> BrownDistortion:
        """The distortion, about the principal point."""
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
        d = np.empty((len(points), 2, len(self.values)))
        d[:, :, 0] = (d_xy @ (points * [1.0, -1.0])[:, :, None])[:, :, 0]
        d[:, :, 1:3] = np.eye(2)
        d[:, :, 3:] = d_lens
        value = self._from_photo(photo + self.values[1:3])
        return Derivatives(value, scale[:, None] * d_xy * self._ideal, scale[:, None] * d)

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the distortion has not folded on the way to these directions, (n,)."""
        return self._lens.one_to_one(as_points(xy) * self._ideal)

    def _inverse(self, xy: Array) -> Array:
        photo = xy if self.grid is None else self.grid.to_photo(xy)
        if self.values[0] == 0:
            return np.full(xy.shape, np.nan)
        return self._lens.inverse(photo - self.values[1:3]) / self._ideal


@dataclass(frozen=True, eq=False)
class BrownWithAdditional(PlaneMapping):
    """Brown's camera on the object side with additional parameters: from the ideal direction to pixels.

    Parameters
    ----------
    camera : Brown
        With a grid.
    additional : PlaneMapping
        Correction of photo-coordinates (mm); its parameters follow those of the camera.

    Raises
    ------
    UsageError
        When the camera has no grid or its distortion is on the image side.

    Examples
    --------
    >>> from reseau.optics.cameras.ebner import EbnerCorrection
    >>> camera = Brown(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0})
    >>> extra = EbnerCorrection(base_mm=2.0).with_values({"b1": 1e-3})
    >>> BrownWithAdditional(camera, extra)([[0.1, 0.0]]).round(6)
    array([[399.58, 239.5 ]])
    """

    camera: Brown
    additional: PlaneMapping

    def __post_init__(self) -> None:
        if self.camera.grid is None or self.camera.side == "image":
            raise UsageError(
                "needs a Brown camera on the object side, with a grid", where="additional parameters"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return (*self.camera.names, *self.additional.names)

    @property
    def values(self) -> Array:
        """Values of all parameters."""
        return np.concatenate([self.camera.values, self.additional.values])

    @property
    def parallel(self) -> bool:
        """As of the camera."""
        return self.camera.parallel

    def _replaced(self, values: Array) -> Self:
        count = len(self.camera.names)
        return replace(
            self,
            camera=self.camera.with_values(values[:count]),
            additional=self.additional.with_values(values[count:]),
        )

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        seen, grid, c = self.camera.derivatives(xy), self.camera.grid, self.camera.values[0]
        assert grid is not None
        turned, scale = np.array([1.0, -1.0]), grid.pixels_per_mm
        ideal = c * turned * np.asarray(xy, dtype=np.float64)
        more = self.additional.derivatives(ideal)
        slope = scale[:, None] * (more.d_xy - np.eye(2)) * turned
        by_camera = seen.d_parameters.copy()
        by_camera[:, :, 0] += (slope @ np.asarray(xy, dtype=np.float64)[:, :, None])[:, :, 0]
        return Derivatives(
            seen.value + grid.to_pixels(more.value - ideal) - grid.to_pixels(np.zeros((1, 2))),
            seen.d_xy + c * slope,
            np.concatenate([by_camera, scale[:, None] * more.d_parameters], axis=2),
        )


@kernel
def brown_kernel(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`.

    With the distortion on the image side the misfit is that of the corrected image point,
    v = xs − (xm + Δ(xm)), as in PhotoModeler and DBAT; on the object side it is that of the measured one.
    """
    p, constants, grid = cameras.values, cameras.constants, cameras.grid
    f = p[c, C]
    px, py = 1.0 / grid[c, 2], -1.0 / grid[c, 3]
    xp, yp = (xy[k, 0] - grid[c, 0]) * grid[c, 2], -(xy[k, 1] - grid[c, 1]) * grid[c, 3]
    on_object = constants[c, SIDE] == 0.0
    if on_object:
        x, y, sign = f * u, -f * v, 1.0
    else:
        x, y, sign = xp - p[c, X0], yp - p[c, Y0], -1.0
    # Brown's Δ at x, y, and its derivatives by x and y.
    s = x * x + y * y
    q1, q2, q3 = (
        s - constants[c, BALANCE2],
        s * s - constants[c, BALANCE4],
        s * s * s - constants[c, BALANCE6],
    )
    radial = p[c, K1] * q1 + p[c, K2] * q2 + p[c, K3] * q3
    by_s = 2.0 * (p[c, K1] + s * (2.0 * p[c, K2] + 3.0 * p[c, K3] * s))
    if constants[c, IS_HIGHER] == 1.0:
        s3 = s * s * s
        q4, q5 = s3 * s - constants[c, BALANCE8], s3 * s * s - constants[c, BALANCE10]
        radial += p[c, K4] * q4 + p[c, K5] * q5
        by_s += 2.0 * s3 * (4.0 * p[c, K4] + 5.0 * p[c, K5] * s)
        d[0, K4], d[1, K4] = sign * px * x * q4, sign * py * y * q4
        d[0, K5], d[1, K5] = sign * px * x * q5, sign * py * y * q5
    xx, yy, xy2 = s + 2.0 * x * x, s + 2.0 * y * y, 2.0 * x * y
    dx = x * radial + p[c, P1] * xx + p[c, P2] * xy2 + p[c, B1] * x + p[c, B2] * y
    dy = y * radial + p[c, P2] * yy + p[c, P1] * xy2
    cross = x * y * by_s + 2.0 * p[c, P1] * y + 2.0 * p[c, P2] * x
    sxx = radial + x * x * by_s + 6.0 * p[c, P1] * x + 2.0 * p[c, P2] * y + p[c, B1]
    sxy = cross + p[c, B2]
    syx = cross
    syy = radial + y * y * by_s + 6.0 * p[c, P2] * y + 2.0 * p[c, P1] * x
    if e >= 0:
        dx, dy, sxx, sxy, syx, syy = additional(e, x, y, cameras, dx, dy, sxx, sxy, syx, syy, more)
        for i in range(more.shape[1]):
            more[0, i] *= sign * px
            more[1, i] *= sign * py
    d[0, K1], d[1, K1], d[0, K2], d[1, K2], d[0, K3], d[1, K3] = (
        x * q1,
        y * q1,
        x * q2,
        y * q2,
        x * q3,
        y * q3,
    )
    d[0, P1], d[1, P1], d[0, P2], d[1, P2] = xx, xy2, xy2, yy
    d[0, B1], d[1, B1], d[0, B2], d[1, B2] = x, 0.0, y, 0.0
    sxx, syy = 1.0 + sxx, 1.0 + syy
    if on_object:
        dx += x + p[c, X0] - xp
        dy += y + p[c, Y0] - yp
        by_uv[0, 0], by_uv[0, 1], by_uv[1, 0], by_uv[1, 1] = f * sxx, -f * sxy, f * syx, -f * syy
        d[0, C], d[1, C] = sxx * u - sxy * v, syx * u - syy * v
        d[0, X0], d[1, X0], d[0, Y0], d[1, Y0] = 1.0, 0.0, 0.0, 1.0
    else:
        dx = f * u - x - dx
        dy = -f * v - y - dy
        by_uv[0, 0], by_uv[0, 1], by_uv[1, 0], by_uv[1, 1] = f, 0.0, 0.0, -f
        d[0, C], d[1, C] = u, -v
        d[0, X0], d[1, X0], d[0, Y0], d[1, Y0] = sxx, syx, sxy, syy
    for i in range(K1, B2 + 1):
        d[0, i] *= sign * px
        d[1, i] *= sign * py
    for i in range(K1):
        d[0, i] *= px
        d[1, i] *= py
    off[0] = dx * px
    off[1] = dy * py
    by_uv[0, 0] *= px
    by_uv[0, 1] *= px
    by_uv[1, 0] *= py
    by_uv[1, 1] *= py


def _build(values: Array, grid: PixelGrid, options: Named[str, Any]) -> Brown:
    return Brown(values, options["side"], options["balance_radius_mm"], grid)


def _start(f: float, grid: PixelGrid) -> dict[str, float]:
    return {"c": f * grid.pitch_mm[0]}


def with_additional(camera: Brown, extra: PlaneMapping) -> BrownWithAdditional | None:
    """Return the camera with additional parameters; None with the distortion on the image side."""
    return None if camera.side == "image" else BrownWithAdditional(camera, extra)


def brown_constants(options: Named[str, Any], higher: bool) -> list[float]:
    """Return what the kernel finds in `CameraColumns.constants`."""
    radius = float(options["balance_radius_mm"]) ** np.array([2.0, 4.0, 6.0, 8.0, 10.0])
    return [float(options["side"] == "image"), *radius.tolist(), float(higher)]


for _name, _parameters in (("brown", PARAMETERS), ("brown_higher", HIGHER_PARAMETERS)):
    register_camera(
        CameraModel(
            _name,
            _parameters,
            _build,
            _start,
            (Option("side", "object", ("object", "image"), required=True), Option("balance_radius_mm", 0.0)),
            needs_pitch=True,
            combine=with_additional,
            kernel=brown_kernel,
            constants=partial(brown_constants, higher=_parameters is HIGHER_PARAMETERS),
        )
    )
