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
from ..compiled_filter import filtered
from .compiled_errors import by_class, of_neighbours, products, standardised, weighted
from .matches import Matches

__all__ = ["with_alike_errors"]

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
    ...                 alike, none, np.zeros((30, 2, 0)), influence, 0 * window)
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
    variance = by_class(unit, shown, activity, limits, free)
    correlation = _correlation(unit, shown, free)
    # The errors that a pixel has in common with those around it, weighted by their influence.
    kernel = np.zeros((2 * _LAGS + 1,) * 2, np.float32)
    kernel[_LAGS, _LAGS] = 1.0
    for (down, right), r in correlation.items():
        kernel[_LAGS + down, _LAGS + right] = kernel[_LAGS - down, _LAGS - right] = r
    k, _, high, broad = found.influence.shape
    # Beside the windows are no errors.
    wide = np.zeros((k, 2, high + 2 * _LAGS, broad + 2 * _LAGS), np.float32)
    largest, plain = np.empty(k), np.empty((k, 2, 2))
    classes = limits, np.sqrt(variance)
    weighted(found.influence, found.noise, classes, _SPREAD, wide, (largest, plain))
    together = filtered(wide.reshape(-1, *wide.shape[2:]), kernel).reshape(found.influence.shape)
    extra = products(wide, together) * largest[:, None, None] ** 2 - plain
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
    shape = len(rows), *found.residuals.shape[1:]
    shifts = np.zeros((0, 2), np.int64)
    if centres is not None:
        shifts = np.rint(2 * (found.xy[rows] - centres)).astype(np.int64)
    unit, used, activity = np.empty(shape, np.float32), np.empty(shape, bool), np.empty(shape, np.float32)
    standardised(rows, found.residuals, found.noise, found.influence, shifts, _SPREAD, (unit, used, activity))
    return unit, used, activity


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
    side, pairs, above, columns, squares, count = of_neighbours(unit, shown, activity, most)
    if not squares > 0:
        return False
    # Residuals are smaller than errors by what the adjustment has taken from them.
    taken = 1 - float(free[shown & (activity <= most)].mean())
    power = squares / count / (1 - taken)
    for total, number in ((side, pairs), (above, columns)):
        r = total / max(number, 1) / power + _TAKEN * taken
        if (abs(r) if both_ways else r) > max(_LEAST, _SIGNIFICANT / np.sqrt(max(number, 1))):
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
