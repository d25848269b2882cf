"""What is on both sides of a frame's edges in an overview: whether it is one, and where its film ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...core.data import Array
from .border import best_line, likelihood

__all__ = ["FrameGuess", "crossings_of", "judged", "lies_in", "settled", "size_of"]

Plane = NDArray[np.float32]

_OUTWARD_MM = 0.8
"""How far beyond a line that voted the edge is looked for; perforations are hardly nearer to it."""
_OUTSIDE, _INSIDE = (-3.5, -2.5, -1.5), (2.0, 3.0)
"""Distances inwards at which film, wherever there is some, and picture are looked at, pixels of the overview.
"""
_GAP_MM = 0.15
"""Width of film beyond which something else begins, as perforations do."""
_ALONG = np.linspace(-0.92, 0.92, 80)
"""Where along an edge its surroundings are looked at, −1 to 1."""


@dataclass(frozen=True, eq=False)
class FrameGuess:
    """A frame as the overview shows it.

    Parameters
    ----------
    corners : ndarray (4, 2)
        ul, ur, lr, ll in pixels of the overview.
    polarity : int
        1 where the film around is darker than the picture, −1 where it is brighter.
    format_mm : (float, float)
        Width and height as they lie in the scan.
    supported : tuple of bool
        Which edges were seen: upper, right, lower, left. Where one was not, the format gives it.
    score : float
        How much of its outline separates unexposed film from picture, less what contradicts, 0 to 4.
    """

    corners: Array
    polarity: int
    format_mm: tuple[float, float]
    supported: tuple[bool, bool, bool, bool]
    score: float


def judged(guess: FrameGuess, grey: Plane) -> FrameGuess | None:
    """The guess with its score by what is on both sides of its edges; None where that is no frame."""
    outside, inside = _sides(guess, grey)
    known, seen = np.isfinite(outside) & np.isfinite(inside), np.array(guess.supported)
    if (known.mean(axis=1)[seen] < 0.5).any() or (seen.all() and not _within(guess.corners, grey.shape)):
        return None
    level, spread, strong = _film(guess, outside[seen], inside[seen])
    if strong <= 0:
        return None
    own = np.nanmedian(np.where(known, outside, level), axis=1)
    contrast = guess.polarity * (inside - own[:, None])
    least = max(4 * spread, 0.08 * strong)
    film = np.abs(outside - own[:, None]) < max(least, 0.15 * strong)
    step, against = (film & (contrast > least)).mean(axis=1), (~film & known).mean(axis=1)
    # A picture's own rectangle has other tones around it, from side to side.
    excess = guess.polarity * (own - level) / strong
    if (excess[seen] > 0.6).any() or (step[seen] < 0.12).any() or (against[seen] > 0.5).any():
        return None
    total = float((step - against - np.clip(2 * excess - 0.1, 0, 1))[seen].sum())
    if total < 0.4 * seen.sum():
        return None
    return FrameGuess(guess.corners, guess.polarity, guess.format_mm, guess.supported, total)


def lies_in(xy: Array, shape: tuple[int, ...]) -> bool:
    """Whether a point is within an image of a shape."""
    return bool((xy > 0).all() and (xy < np.array(shape[::-1]) - 1).all())


def _within(corners: Array, shape: tuple[int, ...]) -> bool:
    return bool((corners > -1).all() and (corners < np.array(shape[::-1])).all())


def _film(guess: FrameGuess, outside: Array, inside: Array) -> tuple[float, float, float]:
    """Tone of unexposed film, how it scatters, and the contrast of a bright picture against it."""
    own = np.nanmedian(outside, axis=1)
    # Film is darker than any picture (polarity 1): the second darkest of the edges is not by chance.
    level = float(guess.polarity * np.sort(guess.polarity * own)[min(1, len(own) - 1)])
    spread = float(np.nanmedian(np.abs(outside - own[:, None])))
    strong = float(np.nanquantile(guess.polarity * (inside - level), 0.8))
    return level, spread, strong


def settled(guess: FrameGuess, grey: Plane) -> FrameGuess:
    """Each edge moved to where unexposed film ends; the lines that voted may run within the picture."""
    scale = float(np.mean(size_of(guess.corners) / guess.format_mm))
    seen = np.array(guess.supported)
    outside, inside = _sides(guess, grey)
    level, spread, strong = _film(guess, outside[seen], inside[seen])
    out, reach = int(np.clip(_OUTWARD_MM * scale, 4, 20)), 6
    offsets = np.arange(-out - 2, 3 * reach + 1)
    profiles = np.stack([_beside(guess.corners, grey, (float(o),)) for o in offsets], axis=2)
    known = np.isfinite(profiles)
    least = max(4 * spread, 0.08 * strong)
    moved = np.zeros((4, 2))
    for k in np.flatnonzero(seen):
        near = _running(outside[k], level)
        far = _running(np.nanmean(np.where(known[k], profiles[k], level)[:, : out // 2], axis=1), level)
        # Where the line that voted has other tones before it than film, film is looked for further out.
        further = guess.polarity * (np.median(far) - np.median(near)) / strong
        raised = guess.polarity * (np.median(near) - level) > 0.1 * strong
        film = (far if raised and further < 0 else near)[:, None]
        # Where film is a narrow strip, blurred with something else beyond it, one place of it must do.
        narrow = further > 0.1
        gap = 1 if narrow else max(2, round(_GAP_MM * scale))
        significant = max(least, 0.4 * further * strong) if narrow else least
        departure = guess.polarity * (np.where(known[k], profiles[k], film) - film) / significant
        found = likelihood(departure, known[k], out + 2, gap)
        start, stop = best_line(found, _ALONG, 2, len(offsets) - 2 * reach, 4)
        moved[k] = offsets[0] - 0.5 + np.array([start, stop])
    return FrameGuess(
        _moved(guess.corners, moved), guess.polarity, guess.format_mm, guess.supported, guess.score
    )


def _running(values: Array, level: float) -> Array:
    """Running median of values (n,) along an edge: the scanner's light may be uneven."""
    filled = np.where(np.isfinite(values), values, level)
    return np.asarray(median_filter(filled, size=31, mode="nearest"))


