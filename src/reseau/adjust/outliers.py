"""Gross errors: robust weights, and data snooping.

Both assume that the model is correct. With a wrong model good observations look bad, and rejecting them hides
the error: therefore data snooping rejects at most a given part. Look at the global test first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Code, Estimated, Failure
from .engine import Options
from .fitted import Adjustable, F, Fitted
from .problem import GaussHelmert
from .reliability import critical_tau, critical_w
from .stochastic import Weighting, blocks_of

WeightName = Literal["huber", "tukey", "danish"]
TUNING = {"huber": 1.345, "tukey": 4.685, "danish": 2.0}
"""Constants of the weight functions."""


@dataclass(frozen=True, eq=False)
class Robust(Estimated, Generic[F]):
    """An adjustment with robust weights; truthy.

    Parameters
    ----------
    adjustment : Adjustment
        With the final weights. Its covariance regards them as constant and is therefore slightly too small.
    factors : ndarray
        Factors on the weights, of the observations' shape.
    scale : float
        Robust standard deviation of unit weight by which the residuals were divided.
    iterations : int
        Number of adjustments.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> y = [1.0, 1.1, 0.9, 1.0, 5.0]
    >>> mean = GaussMarkov(lambda x: np.repeat(x, 5), y, 0.1, Parameters("m", [0.0]))
    >>> found = robust(mean).required()
    >>> round(found.adjustment["m"], 2), int(found.factors.argmin())
    (1.03, 4)
    """

    adjustment: F
    factors: Array
    scale: float
    iterations: int


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
        Maps an array t to factors in [0, 1] of the same shape.

    Raises
    ------
    UsageError
        For an unknown name or a k that is not positive.

    Examples
    --------
    >>> weight_function("huber", 2.0)(np.array([-1.0, 4.0]))
    array([1. , 0.5])
    """
    if name not in TUNING:
        raise UsageError(f"is no weight function: {name!r}", where="weight_function")
    k = TUNING[name] if tuning is None else tuning
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
    """Adjust with weights that decrease with the residuals, iteratively (Holland & Welsch 1977).

    Parameters
    ----------
    problem : GaussMarkov, GaussHelmert, or any Adjustable
        Problem to adjust.
    weights : {"huber", "tukey", "danish"}
        See :func:`weight_function`. Tukey's and the Danish function have several minima and start at Huber's
        estimate.
    tuning : float, optional
        Constant of the weight function.
    scale : {"mad", "a-priori"}
        Unit of the standardised residuals: the median of their absolute values, made consistent for normal
        errors, or one.
    max_iterations : int
        Maximum number of adjustments with each weight function, at least 1.
    tolerance : float
        The weights have converged when no factor changes by more than this.
    options : Options, optional
        Options of each adjustment.

    Returns
    -------
    Robust or Failure
        For conditions between the coordinates of marks, each mark has one factor.

    Raises
    ------
    UsageError
        For an unknown weight function or scale, and for `max_iterations` below 1.

    Examples
    --------
    >>> import numpy as np
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> t, y = np.arange(6.0), [0.1, 0.9, 2.1, 9.0, 4.1, 4.9]
    >>> line = GaussMarkov(lambda x: x[0] + x[1] * t, y, 0.1, Parameters("ab", [0.0, 0.0]))
    >>> found = robust(line, "tukey").required()
    >>> found.factors.round(1).tolist()[3], round(found.adjustment["b"], 1)
    (0.0, 1.0)
    """
    if scale not in ("mad", "a-priori"):
        raise UsageError(f"is no scale: {scale!r}", where="robust")
    if max_iterations < 1:
        raise UsageError("must be at least 1", where="max_iterations")
    stages: list[WeightName] = ["huber"] if weights == "huber" else ["huber", weights]
    runs, unit, total = _Rounds(problem, options), 1.0, 0
    factors = np.ones(problem.observations.shape)
    for stage in stages:
        function = weight_function(stage, tuning if stage == weights else None)
        for _ in range(max_iterations):
            total += 1
            found = runs.adjust(factors == 0, factors)
            if isinstance(found, Failure):
                return found
            fit = found
            t = runs.standardised(fit)
            # The residual of an observation whose unknowns are not determined says nothing about it.
            known = np.isfinite(t)
            if scale == "mad":
                middle = float(np.median(t[runs.eligible & known])) if (runs.eligible & known).any() else 0.0
                unit = max(middle / runs.median, np.finfo(float).tiny)
            fresh = np.where(known, function(np.where(known, t, 0.0) / unit), 1.0)
            change, factors = float(np.abs(fresh - factors)[runs.eligible].max()), fresh
            if change < tolerance:
                break
        else:
            return Failure(
                f"the robust weights have not converged in {max_iterations} adjustments", Code.NOT_CONVERGED
            )
    return Robust(fit, factors, unit, total)


