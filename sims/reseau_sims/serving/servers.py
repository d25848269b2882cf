"""Servers of simulated instruments: TCP and UDP on loopback, pseudo-terminals, and links within one process.

A server is one thread that waits for all its connections. It does not trust its client: the output of a
connection is limited, and a client that does not read is disconnected.
"""

from __future__ import annotations

import heapq
import os
import selectors
import shutil
import socket
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Self

from reseau.core.errors import ConnectionLost, UsageError
from reseau.instruments import Deadline

from .faults import Output
from .machine import Session

_CHUNK = 65536
_MOST_UNSENT = 64_000_000
_LARGEST_SENT, _LARGEST_RECEIVED = 4096, 65536
"""Bytes of a datagram that is sent, as clients by others take it; and of one that is taken."""


class _Connection:
    """File descriptor, session, and pending output."""

    def __init__(self, fd: int, session: Session, close: Callable[[], None]) -> None:
        self.fd, self.session, self.close = fd, session, close
        self.ready = bytearray()
        self._due: list[tuple[float, int, bytes | None]] = []
        self._send_order = 0
        self._last = 0.0

    def put(self, outputs: list[Output]) -> None:
        """Queue the outputs of a session; later outputs are never sent before earlier ones."""
        for delay, data in outputs:
            self._last = max(self._last, time.monotonic() + delay)
            heapq.heappush(self._due, (self._last, self._send_order, data))
            self._send_order += 1

    def mature(self) -> bool:
        """Move due outputs to the send buffer; False if the session closes the connection."""
        while self._due and self._due[0][0] <= time.monotonic():
            data = heapq.heappop(self._due)[2]
            if data is None:
                return False
            self.ready += data
        return len(self.ready) <= _MOST_UNSENT

    @property
    def emission(self) -> float | None:
        """Time at which the instrument sends something unasked."""
        due: float | None = getattr(self.session, "due", None)
        return due

    @property
    def next_due(self) -> float | None:
        """Time of the next output."""
        return self._due[0][0] if self._due else None


class Server(ABC):
    """Serves connections in a thread of its own.

    Parameters
    ----------
    open_session : callable
        Creates the session of a new connection.

    Examples
    --------
    >>> from reseau_sims.serving import FaultyConnection, ZaberChain
    >>> chain = ZaberChain([1])
    >>> with TcpServer(lambda: FaultyConnection(chain)) as server:
    ...     isinstance(server, Server)
    True
    """

    def __init__(self, open_session: Callable[[], Session]) -> None:
        self._open_session = open_session
        self._selector = selectors.DefaultSelector()
        self._wake_out, self._wake_in = os.pipe()
        self._selector.register(self._wake_out, selectors.EVENT_READ)
        self._connections: dict[int, _Connection] = {}
        self._closing, self._drop_all = False, False
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    @property
    @abstractmethod
    def address(self) -> str:
        """Address for a driver."""

    @abstractmethod
    def _accept(self, fd: int) -> bool:
        """Accept a connection if the descriptor is a listener; return whether it is."""

    @abstractmethod
    def _release(self) -> None:
        """Close everything except connections."""

    @abstractmethod
    def _after_loss(self) -> None:
        """Handle the end of a connection."""

    def start(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def close(self) -> None:
        """Close all connections and end the thread."""
        if self._closing:
            return
        self._closing = True
        self._wake()
        self._thread.join(10.0)
        os.close(self._wake_in)

    def hang_up(self) -> None:
        """Break all connections, as when a cable is pulled."""
        self._drop_all = True
        self._wake()

    def _wake(self) -> None:
        # The thread may have seen the flag already and ended.
        with suppress(BrokenPipeError):
            os.write(self._wake_in, b"x")

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add(self, fd: int, close: Callable[[], None]) -> None:
        os.set_blocking(fd, False)
        self._connections[fd] = _Connection(fd, self._open_session(), close)
        self._selector.register(fd, selectors.EVENT_READ)

    def _remove(self, connection: _Connection) -> None:
        del self._connections[connection.fd]
        self._selector.unregister(connection.fd)
        connection.session.disconnected()
        with suppress(OSError):
            connection.close()
        if not self._closing:
            self._after_loss()

    def _run(self) -> None:
        try:
            while not self._closing:
                for key, events in self._selector.select(self._patience()):
                    self._serve(key.fd, events)
                if self._drop_all:
                    self._drop_all = False
                    for connection in list(self._connections.values()):
                        self._remove(connection)
                for connection in list(self._connections.values()):
                    if (due := connection.emission) is not None and due <= time.monotonic():
                        connection.put(connection.session.emit())  # type: ignore[attr-defined]
                    self._flush(connection)
        finally:
            self._closing = True
            for connection in list(self._connections.values()):
                self._remove(connection)
            self._selector.close()
            os.close(self._wake_out)
            self._release()

    def _patience(self) -> float | None:
        times = [at for c in self._connections.values() for at in (c.next_due, c.emission)]
        due = [at for at in times if at is not None]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def _serve(self, fd: int, events: int) -> None:
        if fd == self._wake_out:
            os.read(fd, 64)
            return
        if self._accept(fd):
            return
        connection = self._connections.get(fd)
        if connection is None or not events & selectors.EVENT_READ:
            return
        try:
            data = self._read(fd)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._remove(connection)
            return
        connection.put(connection.session.receive(data))

    def _read(self, fd: int) -> bytes:
        """Return the bytes from a client; none if it disconnected."""
        return os.read(fd, _CHUNK)

    def _write(self, fd: int, data: bytes) -> int:
        """Send as many bytes as possible; return their number."""
        return os.write(fd, data)

    def _flush(self, connection: _Connection) -> None:
        alive = connection.mature()
        try:
            while connection.ready:
                sent = self._write(connection.fd, bytes(connection.ready[:_CHUNK]))
                del connection.ready[:sent]
        except BlockingIOError:
            pass
        except OSError:
            alive = False
        if not alive:
            self._remove(connection)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if connection.ready else 0)
        self._selector.modify(connection.fd, wanted)


