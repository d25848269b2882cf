r"""Thorlabs' APT protocol, which the Kinesis controllers speak: messages of six bytes, with data after some.

Source: Thorlabs, *APT Controllers: Host-Controller Communications Protocol*, "Message structure" and the
sections on the messages named here. A header is ``<id u16> <parameter> <parameter> <destination> <source>``;
if data follow, it has their length (u16) in place of the parameters, and the top bit of the destination is
set. There is no checksum and no mark at the start of a message: a header counts if its id, its length and
both addresses are possible.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reseau.core.errors import ProtocolError, SettingError

from ..profiles import known
from .stream import Damaged, excerpt

HOST, USB = 0x01, 0x50
"""Addresses: the computer, and a controller with one USB connection of its own."""
_ADDRESSES = frozenset({0x00, HOST, 0x11, *range(0x21, 0x2B), USB})
_LONG = 0x80
_HEADER = 6
_KINESIS = known("kinesis")
_NO_HEADER = "not a header of the APT protocol"


def bay(number: int) -> int:
    """Return the address of a bay of a rack, from 1.

    Raises
    ------
    SettingError
        If there is no such bay.

    Examples
    --------
    >>> hex(bay(1))
    '0x21'
    """
    if not 1 <= number <= 10:
        raise SettingError(f"{number} is not 1…10", where="bay")
    return 0x20 + number


@dataclass(frozen=True)
class Message:
    """One message.

    Parameters
    ----------
    name : str
        One of the `messages` of the profile.
    destination, source : int
        Addresses.
    parameters : (int, int)
        Parameters of a message without data: often the channel first.
    data : bytes
        Data of a message that has some.
    """

    name: str
    destination: int
    source: int
    parameters: tuple[int, int] = (0, 0)
    data: bytes = b""

    @property
    def channel(self) -> int:
        """Channel that the message is about: of its data, or of its parameters."""
        return struct.unpack_from("<H", self.data)[0] if len(self.data) >= 2 else self.parameters[0]


def encode(message: Message, profile: Mapping[str, Any] = _KINESIS) -> bytes:
    r"""Encode a message, with the numbers of a profile.

    Raises
    ------
    SettingError
        If it cannot be sent.

    Examples
    --------
    >>> encode(Message("HOME", USB, HOST, (1, 0))).hex(" ")
    '43 04 01 00 50 01'
    """
    two, ends = message.data and any(message.parameters), {message.destination, message.source}
    number, sizes = _told(profile["messages"].get(message.name, "0000 -1"))
    if two or len(message.data) not in sizes or not ends <= _ADDRESSES:
        raise SettingError("is not a message of the APT protocol", where=repr(message))
    if message.data:
        head = (number, len(message.data), message.destination | _LONG, message.source)
        return struct.pack("<HHBB", *head) + message.data
    return struct.pack("<HBBBB", number, *message.parameters, message.destination, message.source)


def move(destination: int, channel: int, position: int, *, name: str = "MOVE_ABSOLUTE") -> Message:
    """Return an order to move to a position, or by a distance (counts).

    Raises
    ------
    SettingError
        If it has more than 32 bits.

    Examples
    --------
    >>> encode(move(USB, 1, 200_000)).hex(" ")
    '53 04 06 00 d0 01 01 00 40 0d 03 00'
    """
    if not -(1 << 31) <= position < 1 << 31:
        raise SettingError(f"{position} counts do not fit into 32 bits", where="position")
    return Message(name, destination, HOST, data=struct.pack("<Hi", channel, position))


@dataclass(frozen=True)
class Velocities:
    """Parameters of the velocity of a channel, in the controller's units."""

    channel: int
    acceleration: int
    maximum: int
    minimum: int = 0


def encode_velocities(velocities: Velocities) -> bytes:
    """Encode the data of SET_VELOCITIES and VELOCITIES.

    Raises
    ------
    SettingError
        If a value has more than 32 bits.

    Examples
    --------
    >>> encode_velocities(Velocities(1, 10, 1000)).hex(" ")
    '01 00 00 00 00 00 0a 00 00 00 e8 03 00 00'
    """
    v = velocities
    try:
        return struct.pack("<H3i", v.channel, v.minimum, v.acceleration, v.maximum)
    except struct.error:
        raise SettingError("do not fit into 32 bits", where=repr(v)) from None


def decode_velocities(message: Message) -> Velocities:
    """Decode the data of SET_VELOCITIES and VELOCITIES."""
    channel, minimum, acceleration, maximum = struct.unpack("<H3i", message.data)
    return Velocities(channel, acceleration, maximum, minimum)


def encode_status(channel: int, position: int, bits: int, *, more: bytes = bytes(4)) -> bytes:
    """Encode the data of STATUS (`more`: encoder count) and DC_STATUS (`more`: velocity and current)."""
    return struct.pack("<Hi4sI", channel, position, more, bits)


