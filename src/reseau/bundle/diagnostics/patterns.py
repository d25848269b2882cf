"""Residual patterns that several images have in common, tested and mapped.

Vosselman and Förstner (1988, sect. 4.3) saw that residuals which look random in one image are those of
another image of the same camera and board rotation. The hypothesis is that the measured coordinates of a
class of observations (one point in images of a kind; one place of the frame in all images) are off by a
common shift. All these shifts together are parameters C s that the adjustment has not got; with the weighted
residuals w and their cofactors I − A Q Aᵀ they lower wᵀw by

    T = gᵀ M⁻ g,   g = Cᵀ w,   M = Cᵀ (I − A Q Aᵀ) C,

exactly as much as an adjustment with them would to first order (Koch 1999, ch. 4; Förstner & Wrobel 2016,
sect. 4.6). What orientation, calibration and points take up of a common shift does not count: M has no rank
there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.special

from ...core.data import Array, Rows
from ...core.errors import UsageError
from ..solver.normal import SEGMENTS
from .result import Result

__all__ = ["CommonPattern", "by_place", "by_point", "common_pattern"]

# Part of a shift that the unknowns leave, below which they have taken it up.
_RANK = 1e-6
# Shifts from which on their full matrices take too long, and columns of them that are worked on at once.
_MOST, _AT_ONCE = 6000, 128


@dataclass(frozen=True, eq=False)
class CommonPattern:
    """Shifts that classes of observations have in common.

    Parameters
    ----------
    key : ndarray of int (n,)
        Class of each image point, −1 for none.
    xy : ndarray (k, 2)
        Mean place of each class in its images, px.
    shift : ndarray (k, 2)
        By how much its measured points are off in the mean, px: the weighted mean of the residuals with the
        sign of errors.
    cov : ndarray (k, 2, 2)
        Covariances of the shifts by noise alone.
    count : ndarray of int (k,)
        Image points in each class.
    statistic : float
        F of all shifts together.
    degrees : (int, int)
        Of it.
    sigma0 : float
        Standard deviation of unit weight when the shifts are estimated too.
    rms : float
        Root mean square of the shifts per coordinate without what noise makes of them, px, as far as they are
        of one size everywhere; 0 where noise makes more.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> pattern = common_pattern(result, by_place(result, 0, 2, 2))
    >>> pattern.count, pattern.degrees, pattern.p > 0.05
    (array([41, 40, 39, 40]), (6, 209), True)
    """

    key: Rows
    xy: Array
    shift: Array
    cov: Array
    count: Rows
    statistic: float
    degrees: tuple[int, int]
    sigma0: float
    rms: float

    @property
    def p(self) -> float:
        """Probability of as much in common by chance."""
        return float(scipy.special.fdtrc(*self.degrees, self.statistic)) if all(self.degrees) else 1.0

    @property
    def p_at(self) -> Array:
        """The same of each class by itself (k,); one where the unknowns take its shift up."""
        known = np.linalg.det(self.cov) > 0
        p = np.ones(len(self.cov))
        s = self.shift[known]
        square = np.einsum("ni,ni->n", s, np.linalg.solve(self.cov[known], s[:, :, None])[:, :, 0])
        p[known] = scipy.special.fdtrc(2, max(sum(self.degrees), 1), square / 2)
        return p


def by_point(result: Result, kinds: Sequence[str | None]) -> Rows:
    """Classes of one point in images of one kind.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    kinds : sequence of str or None (m,)
        What kind each image is of; None for images that are not looked at.

    Returns
    -------
    ndarray of int (n,)
        Class of each image point, −1 for none.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> by_point(result, ["front"] * 4 + [None] * 4)[[0, 1, 20, 159]]
    array([ 0,  1,  0, -1])
    """
    network = result.network
    names = {kind: k for k, kind in enumerate(dict.fromkeys(kind for kind in kinds if kind is not None))}
    kind_of = np.array([-1 if kind is None else names[kind] for kind in kinds], dtype=np.intp)
    of = kind_of[network.image_of]
    key: Rows = np.where(of >= 0, of * len(network.points) + network.point_of, -1)
    return key


def by_place(result: Result, camera: int, across: int = 12, down: int | None = None) -> Rows:
    """Classes of one place of the frame in all images of a camera: cells of a grid.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    camera : int
        Row of the camera.
    across, down : int
        Cells along the axes; `down` by default in proportion.

    Returns
    -------
    ndarray of int (n,)
        Class of each image point, −1 for those of other cameras.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> np.bincount(by_place(result, 0, across=2, down=2))
    array([41, 40, 39, 40])
    """
    network, entry = result.network, result.network.cameras[camera]
    down = max(1, round(across * entry.height / entry.width)) if down is None else down
    size = np.array([entry.width, entry.height])
    cell = np.clip(np.floor((network.xy + 0.5) / size * [across, down]), 0, [across - 1, down - 1])
    own = network.camera_of[network.image_of] == camera
    key: Rows = np.where(own, cell[:, 1] * across + cell[:, 0], -1).astype(np.intp)
    return key


def common_pattern(result: Result, key: Rows) -> CommonPattern:
    """Test and map what classes of image points have in common.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    key : ndarray of int (n,)
        Class of each image point, −1 for none; see :func:`by_point`, :func:`by_place`. A class with one
        image point alone does not count.

    Raises
    ------
    UsageError
        When no class has two image points, or there are too many classes.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> pattern = common_pattern(result, by_place(result, 0, 2, 2))
    >>> pattern.shift.shape, pattern.rms < 0.01
    ((4, 2), True)
    """
    fit, network = result.fit, result.network
    linear, unknowns = fit.linear, fit.unknowns
    rows = np.flatnonzero(fit.usable.observations)[unknowns.order]
    found, number, count = np.unique(key[rows], return_inverse=True, return_counts=True)
    good = (found >= 0) & (count > 1)
    if not good.any():
        raise UsageError("no two image points are in a class", where="common_pattern")
    shifts = int(good.sum())
    if 2 * shifts > _MOST:
        raise UsageError(f"{shifts} classes are too many, {_MOST // 2} can be tested", where="common_pattern")
    at = np.where(good, np.cumsum(good) - 1, -1)[number]
    root = linear.system.seen.root
    own = np.flatnonzero(at >= 0)
    g, normal = np.zeros((shifts, 2)), np.zeros((shifts, 2, 2))
    turned = np.swapaxes(root[own], 1, 2)
    np.add.at(g, at[own], (turned @ linear.misfits[own][:, :, None])[:, :, 0])
    np.add.at(normal, at[own], turned @ root[own])
    m = _left(result, at, normal)
    statistic, degrees, rest = _tested(m, g.ravel(), normal, fit.cost, fit.redundancy)
    variance = rest**2 if np.isfinite(rest) else fit.variance
    inverse, k = np.linalg.inv(normal), np.arange(shifts)
    cov = inverse @ m.reshape(shifts, 2, shifts, 2)[k, :, k, :] @ inverse * variance
    shift = -(inverse @ g[:, :, None])[:, :, 0]
    # A pattern s shows as N⁻¹ M s.
    shown = (inverse @ m.reshape(shifts, 2, -1)).reshape(2 * shifts, -1)
    square = float((shift**2).sum() - np.trace(cov, axis1=1, axis2=2).sum()) / float((shown**2).sum())
    xy = np.zeros((shifts, 2))
    np.add.at(xy, at[own], network.xy[rows[own]])
    keys = np.full(len(network.xy), -1, dtype=np.intp)
    keys[rows] = at
    return CommonPattern(
        key=keys,
        xy=xy / count[good][:, None],
        shift=shift,
        cov=cov,
        count=count[good],
        statistic=statistic,
        degrees=degrees,
        sigma0=rest,
        rms=float(np.sqrt(max(square, 0.0))),
    )


def _left(result: Result, at: Rows, normal: Array) -> Array:
    """M (2k, 2k): what the unknowns leave of the normal equations of the shifts.

    Points are eliminated as from all others: with the derivatives H by the reduced unknowns and K by the
    points, CᵀA Q AᵀC = K V⁻¹ Kᵀ + (H − K V⁻¹ Wᵀ) Z (H − K V⁻¹ Wᵀ)ᵀ, in whatever datum Z is.
    """
    cofactors = result.fit.cofactors
    shifts, p = 2 * len(normal), len(cofactors.points)
    turned, by_points = _slopes(result, at, shifts)
    columns = scipy.sparse.csc_array(by_points)
    for k in range(0, shifts, _AT_ONCE):
        side = columns[:, k : k + _AT_ONCE].toarray().reshape(p, 3, -1)
        turned[:, k : k + _AT_ONCE] += cofactors.normal.reduced_sides(side)
    z = cofactors.reduced if cofactors.referral is None else cofactors.referral.before
    inverse = scipy.sparse.bsr_array((cofactors.normal.inverse, np.arange(p), np.arange(p + 1)))
    m: Array = -(turned.T @ (z @ turned)) - (by_points.T @ (inverse @ by_points)).toarray()
    own = np.arange(len(normal))
    m.reshape(len(normal), 2, len(normal), 2)[own, :, own, :] += normal
    return m


def _slopes(result: Result, at: Rows, shifts: int) -> tuple[Array, Any]:
    """Cᵀ of the weighted derivatives: by the reduced unknowns (u, 2k), by the points (3p, 2k), sparse."""
    linear, unknowns = result.fit.linear, result.fit.unknowns
    pattern, own, last = linear.system.pattern, np.flatnonzero(at >= 0), linear.rows.shape[2] - 3
    slope = np.swapaxes(linear.system.seen.root[own], 1, 2) @ linear.rows[own]
    column = 2 * at[own][:, None] + np.arange(2)
    turned = np.zeros((unknowns.size, shifts))
    for s in range(SEGMENTS):
        width, start, first = pattern.width[own, s], pattern.start[own, s], pattern.column[own, s]
        for i in range(int(width.max(initial=0))):
            k = np.flatnonzero(width > i)
            np.add.at(turned, (start[k, None] + i, column[k]), slope[k, :, first[k] + i])
    point = linear.system.seen.point[own]
    k = np.flatnonzero(pattern.eliminated[point] == 1)
    place = 3 * point[k, None, None] + np.arange(3) + np.zeros((2, 1), dtype=np.intp)
    shape = (3 * len(linear.prior), shifts)
    where = (place.ravel(), np.repeat(column[k].ravel(), 3))
    by_points = scipy.sparse.coo_array((slope[k, :, last:].ravel(), where), shape=shape).tocsr()
    return turned, by_points


def _tested(
    m: Array, g: Array, normal: Array, cost: float, redundancy: int
) -> tuple[float, tuple[int, int], float]:
    """F of all shifts, its degrees of freedom, and sigma0 without what they explain."""
    scale = 1.0 / np.sqrt(np.diagonal(normal, axis1=1, axis2=2)).ravel()
    values, vectors = np.linalg.eigh(m * np.outer(scale, scale))
    keep = values > _RANK
    part = vectors[:, keep].T @ (scale * g)
    explained, number = float((part**2 / values[keep]).sum()), int(keep.sum())
    left = redundancy - number
    if left < 1 or not number:
        return 0.0, (number, max(left, 0)), float("nan")
    variance = max(cost - explained, 0.0) / left
    return explained / number / variance if variance > 0 else np.inf, (number, left), float(np.sqrt(variance))
