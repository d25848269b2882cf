"""VXI-11: numbers of the core channel, and arguments of its procedures.

Source: *TCP/IP Instrument Protocol Specification VXI-11*, revision 1.0, sections B.4 (error codes), B.5
(flags) and B.6 (procedures).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Self

from .rpc import Unpacker, pack

CORE, VERSION = 0x0607AF, 1


class Procedure(IntEnum):
    """Procedures of the core channel."""

    NULL = 0
    CREATE_LINK = 10
    DEVICE_WRITE = 11
    DEVICE_READ = 12
    DEVICE_READSTB = 13
    DEVICE_TRIGGER = 14
    DEVICE_CLEAR = 15
    DEVICE_REMOTE = 16
    DEVICE_LOCAL = 17
    DEVICE_LOCK = 18
    DEVICE_UNLOCK = 19
    DEVICE_ENABLE_SRQ = 20
    DEVICE_DOCMD = 22
    DESTROY_LINK = 23


class Error(IntEnum):
    """Error codes in responses."""

    NONE = 0
    SYNTAX = 1
    DEVICE_NOT_ACCESSIBLE = 3
    INVALID_LINK = 4
    PARAMETER = 5
    NOT_SUPPORTED = 8
    OUT_OF_RESOURCES = 9
    NO_LOCK_HELD = 12
    IO_TIMEOUT = 15
    IO_ERROR = 17
    ABORT = 23


class Flag(IntEnum):
    """Bits of the operation flags."""

    WAIT_LOCK = 1
    END = 8
    TERM_CHAR = 128


class Reason(IntEnum):
    """Bits for the reason why a read ended."""

    REQUEST_COUNT = 1
    TERM_CHAR = 2
    END = 4


@dataclass(frozen=True)
class WriteParameters:
    """Arguments of device_write."""

    link: int
    flags: int
    data: bytes

    @classmethod
    def parse(cls, arguments: bytes) -> Self:
        """Decode the arguments; raises ProtocolError if they are too short."""
        found = Unpacker(arguments)
        link, _io, _lock, flags = (found.number() for _ in range(4))
        return cls(link, flags, found.opaque())


@dataclass(frozen=True)
class ReadParameters:
    """Arguments of device_read; `timeout_ms` is the time limit of the instrument's answer."""

    link: int
    size: int
    timeout_ms: int
    flags: int
    term_char: int

    @classmethod
    def parse(cls, arguments: bytes) -> Self:
        """Decode the arguments; raises ProtocolError if they are too short."""
        found = Unpacker(arguments)
        link, size, io, _lock, flags, char = (found.number() for _ in range(6))
        return cls(link, size, io, flags, char & 0xFF)


def generic_link(arguments: bytes) -> int:
    """Return the link at the start of any other procedure's arguments; raises ProtocolError without one."""
    return Unpacker(arguments).number()


def read_response(error: Error, reason: int, data: bytes) -> bytes:
    """Encode the results of device_read."""
    return pack(error, reason, data)
