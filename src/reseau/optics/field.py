r"""Smooth fields through measured points: a polynomial trend and, if needed, a local model on top.

The local model is least-squares collocation (Krarup 1969; Moritz 1980, eq. 14-26; Kraus & Mikhail 1972),
:math:`l = A x + s + n`: deviations from the polynomial are a signal s whose covariance decreases with
distance, here :math:`C(d) = s^2 (1 + z + z^2/3) e^{-z}` with :math:`z = \sqrt5\,d/L`, twice
differentiable. Its three parameters are estimated by restricted maximum likelihood (Patterson & Thompson
1971), so that the trend does not bias them, and the significance of the signal is tested.

*Beyond* the points it was fitted to, the field is the trend and the decreasing signal; do not use it for
extrapolation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..core.data import Array
from ..core.errors import UsageError
from ..core.threads import one_thread

_LENGTHS = 0.12 * 2.0 ** np.arange(6)
"""Correlation lengths that are tried, in half extents of the field."""
_RATIOS = np.concatenate([[0.0], 10.0 ** np.arange(-2, 3.01, 0.5)])
"""Ratios of the variances of signal and noise that are tried."""


def trend_degree(points: int, most: int = 5) -> int:
    """Highest degree of a trend with at least five points for each pair of coefficients.

    Examples
    --------
    >>> [trend_degree(n) for n in (8, 20, 80, 200)]
    [0, 1, 4, 5]
    """
    return max(d for d in range(most + 1) if d == 0 or 2.5 * (d + 1) * (d + 2) <= points + 4)


@dataclass(frozen=True, eq=False)
class SmoothField:
    """A plane-to-plane field fitted to points.

    Parameters
    ----------
    source : ndarray (n, 2)
        Points at which the field is known.
    target : ndarray (n, 2)
        Values at these points.
    degree : int
        Degree of the trend.
    length : float
        Correlation length L of the signal in the unit of `source`.
    ratio : ndarray (2,)
        Variance of the signal over that of the noise, per axis; 0 without a signal.
    noise : ndarray (2,)
        Standard deviation of the noise of a point of weight 1, per axis.
    need : ndarray (2,)
        Probability, per axis, that white noise alone requires an equally strong signal; NaN if not tested.
    sigma : ndarray (n,)
        Relative standard deviations of the points.
    """

    source: Array
    target: Array
    degree: int
    length: float
    ratio: Array
    noise: Array
    need: Array
    sigma: Array
    _solutions: tuple[tuple[Array, Array, Array], ...]

    @classmethod
    @one_thread()
    def fit(
        cls,
        source: Array,
        target: Array,
        *,
        sigma: Array | None = None,
        degree: int | None = None,
        local: bool = True,
        length: float | None = None,
        trials: int = 0,
        seed: int = 0,
        null: Array | None = None,
    ) -> SmoothField:
        """Fit the field.

        Parameters
        ----------
        source, target : ndarray (n, 2)
            Points and the values there.
        sigma : ndarray (n,), optional
            Relative standard deviations of the values; equal by default.
        degree : int, optional
            Degree of the trend; by default the highest supported by the number of points.
        local : bool
            Whether a signal may be added to the trend.
        length : float, optional
            Correlation length, if known; by default the likeliest one.
        trials : int
            Number of simulated fields of white noise for the test of the signal; 0 for no test.
        seed : int
            Seed of the simulation.
        null : ndarray (trials, n, 2), optional
            Values without a signal for the test, if they are not white: residuals of an adjustment lack the
            part absorbed by its parameters.

        Raises
        ------
        UsageError
            When there are fewer points than coefficients of the trend, plus two.
        """
        degree = trend_degree(len(source)) if degree is None else degree
        relative = np.ones(len(source)) if sigma is None else np.asarray(sigma, dtype=np.float64)
        design, extent = _design(source, source, degree)
        if len(source) < design.shape[1] + 2:
            raise UsageError(f"{len(source)} points are too few for a trend of degree {degree}")
        if not local:
            return _polynomial(source, target, degree, design, relative)
        q, _ = np.linalg.qr(design / relative[:, None], mode="complete")
        free = q[:, design.shape[1] :]
        white = free.T @ (target / relative[:, None])
        distance = scipy.spatial.distance.cdist(source, source)
        ratios, lengths = _RATIOS, _LENGTHS if length is None else np.array([length / extent])
        spectra = [_spectrum(free, _correlation(distance / (extent * scale)), relative) for scale in lengths]
        gains = np.array([_gains(spectrum, vectors.T @ white, ratios) for spectrum, vectors in spectra])
        best = int(gains.max(axis=1).sum(axis=1).argmax())
        at = gains[best].argmax(axis=0)
        if null is None:
            white_noise = np.random.default_rng(seed).standard_normal((1, free.shape[1], trials))
        else:
            white_noise = np.einsum("nf,tna->aft", free / relative[:, None], null)
        need = _need(spectra, ratios, gains, white_noise)
        ratio = ratios[at]
        spectrum, vectors = spectra[best]
        solutions, noise = [], np.empty(2)
        for axis in range(2):
            damped = 1 / (ratio[axis] * spectrum + 1)
            basis = free @ vectors
            noise[axis] = np.sqrt(np.mean((vectors.T @ white[:, axis]) ** 2 * damped))
            inverse = (basis * damped) @ basis.T  # (K + D)⁻¹ after the trend, in whitened coordinates
            weights = inverse @ (target[:, axis] / relative)
            kernel = ratio[axis] * _correlation(distance / (extent * lengths[best]))
            rest = target[:, axis] - weights * relative - kernel @ (weights / relative)
            trend = np.linalg.lstsq(design, rest, rcond=None)[0]
            solutions.append((weights, np.diag(inverse), trend))
        return cls(
            source,
            target,
            degree,
            float(extent * lengths[best]),
            ratio,
            noise,
            need,
            relative,
            tuple(solutions),
        )

    def __call__(self, xy: Array) -> Array:
        """Values of the field at points (n, 2)."""
        design, _ = _design(self.source, xy, self.degree)
        if not self.ratio.any():
            return design @ np.stack([trend for _, _, trend in self._solutions], axis=1)
        kernel = _correlation(scipy.spatial.distance.cdist(xy, self.source) / self.length)
        parts = [
            design @ trend + ratio * (kernel @ (weights / self.sigma))
            for ratio, (weights, _, trend) in zip(self.ratio, self._solutions, strict=True)
        ]
        return np.stack(parts, axis=1)

    def jacobian(self, xy: Array) -> Array:
        """Derivatives of the field at points, (n, 2, 2), by central differences."""
        step = 1e-4 * _extent(self.source)[1]
        return np.stack(
            [(self(xy + shift) - self(xy - shift)) / (2 * step) for shift in step * np.eye(2)], axis=2
        )

    def leave_one_out(self) -> tuple[Array, Array]:
        """Predict every point from the others.

        Returns
        -------
        deviation : ndarray (n, 2)
            Value minus prediction.
        sigma : ndarray (n, 2)
            Its standard deviation, including the noise of the point.

        Notes
        -----
        With :math:`P` the inverse covariance after elimination of the trend, :math:`(P l)_i / P_{ii}` and
        :math:`P_{ii}^{-1/2}` (Dubrule 1983); nothing is adjusted again.
        """
        scale = self.sigma[:, None]
        weights = np.stack([solution[0] for solution in self._solutions], axis=1)
        diagonal = np.maximum(np.stack([solution[1] for solution in self._solutions], axis=1), 1e-12)
        return weights / diagonal * scale, self.noise / np.sqrt(diagonal) * scale


def _polynomial(source: Array, target: Array, degree: int, design: Array, relative: Array) -> SmoothField:
    """The trend alone, by least squares."""
    q, r = np.linalg.qr(design / relative[:, None])
    white = target / relative[:, None]
    fitted = q.T @ white
    rest = white - q @ fitted
    noise = np.sqrt((rest**2).sum(axis=0) / (len(source) - design.shape[1]))
    trend = np.linalg.solve(r, fitted)
    free = 1 - (q**2).sum(axis=1)
    solutions = tuple((rest[:, axis], free, trend[:, axis]) for axis in range(2))
    none = np.zeros(2)
    return SmoothField(source, target, degree, np.inf, none, noise, np.full(2, np.nan), relative, solutions)


def _extent(source: Array) -> tuple[Array, float]:
    low, high = source.min(axis=0), source.max(axis=0)
    return (low + high) / 2, float(max((high - low).max() / 2, 1e-12))


def _design(source: Array, xy: Array, degree: int) -> tuple[Array, float]:
    """Monomials of the trend at `xy`, scaled to the extent of the source."""
    centre, extent = _extent(source)
    x, y = ((xy - centre) / extent).T
    return monomials(x, y, degree), extent


def monomials(x: Array, y: Array, degree: int) -> Array:
    """Monomials xⁱ yʲ up to a degree, (n, terms).

    Examples
    --------
    >>> monomials(np.array([2.0]), np.array([3.0]), 2).tolist()
    [[1.0, 3.0, 9.0, 2.0, 6.0, 4.0]]
    """
    columns = np.empty(((degree + 1) * (degree + 2) // 2, len(x)))
    row, left = 0, np.ones(len(x))
    for i in range(degree + 1):
        columns[row] = left
        for j in range(1, degree + 1 - i):
            np.multiply(columns[row + j - 1], y, out=columns[row + j])
        row += degree + 1 - i
        left = left * x
    return columns.T


def _correlation(z: Array) -> Array:
    """Matérn correlation of smoothness 5/2 at distances in correlation lengths."""
    z = np.sqrt(5) * z
    return (1 + z + z * z / 3) * np.exp(-z)


def _spectrum(free: Array, correlation: Array, relative: Array) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors of the signal's covariance in the space orthogonal to the trend."""
    values, vectors = scipy.linalg.eigh(
        free.T @ (correlation / np.outer(relative, relative)) @ free, check_finite=False
    )
    return np.maximum(values, 0), vectors


