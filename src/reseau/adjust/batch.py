"""Many small Gauss–Markov problems of one shape, adjusted side by side.

The mathematics is that of :func:`reseau.adjust.adjust`, vectorised over a leading axis, so that hundreds of
image patches are matched in the time of a few. The problems are independent: each has its own damping and
ends when it has converged; one without a solution is marked and does not affect the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array, Mask, Rows
from ..core.errors import UsageError
from ..core.threads import one_thread

BatchFunction = Callable[[Array, Rows], tuple[Array, Array]]
ValuesFunction = Callable[[Array, Rows], Array]
Reweight = Callable[[Array], Array]

_EPS = float(np.finfo(np.float64).eps)
# Normal equations, scaled to a unit diagonal, are singular if their smallest eigenvalue is below this.
_SINGULAR = 1e-12
_LEAST_DAMPING, _MOST_DAMPING = 1e-10, 1e12
_MAD_TO_SIGMA = 1.4826
_SERVES, _SHRINKS = 0.75, 0.1
"""A Jacobian is kept if the decrease is more than the first share of the predicted one, and the predicted
decrease at most the second share of the previous prediction."""


class BatchReason(IntEnum):
    """Why the iteration of a problem ended.

    Examples
    --------
    >>> BatchReason(2).name
    'SINGULAR'
    """

    CONVERGED = 0
    MAX_ITERATIONS = 1
    SINGULAR = 2
    DIVERGED = 3
    NOT_FINITE = 4


@dataclass(frozen=True)
class BatchOptions:
    """Options of :func:`adjust_batch`.

    Parameters
    ----------
    max_iterations : int
        Maximum number of evaluations after that at the initial values.
    tolerance : array_like (u,) or float, optional
        A problem has converged when no parameter is corrected by more than this, in the parameter's unit.
        By default `share` decides.
    share : float
        A problem has converged when the correction is below this fraction of its own standard deviation; the
        variance then increases by at most its square. Must not be given together with `tolerance`.
    damping : float
        Initial Levenberg–Marquardt damping, relative to the unit diagonal of the scaled normal equations.
    reweight : callable, optional
        `reweight(t)` with t (m, n), the residuals over a robust scale (1.4826 × the median of their absolute
        values, of each problem), gives factors (m, n) on the weights in [0, 1]; see
        :func:`reseau.adjust.weight_function`. Evaluated in each iteration.

    Raises
    ------
    UsageError
        For values out of range, or when both `tolerance` and `share` are given.

    Examples
    --------
    >>> BatchOptions(max_iterations=7, share=0.05).damping
    0.001
    """

    max_iterations: int = 20
    tolerance: ArrayLike | None = None
    share: float = 1e-4
    damping: float = 1e-3
    reweight: Reweight | None = None

    def __post_init__(self) -> None:
        if self.max_iterations < 0 or not self.share > 0 or not self.damping > 0:
            raise UsageError(
                "share and damping must be positive, max_iterations not negative", where="BatchOptions"
            )
        if self.tolerance is not None and self.share != BatchOptions.share:
            raise UsageError("must not be given together", where="BatchOptions.tolerance and share")


@dataclass(frozen=True, eq=False)
class BatchAdjustment:
    """Results of :func:`adjust_batch`, in columns over the k problems.

    Parameters
    ----------
    estimates : ndarray (k, u)
        Estimated parameters; for problems that did not converge, those of the last iteration.
    cofactor : ndarray (k, u, u)
        Inverse of the normal equations; NaN where they are singular. The covariance is `sigma0² · cofactor`.
    residuals : ndarray (k, n)
        Adjusted minus observed, in the unit of the observations.
    sigma0 : ndarray (k,)
        Standard deviation of unit weight; NaN without redundancy.
    redundancy : ndarray (k,)
        Observations of weight above zero, and priors, less parameters.
    converged : ndarray of bool (k,)
        Problems with a usable result.
    iterations : ndarray of int (k,)
        Number of evaluations of each after the initial one.
    reasons : ndarray of int (k,)
        One :class:`BatchReason` each.
    factors : ndarray (k, n)
        Final factors of `reweight`; ones without it.

    Examples
    --------
    >>> line = lambda x, rows: (x * [1.0, 2.0, 3.0], np.tile([[1.0], [2.0], [3.0]], (len(rows), 1, 1)))
    >>> fit = adjust_batch(line, [[1.0], [1.0]], [[1.0, 2.0, 3.0], [2.1, 3.9, 6.0]])
    >>> len(fit), fit.converged.tolist(), fit.redundancy.tolist()
    (2, [True, True], [2, 2])
    >>> fit.estimates[:, 0].round(3).tolist(), fit.sigma[:, 0].round(3).tolist()
    ([1.0, 1.993], [0.0, 0.026])
    """

    estimates: Array
    cofactor: Array
    residuals: Array
    sigma0: Array
    redundancy: NDArray[np.int64]
    converged: Mask
    iterations: NDArray[np.int64]
    reasons: NDArray[np.int64]
    factors: Array

    def __len__(self) -> int:
        return len(self.estimates)

    @property
    def covariance(self) -> Array:
        """Covariance of the estimates a posteriori, (k, u, u); NaN without redundancy."""
        return np.asarray(self.cofactor * (self.sigma0**2)[:, None, None])

    @property
    def sigma(self) -> Array:
        """Standard deviations of the estimates a posteriori, (k, u)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))


