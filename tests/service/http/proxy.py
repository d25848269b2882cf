"""A proxy between client and server on this machine: cuts connections, or holds back what they carry."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from types import TracebackType
from typing import Self


class Proxy:
    """Passes on what arrives at an address of its own.

    Parameters
    ----------
    server : int
        Port of the server on 127.0.0.1.
    host, port
        Where it listens; port 0: a free one.
    cut_s : float, optional
        Time after which all connections are cut, again and again.
    """

    def __init__(
        self, server: int, host: str = "127.0.0.1", port: int = 0, cut_s: float | None = None
    ) -> None:
        self._to, self._cut_s, self._pairs = server, cut_s, set[tuple[socket.socket, socket.socket]]()
        self._over, self._open, self.cut = threading.Event(), threading.Event(), 0
        self._open.set()
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._server = socket.create_server((host, port), family=family)
        self.port = int(self._server.getsockname()[1])
        for work in (self._accept, *([self._cut_again] if cut_s else [])):
            threading.Thread(target=work, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._over.set()
        self._open.set()
        self._server.shutdown(socket.SHUT_RDWR)  # whoever accepts holds it open otherwise
        self._server.close()
        self.cut_all()

    def hold(self) -> None:
        """Hold back everything, as where a cable is pulled: no connection ends."""
        self._open.clear()

    def release(self) -> None:
        """Pass everything on again."""
        self._open.set()

    def cut_all(self) -> None:
        """Cut all connections."""
        for pair in list(self._pairs):
            self._pairs.discard(pair)
            self.cut += 1
            for each in pair:
                with suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)
                each.close()

    def _accept(self) -> None:
        while not self._over.is_set():
            with suppress(OSError):
                here, _ = self._server.accept()
                try:
                    there = socket.create_connection(("127.0.0.1", self._to))
                except OSError:
                    here.close()
                    continue
                self._pairs.add((here, there))
                for a, b in ((here, there), (there, here)):
                    threading.Thread(target=self._pass, args=(a, b), daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while part := source.recv(1 << 16):
                self._open.wait()
                target.sendall(part)
        for each in (source, target):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _cut_again(self) -> None:
        while not self._over.wait(self._cut_s):
            self.cut_all()
