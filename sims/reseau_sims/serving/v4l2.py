"""Kernel interface of a simulated Video4Linux camera, within one process.

It follows *Linux Media Infrastructure userspace API*, part I: the client with buffers owns the camera,
formats do not change while there are buffers, and frames without a buffer are counted and lost.
"""

from __future__ import annotations

import errno
import os
import time

from reseau_drivers.codecs import v4l2 as uapi
from reseau_drivers.codecs.pixels import VIDEO, size_of

from .imaging import SimulatedCamera
from .video import CONTROLS, FORMATS, Memory, Stream, Video


def _fail(number: int) -> OSError:
    return OSError(number, os.strerror(number))


class VideoCamera(Video):
    """Camera with device nodes.

    Parameters
    ----------
    body : SimulatedCamera
        Forms the images.
    first, start_of_exposure, webcam
        As for :class:`Video`.

    Examples
    --------
    >>> from reseau_sims.serving import SimulatedCamera
    >>> camera = VideoCamera(SimulatedCamera())
    >>> node = camera.open()
    >>> camera.nodes
    1
    >>> node.close()
    """

    def __init__(
        self, body: SimulatedCamera, *, first: int = 0, start_of_exposure: bool = False, webcam: bool = False
    ) -> None:
        super().__init__(body, first=first, start_of_exposure=start_of_exposure, webcam=webcam)
        self.plugged_in = True
        self._nodes: list[VideoNode] = []

    def open(self) -> VideoNode:
        """Open a node, as the kernel does; several may be open."""
        with self.body.lock:
            if not self.plugged_in:
                raise _fail(errno.ENODEV)
            node = VideoNode(self)
            self._nodes.append(node)
            return node

    @property
    def nodes(self) -> int:
        """Number of open nodes."""
        return len(self._nodes)

    def unplug(self, *, power: bool = False) -> None:
        """Pull the cable: all nodes become invalid; new ones can be opened."""
        with self.body.lock:
            super().unplug(power=power)
            for node in self._nodes:
                node.dead = True
            self._nodes = []

    def left(self, node: VideoNode) -> None:
        """Release what a closed node owned."""
        if self.stream is not None and self.stream.owner is node:
            self.stream = None
        if node in self._nodes:
            self._nodes.remove(node)


