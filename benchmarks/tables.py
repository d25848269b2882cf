"""Tables of the benchmarks: normalised errors with their standard errors, level and power of tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binom

from reseau.core.data import Array

__all__ = ["ALPHA", "SIZES", "judged", "level_band", "mean_square", "print_power", "rms", "rms_over_worlds"]

ALPHA = 0.05
"""Level of all tests."""
SIZES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
"""Sizes of coefficients, in standard deviations, at which the power of their tests is computed."""


def rms(values: Array, axis: int | None = None) -> Array:
    """Root mean square, ignoring NaN."""
    found: Array = np.sqrt(np.nanmean(np.square(values), axis=axis))
    return found


def mean_square(groups: Sequence[Array]) -> tuple[float, float]:
    """Mean square of errors in groups, and its standard error with correlated errors in a group.

    That of a ratio of sums over groups, here worlds (Cochran 1977, *Sampling Techniques*, ch. 6).
    """
    count = np.array([np.isfinite(group).sum() for group in groups], dtype=np.float64)
    total = np.array([np.nansum(np.square(group)) for group in groups])
    if not count.any():
        return np.nan, np.nan
    mean = total.sum() / count.sum()
    n = np.count_nonzero(count)
    spread = np.sqrt(np.square(total - mean * count).sum() * n / max(n - 1, 1)) / count.sum()
    return float(mean), float(spread) if n > 1 else np.nan


def rms_over_worlds(groups: Sequence[Array]) -> tuple[float, float]:
    """Root mean square of errors in groups, and its standard error; see `mean_square`."""
    mean, spread = mean_square(groups)
    value = float(np.sqrt(mean))
    return value, spread / (2 * value) if value > 0 else np.nan


def judged(value: float, low: float = 0.9, high: float = 1.1) -> str:
    """A number, marked if it is outside its band."""
    return f"{value:.3f}" + ("" if low <= value <= high else " !")


def level_band(draws: int, level: float = ALPHA) -> tuple[float, float]:
    """Interval of the rate over `draws` at this level with a probability of 99 %."""
    low, high = (float(binom.ppf(q, draws, level)) / draws for q in (0.005, 0.995))
    return low, high


def print_power(
    title: str, names: Sequence[str], rates: Sequence[Array], draws: list[int], theory: Array
) -> None:
    """Level and power of tests.

    Parameters
    ----------
    title : str
        Which tests.
    names : sequence of str (k,)
        Of the coefficients.
    rates : sequence of ndarray (k,)
        For each of `SIZES` the shares called significant.
    draws : list of int
        For each size the number of draws.
    theory : ndarray
        For each size the share to expect.
    """
    low, high = level_band(draws[0])
    print(f"\n{title} at {100 * ALPHA:.0f} %: rate of significant results, in %")
    print(f"  at size 0 over {draws[0]} seeds (99 % band {100 * low:.1f}–{100 * high:.1f}), ", end="")
    print(f"else over {draws[-1]}")
    print("  size/σ  " + "".join(f"{name:>7}" for name in names) + "  theory")
    for size, rate, expected in zip(SIZES, rates, theory, strict=True):
        print(f"  {size:<8.0f}" + "".join(f"{100 * r:7.1f}" for r in rate) + f"{100 * expected:8.1f}")
    outside = [name for name, rate in zip(names, rates[0], strict=True) if not low <= rate <= high]
    print(f"  level {'satisfied by all' if not outside else 'not satisfied by ' + ', '.join(outside) + ' !'}")
