r"""IEEE 488.2 as oscilloscopes speak it: program messages, answers, and blocks of binary data.

Source: IEEE 488.2-1992, sections 7.6 (program data) and 8.7.9 (definite length arbitrary block response
data); SCPI 1999.0, volume 1, section 6 (short and long form of headers) and 21.8 (the error queue). A block
is ``#``, one digit n, n digits of its length, and as many bytes. Pictures come as a block or as the bare
file; where they end is told by the block's length, by the chunk ``IEND`` of a PNG or by the size field of a
BMP, never by a terminator.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

from reseau.core.errors import ProtocolError

from .stream import excerpt

__all__ = [
    "LARGEST",
    "Header",
    "block",
    "error_entry",
    "missing_bytes",
    "parse_block",
    "picture",
    "split_message",
]

LARGEST = 64_000_000
"""Bytes of the largest answer that is waited for."""

_PNG = b"\x89PNG\r\n\x1a\n"
_BLOCK = re.compile(rb"#([1-9])")


def block(data: bytes) -> bytes:
    """A definite length block.

    Examples
    --------
    >>> block(b"abc")
    b'#13abc'
    """
    length = str(len(data)).encode("ascii")
    return b"#%d%b%b" % (len(length), length, data)


def _block_span(data: bytes) -> tuple[int, int] | None:
    """Where the content of a block begins and ends; None while its head is not complete."""
    head = _BLOCK.match(data)
    if head is None:
        if len(data) < 2 and data in (b"", b"#"):
            return None
        raise ProtocolError(f"no block: {excerpt(data)}")
    digits = data[2 : 2 + int(head[1])]
    if digits and not digits.isdigit():
        raise ProtocolError(f"no block: {excerpt(data)}")
    if len(digits) < int(head[1]):
        return None
    start, length = 2 + len(digits), int(digits)
    if length > LARGEST:
        raise ProtocolError(f"announces {length} bytes; more than {LARGEST} are not waited for")
    return start, start + length


def _png_end(data: bytes) -> int | None:
    """Where a PNG ends; None while it is not complete."""
    at = len(_PNG)
    while len(data) >= at + 8:
        length, kind = struct.unpack_from(">I4s", data, at)
        if length > LARGEST:
            raise ProtocolError(f"a PNG with a chunk of {length} bytes")
        at += 12 + length
        if kind == b"IEND":
            return at if len(data) >= at else None
    return None


def missing_bytes(data: bytes) -> int | None:
    r"""How many bytes a binary answer lacks that begins with these: 0 when it is whole.

    Parameters
    ----------
    data : bytes
        A block, a PNG or a BMP, as far as it has come.

    Returns
    -------
    int or None
        None while that cannot be told.

    Raises
    ------
    ProtocolError
        When it is none of them, or announces more than is waited for.

    Examples
    --------
    >>> missing_bytes(b"#15ab"), missing_bytes(b"#15abcde\n"), missing_bytes(b"#1")
    (3, 0, None)
    """
    end: int | None
    if not data:
        return None
    if data[:1] == b"#":
        span = _block_span(data)
        end = None if span is None else span[1]
    elif data[:1] == _PNG[:1]:
        if not _PNG.startswith(data[:8]):
            raise ProtocolError(f"neither block nor picture: {excerpt(data)}")
        end = _png_end(data) if len(data) >= 8 else None
    elif data[:2] in (b"B", b"BM"):
        end = int.from_bytes(data[2:6], "little") if len(data) >= 6 else None
        if end is not None and not 54 <= end <= LARGEST:
            raise ProtocolError(f"a BMP of {end} bytes")
    else:
        raise ProtocolError(f"neither block nor picture: {excerpt(data)}")
    return None if end is None else max(0, end - len(data))


def parse_block(data: bytes) -> bytes:
    """The content of a block.

    Raises
    ------
    ProtocolError
        When it is none, or not complete.
    """
    span = _block_span(data)
    if span is None or len(data) < span[1]:
        raise ProtocolError(f"a block that is not complete: {excerpt(data)}")
    return data[span[0] : span[1]]


def picture(data: bytes) -> bytes:
    """The file of a picture that came as a block or bare.

    Raises
    ------
    ProtocolError
        When it is no picture, or not complete.
    """
    inner = parse_block(data) if data[:1] == b"#" else data
    if inner[:8] != _PNG and inner[:2] != b"BM":
        raise ProtocolError(f"no picture: {excerpt(data)}")
    lacking = missing_bytes(inner)
    if lacking != 0:
        raise ProtocolError(f"a picture that is not complete ({len(inner)} bytes)")
    end = _png_end(inner) if inner[:8] == _PNG else int.from_bytes(inner[2:6], "little")
    return inner[:end]


@dataclass(frozen=True)
class Header:
    """A header as the manual writes it, ``:DISPlay:DATA?``: capitals may not be left out.

    Parameters
    ----------
    written : str
        With the capitals of the short form. ``<n>`` stands for a number.

    Examples
    --------
    >>> Header(":DISPlay:DATA?").matches(":disp:data?"), Header(":DISPlay:DATA?").matches(":displ:data?")
    (True, False)
    """

    written: str

    def matches(self, header: str) -> bool:
        """Whether a header that a client sent is this one, in its short or its long form."""
        return re.fullmatch(self._pattern(), header.lstrip(":"), re.IGNORECASE) is not None

    def _pattern(self) -> str:
        def either(found: re.Match[str]) -> str:
            short, rest = found[1], found[2]
            return f"{short}(?:{rest})?" if rest else short

        text = self.written.lstrip(":").replace("<n>", "\0")
        return (
            re.sub(r"([A-Z]+)([a-z]*)", either, re.escape(text)).replace("\0", r"\d+").replace("\\\0", r"\d+")
        )


def split_message(text: str) -> list[tuple[str, str]]:
    r"""Units of a program message as (header, arguments); quotes keep semicolons together.

    Examples
    --------
    >>> split_message(':TIM:SCAL 1e-3;*OPC?;MMEM:NAME "a;b"')
    [(':TIM:SCAL', '1e-3'), ('*OPC?', ''), ('MMEM:NAME', '"a;b"')]
    """
    units = re.findall(r"(?:[^;\"']|\"[^\"]*\"|'[^']*'|[\"'])+", text)
    found = []
    for unit in units:
        header, _, arguments = unit.strip().partition(" ")
        if header:
            found.append((header, arguments.strip()))
    return found


def error_entry(answer: str) -> tuple[int, str]:
    r"""Number and text of an entry of the error queue; 0 is none.

    Raises
    ------
    ProtocolError
        When it is none.

    Examples
    --------
    >>> error_entry('-113,"Undefined header"')
    (-113, 'Undefined header')
    """
    found = re.fullmatch(r"\s*([+-]?\d{1,6})\s*(?:,\s*\"?(.*?)\"?)?\s*", answer)
    if found is None:
        raise ProtocolError(f"no entry of an error queue: {excerpt(answer.encode())}")
    return int(found[1]), found[2] or ""