class TcpServer(Server):
    """Serves on a port of the loopback interface.

    Parameters
    ----------
    open_session : callable
        Creates the session of a new connection.
    port : int
        Port; 0 selects a free one.

    Examples
    --------
    >>> from reseau_sims.serving import FaultyConnection, ZaberChain
    >>> chain = ZaberChain([1])
    >>> with TcpServer(lambda: FaultyConnection(chain)) as server:
    ...     server.address.startswith("tcp://127.0.0.1:")
    True
    """

    HOST = "127.0.0.1"

    def __init__(self, open_session: Callable[[], Session], port: int = 0) -> None:
        super().__init__(open_session)
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((self.HOST, port))
        except OSError:
            self._listener.close()
            self._selector.close()
            for fd in (self._wake_out, self._wake_in):
                os.close(fd)
            raise
        self._listener.listen(16)
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._selector.register(self._listener, selectors.EVENT_READ)

    @property
    def address(self) -> str:
        """``tcp://127.0.0.1:port``."""
        return f"tcp://{self.HOST}:{self.port}"

    def _accept(self, fd: int) -> bool:
        if fd != self._listener.fileno():
            return False
        with suppress(OSError):
            connection, _ = self._listener.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._add(connection.fileno(), connection.close)
        return True

    def _after_loss(self) -> None:
        """Do nothing: other clients can connect."""

    def _release(self) -> None:
        self._listener.close()


