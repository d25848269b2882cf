"""Filtering of many windows with one even kernel, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.compiled import compiled

Floats = NDArray[Any]


@compiled
def filtered(images: Floats, kernel: Floats) -> Floats:
    """Images (m, r, c) weighted by an even kernel (2 p + 1, 2 p + 1), without their borders of p pixels.

    An even kernel weights sums of two pixels. All rows of an image are one: what the end of a row takes from
    the next lies in the border.
    """
    m, high, wide = images.shape
    reach = len(kernel) // 2
    count = (kernel.size - 1) // 2
    offsets, weights = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.float32)
    used = 0
    for k in range(count):
        value = kernel[k // len(kernel), k % len(kernel)]
        if value != 0:
            offsets[used] = (reach - k // len(kernel)) * wide + reach - k % len(kernel)
            weights[used] = value
            used += 1
    first = reach * wide + reach
    n = high * wide - 2 * first
    flat = images.reshape(m, high * wide)
    total = np.empty(n, np.float32)
    found = np.empty((m, high - 2 * reach, wide - 2 * reach), np.float32)
    for k in range(m):
        image = flat[k]
        _times(image[first:], kernel[reach, reach], total)
        for t in range(0, used, 2):
            _add(image, first, offsets[t : t + 2], weights[t : t + 2], total)
        for row in range(high - 2 * reach):
            for column in range(wide - 2 * reach):
                found[k, row, column] = total[row * wide + column]
    return found


@compiled
def _times(image: Floats, weight: float, total: Floats) -> None:
    for i in range(len(total)):
        total[i] = weight * image[i]


@compiled
def _add(image: Floats, first: int, offsets: Floats, weights: Floats, total: Floats) -> None:
    """Add two weighted sums of two pixels each."""
    n, one, two = len(total), weights[0], weights[1]
    a, b = first + offsets[0], first + offsets[1]
    c, d = first - offsets[0], first - offsets[1]
    # Slices: the compiler need not expect an index below 0.
    left, right = image[a : a + n], image[c : c + n]
    upper, lower = image[b : b + n], image[d : d + n]
    for i in range(n):
        total[i] += one * (left[i] + right[i]) + two * (upper[i] + lower[i])
