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
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import uniform_filter

from ...core.data import Array, Mask, Rows
from ..compiled_filter import filtered
from .matches import Matches

__all__ = ["displaced", "with_alike_errors"]

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
        unit, shown, activity = _prepared(found.select(rows), None if centres is None else centres[rows])
        if not shown.any():
            return found
        free = 1 - found.leverage[rows]
        # Beside a mark, where its image is even, residuals show the errors of pixels alone; on it, also what
        # the formed image lacks, which is alike in all marks and symmetric.
        beside = shown & (activity <= np.median(activity[shown]))
        if not _neighbours(unit, beside, free, both_ways=centres is not None):
            return found
    limits = np.quantile(activity[shown], np.arange(1, _CLASSES) / _CLASSES)
    kind = _kinds(activity, limits)
    variance = np.ones(_CLASSES)
    for k in range(_CLASSES):
        those = shown & (kind == k)
        if those.any():
            variance[k] = (unit[those] ** 2).sum() / max(free[those].sum(), 1.0)
    correlation = _correlation(unit / np.maximum(np.sqrt(variance)[kind], 1e-6), shown, free)
    single = np.float32
    influence: Any = found.influence.astype(single, copy=False)
    influence = influence * found.noise.astype(single)[:, None, None, None]
    kind = _kinds(_activity(influence), limits)
    uneven = influence * np.sqrt(variance).astype(single)[kind][:, None]
    # The errors that a pixel has in common with those around it, weighted by their influence.
    kernel = np.zeros((2 * _LAGS + 1,) * 2, single)
    kernel[_LAGS, _LAGS] = 1.0
    for (down, right), r in correlation.items():
        kernel[_LAGS + down, _LAGS + right] = kernel[_LAGS - down, _LAGS - right] = r
    # Windows in units of their largest value; beside them are no errors.
    largest = np.abs(uneven).max(axis=(1, 2, 3))
    known = np.isfinite(largest) & (largest > 0)
    unity = np.where(known, largest, 1.0).astype(single)
    scaled: Any = np.where(known[:, None, None, None], uneven, 0.0) / unity[:, None, None, None]
    wide = np.pad(scaled, ((0, 0), (0, 0), (_LAGS, _LAGS), (_LAGS, _LAGS)))
    together = filtered(wide.reshape(-1, *wide.shape[2:]), kernel)
    extra = _products(scaled, together.reshape(scaled.shape)) * unity[:, None, None].astype(np.float64) ** 2
    extra -= np.where(known[:, None, None], _products(influence, influence), 0.0)
    extra = (extra + np.swapaxes(extra, 1, 2)) / 2
    # Errors that cancel each other, as after sharpening, are not relied upon without further evidence.
    cov, least = found.cov + extra, found.cov if centres is None else _CANCELLED * found.cov
    shrunk = np.linalg.eigvalsh(np.nan_to_num(cov - least))[:, 0] < 0
    cov[shrunk] = _no_less(cov[shrunk], least[shrunk])
    return replace(found, cov=cov)


def _prepared(found: Matches, centres: Array | None) -> tuple[Array, Mask, Array]:
    """Residuals in units of their standard deviations, the pixels used, and their influence on positions.

    See :func:`with_alike_errors` for `centres`.
    """
    used = np.isfinite(found.residuals)
    unit = np.where(used, found.residuals, 0.0) / np.maximum(found.noise, 1e-300)[:, None, None]
    if centres is not None:
        unit, used = _odd(unit, used, found.xy - centres)
    return unit, used, _activity(found.influence * found.noise[:, None, None, None])


def _kinds(activity: Array, limits: Array) -> Rows:
    """Number of `limits` that each value reaches."""
    kind = np.zeros(activity.shape, np.uint8)
    for limit in limits:
        kind += activity >= limit
    return kind.astype(np.intp)


def _products(one: Array, other: Array) -> Array:
    """Scalar products (k, 2, 2) of pairs of windows (k, 2, rows, columns)."""
    a, b = (part.reshape(*part.shape[:2], -1) for part in (one, other))
    return np.asarray(a @ np.swapaxes(b, 1, 2), dtype=np.float64)


