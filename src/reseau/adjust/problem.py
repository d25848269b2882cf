"""The Gauss–Markov and the Gauss–Helmert problem, and their adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array
from ..core.errors import UsageError
from ..core.threads import one_thread
from .engine import AdjustmentFailure, Options, solve
from .fitted import Fitted
from .models import Conditions, Function, HelmertModel, Jacobian, Jacobians, MarkovModel, Model, Values
from .parameters import Parameters
from .reliability import Solution
from .significance import CoefficientTest, ratio_test
from .stochastic import Covariance, blocks_of


class Problem:
    """Common part of both kinds of problem.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> mean = GaussMarkov(lambda x: np.repeat(x, 4), [1.0, 3.0, 2.0, 8.0], 1.0, Parameters("m", [0.0]))
    >>> isinstance(mean, Problem), mean.size
    (True, 4)
    >>> round(mean.with_weights([1, 1, 1, 0]).adjusted().required()["m"], 6)
    2.0
    """

    observations: Values
    covariance: Covariance
    parameters: Parameters
    weights: Array | None

    def _check(self) -> None:
        if self.weights is not None:
            weights = np.asarray(self.weights, dtype=np.float64)
            if weights.shape != self.observations.shape or not (weights >= 0).all():
                raise UsageError(f"must be {self.observations.shape} and not negative", where="weights")
            # Denormal factors would overflow in the covariance; treat them as zero.
            object.__setattr__(self, "weights", np.where(weights < 1e-200, 0.0, weights))
        blocks_of(self.covariance, self.observations.shape)

    @property
    def size(self) -> int:
        """Number of observations."""
        return int(self.observations.size)

    def with_parameters(self, parameters: Parameters) -> Self:
        """The same problem with other parameters (values, or which of them are free)."""
        return replace(self, parameters=parameters)  # type: ignore[type-var]

    def with_weights(self, weights: ArrayLike | None) -> Self:
        """The same problem with other factors on the weights of the observations."""
        return replace(self, weights=weights)  # type: ignore[type-var]

    def continued(self, fit: Adjustment) -> Self:
        """The same problem, starting at the estimates of an adjustment."""
        return self.with_parameters(fit.parameters)

    def model(self) -> Model:
        """The problem in the form that the engine iterates on."""
        raise NotImplementedError

    def adjusted(self, options: Options | None = None) -> Adjustment | AdjustmentFailure:
        """Adjust it; see :func:`adjust`."""
        return adjust(self, options)

    @property
    def marks(self) -> NDArray[np.intp] | None:
        """Mark number of each observation; a mark is rejected as a whole. None: each observation is alone."""
        return None


@dataclass(frozen=True, eq=False)
class GaussMarkov(Problem):
    """Observations as functions of parameters: l + v = f(x).

    Parameters
    ----------
    function : callable
        `function(x)` with x (u,), all parameters in the order of their names, gives the computed
        observations, of the observations' shape.
    observations : array_like
        n observations in any shape. Where they are of an extended type (``numpy.longdouble``, or
        ``decimal.Decimal`` in an array of objects) the parameters have this type too when `function` is
        called: corrections are computed in double precision, residuals in the extended one.
    covariance : array_like, optional
        Of the observations: standard deviations of their shape (or one for all), a full matrix (n, n), blocks
        (m, k, k) with m·k = n, or a list of ndarrays of these kinds, one after the other. Ones by default.
    parameters : Parameters
        Names, approximate values, which are free, and what was observed of them.
    jacobian : callable, optional
        `jacobian(x)` with x (u,) in double precision gives the derivatives, the observations' shape + (u,).
        By default differences of `function`, accurate to about ten digits.
    weights : array_like, optional
        Factors on the weights, of the observations' shape: zero leaves an observation out.

    Raises
    ------
    UsageError
        When shapes or names disagree.

    Examples
    --------
    >>> from reseau.adjust import adjust
    >>> t = np.arange(4.0)
    >>> line = GaussMarkov(lambda x: x[0] + x[1] * t, [1.1, 2.9, 5.1, 6.9], 0.1, Parameters("ab", [0, 0]))
    >>> fit = adjust(line).required()
    >>> round(fit["b"], 6), round(fit.sigma_of("b"), 6)
    (1.96, 0.056569)
    """

    function: Function
    observations: Values
    covariance: Covariance
    parameters: Parameters
    jacobian: Jacobian | None = None
    weights: Array | None = None

    def __post_init__(self) -> None:
        _tidy(self)
        self._check()

    def model(self) -> Model:
        """The problem in the form that the engine iterates on."""
        return MarkovModel(self, self.function, self.jacobian)


@dataclass(frozen=True, eq=False)
class GaussHelmert(Problem):
    """Conditions between observations and parameters: g(l + v, x) = 0.

    Parameters
    ----------
    conditions : callable
        `conditions(l, x)` with l (m, k) and x (u,), all parameters: (m, c), c conditions for each of m marks
        of k coordinates, independent of the other marks. So no matrix of the size (n, n) is formed.
    observations : array_like (m, k)
        Observations.
    covariance : array_like, optional
        As in :class:`GaussMarkov`, in which no block reaches from one mark into another.
    parameters : Parameters
        Names, approximate values, which are free, and what was observed of them.
    jacobians : callable
        `jacobians(l, x)` gives A = ∂g/∂x (m, c, u) and B = ∂g/∂l (m, c, k).
    weights
        As in :class:`GaussMarkov`; weight zero of one observation leaves its whole mark out.

    Raises
    ------
    UsageError
        When shapes or names disagree.

    Examples
    --------
    A straight line y = a + b x through points with errors in both coordinates:

    >>> xy = np.array([[0.0, 1.1], [1.0, 2.9], [2.0, 5.1], [3.0, 6.9]])
    >>> conditions = lambda l, x: (x[0] + x[1] * l[:, 0] - l[:, 1])[:, None]
    >>> def jacobians(l, x):
    ...     a = np.stack([np.ones(len(l)), l[:, 0]], axis=1)
    ...     return a[:, None], np.tile([x[1], -1.0], (len(l), 1, 1))
    >>> line = GaussHelmert(conditions, xy, 0.1, Parameters("ab", [0.0, 1.0]), jacobians)
    >>> round(line.adjusted().required()["b"], 3)
    1.963
    """

    conditions: Conditions
    observations: Array
    covariance: Covariance
    parameters: Parameters
    jacobians: Jacobians
    weights: Array | None = None

    def __post_init__(self) -> None:
        _tidy(self)
        if self.observations.ndim != 2 or self.observations.dtype != np.float64:
            raise UsageError("observations must be numbers (m, k)", where="GaussHelmert")
        self._check()

    def model(self) -> Model:
        """The problem in the form that the engine iterates on."""
        return HelmertModel(self, self.conditions, self.jacobians)

    @property
    def marks(self) -> NDArray[np.intp] | None:
        """Numbers of the marks, where each has conditions and a covariance of its own."""
        m, k = self.observations.shape
        return np.broadcast_to(np.arange(m)[:, None], (m, k))


def _tidy(problem: Problem) -> None:
    observed = np.asarray(problem.observations)
    # Only types wider than double precision are kept as they are.
    if observed.dtype != np.longdouble and observed.dtype != object:
        observed = np.array(observed, dtype=np.float64)
    if not np.isfinite(observed.astype(np.float64)).all():
        raise UsageError(
            "are not finite", where="observations", do="give missing ones any value and weight 0"
        )
    object.__setattr__(problem, "observations", observed)


@dataclass(frozen=True, eq=False)
class Adjustment(Fitted):
    """An adjustment that converged; truthy.

    Residuals, redundancy numbers and test values have the shape of the observations. The same quantities of
    prior observations of parameters are in attributes beginning with `prior_`. Test values are NaN for
    observations with weight zero, and for those that no other observation controls.

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
        The adjusted problem.
    names : tuple of str (u,)
        Names of all parameters.
    exact_values : ndarray (u,)
        Estimates in the arithmetic of the observations; see `values`.
    cofactor : ndarray (u, u)
        Q of the parameters, their covariance at a variance factor of one; zero for fixed ones.
    sigma0 : float
        Standard deviation of unit weight a posteriori, √(vᵀPv / redundancy); NaN without redundancy.
    redundancy : int
        Observations and observed parameters less free parameters.
    cost : float
        vᵀPv, that of the observed parameters included.
    residuals : ndarray
        v = adjusted − observed.
    scale : {"a-posteriori", "a-priori"}
        What `covariance` and `sigma` are scaled with.
    iterations : int
        Number of corrections tried.
    costs : tuple of float
        vᵀPv at the approximate values and after each accepted correction.
    options : Options
        Options of the adjustment.
    solution : Solution
        The linearised problem at the estimates, from which the reliability is computed.

    Examples
    --------
    >>> t = np.arange(4.0)
    >>> line = GaussMarkov(lambda x: x[0] + x[1] * t, [1.1, 2.9, 5.1, 6.9], 0.1, Parameters("ab", [0, 0]))
    >>> fit = adjust(line).required()
    >>> fit.redundancy, round(fit.sigma0, 3), fit.values.round(3)
    (2, 1.265, array([1.06, 1.96]))
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
    options: Options
    solution: Solution

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.index(name)])

    def index(self, name: str) -> int:
        """Index of a parameter; raises UsageError for an unknown name."""
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
            Parameters; by default all, including fixed ones.
        scaled : bool, optional
            Whether to multiply by the variance factor a posteriori; by default according to `scale`.

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
        """Covariance of all parameters (u, u), scaled according to `scale`."""
        return self.covariance_of()

    @property
    def sigma(self) -> Array:
        """Standard deviations of all parameters (u,), scaled according to `scale`; zero for fixed ones."""
        return np.sqrt(np.diag(self.covariance))

    def sigma_of(self, name: str) -> float:
        """Standard deviation of one parameter, scaled according to `scale`."""
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

    def test_of(
        self, name: str, value: float = 0.0, alpha: float = 0.05, scale: str | None = None
    ) -> CoefficientTest:
        """Test one parameter against a value (Koch 1999, ch. 4).

        Parameters
        ----------
        name : str
            Parameter.
        value : float
            Value of the null hypothesis.
        alpha : float
            Level.
        scale : {"a-posteriori", "a-priori"}, optional
            Student's t with the estimated variance factor, or χ² with the input sigmas; that of the
            adjustment by default.

        Raises
        ------
        UsageError
            When the parameter was fixed or is unknown.
        """
        at = self.index(name)
        if name not in self.free or not self.cofactor[at, at] > 0:
            raise UsageError("was not estimated", where=name)
        ratio = (float(self.values[at]) - value) / float(np.sqrt(self.cofactor[at, at]))
        sigma0 = None if (scale or self.scale) == "a-priori" else self.sigma0
        return ratio_test(name, ratio, sigma0, self.redundancy, alpha)


