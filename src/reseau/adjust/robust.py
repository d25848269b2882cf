"""Robust weights: functions of the residuals, and adjustment by iterated reweighting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal

import numpy as np

from ..core.data import Array
from ..core.errors import UsageError
from ..core.failure import Code, Failure
from .engine import Options
from .fitted import Adjustable, F
from .rounds import Rounds

__all__ = ["Robust", "robust", "weight_function"]

WeightName = Literal["huber", "tukey", "danish"]
_TUNING = {"huber": 1.345, "tukey": 4.685, "danish": 2.0}


@dataclass(frozen=True, eq=False)
class Robust(Generic[F]):
    """An adjustment with robust weights; truthy.

    Parameters
    ----------
    adjustment : Adjustment
        With the last weights; its covariance takes them as given, and so is somewhat too small.
    factors : ndarray
        Factors on the weights, of the observations' shape.
    scale : float
        Robust standard deviation of unit weight that residuals were measured with.
    iterations : int
        Adjustments needed.
    """

    adjustment: F
    factors: Array
    scale: float
    iterations: int

    def __bool__(self) -> bool:
        return True

    def required(self) -> Robust[F]:
        """The robust adjustment itself; see :meth:`Failure.required`."""
        return self


def weight_function(name: WeightName, tuning: float | None = None) -> Callable[[Array], Array]:
    """A robust weight function of standardised residuals.

    Parameters
    ----------
    name : {"huber", "tukey", "danish"}
        min(1, k/|t|) (Huber 1964, k = 1.345); (1 − (t/k)²)² within k and zero beyond (Beaton & Tukey 1974,
        k = 4.685); one within k and exp(1 − (t/k)²) beyond (after Krarup, Juhl & Kubik 1980, k = 2). The
        first two constants keep 95 % efficiency for normal errors.
    tuning : float, optional
        k.

    Returns
    -------
    callable
        Of t, an array, gives factors in [0, 1] of its shape.

    Raises
    ------
    UsageError
        For an unknown name or a k that is not above zero.

    Examples
    --------
    >>> weight_function("huber", 2.0)(np.array([-1.0, 4.0]))
    array([1. , 0.5])
    """
    if name not in _TUNING:
        raise UsageError(f"is no weight function: {name!r}", where="weight_function")
    k = _TUNING[name] if tuning is None else tuning
    if not k > 0:
        raise UsageError("must be above zero", where="tuning")

    def huber(t: Array) -> Array:
        return np.minimum(1.0, k / np.maximum(np.abs(t), k))

    def tukey(t: Array) -> Array:
        within: Array = 1.0 - np.minimum(np.abs(t) / k, 1.0) ** 2
        return within**2

    def danish(t: Array) -> Array:
        # Beyond 6 k the weight of 6e-16 is no weight.
        size = np.abs(t) / k
        return np.where(size < 6.0, np.exp(1.0 - np.clip(size, 1.0, 6.0) ** 2), 0.0)

    return {"huber": huber, "tukey": tukey, "danish": danish}[name]


def robust(
    problem: Adjustable[F],
    weights: WeightName = "huber",
    tuning: float | None = None,
    scale: Literal["mad", "a-priori"] = "mad",
    max_iterations: int = 100,
    tolerance: float = 1e-4,
    options: Options | None = None,
) -> Robust[F] | Failure:
    """Adjust with weights that fall with the residuals, by iteration (Holland & Welsch 1977).

    Parameters
    ----------
    problem : GaussMarkov, GaussHelmert, or any Adjustable
        What is to be adjusted.
    weights : {"huber", "tukey", "danish"}
        See :func:`weight_function`. Those that have several minima begin at Huber's estimate.
    tuning : float, optional
        Constant of the weight function.
    scale : {"mad", "a-priori"}
        What residuals over their sigmas are measured with: the median of their absolute values, made
        consistent for normal errors, or one.
    max_iterations : int
        Adjustments at most.
    tolerance : float
        Greatest change of a factor at which they have settled.
    options : Options, optional
        How to adjust.

    Returns
    -------
    Robust or Failure
        Of conditions between the coordinates of marks each mark has one factor.

    Raises
    ------
    UsageError
        For an unknown weight function.
    """
    if scale not in ("mad", "a-priori"):
        raise UsageError(f"is no scale: {scale!r}", where="robust")
    stages: list[WeightName] = ["huber"] if weights == "huber" else ["huber", weights]
    runs, unit, total = Rounds(problem, options), 1.0, 0
    factors = np.ones(problem.observations.shape)
    fit: F | Failure = Failure("no adjustment was asked for", Code.PREREQUISITE_MISSING)
    for stage in stages:
        function = weight_function(stage, tuning if stage == weights else None)
        for _ in range(max_iterations):
            total += 1
            fit = runs.adjust(factors == 0, factors)
            if isinstance(fit, Failure):
                return fit
            t = runs.standardised(fit)
            if scale == "mad":
                unit = max(float(np.median(t[runs.eligible])) / runs.median, np.finfo(float).tiny)
            fresh = function(t / unit)
            change, factors = float(np.abs(fresh - factors)[runs.eligible].max()), fresh
            if change < tolerance:
                break
        else:
            return Failure(
                f"the robust weights have not settled in {max_iterations} adjustments", Code.NOT_CONVERGED
            )
    return fit if isinstance(fit, Failure) else Robust(fit, factors, unit, total)
