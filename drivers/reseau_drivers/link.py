"""Byte streams to instruments (serial ports, TCP, UDP) with time limits, and message exchange over them."""

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

M = TypeVar("M")

_CHUNK = 65536


class Link(Protocol):
    """Stream of bytes to an instrument; simulators in the same process implement it too.

    Links whose protocol has an end of messages have an attribute `ended`: whether the last bytes end one.
    """

    def open(self, deadline: Deadline) -> None:
        """Open the stream; an open one is closed before and its data are discarded."""

    def close(self) -> None:
        """Close the stream if it is open."""

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all bytes."""

    def pending(self) -> bool:
        """Whether bytes have arrived that were not read yet."""

    def read(self, deadline: Deadline) -> bytes:
        """Return the bytes received; wait for some until the deadline, and return none after it."""


class SerialLink:
    """Serial port.

    Parameters
    ----------
    port : str
        Device, such as ``/dev/ttyUSB0``.
    baud : int
        Speed (baud), with 8 bits, no parity, one stop bit.
    xonxoff : bool
        Whether to use software flow control.
    keep_up : bool
        Whether the line that tells a computer's presence (DTR) stays up after closing: many boards start anew
        when it comes up.

    Examples
    --------
    >>> SerialLink("/dev/ttyUSB0", 9600).read(Deadline(1.0))
    Traceback (most recent call last):
    reseau.core.errors.ConnectionLost: /dev/ttyUSB0 is not open
    """

    def __init__(self, port: str, baud: int, *, xonxoff: bool = False, keep_up: bool = False) -> None:
        self._port, self._baud, self._xonxoff, self._keep_up = port, baud, xonxoff, keep_up
        self._serial: serial.Serial | None = None

    def open(self, deadline: Deadline) -> None:
        """Open the port with exclusive access."""
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
            if self._keep_up:
                _keep_up(self._serial)
            self._serial.reset_input_buffer()
        except (OSError, ValueError) as error:
            self.close()
            # pyserial's text repeats the port and the number of the error.
            number = error.errno if isinstance(error, OSError) else None
            why = os.strerror(number) if number else str(error)
            raise ConnectionLost(
                f"{self._port} cannot be opened ({why})",
                do="check the cable, and whether another program uses it",
            ) from None

    def close(self) -> None:
        """Close the port if it is open."""
        port, self._serial = self._serial, None
        if port is not None:
            with suppress(OSError):
                port.cancel_read()
                port.close()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all bytes."""
        port = self._opened()
        try:
            port.write_timeout = max(0.1, deadline.left)
            port.write(data)
        except serial.SerialTimeoutException:
            raise DeadlineError("took no bytes in the time allowed") from None
        except OSError as error:
            raise ConnectionLost(f"{self._port} went away ({error})", do="is it plugged in?") from None

    def read(self, deadline: Deadline) -> bytes:
        """Return the bytes received; none after the deadline."""
        port = self._opened()
        try:
            port.timeout = deadline.left
            first = port.read(1)
            return bytes(first) + (bytes(port.read(min(port.in_waiting, _CHUNK))) if first else b"")
        # pyserial raises TypeError when another thread closes the port during a read.
        except (OSError, TypeError) as error:
            raise ConnectionLost(f"{self._port} went away ({error})", do="is it plugged in?") from None

    def pending(self) -> bool:
        """Whether bytes have arrived that were not read yet."""
        port = self._opened()
        try:
            return bool(port.in_waiting)
        except (OSError, TypeError) as error:
            raise ConnectionLost(f"{self._port} went away ({error})", do="is it plugged in?") from None

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise ConnectionLost(f"{self._port} is not open")
        return self._serial


def _keep_up(port: serial.Serial) -> None:
    """Keep a terminal from taking DTR down when it is closed; other systems do not offer this."""
    try:
        import termios
    except ImportError:
        return
    with suppress(termios.error):
        flags = termios.tcgetattr(port.fileno())
        flags[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, flags)


class TcpLink:
    """TCP connection.

    Parameters
    ----------
    host, port : str, int
        Address of the instrument.

    Examples
    --------
    >>> TcpLink("192.0.2.7", 5025).pending()
    Traceback (most recent call last):
    reseau.core.errors.ConnectionLost: 192.0.2.7:5025 is not open
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None

    def open(self, deadline: Deadline) -> None:
        """Connect; an existing connection is closed before."""
        self.close()
        try:
            self._socket = socket.create_connection(self._address, timeout=max(0.01, deadline.left))
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise ConnectionLost(
                f"{self._where} cannot be reached ({error})", do="check power and address"
            ) from None

    @property
    def _where(self) -> str:
        return f"{self._address[0]}:{self._address[1]}"

    def close(self) -> None:
        """Close the connection if there is one."""
        connection, self._socket = self._socket, None
        if connection is not None:
            # Closing alone does not wake a thread that waits for bytes.
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all bytes."""
        connection = self._opened()
        try:
            connection.settimeout(max(0.01, deadline.left))
            connection.sendall(data)
        except TimeoutError:
            raise DeadlineError("took no bytes in the time allowed") from None
        except OSError as error:
            raise ConnectionLost(f"{self._where} went away ({error})") from None

    def read(self, deadline: Deadline) -> bytes:
        """Return the bytes received; none after the deadline."""
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
        """Whether bytes have arrived that were not read yet."""
        return bool(select.select([self._opened()], [], [], 0)[0])

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionLost(f"{self._where} is not open")
        return self._socket


