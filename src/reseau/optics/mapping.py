"""Smooth mappings of a plane onto a plane, with analytic derivatives and one inverse for all of them.

A mapping has named parameters and gives, for whole arrays of points, its values, their derivatives with
respect to the point and with respect to every parameter. What is measured and what is corrected, what is held
and what is estimated is decided elsewhere.

The inverse deserves a warning. A distortion polynomial is one-to-one in a region around its centre only and
folds back beyond it, where a second point has the same image. :meth:`PlaneMapping.inverse` answers with the
point of the region around the centre, or with NaN; never with a point behind the fold.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Mapping as Named
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ..data import Array, Mask
from ..errors import UsageError

__all__ = ["Chain", "Derivatives", "Identity", "Inverted", "Mapping", "PlaneMapping", "Similarity"]

# Small enough for the work arrays to stay in the cache, large enough for NumPy's call overhead not to count.
BLOCK = 16384
NEWTON_STEPS = 60
# A Newton step shorter than this (relative) leaves less than the rounding error once it has been taken.
SHORT_STEP = 1e-10
# Where on the way from the centre to a point the orientation of the mapping is looked at.
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
    """

    value: Array
    d_xy: Array
    d_parameters: Array


@runtime_checkable
class Mapping(Protocol):
    """What is asked of a plane mapping; :class:`PlaneMapping` supplies most of it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters (u)."""

    @property
    def values(self) -> Array:
        """Values of the parameters, (u,)."""

    def __call__(self, xy: ArrayLike) -> Array:
        """Map points (n, 2)."""

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """Map points and differentiate."""

    def inverse(self, xy: ArrayLike) -> Array:
        """Points (n, 2) that are mapped to `xy`; NaN where there is none."""

    def with_values(self, values: ArrayLike | Named[str, float]) -> Self:
        """The same model with other values of its parameters."""


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
    """Parameter values as a read-only (u,) array that belongs to them alone.

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


def solve_2x2(matrix: Array, right: Array) -> Array:
    """Solve n systems of two equations, (n, 2, 2) by (n, 2) or (n, 2, u); not finite where singular."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        adjugate = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
        inverse = adjugate / (a * d - b * c)[:, None, None]
        solution: Array = inverse @ (right[..., None] if right.ndim == 2 else right)
    return solution[..., 0] if right.ndim == 2 else solution


def determinant(matrix: Array) -> Array:
    """Determinants of (n, 2, 2) matrices."""
    det: Array = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
    return det


def in_blocks(function: Callable[[Array], Array], xy: Array) -> Array:
    """Apply a function of points to an image's worth of them, block by block."""
    if len(xy) <= BLOCK:
        return function(xy)
    return np.concatenate([function(xy[i : i + BLOCK]) for i in range(0, len(xy), BLOCK)])


def newton(slope_at: Callable[[Array], tuple[Array, Array]], target: Array, start: Array) -> Array:
    """Solve f(xy) = target for whole arrays by Newton's method with damping.

    A point is accepted on the length of its *undamped* step, which is short at a root and nowhere else; so a
    point that has got stuck is not mistaken for a solution.

    Parameters
    ----------
    slope_at : callable
        Gives f (n, 2) and its derivatives (n, 2, 2) at points (n, 2).
    target, start : ndarray (n, 2)
        What f shall be, and where to begin.

    Returns
    -------
    ndarray (n, 2)
        Solutions; NaN where there was no convergence.
    """
    found = np.full(target.shape, np.nan)
    rows = np.flatnonzero(np.isfinite(target).all(1) & np.isfinite(start).all(1))
    with np.errstate(all="ignore"):
        xy, goal = start[rows], target[rows]
        value, slope = slope_at(xy)
        damping = np.ones(len(rows))
        for _ in range(NEWTON_STEPS):
            error = goal - value
            step = solve_2x2(slope, error)
            length = np.hypot(step[:, 0], step[:, 1])
            done = length <= SHORT_STEP * (1 + np.hypot(xy[:, 0], xy[:, 1]))
            found[rows[done]] = (xy + step)[done]
            on = ~done & np.isfinite(length) & (damping > 1e-6)
            if not on.any():
                break
            rows, xy, goal, value, slope = rows[on], xy[on], goal[on], value[on], slope[on]
            damping, step, error = damping[on], step[on], error[on]
            trial = xy + damping[:, None] * step
            new_value, new_slope = slope_at(trial)
            better = ((goal - new_value) ** 2).sum(1) < (error**2).sum(1)
            xy[better], value[better], slope[better] = trial[better], new_value[better], new_slope[better]
            damping = np.where(better, np.minimum(1.0, 4 * damping), damping / 4)
    return found