def adjust(problem: Problem, options: Options | None = None) -> Adjustment | AdjustmentFailure:
    """Adjust a problem by least squares.

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
        Problem to adjust.
    options : Options, optional
        Options of the iteration.

    Returns
    -------
    Adjustment or AdjustmentFailure
        A failure is falsy and has a reason and a code; `.required()` returns the adjustment or raises.

    Raises
    ------
    UsageError
        When functions return arrays of a wrong shape, or an option cannot be honoured.

    Notes
    -----
    Derived in ``docs/mathematics/adjustment.md``.

    Minimises Ω = vᵀPv + (x−x₀)ᵀP₀(x−x₀) (Mikhail 1976; Förstner & Wrobel 2016, ch. 4).
    Damping after Nielsen (1999), IMM-REP-1999-05; convergence after Bates & Watts (1981),
    *Technometrics* 23, 179–183.

    Examples
    --------
    >>> t = np.arange(4.0)
    >>> decay = lambda x: x[0] * np.exp(-x[1] * t)
    >>> fit = adjust(GaussMarkov(decay, [2.0, 1.0, 0.5, 0.25], 0.01, Parameters("ab", [1.0, 1.0]))).required()
    >>> fit.values.round(6)
    array([2.      , 0.693147])
    """
    options = options or Options()
    with one_thread():
        found = solve(problem.model(), options)
    if isinstance(found, AdjustmentFailure):
        return found
    redundancy = found.redundancy
    return Adjustment(
        problem=problem,
        names=problem.parameters.names,
        exact_values=found.x,
        cofactor=found.cofactor,
        sigma0=float(np.sqrt(found.cost / redundancy)) if redundancy > 0 else float("nan"),
        redundancy=redundancy,
        cost=found.cost,
        residuals=found.residuals.reshape(problem.observations.shape),
        scale=options.scale if redundancy > 0 else "a-priori",
        iterations=found.iterations,
        costs=found.costs,
        options=options,
        solution=found.solution,
    )
