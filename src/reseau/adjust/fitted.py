"""What all adjustments have in common, whatever solved them: residuals, reliability, tests.

An adjustment of some hundred unknowns keeps its design and its cofactor matrix (:class:`Adjustment`); one of
a hundred thousand keeps the structure of its normal equations instead. The statistics ask of either no more
than the cofactors of the adjusted observations, block by block.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Failure
from ..core.threads import one_thread
from .engine import Options
from .reliability import Standardised, Whitened, noncentrality
from .significance import GlobalTest, NestedTest, global_test, nested_test
from .stochastic import Covariance

__all__ = ["Adjustable", "Fitted", "compare"]


class Fitted:
    """An adjustment that converged; truthy. What its attributes are is said in :class:`Adjustment`."""

    problem: Any
    sigma0: float
    redundancy: int
    cost: float
    residuals: Array
    iterations: int
    scale: str
    solution: Any

    def __bool__(self) -> bool:
        return True

    def required(self) -> Self:
        """The adjustment itself; see :meth:`Failure.required`."""
        return self

    @property
    def converged(self) -> bool:
        """True: what has not converged is a :class:`Failure`."""
        return True

    @property
    def _observed(self) -> Adjustable[Self]:
        problem: Adjustable[Self] = self.problem
        return problem

    @property
    def observed(self) -> int:
        """Number of observations, those left out too."""
        return int(self._observed.observations.size)

    @property
    def _whitened(self) -> Whitened:
        solution: Whitened = self.solution
        return solution

    @property
    def adjusted(self) -> Array:
        """Adjusted observations, observed + residuals."""
        adjusted: Array = self._observed.observations.astype(np.float64) + self.residuals
        return adjusted

    @property
    def rejected(self) -> Mask:
        """Which observations were left out."""
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
        """How much of each observation's error shows in its own residual; they sum to the redundancy."""
        return self._of_observations(self.standardised.redundancy_numbers)

    @property
    def prior_redundancy_numbers(self) -> Array:
        """Redundancy numbers of the observed parameters that are free."""
        return self.standardised.redundancy_numbers[self._observed.observations.size :]

    @property
    def weighted_squares(self) -> Array:
        """Each observation's part vᵢ (P v)ᵢ of vᵀPv; zero where it was left out."""
        weighted = self._of_observations(self._whitened.weighted_residuals())
        return np.where(self.rejected, 0.0, self.residuals * weighted)

    @property
    def w(self) -> Array:
        """Baarda's test value of each observation, N(0, 1) when the covariance is true."""
        return self._of_observations(self.standardised.w)

    @property
    def prior_w(self) -> Array:
        """Baarda's test value of the observed parameters that are free."""
        return self.standardised.w[self._observed.observations.size :]

    @property
    def tau(self) -> Array:
        """Pope's test value of each observation, w over the estimated sigma0."""
        return self.w / self.sigma0

    def minimal_detectable_errors(self, alpha: float = 0.001, power: float = 0.8) -> Array:
        """Errors of single observations that the w-test finds with the given power (Baarda 1968).

        Parameters
        ----------
        alpha : float
            Level of the two-sided test.
        power : float
            Probability of finding the error.

        Returns
        -------
        ndarray
            In the units of the observations, of their shape; infinite where nothing controls one. For a
            variance factor of one.
        """
        return self._of_observations(noncentrality(alpha, power) * self.standardised.unit_error)

    def external_lengths(self, alpha: float = 0.001, power: float = 0.8) -> Array:
        """What an undetected error does to the parameters, at most, in their standard deviations.

        Baarda's λ̄, its root: no function of the parameters changes by more than this many of its standard
        deviations by an error of the minimal detectable size; see :class:`ExternalReliability`.

        Parameters
        ----------
        alpha, power : float
            As of :meth:`minimal_detectable_errors`.

        Returns
        -------
        ndarray
            Of the observations' shape; NaN where nothing controls one.
        """
        with np.errstate(invalid="ignore"):
            lengths = np.sqrt(np.maximum(self._whitened.diagonal_hats(), 0.0)) * self.standardised.unit_error
        return self._of_observations(noncentrality(alpha, power) * lengths)

    def global_test(self, alpha: float = 0.05) -> GlobalTest:
        """Two-sided χ² test of the variance factor against one (Koch 1999, ch. 4)."""
        return global_test(self.cost, self.redundancy, alpha)


def compare(nested: Fitted, full: Fitted, alpha: float = 0.05, scale: str | None = None) -> NestedTest:
    """Whether a model with fewer parameters (or more constraints) does as well as the wider one.

    Parameters
    ----------
    nested, full : Adjustment, or any other fit
        Of the same observations with the same covariance, `nested` a special case of `full`.
    alpha : float
        Level.
    scale : {"a-posteriori", "a-priori"}, optional
        F or χ²; that of `full` by default.

    Returns
    -------
    NestedTest
        F test of the increase of vᵀPv, or χ² test when the sigmas are taken at their word.

    Raises
    ------
    UsageError
        When the redundancies or the numbers of observations show that they are not nested.

    Notes
    -----
    Koch (1999), *Parameter Estimation and Hypothesis Testing in Linear Models*, ch. 4; for non-linear
    models the likelihood ratio in the same form.
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
    """What robust estimation, rejection and variance components ask of a problem, however it is solved."""

    @property
    def observations(self) -> NDArray[Any]:
        """What was observed, in any shape."""

    @property
    def covariance(self) -> Covariance:
        """Its covariance, as in :class:`GaussMarkov`."""

    @property
    def weights(self) -> Array | None:
        """Factors on the weights, of the observations' shape; zero leaves one out."""

    @property
    def marks(self) -> NDArray[np.intp] | None:
        """Numbers alike for observations that leave together, of their shape; None where each is alone."""

    def with_weights(self, weights: ArrayLike | None) -> Self:
        """The same problem with other factors on the weights of the observations."""

    def continued(self, fit: F) -> Self:
        """The same problem, to be begun at the estimates of an adjustment of it."""

    def adjusted(self, options: Options | None = None) -> F | Failure:
        """Adjust it."""
