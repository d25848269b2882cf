"""Video4Linux cameras: webcams, frame grabbers, board cameras.

Frame buffers are shared with the kernel and copied at once. The kernel counts frames, including those without
a free buffer, and stamps them with the monotonic clock at the start of the exposure or at the end of the
frame.
"""

from __future__ import annotations

import errno
import mmap
import os
import select
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from reseau.core.errors import ConnectionLost, ProtocolError, RefusedError, UsageError
from reseau.instruments import Deadline, Identity, choice, quantity

from ..codecs import v4l2 as uapi
from ..codecs.pixels import VIDEO, decode, size_of
from .camera import CameraSettings, OriginalValues, RawFrame, Ready
from .clocks import FrameCounter, TimeInterval

_UNKNOWN_PERIOD_NS = 1_000_000_000
"""Frame period if the driver does not report one: an upper bound."""
_TICK_NS = 100_000
"""Tolerance for stamps ahead of the time of reading: clocks of processors differ by less."""
_MOST_CONTROLS = 500
_WEBCAMS = "uvcvideo"
"""Kernel driver of USB webcams. It declares its stamps as starts of exposures, but stamps a frame when its
first packet arrives, unless it is set to use the camera's own clock (parameter ``hwtimestamps``).
"""


class Mapping(Protocol):
    """Memory shared with the device."""

    def __getitem__(self, part: slice, /) -> bytes:
        """Return a copy of a part."""

    def close(self) -> None:
        """Unmap the memory."""


class Node(Protocol):
    """Open device node; raises OSError as the kernel does."""

    def ioctl(self, request: int, data: bytearray) -> None:
        """Execute a request; the answer replaces the data."""

    def map(self, length: int, offset: int) -> Mapping:
        """Map memory of the device."""

    def wait(self, seconds: float) -> bool:
        """Wait until a frame is available; return whether one is."""

    def close(self) -> None:
        """Close the node."""


OpenNode = Callable[[], Node]


