"""What stands before the image: wires that cross an echo, found by the sharp dark cut they leave in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...core.data import Mask
from .echoes import Grey

__all__ = ["bridged", "find_cuts"]

_DEPTH = 0.4
"""Share of the light beside it that a wire takes at least."""
_BESIDE_PX = 3
"""Width of the light on either side of a wire; strokes of characters are narrower."""
_APART_PX = 20.0
"""Distance within which there may be one gap more, the next wire's, but not two."""
_AROUND_PX = 9
"""How far beside a gap the light is asked whether it is an echo's."""
_SOFT = 0.1
"""Squared steps along the rows over squared light in an echo, at most: a Gaussian of 2.2 px."""
_FILL_PX = 2.0
"""Width of the Gaussian by which light beside a wire is carried over it."""
_SLENDER = 1.0
"""Height over width from which a dark gap is a wire's and not the space between two echoes."""


def find_cuts(light: Grey, noise: float, most_px: int) -> Mask:
    """Pixels of narrow dark cuts through bright spots: where upright wires cross echoes.

    The closing along the rows fills what is narrower than its element; a cut is what it fills by a good part
    of the light on *both* sides, from one row to the next. Between the ends of two echoes light fades: a
    closing has little to fill there.

    Parameters
    ----------
    light : ndarray (h, w)
        Brightness over the ground.
    noise : float
        Standard deviation of the grey values.
    most_px : int
        Greatest width of a wire, blur included; 0: there are none.

    Returns
    -------
    ndarray (h, w) of bool
    """
    if most_px < 1:
        return np.zeros(light.shape, dtype=bool)
    calm: Grey = cv2.GaussianBlur(light, (1, 5), 0.01, sigmaY=1.0)  # type: ignore[assignment]
    wide = cv2.morphologyEx(calm, cv2.MORPH_OPEN, np.ones((1, _BESIDE_PX), np.uint8))
    # An even element would shift what it closes.
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, np.ones((1, most_px + 1 | 1), np.uint8))
    filled = (closed - calm > _DEPTH * closed) & (closed > 8 * noise)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(filled.astype(np.uint8), connectivity=8)
    upright = stats[:, cv2.CC_STAT_HEIGHT] > _SLENDER * stats[:, cv2.CC_STAT_WIDTH]
    upright &= stats[:, cv2.CC_STAT_HEIGHT] >= 3
    upright[0] = False
    if not upright.any():
        return np.zeros(light.shape, dtype=bool)
    upright &= _soft_around(light, labels.astype(np.int32), count)
    # Wires stand far apart; between the strokes of characters there is one gap beside the other.
    at = np.flatnonzero(stats[:, cv2.CC_STAT_HEIGHT] >= 3)[1:]
    crowd = KDTree(centres[at]).query_ball_point(centres[at], _APART_PX, p=np.inf, return_length=True)
    upright[at[crowd > 2]] = False
    # The blur of the wire's edges reaches a pixel further.
    cut = cv2.dilate(upright[labels].astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(cut > 0)


def _soft_around(light: Grey, labels: NDArray[np.int32], count: int) -> Mask:
    """Which gaps lie in light that changes slowly along the rows, as in an echo and in no character."""
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
    """The light with hidden pixels filled from those beside them, for finding echoes, not for measuring.

    Parameters
    ----------
    light : ndarray (h, w)
        Brightness over the ground.
    hidden : ndarray (h, w) of bool
        Pixels that show something else.
    """
    if not hidden.any():
        return light
    seen = np.where(hidden, np.float32(0), np.float32(1))
    # Along the rows alone: a wire that crosses an arc does not make it thicker.
    weight, carried = (
        cv2.GaussianBlur(image, (0, 0), _FILL_PX, sigmaY=0.3) for image in (seen, seen * light)
    )
    filled: Grey = np.where(hidden & (weight > 1e-3), carried / np.maximum(weight, 1e-3), light)
    return filled
