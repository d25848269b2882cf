"""Pixels of a scene that is given as a function of position: sampled finely, then blurred and averaged.

The scene is sampled `oversampling` times per pixel in both directions. In the domain of frequencies it is
multiplied by the transfer functions of a Gaussian point-spread function and of a square aperture; the values
at the centres of the pixels form the image. Scenes soften their edges over one sample (`edge`), which adds
the variance of a box one sample wide; the point-spread function is narrowed by as much.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import NDArray

__all__ = ["Array", "Scene", "edge", "form", "form_at", "interpolated", "per_sample"]

Array = NDArray[np.float64]
Scene = Callable[[Array, Array, float], Array]
"""Brightness at positions x, y (pixels, origin at the centre of the first) sampled at a spacing."""

_TILE = 96
_REACH = 6.0
_NODES = 14
"""Nodes of an interpolation along an axis of a tile; 1e-9 px for the distortions of lenses."""


def edge(inside: Array, spacing: float) -> Array:
    """Share of a sample inside, from the signed distance to an edge (positive inside)."""
    return np.clip(0.5 + inside / spacing, 0.0, 1.0)


def per_sample(values: Array) -> Array:
    """Change (h, w) of a function from a sample to the next, along the axis where it is larger.

    An edge softened over as much is true at any angle: where samples repeat along it, as at 45°, what they
    add to its spectrum has whole frequencies along that axis, which the softening does not pass. Softened
    by the slope, an edge at 45° with four samples per pixel is up to 0.015 px aside.
    """
    change = np.empty((2, *values.shape))
    for along, at in zip(change, (values, values.T), strict=True):
        along = along if at is values else along.T
        np.subtract(at[2:], at[:-2], out=along[1:-1])
        along[1:-1] /= 2
        along[0], along[-1] = at[1] - at[0], at[-1] - at[-2]
    return np.asarray(np.maximum(*np.abs(change, out=change)))


def interpolated(function: Callable[[Array, Array], Array], x: Array, y: Array) -> Array:
    """Values (k, h, w) of a smooth function of positions on the grid of columns x (w,) and rows y (h,).

    The function (k, n) is evaluated at Chebyshev's nodes only, and interpolated by polynomials.
    """
    node = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    by, at = [], []
    for place in (x, y):
        middle, half = (place[0] + place[-1]) / 2, (place[-1] - place[0]) / 2
        at.append(middle + half * node)
        values = np.polynomial.chebyshev.chebvander((place - middle) / half, _NODES - 1)
        by.append(values @ np.linalg.inv(np.polynomial.chebyshev.chebvander(node, _NODES - 1)))
    u, v = np.meshgrid(*at)
    known = function(u.ravel(), v.ravel()).reshape(-1, _NODES, _NODES)
    return np.asarray(by[1] @ known @ by[0].T)


def form(
    scene: Scene,
    width: int,
    height: int,
    sigma: float,
    aperture: float = 1.0,
    oversampling: int = 8,
    motion: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """An image (height, width) of a scene.

    Parameters
    ----------
    scene : callable
        Brightness of positions.
    width, height : int
        Of the image, in pixels.
    sigma : float
        Standard deviation of the point-spread function, in pixels.
    aperture : float
        Side of the square light-sensitive part of a pixel, in pixels.
    oversampling : int
        Samples per pixel and axis.
    motion : (float, float)
        Even motion of the scene while it is exposed, pixels.
    """
    image = np.empty((height, width))
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            down, across = min(_TILE, height - top), min(_TILE, width - left)
            tile = form_at(scene, (left, top), (across, down), sigma, aperture, oversampling, motion=motion)
            image[top : top + down, left : left + across] = tile[0]
    return image


def form_at(
    scene: Scene,
    first: tuple[int, int],
    size: tuple[int, int],
    sigma: float,
    aperture: float = 1.0,
    oversampling: int = 8,
    derivatives: bool = False,
    motion: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """A part of an image, (1, height, width), see `form`; with derivatives (4, height, width).

    Parameters
    ----------
    scene : callable
        Brightness of positions.
    first : (int, int)
        x and y of its first pixel.
    size : (int, int)
        Its width and height.
    sigma, aperture, oversampling
        As for `form`.
    motion
        As for `form`.
    derivatives : bool
        Whether to return those by a shift of the scene in x, in y and by `sigma` too.
    """
    n = oversampling
    margin = int(np.ceil(_REACH * sigma + 1 + np.hypot(*motion)))
    x, y = (a - margin + np.arange((s + 2 * margin) * n) / n for a, s in zip(first, size, strict=True))
    bright = scene(*np.meshgrid(x, y), 1.0 / n)
    fx, fy = np.fft.rfftfreq(len(x), 1 / n), np.fft.fftfreq(len(y), 1 / n)[:, None]
    narrow = sigma**2 - 1 / (12 * n**2)
    across, down = (np.exp(-2 * np.pi**2 * narrow * f**2) * np.sinc(aperture * f) for f in (fx, fy))
    light = scipy.fft.rfft2(bright) * (down * across)
    if any(motion):
        light *= np.sinc(motion[0] * fx + motion[1] * fy)
    parts = [light]
    if derivatives:
        parts += [-2j * np.pi * fx * light, -2j * np.pi * fy * light]
        parts += [-4 * np.pi**2 * sigma * (fx**2 + fy**2) * light]
    inner = slice(margin, -margin)
    return np.stack([_every(part, n, bright.shape)[inner, inner] for part in parts])


def _every(spectrum: Array, n: int, shape: tuple[int, int]) -> Array:
    """Every n-th row and column of the signal (h, w) with this half of a spectrum."""
    # The spectrum of every n-th value is the sum of n parts of a spectrum; along x only half of it is given.
    rows = scipy.fft.ifft(spectrum.reshape(n, shape[0] // n, -1).sum(axis=0) / n, axis=0)
    return np.asarray(scipy.fft.irfft(rows, shape[1], axis=1)[:, ::n])
