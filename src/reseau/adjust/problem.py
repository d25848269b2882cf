"""What is to be adjusted: the Gauss–Markov and the Gauss–Helmert problem."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array
from ..core.errors import UsageError
from .parameters import Constraint, Parameters
from .stochastic import Covariance, blocks_of

if TYPE_CHECKING:
    from ..core.failure import Failure
    from .engine import Options
    from .result import Adjustment

__all__ = ["GaussHelmert", "GaussMarkov", "Problem"]

Values = NDArray[Any]
Function = Callable[[Values], Any]
Jacobian = Callable[[Array], Any]
Conditions = Callable[[Array, Array], Any]
Jacobians = Callable[[Array, Array], tuple[Any, Any]]


class _Common:
    """What both kinds of problem hold, and how they are changed."""

    observations: Values
    covariance: Covariance
    parameters: Parameters
    constraints: tuple[Constraint, ...]
    datum: tuple[str, ...]
    weights: Array | None

    def _check(self) -> None:
        known = set(self.parameters.names)
        named = [name for c in self.constraints for name in c.coefficients] + list(self.datum)
        unknown = [name for name in named if name not in known]
        if unknown:
            raise UsageError("is not among the parameters", where=", ".join(unknown[:5]))
        if self.weights is not None:
            weights = np.asarray(self.weights, dtype=np.float64)
            if weights.shape != self.observations.shape or not (weights >= 0).all():
                raise UsageError(f"must be {self.observations.shape} and not negative", where="weights")
            # Denormal factors would overflow in the covariance; they say zero.
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
        """The same problem, to be begun at the estimates of an adjustment of it.

        Inner constraints refer to the approximate values, which therefore stay.
        """
        return self if self.datum else self.with_parameters(fit.parameters)

    def adjusted(self, options: Options | None = None) -> Adjustment | Failure:
        """Adjust it; see :func:`adjust`."""
        from .engine import adjust

        return adjust(self, options)  # type: ignore[arg-type]

    @property
    def marks(self) -> NDArray[np.intp] | None:
        """Numbers alike for observations that leave together; None where each is alone."""
        return None


@dataclass(frozen=True, eq=False)
class GaussMarkov(_Common):
    """Observations as functions of parameters: l + v = f(x).

    Parameters
    ----------
    function : callable
        `function(x)` with x (u,), all parameters in the order of their names, gives the computed
        observations, of the observations' shape.
    observations : array_like
        n observations in any shape. Where they are of an extended type (``numpy.longdouble``, or
        ``decimal.Decimal`` in an array of objects) the parameters are carried in it too and `function` is
        given them so: the corrections are found in double precision, the residuals formed in the wider one.
    covariance : array_like, optional
        Of the observations: standard deviations of their shape (or one for all), a full matrix (n, n), blocks
        (m, k, k) with m·k = n, or a list of ndarrays of these kinds, one after the other. Ones by default.
    parameters : Parameters
        Names, approximate values, which are free, and what was observed of them.
    jacobian : callable, optional
        `jacobian(x)` with x (u,) in double precision gives the derivatives, the observations' shape + (u,).
        By default differences of `function`, good for some ten digits.
    constraints : sequence of Constraint
        Linear conditions between parameters, held exactly.
    datum : sequence of str
        Names over which the norm of the corrections is least among all solutions, where the observations
        leave a datum defect (inner constraints).
    weights : array_like, optional
        Factors on the weights, of the observations' shape: zero leaves an observation out.

    Raises
    ------
    UsageError
        When these do not belong together.

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
    constraints: tuple[Constraint, ...] = ()
    datum: tuple[str, ...] = ()
    weights: Array | None = None

    def __post_init__(self) -> None:
        _tidy(self)
        self._check()


@dataclass(frozen=True, eq=False)
class GaussHelmert(_Common):
    """Conditions between observations and parameters: g(l + v, x) = 0.

    Parameters
    ----------
    conditions : callable
        `conditions(l, x)` with l of the observations' shape and x (u,), all parameters. Of observations (n,)
        it gives the conditions (r,). Of observations (m, k), m marks of k coordinates, it gives (m, c): c
        conditions for each mark in which no other mark takes part. Then nothing of the size (n, n) is formed.
    observations : array_like (n,) or (m, k)
        What was observed.
    covariance : array_like, optional
        As in :class:`GaussMarkov`.
    parameters : Parameters
        Names, approximate values, which are free, and what was observed of them.
    jacobians : callable, optional
        `jacobians(l, x)` gives A = ∂g/∂x and B = ∂g/∂l: (r, u) and (r, n), or (m, c, u) and (m, c, k). By
        default differences of `conditions`.
    constraints, datum, weights
        As in :class:`GaussMarkov`; among marks an observation of weight zero takes its whole mark out.

    Raises
    ------
    UsageError
        When these do not belong together.
    """

    conditions: Conditions
    observations: Array
    covariance: Covariance
    parameters: Parameters
    jacobians: Jacobians | None = None
    constraints: tuple[Constraint, ...] = ()
    datum: tuple[str, ...] = ()
    weights: Array | None = None

    def __post_init__(self) -> None:
        _tidy(self)
        if self.observations.ndim not in (1, 2) or self.observations.dtype != np.float64:
            raise UsageError("observations must be numbers (n,) or (m, k)", where="GaussHelmert")
        self._check()

    @property
    def marks(self) -> NDArray[np.intp] | None:
        """Numbers of the marks, where each has conditions and a covariance of its own."""
        if self.observations.ndim != 2:
            return None
        m, k = self.observations.shape
        blocks = blocks_of(self.covariance, self.observations.shape)
        if not all(part.shape[1] in (1, k) for part in blocks):
            return None
        return np.broadcast_to(np.arange(m)[:, None], (m, k))


def _tidy(problem: _Common) -> None:
    observed = np.asarray(problem.observations)
    # Only types wider than double precision are kept as they are.
    if observed.dtype != np.longdouble and observed.dtype != object:
        observed = np.array(observed, dtype=np.float64)
    if not np.isfinite(observed.astype(np.float64)).all():
        raise UsageError(
            "are not finite", where="observations", do="give those missing any value and weight 0"
        )
    object.__setattr__(problem, "observations", observed)
    constraints: Iterable[Constraint] = problem.constraints or ()
    object.__setattr__(problem, "constraints", tuple(constraints))
    object.__setattr__(problem, "datum", tuple(problem.datum or ()))


Problem = GaussMarkov | GaussHelmert
