"""Building blocks of mappings: identity, similarity, inverse, and composition."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array, Mask, twice
from ..core.errors import UsageError
from .mapping import Derivatives, PlaneMapping, as_points, as_values
from .newton import solve_2x2


@dataclass(frozen=True, eq=False)
class Similarity(PlaneMapping):
    """Shift, rotation and one scale: X = X0 + a·x − b·y, Y = Y0 + b·x + a·y.

    Parameters
    ----------
    values : array_like (4,)
        X0, Y0, a, b; default the identity.
    mirrored : bool
        Whether the sign of y is changed first, as between a plane with y down and one with y up.

    Examples
    --------
    >>> system = Similarity.common_system([100.0, 50.0], [100.0, 150.0])
    >>> system([[100.0, 150.0]]).round(6).tolist(), round(system.angle, 4)
    ([[100.0, 0.0]], -1.5708)
    """

    names: ClassVar[tuple[str, ...]] = ("X0", "Y0", "a", "b")
    values: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0, 0.0]))
    mirrored: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    @classmethod
    def common_system(cls, origin: ArrayLike, axis: ArrayLike, *, mirrored: bool = False) -> Self:
        """Transformation to the system with its origin at one mark and its x-axis through another.

        The scale is unchanged. This is the common system of a reseau (Wishahy, step ii): the axis is the line
        through two points, not the wire.

        Parameters
        ----------
        origin, axis : array_like (2,)
            The marks O1 and S1.
        mirrored : bool
            Whether the system has the opposite handedness.

        Raises
        ------
        UsageError
            When the two marks coincide.
        """
        o, s = np.asarray(origin, dtype=np.float64), np.asarray(axis, dtype=np.float64)
        flip = np.array([1.0, -1.0 if mirrored else 1.0])
        along = (s - o) * flip
        length = float(np.hypot(*along))
        if not length > 0:
            raise UsageError("the marks that define origin and axis coincide")
        a, b = along[0] / length, -along[1] / length
        x, y = o * flip
        return cls(np.array([-(a * x - b * y), -(b * x + a * y), a, b]), mirrored)

    @property
    def scale(self) -> float:
        """Length in the second plane of a unit length in the first."""
        return float(np.hypot(self.values[2], self.values[3]))

    @property
    def angle(self) -> float:
        """Rotation in radians, from x towards y."""
        return float(np.arctan2(self.values[3], self.values[2]))

    def _matrix(self) -> Array:
        a, b = self.values[2:]
        sign = -1.0 if self.mirrored else 1.0
        return np.array([[a, -b * sign], [b, a * sign]])

    def _value(self, xy: Array) -> Array:
        return xy @ self._matrix().T + self.values[:2]

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        x, y = points[:, 0], -points[:, 1] if self.mirrored else points[:, 1]
        one, none = np.ones(len(points)), np.zeros(len(points))
        d_parameters = np.stack([np.stack([one, none, x, -y], -1), np.stack([none, one, y, x], -1)], 1)
        d_xy = np.tile(self._matrix(), (len(points), 1, 1))
        return Derivatives(self._value(points), d_xy, d_parameters)

    def _inverse(self, xy: Array) -> Array:
        if not self.scale > 0:
            return np.full(xy.shape, np.nan)
        matrix = np.broadcast_to(self._matrix(), (len(xy), 2, 2))
        return solve_2x2(matrix, xy - self.values[:2])


@dataclass(frozen=True, eq=False)
class Inverted(PlaneMapping):
    """The inverse of a mapping, with the same parameters.

    Its derivatives follow from the implicit function f(p; θ) = q: ∂p/∂q = (∂f/∂p)⁻¹ and
    ∂p/∂θ = −(∂f/∂p)⁻¹ ∂f/∂θ.

    Parameters
    ----------
    mapping : PlaneMapping
        The mapping f.

    Examples
    --------
    >>> back = Inverted(Similarity([10.0, 0.0, 2.0, 0.0]))
    >>> back([[12.0, 4.0]]), back.inverse([[1.0, 2.0]])
    (array([[1., 2.]]), array([[12.,  4.]]))
    """

    mapping: PlaneMapping

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters of f."""
        return self.mapping.names

    @property
    def values(self) -> Array:
        """Values of the parameters of f."""
        return self.mapping.values

    def _replaced(self, values: Array) -> Self:
        return replace(self, mapping=self.mapping.with_values(values))

    def _value(self, xy: Array) -> Array:
        return self.mapping.inverse(xy)

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        value = self.mapping.inverse(xy)
        unit = np.broadcast_to(np.eye(2), (len(xy), 2, 2))
        return value, solve_2x2(self.mapping._slope(value)[1], unit)

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`; NaN where the inverse is."""
        points = as_points(xy)
        value = self.mapping.inverse(points)
        _, d_xy, d_parameters = self.mapping.derivatives(value)
        unit = np.broadcast_to(np.eye(2), (len(points), 2, 2))
        return Derivatives(value, solve_2x2(d_xy, unit), -solve_2x2(d_xy, d_parameters))

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the inverse exists."""
        found = self.mapping.inverse(xy)
        return np.isfinite(found[:, 0]) & np.isfinite(found[:, 1])

    def _inverse(self, xy: Array) -> Array:
        value = self.mapping(xy)
        value[~self.mapping.one_to_one(xy)] = np.nan
        return value


@dataclass(frozen=True, eq=False)
class Chain(PlaneMapping):
    """Composition of two mappings: the result of the first is mapped by the second.

    Parameters
    ----------
    first, second : PlaneMapping
        The mappings; parameters of the first come first.
    labels : (str, str)
        Prefixes of the names of the first and of the second, if both have a parameter of the same name.

    Raises
    ------
    UsageError
        When a name occurs twice.

    Examples
    --------
    >>> shift = Similarity([10.0, 0.0, 1.0, 0.0])
    >>> Chain(shift, shift, ("camera.", "display.")).with_values({"display.a": 2.0})([[1.0, 0.0]])
    array([[32.,  0.]])
    """

    first: PlaneMapping
    second: PlaneMapping
    labels: tuple[str, str] = ("", "")

    def __post_init__(self) -> None:
        _ = self.names

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, each with its label."""
        return _labelled(self.labels, self.first.names, self.second.names)

    @property
    def values(self) -> Array:
        """Values of all parameters."""
        return np.concatenate([self.first.values, self.second.values])

    def _replaced(self, values: Array) -> Self:
        u = len(self.first.names)
        return replace(
            self, first=self.first.with_values(values[:u]), second=self.second.with_values(values[u:])
        )

    def _value(self, xy: Array) -> Array:
        return self.second._value(self.first._value(xy))

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        between, inner = self.first._slope(xy)
        value, outer = self.second._slope(between)
        return value, outer @ inner

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        between, d_xy, d_first = self.first.derivatives(xy)
        value, outer, d_second = self.second.derivatives(between)
        return Derivatives(value, outer @ d_xy, np.concatenate([outer @ d_first, d_second], axis=2))

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether both mappings are one-to-one where they are applied."""
        points = as_points(xy)
        return self.first.one_to_one(points) & self.second.one_to_one(self.first(points))

    def _inverse(self, xy: Array) -> Array:
        return self.first.inverse(self.second.inverse(xy))


@lru_cache(maxsize=64)
def _labelled(labels: tuple[str, str], first: tuple[str, ...], second: tuple[str, ...]) -> tuple[str, ...]:
    """Names of both mappings with their labels; chains of the same kind are formed again and again."""
    names = tuple(label + name for label, part in zip(labels, (first, second), strict=True) for name in part)
    if (both := twice(names)) is not None:
        raise UsageError("is a parameter of both mappings", where=both, do="give the chain labels")
    return names