class _Marquardt:
    """State of all problems during the iteration."""

    def __init__(
        self,
        function: BatchFunction,
        initial: ArrayLike,
        observations: ArrayLike,
        weights: ArrayLike | None,
        prior: tuple[ArrayLike, ArrayLike] | None,
        options: BatchOptions,
    ) -> None:
        self.function, self.options = function, options
        self.x = np.array(initial, dtype=np.float64)
        observed = np.asarray(observations, dtype=np.float64)
        if self.x.ndim != 2 or observed.ndim != 2 or len(self.x) != len(observed):
            raise UsageError(
                f"initial values {self.x.shape} and observations {observed.shape} must be (k, u), (k, n)",
                where="adjust_batch",
            )
        (k, u), n = self.x.shape, observed.shape[1]
        w = np.ones((k, n)) if weights is None else np.asarray(weights, dtype=np.float64)
        if w.shape != (k, n) or not (w >= 0).all() or not np.isfinite(w).all():
            raise UsageError(f"must be {(k, n)}, finite and not negative", where="adjust_batch weights")
        self.weights, self.missing = w, w == 0
        if not np.isfinite(observed[~self.missing]).all():
            raise UsageError("are not finite at weights above zero", where="observations of adjust_batch")
        self.observed = np.where(self.missing, 0.0, observed)
        self._set_prior(prior)
        tolerance = options.tolerance
        self.tolerance = None if tolerance is None else np.broadcast_to(np.asarray(tolerance, float), (u,))
        # Sums of squares below this are rounding of the observations.
        self.floor = n * _EPS**2 * (w * self.observed**2).sum(axis=1)
        self.normal, self.gradient = np.zeros((k, u, u)), np.zeros((k, u))
        self.cost, self.factors = np.full(k, np.inf), np.ones((k, n))
        self.residuals = np.full((k, n), np.nan)
        self.damping, self.growth = np.full(k, options.damping), np.full(k, 2.0)
        self.iterations = np.zeros(k, dtype=np.int64)
        self.reasons = np.full(k, int(BatchReason.MAX_ITERATIONS), dtype=np.int64)
        self.active = np.ones(k, dtype=bool)

    def _set_prior(self, prior: tuple[ArrayLike, ArrayLike] | None) -> None:
        k, u = self.x.shape
        self.mean, self.prior_weight = self.x.copy(), np.zeros(u)
        if prior is not None:
            mean, sigma = np.asarray(prior[0], float), np.asarray(prior[1], float)
            if sigma.shape != (u,) or not (sigma > 0).all():
                raise UsageError(f"sigmas should be ({u},) and above zero", where="prior of adjust_batch")
            self.prior_weight = 1.0 / sigma**2
            self.mean = np.where(np.isinf(sigma), self.x, np.broadcast_to(mean, (k, u)))
        observed = (~self.missing).sum(axis=1) + np.count_nonzero(self.prior_weight)
        self.redundancy = (observed - u).astype(np.int64)

    def start(self) -> None:
        """Evaluate at the initial values."""
        rows = np.arange(len(self.x))
        residuals, jacobian = self._evaluate(self.x, rows)
        cost = self._cost(residuals, self.x, rows)
        finite = np.isfinite(cost) & np.isfinite(jacobian).all(axis=(1, 2))
        self._leave(rows[~finite], BatchReason.NOT_FINITE)
        self._leave(rows[finite & (self.redundancy < 0)], BatchReason.SINGULAR)
        self._accept(rows[finite], self.x[finite], residuals[finite], jacobian[finite])

    def iterate(self) -> bool:
        """Correct every active problem once; return False when no problem is active any more."""
        rows = np.flatnonzero(self.active)
        step, predicted = self._step(rows)
        done = self._arrived(rows, step, predicted)
        # The last, negligible correction is applied to the estimates; the function is not evaluated again.
        self.x[rows[done]] += step[done]
        self._leave(rows[done], BatchReason.CONVERGED)
        rows, step, predicted = rows[~done], step[~done], predicted[~done]
        if not len(rows):
            return False
        self.iterations[rows] += 1
        self._try(rows, self.x[rows] + step, predicted)
        return bool(self.active.any())

    def _arrived(self, rows: Rows, step: Array, predicted: Array) -> Mask:
        """Mask of problems that have converged with this correction."""
        return self._small(rows, step, predicted)

    def _try(self, rows: Rows, trial: Array, predicted: Array) -> None:
        """Evaluate the problems `rows` at `trial`, accept it where the sum of squares decreases."""
        residuals, jacobian = self._evaluate(trial, rows)
        cost = self._cost(residuals, trial, rows)
        gain = (self.cost[rows] - cost) / np.maximum(predicted, np.finfo(float).tiny)
        good = (gain > 1e-4) & np.isfinite(jacobian).all(axis=(1, 2))
        taken, refused = rows[good], rows[~good]
        kept = slice(None) if good.all() else good  # no copy where all are taken
        self._accept(taken, trial[kept], residuals[kept], jacobian[kept])
        shrink = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.minimum(gain[good], 1.0) - 1.0) ** 3)
        self.damping[taken] = np.maximum(self.damping[taken] * shrink, _LEAST_DAMPING)
        self.growth[taken] = 2.0
        self.damping[refused] *= self.growth[refused]
        self.growth[refused] *= 2.0
        self._leave(refused[self.damping[refused] > _MOST_DAMPING], BatchReason.DIVERGED)

    def finish(self) -> BatchAdjustment:
        """Compute cofactors and results from the last normal equations."""
        # Problems still active when the iterations end may have converged in the last one.
        rows = np.flatnonzero(self.active)
        self._leave(rows[self._small(rows, *self._step(rows))], BatchReason.CONVERGED)
        scaled, scale = self._scaled(np.arange(len(self.x)))
        values, vectors = np.linalg.eigh(scaled)
        regular = (values[:, 0] > _SINGULAR) & np.isfinite(self.cost)
        inverse = (vectors / np.where(regular[:, None], values, np.nan)[:, None, :]) @ np.swapaxes(
            vectors, 1, 2
        )
        self.reasons[~regular & (self.reasons != BatchReason.NOT_FINITE)] = BatchReason.SINGULAR
        determined = self.redundancy > 0
        sigma0 = np.full(len(self.x), np.nan)
        determined &= np.isfinite(self.cost)
        sigma0[determined] = np.sqrt(self.cost[determined] / self.redundancy[determined])
        return BatchAdjustment(
            estimates=self.x,
            cofactor=inverse * scale[:, :, None] * scale[:, None, :],
            residuals=self.residuals,
            sigma0=sigma0,
            redundancy=self.redundancy,
            converged=self.reasons == BatchReason.CONVERGED,
            iterations=self.iterations,
            reasons=self.reasons,
            factors=self.factors,
        )

    def _evaluate(self, x: Array, rows: Rows) -> tuple[Array, Array]:
        # What overflows at a bold step is refused by its cost; it need not warn as well.
        with np.errstate(all="ignore"):
            values, jacobian = self.function(x, rows)
        values, jacobian = np.asarray(values, float), _floating(jacobian)
        m, n, u = len(rows), self.observed.shape[1], x.shape[1]
        if values.shape != (m, n) or jacobian.shape != (m, n, u):
            raise UsageError(
                f"gave values {values.shape}, Jacobian {jacobian.shape}, not {(m, n)}, {(m, n, u)}",
                where="function of adjust_batch",
            )
        missing = self.missing[rows]
        residuals = values - self.observed[rows]
        if missing.any():
            residuals = np.where(missing, 0.0, residuals)
            # Weight zero takes care of the rest, and the function's array keeps its layout.
            if not np.isfinite(jacobian).all():
                jacobian = np.where(missing[:, :, None], 0.0, jacobian)
        return residuals, jacobian

    def _cost(self, residuals: Array, x: Array, rows: Rows) -> Array:
        w = self.weights[rows] * self.factors[rows]
        prior = ((x - self.mean[rows]) ** 2 * self.prior_weight).sum(axis=1)
        cost = np.einsum("mn,mn->m", residuals * w, residuals) + prior
        return np.where(np.isfinite(cost), cost, np.inf)

    def _accept(self, rows: Rows, x: Array, residuals: Array, jacobian: Array) -> None:
        """Move the problems `rows` to `x` and form their normal equations there."""
        if not len(rows):
            return
        self.x[rows], self.residuals[rows] = x, residuals
        if self.options.reweight is not None:
            self.factors[rows] = self._robust_factors(rows, residuals)
        self.cost[rows] = self._cost(residuals, x, rows)
        w = self.weights[rows] * self.factors[rows]
        # A Jacobian in single precision is kept so: its products dominate the computing time.
        weighted = np.swapaxes(jacobian * w[:, :, None].astype(jacobian.dtype, copy=False), 1, 2)
        normal: Array = np.asarray(weighted @ jacobian, dtype=np.float64)
        diagonal = np.arange(x.shape[1])
        normal[:, diagonal, diagonal] += self.prior_weight
        self.normal[rows] = normal
        misfit = (self.mean[rows] - x) * self.prior_weight
        self.gradient[rows] = (
            misfit - (weighted @ residuals[:, :, None].astype(jacobian.dtype, copy=False))[:, :, 0]
        )
        self._formed(rows, weighted)

    def _formed(self, rows: Rows, weighted: Array) -> None:
        """Hook for subclasses: called with new Jacobians times weights (m, u, n)."""

    def _robust_factors(self, rows: Rows, residuals: Array) -> Array:
        assert self.options.reweight is not None
        missing = self.missing[rows]
        size = np.abs(residuals) * np.sqrt(self.weights[rows])
        # Missing ones are sorted to the end, so that the median of the others is at half their number.
        ordered = np.sort(np.where(missing, np.inf, size), axis=1)
        count = np.maximum((~missing).sum(axis=1), 1)
        each = np.arange(len(rows))
        scale = _MAD_TO_SIGMA * 0.5 * (ordered[each, (count - 1) // 2] + ordered[each, count // 2])
        scale = np.maximum(np.where(np.isfinite(scale), scale, 1.0), np.sqrt(self.floor[rows]) + 1e-300)
        signed = residuals * np.sqrt(self.weights[rows]) / scale[:, None]
        return np.asarray(self.options.reweight(signed), dtype=np.float64)

    def _scaled(self, rows: Rows) -> tuple[Array, Array]:
        """Normal equations scaled to a unit diagonal, and the scale of the parameters."""
        normal = self.normal[rows]
        diagonal = np.diagonal(normal, axis1=1, axis2=2)
        scale = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 1.0)
        return normal * scale[:, :, None] * scale[:, None, :], scale

    def _step(self, rows: Rows, damping: Array | None = None) -> tuple[Array, Array]:
        """Damped correction (m, u) and the decrease of the sum of squares it predicts (m,)."""
        scaled, scale = self._scaled(rows)
        right = self.gradient[rows] * scale
        index = np.arange(scaled.shape[1])
        damped = scaled.copy()
        damped[:, index, index] += (self.damping[rows] if damping is None else damping)[:, None]
        step = np.linalg.solve(damped, right[:, :, None])[:, :, 0]
        curvature = np.einsum("mi,mij,mj->m", step, scaled, step)
        predicted = 2.0 * (step * right).sum(axis=1) - curvature
        return step * scale, predicted

    def _small(self, rows: Rows, step: Array, predicted: Array) -> Mask:
        """Mask of corrections that are negligible, and not only small because of the damping."""
        small = self._negligible(rows, step, predicted)
        # Near the minimum, rounding errors may reject several steps until the damping makes them small: the
        # step without damping decides.
        held = np.flatnonzero(small & (self.damping[rows] > max(self.options.damping, 1e-2)))
        if len(held):
            free, gain = self._step(rows[held], np.full(len(held), _LEAST_DAMPING))
            small[held] = self._negligible(rows[held], free, gain)
        return np.asarray(small | (predicted <= 10 * _EPS * self.cost[rows] + self.floor[rows]))

    def _negligible(self, rows: Rows, step: Array, predicted: Array) -> Mask:
        if self.tolerance is not None:
            return np.asarray((np.abs(step) <= self.tolerance).all(axis=1))
        variance = self.cost[rows] / np.maximum(self.redundancy[rows], 1)
        return np.asarray(predicted <= self.options.share**2 * variance)

    def _leave(self, rows: Rows, reason: BatchReason) -> None:
        self.active[rows] = False
        self.reasons[rows] = reason


def _floating(values: ArrayLike) -> Array:
    """Convert to an array of floats; single precision is kept."""
    array: NDArray[Any] = np.asarray(values)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


class _Chord(_Marquardt):
    """Chord method: reuse an earlier Jacobian while the corrections agree with the prediction.

    Near the solution they decrease at a nearly constant rate (Kelley 1995, *Iterative Methods for Linear and
    Nonlinear Equations*, 5.4.1), so that a correction times that rate is the remaining error: a problem has
    converged when this is negligible. Where the decrease is less than predicted, or corrections decrease
    slowly, the Jacobian is computed again.

    With a fixed Jacobian A, the solution of Aᵀ W v = 0 is found. If A differs from the Jacobian at the
    estimates by a share e, these differ from the least-squares estimates by e times their standard
    deviations, and their variance is larger by e²: negligible if the approximate values are good.
    """

    def __init__(self, values: ValuesFunction, *given: Any) -> None:
        super().__init__(*given)
        if self.options.reweight is not None:
            raise UsageError("must not be given together", where="values and reweight of adjust_batch")
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
            self.damping[some] = np.maximum(self.damping[some] / 3, _LEAST_DAMPING)
        if not serves.all():
            self.last[rows[~serves]] = 0.0
            # An old Jacobian is computed again at the present place; with a new one the step is rejected.
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


def adjust_batch(
    function: BatchFunction,
    initial: ArrayLike,
    observations: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    prior: tuple[ArrayLike, ArrayLike] | None = None,
    values: ValuesFunction | None = None,
    options: BatchOptions | None = None,
) -> BatchAdjustment:
    """Adjust k independent problems of n observations and u parameters by Levenberg–Marquardt.

    Parameters
    ----------
    function : callable
        `function(x, rows)` with x (m, u), the parameters, and rows (m,), the indices of their
        problems, gives the computed observations (m, n) and their Jacobian (m, n, u). Only active
        problems are evaluated. A step to values that are not finite is rejected; at weight zero they have no
        effect.
    initial : array_like (k, u)
        Approximate values.
    observations : array_like (k, n)
        Observations; may be NaN where the weight is zero.
    weights : array_like (k, n), optional
        1/σ² of the observations up to a common factor; zero for those that are missing. Ones by default.
    prior : (mean, sigma), optional
        Observed parameters: mean (k, u) with the standard deviations (u,) of unit weight; infinite where a
        parameter is not observed.
    values : callable, optional
        `values(x, rows)` gives the computed observations (m, n) alone. Useful where that is much cheaper
        than with the Jacobian: each problem then keeps its Jacobian as long as it is accurate enough; see
        Kelley (1995), 5.4.1.
    options : BatchOptions, optional
        Options of the iteration.

    Returns
    -------
    BatchAdjustment
        Results of all problems; check `converged`.

    Raises
    ------
    UsageError
        When shapes disagree, or weights or sigmas are negative or NaN.

    Notes
    -----
    Damping after Nielsen (1999), *Damping parameter in Marquardt's method*, IMM-REP-1999-05; columns
    are scaled to normal equations of unit diagonal (Marquardt 1963).

    Examples
    --------
    Two straight lines, the second with a missing observation:

    >>> import numpy as np
    >>> t = np.arange(4.0)
    >>> def line(x, rows):
    ...     return x[:, :1] + x[:, 1:] * t, np.broadcast_to(np.column_stack([t**0, t]), (len(rows), 4, 2))
    >>> y, weights = [[1, 3, 5, 7], [2, 1, 9, -1]], [[1, 1, 1, 1], [1, 1, 0, 1]]
    >>> fit = adjust_batch(line, np.zeros((2, 2)), y, weights=weights)
    >>> fit.estimates.round(6) + 0.0
    array([[ 1.,  2.],
           [ 2., -1.]])
    >>> fit.redundancy
    array([2, 1])
    """
    given = function, initial, observations, weights, prior, options or BatchOptions()
    work = _Marquardt(*given) if values is None else _Chord(values, *given)
    with one_thread():
        work.start()
        for _ in range(work.options.max_iterations):
            if not work.iterate():
                break
        return work.finish()
