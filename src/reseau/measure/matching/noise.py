"""How the noise of grey values goes with their size, learnt from what matching leaves.

The variance of a grey value is that of reading plus one that is proportional to the light (photon transfer;
Janesick 2001, EMVA Standard 1288). The residuals of many matched marks tell both, and with them every pixel
gets the weight that it deserves: those in a dark mark a higher one than those around it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask

__all__ = ["course", "grey_variance", "medians"]

_SIGNIFICANT = 5.0
"""Standard deviations by which a growth of the variance must differ from none to be taken for true."""
_LEAST = 0.05
"""Least variance of a pixel over the mean of its patch."""


def grey_variance(pixels: NDArray[Any], start: Array, residuals: Array) -> tuple[float, float] | None:
    """Variance of grey values as a line over them.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.
    start : ndarray (k, 2)
        Positions around which the windows were laid.
    residuals : ndarray (k, rows, columns)
        Adjusted minus observed, NaN where left out.

    Returns
    -------
    (a, b) or None
        The variance a + b·grey; None where it does not grow with the grey values.
    """
    column, row = (
        np.rint(start[:, axis]).astype(np.intp)[:, None] + np.arange(size) - size // 2
        for axis, size in enumerate(residuals.shape[:0:-1])
    )
    h, w = pixels.shape
    observed = pixels[np.clip(row, 0, h - 1)[:, :, None], np.clip(column, 0, w - 1)[:, None, :]]
    used = np.isfinite(residuals)
    square, grey = residuals[used] ** 2, (observed + residuals)[used]
    if square.size < 500 or not square.any():
        return None
    design = np.stack([np.ones_like(grey), grey], axis=1)
    variance = np.full(len(grey), square.mean())
    for _ in range(4):
        # The square of a normal deviate has the variance 2σ⁴.
        normal = (design / variance[:, None] ** 2).T @ design / 2
        a, b = np.linalg.lstsq(normal, (design / variance[:, None] ** 2).T @ square / 2, rcond=None)[0]
        variance = np.maximum(design @ [a, b], _LEAST * square.mean())
    sigma = np.sqrt(np.linalg.pinv(normal)[1, 1])
    return (float(a), float(b)) if b > _SIGNIFICANT * sigma else None


def course(grey: Array, variance: tuple[float, float]) -> Array:
    """Weights (k, n) of grey values, those of a patch around 1."""
    expected = variance[0] + variance[1] * grey
    mean = np.maximum(expected.mean(axis=1, keepdims=True), 1e-12)
    weights: Array = 1 / np.maximum(expected / mean, _LEAST)
    return weights


def medians(values: Array, used: Mask) -> Array:
    """Medians (k, 1) of those values (k, n) in use that are numbers; 0 where there is none."""
    used = used & ~np.isnan(values)
    ordered = np.sort(np.where(used, values, np.inf), axis=1)  # those out of use come last
    count, each = used.sum(axis=1), np.arange(len(values))
    middle = 0.5 * (ordered[each, np.maximum(count - 1, 0) // 2] + ordered[each, count // 2])
    median: Array = np.where(count > 0, middle, 0.0)[:, None]
    return median
