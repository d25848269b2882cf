"""A camera with a spline surface, ``splined_stereographic``: mrcal's model; mapping, kernel, registration.

The grid of the surface is part of the name, as in mrcal:
``splined_stereographic_order=3_Nx=16_Ny=11_fov_x_deg=120``. The plain name has the grid of ``DEFAULT``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Named
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import kernel
from ...core.data import Array, Rows
from ...core.errors import UsageError
from ..mapping import Derivatives, PlaneMapping, as_points, as_values
from .grid import PixelGrid
from .kernels import CameraColumns
from .registry import CameraModel, Parameter, register_camera, register_family

NAME = "splined_stereographic"
FX, FY, CX, CY, CONTROL = range(5)
# Constants of the kernel.
ORDER, NX, NY, PER_U = range(4)
# Corrections of directions (rad) are observed as zero with this standard deviation: regularisation.
PRIOR = 0.1
_PATTERN = re.compile(rf"{NAME}_order=(\d+)_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+)")
_STEPS = 12


class SplineGrid(NamedTuple):
    """Grid of a spline surface.

    Parameters
    ----------
    order : int
        Degree of the pieces: 3 (cubic) or 2 (quadratic).
    nx, ny : int
        Control points along the rows and columns.
    fov_x_deg : int
        Angle of view across the columns that the surface covers, degrees.

    Examples
    --------
    >>> SplineGrid(3, 11, 8, 100).name
    'splined_stereographic_order=3_Nx=11_Ny=8_fov_x_deg=100'
    """

    order: int
    nx: int
    ny: int
    fov_x_deg: int

    @property
    def name(self) -> str:
        """Name of the model."""
        return f"{NAME}_order={self.order}_Nx={self.nx}_Ny={self.ny}_fov_x_deg={self.fov_x_deg}"

    @property
    def per_u(self) -> float:
        """Intervals of the grid per unit of the stereographic plane: nx − order of them cover the angle."""
        return float((self.nx - self.order) / (4 * np.tan(np.deg2rad(self.fov_x_deg) / 4)))

    def checked(self) -> SplineGrid:
        """The grid, if there can be one.

        Raises
        ------
        UsageError
            When the order is neither 2 nor 3, there are too few control points, or the angle of view is not
            between 0 and 360°.
        """
        if self.order not in (2, 3) or min(self.nx, self.ny) < self.order + 1 or not 0 < self.fov_x_deg < 360:
            raise UsageError(
                "needs an order of 2 or 3, more control points than that, and an angle of view below 360",
                where=self.name,
            )
        return self


DEFAULT = SplineGrid(3, 11, 8, 100)


@dataclass(frozen=True, eq=False)
class SplinedStereographic(PlaneMapping):
    """The stereographic projection with a spline surface of corrections: from the ideal direction to pixels.

    With u the stereographic projection of the direction, |u| = 2 tan(θ/2), and a surface Δ(u) of uniform
    B-splines whose control points are the parameters, x = fx·(ux + Δx) + cx, y = fy·(uy + Δy) + cy.

    Kogan, D., *mrcal*, LENSMODEL_SPLINED_STEREOGRAPHIC; uniform B-splines as in de Boor, A Practical Guide to
    Splines (1978). Beyond the outer knots the outermost pieces go on.

    fx, fy, cx, cy act like corrections that are linear in u; a small rotation of the camera too: the surface
    is determined only with a regularisation, see ``docs/mathematics/models.md``.

    Parameters
    ----------
    values : array_like (4 + 2·nx·ny,)
        fx, fy, cx, cy (px), then ux, uy (rad) of each control point, row by row.
    grid : SplineGrid
        Grid of the control points.

    Examples
    --------
    >>> camera = SplinedStereographic([800.0, 800.0, 319.5, 239.5, *np.zeros(176)])
    >>> camera([[np.tan(0.5), 0.0]]).round(3)
    array([[728.047, 239.5  ]])
    """

    values: Array = field(default_factory=lambda: np.array([1.0, 1.0, *np.zeros(2 + 2 * 88)]))
    grid: SplineGrid = DEFAULT

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    @property
    def names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy, and ux_i_j, uy_i_j of the control point in row i and column j."""
        return names_of(self.grid)

    @cached_property
    def _control(self) -> Array:
        return self.values[CONTROL:].reshape(self.grid.ny, self.grid.nx, 2)

    def _weights(self, u: Array) -> tuple[Rows, Rows, Array, Array, Array, Array]:
        """First column and row of the control points of each point, weights and slopes along both axes."""
        found: list[Any] = []
        for axis, count in ((0, self.grid.nx), (1, self.grid.ny)):
            at = u[:, axis] * self.grid.per_u + (count - 1) / 2
            found.append(_b_spline(at, self.grid.order, count))
        (i, wx, dx), (j, wy, dy) = found
        return i, j, wx, wy, dx * self.grid.per_u, dy * self.grid.per_u

    def _corrections(self, u: Array) -> tuple[Array, Array, tuple[Rows, Array]]:
        """Δ (n, 2), its derivatives by u (n, 2, 2), and rows and weights of the control points (n, k)."""
        i, j, wx, wy, dx, dy = self._weights(np.nan_to_num(u))
        k = np.arange(self.grid.order + 1)
        rows = (j[:, None] + k)[:, :, None] * self.grid.nx + (i[:, None] + k)[:, None, :]
        points = self._control.reshape(-1, 2)[rows]
        value = np.einsum("nj,ni,njic->nc", wy, wx, points)
        slope = np.stack(
            [np.einsum("nj,ni,njic->nc", wy, dx, points), np.einsum("nj,ni,njic->nc", dy, wx, points)], axis=2
        )
        weights = wy[:, :, None] * wx[:, None, :]
        shape = (len(u), (self.grid.order + 1) ** 2)
        return value, slope, (rows.reshape(shape).astype(np.intp), weights.reshape(shape))

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        uv = as_points(xy)
        focal = self.values[:2]
        u, by_uv = _stereographic(uv)
        off, slope, (rows, weights) = self._corrections(u)
        off[np.isnan(u).any(axis=1)] = np.nan
        d = np.zeros((len(uv), 2, len(self.values)))
        d[:, [0, 1], [FX, FY]] = u + off
        d[:, [0, 1], [CX, CY]] = 1.0
        every = np.arange(len(uv))[:, None]
        for axis in (0, 1):
            d[every, axis, CONTROL + 2 * rows + axis] = focal[axis] * weights
        value = (u + off) * focal + self.values[2:4]
        return Derivatives(value, ((np.eye(2) + slope) @ by_uv) * focal[:, None], d)

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        u, by_uv = _stereographic(xy)
        off, slope, _ = self._corrections(u)
        off[np.isnan(u).any(axis=1)] = np.nan
        value = (u + off) * self.values[:2] + self.values[2:4]
        return value, ((np.eye(2) + slope) @ by_uv) * self.values[:2, None]

    def _start(self, xy: Array) -> Array:
        image = (xy - self.values[2:4]) / self.values[:2]
        u = image.copy()
        for _ in range(_STEPS):
            off, slope, _ = self._corrections(u)
            step = np.linalg.solve(np.eye(2) + np.clip(slope, -0.45, 0.45), (image - u - off)[:, :, None])
            u = u + np.clip(step[:, :, 0], -0.3, 0.3)
        size = (u**2).sum(axis=1, keepdims=True)
        # Tangents of the angles; nothing is seen at 90° and beyond.
        return np.asarray(u / np.where(size < 3.99, 1 - size / 4, np.nan))


