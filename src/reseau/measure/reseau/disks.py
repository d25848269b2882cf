"""Find disks seen in any perspective: ellipses of a frame, of any size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows


def part_sums(mask: Mask) -> tuple[Array, Rows]:
    """Moments and extents of the components of a mask whose pixels are connected by their sides.

    Components are joined where a run of pixels touches one of the row before (Rosenfeld and Pfaltz 1966,
    Journal of the ACM 13).

    Parameters
    ----------
    mask : ndarray (h, w) of bool
        Pixels of the components.

    Returns
    -------
    sums : ndarray (6, m)
        Sums of 1, x, y, x², xy, y² over the pixels of each component, in the order of their first pixels.
    extent : ndarray (4, m) of int
        First and last column, first and last row of each.
    """
    w = mask.shape[1]
    change = np.diff(np.pad(mask.view(np.int8), ((0, 0), (1, 1))), axis=1)
    (y, first), after = np.nonzero(change == 1), np.nonzero(change == -1)[1]
    count, row = len(y), y * (w + 1)
    if not count:
        return np.zeros((6, 0)), np.zeros((4, 0), np.int64)
    # Runs of the row before that end behind the first pixel, and begin before the last one.
    low = np.searchsorted(row + after, row - (w + 1) + first, side="right")
    touching = np.maximum(np.searchsorted(row + first, row - (w + 1) + after) - low, 0)
    run = np.repeat(np.arange(count), touching)
    above = np.arange(len(run)) + np.repeat(low - np.cumsum(touching) + touching, touching)
    graph = scipy.sparse.coo_array((np.ones(len(run), bool), (run, above)), shape=(count, count))
    parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    # A run of n pixels around m: their squares make n (m² + (n² − 1)/12).
    n, middle = (after - first).astype(np.float64), 0.5 * (first + after - 1)
    squares = n * (middle * middle + (n * n - 1) / 12)
    each = n, n * middle, n * y, squares, n * middle * y, n * y * y
    order = np.argsort(part, kind="stable")
    begin = np.searchsorted(part[order], np.arange(parts))
    lowest, highest = (
        [of.reduceat(values[order], begin) for values in some]
        for of, some in ((np.minimum, (first, y)), (np.maximum, (after - 1, y)))
    )
    extent = np.stack([lowest[0], highest[0], lowest[1], highest[1]])
    return np.stack([np.bincount(part, values, parts) for values in each]), extent


_SIDES_PX = (25, 51, 101)
"""Sides of the squares; the threshold in each is the mean of its darkest and brightest grey value."""
_SMALL = 8000
"""Integers up to this size and their differences fit into 16 bits."""
_LEAST_AREA = 30
_LEAST_CONTRAST = 10.0
"""Minimum contrast of a square, in standard deviations of the noise."""
_ELLIPTIC = 0.97
"""Minimum area over that of the ellipse with the same second moments: 1 for ellipses, 0.955 for squares."""
_NARROWEST = 0.2
"""Minimum ratio of the axes."""

_Parts = tuple[Array, Array, Array, Array]


@dataclass(frozen=True, eq=False)
class Disks:
    """Ellipses in a frame, in columns.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Centres in pixels, good to about 0.3 px.
    form : ndarray (m, 2, 2)
        Symmetric matrices that map the unit circle to each ellipse.
    t : ndarray (m,)
        Contrast times the square root of the number of pixels, over the noise; in descending order.
    """

    xy: Array
    form: Array
    t: Array

    def __len__(self) -> int:
        return len(self.xy)

    def strongest(self, count: int) -> Disks:
        """At most `count` of the strongest ellipses."""
        return self.select(np.arange(min(count, len(self))))

    def select(self, keep: Mask | Rows) -> Disks:
        """Selected ellipses."""
        return Disks(self.xy[keep], self.form[keep], self.t[keep])


def find_disks(grey: NDArray[np.float32], valid: Mask, noise: float) -> Disks:
    """Find the dark ellipses of a frame.

    The frame is thresholded in squares of several sizes, half way between the darkest and the brightest value
    of each. A connected component is kept if its area is that of the ellipse of its second moments, the
    largest of all figures with these moments: this separates disks in perspective from arcs and letters.

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values; negative ones where the disks are bright.
    valid : ndarray (h, w) of bool
        Pixels that carry an image.
    noise : float
        Standard deviation of the grey values.
    """
    found = _of_sizes(_compact(grey), valid, noise, _SIDES_PX)
    part, there, reduced = grey, valid, 1
    # Larger ones are found as well in a smaller picture.
    while min(grey.shape) > 2 * reduced * _SIDES_PX[-1]:
        reduced *= 2
        size = (grey.shape[1] // reduced, grey.shape[0] // reduced)
        even = np.s_[: 2 * size[1], : 2 * size[0]]
        part = cv2.resize(part[even], size, interpolation=cv2.INTER_AREA).astype(np.float32)
        there = there[even]
        there = there[::2, ::2] & there[1::2, ::2] & there[::2, 1::2] & there[1::2, 1::2]
        for xy, moments, quality, t in _of_sizes(part, there, noise, _SIDES_PX[-1:]):
            found.append((reduced * (xy + 0.5) - 0.5, reduced**2 * moments, quality, reduced * t))
    xy, moments, quality, t = (np.concatenate(column) for column in zip(*found, strict=True))
    if not len(xy):
        return Disks(np.empty((0, 2)), np.empty((0, 2, 2)), t)
    value, vector = np.linalg.eigh(moments)
    form = np.einsum("kij,kj,klj->kil", vector, 2 * np.sqrt(value), vector)
    keep, t = np.flatnonzero(_once(xy, 2 * np.sqrt(value[:, 0]), quality)), t / noise
    keep = keep[np.argsort(-t[keep], kind="stable")]
    return Disks(xy[keep], form[keep], t[keep])


def _of_sizes(values: NDArray[Any], valid: Mask, noise: float, sides: tuple[int, ...]) -> list[_Parts]:
    """Elliptic components of a frame thresholded in squares of some sides; see :func:`_parts`."""
    found, before, low, high = [], 1, values, values
    # Integers are compared with an integer: with a number of another kind all of them would be converted.
    least: Any = _LEAST_CONTRAST * noise
    least = int(least) if values.dtype.kind in "ui" else least
    for side in sides:
        square = np.ones((side - before + 1,) * 2, np.uint8)  # minimum over a square of squares
        low, high, before = cv2.erode(low, square), cv2.dilate(high, square), side
        contrast = high - low
        dark = (values - low < high - values) & (contrast > least) & valid
        found.append(_parts(dark, contrast, side))
    return found


def _compact(grey: NDArray[Any]) -> NDArray[Any]:
    """Grey values as small integers where possible: the following steps are then several times as fast."""
    low, high = grey.min(), grey.max()
    if not max(-low, high) <= _SMALL:
        return grey
    whole = grey.astype(np.uint8 if low >= 0 and high <= np.iinfo(np.uint8).max else np.int16)
    return whole if np.array_equal(whole, grey) else grey


def _parts(mask: Mask, contrast: NDArray[Any], side: int) -> _Parts:
    """Centres (m, 2), second moments (m, 2, 2), ellipticity (m,), strength (m,) of elliptic components."""
    h, w = mask.shape
    sums, (left, right, top, bottom) = part_sums(mask)
    keep = (sums[0] >= _LEAST_AREA) & (np.maximum(right - left, bottom - top) < side - 1)
    keep &= (left > 0) & (top > 0) & (right < w - 1) & (bottom < h - 1)
    area = sums[0, keep]
    x, y, xx, xy, yy = sums[1:, keep] / area
    centre = np.stack([x, y], axis=1)
    moments = np.stack([xx - x * x, xy - x * y, xy - x * y, yy - y * y], axis=1).reshape(-1, 2, 2)
    axes = np.linalg.eigvalsh(moments)
    quality = area / (4 * np.pi * np.sqrt(np.maximum(axes.prod(axis=1), 1e-9)))
    good = (quality > _ELLIPTIC) & (axes[:, 0] > _NARROWEST**2 * axes[:, 1])
    at = np.rint(centre).astype(np.intp)
    t = contrast[at[:, 1], at[:, 0]] * np.sqrt(area)
    return centre[good], moments[good], quality[good], t[good]


def _once(xy: Array, radius: Array, quality: Array) -> Mask:
    """Mask that keeps the most elliptic of components found in squares of several sizes."""
    keep = np.ones(len(xy), dtype=bool)
    near = scipy.spatial.KDTree(xy).query_ball_point(xy, 0.5 * radius)
    for k in np.argsort(-quality, kind="stable"):
        if keep[k]:
            keep[near[k]] = False
            keep[k] = True
    return keep
