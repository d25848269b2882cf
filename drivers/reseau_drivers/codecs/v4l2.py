"""Structures of Video4Linux for `ioctl`: bytes and values, no devices.

Source: the kernel's ``include/uapi/linux/videodev2.h`` (Linux 6.1), on little-endian 64-bit machines.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Self

CAPTURE = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE."""
MMAP = 1
"""V4L2_MEMORY_MMAP."""


def _request(way: int, number: int, size: int) -> int:
    """Compose a request as <asm-generic/ioctl.h>; way: 1 into the kernel, 2 out of it, 3 both."""
    return way << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP = _request(2, 0, 104)
ENUM_FMT = _request(3, 2, 64)
G_FMT, S_FMT = _request(3, 4, 208), _request(3, 5, 208)
REQBUFS = _request(3, 8, 20)
QUERYBUF, QBUF, DQBUF = _request(3, 9, 88), _request(3, 15, 88), _request(3, 17, 88)
STREAMON, STREAMOFF = _request(1, 18, 4), _request(1, 19, 4)
G_PARM, S_PARM = _request(3, 21, 204), _request(3, 22, 204)
G_CTRL, S_CTRL = _request(3, 27, 8), _request(3, 28, 8)
QUERYCTRL = _request(3, 36, 68)
G_SELECTION, S_SELECTION = _request(3, 94, 64), _request(3, 95, 64)

BRIGHTNESS, AUTOGAIN, GAIN = 0x980900, 0x980912, 0x980913
EXPOSURE_AUTO, EXPOSURE_ABSOLUTE = 0x9A0901, 0x9A0902
EXPOSURE_MANUAL = 1
"""Value of EXPOSURE_AUTO: EXPOSURE_ABSOLUTE sets the exposure time, in units of 100 µs."""

FIELDS = (
    "ANY", "NONE", "TOP", "BOTTOM", "INTERLACED", "SEQ_TB", "SEQ_BT", "ALTERNATE", "INTERLACED_TB",
    "INTERLACED_BT",
)  # fmt: skip
"""Orders of fields: NONE are whole frames; all from TOP on have half of the rows, or rows of two times."""

_NEXT = 0x80000000


def fourcc_of(text: str) -> int:
    """Return the number of a four-character code.

    Examples
    --------
    >>> hex(fourcc_of("Y16 "))
    '0x20363159'
    """
    return int.from_bytes(text.encode("ascii"), "little")


def fourcc_text(code: int) -> str:
    """Return the four characters of a code."""
    return code.to_bytes(4, "little").decode("ascii", "replace")


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("utf-8", "replace")


def stream_type() -> bytearray:
    """Argument of STREAMON and STREAMOFF."""
    return bytearray(struct.pack("<i", CAPTURE))


def control_value(identifier: int, value: int = 0) -> bytearray:
    """``struct v4l2_control``."""
    return bytearray(struct.pack("<Ii", identifier, value))


@dataclass(frozen=True)
class Capability:
    """``struct v4l2_capability``: properties of a node."""

    driver: str
    card: str
    bus: str
    version: tuple[int, int, int]
    capabilities: int

    SIZE = 104
    VIDEO_CAPTURE, STREAMING, OWN = 0x1, 0x4000000, 0x80000000

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure; the capabilities are those of this node if the driver reports them."""
        driver, card, bus, version, whole, own = struct.unpack_from("<16s32s32sIII", data)
        parts = (version >> 16 & 0xFF, version >> 8 & 0xFF, version & 0xFF)
        return cls(_text(driver), _text(card), _text(bus), parts, own if whole & cls.OWN else whole)

    def build(self) -> bytearray:
        """Encode the structure."""
        major, minor, patch = self.version
        return bytearray(
            struct.pack(
                "<16s32s32sIII12x",
                self.driver.encode(),
                self.card.encode(),
                self.bus.encode(),
                major << 16 | minor << 8 | patch,
                self.capabilities | self.OWN,
                self.capabilities,
            )
        )


@dataclass(frozen=True)
class Format:
    """``struct v4l2_format`` with a ``v4l2_pix_format``.

    Parameters
    ----------
    width, height : int
        Size (px).
    fourcc : str
        Four-character code.
    stride : int
        Bytes from one row to the next.
    size : int
        Largest size of a frame (bytes).
    field : int
        Order of fields; see `FIELDS`.
    """

    width: int
    height: int
    fourcc: str
    stride: int = 0
    size: int = 0
    field: int = 1

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure."""
        width, height, code, field, stride, size = struct.unpack_from("<IIIIII", data, 8)
        return cls(width, height, fourcc_text(code), stride, size, field)

    def build(self) -> bytearray:
        """Encode the structure."""
        head = struct.pack("<I4x", CAPTURE)
        body = struct.pack(
            "<IIIIII", self.width, self.height, fourcc_of(self.fourcc), self.field, self.stride, self.size
        )
        return bytearray(head + body).ljust(208, b"\0")

    @staticmethod
    def ask(index: int) -> bytearray:
        """``struct v4l2_fmtdesc``: query for the format with this index."""
        return bytearray(struct.pack("<II", index, CAPTURE)).ljust(64, b"\0")

    @staticmethod
    def listed(data: bytes) -> str:
        """Return the four-character code of the answer."""
        return fourcc_text(struct.unpack_from("<I", data, 44)[0])


