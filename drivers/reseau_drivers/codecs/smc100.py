r"""Newport's SMC100 and CONEX controllers: ``nnAAxx\r\n``, one axis per address.

Source: *SMC100CC & SMC100PP User's Manual*, commands TE (page 61) and TS (page 65), as implemented in the
drivers of PyMeasure, bliss and hvl_ccb, which agree; *CONEX-CC Controller Documentation* for the additions of
the CONEX. Commands that set or move are not acknowledged: TE returns their error, TS the state of the axis.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

from reseau.core.errors import ProtocolError, SettingError

from .stream import excerpt

__all__ = ["LIMIT", "Line", "Phase", "Status", "decode", "decode_status", "encode", "phase"]

LIMIT = 128
"""Largest size of an accepted line (bytes)."""

_LINE = re.compile(rb"(\d{1,2})([A-Z]{2})([ -~]*)")


class Phase(Enum):
    """State of an axis, from the last two digits of TS."""

    NOT_REFERENCED = "not referenced"
    CONFIGURATION = "configuration"
    HOMING = "homing"
    MOVING = "moving"
    READY = "ready"
    DISABLED = "disabled"
    JOGGING = "jogging"


def phase(code: int) -> Phase:
    """Return the phase of a state code.

    Raises
    ------
    ProtocolError
        If the code is unknown.

    Examples
    --------
    >>> phase(0x33)
    <Phase.READY: 'ready'>
    """
    for codes, found in (
        (range(0x0A, 0x12), Phase.NOT_REFERENCED),
        (range(0x14, 0x15), Phase.CONFIGURATION),
        (range(0x1E, 0x20), Phase.HOMING),
        (range(0x28, 0x29), Phase.MOVING),
        (range(0x32, 0x36), Phase.READY),
        # CONEX: ready to track.
        (range(0x36, 0x39), Phase.READY),
        (range(0x3C, 0x40), Phase.DISABLED),
        # CONEX: tracking.
        (range(0x46, 0x48), Phase.JOGGING),
    ):
        if code in codes:
            return found
    raise ProtocolError(f"{code:02X} is not a state of an SMC100")


@dataclass(frozen=True)
class Line:
    """Command or answer.

    Parameters
    ----------
    address : int
        Address of the controller, 1 to 31.
    name : str
        Two letters.
    value : str
        Argument; ``?`` queries a parameter.
    """

    address: int
    name: str
    value: str = ""


@dataclass(frozen=True)
class Status:
    """Answer to TS: error bits and state."""

    errors: int
    state: int

    @property
    def phase(self) -> Phase:
        """State of the axis."""
        return phase(self.state)


def encode(line: Line) -> bytes:
    r"""Encode a command or an answer.

    Raises
    ------
    SettingError
        If it cannot be sent.

    Examples
    --------
    >>> encode(Line(1, "PA", "12.5"))
    b'1PA12.5\r\n'
    """
    content = f"{line.address}{line.name}{line.value}"
    if not 1 <= line.address <= 31 or not content.isascii() or _LINE.fullmatch(content.encode()) is None:
        raise SettingError("is not a command of an SMC100", where=repr(content))
    return content.encode("ascii") + b"\r\n"


def decode(line: bytes) -> Line:
    """Decode a command or an answer.

    Raises
    ------
    ProtocolError
        If the line is neither.
    """
    found = _LINE.fullmatch(line.strip(b"\r\n"))
    if found is None or not 1 <= int(found[1]) <= 31:
        raise ProtocolError(f"not a line of an SMC100: {excerpt(line)}")
    return Line(int(found[1]), found[2].decode(), found[3].decode())


def decode_status(value: str) -> Status:
    """Decode an answer to TS.

    Raises
    ------
    ProtocolError
        If it is not a valid answer, or the state is unknown.

    Examples
    --------
    >>> decode_status("002028")
    Status(errors=32, state=40)
    """
    if re.fullmatch(r"[0-9A-Fa-f]{6}", value) is None:
        raise ProtocolError(f"not a status: {value!r}")
    status = Status(int(value[:4], 16), int(value[4:], 16))
    phase(status.state)
    return status
