"""A third camera model, as a user adds one: the equidistant fisheye. One module, one registration.

The image radius grows with the angle θ from the axis, r = f·θ·(1 + e1·θ²). There is no kernel: the adjustment
uses the mapping.
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
from reseau.optics.cameras.registry import CameraModel, Option
from reseau.optics.mapping import Derivatives, PlaneMapping, as_points, as_values

PARAMETERS = (
    Parameter("f", "px", "scale", usual=True, required=True),
    Parameter("u0", "px", "centre", usual=True),
    Parameter("v0", "px", "centre", usual=True),
    Parameter("e1", usual=True),
)


@dataclass(frozen=True, eq=False)
class Equidistant(PlaneMapping):
    """From the ideal direction to pixels; u0, v0 from the centre of the image, y down or up."""

    values: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    grid: PixelGrid = field(default_factory=lambda: PixelGrid(1, 1, (1.0, 1.0)))
    up: bool = False

    names: ClassVar[tuple[str, ...]] = tuple(p.name for p in PARAMETERS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        f, u0, v0, e1 = self.values
        r = np.maximum(np.hypot(*points.T), 1e-8)
        angle = np.arctan(r)
        bent = angle * (1 + e1 * angle**2)
        q = bent / r
        by_r = (1 + 3 * e1 * angle**2) / (1 + r**2)
        by_s = (by_r - q) / r**2
        d_xy = f * (
            q[:, None, None] * np.eye(2) + by_s[:, None, None] * points[:, :, None] * points[:, None, :]
        )
        d = np.zeros((len(points), 2, 4))
        d[:, :, 0] = q[:, None] * points
        d[:, :, 3] = f * (angle**3 / r)[:, None] * points
        d[:, 0, 1] = 1.0
        d[:, 1, 2] = -1.0 if self.up else 1.0
        shift = np.array([u0, -v0 if self.up else v0]) + self.grid.centre
        return Derivatives(f * q[:, None] * points + shift, d_xy, d)


def build(values: Array, grid: PixelGrid, options: Mapping[str, Any]) -> Equidistant:
    """The mapping of the model."""
    return Equidistant(values, grid, options["v_axis"] == "up")


MODEL = CameraModel(
    "equidistant",
    PARAMETERS,
    build,
    lambda f, grid: {"f": f},
    (Option("v_axis", "down", ("down", "up")),),
)
