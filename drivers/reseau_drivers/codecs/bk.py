"""BK Medical's OEM interface: messages between 0x01 and 0x04, with frames and their geometry.

Source: BK's document PS12640-44, page 9 (framing), as quoted by NifTK's ``BKMedicalDataSourceWorker``, and
PLUS's ``vtkPlusBkProFocusOemVideoSource`` (frames, geometry). Inside a message the bytes 0x01, 0x04 and 0x1B
are sent as 0x1B and their complement. A frame is ``DATA:GRAB_FRAME #6227332<4 bytes of a time
stamp><592·384 pixels>;``: its length includes the time stamp. A BK5000 announces another length; the end of
the message is decisive.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from reseau.core.errors import ProtocolError

from .numbers import number
from .stream import Damaged, excerpt

PORT = 7915
START, END, ESCAPE = 0x01, 0x04, 0x1B

_ESCAPED = re.compile(b"[\x01\x04\x1b]")
_MARKS = re.compile(b"[\x01\x04]")
_STAMP = 4
_GRAB = b"DATA:GRAB_FRAME "


def encode(content: bytes) -> bytes:
    """Encode a message with its delimiters.

    Examples
    --------
    >>> encode(b"A" + bytes([4]) + b";").hex(" ")
    '01 41 1b fb 3b 04'
    """
    body = _ESCAPED.sub(lambda found: bytes([ESCAPE, ~found[0][0] & 0xFF]), content)
    return bytes([START]) + body + bytes([END])


class MessageDecoder:
    """Decode messages from a stream.

    Parameters
    ----------
    limit : int
        Largest size of a message (bytes); a longer one is discarded.
    """

    def __init__(self, limit: int = 8_000_000) -> None:
        self._limit = limit
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete message."""
        self._partial: bytearray | None = None

    def feed(self, data: bytes) -> list[bytes | Damaged]:
        """Return the messages that these bytes complete, without delimiters and escapes."""
        found: list[bytes | Damaged] = []
        at = 0
        for mark in _MARKS.finditer(data):
            self._take(data[at : mark.start()], found)
            at = mark.end()
            body, self._partial = self._partial, bytearray() if mark[0] == b"\x01" else None
            if body is None:
                continue
            if mark[0] == b"\x04":
                found.append(_unescaped(bytes(body)))
            else:
                # A start byte cannot occur inside a message: the end of the previous one was lost.
                _report(found, bytes(body), "a message without end")
        self._take(data[at:], found)
        return found

    def _take(self, piece: bytes, found: list[bytes | Damaged]) -> None:
        """Append bytes without delimiters to the incomplete message."""
        if not piece:
            return
        if self._partial is None:
            _report(found, piece, f"{len(piece)} bytes between messages")
        elif len(self._partial) + len(piece) > self._limit:
            _report(found, bytes(self._partial[:60]), f"longer than {self._limit} bytes")
            self._partial = None
        else:
            self._partial += piece


def _report(found: list[bytes | Damaged], data: bytes, why: str) -> None:
    """Report consecutive damaged data once: noise can look like thousands of messages."""
    if not found or not isinstance(found[-1], Damaged):
        found.append(Damaged(data[:60], why))


def _unescaped(body: bytes) -> bytes | Damaged:
    parts = body.split(bytes([ESCAPE]))
    out = bytearray(parts[0])
    for part in parts[1:]:
        if not part or (~part[0] & 0xFF) not in (START, END, ESCAPE):
            return Damaged(body[:60], "a wrong escape")
        out.append(~part[0] & 0xFF)
        out += part[1:]
    return bytes(out)


@dataclass(frozen=True)
class GrabbedFrame:
    """Pixels of a frame, row by row.

    Parameters
    ----------
    stamp : int
        Time stamp of the instrument's clock (ms).
    pixels : bytes
        One byte per pixel.
    announced : int
        Length in the message; unreliable.
    """

    stamp: int
    pixels: bytes
    announced: int


def encode_frame(frame: GrabbedFrame) -> bytes:
    """Encode the content of a message with a frame."""
    length = str(frame.announced).encode("ascii")
    stamp = frame.stamp.to_bytes(_STAMP, "little")
    return _GRAB + b"#%d" % len(length) + length + stamp + frame.pixels + b";"


def parse_frame(content: bytes, size: int) -> GrabbedFrame:
    """Decode the frame in a message.

    Parameters
    ----------
    content : bytes
        Content of the message.
    size : int
        Number of pixels of the window; a semicolon after them is not one of them.

    Raises
    ------
    ProtocolError
        If there is no frame, or it has another size.
    """
    head = re.match(rb"DATA:GRAB_FRAME #([1-9])", content)
    digits = int(head[1]) if head else 0
    length = content[head.end() : head.end() + digits] if head else b""
    if head is None or len(length) != digits or not length.isdigit():
        raise ProtocolError(f"not a frame: {excerpt(content)}")
    start = head.end() + digits
    stamp, pixels = content[start : start + _STAMP], content[start + _STAMP :]
    if len(pixels) == size + 1:
        pixels = pixels.removesuffix(b";")
    if len(stamp) < _STAMP or len(pixels) != size:
        raise ProtocolError(
            f"a frame of {len(pixels)} bytes for {size} pixels", do="switch off colour and overlays"
        )
    return GrabbedFrame(int.from_bytes(stamp, "little"), pixels, int(length))


def numbers(content: bytes, name: str) -> tuple[float, ...]:
    """Decode the numbers of an answer ``DATA:<name> a,b,…;``.

    Raises
    ------
    ProtocolError
        If it is another message or does not contain numbers.

    Examples
    --------
    >>> numbers(b"DATA:US_WIN_SIZE 640,480;", "US_WIN_SIZE")
    (640.0, 480.0)
    """
    prefix = f"DATA:{name} ".encode("ascii")
    if not content.startswith(prefix):
        raise ProtocolError(f"not an answer to {name}: {excerpt(content)}")
    values = content[len(prefix) :].rstrip(b"; ").decode("latin-1").split(",")
    return tuple(number(value) for value in values)