class KernelNode:
    """Device node of the kernel.

    Parameters
    ----------
    path : str
        Such as ``/dev/video0``, or one of the persistent links in ``/dev/v4l/by-id``.

    Raises
    ------
    ConnectionLost
        If the node cannot be opened.
    UsageError
        If the system is not Linux.
    """

    def __init__(self, path: str) -> None:
        try:
            from fcntl import ioctl
        except ImportError:
            raise UsageError("cameras of Video4Linux need Linux", where=path) from None
        self._ioctl = ioctl
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise ConnectionLost(
                f"{path} cannot be opened ({error.strerror})", do="check the cable and the permissions"
            ) from None
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def ioctl(self, request: int, data: bytearray) -> None:
        """Execute a request; the answer replaces the data."""
        self._ioctl(self._fd, request, data, True)

    def map(self, length: int, offset: int) -> Mapping:
        """Map memory of the device."""
        return mmap.mmap(self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, seconds: float) -> bool:
        """Wait until a frame is available; return whether one is."""
        for _, events in self._poll.poll(max(0, int(seconds * 1000))):
            if events & select.POLLIN:
                return True
            # An unplugged device reports a hang-up; an error alone concerns its queue of buffers.
            number = errno.EIO if events == select.POLLERR else errno.ENODEV
            raise OSError(number, os.strerror(number))
        return False

    def close(self) -> None:
        """Close the node."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):
                os.close(fd)


def video_devices() -> tuple[str, ...]:
    """List the nodes of video devices, by persistent links if there are any; entry point ``video``.

    Examples
    --------
    >>> all(path.startswith("/dev/") for path in video_devices())
    True
    """
    stable = sorted(str(path) for path in Path("/dev/v4l/by-id").glob("*"))
    return tuple(stable or sorted(str(path) for path in Path("/dev").glob("video*")))


@dataclass(frozen=True)
class V4l2Settings(CameraSettings):
    """Settings of a Video4Linux camera; a gain or brightness below 0 keeps its value. Gains have no unit.

    Examples
    --------
    >>> V4l2Settings(format="Y16", gain=10.0).format
    'Y16'
    """

    format: str = choice("GREY", *VIDEO)
    brightness: int = quantity(-1, "", -1, 65535)


class V4l2:
    """Interface to a Video4Linux camera.

    Parameters
    ----------
    open_node : callable
        Opens the device node.

    Examples
    --------
    >>> V4l2(lambda: KernelNode("/dev/video0")).dropped
    0
    """

    def __init__(self, open_node: OpenNode) -> None:
        self._open_node = open_node
        self._node: Node | None = None
        self._maps: list[Mapping] = []
        self._streaming = False
        self._numbers = FrameCounter(1 << 32)
        self._damaged = 0
        self._original = OriginalValues()
        self._buffers = 4
        self._format, self._layout = uapi.Format(0, 0, "GREY"), VIDEO["GREY"]
        self._period_ns = _UNKNOWN_PERIOD_NS
        self._exposure_ns: int | None = None
        self._gain = float("nan")
        self._stamp_ns, self._stamped_at = 0, "end of the frame"
        self._controls: dict[int, uapi.Control] = {}

    @property
    def dropped(self) -> int:
        """Number of frames lost or damaged."""
        return self._numbers.lost + self._damaged

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frames (px)."""
        return self._format.height, self._format.width

    def open(self, deadline: Deadline) -> None:
        """Open the node; an open one is closed before and all state is reset."""
        self.close()
        self._numbers, self._damaged, self._original = FrameCounter(1 << 32), 0, OriginalValues()
        self._node = self._open_node()
        with self._translated_errors("query"):
            found = uapi.Capability.parse(self._ask(uapi.QUERYCAP, bytearray(uapi.Capability.SIZE)))
        if not found.capabilities & uapi.Capability.VIDEO_CAPTURE:
            raise RefusedError(
                "is not a capture device", do="give the node that captures; see v4l2-ctl --list-devices"
            )
        if not found.capabilities & uapi.Capability.STREAMING:
            raise RefusedError("does not support streaming with shared buffers")
        self._identity = Identity(found.driver, found.card, found.bus, ".".join(map(str, found.version)))
        self._controls = {control.identifier: control for control in self._listed()}

    def close(self) -> None:
        """Close the node if it is open."""
        node, self._node = self._node, None
        maps, self._maps = self._maps, []
        self._streaming = False
        for each in maps:
            with suppress(OSError, ValueError, BufferError):
                each.close()
        if node is not None:
            node.close()

    def identify(self, deadline: Deadline) -> Identity:
        """Return the identity that the kernel driver reports."""
        return self._identity

    def apply(self, settings: V4l2Settings, deadline: Deadline) -> None:
        """Stop the acquisition and apply settings."""
        self.halt()
        self._buffers = settings.buffers
        with self._translated_errors("set"):
            self._set_format(settings)
            self._set_rate(settings.rate)
        self._set_exposure(settings.exposure_us)
        self._set_gain(settings.gain)
        if settings.brightness >= 0:
            self._set(uapi.BRIGHTNESS, settings.brightness, "brightness")
        else:
            self._put_back(uapi.BRIGHTNESS)

    def dark(self, settings: V4l2Settings) -> V4l2Settings:
        """Return the settings with the shortest exposure, if there is a control for it."""
        control = self._controls.get(uapi.EXPOSURE_ABSOLUTE)
        return settings if control is None else replace(settings, exposure_us=max(1, control.low) * 100.0)

    def start(self, deadline: Deadline) -> None:
        """Start the acquisition if it is not running."""
        if self._streaming:
            return
        with self._translated_errors("start"):
            count = uapi.Request.parse(self._ask(uapi.REQBUFS, uapi.Request(self._buffers).build())).count
            for index in range(count):
                asked = uapi.Buffer(index).build()
                buffer = uapi.Buffer.parse(self._ask(uapi.QUERYBUF, asked))
                self._maps.append(self._opened().map(buffer.length, buffer.offset))
                self._ask(uapi.QBUF, uapi.Buffer(index).build())
            self._ask(uapi.STREAMON, uapi.stream_type())
        self._streaming = True
        self._numbers.restart()
        self._stamp_ns = 0

    def request(self, deadline: Deadline, ready: Ready | None = None) -> int:
        """Wait for the other cameras of a rig, if any: the camera runs freely."""
        return time.monotonic_ns() if ready is None else ready()[0]

    def take(self, deadline: Deadline) -> RawFrame | None:
        """Return the next complete frame that is newer than the last."""
        with self._translated_errors("fetch"):
            if not self._opened().wait(deadline.left):
                return None
            try:
                buffer = uapi.Buffer.parse(self._ask(uapi.DQBUF, uapi.Buffer().build()))
            except BlockingIOError:
                return None
            now = time.monotonic_ns()
            if not buffer.index < len(self._maps):
                raise ProtocolError(f"delivered a buffer {buffer.index}, of {len(self._maps)}")
            data = self._maps[buffer.index][: buffer.used]
            self._ask(uapi.QBUF, uapi.Buffer(buffer.index).build())
        _require_whole(buffer.field)
        sequence = self._numbers.next(buffer.sequence)
        if sequence is None:
            return None
        if not self._whole(buffer):
            self._damaged += 1
            return None
        began = self._began(buffer, now)
        try:
            pixels = decode(self._layout, self._format.width, self._format.height, data, self._format.stride)
        except ProtocolError:
            # Damage of a compressed frame shows only when it is decoded.
            self._damaged += 1
            return None
        exposure_us = float("nan") if self._exposure_ns is None else self._exposure_ns / 1000
        raw = data if self._layout.coloured else b""
        return RawFrame(
            pixels,
            self._layout.full_scale,
            self._layout.pattern,
            raw,
            sequence,
            began,
            exposure_us,
            self._gain,
        )

    def halt(self) -> None:
        """Stop the acquisition and release the buffers."""
        if self._node is None:
            return
        maps, self._maps = self._maps, []
        for each in maps:
            each.close()
        if self._streaming or maps:
            self._streaming = False
            with self._translated_errors("stop"):
                self._ask(uapi.STREAMOFF, uapi.stream_type())
                self._ask(uapi.REQBUFS, uapi.Request(0).build())

    def clock(self, deadline: Deadline) -> str:
        """Describe the clock: the kernel stamps frames with the computer's clock."""
        return f"offset 0 s, stamped by the kernel at the {self._stamped_at}"

    def _whole(self, buffer: uapi.Buffer) -> bool:
        need = size_of(self._layout, self._format.width, self._format.height, self._format.stride)
        return not buffer.flags & uapi.Buffer.ERROR and buffer.used >= max(1, need)

    def _began(self, buffer: uapi.Buffer, now: int) -> TimeInterval:
        """Return the interval of the start of the exposure; see the flags of ``v4l2_buffer``."""
        if buffer.flags & uapi.Buffer.CLOCKS != uapi.Buffer.MONOTONIC:
            raise ProtocolError("stamps its frames with an unknown clock")
        stamp = buffer.stamp_ns
        if stamp > now + self._period_ns + _TICK_NS or stamp < self._stamp_ns:
            raise ProtocolError(f"stamped a frame {(stamp - now) / 1e9:+.3g} s from now, or out of order")
        self._stamp_ns = stamp
        # Drivers that stamp the expected end of a frame may be ahead of it by a part of the period.
        stamp = min(stamp, now)
        at_start = buffer.flags & uapi.Buffer.SOURCES == uapi.Buffer.START_OF_EXPOSURE
        # Reading the rows takes up to one period; an unknown exposure may fill another one.
        exposure = self._exposure_ns
        earliest = stamp - self._period_ns - (self._period_ns if exposure is None else exposure)
        if at_start and self._identity.maker == _WEBCAMS:
            self._stamped_at = "first packet of the frame"
            return TimeInterval(earliest, stamp)
        if at_start:
            self._stamped_at = "start of the exposure"
            return TimeInterval(stamp, stamp + 1000)
        self._stamped_at = "end of the frame"
        return TimeInterval(earliest, stamp - (exposure or 0))

    def _set_format(self, settings: V4l2Settings) -> None:
        now = uapi.Format.parse(self._ask(uapi.G_FMT, uapi.Format(0, 0, "GREY").build()))
        sized = bool(settings.width or settings.height)
        width, height = self._original.keep("size", sized, lambda: (now.width, now.height)) or (
            now.width,
            now.height,
        )
        width, height = settings.width or width, settings.height or height
        moved = bool(settings.left or settings.top)
        region = self._original.keep("region", moved, self._region)
        if moved:
            region = uapi.Selection(settings.left, settings.top, width, height)
        if region is not None:
            got = uapi.Selection.parse(self._ask(uapi.S_SELECTION, region.build()))
            if got != region:
                raise RefusedError(f"reads the region {got}, not {region}")
        self._layout = VIDEO[settings.format]
        wanted = uapi.Format(width, height, str(self._layout.code))
        accepted = uapi.Format.parse(self._ask(uapi.S_FMT, wanted.build()))
        if (accepted.width, accepted.height, accepted.fourcc) != (width, height, wanted.fourcc):
            offered = ", ".join(self._offered())
            raise RefusedError(
                f"delivers {accepted.width}×{accepted.height} {accepted.fourcc.strip()}, "
                f"not {width}×{height} {settings.format}",
                do=f"it offers {offered}",
            )
        _require_whole(accepted.field)
        self._format = accepted

    def _region(self) -> uapi.Selection:
        """Return the region of the sensor that is read out."""
        return uapi.Selection.parse(self._ask(uapi.G_SELECTION, uapi.Selection(0, 0, 0, 0).build()))

    def _set_rate(self, rate: float) -> None:
        self._period_ns = _UNKNOWN_PERIOD_NS
        # Not every driver supports frame intervals; one that does reports the interval it chose.
        with suppress(OSError):
            interval = self._original.keep("interval", bool(rate), self._interval)
            if rate:
                interval = uapi.Interval(1000, round(rate * 1000))
            if interval is not None:
                self._ask(uapi.S_PARM, interval.build())
            got = self._interval()
            self._period_ns = got.ns or _UNKNOWN_PERIOD_NS
        if rate and abs(self._period_ns * rate - 1e9) > 5e7:
            raise RefusedError(f"delivers {1e9 / self._period_ns:.4g} frames in a second, not {rate:g}")

    def _interval(self) -> uapi.Interval:
        return uapi.Interval.parse(self._ask(uapi.G_PARM, uapi.Interval(0, 0).build()))

    def _set_exposure(self, exposure_us: float) -> None:
        known = uapi.EXPOSURE_ABSOLUTE in self._controls
        if exposure_us and not known:
            raise RefusedError("has no control for the exposure time")
        if exposure_us:
            if uapi.EXPOSURE_AUTO in self._controls:
                self._set(uapi.EXPOSURE_AUTO, uapi.EXPOSURE_MANUAL, "exposure mode")
            self._set(uapi.EXPOSURE_ABSOLUTE, max(1, round(exposure_us / 100)), "exposure_us / 100")
        else:
            self._put_back(uapi.EXPOSURE_ABSOLUTE, uapi.EXPOSURE_AUTO)
        automatic = (
            uapi.EXPOSURE_AUTO in self._controls and self._get(uapi.EXPOSURE_AUTO) != uapi.EXPOSURE_MANUAL
        )
        self._exposure_ns = self._get(uapi.EXPOSURE_ABSOLUTE) * 100_000 if known and not automatic else None

    def _set_gain(self, gain: float) -> None:
        if gain >= 0:
            if uapi.AUTOGAIN in self._controls:
                self._set(uapi.AUTOGAIN, 0, "automatic gain")
            self._set(uapi.GAIN, round(gain), "gain")
        else:
            self._put_back(uapi.GAIN, uapi.AUTOGAIN)
        self._gain = float(self._get(uapi.GAIN)) if uapi.GAIN in self._controls else float("nan")

    def _set(self, identifier: int, value: int, name: str) -> None:
        control = self._controls.get(identifier)
        if control is None:
            raise RefusedError(f"has no control for {name}")
        if not control.low <= value <= control.high:
            raise RefusedError(f"{name} {value} is outside {control.low}…{control.high}")
        self._original.keep(identifier, True, lambda: self._get(identifier))
        with self._translated_errors(f"set {control.name}"):
            self._ask(uapi.S_CTRL, uapi.control_value(identifier, value))
        if (got := self._get(identifier)) != value:
            raise RefusedError(f"{name} is {got}, not {value}", do="is it driven automatically?")

    def _put_back(self, *identifiers: int) -> None:
        """Restore controls that the driver has changed."""
        for identifier in identifiers:
            if (value := self._original.keep(identifier, False)) is not None:
                with self._translated_errors(f"set {self._controls[identifier].name}"):
                    self._ask(uapi.S_CTRL, uapi.control_value(identifier, value))

    def _get(self, identifier: int) -> int:
        with self._translated_errors("get"):
            data = self._ask(uapi.G_CTRL, uapi.control_value(identifier))
        return int(np.frombuffer(data, "<i4")[1])

    def _listed(self) -> Iterator[uapi.Control]:
        """Yield the controls with their limits."""
        last = 0
        for _ in range(_MOST_CONTROLS):
            try:
                data = self._ask(uapi.QUERYCTRL, uapi.Control.after(last))
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    return
                raise
            control = uapi.Control.parse(data)
            last = control.identifier
            if not control.flags & uapi.Control.DISABLED:
                yield control

    def _offered(self) -> Iterator[str]:
        """Yield the available pixel formats, by the names of the settings where possible."""
        names = {str(layout.code): name for name, layout in VIDEO.items()}
        for index in range(64):
            try:
                code = uapi.Format.listed(self._ask(uapi.ENUM_FMT, uapi.Format.ask(index)))
            except OSError:
                return
            yield names.get(code, code.strip())

    def _ask(self, request: int, data: bytearray) -> bytes:
        self._opened().ioctl(request, data)
        return bytes(data)

    def _opened(self) -> Node:
        if self._node is None:
            raise ConnectionLost("the camera is not open")
        return self._node

    @contextmanager
    def _translated_errors(self, what: str) -> Iterator[None]:
        """Translate errors of the kernel."""
        try:
            yield
        except OSError as error:
            number = error.errno or 0
            if number == errno.EBUSY:
                raise RefusedError(
                    f"is used by another process ({what})", do="end that process, or wait"
                ) from None
            if number in (errno.EINVAL, errno.ENOTTY, errno.ERANGE, errno.EACCES):
                raise RefusedError(f"does not support this ({what}: {os.strerror(number)})") from None
            if number == errno.EIO:
                raise ProtocolError(f"reports an internal fault ({what})", do="check the cable") from None
            raise ConnectionLost(f"disappeared ({what}: {error.strerror})", do="check the cable") from None
        except ValueError:
            # Another thread has unmapped the memory.
            raise ConnectionLost("was closed during the call") from None


def _require_whole(field: int) -> None:
    """Refuse fields, and frames of fields: their rows are of two times, or every second one is missing."""
    name = uapi.FIELDS[field] if field < len(uapi.FIELDS) else str(field)
    if name not in ("NONE", "ANY"):
        do = "set the source to progressive scan: rows of two times are not measured"
        raise RefusedError(f"delivers fields, not whole frames (field order {name})", do=do)
