"""Smooth plane mappings with analytic derivatives, and one inverse for all of them.

A mapping has named parameters. For arrays of points it returns the values and their derivatives with respect
to the point and to every parameter. It does not define which quantities are measured, corrected, fixed or
estimated.

Beware of the inverse: a distortion polynomial is one-to-one only in a region around its centre. It folds back
beyond, where a second point has the same image. :meth:`PlaneMapping.inverse` returns the point in the region
around the centre, or NaN; never a point beyond the fold.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping as Named
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array, Mask
from ..core.errors import UsageError
from .newton import determinant, in_blocks, newton, solve_2x2

# Positions between the centre and a point at which the orientation of the mapping is tested.
ON_THE_WAY = (0.25, 0.5, 0.75, 1.0)


class Derivatives(NamedTuple):
    """Values of a mapping at n points and their derivatives.

    Parameters
    ----------
    value : ndarray (n, 2)
        The mapped points.
    d_xy : ndarray (n, 2, 2)
        Derivatives with respect to the point; rows are the mapped coordinates.
    d_parameters : ndarray (n, 2, u)
        Derivatives with respect to the parameters, in the order of their names.

    Examples
    --------
    >>> from reseau.optics.composition import Similarity
    >>> value, d_xy, d_parameters = Similarity([1.0, 0.0, 2.0, 0.0]).derivatives([[3.0, 4.0]])
    >>> value, d_xy.shape, d_parameters.shape
    (array([[7., 8.]]), (1, 2, 2), (1, 2, 4))
    """

    value: Array
    d_xy: Array
    d_parameters: Array


def as_points(xy: ArrayLike) -> Array:
    """Points as (n, 2) floats.

    Raises
    ------
    UsageError
        When the array has another shape.
    """
    points = np.asarray(xy, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise UsageError(f"points have the shape {points.shape}, not (n, 2)")
    return points


def as_values(names: Sequence[str], values: ArrayLike) -> Array:
    """Parameter values as a read-only copy (u,).

    Raises
    ------
    UsageError
        When their number is not that of the names.
    """
    array = np.array(values, dtype=np.float64)
    if array.shape != (len(names),):
        raise UsageError(f"{len(names)} parameters with values of the shape {array.shape}")
    array.flags.writeable = False
    return array


class PlaneMapping(ABC):
    """Base class of the mappings: everything that follows from values and derivatives.

    A subclass defines `names`, `values` and :meth:`derivatives`. It overrides :meth:`_value` and
    :meth:`_slope` where they are cheaper without the parameters, :meth:`_start` for a better start value of
    the inverse, and :meth:`one_to_one` where the region is known exactly.

    Examples
    --------
    >>> from reseau.optics.composition import Similarity
    >>> doubled = Similarity().with_values({"a": 2.0})
    >>> doubled([[1.0, 3.0]]), doubled.inverse([[2.0, 6.0]]), doubled.value_of("a")
    (array([[2., 6.]]), array([[1., 3.]]), 2.0)
    """

    if TYPE_CHECKING:  # a subclass may define them as fields, which a property here would hide

        @property
        def names(self) -> tuple[str, ...]:
            """Names of the parameters (u)."""

        @property
        def values(self) -> Array:
            """Values of the parameters, (u,)."""

    @property
    def parallel(self) -> bool:
        """Whether the first plane of a camera is that of parallel rays: (xc, yc), not (xc/zc, yc/zc)."""
        return False

    @abstractmethod
    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """Map points and differentiate.

        Parameters
        ----------
        xy : array_like (n, 2)
            Points in the first plane.

        Returns
        -------
        Derivatives
            Values (n, 2), derivatives with respect to the point (n, 2, 2) and to the parameters (n, 2, u).
        """

    def __call__(self, xy: ArrayLike) -> Array:
        """Map points (n, 2)."""
        return in_blocks(self._value, as_points(xy))

    def inverse(self, xy: ArrayLike) -> Array:
        """Points that are mapped to `xy`.

        Parameters
        ----------
        xy : array_like (n, 2)
            Points in the second plane.

        Returns
        -------
        ndarray (n, 2)
            Points in the first plane, within rounding error; NaN where no point of the region in which the
            mapping is one-to-one has this image.
        """
        points = as_points(xy)
        finite = np.isfinite(points).all(axis=1, keepdims=True)
        return in_blocks(self._inverse, np.where(finite, points, np.nan))

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Mask (n,) of points up to which the mapping has not folded on the way from its centre.

        The sign of the determinant of the derivatives is compared with that at the centre at a few points of
        the straight way; a fold is missed only if the mapping folds back within a quarter of the way.
        """
        points, centre = as_points(xy), self._centre()
        with np.errstate(all="ignore"):
            sign = np.sign(determinant(self._slope(centre)[1]))
            same: Mask = np.full(len(points), bool(sign[0]))
            for part in ON_THE_WAY:
                same &= np.sign(determinant(self._slope(centre + part * (points - centre))[1])) == sign
        return same

    def with_values(self, values: ArrayLike | Named[str, float]) -> Self:
        """The same model with other values of its parameters.

        Parameters
        ----------
        values : array_like (u,) or mapping of names to values
            All values in order, or some by name; the others are kept.

        Raises
        ------
        UsageError
            When the number of values is wrong or a name is not a parameter.
        """
        return self._replaced(self._merged(values))

    def value_of(self, name: str) -> float:
        """Value of one parameter.

        Raises
        ------
        UsageError
            When there is no such parameter.
        """
        if name not in self.names:
            raise UsageError(f"is not one of the parameters {', '.join(self.names)}", where=name)
        return float(self.values[self.names.index(name)])

    def _merged(self, values: ArrayLike | Named[str, float]) -> Array:
        if not isinstance(values, Named):
            return as_values(self.names, values)
        unknown = [name for name in values if name not in self.names]
        if unknown:
            raise UsageError(f"not among the parameters {', '.join(self.names)}", where=", ".join(unknown))
        return np.array([values.get(name, old) for name, old in zip(self.names, self.values, strict=True)])

    def _replaced(self, values: Array) -> Self:
        return replace(self, values=values)  # type: ignore[type-var]

    def _value(self, xy: Array) -> Array:
        return self._slope(xy)[0]

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        return self.derivatives(xy)[:2]

    def _centre(self) -> Array:
        """Centre (1, 2) of the region in which the mapping is one-to-one."""
        return np.zeros((1, 2))

    def _start(self, xy: Array) -> Array:
        """Start value of the inverse: that of the mapping linearised at the centre."""
        centre = self._centre()
        value, slope = self._slope(centre)
        return centre + solve_2x2(np.broadcast_to(slope, (len(xy), 2, 2)), xy - value)

    def _inverse(self, xy: Array) -> Array:
        found = newton(self._slope, xy, self._start(xy), self._centre())
        found[~self.one_to_one(found)] = np.nan
        return found
