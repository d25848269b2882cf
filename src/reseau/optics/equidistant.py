r"""The image of a fisheye from that of a lens without distortion.

A point at the distance r from the middle, in units of the scale, goes to

.. math:: r' = \arctan(\sqrt w\, r) / \sqrt w ,

as an equidistant fisheye has it (r' proportional to the angle from the axis) whose focal length is the scale
over √w. It is an approximation of any fisheye, and for w = 0 the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array
from .mapping import Derivatives, PlaneMapping, as_points, as_values

_FLAT = 1e-3
"""Value of w r² up to which series are used."""


def _factor(z: Array) -> tuple[Array, Array]:
    """atan(√z)/√z, and its derivative."""
    flat, safe = z < _FLAT, np.maximum(z, _FLAT)
    root = np.sqrt(safe)
    factor = np.where(flat, 1 - z * (1 / 3 - z * (1 / 5 - z / 7)), np.arctan(root) / root)
    slope = np.where(flat, -1 / 3 + z * (2 / 5 - z * 3 / 7), (1 / (1 + safe) - factor) / (2 * safe))
    return factor, slope


@dataclass(frozen=True, eq=False)
class Equidistant(PlaneMapping):
    """An equidistant fisheye behind a lens without distortion.

    Parameters
    ----------
    values : array_like (1,)
        The strength w ≥ 0.
    offset : (float, float)
        The middle, in the unit of the points.
    scale : float
        Unit of the distance r, in the unit of the points.

    Examples
    --------
    At 45° from the axis, with a focal length of 100:

    >>> lens = Equidistant([1.0], scale=100.0)
    >>> lens([[100.0, 0.0]]).round(3), lens.inverse([[25 * np.pi, 0.0]]).round(3)
    (array([[78.54,  0.  ]]), array([[100.,   0.]]))
    """

    names: ClassVar[tuple[str, ...]] = ("w",)
    values: Array = field(default_factory=lambda: np.zeros(1))
    offset: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        p = (as_points(xy) - self.offset) / self.scale
        square, w = (p**2).sum(axis=1), float(self.values[0])
        factor, slope = _factor(w * square)
        d_xy = factor[:, None, None] * np.eye(2) + 2 * w * slope[:, None, None] * p[:, :, None] * p[:, None]
        by_w = self.scale * (slope * square)[:, None] * p
        return Derivatives(self.offset + self.scale * factor[:, None] * p, d_xy, by_w[:, :, None])

    def _inverse(self, xy: Array) -> Array:
        p = (xy - self.offset) / self.scale
        angle = np.sqrt(self.values[0]) * np.hypot(*p.T)
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(angle < 1e-6, 1.0, np.tan(angle) / angle)
        factor[angle >= np.pi / 2] = np.nan
        return np.asarray(self.offset + self.scale * factor[:, None] * p)
