"""Camera that exposes frames into buffers at its own times, without threads: it catches up when called.

A frame shows the scene at the start of its exposure.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field

from reseau_drivers.codecs import v4l2 as uapi
from reseau_drivers.codecs.pixels import VIDEO, encode

from .faults import Fault
from .imaging import SimulatedCamera, View

_DEFAULTS = {uapi.BRIGHTNESS: 128, uapi.GAIN: 0, uapi.EXPOSURE_AUTO: 3, uapi.EXPOSURE_ABSOLUTE: 50}
CONTROLS = (
    uapi.Control(uapi.BRIGHTNESS, "Brightness", 1, 0, 255, 1, 128),
    uapi.Control(uapi.GAIN, "Gain", 1, 0, 24, 1, 0),
    uapi.Control(uapi.EXPOSURE_AUTO, "Auto Exposure", 3, 0, 3, 1, 3),
    uapi.Control(uapi.EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1, 10000, 1, 50),
)
FORMATS = tuple(VIDEO)


class Memory:
    """Mapped memory of a buffer.

    Parameters
    ----------
    size : int
        Size (bytes).
    """

    def __init__(self, size: int) -> None:
        self.data = bytearray(size)
        self.mapped = False

    def __getitem__(self, part: slice) -> bytes:
        if not self.mapped:
            raise ValueError("mmap closed or invalid")
        return bytes(self.data[part])

    def close(self) -> None:
        """Unmap the memory."""
        self.mapped = False


@dataclass
class _Exposed:
    """Frame between the start of its exposure and its delivery."""

    sequence: int
    began_ns: int
    due_ns: int
    stamp_ns: int
    data: bytes
    flags: int = 0
    fault: Fault | None = None


@dataclass
class Stream:
    """Buffers of the owner of the camera, and frames in progress."""

    owner: object
    memory: list[Memory]
    queued: deque[int] = field(default_factory=deque)
    done: deque[uapi.Buffer] = field(default_factory=deque)
    coming: deque[_Exposed] = field(default_factory=deque)
    on: bool = False
    next_ns: int = 0
    sequence: int = 0
    stuck: bool = False
    broken: bool = False


class Video:
    """Camera with frames in progress.

    Parameters
    ----------
    body : SimulatedCamera
        Forms the images.
    first : int
        Number of the first frame.
    start_of_exposure : bool
        Whether stamps refer to the start of the exposure; otherwise to the end of the frame.
    webcam : bool
        Whether it is a USB camera: the kernel stamps frames when their first packet arrives, and declares
        this as the start of the exposure.
    """

    def __init__(
        self, body: SimulatedCamera, *, first: int = 0, start_of_exposure: bool = False, webcam: bool = False
    ) -> None:
        self.body, self.first, self._at_start, self.webcam = body, first, start_of_exposure, webcam
        self.stream: Stream | None = None
        """Stream of the owner."""
        self.overruns = 0
        """Frames that were lost because no buffer was queued."""
        self._last: _Exposed | None = None
        body.before_change.append(self.expose)
        self._switch_on()

    def _switch_on(self) -> None:
        self.controls = dict(_DEFAULTS)
        self.format = uapi.Format(self.body.width, self.body.height, "GREY")
        self.region = (0, 0)
        self.period = uapi.Interval(1, 100)

    def unplug(self, *, power: bool = False) -> None:
        """Pull the cable: open nodes become invalid; without power the settings are lost."""
        with self.body.lock:
            self.stream = None
            if power:
                self._switch_on()

    @property
    def view(self) -> View:
        """Current settings."""
        layout = next(each for each in VIDEO.values() if each.code == self.format.fourcc)
        automatic = self.controls[uapi.EXPOSURE_AUTO] != uapi.EXPOSURE_MANUAL
        return View(
            5000.0 if automatic else self.controls[uapi.EXPOSURE_ABSOLUTE] * 100.0,
            float(self.controls[uapi.GAIN]),
            float(self.controls[uapi.BRIGHTNESS] - 128),
            *self.region,
            self.format.width,
            self.format.height,
            layout.full_scale,
        )

    def expose(self) -> None:
        """Expose the frames that are due, and deliver those that have been read out."""
        with self.body.lock:
            stream, now = self.stream, time.monotonic_ns()
            if stream is None or not stream.on:
                return
            while stream.next_ns <= now and not stream.stuck:
                self._begin(stream)
            while stream.coming and stream.coming[0].due_ns <= now:
                self._deliver(stream, stream.coming.popleft())

    def _begin(self, stream: Stream) -> None:
        view = self.view
        layout = next(each for each in VIDEO.values() if each.code == self.format.fourcc)
        began, ended = stream.next_ns, stream.next_ns + int(view.exposure_us * 1000)
        stamp = began if self._at_start else ended
        # A frame without a buffer is lost and need not be drawn.
        waited_for = len(stream.queued) > len(stream.coming)
        data = encode(layout, self.body.draw(view)) if waited_for else b""
        stream.coming.append(_Exposed(stream.sequence, began, ended + 1_000_000, stamp, data))
        stream.sequence = (stream.sequence + 1) % (1 << 32)
        stream.next_ns += max(self.period.ns, ended - began)

    def _deliver(self, stream: Stream, frame: _Exposed) -> None:
        if not stream.queued or not frame.data:
            self.overruns += 1
            return
        if frame.fault is None:
            frame.fault = self.body.script.draw()
            if frame.fault is not None and not self._survives(stream, frame, frame.fault):
                return
        repeated = frame.fault is not None and frame.fault.kind == "repeated"
        if repeated and self._last is not None:
            self._fill(stream, self._last)
        self._fill(stream, frame)
        self._last = frame

    def _survives(self, stream: Stream, frame: _Exposed, fault: Fault) -> bool:
        """Whether the frame is delivered now, after applying its fault."""
        match fault.kind:
            case "late":
                frame.due_ns = time.monotonic_ns() + int(fault.seconds * 1e9)
                stream.coming.appendleft(frame)
                return False
            case "dropped":
                return False
            case "truncated":
                frame.data = frame.data[: len(frame.data) // 2]
            case "corrupted":
                frame.data, frame.flags = bytes(len(frame.data)), uapi.Buffer.ERROR
            case "disconnected" | "power-cycled":
                self.unplug(power=fault.kind == "power-cycled")
                return False
            case "stuck":
                stream.stuck = True
                stream.coming.clear()
                return False
            case "wrong state":
                stream.broken = True
            case "out of range":
                frame.stamp_ns += 3_600_000_000_000
        return True

    def _fill(self, stream: Stream, frame: _Exposed) -> None:
        if not stream.queued:
            self.overruns += 1
            return
        index = stream.queued.popleft()
        stream.memory[index].data[: len(frame.data)] = frame.data
        source = uapi.Buffer.START_OF_EXPOSURE if self._at_start or self.webcam else 0
        flags = frame.flags | uapi.Buffer.MONOTONIC | source
        stream.done.append(uapi.Buffer(index, len(frame.data), flags, frame.stamp_ns, frame.sequence))