class UdpLink:
    """Datagrams to and from one peer, read as one stream; datagrams may be lost.

    Parameters
    ----------
    host, port : str, int
        Address of the instrument or of a relay.

    Examples
    --------
    >>> UdpLink("192.0.2.7", 9092).pending()
    Traceback (most recent call last):
    reseau.core.errors.ConnectionLost: udp 192.0.2.7:9092 is not open
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None

    @property
    def _where(self) -> str:
        return f"udp {self._address[0]}:{self._address[1]}"

    def open(self, deadline: Deadline) -> None:
        """Open a new port, so that datagrams to the previous one are discarded."""
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
                f"{self._where} cannot be reached ({error})", do="check the address"
            ) from None

    def close(self) -> None:
        """Close the port if it is open."""
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
        """Whether datagrams have arrived that were not read yet."""
        return bool(select.select([self._opened()], [], [], 0)[0])

    def read(self, deadline: Deadline) -> bytes:
        """Return a datagram; nothing after the deadline."""
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
    """List the serial ports of this computer; entry point ``serial``.

    Examples
    --------
    >>> isinstance(serial_ports(), tuple)
    True
    """
    return tuple(sorted(port.device for port in list_ports.comports()))


def link_to(address: str | Link, *, baud: int = 115200, xonxoff: bool = False, keep_up: bool = False) -> Link:
    """Return the link for an address.

    Parameters
    ----------
    address : str or Link
        ``tcp://host:port``, ``udp://host:port``, a serial device, or a link (returned as it is).
    baud : int
        Speed of a serial device; the address ``device@baud`` overrides it.
    xonxoff, keep_up : bool
        For a serial device, as for :class:`SerialLink`.

    Raises
    ------
    UsageError
        If the address is not valid.

    Examples
    --------
    >>> type(link_to("tcp://192.0.2.7:4000")).__name__, type(link_to("/dev/ttyUSB0@9600")).__name__
    ('TcpLink', 'SerialLink')
    >>> link_to("http://host:80")
    Traceback (most recent call last):
    reseau.core.errors.UsageError: http://host:80: is not a valid address; write tcp://host:port or
    udp://host:port
    """
    if not isinstance(address, str):
        return address
    scheme, slashes, rest = address.partition("://")
    if slashes:
        host, _, port = rest.rpartition(":")
        if scheme not in _NETWORK or not host or not port.isdigit() or int(port) > 65535:
            raise UsageError(
                "is not a valid address", where=address, do="write tcp://host:port or udp://host:port"
            )
        return _NETWORK[scheme](host.strip("[]"), int(port))
    device, at, speed = address.partition("@")
    if not device or (at and not speed.isdigit()):
        raise UsageError("is not a valid address", where=address, do="write a serial device, or device@baud")
    return SerialLink(device, int(speed) if at else baud, xonxoff=xonxoff, keep_up=keep_up)


_NETWORK: dict[str, Callable[[str, int], Link]] = {"tcp": TcpLink, "udp": UdpLink}


class MessageLink(Generic[M]):
    """Exchange of messages over a link.

    Parameters
    ----------
    link : Link
        Carries the bytes.
    decoder : Decoder
        Decodes the messages of the instrument.
    overhear : callable, optional
        Called with each message that is not an answer: some instruments report events unasked.

    Attributes
    ----------
    ignored : int
        Number of damaged messages and of messages that were not the expected answer.

    Examples
    --------
    >>> from reseau_drivers.codecs.stream import LineDecoder
    >>> messages = MessageLink(link_to("tcp://192.0.2.7:4000"), LineDecoder())
    >>> messages.ignored
    0
    """

    def __init__(
        self, link: Link, decoder: Decoder[M], overhear: Callable[[M], None] = lambda message: None
    ) -> None:
        self._link, self._decoder, self._overhear = link, decoder, overhear
        self._received: deque[M | Damaged] = deque()
        self.ignored = 0

    def open(self, deadline: Deadline) -> None:
        """Open the link; an open one is closed before."""
        self._link.open(deadline)
        self._decoder.reset()
        self._received.clear()

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send bytes without waiting for an answer."""
        self._link.write(data, deadline)

    def query(self, data: bytes, is_answer: Callable[[M], bool], deadline: Deadline) -> M:
        """Send a query and wait for its answer; other messages are ignored.

        Parameters
        ----------
        data : bytes
            Encoded query.
        is_answer : callable
            Whether a message is the answer.
        deadline : Deadline
            Time limit.

        Raises
        ------
        DeadlineError
            If no answer arrives in time.
        ProtocolError
            If only damaged messages arrive in time.
        ConnectionLost
            If the connection is lost.
        """
        # Messages that arrived before the query do not answer it: repeated or abandoned answers.
        while self._received:
            self._ignore(self._received.popleft())
        while self._link.pending() and not deadline.expired:
            for message in self._decoder.feed(self._link.read(deadline)):
                self._ignore(message)
        self.send(data, deadline)
        return self.receive(is_answer, deadline)

    def receive(self, is_answer: Callable[[M], bool], deadline: Deadline) -> M:
        """Wait for a message; raises as :meth:`query`."""
        damaged: Damaged | None = None
        read = False
        while True:
            while self._received:
                message = self._received.popleft()
                if isinstance(message, Damaged):
                    damaged = message
                elif is_answer(message):
                    return message
                self._ignore(message)
            # What has arrived is read, also where a busy machine held this process up until the deadline.
            if read and deadline.expired:
                if damaged is not None:
                    raise ProtocolError(f"the answer was damaged ({damaged})", do="check cable and baud rate")
                raise DeadlineError(
                    f"did not answer within {deadline.seconds:g} s",
                    do="check power, and whether another program uses it",
                )
            self._received += self._decoder.feed(self._link.read(deadline))
            read = True

    def _ignore(self, message: M | Damaged) -> None:
        self.ignored += 1
        if not isinstance(message, Damaged):
            self._overhear(message)
