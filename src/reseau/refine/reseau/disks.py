"""Disks seen in any perspective: dark or bright ellipses of a frame, whatever their size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...data import Array, Mask

__all__ = ["Disks", "find_disks"]

_SIDES_PX = (25, 51, 101)
"""Sides of the squares in which half way between the darkest and the brightest is the threshold."""
_LEAST_AREA = 30
_LEAST_CONTRAST = 10.0
"""Contrast in standard deviations of the noise from which on a square holds anything."""
_ELLIPTIC = 0.97
"""Least area over that of the ellipse of the same second moments: 1 for ellipses, 0.955 for squares."""
_NARROWEST = 0.2
"""Least ratio of the axes."""


@dataclass(frozen=True, eq=False)
class Disks:
    """Ellipses in a frame, in columns.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Centres in pixels, good to about 0.3 px.
    form : ndarray (m, 2, 2)
        Symmetric matrices that carry the unit circle to each ellipse.
    t : ndarray (m,)
        Contrast times the root of the number of pixels over the noise: the strongest come first.
    """

    xy: Array
    form: Array
    t: Array

    def __len__(self) -> int:
        return len(self.xy)

    def strongest(self, count: int) -> Disks:
        """So many of them at most."""
        return Disks(self.xy[:count], self.form[:count], self.t[:count])


def find_disks(grey: NDArray[np.float32], valid: Mask, noise: float) -> Disks:
    """Find the dark ellipses of a frame.

    In squares of several sizes the frame is cut half way between what is darkest and brightest there. Of all
    connected parts those stay whose area is that of the ellipse of their second moments, which of all plane
    figures have the largest: moments tell a disk in perspective from arcs, letters and crossings.

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values; negative ones where the disks are bright.
    valid : ndarray (h, w) of bool
        Pixels that carry an image.
    noise : float
        Standard deviation of the grey values.
    """
    found = []
    for side in _SIDES_PX:
        square = np.ones((side, side), np.uint8)
        low, high = cv2.erode(grey, square), cv2.dilate(grey, square)
        contrast = (high - low) / noise
        dark = (grey < (low + high) / 2) & (contrast > _LEAST_CONTRAST) & valid
        found.append(_parts(dark, contrast, side))
    xy, moments, quality, t = (np.concatenate(column) for column in zip(*found, strict=True))
    if not len(xy):
        return Disks(np.empty((0, 2)), np.empty((0, 2, 2)), t)
    value, vector = np.linalg.eigh(moments)
    form = np.einsum("kij,kj,klj->kil", vector, 2 * np.sqrt(value), vector)
    keep = np.flatnonzero(_once(xy, 2 * np.sqrt(value[:, 0]), quality))
    keep = keep[np.argsort(-t[keep], kind="stable")]
    return Disks(xy[keep], form[keep], t[keep])


def _parts(mask: Mask, contrast: NDArray[Any], side: int) -> tuple[Array, Array, Array, Array]:
    """Centres (m, 2), second moments (m, 2, 2), ellipticity (m,), strength (m,) of elliptic parts."""
    h, w = mask.shape
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    left, top, wide, high, area = stats.T
    keep = (area >= _LEAST_AREA) & (np.maximum(wide, high) < side)
    keep &= (left > 0) & (top > 0) & (left + wide < w) & (top + high < h)
    keep[0] = False  # the ground
    number = np.cumsum(keep) - 1
    row, column = np.nonzero(keep[labels])
    label, count = number[labels[row, column]], int(keep.sum())

    def mean(values: Any) -> Array:
        value: Array = np.bincount(label, values, count) / area[keep]
        return value

    xy = np.stack([mean(column), mean(row)], axis=1)
    u, v = column - xy[label, 0], row - xy[label, 1]
    uv = mean(u * v)
    moments = np.stack([np.stack([mean(u * u), uv], axis=1), np.stack([uv, mean(v * v)], axis=1)], axis=1)
    axes = np.linalg.eigvalsh(moments)
    quality = area[keep] / (4 * np.pi * np.sqrt(np.maximum(axes.prod(axis=1), 1e-9)))
    good = (quality > _ELLIPTIC) & (axes[:, 0] > _NARROWEST**2 * axes[:, 1])
    at = np.rint(xy).astype(np.intp)
    t = contrast[at[:, 1], at[:, 0]] * np.sqrt(area[keep])
    return xy[good], moments[good], quality[good], t[good]


def _once(xy: Array, radius: Array, quality: Array) -> Mask:
    """Of parts found in squares of several sizes the most elliptic."""
    keep = np.ones(len(xy), dtype=bool)
    tree = KDTree(xy)
    for k in np.argsort(-quality, kind="stable"):
        if keep[k]:
            near = [i for i in tree.query_ball_point(xy[k], 0.5 * radius[k]) if i != k]
            keep[near] = False
    return keep
