"""Good observations among gross errors, as two explanations of each misfit.

Good misfits are normal with a standard deviation that is not known; the sizes of gross errors are equally
probable on a logarithmic scale, up to the largest that is possible. Both, and the share of gross errors, are
estimated by expectation and maximisation (Dempster, Laird & Rubin 1977, J. R. Statist. Soc. B 39). Where
nothing is explained, misfits are anywhere within the largest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..core.data import Array, Mask

# Rounds of the estimation, and relative change of the standard deviation that ends it.
_ROUNDS, _SETTLED = 60, 1e-3


@dataclass(frozen=True)
class Mixture:
    """Misfits of good observations and gross errors.

    Parameters
    ----------
    sigma : float
        Standard deviation of each component of a good misfit.
    share : float
        Part of the observations that are gross errors.
    reach : float
        Largest size of a misfit.
    components : int
        Number of components of a misfit, such as 2 for image points.

    Examples
    --------
    >>> found = Mixture(1.0, 0.1, 1000.0)
    >>> found.good(np.array([0.5, 3.0, 30.0])).round(2)
    array([0.98, 0.87, 0.  ])
    """

    sigma: float
    share: float
    reach: float
    components: int = 2

    def _logarithms(self, size: Array, sigma: Array | float | None = None) -> tuple[Array, Array]:
        """Logarithms of the densities of good and of gross misfits, times their shares."""
        d, s = self.components, self.sigma if sigma is None else sigma
        sphere = 2 * np.pi ** (d / 2) / math.gamma(d / 2)
        span = np.log(np.maximum(self.reach / s, 1.0)) + 1 / d
        finite = np.isfinite(size)
        r = np.where(finite, np.minimum(size, self.reach), self.reach)
        good = math.log1p(-self.share) - d / 2 * np.log(2 * np.pi * s**2) - 0.5 * (r / s) ** 2
        gross = math.log(self.share) - np.log(sphere * span) - d * np.log(np.maximum(r, s))
        return np.where(finite, good, -np.inf), gross

    def good(self, size: Array, sigma: Array | float | None = None) -> Array:
        """Return the probability that each misfit is that of a good observation, with `sigma` of its own."""
        good, gross = self._logarithms(size, sigma)
        return np.asarray(scipy.special.expit(good - gross), dtype=np.float64)

    def evidence(self, size: Array, sigma: Array | None = None) -> Array:
        """Return by how much each misfit is better explained than by a place anywhere (logarithm)."""
        d = self.components
        ball = np.pi ** (d / 2) / math.gamma(d / 2 + 1) * self.reach**d
        return np.asarray(np.logaddexp(*self._logarithms(size, sigma)) + math.log(ball), dtype=np.float64)

    @property
    def price(self) -> float:
        """Evidence that one free parameter costs: the part of its range that the good misfits leave."""
        return float(self.prices(np.array(self.sigma)))

    def prices(self, sigma: Array) -> Array:
        """Return the same with other standard deviations."""
        return np.asarray(np.log(np.maximum(self.reach / sigma, 1.0)), dtype=np.float64)

    def fitted(self, size: Array, freedom: float = 1.0, least: float = 0.0) -> Mixture:
        """Return the estimates from misfits, beginning with these.

        Parameters
        ----------
        size : ndarray
            Sizes of the misfits; those that are not finite are gross errors.
        freedom : float
            Redundancy of the good misfits in their number of components: unknowns were fitted to them.
        least : float
            Smallest standard deviation.
        """
        found, known = self, np.where(np.isfinite(size), size, 0.0)
        if not len(size):
            return found
        for _ in range(_ROUNDS):
            good = found.good(size)
            count = float(good.sum())
            if count <= 0:
                return found
            square = float(good @ known**2) / (self.components * count * max(freedom, 0.1))
            sigma = min(max(np.sqrt(square), least, 1e-9 * self.reach), self.reach)
            share = (len(size) - count + 0.5) / (len(size) + 1.0)
            settled = abs(sigma / found.sigma - 1) < _SETTLED
            found = replace(found, sigma=float(sigma), share=float(share))
            if settled:
                break
        return found

    def at_best(self, size: Array, sigmas: Array, parameters: int) -> tuple[Array, Array]:
        """Return the largest evidence of the misfits (…, k) of trials, and with which standard deviations.

        `parameters` have been chosen by the misfits of each trial.
        """
        each = sigmas.reshape(-1, *[1] * size.ndim)
        sums = self.evidence(size, each).sum(axis=-1) - parameters * self.prices(each[..., 0])
        best = np.argmax(sums, axis=0)
        return np.take_along_axis(sums, best[None], axis=0)[0], sigmas[best]

    def gross(self, size: Array, sigma: Array | None = None) -> Mask:
        """Whether each misfit is more probably a gross error."""
        return np.asarray(self.good(size, sigma) < 0.5)