def names_of(grid: SplineGrid) -> tuple[str, ...]:
    """Names of the parameters."""
    control = [f"u{axis}_{j}_{i}" for j in range(grid.ny) for i in range(grid.nx) for axis in "xy"]
    return ("fx", "fy", "cx", "cy", *control)


def _stereographic(uv: Array) -> tuple[Array, Array]:
    """Stereographic projection (n, 2) of directions, and its derivatives (n, 2, 2)."""
    h = np.sqrt(1 + (uv**2).sum(axis=1))
    g = 2 / (1 + h)
    slope = g[:, None, None] * np.eye(2) - (g * g / (2 * h))[:, None, None] * uv[:, :, None] * uv[:, None, :]
    return uv * g[:, None], slope


def _b_spline(at: Array, order: int, count: int) -> tuple[Rows, Array, Array]:
    """First control point (n,) of the pieces at places on a grid, weights and their slopes (n, order + 1)."""
    piece = np.floor(at) if order == 3 else np.floor(at + 0.5)
    piece = np.clip(piece, 1, count - 3 if order == 3 else count - 2)
    x = at - piece
    if order == 3:
        w = [(1 - x) ** 3, 3 * x**3 - 6 * x**2 + 4, -3 * x**3 + 3 * x**2 + 3 * x + 1, x**3]
        d = [-3 * (1 - x) ** 2, 9 * x**2 - 12 * x, -9 * x**2 + 6 * x + 3, 3 * x**2]
        weights, slopes = np.stack(w, axis=1) / 6, np.stack(d, axis=1) / 6
    else:
        w = [(1 - 2 * x) ** 2, 6 - 8 * x**2, (1 + 2 * x) ** 2]
        d = [-4 * (1 - 2 * x), -16 * x, 4 * (1 + 2 * x)]
        weights, slopes = np.stack(w, axis=1) / 8, np.stack(d, axis=1) / 8
    return (piece - 1).astype(np.intp), weights, slopes


