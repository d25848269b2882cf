"""Features of GenICam by their names, as text: ``ReverseX=true BlackLevel=16 DeviceUserID="left eye"``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence

from reseau.core.errors import RefusedError, SettingError

__all__ = ["require_within", "same_value", "wanted_features"]


def wanted_features(text: str) -> tuple[tuple[str, str], ...]:
    """Names and values, in the order in which they are to be set.

    Raises
    ------
    SettingError
        When the text is something else.

    Examples
    --------
    >>> wanted_features('ReverseX=true  DeviceUserID="left eye"')
    (('ReverseX', 'true'), ('DeviceUserID', 'left eye'))
    """
    try:
        pairs = [word.partition("=") for word in shlex.split(text)]
    except ValueError as error:
        raise SettingError(f"{text!r} is not whole ({error})", where="features") from None
    for name, sign, value in pairs:
        if not (name.isidentifier() and sign and value):
            raise SettingError(
                f"{name + sign + value!r} sets no feature",
                where="features",
                do="write Name=value, with blanks between them",
            )
    return tuple((name, value) for name, _, value in pairs)


def same_value(got: str, wanted: str) -> bool:
    """Whether what a camera says it has is what was asked for.

    Examples
    --------
    >>> same_value("2.500000", "2.5"), same_value("16", "0x10"), same_value("true", "True")
    (True, True, True)
    >>> same_value("2", "3"), same_value("Off", "On")
    (False, False)
    """
    if got.casefold() == wanted.casefold():
        return True
    numbers = _number(got), _number(wanted)
    return math.isclose(*numbers, rel_tol=1e-6)


def require_within(name: str, value: float, bounds: Sequence[float]) -> None:
    """Make sure that a camera can do what it is to be set to.

    Raises
    ------
    RefusedError
        When the value is beyond its bounds.
    """
    low, high = bounds[0], bounds[1]
    if not low <= value <= high:
        raise RefusedError(f"{name} {value:g} is beyond its {low:g}…{high:g}")


def _number(text: str) -> float:
    """The number; NaN, which is the same as no other, when it is none."""
    for kind in (lambda: int(text, 0), lambda: float(text)):
        try:
            return kind()
        except ValueError:
            continue
    return math.nan
