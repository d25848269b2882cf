r"""Modbus: reading registers, over serial lines (RTU) and over TCP.

Source: *MODBUS Application Protocol Specification V1.1b3*, sections 4, 6.3, 6.4, 6.8 and 7; *MODBUS over
Serial Line V1.02*, section 2.5.1 and appendix B (CRC); *MODBUS Messaging on TCP/IP V1.0b*, section 3.1.3.

A frame of RTU is ``<address> <PDU> <CRC low, high>``; its length follows from the function. A frame over TCP
is ``<transaction u16> <0 u16> <length u16> <unit> <PDU>``, big-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from reseau.core.errors import ProtocolError, RefusedError, SettingError

from .stream import Damaged, excerpt

HOLDING, INPUT, DIAGNOSTICS = 3, 4, 8
"""Functions: read holding registers, read input registers, diagnostics."""
MOST = 125
"""Largest number of registers in one answer."""
EXCEPTIONS: dict[int, str] = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledge",
    6: "device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target failed to respond",
}
"""Exception codes."""
FORMATS: dict[str, str] = {
    "uint16": ">H", "int16": ">h", "uint32": ">I", "int32": ">i", "float32": ">f", "float64": ">d",
}  # fmt: skip
"""Formats of numbers in registers, for :mod:`struct`."""
WordOrder = Literal["big", "little"]
"""Whether the most significant register of a number comes first."""

_ERROR = 0x80
_BY_COUNT = (1, 2, 3, 4, 17)
_KNOWN = (1, 2, 3, 4, 5, 6, DIAGNOSTICS, 15, 16, 17)
_FUNCTIONS = frozenset({*_KNOWN, *(each | _ERROR for each in _KNOWN)})
"""Functions whose answer has the number of its data bytes in front."""


def crc(data: bytes) -> bytes:
    """Return the checksum of a frame of RTU: CRC-16 with the polynomial 0xA001, low byte first.

    Examples
    --------
    >>> crc(bytes.fromhex("02 07")).hex(" ")  # appendix B
    '41 12'
    """
    found = 0xFFFF
    for each in data:
        found = (found >> 8) ^ _TABLE[(found ^ each) & 0xFF]
    return struct.pack("<H", found)


def _shifted(byte: int) -> int:
    """The checksum of one byte, bit by bit."""
    for _ in range(8):
        byte = (byte >> 1) ^ 0xA001 if byte & 1 else byte >> 1
    return byte


_TABLE = tuple(map(_shifted, range(256)))


@dataclass(frozen=True)
class Frame:
    """A request or an answer.

    Parameters
    ----------
    unit : int
        Address of the device.
    pdu : bytes
        Function and data.
    transaction : int or None
        Number that the answer repeats; None on serial lines, where there is none.
    """

    unit: int
    pdu: bytes
    transaction: int | None = None

    @property
    def function(self) -> int:
        """Function, without the mark of an exception."""
        return self.pdu[0] & ~_ERROR


def encode(frame: Frame) -> bytes:
    """Encode a frame: of TCP if it has a transaction, otherwise of RTU.

    Examples
    --------
    >>> encode(Frame(17, encode_read(HOLDING, 107, 3))).hex(" ")
    '11 03 00 6b 00 03 76 87'
    >>> encode(Frame(17, encode_read(HOLDING, 107, 3), 1)).hex(" ")
    '00 01 00 00 00 06 11 03 00 6b 00 03'
    """
    content = bytes([frame.unit]) + frame.pdu
    if frame.transaction is None:
        return content + crc(content)
    return struct.pack(">HHH", frame.transaction, 0, len(content)) + content


def encode_read(function: int, register: int, count: int) -> bytes:
    """Encode the request of registers.

    Raises
    ------
    SettingError
        If there are no such registers, or too many are requested.
    """
    if function not in (HOLDING, INPUT) or not (register >= 0 and register + count <= 65536):
        raise SettingError("registers are 0…65535, of function 3 or 4", where=f"register {register}")
    if not 1 <= count <= MOST:
        raise SettingError(f"{count} registers are not 1…{MOST}", where=f"register {register}")
    return struct.pack(">BHH", function, register, count)


def decode_read(pdu: bytes) -> tuple[int, int, int]:
    """Decode a request of registers: function, first register, count.

    Raises
    ------
    ProtocolError
        If it is none.
    """
    if len(pdu) != 5 or pdu[0] not in (HOLDING, INPUT):
        raise ProtocolError(f"not a request of registers: {excerpt(pdu)}")
    function, register, count = struct.unpack(">BHH", pdu)
    return function, register, count


def encode_registers(function: int, values: Sequence[int]) -> bytes:
    """Encode the answer with registers."""
    return struct.pack(f">BB{len(values)}H", function, 2 * len(values), *values)


def decode_registers(pdu: bytes, function: int, count: int) -> tuple[int, ...]:
    """Decode the answer to a request of registers.

    Raises
    ------
    RefusedError
        If the device reports an exception.
    ProtocolError
        If it is not an answer to this request.

    Examples
    --------
    >>> decode_registers(bytes.fromhex("03 04 00 c8 01 c2"), HOLDING, 2)
    (200, 450)
    >>> decode_registers(bytes.fromhex("83 02"), HOLDING, 2)
    Traceback (most recent call last):
    reseau.core.errors.RefusedError: refused the request: illegal data address
    """
    if len(pdu) == 2 and pdu[0] == function | _ERROR:
        raise RefusedError(f"refused the request: {EXCEPTIONS.get(pdu[1], f'exception {pdu[1]}')}")
    if len(pdu) != 2 + 2 * count or pdu[0] != function or pdu[1] != 2 * count:
        raise ProtocolError(f"not an answer with {count} registers: {excerpt(pdu)}")
    return struct.unpack(f">{count}H", pdu[2:])


def encode_exception(function: int, code: int) -> bytes:
    """Encode the answer that refuses a request."""
    return bytes([function | _ERROR, code])


def encode_echo(value: int) -> bytes:
    """Encode the diagnostic request that is sent back as it is (function 8, sub-function 0)."""
    return struct.pack(">BHH", DIAGNOSTICS, 0, value)


def number(words: Sequence[int], kind: str, order: WordOrder = "big") -> float:
    """Return the number in some registers.

    Examples
    --------
    >>> number((0x41AC, 0x0000), "float32"), number((0xFFF6,), "int16"), number((1, 0), "uint32", "little")
    (21.5, -10.0, 1.0)
    """
    ordered = words if order == "big" else tuple(reversed(words))
    return float(struct.unpack(FORMATS[kind], struct.pack(f">{len(ordered)}H", *ordered))[0])


def words_of(value: float, kind: str, order: WordOrder = "big") -> tuple[int, ...]:
    """Return the registers of a number: the reverse of :func:`number`.

    Examples
    --------
    >>> [hex(word) for word in words_of(21.5, "float32")]
    ['0x41ac', '0x0']
    """
    form = FORMATS[kind]
    data = struct.pack(form, value if form[1] in "fd" else round(value))
    words = struct.unpack(f">{len(data) // 2}H", data)
    return words if order == "big" else tuple(reversed(words))


class _Decoder:
    """Decode frames from a stream; what is none is skipped up to the next one."""

    def __init__(
        self,
        size: Callable[[bytes], int | None],
        frame: Callable[[bytes], Frame | None],
        at: int,
        possible: frozenset[int],
    ) -> None:
        self._size, self._frame = size, frame
        # What the byte at a place of a frame can be: noise is skipped fast.
        self._at, self._possible = at, possible
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete frame."""
        self._held = bytearray()

    def feed(self, data: bytes) -> list[Frame | Damaged]:
        """Return the frames that these bytes complete."""
        found: list[Frame | Damaged] = []
        self._held += data
        held, at, skipped = bytes(self._held), 0, 0
        while at < len(held):
            if at + self._at < len(held) and held[at + self._at] not in self._possible:
                at, skipped = at + 1, skipped + 1
                continue
            size = self._size(held[at : at + 8])
            if size is None or (size > 0 and len(held) - at < size):
                break  # incomplete
            frame = self._frame(held[at : at + size]) if size else None
            if frame is None:
                at, skipped = at + 1, skipped + 1
                continue
            if skipped:
                found.append(self._damaged(at, skipped))
            found.append(frame)
            at, skipped = at + size, 0
        if skipped:
            found.append(self._damaged(at, skipped))
        del self._held[:at]
        return found

    def _damaged(self, at: int, count: int) -> Damaged:
        return Damaged(bytes(self._held[at - count : at][:60]), "not a frame of Modbus, or a wrong checksum")


