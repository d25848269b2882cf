"""IEEE 488.2 for oscilloscopes: program messages, answers, and blocks of binary data.

Source: IEEE 488.2-1992, sections 7.6 (program data), 8.7.9 and 8.7.10 (definite and indefinite length
arbitrary block response data); SCPI 1999.0, volume 1, section 6 (short and long form of headers) and 21.8
(the error queue). A block is ``#``, one digit n, n digits of its length, and as many bytes; ``#(length)``
where the length has ten digits or more; ``#0`` where the end of the message ends it. Pictures are sent as a
block or as the bare file; their end follows from the length of the block, from the chunk ``IEND`` of a PNG,
or from the size field of a BMP, never from a terminator.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

from reseau.core.errors import ProtocolError

from .stream import excerpt

LARGEST = 64_000_000
"""Largest size of an accepted answer (bytes)."""

_PNG = b"\x89PNG\r\n\x1a\n"
_BLOCK = re.compile(rb"#(?:([1-9])|\((\d{1,12})\))")
_INDEFINITE = b"#0"
_OTHERS = {
    b"\xff\xd8\xff": "a JPEG, which alters grey values", b"GIF8": "a GIF", b"II*\0": "a TIFF",
    b"MM\0*": "a TIFF", b"\x1f\x8b": "compressed by gzip", b"%!PS": "PostScript",
    b"\x1b": "codes for a printer",
}  # fmt: skip
"""What pictures that are neither PNG nor BMP begin with."""


def block(data: bytes) -> bytes:
    """Encode a definite length block.

    Examples
    --------
    >>> block(b"abc")
    b'#13abc'
    """
    length = str(len(data)).encode("ascii")
    return b"#%d%b%b" % (len(length), length, data)


def _block_span(data: bytes) -> tuple[int, int] | None:
    """Return start and end of the content of a block; None while its header is incomplete."""
    head = _BLOCK.match(data)
    if head is None:
        if data in (b"", b"#") or re.fullmatch(rb"#\(\d{0,12}", data):
            return None
        raise ProtocolError(f"not a block: {excerpt(data)}")
    digits = head[2] or data[2 : 2 + int(head[1])]
    if digits and not digits.isdigit():
        raise ProtocolError(f"not a block: {excerpt(data)}")
    if head[1] and len(digits) < int(head[1]):
        return None
    start, length = head.end() + (len(digits) if head[1] else 0), int(digits)
    if length > LARGEST:
        raise ProtocolError(f"announces {length} bytes; at most {LARGEST} are accepted")
    return start, start + length


def _png_end(data: bytes) -> int | None:
    """Return the end of a PNG file; None while it is incomplete."""
    at = len(_PNG)
    while len(data) >= at + 8:
        length, kind = struct.unpack_from(">I4s", data, at)
        if length > LARGEST:
            raise ProtocolError(f"a PNG with a chunk of {length} bytes")
        at += 12 + length
        if kind == b"IEND":
            return at if len(data) >= at else None
    return None


def missing_bytes(data: bytes, ended: bool = False) -> int | None:
    r"""Return the number of bytes missing from a binary answer; 0 if it is complete.

    Parameters
    ----------
    data : bytes
        Start of a block, a PNG or a BMP.
    ended : bool
        Whether the message ends here; of streams that is not known.

    Returns
    -------
    int or None
        None while the number is unknown.

    Raises
    ------
    ProtocolError
        If the data are none of these, or announce more than the limit.

    Examples
    --------
    >>> missing_bytes(b"#15ab"), missing_bytes(b"#15abcde\n"), missing_bytes(b"#1")
    (3, 0, None)
    """
    end: int | None
    if not data:
        return None
    if data[:2] == _INDEFINITE:
        inner = data[2:]
        if inner[:1] in (b"B", _PNG[:1]) and _is_picture(inner):
            return missing_bytes(inner)
        return 0 if ended else None
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
        raise _strange("neither block nor picture", data)
    return None if end is None else max(0, end - len(data))


def _is_picture(data: bytes) -> bool:
    return data[:8] == _PNG or data[:2] == b"BM"


def _strange(what: str, data: bytes) -> ProtocolError:
    """An error that names a picture of another kind."""
    kind = next((name for start, name in _OTHERS.items() if data.startswith(start)), None)
    if kind is None:
        return ProtocolError(f"{what}: {excerpt(data)}")
    return ProtocolError(f"the picture is {kind}", do="set the format of its screen pictures to PNG or BMP")


def _require_rows(data: bytes) -> None:
    """Raise ProtocolError if a BMP is too small for its rows."""
    start, width, height, bits, packed = struct.unpack_from("<I4xii2xHI", data, 10)
    need = start + (width * bits + 31) // 32 * 4 * abs(height)
    if width < 1 or (packed in (0, 3) and len(data) < need):
        raise ProtocolError(f"a BMP of {width}×{abs(height)} pixels has {len(data)} of {need} bytes")


def parse_block(data: bytes) -> bytes:
    """Return the content of a block.

    Raises
    ------
    ProtocolError
        If it is not a block, or is incomplete.
    """
    if data[:2] == _INDEFINITE:
        return data[2:].removesuffix(b"\n")
    span = _block_span(data)
    if span is None or len(data) < span[1]:
        raise ProtocolError(f"an incomplete block: {excerpt(data)}")
    return data[span[0] : span[1]]


def picture(data: bytes) -> bytes:
    """Return the file of a picture that was sent as a block or as the bare file.

    Raises
    ------
    ProtocolError
        If it is not a picture, or is incomplete.
    """
    inner = parse_block(data) if data[:1] == b"#" else data
    if not _is_picture(inner):
        raise _strange("not a picture", inner)
    lacking = missing_bytes(inner)
    if lacking != 0:
        raise ProtocolError(f"an incomplete picture ({len(inner)} bytes)")
    if inner[:8] == _PNG:
        return inner[: _png_end(inner)]
    found = inner[: int.from_bytes(inner[2:6], "little")]
    _require_rows(found)
    return found


@dataclass(frozen=True)
class Header:
    """Header as in a manual, ``:DISPlay:DATA?``: the capitals are mandatory.

    Parameters
    ----------
    written : str
        Header with the capitals of the short form; ``<n>`` stands for a number.

    Examples
    --------
    >>> Header(":DISPlay:DATA?").matches(":disp:data?"), Header(":DISPlay:DATA?").matches(":displ:data?")
    (True, False)
    """

    written: str

    def matches(self, header: str) -> bool:
        """Whether a received header is this one, in its short or long form."""
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
    """Split a program message into (header, arguments); semicolons in quotes do not separate.

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
    """Return number and text of an entry of the error queue; 0 means no error.

    Raises
    ------
    ProtocolError
        If it is not an entry.

    Examples
    --------
    >>> error_entry('-113,"Undefined header"')
    (-113, 'Undefined header')
    """
    found = re.fullmatch(r"\s*([+-]?\d{1,6})\s*(?:,\s*\"?(.*?)\"?)?\s*", answer)
    if found is None:
        raise ProtocolError(f"not an entry of an error queue: {excerpt(answer.encode())}")
    return int(found[1]), found[2] or ""