def _moved(corners: Array, ends: Array) -> Array:
    """Corners of a frame whose edges were moved inwards by `ends` (4, 2) at their beginning and end."""
    following = np.roll(corners, -1, axis=0)
    along = (following - corners) / np.hypot(*(following - corners).T)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    a, b = corners + ends[:, :1] * normal, following + ends[:, 1:] * normal
    return crossings_of(a, b)


def crossings_of(a: Array, b: Array) -> Array:
    """Corners (4, 2) of lines through a and b, both (4, 2): corner k is where line k meets the one before."""
    line = np.cross(np.column_stack([a, np.ones(4)]), np.column_stack([b, np.ones(4)]))
    corner = np.cross(np.roll(line, 1, axis=0), line)
    return np.asarray(corner[:, :2] / corner[:, 2:])


def _sides(guess: FrameGuess, grey: Plane) -> tuple[Array, Array]:
    """Grey values (4, 80) along the edges outside, where they are most like film, and inside."""
    outside = [guess.polarity * _beside(guess.corners, grey, (offset,)) for offset in _OUTSIDE]
    return guess.polarity * np.fmin.reduce(outside), _beside(guess.corners, grey, _INSIDE)


def _beside(corners: Array, grey: Plane, offsets: Sequence[float]) -> Array:
    """Mean grey values (4, 80) along the edges at distances inwards; NaN outside the overview."""
    t = (_ALONG + 1) / 2
    a, b = corners, np.roll(corners, -1, axis=0)
    along = (b - a) / np.hypot(*(b - a).T)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    at = a[:, None] + t[:, None] * (b - a)[:, None]
    total = np.zeros(at.shape[:2])
    for offset in offsets:
        xy = (at + offset * normal[:, None]).astype(np.float32)
        # Beyond the border of the scan there is nothing.
        total += cv2.remap(
            grey, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
        )
    return total / len(offsets)


def size_of(corners: Array) -> Array:
    """Width and height of a frame, means of its sides."""
    ul, ur, lr, ll = corners
    return np.array([np.hypot(*(ur + lr - ul - ll)), np.hypot(*(ll + lr - ul - ur))]) / 2