@kernel
def _piece(at: float, order: int, count: int, w: Array, d: Array, axis: int) -> int:
    """Write weights and slopes of the pieces at a place on a grid; return the first control point."""
    shift = 0.0 if order == 3 else 0.5
    last = count - 3.0 if order == 3 else count - 2.0
    piece = min(max(np.floor(at + shift), 1.0), last)
    x = at - piece
    y, z = 1.0 - x, 1.0 + 2.0 * x
    if order == 3:
        w[axis, 0], d[axis, 0] = y * y * y / 6.0, -y * y / 2.0
        w[axis, 1], d[axis, 1] = (x * x * (3.0 * x - 6.0) + 4.0) / 6.0, x * (3.0 * x - 4.0) / 2.0
        w[axis, 2] = (x * (x * (3.0 - 3.0 * x) + 3.0) + 1.0) / 6.0
        d[axis, 2] = (x * (2.0 - 3.0 * x) + 1.0) / 2.0
        w[axis, 3], d[axis, 3] = x * x * x / 6.0, x * x / 2.0
    else:
        w[axis, 0], d[axis, 0] = (y - x) * (y - x) / 8.0, x - 0.5
        w[axis, 1], d[axis, 1] = 0.75 - x * x, -2.0 * x
        w[axis, 2], d[axis, 2] = z * z / 8.0, x + 0.5
    return int(piece) - 1


@kernel
def _splined(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`."""
    p, constants = cameras.values, cameras.constants
    order, nx, ny = int(constants[c, ORDER]), int(constants[c, NX]), int(constants[c, NY])
    per_u = constants[c, PER_U]
    h = np.sqrt(1.0 + u * u + v * v)
    g = 2.0 / (1.0 + h)
    b = g * g / (2.0 * h)
    sx, sy = u * g, v * g
    w, slope = np.empty((2, 4)), np.empty((2, 4))
    i = _piece(sx * per_u + (nx - 1) / 2.0, order, nx, w, slope, 0)
    j = _piece(sy * per_u + (ny - 1) / 2.0, order, ny, w, slope, 1)
    d[:, :] = 0.0
    fx, fy = p[c, FX], p[c, FY]
    x, y, xx, xy_, yx, yy = sx, sy, 1.0, 0.0, 0.0, 1.0
    for q in range(order + 1):
        for s in range(order + 1):
            at = CONTROL + 2 * ((j + q) * nx + i + s)
            weight = w[1, q] * w[0, s]
            along_x, along_y = w[1, q] * slope[0, s] * per_u, slope[1, q] * w[0, s] * per_u
            x += weight * p[c, at]
            y += weight * p[c, at + 1]
            xx += along_x * p[c, at]
            xy_ += along_y * p[c, at]
            yx += along_x * p[c, at + 1]
            yy += along_y * p[c, at + 1]
            d[0, at], d[1, at + 1] = fx * weight, fy * weight
    a, m, e2 = g - b * u * u, -b * u * v, g - b * v * v
    by_uv[0, 0], by_uv[0, 1] = fx * (xx * a + xy_ * m), fx * (xx * m + xy_ * e2)
    by_uv[1, 0], by_uv[1, 1] = fy * (yx * a + yy * m), fy * (yx * m + yy * e2)
    d[0, FX], d[1, FY], d[0, CX], d[1, CY] = x, y, 1.0, 1.0
    off[0] = fx * x + p[c, CX] - xy[k, 0]
    off[1] = fy * y + p[c, CY] - xy[k, 1]


def model_of(name: str) -> CameraModel | None:
    """The camera model of a name with a grid; None for another name.

    Raises
    ------
    UsageError
        When the name describes no possible grid.
    """
    found = _PATTERN.fullmatch(name)
    if found is None:
        return None
    order, nx, ny, fov = (int(each) for each in found.groups())
    return _model(name, SplineGrid(order, nx, ny, fov).checked())


def _model(name: str, grid: SplineGrid) -> CameraModel:
    def build(values: Array, pixels: PixelGrid, options: Named[str, Any]) -> SplinedStereographic:
        return SplinedStereographic(values, grid)

    def start(f: float, pixels: PixelGrid) -> dict[str, float]:
        return {"fx": f, "fy": f, "cx": (pixels.width - 1) / 2, "cy": (pixels.height - 1) / 2}

    def constants(options: Named[str, Any]) -> list[float]:
        return [grid.order, grid.nx, grid.ny, grid.per_u]

    parameters = [Parameter(each, "px", "scale", required=True) for each in ("fx", "fy")]
    parameters += [Parameter(each, "px", "centre", required=True) for each in ("cx", "cy")]
    parameters += [Parameter(each, "rad", usual=True, prior=PRIOR) for each in names_of(grid)[CONTROL:]]
    return CameraModel(name, tuple(parameters), build, start, kernel=_splined, constants=constants)


register_camera(_model(NAME, DEFAULT))
register_family(NAME, model_of)
