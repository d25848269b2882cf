"""A camera model with a kernel, as a user adds one: the division model of Fitzgibbon (2001).

An ideal radius ρ and the image radius r (in units of the focal length) satisfy ρ = r / (1 + λ r²), so that
r = 2ρ / (1 + √(1 − 4λρ²)).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from reseau.core.compiled import kernel
from reseau.core.data import Array
from reseau.optics import PixelGrid
from reseau.optics.cameras import Parameter
from reseau.optics.cameras.kernels import CameraColumns
from reseau.optics.cameras.registry import CameraModel
from reseau.optics.mapping import Derivatives, PlaneMapping, as_points, as_values

PARAMETERS = (
    Parameter("focal", "mm", "scale", usual=True, required=True),
    Parameter("xh", "px", "centre", usual=True),
    Parameter("yh", "px", "centre", usual=True),
    Parameter("lambda", usual=True),
)
FOCAL, XH, YH, LAMBDA = range(len(PARAMETERS))


@dataclass(frozen=True, eq=False)
class Division(PlaneMapping):
    """From the ideal direction to pixels; the focal length in millimetres."""

    values: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    grid: PixelGrid = field(default_factory=lambda: PixelGrid(1, 1, (1.0, 1.0)))

    names: ClassVar[tuple[str, ...]] = tuple(p.name for p in PARAMETERS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        focal, xh, yh, bend = self.values
        s = (points**2).sum(axis=1)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1 - 4 * bend * s)
        q = 2 / (1 + root)
        by_s, by_bend = 2 * bend * q * q / (2 * root), s * q * q / root
        scale = focal / np.array(self.grid.pitch_mm)
        d_xy = (
            q[:, None, None] * np.eye(2) + 2 * by_s[:, None, None] * points[:, :, None] * points[:, None, :]
        )
        d = np.zeros((len(points), 2, 4))
        d[:, :, FOCAL] = q[:, None] * points / self.grid.pitch_mm
        d[:, 0, XH] = d[:, 1, YH] = 1.0
        d[:, :, LAMBDA] = scale * by_bend[:, None] * points
        value = scale * q[:, None] * points + [xh, yh] + self.grid.centre
        return Derivatives(value, scale[:, None] * d_xy, d)


@kernel
def division_kernel(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """See :mod:`reseau.optics.cameras.kernels`."""
    p, grid = cameras.values, cameras.grid
    s = u * u + v * v
    root = np.sqrt(1.0 - 4.0 * p[c, LAMBDA] * s)
    q = 2.0 / (1.0 + root)
    by_s, by_bend = 2.0 * p[c, LAMBDA] * q * q / (2.0 * root), s * q * q / root
    fx, fy = p[c, FOCAL] / grid[c, 2], p[c, FOCAL] / grid[c, 3]
    by_uv[0, 0], by_uv[0, 1] = fx * (q + 2.0 * by_s * u * u), fx * 2.0 * by_s * u * v
    by_uv[1, 0], by_uv[1, 1] = fy * 2.0 * by_s * u * v, fy * (q + 2.0 * by_s * v * v)
    d[0, FOCAL], d[1, FOCAL] = q * u / grid[c, 2], q * v / grid[c, 3]
    d[0, XH], d[1, XH], d[0, YH], d[1, YH] = 1.0, 0.0, 0.0, 1.0
    d[0, LAMBDA], d[1, LAMBDA] = fx * by_bend * u, fy * by_bend * v
    off[0] = fx * q * u + p[c, XH] + grid[c, 0] - xy[k, 0]
    off[1] = fy * q * v + p[c, YH] + grid[c, 1] - xy[k, 1]


def build(values: Array, grid: PixelGrid, options: Mapping[str, Any]) -> Division:
    """The mapping of the model."""
    return Division(values, grid)


MODEL = CameraModel(
    "fitzgibbon",
    PARAMETERS,
    build,
    lambda f, grid: {"focal": f * grid.pitch_mm[0]},
    needs_pitch=True,
    kernel=division_kernel,
)
