"""Reflectors in the tank: the rods of a test object as manufactured, or a body of unknown points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.io import ReseauDesign
from reseau.optics.mapping import PlaneMapping

_APART = np.array([14.0, 8.0])
"""Least distance of the points of a body, along the edge and in depth (mm): their echoes do not touch."""


@dataclass(frozen=True, eq=False)
class Reflectors:
    """Point reflectors, in columns.

    Parameters
    ----------
    names : tuple of str (n,)
        Their names.
    xy : ndarray (n, 2)
        True coordinates in the system of the object: millimetres, x right, y up, the depth is −y.
    strength : ndarray (n,)
        Echo amplitude relative to a rod of the test object.

    Raises
    ------
    UsageError
        When the columns differ in length, or a point is not below the transducer.

    Examples
    --------
    >>> rods = Reflectors(("A1", "A2"), np.array([[0.0, -20.0], [10.0, -20.0]]), np.ones(2))
    >>> rods.without(frozenset({"A1"})).names
    ('A2',)
    """

    names: tuple[str, ...]
    xy: Array
    strength: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.xy.shape != (n, 2) or self.strength.shape != (n,):
            raise UsageError(f"{n} names with coordinates {self.xy.shape}", where="reflectors")
        if not (self.xy[:, 1] < 0).all():
            raise UsageError("do not all lie below the transducer, at y < 0", where="reflectors")

    def __len__(self) -> int:
        return len(self.names)

    def without(self, names: frozenset[str]) -> Reflectors:
        """The reflectors without these names."""
        keep = np.array([name not in names for name in self.names], dtype=bool)
        return Reflectors(
            tuple(name for name in self.names if name not in names), self.xy[keep], self.strength[keep]
        )

    def moved(self, mapping: PlaneMapping) -> Reflectors:
        """The reflectors at mapped positions."""
        return Reflectors(self.names, mapping(self.xy), self.strength)


def rods_of(design: ReseauDesign, rng: np.random.Generator) -> Reflectors:
    """The rods of a design as manufactured.

    Their positions deviate from the design by normal errors with the sigmas of its points; their echoes
    differ by 5 %.

    Raises
    ------
    UsageError
        When the design lacks coordinates.
    """
    if not np.isfinite(design.xy).all():
        raise UsageError("lacks coordinates of rods", where=f"design {design.name}")
    sigma = np.array([point.sigma or 0.0 for point in design.points])
    deviation = sigma[:, None] * rng.standard_normal((len(sigma), 2))
    strength = 1 + 0.05 * np.clip(rng.standard_normal(len(sigma)), -2, 2)
    return Reflectors(design.ids, design.xy + deviation, strength)


def body_of(count: int, rng: np.random.Generator) -> Reflectors:
    """A body of random points, inside the area of the rods of the test object.

    Parameters
    ----------
    count : int
        Number of points, ``P1`` and so on from the top; their echoes do not touch.

    Raises
    ------
    UsageError
        When this number of points does not fit.
    """
    found = np.empty((0, 2))
    for _ in range(200 * count):
        if len(found) == count:
            break
        place = rng.uniform([-48.0, -98.0], [48.0, -14.0])
        if (np.abs(found - place) > _APART).any(axis=1).all():
            found = np.vstack([found, place])
    if len(found) < count or count < 1:
        raise UsageError(f"cannot have {count} points that do not touch", where="body")
    found = found[np.argsort(-found[:, 1])]
    names = tuple(f"P{i + 1}" for i in range(count))
    return Reflectors(names, found, rng.uniform(0.7, 1.0, count))
