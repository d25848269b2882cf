"""Gross errors: robust weights, and data snooping.

Both assume that the model is correct. With a wrong model good observations look bad, and rejecting them hides
the error: therefore data snooping rejects at most a given part. Look at the global test first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Code, Failure
from .engine import Options
from .fitted import Adjustable, F, Fitted
from .problem import GaussHelmert
from .reliability import critical_tau, critical_w
from .stochastic import Weighting, blocks_of

__all__ = ["Rejection", "Robust", "SnoopingStep", "data_snooping", "robust", "weight_function"]

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
    if max_iterations < 1:
        raise UsageError("must be at least 1", where="max_iterations")
    stages: list[WeightName] = ["huber"] if weights == "huber" else ["huber", weights]
    runs, unit, total = _Rounds(problem, options), 1.0, 0
    factors = np.ones(problem.observations.shape)
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
    return Robust(fit, factors, unit, total)


@dataclass(frozen=True)
class SnoopingStep:
    """One observation left out or taken back.

    Parameters
    ----------
    index : tuple of int
        Where it stands among the observations.
    statistic : float
        Its test value at that time.
    critical : float
        What it was compared with.
    restored : bool
        Whether it was taken back.
    """

    index: tuple[int, ...]
    statistic: float
    critical: float
    restored: bool


@dataclass(frozen=True, eq=False)
class Rejection(Generic[F]):
    """An adjustment after observations have been left out; truthy.

    Parameters
    ----------
    adjustment : Adjustment
        Without them.
    rejected : ndarray of bool
        Which were left out, of the observations' shape; those left out from the start are not among them.
    steps : tuple of SnoopingStep
        How it came about.
    rounds : int
        Adjustments needed.
    """

    adjustment: F
    rejected: Mask
    steps: tuple[SnoopingStep, ...]
    rounds: int

    def __bool__(self) -> bool:
        return True

    def required(self) -> Rejection[F]:
        """The rejection itself; see :meth:`Failure.required`."""
        return self


def data_snooping(
    problem: Adjustable[F],
    alpha: float = 0.001,
    test: Literal["w", "tau"] = "w",
    max_fraction: float = 0.25,
    options: Options | None = None,
    groups: NDArray[np.intp] | None = None,
) -> Rejection[F] | Failure:
    """Leave out the observation of the greatest significant test value, one at a time (Baarda 1968).

    Parameters
    ----------
    problem : GaussMarkov, GaussHelmert, or any Adjustable
        What is to be adjusted.
    alpha : float
        Level of the single test.
    test : {"w", "tau"}
        Baarda's w, which takes the sigmas at their word, or Pope's τ, which estimates the variance factor.
    max_fraction : float
        Part of the observations that may be left out.
    options : Options, optional
        How to adjust.
    groups : ndarray of int, optional
        Numbers of the observations' shape: in each round the greatest of every number leaves or comes back,
        where observations of different numbers hardly know of each other.

    Returns
    -------
    Rejection or Failure
        With each step. When no test is significant any more, the one left out that now fits best is taken
        back, if it passes the test among the others.

    Raises
    ------
    UsageError
        For an unknown test, levels and fractions that cannot be.
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
    """Where the greatest value of each label stands, of those that have one above zero; greatest first."""
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
    """The adjustment with the best fitting of those left out taken back, one of each label, if they pass."""
    if not out.any():
        return None
    t = runs.standardised(fit) / (fit.sigma0 if level[0] == "tau" and fit.sigma0 > 0 else 1.0)
    size = np.where(out, 1.0 / np.maximum(t, np.finfo(float).tiny), 0.0)
    several = label.any()
    best = _foremost(size, label)
    if several:
        # The best alone is tried whatever its residual; more at once only when they look good.
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
    reason = f"{count} of {total} observations would have to be left out"
    return Failure(f"{reason}: look at the model before the observations", Code.TOO_MANY_OUTLIERS)


class _Rounds(Generic[F]):
    """A problem adjusted again and again with other weights, each time from the last estimates."""

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
        # Median of what `standardised` gives for normal errors: of χ with one degree of freedom.
        self.median = float(scipy.special.ndtri(0.75))

    def adjust(self, out: Mask, factors: Array | None = None) -> F | Failure:
        """The adjustment with some left out, and with factors on the weights of the others."""
        weights = np.where(out, 0.0, self.base if factors is None else self.base * factors)
        fit = self.start.with_weights(weights).adjusted(self.options)
        if not isinstance(fit, Failure):
            self.start = self.start.continued(fit)
        return fit

    def standardised(self, fit: F) -> Array:
        """|v|/σ of each observation, with σ as it was given.

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
        """The mask with whole marks."""
        if self.marks is None:
            return mask
        touched = np.zeros(int(self.marks.max(initial=-1)) + 1, dtype=bool)
        touched[self.marks[mask]] = True
        whole: Mask = touched[self.marks]
        return whole

    def mark(self, place: tuple[int, ...]) -> Mask | tuple[int, ...]:
        """What leaves together with one observation."""
        return place if self.marks is None else np.asarray(self.marks == self.marks[place])
