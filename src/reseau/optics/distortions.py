"""Distortions about a point, and the radius beyond which they fold back."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike

from ..core.data import Array, Mask
from .mapping import Derivatives, PlaneMapping, as_points, as_values

__all__ = ["BrownDistortion"]


def first_root(*polynomials: ArrayLike) -> float:
    """The smallest positive root of some polynomials (coefficients from the constant up), or infinity.

    Found as the largest root of the polynomials read backwards: a highest coefficient of next to nothing, as
    an adjustment leaves it, then is a root of next to nothing and no division by it.
    """
    backwards = [root for p in polynomials for root in poly.polyroots(np.asarray(p)[::-1])]
    # A double root comes out as a pair that is complex by the root of the rounding error.
    real = [root.real for root in backwards if abs(root.imag) <= 1e-7 * abs(root)]
    largest = float(max(real, default=0.0))
    return 1 / largest if largest > 1e-30 else np.inf


class Radial(PlaneMapping):
    """What distortions about a point share: a radius up to which the image radius grows.

    The start of the inverse lies within it, from where Newton's method finds the branch around the centre.
    """

    if TYPE_CHECKING:

        @property
        def fold(self) -> float:
            """Square of the radius at which the image radius stops growing; infinite where it never does."""

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the radius is one up to which the image radius grows, and decentering folds nothing."""
        points = as_points(xy)
        return super().one_to_one(points) & (points[:, 0] ** 2 + points[:, 1] ** 2 < self.fold)

    def within(self, xy: Array) -> Array:
        radius = np.hypot(xy[:, 0], xy[:, 1])
        largest = 0.95 * np.sqrt(self.fold)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside: Array = xy * np.fmin(1.0, largest / radius)[:, None]
        return inside


@dataclass(frozen=True, eq=False)
class BrownDistortion(Radial):
    """Radial and decentering distortion with affinity, in the plane of the photo (mm): (x, y) + (Δx, Δy).

    ::

        Δx = x·[K1(r²−R0²) + K2(r⁴−R0⁴) + K3(r⁶−R0⁶)] + P1(r²+2x²) + 2·P2·xy + B1·x + B2·y
        Δy = y·[K1(r²−R0²) + K2(r⁴−R0⁴) + K3(r⁶−R0⁶)] + P2(r²+2y²) + 2·P1·xy

    Radial and decentering terms after Brown (1971), Close-range camera calibration, Photogrammetric
    Engineering 37(8); the balance radius R0, where the radial distortion vanishes, and the affinity as in
    Luhmann et al., Close-Range Photogrammetry and 3D Imaging.

    Parameters
    ----------
    values : array_like (7,)
        K1 (mm⁻²), K2 (mm⁻⁴), K3 (mm⁻⁶), P1, P2 (mm⁻¹), B1, B2.
    balance_radius_mm : float
        R0.
    """

    names: ClassVar[tuple[str, ...]] = ("K1", "K2", "K3", "P1", "P2", "B1", "B2")
    values: Array = field(default_factory=lambda: np.zeros(7))
    balance_radius_mm: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    @cached_property
    def balance(self) -> Array:
        """R0², R0⁴, R0⁶, (3,)."""
        balance: Array = self.balance_radius_mm ** np.array([2.0, 4.0, 6.0])
        return balance

    @cached_property
    def fold(self) -> float:
        """See :class:`Radial`."""
        k = self.values[:3]
        at_centre = 1 - float(k @ self.balance)
        # d/dr of r·(1 + …) in powers of r².
        return first_root([at_centre, 3 * k[0], 5 * k[1], 7 * k[2]]) if at_centre > 0 else 0.0

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        k1, k2, k3, p1, p2, b1, b2 = self.values
        x, y = xy[:, 0], xy[:, 1]
        s = x * x + y * y
        radial = 1 - self.values[:3] @ self.balance + s * (k1 + s * (k2 + s * k3))
        by_s = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
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
        d = np.zeros((len(points), 2, 7))
        d[:, :, :3] = points[:, :, None] * (np.stack([s, s**2, s**3], axis=1) - self.balance)[:, None, :]
        d[:, 0, 3], d[:, 1, 3] = s + 2 * x * x, 2 * x * y
        d[:, 0, 4], d[:, 1, 4] = 2 * x * y, s + 2 * y * y
        d[:, 0, 5], d[:, 0, 6] = x, y
        return Derivatives(value, d_xy, d)

    def _start(self, xy: Array) -> Array:
        return self.within(xy)