def _gains(spectrum: Array, white: Array, ratios: Array) -> Array:
    """Restricted log-likelihood relative to no signal, (ratios, columns of `white`).

    The variance of the noise is replaced by its estimate for each ratio.
    """
    damped = 1 / (ratios[:, None] * spectrum + 1)
    variance = damped @ white**2 / len(spectrum)
    gain: Array = -0.5 * (
        len(spectrum) * np.log(np.maximum(variance, 1e-300)) - np.log(damped).sum(axis=1)[:, None]
    )
    return gain - gain[:1]


def _need(spectra: list[tuple[Array, Array]], ratios: Array, gains: Array, null: Array) -> Array:
    """Share of simulated fields without a signal with at least the same gain in likelihood (an exact test).

    The simulated fields (1 or 2 axes, free values, trials) are transformed to the basis of each spectrum.
    """
    trials = null.shape[2]
    if not trials:
        return np.full(2, np.nan)
    simulated = np.max(
        [
            [_gains(values, vectors.T @ axis, ratios).max(axis=0) for axis in null]
            for values, vectors in spectra
        ],
        axis=0,
    )
    observed = gains.max(axis=(0, 1))
    need: Array = (1 + (simulated >= observed[:, None]).sum(axis=1)) / (trials + 1)
    return need
