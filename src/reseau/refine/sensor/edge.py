"""Sharpness by a slanted edge: the width of the point-spread function, and the MTF that follows from it.

A straight edge between dark and bright, slanted by a few degrees, is seen at every distance from the centre
of a pixel (ISO 12233). Its image is formed as that of all targets is: a Gaussian folded with the square of
the pixel, which along the edge's normal is a trapezoid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from ...adjust import Adjustment, Failure, GaussMarkov, Parameters, adjust
from ...data import Array, Frame

__all__ = ["EdgeSpread", "measure_edge"]

_REACH_PX = 8.0
"""From the edge, up to which pixels take part."""
_LEAST_SLANT = 0.02
"""Radians; below, all pixels along the edge have nearly the same distance."""
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """An edge, and how sharp it is.

    Parameters
    ----------
    fit : Adjustment
        Of `offset` (px) and `slope` of the edge, `dark` and `bright` beside it, and `psf` (px, one sigma).
    """

    fit: Adjustment

    @property
    def angle(self) -> float:
        """Of the edge from its axis (rad)."""
        return float(np.arctan(self.fit["slope"]))

    def mtf(self, frequency: Array | float, psf: float | None = None) -> Array:
        """Modulation transfer at frequencies in cycles per pixel, along the normal of the edge; the pixel's
        own square is in it.
        """
        f = np.asarray(frequency, dtype=np.float64)
        width = self.fit["psf"] if psf is None else psf
        blur = np.exp(-2 * (np.pi * width * f) ** 2)
        transfer: Array = blur * np.abs(np.sinc(f * np.cos(self.angle)) * np.sinc(f * np.sin(self.angle)))
        return transfer

    @property
    def mtf50(self) -> tuple[float, float]:
        """Frequency at which half of the modulation is left (cycles per pixel), and its sigma."""

        def half(psf: float) -> float:
            return float(brentq(lambda f: float(self.mtf(f, psf)) - 0.5, 1e-6, 0.99))

        psf, step = self.fit["psf"], 1e-4
        slope = (half(psf + step) - half(max(psf - step, 0.0))) / (step + min(step, psf))
        return half(psf), abs(slope) * self.fit.sigma_of("psf")


def measure_edge(frame: Frame, region: tuple[int, int, int, int] | None = None) -> EdgeSpread | Failure:
    """Measure the edge in a region.

    Parameters
    ----------
    frame : Frame
        With a straight edge, nearly upright or level.
    region : (left, top, width, height), optional
        Where nothing else is; by default the whole frame.
    """
    left, top, width, height = region or (0, 0, frame.width, frame.height)
    pixels = frame.pixels[top : top + height, left : left + width].astype(np.float64)
    if min(pixels.shape) < 16:
        return Failure("the region of the edge is smaller than 16 pixels")
    across, along = (np.abs(np.diff(pixels, axis=axis)).sum() for axis in (1, 0))
    if along > across:
        pixels = pixels.T
    values = _approximate(pixels)
    if values is None:
        return Failure("there is a row without an edge in its region")
    if not _LEAST_SLANT < abs(values[1]) < 0.6:
        slant = np.rad2deg(np.arctan(values[1]))
        return Failure(f"the edge is slanted by {slant:.1f}°: turn it by 3° to 20°")
    # Which pixels are near enough depends on where the edge is.
    fit = _fitted(pixels, values)
    for _ in range(_ROUNDS):
        if not isinstance(fit, Adjustment):
            return fit
        fit = _fitted(pixels, fit.values)
    if not isinstance(fit, Adjustment):
        return fit
    return EdgeSpread(fit)


def _approximate(pixels: Array) -> Array | None:
    """Edge by the centroids of the gradient in each row, and grey values beside it; None without an edge."""
    gradient = np.diff(pixels, axis=1)
    sign = np.sign(gradient.sum())
    weight = np.clip(sign * gradient, 0, None) ** 2
    if not weight.sum(axis=1).min() > 0:
        return None
    x = np.arange(gradient.shape[1]) + 0.5
    centre = (weight * x).sum(axis=1) / weight.sum(axis=1)
    rows = np.arange(len(pixels)) - (len(pixels) - 1) / 2
    slope, offset = np.polyfit(rows, centre, 1)
    low, high = np.percentile(pixels, [10, 90])
    sides = (low, high) if sign > 0 else (high, low)
    return np.array([offset, slope, *sides, 0.7])


def _fitted(pixels: Array, values: Array) -> Adjustment | Failure:
    """Adjust edge, grey values and width to the pixels near it; all of the same noise, found by them."""
    rows: Array = np.arange(len(pixels))[:, None] - (len(pixels) - 1) / 2 + np.zeros(pixels.shape)
    columns: Array = np.arange(pixels.shape[1], dtype=np.float64) + np.zeros(pixels.shape)
    near = np.abs(_distance(rows, columns, values)) < _REACH_PX
    y, x, grey = rows[near], columns[near], pixels[near]

    def computed(p: Array) -> Array:
        slant = np.arctan(p[1])
        spread = _edge_spread(_distance(y, x, p), abs(p[4]), np.cos(slant), abs(np.sin(slant)))
        formed: Array = p[2] + (p[3] - p[2]) * spread
        return formed

    parameters = Parameters(["offset", "slope", "dark", "bright", "psf"], values)
    return adjust(GaussMarkov(computed, grey, np.ones_like(grey), parameters))


def _distance(rows: Array, columns: Array, values: Array) -> Array:
    """From the edge, along its normal."""
    distance: Array = (columns - values[0] - values[1] * rows) / np.hypot(1.0, values[1])
    return distance


def _edge_spread(d: Array, sigma: float, c: float, s: float) -> Array:
    """Share of the bright side in a pixel at a distance: the step folded with a Gaussian and the trapezoid
    that the unit square is when seen along a normal with the components c and s.
    """
    s = max(s, 1e-3)  # along the rows the trapezoid is a square, which it is nearly here
    wide, narrow = (c + s) / 2, (c - s) / 2
    ends = _twice(d + wide, sigma) - _twice(d + narrow, sigma) - _twice(d - narrow, sigma)
    spread: Array = (ends + _twice(d - wide, sigma)) / (c * s)
    return spread


def _twice(u: Array, sigma: float) -> Array:
    """The second integral of the normal distribution of this width."""
    width = max(sigma, 1e-6)
    density = np.exp(-0.5 * (u / width) ** 2) / np.sqrt(2 * np.pi)
    integral: Array = ((u**2 + width**2) * ndtr(u / width) + u * width * density) / 2
    return integral
