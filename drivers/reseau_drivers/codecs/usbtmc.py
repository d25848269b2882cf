"""USB Test and Measurement Class: the header of twelve bytes of each transfer.

Source: *USBTMC* 1.0, tables 1 to 9: MsgID, bTag and its complement, a reserved byte, the size of the
transfer, its attributes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from reseau.core.errors import ProtocolError

from .stream import excerpt

OUT, REQUEST_IN = 1, 2
HEAD = 12
END = 1
"""Attribute bit: this transfer contains the last byte of a message."""

_HEAD = struct.Struct("<BBBBIB3x")


@dataclass(frozen=True)
class Transfer:
    """Transfer from the host to the bulk-out endpoint.

    Parameters
    ----------
    kind : int
        :data:`OUT` or :data:`REQUEST_IN`.
    tag : int
        1 to 255; an answer repeats it.
    size : int
        Number of bytes sent, or the largest number requested.
    end : bool
        Whether the message ends with this transfer.
    data : bytes
        Data of an OUT transfer, without padding.
    """

    kind: int
    tag: int
    size: int
    end: bool
    data: bytes = b""


def decode(packet: bytes) -> Transfer:
    r"""Decode the transfer that starts with these bytes.

    Raises
    ------
    ProtocolError
        If the complement of the tag is wrong, or the size of the data differs from the stated one.

    Examples
    --------
    >>> decode(bytes.fromhex("01 01 fe 00 06 00 00 00 01 00 00 00 2a 49 44 4e 3f 0a 00 00")).data
    b'*IDN?\n'
    """
    if len(packet) < HEAD:
        raise ProtocolError(f"not a USBTMC transfer: {excerpt(packet)}")
    kind, tag, complement, _, size, attributes = _HEAD.unpack_from(packet)
    if tag == 0 or tag ^ complement != 0xFF or kind not in (OUT, REQUEST_IN):
        raise ProtocolError(f"not a USBTMC transfer: {excerpt(packet)}")
    if kind == REQUEST_IN:
        return Transfer(kind, tag, size, False)
    # Some hosts omit the padding to four bytes; data must not be missing.
    if size == 0 or not size <= len(packet) - HEAD <= size + 3:
        raise ProtocolError(f"a transfer of {len(packet) - HEAD} bytes states {size}")
    return Transfer(kind, tag, size, bool(attributes & END), packet[HEAD : HEAD + size])


def encode_in(tag: int, data: bytes, end: bool) -> bytes:
    """Encode a transfer of an instrument's answer."""
    head = _HEAD.pack(REQUEST_IN, tag, tag ^ 0xFF, 0, len(data), END if end else 0)
    return head + data + bytes(-len(data) % 4)
