"""Observations left out: k·σ rejection and data snooping.

Both presume that the model is right. A wrong model makes good observations look bad, and leaving those out
hides it: therefore neither leaves out more than a given part, and the global test should be looked at first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from reseau.data import Array, Mask
from reseau.errors import UsageError

from .engine import Options
from .problem import Problem
from .reliability import critical_tau, critical_w
from .result import Adjustment, Failure
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
class Rejection:
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

    adjustment: Adjustment
    rejected: Mask
    steps: tuple[SnoopingStep, ...]
    rounds: int

    def __bool__(self) -> bool:
        return True

    def required(self) -> Rejection:
        """The rejection itself; see :meth:`Failure.required`."""
        return self


def reject_outliers(
    problem: Problem,
    k: float = 3.0,
    max_fraction: float = 0.25,
    max_rounds: int = 30,
    options: Options | None = None,
) -> Rejection | Failure:
    """Leave out all observations whose residual exceeds k standard deviations, until none does.

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
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
        if not isinstance(fit, Adjustment):
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
    return Failure(f"the rejection has not settled in {max_rounds} rounds")


def data_snooping(
    problem: Problem,
    alpha: float = 0.001,
    test: Literal["w", "tau"] = "w",
    max_fraction: float = 0.25,
    options: Options | None = None,
) -> Rejection | Failure:
    """Leave out the observation of the greatest significant test value, one at a time (Baarda 1968).

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
        What is to be adjusted.
    alpha : float
        Level of the single test.
    test : {"w", "tau"}
        Baarda's w, which takes the sigmas at their word, or Pope's τ, which estimates the variance factor.
    max_fraction : float
        Part of the observations that may be left out.
    options : Options, optional
        How to adjust.

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
    out = np.zeros(problem.observations.shape, dtype=bool)
    seen, steps, rounds = {out.tobytes()}, list[SnoopingStep](), 1
    fit = runs.adjust(out)
    while isinstance(fit, Adjustment):
        values, critical = _tests(fit, test, alpha)
        index = np.unravel_index(int(np.argmax(values)), values.shape)
        place = tuple(int(i) for i in index)
        if values[place] > critical:
            out = out.copy()
            out[runs.mark(place)] = True
            if out.sum() > max_fraction * runs.eligible.sum():
                return _too_many(int(out.sum()), runs)
            seen.add(out.tobytes())
            steps.append(SnoopingStep(place, float(values[place]), critical, restored=False))
            fit, rounds = runs.adjust(out), rounds + 1
            continue
        restored = _restored(runs, fit, out, seen, test, alpha)
        if restored is None:
            return Rejection(fit, out, tuple(steps), rounds)
        fit, out, step = restored
        seen.add(out.tobytes())
        steps.append(step)
        rounds += 1
    return fit


def _tests(fit: Adjustment, test: str, alpha: float) -> tuple[Array, float]:
    values = np.nan_to_num(np.abs(fit.w), nan=0.0)
    if test == "w":
        return values, critical_w(alpha)
    if fit.redundancy < 2 or not fit.sigma0 > 0:
        return np.zeros_like(values), np.inf
    return values / fit.sigma0, critical_tau(alpha, fit.redundancy)


def _restored(
    runs: Rounds, fit: Adjustment, out: Mask, seen: set[bytes], test: str, alpha: float
) -> tuple[Adjustment, Mask, SnoopingStep] | None:
    """The adjustment with the best fitting of those left out taken back, if it passes."""
    if not out.any():
        return None
    t = np.where(out, runs.standardised(fit), np.inf)
    place = tuple(int(i) for i in np.unravel_index(int(np.argmin(t)), t.shape))
    fewer = out.copy()
    fewer[runs.mark(place)] = False
    if fewer.tobytes() in seen:
        return None
    again = runs.adjust(fewer)
    if not isinstance(again, Adjustment):
        return None
    values, critical = _tests(again, test, alpha)
    own = float(values[runs.mark(place)].max())
    if own > critical:
        return None
    return again, fewer, SnoopingStep(place, own, critical, restored=True)


def _too_many(count: int, runs: Rounds) -> Failure:
    total = int(runs.eligible.sum())
    reason = f"{count} of {total} observations would have to be left out"
    return Failure(f"{reason}: look at the model before the observations")
