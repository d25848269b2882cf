"""Blue Robotics' Ping protocol, and the messages of the scanning sonar Ping360.

Source: *Ping Protocol*, "Message Format", "Common Messages" and "Ping360 Messages". A frame consists of
``BR``, length of the payload, number of the message, sender and receiver, payload, and the sum of all these
bytes, little-endian. Angles are in gradians (400 per turn), sample periods in units of 25 ns.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Self

from reseau.core.errors import ProtocolError, SettingError

from .stream import Damaged

ACK, NACK, ASCII_TEXT, DEVICE_INFORMATION, PROTOCOL_VERSION, GENERAL_REQUEST = 1, 2, 3, 4, 5, 6
DEVICE_ID, DEVICE_DATA, AUTO_DEVICE_DATA = 2000, 2300, 2301
RESET, TRANSDUCER, AUTO_TRANSMIT, MOTOR_OFF = 2600, 2601, 2602, 2903
GRADIANS = 400
"""Gradians per turn of the head."""
PERIOD_NS = 25.0
"""Unit of the sample period (ns)."""
MAX_PAYLOAD = 2048
"""Longer than any message of these devices; a greater length is noise."""

_HEAD = struct.Struct("<2sHHBB")
_TRANSDUCER = struct.Struct("<BBHHHHHBB")
_DATA = struct.Struct("<BBHHHHH")
SCAN = struct.Struct("<BBHHHHHHBB")
"""Payload of AUTO_TRANSMIT."""
_SCAN_DATA = struct.Struct("<BBHHHHHHBBH")
_VECTOR = struct.Struct("<H")
_INFORMATION = struct.Struct("<BBBBBB")


@dataclass(frozen=True)
class Frame:
    """One message.

    Parameters
    ----------
    id : int
        Number of the message type.
    payload : bytes
        Content.
    source, target : int
        Numbers of the devices.
    """

    id: int
    payload: bytes = b""
    source: int = 0
    target: int = 0


def encode(frame: Frame) -> bytes:
    r"""Encode a frame.

    Raises
    ------
    SettingError
        If the payload is too long.

    Examples
    --------
    >>> encode(Frame(GENERAL_REQUEST, b"\x05\x00")).hex(" ")
    '42 52 02 00 06 00 00 00 05 00 a1 00'
    """
    if len(frame.payload) > MAX_PAYLOAD:
        raise SettingError(f"is longer than {MAX_PAYLOAD} bytes", where="payload of a Ping frame")
    body = _HEAD.pack(b"BR", len(frame.payload), frame.id, frame.source, frame.target) + frame.payload
    return body + _VECTOR.pack(sum(body) & 0xFFFF)


class FrameDecoder:
    """Decode frames from a stream; data between them are skipped and reported."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard an incomplete frame."""
        self._partial = bytearray()

    def feed(self, data: bytes) -> list[Frame | Damaged]:
        """Return the frames that these bytes complete."""
        found: list[Frame | Damaged] = []
        begun = self._partial
        begun += data
        while True:
            self._skip_to_start(found)
            if len(begun) < _HEAD.size:
                return found
            _, length, id_, source, target = _HEAD.unpack_from(begun)
            if length > MAX_PAYLOAD:
                self._give_up(found, f"a frame of {length} bytes")
                continue
            end = _HEAD.size + length
            if len(begun) < end + 2:
                return found
            if _VECTOR.unpack_from(begun, end)[0] != sum(begun[:end]) & 0xFFFF:
                # The length may be wrong: the next frame may start within this one.
                self._give_up(found, "a frame with a wrong checksum")
                continue
            found.append(Frame(id_, bytes(begun[_HEAD.size : end]), source, target))
            del begun[: end + 2]

    def _skip_to_start(self, found: list[Frame | Damaged]) -> None:
        start = self._partial.find(b"BR")
        if start < 0:
            start = len(self._partial) - (self._partial[-1:] == b"B")
        if start > 0:
            if not found or not isinstance(found[-1], Damaged):
                found.append(Damaged(bytes(self._partial[: min(start, 60)]), f"{start} bytes between frames"))
            del self._partial[:start]

    def _give_up(self, found: list[Frame | Damaged], why: str) -> None:
        # Report consecutive damaged data once: noise can look like thousands of frames.
        if not found or not isinstance(found[-1], Damaged):
            found.append(Damaged(bytes(self._partial[:60]), why))
        del self._partial[:2]


def _unpacked(layout: struct.Struct, payload: bytes, what: str) -> tuple[int, ...]:
    if len(payload) < layout.size:
        raise ProtocolError(f"{what} of {len(payload)} bytes; {layout.size} were expected")
    return layout.unpack_from(payload)


