"""OEM interface of a BK scanner: windows in pixels and metres, and grabbed frames.

Source: PLUS's ``vtkPlusBkProFocusOemVideoSource``. While frames are enabled, one precedes every answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from reseau_drivers.codecs import bk
from reseau_drivers.codecs.stream import Damaged

from .faults import Kind
from .machine import Machine


def _grey() -> NDArray[np.uint8]:
    """Test image that contains every byte that must be escaped."""
    return np.add.outer(np.arange(60), np.arange(80)).astype(np.uint8)


class BkScanner(Machine):
    r"""Simulated BK scanner.

    Parameters
    ----------
    section : callable
        Returns the grey image.
    mm_per_px : (float, float)
        Pixel size along x and in depth (mm).
    announces_wrongly : bool
        Whether the announced length of a frame is wrong, as on a BK5000.
    acknowledges_off : bool
        Whether the end of frames is acknowledged; instruments differ.

    Examples
    --------
    >>> BkScanner().receive(bk.encode(b"QUERY:US_WIN_SIZE;"))[0]
    b'\x01DATA:US_WIN_SIZE 80,60;\x04'
    """

    def __init__(
        self,
        section: Callable[[], NDArray[np.uint8]] = _grey,
        mm_per_px: tuple[float, float] = (0.2, 0.25),
        *,
        announces_wrongly: bool = False,
        acknowledges_off: bool = True,
    ) -> None:
        super().__init__()
        self.section, self._mm, self._wrong = section, mm_per_px, announces_wrongly
        self._messages = bk.MessageDecoder(4096)
        self._acknowledges_off, self.streaming = acknowledges_off, False
        self._silent, self._refuse, self._wrong_size, self._stamp = 0, False, False, 0

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the messages in answer."""
        answers: list[bytes] = []
        for message in self._messages.feed(data):
            if isinstance(message, Damaged):
                self.violations.append(str(message))
                continue
            frames = self.streaming
            content = self._answer(message)
            if self._silent:
                self._silent -= 1
                continue
            found = [self._frame()] if frames else []
            found += [content] if content is not None else []
            found += [self._frame()] if self.streaming and not frames else []
            answers += [bk.encode(each) for each in found]
        return answers

    def disconnected(self) -> None:
        """Discard an incomplete message and stop the frames."""
        self._messages.reset()
        self.streaming = False

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: one answer is missing; wrong state: an error; out of range: too few rows."""
        if kind == "stuck":
            self._silent = 1
        self._refuse = self._refuse or kind == "wrong state"
        self._wrong_size = self._wrong_size or kind == "out of range"
        if kind == "power-cycled":
            self._silent, self._refuse, self._wrong_size, self._stamp = 0, False, False, 0
            self.streaming = False

    def _answer(self, message: bytes) -> bytes | None:
        if self._refuse:
            self._refuse = False
            return b'ERROR "not ready";'
        height, width = self.section().shape
        match message:
            case b"QUERY:US_WIN_SIZE;":
                return f"DATA:US_WIN_SIZE {width},{height};".encode()
            case b"QUERY:B_GEOMETRY_US_FRAME_GRAB:A;":
                return f"DATA:B_GEOMETRY_US_FRAME_GRAB:A 0,0,{width - 1},{height - 1};".encode()
            case b"QUERY:B_GEOMETRY_PIXEL:A;":
                # Box of the whole screen, which contains the section.
                return f"DATA:B_GEOMETRY_PIXEL:A 200,50,{200 + width},{50 + height};".encode()
            case b"QUERY:B_GEOMETRY_TISSUE:A;":
                right, down = width * self._mm[0] / 1000, height * self._mm[1] / 1000
                return f"DATA:B_GEOMETRY_TISSUE:A {-right / 2:g},0,{right / 2:g},{-down:g};".encode()
            case b"QUERY:B_GAIN:A;":
                return b"DATA:B_GAIN:A 57;"
            case b'QUERY:GRAB_FRAME "ON",20;':
                self.streaming = True
                return b"ACK;"
            case b'QUERY:GRAB_FRAME "OFF";':
                self.streaming = False
                return b"ACK;" if self._acknowledges_off else None
        self.violations.append(f"unknown message {message!r}")
        return b'ERROR "unknown";'

    def _frame(self) -> bytes:
        self._stamp += 50
        pixels = self.section().tobytes()
        if self._wrong_size:
            self._wrong_size, pixels = False, pixels[: len(pixels) // 2]
        announced = 7 if self._wrong else len(pixels) + 4
        return bk.encode_frame(bk.GrabbedFrame(self._stamp, pixels, announced))
