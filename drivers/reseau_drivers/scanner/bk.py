"""BK scanners through their OEM interface: B-mode frames with the millimetres that the scanner states.

Source: *BK Ultrasound OEM Interface*, "QUERY". The window of the section is told twice, in pixels and in
metres; their quotient is the size of a pixel. A window that is told wrongly gives no millimetres rather than
wrong ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from reseau.errors import ProtocolError, RefusedError
from reseau.instruments import BScan, Deadline, Device, Identity, Limits, Settings, quantity
from reseau.instruments.values import now

from ..codecs import bk
from ..codecs.stream import shown
from ..link import Conversation, Link

__all__ = ["BkScanner", "BkSettings"]

_LARGEST_SIDE = 8192
_ON, _OFF = b'QUERY:GRAB_FRAME "ON",20;', b'QUERY:GRAB_FRAME "OFF",20;'


@dataclass(frozen=True)
class BkSettings(Settings):
    """What the interface does not tell and the calibration needs; set on the scanner by hand."""

    speed_m_s: float = quantity(1540.0, "m/s", 1000.0, 2500.0)
    frequency_khz: float = quantity(6000.0, "kHz", 500.0, 30_000.0)
    gain: float = quantity(50.0, "%", 0.0, 100.0)


class BkScanner(Device[BkSettings]):
    """The scanner.

    Parameters
    ----------
    name : str
        On the bench.
    link : Link
        To its port 7915.
    settings : BkSettings
        What it is set to.
    seconds : float
        Deadline of calls that name none.
    limits : mapping, optional
        Of settings.
    """

    def __init__(
        self,
        name: str,
        link: Link,
        settings: BkSettings | None = None,
        *,
        seconds: float = 5.0,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or BkSettings(), seconds=seconds, limits=limits)
        self._talk: Conversation[bytes] = Conversation(link, bk.MessageDecoder())

    def _open(self, deadline: Deadline) -> None:
        self._talk.open(deadline)
        # Frames may still come that another session asked for.
        self._ask(_OFF, b"ACK", deadline)

    def _shut(self) -> None:
        self._talk.close()

    def _push(self, settings: BkSettings, deadline: Deadline) -> None:
        """Nothing to send: the interface reads."""

    def _identify(self, deadline: Deadline) -> Identity:
        width, height = self._window(deadline)
        return Identity("BK Medical", f"OEM interface, {width}×{height} px")

    def _halt(self, deadline: Deadline) -> None:
        self._ask(_OFF, b"ACK", deadline)

    def _acquire(self) -> dict[str, Any]:
        scan = self.scan()
        mm = scan.mm_per_px or (float("nan"), float("nan"))
        return {f"{self.name}_section": scan.pixels, f"{self.name}_mm_per_px": list(mm)}

    def _kinds(self) -> dict[str, dict[str, Any]]:
        with self._exchange("window") as deadline:
            width, height = self._window(deadline)
        return {
            f"{self.name}_section": {"dtype": "array", "shape": [height, width]},
            f"{self.name}_mm_per_px": {"dtype": "array", "shape": [2], "units": "mm"},
        }

    def scan(self, seconds: float | None = None) -> BScan:
        """One frame, with the millimetres of the moment.

        Raises
        ------
        InstrumentError
            When no whole frame came.
        """
        with self._exchange("scan", seconds) as deadline:
            asked = now()
            width, height = self._window(deadline)
            mm, origin = self._geometry(width, height, deadline)
            grabbed = bk.parse_frame(self._ask(_ON, b"DATA:GRAB_FRAME ", deadline))
            self._ask(_OFF, b"ACK", deadline)
            if len(grabbed.pixels) != width * height:
                raise ProtocolError(
                    f"a frame of {len(grabbed.pixels)} bytes; {width}×{height} were announced"
                )
            pixels = np.frombuffer(grabbed.pixels, np.uint8).reshape(height, width)
            s = self.settings
            return BScan(pixels, mm, origin, s.speed_m_s, s.frequency_khz, s.gain, asked)

    def _window(self, deadline: Deadline) -> tuple[int, int]:
        size = bk.numbers(self._ask(b"QUERY:US_WIN_SIZE;", b"DATA:US_WIN_SIZE ", deadline), "US_WIN_SIZE")
        if len(size) != 2 or not all(2 <= side <= _LARGEST_SIDE and side == int(side) for side in size):
            raise ProtocolError(f"states a window of {size}")
        return int(size[0]), int(size[1])

    def _geometry(
        self, width: int, height: int, deadline: Deadline
    ) -> tuple[tuple[float, float] | None, tuple[float, float]]:
        """Millimetres of a pixel, and where the middle of the transducer's face is."""
        names = ("B_GEOMETRY_PIXEL:A", "B_GEOMETRY_TISSUE:A")
        windows = [
            bk.numbers(self._ask(f"QUERY:{name};".encode(), f"DATA:{name} ".encode(), deadline), name)
            for name in names
        ]
        if any(len(window) != 4 for window in windows):
            raise ProtocolError(f"states a geometry of {windows}")
        (left, top, right, bottom), (x0, y0, x1, y1) = windows
        within = min(left, right) >= 0 and max(left, right) <= width
        within = within and min(top, bottom) >= 0 and max(top, bottom) <= height
        origin = ((left + right - 1) / 2, top)
        if not within or left == right or top == bottom or x0 == x1 or y0 == y1:
            return None, origin
        return (abs((x1 - x0) / (right - left)) * 1000, abs((y1 - y0) / (bottom - top)) * 1000), origin

    def _ask(self, question: bytes, head: bytes, deadline: Deadline) -> bytes:
        answer = self._talk.ask(bk.encode(question), lambda got: got.startswith((head, b"ERROR")), deadline)
        if answer.startswith(b"ERROR"):
            raise RefusedError(f"refused: {shown(answer)}", command=question.decode())
        return answer
