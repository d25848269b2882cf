"""What an instrument has done since its reference calibration: stable, creeping, or changed at once.

Each is a model of the calibrations z_i of all runs, with their covariances Σ_i, the reference's included:

    z_i = a + g_i δ + e_i,    e_i ~ N(0, s² Σ_i)

with g = 0 (*stable*), rising in proportion to time from run k on (*creeping since k*), or 0 before and 1 from
run k on (*changed at k*); g is 0 at the reference and 1 now, so that δ is the drift since the reference. The
scale s of the errors between runs is not known either. The evidence of each model and scale follows in closed
form, with a flat prior for a, and N(0, τ²) for the field of δ with τ of several sizes; the three kinds are
equally probable. What is stated of the drift is the mean over all models by their probabilities (Bayesian
model averaging: Hoeting et al. 1999). A run of large noise does not look like a change, and a change that a
few runs agree in is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from ..core.data import Array

_SCALES = np.array([1.0, 1.5, 2.2, 3.3, 5.0])
"""Scales of the errors between runs, of which each is half as probable as the one before."""
_LEAST = 0.02
"""Part of the largest error below which a direction is not one of errors: changes in it are `outside`."""
_WIDTHS = np.array([0.5, 1.0, 2.0, 4.0])
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
    """

    days: Array
    values: Array
    covs: Array
    basis: Array
    outside: float = 0.0

    @classmethod
    def of(cls, days: Array, offs: Array, roots: list[Array]) -> RunHistory:
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
        return cls(days, values, covs, (u * s).reshape(-1, 2, len(s)), float(rest.max()))


