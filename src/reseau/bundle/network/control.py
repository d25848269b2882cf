"""Points whose coordinates are known before the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

from ...core.data import Array

__all__ = ["ControlPoints"]


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Points whose coordinates are known.

    Parameters
    ----------
    names : tuple of str (k,)
        Names.
    xyz : ndarray (k, 3)
        Coordinates.
    sigma : ndarray (k, 3)
        0 holds a coordinate, NaN leaves it free, otherwise it is an observation.
    """

    names: tuple[str, ...]
    xyz: Array
    sigma: Array