def decode_status(message: Message) -> tuple[int, int]:
    """Decode position (counts) and bits of STATUS, DC_STATUS, and MOVED or STOPPED with data.

    Examples
    --------
    >>> data = encode_status(1, -5, 0x80000400)
    >>> position, bits = decode_status(Message("DC_STATUS", HOST, USB, data=data))
    >>> position, hex(bits)
    (-5, '0x80000400')
    """
    _, position, _, bits = struct.unpack("<Hi4sI", message.data)
    return position, bits


@dataclass(frozen=True)
class Info:
    """What a controller says about itself.

    Parameters
    ----------
    serial : int
        Serial number.
    model : str
        Up to eight characters.
    firmware : (int, int, int)
        Major, interim and minor version.
    channels : int
        Number of channels.
    """

    serial: int
    model: str
    firmware: tuple[int, int, int]
    channels: int = 1


_INFO = struct.Struct("<I8sH3Bx60sHHH")


def encode_info(info: Info) -> bytes:
    """Encode the data of INFO."""
    model = info.model.encode("ascii")[:8]
    return _INFO.pack(info.serial, model, 16, *reversed(info.firmware), b"", 1, 0, info.channels)


def decode_info(message: Message) -> Info:
    """Decode the data of INFO.

    Raises
    ------
    ProtocolError
        If the model is no text.

    Examples
    --------
    >>> data = encode_info(Info(27001234, "KDC101", (2, 1, 3)))
    >>> decode_info(Message("INFO", HOST, USB, data=data))
    Info(serial=27001234, model='KDC101', firmware=(2, 1, 3), channels=1)
    """
    serial, model, _, minor, interim, major, _, _, _, channels = _INFO.unpack(message.data)
    name = model.partition(b"\0")[0]
    if not name.isascii() or not name.decode("ascii", "replace").isprintable():
        raise ProtocolError(f"not a model of a controller: {excerpt(name)}")
    return Info(serial, name.decode(), (major, interim, minor), channels)


class MessageDecoder:
    r"""Decode messages from a stream.

    Examples
    --------
    >>> decoder = MessageDecoder()
    >>> decoder.feed(b"\x44\x04\x01")
    []
    >>> decoder.feed(b"\x00\x01\x50")
    [Message(name='HOMED', destination=1, source=80, parameters=(1, 0), data=b'')]
    >>> decoder.feed(b"\xff\xff" + bytes.fromhex("660401000150"))[0].why
    'not a header of the APT protocol'
    """

    def __init__(self, profile: Mapping[str, Any] = _KINESIS) -> None:
        self._names = {}
        for name, text in profile["messages"].items():
            number, sizes = _told(text)
            self._names[number] = (name, sizes)
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete message."""
        self._held = bytearray()

    def feed(self, data: bytes) -> list[Message | Damaged]:
        """Return the messages that these bytes complete."""
        found: list[Message | Damaged] = []
        self._held += data
        held, at, skipped = bytes(self._held), 0, 0
        while len(held) - at >= _HEADER:
            size = self._size(held[at : at + _HEADER]) if held[at + _HEADER - 1] in _ADDRESSES else None
            if size is None:
                at, skipped = at + 1, skipped + 1
                continue
            if skipped:
                found.append(Damaged(held[at - skipped : at][:_HEADER], _NO_HEADER))
                skipped = 0
            if len(held) - at < _HEADER + size:
                break
            found.append(self._message(held[at : at + _HEADER + size]))
            at += _HEADER + size
        if skipped:
            found.append(Damaged(held[at - skipped : at][:_HEADER], _NO_HEADER))
        del self._held[:at]
        return found

    def _size(self, header: bytes) -> int | None:
        """Length of the data after a header; None if it is none."""
        number, length, destination, source = struct.unpack("<HHBB", header)
        size = length if destination & _LONG else 0
        _, sizes = self._names.get(number, ("", ()))
        if {destination & ~_LONG, source} <= _ADDRESSES and size in sizes:
            # A long message has data.
            return size if bool(size) == bool(destination & _LONG) else None
        return None

    def _message(self, data: bytes) -> Message:
        number, first, second, destination, source = struct.unpack("<HBBBB", data[:_HEADER])
        name, _ = self._names[number]
        if destination & _LONG:
            return Message(name, destination & ~_LONG, source, data=data[_HEADER:])
        return Message(name, destination, source, (first, second))


def _told(text: str) -> tuple[int, tuple[int, ...]]:
    """Number of a message, and possible lengths of its data; 0: the header alone."""
    number, *sizes = text.split()
    return int(number, 16), tuple(map(int, sizes)) or (0,)