@dataclass(frozen=True)
class Control:
    """``struct v4l2_queryctrl``: a control with its limits."""

    identifier: int
    name: str
    kind: int
    low: int
    high: int
    step: int
    default: int
    flags: int = 0

    DISABLED, READ_ONLY, INACTIVE = 0x1, 0x4, 0x10

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure."""
        identifier, kind, name, low, high, step, default, flags = struct.unpack_from("<II32siiiiI", data)
        return cls(identifier, _text(name), kind, low, high, step, default, flags)

    def build(self) -> bytearray:
        """Encode the structure."""
        fields = self.identifier, self.kind, self.name.encode(), self.low, self.high, self.step
        return bytearray(struct.pack("<II32siiiiI8x", *fields, self.default, self.flags))

    @staticmethod
    def after(identifier: int) -> bytearray:
        """Query for the first control after this one."""
        return bytearray(struct.pack("<I", identifier | _NEXT)).ljust(68, b"\0")

    @staticmethod
    def asked(data: bytes) -> int:
        """Return the identifier in a query."""
        return int(struct.unpack_from("<I", data)[0]) & ~_NEXT


@dataclass(frozen=True)
class Interval:
    """``struct v4l2_streamparm``: the time between frames as a fraction of seconds."""

    numerator: int
    denominator: int
    capability: int = 0x1000

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure."""
        capability, _, numerator, denominator = struct.unpack_from("<IIII", data, 4)
        return cls(numerator, denominator, capability)

    def build(self) -> bytearray:
        """Encode the structure."""
        head = struct.pack("<IIIII", CAPTURE, self.capability, 0, self.numerator, self.denominator)
        return bytearray(head).ljust(204, b"\0")

    @property
    def ns(self) -> int:
        """Interval in nanoseconds; 0 if unknown."""
        return self.numerator * 1_000_000_000 // self.denominator if self.denominator else 0


@dataclass(frozen=True)
class Selection:
    """``struct v4l2_selection``: the region of the sensor that is read out."""

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure."""
        return cls(*struct.unpack_from("<iiII", data, 12))

    def build(self) -> bytearray:
        """Encode the structure with the crop rectangle as target."""
        head = struct.pack("<IIIiiII", CAPTURE, 0, 0, self.left, self.top, self.width, self.height)
        return bytearray(head).ljust(64, b"\0")


@dataclass(frozen=True)
class Request:
    """``struct v4l2_requestbuffers``."""

    count: int

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure."""
        return cls(struct.unpack_from("<I", data)[0])

    def build(self) -> bytearray:
        """Encode the structure."""
        return bytearray(struct.pack("<IIIII", self.count, CAPTURE, MMAP, 0, 0))


@dataclass(frozen=True)
class Buffer:
    """``struct v4l2_buffer`` of mapped memory.

    Parameters
    ----------
    index : int
        Index of the buffer.
    used : int
        Size of the frame in it (bytes).
    flags : int
        See the constants.
    stamp_ns : int
        Time of the frame (ns).
    sequence : int
        Frame number, 32 bits.
    offset, length : int
        Position and size of the memory (bytes).
    field : int
        Order of fields in it; see `FIELDS`.
    """

    index: int = 0
    used: int = 0
    flags: int = 0
    stamp_ns: int = 0
    sequence: int = 0
    offset: int = 0
    length: int = 0
    field: int = 1

    ERROR, MONOTONIC, CLOCKS = 0x40, 0x2000, 0xE000
    START_OF_EXPOSURE, SOURCES = 0x10000, 0x70000

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Decode the structure."""
        index, _, used, flags, field, seconds, micros = struct.unpack_from("<IIIII4xqq", data)
        (sequence,) = struct.unpack_from("<I", data, 56)
        offset, length = struct.unpack_from("<I4xI", data, 64)
        return cls(index, used, flags, (seconds * 1_000_000 + micros) * 1000, sequence, offset, length, field)

    def build(self) -> bytearray:
        """Encode the structure."""
        seconds, micros = divmod(self.stamp_ns // 1000, 1_000_000)
        head = struct.pack(
            "<IIIII4xqq", self.index, CAPTURE, self.used, self.flags, self.field, seconds, micros
        )
        tail = struct.pack("<IIQI", self.sequence, MMAP, self.offset, self.length)
        return bytearray(head + bytes(16) + tail).ljust(88, b"\0")
