"""Pixels of a slanted edge, and an edge blurred by a Gaussian and the square of the pixel.

The Gaussian edge is formed like all targets: a Gaussian convolved with the square of the pixel, which is a
trapezoid along the normal of the edge. The edge may be slightly curved by distortion: x = offset + slope·y +
bow·(y² − q)/k², with y from the middle row, q the mean of y², and k half the height of the region; the bow is
the distance of the centre of the edge from its chord (px).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ..adjust import Adjustment, GaussMarkov, Options, Parameters, adjust
from ..core.data import Array, Mask
from ..core.failure import Failure

_NEAR_PX = 8.0
"""Distance from the approximate edge within which its gradient is evaluated."""
_ROUNDS = 3
_SHARPEST_PX = 0.02
"""Width assigned to an edge that shows none."""
ENOUGH = Options(tolerance=1e-4)
"""Iterations end when corrections are below this share of their standard deviations."""
_Integral = Callable[[Array, float], Array]


@dataclass(frozen=True, eq=False)
class EdgePixels:
    """Pixels of a region with a nearly vertical edge.

    Parameters
    ----------
    x, y : ndarray (n,)
        Column, and row relative to the middle row.
    grey : ndarray (n,)
        Grey values.
    sigma : ndarray (n,)
        Their standard deviations, up to a common factor.
    size : (int, int)
        Height and width of the region.
    """

    x: Array
    y: Array
    grey: Array
    sigma: Array
    size: tuple[int, int]

    @classmethod
    def of(cls, pixels: Array, good: Mask) -> EdgePixels:
        """The good pixels of a region (height, width)."""
        rows, columns = np.mgrid[: pixels.shape[0], : pixels.shape[1]].astype(np.float64)
        rows -= (pixels.shape[0] - 1) / 2
        height, width = pixels.shape
        return cls(columns[good], rows[good], pixels[good], np.ones(int(good.sum())), (height, width))

    def part(self, keep: Mask) -> EdgePixels:
        """A subset of the pixels."""
        return EdgePixels(self.x[keep], self.y[keep], self.grey[keep], self.sigma[keep], self.size)

    def distance(self, offset: float, slope: float, bow: float = 0.0) -> Array:
        """Distances from the edge along its normal."""
        turned = slope + 2 * bow * self.y / self.half**2
        return self.aside(offset, slope, bow) / np.hypot(1.0, turned)

    def aside(self, offset: float, slope: float, bow: float) -> Array:
        """Distances from the edge along the row."""
        return self.x - offset - slope * self.y - bow * self.bent

    @property
    def bent(self) -> Array:
        """Displacement of the edge by a bow of 1, along the normal."""
        return self.bent_at(self.y)

    @property
    def half(self) -> float:
        """Half the height of the region."""
        return self.size[0] / 2

    def bent_at(self, y: Array) -> Array:
        """Displacement of the edge by a bow of 1, along the rows."""
        return (y**2 - (self.size[0] ** 2 - 1) / 12) / self.half**2

    def turning(self, offset: float, slope: float, bow: float) -> tuple[Array, Array]:
        """Derivatives of the distance with respect to slope and bow."""
        turned, aside = slope + 2 * bow * self.y / self.half**2, self.aside(offset, slope, bow)
        width = np.hypot(1.0, turned)
        lean = aside * turned / width**3
        return -self.y / width - lean, -self.bent / width - 2 * self.y / self.half**2 * lean


def approximate_edge(pixels: Array, usable: Mask) -> Array | None:
    """Edge from the centroids of the gradient in each row, with grey values beside it; None without an edge.

    Parameters
    ----------
    pixels : ndarray (h, w)
        The region.
    usable : ndarray (h, w) of bool
        Pixels to be used.

    Returns
    -------
    ndarray (6,) or None
        Values of the parameters of :func:`fit_gaussian`.
    """
    gradient = np.diff(pixels, axis=1) * (usable[:, 1:] & usable[:, :-1])
    sign = np.sign(gradient.sum())
    weight = np.clip(sign * gradient, 0, None) ** 2
    if not weight.sum(axis=1).min() > 0:
        return None
    x = np.arange(gradient.shape[1], dtype=np.float64) + 0.5
    rows = np.arange(len(pixels), dtype=np.float64) - (len(pixels) - 1) / 2
    slope, offset = _line(weight, x, rows)
    for _ in range(_ROUNDS):  # far from the edge there is only noise
        near = weight * (np.abs(x - offset - slope * rows[:, None]) < _NEAR_PX)
        if not near.sum(axis=1).min() > 0:
            break
        slope, offset = _line(near, x, rows)
    low, high = np.percentile(pixels[usable], [10, 90])
    sides = (low, high) if sign > 0 else (high, low)
    return np.array([offset, slope, 0.0, *sides, 0.7])


def _line(weight: Array, x: Array, rows: Array) -> tuple[float, float]:
    centre = (weight * x).sum(axis=1) / weight.sum(axis=1)
    slope, offset = np.polyfit(rows, centre, 1)
    return float(slope), float(offset)


def fit_gaussian(
    pixels: EdgePixels, values: Array, reach_px: float, *, bow: bool = False
) -> Adjustment | Failure:
    """Adjust edge, grey values and width to the pixels near the edge.

    Parameters
    ----------
    pixels : EdgePixels
        The pixels; weights follow from their sigmas, the scale of the noise is estimated.
    values : ndarray (6,)
        Approximate `offset` (px), `slope`, `bow` (px), `dark`, `bright` (grey values of the left and right
        side), `psf` (px, one sigma).
    reach_px : float
        Distance from the edge up to which pixels are used.
    bow : bool
        Whether the edge may be curved; otherwise the bow is fixed.
    """
    # The selection of near pixels depends on the position of the edge.
    for _ in range(_ROUNDS if np.isfinite(reach_px) else 0):
        fit = _fitted(pixels, values, reach_px, bow)
        if isinstance(fit, Failure):
            return fit
        values = fit.values
    return _fitted(pixels, values, reach_px, bow)


def _fitted(pixels: EdgePixels, values: Array, reach_px: float, bow: bool) -> Adjustment | Failure:
    part = pixels.part(np.abs(pixels.distance(*values[:3])) < reach_px)
    parameters = Parameters(["offset", "slope", "bow", "dark", "bright", "psf"], values)
    free = parameters if bow else parameters.fix("bow")
    edge = GaussMarkov(
        lambda p: _formed(part, p), part.grey, part.sigma, free, lambda p: _derivatives(part, p)
    )
    found = adjust(edge, ENOUGH)
    if isinstance(found, Failure) and abs(found.values.get("psf", np.inf)) < _SHARPEST_PX:
        # Only the square of the width enters; it would be negative here.
        return adjust(edge.with_parameters(free.fix("psf", at=_SHARPEST_PX)), ENOUGH)
    return found


def _formed(pixels: EdgePixels, p: Array) -> Array:
    slant = np.arctan(p[1])
    spread = edge_spread(pixels.distance(*p[:3]), abs(p[5]), np.cos(slant), abs(np.sin(slant)))
    formed: Array = p[3] + (p[4] - p[3]) * spread
    return formed


def _derivatives(pixels: EdgePixels, p: Array) -> Array:
    """Derivatives of :func:`_formed` with respect to its parameters (n, 6)."""
    slant, width, step = np.arctan(p[1]), abs(p[5]), p[4] - p[3]
    c, s = np.cos(slant), abs(np.sin(slant))
    d = pixels.distance(*p[:3])
    spread, rise = edge_spread(d, width, c, s), edge_slope(d, width, c, s)
    by_slope, by_bow = pixels.turning(*p[:3])
    by_offset = -1 / np.hypot(1.0, p[1] + 2 * p[2] * pixels.y / pixels.half**2)
    # The trapezoid also changes with the slope.
    wide, narrow, near = (c + s) / 2, (c - s) / 2, _close(d, width)
    dc, ds = -np.sin(slant) * c**2, np.sign(p[1]) * c**3
    by_wide, by_narrow = (_once(near + at, width) - _once(near - at, width) for at in (wide, narrow))
    turned = (by_wide * (dc + ds) / 2 - by_narrow * (dc - ds) / 2) / (c * s) - spread * (dc / c + ds / s)
    by_width = np.sign(p[5]) * width * _folded(_never, d, width, c, s)
    columns = [rise * by_offset, rise * by_slope + turned, rise * by_bow]
    return np.column_stack([*(step * column for column in columns), 1 - spread, spread, step * by_width])


def edge_spread(d: Array, sigma: float, c: float, s: float) -> Array:
    """Bright share of a pixel at a distance from the edge: the step convolved with a Gaussian and with the
    trapezoid of the unit square along a normal with the components c and s.
    """
    return _folded(_twice, d, sigma, c, s)


def edge_slope(d: Array, sigma: float, c: float, s: float) -> Array:
    """Derivative of :func:`edge_spread` with respect to the distance: the line-spread function."""
    return _folded(_once, d, sigma, c, s)


def _folded(integral: _Integral, d: Array, sigma: float, c: float, s: float) -> Array:
    d, s = _close(d, sigma), max(s, 1e-3)  # along the rows the trapezoid degenerates to a square
    wide, narrow = (c + s) / 2, (c - s) / 2
    ends = integral(d + wide, sigma) - integral(d + narrow, sigma) - integral(d - narrow, sigma)
    return (ends + integral(d - wide, sigma)) / (c * s)


def _close(d: Array, sigma: float) -> Array:
    """Distances clipped to where the function is constant; beyond, differences of squares lose precision."""
    reach = 9 * sigma + 1.5
    return np.clip(d, -reach, reach)


def _never(u: Array, sigma: float) -> Array:
    """The normal distribution of this width."""
    integral: Array = scipy.special.ndtr(u / max(sigma, 1e-6))
    return integral


def _once(u: Array, sigma: float) -> Array:
    """The first integral of the normal distribution of this width."""
    width = max(sigma, 1e-6)
    density = np.exp(-0.5 * (u / width) ** 2) / np.sqrt(2 * np.pi)
    integral: Array = u * scipy.special.ndtr(u / width) + width * density
    return integral


def _twice(u: Array, sigma: float) -> Array:
    """The second integral of the normal distribution of this width."""
    width = max(sigma, 1e-6)
    density = np.exp(-0.5 * (u / width) ** 2) / np.sqrt(2 * np.pi)
    integral: Array = ((u**2 + width**2) * scipy.special.ndtr(u / width) + u * width * density) / 2
    return integral
