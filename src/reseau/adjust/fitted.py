"""Common part of all adjustments, dense or sparse: residuals, reliability, tests.

A dense adjustment keeps its design and its cofactor matrix (:class:`~reseau.adjust.Adjustment`); a bundle
adjustment keeps the structure of its normal equations instead. The statistics need only the cofactors of the
adjusted observations, block by block.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Estimated, Failure
from ..core.threads import one_thread
from .engine import Options
from .reliability import Standardised, Whitened, noncentrality
from .significance import GlobalTest, NestedTest, global_test, nested_test
from .stochastic import Covariance


class Fitted(Estimated):
    """An adjustment that converged; truthy. For its attributes see :class:`~reseau.adjust.Adjustment`."""

    problem: Any
    sigma0: float
    redundancy: int
    cost: float
    residuals: Array
    iterations: int
    scale: str
    solution: Any

    @property
    def converged(self) -> bool:
        """True; an adjustment that has not converged is a failure."""
        return True

    @property
    def _observed(self) -> Adjustable[Self]:
        problem: Adjustable[Self] = self.problem
        return problem

    @property
    def observed(self) -> int:
        """Number of observations, including those with weight zero."""
        return int(self._observed.observations.size)

    @property
    def _whitened(self) -> Whitened:
        solution: Whitened = self.solution
        return solution

    @property
    def adjusted(self) -> Array:
        """Adjusted observations, observed + residuals."""
        return self._observed.observations.astype(np.float64) + self.residuals

    @property
    def rejected(self) -> Mask:
        """Observations with weight zero."""
        if self._observed.weights is None:
            return np.zeros(self._observed.observations.shape, dtype=bool)
        return np.asarray(self._observed.weights == 0)

    @cached_property
    def standardised(self) -> Standardised:
        """Redundancy numbers and test values of observations and then of observed parameters, flat."""
        with one_thread():
            return self._whitened.standardise()

    def _of_observations(self, flat: Array) -> Array:
        shape = self._observed.observations.shape
        return flat[: self._observed.observations.size].reshape(*shape, *flat.shape[1:])

    @property
    def redundancy_numbers(self) -> Array:
        """Fraction of each observation's error that shows in its own residual; the sum is the redundancy."""
        return self._of_observations(self.standardised.redundancy_numbers)

    @property
    def weighted_squares(self) -> Array:
        """Contribution vᵢ (P v)ᵢ of each observation to vᵀPv; zero where its weight is zero."""
        weighted = self._of_observations(self._whitened.weighted_residuals())
        return np.where(self.rejected, 0.0, self.residuals * weighted)

    @property
    def w(self) -> Array:
        """Baarda's test value of each observation, N(0, 1) when the input covariance is correct."""
        return self._of_observations(self.standardised.w)

    @property
    def tau(self) -> Array:
        """Pope's test value of each observation, w over the estimated sigma0."""
        return self.w / self.sigma0

    def minimal_detectable_errors(self, alpha: float = 0.001, power: float = 0.8) -> Array:
        """Errors of single observations that the w-test detects with the given power (Baarda 1968).

        Parameters
        ----------
        alpha : float
            Level of the two-sided test.
        power : float
            Probability of detecting the error.

        Returns
        -------
        ndarray
            In the units and the shape of the observations, for a variance factor of one; infinite for
            observations that no other observation controls.
        """
        return self._of_observations(noncentrality(alpha, power) * self.standardised.unit_error)

    def external_lengths(self, alpha: float = 0.001, power: float = 0.8) -> Array:
        """Maximum effect of an undetected error on the parameters, in their standard deviations.

        The square root of Baarda's λ̄: an error of the minimal detectable size changes no function of the
        parameters by more than this number of its standard deviations.

        Parameters
        ----------
        alpha, power : float
            As of :meth:`minimal_detectable_errors`.

        Returns
        -------
        ndarray
            Of the observations' shape; NaN where no other observation controls one.
        """
        with np.errstate(invalid="ignore"):
            lengths = np.sqrt(np.maximum(self._whitened.diagonal_hats(), 0.0)) * self.standardised.unit_error
        return self._of_observations(noncentrality(alpha, power) * lengths)

    def global_test(self, alpha: float = 0.05) -> GlobalTest:
        """Two-sided χ² test of the variance factor against one (Koch 1999, ch. 4)."""
        return global_test(self.cost, self.redundancy, alpha)


def compare(nested: Fitted, full: Fitted, alpha: float = 0.05, scale: str | None = None) -> NestedTest:
    """Test a model with fewer parameters against a wider one.

    Parameters
    ----------
    nested, full : Adjustment, or any other fit
        Adjustments of the same observations with the same covariance; `nested` is a special case of `full`.
    alpha : float
        Level.
    scale : {"a-posteriori", "a-priori"}, optional
        F or χ²; that of `full` by default.

    Returns
    -------
    NestedTest
        F test of the increase of vᵀPv, or χ² test with the input sigmas.

    Raises
    ------
    UsageError
        When the redundancies or the numbers of observations show that they are not nested.

    Notes
    -----
    Koch (1999), *Parameter Estimation and Hypothesis Testing in Linear Models*, ch. 4; for non-linear
    models the likelihood ratio in the same form.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters, adjust
    >>> t, both = np.arange(6.0), Parameters("ab", [0.0, 0.0])
    >>> y = [0.1, 0.9, 2.1, 2.9, 4.1, 4.9]
    >>> line = GaussMarkov(lambda x: x[0] + x[1] * t, y, 0.1, both)
    >>> level = line.with_parameters(both.fix("b"))
    >>> compare(adjust(level).required(), adjust(line).required()).significant
    True
    """
    restrictions = nested.redundancy - full.redundancy
    if restrictions < 1 or nested.observed != full.observed:
        raise UsageError(
            f"redundancies {nested.redundancy} and {full.redundancy} are not of a model within another",
            where="compare",
        )
    increase = max(nested.cost - full.cost, 0.0)
    cost = None if (scale or full.scale) == "a-priori" else full.cost
    return nested_test(increase, restrictions, cost, full.redundancy, alpha)


F = TypeVar("F", bound=Fitted)


class Adjustable(Protocol[F]):
    """Interface of a problem for robust estimation, data snooping and variance components."""

    @property
    def observations(self) -> NDArray[Any]:
        """Observations, in any shape."""

    @property
    def covariance(self) -> Covariance:
        """Covariance of the observations, as in :class:`GaussMarkov`."""

    @property
    def weights(self) -> Array | None:
        """Factors on the weights, of the observations' shape; zero leaves an observation out."""

    @property
    def marks(self) -> NDArray[np.intp] | None:
        """Mark number of each observation; a mark is rejected as a whole. None: each observation is alone."""

    def with_weights(self, weights: ArrayLike | None) -> Self:
        """The same problem with other factors on the weights of the observations."""

    def continued(self, fit: F) -> Self:
        """The same problem, starting at the estimates of an adjustment."""

    def adjusted(self, options: Options | None = None) -> F | Failure:
        """Adjust it."""
