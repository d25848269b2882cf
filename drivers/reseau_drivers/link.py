"""Byte streams to instruments: serial ports, TCP, UDP, with a deadline for everything; and talk over them."""

from __future__ import annotations

import os
import select
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, Protocol, TypeVar

import serial
from serial.tools import list_ports

from reseau.core.errors import ConnectionLost, DeadlineError, ProtocolError, UsageError
from reseau.instruments import Deadline

from .codecs.stream import Damaged, Decoder

__all__ = ["Link", "MessageLink", "SerialLink", "TcpLink", "UdpLink", "link_to", "serial_ports"]

M = TypeVar("M")

_CHUNK = 65536


class Link(Protocol):
    """A stream of bytes; simulators in the same process have one of their own."""

    def open(self, deadline: Deadline) -> None:
        """Open it anew; nothing of an earlier stream is left."""

    def close(self) -> None:
        """Close it, if it is open."""

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all of it."""

    def pending(self) -> bool:
        """Whether bytes have come that were not read yet."""

    def read(self, deadline: Deadline) -> bytes:
        """What has come; waits for something until the deadline, and is empty after it."""


class SerialLink:
    """A serial port.

    Parameters
    ----------
    port : str
        Device, as ``/dev/ttyUSB0``.
    baud : int
        8 bits, no parity, one stop bit.
    xonxoff : bool
        Whether both sides may ask the other to wait.
    """

    def __init__(self, port: str, baud: int, *, xonxoff: bool = False) -> None:
        self._port, self._baud, self._xonxoff = port, baud, xonxoff
        self._serial: serial.Serial | None = None

    def open(self, deadline: Deadline) -> None:
        """Open the port for oneself alone."""
        self.close()
        try:
            self._serial = serial.Serial(
                self._port,
                self._baud,
                timeout=0.1,
                write_timeout=1.0,
                exclusive=True,
                xonxoff=self._xonxoff,
            )
            self._serial.reset_input_buffer()
        except (OSError, ValueError) as error:
            self.close()
            # pyserial's text repeats the port and the number of the error.
            number = error.errno if isinstance(error, OSError) else None
            why = os.strerror(number) if number else str(error)
            raise ConnectionLost(
                f"{self._port} cannot be opened ({why})", do="is it plugged in, and free?"
            ) from None

    def close(self) -> None:
        """Close the port, if it is open."""
        port, self._serial = self._serial, None
        if port is not None:
            with suppress(OSError):
                port.cancel_read()
                port.close()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all of it."""
        port = self._opened()
        try:
            port.write_timeout = max(0.01, deadline.left)
            port.write(data)
        except serial.SerialTimeoutException:
            raise DeadlineError("took no bytes in the time allowed") from None
        except OSError as error:
            raise ConnectionLost(f"{self._port} went away ({error})", do="is it plugged in?") from None

    def read(self, deadline: Deadline) -> bytes:
        """What has come, or nothing after the deadline."""
        port = self._opened()
        try:
            port.timeout = deadline.left
            first = port.read(1)
            return bytes(first) + (bytes(port.read(min(port.in_waiting, _CHUNK))) if first else b"")
        # pyserial lets a TypeError out where another thread closes the port while it is read.
        except (OSError, TypeError) as error:
            raise ConnectionLost(f"{self._port} went away ({error})", do="is it plugged in?") from None

    def pending(self) -> bool:
        """Whether bytes have come that were not read yet."""
        port = self._opened()
        try:
            return bool(port.in_waiting)
        except (OSError, TypeError) as error:
            raise ConnectionLost(f"{self._port} went away ({error})", do="is it plugged in?") from None

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise ConnectionLost(f"{self._port} is not open")
        return self._serial


class TcpLink:
    """A TCP connection.

    Parameters
    ----------
    host, port : str, int
        Of the instrument.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None

    def open(self, deadline: Deadline) -> None:
        """Connect anew."""
        self.close()
        try:
            self._socket = socket.create_connection(self._address, timeout=max(0.01, deadline.left))
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise ConnectionLost(
                f"{self._where} cannot be reached ({error})", do="is it switched on, and the address right?"
            ) from None

    @property
    def _where(self) -> str:
        return f"{self._address[0]}:{self._address[1]}"

    def close(self) -> None:
        """Disconnect, if connected."""
        connection, self._socket = self._socket, None
        if connection is not None:
            # Closing alone does not wake a thread that waits for bytes.
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all of it."""
        connection = self._opened()
        try:
            connection.settimeout(max(0.01, deadline.left))
            connection.sendall(data)
        except TimeoutError:
            raise DeadlineError("took no bytes in the time allowed") from None
        except OSError as error:
            raise ConnectionLost(f"{self._where} went away ({error})") from None

    def read(self, deadline: Deadline) -> bytes:
        """What has come, or nothing after the deadline."""
        connection = self._opened()
        try:
            connection.settimeout(max(0.001, deadline.left))
            data = connection.recv(_CHUNK)
        except TimeoutError:
            return b""
        except OSError as error:
            raise ConnectionLost(f"{self._where} went away ({error})") from None
        if not data:
            raise ConnectionLost(f"{self._where} closed the connection")
        return data

    def pending(self) -> bool:
        """Whether bytes have come that were not read yet."""
        return bool(select.select([self._opened()], [], [], 0)[0])

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionLost(f"{self._where} is not open")
        return self._socket


