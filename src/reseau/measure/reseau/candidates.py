"""Candidates for marks in a frame: a matched filter with the formed mark that ignores missing pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask

_BACKGROUND_PX = 41
"""Side of the square whose mean is subtracted first: larger than a mark, smaller than shading."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Places that look like a mark, the likeliest first.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Position in pixels, good to about 0.3 px.
    t : ndarray (m,)
        Amplitude of the mark divided by its standard deviation.
    """

    xy: Array
    t: Array

    def __len__(self) -> int:
        return len(self.t)


def find_candidates(
    pixels: NDArray[Any], valid: Mask, template: Array, least_t: float = 4.0, most: int = 4000
) -> Candidates:
    """Fit a template with amplitude and constant at every pixel, and keep the significant maxima.

    The least-squares amplitude of a template in the window around a pixel, and its standard deviation from
    the residuals in that window, are ratios of correlations of the frame with template, template² and 1.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.
    valid : ndarray (h, w) of bool
        Pixels that carry an image; others are ignored.
    template : ndarray (k, k)
        Formed image of the mark in its polarity, k odd.
    least_t : float
        Minimum amplitude over its standard deviation.
    most : int
        Maximum number of candidates.
    """
    w = valid.astype(np.float32)
    y = pixels.astype(np.float32) * w
    y = (y - _box(y, _BACKGROUND_PX) / np.maximum(_box(w, _BACKGROUND_PX), 1)) * w
    side = len(template)
    n, sum_y, sum_yy = _box(w, side), _box(y, side), _box(y * y, side)
    sum_t, sum_tt, sum_ty = _correlate(w, template), _correlate(w, template**2), _correlate(y, template)
    n = np.maximum(n, 1)
    spread = sum_tt - sum_t**2 / n
    # Less than one fifth of a mark is not enough.
    in_sight = spread > 0.2 * (template**2).sum() - template.sum() ** 2 / template.size * 0.2
    spread = np.where(in_sight, spread, 1)
    amplitude = np.where(in_sight, (sum_ty - sum_t * sum_y / n) / spread, 0)
    rest = sum_yy - sum_y**2 / n - amplitude**2 * spread
    step = float(np.median(np.diff(np.unique(pixels[:: max(1, len(pixels) // 200)])))) if pixels.size else 1.0
    variance = np.maximum(rest / np.maximum(n - 2, 1), step**2 / 12)
    t = amplitude * np.sqrt(spread / variance)
    reach = max(3, side // 2) | 1
    peaks = np.argwhere((t == cv2.dilate(t, np.ones((reach, reach), np.uint8))) & (t > least_t))
    order = np.argsort(-t[peaks[:, 0], peaks[:, 1]], kind="stable")[:most]
    row, column = peaks[order].T
    xy = np.stack([column + _vertex(t, row, column, 0, 1), row + _vertex(t, row, column, 1, 0)], axis=1)
    return Candidates(xy, t[row, column].astype(np.float64))


def _box(image: NDArray[Any], side: int) -> NDArray[np.float32]:
    return cv2.boxFilter(image, cv2.CV_32F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)  # type: ignore[return-value]


def _correlate(image: NDArray[Any], kernel: Array) -> NDArray[np.float32]:
    return cv2.filter2D(image, cv2.CV_32F, kernel.astype(np.float32), borderType=cv2.BORDER_CONSTANT)  # type: ignore[return-value]


def _vertex(t: NDArray[np.float32], row: Any, column: Any, down: int, right: int) -> Array:
    """Offset of the vertex of the parabola through three neighbours, limited to half a pixel."""
    h, w = t.shape
    before = t[np.maximum(row - down, 0), np.maximum(column - right, 0)].astype(np.float64)
    after = t[np.minimum(row + down, h - 1), np.minimum(column + right, w - 1)].astype(np.float64)
    bend = before - 2 * t[row, column] + after
    offset: Array = np.where(bend < 0, (before - after) / np.where(bend < 0, 2 * bend, 1), 0)
    return np.clip(offset, -0.5, 0.5)
