"""Noise of grey values as a function of the grey value, estimated from residuals of matching.

The variance of a grey value is the variance of the read noise plus a part proportional to the light (photon
transfer; Janesick 2001, EMVA Standard 1288). The residuals of many matched marks determine both. Pixels are
weighted accordingly: those in a dark mark get a higher weight than those around it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask

_ENOUGH = 8000
"""Number of pixels that show how the variance grows."""
LEAST = 0.05
"""Smallest variance of a pixel relative to the mean of its patch."""


def grey_variance(pixels: NDArray[Any], start: Array, residuals: Array) -> tuple[float, float] | None:
    """Variance of grey values as a linear function of the grey value.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.
    start : ndarray (k, 2)
        Positions on which the windows are centred.
    residuals : ndarray (k, rows, columns)
        Adjusted minus observed, NaN where a pixel was not used.

    Returns
    -------
    (a, b) or None
        Coefficients of the variance a + b·grey; None if it does not increase with the grey values.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> light = np.tile(np.linspace(20.0, 200.0, 40), (40, 1))
    >>> pixels = light + rng.normal(0.0, np.sqrt(4 + light / 10))
    >>> a, b = grey_variance(pixels, np.array([[20.0, 20.0]]), (light - pixels)[None, 1:, 1:])
    >>> bool(abs(b - 0.1) < 0.03)
    True
    """
    adjusted = adjusted_grey(pixels, start, residuals)
    used = np.flatnonzero(np.isfinite(residuals))
    used = used[:: max(1, len(used) // _ENOUGH)]
    left = residuals.ravel()[used]
    square, grey = left**2, adjusted.ravel()[used]
    return linear_variance(grey, square)


def adjusted_grey(pixels: NDArray[Any], start: Array, residuals: Array) -> Array:
    """Adjusted grey values (k, rows, columns); parameters as of :func:`grey_variance`."""
    column, row = (
        np.rint(start[:, axis]).astype(np.intp)[:, None] + np.arange(size) - size // 2
        for axis, size in enumerate(residuals.shape[:0:-1])
    )
    h, w = pixels.shape
    observed = pixels[np.clip(row, 0, h - 1)[:, :, None], np.clip(column, 0, w - 1)[:, None, :]]
    return np.asarray(observed + residuals)


def linear_variance(grey: Array, square: Array) -> tuple[float, float] | None:
    """Coefficients of a variance a + b·grey that explains squares (n,) of errors better than a constant one.

    Both explanations are compared by their likelihood, less what one more parameter is worth (Schwarz 1978).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> grey = rng.uniform(20.0, 200.0, 2000)
    >>> linear_variance(grey, rng.normal(0.0, 3.0, 2000) ** 2)
    >>> a, b = linear_variance(grey, rng.normal(0.0, np.sqrt(4 + grey / 10)) ** 2)
    >>> round(b, 1)
    0.1
    """
    if not square.any():
        return None
    design = np.stack([np.ones_like(grey), grey])
    mean = float(square.mean())
    variance = np.full(len(grey), mean)
    for _ in range(4):
        # The square of a normal deviate has variance 2σ⁴.
        weighted = design / (2 * variance**2)
        a, b = np.linalg.lstsq(weighted @ design.T, weighted @ square, rcond=None)[0]
        variance = np.maximum(a + b * grey, LEAST * mean)
    gain = float((np.log(mean) + 1 - np.log(variance) - square / variance).sum())
    return (float(a), float(b)) if b > 0 and gain > np.log(len(grey)) else None


def relative_weights(grey: Array, variance: tuple[float, float], used: Mask | None = None) -> Array:
    """Relative weights (k, n) of grey values, about 1 on average of those in use in each patch."""
    expected, used = variance[0] + variance[1] * grey, np.ones(grey.shape, bool) if used is None else used
    mean = np.where(used, expected, 0.0).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    weights: Array = 1 / np.maximum(expected / np.maximum(mean, 1e-12)[:, None], LEAST)
    return weights


def medians(values: Array, used: Mask) -> Array:
    """Medians (k, 1) of the finite values (k, n) in use; 0 where there is none."""
    used = used & ~np.isnan(values)
    ordered = np.sort(np.where(used, values, np.inf), axis=1)  # values not in use are sorted to the end
    count, each = used.sum(axis=1), np.arange(len(values))
    middle = 0.5 * (ordered[each, np.maximum(count - 1, 0) // 2] + ordered[each, count // 2])
    return np.where(count > 0, middle, 0.0)[:, None]