@dataclass(frozen=True)
class SnoopingStep:
    """One observation rejected or restored.

    Parameters
    ----------
    index : tuple of int
        Index in the array of observations.
    statistic : float
        Its test value in this step.
    critical : float
        Critical value.
    restored : bool
        Whether it was restored; otherwise it was rejected.

    Examples
    --------
    >>> SnoopingStep((3,), statistic=7.2, critical=3.29, restored=False).index
    (3,)
    """

    index: tuple[int, ...]
    statistic: float
    critical: float
    restored: bool


@dataclass(frozen=True, eq=False)
class Rejection(Estimated, Generic[F]):
    """An adjustment without the rejected observations; truthy.

    Parameters
    ----------
    adjustment : Adjustment
        Without them.
    rejected : ndarray of bool
        Rejected observations, of the observations' shape; those with weight zero from the start not included.
    steps : tuple of SnoopingStep
        Rejections and restorations in their order.
    rounds : int
        Number of adjustments.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> y = [1.0, 1.1, 0.9, 1.0, 5.0]
    >>> mean = GaussMarkov(lambda x: np.repeat(x, 5), y, 0.1, Parameters("m", [0.0]))
    >>> found = data_snooping(mean).required()
    >>> found.rejected.tolist(), [step.index for step in found.steps], found.rounds
    ([False, False, False, False, True], [(4,)], 2)
    >>> round(found.adjustment["m"], 6)
    1.0
    """

    adjustment: F
    rejected: Mask
    steps: tuple[SnoopingStep, ...]
    rounds: int


def data_snooping(
    problem: Adjustable[F],
    alpha: float = 0.001,
    test: Literal["w", "tau"] = "w",
    max_fraction: float = 0.25,
    options: Options | None = None,
    groups: NDArray[np.intp] | None = None,
) -> Rejection[F] | Failure:
    """Reject the observation with the largest significant test value, one at a time (Baarda 1968).

    Parameters
    ----------
    problem : GaussMarkov, GaussHelmert, or any Adjustable
        Problem to adjust.
    alpha : float
        Level of a single test.
    test : {"w", "tau"}
        Baarda's w, which assumes that the input sigmas are correct, or Pope's τ, which uses the estimated
        variance factor.
    max_fraction : float
        Maximum fraction of the observations that may be rejected.
    options : Options, optional
        Options of each adjustment.
    groups : ndarray of int, optional
        Group numbers, of the observations' shape: each round rejects or restores one observation per group.
        Use it where observations of different groups hardly influence each other.

    Returns
    -------
    Rejection or Failure
        With all steps. When no test is significant any more, the rejected observation that fits best is
        restored if it passes the test together with the others.

    Raises
    ------
    UsageError
        For an unknown test, and for levels and fractions out of range.

    Examples
    --------
    >>> import numpy as np
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> t, y = np.arange(6.0), [0.1, 0.9, 2.1, 9.0, 4.1, 4.9]
    >>> line = GaussMarkov(lambda x: x[0] + x[1] * t, y, 0.1, Parameters("ab", [0.0, 0.0]))
    >>> data_snooping(line).required().rejected.tolist()
    [False, False, False, True, False, False]
    """
    if test not in ("w", "tau") or not 0 < max_fraction < 1 or not 0 < alpha < 1:
        raise UsageError("needs test 'w' or 'tau', alpha and max_fraction in (0, 1)", where="data_snooping")
    runs = _Rounds(problem, options)
    label = np.zeros(problem.observations.shape, np.intp) if groups is None else np.asarray(groups)
    out = np.zeros(problem.observations.shape, dtype=bool)
    seen, steps, rounds = {out.tobytes()}, list[SnoopingStep](), 1
    fit = runs.adjust(out)
    while not isinstance(fit, Failure):
        values, critical = _tests(fit, test, alpha)
        leaving = _foremost(np.where(values > critical, values, 0.0), label)
        if leaving:
            out = out.copy()
            for place in leaving:
                out[runs.mark(place)] = True
                steps.append(SnoopingStep(place, float(values[place]), critical, restored=False))
            if out.sum() > max_fraction * runs.eligible.sum():
                return _too_many(int(out.sum()), runs)
            seen.add(out.tobytes())
            fit, rounds = runs.adjust(out), rounds + 1
            continue
        restored = _restored(runs, fit, out, seen, (test, alpha), label)
        if restored is None:
            return Rejection(fit, out, tuple(steps), rounds)
        fit, out, back = restored
        seen.add(out.tobytes())
        steps += back
        rounds += 1
    return fit


def _foremost(values: Array, label: NDArray[np.intp]) -> list[tuple[int, ...]]:
    """Indices of the largest value of each label, where it is above zero; largest first."""
    order = np.argsort(-values, axis=None, kind="stable")
    order = order[: int((values > 0).sum())]
    _, first = np.unique(label.ravel()[order], return_index=True)
    places = np.unravel_index(order[np.sort(first)], values.shape)
    return [tuple(int(i) for i in place) for place in zip(*places, strict=True)]


