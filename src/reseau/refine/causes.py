"""The physical causes of the coefficients of the ultrasonic instrument (group B).

Equations (7a, b) of Wishahy's paper have 16 coefficients; its equations (6a, b) derive them from 13 causes:
orientation P0…P4, symmetric distortion k0, k1, asymmetric distortion h'1…h'4, and the ultrasonic beam m1, m2.
This implies three conditions, A6 = B6, A4 = B3 + A5 and B4 = A3 + B5, which can be tested; where they hold,
the causes follow by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ..adjust import Adjustment, GaussMarkov, Parameters, adjust
from ..core.data import Array
from ..core.errors import UsageError
from ..core.failure import Failure

CAUSES = ("P0", "P1", "P2", "P3", "P4", "k0", "k1", "h'1", "h'2", "h'3", "h'4", "m1", "m2")
"""Orientation, symmetric and asymmetric distortion of the display, the ultrasonic beam."""

_MADE_OF: dict[str, dict[str, float]] = {
    "A0": {"P0": 1},
    "A1": {"k0": 1, "m1": 1},
    "A2": {"m2": 1, "P3": -1},
    "A3": {"P1": 1},
    "A4": {"P2": 1, "h'1": -1},
    "A5": {"h'1": -1},
    "A6": {"k1": 1},
    "A7": {"h'2": -1},
    "B0": {"P4": 1},
    "B1": {"k0": 1},
    "B2": {"P3": 1},
    "B3": {"P2": 1},
    "B4": {"P1": 1, "h'3": 1},
    "B5": {"h'3": 1},
    "B6": {"k1": 1},
    "B7": {"h'4": 1},
}
_UNITY = ("A1", "B1")

COEFFICIENTS = tuple(_MADE_OF)
"""The 16 coefficients of equations (7a, b)."""

CONDITIONS: dict[str, dict[str, float]] = {
    "A6 = B6": {"A6": 1, "B6": -1},
    "A4 = B3 + A5": {"A4": 1, "B3": -1, "A5": -1},
    "B4 = A3 + B5": {"B4": 1, "A3": -1, "B5": -1},
}
"""Conditions that 13 causes impose on 16 coefficients; each sum is zero."""


@dataclass(frozen=True)
class ConditionTest:
    """χ² test of one condition between coefficients.

    Parameters
    ----------
    condition : str
        As in the paper's symbols.
    misclosure, sigma : float
        Misclosure of the condition, and its standard deviation.
    statistic, critical, p : float
        χ² with one degree of freedom, its critical value at level alpha, and its p-value.
    holds : bool
        Whether the condition is not contradicted.
    """

    condition: str
    misclosure: float
    sigma: float
    statistic: float
    critical: float
    p: float
    holds: bool


@dataclass(frozen=True, eq=False)
class Causes:
    """Causes estimated from the coefficients.

    Parameters
    ----------
    adjustment : Adjustment
        Adjustment of the 13 causes to the 16 coefficients; redundancy 3. Its global test is the joint test of
        the three conditions.
    conditions : tuple of ConditionTest
        Test of each condition.

    Examples
    --------
    >>> values = np.array([float(name in ("A1", "B1")) for name in COEFFICIENTS])
    >>> causes = physical_causes(COEFFICIENTS, values + 1e-3, 1e-4 * np.eye(16))
    >>> isinstance(causes, Causes), causes.adjustment.redundancy
    (True, 3)
    >>> [test.condition for test in causes.conditions if test.holds]
    ['A6 = B6', 'A4 = B3 + A5', 'B4 = A3 + B5']
    """

    adjustment: Adjustment
    conditions: tuple[ConditionTest, ...]


def physical_causes(
    names: Sequence[str], values: Array, covariance: Array, alpha: float = 0.05
) -> Causes | Failure:
    """Adjust the causes to coefficients and test the conditions.

    Parameters
    ----------
    names : sequence of str (16)
        The coefficients A0…A7, B0…B7 in any order. None may have been dropped: a coefficient held at zero
        has no variance.
    values : ndarray (16,)
        Their values.
    covariance : ndarray (16, 16)
        Their covariance matrix.
    alpha : float
        Level of the tests.

    Returns
    -------
    Causes or Failure
        A failure when the adjustment fails.

    Raises
    ------
    UsageError
        When a coefficient is missing.

    Examples
    --------
    >>> values = np.zeros(16)
    >>> values[[COEFFICIENTS.index("A1"), COEFFICIENTS.index("B1")]] = 1.02, 1.01
    >>> found = physical_causes(COEFFICIENTS, values, 1e-6 * np.eye(16))
    >>> [test.holds for test in found.conditions], round(found.adjustment["m1"], 3)
    ([True, True, True], 0.01)
    """
    missing = [name for name in COEFFICIENTS if name not in names]
    if missing:
        raise UsageError("are missing among the coefficients", where=", ".join(missing))
    order = [list(names).index(name) for name in COEFFICIENTS]
    observed, cov = values[order], covariance[np.ix_(order, order)]
    unity = np.array([name in _UNITY for name in COEFFICIENTS], dtype=np.float64)
    design = np.array([[_MADE_OF[name].get(cause, 0.0) for cause in CAUSES] for name in COEFFICIENTS])
    problem = GaussMarkov(
        lambda x: design @ x + unity,
        observed,
        cov,
        Parameters(CAUSES, np.zeros(len(CAUSES))),
        lambda x: design,
    )
    fit = adjust(problem)
    if isinstance(fit, Failure):
        return fit
    return Causes(fit, tuple(_test(name, observed, cov, alpha) for name in CONDITIONS))


def causes_of(fit: Adjustment, alpha: float = 0.05) -> Causes | None:
    """The causes of the coefficients of an adjustment of group B.

    Parameters
    ----------
    fit : Adjustment
        With all 16 coefficients.
    alpha : float
        Level of the tests.

    Returns
    -------
    Causes or None
        None where a coefficient is missing, or the adjustment fails.

    Examples
    --------
    >>> from reseau.core.data import ImagePoints
    >>> from reseau.measure.fitting import fit_mapping
    >>> from reseau.optics import RationalPolynomial
    >>> xy = np.stack(np.meshgrid(np.linspace(-50, 50, 5), np.linspace(-40, 40, 5)), axis=-1).reshape(-1, 2)
    >>> points = ImagePoints.with_sigma(map(str, range(25)), xy, 0.01)
    >>> causes = causes_of(fit_mapping(RationalPolynomial.ultrasonic(), points, 1.01 * xy).required())
    >>> round(causes.adjustment["k0"], 4)
    0.01
    """
    if any(name not in fit.names for name in COEFFICIENTS):
        return None
    causes = physical_causes(fit.names, fit.values, fit.cofactor, alpha)
    return None if isinstance(causes, Failure) else causes


def _test(condition: str, values: Array, covariance: Array, alpha: float) -> ConditionTest:
    terms = CONDITIONS[condition]
    row = np.array([terms.get(name, 0.0) for name in COEFFICIENTS])
    misclosure, variance = float(row @ values), float(row @ covariance @ row)
    statistic = misclosure**2 / variance
    critical = float(scipy.special.chdtri(1, alpha))
    p = float(scipy.special.chdtrc(1, statistic))
    return ConditionTest(condition, misclosure, variance**0.5, statistic, critical, p, statistic <= critical)