class UdpServer(Server):
    """Serves datagrams on a port of the loopback interface; answers go to the last sender.

    Parameters
    ----------
    open_session : callable
        Creates the session of a new client.
    port : int
        Port; 0 selects a free one.

    Examples
    --------
    >>> from reseau_sims.serving import FaultyConnection, Ping360
    >>> sonar = Ping360()
    >>> with UdpServer(lambda: FaultyConnection(sonar)) as server:
    ...     server.address.startswith("udp://127.0.0.1:")
    True
    """

    HOST = "127.0.0.1"

    def __init__(self, open_session: Callable[[], Session], port: int = 0) -> None:
        super().__init__(open_session)
        self.port = port
        self._peer: tuple[str, int] | None = None
        self._bind()

    def _bind(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        self._socket.bind((self.HOST, self.port))
        self.port = int(self._socket.getsockname()[1])
        self._peer = None
        self._add(self._socket.fileno(), lambda: None)

    @property
    def address(self) -> str:
        """``udp://127.0.0.1:port``."""
        return f"udp://{self.HOST}:{self.port}"

    def _accept(self, fd: int) -> bool:
        return False

    def _read(self, fd: int) -> bytes:
        data, peer = self._socket.recvfrom(_LARGEST_RECEIVED)
        if not data:
            raise BlockingIOError
        if peer != self._peer:
            # Discard an incomplete message of another client.
            self._peer = peer
            self._connections[fd].session.disconnected()
        return data

    def _write(self, fd: int, data: bytes) -> int:
        if self._peer is None:
            return len(data)
        return self._socket.sendto(data[:_LARGEST_SENT], self._peer)

    def _after_loss(self) -> None:
        # Nobody else gets the port meanwhile.
        with self._socket:
            self._bind()

    def _release(self) -> None:
        self._socket.close()


class PtyServer(Server):
    """Serves on a pseudo-terminal with a name that persists when it is unplugged and plugged in again.

    Parameters
    ----------
    open_session : callable
        Creates the session of a new connection.

    Examples
    --------
    >>> from reseau_sims.serving import FaultyConnection, ZaberChain
    >>> chain = ZaberChain([1])
    >>> with PtyServer(lambda: FaultyConnection(chain)) as server:
    ...     os.path.basename(server.address)
    'tty'
    """

    def __init__(self, open_session: Callable[[], Session]) -> None:
        super().__init__(open_session)
        self._folder = tempfile.mkdtemp(prefix="reseau-")
        self._slave = -1
        self._plug_in()

    @property
    def address(self) -> str:
        """Path of the terminal."""
        return os.path.join(self._folder, "tty")

    def _plug_in(self) -> None:
        try:
            import tty
        except ImportError:
            raise UsageError(
                "this system has none", where="pseudo-terminals", do="use Linux or macOS"
            ) from None
        master, slave = os.openpty()
        tty.setraw(slave)
        # Keep one end open: otherwise the master is disconnected whenever the client closes.
        old, self._slave = self._slave, slave
        if old >= 0:
            os.close(old)
        draft = f"{self.address}.new"
        os.symlink(os.ttyname(slave), draft)
        os.replace(draft, self.address)
        self._add(master, lambda: os.close(master))

    def _after_loss(self) -> None:
        self._plug_in()

    def _accept(self, fd: int) -> bool:
        return False

    def _release(self) -> None:
        os.close(self._slave)
        shutil.rmtree(self._folder, ignore_errors=True)


class InProcess:
    r"""Link to a simulator in the same process, without sockets or threads.

    Parameters
    ----------
    open_session : callable
        Creates the session of a new connection.

    Examples
    --------
    >>> from reseau_sims.serving import FaultyConnection, ZaberChain
    >>> chain = ZaberChain([1])
    >>> link = InProcess(lambda: FaultyConnection(chain))
    >>> link.open(Deadline(1.0))
    >>> link.write(b"/01 0 00 tools echo:BF\n", Deadline(1.0))
    >>> link.read(Deadline(1.0))
    b'@01 0 00 OK IDLE WR 0:BE\r\n'
    """

    def __init__(self, open_session: Callable[[], Session]) -> None:
        self._open_session = open_session
        self._connection: _Connection | None = None

    def open(self, deadline: Deadline) -> None:
        """Open a session; an open one is ended before."""
        self.close()
        self._connection = _Connection(-1, self._open_session(), lambda: None)

    def close(self) -> None:
        """End the session."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.session.disconnected()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Pass the bytes to the simulator."""
        connection = self._opened()
        connection.put(connection.session.receive(data))

    def pending(self) -> bool:
        """Whether bytes are due."""
        connection = self._opened()
        if (due := connection.emission) is not None and due <= time.monotonic():
            connection.put(connection.session.emit())  # type: ignore[attr-defined]
        if not connection.mature():
            self.close()
            raise ConnectionLost("the simulator closed the connection")
        return bool(connection.ready)

    def read(self, deadline: Deadline) -> bytes:
        """Return the bytes that are due before the deadline."""
        while not self.pending():
            connection = self._opened()
            due = min(
                (at for at in (connection.next_due, connection.emission) if at is not None), default=None
            )
            if due is None or due - time.monotonic() > deadline.left:
                time.sleep(deadline.left)
                return b""
            time.sleep(max(0.0, due - time.monotonic()))
        connection = self._opened()
        data = bytes(connection.ready[:_CHUNK])
        del connection.ready[: len(data)]
        return data

    def _opened(self) -> _Connection:
        if self._connection is None:
            raise ConnectionLost("the simulator is not connected")
        return self._connection
