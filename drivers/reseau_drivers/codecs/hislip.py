"""HiSLIP messages: a header of sixteen bytes and a payload.

Source: IVI-6.1, *High-Speed LAN Instrument Protocol* 1.1, section 2.4 (message header format), table 4
(message types) and section 3 (transactions).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from reseau.core.errors import SettingError

from .stream import Damaged

PORT = 4880
HEAD = 16
"""Size of the header (bytes)."""

_HEAD = struct.Struct(">2sBBIQ")


class Type(IntEnum):
    """Message types."""

    INITIALIZE = 0
    INITIALIZE_RESPONSE = 1
    FATAL_ERROR = 2
    ERROR = 3
    ASYNC_LOCK = 4
    ASYNC_LOCK_RESPONSE = 5
    DATA = 6
    DATA_END = 7
    DEVICE_CLEAR_COMPLETE = 8
    DEVICE_CLEAR_ACKNOWLEDGE = 9
    ASYNC_REMOTE_LOCAL_CONTROL = 10
    ASYNC_REMOTE_LOCAL_RESPONSE = 11
    TRIGGER = 12
    INTERRUPTED = 13
    ASYNC_INTERRUPTED = 14
    ASYNC_MAX_MSG_SIZE = 15
    ASYNC_MAX_MSG_SIZE_RESPONSE = 16
    ASYNC_INITIALIZE = 17
    ASYNC_INITIALIZE_RESPONSE = 18
    ASYNC_DEVICE_CLEAR = 19
    ASYNC_SERVICE_REQUEST = 20
    ASYNC_STATUS_QUERY = 21
    ASYNC_STATUS_RESPONSE = 22
    ASYNC_DEVICE_CLEAR_ACKNOWLEDGE = 23
    ASYNC_LOCK_INFO = 24
    ASYNC_LOCK_INFO_RESPONSE = 25


@dataclass(frozen=True)
class Message:
    """One message.

    Parameters
    ----------
    type : int
        A :class:`Type`, or the unknown value that the peer sent.
    control : int
        Control code, 8 bits.
    parameter : int
        Message parameter, 32 bits; in data messages, the message's number.
    payload : bytes
        Data.
    """

    type: int
    control: int = 0
    parameter: int = 0
    payload: bytes = b""


def encode(message: Message) -> bytes:
    """Encode a message.

    Raises
    ------
    SettingError
        If a number does not fit its field.

    Examples
    --------
    >>> encode(Message(Type.DATA_END, 0, 0xFFFFFF00, b"*IDN?")).hex(" ", -4)
    '48530700 ffffff00 00000000 00000005 2a49444e 3f'
    """
    try:
        head = _HEAD.pack(b"HS", message.type, message.control, message.parameter, len(message.payload))
    except struct.error as error:
        raise SettingError(f"does not fit ({error})", where="a HiSLIP message") from None
    return head + message.payload


class MessageDecoder:
    """Decode messages from a stream.

    Parameters
    ----------
    limit : int
        Largest size of a payload (bytes). After a larger one, or an invalid header, the stream cannot be
        synchronised again; further data are ignored.
    """

    def __init__(self, limit: int = 1 << 23) -> None:
        self._limit = limit
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete message."""
        self._partial, self._failed = bytearray(), False

    def feed(self, data: bytes) -> list[Message | Damaged]:
        """Return the messages that these bytes complete."""
        if self._failed:
            return []
        found: list[Message | Damaged] = []
        self._partial += data
        while len(self._partial) >= HEAD:
            prologue, kind, control, parameter, length = _HEAD.unpack_from(self._partial)
            if prologue != b"HS" or length > self._limit:
                why = "not a HiSLIP header" if prologue != b"HS" else f"a payload of {length} bytes"
                found.append(Damaged(bytes(self._partial[:60]), why))
                self._partial.clear()
                self._failed = True
                return found
            if len(self._partial) < HEAD + length:
                return found
            found.append(Message(kind, control, parameter, bytes(self._partial[HEAD : HEAD + length])))
            del self._partial[: HEAD + length]
        return found
