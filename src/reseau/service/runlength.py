"""Run lengths of control charts: how many runs until a chart signals, with and without a shift.

The run length of a chart is the time until absorption of a Markov process. Its mean from the state s solves
the integral equation L(s) = 1 + ∫ L(x) f(x | s) dx over the states x without a signal (Page 1954; Crowder
1987). With Gauss–Legendre nodes it becomes the linear system (I − Q) L = 1. A CUSUM chart that is combined
with a Shewhart limit has a density that is cut off; there Q is the Markov chain of Brook and Evans (1972).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from ..core.data import Array
from ..core.errors import UsageError

_NODES = 80
_CELLS = 400
_HEADROOM = 1e-10
"""Probability in each tail of the distribution of an estimate that is cut off."""


@dataclass(frozen=True, eq=False)
class Transition:
    """One step of a chart between the states without a signal.

    Parameters
    ----------
    first : ndarray (n,)
        Probabilities (with the weights of the quadrature) of the states after the first run.
    matrix : ndarray (n, n)
        Those after a further run, from each state.

    Examples
    --------
    >>> half = Transition(np.array([0.5]), np.array([[0.5]]))
    >>> half.arl, half.survival(3).tolist()
    (2.0, [0.5, 0.25, 0.125])
    """

    first: Array
    matrix: Array

    @cached_property
    def remaining(self) -> Array:
        """Mean number of further runs from each state (n,)."""
        n = len(self.matrix)
        return np.asarray(np.linalg.solve(np.eye(n) - self.matrix, np.ones(n)), dtype=np.float64)

    @property
    def arl(self) -> float:
        """Average run length from the start."""
        return float(1.0 + self.first @ self.remaining)

    def survival(self, runs: int) -> Array:
        """Probabilities (runs,) that the first 1, 2, … runs give no signal."""
        found = np.empty(runs)
        state: Array = self.first
        for k in range(runs):
            found[k] = state.sum()
            state = state @ self.matrix
        return found

    def after(self, runs: int | None) -> Array:
        """States (n,) after `runs` runs without a signal; None: after very many."""
        if runs is None:
            values, vectors = np.linalg.eig(self.matrix.T)
            state = np.abs(vectors[:, np.argmax(values.real)].real)
        else:
            state = self.first
            for _ in range(runs - 1):
                state = state @ self.matrix
        found: Array = state / state.sum()
        return found


class Chart(ABC):
    """A control chart of independent standard normal values whose mean may shift."""

    @abstractmethod
    def transition(self, shift: float) -> Transition:
        """Return one step of the chart for values with the mean `shift`."""

    def arl(self, shift: float = 0.0) -> float:
        """Average run length from the start, when the mean is `shift` from the first run on.

        Parameters
        ----------
        shift : float
            Mean of the values, in standard deviations.
        """
        return self.transition(shift).arl

    def delay(self, shift: float, after: int | None = None) -> float:
        """Average number of runs from a shift to the signal, given that there was none before.

        Parameters
        ----------
        shift : float
            Mean of the values after the shift, in standard deviations; before it is 0.
        after : int, optional
            Number of runs before the shift; None: very many (the conditional steady state).
        """
        if after == 0:
            return self.arl(shift)
        return float(self.transition(0.0).after(after) @ self.transition(shift).remaining)


@dataclass(frozen=True)
class Shewhart(Chart):
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

    def transition(self, shift: float) -> Transition:
        """Return one step; there is one state."""
        inside = scipy.special.ndtr(self.limit - shift) - scipy.special.ndtr(-self.limit - shift)
        return Transition(np.array([inside]), np.array([[inside]]))


@dataclass(frozen=True)
class Ewma(Chart):
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

    def transition(self, shift: float) -> Transition:
        """Return one step between the nodes of the quadrature."""
        edge = self.limit * np.sqrt(self.weight / (2.0 - self.weight))
        nodes, weights = _quadrature(-edge, edge)

        def density(start: Array) -> Array:
            to = (nodes - (1.0 - self.weight) * start[:, None]) / self.weight
            found: Array = weights * _density(to - shift) / self.weight
            return found

        return Transition(density(np.zeros(1))[0], density(nodes))


@dataclass(frozen=True)
class Cusum(Chart):
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
        1/L = 1/L⁺ + 1/L⁻ (Van Dobben de Bruyn 1968; exact without a Shewhart limit); only the average run
        length from the start is available.

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
        """Average run length from the start; see :meth:`Chart.arl`."""
        if not self.two_sided:
            return super().arl(shift)
        upper = replace(self, two_sided=False)
        return 1.0 / (1.0 / upper.arl(shift) + 1.0 / upper.arl(-shift))

    def transition(self, shift: float) -> Transition:
        """Return one step of the upper sum.

        Raises
        ------
        UsageError
            If the chart is two-sided.
        """
        if self.two_sided:
            raise UsageError("has two sums", where="CUSUM chart", do="use `two_sided=False`")
        return self._by_nodes(shift) if np.isinf(self.shewhart) else self._by_cells(shift)

    def _by_nodes(self, shift: float) -> Transition:
        nodes, weights = _quadrature(0.0, self.limit)
        states = np.concatenate([[0.0], nodes])
        change = self.reference - shift - states
        matrix = np.column_stack([scipy.special.ndtr(change), weights * _density(nodes + change[:, None])])
        return Transition(matrix[0], matrix)

    def _by_cells(self, shift: float) -> Transition:
        width = 2.0 * self.limit / (2 * _CELLS - 1)
        states = width * np.arange(_CELLS)
        edges = np.concatenate([[-np.inf], states + width / 2])
        value = np.minimum(edges + self.reference - states[:, None], self.shewhart)
        matrix = np.diff(scipy.special.ndtr(value - shift), axis=1)
        return Transition(matrix[0], matrix)


@dataclass(frozen=True)
class Prerun:
    """A chart whose mean, standard deviation or both were estimated from earlier runs.

    Parameters
    ----------
    chart : Chart
        The chart with its nominal limits.
    runs : int
        Number of earlier runs m.
    estimated : {"mean", "sigma", "both"}
        What was estimated.

    Notes
    -----
    The average run length is that over all possible estimates (Jones, Champ and Rigdon 2001): the mean is
    normal with the variance 1/m, the variance is χ²/(m − 1). It is large when sigma is estimated, because of
    the few series in which sigma was estimated far too large; it says little about the rate of false alarms.

    Examples
    --------
    >>> round(Prerun(Ewma(0.1, 2.7), 20, "mean").arl(), 1)
    187.0
    """

    chart: Ewma | Shewhart | Cusum
    runs: int
    estimated: Literal["mean", "sigma", "both"] = "both"

    def __post_init__(self) -> None:
        if self.runs < 2:
            raise UsageError(f"{self.runs} is too small", where="runs", do="use at least 2")

    def arl(self, shift: float = 0.0) -> float:
        """Average run length from the start, over all possible estimates; see :meth:`Chart.arl`."""
        means, mean_weights = np.zeros(1), np.ones(1)
        sigmas, sigma_weights = np.ones(1), np.ones(1)
        if self.estimated != "sigma":
            scale = 1.0 / np.sqrt(self.runs)
            means, mean_weights = _expectation(scipy.stats.norm(0.0, scale).ppf, _normal(scale))
        if self.estimated != "mean":
            degrees = self.runs - 1
            sigmas, sigma_weights = _expectation(
                lambda p: np.sqrt(scipy.stats.chi2.ppf(p, degrees) / degrees),
                lambda s: scipy.stats.chi2.pdf(degrees * s * s, degrees) * 2.0 * degrees * s,
            )
        total = 0.0
        for sigma, weight in zip(sigmas, sigma_weights, strict=True):
            chart = _scaled(self.chart, float(sigma))
            by_mean = [_in_units(chart, self.chart, float(sigma), shift - mean) for mean in means]
            total += weight * float(mean_weights @ by_mean)
        return float(total)


def _scaled(chart: Ewma | Shewhart | Cusum, sigma: float) -> Ewma | Shewhart | Cusum:
    """The chart of true standard normal values that acts as `chart` does on values divided by sigma."""
    if isinstance(chart, Cusum):
        return replace(
            chart,
            reference=chart.reference * sigma,
            limit=chart.limit * sigma,
            shewhart=chart.shewhart * sigma,
        )
    return replace(chart, limit=chart.limit * sigma)


def _in_units(chart: Chart, nominal: Chart, sigma: float, shift: float) -> float:
    """Run length of a scaled chart; `nominal` and sigma are named where it cannot be computed."""
    found = chart.arl(shift)
    if not np.isfinite(found) or found < 1:
        raise UsageError(
            f"has no finite run length for an estimated sigma of {sigma:.3g}", where=repr(nominal)
        )
    return found


def _expectation(quantile: Callable[[float], float], pdf: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Nodes and weights of an expectation over a distribution, without its far tails."""
    nodes, weights = _quadrature(float(quantile(_HEADROOM / 2)), float(quantile(1.0 - _HEADROOM / 2)), 30)
    return nodes, weights * pdf(nodes)


def _normal(scale: float) -> Callable[[Array], Array]:
    return lambda x: _density(x / scale) / scale


def _density(x: Array) -> Array:
    """Density of the standard normal distribution."""
    found: Array = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    return found


def _quadrature(low: float, high: float, count: int = _NODES) -> tuple[Array, Array]:
    """Gauss–Legendre nodes and weights of an interval."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return low + (nodes + 1.0) * (high - low) / 2.0, weights * (high - low) / 2.0


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise UsageError(f"{value:g} is not above 0", where=name)
