"""Sharpness from a slanted edge (ISO 12233): modulation transfer without assumptions, and a Gaussian model.

A straight edge between dark and bright, slanted by a few degrees, is sampled at all distances from the centre
of a pixel.

The Gaussian edge is formed like all targets: a Gaussian convolved with the square of the pixel, which is a
trapezoid along the normal of the edge. The edge may be slightly curved by distortion: x = offset + slope·y +
bow·(y² − q)/k², with y from the middle row, q the mean of y², and k half the height of the region; the bow is
the distance of the centre of the edge from its chord (px).

The free edge-spread function is that of the Gaussian plus the integral of a spline, adjusted by least squares
to all pixels at their distances from the edge, together with the edge's slope and bow. Its derivative is the
line-spread function, whose Fourier transform has a closed form: no bins, differences or windows, and none of
their biases. Knots are dense at the edge and further apart with increasing distance, where blur changes
slowly, so that noise there affects low frequencies only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import f as fisher

from ..adjust import (
    Adjustment,
    CoefficientTest,
    GaussMarkov,
    NestedTest,
    Options,
    Parameters,
    adjust,
    compare,
)
from ..calibration.document import Quantity
from ..core.data import Array, Frame, Mask
from ..core.failure import Code, Failure
from ..core.threads import one_thread

__all__ = [
    "FREQUENCIES",
    "EdgePixels",
    "EdgeSpread",
    "FreeCurve",
    "approximate_edge",
    "edge_slope",
    "edge_spread",
    "fit_free",
    "fit_gaussian",
    "measure_edge",
]

_NEAR_PX = 8.0
"""Distance from the approximate edge within which its gradient is evaluated."""
_ROUNDS = 3
_SHARPEST_PX = 0.02
"""Width assigned to an edge that shows none."""
ENOUGH = Options(tolerance=1e-7)
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
        distance: Array = self.aside(offset, slope, bow) / np.hypot(1.0, turned)
        return distance

    def aside(self, offset: float, slope: float, bow: float) -> Array:
        """Distances from the edge along the row."""
        aside: Array = self.x - offset - slope * self.y - bow * self.bent
        return aside

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
        bent: Array = (y**2 - (self.size[0] ** 2 - 1) / 12) / self.half**2
        return bent

    def turning(self, offset: float, slope: float, bow: float) -> tuple[Array, Array]:
        """Derivatives of the distance with respect to slope and bow."""
        turned, aside = slope + 2 * bow * self.y / self.half**2, self.aside(offset, slope, bow)
        width = np.hypot(1.0, turned)
        lean = aside * turned / width**3
        return -self.y / width - lean, -self.bent / width - 2 * self.y / self.half**2 * lean


def approximate_edge(pixels: Array) -> Array | None:
    """Edge from the centroids of the gradient in each row, with grey values beside it; None without an edge.

    Returns
    -------
    ndarray (6,) or None
        Values of the parameters of :func:`fit_gaussian`.
    """
    gradient = np.diff(pixels, axis=1)
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
    low, high = np.percentile(pixels, [10, 90])
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
    folded: Array = (ends + integral(d - wide, sigma)) / (c * s)
    return folded


def _close(d: Array, sigma: float) -> Array:
    """Distances clipped to where the function is constant; beyond, differences of squares lose precision."""
    reach = 9 * sigma + 1.5
    close: Array = np.clip(d, -reach, reach)
    return close


def _never(u: Array, sigma: float) -> Array:
    """The normal distribution of this width."""
    integral: Array = ndtr(u / max(sigma, 1e-6))
    return integral


def _once(u: Array, sigma: float) -> Array:
    """The first integral of the normal distribution of this width."""
    width = max(sigma, 1e-6)
    density = np.exp(-0.5 * (u / width) ** 2) / np.sqrt(2 * np.pi)
    integral: Array = u * ndtr(u / width) + width * density
    return integral


def _twice(u: Array, sigma: float) -> Array:
    """The second integral of the normal distribution of this width."""
    width = max(sigma, 1e-6)
    density = np.exp(-0.5 * (u / width) ** 2) / np.sqrt(2 * np.pi)
    integral: Array = ((u**2 + width**2) * ndtr(u / width) + u * width * density) / 2
    return integral


FREQUENCIES: Array = np.arange(33) / 32
"""Frequencies in cycles per pixel at which the curve is reported."""
NYQUIST = 0.5
_STEP_PX = 0.25
"""Distance of knots at the edge; they reproduce a line spread to 1e-4 up to one cycle per pixel."""
_FEWEST = 1.5
"""Minimum distance of knots, relative to the widest gap between the distances of pixels."""
_GROWTH, _WIDEST_PX = 1.25, 2.0
_LIMIT = 0.375
"""Cycles per distance of knots up to which a spline can follow."""
_SHORT = 1e-9


@dataclass(frozen=True, eq=False)
class _Spline:
    """Quadratic B-splines that vanish at the ends, and their integrals."""

    knots: Array

    @property
    def size(self) -> int:
        return len(self.knots) - 3

    @cached_property
    def _lines(self) -> BSpline:
        k = self.knots
        # Exclude splines that extend beyond the end knots.
        wide = np.concatenate([k[0] - [3.0, 2.0, 1.0], k, k[-1] + [1.0, 2.0, 3.0]])
        chosen = np.zeros((len(wide) - 3, self.size))
        chosen[3 : 3 + self.size] = np.eye(self.size)
        return BSpline(wide, chosen, 2)

    @cached_property
    def _integrals(self) -> BSpline:
        return self._lines.antiderivative()

    def lines(self, d: Array) -> Array:
        """Values (n, size) at distances."""
        inside = (d >= self.knots[0]) & (d <= self.knots[-1])
        found: Array = np.where(inside[:, None], self._lines(np.clip(d, self.knots[0], self.knots[-1])), 0.0)
        return found

    def integrals(self, d: Array) -> Array:
        """Integrals (n, size) from the first knot."""
        start, end = self.knots[0], self.knots[-1]
        found: Array = self._integrals(np.clip(d, start, end)) - self._integrals(start)
        return found

    def transforms(self, frequency: Array) -> Array:
        """Fourier transforms (m, size), exact within rounding: no piece has more than two periods."""
        nodes, weights = np.polynomial.legendre.leggauss(20)
        half = np.diff(self.knots) / 2
        at = ((self.knots[1:] + self.knots[:-1]) / 2)[:, None] + half[:, None] * nodes
        weighed = self.lines(at.ravel()) * (half[:, None] * weights).reshape(-1, 1)
        transformed: Array = np.exp(-2j * np.pi * np.outer(frequency, at.ravel())) @ weighed
        return transformed


@dataclass(frozen=True, eq=False)
class FreeCurve:
    """Modulation transfer of an edge without a model; includes the square of the pixel.

    Parameters
    ----------
    fit : Adjustment
        Adjustment of `dark` (grey value), the coefficients `a0` … of the line spread in excess of the
        Gaussian, `slope` and, where it is estimated, `bow`.
    spline : object
        The spline of these coefficients.
    base : ndarray (6,)
        Parameters of the Gaussian edge; see :func:`~reseau.sensor.edge.fit_gaussian`.
    limit : float
        Frequency (cycles per pixel) up to which the distances of the pixels resolve the curve.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[-12:12, -12:12]
    >>> pixels = EdgePixels.of(40 + 150 * ndtr((x - 0.1 * y) / 0.9), np.ones((24, 24), dtype=bool))
    >>> curve = fit_free(pixels, np.array([12.0, 0.1, 0.0, 40.0, 190.0, 0.9]))
    >>> modulation, sigma = curve.mtf(np.array([0.0, 0.25]))
    >>> modulation.round(2).tolist(), curve.limit
    ([1.0, 0.37], 1.0)
    """

    fit: Adjustment
    spline: _Spline
    base: Array
    limit: float

    @property
    def _coefficients(self) -> tuple[Array, Array]:
        names = tuple(f"a{j}" for j in range(self.spline.size))
        return np.array([self.fit[name] for name in names]), self.fit.covariance_of(*names)

    def transfer(self, frequency: Array | float) -> tuple[Array, Array]:
        """Optical transfer (m,), complex about the edge, and the covariance (m, 2, 2) of its two parts.

        Notes
        -----
        With A the step and ĝ the transform of the Gaussian edge, aⱼ and b̂ⱼ those of the spline,
        Z(f) = (A ĝ(f) + Σ aⱼ b̂ⱼ(f)) / (A + Σ aⱼ b̂ⱼ(0)), and ∂Z/∂aⱼ = (b̂ⱼ(f) − Z b̂ⱼ(0)) / (A + …).
        """
        f = np.atleast_1d(np.asarray(frequency, dtype=np.float64))
        a, cov = self._coefficients
        step, c, s = self._step
        gaussian = np.exp(-2 * (np.pi * self.base[5] * f) ** 2) * np.sinc(f * c) * np.sinc(f * s)
        with one_thread():  # makes sums independent of the number of processors
            lines, areas = self.spline.transforms(f), self.spline.transforms(np.zeros(1)).real[0]
        whole = step + float(areas @ a)
        z = (step * gaussian + lines @ a) / whole
        by = (lines - z[:, None] * areas) / whole
        parts = np.stack([by.real, by.imag], axis=1)
        return z, np.einsum("mik,kl,mjl->mij", parts, cov, parts)

    @property
    def _step(self) -> tuple[float, float, float]:
        """Grey values of the Gaussian edge, and the components of its normal."""
        slant = np.arctan(self.base[1])
        return float(self.base[4] - self.base[3]), float(np.cos(slant)), float(abs(np.sin(slant)))

    def mtf(self, frequency: Array | float) -> tuple[Array, Array]:
        """Modulation transfer at frequencies (cycles per pixel, along the normal), and its sigmas.

        Notes
        -----
        Noise increases the expected modulus of the estimate. The variance of the component along Z is that of
        the modulus; the variance of the component across is subtracted, ``|Z|² − σ²₊``, at least 0.
        """
        z, cov = self.transfer(frequency)
        along = np.where(np.abs(z) > _SHORT, z / np.maximum(np.abs(z), _SHORT), 1.0)
        u = np.stack([along.real, along.imag], axis=1)
        across = np.stack([-along.imag, along.real], axis=1)
        own, other = (np.einsum("mi,mij,mj->m", v, cov, v) for v in (u, across))
        return np.sqrt(np.maximum(np.abs(z) ** 2 - other, 0.0)), np.sqrt(np.maximum(own, 0.0))

    @property
    def mtf50(self) -> tuple[float, float] | None:
        """Frequency at which the modulation is 0.5, and its sigma; None if it stays above."""

        def above(frequency: float) -> float:
            return float(self.mtf(frequency)[0][0]) - 0.5

        grid = np.linspace(0.0, self.limit, 129)
        below = np.flatnonzero(self.mtf(grid)[0] < 0.5)
        if not len(below):
            return None
        low, high = float(grid[below[0] - 1]), float(grid[below[0]])
        half = float(brentq(above, low, high, xtol=1e-10))
        slope = (above(half + 1e-4) - above(half - 1e-4)) / 2e-4
        return half, float(self.mtf(half)[1][0]) / max(abs(slope), _SHORT)

    @property
    def nyquist(self) -> tuple[float, float]:
        """Modulation transfer at half a cycle per pixel, and its sigma."""
        value, sigma = self.mtf(NYQUIST)
        return float(value[0]), float(sigma[0])

    def line_spread(self, distance: Array) -> tuple[Array, Array]:
        """Line-spread function (1/px) at distances from the edge, and that of the underlying Gaussian."""
        step, c, s = self._step
        a, _ = self._coefficients
        gaussian = edge_slope(distance, abs(self.base[5]), c, s)
        whole = step + float(self.spline.integrals(self.spline.knots[-1:])[0] @ a)
        return (step * gaussian + self.spline.lines(distance) @ a) / whole, gaussian

    def ends(self) -> tuple[float, float]:
        """Share of the step that rises in the outer quarters of the region, and the probability that noise
        alone causes it. A significant rise means blur beyond the region, or uneven light.
        """
        a, cov = self._coefficients
        k, step = self.spline.knots, self._step[0]
        at = np.array([k[0], 0.75 * k[0], 0.75 * k[-1], k[-1]])
        values = self.spline.integrals(at)
        rises = np.stack([values[1] - values[0], values[3] - values[2]])
        found, spread = rises @ a, rises @ cov @ rises.T
        statistic = float(found @ np.linalg.pinv(spread) @ found) / 2
        return float(np.abs(found).sum() / abs(step)), float(fisher.sf(statistic, 2, self.fit.redundancy))


def fit_free(pixels: EdgePixels, base: Array, *, bow: bool = False) -> FreeCurve | Failure:
    """Adjust the free curve to pixels.

    Parameters
    ----------
    pixels : EdgePixels
        All pixels to be used.
    base : ndarray (6,)
        Parameters of the Gaussian edge; see :func:`~reseau.sensor.edge.fit_gaussian`.
    bow : bool
        Whether the edge may be curved.
    """
    gap = _gap(pixels, base)
    limit = min(1.0, _LIMIT / max(_STEP_PX, _FEWEST * gap))
    if limit < NYQUIST:
        return Failure(
            "the edge crosses too few pixels: take a longer region, or another slant", Code.TOO_SMALL
        )
    spline = _Spline(_knots(pixels, base, max(_STEP_PX, _FEWEST * gap)))
    names = ["dark", *(f"a{j}" for j in range(spline.size)), "slope", "bow"]
    start = [base[3], *np.zeros(spline.size), base[1], base[2]]
    parameters = Parameters(names, start)
    slant = np.arctan(base[1])
    shape = abs(float(base[5])), float(np.cos(slant)), float(abs(np.sin(slant)))
    step = float(base[4] - base[3])

    def computed(p: Array) -> Array:
        d = pixels.distance(base[0], p[-2], p[-1])
        formed: Array = p[0] + step * edge_spread(d, *shape) + spline.integrals(d) @ p[1:-2]
        return formed

    def jacobian(p: Array) -> Array:
        d = pixels.distance(base[0], p[-2], p[-1])
        rise = step * edge_slope(d, *shape) + spline.lines(d) @ p[1:-2]
        turned = [rise * by for by in pixels.turning(base[0], p[-2], p[-1])]
        return np.column_stack([np.ones_like(d), spline.integrals(d), *turned])

    problem = GaussMarkov(
        computed, pixels.grey, pixels.sigma, parameters if bow else parameters.fix("bow"), jacobian
    )
    fit = adjust(problem, ENOUGH)
    return fit if isinstance(fit, Failure) else FreeCurve(fit, spline, base, limit)


def _gap(pixels: EdgePixels, base: Array) -> float:
    """The widest gap between the distances of all pixels from the edge."""
    rows = np.unique(pixels.y)
    edge = base[0] + base[1] * rows + base[2] * pixels.bent_at(rows)
    phases = np.sort(np.mod(edge, 1.0))
    gaps = np.diff(phases, append=phases[0] + 1.0)
    return float(gaps.max() / np.hypot(1.0, base[1]))


def _knots(pixels: EdgePixels, base: Array, step: float) -> Array:
    """Knots: dense within the blur of the Gaussian, then with growing steps to where half of the rows end.

    The curve is constant beyond.
    """
    d = pixels.distance(*base[:3])
    rows = np.unique(pixels.y, return_inverse=True)[1]
    ends = np.zeros((2, int(rows.max()) + 1))
    np.minimum.at(ends[0], rows, d)
    np.maximum.at(ends[1], rows, d)
    left, right = np.median(ends, axis=1)
    core = 3 * abs(float(base[5])) + 1.0
    return np.concatenate([-_side(-float(left), core, step)[::-1], [0.0], _side(float(right), core, step)])


def _side(reach: float, core: float, step: float) -> Array:
    at, wide = [step], step
    while at[-1] + 1.5 * wide < reach:
        at.append(at[-1] + wide)
        wide = min(wide * _GROWTH, max(_WIDEST_PX, step)) if at[-1] > core else step
    return np.append(at, max(reach, at[-1] + step))


_REACH_PX, _REACH_PSF = 8.0, 4.0
"""Distance from the edge up to which pixels are used for the Gaussian: the larger of pixels and widths."""
_FREE_REACH_PX, _FREE_REACH_PSF = 32.0, 12.0
"""The same for the free curve."""
_LEAST_SLANT, _MOST_SLANT = 0.02, 0.6
"""Limits of the slant in radians; below, all pixels along the edge have nearly the same distance."""
_LEAST_CONTRAST, _BESIDE_PX = 5.0, 2.0
"""Minimum contrast of an edge over the noise of a pixel; distance from the edge of its two flat sides."""
ALPHA = 0.01
"""Level of significance of the tests."""
_SATURATED = 0.005
"""Largest share of saturated pixels in the region."""


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """Sharpness of an edge.

    Parameters
    ----------
    fit : Adjustment
        Adjustment of `offset` (px), `slope` and `bow` of the edge (zero for a straight edge), `dark` and
        `bright` beside it, and `psf` (px, one sigma; fixed if the edge shows no width).
    free : FreeCurve or Failure
        Modulation transfer without the assumption of a Gaussian; a failure if there are too few pixels.
    gaussian : NestedTest or None
        Test of whether more than the Gaussian is needed; significant if it does not describe the edge.
    bent : CoefficientTest or None
        Test of whether the edge is curved.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[-12:12, -12:12]
    >>> pixels = EdgePixels.of(40 + 150 * ndtr((x - 0.1 * y) / 0.9), np.ones((24, 24), dtype=bool))
    >>> fit = fit_gaussian(pixels, np.array([12.0, 0.1, 0.0, 40.0, 190.0, 0.8]), np.inf)
    >>> edge = EdgeSpread(fit.required(), Failure("not measured", Code.TOO_SMALL))
    >>> round(edge.fit["psf"], 2), round(float(np.rad2deg(edge.angle)), 1), round(edge.mtf50[0], 2)
    (0.85, 5.7, 0.21)
    """

    fit: Adjustment
    free: FreeCurve | Failure
    gaussian: NestedTest | None = None
    bent: CoefficientTest | None = None

    @property
    def angle(self) -> float:
        """Angle of the edge from its axis (rad)."""
        return float(np.arctan(self.fit["slope"]))

    def mtf(self, frequency: Array | float, psf: float | None = None) -> Array:
        """Modulation transfer of the Gaussian at frequencies in cycles per pixel, along the normal of the
        edge; includes the square of the pixel.
        """
        f = np.asarray(frequency, dtype=np.float64)
        width = self.fit["psf"] if psf is None else psf
        blur = np.exp(-2 * (np.pi * width * f) ** 2)
        transfer: Array = blur * np.abs(np.sinc(f * np.cos(self.angle)) * np.sinc(f * np.sin(self.angle)))
        return transfer

    @property
    def mtf50(self) -> tuple[float, float]:
        """Frequency at which the modulation of the Gaussian is 0.5 (cycles per pixel), and its sigma."""

        def half(psf: float) -> float:
            return float(brentq(lambda f: float(self.mtf(f, psf)) - 0.5, 1e-6, 0.99))

        psf, step = abs(self.fit["psf"]), 1e-4
        slope = (half(psf + step) - half(max(psf - step, 0.0))) / (step + min(step, psf))
        return half(psf), abs(slope) * self.fit.sigma_of("psf")

    def quantities(self) -> dict[str, Quantity]:
        """Estimated quantities by name: of the Gaussian, and of the free curve."""
        half, sigma = self.mtf50
        found = {
            "psf": Quantity(value=abs(self.fit["psf"]), sigma=self.fit.sigma_of("psf"), unit="px"),
            "mtf50": Quantity(value=half, sigma=sigma, unit="1/px"),
        }
        if isinstance(self.free, FreeCurve):
            if (free := self.free.mtf50) is not None:
                found["mtf50_free"] = Quantity(value=free[0], sigma=free[1], unit="1/px")
            value, sigma = self.free.nyquist
            found["mtf_nyquist_free"] = Quantity(value=value, sigma=sigma, unit="1")
        return found

    def to_model(self) -> dict[str, Any]:
        """Curves for a calibration file: the free curve in columns, and that of the Gaussian."""
        if isinstance(self.free, Failure):
            return {}
        frequency = FREQUENCIES[: int(np.searchsorted(FREQUENCIES, self.free.limit, side="right"))]
        value, sigma = self.free.mtf(frequency)
        columns = {"frequency": frequency, "mtf": value, "sigma": sigma, "gaussian": self.mtf(frequency)}
        return {"mtf": {name: column.tolist() for name, column in columns.items()}}

    def tests(self) -> list[dict[str, Any]]:
        """Tests for a calibration file: Gaussian edge, straight edge, constant sides."""
        if isinstance(self.free, Failure):
            return []
        found: list[dict[str, Any]] = [
            {"name": name, "passed": not test.significant, "statistic": test.statistic, "p": test.p}
            for name, test in (("Gaussian edge", self.gaussian), ("straight edge", self.bent))
            if test is not None
        ]
        rise, p = self.free.ends()
        return [*found, {"name": "flat beside the edge", "passed": p >= ALPHA, "statistic": rise, "p": p}]

    def validity(self) -> dict[str, Any]:
        """Description for a calibration file: the method and the slant."""
        free = "measured" if self.free else f"no free curve: {getattr(self.free, 'reason', '')}"
        return {"edge": free, "edge_angle_deg": float(np.rad2deg(self.angle))}


def measure_edge(
    frame: Frame,
    region: tuple[int, int, int, int] | None = None,
    variance: Array | None = None,
    good: Mask | None = None,
) -> EdgeSpread | Failure:
    """Measure the edge in a region.

    Parameters
    ----------
    frame : Frame
        A frame with a straight edge, nearly vertical or horizontal; grey values proportional to the light.
    region : (left, top, width, height), optional
        Region that contains nothing else; by default the whole frame.
    variance : ndarray (height, width), optional
        Variance of the grey values, up to a common factor, if the photon transfer is known; by default one
        value for the dark and one for the bright side are estimated from the residuals.
    good : ndarray (height, width) of bool, optional
        Pixels to be used; by default all.

    Returns
    -------
    EdgeSpread or Failure
        A failure if the region has no suitable edge.

    Examples
    --------
    A vertical edge with a slope of 0.1 and a width of 0.9 px:

    >>> import numpy as np
    >>> from scipy.special import ndtr
    >>> x, y = np.meshgrid(np.arange(40.0) - 20, np.arange(40.0) - 20)
    >>> grey = 40 + 150 * ndtr((x - 0.1 * y) / 0.9) + np.random.default_rng(1).normal(0, 1, x.shape)
    >>> found = measure_edge(Frame(grey.astype(np.float32), 255.0))
    >>> round(float(np.rad2deg(found.angle)), 0)
    6.0
    """
    left, top, width, height = region or (0, 0, frame.width, frame.height)
    inside = np.s_[max(top, 0) : top + height, max(left, 0) : left + width]
    pixels = frame.pixels[inside].astype(np.float64)
    if min(pixels.shape) < 16:
        return Failure("the region of the edge is smaller than 16 pixels", Code.TOO_SMALL)
    usable = np.ones(pixels.shape, dtype=bool) if good is None else good[inside]
    if np.mean(pixels[usable] >= frame.full_scale) > _SATURATED:
        return Failure("its bright side is saturated: reduce the exposure", Code.SATURATED)
    noise = None if variance is None else variance[inside]
    across, along = (np.abs(np.diff(pixels, axis=axis)).sum() for axis in (1, 0))
    if along > across:
        pixels, usable = pixels.T, usable.T
        noise = None if noise is None else noise.T
    values = approximate_edge(pixels)
    if values is None:
        return Failure("a row of the region has no edge", Code.NOT_FOUND)
    if not _contrast(pixels, values) > _LEAST_CONTRAST:
        return Failure("there is no edge above the noise in its region", Code.LOW_CONTRAST)
    if not _LEAST_SLANT < abs(values[1]) < _MOST_SLANT:
        slant = np.rad2deg(np.arctan(values[1]))
        return Failure(f"the edge is slanted by {slant:.1f}°: rotate it to 3° to 20°", Code.SLANT)
    around = EdgePixels.of(pixels, usable)
    if noise is not None:
        around = replace(around, sigma=np.sqrt(noise[usable]))
    with one_thread():
        return _measured(around, values, noise is not None)


def _contrast(pixels: Array, values: Array) -> float:
    """Difference of the two sides over the noise of a pixel, both robust; 0 if a side is missing."""
    rows = np.arange(len(pixels)) - (len(pixels) - 1) / 2
    aside = np.arange(pixels.shape[1]) - values[0] - values[1] * rows[:, None]
    left, right = pixels[aside < -_BESIDE_PX], pixels[aside > _BESIDE_PX]
    if not len(left) or not len(right):
        return 0.0
    noise = 1.4826 * float(np.median(np.abs(np.diff(pixels, axis=0)))) / np.sqrt(2)
    step = abs(float(np.median(left) - np.median(right)))
    return step / noise if noise > 0 else np.inf if step > 0 else 0.0


def _measured(pixels: EdgePixels, values: Array, known: bool) -> EdgeSpread | Failure:
    """Adjust Gaussian and free curve in turn, with selection of pixels, noise and test of the bow."""
    first = fit_gaussian(pixels, values, _REACH_PX)
    if isinstance(first, Failure):
        return first
    near, far = _reaches(first)
    pixels = pixels.part(np.abs(pixels.distance(*first.values[:3])) < far)
    wide = fit_gaussian(pixels, first.values, np.inf, bow=True)
    if isinstance(wide, Failure):
        return wide
    free = fit_free(pixels, wide.values, bow=True)
    if isinstance(free, Failure):
        fit = fit_gaussian(pixels, first.values, near)
        return fit if isinstance(fit, Failure) else EdgeSpread(fit, free)
    if not known:
        pixels = _weighed(free, pixels)
        free = fit_free(pixels, wide.values, bow=True)
        if isinstance(free, Failure):
            return free
    bent = free.fit.test_of("bow", alpha=ALPHA)
    wide = fit_gaussian(pixels, first.values, np.inf, bow=bent.significant)
    fit = fit_gaussian(pixels, first.values, near, bow=bent.significant)
    if isinstance(wide, Failure):
        return wide
    if isinstance(fit, Failure):
        return fit
    free = fit_free(pixels, wide.values, bow=bent.significant)
    test = None if isinstance(free, Failure) else compare(wide, free.fit, ALPHA)
    return EdgeSpread(fit, free, test, bent)


def _reaches(fit: Adjustment) -> tuple[float, float]:
    """Distances up to which pixels are used, in the Gaussian and in the free curve."""
    psf = abs(fit["psf"])
    return max(_REACH_PX, _REACH_PSF * psf), max(_FREE_REACH_PX, _FREE_REACH_PSF * psf)


def _weighed(free: FreeCurve, pixels: EdgePixels) -> EdgePixels:
    """The pixels with sigmas from the residuals; the variance is a linear function of the light."""
    dark, bright = free.base[3:5]
    residual = free.fit.residuals**2 * (len(pixels.grey) / free.fit.redundancy)
    share = np.clip((pixels.grey + free.fit.residuals - dark) / (bright - dark), 0.0, 1.0)
    levels = np.full(2, float(residual.mean()))
    for _ in range(2):  # squared residuals scatter in proportion to their mean
        design = np.stack([1 - share, share], axis=1)
        weight = 1 / (design @ levels)
        found = np.linalg.lstsq(design * weight[:, None], residual * weight, rcond=None)[0]
        levels = np.maximum(found, 1e-3 * float(residual.mean()) + 1e-12)
    return replace(pixels, sigma=np.sqrt(levels[0] + (levels[1] - levels[0]) * share))