@dataclass(frozen=True)
class Transducer:
    """Parameters that TRANSDUCER requests and DEVICE_DATA repeats.

    Parameters
    ----------
    gain : int
        0 low, 1 normal, 2 high.
    angle : int
        Angle of the head (gradians).
    duration_us : int
        Duration of the transmitted pulse (µs).
    period : int
        Sample period, in units of 25 ns.
    frequency_khz : int
        Frequency of the pulse (kHz).
    samples : int
        Number of samples.
    transmit : bool
        Whether a pulse is sent.
    mode : int
        1 for a Ping360.
    """

    gain: int
    angle: int
    duration_us: int
    period: int
    frequency_khz: int
    samples: int
    transmit: bool = True
    mode: int = 1

    def frame(self, target: int = 0) -> Frame:
        """Return the request message.

        Raises
        ------
        SettingError
            If a value does not fit its field.
        """
        try:
            payload = _TRANSDUCER.pack(*self._common, int(self.transmit), 0)
        except struct.error as error:
            raise SettingError(f"does not fit ({error})", where="TRANSDUCER") from None
        return Frame(TRANSDUCER, payload, 0, target)

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Decode a TRANSDUCER message.

        Raises
        ------
        ProtocolError
            If it is too short.
        """
        mode, *rest, transmit, _ = _unpacked(_TRANSDUCER, payload, "a TRANSDUCER message")
        gain, angle, duration, period, frequency, samples = rest
        return cls(gain, angle, duration, period, frequency, samples, bool(transmit), mode)

    @property
    def _common(self) -> tuple[int, ...]:
        return (
            self.mode,
            self.gain,
            self.angle,
            self.duration_us,
            self.period,
            self.frequency_khz,
            self.samples,
        )


@dataclass(frozen=True)
class DeviceData:
    """One line of echoes: acquisition parameters and samples."""

    settings: Transducer
    samples: bytes

    def frame(self, source: int = 1) -> Frame:
        """Return the message that reports it."""
        head = _DATA.pack(*self.settings._common)
        return Frame(DEVICE_DATA, head + _VECTOR.pack(len(self.samples)) + self.samples, source, 0)

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Decode a DEVICE_DATA message.

        Raises
        ------
        ProtocolError
            If it is too short, or its number of samples is wrong.
        """
        mode, *rest = _unpacked(_DATA, payload, "a DEVICE_DATA message")
        (count,) = _unpacked(_VECTOR, payload[_DATA.size :], "the vector of a DEVICE_DATA message")
        samples = payload[_DATA.size + _VECTOR.size :]
        if len(samples) != count:
            raise ProtocolError(f"DEVICE_DATA announces {count} samples and contains {len(samples)}")
        gain, angle, duration, period, frequency, number = rest
        asked = Transducer(gain, angle, duration, period, frequency, number, False, mode)
        return cls(asked, samples)


@dataclass(frozen=True)
class Sector:
    """What AUTO_TRANSMIT scans: angles and steps in gradians, a pause after each pulse in ms.

    Examples
    --------
    >>> settings, sector = Sector.parse(SCAN.pack(1, 0, 32, 80, 740, 200, 10, 20, 2, 0))
    >>> settings.samples, sector.next(20, 1), sector.next(398, 1)
    (200, (18, -1), (20, -1))
    """

    start: int
    stop: int
    steps: int
    delay_ms: int

    @classmethod
    def parse(cls, payload: bytes) -> tuple[Transducer, Self]:
        """Decode an AUTO_TRANSMIT message.

        Raises
        ------
        ProtocolError
            If it is too short.
        """
        mode, gain, duration, period, frequency, samples, *rest = _unpacked(
            SCAN, payload, "an AUTO_TRANSMIT message"
        )
        start, stop, steps, delay = rest
        settings = Transducer(gain, start, duration, period, frequency, samples, True, mode)
        return settings, cls(start, stop, steps, delay)

    def next(self, angle: int, way: int) -> tuple[int, int]:
        """Return the angle of the next pulse and the sense of rotation; a full turn does not reverse."""
        if (self.stop - self.start) % GRADIANS == GRADIANS - 1:
            return (angle + self.steps) % GRADIANS, way
        width = (self.stop - self.start) % GRADIANS
        at = (angle - self.start) % GRADIANS + way * self.steps
        if not 0 <= at <= width:
            way = -way
            at = min(max((angle - self.start) % GRADIANS + way * self.steps, 0), width)
        return (self.start + at) % GRADIANS, way


@dataclass(frozen=True)
class ScanData:
    """One line of echoes of an automatic scan."""

    data: DeviceData
    sector: Sector

    def frame(self, source: int = 1) -> Frame:
        """Return the message that reports it."""
        asked, sector = self.data.settings, self.sector
        head = _SCAN_DATA.pack(
            asked.mode, asked.gain, asked.angle, asked.duration_us, asked.period, asked.frequency_khz,
            sector.start, sector.stop, sector.steps, sector.delay_ms, asked.samples,
        )  # fmt: skip
        samples = self.data.samples
        return Frame(AUTO_DEVICE_DATA, head + _VECTOR.pack(len(samples)) + samples, source, 0)


@dataclass(frozen=True)
class Information:
    """DEVICE_INFORMATION; type 2 is a Ping360."""

    type: int
    revision: int
    firmware: tuple[int, int, int]

    def frame(self, source: int = 1) -> Frame:
        """Return the message that reports it."""
        return Frame(
            DEVICE_INFORMATION, _INFORMATION.pack(self.type, self.revision, *self.firmware, 0), source
        )

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Decode a DEVICE_INFORMATION message.

        Raises
        ------
        ProtocolError
            If it is too short.
        """
        kind, revision, major, minor, patch, _ = _unpacked(
            _INFORMATION, payload, "a DEVICE_INFORMATION message"
        )
        return cls(kind, revision, (major, minor, patch))
