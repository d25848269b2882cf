"""A scan: an image of any size, accessible as a reduced overview and as windows at full resolution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import ImageError
from ..core.tone import ToneCurve

CHANNELS = {1: ("grey",), 3: ("red", "green", "blue")}
"""Names of the channels by their number."""
_STRIPE = 256
"""Rows that are read at a time for an overview."""
_WHOLE = 60_000_000
"""Samples up to which an overview averages every pixel; of larger images it averages a regular subset."""

Window = Callable[[int, int, int, int], NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Scan:
    """An image that is read window by window.

    Parameters
    ----------
    name : str
        Name in messages and results.
    width, height : int
        Columns and rows.
    channels : tuple of str
        ``grey``, or ``red``, ``green``, ``blue``.
    full_scale : float
        Grey value at which the scanner saturates.
    dpi : float or None
        Resolution stated in the file, in pixels per inch; None if the file states none.
    dtype : numpy.dtype
        Type of the grey values.
    window : callable
        ``window(top, bottom, left, right)`` returns rows [top, bottom) and columns [left, right) as an array
        (rows, columns, channels) of type `dtype`. The window must lie within the image.
    notes : tuple of str
        What a user should know about how it was read.
    curve : ToneCurve, optional
        Curve between grey values and light that the file states; None if it states none.
    filters : str
        Colour filters of the pixels of the first two rows, as RGGB; empty if there are none.

    Examples
    --------
    >>> scan = scan_of(np.arange(24, dtype=np.uint8).reshape(4, 6))
    >>> scan.window(1, 3, 2, 4)[:, :, 0]
    array([[ 8,  9],
           [14, 15]], dtype=uint8)
    """

    name: str
    width: int
    height: int
    channels: tuple[str, ...]
    full_scale: float
    dpi: float | None
    dtype: np.dtype[Any]
    window: Window
    notes: tuple[str, ...] = ()
    curve: ToneCurve | None = None
    filters: str = ""

    def picture(self) -> NDArray[Any]:
        """All pixels: grey values (h, w), or those of the channels (h, w, c)."""
        pixels = self.window(0, self.height, 0, self.width)
        return np.asarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels)

    def overview(self, longest: int) -> tuple[NDArray[np.float32], float]:
        """Reduce the image so that its longer side has at most `longest` pixels.

        Returns
        -------
        (ndarray (h, w, channels), float)
            Grey values, and the reduction r: pixel (i, j) of the overview has its centre at
            ((j + 0.5)·r − 0.5, (i + 0.5)·r − 0.5) of the image.
        """
        r = max(1, int(np.ceil(max(self.width, self.height) / longest)))
        thin = max(1, r // 4) if self.width * self.height * len(self.channels) > _WHOLE else 1
        h, w = self.height // r, self.width // r
        out = np.empty((h, w, len(self.channels)), dtype=np.float32)
        step = max(1, _STRIPE // r)
        # OpenCV resizes neither signed bytes nor half floats.
        kind = self.dtype if self.dtype in (np.uint8, np.uint16) else np.dtype(np.float32)
        for top in range(0, h, step):
            rows = min(step, h - top)
            part = self.window(top * r, (top + rows) * r, 0, w * r)
            # Start in the middle of each group so that the centres do not shift.
            part = np.ascontiguousarray(part[thin // 2 :: thin, thin // 2 :: thin], dtype=kind)
            for c in range(out.shape[2]):
                small = cv2.resize(part[:, :, c], (w, rows), interpolation=cv2.INTER_AREA)
                out[top : top + rows, :, c] = small
        return out, float(r)


def check_most(path: object, width: int, height: int, most: int) -> None:
    """Refuse an image of more pixels than `most`."""
    if width * height > most:
        raise ImageError(f"has {width}×{height} pixels, more than {most:,}", where=path, do="crop it")


def check_least(path: object, width: int, height: int) -> None:
    """Refuse an image that is a line."""
    if min(width, height) < 2:
        raise ImageError(f"has {width}×{height} pixels, fewer than 2×2", where=path)


def full_scale_of(dtype: np.dtype[Any], where: object) -> float:
    """Return the grey value at which an image of this type saturates.

    Parameters
    ----------
    dtype : numpy.dtype
        Type of the grey values.
    where : object
        File or name for the message.

    Raises
    ------
    ImageError
        When grey values of this type are not supported.

    Examples
    --------
    >>> full_scale_of(np.dtype(np.uint16), "a.tif")
    65535.0
    """
    if dtype.kind == "u" and dtype.itemsize <= 2:
        return float(np.iinfo(dtype).max)
    if dtype == np.int16:  # as planetary archives store 12 and more bits
        return 32767.0
    if dtype.kind == "f":
        return 1.0
    raise ImageError(
        f"has grey values of type {dtype}", where=where, do="convert it to grey or RGB of 8 or 16 bit"
    )


def scan_of(pixels: NDArray[Any], name: str = "scan", dpi: float | None = None) -> Scan:
    """Make a scan of an array.

    Parameters
    ----------
    pixels : ndarray (h, w) or (h, w, 3)
        Grey or RGB values of 8 or 16 bit, or floating point in the range 0 to 1. A fourth channel is ignored.
    name : str
        Name in messages and results.
    dpi : float, optional
        Resolution in pixels per inch.

    Raises
    ------
    ImageError
        When the array is not such an image.

    Examples
    --------
    >>> scan_of(np.zeros((20, 30, 3), dtype=np.uint8)).channels
    ('red', 'green', 'blue')
    """
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    scale = full_scale_of(pixels.dtype, name)
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or min(pixels.shape[:2]) < 2:
        raise ImageError(f"has the shape {pixels.shape}", where=name, do="convert it to grey or RGB")
    colours = pixels[:, :, :3]
    h, w, c = colours.shape
    return Scan(name, w, h, CHANNELS[c], scale, dpi, pixels.dtype, lambda t, b, le, r: colours[t:b, le:r])
