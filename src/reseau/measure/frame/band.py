"""The pixels along an approximate edge, each with its exact distance from it, in profiles across.

All four edges are one case (Cruz et al., sect. 2.2): distances are positive towards the picture. Nothing is
rotated or resampled for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array
from ...io.scans import Scan

__all__ = ["Band", "read_band"]

_PROFILES = 400
"""Profiles of an edge, where it is long enough for as many."""
_COLUMNS, _MANY = 4, 12
"""Neighbouring columns of pixels that make a profile, at most; and where so few show no step."""
_ENDS = 0.03
"""Part of an edge at either end that is left out: corners are rounded."""


@dataclass(frozen=True, eq=False)
class Band:
    """Pixels along an approximate edge.

    Parameters
    ----------
    start, stop : ndarray (2,)
        Ends of the approximate edge, pixels.
    place : ndarray (n,)
        Of the profiles along it, −1 at its start and 1 at its end.
    distance : ndarray (n, s)
        Of the pixels from it, positive inwards.
    grey : ndarray (n, s, channels)
        Their values; NaN outside the scan.
    columns : int
        Neighbouring columns of pixels in a profile.
    """

    start: Array
    stop: Array
    place: Array
    distance: Array
    grey: NDArray[np.float32]
    columns: int

    @property
    def normal(self) -> Array:
        """Unit vector inwards."""
        along = self.stop - self.start
        return np.asarray(np.array([-along[1], along[0]]) / np.hypot(*along))


def read_band(
    scan: Scan, start: Array, stop: Array, outward: float, inward: float, *, wide: bool = False
) -> Band:
    """Read the pixels along an approximate edge, `outward` and `inward` pixels to its sides.

    `wide` profiles are of more columns each, for weak contrast.
    """
    along = stop - start
    length = float(np.hypot(*along))
    tangent = along / length
    axis = int(abs(tangent[1]) > abs(tangent[0]))  # 0: profiles are columns of the scan
    across = 1 - axis
    normal = np.array([-tangent[1], tangent[0]])
    spans = abs(along[axis]) * (1 - 2 * _ENDS)
    count = int(np.clip(spans / (_MANY if wide else 2), 8, _PROFILES))
    each = int(np.clip(spans / count, 1, _MANY if wide else _COLUMNS))
    centre = start[axis] + along[axis] * (_ENDS + (1 - 2 * _ENDS) * (np.arange(count) + 0.5) / count)
    step = np.rint(centre - (each - 1) / 2).astype(np.intp)
    sign = np.sign(normal[across])
    low, high = sorted((-outward * sign / abs(normal[across]), inward * sign / abs(normal[across])))
    size = int(np.ceil(high - low)) + 1
    slope = along[across] / along[axis]
    first = np.rint(start[across] + (step + (each - 1) / 2 - start[axis]) * slope + low).astype(np.intp)
    grey = np.full((count, each, size, len(scan.channels)), np.nan, dtype=np.float32)
    limits = (scan.width, scan.height)
    for i in range(count):
        a0, a1 = max(step[i], 0), min(step[i] + each, limits[axis])
        b0, b1 = max(first[i], 0), min(first[i] + size, limits[across])
        if a1 <= a0 or b1 <= b0:
            continue
        box = (b0, b1, a0, a1) if axis == 0 else (a0, a1, b0, b1)
        part: NDArray[Any] = scan.window(*(int(v) for v in box))
        turned = part.transpose(1, 0, 2) if axis == 0 else part
        grey[i, a0 - step[i] : a1 - step[i], b0 - first[i] : b1 - first[i]] = turned
    at = np.empty((count, each, size, 2))
    at[..., axis] = step[:, None, None] + np.arange(each)[None, :, None]
    at[..., across] = first[:, None, None] + np.arange(size)
    distance = (at - start) @ normal
    middle = step + (each - 1) / 2
    place = 2 * (middle - start[axis]) / along[axis] - 1
    flat = distance.reshape(count, -1), grey.reshape(count, each * size, -1)
    return Band(start, stop, place, *flat, each)
