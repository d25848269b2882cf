"""A limit to what pyvisa-py takes for one call of ours, and a hand on the sockets that it opens.

Its VXI-11 and HiSLIP believe the lengths that a peer announces, up to 2 GB and 2⁶⁴: they reserve it, gather
bytes as long as some come, and lose their sockets when they fail while they open. So for a thread that has an
account, its sockets and buffers are counted; for every other thread they are as they always were.
"""

from __future__ import annotations

import builtins
import socket
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pyvisa_py.protocols import hislip, rpc

from reseau.core.errors import ProtocolError

__all__ = ["Account"]

_AT_ONCE = 1 << 20
_thread = threading.local()


class Account:
    """What the calls of one link may take and have opened.

    Parameters
    ----------
    size : int
        Bytes that a call may take.
    """

    def __init__(self, size: int) -> None:
        self.size = self._left = size
        self._sockets: list[socket.socket] = []

    @contextmanager
    def open(self) -> Iterator[None]:
        """For one call, on this thread."""
        self._left, _thread.account = self.size, self
        try:
            yield
        finally:
            _thread.account = None

    def opened(self, made: socket.socket) -> None:
        """Remember a socket."""
        self._sockets.append(made)

    def spend(self, count: int) -> None:
        """Count bytes that came, or are to be reserved; raises ProtocolError when they are too many."""
        self._left -= count
        if self._left < 0:
            raise ProtocolError(f"sent, or announced, more than {self.size} bytes in one answer")

    def cut(self) -> None:
        """Close all sockets, whoever waits for them."""
        sockets, self._sockets = self._sockets, []
        for each in sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            # pyvisa-py takes the end of a VXI-11 stream for silence, and asks again; not of a closed one.
            each.close()


def _account() -> Account | None:
    return getattr(_thread, "account", None)


class _Counted(socket.socket):
    """A socket that counts, and asks for no more at once than it may be worth."""

    def __init__(self, *kind: Any, **more: Any) -> None:
        super().__init__(*kind, **more)
        if account := _account():
            account.opened(self)

    def recv(self, size: int, flags: int = 0, /) -> bytes:
        data = super().recv(min(size, _AT_ONCE), flags)
        if account := _account():
            account.spend(len(data))
        return data

    def recv_into(self, buffer: Any, size: int = 0, flags: int = 0, /) -> int:
        count = super().recv_into(buffer, size, flags)
        if account := _account():
            account.spend(count)
        return count


def _counted_bytearray(source: Any = b"") -> bytearray:
    """A bytearray; one of a size is of zeros, which takes its memory at once."""
    if isinstance(source, int) and (account := _account()) and source > account.size:
        account.spend(source)
    return builtins.bytearray(source)


class _SocketModule(types.ModuleType):
    """The module socket, but for its class."""

    socket = _Counted

    def __getattr__(self, name: str) -> Any:
        return getattr(socket, name)


for _module in (rpc, hislip):
    _module.socket = _SocketModule("socket")
    _module.bytearray = _counted_bytearray
