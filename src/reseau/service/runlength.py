"""Run lengths of control charts: how many runs until a chart signals, with and without a shift.

The run length of a chart is the time until absorption of a Markov process. Its mean from the state s solves
the integral equation L(s) = 1 + ∫ L(x) f(x | s) dx over the states x without a signal (Page 1954; Crowder
1987). With Gauss–Legendre nodes it becomes the linear system (I − Q) L = 1. A CUSUM chart that is combined
with a Shewhart limit has a density that is cut off; there Q is the Markov chain of Brook and Evans (1972).

Values are independent and standard normal; ``arl(shift)`` is the average run length from the start when their
mean is `shift` from the first run on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..core.data import Array
from ..core.errors import UsageError

_NODES = 80
_CELLS = 400


@dataclass(frozen=True)
class Shewhart:
    """A chart that signals when a value exceeds its limit in size.

    Parameters
    ----------
    limit : float
        Limit, in standard deviations.

    Examples
    --------
    >>> round(Shewhart(3.0).arl(), 1), round(Shewhart(3.0).arl(1.0), 1)
    (370.4, 43.9)
    """

    limit: float

    def __post_init__(self) -> None:
        _positive(limit=self.limit)

    def arl(self, shift: float = 0.0) -> float:
        """Average run length from the start."""
        inside = scipy.special.ndtr(self.limit - shift) - scipy.special.ndtr(-self.limit - shift)
        return float(1.0 / (1.0 - inside))


@dataclass(frozen=True)
class Ewma:
    """A chart of the exponentially weighted moving average z ← (1 − λ) z + λ x, two-sided.

    Parameters
    ----------
    weight : float
        λ, above 0 and at most 1.
    limit : float
        Limit of z, in its standard deviations √(λ / (2 − λ)) after many runs.

    Examples
    --------
    >>> round(Ewma(0.1, 2.7).arl(1.0), 2)
    9.73
    """

    weight: float
    limit: float

    def __post_init__(self) -> None:
        _positive(weight=self.weight, limit=self.limit)
        if self.weight > 1:
            raise UsageError(f"{self.weight:g} is above 1", where="weight")

    def arl(self, shift: float = 0.0) -> float:
        """Average run length from the start."""
        edge = self.limit * np.sqrt(self.weight / (2.0 - self.weight))
        nodes, weights = _quadrature(-edge, edge)
        start = np.append(0.0, nodes)[:, None]
        to = (nodes - (1.0 - self.weight) * start) / self.weight
        first, *further = weights * _density(to - shift) / self.weight
        return _run_length(first, np.array(further))


@dataclass(frozen=True)
class Cusum:
    """A cumulative sum chart, S ← max(0, S + x − k), optionally with a Shewhart limit of single values.

    Parameters
    ----------
    reference : float
        k, half of the shift that is to be found.
    limit : float
        The chart signals when S exceeds it.
    shewhart : float
        The chart also signals when a value exceeds this limit.
    two_sided : bool
        Whether a second sum signals decreases. Its run lengths then follow from those of the two sums:
        1/L = 1/L⁺ + 1/L⁻ (Van Dobben de Bruyn 1968; exact without a Shewhart limit).

    Examples
    --------
    >>> round(Cusum(0.5, 5.0).arl(), 1), round(Cusum(0.5, 5.0).arl(1.0), 2)
    (465.4, 10.38)
    >>> round(Cusum(0.5, 5.0, two_sided=False).arl(), 1)
    930.9
    """

    reference: float
    limit: float
    shewhart: float = np.inf
    two_sided: bool = True

    def __post_init__(self) -> None:
        _positive(reference=self.reference, limit=self.limit, shewhart=self.shewhart)

    def arl(self, shift: float = 0.0) -> float:
        """Average run length from the start."""
        if self.two_sided:
            upper = replace(self, two_sided=False)
            return 1.0 / (1.0 / upper.arl(shift) + 1.0 / upper.arl(-shift))
        matrix = self._by_nodes(shift) if np.isinf(self.shewhart) else self._by_cells(shift)
        return _run_length(matrix[0], matrix)

    def _by_nodes(self, shift: float) -> Array:
        nodes, weights = _quadrature(0.0, self.limit)
        states = np.concatenate([[0.0], nodes])
        change = self.reference - shift - states
        return np.column_stack([scipy.special.ndtr(change), weights * _density(nodes + change[:, None])])

    def _by_cells(self, shift: float) -> Array:
        width = 2.0 * self.limit / (2 * _CELLS - 1)
        states = width * np.arange(_CELLS)
        edges = np.concatenate([[-np.inf], states + width / 2])
        value = np.minimum(edges + self.reference - states[:, None], self.shewhart)
        return np.diff(scipy.special.ndtr(value - shift), axis=1)


def _run_length(first: Array, matrix: Array) -> float:
    """Average run length with the states (n,) after the first run, and those (n, n) after one from each."""
    return float(1.0 + first @ np.linalg.solve(np.eye(len(matrix)) - matrix, np.ones(len(matrix))))


def _density(x: Array) -> Array:
    """Density of the standard normal distribution."""
    found: Array = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    return found


def _quadrature(low: float, high: float) -> tuple[Array, Array]:
    """Gauss–Legendre nodes and weights of an interval."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return low + (nodes + 1.0) * (high - low) / 2.0, weights * (high - low) / 2.0


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise UsageError(f"{value:g} is not above 0", where=name)
