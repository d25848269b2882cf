"""Errors that pixels of windows have in common, compiled; see :mod:`reseau.measure.matching.correlation`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = ["by_class", "of_neighbours", "products", "standardised", "weighted"]

Floats = NDArray[Any]
f32 = np.float32


@compiled
def standardised(
    rows: Floats,
    residuals: Floats,
    noise: Floats,
    influence: Floats,
    shifts: Floats,
    width: int,
    found: tuple[Floats, Floats, Floats],
) -> None:
    """Fill residuals of windows in units of their standard deviation, the pixels used, and their activity.

    Parameters
    ----------
    rows : ndarray of int (m,)
        The windows.
    residuals, noise, influence : ndarray (k, r, c), (k,), (k, 2, r, c)
        As of :class:`reseau.measure.matching.matches.Matches`.
    shifts : ndarray of int (m, 2)
        Twice the distances right and down from the middle of each window at which its odd part is taken;
        (0, 2) where residuals count as they are.
    width : int
        Of the square over which the activity is a mean.
    found : tuple
        Filled: values (m, r, c), float32, 0 where a pixel is not used; these pixels (m, r, c); activity
        (m, r, c), float32.
    """
    values, used, activity = found
    _, high, wide = residuals.shape
    squares, sums = np.empty((high, wide), f32), np.empty((high, wide), f32)
    for j in range(len(rows)):
        k = rows[j]
        here, scale = residuals[k], 1.0 / max(noise[k], 1e-300)
        if len(shifts):
            right, down = shifts[j, 0], shifts[j, 1]
            scale /= math.sqrt(2.0)
            for y in range(high):
                across = high - 1 - y + down
                for x in range(wide):
                    other = wide - 1 - x + right
                    off = math.nan
                    if 0 <= across < high and 0 <= other < wide:
                        off = here[y, x] - here[across, other]
                    used[j, y, x] = math.isfinite(off)
                    values[j, y, x] = f32(off * scale) if used[j, y, x] else f32(0)
        else:
            for y in range(high):
                for x in range(wide):
                    used[j, y, x] = math.isfinite(here[y, x])
                    values[j, y, x] = f32(here[y, x] * scale) if used[j, y, x] else f32(0)
        _fill_activity(influence[k], width, squares, sums, activity[j])


@compiled
def _mirrored(at: int, size: int) -> int:
    """Index of a pixel beyond the border, as that of the pixel as far inside."""
    if at < 0:
        at = -at - 1
    elif at >= size:
        at = 2 * size - at - 1
    return min(max(at, 0), size - 1)


@compiled
def _fill_activity(influence: Floats, width: int, squares: Floats, sums: Floats, activity: Floats) -> None:
    """Fill the mean square influence (r, c) of pixels and those around them on a position; at most 1.

    `squares` and `sums` (r, c) are memory.
    """
    high, wide = squares.shape
    reach = width // 2
    for y in range(high):
        for x in range(wide):
            squares[y, x] = influence[0, y, x] ** 2 + influence[1, y, x] ** 2
    for y in range(high):
        sums[y] = squares[y]
        for step in range(1, reach + 1):
            above, below = squares[_mirrored(y - step, high)], squares[_mirrored(y + step, high)]
            for x in range(wide):
                sums[y, x] += above[x] + below[x]
    largest = 0.0
    for y in range(high):
        line = sums[y]
        for x in range(wide):
            total = line[x]
            if reach <= x < wide - reach:
                for step in range(1, reach + 1):
                    total += line[x - step] + line[x + step]
            else:
                for step in range(1, reach + 1):
                    total += line[_mirrored(x - step, wide)] + line[_mirrored(x + step, wide)]
            activity[y, x] = total
            largest = max(largest, float(total))
    scale = f32(1.0 / max(largest, 1e-30))
    for y in range(high):
        for x in range(wide):
            activity[y, x] *= scale


@compiled
def of_neighbours(values: Floats, used: Floats, activity: Floats, most: float) -> Floats:
    """Sums over pixels of windows (k, r, c) whose activity is at most `most`.

    Returns
    -------
    ndarray (6,)
        Products of pixels side by side, and number of these pairs; the same of pixels one above the other;
        square sum of all, and their number.
    """
    total = np.zeros(6)
    for k in range(len(values)):
        for y in range(values.shape[1]):
            for x in range(values.shape[2]):
                if not used[k, y, x] or activity[k, y, x] > most:
                    continue
                here = values[k, y, x]
                total[4] += here * here
                total[5] += 1
                if x > 0 and used[k, y, x - 1] and activity[k, y, x - 1] <= most:
                    total[0] += here * values[k, y, x - 1]
                    total[1] += 1
                if y > 0 and used[k, y - 1, x] and activity[k, y - 1, x] <= most:
                    total[2] += here * values[k, y - 1, x]
                    total[3] += 1
    return total


@compiled
def _class_of(activity: float, limits: Floats) -> int:
    """Number of `limits` that a value reaches."""
    kind = 0
    for limit in limits:
        kind += activity >= limit
    return kind


@compiled
def by_class(values: Floats, used: Floats, activity: Floats, limits: Floats, free: Floats) -> Floats:
    """Variances of pixels by the class of their activity; `values` are divided by their roots.

    Parameters
    ----------
    values, used, activity : ndarray (m, r, c)
        As filled by :func:`standardised`.
    limits : ndarray (c - 1,)
        Of the activity.
    free : ndarray (m, r, c)
        Redundancy numbers of pixels.

    Returns
    -------
    ndarray (c,)
        1 for a class without pixels.
    """
    sums = np.zeros((2, len(limits) + 1))
    for k in range(len(values)):
        for y in range(values.shape[1]):
            for x in range(values.shape[2]):
                if used[k, y, x]:
                    kind = _class_of(activity[k, y, x], limits)
                    sums[0, kind] += values[k, y, x] ** 2
                    sums[1, kind] += free[k, y, x]
    variance = np.ones(len(limits) + 1)
    for kind in range(len(variance)):
        if sums[1, kind] > 0:
            variance[kind] = sums[0, kind] / max(sums[1, kind], 1.0)
    scale = 1.0 / np.maximum(np.sqrt(variance), 1e-6)
    for k in range(len(values)):
        for y in range(values.shape[1]):
            for x in range(values.shape[2]):
                values[k, y, x] *= f32(scale[_class_of(activity[k, y, x], limits)])
    return variance


@compiled
def weighted(
    influence: Floats,
    noise: Floats,
    classes: tuple[Floats, Floats],
    width: int,
    wide: Floats,
    found: tuple[Floats, Floats],
) -> None:
    """Fill influences of pixels times the standard deviations of their errors.

    Parameters
    ----------
    influence, noise : ndarray (k, 2, r, c), (k,)
        As of :class:`reseau.measure.matching.matches.Matches`.
    classes : (ndarray (c - 1,), ndarray (c,))
        Limits of the activity, and factors of the standard deviation in each class.
    width : int
        See :func:`standardised`.
    wide : ndarray (k, 2, r + 2 p, c + 2 p), float32
        Filled in the middle, relative to the largest value of a window; elsewhere 0. Windows without an
        influence, or with one that is not finite, are 0.
    found : (ndarray (k,), ndarray (k, 2, 2))
        Filled: largest value of each window, and the products of the two influences with equal errors.
    """
    limits, factors = classes
    largest, plain = found
    count, _, high, broad = influence.shape
    reach = (wide.shape[2] - high) // 2
    squares, sums = np.empty((high, broad), f32), np.empty((high, broad), f32)
    activity = np.empty((high, broad), f32)
    for k in range(count):
        _fill_activity(influence[k], width, squares, sums, activity)
        most, xx, xy, yy = 0.0, 0.0, 0.0, 0.0
        for y in range(high):
            for x in range(broad):
                a, b = influence[k, 0, y, x] * noise[k], influence[k, 1, y, x] * noise[k]
                xx += a * a
                xy += a * b
                yy += b * b
                factor = factors[_class_of(activity[y, x], limits)]
                wide[k, 0, reach + y, reach + x] = f32(a * factor)
                wide[k, 1, reach + y, reach + x] = f32(b * factor)
                most = max(most, abs(a * factor), abs(b * factor))
        known = math.isfinite(xx + yy) and most > 0
        largest[k] = most if known else 1.0
        scale = f32(1.0 / largest[k])
        for m in range(2):
            for y in range(reach, reach + high):
                for x in range(reach, reach + broad):
                    wide[k, m, y, x] = wide[k, m, y, x] * scale if known else f32(0)
        plain[k, 0, 0], plain[k, 1, 1] = (xx, yy) if known else (0.0, 0.0)
        plain[k, 0, 1] = plain[k, 1, 0] = xy if known else 0.0


@compiled
def products(wide: Floats, together: Floats) -> Floats:
    """Scalar products (k, 2, 2) of windows (k, 2, r + 2 p, c + 2 p), without their borders, and others."""
    count, _, high, broad = together.shape
    reach = (wide.shape[2] - high) // 2
    found = np.zeros((count, 2, 2))
    for k in range(count):
        for m in range(2):
            for n in range(2):
                for y in range(high):
                    row, other = wide[k, m, reach + y, reach : reach + broad], together[k, n, y]
                    total = 0.0
                    for x in range(broad):
                        total += row[x] * other[x]
                    found[k, m, n] += total
    return found
