"""Simulated instruments behind UDP, as a vehicle's computer passes the bytes of its sonar on."""

from __future__ import annotations

import socket
from collections.abc import Callable

from .machine import Session
from .servers import Server

__all__ = ["UdpServer"]

_LARGEST, _LARGEST_EVER = 4096, 65536
"""Bytes of a datagram that is sent, as clients by others take it; and of one that is taken."""


class UdpServer(Server):
    """Serves datagrams on a port of the loopback interface; whoever spoke last is answered.

    Parameters
    ----------
    open_session : callable
        Makes the session of a client that was not heard before.
    port : int
        0 takes a free one.
    """

    HOST = "127.0.0.1"

    def __init__(self, open_session: Callable[[], Session], port: int = 0) -> None:
        super().__init__(open_session)
        self.port = port
        self._peer: tuple[str, int] | None = None
        self._bind()

    def _bind(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((self.HOST, self.port))
        self.port = int(self._socket.getsockname()[1])
        self._peer = None
        self._add(self._socket.fileno(), self._socket.close)

    @property
    def address(self) -> str:
        """``udp://127.0.0.1:port``."""
        return f"udp://{self.HOST}:{self.port}"

    def _accept(self, fd: int) -> bool:
        return False

    def _read(self, fd: int) -> bytes:
        data, peer = self._socket.recvfrom(_LARGEST_EVER)
        if not data:
            raise BlockingIOError
        if peer != self._peer:
            # What another had begun is not continued.
            self._peer = peer
            self._connections[fd].session.hung_up()
        return data

    def _write(self, fd: int, data: bytes) -> int:
        if self._peer is None:
            return len(data)
        return self._socket.sendto(data[:_LARGEST], self._peer)

    def _after_loss(self) -> None:
        self._bind()

    def _release(self) -> None:
        """Its socket was its connection."""
