"""Numbers as instruments write them: a value, or an error; never a part of what was written.

Source: IEEE 488.2-1992, 8.7.2 to 8.7.4 (NR1, NR2, NR3); SCPI 1999.0, volume 1, 7.2.1.4 and 7.2.1.5 (9.9E37 is
infinity, 9.91E37 not a number); SI prefixes where a unit follows.
"""

from __future__ import annotations

import math
import re

from reseau.core.errors import ProtocolError

_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[Ee][-+]?\d+)?)\s*([^\d\s,;.+-][^\d\s,;]*)?", re.ASCII)
INFINITE = 9.9e37
"""From here on, SCPI's numbers stand for infinity, or for none."""
_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "G": 1e9}
"""M is milli for some instruments and mega for others: only rates have it."""
_SPELLINGS = {
    "s": ("s", "S"), "°C": ("°C", "C", "degC", "DEGC", "CEL"), "%": ("%", "%RH", "RH", "PCT"),
    "hPa": ("hPa", "HPA", "mbar", "MBAR"),
}  # fmt: skip
"""Other ways in which instruments write units."""


def number(text: str, unit: str | None = "", *, to: str = "") -> float:
    """Return a number.

    Parameters
    ----------
    text : str
        What the instrument wrote.
    unit : str or None
        Unit that may follow, with or without a prefix; None: any word.
    to : str
        The query that it answers, for messages.

    Raises
    ------
    ProtocolError
        If the text is not one number, or stands for infinity or for none.

    Examples
    --------
    >>> number("-1.50E+00"), number("500mV", "V"), number("1.00GSa/s", "Sa/s")
    (-1.5, 0.5, 1000000000.0)
    >>> number("5,00E-01")
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: '5,00E-01' is not a number; set its numbers to a decimal point
    >>> number("9.91E37")
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: '9.91E37' stands for no value; is it switched on, and within its range?
    """
    found, shown = _NUMBER.fullmatch(text.strip()), _shown(text, to)
    if found is None:
        do = "set its numbers to a decimal point" if re.search(r"\d,\d", text) else None
        raise ProtocolError(f"{shown} is not a number", do=do)
    value, word = float(found[1]), found[2] or ""
    if not math.isfinite(value) or abs(value) >= INFINITE:
        raise ProtocolError(f"{shown} stands for no value", do="is it switched on, and within its range?")
    if unit is None or not word:
        return value
    scale = _scale(word, unit)
    if scale is None:
        what = f"is not in {unit}" if unit else "is not a number alone"
        raise ProtocolError(f"{shown} {what}")
    return value * scale


def _scale(word: str, unit: str) -> float | None:
    """What a unit stands for, in terms of the wanted one."""
    for written in _SPELLINGS.get(unit, (unit,) if unit else ()):
        if word.endswith(written):
            prefix = word[: -len(written)]
            scale = 1e6 if prefix == "M" and unit == "Sa/s" else _PREFIXES.get(prefix)
            if scale is not None:
                return scale
    return None


def numbers(text: str, *counts: int, unit: str | None = "", to: str = "") -> list[float]:
    """Return numbers that are separated by commas.

    Parameters
    ----------
    text : str
        What the instrument wrote.
    *counts : int
        How many there may be; what is more than the first is not read as numbers.
    unit, to
        As for :func:`number`.

    Raises
    ------
    ProtocolError
        If there are more or fewer, or one is none.

    Examples
    --------
    >>> numbers("0,2,1200", 3)
    [0.0, 2.0, 1200.0]
    >>> numbers("1,5", 1)
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: '1,5' has 2 fields, not 1; is a comma its decimal point?
    """
    fields = text.split(",")
    if len(fields) not in counts:
        wanted = " or ".join(map(str, counts))
        do = "is a comma its decimal point?" if len(fields) > counts[0] else None
        raise ProtocolError(f"{_shown(text, to)} has {len(fields)} fields, not {wanted}", do=do)
    return [number(each, unit, to=to) for each in fields[: counts[0]]]


def _shown(text: str, to: str) -> str:
    return repr(text.strip()[:60]) + (f" in answer to {to}" if to else "")
