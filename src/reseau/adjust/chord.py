"""The chord method: a batch that keeps its Jacobians while they serve."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..core.data import Array, Mask, Rows
from ..core.errors import UsageError
from .marquardt import LEAST_DAMPING, Marquardt

__all__ = ["Chord", "ValuesFunction"]

ValuesFunction = Callable[[Array, Rows], Array]

_SERVES, _SHRINKS = 0.75, 0.1
"""Part of the decrease predicted that must come true if a Jacobian is to be kept, and part of the one before
that the next may promise."""


class Chord(Marquardt):
    """Corrections from the Jacobian of an earlier iteration, as long as they do what they promise.

    Near the solution they shrink by a nearly constant rate (Kelley 1995, *Iterative Methods for Linear and
    Nonlinear Equations*, 5.4.1), so that a correction times that rate is what is left after it: a problem has
    arrived when this is negligible. Where less is gained than predicted, or corrections shrink slowly, the
    Jacobian is formed anew.

    With the Jacobian A kept, Aᵀ W v = 0 is solved. Where A is by a share e not that of the estimates, these
    differ from those of least squares by e of their standard deviations, and their variance is larger by e²:
    nothing, if the approximate values are good.
    """

    def __init__(self, values: ValuesFunction, *given: Any) -> None:
        super().__init__(*given)
        if self.options.reweight is not None:
            raise UsageError("weights are not renewed where Jacobians are kept", where="adjust_batch")
        self.values = values
        self.kept: Array | None = None
        self.last, (self.slow, self.stale) = np.zeros(len(self.x)), np.zeros((2, len(self.x)), dtype=bool)

    def _arrived(self, rows: Rows, step: Array, predicted: Array) -> Mask:
        last = self.last[rows]
        rate2 = predicted / np.maximum(np.maximum(last, predicted), np.finfo(float).tiny)
        self.slow[rows] = (last > 0) & (predicted > _SHRINKS * last)
        self.last[rows] = predicted
        return self._small(rows, step * np.sqrt(rate2)[:, None], predicted * rate2)

    def _try(self, rows: Rows, trial: Array, predicted: Array) -> None:
        with np.errstate(all="ignore"):
            computed = np.asarray(self.values(trial, rows), dtype=np.float64)
        residuals = np.where(self.missing[rows], 0.0, computed - self.observed[rows])
        cost = self._cost(residuals, trial, rows)
        serves = (self.cost[rows] - cost > _SERVES * predicted) & ~self.slow[rows]
        some = rows[serves]
        if len(some):
            assert self.kept is not None
            self.x[some], self.residuals[some], self.cost[some] = (
                trial[serves],
                residuals[serves],
                cost[serves],
            )
            misfit = (self.mean[some] - trial[serves]) * self.prior_weight
            short = residuals[serves, :, None].astype(self.kept.dtype, copy=False)
            self.gradient[some] = misfit - (self.kept[some] @ short)[:, :, 0]
            self.stale[some], self.growth[some] = True, 2.0
            self.damping[some] = np.maximum(self.damping[some] / 3, LEAST_DAMPING)
        if not serves.all():
            self.last[rows[~serves]] = 0.0
            # One that is not of the present place is formed there first; else the step is to blame.
            old, fresh = ~serves & self.stale[rows], ~serves & ~self.stale[rows]
            if old.any():
                again = rows[old]
                self._accept(again, self.x[again], *self._evaluate(self.x[again], again))
            if fresh.any():
                super()._try(rows[fresh], trial[fresh], predicted[fresh])

    def _formed(self, rows: Rows, weighted: Array) -> None:
        self.stale[rows] = False
        if len(rows) == len(self.x):
            self.kept = weighted
            return
        if self.kept is None:
            self.kept = np.empty((len(self.x), *weighted.shape[1:]), dtype=weighted.dtype)
        self.kept[rows] = weighted
