"""One problem adjusted again and again with other weights."""

from __future__ import annotations

import numpy as np
import scipy.special

from reseau.data import Array, Mask

from .engine import Options, adjust
from .problem import GaussHelmert, Problem
from .result import Adjustment, Failure
from .stochastic import Weighting, blocks_of

__all__ = ["Rounds"]


class Rounds:
    """A problem adjusted again and again with other weights, each time from the last estimates."""

    def __init__(self, problem: Problem, options: Options | None) -> None:
        self.problem, self.options = problem, options
        shape = problem.observations.shape
        self.base = np.ones(shape) if problem.weights is None else problem.weights
        self.marks = isinstance(problem, GaussHelmert) and len(shape) == 2
        blocks = blocks_of(problem.covariance, shape)
        self.marks = self.marks and all(part.shape[1] in (1, shape[1]) for part in blocks)
        self.whitening = Weighting(blocks)
        diagonal = [np.diagonal(part, axis1=1, axis2=2).ravel() for part in blocks]
        self.sigma: Array = np.sqrt(np.concatenate(diagonal)).reshape(shape)
        self.parameters = problem.parameters
        self.eligible: Mask = ~self.whole(np.asarray(self.base == 0, dtype=bool))
        # Median of what `standardised` gives for normal errors: of χ with one degree of freedom.
        self.median = float(scipy.special.ndtri(0.75))

    def adjust(self, out: Mask, factors: Array | None = None) -> Adjustment | Failure:
        """The adjustment with some left out, and with factors on the weights of the others."""
        weights = np.where(out, 0.0, self.base if factors is None else self.base * factors)
        problem = self.problem.with_weights(weights).with_parameters(self.parameters)
        fit = adjust(problem, self.options)
        # Inner constraints refer to the approximate values, which therefore stay.
        if isinstance(fit, Adjustment) and not self.problem.datum:
            self.parameters = fit.parameters
        return fit

    def standardised(self, fit: Adjustment) -> Array:
        """|v|/σ of each observation, with σ as it was given.

        For marks √(vᵀPv / c) of their c conditions, the same for all coordinates of the mark.
        """
        base = np.sqrt(np.where(self.eligible, self.base, 1.0))
        if not self.marks:
            return np.abs(fit.residuals) / self.sigma * base
        v, k = fit.residuals * base, self.base.shape[1]
        conditions = fit.solution.influence[0].matrices.shape[2]
        self.median = float(np.sqrt(scipy.special.chdtri(conditions, 0.5) / conditions))
        whitened = self.whitening.whiten(v.ravel()).reshape(v.shape)
        length = np.sqrt((whitened**2).sum(axis=1) / conditions)
        return np.repeat(length[:, None], k, axis=1)

    def whole(self, mask: Mask) -> Mask:
        """The mask with whole marks."""
        if not self.marks:
            return mask
        whole: Mask = np.repeat(mask.any(axis=1, keepdims=True), mask.shape[1], axis=1)
        return whole

    def mark(self, place: tuple[int, ...]) -> tuple[int, ...]:
        """What leaves together with one observation."""
        return place[:1] if self.marks else place
