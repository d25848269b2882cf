"""Covariances of matched marks where the errors of neighbouring pixels are alike.

An adjustment takes the errors of pixels as independent and, within a patch, as equally large. Compression,
sharpening and resampling violate both: their errors extend over several pixels, and they are large at the
edges of a mark and small in its even surroundings. The residuals of all marks of a frame show how; variances
and correlations are then propagated to the positions with the influence L of each pixel on a position, L Σ Lᵀ
(the law of propagation of covariances; Mikhail and Ackermann 1976, chapter 4).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from .matches import Matches
from .patches import filtered

_LAGS = 7
"""Largest distance of pixels along either axis: errors of a compressed picture end with its blocks of 8."""
_SIGNIFICANT = 4.0
"""A correlation must exceed this many of its standard deviations to be used."""
_LEAST = 0.05
"""Errors count as alike if pixels next to each other have at least this correlation."""
_CANCELLED = 0.3
"""Least share of the variance of independent errors that remains where they cancel each other."""
_SHOWN = 40
"""Most marks from which correlations are learnt."""
_FEW, _SEEN = 24, 60
"""Numbers of marks that show whether there are any, and of those that show what they are."""
_FEWEST = 20
"""Marks that are needed to learn correlations."""
_SPREAD = 5
"""Width in pixels over which errors at the edge of a mark extend."""
_CLASSES = 5
"""Classes of pixels, by their influence on the position, whose variances are estimated apart."""
_TAKEN = 0.7
"""Correlation of neighbouring pixels in what the adjustment takes from their residuals: parameters describe
what is smooth, so residuals of independent errors are negatively correlated by this share of the leverage."""


def with_alike_errors(found: Matches, centres: Array | None = None) -> Matches:
    """Matches with covariances that contain what errors of neighbouring pixels have in common.

    Where pixels next to each other are not significantly correlated, or too few marks show it, the matches
    are returned as they are.

    Parameters
    ----------
    found : Matches
        Marks of one frame; their covariances are those of independent errors.
    centres : ndarray (k, 2), optional
        Pixels in the middle of the windows, if the images of the marks are even about their points. What the
        formed images lack is then even, too, and shifts no mark: only the odd part of residuals counts.
        Covariances may then become smaller; test them by the scatter of positions.

    Returns
    -------
    Matches

    Examples
    --------
    Errors that extend over three pixels along both axes, and pixels that influence a position together:

    >>> from scipy.ndimage import uniform_filter
    >>> rng = np.random.default_rng(0)
    >>> one, none, window = np.ones(30), np.zeros((30, 0)), np.ones((30, 17, 17))
    >>> alike = 3 * uniform_filter(rng.standard_normal(window.shape), (0, 3, 3))
    >>> cov, influence = np.tile(np.eye(2), (30, 1, 1)), np.stack([window, window], axis=1) / 17
    >>> found = Matches(np.zeros((30, 2)), cov, one, one, one, one, none, one, one, one, 0 * one, one > 0,
    ...                 alike, none, np.zeros((30, 2, 0)), influence, 0 * window, one)
    >>> bool(with_alike_errors(found).cov[0, 0, 0] > 5)
    True
    """
    with np.errstate(invalid="ignore"):
        sure = found.converged & (found.rejected < 0.1) & (found.seen > 0.9) & (found.noise > 0)
        sure &= found.noise < 2 * np.median(found.noise[sure]) if sure.any() else False
    sure &= np.isfinite(found.influence).all(axis=(1, 2, 3))
    if sure.sum() < _FEWEST:
        return found
    for most in (_FEW, _SEEN):
        # A part of many marks shows what they have in common.
        rows = np.flatnonzero(sure)
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.intp))]
        unit, shown, activity = _prepared(found, rows, None if centres is None else centres[rows])
        if not shown.any():
            return found
        free = 1 - found.leverage[rows]
        if not _neighbours(unit, shown, activity, free, both_ways=centres is not None):
            return found
    limits = _limits(activity, shown, np.arange(1, _CLASSES) / _CLASSES)
    variance = _by_class(unit, shown, activity, limits, free)
    correlation = _correlation(unit, shown, free)
    # The errors that a pixel has in common with those around it, weighted by their influence.
    kernel = np.zeros((2 * _LAGS + 1,) * 2, np.float32)
    kernel[_LAGS, _LAGS] = 1.0
    for (down, right), r in correlation.items():
        kernel[_LAGS + down, _LAGS + right] = kernel[_LAGS - down, _LAGS - right] = r
    plain = found.influence * found.noise[:, None, None, None]
    known = np.asarray(np.isfinite(plain).all(axis=(1, 2, 3), keepdims=True))
    plain = np.where(known, plain, 0.0)
    own = plain * np.sqrt(variance)[_classes(_activity(found.influence), limits)][:, None]
    largest = np.abs(own).max(axis=(1, 2, 3), initial=0.0)
    largest = np.where(largest > 0, largest, 1.0)[:, None, None, None]
    own = (own / largest).astype(np.float32)
    # Beside the windows are no errors.
    wide = np.pad(own, ((0, 0), (0, 0), (_LAGS, _LAGS), (_LAGS, _LAGS)))
    together = filtered(wide.reshape(-1, *wide.shape[2:]), kernel).reshape(own.shape)
    extra = _products(own, together) * largest[:, 0] ** 2 - _products(plain, plain)
    extra = (extra + np.swapaxes(extra, 1, 2)) / 2
    # Errors that cancel each other, as after sharpening, are not relied upon without further evidence.
    cov, least = found.cov + extra, found.cov if centres is None else _CANCELLED * found.cov
    shrunk = np.linalg.eigvalsh(np.nan_to_num(cov - least))[:, 0] < 0
    cov[shrunk] = _no_less(cov[shrunk], least[shrunk])
    return replace(found, cov=cov)


def _prepared(found: Matches, rows: Rows, centres: Array | None) -> tuple[Array, Mask, Array]:
    """Residuals in units of their standard deviations, the pixels used, and their influence on positions.

    See :func:`with_alike_errors` for `centres`. An image is reflected at the half pixel that is nearest to
    its point.
    """
    unit = found.residuals[rows] / np.maximum(found.noise[rows], 1e-300)[:, None, None]
    if centres is not None:
        right, down = np.rint(2 * (found.xy[rows] - centres)).astype(np.intp).T[:, :, None]
        high, wide = unit.shape[1:]
        across, other = np.arange(high)[::-1] + down, np.arange(wide)[::-1] + right
        there = ((across >= 0) & (across < high))[:, :, None] & ((other >= 0) & (other < wide))[:, None]
        at = np.arange(len(rows))[:, None, None], across[:, :, None] % high, other[:, None] % wide
        unit = np.where(there, unit - unit[at], np.nan) / np.sqrt(2)
    used = np.isfinite(unit)
    return np.where(used, unit, 0.0).astype(np.float32), used, _activity(found.influence[rows])


def _activity(influence: Array) -> Array:
    """Mean square influence (k, r, c) of pixels and those around them on a position; at most 1."""
    found = np.square(influence, dtype=np.float32).sum(axis=1)
    for axis in (1, 2):
        found = scipy.ndimage.uniform_filter1d(found, _SPREAD, axis)
    return np.asarray(found / np.maximum(found.max(axis=(1, 2), keepdims=True), 1e-30))


def _classes(activity: Array, limits: Array) -> Rows:
    """Number of the limits that each value reaches."""
    return np.searchsorted(limits, activity, side="right")


def _by_class(values: Array, used: Mask, activity: Array, limits: Array, free: Array) -> Array:
    """Variances (c,) of pixels (m, r, c) by the class of their activity; 1 for a class without pixels.

    `values` are divided by their roots; `free` are redundancy numbers.
    """
    kind, count = _classes(activity, limits), len(limits) + 1
    squares, degrees = (np.bincount(kind[used], of[used], count) for of in (values.astype(float) ** 2, free))
    variance = np.where(degrees > 0, squares / np.maximum(degrees, 1.0), 1.0)
    values /= np.maximum(np.sqrt(variance), 1e-6)[kind]
    return variance


def _products(one: Array, other: Array) -> Array:
    """Scalar products (k, 2, 2) of windows (k, 2, r, c)."""
    flat = len(one), 2, -1
    return np.asarray(one.reshape(flat) @ np.swapaxes(other.reshape(flat), 1, 2), np.float64)


def _limits(activity: Array, shown: Mask, share: float | Array) -> Array:
    """Quantiles of the activity of the pixels shown; one in four shows them."""
    some = np.s_[:, ::2, ::2] if shown[:, ::2, ::2].any() else np.s_[:]
    return np.atleast_1d(np.quantile(activity[some][shown[some]], share))


def _no_less(cov: Array, least: Array) -> Array:
    """Covariances (k, 2, 2), enlarged where they are less than others in any direction."""
    root = np.linalg.cholesky(least)
    back = np.linalg.inv(root)
    value, vector = np.linalg.eigh(back @ cov @ np.swapaxes(back, 1, 2))
    axes = root @ vector
    enlarged: Array = (axes * np.maximum(value, 1.0)[:, None]) @ np.swapaxes(axes, 1, 2)
    return enlarged


def _lags() -> Iterator[tuple[int, int]]:
    """Distances (down, right) of pairs of pixels, each pair once."""
    for down in range(_LAGS + 1):
        for right in range(-_LAGS if down else 1, _LAGS + 1):
            yield down, right


def _neighbours(unit: Array, shown: Mask, activity: Array, free: Array, both_ways: bool) -> bool:
    """Whether pixels next to each other have errors in common, or also opposite ones.

    Beside a mark, where its image is even, residuals show the errors of pixels alone; on it, also what the
    formed image lacks, which is alike in all marks and symmetric.
    """
    most = float(_limits(activity, shown, 0.5)[0])
    even = shown & (activity <= most)
    quiet = np.where(even, unit, 0.0)
    squares, count = float(np.vdot(quiet, quiet)), np.count_nonzero(even)
    if not squares > 0:
        return False
    # Residuals are smaller than errors by what the adjustment has taken from them.
    taken = 1 - float(free[even].mean())
    power = squares / count / (1 - taken)
    for before, after in ((np.s_[:, :, :-1], np.s_[:, :, 1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        total = float((quiet[before] * quiet[after]).sum())
        number = max(int(np.count_nonzero(even[before] & even[after])), 1)
        r = total / number / power + _TAKEN * taken
        if (abs(r) if both_ways else r) > max(_LEAST, _SIGNIFICANT / np.sqrt(number)):
            return True
    return False


def _correlation(unit: Array, used: Mask, free: Array) -> dict[tuple[int, int], float]:
    """Significant correlations by distance; a part of many marks shows them."""
    some = np.unique(np.linspace(0, len(unit) - 1, _SHOWN).astype(np.intp))
    unit, used, free = unit[some], used[some], free[some]
    sums, pairs = (_lag_sums(values) for values in (unit, used.astype(np.float32)))
    taken = 1 - float(free[used].mean())
    power = float((unit[used] ** 2).mean()) / (1 - taken)
    rows, columns = unit.shape[1:]
    found = {}
    for down, right in _lags():
        if down >= rows or abs(right) >= columns:
            continue
        count = max(float(pairs[down, right]), 1.0)
        r = float(sums[down, right]) / count / power + _TAKEN * taken
        if abs(r) > _SIGNIFICANT / np.sqrt(count):
            found[down, right] = r
    return found


def _lag_sums(windows: NDArray[Any]) -> Array:
    """Sums of products of pixels of windows (k, rows, columns) at all distances (down, right) up to `_LAGS`.

    Negative distances are counted from the end. By the theorem of Wiener and Khinchin these are the transform
    of the power spectrum, of windows with as many zeros beside them.
    """
    size = [scipy.fft.next_fast_len(n + _LAGS, real=True) for n in windows.shape[1:]]
    spectrum = scipy.fft.rfft2(windows, size)
    power = np.einsum("kij,kij->ij", spectrum.real, spectrum.real)
    power += np.einsum("kij,kij->ij", spectrum.imag, spectrum.imag)
    return np.asarray(scipy.fft.irfft2(power, size))