class VideoNode:
    """Open device node.

    Parameters
    ----------
    camera : VideoCamera
        Camera of the node.
    """

    def __init__(self, camera: VideoCamera) -> None:
        self._camera = camera
        self.dead, self._closed = False, False

    def ioctl(self, request: int, data: bytearray) -> None:
        """Execute a request as the kernel does; the answer replaces the data."""
        with self._camera.body.lock:
            self._alive()
            self._camera.expose()
            self._alive()
            answer = _ANSWERS.get(request)
            if answer is None:
                raise _fail(errno.ENOTTY)
            data[:] = answer(self, bytes(data)).ljust(len(data), b"\0")

    def map(self, length: int, offset: int) -> Memory:
        """Map the memory of a buffer."""
        with self._camera.body.lock:
            self._alive()
            memory = self._owned().memory[offset // length]
            memory.mapped = True
            return memory

    def wait(self, seconds: float) -> bool:
        """Wait until a frame is available; return whether one is."""
        until = time.monotonic() + seconds
        while True:
            with self._camera.body.lock:
                self._alive()
                self._camera.expose()
                self._alive()
                stream = self._owned()
                if stream.done:
                    return True
                due = [frame.due_ns for frame in stream.coming] + [stream.next_ns]
            left = until - time.monotonic()
            if left <= 0:
                return False
            time.sleep(max(0.0, min(left, min(due) / 1e9 - time.monotonic(), 0.01)))

    def close(self) -> None:
        """Close the node and release what it owned."""
        with self._camera.body.lock:
            self._closed = True
            self._camera.left(self)

    def _alive(self) -> None:
        if self.dead:
            raise _fail(errno.ENODEV)
        if self._closed:
            raise _fail(errno.EBADF)

    def _wrong(self, what: str) -> OSError:
        self._camera.body.violations.append(what)
        return _fail(errno.EINVAL)

    def _owned(self) -> Stream:
        stream = self._camera.stream
        if stream is None or stream.owner is not self:
            raise self._wrong("no buffers of its own")
        return stream

    def _free(self) -> None:
        if self._camera.stream is not None:
            raise _fail(errno.EBUSY)

    def _capability(self, data: bytes) -> bytearray:
        can = uapi.Capability.VIDEO_CAPTURE | uapi.Capability.STREAMING
        driver = "uvcvideo" if self._camera.webcam else "simulated"
        return uapi.Capability(driver, "Simulated camera", "platform:reseau", (6, 1, 0), can).build()

    def _list_format(self, data: bytes) -> bytearray:
        index = int.from_bytes(data[:4], "little")
        if index >= len(FORMATS):
            raise _fail(errno.EINVAL)
        code = uapi.fourcc_of(str(VIDEO[FORMATS[index]].code))
        return bytearray(data[:44] + code.to_bytes(4, "little"))

    def _get_format(self, data: bytes) -> bytearray:
        return self._camera.format.build()

    def _set_format(self, data: bytes) -> bytearray:
        asked, body = uapi.Format.parse(data), self._camera.body
        self._free()
        names = {str(VIDEO[name].code): VIDEO[name] for name in FORMATS}
        fourcc = asked.fourcc if asked.fourcc in names else "GREY"
        left, top = self._camera.region
        width = min(max(asked.width, 2), body.width - left)
        height = min(max(asked.height, 2), body.height - top)
        width -= width % names[fourcc].group[0]
        # A compressed image may be as large as the raw one plus a header.
        stride = names[fourcc].row(width)
        size = size_of(names[fourcc], width, height) or width * height * 2 + 4096
        self._camera.format = uapi.Format(width, height, fourcc, stride, size)
        return self._camera.format.build()

    def _get_region(self, data: bytes) -> bytearray:
        form = self._camera.format
        return uapi.Selection(*self._camera.region, form.width, form.height).build()

    def _set_region(self, data: bytes) -> bytearray:
        asked, body = uapi.Selection.parse(data), self._camera.body
        self._free()
        self._camera.region = (
            min(max(asked.left, 0), body.width - 2),
            min(max(asked.top, 0), body.height - 2),
        )
        left, top = self._camera.region
        width, height = min(asked.width, body.width - left), min(asked.height, body.height - top)
        return uapi.Selection(left, top, width, height).build()

    def _get_interval(self, data: bytes) -> bytearray:
        return self._camera.period.build()

    def _set_interval(self, data: bytes) -> bytearray:
        asked = uapi.Interval.parse(data)
        self._free()
        if asked.ns:
            slowest, fastest = 1_000_000_000, 1_000_000
            if fastest <= asked.ns <= slowest:
                self._camera.period = uapi.Interval(asked.numerator, asked.denominator)
        return self._camera.period.build()

    def _list_control(self, data: bytes) -> bytearray:
        after = uapi.Control.asked(data)
        for control in sorted(CONTROLS, key=lambda each: each.identifier):
            if control.identifier > after:
                return control.build()
        raise _fail(errno.EINVAL)

    def _get_control(self, data: bytes) -> bytearray:
        identifier = int.from_bytes(data[:4], "little")
        if identifier not in self._camera.controls:
            raise _fail(errno.EINVAL)
        return uapi.control_value(identifier, self._camera.controls[identifier])

    def _set_control(self, data: bytes) -> bytearray:
        identifier, value = (
            int.from_bytes(data[:4], "little"),
            int.from_bytes(data[4:8], "little", signed=True),
        )
        for control in CONTROLS:
            if control.identifier == identifier:
                if not control.low <= value <= control.high:
                    raise self._wrong(f"{control.name} set to {value}")
                self._camera.controls[identifier] = value
                return bytearray(data)
        raise self._wrong(f"control {identifier:#x} set")

    def _buffers(self, data: bytes) -> bytearray:
        count, stream = uapi.Request.parse(data).count, self._camera.stream
        if stream is not None and stream.owner is not self:
            raise _fail(errno.EBUSY)
        if stream is not None and (stream.on or any(memory.mapped for memory in stream.memory)):
            self._camera.body.violations.append("buffers asked for while they are in use")
            raise _fail(errno.EBUSY)
        self._camera.stream = None
        if count:
            memory = [Memory(self._camera.format.size) for _ in range(count)]
            self._camera.stream = Stream(self, memory)
        return uapi.Request(count).build()

    def _query_buffer(self, data: bytes) -> bytearray:
        index, stream = uapi.Buffer.parse(data).index, self._owned()
        if index >= len(stream.memory):
            raise _fail(errno.EINVAL)
        size = len(stream.memory[index].data)
        return uapi.Buffer(index, offset=index * size, length=size).build()

    def _queue(self, data: bytes) -> bytearray:
        index, stream = uapi.Buffer.parse(data).index, self._owned()
        if index >= len(stream.memory) or index in stream.queued:
            raise self._wrong(f"buffer {index} queued, which does not exist or is queued already")
        stream.queued.append(index)
        return bytearray(data)

    def _fetch(self, data: bytes) -> bytearray:
        stream = self._owned()
        if stream.broken:
            stream.broken = False
            raise _fail(errno.EIO)
        if not stream.done:
            raise _fail(errno.EAGAIN)
        return stream.done.popleft().build()

    def _stream_on(self, data: bytes) -> bytearray:
        stream = self._owned()
        if not stream.on:
            stream.on, stream.stuck = True, False
            stream.sequence, stream.next_ns = self._camera.first, time.monotonic_ns() + 1_000_000
        return bytearray(data)

    def _stream_off(self, data: bytes) -> bytearray:
        stream = self._owned()
        stream.on = False
        for queue in (stream.queued, stream.done, stream.coming):
            queue.clear()
        return bytearray(data)


_ANSWERS = {
    uapi.QUERYCAP: VideoNode._capability,
    uapi.ENUM_FMT: VideoNode._list_format,
    uapi.G_FMT: VideoNode._get_format,
    uapi.S_FMT: VideoNode._set_format,
    uapi.G_SELECTION: VideoNode._get_region,
    uapi.S_SELECTION: VideoNode._set_region,
    uapi.G_PARM: VideoNode._get_interval,
    uapi.S_PARM: VideoNode._set_interval,
    uapi.QUERYCTRL: VideoNode._list_control,
    uapi.G_CTRL: VideoNode._get_control,
    uapi.S_CTRL: VideoNode._set_control,
    uapi.REQBUFS: VideoNode._buffers,
    uapi.QUERYBUF: VideoNode._query_buffer,
    uapi.QBUF: VideoNode._queue,
    uapi.DQBUF: VideoNode._fetch,
    uapi.STREAMON: VideoNode._stream_on,
    uapi.STREAMOFF: VideoNode._stream_off,
}
