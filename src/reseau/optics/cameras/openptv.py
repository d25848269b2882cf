"""The camera of OpenPTV, ``openptv``: Brown's distortion about the middle of the image, scale and shear.

From liboptv, ``imgcoord`` and ``trafo``; x right, y up, in mm from the middle of the image::

    x = c·u + x0,  y = −c·v + y0
    x' = x + x(K1r² + K2r⁴ + K3r⁶) + P1(r² + 2x²) + 2·P2·xy   (y' likewise, P1 and P2 exchanged)
    x" = (1 + B1)x' − sin(she)·y',  y" = cos(she)·y'

with B1 = scx − 1 (Maas, Gruen & Papantoniou 1993, Experiments in Fluids 15).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.data import Array, Mask
from ..mapping import Derivatives, PlaneMapping, as_points, as_values
from .brown import PARAMETERS, BrownDistortion
from .grid import PixelGrid
from .registry import CameraModel, Parameter, register_camera

# All of Brown's but its last, B2, in whose place there is the shear.
_PARAMETERS = (*PARAMETERS[:-1], Parameter("she", "rad"))


@dataclass(frozen=True, eq=False)
class OpenPtv(PlaneMapping):
    """Camera of OpenPTV: from ideal directions to pixels.

    Parameters
    ----------
    values : array_like (10,)
        c, x0, y0 (mm), K1, K2, K3, P1, P2, B1, she (rad).
    grid : PixelGrid
        Pixels of the image.

    Examples
    --------
    >>> camera = OpenPtv(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0, "K1": 1e-3})
    >>> camera([[0.1, 0.0]]).round(3)
    array([[399.551, 239.5  ]])
    """

    names: ClassVar[tuple[str, ...]] = tuple(p.name for p in _PARAMETERS)
    values: Array = field(default_factory=lambda: np.array([1.0] + 9 * [0.0]))
    grid: PixelGrid = field(default_factory=lambda: PixelGrid(1, 1, (1.0, 1.0)))

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    @property
    def _lens(self) -> BrownDistortion:
        return BrownDistortion(np.append(self.values[3:8], [0.0, 0.0]))

    @property
    def _affine(self) -> Array:
        b1, she = self.values[8:]
        return np.array([[1 + b1, -np.sin(she)], [0.0, np.cos(she)]])

    @property
    def _ideal(self) -> Array:
        return np.array([self.values[0], -self.values[0]])

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        bent = self._lens.derivatives(points * self._ideal + self.values[1:3])
        affine, scale = self._affine, self.grid.pixels_per_mm
        d = np.zeros((len(points), 2, 10))
        d[:, :, 0] = (bent.d_xy @ (points * [1.0, -1.0])[:, :, None])[:, :, 0]
        d[:, :, 1:3] = bent.d_xy
        d[:, :, 3:8] = bent.d_parameters[:, :, :5]
        d = affine @ d
        d[:, 0, 8] = bent.value[:, 0]
        d[:, 0, 9] = -np.cos(self.values[9]) * bent.value[:, 1]
        d[:, 1, 9] = -np.sin(self.values[9]) * bent.value[:, 1]
        value = self.grid.to_pixels(bent.value @ affine.T)
        return Derivatives(value, scale[:, None] * (affine @ bent.d_xy) * self._ideal, scale[:, None] * d)

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the distortion has not folded on the way to these directions, (n,)."""
        return self._lens.one_to_one(as_points(xy) * self._ideal + self.values[1:3])

    def _inverse(self, xy: Array) -> Array:
        if self.values[0] == 0:
            return np.full(xy.shape, np.nan)
        photo = self.grid.to_photo(xy) @ np.linalg.inv(self._affine).T
        return (self._lens.inverse(photo) - self.values[1:3]) / self._ideal


def _build(values: Array, grid: PixelGrid, options: Mapping[str, Any]) -> OpenPtv:
    return OpenPtv(values, grid)


def _start(f: float, grid: PixelGrid) -> dict[str, float]:
    return {"c": f * grid.pitch_mm[0]}


register_camera(CameraModel("openptv", _PARAMETERS, _build, _start, needs_pitch=True))