class PlaneMapping(ABC):
    """Base of the mappings: what follows from values and derivatives alone.

    A subclass gives `names`, `values` and :meth:`derivatives`; it overrides :meth:`_value` and :meth:`_slope`
    where they are cheaper without the parameters, :meth:`_start` where it knows a better first guess of the
    inverse, and :meth:`one_to_one` where it knows the region exactly.
    """

    if TYPE_CHECKING:  # a subclass may have them as fields, which a property here would hide

        @property
        def names(self) -> tuple[str, ...]:
            """Names of the parameters (u)."""

        @property
        def values(self) -> Array:
            """Values of the parameters, (u,)."""

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
            Value (n, 2), derivatives by the point (n, 2, 2) and by the parameters (n, 2, u).
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
            Points in the first plane, to rounding error; NaN where no point of the region in which the
            mapping is one-to-one has this image.
        """
        points = as_points(xy)
        finite = np.isfinite(points).all(axis=1, keepdims=True)
        return in_blocks(self._inverse, np.where(finite, points, np.nan))

    def one_to_one(self, xy: ArrayLike) -> Mask:
        """Whether the mapping has not folded anywhere on the way from its centre to these points, (n,).

        The sign of the determinant of the derivatives is compared with that at the centre at a few points of
        the straight way; a fold shows unless the mapping folds back within a quarter of the way.
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
            All values in order, or some by name: the others stay.

        Raises
        ------
        UsageError
            When the number of values is wrong or a name is none of the parameters.
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
            raise UsageError(f"is none of the parameters {', '.join(self.names)}", where=name)
        return float(self.values[self.names.index(name)])

    def _merged(self, values: ArrayLike | Named[str, float]) -> Array:
        if not isinstance(values, Named):
            return as_values(self.names, values)
        unknown = [name for name in values if name not in self.names]
        if unknown:
            raise UsageError(f"is none of the parameters {', '.join(self.names)}", where=", ".join(unknown))
        return np.array([values.get(name, old) for name, old in zip(self.names, self.values, strict=True)])

    def _replaced(self, values: Array) -> Self:
        changed: Any = replace(self, values=values)  # type: ignore[type-var]
        return changed  # type: ignore[no-any-return]

    def _value(self, xy: Array) -> Array:
        return self._slope(xy)[0]

    def _slope(self, xy: Array) -> tuple[Array, Array]:
        return self.derivatives(xy)[:2]

    def _centre(self) -> Array:
        """The point (1, 2) from which the region of one-to-one mapping is reckoned."""
        return np.zeros((1, 2))

    def _start(self, xy: Array) -> Array:
        """First guess of the inverse: that of the mapping linearised at the centre."""
        centre = self._centre()
        value, slope = self._slope(centre)
        return centre + solve_2x2(np.broadcast_to(slope, (len(xy), 2, 2)), xy - value)

    def _inverse(self, xy: Array) -> Array:
        found = newton(self._slope, xy, self._start(xy))
        found[~self.one_to_one(found)] = np.nan
        return found


@dataclass(frozen=True, eq=False)
class Identity(PlaneMapping):
    """The mapping that changes nothing; it has no parameters."""

    names: ClassVar[tuple[str, ...]] = ()
    values: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """The points, unit matrices, and nothing."""
        points = as_points(xy)
        return Derivatives(
            points.copy(), np.tile(np.eye(2), (len(points), 1, 1)), np.zeros((len(points), 2, 0))
        )

    def _inverse(self, xy: Array) -> Array:
        return xy.copy()


@dataclass(frozen=True, eq=False)
class Similarity(PlaneMapping):
    """Shift, rotation and one scale: X = X0 + a·x − b·y, Y = Y0 + b·x + a·y.

    Parameters
    ----------
    values : array_like (4,)
        X0, Y0, a, b; default the identity.
    mirrored : bool
        Whether y changes its sign first, as between a plane with y down and one with y up.
    """

    names: ClassVar[tuple[str, ...]] = ("X0", "Y0", "a", "b")
    values: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0, 0.0]))
    mirrored: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))

    @classmethod
    def common_system(cls, origin: ArrayLike, axis: ArrayLike, *, mirrored: bool = False) -> Self:
        """Into the system with its origin at one mark and its x-axis through another, scale unchanged.

        The common system of a reseau (Wishahy, step ii): the axis is the line joining two points of it and
        not the wire.

        Parameters
        ----------
        origin, axis : array_like (2,)
            The marks O1 and S1.
        mirrored : bool
            Whether the system shall have the other handedness.

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
        value: Array = xy @ self._matrix().T + self.values[:2]
        return value

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
    """A mapping the other way round, with the same parameters.

    Its derivatives follow from the implicit function f(p; θ) = q: ∂p/∂q = (∂f/∂p)⁻¹ and
    ∂p/∂θ = −(∂f/∂p)⁻¹ ∂f/∂θ.

    Parameters
    ----------
    mapping : PlaneMapping
        The mapping f.
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
    """One mapping after another: the result of the first goes into the second.

    Parameters
    ----------
    first, second : PlaneMapping
        The mappings; parameters of the first come first.
    labels : (str, str)
        Put before the names of the one and of the other, where both have a parameter of the same name.

    Raises
    ------
    UsageError
        When a name stands twice.

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
        twice = _twice(self.names)
        if twice is not None:
            raise UsageError("is a parameter of both mappings", where=twice, do="give the chain labels")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, each with its label."""
        parts = zip(self.labels, (self.first, self.second), strict=True)
        return tuple(label + name for label, part in parts for name in part.names)

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
        """Whether both mappings are, each where it is applied."""
        points = as_points(xy)
        return self.first.one_to_one(points) & self.second.one_to_one(self.first(points))

    def _inverse(self, xy: Array) -> Array:
        return self.first.inverse(self.second.inverse(xy))


def _twice(names: Iterable[str]) -> str | None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None
