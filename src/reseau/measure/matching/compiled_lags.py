"""Sums of products of neighbouring pixels, compiled; see :mod:`reseau.measure.matching.correlation`."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["lag_sums"]

Floats = NDArray[Any]


@numba.njit(cache=True, nogil=True, fastmath=True)
def lag_sums(values: Floats, used: Floats, reach: int) -> tuple[Floats, Floats]:
    """Sums of products of pixels at all distances, and the number of pairs, (reach + 1, 2 reach + 1) each.

    Parameters
    ----------
    values, used : ndarray (k, r, c), float32
        Images, 0 where a pixel is not used; ones where it is.
    reach : int
        Largest distance along an axis; the first index is that of rows, the second begins at `-reach`.
    """
    sums, pairs = np.zeros((reach + 1, 2 * reach + 1)), np.zeros((reach + 1, 2 * reach + 1))
    count, rows, columns = values.shape
    for k in range(count):
        for down in range(min(reach + 1, rows)):
            for right in range(-reach, reach + 1):
                first, last = max(0, -right), columns - max(0, right)
                total, both = np.float32(0), np.float32(0)
                for i in range(rows - down):
                    for j in range(first, last):
                        total += values[k, i, j] * values[k, i + down, j + right]
                        both += used[k, i, j] * used[k, i + down, j + right]
                sums[down, right + reach] += total
                pairs[down, right + reach] += both
    return sums, pairs
