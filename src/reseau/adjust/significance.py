"""Tests of the variance factor, of single parameters, and of nested models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..core.errors import UsageError


@dataclass(frozen=True)
class GlobalTest:
    """Test of the variance factor against one.

    Parameters
    ----------
    statistic : float
        vᵀPv.
    redundancy : int
        Degrees of freedom.
    lower, upper : float
        The statistic lies between these with probability 1 − alpha.
    p : float
        Two-sided p-value.
    passed : bool
        Whether the statistic lies between the bounds.

    Examples
    --------
    >>> global_test(cost=12.0, redundancy=10, alpha=0.05).passed
    True
    """

    statistic: float
    redundancy: int
    lower: float
    upper: float
    p: float
    passed: bool


@dataclass(frozen=True)
class CoefficientTest:
    """Test of one parameter against a value.

    Parameters
    ----------
    name : str
        Parameter.
    distribution : {"t", "chi2", "F"}
        Distribution of the statistic.
    statistic, critical : float
        Test value (its magnitude for t), and its critical value at level alpha.
    p : float
        p-value.
    significant : bool
        Whether the parameter differs significantly from the value.

    Examples
    --------
    >>> test = ratio_test("K3", 3.0, 1.0, 100)
    >>> test.distribution, round(test.critical, 2), test.significant
    ('t', 1.98, True)
    """

    name: str
    distribution: str
    statistic: float
    critical: float
    p: float
    significant: bool


@dataclass(frozen=True)
class NestedTest:
    """Test of a model within a wider one.

    Parameters
    ----------
    distribution : {"F", "chi2"}
        F with the estimated variance factor, χ² with the input sigmas.
    statistic, critical : float
        Test value, and its critical value at level alpha.
    degrees : (int, int)
        Restrictions, and the redundancy of the wider model.
    p : float
        p-value.
    significant : bool
        Whether the wider model fits significantly better.

    Examples
    --------
    >>> test = nested_test(increase=8.0, restrictions=2, cost=None, redundancy=10, alpha=0.05)
    >>> test.distribution, round(test.critical, 2), test.significant
    ('chi2', 5.99, True)
    """

    distribution: str
    statistic: float
    critical: float
    degrees: tuple[int, int]
    p: float
    significant: bool


def _level(alpha: float) -> None:
    if not 0 < alpha < 1:
        raise UsageError(f"{alpha} must be between 0 and 1", where="alpha")


def global_test(cost: float, redundancy: int, alpha: float) -> GlobalTest:
    """Two-sided χ² test of a weighted sum of squares (Koch 1999, ch. 4).

    Raises
    ------
    UsageError
        Without redundancy, or for an alpha outside (0, 1).
    """
    _level(alpha)
    if redundancy < 1:
        raise UsageError("is not possible without redundancy", where="global_test")
    lower = float(scipy.special.chdtri(redundancy, 1.0 - alpha / 2.0))
    upper = float(scipy.special.chdtri(redundancy, alpha / 2.0))
    tail = float(scipy.special.chdtrc(redundancy, cost))
    return GlobalTest(cost, redundancy, lower, upper, 2.0 * min(tail, 1.0 - tail), lower <= cost <= upper)


def ratio_test(
    name: str, ratio: float, sigma0: float | None, redundancy: int, alpha: float = 0.05
) -> CoefficientTest:
    """Test an estimate whose difference from a value is `ratio` times the square root of its cofactor.

    Parameters
    ----------
    name : str
        Name of the parameter.
    ratio : float
        Difference over the square root of the cofactor.
    sigma0 : float, optional
        Standard deviation of unit weight a posteriori, for Student's t; without it χ² with the input sigmas.
    redundancy : int
        Degrees of freedom of sigma0.
    alpha : float
        Level.

    Examples
    --------
    >>> ratio_test("K3", 3.0, 1.0, 100).significant
    True
    """
    _level(alpha)
    if sigma0 is None:
        statistic, critical = ratio**2, float(scipy.special.chdtri(1, alpha))
        p = float(scipy.special.chdtrc(1, statistic))
        return CoefficientTest(name, "chi2", statistic, critical, p, statistic > critical)
    statistic = abs(ratio) / sigma0 if sigma0 > 0 else (np.inf if ratio else 0.0)
    critical = float(scipy.special.stdtrit(redundancy, 1.0 - alpha / 2.0))
    p = float(2.0 * scipy.special.stdtr(redundancy, -statistic))
    return CoefficientTest(name, "t", statistic, critical, p, bool(statistic > critical))


def nested_test(
    increase: float, restrictions: int, cost: float | None, redundancy: int, alpha: float
) -> NestedTest:
    """Test of the increase of vᵀPv by restrictions (Koch 1999, ch. 4).

    Parameters
    ----------
    increase : float
        vᵀPv of the nested model less that of the wider one.
    restrictions : int
        Number of restrictions.
    cost : float or None
        vᵀPv of the wider model, for an F test; without it χ² with the input sigmas.
    redundancy : int
        Redundancy of the wider model.
    alpha : float
        Level.
    """
    _level(alpha)
    degrees = (restrictions, redundancy)
    if cost is None:
        critical = float(scipy.special.chdtri(restrictions, alpha))
        p = float(scipy.special.chdtrc(restrictions, increase))
        return NestedTest("chi2", increase, critical, degrees, p, increase > critical)
    variance = cost / redundancy
    statistic = increase / restrictions / variance if variance > 0 else (np.inf if increase else 0.0)
    critical = float(scipy.special.fdtri(*degrees, 1.0 - alpha))
    p = float(scipy.special.fdtrc(*degrees, statistic))
    return NestedTest("F", statistic, critical, degrees, p, bool(statistic > critical))
