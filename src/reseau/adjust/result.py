"""What comes out of an adjustment: estimates with all that is known of their quality, or the reason."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from ..core.errors import UsageError
from ..core.failure import Failure
from .fitted import Fitted, NullVector
from .parameters import Parameters
from .problem import Problem
from .reliability import ExternalReliability, Solution, noncentrality
from .significance import CoefficientTest, coefficient_test

if TYPE_CHECKING:
    from .engine import Options
from ..core.threads import one_thread

__all__ = ["Adjustment", "Failure", "NullVector", "Solution"]


@dataclass(frozen=True, eq=False)
class Adjustment(Fitted):
    """An adjustment that converged; truthy.

    What stands in columns over the observations has their shape: residuals, redundancy numbers, test values.
    Of observed parameters the same is in the attributes beginning with `prior_`. For observations left out
    (weight zero), and those no other observation controls, test values are NaN.

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
        What was adjusted.
    names : tuple of str (u,)
        Names of all parameters.
    exact_values : ndarray (u,)
        Estimates in the arithmetic of the observations; see `values`.
    cofactor : ndarray (u, u)
        Q of the parameters, their covariance at a variance factor of one; zero for fixed ones.
    sigma0 : float
        Standard deviation of unit weight a posteriori, √(vᵀPv / redundancy); NaN without redundancy.
    redundancy : int
        Observations, observed parameters and constraints less free parameters (plus the datum defect).
    cost : float
        vᵀPv, that of the observed parameters included.
    residuals : ndarray
        v = adjusted − observed.
    scale : {"a-posteriori", "a-priori"}
        What `covariance` and `sigma` are scaled with.
    iterations : int
        Corrections tried.
    costs : tuple of float
        vᵀPv at the approximate values and after each correction taken.
    datum_defect : int
        Rank defect that inner constraints made good.
    options : Options
        How it was adjusted.
    solution : Solution
        The linearised problem at the estimates, of which the reliability is made.
    """

    problem: Problem
    names: tuple[str, ...]
    exact_values: NDArray[Any]
    cofactor: Array
    sigma0: float
    redundancy: int
    cost: float
    residuals: Array
    scale: str
    iterations: int
    costs: tuple[float, ...]
    datum_defect: int
    options: Options
    solution: Solution

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.index(name)])

    def index(self, name: str) -> int:
        """Where a parameter stands; raises UsageError when there is none of this name."""
        return self.problem.parameters.index(name)

    @cached_property
    def values(self) -> Array:
        """Estimates of all parameters, (u,)."""
        return np.asarray(self.exact_values, dtype=np.float64)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return self.problem.parameters.free

    @property
    def estimates(self) -> dict[str, float]:
        """All parameters by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def parameters(self) -> Parameters:
        """The problem's parameters at their estimates."""
        return self.problem.parameters.with_values(self.values)

    def covariance_of(self, *names: str, scaled: bool | None = None) -> Array:
        """Covariance of some parameters, or of all.

        Parameters
        ----------
        *names : str
            Which; all, fixed ones included, when none is given.
        scaled : bool, optional
            Whether multiplied with the variance factor a posteriori; as `scale` says by default.

        Raises
        ------
        UsageError
            For unknown names, and for `scaled` without redundancy.
        """
        scaled = self.scale == "a-posteriori" if scaled is None else scaled
        if scaled and not self.redundancy > 0:
            raise UsageError(
                "no variance factor without redundancy", where="covariance", do="use scaled=False"
            )
        at = [self.index(name) for name in names] if names else list(range(len(self.names)))
        cofactor = self.cofactor[np.ix_(at, at)]
        return cofactor * self.sigma0**2 if scaled else cofactor

    @property
    def covariance(self) -> Array:
        """Covariance of all parameters (u, u), scaled as `scale` says."""
        return self.covariance_of()

    @property
    def sigma(self) -> Array:
        """Standard deviations of all parameters (u,), scaled as `scale` says; zero for fixed ones."""
        sigma: Array = np.sqrt(np.diag(self.covariance))
        return sigma

    def sigma_of(self, name: str) -> float:
        """Standard deviation of one parameter, scaled as `scale` says."""
        return float(self.sigma[self.index(name)])

    @cached_property
    def correlation(self) -> Array:
        """Correlations of all parameters (u, u); zero with fixed ones."""
        sigma = np.sqrt(np.diag(self.cofactor))
        known = sigma > 0
        scale = np.where(known, 1.0 / np.where(known, sigma, 1.0), 0.0)
        correlation: Array = self.cofactor * np.outer(scale, scale)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    def external_reliability(self, alpha: float = 0.001, power: float = 0.8) -> ExternalReliability:
        """What an undetected error as large as the minimal detectable one does to the parameters.

        Parameters
        ----------
        alpha, power : float
            As of :meth:`minimal_detectable_errors`.

        Returns
        -------
        ExternalReliability
            Effects by observation.
        """
        with one_thread():
            effects, lengths = self.solution.effects(self.standardised, noncentrality(alpha, power))
        full = np.zeros((len(effects), len(self.names)))
        full[:, self.problem.parameters.mask] = effects
        return ExternalReliability(self.names, self._of_observations(full), self._of_observations(lengths))

    def test_of(self, name: str, value: float = 0.0, alpha: float = 0.05) -> CoefficientTest:
        """Test one parameter against a value: Student's t a posteriori, χ² a priori, as `scale` says."""
        return coefficient_test(self, name, value, alpha)
