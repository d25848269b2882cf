"""Competing models of all calibrations of an instrument: stable, creeping, changed at once, with the seasons.

The runs differ by their errors, whose covariances are known up to a scale, and by a change of the instrument,
a field over the image that grows as a function of time. Scale, size and direction of the change, and when it
began, are unknown; what is said of the present drift is the mean over all of them by their probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import scipy.special

from ..core.data import Array

_MISSED, _FALSE, _WARNED = 0.01, 0.1, 0.05
"""Mistakes that are allowed: years with a run accepted beyond the limit, or with a trend announced late; runs
held back by mistake, a year; stable runs with a warning. The rarer one may be, the more it costs."""
_SCALES = np.array([1.0, 1.5, 2.2, 3.3, 5.0])
"""Scales of the errors between runs, in the standard deviations that the calibrations state."""
_HOLD = 8.0
"""How much more probable it is that these hold than that errors are a step of the scale larger."""
_LEAST = 0.02
"""Part of the largest error below which a direction is not one of errors: changes in it are `outside`."""
_AHEAD = np.append(0.0, np.geomspace(1.0, 36525.0, 300))[:, None]
"""Times at which a drift may reach its limit, days."""
_YEAR = 365.25
"""Period of seasons, days."""
_SEASONS = np.linspace(0.0, _YEAR, 25)
"""Times ahead at which a drift that follows the seasons is predicted, days."""
_PHASES = np.linspace(0.0, np.pi, 12, endpoint=False)
"""Phases of the year at the reference; the field may have either sign."""
_WIDTHS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
"""Sizes τ of changes (rms over the image), in limits, all equally probable."""


@dataclass(frozen=True, eq=False)
class RunHistory:
    """Calibrations of an instrument from its reference to now, in coordinates of their errors.

    Parameters
    ----------
    days : ndarray (n,)
        Times, rising; the first run is the reference, the last one is judged.
    values : ndarray (n, r)
        Coordinates of the differences from the reference.
    covs : ndarray (n, r, r)
        Their covariances, each by the errors of its own run.
    basis : ndarray (m, 2, r)
        Differences at places of the image by the coordinates.
    outside : float
        Largest difference of the last run from the reference that no coordinate describes.
    rejected : ndarray of bool (n,), optional
        Runs that were rejected: either each has an error of its own, or the instrument changed as they say.
    """

    days: Array
    values: Array
    covs: Array
    basis: Array
    outside: float = 0.0
    rejected: Array | None = None

    @classmethod
    def of(cls, days: Array, offs: Array, roots: list[Array], rejected: Array) -> RunHistory:
        """Reduce differences (n, m, 2) from the reference, with roots (m, 2, k) of the covariance of each."""
        known = np.isfinite(offs).all(axis=(0, 2)) & np.array(
            [np.isfinite(each).all(axis=(1, 2)) for each in roots]
        ).all(axis=0)
        flat = offs[:, known].reshape(len(offs), -1)
        own = [each[known].reshape(flat.shape[1], -1) for each in roots]
        # Errors of the first and of the last run span what may change; their models may differ.
        u, s, _ = np.linalg.svd(np.hstack([own[0], own[-1]]) / np.sqrt(2), full_matrices=False)
        keep = s > _LEAST * s[0]
        u, s = u[:, keep], s[keep]
        values = flat @ u / s
        scaled = [u.T @ each / s[:, None] for each in own]
        covs = np.array([each @ each.T for each in scaled]) + 1e-6 * np.eye(len(s))
        rest = np.hypot(*(flat[-1] - u @ (s * values[-1])).reshape(-1, 2).T)
        return cls(days, values, covs, (u * s).reshape(-1, 2, len(s)), float(rest.max()), rejected)

    def without(self, rows: Array) -> RunHistory:
        """Return the runs without some of them."""
        keep = np.flatnonzero(np.logical_not(rows))
        return replace(
            self, days=self.days[keep], values=self.values[keep], covs=self.covs[keep], rejected=None
        )

    def mean(self) -> tuple[Array, Array, float]:
        """Precisions (n, r, r), the mean of the runs, and the weighted squares of what deviates from it."""
        precision = np.asarray(np.linalg.inv(self.covs), dtype=np.float64)
        weighted = np.einsum("nij,nj->ni", precision, self.values)
        mean = np.linalg.solve(precision.sum(axis=0), weighted.sum(axis=0))
        return precision, np.asarray(mean, dtype=np.float64), float(((self.values - mean) * weighted).sum())

    def evidence(self) -> Array:
        """Log likelihoods of the runs without a change, for each scale of their errors."""
        (n, r), (precision, _, squares) = self.values.shape, self.mean()
        log = -0.5 * squares / _SCALES**2 - (n - 1) * r * np.log(_SCALES * np.sqrt(2 * np.pi))
        size = np.linalg.slogdet(precision)[1].sum() - np.linalg.slogdet(precision.sum(axis=0))[1]
        found: Array = log + 0.5 * size - np.log(_HOLD) * np.arange(len(_SCALES))
        return found

    def spreads(self, limit: float) -> Array:
        """Sizes (2, r) of a change of rms `limit`: equal in all coordinates of the field, or as of errors."""
        r = self.values.shape[1]
        rms = np.sqrt(np.square(self.basis).sum(axis=(0, 1)) / len(self.basis))
        return limit * np.array([1 / (rms * np.sqrt(r)), np.full(r, 1 / np.sqrt(np.square(rms).sum()))])

    def own_errors(self, rows: Array, base: Array, limit: float) -> Array:
        """Log likelihoods of some runs by an error of each of them, for each scale of the other errors."""
        off, wide = self.values[rows] - base, np.square(self.spreads(limit))[:, :, None] * np.eye(len(base))
        cov = np.square(_SCALES)[:, None, None, None, None, None] * self.covs[rows][:, None, None]
        cov = cov + np.square(_WIDTHS)[:, None, None] * wide[:, None]
        square = np.einsum("sjatik,ji,jk->sjat", np.linalg.inv(cov), off, off)
        log = -0.5 * (square + np.linalg.slogdet(2 * np.pi * cov)[1])
        log = scipy.special.logsumexp(log, axis=(2, 3)) - np.log(2 * len(_WIDTHS))
        found: Array = log.sum(axis=1)
        return found


@dataclass(frozen=True, eq=False)
class History:
    """What the models say of the last run.

    Parameters
    ----------
    stable, creeping, changed, seasonal : float
        Probabilities that the instrument is as at its reference, creeps, changed at once, or follows the
        seasons.
    scale : float
        Scale of the errors between runs, in the standard deviations that the calibrations state.
    sigma : float
        Largest standard deviation of a run over the image.
    p : float
        Probability that errors alone let the last run differ so much from the one in force.
    """

    stable: float
    creeping: float
    changed: float
    seasonal: float
    scale: float
    sigma: float
    p: float
    _log: Array
    _weights: Array
    _total: Array
    _step: Array
    _growth: Array
    """Growth of the drift a day by each model, in parts of the drift."""
    _seasonal: Array
    """Which models follow the seasons."""
    _ahead: Array
    """Sizes, and standard deviations, that they predict at times ahead."""

    def beyond(self, limit: float, *, step: bool = False) -> float:
        """Return the probability that the drift, or the step from the run in force, exceeds a limit."""
        size, sigma = self._step if step else self._total
        return float(self._weights @ scipy.special.ndtr((size - limit) / np.maximum(sigma, 1e-300)))

    def held(self, limit: float, *, step: bool = False) -> bool:
        """Return whether accepting the drift, or the step, would be the dearer mistake than holding it back.

        One is accepted by mistake where it exceeds the limit by two sigma of a run, and held back by mistake
        where it is below the limit by as much.
        """
        margin = 2 * self.sigma
        above = self.beyond(limit + margin, step=step)
        below = 1 - self.beyond(max(limit - margin, 0.0), step=step)
        return above / _MISSED > below / _FALSE

    def creeps(self, limit: float, part: float) -> bool:
        """Return whether to announce that the drift, which has reached a part of the limit, will reach it.

        A drift that creeps will, one that follows the seasons may, and no other one grows. It is announced
        where to say it late would be dearer than to say it in vain.
        """
        (size, sigma), least = self._total, np.full(len(self._weights), limit * part)
        there = self._weights * scipy.special.ndtr((size - least) / np.maximum(sigma, 1e-300))
        will = float(there[self._growth > 0].sum() + there[self._seasonal] @ self._within_a_year(limit)[-1])
        return will / _MISSED > (1 - will) / _WARNED

    def _within_a_year(self, limit: float) -> Array:
        """Probabilities (time ahead, model) that a drift that follows the seasons has reached a limit."""
        size, sigma = self._ahead
        reached = scipy.special.ndtr((size - limit) / np.maximum(sigma, 1e-300))
        return np.asarray(np.maximum.accumulate(reached), dtype=np.float64)

    def turns(self) -> tuple[float, float]:
        """Return in how many days the drift is largest, if it follows the seasons, and its size then."""
        mean = self._ahead[0] @ self._weights[self._seasonal] / max(self.seasonal, 1e-300)
        return float(_SEASONS[np.argmax(mean)]), float(mean.max())

    @property
    def rate_day(self) -> float:
        """Growth of the drift a day, if it creeps."""
        return float(self._weights @ (self._total[0] * self._growth)) / max(self.creeping, 1e-300)

    def reaches(self, limit: float, *quantiles: float) -> Array:
        """Return in how many days the drift reaches a limit, if it creeps: quantiles of that time."""
        creeps = self._growth > 0
        (size, sigma), weights = self._total[:, creeps], self._weights[creeps] / max(self.creeping, 1e-300)
        grown = 1 + _AHEAD * self._growth[creeps]
        reached = scipy.special.ndtr((size - limit / grown) / np.maximum(sigma, 1e-300)) @ weights
        found: Array = np.interp(quantiles, reached, _AHEAD[:, 0])
        return found

    def size(self, *, step: bool = False) -> tuple[float, float]:
        """Return the drift since the reference (or the step) and its standard deviation.

        The latter is that of the models with a change, however improbable: the others have none, which says
        nothing of how small a change can be seen.
        """
        size, sigma = self._step if step else self._total
        mean, some = float(self._weights @ size), sigma > 0
        weights = scipy.special.softmax(self._log[some])
        return mean, float(np.sqrt(weights @ (sigma**2 + (size - mean) ** 2)[some]))


def explain_runs(runs: RunHistory, limit: float, in_force: int) -> History:
    """Explain runs by competing models.

    Parameters
    ----------
    runs : RunHistory
        Two runs at least.
    limit : float
        Limit of the drift, in the unit of the field: changes of this order are expected.
    in_force : int
        Run that is in force.

    Examples
    --------
    Twelve runs, of which the last four have changed by eight standard deviations:

    >>> values = np.where(np.arange(12) < 8, 0.0, 8.0)[:, None] + [[0.3], [-0.4]] * 6
    >>> runs = RunHistory(7.0 * np.arange(12), values, np.ones((12, 1, 1)), np.full((1, 2, 1), 0.1))
    >>> found = explain_runs(runs, 0.5, 7)
    >>> round(found.changed, 2), round(found.beyond(0.5), 2)
    (1.0, 1.0)
    """
    found = _all_supposed(runs, runs.evidence(), limit, in_force)
    if runs.rejected is not None and runs.rejected.any():
        others, now_in_force = runs.without(runs.rejected), in_force - int(runs.rejected[:in_force].sum())
        common = others.evidence() + runs.own_errors(runs.rejected, others.mean()[1], limit)
        found += _all_supposed(others, common, limit, now_in_force)
    log = np.concatenate([each.log for each in found])
    weights = scipy.special.softmax(log)
    kinds = np.repeat([each.kind for each in found], [len(each.log) for each in found])
    stable, creeps, changed, seasonal = (float(weights[kinds == each].sum()) for each in range(4))
    n, r = runs.values.shape
    scale = float(weights @ np.concatenate([each.scale for each in found])) if n > 2 else 1.0
    off = runs.values[-1] - runs.values[in_force]
    statistic = off @ np.linalg.solve(runs.covs[-1] + runs.covs[in_force], off) / scale**2
    sigma = scale * float(np.linalg.svd(runs.basis, compute_uv=False)[:, 0].max())
    total, step = (
        np.concatenate(each, axis=1) for each in zip(*((f.total, f.step) for f in found), strict=True)
    )
    return History(
        stable, creeps, changed, seasonal, scale, sigma, float(scipy.special.chdtrc(r, statistic)), log,
        weights, total, step, np.concatenate([each.growth for each in found]), kinds == 3,
        np.concatenate([each.ahead for each in found], axis=2),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Supposed:
    """A kind of model for every shape, direction, scale and width: log evidence, and what it says of now."""

    kind: int
    log: Array
    scale: Array
    total: Array
    step: Array
    growth: Array
    ahead: Array = field(default_factory=lambda: np.zeros((2, len(_SEASONS), 0)))
    """Of the seasons, the drift that is predicted (2, time, model)."""

    @classmethod
    def stable(cls, common: Array) -> Self:
        none = np.zeros((2, len(common)))
        return cls(0, common, _SCALES, none, none, none[0])


def _all_supposed(runs: RunHistory, common: Array, limit: float, in_force: int) -> list[_Supposed]:
    """All kinds of models; `common` are the log likelihoods without a change, for each scale."""
    profiles = _profiles(runs.days - runs.days[0]).items()
    changed = [_supposed(kind, *each, runs, limit, common, in_force) for kind, each in profiles]
    return [_Supposed.stable(common), *changed]


def _supposed(
    kind: int, shapes: Array, growth: Array, runs: RunHistory, limit: float, common: Array, in_force: int
) -> _Supposed:
    """Changes of shapes (k, n): a field of random direction and size, times a function of time."""
    precision, base, _ = runs.mean()
    one = np.einsum("kn,nij->kij", shapes, precision)
    both = np.einsum("kn,nij->kij", shapes**2, precision)
    both -= np.einsum("kia,ab,kbj->kij", one, np.linalg.inv(precision.sum(axis=0)), one)
    right = np.einsum("kn,nij,nj->ki", shapes, precision, runs.values - base)
    sigma = runs.spreads(limit)
    known, u = np.linalg.eigh(np.einsum("ai,kij,aj->akij", sigma, both, sigma))
    h = np.einsum("akji,aj,kj->aki", u, sigma, right)
    s, tau = _SCALES[:, None, None], _WIDTHS[:, None]
    at = (slice(None), slice(None), None, None)
    cov = 1 / (np.maximum(known, 0.0)[at] / s**2 + 1 / tau**2)
    mean = h[at] / s**2 * cov
    log = 0.5 * (h[at] / s**2 * mean + np.log(cov) - 2 * np.log(tau)).sum(axis=-1)
    log = log + common[:, None] - np.log(2 * len(shapes) * len(_WIDTHS))
    fields = np.einsum("mci,ai,akij->akmcj", runs.basis, sigma, u, optimize=True)
    sizes = _greatest(fields, mean, cov).reshape(2, 2, len(shapes), -1)

    def grown(part: Array) -> Array:
        """Changes and standard deviations where the functions have grown by parts (…, k)."""
        found = np.abs(part)[..., None, :, None] * sizes.reshape(2, *(1,) * (part.ndim - 1), *sizes.shape[1:])
        return np.asarray(found.reshape(*found.shape[:-3], -1))

    count = len(_SCALES) * len(_WIDTHS)
    scale = np.broadcast_to(_SCALES[:, None], log.shape).ravel()
    made = _Supposed(
        kind, log.ravel(), scale, grown(shapes[:, -1]), grown(shapes[:, -1] - shapes[:, in_force]),
        np.tile(np.repeat(growth, count), 2),
    )  # fmt: skip
    if kind != 3:
        return made
    return replace(made, ahead=grown(_seasons(runs.days[-1] - runs.days[0] + _SEASONS).T))


def _profiles(days: Array) -> dict[int, tuple[Array, Array]]:
    """Functions of time (k, n), 0 at the reference, and the growth (k,) a day of what creeps.

    Kinds: 1 creeping, 2 at once, 3 with the seasons.
    """
    n = len(days)
    left = days[-1] - days[: max(1, n - 2)]
    at_once = np.array([np.arange(n) >= k for k in range(1, n)], dtype=np.float64)
    found = {2: (at_once, np.zeros(n - 1))}
    if n > 2:
        found[1] = np.maximum(0.0, days - days[: len(left), None]) / left[:, None], 1 / left
        found[3] = _seasons(days), np.zeros(len(_PHASES))
    return found


def _seasons(days: Array) -> Array:
    """The functions (k, n) of time of what follows one temperature of the year, 0 at the reference."""
    return np.asarray(np.sin(2 * np.pi * days / _YEAR + _PHASES[:, None]) - np.sin(_PHASES)[:, None])


def _greatest(fields: Array, mean: Array, cov: Array) -> Array:
    """Largest length over the image of changes, and its standard deviation (2, …)."""
    a, k, m, _, j = fields.shape
    flat, of = mean.reshape(a, k, -1, j), fields.reshape(a, k, 2 * m, j)
    there = (flat @ of.swapaxes(2, 3)).reshape(a, k, -1, m, 2)
    square = np.square(there).sum(axis=-1)
    where = np.argmax(square, axis=-1)[..., None]
    most = np.sqrt(np.take_along_axis(square, where, axis=-1))
    along = np.take_along_axis(there, where[..., None], axis=-2)[..., 0, :]
    along = np.where(most > 0, along / np.maximum(most, 1e-300), [1.0, 0.0])  # no change: any direction
    rows = fields[np.arange(a)[:, None, None], np.arange(k)[:, None], where[..., 0]]
    by = (rows * along[..., None]).sum(axis=-2)
    sigma = np.sqrt((np.square(by) * cov.reshape(a, k, -1, j)).sum(axis=-1))
    return np.array([most.ravel(), sigma.ravel()])
