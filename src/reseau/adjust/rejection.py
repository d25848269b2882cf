"""Observations left out: k·σ rejection and data snooping.

Both presume that the model is right. A wrong model makes good observations look bad, and leaving those out
hides it: therefore neither leaves out more than a given part, and the global test should be looked at first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Code, Failure
from .engine import Options
from .fitted import Adjustable, F, Fitted
from .reliability import critical_tau, critical_w
from .rounds import Rounds

__all__ = ["Rejection", "SnoopingStep", "data_snooping", "reject_outliers"]


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
        How it came about; empty for k·σ rejection.
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


def reject_outliers(
    problem: Adjustable[F],
    k: float = 3.0,
    max_fraction: float = 0.25,
    max_rounds: int = 30,
    options: Options | None = None,
) -> Rejection[F] | Failure:
    """Leave out all observations whose residual exceeds k standard deviations, until none does.

    Parameters
    ----------
    problem : GaussMarkov, GaussHelmert, or any Adjustable
        What is to be adjusted.
    k : float
        Bound of |v| over σ·sigma0, with sigma0 from the observations still in.
    max_fraction : float
        Part of the observations that may be left out.
    max_rounds : int
        Adjustments at most.
    options : Options, optional
        How to adjust.

    Returns
    -------
    Rejection or Failure
        In each round all are judged anew, so that one left out may come back. Of conditions between the
        coordinates of marks the whole mark goes.

    Raises
    ------
    UsageError
        For k or fractions that cannot be.
    """
    if not k > 0 or not 0 < max_fraction < 1:
        raise UsageError("k must be above zero and max_fraction within (0, 1)", where="reject_outliers")
    runs = Rounds(problem, options)
    out = np.zeros(problem.observations.shape, dtype=bool)
    seen = {out.tobytes()}
    for rounds in range(1, max_rounds + 1):
        fit = runs.adjust(out)
        if isinstance(fit, Failure):
            return fit
        sigma0 = fit.sigma0 if fit.redundancy > 0 else 1.0
        judged = runs.whole((runs.standardised(fit) > k * sigma0) & runs.eligible)
        if judged.tobytes() in seen:
            # Either nothing changed, or what comes and goes would do so for ever.
            return Rejection(fit, out, (), rounds)
        if judged.sum() > max_fraction * runs.eligible.sum():
            return _too_many(int(judged.sum()), runs)
        seen.add(judged.tobytes())
        out = judged
    return Failure(f"the rejection has not settled in {max_rounds} rounds", Code.NOT_CONVERGED)


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
    runs = Rounds(problem, options)
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
    runs: Rounds[F], fit: F, out: Mask, seen: set[bytes], level: tuple[str, float], label: NDArray[np.intp]
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


def _too_many(count: int, runs: Rounds[F]) -> Failure:
    total = int(runs.eligible.sum())
    reason = f"{count} of {total} observations would have to be left out"
    return Failure(f"{reason}: look at the model before the observations", Code.TOO_MANY_OUTLIERS)
