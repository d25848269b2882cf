"""What all decoders of streams have in common, and the one for lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

__all__ = ["Damaged", "Decoder", "LineDecoder", "excerpt"]

T = TypeVar("T")

_SHOWN = 60
"""Bytes of a damaged message that are kept to be shown."""


@dataclass(frozen=True)
class Damaged:
    """Bytes that arrived and are no message.

    Parameters
    ----------
    data : bytes
        The first of them.
    why : str
        What is wrong with them.
    """

    data: bytes
    why: str

    def __str__(self) -> str:
        return f"{self.why}: {excerpt(self.data)}"


class Decoder(Protocol, Generic[T]):
    """Takes the bytes of a stream as they come and yields what they mean."""

    def feed(self, data: bytes) -> list[T | Damaged]:
        """Messages that are complete with these bytes, in their order."""

    def reset(self) -> None:
        """Forget what was begun: the connection is a new one."""


def excerpt(data: bytes) -> str:
    r"""Bytes as one can read them, not too many.

    Examples
    --------
    >>> excerpt(b"1TS\x00\r\n")
    "b'1TS\\x00\\r\\n'"
    """
    return repr(data[:_SHOWN]) + (f" … ({len(data)} bytes)" if len(data) > _SHOWN else "")


class LineDecoder:
    r"""Lines of a stream.

    Parameters
    ----------
    end : bytes
        The one byte that ends a line; carriage returns and line feeds around a line are taken off.
    limit : int
        Bytes of the longest line. A longer one is damaged, and is skipped up to its end.

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
        """Forget the line that was begun."""
        self._partial = bytearray()
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes | Damaged]:
        """Lines that are complete with these bytes; empty ones are left out."""
        found: list[bytes | Damaged] = []
        *ended, rest = data.split(self._end)
        for piece in ended:
            line = bytes(self._partial) + piece
            skipped, self._skipping = self._skipping, False
            self._partial.clear()
            stripped = line.strip(b"\r\n")
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