class RtuDecoder(_Decoder):
    """Decode frames of a serial line.

    Parameters
    ----------
    requests : bool
        Whether these are requests; otherwise answers.

    Examples
    --------
    >>> decoder = RtuDecoder()
    >>> answer = encode(Frame(1, encode_registers(INPUT, (215,))))
    >>> decoder.feed(answer[:3]), decoder.feed(answer[3:])[0].pdu.hex(" ")
    ([], '04 02 00 d7')
    >>> decoder.feed(answer[:-1] + b"?")[0].why
    'not a frame of Modbus, or a wrong checksum'
    """

    def __init__(self, requests: bool = False) -> None:
        super().__init__(_request_size if requests else _answer_size, _rtu_frame, 1, _FUNCTIONS)


class TcpDecoder(_Decoder):
    """Decode frames of a TCP connection.

    Examples
    --------
    >>> TcpDecoder().feed(encode(Frame(1, encode_registers(INPUT, (215,)), 7)))
    [Frame(unit=1, pdu=b'\\x04\\x02\\x00\\xd7', transaction=7)]
    """

    def __init__(self) -> None:
        super().__init__(_tcp_size, _tcp_frame, 2, frozenset({0}))


def _answer_size(head: bytes) -> int | None:
    """Size of an answer that begins so; 0 if none does, None if more bytes are needed."""
    if len(head) < 2:
        return None
    function = head[1]
    if function & _ERROR:
        return 5
    if function in _BY_COUNT:
        return None if len(head) < 3 else 5 + head[2]
    return 8 if function in (5, 6, DIAGNOSTICS, 15, 16) else 0


def _request_size(head: bytes) -> int | None:
    if len(head) < 2:
        return None
    if head[1] in (15, 16):
        return None if len(head) < 7 else 9 + head[6]
    if head[1] == 17:
        return 4
    return 8 if head[1] in (1, 2, 3, 4, 5, 6, DIAGNOSTICS) else 0


def _rtu_frame(data: bytes) -> Frame | None:
    return Frame(data[0], data[1:-2]) if crc(data[:-2]) == data[-2:] else None


def _tcp_size(head: bytes) -> int | None:
    if len(head) < 6:
        return None
    _, protocol, length = struct.unpack(">HHH", head[:6])
    return 6 + length if protocol == 0 and 2 <= length <= 254 else 0


def _tcp_frame(data: bytes) -> Frame | None:
    return Frame(data[6], data[7:], struct.unpack(">H", data[:2])[0])
