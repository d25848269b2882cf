"""Screening of a frame before measurement: valid pixels, levelled borders, and noise of the grey values."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ..core.data import Array, Frame, Mask
from ..core.failure import Code, Failure

_BORDER = 3
"""Outermost lines of a frame whose level is compared with that of the lines further inside."""
_ALONG = 41
"""Length of the running median along a border: several times the size of a mark."""
_BLOCK = 6
"""Side of the blocks of pixels in which the noise is estimated."""
_SPIKE = 6.0
"""A pixel is a bit error if it leaves the range of its neighbours by more than this many noise sigmas."""

_LOW, _ROUNDED, _ENOUGH = 4, 1.5, 8
"""Frequencies of the cosine transform along an axis that images of marks have; coefficients that rounding of
grey values does not make; fewest of one frequency that show its step."""
_SIDE, _STEEP, _STEPS = 8, 8.0, 1.15
"""Side of the blocks of JPEG; grey levels above which a step is one of the scene; least ratio of the steps
between blocks to those elsewhere (along both axes at most 1.09 without compression in frames of reseaux, 1.1
and more at quality 90)."""


@dataclass(frozen=True, eq=False)
class Screened:
    """A frame prepared for measurement.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values with levelled borders.
    valid : ndarray (h, w) of bool
        Pixels that carry image content.
    noise : float
        Standard deviation of the grey values, including quantisation.
    """

    grey: NDArray[np.float32]
    valid: Mask
    noise: float


def screen(frame: Frame, run: int | None, *, noisy: bool = True) -> Screened | Failure:
    """Find the valid pixels of a frame, level its borders, and estimate its noise.

    Parameters
    ----------
    frame : Frame
        The frame.
    run : int or None
        Minimum length in pixels of a straight run of the lowest grey value that counts as lost pixels; choose
        several times the size of a mark. None for bright marks on a black background: then no pixels are
        treated as lost, and borders are not levelled.
    noisy : bool
        Whether the noise is estimated; otherwise it is NaN. Needed where pixels may be lost.

    Returns
    -------
    Screened or Failure
        A failure when all pixels have the same grey value, or almost all are black or saturated.
    """
    pixels = frame.pixels
    low, high = float(pixels.min()), float(pixels.max())
    if low == high:
        full = high >= frame.full_scale
        colour = "black" if low == 0 else "saturated" if full else "of one grey"
        code = Code.SATURATED if full else Code.LOW_CONTRAST
        return Failure(f"is all {colour}; check exposure and shutter", code, frame.name)
    if (share := float(np.mean(pixels >= frame.full_scale))) > 0.9:
        why = f"is saturated over {share:.0%} of its area; reduce the exposure"
        return Failure(why, Code.SATURATED, frame.name)
    grey = pixels.astype(np.float32)
    if run is None:
        valid = np.ones(pixels.shape, dtype=bool)
        return Screened(grey, valid, _noise(pixels, None) if noisy else np.nan)
    valid = ~_lost(pixels, run)
    if (share := float(np.mean(valid & (pixels > low)))) < 0.02:
        why = f"is black over {1 - share:.0%} of its area; increase the exposure"
        return Failure(why, Code.LOW_CONTRAST, frame.name)
    noise = _noise(pixels, valid)
    valid &= ~_spikes(grey, noise)
    return Screened(_level_borders(grey, valid), valid, noise)


def inner_pixels(valid: Mask, width: int) -> Mask:
    """Valid pixels (h, w) without the outermost lines of a frame, `width` of them on each side.

    Examples
    --------
    >>> int(inner_pixels(np.ones((5, 6), dtype=bool), 2).sum())
    2
    """
    inner = np.zeros_like(valid)
    kept = slice(width, valid.shape[0] - width), slice(width, valid.shape[1] - width)
    inner[kept] = valid[kept]
    return inner


def _lost(pixels: NDArray[Any], run: int) -> Mask:
    """Mask of lost telemetry, masked borders and dead lines: straight runs of the lowest grey value."""
    extreme = (pixels == pixels.min()).astype(np.uint8)
    rows, columns = (
        cv2.morphologyEx(extreme, cv2.MORPH_OPEN, np.ones(size, np.uint8)) > 0
        for size in ((1, run), (run, 1))
    )
    return rows | columns


def _noise(pixels: NDArray[Any], valid: Mask | None) -> float:
    """Robust standard deviation from second differences along the lines where all three pixels are valid."""
    rows = slice(None, None, max(1, len(pixels) // 256))  # a few hundred lines are enough
    bend = _second_differences(pixels[rows].astype(np.float32))
    if valid is not None:
        seen = valid[rows]
        bend = bend[seen[:, 1:-1] & seen[:, :-2] & seen[:, 2:]]
    steps = np.diff(_values(pixels[:: max(1, len(pixels) // 100)]).astype(np.float64))
    quantisation = float(np.median(steps) / np.sqrt(12))
    if not bend.size:
        return quantisation
    return max(float(1.4826 * _median_size(bend, pixels.dtype) / np.sqrt(1.5)), quantisation)


def _second_differences(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Half the negative second differences (h, w − 2) along the lines."""
    bend = grey[:, :-2] + grey[:, 2:]
    bend *= -0.5
    bend += grey[:, 1:-1]
    return bend


def _values(pixels: NDArray[Any]) -> NDArray[Any]:
    """Grey values that occur, in ascending order; of bytes they are counted, which is faster than sorting."""
    if pixels.dtype == np.uint8:
        return np.flatnonzero(np.bincount(pixels.ravel(), minlength=256))
    return np.unique(pixels)


