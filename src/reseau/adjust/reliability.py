"""Reliability of observations (Baarda 1968), for any covariance and either model.

With P v = T r and D = I − A Q Aᵀ in the whitened space, everything follows from the blocks of
T D Tᵀ = P Qᵥᵥ P:
redundancy numbers are the diagonal of Q P Qᵥᵥ P … = (Qᵥᵥ P), and for an error in observation i alone (the
conventional alternative hypothesis) the test value is w = (P v)ᵢ / √(P Qᵥᵥ P)ᵢᵢ.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from ..core.data import Array
from ..core.errors import UsageError
from .stochastic import Blocks

# A redundancy number below this is due to rounding: no other observation controls this one.
_UNCONTROLLED = 1e-10


@dataclass(frozen=True, eq=False)
class Standardised:
    """Redundancy numbers and test values in columns over observations and observed parameters (N,).

    Parameters
    ----------
    redundancy_numbers : ndarray (N,)
        Diagonal of Qᵥᵥ P.
    w : ndarray (N,)
        Test values for a variance factor of one; NaN where no other observation controls this one.
    unit_error : ndarray (N,)
        Error whose expected test value is one, 1/√(P Qᵥᵥ P)ᵢᵢ; infinite where nothing controls it.
    """

    redundancy_numbers: Array
    w: Array
    unit_error: Array


class Whitened(ABC):
    """The part of the whitened linear problem at the estimates that reliability needs.

    Subclasses have `whitened` (N',), the whitened residuals; `influence`, the blocks of T with P v = T r; and
    `cofactors`, the covariances of the observations and observed parameters that belong to these blocks.
    """

    whitened: Array
    influence: tuple[Blocks, ...]
    cofactors: tuple[Blocks, ...]

    @abstractmethod
    def hats(self) -> Iterator[Array]:
        """For each part of `influence` the diagonal blocks (b, k, k) of T A Q Aᵀ Tᵀ = P Q_l̂l̂ P."""

    def standardise(self) -> Standardised:
        """Redundancy numbers and test values."""
        numbers, tests, errors = [], [], []
        for turn, cofactor, hat in zip(self.influence, self.cofactors, self.hats(), strict=True):
            t = turn.matrices
            k = t.shape[1]
            own = t @ np.swapaxes(t, 1, 2)
            controlled = own - hat
            number = np.einsum("bij,bji->bi", cofactor.matrices, controlled).ravel()
            diagonal = np.diagonal(controlled, axis1=1, axis2=2).ravel()
            before = np.diagonal(own, axis1=1, axis2=2).ravel()
            known = diagonal > _UNCONTROLLED * before
            size = np.sqrt(np.where(known, diagonal, 1.0))
            numbers.append(np.clip(number, 0.0, None) if k == 1 else number)
            tests.append(np.where(known, turn.times(self.whitened) / size, np.nan))
            # Cofactors that were not computed are NaN: nothing is known of the observation then.
            errors.append(np.where(known, 1.0 / size, np.where(np.isnan(diagonal), np.nan, np.inf)))
        return Standardised(np.concatenate(numbers), np.concatenate(tests), np.concatenate(errors))

    def diagonal_hats(self) -> Array:
        """Diagonal (N,) of P Q_l̂l̂ P."""
        return np.concatenate([np.diagonal(hat, axis1=1, axis2=2).ravel() for hat in self.hats()])

    def weighted_residuals(self) -> Array:
        """P v of the observations and observed parameters (N,)."""
        return np.concatenate([turn.times(self.whitened) for turn in self.influence])


@dataclass(frozen=True, eq=False)
class Solution(Whitened):
    """The whitened linear problem at the estimates, with its design.

    Parameters
    ----------
    design : ndarray (N', f)
        Whitened design of the free parameters.
    whitened : ndarray (N',)
        Whitened residuals.
    factor : ndarray (f, rank)
        F with the cofactor matrix of the parameters F Fᵀ.
    influence : tuple of Blocks
        T with P v = T r.
    cofactors : tuple of Blocks
        Covariances of the observations and observed parameters.
    """

    design: Array
    whitened: Array
    factor: Array
    influence: tuple[Blocks, ...]
    cofactors: tuple[Blocks, ...]

    def hats(self) -> Iterator[Array]:
        """See :meth:`Whitened.hats`."""
        through = self.design @ self.factor
        for turn in self.influence:
            b, k, _ = turn.matrices.shape
            a = turn.times(through).reshape(b, k, -1)
            yield a @ np.swapaxes(a, 1, 2)


def noncentrality(alpha: float, power: float) -> float:
    """Baarda's δ₀: mean of a normal test value that a two-sided test of level alpha detects with this power.

    Examples
    --------
    >>> round(noncentrality(0.001, 0.8), 3)
    4.132
    """
    critical = critical_w(alpha)
    if not alpha < power < 1:
        raise UsageError(f"{power} must be between alpha and 1", where="power")

    def missing(delta: float) -> float:
        found = scipy.special.ndtr(delta - critical) + scipy.special.ndtr(-delta - critical)
        return float(found - power)

    highest = critical + float(scipy.special.ndtri(power)) + 1.0
    return float(scipy.optimize.brentq(missing, 0.0, max(highest, 1.0), xtol=1e-12))


def critical_w(alpha: float) -> float:
    """Critical value of Baarda's w, two-sided.

    Examples
    --------
    >>> round(critical_w(0.001), 2)
    3.29
    """
    if not 0 < alpha < 1:
        raise UsageError(f"{alpha} must be between 0 and 1", where="alpha")
    return float(-scipy.special.ndtri(alpha / 2.0))


def critical_tau(alpha: float, redundancy: int) -> float:
    """Critical value of Pope's τ, two-sided (Pope 1976): of t with redundancy − 1 degrees of freedom.

    Raises
    ------
    UsageError
        For a redundancy below 2, which leaves τ = ±1.

    Examples
    --------
    >>> round(critical_tau(0.05, 10), 2)
    1.9
    """
    if not 0 < alpha < 1:
        raise UsageError(f"{alpha} must be between 0 and 1", where="alpha")
    if redundancy < 2:
        raise UsageError(f"τ has no distribution at a redundancy of {redundancy}", where="critical_tau")
    t = float(scipy.special.stdtrit(redundancy - 1, 1.0 - alpha / 2.0))
    return float(t * np.sqrt(redundancy / (redundancy - 1 + t**2)))
