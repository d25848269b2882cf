r"""Raw frames of colour sensors: pixels behind their filters are brought to one scale, none is interpolated.

Behind filters of gains :math:`g_k` (k: place in a cell of 2 × 2 pixels) a colourless scene L is recorded as
:math:`g_k L`. Two explanations of a frame compete: one gain, and four. Each predicts a pixel by its four
neighbours, which in most of a frame are of nearly the same light. Four gains explain the frame if more than
half of the variance of what one gain does not predict is theirs; otherwise they are less than the noise, and
nothing is changed.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame

_LEAST = 16
"""Smallest side of a frame in which gains are looked for, and height of the bands of a large one (px)."""
_BANDS = 16


def gains_of(frame: Frame) -> Array:
    """Return the gains (2, 2) of the pixels of a cell, the largest 1; ones if one gain explains the frame.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> scene = 100 + 80 * np.sin(np.arange(160) / 7) * np.cos(np.arange(120) / 5)[:, None]
    >>> filters = np.tile([[0.6, 1.0], [1.0, 0.5]], (60, 80))
    >>> gains_of(Frame(scene * filters + rng.normal(0, 1, scene.shape), 255.0)).round(2).tolist()
    [[0.6, 1.0], [1.0, 0.5]]
    >>> gains_of(Frame(scene + rng.normal(0, 1, scene.shape), 255.0)).tolist()
    [[1.0, 1.0], [1.0, 1.0]]
    """
    height, width = (side // 2 * 2 for side in frame.pixels.shape)
    even: Array = np.ones((2, 2))
    if min(height, width) < _LEAST:
        return even
    if height > _BANDS * _LEAST:  # some bands of a large frame are enough
        first = (np.linspace(0, height - _LEAST, _BANDS) // 2 * 2).astype(int)
        rows, height = (first[:, None] + np.arange(_LEAST)).ravel(), _BANDS * _LEAST
    else:
        rows = np.arange(height)
    grey = frame.pixels[rows, :width].astype(np.float32)
    # The level of a place is the same for the four filters: each is in it with the weight of a quarter.
    weights = np.array([1, 2, 1], np.float32) / 4
    level = cv2.sepFilter2D(grey, -1, weights, weights)
    cells = (height // 2, 2, width // 2, 2)
    power = (level * level).reshape(cells).sum(axis=(0, 2), dtype=np.float64)
    found: Array = (grey * level).reshape(cells).sum(axis=(0, 2), dtype=np.float64) / np.maximum(power, 1e-30)
    found /= max(found.max(), 1e-30)
    if found.min() <= 0 or 2 * _unpredicted(_divided(grey, found)) >= _unpredicted(grey):
        return even
    return found


def _divided(pixels: NDArray[np.float32], gains: Array) -> NDArray[np.float32]:
    height, width = pixels.shape
    whole = np.tile(1 / gains, (height // 2 + 1, width // 2 + 1))[:height, :width]
    return pixels * whole.astype(np.float32)


def _unpredicted(grey: NDArray[np.float32]) -> float:
    """Square of the median deviation of a pixel from its four neighbours."""
    around = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
    return float(np.median(np.abs(grey - cv2.filter2D(grey, -1, around)))) ** 2


def balanced(frame: Frame) -> Frame:
    """Return a frame whose pixels have one gain; the frame itself if they have.

    Examples
    --------
    >>> frame = Frame(np.random.default_rng(0).normal(100, 2, (90, 90)), 255.0)
    >>> balanced(frame) is frame
    True
    """
    gains = gains_of(frame)
    if (gains == 1).all():
        return frame
    return replace(frame, pixels=_divided(frame.pixels.astype(np.float32), gains))
