"""Which echo is that of which rod: all rods and echoes of a frame at once, with gross errors.

A rod has its echo where a smooth field from the design predicts it, with errors of the scatter σ, the rod's
tolerance and the covariance of the echo; or it has none, and what lies near its place is something else, as
likely anywhere within the search distance. Field, σ and assignment are those of the largest likelihood: found
with a σ that decreases from the search distance to that of the residuals, and a field that is bent the more,
the smaller σ is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...optics.field import SmoothField, trend_degree
from ..marks.judging import robust_spread

_GROSS = 0.05
"""Share of rods beside whose place something else is seen."""
_ROUNDS = 12
"""Rounds of fitting the field and assigning echoes with it; usually six suffice."""
_FEWEST = 5
"""Minimum number of rods that test a field."""
_LOCAL = 20
"""Minimum number of rods from which a field is more than a polynomial."""


@dataclass
class Assignment:
    """Echoes of rods, and the field that they show.

    Parameters
    ----------
    row : ndarray of int (n,)
        Index of the echo of each rod, -1 where there is none.
    predicted : ndarray (n, 2)
        Places of the rods in the image.
    deviation : ndarray (n, 2)
        Echo minus its prediction by all other rods; NaN where there is none.
    excluded : dict of int to float
        Rods beside whose place something else is seen, and its distance, pixels.
    """

    row: Rows
    predicted: Array
    deviation: Array
    excluded: dict[int, float] = field(default_factory=dict)


def assign(
    source: Array, xy: Array, cov: Array, row: Rows, predicted: Array, gate_px: float, tolerance_px: Array
) -> Assignment:
    """Assign echoes to rods.

    Parameters
    ----------
    source : ndarray (n, 2)
        Rods in the design.
    xy, cov : ndarray (m, 2), (m, 2, 2)
        Echoes.
    row, predicted : ndarray (n,), (n, 2)
        First assignment, -1 for none, and first places of the rods.
    gate_px : float
        Search distance.
    tolerance_px : ndarray (n,)
        Standard deviation of each rod in the design, in pixels.

    Examples
    --------
    A rod whose echo is hidden does not take what lies 12 px beside its place:

    >>> rods = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2) * 100
    >>> echoes = rods + 0.00002 * rods**2
    >>> echoes[7] += [0.0, 12.0]
    >>> cov, none = np.tile(0.01 * np.eye(2), (20, 1, 1)), np.zeros(20)
    >>> found = assign(rods, echoes, cov, np.arange(20), rods, 20.0, none)
    >>> np.flatnonzero(found.row < 0), round(found.excluded[7])
    (array([7]), 12)
    """
    found = Assignment(row.copy(), predicted, np.full(source.shape, np.nan))
    own = np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2)
    sigma, degree, before = gate_px / 2, 1, (-1, row)
    for _ in range(_ROUNDS):
        has = np.flatnonzero(found.row >= 0)
        if len(has) < _FEWEST:
            return found
        degree = max(1, min(degree, trend_degree(len(has)), 3))
        trend = SmoothField.fit(source[has], xy[found.row[has]], degree=degree, local=False)
        found.predicted = trend(source)
        rest = xy[found.row[has]] - found.predicted[has]
        free = 1 - (degree + 1) * (degree + 2) / 2 / len(has)
        scatter = robust_spread(rest, 0.0) / np.sqrt(max(free, 0.1))
        sigma = max(scatter, float(np.median(own[found.row[has]])), sigma / 2)
        found.row = _likeliest(found.predicted, xy, cov, np.full(len(source), sigma), gate_px, tolerance_px)
        if degree == before[0] and (found.row == before[1]).all() and sigma <= 2 * scatter:
            break
        before, degree = (degree, found.row), degree + 1
    _settled(found, source, xy, cov, gate_px, tolerance_px)
    others = xy[np.setdiff1d(np.arange(len(xy)), found.row)]
    for rod in np.flatnonzero(found.row < 0):
        off = np.hypot(*(others - found.predicted[rod]).T)
        if len(off) and off.min() < gate_px:
            found.excluded[int(rod)] = float(off.min())
    return found


def _settled(
    found: Assignment, source: Array, xy: Array, cov: Array, gate_px: float, tolerance_px: Array
) -> None:
    """Assign with the field of all others, which is more than a polynomial."""
    for _ in range(_ROUNDS):
        has = np.flatnonzero(found.row >= 0)
        if len(has) < _FEWEST:
            return
        degree = max(1, min(3, trend_degree(len(has))))
        smooth = SmoothField.fit(source[has], xy[found.row[has]], degree=degree, local=len(has) >= _LOCAL)
        found.predicted = smooth(source)
        found.deviation[:] = np.nan
        found.deviation[has], spread = smooth.leave_one_out()
        wide = np.sqrt((spread**2).mean(axis=1))
        worst = _worst(found.deviation[has], cov[found.row[has]], wide, gate_px, tolerance_px[has])
        if worst >= 0:
            found.row[has[worst]] = -1
            found.deviation[has[worst]] = np.nan
            continue
        scatter = np.full(len(source), np.quantile(wide, 0.9))
        scatter[has] = wide
        again = _likeliest(found.predicted, xy, cov, scatter, gate_px, tolerance_px)
        gained = (found.row < 0) & (again >= 0) & ~np.isin(again, found.row)
        if not gained.any():
            return
        found.row[gained] = again[gained]


def _worst(deviation: Array, cov: Array, sigma: Array, gate_px: float, tolerance_px: Array) -> int:
    """The rod that is most likely a gross error; -1 for none."""
    total = cov + (sigma**2 + tolerance_px**2)[:, None, None] * np.eye(2)
    odds = _misfit(deviation, total) - _limit(total, gate_px)
    return int(odds.argmax()) if odds.max() > 0 else -1


def _likeliest(
    predicted: Array, xy: Array, cov: Array, sigma: Array, gate_px: float, tolerance_px: Array
) -> Rows:
    """The echoes (n,) of the rods with the largest likelihood of all, -1 for none."""
    row = np.full(len(predicted), -1)
    off = xy[None] - predicted[:, None]
    near = np.hypot(off[..., 0], off[..., 1]) < gate_px
    rods, echoes = np.nonzero(near)
    if not len(rods):
        return row
    total = cov[echoes] + (sigma[rods] ** 2 + tolerance_px[rods] ** 2)[:, None, None] * np.eye(2)
    gain: Array = np.zeros(near.shape)
    gain[rods, echoes] = np.maximum(_limit(total, gate_px) - _misfit(off[rods, echoes], total), 0)
    mine, theirs = scipy.optimize.linear_sum_assignment(-gain)
    taken: Mask = gain[mine, theirs] > 0
    row[mine[taken]] = theirs[taken]
    return row


def _misfit(off: Array, cov: Array) -> Array:
    """Half of the weighted squares of offsets (k, 2)."""
    return np.asarray(0.5 * np.einsum("ki,ki->k", off, np.linalg.solve(cov, off[..., None])[..., 0]))


def _limit(cov: Array, gate_px: float) -> Array:
    """The same (k,) from which anything within the search distance is as likely."""
    share = (1 - _GROSS) / _GROSS * gate_px**2 / (2 * np.sqrt(np.linalg.det(cov)))
    return np.asarray(np.log(np.maximum(share, 1.0)))
