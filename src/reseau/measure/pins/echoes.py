"""Bright spots on a dark background: position, size, curvature, and contact with other spots.

A spot is a maximum of the smoothed frame with sufficient prominence: a large share of its height lies above
the level at which it joins a higher one. Its region consists of the pixels above a share of its height and
above the level of contact with the next spot. No template is needed, so echoes of all lengths are found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Rows

_STEP = 0.85
"""Ratio of successive levels."""
_JOINED = 0.7
"""A maximum that joins a higher one above this share of its height is part of it."""
_LEVEL = 0.35
"""Share of its height above which pixels belong to an isolated spot."""
_CLAIM_PX = 3.0
"""Distance from its region within which light is attributed to a spot."""
_MOST = 3000
"""Maximum number of maxima, the highest ones; graphics on a full screen have about a thousand."""

Grey = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Echoes:
    """Spots in columns, the highest first.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Centre of the curved line through each spot.
    height : ndarray (m,)
        Smoothed brightness over the background.
    length, thickness : ndarray (m,)
        Four standard deviations of the light along and across, pixels.
    curvature, tilt : ndarray (m,)
        As in :class:`reseau.optics.Arcs`.
    joined : ndarray (m,)
        Level of contact with another spot, as a share of the height.
    level : ndarray (m,)
        Lower limit of the region, as a share of the height.
    edge : ndarray (m, 2)
        Squared steps of brightness between pixels over the squared brightness, summed over the region and its
        border: in the direction where they are largest, and in the other.
    box : ndarray of int (m, 4)
        First and last column, first and last row of the region.
    area : ndarray (m,)
        Number of pixels of the region.
    centroid : ndarray (m, 2)
        Unweighted mean position of the pixels above one fifth of the height.
    owner : ndarray of int (h, w)
        Index of the spot whose region contains a pixel, -1 for none.
    claimed : ndarray of int (h, w)
        The same with regions extended by a few pixels, assigned to the nearest region.
    """

    xy: Array
    height: Array
    length: Array
    thickness: Array
    curvature: Array
    tilt: Array
    joined: Array
    level: Array
    edge: Array
    box: Rows
    area: Array
    centroid: Array
    owner: NDArray[np.int32]
    claimed: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.height)


def ground_of(grey: Grey, reach: int) -> Grey:
    """Background of spots: the running median over squares of which a spot covers less than half.

    Parameters
    ----------
    grey : ndarray (h, w)
        Frame.
    reach : int
        Side of the squares, pixels.
    """
    step = max(1, reach // 16)
    h, w = grey.shape
    small = grey[::step, ::step]
    low, high = float(grey.min()), float(grey.max())
    coded = np.round((small - low) * (255 / max(high - low, 1e-6))).astype(np.uint8)
    side = min(max(3, reach // step), min(small.shape)) | 1
    median = cv2.medianBlur(coded, side).astype(np.float32) * ((high - low) / 255) + low
    grown: Grey = cv2.resize(median, (w, h), interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
    return grown


def find_echoes(light: Grey, psf_px: float, least: float) -> Echoes:
    """Find all spots and determine their approximate shape.

    Parameters
    ----------
    light : ndarray (h, w)
        Brightness over the background, interpolated where an echo is hidden.
    psf_px : float
        Width of the smoothing Gaussian.
    least : float
        Minimum height over the background.
    """
    smooth: Grey = cv2.GaussianBlur(light, (0, 0), psf_px, borderType=cv2.BORDER_REFLECT)  # type: ignore[assignment]
    row, column = _maxima(smooth, least)
    height = smooth[row, column].astype(np.float64)
    joins = _joins(smooth, row, column, height, least)
    own = joins < _JOINED
    row, column, height = row[own], column[own], height[own]
    owner, level, joined = _regions(smooth, row, column, height, least)
    return _measured(light, smooth, owner, height, level, joined)


def _maxima(smooth: Grey, least: float) -> tuple[Rows, Rows]:
    """Rows and columns of the local maxima, in descending order."""
    peak = (smooth >= cv2.dilate(smooth, np.ones((5, 5), np.uint8))) & (smooth >= least)
    row, column = np.nonzero(peak)
    order = np.argsort(-smooth[row, column], kind="stable")[:_MOST]
    return row[order], column[order]


def _levels(highest: float, least: float) -> Array:
    count = max(1, int(np.ceil(np.log(least / highest) / np.log(_STEP))))
    return np.asarray(highest * _STEP ** np.arange(1.0, count + 1), dtype=np.float64)


def _sliced(smooth: Grey, highest: float, least: float) -> Iterator[tuple[float, NDArray[np.int32]]]:
    """Levels in descending order, and the connected regions above each."""
    for level in _levels(highest, least):
        yield float(level), cv2.connectedComponents((smooth > level).astype(np.uint8), ltype=cv2.CV_32S)[1]


def _joins(smooth: Grey, row: Rows, column: Rows, height: Array, least: float) -> Array:
    """Level at which each maximum joins a higher one, as a share of its height; 0 if it never does."""
    joins = np.zeros(len(row))
    if not len(row):
        return joins
    for level, labels in _sliced(smooth, height[0], 0.5 * least):
        at = labels[row, column]
        first = np.full(int(labels.max()) + 1, len(row))
        np.minimum.at(first, at, np.arange(len(row)))  # maxima are sorted: the first is the highest
        met = (at > 0) & (first[at] < np.arange(len(row))) & (joins == 0)
        joins[met] = np.minimum(level / height[met], 1.0)
    return joins


def _regions(
    smooth: Grey, row: Rows, column: Rows, height: Array, least: float
) -> tuple[NDArray[np.int32], Array, Array]:
    """Owner of each pixel; lower limit of each region, and level of first contact, as shares of heights."""
    count = len(row)
    owner = np.full(smooth.shape, -1, dtype=np.int32)
    level_of, joined = np.ones(count), np.zeros(count)
    if not count:
        return owner, level_of, joined
    for level, labels in _sliced(smooth, height[0], 0.5 * least):
        at = labels[row, column]
        sharing = np.bincount(at, minlength=int(labels.max()) + 1)
        alone = (at > 0) & (sharing[at] == 1)
        touching = (at > 0) & ~alone & (joined == 0)
        joined[touching] = np.minimum(level / height[touching], 1.0)
        take = np.flatnonzero(alone & (level >= _LEVEL * _STEP * height) & (joined == 0))
        level_of[take] = level / height[take]
        spot = np.full(int(labels.max()) + 1, -1, dtype=np.int32)
        spot[at[take]] = take
        mine = spot[labels]
        owner = np.where(mine >= 0, mine, owner)
    return owner, level_of, joined


def _measured(
    light: Grey, smooth: Grey, owner: NDArray[np.int32], height: Array, level: Array, joined: Array
) -> Echoes:
    """Columns of spots from their regions."""
    count = len(height)
    row, column = np.nonzero(owner >= 0)
    spot = owner[row, column]
    weight = np.maximum(smooth[row, column] - 0.9 * (level * height)[spot], 0).astype(np.float64)
    middle, along, across, bend, tilt = _bent(spot, column, row, weight, count)
    claimed = _claimed(owner)
    near_row, near_column = np.nonzero((claimed >= 0) & (smooth > 0.2 * np.append(height, 0.0)[claimed]))
    near = claimed[near_row, near_column]
    pixels = np.maximum(np.bincount(near, minlength=count), 1)
    mean = [np.bincount(near, values, minlength=count) / pixels for values in (near_column, near_row)]
    box = np.zeros((count, 4), dtype=np.intp)
    for at, (values, extreme) in enumerate(
        ((column, np.minimum), (column, np.maximum), (row, np.minimum), (row, np.maximum))
    ):
        box[:, at] = -1 if at % 2 else np.iinfo(np.intp).max
        extreme.at(box[:, at], spot, values)
    return Echoes(
        xy=middle,
        height=height,
        length=4 * np.sqrt(np.maximum(along, 1 / 12)),
        thickness=4 * np.sqrt(np.maximum(across, 1 / 12)),
        curvature=bend,
        tilt=tilt,
        joined=joined,
        level=level,
        edge=_edges(light, owner, count),
        box=box,
        area=np.bincount(spot, minlength=count).astype(np.float64),
        centroid=np.stack(mean, axis=1),
        owner=owner,
        claimed=claimed,
    )


def _bent(
    spot: NDArray[np.int32], column: Rows, row: Rows, weight: Array, count: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Centre of a parabola through each region's light, variances along and across, curvature, tilt."""

    def total(values: NDArray[Any]) -> Array:
        return np.asarray(np.bincount(spot, weight * values, minlength=count), dtype=np.float64)

    sums = np.maximum(total(np.ones(len(row))), 1e-12)
    centre = np.stack([total(column) / sums, total(row) / sums], axis=1)
    x, y = column - centre[spot, 0], row - centre[spot, 1]
    sxx, syy, sxy = total(x * x) / sums, total(y * y) / sums, total(x * y) / sums
    tilt = 0.5 * np.arctan2(2 * sxy, sxx - syy)
    c, s = np.cos(tilt), np.sin(tilt)
    u, v = c[spot] * x + s[spot] * y, c[spot] * y - s[spot] * x
    along, across = total(u * u) / sums, total(v * v) / sums
    # v = a + b u + κ u²/2 by least squares; first moments and that of u v are 0 along these axes.
    skew, fourth, none = total(u**3) / sums, total(u**4) / sums, np.zeros(count)
    normal = np.stack([np.ones(count), none, along, none, along, skew, along, skew, fourth], axis=1)
    right = np.stack([none, none, total(u * u * v) / sums], axis=1)
    fitted = np.linalg.solve(normal.reshape(count, 3, 3) + 1e-6 * np.eye(3), right[..., None])[..., 0]
    middle: Array = centre + fitted[:, :1] * np.stack([-s, c], axis=1)
    bend: Array = np.asarray(2 * fitted[:, 2], dtype=np.float64)
    return middle, along, across, bend, tilt


