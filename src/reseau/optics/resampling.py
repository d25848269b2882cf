"""Resampling of images through a mapping, tile by tile, with bounded memory for images of any size.

Grey values are interpolated by cubic splines at positions accurate to 1e-6 px; the tables with steps of 1/32
px in fast warping routines would shift an edge by up to 1/64 px.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..core.data import Array

_STEP = 12
"""Distance of the pixels at which a mapping is evaluated; cubic splines interpolate between them."""
_MARGIN = 14
"""Margin around a tile, after which the recursive filter of a spline has decayed to 1e-8."""
_TILE = 1024


def on_lattice(mapping: Callable[[Array], Array], columns: Array, rows: Array) -> tuple[Array, Array]:
    """A smooth mapping at all pixels of a rectangle, interpolated from every twelfth.

    Parameters
    ----------
    mapping : callable
        Function from (n, 2) to (n, 2); NaN where undefined.
    columns, rows : ndarray (c,), (r,)
        Pixel coordinates, in steps of one.

    Returns
    -------
    x, y : ndarray (r, c)
        Mapped coordinates, accurate to 1e-6 px for the distortion of a camera. Near undefined places the
        mapping is evaluated at every pixel.
    """

    def nodes(at: Array) -> Array:
        return np.linspace(at[0], at[-1], max(4, int(np.ceil((at[-1] - at[0]) / _STEP)) + 1))

    if min(len(columns), len(rows)) > 1:
        u, v = nodes(columns), nodes(rows)
        value = mapping(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)).reshape(len(v), len(u), 2)
        if np.isfinite(value).all():
            x, y = (
                scipy.interpolate.RectBivariateSpline(v, u, value[..., k])(rows, columns) for k in range(2)
            )
            return x, y
    value = mapping(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    return value[:, 0].reshape(len(rows), len(columns)), value[:, 1].reshape(len(rows), len(columns))


def resample(
    pixels: NDArray[Any],
    to_source: Callable[[Array], Array],
    shape: tuple[int, int],
    *,
    band: int = 256,
) -> Iterator[NDArray[Any]]:
    """Resample an image through a mapping; yields bands from the top.

    Parameters
    ----------
    pixels : ndarray (h, w)
        The image; it is never copied as a whole.
    to_source : callable
        Function that maps pixels (n, 2) of the result to the image (n, 2); NaN where undefined.
    shape : (int, int)
        Height and width of the result.
    band : int
        Number of rows of a band.

    Yields
    ------
    ndarray (rows, width)
        Grey values of the image's type, rounded and clipped; 0 outside the image.
    """
    height, width = shape
    for top in range(0, height, band):
        rows = np.arange(top, min(top + band, height), dtype=np.float64)
        result = np.zeros((len(rows), width), dtype=pixels.dtype)
        for left in range(0, width, _TILE):
            columns = np.arange(left, min(left + _TILE, width), dtype=np.float64)
            x, y = on_lattice(to_source, columns, rows)
            result[:, left : left + len(columns)] = _tile(pixels, x, y)
        yield result


def _tile(pixels: NDArray[Any], x: Array, y: Array) -> NDArray[Any]:
    height, width = pixels.shape
    with np.errstate(invalid="ignore"):
        seen = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    if not seen.any():
        return np.zeros(x.shape, dtype=pixels.dtype)
    left, top = (max(0, int(np.floor(t[seen].min())) - _MARGIN) for t in (x, y))
    right, bottom = (int(np.ceil(t[seen].max())) + _MARGIN + 1 for t in (x, y))
    part = pixels[top:bottom, left:right].astype(np.float32)
    at = np.stack([np.where(seen, y, top) - top, np.where(seen, x, left) - left])
    grey = scipy.ndimage.map_coordinates(part, at, output=np.float64, order=3, mode="nearest")
    if pixels.dtype.kind in "ui":
        limits = np.iinfo(pixels.dtype)
        grey = np.clip(np.rint(grey), limits.min, limits.max)
    return np.where(seen, grey, 0).astype(pixels.dtype)
