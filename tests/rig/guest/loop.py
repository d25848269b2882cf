"""A V4L2 camera that shows our pictures: the kernel's virtual video driver, its output looped to its input.

Frames written to the output node come out of the capture node unchanged when size and format agree. Written
by the numbers of the kernel's header, and apart from the driver that is tested.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reseau_sims.serving import SimulatedCamera, View

__all__ = ["LoopCamera"]


def _both_ways(number: int, size: int) -> int:
    return 3 << 30 | size << 16 | ord("V") << 8 | number


S_FMT = _both_ways(5, 208)
REQBUFS, QUERYBUF, QBUF, DQBUF = (
    _both_ways(8, 20),
    _both_ways(9, 88),
    _both_ways(15, 88),
    _both_ways(17, 88),
)
STREAMON = 1 << 30 | 4 << 16 | ord("V") << 8 | 18
G_CTRL, S_CTRL = _both_ways(27, 8), _both_ways(28, 8)
QUERYCTRL, QUERYMENU = _both_ways(36, 68), _both_ways(37, 44)
S_DV_TIMINGS, ENUM_DV_TIMINGS = _both_ways(87, 132), _both_ways(98, 148)
OUTPUT, MAPPED, PROGRESSIVE, NEXT = 2, 1, 1, 0x80000000
BITS = {"GREY": 8, "Y10 ": 10, "Y12 ": 12, "Y16 ": 16, "YUYV": 8}
"""Of a grey value; more than eight lie in the low bits of two bytes."""


def nodes() -> dict[str, str]:
    """Nodes of the virtual driver, by the ends of their names: cap, out."""
    names = {
        path.name: (path / "name").read_text().strip() for path in Path("/sys/class/video4linux").iterdir()
    }
    return {
        name.rsplit("-", 1)[-1]: f"/dev/{node}" for node, name in names.items() if name.startswith("vivid")
    }


class LoopCamera:
    """Feeds what a camera body sees into the loop, as bright as the capture node is set.

    Parameters
    ----------
    body : SimulatedCamera
        Its width and height are those of the frames.
    fourcc : str
        GREY, Y10, Y12, Y16 or YUYV.
    """

    def __init__(self, body: SimulatedCamera, fourcc: str) -> None:
        self._body, self._fourcc = body, fourcc
        found = nodes()
        self.node = found["cap"]
        self._out, self._cap = (os.open(found[end], os.O_RDWR) for end in ("out", "cap"))
        for fd in (self._out, self._cap):
            fcntl.ioctl(fd, S_DV_TIMINGS, bytearray(self._timings(fd)))
        form = bytearray(208)
        struct.pack_into("<I4xII4sI", form, 0, OUTPUT, body.width, body.height, fourcc.encode(), 0)
        fcntl.ioctl(self._out, S_FMT, form)
        self._controls = {name: identifier for identifier, name in _controls(self._cap)}
        self._loop()
        self.failed, self.shown = "", 0
        self._stop, self._begun = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()
        # Injected faults are for whoever begins to stream next: not for this one.
        if not self._begun.wait(30.0):
            raise TimeoutError(f"the loop did not begin: {self.failed}")

    @property
    def state(self) -> str:
        """What it did so far."""
        return f"{self.shown} frames shown, {self.view}, {self.failed or 'well'}"

    @property
    def view(self) -> View:
        """How the capture node is set: its brightness is an offset; it has no exposure and no gain in dB."""
        brightness = float(self._get("Brightness") - 128)
        full = float(2 ** BITS[self._fourcc] - 1)
        gain = self._get("Gain") / 10
        return View(10_000.0, gain, brightness * full / 255, 0, 0, self._body.width, self._body.height, full)

    def close(self) -> None:
        """End it."""
        self._stop.set()
        self._thread.join(5.0)
        os.close(self._out)
        os.close(self._cap)

    def _timings(self, fd: int) -> bytes:
        """The first progressive timing of the size."""
        for index in range(1000):
            data = bytearray(struct.pack("<I", index).ljust(148, b"\0"))
            fcntl.ioctl(fd, ENUM_DV_TIMINGS, data)
            if struct.unpack_from("<III", data, 20) == (self._body.width, self._body.height, 0):
                return bytes(data[16:148])
        raise ValueError("no such timing")

    def _loop(self) -> None:
        """Output to input, and no text drawn over it."""
        self._choose("OSD Text Mode", "None")
        if "Loop Video" in self._controls:  # Linux up to 6.11
            self._set("Loop Video", 1)
        else:
            name = next(each for each in self._controls if each.startswith("HDMI") and "Connected" in each)
            self._choose(name, "Output")
        # Its automatic gain is the clock's seconds.
        self._set("Gain, Automatic", 0)
        self._set("Gain", 0)

    def _choose(self, name: str, wanted: str) -> None:
        for index in range(64):
            data = bytearray(struct.pack("<II", self._controls[name], index).ljust(44, b"\0"))
            with suppress(OSError):
                fcntl.ioctl(self._cap, QUERYMENU, data)
                if wanted in data[8:40].split(b"\0")[0].decode():
                    self._set(name, index)
                    return
        raise ValueError(f"{name} offers no {wanted}")

    def _get(self, name: str) -> int:
        data = bytearray(struct.pack("<Ii", self._controls[name], 0))
        fcntl.ioctl(self._cap, G_CTRL, data)
        return int(struct.unpack("<Ii", data)[1])

    def _set(self, name: str, value: int) -> None:
        fcntl.ioctl(self._cap, S_CTRL, bytearray(struct.pack("<Ii", self._controls[name], value)))

    def _feed(self) -> None:
        try:
            # Not by write(): the driver in Linux 6.1 answers EINVAL.
            maps = list(self._maps())
            free, on, drawn, picture = list(range(len(maps))), False, None, b""
            while not self._stop.is_set():
                # Drawn anew only when something changed: the emulated processor has others to serve.
                wanted = self._body.scene, self.view
                if wanted != drawn:
                    drawn = wanted
                    picture = _bytes(self._body.draw(wanted[1]), self._fourcc)
                if not free:
                    done = _buffer()
                    fcntl.ioctl(self._out, DQBUF, done)  # when the driver has shown it
                    free.append(struct.unpack_from("<I", done)[0])
                    self.shown += 1
                index = free.pop()
                maps[index][: len(picture)] = picture
                fcntl.ioctl(self._out, QBUF, _buffer(index, len(picture)))
                if not on and not free:
                    fcntl.ioctl(self._out, STREAMON, struct.pack("<i", OUTPUT))
                    on = True
                    self._begun.set()
        except Exception as error:
            # A thread that ends says nothing: the tests ask for this.
            self.failed = repr(error)

    def _maps(self) -> Iterator[mmap.mmap]:
        request = bytearray(struct.pack("<IIIII", 3, OUTPUT, MAPPED, 0, 0))
        fcntl.ioctl(self._out, REQBUFS, request)
        for index in range(struct.unpack_from("<I", request)[0]):
            data = _buffer(index)
            fcntl.ioctl(self._out, QUERYBUF, data)
            (offset,), (length,) = struct.unpack_from("<I", data, 64), struct.unpack_from("<I", data, 72)
            yield mmap.mmap(self._out, length, offset=offset)


def _bytes(picture: NDArray[Any], fourcc: str) -> bytes:
    if fourcc == "YUYV":
        # Every second byte is of colour, of which there is none.
        picture = np.stack([picture, np.full_like(picture, 128)], -1)
    return np.ascontiguousarray(picture, np.uint8 if BITS[fourcc] == 8 else "<u2").tobytes()


def _buffer(index: int = 0, used: int = 0) -> bytearray:
    data = bytearray(88)
    struct.pack_into("<IIIII", data, 0, index, OUTPUT, used, 0, PROGRESSIVE)
    struct.pack_into("<I", data, 60, MAPPED)
    return data


def _controls(fd: int) -> Iterator[tuple[int, str]]:
    last = 0
    while True:
        data = bytearray(struct.pack("<I", last | NEXT).ljust(68, b"\0"))
        try:
            fcntl.ioctl(fd, QUERYCTRL, data)
        except OSError:
            return
        (last,) = struct.unpack_from("<I", data)
        yield last, data[8:40].split(b"\0")[0].decode()
