"""Graphics in front of an image: drawn characters, ticks, scale dots and markers, and wires across echoes.

A drawn stroke is as sharp as the screen in every direction; an echo is blurred along its arc. If copying has
blurred a drawing, its neighbours still identify it: characters stand in rows of one height, dots and ticks of
a scale are similar and equally spaced. A row is rejected if most of its members look drawn by themselves, so
that rows of rods are kept.

Wires that cross an echo are found by the sharp dark cut that they leave in it.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Frame, Mask, Rows
from .echoes import Echoes, Grey

_SHARP = 0.16
"""Squared steps over squared light, in the direction where they are smaller: a Gaussian of 1.8 px."""
_SUSPECT = 0.08
"""The same for a spot that counts as drawn if its neighbours do: a Gaussian of 2.5 px."""
_ACROSS = 0.42
"""The same in the other direction: a Gaussian of 1.1 px; a short echo that sharp is drawn, too."""
_FEWEST = 4
"""Minimum number of members of a row."""


def is_sharp(echoes: Echoes) -> Mask:
    """Mask (m,) of spots with sharp borders all around."""
    short = echoes.length < 8.0
    return (echoes.edge[:, 1] > _SHARP) | (short & (echoes.edge[:, 0] > _ACROSS))


def looks_drawn(echoes: Echoes) -> Mask:
    """Mask (m,) of spots about as sharp along as across: drawn, if they stand in a row of such spots."""
    return echoes.edge[:, 1] > _SUSPECT


def series(echoes: Echoes, suspect: Mask) -> tuple[Mask, Mask]:
    """Spots in rows of characters, and in rows of similar, equally spaced marks.

    Parameters
    ----------
    echoes : Echoes
        The spots (m,).
    suspect : ndarray of bool (m,)
        Which spots look drawn by themselves.

    Returns
    -------
    characters, scale : ndarray of bool (m,)
        Spots of rows in which most spots are suspect.
    """
    return _condemned(_lines_of_text(echoes), suspect), _condemned(_equally_spaced(echoes), suspect)


def _condemned(rows: list[Rows], suspect: Mask) -> Mask:
    found = np.zeros(len(suspect), dtype=bool)
    for row in rows:
        if suspect[row].mean() > 0.5:
            found[row] = True
    return found


def _lines_of_text(echoes: Echoes) -> list[Rows]:
    """Runs of neighbours with common top and bottom."""
    left, right, top, bottom = echoes.box.T
    high, middle = bottom - top + 1, (top + bottom) / 2
    rows = []
    glyph = (right - left < 1.6 * high) & (high > 3)
    for size in np.unique(high[glyph]):
        for line in np.unique(top[glyph & (high == size)]):
            alike = np.flatnonzero(glyph & (np.abs(top - line) <= 1) & (np.abs(high - size) <= 1))
            for run in _runs(left[alike], right[alike], 1.5 * size):
                if len(run) < _FEWEST:
                    continue
                first, last = left[alike[run]].min(), right[alike[run]].max()
                # Dots, dashes and parts of letters in between belong to the line.
                inside = (np.abs(middle - line - size / 2) < size) & (high <= 2 * size)
                inside &= (right > first - 2 * size) & (left < last + 2 * size)
                rows.append(np.flatnonzero(inside))
    return rows


def _runs(left: Rows, right: Rows, gap: float) -> list[Rows]:
    """Groups of intervals with gaps of at most `gap` between members."""
    order = np.argsort(left, kind="stable")
    reached = np.maximum.accumulate(right[order])
    breaks = np.flatnonzero(left[order][1:] - reached[:-1] > gap) + 1
    return list(np.split(order, breaks))


def _equally_spaced(echoes: Echoes) -> list[Rows]:
    """Rows of similar spots at equal steps along a straight line."""
    rows = []
    size = np.stack([echoes.length, echoes.thickness], axis=1)
    for i in range(len(echoes)):
        alike = np.flatnonzero(
            (np.abs(echoes.height - echoes.height[i]) < 0.08 * echoes.height[i])
            & (np.abs(size - size[i]) < 0.15 * size[i] + 0.3).all(axis=1)
        )
        alike = alike[alike != i]
        if len(alike) < _FEWEST - 1:
            continue
        step = echoes.xy[alike] - echoes.xy[i]
        # With each other spot as the next of the row: how many more lie at the expected positions?
        off = (
            np.abs(step[None] - 2 * step[:, None]).max(axis=2),
            np.abs(step[None] - 3 * step[:, None]).max(axis=2),
        )
        third, fourth = (distance.argmin(axis=1) for distance in off)
        each = np.arange(len(alike))
        on = (off[0][each, third] < 1.5) & (off[1][each, fourth] < 2.0)
        rows += [np.array([i, alike[k], alike[third[k]], alike[fourth[k]]]) for k in np.flatnonzero(on)]
    return rows


def same_in_all(frame: Frame, others: tuple[Frame, ...]) -> Mask | None:
    """Pixels that are bright and the same in all frames of a sequence; None if nothing moves at all.

    Parameters
    ----------
    frame : Frame
        One of the frames.
    others : tuple of Frame
        The other frames; those of another size are ignored.
    """
    stack: list[Array] = [other.pixels for other in others if other.pixels.shape == frame.pixels.shape]
    if not stack:
        return None
    own = frame.pixels.astype(np.float32)
    change = np.max([np.abs(own - other) for other in stack], axis=0)
    ground = float(np.median(own))
    bright = own > ground + 0.05 * (float(own.max()) - ground)
    same: Mask = change <= 0.02 * frame.full_scale
    if not bright.any() or same[bright].mean() > 0.98:
        return None
    return bright & same


_DEPTH = 0.4
"""Minimum share of the adjacent light that a wire removes."""
_BESIDE_PX = 3
"""Width of the light on either side of a wire; strokes of characters are narrower."""
_APART_PX = 20.0
"""Distance within which at most one more gap is allowed, that of the next wire."""
_AROUND_PX = 9
"""Distance beside a gap within which the light is tested for being an echo."""
_SOFT = 0.1
"""Largest ratio of squared steps along the rows to squared light in an echo: a Gaussian of 2.2 px."""
_FILL_PX = 2.0
"""Width of the Gaussian that interpolates light across a wire."""
_LYING_PX = 25
"""Length of a wire that runs along rows or columns, pixels; others are narrower."""
_SLENDER = 1.0
"""Minimum height over width of the dark gap of a wire, as opposed to the space between two echoes."""


def find_cuts(light: Grey, noise: float, most_px: int) -> Mask:
    """Pixels of narrow dark cuts through bright spots, where vertical wires cross echoes.

    A closing along the rows fills gaps narrower than its element. A cut is a gap that it fills by a large
    share of the light on *both* sides, from one row to the next. Between the ends of two echoes the light
    fades, so a closing fills little there.

    Parameters
    ----------
    light : ndarray (h, w)
        Brightness over the ground.
    noise : float
        Standard deviation of the grey values.
    most_px : int
        Largest width of a wire, including blur; 0 if there are no wires.

    Returns
    -------
    ndarray (h, w) of bool
    """
    if most_px < 1:
        return np.zeros(light.shape, dtype=bool)
    calm: Grey = cv2.GaussianBlur(light, (1, 5), 0.01, sigmaY=1.0)  # type: ignore[assignment]
    wide = cv2.morphologyEx(calm, cv2.MORPH_OPEN, np.ones((1, _BESIDE_PX), np.uint8))
    # An element of even size would shift the result.
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, np.ones((1, most_px + 1 | 1), np.uint8))
    filled = (closed - calm > _DEPTH * closed) & (closed > 8 * noise)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(filled.astype(np.uint8), connectivity=8)
    upright = stats[:, cv2.CC_STAT_HEIGHT] > _SLENDER * stats[:, cv2.CC_STAT_WIDTH]
    upright &= stats[:, cv2.CC_STAT_HEIGHT] >= 3
    upright[0] = False
    if not upright.any():
        return np.zeros(light.shape, dtype=bool)
    upright &= _soft_around(light, labels.astype(np.int32), count)
    # Wires are far apart; between the strokes of characters gaps are close together.
    at = np.flatnonzero(stats[:, cv2.CC_STAT_HEIGHT] >= 3)[1:]
    crowd = scipy.spatial.KDTree(centres[at]).query_ball_point(
        centres[at], _APART_PX, p=np.inf, return_length=True
    )
    upright[at[crowd > 2]] = False
    # The blur of the wire's edges extends one pixel further.
    cut = cv2.dilate(upright[labels].astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(cut > 0)


def _soft_around(light: Grey, labels: NDArray[np.int32], count: int) -> Mask:
    """Gaps in light that changes slowly along the rows, as in an echo but not in characters."""
    near = cv2.dilate((labels > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    apart: Grey = np.where(near, np.float32(0), light)
    both = ~near[:, 1:] & ~near[:, :-1]
    step = np.zeros_like(light)
    step[:, 1:][both] = (apart[:, 1:] - apart[:, :-1])[both]
    window = (2 * _AROUND_PX + 1, 3)
    steps, energy = (
        cv2.boxFilter(values * values, cv2.CV_32F, window, normalize=False) for values in (step, apart)
    )
    inside = labels > 0
    sums = [np.bincount(labels[inside], values[inside], minlength=count) for values in (steps, energy)]
    return np.asarray(sums[0] <= _SOFT * sums[1])


def bridged(light: Grey, hidden: Mask) -> Grey:
    """Light with hidden pixels interpolated from their neighbours; for detection, not for measurement.

    Parameters
    ----------
    light : ndarray (h, w)
        Brightness over the ground.
    hidden : ndarray (h, w) of bool
        Hidden pixels.
    """
    if not hidden.any():
        return light
    seen = np.where(hidden, np.float32(0), np.float32(1))
    # Along the rows only: a wire that crosses an arc does not make it thicker.
    weight, carried = (
        cv2.GaussianBlur(image, (0, 0), _FILL_PX, sigmaY=0.3) for image in (seen, seen * light)
    )
    filled: Grey = np.where(hidden & (weight > 1e-3), carried / np.maximum(weight, 1e-3), light)
    # Beneath a wire along the rows nothing is seen on either side; the wire itself may be bright.
    weight, carried = (
        cv2.GaussianBlur(image, (0, 0), 0.3, sigmaY=_FILL_PX) for image in (seen, seen * light)
    )
    along = hidden & _lying(hidden)
    return np.where(along, carried / np.maximum(weight, 1e-3), filled).astype(np.float32)


def _lying(hidden: Mask) -> Mask:
    """Hidden pixels in runs along the rows that are longer than those along the columns."""
    bar = np.ones((1, _LYING_PX), np.uint8)
    rows, columns = (cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_OPEN, k) for k in (bar, bar.T))
    return np.asarray((rows > 0) & (columns == 0))