def _activity(influence: Array) -> Array:
    """Influence (k, rows, columns) of pixels and those around them on positions; at most 1."""
    activity = uniform_filter((influence**2).sum(axis=1), (0, _SPREAD, _SPREAD))
    return np.asarray(activity / np.maximum(activity.max(axis=(1, 2), keepdims=True), 1e-30))


def _odd(unit: Array, used: Mask, off: Array) -> tuple[Array, Mask]:
    """Odd part of images about points (k, 2) near their middles, of the same variance, and its pixels.

    An image is reflected at the half pixel that is nearest to its point.
    """
    other, both = np.zeros_like(unit), np.zeros_like(used)
    twice = np.rint(2 * off)
    for shift in np.unique(twice, axis=0):
        if not np.isfinite(shift).all() or np.abs(shift).max() >= min(unit.shape[1:]):
            continue
        these, (right, down) = (twice == shift).all(axis=1), shift.astype(int)
        there, here = (
            tuple(
                slice(max(0, s * t), n + min(0, s * t))
                for t, n in zip((down, right), unit.shape[1:], strict=True)
            )
            for s in (1, -1)
        )
        turned, seen = unit[these, ::-1, ::-1], used[these, ::-1, ::-1]
        part, mask = np.zeros_like(turned), np.zeros_like(seen)
        part[:, *there], mask[:, *there] = turned[:, *here], seen[:, *here]
        other[these], both[these] = part, mask & used[these]
    return np.where(both, (unit - other) / np.sqrt(2), 0.0), both


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


def displaced(values: NDArray[Any], down: int, right: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Two views of windows (..., rows, columns), the second displaced against the first.

    Examples
    --------
    >>> here, there = displaced(np.arange(6).reshape(2, 3), 1, -1)
    >>> here.tolist(), there.tolist()
    ([[1, 2]], [[3, 4]])
    """
    rows, columns = values.shape[-2:]
    return (
        values[..., : rows - down, max(0, -right) : columns - max(0, right)],
        values[..., down:, max(0, right) : columns + min(0, right)],
    )


def _at(lag: tuple[int, int], unit: Array, used: Mask, free: Array) -> tuple[float, float]:
    """Correlation of residuals in units of their standard deviations, and its standard deviation."""
    if not used.any() or not unit[used].any():
        return 0.0, np.inf
    here, there = displaced(np.where(used, unit, 0.0), *lag)
    both = np.logical_and(*displaced(used, *lag))
    count = max(int(both.sum()), 1)
    # Residuals are smaller than errors by what the adjustment has taken from them.
    taken = 1 - float(free[used].mean())
    power = float((unit[used] ** 2).mean()) / (1 - taken)
    return float((here * there).sum()) / count / power + _TAKEN * taken, 1 / np.sqrt(count)


def _neighbours(unit: Array, used: Mask, free: Array, both_ways: bool) -> bool:
    """Whether pixels next to each other have errors in common, or also opposite ones."""
    found = [_at(lag, unit, used, free) for lag in ((0, 1), (1, 0))]
    return any((abs(r) if both_ways else r) > max(_LEAST, _SIGNIFICANT * sigma) for r, sigma in found)


def _correlation(unit: Array, used: Mask, free: Array) -> dict[tuple[int, int], float]:
    """Significant correlations by distance; a part of many marks shows them."""
    some = np.unique(np.linspace(0, len(unit) - 1, _SHOWN).astype(np.intp))
    unit, used, free = unit[some], used[some], free[some]
    sums, pairs = (_lag_sums(values.astype(np.float32)) for values in (np.where(used, unit, 0.0), used))
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


def _lag_sums(windows: Array) -> Array:
    """Sums of products of pixels of windows (k, rows, columns) at all distances (down, right) up to `_LAGS`.

    Negative distances are counted from the end. By the theorem of Wiener and Khinchin these are the transform
    of the power spectrum, of windows with as many zeros beside them.
    """
    size = [next_fast_len(n + _LAGS, real=True) for n in windows.shape[1:]]
    spectrum = rfft2(windows, size)
    power = np.einsum("kij,kij->ij", spectrum.real, spectrum.real)
    power += np.einsum("kij,kij->ij", spectrum.imag, spectrum.imag)
    return np.asarray(irfft2(power, size))
