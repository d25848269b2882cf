r"""GigE Vision: packets of the control protocol (GVCP) and of the stream protocol (GVSP).

Source: AIA, *GigE Vision* 2.0: commands (sections 14 to 18), blocks of images (section 24), and bootstrap
registers (section 28). All numbers are big-endian.

A command is a key, flags, its kind, the length of its data and a number that its acknowledgement repeats.
An image is a leader, packets of data and a trailer; each packet has the number of its block and its own.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from reseau.core.errors import ProtocolError

from .stream import excerpt

PORT = 3956
"""UDP port of the control protocol."""
PRIVILEGE = 0x0A00
"""Register of the control: bit 0 exclusive access, bit 1 control."""
ACTION_DEVICE_KEY, ACTION_GROUP_KEY, ACTION_GROUP_MASK = 0x090C, 0x9800, 0x9804
"""Registers of the first action signal."""

_COMMAND = struct.Struct(">BBHHH")
_ANSWER = struct.Struct(">HHHH")
_ACTION = struct.Struct(">III")
_LEADER = struct.Struct(">HHQIIIIIHH")
_PACKET = struct.Struct(">HHI")
_KEY, _ACKNOWLEDGE = 0x42, 0x01
_IMAGE = 1
_LEADER_FORMAT, _TRAILER_FORMAT, _DATA_FORMAT = 1, 2, 3


class Kind(IntEnum):
    """Kinds of commands; an acknowledgement has the number after."""

    DISCOVERY = 0x0002
    PACKET_RESEND = 0x0040
    READ_REGISTER = 0x0080
    WRITE_REGISTER = 0x0082
    READ_MEMORY = 0x0084
    WRITE_MEMORY = 0x0086
    ACTION = 0x0100


class Status(IntEnum):
    """Status of an acknowledgement."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    ACCESS_DENIED = 0x8006


@dataclass(frozen=True)
class Command:
    """A command.

    Parameters
    ----------
    kind : int
        One of :class:`Kind`, or another number.
    data : bytes
        Its parameters.
    number : int
        From 1 to 65535.
    acknowledge : bool
        Whether an answer is wanted.

    Examples
    --------
    >>> Command(Kind.READ_REGISTER, PRIVILEGE.to_bytes(4, "big"), 7).encode().hex(" ", 2)
    '4201 0080 0004 0007 0000 0a00'
    >>> Command.decode(bytes.fromhex("4201008000040007 00000a00")).number
    7
    """

    kind: int
    data: bytes = b""
    number: int = 1
    acknowledge: bool = True

    def encode(self) -> bytes:
        """Return the bytes of the command."""
        flags = _ACKNOWLEDGE if self.acknowledge else 0
        return _COMMAND.pack(_KEY, flags, self.kind, len(self.data), self.number) + self.data

    @classmethod
    def decode(cls, packet: bytes) -> Command:
        """Return the command in a packet.

        Raises
        ------
        ProtocolError
            If it is not a command, or shorter than it says.
        """
        if len(packet) < _COMMAND.size or packet[0] != _KEY:
            raise ProtocolError(f"not a command of GigE Vision: {excerpt(packet)}")
        _, flags, kind, size, number = _COMMAND.unpack_from(packet)
        data = packet[_COMMAND.size : _COMMAND.size + size]
        if len(data) < size:
            raise ProtocolError(f"a command announces {size} bytes and has {len(data)}")
        return cls(kind, data, number, bool(flags & _ACKNOWLEDGE))


def acknowledgement(command: Command, data: bytes = b"", status: int = Status.SUCCESS) -> bytes:
    """Return the bytes of the answer to a command.

    Examples
    --------
    >>> acknowledgement(Command(Kind.ACTION, number=9)).hex(" ", 2)
    '0000 0101 0000 0009'
    """
    return _ANSWER.pack(status, command.kind + 1, len(data), command.number) + data


@dataclass(frozen=True)
class Action:
    """An action command: it acts on every camera with its device key, group key and a bit of its mask.

    Examples
    --------
    >>> Action(1, 2, 0xFF).encode().hex(" ", 4)
    '00000001 00000002 000000ff'
    >>> Action(1, 2, 0xF0).concerns(Action(1, 2, 0x0F)), Action(1, 2, 1).concerns(Action(1, 2, 3))
    (False, True)
    """

    device_key: int
    group_key: int
    group_mask: int

    def encode(self) -> bytes:
        """Return the parameters of the command."""
        return _ACTION.pack(self.device_key, self.group_key, self.group_mask)

    @classmethod
    def decode(cls, data: bytes) -> Action:
        """Return the action of a command's parameters; a scheduled time after it is ignored.

        Raises
        ------
        ProtocolError
            If there are too few bytes.
        """
        if len(data) < _ACTION.size:
            raise ProtocolError(f"an action command has {len(data)} of {_ACTION.size} bytes")
        return cls(*_ACTION.unpack_from(data))

    def concerns(self, camera: Action) -> bool:
        """Whether the command acts on a camera with these keys and this mask."""
        same = (self.device_key, self.group_key) == (camera.device_key, camera.group_key)
        return same and bool(self.group_mask & camera.group_mask)


@dataclass(frozen=True)
class Leader:
    """What the first packet of an image says.

    Parameters
    ----------
    stamp : int
        Time stamp of the camera (ticks).
    pixel_format : int
        Code of the format.
    width, height, left, top : int
        Size and place of the image on the sensor (px).

    Examples
    --------
    >>> len(Leader(1, 0x01080001, 64, 48, 0, 0).packet(5))
    44
    """

    stamp: int
    pixel_format: int
    width: int
    height: int
    left: int
    top: int

    def packet(self, block: int) -> bytes:
        """Return the packet, the first of its block."""
        region = self.width, self.height, self.left, self.top
        body = _LEADER.pack(0, _IMAGE, self.stamp, self.pixel_format, *region, 0, 0)
        return _PACKET.pack(0, block, _LEADER_FORMAT << 24) + body


def data_packet(block: int, number: int, data: bytes | memoryview) -> bytes:
    """Return a packet of pixels; the first has the number 1."""
    return _PACKET.pack(0, block, _DATA_FORMAT << 24 | number) + data


def trailer(block: int, number: int, height: int) -> bytes:
    """Return the last packet of an image."""
    return _PACKET.pack(0, block, _TRAILER_FORMAT << 24 | number) + struct.pack(">HHI", 0, _IMAGE, height)
