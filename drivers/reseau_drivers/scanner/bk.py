"""BK scanners through their OEM interface: B-mode frames with the pixel size that the scanner reports.

Source: PLUS's ``vtkPlusBkProFocusOemVideoSource``, which was tested on the instruments, and BK's document
PS12640-44. The scanner reports the section twice: as a box in pixels of the grabbed frame (last pixels
included) and in metres of tissue. The pixel size is their quotient. If the box exceeds the frame, no pixel
size is returned rather than a wrong one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from reseau.core.errors import ProtocolError, RefusedError, SettingError
from reseau.instruments import BScan, Deadline, Device, Identity, Limits, Settings, quantity
from reseau.instruments.values import now

from ..codecs import bk
from ..codecs.stream import excerpt
from ..link import Link, MessageLink

_LARGEST_SIDE = 8192
_ON, _OFF = b'QUERY:GRAB_FRAME "ON",20;', b'QUERY:GRAB_FRAME "OFF";'
_BOXES = ("B_GEOMETRY_US_FRAME_GRAB", "B_GEOMETRY_PIXEL")


@dataclass(frozen=True)
class BkSettings(Settings):
    """Values that the interface does not report and the calibration needs; set on the scanner by hand.

    Examples
    --------
    >>> BkSettings(frequency_khz=8000.0).speed_m_s
    1540.0
    """

    speed_m_s: float = quantity(1540.0, "m/s", 1000.0, 2500.0)
    frequency_khz: float = quantity(6000.0, "kHz", 500.0, 30_000.0)


class BkScanner(Device[BkSettings]):
    """Driver of a BK scanner.

    Parameters
    ----------
    name : str
        Name on the bench.
    link : Link
        Link to port 7915 of the scanner.
    settings : BkSettings
        Speed of sound and frequency set on the scanner.
    box : str
        Parameter that reports the box of the section: ``B_GEOMETRY_US_FRAME_GRAB``, or ``B_GEOMETRY_PIXEL``
        for firmware without it. On some instruments PLUS found the latter to cover more than the section.
    seconds : float
        Time limit of calls that do not specify one (s).
    limits : mapping, optional
        Limits of settings.

    Raises
    ------
    SettingError
        If `box` is not one of these names.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> BkScanner("bmode", link_to("tcp://192.0.2.3:7915")).name
    'bmode'
    """

    def __init__(
        self,
        name: str,
        link: Link,
        settings: BkSettings | None = None,
        *,
        box: str = _BOXES[0],
        seconds: float = 5.0,
        limits: Limits | None = None,
    ) -> None:
        if box not in _BOXES:
            raise SettingError(f"box must be one of {', '.join(_BOXES)}", where=name)
        super().__init__(name, settings or BkSettings(), seconds=seconds, limits=limits)
        self._box = box
        self._link: MessageLink[bytes] = MessageLink(link, bk.MessageDecoder())

    def _open(self, deadline: Deadline) -> None:
        self._link.open(deadline)
        self._quiet(deadline)

    def _disconnect(self) -> None:
        self._link.close()

    def _push(self, settings: BkSettings, deadline: Deadline) -> None:
        """Do nothing: the interface is read-only."""

    def _identify(self, deadline: Deadline) -> Identity:
        width, height = self._window(deadline)
        return Identity("BK Medical", f"OEM interface, {width}×{height} px")

    def _halt(self, deadline: Deadline) -> None:
        self._quiet(deadline)

    def _acquire(self) -> dict[str, Any]:
        scan = self.scan()
        mm = scan.mm_per_px or (float("nan"), float("nan"))
        return {f"{self.name}_section": scan.pixels, f"{self.name}_mm_per_px": list(mm)}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        with self._exchange("window") as deadline:
            width, height = self._window(deadline)
        return {
            f"{self.name}_section": {"dtype": "array", "shape": [height, width]},
            f"{self.name}_mm_per_px": {"dtype": "array", "shape": [2], "units": "mm"},
        }

    def _test(self, deadline: Deadline) -> dict[str, str]:
        scan = self.scan(deadline.left)
        height, width = scan.pixels.shape
        mm = "of unknown size" if scan.mm_per_px is None else "of {:g} × {:g} mm".format(*scan.mm_per_px)
        return {"frame": f"{width}×{height} px {mm}"}

    def scan(self, seconds: float | None = None) -> BScan:
        """Return one frame with its current pixel size.

        Raises
        ------
        InstrumentError
            If no complete frame arrives.
        """
        with self._exchange("scan", seconds) as deadline:
            asked = now()
            width, height = self._window(deadline)
            mm, origin = self._geometry(width, height, deadline)
            gain = self._numbers("B_GAIN:A", 1, deadline)[0]
            grabbed = bk.parse_frame(self._query(_ON, b"DATA:GRAB_FRAME ", deadline), width * height)
            if self._quiet(deadline) != (width, height):
                raise ProtocolError(
                    "changed its window during the acquisition of a frame", do="repeat the scan"
                )
            pixels = np.frombuffer(grabbed.pixels, np.uint8).reshape(height, width)
            s = self.settings
            return BScan(pixels, mm, origin, s.speed_m_s, s.frequency_khz, gain, asked)

    def _quiet(self, deadline: Deadline) -> tuple[int, int]:
        """Stop the frames and return the window, whose answer follows the last frame."""
        # Some instruments acknowledge this command, others do not: nothing depends on it.
        self._link.send(bk.encode(_OFF), deadline)
        return self._window(deadline)

    def _window(self, deadline: Deadline) -> tuple[int, int]:
        size = self._numbers("US_WIN_SIZE", 2, deadline)
        if not all(2 <= side <= _LARGEST_SIDE and side == int(side) for side in size):
            raise ProtocolError(f"reports a window of {size}")
        return int(size[0]), int(size[1])

    def _geometry(
        self, width: int, height: int, deadline: Deadline
    ) -> tuple[tuple[float, float] | None, tuple[float, float]]:
        """Return the pixel size (mm), and the position of the middle of the transducer's face (px)."""
        left, top, right, bottom = self._numbers(f"{self._box}:A", 4, deadline)
        x0, y0, x1, y1 = self._numbers("B_GEOMETRY_TISSUE:A", 4, deadline)
        origin = ((left + right) / 2, top)
        if not (0 <= left < right < width and 0 <= top < bottom < height) or x0 == x1 or y0 == y1:
            return None, origin
        return (1000 * abs(x1 - x0) / (right - left + 1), 1000 * abs(y1 - y0) / (bottom - top + 1)), origin

    def _numbers(self, name: str, count: int, deadline: Deadline) -> tuple[float, ...]:
        """Query the numbers of a parameter."""
        answer = self._query(f"QUERY:{name};".encode(), f"DATA:{name} ".encode(), deadline)
        found = bk.numbers(answer, name)
        if len(found) != count or not np.isfinite(found).all():
            raise ProtocolError(f"reports {found} for {name}")
        return found

    def _query(self, question: bytes, head: bytes, deadline: Deadline) -> bytes:
        answer = self._link.query(bk.encode(question), lambda got: got.startswith((head, b"ERROR")), deadline)
        if answer.startswith(b"ERROR"):
            raise RefusedError(f"refused: {excerpt(answer)}", command=question.decode())
        return answer
