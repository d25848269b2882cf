"""Limit the bytes that pyvisa-py accepts in one call, and close the sockets that it opens.

Its VXI-11 and HiSLIP modules trust the lengths that a peer announces, up to 2 GB and 2⁶⁴ bytes: they allocate
that size, read as long as bytes arrive, and lose their sockets when opening fails. Therefore sockets and
buffers of threads with an account are counted; all other threads use the ordinary ones.
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

_AT_ONCE = 1 << 20
_thread = threading.local()


class Account:
    """Limits and open sockets of the calls of one link.

    Parameters
    ----------
    size : int
        Largest number of bytes that a call may receive.

    Examples
    --------
    >>> account = Account(100)
    >>> with account.open():
    ...     account.spend(60)
    ...     account.spend(60)
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: sent, or announced, more than 100 bytes in one answer
    """

    def __init__(self, size: int) -> None:
        self.size = self._left = size
        self._sockets: list[socket.socket] = []

    @contextmanager
    def open(self) -> Iterator[None]:
        """Apply the limits to one call on this thread."""
        self._left, _thread.account = self.size, self
        try:
            yield
        finally:
            _thread.account = None

    def opened(self, made: socket.socket) -> None:
        """Register a socket."""
        self._sockets.append(made)

    def spend(self, count: int) -> None:
        """Count bytes received or to be allocated.

        Raises
        ------
        ProtocolError
            If the limit is exceeded.
        """
        self._left -= count
        if self._left < 0:
            raise ProtocolError(f"sent, or announced, more than {self.size} bytes in one answer")

    def cut(self) -> None:
        """Close all sockets, also those that a thread waits for."""
        sockets, self._sockets = self._sockets, []
        for each in sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            # pyvisa-py reads on at the end of a VXI-11 stream, but not from a closed socket.
            each.close()


def _account() -> Account | None:
    return getattr(_thread, "account", None)


class _Counted(socket.socket):
    """Socket that counts bytes and limits the size of a single read."""

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
    """Replacement for bytearray that counts the memory of large buffers before it is allocated."""
    if isinstance(source, int) and (account := _account()) and source > account.size:
        account.spend(source)
    return builtins.bytearray(source)


class _SocketModule(types.ModuleType):
    """The module ``socket`` with another socket class."""

    socket = _Counted

    def __getattr__(self, name: str) -> Any:
        return getattr(socket, name)


for _module in (rpc, hislip):
    _module.socket = _SocketModule("socket")
    _module.bytearray = _counted_bytearray
