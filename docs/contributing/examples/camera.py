"""A camera model in one module: the field-of-view model of Devernay and Faugeras (2001), eq. 13.

A ray at the tangent r from the axis has its image at r_d = atan(2 r tan(ω/2)) / ω, in focal lengths.
Entry point: ``[project.entry-points."reseau.cameras"] fov = "camera:MODEL"``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from reseau.core.data import Array
from reseau.optics import PixelGrid
from reseau.optics.cameras import Parameter
from reseau.optics.cameras.registry import CameraModel
from reseau.optics.mapping import Derivatives, PlaneMapping, as_points, as_values

PARAMETERS = (
    Parameter("f", "px", "scale", usual=True, required=True),
    Parameter("cx", "px", "centre", usual=True),
    Parameter("cy", "px", "centre", usual=True),
    Parameter("omega", "rad", usual=True),
)
_SMALL = 1e-4


@dataclass(frozen=True, eq=False)
class FieldOfView(PlaneMapping):
    """From the ideal direction to pixels."""

    values: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    names: ClassVar[tuple[str, ...]] = tuple(each.name for each in PARAMETERS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """Image, and its derivatives by the direction and by the parameters."""
        uv = as_points(xy)
        f, cx, cy, omega = self.values
        q, by_r, by_omega = _quotient(np.hypot(*uv.T), omega)
        value = f * q[:, None] * uv + [cx, cy]
        d_xy = f * (q[:, None, None] * np.eye(2) + by_r[:, None, None] * uv[:, :, None] * uv[:, None, :])
        d = np.zeros((len(uv), 2, 4))
        d[:, :, 0], d[:, 0, 1], d[:, 1, 2] = q[:, None] * uv, 1.0, 1.0
        d[:, :, 3] = f * by_omega[:, None] * uv
        return Derivatives(value, d_xy, d)


def _quotient(r: Array, omega: float) -> tuple[Array, Array, Array]:
    """q = r_d / r, its derivative by r over r, and that by ω; a series where ω or r is small."""
    tangent = np.tan(omega / 2)
    a, by_omega = 2 * tangent, 1 + tangent**2
    small = (abs(a) * r < _SMALL) | (abs(omega) < _SMALL)
    safe, w = np.where(small, 1.0, r), omega if abs(omega) > _SMALL else 1.0
    angle, slope = np.arctan(a * safe), 1 / (1 + (a * safe) ** 2)
    q = angle / (w * safe)
    by_r = (a * slope / safe - angle / safe**2) / (w * safe)
    by_w = slope * by_omega / w - angle / (w * w * safe)
    near = 1 + omega**2 / 12 if abs(omega) < _SMALL else a / omega
    near_w = omega * (1 / 6 - 2 * r * r / 3) if abs(omega) < _SMALL else by_omega / omega - a / omega**2
    return (
        np.where(small, near - omega**2 * r * r / 3, q),
        np.where(small, -2 * omega**2 / 3 * np.ones_like(r), by_r),
        np.where(small, near_w, by_w),
    )


def _build(values: Array, grid: PixelGrid, options: Mapping[str, Any]) -> FieldOfView:
    return FieldOfView(values)


def _start(f: float, grid: PixelGrid) -> dict[str, float]:
    return {"f": f, "cx": grid.centre[0], "cy": grid.centre[1], "omega": 0.5}


MODEL = CameraModel("fov", PARAMETERS, _build, _start)