def _median_size(bend: NDArray[Any], of: np.dtype[Any]) -> float:
    """Median of the absolute second differences of grey values of a type."""
    if of.kind != "u" or of.itemsize > 1:
        return float(np.median(np.abs(bend)))
    # Few values are possible, multiples of a half: counting them is faster than a partition.
    count = np.cumsum(np.bincount((2 * np.abs(bend)).astype(np.intp).ravel()))
    middle = np.searchsorted(count, [(bend.size - 1) // 2, bend.size // 2], side="right")
    return float(middle.mean()) / 2


def quiet_noise(grey: NDArray[np.float32]) -> float:
    """Standard deviation of the noise in the quietest tenth of a frame that is otherwise full of targets."""
    bend = _second_differences(grey)
    side = _BLOCK
    rows, columns = bend.shape[0] // side, bend.shape[1] // side
    if not rows or not columns:
        return float(np.std(bend) / np.sqrt(1.5))
    bend, size = bend[: rows * side, : columns * side], (columns, rows)
    mean = cv2.resize(bend, size, interpolation=cv2.INTER_AREA)  # of whole blocks
    bend *= bend
    variance = cv2.resize(bend, size, interpolation=cv2.INTER_AREA) - mean * mean
    deviation = np.sqrt(np.maximum(variance, 0))
    # The lowest decile of standard deviations from 36 values is too small by one eighth.
    quiet = float(1.12 * np.quantile(deviation, 0.1) / np.sqrt(1.5))
    return max(quiet, float(1 / np.sqrt(12))) if float(grey.max()) > 1 else quiet


def _spikes(grey: NDArray[np.float32], noise: float) -> Mask:
    """Mask of bit errors: single pixels that leave the range of their neighbours by more than that range."""
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    high, low = cv2.dilate(grey, ring), cv2.erode(grey, ring)
    beyond = np.maximum(_SPIKE * noise, high - low)
    mask: Mask = (grey > high + beyond) | (grey < low - beyond)
    return mask


def _level_borders(grey: NDArray[np.float32], valid: Mask) -> NDArray[np.float32]:
    """Bring the outermost lines to the level of the lines further inside.

    The first and last lines of a scanned camera tube are brighter or darker than the rest. The running median
    along the border measures this difference; marks do not affect it.
    """
    if min(grey.shape) < 8 * _BORDER:
        return grey
    levelled = grey.copy()
    for turned, mask in ((levelled, valid), (levelled.T, valid.T)):  # views: assignments change `levelled`
        for lines in (turned, turned[::-1]):
            inside = _running_median(np.median(lines[_BORDER : 3 * _BORDER], axis=0))
            usable = mask.mean() > 0.5
            for line in lines[:_BORDER]:
                level = _running_median(line)
                gain = np.where((level > 0) & usable, inside / np.maximum(level, 1e-6), 1.0)
                # Correct a border effect only, not shading or a scene that ends at the border.
                uneven = np.median(np.abs(np.log(np.clip(gain, 0.1, 10)))) > 0.05
                if uneven:
                    line *= np.clip(gain, 0.1, 10).astype(np.float32)
    return levelled


def _running_median(line: NDArray[Any]) -> Array:
    smooth: Array = scipy.ndimage.median_filter(line.astype(np.float64), size=_ALONG, mode="nearest")
    return smooth


def lost_in_blocks(pixels: NDArray[Any]) -> float | None:
    """Largest rms of the detail that compression in blocks of 8 × 8 pixels, as by JPEG, has taken.

    Between blocks, grey values have steps; elsewhere there are as many in one column of pixels as in the
    next. Steps of the scene count little: they are limited. Within a block, each coefficient of the cosine
    transform is a multiple of a step: what is lost is uniform within half of it, with the rms step ÷ √12.
    The least coefficients that are not zero tell the steps.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.

    Returns
    -------
    float or None
        Grey values; None for an image that was not compressed so, wherever its blocks begin.

    Examples
    --------
    >>> grey = np.random.default_rng(0).normal(100, 3, (200, 200))
    >>> coded = cv2.imencode(".jpg", grey.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    >>> lost_in_blocks(grey)
    >>> bool(2 < lost_in_blocks(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)[3:, 5:]) < 8)
    True
    """
    grey = pixels.astype(np.float32)
    first = []
    for values in (grey, grey.T):
        steps = np.minimum(np.abs(np.diff(values, axis=0)), _STEEP).mean(axis=1)
        if len(steps) < 2 * _SIDE:
            return None
        means = np.array([steps[start::_SIDE].mean() for start in range(_SIDE)])
        second, most = np.sort(means)[-2:]
        if not most > _STEPS * second:
            return None
        first.append((int(means.argmax()) + 1) % _SIDE)
    whole = grey[first[0] :, first[1] :]
    rows, columns = (n // _SIDE for n in whole.shape)
    blocks = whole[: rows * _SIDE, : columns * _SIDE].reshape(rows, _SIDE, columns, _SIDE)
    coefficients = np.abs(scipy.fft.dctn(blocks, axes=(1, 3), norm="ortho")).transpose(1, 3, 0, 2)
    found = []
    for u, v in list(product(range(_LOW), repeat=2))[1:]:
        distinct = coefficients[u, v][coefficients[u, v] > _ROUNDED]
        if len(distinct) >= _ENOUGH:
            found.append(np.quantile(distinct, 0.1))
    return float(np.median(found) / np.sqrt(12)) if found else 0.0
