r"""Newport's SMC100 and CONEX controllers: ``nnAAxx\r\n``, one axis per address.

Source: *SMC100CC & SMC100PP User's Manual*, commands TE (page 61) and TS (page 65), as implemented in the
drivers of PyMeasure, bliss and hvl_ccb, which agree; *CONEX-CC Controller Documentation* for the additions of
the CONEX. Commands that set or move are not acknowledged: TE returns their error, TS the state of the axis.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reseau.core.errors import ProtocolError, SettingError

from ..profiles import known
from .stream import excerpt

LIMIT = 128
"""Largest size of an accepted line (bytes)."""

_SMC100 = known("smc100")
_LINE = re.compile(rb"(\d{1,2})([A-Z]{2})([ -~]*)")


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


def decode_status(value: str, profile: Mapping[str, Any] = _SMC100) -> tuple[int, str]:
    """Decode an answer to TS: error bits, and the name of the state in a profile.

    Raises
    ------
    ProtocolError
        If it is not a valid answer, or the state is unknown.

    Examples
    --------
    >>> decode_status("002028")
    (32, 'moving')
    """
    if re.fullmatch(r"[0-9A-Fa-f]{6}", value) is None:
        raise ProtocolError(f"not a status: {value!r}")
    for name, codes in profile["states"].items():
        first, last = (int(code, 16) for code in codes.split("-"))
        if first <= int(value[4:], 16) <= last:
            return int(value[:4], 16), name
    raise ProtocolError(f"{value[4:]} is not a state of an SMC100")
