"""ONC remote procedure calls: XDR, records on a stream, calls, replies, and the portmapper.

Source: RFC 4506 (XDR), RFC 5531 (RPC: sections 9 and 11), RFC 1833 (portmapper, section 3). Numbers are
big-endian with four bytes; opaque data are padded to multiples of four. On a stream, a record consists of
fragments with a header of four bytes: their length, and the highest bit in the last fragment.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from reseau.core.errors import ProtocolError

from .stream import Damaged, excerpt

PORTMAPPER, PORTMAPPER_VERSION, GETPORT = 100000, 2, 3
ACCEPTED = 0
SUCCESS, PROG_UNAVAIL, PROC_UNAVAIL, GARBAGE_ARGS = 0, 1, 3, 4
_LAST = 0x80000000


def pack(*values: int | bytes) -> bytes:
    """Encode numbers and opaque data of variable length as XDR.

    Examples
    --------
    >>> pack(1, b"inst0").hex(" ", 4)
    '00000001 00000005 696e7374 30000000'
    """
    out = bytearray()
    for value in values:
        if isinstance(value, int):
            out += struct.pack(">I", value & 0xFFFFFFFF)
        else:
            out += struct.pack(">I", len(value)) + value + bytes(-len(value) % 4)
    return bytes(out)


class Unpacker:
    """Decode XDR.

    Raises
    ------
    ProtocolError
        From its methods, if the data end before the value.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def number(self) -> int:
        """Return an unsigned number."""
        return int.from_bytes(self._take(4), "big")

    def opaque(self, largest: int = 1 << 26) -> bytes:
        """Return data of variable length, up to a limit."""
        length = self.number()
        if length > largest:
            raise ProtocolError(f"XDR announces {length} bytes")
        data = self._take(length)
        self._take(-length % 4)
        return data

    def rest(self) -> bytes:
        """Return the remaining data."""
        rest, self._at = self._data[self._at :], len(self._data)
        return rest

    def _take(self, count: int) -> bytes:
        if len(self._data) - self._at < count:
            raise ProtocolError(f"XDR ends too early: {excerpt(self._data)}")
        self._at += count
        return self._data[self._at - count : self._at]


def record(content: bytes) -> bytes:
    """Encode a record with one fragment."""
    return struct.pack(">I", _LAST | len(content)) + content


class RecordDecoder:
    """Decode records from a stream.

    Parameters
    ----------
    limit : int
        Largest size of a record (bytes). After a larger one the stream cannot be synchronised again; further
        data are ignored.
    """

    def __init__(self, limit: int = 1 << 23) -> None:
        self._limit = limit
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete record."""
        self._partial, self._record, self._failed = bytearray(), bytearray(), False

    def feed(self, data: bytes) -> list[bytes | Damaged]:
        """Return the records that these bytes complete."""
        if self._failed:
            return []
        found: list[bytes | Damaged] = []
        self._partial += data
        while len(self._partial) >= 4:
            head = int.from_bytes(self._partial[:4], "big")
            length = head & ~_LAST
            if length + len(self._record) > self._limit:
                found.append(Damaged(bytes(self._partial[:60]), f"a record of more than {self._limit} bytes"))
                self._partial.clear()
                self._failed = True
                return found
            if len(self._partial) < 4 + length:
                return found
            self._record += self._partial[4 : 4 + length]
            del self._partial[: 4 + length]
            if head & _LAST:
                found.append(bytes(self._record))
                self._record.clear()
        return found


@dataclass(frozen=True)
class Call:
    """Call of a remote procedure."""

    xid: int
    program: int
    version: int
    procedure: int
    arguments: bytes = b""


def encode_call(call: Call) -> bytes:
    """Encode the content of a record with a call, without credentials."""
    head = (call.xid, 0, 2, call.program, call.version, call.procedure, 0, 0, 0, 0)
    return pack(*head) + call.arguments


def decode_call(data: bytes) -> Call:
    """Decode the call in a record.

    Raises
    ------
    ProtocolError
        If it is not a call, or of another version of RPC.
    """
    found = Unpacker(data)
    xid, kind, version = found.number(), found.number(), found.number()
    if kind != 0 or version != 2:
        raise ProtocolError(f"not an RPC call: {excerpt(data)}")
    program, its_version, procedure = found.number(), found.number(), found.number()
    for _ in ("credentials", "verifier"):
        found.number()
        found.opaque(400)
    return Call(xid, program, its_version, procedure, found.rest())


def encode_reply(xid: int, results: bytes, status: int = SUCCESS) -> bytes:
    """Encode the content of a record with the reply to an accepted call."""
    return pack(xid, 1, ACCEPTED, 0, 0, status) + (results if status == SUCCESS else b"")


def decode_reply(data: bytes) -> tuple[int, int, bytes]:
    """Return number of the call, status and results of a reply.

    Raises
    ------
    ProtocolError
        If it is not a reply, or denies the call.
    """
    found = Unpacker(data)
    xid, kind, state = found.number(), found.number(), found.number()
    if kind != 1 or state != ACCEPTED:
        raise ProtocolError(f"not an RPC reply to an accepted call: {excerpt(data)}")
    found.number()
    found.opaque(400)
    return xid, found.number(), found.rest()
