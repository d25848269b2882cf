"""Variance components: how good each group of observations really is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reseau.data import Array
from reseau.errors import UsageError

from .engine import Options
from .fitted import Adjustable, F, Failure
from .stochastic import blocks_of

__all__ = ["VarianceComponents", "variance_components"]


@dataclass(frozen=True, eq=False)
class VarianceComponents(Generic[F]):
    """Estimated factors on the standard deviations of groups; truthy.

    Parameters
    ----------
    names : tuple of str (g,)
        Groups.
    factors : ndarray (g,)
        The true standard deviations over those given.
    sigma : ndarray (g,)
        Standard deviations of the factors, to first order factor/√(2·redundancy).
    redundancy : ndarray (g,)
        Redundancy of each group.
    adjustment : Adjustment
        With the weights so found; its variance factor is one.
    iterations : int
        Adjustments needed.
    """

    names: tuple[str, ...]
    factors: Array
    sigma: Array
    redundancy: Array
    adjustment: F
    iterations: int

    def __bool__(self) -> bool:
        return True

    def __getitem__(self, name: str) -> float:
        return float(self.factors[self.names.index(name)])

    def required(self) -> VarianceComponents[F]:
        """The components themselves; see :meth:`Failure.required`."""
        return self


def variance_components(
    problem: Adjustable[F],
    groups: Mapping[str, ArrayLike],
    options: Options | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 100,
) -> VarianceComponents[F] | Failure:
    """Estimate one variance factor for each group of observations.

    Parameters
    ----------
    problem : GaussMarkov, GaussHelmert, or any Adjustable
        With the covariance as far as it is known.
    groups : mapping of str to array_like of bool
        Masks of the observations' shape. Observations in no group keep their variance.
    options : Options, optional
        How to adjust.
    tolerance : float
        Relative change of all factors at which they have converged.
    max_iterations : int
        Adjustments at most.

    Returns
    -------
    VarianceComponents or Failure
        A failure when an adjustment fails, a group has next to no redundancy, or the factors do not settle.

    Raises
    ------
    UsageError
        When groups overlap, are empty, or are correlated with what is outside them.

    Notes
    -----
    σ̂² = vᵀPv / Σr of each group, iterated (Förstner 1979, *Ein Verfahren zur Schätzung von Varianz- und
    Kovarianzkomponenten*, AVN 86); at convergence that of Helmert and of restricted maximum likelihood.
    """
    names, label = tuple(groups), _labels(problem, groups)
    base = np.ones(problem.observations.size) if problem.weights is None else problem.weights.ravel()
    variance, start = np.ones(len(names)), problem
    for iteration in range(1, max_iterations + 1):
        inverse = np.append(1.0 / variance, 1.0)
        weights = (base * inverse[label]).reshape(problem.observations.shape)
        fit = start.with_weights(weights).adjusted(options)
        if isinstance(fit, Failure):
            return fit
        start = start.continued(fit)
        numbers, squares = fit.redundancy_numbers.ravel(), fit.weighted_squares.ravel()
        r: Array = np.bincount(label, numbers, len(names) + 1)[:-1].astype(np.float64)
        if r.min() < 1e-6:
            weak = names[int(np.argmin(r))]
            return Failure(f"the group {weak} has no redundancy to estimate its variance from")
        change = np.bincount(label, squares, len(names) + 1)[:-1] / r
        variance = variance * change
        if not (variance > 0).all():
            return Failure(f"the group {names[int(np.argmin(variance))]} has no residuals at all")
        if np.abs(change - 1.0).max() < tolerance:
            factors = np.sqrt(variance)
            return VarianceComponents(names, factors, factors / np.sqrt(2.0 * r), r, fit, iteration)
    return Failure(f"the variance components have not settled in {max_iterations} adjustments")


def _labels(problem: Adjustable[F], groups: Mapping[str, ArrayLike]) -> NDArray[np.intp]:
    """Number of the group of each observation (n,); one more for none."""
    label = np.full(problem.observations.size, len(groups), dtype=np.intp)
    for number, (name, given) in enumerate(groups.items()):
        mask = np.asarray(given)
        if mask.dtype != bool or mask.shape != problem.observations.shape or not mask.any():
            raise UsageError(
                f"must be a mask {problem.observations.shape} with something in it", where=f"group {name}"
            )
        if (label[mask.ravel()] < len(groups)).any():
            raise UsageError("overlaps with another", where=f"group {name}")
        label[mask.ravel()] = number
    start = 0
    for blocks in blocks_of(problem.covariance, problem.observations.shape):
        b, k, _ = blocks.shape
        own = label[start : start + b * k].reshape(b, k)
        if ((own[:, :, None] != own[:, None, :]) & (blocks != 0)).any():
            raise UsageError("are correlated with one another", where="groups")
        start += b * k
    return label
