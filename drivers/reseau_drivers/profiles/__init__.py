"""What is known of families of instruments: TOML files, each line with its public source.

Those of oscilloscopes (``reseau-instrument-profile/1``) are read by
:mod:`reseau_drivers.oscilloscope.dialects`, those of controllers
(``reseau-controller-profile/1``) by :func:`controller`, those of pixels by their codec.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from string import Formatter
from typing import Any

from reseau.core.errors import FormatError, InputError

__all__ = [
    "CONTROLLERS",
    "CONTROLLER_SCHEMA",
    "FOLDER",
    "controller",
    "known",
    "order",
    "text_of",
    "told_bits",
]

FOLDER = Path(__file__).parent
CONTROLLERS = ("grbl", "kinesis", "marlin", "smc100", "zaber")
CONTROLLER_SCHEMA = "reseau-controller-profile/1"
_PATTERNS = ("banner", "marks", "replies", "tells")
_FIXED = ("commands", "factors", "masks", "messages", "motors", "replies", "states", "status")
"""Tables whose names the drivers ask for."""
_FORMS = {
    "bits": (r"[0-9A-Fa-f]{1,8}", "hexadecimal number"),
    "usb": (r"[0-9A-Fa-f]{4}", "hexadecimal number"),
    "masks": (r"[0-9A-Fa-f]{8}", "hexadecimal number"),
    "messages": (r"[0-9A-Fa-f]{4}( \d+)*", "hexadecimal number with lengths"),
    "states": (r"[0-9A-Fa-f]{2}-[0-9A-Fa-f]{2}", "range of hexadecimal numbers"),
}
"""How the keys of ``bits`` and the values of others are written."""


def known(name: str) -> dict[str, Any]:
    """Return what is known of a controller (banners, codes, flags), or of formats of pixels.

    Examples
    --------
    >>> known("grbl")["alarms"]["1"]
    'a limit switch was reached'
    """
    return tomllib.loads((FOLDER / f"{name}.toml").read_text("utf-8"))


def text_of(path: str) -> str:
    """Return the text of a file of profiles.

    Raises
    ------
    InputError
        If it cannot be read.

    Examples
    --------
    >>> text_of("none.toml")
    Traceback (most recent call last):
        ...
    reseau.core.errors.InputError: none.toml: cannot be read ([Errno 2] No such file or ...)
    """
    try:
        return Path(path).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=path) from None


def controller(name: str = "", own: str | None = None) -> dict[str, Any]:
    """Return what is known of a controller, or what a file of one's own says of it.

    Parameters
    ----------
    name : str
        One of `CONTROLLERS`; empty: the one that the file names.
    own : str, optional
        A file of the same form, with the same parts.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is no profile of this controller.

    Examples
    --------
    >>> controller("marlin")["banner"]
    'start'
    """
    if not own:
        return known(name)
    try:
        mine = tomllib.loads(text_of(own))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"is not TOML ({error})", where=own) from None
    if mine.get("schema") != CONTROLLER_SCHEMA:
        raise FormatError(f"schema {mine.get('schema')!r} is not {CONTROLLER_SCHEMA}", where=own)
    if mine.get("name") not in ((name,) if name else CONTROLLERS):
        wanted = name or ", ".join(CONTROLLERS)
        raise FormatError(f"is of {mine.get('name')!r}, not of {wanted}", where=own, do="set `name`")
    _require_alike(known(mine["name"]), mine, own)
    return mine


def _require_alike(ours: dict[str, Any], mine: dict[str, Any], where: str) -> None:
    """Refuse a profile whose parts are not those of ours, or whose lines are of another kind."""
    if missing := sorted(ours.keys() ^ mine.keys()):
        raise FormatError(f"`{missing[0]}` is missing, or not of this controller", where=where)
    for key, part in ours.items():
        told = list(mine[key].values()) if isinstance(mine[key], dict) else mine[key]
        fixed = isinstance(part, dict) and key in _FIXED
        if type(mine[key]) is not type(part) or (fixed and part.keys() != mine[key].keys()):
            names = f": it has {', '.join(part)}" if isinstance(part, dict) else ""
            raise FormatError(f"`{key}` is not as that of a profile{names}", where=where)
        kind = float if key in ("factors", "motors") else str
        wrong = next((each for each in told if type(each) is not kind), None)
        if wrong is not None:
            expected = "number" if kind is float else "text"
            raise FormatError(f"`{key}`: {wrong!r} is no {expected}", where=where)
        for pattern in ([told] if isinstance(told, str) else told) if key in _PATTERNS else ():
            try:
                re.compile(pattern)
            except re.error as error:
                raise FormatError(f"`{key}`: {pattern!r} is no pattern ({error})", where=where) from None
        for name, text in mine[key].items() if key == "commands" else ():
            if (values := _values_of(text)) is None or not values <= (_values_of(part[name]) or set()):
                raise FormatError(f"`commands`: {text!r} has other values than {part[name]!r}", where=where)
        form, called = _FORMS.get(key, (".*", ""))
        for text in mine[key] if key == "bits" else told if called else ():
            if re.fullmatch(form, text) is None:
                raise FormatError(f"`{key}`: {text!r} is no {called}", where=where)


def _values_of(text: str) -> set[str] | None:
    """Names of the values in a command; None if it is none."""
    try:
        return {name for _, name, _, _ in Formatter().parse(text) if name is not None}
    except ValueError:
        return None


def order(profile: Mapping[str, Any], command: str, **values: object) -> str:
    """Return a command of a profile with these values.

    Examples
    --------
    >>> order(known("zaber"), "move", position=200_000)
    'move abs 200000'
    """
    text: str = profile["commands"][command]
    return text.format(**values)


def told_bits(profile: Mapping[str, Any], value: int) -> tuple[str, ...]:
    """Return the meanings of the bits that are set.

    Examples
    --------
    >>> told_bits(known("smc100"), 0x0020)
    ('following error',)
    """
    return tuple(meaning for bit, meaning in profile["bits"].items() if value & int(bit, 16))
