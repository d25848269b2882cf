"""Which points and images the observations determine at all, and why the others are left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array, Mask
from .network import Network, finite

__all__ = ["Usable", "usable"]

# An image has six unknowns: three points.
_LEAST_POINTS = 3


@dataclass(frozen=True, eq=False)
class Usable:
    """What takes part in an adjustment.

    Parameters
    ----------
    observations : ndarray of bool (n,)
        Image coordinates.
    images : ndarray of bool (m,)
        Images with three points at least, whose pose is known approximately.
    points : ndarray of bool (p,)
        Points with rays enough for their unknown coordinates, known approximately.
    """

    observations: Mask
    images: Mask
    points: Mask


def usable(network: Network, counted: Mask, x0: Array, xyz: Array) -> Usable:
    """What of a network can be adjusted.

    Parameters
    ----------
    network : Network
        The network.
    counted : ndarray of bool (n,)
        Image coordinates that have a weight.
    x0 : ndarray (m, 3)
        Approximate projection centres, NaN where a pose is not known.
    xyz : ndarray (p, 3)
        Approximate coordinates, NaN where a point is not known.

    Notes
    -----
    A ray gives two equations, but two rays are needed for three unknown coordinates. Whatever has too few is
    left out with its rays, and so on until all that remains has enough.
    """
    images, points = finite(x0), finite(xyz)
    unknown = (~network.held & ~network.observed).sum(axis=1)
    needed = np.where(unknown == 0, 1, np.where(unknown <= 2, 1, 2))
    rows = counted.copy()
    while True:
        rows = rows & images[network.image_of] & points[network.point_of]
        rays = np.bincount(network.point_of[rows], minlength=len(points))
        seen = np.bincount(network.image_of[rows], minlength=len(images))
        fewer_points, fewer_images = points & (rays >= needed), images & (seen >= _LEAST_POINTS)
        if (fewer_points == points).all() and (fewer_images == images).all():
            return Usable(rows, images, points)
        points, images = fewer_points, fewer_images
