"""Settings of instruments: typed, with units and limits, checked before anything is sent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from ..core.errors import SettingError

Limits = Mapping[str, tuple[float, float]]
"""Lowest and highest allowed value of each setting, by name."""


def quantity(default: float, unit: str, low: float, high: float) -> Any:
    """Declare a numeric setting.

    Parameters
    ----------
    default : float
        Default value; an int declares a setting that takes whole numbers only.
    unit : str
        Unit, as it is displayed.
    low, high : float
        Limits, inclusive, in `unit`.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Averaging(Settings):
    ...     frames: int = quantity(1, "", 1, 64)
    >>> Averaging(4).limits
    {'frames': (1, 64)}
    """
    return field(default=default, metadata={"unit": unit, "low": low, "high": high})


def choice(default: str, *options: str) -> Any:
    """Declare a setting with a fixed set of values.

    Parameters
    ----------
    default : str
        Default value.
    *options : str
        Allowed values.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Mode(Settings):
    ...     mode: str = choice("echo", "echo", "through")
    >>> Mode("off")
    Traceback (most recent call last):
    reseau.core.errors.SettingError: mode: 'off' is not one of echo, through
    """
    return field(default=default, metadata={"options": options})


def text(default: str) -> Any:
    """Declare a free text setting; the driver checks its syntax.

    Parameters
    ----------
    default : str
        Default value.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Note(Settings):
    ...     note: str = text("")
    >>> Note("left camera").to_dict()
    {'note': 'left camera'}
    """
    return field(default=default, metadata={"text": True})


@dataclass(frozen=True)
class Settings:
    """Base class of settings; declare fields with :func:`quantity`, :func:`choice` and :func:`text`.

    Raises
    ------
    SettingError
        If a value has a wrong type, is not finite, or is outside its limits.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Pulser(Settings):
    ...     voltage: float = quantity(300.0, "V", 40.0, 300.0)
    >>> Pulser(120.0).units
    {'voltage': 'V'}
    >>> Pulser(400.0)
    Traceback (most recent call last):
    reseau.core.errors.SettingError: voltage: 400 V is outside 40…300 V
    """

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if "options" in each.metadata:
                if value not in each.metadata["options"]:
                    raise SettingError(
                        f"{value!r} is not one of {', '.join(each.metadata['options'])}", where=each.name
                    )
                continue
            if "text" in each.metadata:
                if not isinstance(value, str):
                    raise SettingError(f"{value!r} is not a text", where=each.name)
                continue
            whole = isinstance(each.default, int)
            if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
                raise SettingError(
                    f"{value!r} is not a {'whole number' if whole else 'number'}", where=each.name
                )
            if not whole:
                object.__setattr__(self, each.name, float(value))
            _check(each.name, value, each.metadata["unit"], each.metadata["low"], each.metadata["high"])

    @property
    def units(self) -> dict[str, str]:
        """Units by name of the setting; only numeric settings have one."""
        return {each.name: each.metadata["unit"] for each in fields(self) if "unit" in each.metadata}

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Limits by name of the setting."""
        return {
            each.name: (each.metadata["low"], each.metadata["high"])
            for each in fields(self)
            if "low" in each.metadata
        }

    def to_dict(self) -> dict[str, float | str]:
        """Return the values by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def changed(self, changes: Mapping[str, Any], limits: Limits | None = None) -> Self:
        """Return a copy with other values.

        Parameters
        ----------
        changes : mapping
            New values by name.
        limits : mapping, optional
            Narrower limits by name, for example those of a bench.

        Raises
        ------
        SettingError
            If a setting does not exist or a value is outside its limits.
        """
        known = {each.name for each in fields(self)}
        for name in (*changes, *(limits or {})):
            if name not in known:
                raise SettingError(
                    "is not a setting of this instrument",
                    where=name,
                    do=f"choose from {', '.join(sorted(known))}",
                )
        new = replace(self, **changes)
        for name, (low, high) in (limits or {}).items():
            _check(name, getattr(new, name), new.units.get(name, ""), low, high)
        return new


def _check(name: str, value: float, unit: str, low: float, high: float) -> None:
    if not math.isfinite(value) or not low <= value <= high:
        raise SettingError(f"{value:g} {unit} is outside {low:g}…{high:g} {unit}", where=name)
