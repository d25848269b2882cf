r"""Lines of text in which sensors send their values, with the checksum of NMEA 0183 or without one.

Source: NMEA 0183: ``$<content>*<two hexadecimal digits>``, the exclusive or of the bytes of the content.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

from reseau.core.errors import ProtocolError, SettingError

from .numbers import number
from .stream import excerpt

Checksum = Literal["none", "xor"]


def checksum(content: bytes) -> int:
    """Return the exclusive or of some bytes.

    Examples
    --------
    >>> f"{checksum(b'GPGLL,5057.970,N,00146.110,E,142451,A'):02X}"
    '27'
    """
    found = 0
    for each in content:
        found ^= each
    return found


def with_checksum(content: bytes) -> bytes:
    """Return a line with its checksum.

    Examples
    --------
    >>> with_checksum(b"T,21.5")
    b'$T,21.5*60'
    """
    return b"$%b*%02X" % (content, checksum(content))


class Sentence:
    r"""A line with values, as a pattern describes it.

    Parameters
    ----------
    pattern : str
        Regular expression for the whole line (without the checksum and its marks); a named group is a value.
    checksum : {"none", "xor"}
        Checksum of a line.

    Raises
    ------
    SettingError
        If the pattern is none, or has no named groups.

    Examples
    --------
    >>> Sentence(r"T=(?P<temperature>\S+) C RH=(?P<humidity>\S+) %").values(b"T=21.53 C RH=45.2 %")
    {'temperature': 21.53, 'humidity': 45.2}
    """

    def __init__(self, pattern: str, checksum: Checksum = "none") -> None:
        try:
            self._pattern = re.compile(pattern)
        except re.error as error:
            raise SettingError(f"is no regular expression ({error})", where="pattern") from None
        if not self._pattern.groupindex:
            raise SettingError(
                "names no value", where="pattern", do="write (?P<temperature>\\S+) or the like"
            )
        if checksum not in ("none", "xor"):
            raise SettingError(f"{checksum!r} is not one of none, xor", where="checksum")
        self._checksum = checksum

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values."""
        return tuple(self._pattern.groupindex)

    def values(self, line: bytes) -> Mapping[str, float]:
        """Return the values of a line.

        Raises
        ------
        ProtocolError
            If the line is another one, its checksum is wrong, or a value is no number.
        """
        content = self._content(line) if self._checksum == "xor" else line
        if not content.isascii() or (found := self._pattern.fullmatch(content.decode().strip())) is None:
            raise ProtocolError(f"not a line with values: {excerpt(line)}")
        return {name: number(text) for name, text in found.groupdict().items() if text is not None}

    @staticmethod
    def _content(line: bytes) -> bytes:
        """The part between the marks, if the checksum fits."""
        found = re.fullmatch(rb".*\$([^$*]*)\*([0-9A-Fa-f]{2})\s*", line)
        if found is None or checksum(found[1]) != int(found[2], 16):
            raise ProtocolError(f"a line with a wrong checksum: {excerpt(line)}")
        return found[1]
