"""Numbers as text: aligned columns, powers of ten, and values with as many digits as their sigma supports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

_MINUS = "\u2212"


def aligned(values: Iterable[float], decimals: int) -> list[str]:
    """Numbers of one column, all with the same decimals; a dash where there is none.

    Examples
    --------
    >>> aligned([1.234, -0.5, float("nan")], 2)
    ['1.23', '−0.50', '–']
    """
    # Rounded first and zero added: no minus before a zero.
    rounded = [round(float(v), decimals) + 0.0 if np.isfinite(v) else None for v in values]
    return ["–" if v is None else f"{v:.{decimals}f}".replace("-", _MINUS) for v in rounded]


def or_null(value: float) -> float | None:
    """A number as JSON has it: None in place of NaN and infinity.

    Examples
    --------
    >>> or_null(0.5), or_null(float("nan"))
    (0.5, None)
    """
    return float(value) if np.isfinite(value) else None


def grouped(value: float) -> str:
    """One decimal below a thousand, whole and in groups of three above.

    Examples
    --------
    >>> grouped(62.24), grouped(1064179.8) == "1\u202f064\u202f180"
    ('62.2', True)
    """
    return f"{value:.1f}" if value < 1000 else f"{value:,.0f}".replace(",", "\u202f")


def plain(value: float, digits: int) -> str:
    """Return a number rounded to some digits, without a power of ten.

    Examples
    --------
    >>> plain(5012.3, 3), plain(0.0004567, 2), plain(3600.0, 2), plain(0.00005, 2)
    ('5010', '0.00046', '3600', '0.00005')
    """
    return np.format_float_positional(float(f"{value:.{digits}g}"), trim="-")


class Power(NamedTuple):
    """A value and its standard deviation over a common power of ten."""

    value: str
    sigma: str
    exponent: str


def power(value: float, sigma: float) -> Power:
    """A value with as many digits as two of its standard deviation allow.

    Examples
    --------
    >>> power(-0.00123456, 0.0000012)
    Power(value='−1.2346', sigma='0.0012', exponent='−3')
    >>> power(0.99342, 0.00002)
    Power(value='0.993420', sigma='0.000020', exponent='')
    """
    largest = max(abs(value), sigma)
    exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
    # Between a tenth and ten thousand a number reads best as it is.
    exponent = 0 if -2 <= exponent <= 3 else exponent
    scaled = sigma / 10.0**exponent
    decimals = int(np.clip(1 - np.floor(np.log10(scaled)), 0, 9)) if scaled > 0 else 6
    shown, spread = aligned([value / 10.0**exponent, scaled], decimals)
    return Power(
        shown, spread if sigma > 0 else "held", str(exponent).replace("-", _MINUS) if exponent else ""
    )


def at_power(value: float, shown: Power) -> str:
    """A number of two digits over the power of ten of another one.

    Examples
    --------
    >>> at_power(0.0000075, power(0.000889, 0.000012)), at_power(0.066, power(445.2, 0.061))
    ('0.075', '0.066')
    """
    exponent = int(shown.exponent.replace(_MINUS, "-")) if shown.exponent else 0
    return plain(value / 10.0**exponent, 2)


def measured(value: float, sigma: float | None = None, unit: str = "") -> str:
    """Return a value with its standard deviation and unit, to two digits of the standard deviation.

    Parameters
    ----------
    value : float
        The value.
    sigma : float, optional
        Its standard deviation; 0 or None where it is held or unknown.
    unit : str
        Unit of both; empty or 1 for a number.

    Examples
    --------
    >>> measured(57.499512, 0.0030214, "mm")
    '57.4995 ± 0.0030 mm'
    >>> measured(-0.00000457215, 0.000000031, "mm^-2")
    '(-4.572 ± 0.031)e-6 mm^-2'
    >>> measured(12.5, None, "px")
    '12.5 px'
    """
    tail = f" {unit}" if unit not in ("", "1") else ""
    if sigma is None or not np.isfinite(sigma) or sigma <= 0:
        return f"{value:.7g}{tail}"
    shown = power(value, sigma)
    text = f"{shown.value} ± {shown.sigma}".replace(_MINUS, "-")
    if not shown.exponent:
        return text + tail
    return f"({text})e{shown.exponent.replace(_MINUS, '-')}{tail}"
