"""Common residual patterns of several images: test and map.

Vosselman and Förstner (1988, sect. 4.3) found that residuals which look random in one image repeat in other
images of the same camera and board rotation. The hypothesis is that the measured coordinates of a class of
observations (one point in images of one kind; one cell of the frame in all images) have a common shift. The
shifts s are parameters C s that are missing in the adjustment; with the weighted residuals w and their
cofactors I − A Q Aᵀ they reduce wᵀw by

    T = gᵀ M⁻ g,   g = Cᵀ w,   M = Cᵀ (I − A Q Aᵀ) C,

to first order the same as an adjustment with these parameters (Koch 1999, ch. 4; Förstner & Wrobel 2016,
sect. 4.6). Shifts that orientation, calibration and points absorb are not tested: M is singular there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from ...core.data import Array, Rows
from ...core.display import Display
from ...core.errors import UsageError
from ...core.threads import one_thread
from ..solver.normal import SEGMENTS
from .result import Result

# Eigenvalues of the scaled M below this belong to shifts that the unknowns absorb.
_RANK = 1e-6
# Maximum number of shift components, because of their full matrices, and columns processed at once.
_MOST, _AT_ONCE = 6000, 128


@dataclass(frozen=True, eq=False, repr=False)
class CommonPattern(Display):
    """Common shifts of classes of observations.

    Parameters
    ----------
    key : ndarray of int (n,)
        Class of each image point, −1 for none.
    xy : ndarray (k, 2)
        Mean position of each class in its images, px.
    shift : ndarray (k, 2)
        Mean error of the measured points of each class, px: the negative weighted mean of their residuals.
    cov : ndarray (k, 2, 2)
        Covariances of the shifts due to noise.
    count : ndarray of int (k,)
        Image points in each class.
    statistic : float
        F of all shifts together.
    degrees : (int, int)
        Degrees of freedom of F.
    sigma0 : float
        Standard deviation of unit weight when the shifts are estimated too.
    rms : float
        Root mean square of the shifts per coordinate after subtraction of the noise, px, assuming the same
        size everywhere; 0 where the noise is larger.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> pattern = common_pattern(result, by_place(result, 0, 2, 2))
    >>> pattern
    <CommonPattern: 4 classes, F 0.8, p 0.57, 0 px rms>
    >>> pattern.count, pattern.degrees
    (array([41, 40, 39, 40]), (6, 209))
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

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{len(self.count)} classes", ""),
            ("F", f"{self.statistic:.1f}"),
            ("p", f"{self.p:.2g}"),
            (f"{self.rms:.2g} px rms", ""),
        ]

    def _columns(self) -> dict[str, list[object]]:
        found: dict[str, list[object]] = {}
        for k, axis in enumerate("xy"):
            found |= {
                f"{axis}_px": self.xy[:, k].tolist(),
                f"shift_{axis}_px": self.shift[:, k].tolist(),
                f"sigma_{axis}_px": np.sqrt(self.cov[:, k, k]).tolist(),
            }
        return found | {"count": self.count.tolist(), "p": self.p_at.tolist()}

    @property
    def p(self) -> float:
        """Probability of an F at least as large without common shifts."""
        return float(scipy.special.fdtrc(*self.degrees, self.statistic)) if all(self.degrees) else 1.0

    @property
    def p_at(self) -> Array:
        """Probability for each class separately (k,); one where the unknowns absorb its shift."""
        known = np.linalg.det(self.cov) > 0
        p = np.ones(len(self.cov))
        s = self.shift[known]
        square = np.einsum("ni,ni->n", s, np.linalg.solve(self.cov[known], s[:, :, None])[:, :, 0])
        p[known] = scipy.special.fdtrc(2, max(sum(self.degrees), 1), square / 2)
        return p


def by_point(result: Result, kinds: Sequence[str | None]) -> Rows:
    """Form classes of each point in images of each kind.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    kinds : sequence of str or None (m,)
        Kind of each image; None for images to ignore.

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
    return np.where(of >= 0, of * len(network.points) + network.point_of, -1)


def by_place(result: Result, camera: int, across: int = 12, down: int | None = None) -> Rows:
    """Form classes of image points in each cell of a grid over all images of a camera.

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
    return np.where(own, cell[:, 1] * across + cell[:, 0], -1).astype(np.intp)


@one_thread()
def common_pattern(result: Result, key: Rows) -> CommonPattern:
    """Test and map the common shifts of classes of image points.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    key : ndarray of int (n,)
        Class of each image point, −1 for none; see :func:`by_point`, :func:`by_place`. Classes with a single
        image point are ignored.

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
        raise UsageError("no class has two image points", where="common_pattern")
    shifts = int(good.sum())
    if 2 * shifts > _MOST:
        raise UsageError(
            f"{shifts} classes are too many; at most {_MOST // 2} can be tested", where="common_pattern"
        )
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
    # A pattern s appears in the residuals as N⁻¹ M s.
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
    """M (2k, 2k): normal equations of the shifts, reduced by the unknowns of the adjustment.

    Points are eliminated as in the adjustment: with the derivatives H by the reduced unknowns and K by the
    points, CᵀA Q AᵀC = K V⁻¹ Kᵀ + (H − K V⁻¹ Wᵀ) Z (H − K V⁻¹ Wᵀ)ᵀ, with Z in any datum.
    """
    cofactors = result.fit.cofactors
    shifts, p = 2 * len(normal), len(cofactors.points)
    turned, by_points = _slopes(result, at, shifts)
    columns = scipy.sparse.csc_array(by_points)
    for k in range(0, shifts, _AT_ONCE):
        side = columns[:, k : k + _AT_ONCE].toarray(order="C").reshape(p, 3, -1)
        turned[:, k : k + _AT_ONCE] += cofactors.normal.reduced_sides(side)
    z = cofactors.reduced if cofactors.referral is None else cofactors.referral.before
    inverse = scipy.sparse.bsr_array((cofactors.normal.inverse, np.arange(p), np.arange(p + 1)))
    m: Array = -(turned.T @ z.times(turned)) - (by_points.T @ (inverse @ by_points)).toarray()
    own = np.arange(len(normal))
    m.reshape(len(normal), 2, len(normal), 2)[own, :, own, :] += normal
    return m


def _slopes(result: Result, at: Rows, shifts: int) -> tuple[Array, Any]:
    """Products of Cᵀ and the weighted derivatives by reduced unknowns (u, 2k) and points (3p, 2k), sparse."""
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
    """Return F of all shifts, its degrees of freedom, and sigma0 with the shifts estimated."""
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