class UdpLink:
    """Datagrams to and from one peer, read as one stream; any of them may get lost on the way.

    Parameters
    ----------
    host, port : str, int
        Of the instrument, or of what passes its bytes on.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None

    @property
    def _where(self) -> str:
        return f"udp {self._address[0]}:{self._address[1]}"

    def open(self, deadline: Deadline) -> None:
        """Take a port of one's own: what is still under way to the one before is lost."""
        self.close()
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                *self._address, type=socket.SOCK_DGRAM, proto=socket.IPPROTO_UDP
            )[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.connect(address)
        except OSError as error:
            self.close()
            raise ConnectionLost(
                f"{self._where} cannot be reached ({error})", do="is the address right?"
            ) from None

    def close(self) -> None:
        """Let go of the port, if there is one."""
        held, self._socket = self._socket, None
        if held is not None:
            # Closing alone does not wake a thread that waits for bytes.
            with suppress(OSError):
                held.shutdown(socket.SHUT_RDWR)
            held.close()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send a datagram."""
        held = self._opened()
        try:
            held.settimeout(max(0.01, deadline.left))
            held.send(data)
        except TimeoutError:
            raise DeadlineError("took no bytes in the time allowed") from None
        except OSError as error:
            raise ConnectionLost(f"{self._where} does not listen ({error})", do="is it on?") from None

    def pending(self) -> bool:
        """Whether datagrams have come that were not read yet."""
        return bool(select.select([self._opened()], [], [], 0)[0])

    def read(self, deadline: Deadline) -> bytes:
        """A datagram, or nothing after the deadline."""
        held = self._opened()
        try:
            held.settimeout(max(0.001, deadline.left))
            data = held.recv(_CHUNK)
        except TimeoutError:
            return b""
        except OSError as error:
            raise ConnectionLost(f"{self._where} does not listen ({error})", do="is it on?") from None
        if not data and self._socket is None:
            raise ConnectionLost(f"{self._where} was closed")
        return data

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionLost(f"{self._where} is not open")
        return self._socket


def serial_ports() -> tuple[str, ...]:
    """Serial ports of this machine; found by its entry point."""
    return tuple(sorted(port.device for port in list_ports.comports()))


def link_to(address: str | Link, *, baud: int = 115200, xonxoff: bool = False) -> Link:
    """The link of an address.

    Parameters
    ----------
    address : str or Link
        ``tcp://host:port``, ``udp://host:port``, a serial device, or a link, which is passed through.
    baud : int
        Of a serial device; ``device@baud`` says another one.
    xonxoff : bool
        Of a serial device.

    Raises
    ------
    UsageError
        When it is no address.
    """
    if not isinstance(address, str):
        return address
    scheme, slashes, rest = address.partition("://")
    if slashes:
        host, _, port = rest.rpartition(":")
        if scheme not in _NETWORK or not host or not port.isdigit() or int(port) > 65535:
            raise UsageError("is no address", where=address, do="write tcp://host:port or udp://host:port")
        return _NETWORK[scheme](host.strip("[]"), int(port))
    device, at, speed = address.partition("@")
    if not device or (at and not speed.isdigit()):
        raise UsageError("is no address", where=address, do="write a serial device, or device@baud")
    return SerialLink(device, int(speed) if at else baud, xonxoff=xonxoff)


_NETWORK: dict[str, Callable[[str, int], Link]] = {"tcp": TcpLink, "udp": UdpLink}


class MessageLink(Generic[M]):
    """Messages over a link.

    Parameters
    ----------
    link : Link
        Carries the bytes.
    decoder : Decoder
        Of what the instrument says.

    Attributes
    ----------
    ignored : int
        Messages that were no answer to what had been asked, and damaged ones.
    """

    def __init__(self, link: Link, decoder: Decoder[M]) -> None:
        self._link, self._decoder = link, decoder
        self._received: deque[M | Damaged] = deque()
        self.ignored = 0

    def open(self, deadline: Deadline) -> None:
        """Open the link anew."""
        self._link.open(deadline)
        self._decoder.reset()
        self._received.clear()

    def close(self) -> None:
        """Close it."""
        self._link.close()

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send bytes, and wait for nothing."""
        self._link.write(data, deadline)

    def query(self, data: bytes, is_answer: Callable[[M], bool], deadline: Deadline) -> M:
        """Send a question and wait for its answer; other messages are passed over.

        Raises
        ------
        DeadlineError
            When no answer came in time.
        ProtocolError
            When nothing but damaged ones came in time.
        ConnectionLost
            When the link broke.
        """
        # What is there before the question is no answer to it: one that came twice, or was given up.
        while self._link.pending() and not deadline.expired:
            self.ignored += len(self._decoder.feed(self._link.read(deadline)))
        self.ignored += len(self._received)
        self._received.clear()
        self.send(data, deadline)
        return self.receive(is_answer, deadline)

    def receive(self, is_answer: Callable[[M], bool], deadline: Deadline) -> M:
        """Wait for a message; raises as :meth:`query`."""
        damaged: Damaged | None = None
        while True:
            while self._received:
                message = self._received.popleft()
                if isinstance(message, Damaged):
                    damaged = message
                elif is_answer(message):
                    return message
                self.ignored += 1
            if deadline.expired:
                if damaged is not None:
                    raise ProtocolError(f"its answer was damaged ({damaged})", do="check cable and speed")
                raise DeadlineError(
                    f"did not answer within {deadline.seconds:g} s", do="is it switched on, and free?"
                )
            self._received += self._decoder.feed(self._link.read(deadline))
