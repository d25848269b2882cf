"""Common parts of stream decoders, and decoders of lines and of messages that are lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from reseau.core.errors import ProtocolError

T = TypeVar("T")

_SHOWN = 60
"""Number of bytes of a damaged message that are kept for error messages."""


@dataclass(frozen=True)
class Damaged:
    """Received bytes that are not a valid message.

    Parameters
    ----------
    data : bytes
        The first of these bytes.
    why : str
        Reason.
    """

    data: bytes
    why: str

    def __str__(self) -> str:
        return f"{self.why}: {excerpt(self.data)}"


class Decoder(Protocol, Generic[T]):
    """Decodes the bytes of a stream into messages."""

    def feed(self, data: bytes) -> list[T | Damaged]:
        """Return the messages that these bytes complete, in order."""

    def reset(self) -> None:
        """Discard incomplete data: a new connection starts."""


def excerpt(data: bytes) -> str:
    r"""Return the start of some bytes in readable form.

    Examples
    --------
    >>> excerpt(b"1TS\x00\r\n")
    "b'1TS\\x00\\r\\n'"
    """
    return repr(data[:_SHOWN]) + (f" … ({len(data)} bytes)" if len(data) > _SHOWN else "")


class LineDecoder:
    r"""Decode lines from a stream.

    Parameters
    ----------
    end : bytes
        Byte that ends a line; carriage returns, line feeds and NUL around it are removed, and a byte order
        mark before it.
    limit : int
        Largest size of a line (bytes). A longer one is damaged, and is skipped up to its end.

    Examples
    --------
    >>> lines = LineDecoder(limit=8)
    >>> lines.feed(b"1TP0.5\r\n1T")
    [b'1TP0.5']
    >>> lines.feed(b"S\n" + b"x" * 20 + b"\nok\n")
    [b'1TS', Damaged(data=b'xxxxxxxxxxxxxxxxxxxx', why='longer than 8 bytes'), b'ok']
    """

    def __init__(self, *, end: bytes = b"\n", limit: int = 1024) -> None:
        self._end, self._limit = end, limit
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete line."""
        self._partial = bytearray()
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes | Damaged]:
        """Return the lines that these bytes complete; empty ones are omitted."""
        found: list[bytes | Damaged] = []
        *ended, rest = data.split(self._end)
        for piece in ended:
            line = bytes(self._partial) + piece
            skipped, self._skipping = self._skipping, False
            self._partial.clear()
            stripped = line.removeprefix(b"\xef\xbb\xbf").strip(b"\r\n\0")
            if skipped:
                continue
            if len(stripped) > self._limit:
                found.append(Damaged(stripped[:_SHOWN], f"longer than {self._limit} bytes"))
            elif stripped:
                found.append(stripped)
        if not self._skipping:
            self._partial += rest
            if len(self._partial) > self._limit + 1:
                found.append(Damaged(bytes(self._partial[:_SHOWN]), f"longer than {self._limit} bytes"))
                self._partial.clear()
                self._skipping = True
        return found


class LineMessageDecoder(Generic[T]):
    """Decode messages of one line each from a stream.

    Parameters
    ----------
    decode : callable
        Returns the message of a line; raises a ProtocolError for a line that is none.
    limit : int
        Largest size of a line (bytes).

    Examples
    --------
    >>> decoder = LineMessageDecoder(len, limit=8)
    >>> decoder.feed(b"ok" + bytes([10]) + b"err")
    [2]
    """

    def __init__(self, decode: Callable[[bytes], T], *, limit: int) -> None:
        self._decode, self._lines = decode, LineDecoder(limit=limit)

    def reset(self) -> None:
        """Discard an incomplete message."""
        self._lines.reset()

    def feed(self, data: bytes) -> list[T | Damaged]:
        """Return the messages that these bytes complete, in order."""
        found: list[T | Damaged] = []
        for line in self._lines.feed(data):
            if isinstance(line, Damaged):
                found.append(line)
                continue
            try:
                found.append(self._decode(line))
            except ProtocolError as error:
                found.append(Damaged(line, error.what))
        return found
