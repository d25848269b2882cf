"""Blue Robotics Ping360: a rotating head; its lines of echoes are resampled to a section in millimetres.

Source: *Ping Protocol*, "Ping360 Messages". Sample k with the period T is at the distance (k + ½)·c·T/2.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.core.errors import DeadlineError, ProtocolError, RefusedError, StateError
from reseau.instruments import BScan, Deadline, Device, Identity, Limits, Settings, quantity

from ..codecs import ping
from ..link import Link, MessageLink

_SHORTEST = 80
"""Shortest sample period of the instrument, in units of 25 ns."""
_ROWS = 400
"""Largest number of rows of a section."""


@dataclass(frozen=True)
class Ping360Settings(Settings):
    """Geometry and transmission of a section; angles in gradians (400 per turn).

    Examples
    --------
    >>> settings = Ping360Settings(range_mm=1000.0, half_sector=2)
    >>> settings.angles, round(settings.mm_per_sample, 1)
    ((-2, -1, 0, 1, 2), 5.0)
    """

    range_mm: float = quantity(150.0, "mm", 10.0, 60_000.0)
    speed_m_s: float = quantity(1540.0, "m/s", 1000.0, 2500.0)
    frequency_khz: int = quantity(740, "kHz", 500, 1000)
    gain: int = quantity(1, "", 0, 2)
    duration_us: int = quantity(32, "µs", 1, 1000)
    samples: int = quantity(200, "", 200, 1200)
    middle: int = quantity(200, "grad", 0, 399)
    half_sector: int = quantity(60, "grad", 1, 100)
    step: int = quantity(1, "grad", 1, 10)

    @property
    def period(self) -> int:
        """Sample period in units of 25 ns: the shortest that covers the range, below 1 ms."""
        seconds = 2 * self.range_mm * 1e-3 / self.speed_m_s / self.samples
        return max(_SHORTEST, int(np.ceil(seconds * 1e9 / ping.PERIOD_NS)))

    @property
    def mm_per_sample(self) -> float:
        """Depth per sample (mm)."""
        return self.speed_m_s * 1e3 * self.period * ping.PERIOD_NS * 1e-9 / 2

    @property
    def angles(self) -> tuple[int, ...]:
        """Angles of the head relative to the middle, in order (gradians)."""
        return tuple(range(-self.half_sector, self.half_sector + 1, self.step))


class Ping360(Device[Ping360Settings]):
    """Driver of a Ping360.

    Parameters
    ----------
    name : str
        Name on the bench.
    link : Link
        Link to the instrument.
    settings : Ping360Settings
        Geometry and transmission.
    seconds : float
        Time limit of calls that do not specify one (s); in a scan, the limit of each line.
    answer_s : float
        Time limit of a line (s): the head may have to rotate by half a turn first.
    limits : mapping, optional
        Limits of settings.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> Ping360("sonar", link_to("/dev/ttyUSB2")).settings.frequency_khz
    740
    """

    def __init__(
        self,
        name: str,
        link: Link,
        settings: Ping360Settings | None = None,
        *,
        seconds: float = 5.0,
        answer_s: float = 4.0,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or Ping360Settings(), seconds=seconds, limits=limits)
        self._link: MessageLink[ping.Frame] = MessageLink(link, ping.FrameDecoder())
        self._answer_s = answer_s

    def _open(self, deadline: Deadline) -> None:
        self._link.open(deadline)
        # Lines have no number but arrive in order: after this answer no old one is left.
        self._request(ping.DEVICE_INFORMATION, deadline)

    def _disconnect(self) -> None:
        self._link.close()

    def _push(self, settings: Ping360Settings, deadline: Deadline) -> None:
        """Do nothing: every line is requested with its settings."""

    def _identify(self, deadline: Deadline) -> Identity:
        found = ping.Information.parse(self._request(ping.DEVICE_INFORMATION, deadline).payload)
        if found.type != 2:
            raise ProtocolError(f"has device type {found.type} and is not a Ping360", do="check the address")
        return Identity("Blue Robotics", "Ping360", "", ".".join(map(str, found.firmware)))

    def _halt(self, deadline: Deadline) -> None:
        self._confirmed(ping.Frame(ping.MOTOR_OFF), deadline)

    def _acquire(self) -> dict[str, Any]:
        scan = self.scan()
        return {f"{self.name}_section": scan.pixels, f"{self.name}_mm_per_px": list(scan.mm_per_px or ())}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        height, width = _raster(self.settings)[1]
        return {
            f"{self.name}_section": {"dtype": "array", "shape": [height, width]},
            f"{self.name}_mm_per_px": {"dtype": "array", "shape": [2], "units": "mm"},
        }

    def _test(self, deadline: Deadline) -> dict[str, str]:
        line = self.line(0, deadline.left)
        return {"line": f"{len(line)} samples, mean {line.mean():.1f}"}

    def line(self, angle: int, seconds: float | None = None) -> NDArray[np.uint8]:
        """Return the echoes of one pulse.

        Parameters
        ----------
        angle : int
            Angle of the head relative to the middle of the sector (gradians).
        seconds : float, optional
            Time limit (s).

        Raises
        ------
        StateError
            If the head is at another angle.
        RefusedError
            If the instrument rejects the request.
        InstrumentError
            If no line arrives.
        """
        s = self.settings
        head = (s.middle + angle) % ping.GRADIANS
        asked = ping.Transducer(s.gain, head, s.duration_us, s.period, s.frequency_khz, s.samples)
        with self._exchange(f"line at {head} grad", seconds) as deadline:
            return self._line(asked, deadline.part(self._answer_s))

    def scan(self, seconds: float | None = None) -> BScan:
        """Return one section; :class:`Ping360Settings` defines what it covers.

        Raises
        ------
        InstrumentError
            If a line is missing, the time limit is exceeded, or the scan was stopped.
        """
        s = self.settings
        deadline = Deadline(self._answer_s * len(s.angles) if seconds is None else seconds)
        self._begin("scan")
        lines = []
        for angle in s.angles:
            self._require_unstopped("scan")
            if deadline.expired:
                raise DeadlineError(
                    f"did not finish within {deadline.seconds:g} s", where=self.name, command="scan"
                )
            lines.append(self.line(angle, max(0.05, deadline.at_most(self._seconds))))
        pixels, mm, origin = _section(np.array(lines), s)
        return BScan(pixels, (mm, mm), origin, s.speed_m_s, float(s.frequency_khz), float(s.gain))

    def _line(self, asked: ping.Transducer, deadline: Deadline) -> NDArray[np.uint8]:
        others: list[ping.DeviceData] = []

        def answers(frame: ping.Frame) -> bool:
            if _nacks(frame, ping.TRANSDUCER):
                return True
            if frame.id != ping.DEVICE_DATA:
                return False
            data = ping.DeviceData.parse(frame.payload)
            if _same(data, asked):
                return True
            others.append(data)
            return False

        try:
            frame = self._link.query(ping.encode(asked.frame()), answers, deadline)
        except DeadlineError:
            if not others:
                raise
            last = others[-1]
            raise StateError(
                f"reports {len(last.samples)} samples at {last.settings.angle} grad, not as requested",
                do="check that the head turns freely",
            ) from None
        if frame.id == ping.NACK:
            raise RefusedError(_reason(frame))
        return np.frombuffer(ping.DeviceData.parse(frame.payload).samples, np.uint8)

    def _request(self, id_: int, deadline: Deadline) -> ping.Frame:
        asked = ping.Frame(ping.GENERAL_REQUEST, struct.pack("<H", id_))
        frame = self._link.query(
            ping.encode(asked),
            lambda frame: frame.id == id_ or _nacks(frame, id_),
            deadline.part(self._answer_s),
        )
        if frame.id == ping.NACK:
            raise RefusedError(_reason(frame))
        return frame

    def _confirmed(self, frame: ping.Frame, deadline: Deadline) -> None:
        acked = ping.Frame(ping.ACK, struct.pack("<H", frame.id))
        answer = self._link.query(
            ping.encode(frame),
            lambda got: (got.id, got.payload) == (acked.id, acked.payload) or _nacks(got, frame.id),
            deadline.part(self._answer_s),
        )
        if answer.id == ping.NACK:
            raise RefusedError(_reason(answer))


def _same(data: ping.DeviceData, asked: ping.Transducer) -> bool:
    got = data.settings
    return len(data.samples) == asked.samples and (
        (got.angle, got.gain, got.duration_us, got.period, got.frequency_khz)
        == (asked.angle, asked.gain, asked.duration_us, asked.period, asked.frequency_khz)
    )


def _nacks(frame: ping.Frame, id_: int) -> bool:
    return frame.id == ping.NACK and frame.payload[:2] == struct.pack("<H", id_)


def _reason(frame: ping.Frame) -> str:
    return f"refused: {frame.payload[2:].rstrip(bytes(1)).decode('ascii', 'replace') or 'no reason given'}"


def _raster(s: Ping360Settings) -> tuple[float, tuple[int, int]]:
    """Return the pixel size (mm), and height and width of the section (px)."""
    depth = s.samples * s.mm_per_sample
    mm = depth / _ROWS
    half = int(np.ceil(depth * np.sin(min(np.pi / 2, _radians(s.half_sector))) / mm))
    return mm, (int(np.ceil(depth / mm)), 2 * half + 1)


def _radians(gradians: float) -> float:
    return float(gradians) * 2 * np.pi / ping.GRADIANS


def _section(
    lines: NDArray[np.uint8], s: Ping360Settings
) -> tuple[NDArray[np.uint8], float, tuple[float, float]]:
    """Resample lines by angle to square pixels; pixels outside the sector are 0."""
    mm, (height, width) = _raster(s)
    x: Array = (np.arange(width, dtype=np.float64) - (width - 1) / 2) * mm
    y: Array = np.arange(height, dtype=np.float64) * mm
    distance, angle = np.hypot(x[None, :], y[:, None]), np.arctan2(x[None, :], np.maximum(y[:, None], 1e-9))
    sample = distance / s.mm_per_sample - 0.5
    row = (angle - _radians(s.angles[0])) / _radians(s.step)
    pixels = cv2.remap(
        lines,
        sample.astype(np.float32),
        row.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return pixels.astype(np.uint8), mm, ((width - 1) / 2, 0.0)
