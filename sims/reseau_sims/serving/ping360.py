"""Simulated Ping360: a rotating head that sends pulses and reports their echoes.

Source: *Ping Protocol*, "Common Messages" and "Ping360 Messages", with the ranges of their fields.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reseau_drivers.codecs import ping
from reseau_drivers.codecs.stream import Damaged

from .faults import Kind
from .machine import Machine

Echo = Callable[[int, int, float, float], NDArray[np.uint8]]
_GAINS = (0.5, 1.0, 2.0)


def _silence(angle: int, samples: int, period_s: float, gain: float) -> NDArray[np.uint8]:
    """Test echoes that encode the angle."""
    return np.full(samples, angle % 256, np.uint8)


class Ping360(Machine):
    """Simulated sonar.

    Parameters
    ----------
    echo : callable
        Echoes of a pulse, given angle (gradians), number of samples, sample period (s), and gain factor.

    Examples
    --------
    >>> answers = Ping360().receive(ping.encode(ping.Transducer(1, 7, 32, 80, 740, 200).frame()))
    >>> frame = ping.FrameDecoder().feed(answers[0])[0]
    >>> set(ping.DeviceData.parse(frame.payload).samples)
    {7}
    """

    def __init__(self, echo: Echo = _silence) -> None:
        super().__init__()
        self._echo, self._frames = echo, ping.FrameDecoder()
        self.motor_on, self._stuck, self._refuse, self._wrong_size = False, False, False, False
        self.last = ping.DeviceData(ping.Transducer(0, 0, 32, 80, 740, 200), bytes(200))
        self._scan: tuple[ping.Transducer, ping.Sector, int] | None = None
        self._next = 0.0

    @property
    def due(self) -> float | None:
        """Time of the next pulse of an automatic scan."""
        return None if self._scan is None else self._next

    def emit(self) -> Sequence[bytes]:
        """Return the echoes of the pulse that is due, and rotate the head."""
        if self._scan is None or time.monotonic() < self._next:
            return ()
        asked, sector, way = self._scan
        self.last = ping.DeviceData(asked, self._heard(asked))
        angle, way = sector.next(asked.angle, way)
        self._scan = replace(asked, angle=angle), sector, way
        self._next = time.monotonic() + self._seconds(asked) + sector.delay_ms * 1e-3
        return (ping.encode(ping.ScanData(self.last, sector).frame()),)

    @staticmethod
    def _seconds(asked: ping.Transducer) -> float:
        return asked.duration_us * 1e-6 + asked.samples * asked.period * ping.PERIOD_NS * 1e-9

    def _heard(self, asked: ping.Transducer) -> bytes:
        period = asked.period * ping.PERIOD_NS * 1e-9
        return self._echo(asked.angle, asked.samples, period, _GAINS[asked.gain]).tobytes()

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the messages in answer."""
        answers: list[bytes] = []
        for frame in self._frames.feed(data):
            if isinstance(frame, Damaged):
                # A single U after a break is used by the instrument to detect the baud rate.
                if frame.data == b"U":
                    continue
                self.violations.append(str(frame))
            else:
                answer = self._obey(frame)
                if answer is not None:
                    answers.append(ping.encode(answer))
        return answers

    def disconnected(self) -> None:
        """Discard an incomplete message, and end an automatic scan."""
        self._frames.reset()
        self._scan = None

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: the head does not rotate; wrong state: it refuses; out of range: too many samples."""
        self._stuck = self._stuck or kind == "stuck"
        self._refuse = self._refuse or kind == "wrong state"
        self._wrong_size = self._wrong_size or kind == "out of range"
        if kind == "power-cycled":
            self.motor_on = self._stuck = self._refuse = self._wrong_size = False
            self.last = ping.DeviceData(ping.Transducer(0, 0, 32, 80, 740, 200), bytes(200))

    def _obey(self, frame: ping.Frame) -> ping.Frame | None:
        if frame.id == ping.AUTO_TRANSMIT and len(frame.payload) == ping.SCAN.size:
            return self._begin_scan(*ping.Sector.parse(frame.payload))
        if frame.id != ping.GENERAL_REQUEST:
            self._scan = None
        if frame.id == ping.RESET and len(frame.payload) == 2:
            self.inject_fault("power-cycled")
            return ping.Frame(ping.ACK, struct.pack("<H", frame.id), 1)
        if frame.id == ping.GENERAL_REQUEST and len(frame.payload) == 2:
            return self._tell(int.from_bytes(frame.payload, "little"))
        if frame.id == ping.TRANSDUCER and len(frame.payload) == 14:
            return self._ping(ping.Transducer.parse(frame.payload))
        if frame.id == ping.MOTOR_OFF:
            self.motor_on = self._stuck = self._refuse = self._wrong_size = False
            return ping.Frame(ping.ACK, struct.pack("<H", frame.id), 1)
        return self._no(frame.id, "unknown message")

    def _no(self, id_: int, why: str) -> ping.Frame:
        self.violations.append(f"message {id_}: {why}")
        return ping.Frame(ping.NACK, struct.pack("<H", id_) + why.encode() + b"\0", 1)

    def _tell(self, id_: int) -> ping.Frame:
        match id_:
            case ping.PROTOCOL_VERSION:
                return ping.Frame(id_, bytes([1, 0, 0, 0]), 1)
            case ping.DEVICE_INFORMATION:
                return ping.Information(2, 1, (3, 1, 1)).frame()
            case ping.DEVICE_DATA:
                return self.last.frame()
            case ping.DEVICE_ID:
                return ping.Frame(id_, bytes([1, 0]), 1)
        return self._no(id_, "unknown request")

    @staticmethod
    def _within(asked: ping.Transducer) -> bool:
        # The vendor's client sends 0 as the mode with `transmitAngle`.
        return (
            asked.mode in (0, 1)
            and asked.gain in (0, 1, 2)
            and asked.angle < ping.GRADIANS
            and 1 <= asked.duration_us <= 1000
            and 80 <= asked.period <= 40000
            and 500 <= asked.frequency_khz <= 1000
            and 200 <= asked.samples <= 1200
        )

    def _begin_scan(self, asked: ping.Transducer, sector: ping.Sector) -> ping.Frame | None:
        """Begin a scan; its lines are sent without request."""
        if not self._within(asked) or sector.stop >= ping.GRADIANS or not 1 <= sector.steps <= 10:
            return self._no(ping.AUTO_TRANSMIT, "parameter out of range")
        self.motor_on, self._next = True, time.monotonic()
        self._scan = replace(asked, mode=1), sector, 1
        return None

    def _ping(self, asked: ping.Transducer) -> ping.Frame:
        within = self._within(asked)
        if not within:
            return self._no(ping.TRANSDUCER, "parameter out of range")
        if self._refuse:
            self._refuse = False
            return ping.Frame(ping.NACK, struct.pack("<H", ping.TRANSDUCER) + b"busy\0", 1)
        self.motor_on = True
        angle = self.last.settings.angle if self._stuck else asked.angle
        settings = ping.Transducer(
            asked.gain, angle, asked.duration_us, asked.period, asked.frequency_khz, asked.samples, False
        )
        if not asked.transmit:
            return ping.DeviceData(settings, b"").frame()
        samples = self._heard(settings)
        if self._wrong_size:
            self._wrong_size, samples = False, samples + bytes(300)
        self.last = ping.DeviceData(settings, samples)
        return self.last.frame()
