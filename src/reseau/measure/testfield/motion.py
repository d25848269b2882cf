"""Motion of the camera during the exposure: images of marks averaged along a straight path.

A motion of constant speed over a path m adds the covariance m mᵀ / 12 to the point-spread function. Its part
that is equal in all directions cannot be distinguished from blur; the rest is estimated from the residuals of
matched targets: half the second derivatives of their images, weighted with the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array, Rows
from ..matching import Shape
from ..matching.shapes import Window

_LEAST_PX = 1.0
"""Shortest path that is modelled."""
_LONG_PX = 2.5
"""Path from which more images are averaged."""

_DIFFERENCE_PX = 0.5
"""Step of the second differences of images; half a pixel, so that neighbouring pixels are both sides."""


def steps_of(path: Array) -> tuple[Array, Array]:
    """Places along a path (s, 2) from its middle, and their weights, of Gauss's quadrature."""
    length = float(np.hypot(*path))
    count = 1 if length == 0 else 3 if length < _LONG_PX else 3 + 2 * round(length / _LONG_PX)
    place, weight = np.polynomial.legendre.leggauss(count)
    return place[:, None] / 2 * path, weight / 2


def path_of(spread: Array) -> Array:
    """Path (2,) of which half the difference of the covariances along and across is [(xx − yy)/2, xy]."""
    length = float(np.sqrt(24 * np.hypot(*spread)))
    angle = 0.5 * np.arctan2(spread[1], spread[0])
    path: Array = length * np.array([np.cos(angle), np.sin(angle)])
    return path if length >= _LEAST_PX else np.zeros(2)


def spread_of(path: Array) -> Array:
    """The inverse of :func:`path_of`."""
    x, y = path
    return np.array([x * x - y * y, 2 * x * y]) / 24


@dataclass(frozen=True, eq=False)
class MovedShape:
    """A shape whose images are averaged along a path.

    Parameters
    ----------
    shape : Shape
        The marks at rest.
    path : ndarray (2,)
        From one end of the path to the other, pixels.

    Examples
    --------
    >>> from reseau.measure.matching.shapes import GrownOutline
    >>> from reseau.optics.formation import Outline, PixelResponse
    >>> disk = Outline.circle(2.0, 0.5)
    >>> still = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(15.0)[None], np.arange(15.0)[None], PixelResponse())
    >>> at = np.array([[7.0, 7.0]]), np.ones(1), np.zeros((1, 0)), np.array([0]), window
    >>> moved = MovedShape(still, np.array([4.0, 0.0])).image(*at)[0]
    >>> bool(moved.max() < still.image(*at).max()), bool(moved[7, 4] > moved[4, 7])
    (True, True)
    """

    shape: Shape
    path: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return self.shape.parameters

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`Shape`."""
        places, weights = steps_of(self.path)
        mean: Array = weights[0] * self.shape.image(xy + places[0], width, form, at, window)
        for place, weight in zip(places[1:], weights[1:], strict=True):
            mean += weight * self.shape.image(xy + place, width, form, at, window)
        return np.asarray(mean, dtype=np.float32)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`Shape`."""
        places, weights = steps_of(self.path)
        parts = [self.shape.derivatives(xy + place, width, form, at, window) for place in places]
        mean, slopes = (
            sum(weight * part[k] for weight, part in zip(weights, parts, strict=True)) for k in (0, 1)
        )
        return np.asarray(mean, dtype=np.float32), np.asarray(slopes, dtype=np.float32)


def anisotropy(shape: Shape, xy: Array, width: Array, window: Window, left: Array) -> Array:
    """Half the difference of the covariances along x and y, and xy, that explain what is left (k, r, c).

    Parameters
    ----------
    left : ndarray (k, r, c)
        Observed minus formed images, as shares; NaN where a pixel was not used.
    """
    every, none = np.arange(len(xy)), np.zeros((len(xy), shape.parameters))
    h = _DIFFERENCE_PX

    def at(x: float, y: float) -> Array:
        """Images displaced by both signs of x and y: a window shifted by half a pixel, and its neighbours."""
        wider = Window(_begun(window.columns, x), _begun(window.rows, y), window.response)
        return shape.image(xy, width, none, every, wider).astype(np.float64)

    across, down, both = at(h, 0), at(0, h), at(h, h)
    sides = across[:, :, 1:] + across[:, :, :-1] - down[:, 1:] - down[:, :-1]
    corners = (both[:, 1:, 1:] + both[:, :-1, :-1] - both[:, 1:, :-1] - both[:, :-1, 1:]) / 4
    design = np.stack([sides / 2, corners], axis=-1) / h**2
    used = np.isfinite(left)
    return np.asarray(np.linalg.lstsq(design[used], left[used], rcond=None)[0], dtype=np.float64)


def _begun(axis: Array, before: float) -> Array:
    """Coordinates (k, n + 1) that begin by so much before those given (k, n); unchanged if by nothing."""
    return np.concatenate([axis - before, axis[:, -1:] + before], axis=1) if before else axis
