r"""US Ultratek's CompactPulser: one letter, an integer, a carriage return; ``G?`` is answered by ``G=…\r``.

Source: ``ultratekPulser.py`` of changbatterygroup/ultrasonicTesting, which controls one: 9600 baud, ``D0``,
``M0``, ``V300``, ``W220``, ``P500`` (5000 Hz), ``P0``, ``T0`` (internal), ``G?`` → ``G=…``, gains from −120
to 840. The maker's manual is not public: that gains are tenths of a decibel follows from their range.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from reseau.core.errors import ProtocolError, SettingError

from .stream import excerpt

LIMIT = 64
"""Largest size of a line (bytes)."""

LETTERS: dict[str, str] = {
    "P": "pulse repetition frequency, in units of 10 Hz; 0 is off",
    "W": "width of the pulse (ns)",
    "V": "voltage of the pulse (V)",
    "D": "damping",
    "M": "mode",
    "T": "trigger: 0 internal, 1 external",
    "G": "gain (0.1 dB)",
}
"""Meaning of each letter."""

_COMMAND = re.compile(rb"([A-Z])(\?|-?\d{1,5})")
_ANSWER = re.compile(rb"([A-Z])=(-?\d{1,5})")


@dataclass(frozen=True)
class Setting:
    """Letter with its value; None in a query."""

    letter: str
    value: int | None


def encode(setting: Setting) -> bytes:
    r"""Encode a command or query.

    Raises
    ------
    SettingError
        If the letter does not exist or the value cannot be encoded.

    Examples
    --------
    >>> encode(Setting("P", 100)), encode(Setting("G", None))
    (b'P100\r', b'G?\r')
    """
    text = f"{setting.letter}{'?' if setting.value is None else setting.value}"
    if setting.letter not in LETTERS or _COMMAND.fullmatch(text.encode()) is None:
        raise SettingError("is not a command of a CompactPulser", where=repr(text))
    return text.encode("ascii") + b"\r"


def encode_answer(setting: Setting) -> bytes:
    """Encode an answer."""
    return f"{setting.letter}={setting.value}\r".encode("ascii")


def decode(line: bytes) -> tuple[Setting, bool]:
    """Return the setting in a line, and whether it is an answer.

    Raises
    ------
    ProtocolError
        If the line is neither a command nor an answer.
    """
    line = line.strip(b"\r\n")
    for pattern, answer in ((_COMMAND, False), (_ANSWER, True)):
        found = pattern.fullmatch(line)
        if found and found[1].decode() in LETTERS:
            value = None if found[2] == b"?" else int(found[2])
            return Setting(found[1].decode(), value), answer
    raise ProtocolError(f"not a line of a CompactPulser: {excerpt(line)}")
