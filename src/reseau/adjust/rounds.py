"""One problem adjusted again and again with other weights."""

from __future__ import annotations

from typing import Generic

import numpy as np
import scipy.special

from ..core.data import Array, Mask
from ..core.failure import Failure
from .engine import Options
from .fitted import Adjustable, F
from .problem import GaussHelmert
from .stochastic import Weighting, blocks_of

__all__ = ["Rounds"]


class Rounds(Generic[F]):
    """A problem adjusted again and again with other weights, each time from the last estimates."""

    def __init__(self, problem: Adjustable[F], options: Options | None) -> None:
        self.problem, self.options, self.start = problem, options, problem
        shape = problem.observations.shape
        self.base = np.ones(shape) if problem.weights is None else problem.weights
        self.marks = problem.marks
        blocks = blocks_of(problem.covariance, shape)
        self.whitening = Weighting(blocks)
        diagonal = [np.diagonal(part, axis1=1, axis2=2).ravel() for part in blocks]
        self.sigma: Array = np.sqrt(np.concatenate(diagonal)).reshape(shape)
        self.eligible: Mask = ~self.whole(np.asarray(self.base == 0, dtype=bool))
        # Median of what `standardised` gives for normal errors: of χ with one degree of freedom.
        self.median = float(scipy.special.ndtri(0.75))

    def adjust(self, out: Mask, factors: Array | None = None) -> F | Failure:
        """The adjustment with some left out, and with factors on the weights of the others."""
        weights = np.where(out, 0.0, self.base if factors is None else self.base * factors)
        fit = self.start.with_weights(weights).adjusted(self.options)
        if not isinstance(fit, Failure):
            self.start = self.start.continued(fit)
        return fit

    def standardised(self, fit: F) -> Array:
        """|v|/σ of each observation, with σ as it was given.

        For marks of conditions √(vᵀPv / c) of their c conditions, the same for all coordinates of the mark.
        """
        base = np.sqrt(np.where(self.eligible, self.base, 1.0))
        if self.marks is None or not isinstance(self.problem, GaussHelmert):
            return np.abs(fit.residuals) / self.sigma * base
        v, k = fit.residuals * base, self.base.shape[1]
        conditions = fit.solution.influence[0].matrices.shape[2]
        self.median = float(np.sqrt(scipy.special.chdtri(conditions, 0.5) / conditions))
        whitened = self.whitening.whiten(v.ravel()).reshape(v.shape)
        length = np.sqrt((whitened**2).sum(axis=1) / conditions)
        return np.repeat(length[:, None], k, axis=1)

    def whole(self, mask: Mask) -> Mask:
        """The mask with whole marks."""
        if self.marks is None:
            return mask
        touched = np.zeros(int(self.marks.max(initial=-1)) + 1, dtype=bool)
        touched[self.marks[mask]] = True
        whole: Mask = touched[self.marks]
        return whole

    def mark(self, place: tuple[int, ...]) -> Mask | tuple[int, ...]:
        """What leaves together with one observation."""
        return place if self.marks is None else np.asarray(self.marks == self.marks[place])
