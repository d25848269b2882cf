"""The seam between the driver and the kernel: one node of a device, and what can be done with it."""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import select
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from reseau.core.errors import ConnectionLost

__all__ = ["KernelNode", "Mapping", "Node", "OpenNode", "video_devices"]


class Mapping(Protocol):
    """Memory shared with the device."""

    def __getitem__(self, part: slice, /) -> bytes:
        """A copy of a part."""

    def close(self) -> None:
        """Give it back."""


class Node(Protocol):
    """A device that has been opened; raises OSError as the kernel does."""

    def ioctl(self, request: int, data: bytearray) -> None:
        """Ask or tell it something; the answer replaces the data."""

    def map(self, length: int, offset: int) -> Mapping:
        """Map memory of it."""

    def wait(self, seconds: float) -> bool:
        """Wait until a frame can be fetched; whether it can."""

    def close(self) -> None:
        """Close it."""


OpenNode = Callable[[], Node]


class KernelNode:
    """A device node.

    Parameters
    ----------
    path : str
        As ``/dev/video0``, or one of the links in ``/dev/v4l/by-id`` that stay.

    Raises
    ------
    ConnectionLost
        When it cannot be opened.
    """

    def __init__(self, path: str) -> None:
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise ConnectionLost(
                f"{path} cannot be opened ({error.strerror})", do="is it plugged in, and may you use it?"
            ) from None
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def ioctl(self, request: int, data: bytearray) -> None:
        """Ask or tell it something; the answer replaces the data."""
        fcntl.ioctl(self._fd, request, data, True)

    def map(self, length: int, offset: int) -> Mapping:
        """Map memory of it."""
        return mmap.mmap(self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, seconds: float) -> bool:
        """Wait until a frame can be fetched; whether it can."""
        for _, events in self._poll.poll(max(0, int(seconds * 1000))):
            if events & select.POLLIN:
                return True
            # Unplugged it hangs up; an error alone is one of its queue of buffers.
            number = errno.EIO if events == select.POLLERR else errno.ENODEV
            raise OSError(number, os.strerror(number))
        return False

    def close(self) -> None:
        """Close it."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):
                os.close(fd)


def video_devices() -> tuple[str, ...]:
    """Nodes of video devices, by the links that stay where there are any; found by its entry point."""
    stable = sorted(str(path) for path in Path("/dev/v4l/by-id").glob("*"))
    return tuple(stable or sorted(str(path) for path in Path("/dev").glob("video*")))
