"""Distortions about a point, and the radius beyond which they fold back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike

from ...core.data import Array, Mask
from ..mapping import Derivatives, PlaneMapping, as_points


def first_root(*polynomials: ArrayLike) -> float:
    """The smallest positive root of polynomials (coefficients from the constant up), or infinity.

    It is found as the largest root of the reversed polynomials: a highest coefficient that is almost zero, as
    an adjustment leaves it, then gives a root that is almost zero, and no division by it.
    """
    backwards = [root for p in polynomials for root in poly.polyroots(np.asarray(p)[::-1])]
    # A double root comes out as a pair that is complex by the root of the rounding error.
    real = [root.real for root in backwards if abs(root.imag) <= 1e-7 * abs(root)]
    largest = float(max(real, default=0.0))
    return 1 / largest if largest > 1e-30 else np.inf


class Radial(PlaneMapping):
    """Base of distortions about a point: they have a radius up to which the image radius grows.

    The inverse starts within it; from there Newton's method finds the branch around the centre.
    """

    if TYPE_CHECKING:

        @property
        def fold(self) -> float:
            """Square of the radius at which the image radius stops growing; infinite where it does not."""

    def _evaluated(self, xy: Array, *, parameters: bool = True) -> Derivatives:
        """Values and derivatives, those by the parameters only where they are wanted."""
        raise NotImplementedError

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        return self._evaluated(xy, parameters=False)[:2]

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        return self._evaluated(as_points(xy))

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the image radius grows up to these points, and decentering does not fold there, (n,)."""
        points = as_points(xy)
        return super().one_to_one(points) & (points[:, 0] ** 2 + points[:, 1] ** 2 < self.fold)

    def within(self, xy: Array) -> Array:
        """The points (n, 2), moved towards the centre where they are not within the fold."""
        radius = np.hypot(xy[:, 0], xy[:, 1])
        largest = 0.95 * np.sqrt(self.fold)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside: Array = xy * np.fmin(1.0, largest / radius)[:, None]
        return inside
