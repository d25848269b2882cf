"""Grey values of a frame between its pixels, and around places of a plane."""

from __future__ import annotations

from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array
from ...optics.composition import Chain
from .lattice_mapping import images_of

_WIDE = 16384
"""Columns of the map of places; OpenCV allows fewer than 32768 along an axis."""


def levels_at(grey: NDArray[np.float32], xy: Array, how: int = cv2.INTER_LINEAR) -> Array:
    """Grey values (...) at image points (..., 2), linear between pixels; those of the border beyond it.

    Examples
    --------
    >>> levels_at(np.float32([[1, 2], [3, 4]]), np.array([[0.5, 0.0], [0.5, 1.0], [9.0, 9.0]])).tolist()
    [1.5, 3.5, 4.0]
    """
    last = np.array(grey.shape[::-1]) - 1.0
    at = np.clip(np.nan_to_num(xy), 0, last).astype(np.float32).reshape(-1, 2)
    wide = max(min(len(at), _WIDE), 1)
    places = np.resize(at, (-(-len(at) // wide), wide, 2))
    levels = cv2.remap(grey, places, cast(Any, None), how) if len(at) else at
    return np.asarray(levels, dtype=np.float64).ravel()[: len(at)].reshape(xy.shape[:-1])


def levels_around(grey: NDArray[np.float32], mapping: Chain, nodes: Array, offsets: Array) -> Array:
    """Grey values (n, k) at `offsets` (k, 2) from places (n, 2) of a plane, or at (n, k, 2) from them."""
    at = np.asarray(nodes[:, None] + offsets, dtype=np.float64)
    return levels_at(grey, images_of(mapping, at.reshape(-1, 2)).reshape(at.shape))
