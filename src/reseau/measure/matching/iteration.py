"""Least-squares matching of many windows with images in single precision.

The equations are those of :class:`reseau.measure.matching.patches.Patches` (grey values, derivatives, common
errors of rows) and of the damped chord method of :func:`reseau.adjust.adjust_batch`. The derivatives times
the roots of their weights are kept, so that trials need the images alone. A window that needs other
derivatives (a refused step, slow convergence) is STALE: the caller forms its image with derivatives, and
linearises it again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...adjust.batch import BatchAdjustment, BatchOptions, BatchReason
from ...core.data import Array, Mask, Rows
from .patches import CONTRAST, SHARPEST, WIDTH, Patches

Floats = NDArray[Any]
"""Of single or double precision."""


ACTIVE, DONE, STALE, FAILED = 0, 1, 2, 3
"""States of a window: to be evaluated at its trial, converged, to be linearised at its estimates, without a
solution."""
_SERVES, _SHRINKS, _LEAST_DAMPING, _MOST_DAMPING = 0.75, 0.1, 1e-10, 1e12
_GAINS, _HELD, _SINGULAR = 1e-4, 1e-2, 1e-12
"""As in :mod:`reseau.adjust.batch`."""
_TOGETHER = 1 << 17
"""Number of derivatives that are formed and multiplied together: they fit into a cache."""


class Iteration:
    """State of the iteration of m windows of n pixels.

    Parameters
    ----------
    patch, rows : Patches, ndarray of int (m,)
        Windows of a frame, and those that are adjusted.
    start, mean : ndarray (m, u)
        Approximate values, and observed ones, with the standard deviations `free` (u,).
    weights : ndarray (m, n)
        Weights of the grey values; 0 where a pixel is not used.
    options : BatchOptions
        Damping, and the share of a standard deviation below which corrections end the iteration.
    noise : float, optional
        Standard deviation of grey values, if shifts of rows are among the errors.
    """

    def __init__(
        self,
        patch: Patches,
        rows: Rows,
        start: Array,
        mean: Array,
        weights: Array,
        free: Array,
        options: BatchOptions,
        noise: float | None,
    ) -> None:
        (m, u), n = start.shape, weights.shape[1]
        every = len(rows) == len(patch.xy)
        self.patch, self.share_of_sigma = patch, options.share
        self.observed, psf = (v if every else v[rows] for v in (patch.grey, SHARPEST * patch.psf))
        self.psf, self.mean, self.prior = psf, mean, 1 / free**2
        self.root = np.sqrt(weights).astype(np.float32)
        self.used = self.root > 0
        self.redundancy = self.used.sum(axis=1) + np.isfinite(free).sum() - u
        jitter = 0.0 if noise is None else patch.options.row_jitter_px / noise
        self.jitter2, self.variance = jitter**2, 1.0 if noise is None else noise**2
        self.x, self.trial, self.begun = start.copy(), start.copy(), start.copy()
        self.residuals, self.jacobian = np.zeros((m, n)), np.zeros((m, u, n), np.float32)
        self.normal, self.gradient = np.zeros((m, u, u)), np.zeros((m, u))
        self.common = np.zeros((2, m if jitter > 0 else 0, *patch.shape[1:]), np.float32)
        self.cost, self.predicted, self.last = np.zeros((3, m))
        self.damping, self.growth = np.full(m, options.damping), np.full(m, 2.0)
        self.fresh = np.ones(m, dtype=bool)  # whether the derivatives are those at the estimates
        self.state, self.rounds = np.zeros((2, m), np.int64)
        self._diagonal = np.arange(u)

    # Images and their derivatives.

    def _formed(self, x: Array, share: Floats) -> tuple[Array, Array, Array]:
        """Background, contrast and grey values (m, n) of windows of which `share` (m, n) is covered."""
        plane = self.patch.background(x).reshape(share.shape)
        contrast = self.patch.contrast(x).reshape(len(x), -1)
        part = contrast * share
        return plane, contrast, plane * (1 - part) if self._dark else plane + part

    @property
    def _dark(self) -> bool:
        return self.patch.options.polarity == "dark"

    def _widening(self, x: Array, rows: Rows) -> Array:
        """Derivative (m,) of the width of the point-spread function by its logarithm above the bound."""
        wide = np.exp(x[:, WIDTH])
        return np.asarray(wide * wide / np.hypot(self.psf[rows], wide))

    def _derive(self, rows: Rows, share: Floats, slopes: Floats) -> Floats:
        """Keep derivatives of windows at their estimates; residuals (m, n) times the roots of the weights."""
        patch, x, root, out = self.patch, self.x[rows], self.root[rows], self.jacobian[rows]
        plane, contrast, grey = self._formed(x, share)
        rest = root
        if self._dark:
            by_share, by_contrast = (
                -(v * root).astype(np.float32) for v in (plane * contrast, plane * share)
            )
            rest = ((1 - contrast * share) * root).astype(np.float32)
        else:
            by_share, by_contrast = ((v * root).astype(np.float32) for v in (contrast, share))
        monomials, across, _ = patch.terms
        np.multiply(by_share[:, None], slopes[:, :CONTRAST], out=out[:, :CONTRAST])
        out[:, WIDTH] *= self._widening(x, rows)[:, None].astype(np.float32)
        out[:, CONTRAST] = by_contrast
        np.multiply(rest[:, None], monomials, out=out[:, patch.ground])
        np.multiply(by_contrast[:, None], across, out=out[:, patch.ground.stop : patch.form_at])
        np.multiply(by_share[:, None], slopes[:, CONTRAST:], out=out[:, patch.form_at :])
        # Pixels that are not used may carry any value.
        residuals = np.where(self.used[rows], grey - self.observed[rows], 0.0)
        left: Floats = residuals * root
        if len(self.common[0]):
            along = out[:, 0].reshape(len(out), *patch.shape[1:]).copy()
            length2 = self.variance * (along * along).sum(axis=2, keepdims=True)
            factor = (
                self.variance * (1 - 1 / np.sqrt(1 + self.jitter2 * length2)) / np.maximum(length2, 1e-30)
            )
            self.common[0, rows], self.common[1, rows] = along, along * factor
            left, out = self._without_common(rows, left), self._without_common(rows, out)
            residuals = self._unweighted(rows, left)
        self.residuals[rows], self.jacobian[rows] = residuals, out
        return left

    def _without_common(self, rows: Rows, values: Floats) -> Floats:
        """Values (m, n) or (m, u, n) without their common error in each row; see `Patches.whiten`."""
        along, heavy = (
            v[rows].reshape(len(rows), *(1,) * (values.ndim - 2), *v.shape[1:]) for v in self.common
        )
        rowwise = values.reshape(*values.shape[:-1], *along.shape[-2:])
        common = (heavy * rowwise).sum(axis=-1, keepdims=True)
        return np.asarray((rowwise - along * common).reshape(values.shape))

    def _unweighted(self, rows: Rows, left: Floats) -> Array:
        """Residuals (m, n) from weighted ones; 0 where a pixel is not used."""
        return np.divide(left, self.root[rows], out=np.zeros(left.shape), where=self.used[rows])

    # Steps.

    def linearise(self, rows: Rows, share: Floats, slopes: Floats) -> None:
        """Form the normal equations of windows `rows` (m,) at their estimates, and the next trial of each.

        Parameters
        ----------
        share, slopes : ndarray (m, n), (m, 3 + p, n), float32
            Images formed at the estimates, and their derivatives by x, y, width and form. The images of
            windows that have converged are changed to those at the new estimates.
        """
        u = self.x.shape[1]
        left = np.empty(share.shape)
        step = max(1, _TOGETHER // (u * share.shape[1]))
        for begin in range(0, len(rows), step):
            part = slice(begin, begin + step)
            few = rows[part]
            left[part] = self._derive(few, share[part], slopes[part])
            jacobian = self.jacobian[few]
            self.normal[few] = jacobian @ np.swapaxes(jacobian, 1, 2)
            single = left[part, :, None].astype(np.float32)
            self.gradient[few] = -(jacobian @ single)[:, :, 0]
        off = self.mean[rows] - self.x[rows]
        self.gradient[rows] += self.prior * off
        self.normal[rows[:, None], self._diagonal, self._diagonal] += self.prior
        self.cost[rows] = np.einsum("mn,mn->m", left, left) + (self.prior * off**2).sum(axis=1)
        self.begun[rows], self.last[rows], self.fresh[rows] = self.x[rows], 0.0, True
        self.state[rows] = np.where(
            np.isfinite(self.cost[rows]) & (self.redundancy[rows] >= 0) & self._regular(rows), ACTIVE, FAILED
        )
        good = self.state[rows] == ACTIVE
        self._next(rows[good])
        sure = self.state[rows] == ACTIVE
        sure[sure] = self._foreseen(rows[sure])
        self._extrapolate(rows[sure], left[sure], share, slopes, np.flatnonzero(sure))

    def _scaled(self, rows: Rows) -> tuple[Array, Array]:
        """Normal equations (m, u, u) of unit diagonal, and the scale (m, u) of the parameters."""
        normal = self.normal[rows]
        diagonal = normal[:, self._diagonal, self._diagonal]
        positive = diagonal > 0
        scale = np.where(positive, 1 / np.sqrt(np.where(positive, diagonal, 1.0)), 1.0)
        return normal * scale[:, :, None] * scale[:, None], scale

    def _regular(self, rows: Rows) -> Mask:
        """Whether normal equations (m,) have a solution."""

        def pivots(scaled: Array) -> Array:
            return np.asarray(np.linalg.cholesky(scaled)[..., self._diagonal, self._diagonal].min(axis=-1))

        scaled, _ = self._scaled(rows)
        try:
            return np.asarray(pivots(scaled) ** 2 > _SINGULAR)
        except np.linalg.LinAlgError:
            found = np.zeros(len(rows), dtype=bool)
            for k, one in enumerate(scaled):
                try:
                    found[k] = pivots(one) ** 2 > _SINGULAR
                except np.linalg.LinAlgError:
                    continue
            return found

    def _step(self, rows: Rows, damping: Array) -> tuple[Array, Array]:
        """Damped corrections (m, u), and the decrease (m,) of the sum of squares that they predict."""
        scaled, scale = self._scaled(rows)
        right = self.gradient[rows] * scale
        scaled[:, self._diagonal, self._diagonal] += damping[:, None]
        step = np.linalg.solve(scaled, right[:, :, None])[:, :, 0]
        # The decrease 2 sᵀ g − sᵀ N s of the sum of squares, with (N + d I) s = g.
        return step * scale, (step * (right + damping[:, None] * step)).sum(axis=1)

    def _limit(self, rows: Rows) -> Array:
        """Decrease (m,) of the sum of squares that is negligible."""
        return np.asarray(self.share_of_sigma**2 * self.cost[rows] / np.maximum(self.redundancy[rows], 1))

    def _next(self, rows: Rows) -> None:
        """Correct windows that have converged, and place the trials of the others."""
        if not len(rows):
            return
        limit, damping, last = self._limit(rows), self.damping[rows], self.last[rows]
        step, predicted = self._step(rows, damping)
        self.trial[rows] = self.x[rows] + step
        rate2 = np.where(predicted > 0, predicted / np.maximum(np.maximum(last, predicted), 1e-300), 1.0)
        done = predicted * rate2 <= limit
        held = np.flatnonzero(done & (damping > _HELD))
        if len(held):
            # Damping makes corrections small: the one without it decides.
            done[held] = self._step(rows[held], np.full(len(held), _LEAST_DAMPING))[1] <= limit[held]
        lost = ~(predicted >= 0)
        slow = ~lost & ~done & (last > 0) & (predicted > _SHRINKS * last)
        self.state[rows[lost]], self.state[rows[slow]] = FAILED, STALE  # corrections decrease slowly
        going = ~lost & ~slow
        some = rows[going]
        self.predicted[some] = self.last[some] = predicted[going]
        ended = rows[going & done]
        self.state[ended] = DONE
        self.x[ended] = self.trial[ended]

    def _foreseen(self, rows: Rows) -> Mask:
        """Whether what the first correction leaves is negligible.

        It is smaller than the correction by half the relative change of the mark.
        """
        x, trial = self.x[rows], self.trial[rows]
        wide, off = np.exp(x[:, WIDTH]), np.abs(trial - x)
        total = np.hypot(self.psf[rows], wide)
        with np.errstate(all="ignore"):
            brighter = np.abs(trial[:, CONTRAST] / x[:, CONTRAST] - 1.0)
        parts = [off[:, 0] / total, off[:, 1] / total, off[:, WIDTH] * (wide / total) ** 2, brighter]
        change = np.max([*parts, *off[:, self.patch.form_at :].T], axis=0)
        left = self.predicted[rows]
        return np.asarray(left * (change / 4) ** 2 <= self._limit(rows) * (1 - left / self.cost[rows]))

    def _extrapolate(self, rows: Rows, left: Floats, share: Floats, slopes: Floats, at: Rows) -> None:
        """Correct windows, and by their derivatives residuals and images `share[at]`."""
        if not len(rows):
            return
        step = self.trial[rows] - self.x[rows]
        left = left + (step[:, None].astype(np.float32) @ self.jacobian[rows])[:, 0]
        self.residuals[rows] = self._unweighted(rows, left)
        image = np.concatenate([step[:, :CONTRAST], step[:, self.patch.form_at :]], axis=1)
        image[:, WIDTH] *= self._widening(self.x[rows], rows)
        share[at] += (image[:, None].astype(np.float32) @ slopes[at])[:, 0]
        self.x[rows] = self.trial[rows]
        self.cost[rows] -= self.predicted[rows]
        self.state[rows] = DONE

    def advance(self, rows: Rows, share: Floats) -> Mask:
        """Accept or refuse the trials of windows `rows` (m,), in which `share` (m, n) was formed; next ones.

        Returns
        -------
        ndarray of bool (m,)
            Which were accepted.
        """
        trial = self.trial[rows]
        off = np.where(self.used[rows], self._formed(trial, share)[2] - self.observed[rows], 0.0)
        left: Floats = off * self.root[rows]
        if len(self.common[0]):
            left = self._without_common(rows, left)
            off = self._unweighted(rows, left)
        aside = self.mean[rows] - trial
        cost = np.einsum("mn,mn->m", left, left) + (self.prior * aside**2).sum(axis=1)
        gain = (self.cost[rows] - cost) / np.maximum(self.predicted[rows], 1e-300)
        serves = gain > _SERVES
        taken = serves | (self.fresh[rows] & (gain > _GAINS))
        some, shrink = rows[taken], np.where(serves, 1 / 3, np.maximum(1 / 3, 1 - (2 * gain - 1) ** 3))
        self.x[some], self.residuals[some], self.cost[some] = trial[taken], off[taken], cost[taken]
        self.growth[some] = 2.0
        self.damping[some] = np.maximum(self.damping[some] * shrink[taken], _LEAST_DAMPING)
        stale = ~serves & (taken | ~self.fresh[rows])
        self.state[rows[stale]] = STALE
        refused = rows[~taken & ~stale]
        self.damping[refused] *= self.growth[refused]
        self.growth[refused] *= 2.0
        self.last[refused] = 0.0
        hopeless = self.damping[refused] > _MOST_DAMPING
        self.state[refused[hopeless]] = FAILED
        some = rows[serves]
        self.fresh[some] = False
        if len(some):
            jacobian = self.jacobian if len(some) == len(self.x) else self.jacobian[some]
            by_grey = (jacobian @ left[serves, :, None].astype(np.float32))[:, :, 0]
            self.gradient[some] = self.prior * aside[serves] - by_grey
        self._next(np.concatenate([some, refused[~hopeless]]))
        return np.asarray(taken)

    # Results.

    def cofactors(self, rows: Rows) -> Array:
        """Inverse normal equations (m, u, u); NaN without a solution."""
        found = np.full((len(rows), *self.normal.shape[1:]), np.nan)
        good = self.state[rows] != FAILED
        scaled, scale = self._scaled(rows[good])
        found[good] = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None]
        return found

    def influences(self, rows: Rows) -> tuple[Floats, Floats]:
        """Influence of each pixel on the position (m, 2, n), and its leverage (m, n).

        With derivatives A, weights W and cofactor Q they are the first rows of Q Aᵀ W, and the diagonal of
        A Q Aᵀ W.
        """
        jacobian = self.jacobian[rows]
        gain = self.cofactors(rows).astype(np.float32) @ jacobian
        return gain[:, :2] * self.root[rows, None], np.einsum("mun,mun->mn", gain, jacobian)

    def finished(self) -> BatchAdjustment:
        """Results of all windows."""
        done = self.state == DONE
        reasons = np.where(done, BatchReason.CONVERGED, BatchReason.MAX_ITERATIONS)
        cost = np.where(np.isfinite(self.cost), self.cost, np.nan)
        return BatchAdjustment(
            estimates=self.x,
            cofactor=self.cofactors(np.arange(len(self.x))),
            residuals=self.residuals,
            sigma0=np.sqrt(np.maximum(cost, 0.0) / np.maximum(self.redundancy, 1)),
            redundancy=self.redundancy,
            converged=done,
            iterations=self.rounds,
            reasons=np.where(self.state == FAILED, BatchReason.SINGULAR, reasons).astype(np.int64),
            factors=np.broadcast_to(1.0, self.residuals.shape),
        )
