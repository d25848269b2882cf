"""Backward elimination: drop insignificant parameters, one at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..core.errors import UsageError
from ..core.failure import Estimated, Failure
from .engine import AdjustmentFailure, Options
from .fitted import compare
from .problem import Adjustment, Problem, adjust
from .significance import CoefficientTest

_LOOKED_AT = 2
"""Number of parameters tested in each step."""

Criterion = Literal["t", "chi2", "F"]


@dataclass(frozen=True)
class EliminationStep:
    """One dropped parameter.

    Parameters
    ----------
    test : CoefficientTest
        Test of the dropped parameter.
    parameters : int
        Number of free parameters before.
    sigma0_before, sigma0_after : float
        Standard deviation of unit weight with and without the parameter.

    Examples
    --------
    >>> test = CoefficientTest("K3", "t", statistic=0.4, critical=1.98, p=0.69, significant=False)
    >>> step = EliminationStep(test, parameters=8, sigma0_before=1.02, sigma0_after=1.01)
    >>> step.name, step.test.p
    ('K3', 0.69)
    """

    test: CoefficientTest
    parameters: int
    sigma0_before: float
    sigma0_after: float

    @property
    def name(self) -> str:
        """The parameter that was dropped."""
        return self.test.name


@dataclass(frozen=True, eq=False)
class Elimination(Estimated):
    """Record and result of a backward elimination; truthy.

    Parameters
    ----------
    steps : tuple of EliminationStep
        Dropped parameters in their order.
    kept : tuple of CoefficientTest
        Tests of the remaining candidates, all significant.
    full : Adjustment
        With all parameters.
    adjustment : Adjustment
        With the remaining parameters; the dropped ones are fixed.
    criterion : str
        Test used.
    alpha : float
        Its level.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> terms = np.arange(6.0)[:, None] ** [0, 1, 2]
    >>> y = [0.1, 0.9, 2.1, 2.9, 4.1, 4.9]
    >>> problem = GaussMarkov(lambda x: terms @ x, y, 0.1, Parameters("abc", [0.0] * 3), lambda x: terms)
    >>> found = eliminate(problem, keep=["a"]).required()
    >>> found.dropped, [test.name for test in found.kept], round(found.adjustment["b"], 3)
    (('c',), ['b'], 0.983)
    """

    steps: tuple[EliminationStep, ...]
    kept: tuple[CoefficientTest, ...]
    full: Adjustment
    adjustment: Adjustment
    criterion: str
    alpha: float

    @property
    def dropped(self) -> tuple[str, ...]:
        """Names of the dropped parameters, in their order."""
        return tuple(step.name for step in self.steps)


def eliminate(
    problem: Problem,
    alpha: float = 0.05,
    criterion: Criterion = "t",
    keep: Iterable[str] = (),
    value: float = 0.0,
    options: Options | None = None,
) -> Elimination | Failure:
    """Drop the least significant parameter and adjust again, until all remaining ones are significant.

    Parameters
    ----------
    problem : GaussMarkov or GaussHelmert
        With all parameters.
    alpha : float
        Level of each test. A parameter is kept when it is significant at this level.
    criterion : {"t", "chi2", "F"}
        Student's t with the estimated variance factor; χ² with the input sigmas; or the F test of the model
        without the parameter against that with it, both adjusted, for non-linear models.
    keep : iterable of str
        Parameters that must not be dropped.
    value : float
        Value at which a dropped parameter is fixed.
    options : Options, optional
        Options of each adjustment; `scale` has no effect on the tests.

    Returns
    -------
    Elimination or Failure
        The record and the last adjustment; a failure when one of the adjustments fails.

    Raises
    ------
    UsageError
        For an unknown criterion or name, and for t and F without redundancy.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> y = [0.1, 0.9, 2.1, 2.9, 4.1, 4.9]
    >>> terms = np.arange(6.0)[:, None] ** [0, 1, 2]
    >>> names = Parameters("abc", [0.0, 0.0, 0.0])
    >>> problem = GaussMarkov(lambda x: terms @ x, y, 0.1, names, lambda x: terms)
    >>> eliminate(problem, keep=["a"]).required().dropped
    ('c',)
    """
    if criterion not in ("t", "chi2", "F"):
        raise UsageError(f"{criterion!r} is not one of t, chi2, F", where="criterion")
    kept = set(keep)
    for name in kept:
        problem.parameters.index(name)
    fit = full = adjust(problem, options)
    if not isinstance(full, Adjustment):
        return full
    if criterion != "chi2" and full.redundancy < 1:
        raise UsageError("has no redundancy to test with", where="eliminate", do="use criterion='chi2'")
    steps: list[EliminationStep] = []
    while isinstance(fit, Adjustment):
        candidates = [name for name in fit.free if name not in kept]
        tests = _tests(fit, _weakest(fit, candidates, value), value, alpha, criterion)
        if isinstance(tests, Failure):
            return tests
        weakest = min(tests, key=lambda test: (-test.p, test.statistic), default=None)
        if weakest is None or weakest.significant:
            tests = _tests(fit, candidates, value, alpha, criterion)
            if isinstance(tests, Failure):
                return tests
            return Elimination(tuple(steps), tuple(tests), full, fit, criterion, alpha)
        before = fit
        fit = _without(before, weakest.name, value)
        if isinstance(fit, Adjustment):
            steps.append(EliminationStep(weakest, len(before.free), before.sigma0, fit.sigma0))
    return fit


def _weakest(fit: Adjustment, names: list[str], value: float) -> list[str]:
    """The names whose estimates are closest to the value, in their standard deviations.

    In a linear model the first one is the least significant by every criterion; a second one is tested for
    non-linear models.
    """
    at = [fit.index(name) for name in names]
    ratio = np.abs(fit.values[at] - value) / np.sqrt(np.maximum(np.diagonal(fit.cofactor)[at], 1e-300))
    return [names[k] for k in np.argsort(ratio, kind="stable")[:_LOOKED_AT]]


def _tests(
    fit: Adjustment, names: Iterable[str], value: float, alpha: float, criterion: Criterion
) -> list[CoefficientTest] | Failure:
    tests = []
    for name in names:
        test = _test(fit, name, value, alpha, criterion)
        if isinstance(test, Failure):
            return test
        tests.append(test)
    return tests


def _without(fit: Adjustment, name: str, value: float) -> Adjustment | AdjustmentFailure:
    """The adjustment with one parameter fixed, starting at the estimates with it."""
    start = fit.parameters
    return adjust(fit.problem.with_parameters(start.fix(name, at=value)), fit.options)


def _test(
    fit: Adjustment, name: str, value: float, alpha: float, criterion: Criterion
) -> CoefficientTest | Failure:
    if criterion != "F":
        scale: Literal["a-priori", "a-posteriori"] = "a-priori" if criterion == "chi2" else "a-posteriori"
        return fit.test_of(name, value, alpha, scale)
    without = _without(fit, name, value)
    if isinstance(without, Failure):
        return without
    nested = compare(without, fit, alpha, scale="a-posteriori")
    return CoefficientTest(name, "F", nested.statistic, nested.critical, nested.p, nested.significant)
