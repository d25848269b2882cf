"""Modulation transfer of a slanted edge without a model.

The free edge-spread function is that of the Gaussian edge plus the integral of a spline, adjusted by least
squares to all pixels at their distances from the edge, together with the edge's slope and bow. Its derivative
is the line-spread function, whose Fourier transform has a closed form: no bins, differences or windows, and
none of their biases. Knots are dense at the edge and further apart with increasing distance, where blur
changes slowly, so that noise there affects low frequencies only.

The pupil of a lens has a rim: whatever its shape and aberrations, its transfer function begins with a cusp,
1 − κ|f|, and its line spread falls like κ/(2π²d²). Some of this light leaves every region. A Lorentzian with
this asymptote is therefore adjusted with the spline; the light beyond the region follows from it.

How far from the edge the spline is needed beside the tail is not known. Splines that end at several distances
are averaged with weights like Akaike's; the variance is that of the mean, and includes what they differ by.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ..adjust import Adjustment, GaussMarkov, Parameters, adjust
from ..core.data import Array
from ..core.failure import Code, Failure
from ..core.threads import one_thread
from .gaussian_edge import ENOUGH, EdgePixels, edge_slope, edge_spread

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
_CHORD = 0.25
"""Half the length of the chord whose slope is that of the curve at its half, relative to the frequency."""
_PENALTY = 1.5
"""For each coefficient; with 2, as Akaike has it, a weak flare is taken for the tail and Z is 1 σ too low."""


@dataclass(frozen=True, eq=False)
class _Spline:
    """Quadratic B-splines that vanish at the ends, and their integrals."""

    knots: Array

    @property
    def size(self) -> int:
        return len(self.knots) - 3

    @cached_property
    def _lines(self) -> scipy.interpolate.BSpline:
        k = self.knots
        # Exclude splines that extend beyond the end knots.
        wide = np.concatenate([k[0] - [3.0, 2.0, 1.0], k, k[-1] + [1.0, 2.0, 3.0]])
        chosen = np.zeros((len(wide) - 3, self.size))
        chosen[3 : 3 + self.size] = np.eye(self.size)
        return scipy.interpolate.BSpline(wide, chosen, 2)

    @cached_property
    def _integrals(self) -> scipy.interpolate.BSpline:
        return self._lines.antiderivative()

    def beyond(self, distance: float) -> NDArray[np.intp]:
        """Numbers of the splines that extend beyond a distance from the edge."""
        return np.flatnonzero(np.maximum(-self.knots[:-3], self.knots[3:]) > distance + _SHORT)

    def outer(self, core: float) -> list[NDArray[np.intp]]:
        """The same for each distance of knots behind the core, from the furthest."""
        ends = np.unique(np.abs(self.knots))[::-1]
        found = [self.beyond(float(end)) for end in ends[ends >= core]]
        return [outer for outer in found if len(outer)]

    def lines(self, d: Array) -> Array:
        """Values (n, size) at distances."""
        inside = (d >= self.knots[0]) & (d <= self.knots[-1])
        return np.where(inside[:, None], self._lines(np.clip(d, self.knots[0], self.knots[-1])), 0.0)

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


class _Averaged(NamedTuple):
    """Nested solutions, the largest first, with their weights (n,): values (n, k), covariances (n, k, k).

    Two nested solutions have the covariance of the smaller one. That of the weighted mean is therefore the
    sum of the covariances with the shares Σ wₖ wₗ over the pairs whose smaller one it is.
    """

    weight: Array
    values: Array
    cov: Array

    @property
    def share(self) -> Array:
        """Shares (n,) of the solutions in the covariance of the mean; their sum is 1."""
        return self.weight * (2 * np.cumsum(self.weight) - self.weight)


@dataclass(frozen=True, eq=False)
class FreeCurve:
    """Modulation transfer of an edge without a model; includes the square of the pixel.

    Parameters
    ----------
    fit : Adjustment
        Adjustment of `dark` (grey value), the coefficients `a0` … of the line spread in excess of Gaussian
        and tail, the `tail` (grey values), `slope` and, where it is estimated, `bow`.
    spline : object
        The spline of these coefficients.
    base : ndarray (6,)
        Parameters of the Gaussian edge; see :func:`~reseau.sensor.gaussian_edge.fit_gaussian`.
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

    @cached_property
    def _averaged(self) -> _Averaged:
        """Coefficients and tail, for splines that end at several distances.

        Notes
        -----
        Without the coefficients aₛ of the outer splines the others are a − Q₋ₛ Qₛₛ⁻¹ aₛ with the covariance
        Q − Q₋ₛ Qₛₛ⁻¹ Qₛ₋, and the weighted sum of squares increases by aₛᵀ Qₛₛ⁻¹ aₛ, in units of the
        variance factor. The criterion is that increase, minus a penalty for each of them.
        """
        names = (*(f"a{j}" for j in range(self.spline.size)), "tail")
        a, q = np.array([self.fit[name] for name in names]), self.fit.covariance_of(*names)
        found, spreads, criteria = [a], [q], [0.0]
        with one_thread():  # makes sums independent of the number of processors
            for outer in self.spline.outer(self.core):
                gain = np.linalg.solve(q[np.ix_(outer, outer)], q[outer]).T
                found.append(a - gain @ a[outer])
                spreads.append(q - gain @ q[outer])
                increase = float(a[outer] @ np.linalg.solve(q[np.ix_(outer, outer)], a[outer]))
                criteria.append(increase - _PENALTY * len(outer))
        weight = np.exp(-0.5 * (np.array(criteria) - min(criteria)))
        return _Averaged(weight / weight.sum(), np.array(found), np.array(spreads))

    def transfer(self, frequency: Array | float) -> tuple[Array, Array]:
        """Optical transfer (m,), complex about the edge, and the covariance (m, 2, 2) of its two parts.

        Notes
        -----
        With A the step and ĝ the transform of the Gaussian edge, aⱼ and b̂ⱼ those of the spline and of the
        tail, Z(f) = (A ĝ(f) + Σ aⱼ b̂ⱼ(f)) / (A + Σ aⱼ b̂ⱼ(0)), and
        ∂Z/∂aⱼ = (b̂ⱼ(f) − Z b̂ⱼ(0)) / (A + …). Averaged with the weights w over splines that end at several
        distances, of the shares v in the covariance of the mean, the covariance is
        Σ v C + Σ w (Z − Z̄)(Z − Z̄)ᵀ.
        """
        f = np.atleast_1d(np.asarray(frequency, dtype=np.float64))
        step, c, s = self._step
        gaussian = np.exp(-2 * (np.pi * self.base[5] * f) ** 2) * np.sinc(f * c) * np.sinc(f * s)
        each = self._averaged
        with one_thread():
            lines, areas = self.spline.transforms(f), self.spline.transforms(np.zeros(1)).real[0]
            lines = np.column_stack([lines, np.exp(-2 * np.pi * self.width * np.abs(f))])
            areas = np.append(areas, 1.0)
            whole = step + each.values @ areas
            z = (step * gaussian + each.values @ lines.T) / whole[:, None]
            by = (lines - z[..., None] * areas) / whole[:, None, None]
            parts = np.stack([by.real, by.imag], axis=2)
            own = np.einsum("nmik,nmjk->nmij", parts @ each.cov[:, None], parts)
        mean = each.weight @ z
        away = np.stack([(z - mean).real, (z - mean).imag], axis=-1)
        differ = np.einsum("n,nmi,nmj->mij", each.weight, away, away)
        return mean, np.einsum("n,nmij->mij", each.share, own) + differ

    @property
    def core(self) -> float:
        """Distance from the edge (px) within which the spline is needed."""
        return _core(self.base)

    @property
    def width(self) -> float:
        """Half the full width at half maximum of the tail's line spread (px)."""
        return _tail_width(self.base)

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

    @cached_property
    def mtf50(self) -> tuple[float, float] | None:
        """Frequency at which the modulation is 0.5, and its sigma; None if it stays above.

        Notes
        -----
        The sigma is that of the modulation over the slope of the curve. Noise bends the curve: at a point,
        the slope would be steep just where noise moved the crossing, so it is that of a chord.
        """
        grid = np.linspace(0.0, self.limit, 129)
        below = np.flatnonzero(self.mtf(grid)[0] < 0.5)
        if not len(below):
            return None
        low, high = float(grid[below[0] - 1]), float(grid[below[0]])
        half = float(scipy.optimize.brentq(lambda f: float(self.mtf(f)[0][0]) - 0.5, low, high, xtol=1e-7))
        aside = min(_CHORD * half, self.limit - half)
        values, sigmas = self.mtf(np.array([half - aside, half, half + aside]))
        slope = float(values[0] - values[2]) / (2 * aside) if aside > 0 else 0.0
        return half, float(sigmas[1]) / max(slope, _SHORT)

    @property
    def nyquist(self) -> tuple[float, float]:
        """Modulation transfer at half a cycle per pixel, and its sigma."""
        value, sigma = self.mtf(NYQUIST)
        return float(value[0]), float(sigma[0])

    def line_spread(self, distance: Array) -> tuple[Array, Array]:
        """Line-spread function (1/px) at distances from the edge, and that of the underlying Gaussian."""
        step, c, s = self._step
        a = self._averaged.weight @ self._averaged.values
        gaussian = edge_slope(distance, abs(self.base[5]), c, s)
        whole = step + float(self.spline.integrals(self.spline.knots[-1:])[0] @ a[:-1]) + a[-1]
        light = self.spline.lines(distance) @ a[:-1] + a[-1] * _tail_slope(distance, self.width)
        return (step * gaussian + light) / whole, gaussian

    def ends(self) -> tuple[float, float]:
        """Share of the step that rises in the outer quarters of the region beside the tail, and the
        probability that noise alone causes the coefficients there. A significant rise means blur beyond the
        region, or uneven light.
        """
        a, cov = self._averaged.values[0][:-1], self._averaged.cov[0][:-1, :-1]
        k = self.spline.knots
        values = self.spline.integrals(np.array([k[0], 0.75 * k[0], 0.75 * k[-1], k[-1]]))
        found = np.stack([values[1] - values[0], values[3] - values[2]]) @ a
        outer = self.spline.beyond(0.75 * min(-k[0], k[-1]))
        with one_thread():
            statistic = float(a[outer] @ np.linalg.solve(cov[np.ix_(outer, outer)], a[outer])) / len(outer)
        p = float(scipy.special.fdtrc(len(outer), self.fit.redundancy, statistic))
        return float(np.abs(found).sum() / abs(self._step[0])), p


