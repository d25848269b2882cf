"""Profiles of lines one pixel wide: their crossings with the rows or columns of a frame, and their images.

Along a line the image changes slowly, so that it is the image of a strip: the difference of two blurred steps
as a function of the distance from the line. Level, depth and place of a profile are estimated by least
squares from the pixels of a row around the crossing, or of a column for lines that are nearly horizontal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ...core.data import Array, Rows
from ...optics.formation import PixelResponse

__all__ = ["Crossings", "blur_of", "crossings", "located", "strip"]

_REACH = 2
"""Pixels to either side of a line that are looked at."""
_MOST_PX = 0.7
"""How far a line may be off its approximate place."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where a line crosses the rows or columns of a frame, in columns over the n crossings.

    Parameters
    ----------
    axis : int
        0 where it crosses columns, 1 where it crosses rows.
    step : ndarray of int (n,)
        Which of them.
    place : ndarray (n,)
        The other coordinate there.
    normal : ndarray (n, 2)
        Unit vector across.
    along : ndarray (n,)
        Parameter along the line.
    """

    axis: int
    step: Rows
    place: Array
    normal: Array
    along: Array

    def xy(self, shift: Array) -> Array:
        """Points (n, 2), moved across by a shift (n,)."""
        pair = (self.step, self.place) if self.axis == 0 else (self.place, self.step)
        return np.stack(pair, axis=1).astype(np.float64) + shift[:, None] * self.normal

    def within(self, reach: int, shape: tuple[int, ...]) -> Crossings:
        """The crossings at most `reach` outside a frame of this height and width."""
        keep = (self.place > -reach) & (self.place < shape[self.axis] + reach)
        return Crossings(self.axis, self.step[keep], self.place[keep], self.normal[keep], self.along[keep])

    def around(self, reach: int) -> tuple[NDArray[Any], NDArray[Any], Array]:
        """Rows and columns (n, 2·reach + 1) of the pixels around, in the frame or not; distances (n, …)."""
        beside = np.rint(self.place).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
        across = self.normal[:, 1 - self.axis, None]
        distance = (beside - self.place[:, None]) * across
        steps = np.broadcast_to(self.step[:, None], beside.shape)
        row, column = (beside, steps) if self.axis == 0 else (steps, beside)
        return row, column, distance


def crossings(xy: Array, along: Array, shape: tuple[int, int], beyond: float = 0.0) -> Crossings | None:
    """Crossings of a line, of which points were computed, with the rows or columns of a frame.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Points along the line, in and beyond the frame.
    along : ndarray (m,)
        Parameter of the line at these points.
    shape : (int, int)
        Height and width of the frame.
    beyond : float
        Distance by which the line is extended beyond its ends, pixels.

    Returns
    -------
    Crossings or None
        None if the line does not cross the frame.
    """
    way = np.empty_like(xy)
    way[1:-1], way[0], way[-1] = xy[2:] - xy[:-2], xy[1] - xy[0], xy[-1] - xy[-2]
    axis = int(np.abs(way[:, 1]).sum() > np.abs(way[:, 0]).sum())
    if xy[-1, axis] < xy[0, axis]:
        xy, along, way = xy[::-1], along[::-1], way[::-1]
    first = max(0.0, np.ceil(xy[0, axis] - beyond))
    last = min(shape[1 - axis] - 1.0, np.floor(xy[-1, axis] + beyond))
    if not first <= last:
        return None
    step = np.arange(first, last + 1)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=1)
    normal /= np.maximum(np.hypot(*normal.T), 1e-12)[:, None]
    place, x, y, u = (np.interp(step, xy[:, axis], v) for v in (xy[:, 1 - axis], *normal.T, along))
    return Crossings(axis, step.astype(np.intp), place, np.stack([x, y], axis=1), u)


def blur_of(psf_px: float, response: PixelResponse) -> float:
    """Width (one sigma) of a blurred edge; the square of a pixel has the same variance in all directions."""
    return float(np.hypot(psf_px, response.fill / np.sqrt(12)))


def strip(distance: Array, half_width: Array, blur: float) -> Array:
    """Share of pixels covered by a strip, from their distances to its centre line; all in pixels."""
    share: Array = ndtr((distance + half_width) / blur) - ndtr((distance - half_width) / blur)
    return share


def located(
    grey: NDArray[np.float32], line: Crossings, half_width: Array, blur: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Offsets (n,) of a dark line from its crossings, in pixels across, and a mask of determined ones."""
    h, w = grey.shape
    row, column, distance = line.around(_REACH)
    inside = ((row >= 0) & (row < h) & (column >= 0) & (column < w)).all(axis=1)
    seen = grey[row.clip(0, h - 1), column.clip(0, w - 1)].astype(np.float64)
    far, near = ((distance + sign * half_width[:, None]) / blur for sign in (1, -1))
    slope = (np.exp(-0.5 * near**2) - np.exp(-0.5 * far**2)) / (np.sqrt(2 * np.pi) * blur)
    design = np.stack([np.ones_like(slope), strip(distance, half_width[:, None], blur), slope], axis=2)
    normal = np.swapaxes(design, 1, 2) @ design
    normal[:, [0, 1, 2], [0, 1, 2]] += 1e-9  # regularizes where the pixels do not determine the profile
    x = np.linalg.solve(normal, np.swapaxes(design, 1, 2) @ seen[..., None])[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = x[:, 2] / x[:, 1]
    measured = inside & (x[:, 1] < 0) & (np.abs(shift) < _MOST_PX)
    return np.where(measured, shift, 0.0), measured
