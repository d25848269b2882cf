"""G-code lines, and the answers of GRBL and Marlin.

Sources: *Grbl v1.1 Interface*, *Grbl v1.1 Commands* and the tables of error and alarm codes of gnea/grbl; the
G-code reference of marlinfw.org (G28, M17, M84, M92, M110, M114, M115, M220, M410) and Marlin's queue for
line numbers and checksums; RepRap, *G-code*, "Checking" for the checksum.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from reseau.core.errors import ProtocolError, SettingError

from ..profiles import known
from .numbers import number
from .stream import LineMessageDecoder, excerpt

LIMIT = 256
"""Largest size of an accepted line (bytes)."""
AXES = "XYZABC"
"""Letters of the axes, in order."""

_WORD = re.compile(r"([A-Z])\s*([-+]?\d*\.?\d+|[-+]?\d+\.)")
_NUMBERED = re.compile(rb"\s*N(-?\d+)\s*(.*?)\s*\*(\d{1,3})\s*")
_REPORT = re.compile(r"<([A-Z][a-z]+)(?::(\d+))?((?:\|[^|<>]+)*)>")
_OUTDATED = re.compile(r"<[A-Z][a-z]+,[MW]Pos:[^|<>]*>|\[G\d[^:\]]*\]")
"""Status, and modes of the parser, as GRBL up to 0.9 gives them."""
_GRBL = known("grbl")


def checksum(line: bytes) -> int:
    """Return the checksum of a line with its number: all bytes before the asterisk, exclusive or.

    Examples
    --------
    >>> checksum(b"N3 T0")  # the example of the RepRap wiki
    57
    """
    found = 0
    for each in line:
        found ^= each
    return found


def encode(line: str) -> bytes:
    r"""Encode a line.

    Raises
    ------
    SettingError
        If it cannot be sent.

    Examples
    --------
    >>> encode("G53 G1 X10 F600")
    b'G53 G1 X10 F600\n'
    """
    if not line.isascii() or not line.isprintable() or set(line) & set(";()*!~?%") or len(line) > 80:
        raise SettingError("is not a line of G-code", where=repr(line))
    return line.encode("ascii") + b"\n"


def encode_numbered(line: str, number: int) -> bytes:
    r"""Encode a line with number and checksum.

    Raises
    ------
    SettingError
        If it cannot be sent.

    Examples
    --------
    >>> encode_numbered("M110 N0", 0)
    b'N0 M110 N0*125\n'
    """
    content = b"N%d %b" % (number, encode(line).rstrip(b"\n"))
    return content + b"*%d\n" % checksum(content)


def decode_numbered(line: bytes) -> tuple[int | None, str]:
    """Decode a line that may have number and checksum.

    Raises
    ------
    ProtocolError
        If the checksum is wrong, or the line is no text.

    Examples
    --------
    >>> decode_numbered(b"N0 M110 N0*125"), decode_numbered(b"M114")
    ((0, 'M110 N0'), (None, 'M114'))
    """
    if not line.isascii():
        raise ProtocolError(f"not a line of G-code: {excerpt(line)}")
    found = _NUMBERED.fullmatch(line)
    if found is None:
        return None, line.decode().strip()
    if checksum(line[: line.rindex(b"*")]) != int(found[3]):
        raise ProtocolError(f"a line with a wrong checksum: {excerpt(line)}")
    return int(found[1]), found[2].decode()


def words_of(line: str) -> dict[str, float] | None:
    """Return the words of a line by letter; None if it is not G-code. Of repeated letters the last counts.

    Examples
    --------
    >>> words_of("G1 X-10.5 F600")
    {'G': 1.0, 'X': -10.5, 'F': 600.0}
    >>> words_of("$H") is None
    True
    """
    if _WORD.sub("", line).strip():
        return None
    return {letter: float(number) for letter, number in _WORD.findall(line)}


@dataclass(frozen=True)
class Ok:
    """A line was accepted, by Marlin with further words."""

    rest: str = ""


@dataclass(frozen=True)
class Error:
    """A line was not accepted.

    Parameters
    ----------
    text : str
        Code of GRBL, or text of Marlin.
    meaning : str
        The error in words.
    """

    text: str
    meaning: str


@dataclass(frozen=True)
class Alarm:
    """GRBL has stopped and is locked, for a reason in words."""

    meaning: str


@dataclass(frozen=True)
class Banner:
    """The controller has started."""

    text: str


@dataclass(frozen=True)
class Outdated:
    """An answer of GRBL up to 0.9, which has no states in detail."""

    text: str


@dataclass(frozen=True)
class Busy:
    """Marlin has not finished a line."""

    text: str = ""


@dataclass(frozen=True)
class Resend:
    """Marlin wants a line again."""

    number: int


@dataclass(frozen=True)
class Report:
    """Status of GRBL.

    Parameters
    ----------
    state : str
        Idle, Run, Hold, Jog, Alarm, Door, Check, Home or Sleep; of grblHAL also Tool.
    substate : int
        Detail of Hold and Door; 0 where there is none.
    fields : dict of str to tuple of float
        Numbers by name, as ``MPos``.
    """

    state: str
    substate: int = 0
    fields: dict[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Said:
    """Any other line: feedback, settings, positions, messages."""

    text: str


Message = Ok | Error | Alarm | Banner | Outdated | Busy | Resend | Report | Said


def decode(line: bytes, profile: Mapping[str, Any] = _GRBL) -> Message:
    """Decode a line of GRBL or Marlin.

    Parameters
    ----------
    line : bytes
        The line.
    profile : mapping
        What is known of the controller: its `banner`, the meanings of `errors` and `alarms`.

    Raises
    ------
    ProtocolError
        If it is no text, or begins like a message that it is not.

    Examples
    --------
    >>> decode(b"<Run|MPos:1.000,-2.500,0.000|FS:600,0>").fields["MPos"]
    (1.0, -2.5, 0.0)
    >>> decode(b"ALARM:2").meaning, decode(b"ok"), decode(b"echo:busy: processing")
    ('the target is outside the travel', Ok(rest=''), Busy(text='processing'))
    """
    if not line.isascii() or not (text := line.decode().strip()).isprintable():
        raise ProtocolError(f"not a line of text: {excerpt(line)}")
    if _OUTDATED.fullmatch(text):
        return Outdated(text)
    if text.startswith("<"):
        return _report(text)
    if text == "ok" or text.startswith("ok "):
        return Ok(text[3:])
    if found := re.fullmatch(r"ALARM:(\d+)", text):
        return Alarm(profile.get("alarms", {}).get(found[1], f"alarm {found[1]}"))
    if found := re.match(r"[Ee]rror:\s*(.*)", text):
        code = f"error {found[1]}" if found[1].isdigit() else found[1]
        return Error(found[1], profile["errors"].get(found[1], code))
    if found := re.match(r"(?:Resend|rs):?\s*N?(\d+)", text):
        return Resend(int(found[1]))
    if found := re.match(r"(?:echo:\s*)?busy:\s*(.*)", text):
        return Busy(found[1])
    if re.fullmatch(profile["banner"], text, re.IGNORECASE):
        return Banner(text)
    return Said(text)


def _report(text: str) -> Report:
    found = _REPORT.fullmatch(text)
    if found is None:
        raise ProtocolError(f"not a status of GRBL: {text[:60]!r}")
    fields = {}
    for each in filter(None, found[3].split("|")):
        name, _, values = each.partition(":")
        try:
            fields[name] = tuple(number(value) for value in values.split(","))
        except ProtocolError:  # switches that are closed are letters
            if name == "MPos":
                raise
            fields[name] = ()
    return Report(found[1], int(found[2] or 0), fields)


class AnswerDecoder(LineMessageDecoder[Message]):
    """Decode answers from a stream."""

    def __init__(self, profile: Mapping[str, Any] = _GRBL) -> None:
        super().__init__(lambda line: decode(line, profile), limit=LIMIT)