def fit_free(
    pixels: EdgePixels, base: Array, *, bow: bool = False, start: FreeCurve | None = None
) -> FreeCurve | Failure:
    """Adjust the free curve to pixels.

    Parameters
    ----------
    pixels : EdgePixels
        All pixels to be used.
    base : ndarray (6,)
        Parameters of the Gaussian edge; see :func:`~reseau.sensor.gaussian_edge.fit_gaussian`.
    bow : bool
        Whether the edge may be curved.
    start : FreeCurve, optional
        Curve of the same base, with other sigmas of the pixels, from which to start.
    """
    gap = _gap(pixels, base)
    limit = min(1.0, _LIMIT / max(_STEP_PX, _FEWEST * gap))
    if limit < NYQUIST:
        return Failure(
            "the edge crosses too few pixels: take a longer region, or another slant", Code.TOO_SMALL
        )
    spline = _Spline(_knots(pixels, base, max(_STEP_PX, _FEWEST * gap)))
    names = ["dark", *(f"a{j}" for j in range(spline.size)), "tail", "slope", "bow"]
    begin = [base[3], *np.zeros(spline.size + 1), base[1], base[2]] if start is None else start.fit.values
    width = _tail_width(base)
    parameters = Parameters(names, begin)
    slant = np.arctan(base[1])
    shape = abs(float(base[5])), float(np.cos(slant)), float(abs(np.sin(slant)))
    step = float(base[4] - base[3])

    def computed(p: Array) -> Array:
        d = pixels.distance(base[0], p[-2], p[-1])
        formed: Array = p[0] + step * edge_spread(d, *shape) + spline.integrals(d) @ p[1:-3]
        formed += p[-3] * _tail_spread(d, width)
        return formed

    def jacobian(p: Array) -> Array:
        d = pixels.distance(base[0], p[-2], p[-1])
        rise = step * edge_slope(d, *shape) + spline.lines(d) @ p[1:-3] + p[-3] * _tail_slope(d, width)
        turned = [rise * by for by in pixels.turning(base[0], p[-2], p[-1])]
        return np.column_stack([np.ones_like(d), spline.integrals(d), _tail_spread(d, width), *turned])

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
    core = _core(base)
    return np.concatenate([-_side(-float(left), core, step)[::-1], [0.0], _side(float(right), core, step)])


def _core(base: Array) -> float:
    return 3 * abs(float(base[5])) + 1.0


def _tail_width(base: Array) -> float:
    """Wide enough for the spline to follow the difference to the light near the edge."""
    return abs(float(base[5])) + 0.5


def _tail_spread(d: Array, width: float) -> Array:
    """Integral of :func:`_tail_slope`, from the dark side."""
    return 0.5 + np.arctan(d / width) / np.pi


def _tail_slope(d: Array, width: float) -> Array:
    """A Lorentzian of the area 1."""
    return width / (np.pi * (d**2 + width**2))


def _side(reach: float, core: float, step: float) -> Array:
    at, wide = [step], step
    while at[-1] + 1.5 * wide < reach:
        at.append(at[-1] + wide)
        wide = min(wide * _GROWTH, max(_WIDEST_PX, step)) if at[-1] > core else step
    return np.append(at, max(reach, at[-1] + step))
