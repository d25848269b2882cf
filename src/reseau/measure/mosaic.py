r"""Raw frames of colour sensors: pixels behind their filters are brought to one scale, none is interpolated.

Behind filters of gains :math:`g_k` (k: place in a cell of 2 × 2 pixels) a colourless scene L is recorded as
:math:`g_k L`. Two explanations of a frame compete: one gain, and four. Each predicts a pixel by its four
neighbours, which in most of a frame are of nearly the same light. Four gains explain the frame if more than
half of the variance of what one gain does not predict is theirs; otherwise they are less than the noise, and
nothing is changed. Where camera or file tell that there are filters, there is nothing to decide.

In a coloured scene a filter has another gain at each place. Where the filters are known, gains of the whole
frame compete with gains of blocks, by the likelihood of what both do not predict and the number of gains; the
luminance of a coloured scene is interpolated.
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
_STEP = 1 / 12
"""Variance of rounding."""
_AROUND = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
_LEVEL = np.array([1, 2, 1], np.float32) / 4
"""The level of a place is the same for the four filters: each is in it with the weight of a quarter."""


def gains_of(frame: Frame) -> Array:
    """Return the gains (2, 2) of the pixels of a cell, the largest 1; ones if one gain explains the frame.

    A frame that is known to be a mosaic has four.

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
    level = cv2.sepFilter2D(grey, -1, _LEVEL, _LEVEL)
    cells = (height // 2, 2, width // 2, 2)
    power = (level * level).reshape(cells).sum(axis=(0, 2), dtype=np.float64)
    found: Array = (grey * level).reshape(cells).sum(axis=(0, 2), dtype=np.float64) / np.maximum(power, 1e-30)
    found /= max(found.max(), 1e-30)
    if found.min() <= 0:
        return even
    told = frame.filters or 2 * _unpredicted(_divided(grey, found)) < _unpredicted(grey)
    return found if told else even


def _divided(pixels: NDArray[np.float32], gains: Array) -> NDArray[np.float32]:
    height, width = pixels.shape
    whole = np.tile(1 / gains, (height // 2 + 1, width // 2 + 1))[:height, :width]
    return pixels * whole.astype(np.float32)


def _unpredicted(grey: NDArray[np.float32]) -> float:
    """Square of the median deviation of a pixel from its four neighbours."""
    return float(np.median(np.abs(grey - cv2.filter2D(grey, -1, _AROUND)))) ** 2


def _coloured(grey: NDArray[np.float32]) -> bool:
    """Whether gains of blocks explain a frame, whose filters have one gain, better than that gain."""
    side = _LEAST
    rows, columns = (length // side for length in grey.shape)
    if min(rows, columns) < 2:
        return False
    grey = grey[: rows * side, : columns * side]
    level = cv2.sepFilter2D(grey, -1, _LEVEL, _LEVEL)
    cells = (rows, side // 2, 2, columns, side // 2, 2)
    power = (level * level).reshape(cells).sum(axis=(1, 4), keepdims=True)
    gains = (grey * level).reshape(cells).sum(axis=(1, 4), keepdims=True) / np.maximum(power, 1e-30)
    gains = np.where(gains > 0, gains, 1)
    own = (grey.reshape(cells) / gains).reshape(grey.shape)
    off = [grey - cv2.filter2D(grey, -1, _AROUND), own - cv2.filter2D(own, -1, _AROUND)]
    off[1] = (off[1].reshape(cells) * gains).reshape(grey.shape)
    one, four = ((each**2).reshape(rows, side, columns, side).mean(axis=(1, 3)) for each in off)
    # Grey values are integers: what is below their steps is none of an explanation.
    better = side**2 / 2 * np.log((one + _STEP) / (four + _STEP)) - 3 / 2 * np.log(side**2)
    return bool(better.sum() > 0)


def _luminance(frame: Frame, even: NDArray[np.float32]) -> NDArray[np.float32]:
    """The luminance of a coloured scene, interpolated between pixels of the same filter."""
    scale = 65535 / max(float(even.max()), 1e-30)
    kind = getattr(cv2, f"COLOR_Bayer{frame.filters}2RGB_EA")
    colours = cv2.demosaicing(np.rint(np.clip(even * scale, 0, 65535)).astype(np.uint16), kind)
    return np.asarray(cv2.cvtColor(colours.astype(np.float32), cv2.COLOR_RGB2GRAY) / scale, np.float32)


def balanced(frame: Frame) -> Frame:
    """Return a frame whose pixels have one gain; the frame itself if they have.

    Examples
    --------
    >>> frame = Frame(np.random.default_rng(0).normal(100, 2, (90, 90)), 255.0)
    >>> balanced(frame) is frame
    True
    """
    gains = gains_of(frame)
    even = _divided(frame.pixels.astype(np.float32), gains)
    if frame.filters and _coloured(even):
        return replace(frame, pixels=_luminance(frame, even), filters="")
    return frame if (gains == 1).all() else replace(frame, pixels=even, filters="")
