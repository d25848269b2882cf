"""First mappings of a plane target to a frame: a projectivity and a polynomial, maybe behind a fisheye.

The strength of the fisheye (:class:`reseau.optics.Equidistant`) is searched for: the one that leaves least
with a projectivity alone, or behind which most points agree with one.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy

from ...core.data import Array, Mask
from ...optics.composition import Chain
from .lattice_mapping import images_of, started
from .polynomial import refit

STRENGTHS = (0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0)
"""Of fisheyes that are tried: one that shows 180° along the longer side of the frame has 2.5."""
_POINT_PX = 0.1
_LEFT_PX, _BETTER, _FEWEST_FISHEYE = 0.5, 0.5, 8
"""Residuals of a mapping from which a fisheye is tried, share of them that it may leave, and the least number
of points."""
_MIDDLE = 0.5
_ENOUGH = 30
"""Number of points in the centre of the frame from which the projectivity is estimated from these alone."""


def plane_through(at: Array, xy: Array, shape: tuple[int, int], rough_px: float = _LEFT_PX) -> Chain:
    """Mapping through points, behind a fisheye if that leaves much less than none.

    Parameters
    ----------
    at, xy : ndarray (n, 2)
        Lattice coordinates and images.
    shape : (int, int)
        Height and width of the frame.
    rough_px : float
        Root mean square of what a mapping without a fisheye leaves up to which none is tried, pixels.
    """
    plain = polynomial_through(at, xy, shape)
    if len(at) < _FEWEST_FISHEYE:
        return plain
    left = _rms(plain, at, xy)
    if left < rough_px:
        return plain
    strength = fisheye_of(at, xy, shape)
    if not strength > 0:
        return plain
    bent = polynomial_through(at, xy, shape, strength=strength)
    return bent if _rms(bent, at, xy) < _BETTER * left else plain


def _rms(mapping: Chain, at: Array, xy: Array) -> float:
    """Root mean square of what a mapping leaves; infinite where it shows a point nowhere."""
    left = float(np.sqrt(((images_of(mapping, at) - xy) ** 2).mean()))
    return left if np.isfinite(left) else np.inf


def polynomial_through(
    at: Array, xy: Array, shape: tuple[int, int], degree: int = 1, strength: float = 0.0
) -> Chain:
    """Projectivity and polynomial through points, whose degree grows with their number.

    Parameters
    ----------
    at, xy, shape
        See :func:`plane_through`.
    degree : int
        Least degree of the polynomial, for points that were measured precisely.
    strength : float
        Of a fisheye between both; 0, or points outside of what it shows: none.
    """
    if strength > 0:
        straight = projectivity_behind(at, xy, shape, strength)[0]
        if straight is not None:
            return refit(started(straight, degree, shape, strength), at, xy, _POINT_PX)
    h, w = shape
    middle, half = np.array([w - 1, h - 1]) / 2, max(h, w) / 2
    near = np.hypot(*(xy - middle).T) < _MIDDLE * half
    # Distortion of the lens is smallest there; the polynomial then models the distortion alone.
    some = near if near.sum() >= _ENOUGH and np.ptp(at[near], axis=0).min() > 1 else np.ones_like(near)
    straight = projectivity_behind(at[some], xy[some], shape, 0.0)[0]
    return refit(started(np.eye(3) if straight is None else straight, degree, shape), at, xy, _POINT_PX)


def fisheye_of(at: Array, xy: Array, shape: tuple[int, int]) -> float:
    """Strength of the fisheye that leaves least with a projectivity alone; 0 if none leaves less than none.

    Parameters
    ----------
    at, xy, shape
        See :func:`plane_through`.
    """

    def left(strength: float) -> float:
        straight = projectivity_behind(at, xy, shape, strength)[0]
        if straight is None:
            return np.inf
        return float(((images_of(started(straight, 1, shape, strength), at) - xy) ** 2).sum())

    squares: list[float] = []
    for strength in STRENGTHS:
        squares.append(left(strength))
        # What is left has one minimum; a weak fisheye may show less than the frame does.
        if len(squares) > 2 and np.isfinite(squares[-3:]).all() and squares[-1] > squares[-2] > squares[-3]:
            break
    k = int(np.argmin(squares))
    if k == 0:
        return 0.0
    low, high = STRENGTHS[k - 1], STRENGTHS[min(k + 1, len(STRENGTHS) - 1)]
    found = scipy.optimize.minimize_scalar(
        left, bounds=(low, high), method="bounded", options={"xatol": 0.02}
    )
    return float(found.x if found.fun < squares[k] else STRENGTHS[k])


def projectivity_behind(
    at: Array, xy: Array, shape: tuple[int, int], strength: float, limit_px: float | None = None
) -> tuple[Array | None, Mask]:
    """Projectivity (3, 3) through points behind a fisheye, and which points (n,) agree with it.

    Parameters
    ----------
    at, xy, shape
        See :func:`plane_through`.
    strength : float
        Of the fisheye; 0 without one.
    limit_px : float, optional
        Distance within which a point agrees, of which as many as possible do. By default all of them count.

    Returns
    -------
    ndarray or None
        None without a projectivity, or if less than four points that count are in what the fisheye shows, or
        by default not all.
    ndarray of bool (n,)
    """
    ideal = started(np.eye(3), 1, shape, strength).first.inverse(xy) if strength > 0 else xy
    there: Mask = np.asarray(np.isfinite(ideal).all(axis=1))
    agree: Mask = np.zeros(len(at), dtype=bool)
    if there.sum() < 4 or (limit_px is None and not there.all()):
        return None, agree
    method, limit = (0, 0.0) if limit_px is None else (cv2.RANSAC, limit_px)
    found, inlier = cv2.findHomography(at[there], ideal[there], method, limit)
    if found is None:
        return None, agree
    matrix = np.asarray(found, dtype=np.float64)
    if limit_px is not None and strength > 0:
        # That search has compared ideal images.
        off = images_of(started(matrix, 1, shape, strength), at) - xy
        return matrix, np.asarray(np.hypot(*off.T) < limit)
    agree[there] = inlier.ravel() > 0
    return matrix, agree