def _tests(fit: Fitted, test: str, alpha: float) -> tuple[Array, float]:
    values = np.nan_to_num(np.abs(fit.w), nan=0.0)
    if test == "w":
        return values, critical_w(alpha)
    if fit.redundancy < 2 or not fit.sigma0 > 0:
        return np.zeros_like(values), np.inf
    return values / fit.sigma0, critical_tau(alpha, fit.redundancy)


def _restored(
    runs: _Rounds[F], fit: F, out: Mask, seen: set[bytes], level: tuple[str, float], label: NDArray[np.intp]
) -> tuple[F, Mask, list[SnoopingStep]] | None:
    """The adjustment with the best fitting rejected observation of each label restored, if they pass."""
    if not out.any():
        return None
    t = runs.standardised(fit) / (fit.sigma0 if level[0] == "tau" and fit.sigma0 > 0 else 1.0)
    t = np.where(np.isfinite(t), t, np.inf)
    size = np.where(out, 1.0 / np.maximum(t, np.finfo(float).tiny), 0.0)
    several = label.any()
    best = _foremost(size, label)
    if several:
        # The best one is always tried; several at once only when their residuals are small.
        best = [place for k, place in enumerate(best) if k == 0 or t[place] <= _tests(fit, *level)[1]]
    fewer = out.copy()
    for place in best:
        fewer[runs.mark(place)] = False
    if fewer.tobytes() in seen:
        return None
    again = runs.adjust(fewer)
    if isinstance(again, Failure):
        return None
    values, critical = _tests(again, *level)
    own = [float(values[runs.mark(place)].max()) for place in best]
    passed = [place for place, value in zip(best, own, strict=True) if value <= critical]
    if not passed:
        return None
    steps = [
        SnoopingStep(p, v, critical, restored=True) for p, v in zip(best, own, strict=True) if v <= critical
    ]
    if len(passed) == len(best) or not several:
        return again, fewer, steps
    fewer = out.copy()
    for place in passed:
        fewer[runs.mark(place)] = False
    fit_again = None if fewer.tobytes() in seen else runs.adjust(fewer)
    return None if fit_again is None or isinstance(fit_again, Failure) else (fit_again, fewer, steps)


def _too_many(count: int, runs: _Rounds[F]) -> Failure:
    total = int(runs.eligible.sum())
    reason = f"{count} of {total} observations would be rejected; check the model first"
    return Failure(reason, Code.TOO_MANY_OUTLIERS)


class _Rounds(Generic[F]):
    """Repeated adjustments of one problem with different weights, each starting at the last estimates."""

    def __init__(self, problem: Adjustable[F], options: Options | None) -> None:
        self.problem, self.options, self.start = problem, options, problem
        shape = problem.observations.shape
        self.base = np.ones(shape) if problem.weights is None else problem.weights
        self.marks = problem.marks
        blocks = blocks_of(problem.covariance, shape)
        self.whitening = Weighting(blocks)
        diagonal = [np.diagonal(part, axis1=1, axis2=2).ravel() for part in blocks]
        self.sigma: Array = np.sqrt(np.concatenate(diagonal)).reshape(shape)
        self.eligible: Mask = ~self.whole(np.asarray(self.base == 0, dtype=bool))
        # Median of `standardised` for normal errors: that of χ with one degree of freedom.
        self.median = float(scipy.special.ndtri(0.75))

    def adjust(self, out: Mask, factors: Array | None = None) -> F | Failure:
        """Adjust without some observations, and with factors on the weights of the others."""
        weights = np.where(out, 0.0, self.base if factors is None else self.base * factors)
        fit = self.start.with_weights(weights).adjusted(self.options)
        if not isinstance(fit, Failure):
            self.start = self.start.continued(fit)
        return fit

    def standardised(self, fit: F) -> Array:
        """|v|/σ of each observation, with the input σ.

        For marks of conditions √(vᵀPv / c) of their c conditions, the same for all coordinates of the mark.
        """
        base = np.sqrt(np.where(self.eligible, self.base, 1.0))
        if self.marks is None or not isinstance(self.problem, GaussHelmert):
            return np.abs(fit.residuals) / self.sigma * base
        v, k = fit.residuals * base, self.base.shape[1]
        conditions = fit.solution.influence[0].matrices.shape[2]
        self.median = float(np.sqrt(scipy.special.chdtri(conditions, 0.5) / conditions))
        whitened = self.whitening.whiten(v.ravel()).reshape(v.shape)
        length = np.sqrt((whitened**2).sum(axis=1) / conditions)
        return np.repeat(length[:, None], k, axis=1)

    def whole(self, mask: Mask) -> Mask:
        """The mask extended to whole marks."""
        if self.marks is None:
            return mask
        touched = np.zeros(int(self.marks.max(initial=-1)) + 1, dtype=bool)
        touched[self.marks[mask]] = True
        return touched[self.marks]

    def mark(self, place: tuple[int, ...]) -> Mask | tuple[int, ...]:
        """The observations that are rejected together with one observation."""
        return place if self.marks is None else np.asarray(self.marks == self.marks[place])