@dataclass(frozen=True, eq=False)
class History:
    """What the models say of the last run.

    Parameters
    ----------
    stable, creeping, changed : float
        Probabilities that the instrument is as at its reference, creeps, or changed at once.
    scale : float
        Scale of the errors between runs, in the standard deviations that the calibrations state.
    p : float
        Probability that errors alone let the last run differ so much from the one in force.
    rate_day : float
        Growth of the drift a day, as far as it creeps.
    """

    stable: float
    creeping: float
    changed: float
    scale: float
    p: float
    rate_day: float
    _weights: Array
    _total: Array
    _step: Array

    def beyond(self, limit: float, *, step: bool = False) -> float:
        """Return the probability that the drift, or the step from the run in force, exceeds a limit."""
        size, sigma = self._step if step else self._total
        return float(self._weights @ scipy.special.ndtr((size - limit) / np.maximum(sigma, 1e-12 * limit)))

    def size(self, *, step: bool = False) -> tuple[float, float]:
        """Return the drift since the reference (or the step) and its standard deviation."""
        size, sigma = self._step if step else self._total
        mean = float(self._weights @ size)
        return mean, float(np.sqrt(self._weights @ (sigma**2 + (size - mean) ** 2)))


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
    (n, r), days = runs.values.shape, runs.days - runs.days[0]
    shape, kind = _profiles(days)
    precision = np.linalg.inv(runs.covs)
    weighted = np.einsum("nij,nj->ni", precision, runs.values)
    square = float(np.einsum("ni,ni->", runs.values, weighted))
    m = len(runs.basis)
    # The field of a change is N(0, τ²) in every direction that the coordinates have.
    rms = np.sqrt(np.square(runs.basis).sum(axis=(0, 1)) / m)
    prior = rms**2 * r / limit**2
    a11, b1 = precision.sum(axis=0), weighted.sum(axis=0)
    base = np.linalg.solve(a11, b1)
    a12 = np.einsum("kn,nij->kij", shape, precision)
    a22 = np.einsum("kn,nij->kij", shape**2, precision)
    left = a22 - a12 @ np.linalg.solve(a11, a12)
    right = shape @ weighted - np.einsum("kij,j->ki", a12, base)
    # Over models, scales and widths.
    s, tau = _SCALES[:, None, None, None], _WIDTHS[:, None, None]
    inverse = np.linalg.inv(left[:, None, None] / s**2 + np.diag(prior) / tau**2)
    right = np.broadcast_to(right[:, None, None], inverse.shape[:-1]) / s[..., 0] ** 2
    delta = np.einsum("kstij,kstj->ksti", inverse, right)
    change = 0.5 * np.einsum("ksti,ksti->kst", right, delta) + 0.5 * np.linalg.slogdet(inverse)[1]
    change += 0.5 * np.log(prior).sum() - r * np.log(_WIDTHS) - np.log(len(_WIDTHS))
    # The three kinds are equally probable, and so are the runs at which one begins.
    change -= np.log(np.bincount(kind)[kind])[:, None, None]
    common = -0.5 * (square - b1 @ base) / _SCALES**2 - (n - 1) * r * np.log(_SCALES)
    common -= np.log(2) * np.arange(len(_SCALES))
    log = np.concatenate([common, (change + common[:, None]).ravel()])
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    each = (len(_SCALES), len(_SCALES) * len(_WIDTHS))
    model = np.concatenate([np.zeros(each[0], dtype=int), np.repeat(np.arange(1, len(shape) + 1), each[1])])
    delta = np.concatenate([np.zeros((each[0], r)), delta.reshape(-1, r)])
    cov = np.concatenate([np.zeros((each[0], r, r)), inverse.reshape(-1, r, r)])
    kinds = np.concatenate([[0], kind])[model]
    scales = np.concatenate([_SCALES, np.tile(np.repeat(_SCALES, len(_WIDTHS)), len(shape))])
    total = _greatest(runs.basis, delta, cov)
    part = np.concatenate([[0.0], 1 - shape[:, in_force]])[model]
    step = np.array([total[0] * part, total[1] * part])
    scale = float(weights @ scales) if n > 2 else 1.0  # two runs say nothing of it
    off = runs.values[-1] - runs.values[in_force]
    statistic = off @ np.linalg.solve(runs.covs[-1] + runs.covs[in_force], off) / scale**2
    since = np.concatenate([[0.0], _since(shape, days)])[model]
    creeping = kinds == 1
    rate = float((weights * total[0] / (days[-1] - since))[creeping].sum())
    stable, creeps, changed = (float(weights[kinds == each].sum()) for each in (0, 1, 2))
    return History(
        stable, creeps, changed, scale,
        float(scipy.special.chdtrc(r, statistic)), rate / max(creeps, 1e-300),
        weights, total, step,
    )  # fmt: skip


def _profiles(days: Array) -> tuple[Array, Array]:
    """Shapes g (k, n) of changes, from 0 at the reference to 1 now; their kinds: 1 creeping, 2 at once."""
    n = len(days)
    rising = [np.maximum(0.0, days - days[k]) / (days[-1] - days[k]) for k in range(n - 2)]
    at_once = [(np.arange(n) >= k).astype(np.float64) for k in range(1, n)]
    return np.array(rising + at_once), np.array([1] * len(rising) + [2] * len(at_once))


def _since(shape: Array, days: Array) -> Array:
    """Days from which on shapes rise."""
    found: Array = days[np.maximum(np.argmax(shape > 0, axis=1) - 1, 0)]
    return found


def _greatest(basis: Array, delta: Array, cov: Array) -> Array:
    """Largest length (k,) over the image of changes, and its standard deviation (2, k)."""
    field = np.einsum("mcr,kr->kmc", basis, delta)
    size = np.hypot(field[..., 0], field[..., 1])
    where = np.argmax(size, axis=1)
    rows = np.arange(len(delta))
    there = basis[where]
    along = field[rows, where] / np.maximum(size[rows, where], 1e-300)[:, None]
    by = np.einsum("kcr,kc->kr", there, along)
    return np.array([size[rows, where], np.sqrt(np.einsum("kr,krs,ks->k", by, cov, by))])
