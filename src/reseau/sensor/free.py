"""The modulation transfer of an edge without any assumption on the point-spread function (ISO 12233).

The edge-spread function is that of the Gaussian plus the integral of a spline, adjusted by least squares to
all pixels at their distances from the edge, together with the edge's slope and bow. Its derivative is the
line-spread function, whose Fourier transform is a closed form: no bins, no differences, no window, so none of
their biases. Knots are close where the edge is, and farther apart with the distance from it, where blur
changes slowly: what noise brings in there stays at low frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import brentq
from scipy.stats import f as fisher

from ..adjust import Adjustment, GaussMarkov, Parameters, adjust
from ..core.data import Array
from ..core.failure import Code, Failure
from ..core.threads import one_thread
from .gaussian import ENOUGH, EdgePixels, edge_slope, edge_spread

__all__ = ["FREQUENCIES", "FreeCurve", "fit_free"]

FREQUENCIES: Array = np.arange(33) / 32
"""Cycles per pixel at which the curve is told."""
NYQUIST = 0.5
_STEP_PX = 0.25
"""Between knots at the edge; they reproduce a line spread to 1e-4 up to one cycle per pixel."""
_FEWEST = 1.5
"""Knots are at least so many times as far apart as the widest gap between the pixels' distances."""
_GROWTH, _WIDEST_PX = 1.25, 2.0
_LIMIT = 0.375
"""Cycles per distance of knots up to which a spline follows."""
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
        # Splines with knots beyond the ends have no part; those within are then whole.
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
        """Fourier transforms (m, size), exact but for rounding: no piece has more than two periods."""
        nodes, weights = np.polynomial.legendre.leggauss(20)
        half = np.diff(self.knots) / 2
        at = ((self.knots[1:] + self.knots[:-1]) / 2)[:, None] + half[:, None] * nodes
        weighed = self.lines(at.ravel()) * (half[:, None] * weights).reshape(-1, 1)
        transformed: Array = np.exp(-2j * np.pi * np.outer(frequency, at.ravel())) @ weighed
        return transformed


@dataclass(frozen=True, eq=False)
class FreeCurve:
    """What an edge tells of the modulation transfer by itself; the pixel's own square is in it.

    Parameters
    ----------
    fit : Adjustment
        Of `dark` (grey value), the coefficients `a0` … of the line spread beyond the Gaussian, `slope` and,
        where it is free, `bow`.
    spline : object
        That they belong to.
    base : ndarray (6,)
        Values of the Gaussian edge; see :func:`~reseau.sensor.gaussian.fit_gaussian`.
    limit : float
        Frequency (cycles per pixel) up to which the distances of the pixels resolve the curve.
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
        with one_thread():  # the same sums however many processors there are
            lines, areas = self.spline.transforms(f), self.spline.transforms(np.zeros(1)).real[0]
        whole = step + float(areas @ a)
        z = (step * gaussian + lines @ a) / whole
        by = (lines - z[:, None] * areas) / whole
        parts = np.stack([by.real, by.imag], axis=1)
        return z, np.einsum("mik,kl,mjl->mij", parts, cov, parts)

    @property
    def _step(self) -> tuple[float, float, float]:
        """Of the Gaussian edge: grey values, and the components of its normal."""
        slant = np.arctan(self.base[1])
        return float(self.base[4] - self.base[3]), float(np.cos(slant)), float(abs(np.sin(slant)))

    def mtf(self, frequency: Array | float) -> tuple[Array, Array]:
        """Modulation transfer at frequencies (cycles per pixel, along the normal), and its sigmas.

        Notes
        -----
        The modulus of an estimate with noise is too large: |Z|² by both variances. That along Z is the
        modulus' own; of the one across it is freed, |Z|² − σ²₊, and is zero where that is negative.
        """
        z, cov = self.transfer(frequency)
        along = np.where(np.abs(z) > _SHORT, z / np.maximum(np.abs(z), _SHORT), 1.0)
        u = np.stack([along.real, along.imag], axis=1)
        across = np.stack([-along.imag, along.real], axis=1)
        own, other = (np.einsum("mi,mij,mj->m", v, cov, v) for v in (u, across))
        return np.sqrt(np.maximum(np.abs(z) ** 2 - other, 0.0)), np.sqrt(np.maximum(own, 0.0))

    @property
    def mtf50(self) -> tuple[float, float] | None:
        """Frequency at which half of the modulation is left, and its sigma; None where there is none."""

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
        """Line-spread function (1/px) at distances from the edge, and that of the Gaussian it is beyond."""
        step, c, s = self._step
        a, _ = self._coefficients
        gaussian = edge_slope(distance, abs(self.base[5]), c, s)
        whole = step + float(self.spline.integrals(self.spline.knots[-1:])[0] @ a)
        return (step * gaussian + self.spline.lines(distance) @ a) / whole, gaussian

    def ends(self) -> tuple[float, float]:
        """How much of the step still rises in the outer quarters of the region (share), and the probability
        that noise alone has it so: blur that reaches beyond the region, or uneven light.
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
        All that take part.
    base : ndarray (6,)
        The Gaussian edge among them; see :func:`~reseau.sensor.gaussian.fit_gaussian`.
    bow : bool
        Whether the edge may be bent.
    """
    gap = _gap(pixels, base)
    limit = min(1.0, _LIMIT / max(_STEP_PX, _FEWEST * gap))
    if limit < NYQUIST:
        return Failure(
            "the edge passes too few pixels: take a longer region, or another slant", Code.TOO_SMALL
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
    """The widest gap between the distances of pixels from the edge, of whatever row."""
    rows = np.unique(pixels.y)
    edge = base[0] + base[1] * rows + base[2] * pixels.bent_at(rows)
    phases = np.sort(np.mod(edge, 1.0))
    gaps = np.diff(phases, append=phases[0] + 1.0)
    return float(gaps.max() / np.hypot(1.0, base[1]))


def _knots(pixels: EdgePixels, base: Array, step: float) -> Array:
    """Close within what a blur of the Gaussian's width can reach, then farther and farther apart, to where
    half of the rows end; what is beyond is flat.
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