def _claimed(owner: NDArray[np.int32]) -> NDArray[np.int32]:
    """Regions extended by a few pixels, each pixel assigned to the nearest."""
    if not (owner >= 0).any():
        return owner
    distance, (row, column) = scipy.ndimage.distance_transform_edt(owner < 0, return_indices=True)
    return np.where(distance <= _CLAIM_PX, owner[row, column], -1).astype(np.int32)


def _edges(light: Grey, owner: NDArray[np.int32], count: int) -> Array:
    """Squared steps across and along each region and its border, over the squared light there, (m, 2).

    They are the eigenvalues of the sum of squared differences of neighbours: 1/(2σ²) along an axis for a
    Gaussian of width σ, 2/n for a stroke of n pixels without blur.
    """
    around = cv2.dilate((owner + 1).astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32) - 1
    row, column = np.nonzero(around[:-1, :-1] >= 0)
    spot, here = around[row, column], light[row, column].astype(np.float64)
    right, down = light[row, column + 1] - here, light[row + 1, column] - here

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(spot, values, minlength=count), dtype=np.float64)

    energy = np.maximum(total(here**2), 1e-12)
    xx, yy, xy = (total(product) / energy for product in (right**2, down**2, right * down))
    half, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.stack([half + spread, half - spread], axis=1)
