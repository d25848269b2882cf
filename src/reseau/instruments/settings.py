"""Settings of instruments: typed, with units and limits, checked before anything is sent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from ..core.errors import SettingError

__all__ = ["Limits", "Settings", "choice", "quantity", "text"]

Limits = Mapping[str, tuple[float, float]]
"""Lowest and highest value of a setting, by its name."""


def quantity(default: float, unit: str, low: float, high: float) -> Any:
    """A field of settings that is a number.

    Parameters
    ----------
    default : float
        An int makes it a whole number.
    unit : str
        As it is shown.
    low, high : float
        Limits, themselves allowed.
    """
    return field(default=default, metadata={"unit": unit, "low": low, "high": high})


def choice(default: str, *options: str) -> Any:
    """A field of settings that is one of several words."""
    return field(default=default, metadata={"options": options})


def text(default: str) -> Any:
    """A field of settings that is text of its own form, which the driver checks."""
    return field(default=default, metadata={"text": True})


@dataclass(frozen=True)
class Settings:
    """Base of an instrument's settings; fields are made by :func:`quantity`, :func:`choice`, :func:`text`.

    Raises
    ------
    SettingError
        When a value is of another type, not finite, or beyond its limits.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Pulser(Settings):
    ...     voltage: float = quantity(300.0, "V", 40.0, 300.0)
    >>> Pulser(120.0).units
    {'voltage': 'V'}
    >>> Pulser(400.0)
    Traceback (most recent call last):
    reseau.core.errors.SettingError: voltage: 400 V is beyond 40…300 V
    """

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if "options" in each.metadata:
                if value not in each.metadata["options"]:
                    raise SettingError(
                        f"{value!r} is none of {', '.join(each.metadata['options'])}", where=each.name
                    )
                continue
            if "text" in each.metadata:
                if not isinstance(value, str):
                    raise SettingError(f"{value!r} is no text", where=each.name)
                continue
            whole = isinstance(each.default, int)
            if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
                raise SettingError(
                    f"{value!r} is no {'whole number' if whole else 'number'}", where=each.name
                )
            if not whole:
                object.__setattr__(self, each.name, float(value))
            _check(each.name, value, each.metadata["unit"], each.metadata["low"], each.metadata["high"])

    @property
    def units(self) -> dict[str, str]:
        """Units by name; words have none."""
        return {each.name: each.metadata["unit"] for each in fields(self) if "unit" in each.metadata}

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Limits by name."""
        return {
            each.name: (each.metadata["low"], each.metadata["high"])
            for each in fields(self)
            if "low" in each.metadata
        }

    def to_dict(self) -> dict[str, float | str]:
        """Values by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def changed(self, changes: Mapping[str, Any], limits: Limits | None = None) -> Self:
        """These settings with some other values.

        Parameters
        ----------
        changes : mapping
            New values by name.
        limits : mapping, optional
            Narrower ones, those of a bench.

        Raises
        ------
        SettingError
            When there is no such setting, or a value is beyond a limit.
        """
        known = {each.name for each in fields(self)}
        for name in (*changes, *(limits or {})):
            if name not in known:
                raise SettingError(
                    "is no setting here", where=name, do=f"there are {', '.join(sorted(known))}"
                )
        new = replace(self, **changes)
        for name, (low, high) in (limits or {}).items():
            _check(name, getattr(new, name), new.units.get(name, ""), low, high)
        return new


def _check(name: str, value: float, unit: str, low: float, high: float) -> None:
    if not math.isfinite(value) or not low <= value <= high:
        raise SettingError(f"{value:g} {unit} is beyond {low:g}…{high:g} {unit}", where=name)
