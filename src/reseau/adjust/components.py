"""Variance components: one estimated variance factor for each group of observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array
from ..core.errors import UsageError
from ..core.failure import Code, Estimated, Failure
from .engine import Options
from .fitted import Adjustable, F
from .stochastic import blocks_of

# Greatest change of the logarithm of a variance in a step of scoring.
_STEP = 1.5


@dataclass(frozen=True, eq=False)
class VarianceComponents(Estimated, Generic[F]):
    """Estimated factors on the standard deviations of groups; truthy.

    Parameters
    ----------
    names : tuple of str (g,)
        Groups.
    factors : ndarray (g,)
        Estimated standard deviations over the input ones.
    sigma : ndarray (g,)
        Standard deviations of the factors, to first order; factor/√(2·redundancy) where groups are not
        correlated with each other.
    redundancy : ndarray (g,)
        Redundancy of each group.
    adjustment : Adjustment
        With the estimated weights; its variance factor is one.
    iterations : int
        Number of adjustments.

    Examples
    --------
    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> lengths = [10.0, 10.1, 9.9, 10.0, 10.4, 9.6, 10.3, 9.7]
    >>> first = np.arange(8) < 4
    >>> problem = GaussMarkov(lambda x: np.repeat(x, 8), lengths, 0.1, Parameters("l", [10.0]))
    >>> found = variance_components(problem, {"tape": first, "pacing": ~first}).required()
    >>> found.names, found["pacing"] > 3 * found["tape"], found.redundancy.sum().round(6).item()
    (('tape', 'pacing'), True, 7.0)
    """

    names: tuple[str, ...]
    factors: Array
    sigma: Array
    redundancy: Array
    adjustment: F
    iterations: int

    def __getitem__(self, name: str) -> float:
        return float(self.factors[self.names.index(name)])


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
        With the input covariance.
    groups : mapping of str to array_like of bool
        Masks of the observations' shape. Observations in no group keep their variance. Groups may be
        correlated with each other: the correlations are kept, the standard deviations are multiplied.
    options : Options, optional
        Options of each adjustment.
    tolerance : float
        The factors have converged when none changes by more than this, relatively.
    max_iterations : int
        Maximum number of adjustments.

    Returns
    -------
    VarianceComponents or Failure
        A failure when an adjustment fails, a group has almost no redundancy, or the factors do not converge.

    Raises
    ------
    UsageError
        When groups overlap or are empty.

    Notes
    -----
    σ̂² = Σ vᵢ(Pv)ᵢ / Σr of each group, iterated (Förstner 1979, *Ein Verfahren zur Schätzung von Varianz- und
    Kovarianzkomponenten*, AVN 86); at convergence that of Helmert and of restricted maximum likelihood. With
    C = F C₀ F, F diagonal, the score of the logarithm of a factor is Σ vᵢ(Pv)ᵢ less its expectation
    Σ(QᵥᵥP)ᵢᵢ, also where C₀ correlates the groups. These are then found by scoring, with the information
    A = (N + Σ C⁻¹∘C)/2 of two groups, N diagonal of their sizes, in the proportion of their redundancy.

    Examples
    --------
    Four measurements with each of two instruments, all with an input sigma of 0.1:

    >>> from reseau.adjust import GaussMarkov, Parameters
    >>> lengths = [10.0, 10.1, 9.9, 10.0, 10.4, 9.6, 10.3, 9.7]
    >>> first = np.arange(8) < 4
    >>> problem = GaussMarkov(lambda x: np.repeat(x, 8), lengths, 0.1, Parameters("l", [10.0]))
    >>> found = variance_components(problem, {"tape": first, "pacing": ~first}).required()
    >>> found.factors.round(2).tolist(), found.sigma.round(2).tolist()
    ([0.81, 3.56], [0.33, 1.27])
    """
    names = tuple(groups)
    label, information = _labels(problem, groups)
    size, correlated = np.bincount(label, minlength=len(names) + 1)[:-1], bool(np.triu(information, 1).any())
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
            return Failure(
                f"the group {weak} has no redundancy to estimate its variance from", Code.NO_REDUNDANCY
            )
        change = np.bincount(label, squares, len(names) + 1)[:-1] / r
        part = np.sqrt(r / size)
        weight = information * np.outer(part, part)
        if correlated:
            step = np.linalg.solve(weight, (change - 1.0) * r)
            variance = variance * np.exp(np.clip(step, -_STEP, _STEP))
        elif (change > 0).all():
            variance = variance * change
        else:
            return Failure(
                f"the group {names[int(np.argmin(change))]} has no residuals at all", Code.NOT_IDENTIFIED
            )
        if np.abs(change - 1.0).max() < tolerance:
            factors = np.sqrt(variance)
            sigma = factors * np.sqrt(np.diag(np.linalg.inv(weight)) / 2.0)
            return VarianceComponents(names, factors, sigma, r, fit, iteration)
    return Failure(
        f"the variance components have not converged in {max_iterations} adjustments", Code.NOT_CONVERGED
    )


def _labels(problem: Adjustable[F], groups: Mapping[str, ArrayLike]) -> tuple[NDArray[np.intp], Array]:
    """Number of the group of each observation (n,), one more for none; and A (g, g), were all redundant."""
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
    start, g = 0, len(groups) + 1
    sums = np.diag(np.bincount(label, minlength=g).astype(np.float64))
    for blocks in blocks_of(problem.covariance, problem.observations.shape):
        b, k, _ = blocks.shape
        own = label[start : start + b * k].reshape(b, k)
        product = blocks * np.linalg.inv(blocks)
        i, j = np.broadcast_arrays(own[:, :, None], own[:, None, :])
        np.add.at(sums, (i.ravel(), j.ravel()), product.ravel())
        start += b * k
    information: Array = sums[:-1, :-1] / 2.0
    return label, information
