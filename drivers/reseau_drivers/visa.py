"""VISA resources as links: VXI-11, HiSLIP and USBTMC through pyvisa-py, with deadlines that hold.

pyvisa-py applies its time-outs to each chunk, and none at all while it opens a connection. Each link
therefore makes its calls in a thread of its own; when a call exceeds its deadline, its sockets are closed,
and no call receives more bytes than its budget.

USB uses PyUSB. pyvisa-py takes the system's libusb-1.0 where there is one, and otherwise the library of the
Python package ``libusb-package``, which is a dependency of this project.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import pyvisa
from pyvisa import constants

from reseau.core.errors import ConnectionLost, DeadlineError, InstrumentError, UsageError
from reseau.instruments import Deadline

from .budget import Account
from .link import Link, TcpLink, link_to

_READ = 1 << 20
"""Bytes requested in one read; longer messages take several reads."""
_MOST = 16 << 20
"""Bytes that one call may receive; an image takes several reads."""
_GRACE_S = 0.3
_MESSAGE_AVAILABLE = 0x10

_lock = threading.Lock()
_manager: pyvisa.ResourceManager | None = None


def _resource_manager() -> pyvisa.ResourceManager:
    """Return the resource manager of the process: closing one of several would close all of them."""
    global _manager
    with _lock:
        if _manager is None:
            _manager = pyvisa.ResourceManager("@py")
        return _manager


def resources() -> tuple[str, ...]:
    """List the resources that VISA discovers: VXI-11 by broadcast, HiSLIP by mDNS, USB.

    Raises
    ------
    ConnectionLost
        When the search fails, for example on a machine without a network.
    """
    try:
        return tuple(_resource_manager().list_resources("?*"))
    except Exception as error:
        # The back ends have no common class of exceptions.
        raise ConnectionLost(f"VISA cannot search ({error})", do="is there a network?") from None


class _Worker:
    """A thread that runs the calls of one link in order."""

    def __init__(self) -> None:
        self.account = Account(_MOST)
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], queue.SimpleQueue[tuple[Any, Any]]] | None] = (
            queue.SimpleQueue()
        )
        self._thread = threading.Thread(target=self._run, name="visa", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            work, answer = job
            try:
                with self.account.open():
                    answer.put((work(), None))
            except Exception as error:
                answer.put((None, error))

    def do(self, work: Callable[[], Any], seconds: float) -> Any:
        """Run a call and return its result; raise queue.Empty when it takes longer than `seconds`."""
        answer: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
        self._jobs.put((work, answer))
        result, error = answer.get(timeout=max(0.001, seconds))
        if error is not None:
            raise error
        return result

    def end(self) -> None:
        """Stop the thread; wait at most `_GRACE_S` for a call that hangs."""
        self._jobs.put(None)
        self._thread.join(_GRACE_S)


class VisaLink:
    """A link to a VISA resource.

    Parameters
    ----------
    resource : str
        VISA resource string, for example ``USB0::0x1AB1::0x04CE::DS1ZA::INSTR``.

    Examples
    --------
    >>> link = VisaLink("TCPIP::192.0.2.7::inst0::INSTR")
    >>> link.read(Deadline(1.0))
    Traceback (most recent call last):
    reseau.core.errors.ConnectionLost: TCPIP::192.0.2.7::inst0::INSTR is not open; open the link first
    """

    def __init__(self, resource: str) -> None:
        self._name = resource
        self._resource: Any = None
        self._worker: _Worker | None = None
        self._bare: bool | None = None
        self.ended = False
        """Whether the bytes read last end a message."""

    def open(self, deadline: Deadline) -> None:
        """Open the resource; an open one is closed before."""
        self.close()
        # Raw USB has packets of its own, no messages.
        self._bare, self.ended = False if self._name.upper().endswith("::RAW") else None, False
        if self._name.upper().startswith("VICP") and find_spec("pyvicp") is None:
            do = "pip install pyvicp; or set its remote control to LXI and write TCPIP::host::inst0::INSTR"
            raise ConnectionLost(f"{self._name} needs the package pyvicp", do=do)
        manager, self._worker = _resource_manager(), _Worker()
        opened: list[Any] = []

        def work() -> None:
            opened.append(manager.open_resource(self._name, open_timeout=int(1000 * deadline.left)))

        try:
            self._do(work, deadline, "open")
        except InstrumentError:
            self._worker.account.cut()
            raise
        finally:
            if opened:
                self._resource = opened[0]
        self._resource.read_termination = self._resource.write_termination = None

    def close(self) -> None:
        """Close the resource if it is open."""
        resource, self._resource = self._resource, None
        worker, self._worker = self._worker, None
        if worker is None:
            return
        if resource is not None:
            # VXI-11 closes a link with a remote call, which an instrument that is switched off never answers.
            with suppress(queue.Empty):
                worker.do(lambda: self._quietly(resource), _GRACE_S)
        worker.account.cut()
        worker.end()

    @staticmethod
    def _quietly(resource: Any) -> None:
        with suppress(Exception):
            resource.timeout = int(1000 * _GRACE_S)
        with suppress(Exception):
            resource.close()

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send one message."""
        self._do(lambda: self._resource.write_raw(data), deadline, "write")

    def pending(self) -> bool:
        """Whether an answer is available, according to the status byte."""
        try:
            status = self._do(lambda: self._resource.read_stb(), Deadline(1.0), "status")
        except DeadlineError:
            return False
        except ConnectionLost:
            # pyvisa-py cannot read the status byte over USB; there a new query discards the previous answer.
            if self._name.upper().startswith("USB"):
                return False
            raise
        return bool(int(status) & _MESSAGE_AVAILABLE)

    def read(self, deadline: Deadline) -> bytes:
        """Return the bytes received; none when the deadline passes.

        An instrument whose first message ends without a newline ends all of them so: each gets one.
        From any other, a message without a newline is a part of one.
        """

        self.ended = False
        try:
            read = self._do(
                lambda: self._resource.visalib.read(self._resource.session, _READ), deadline, "read"
            )
        except DeadlineError:
            return b""
        data, status = bytes(read[0]), read[1]
        self.ended = status != constants.StatusCode.success_max_count_read
        if self._bare is None and self.ended:
            self._bare = not data.endswith(b"\n")
        answer: bytes = data
        return answer + b"\n" if self.ended and self._bare and not answer.endswith(b"\n") else answer

    def _do(self, work: Callable[[], Any], deadline: Deadline, what: str) -> Any:
        worker = self._worker
        if worker is None or (self._resource is None and what != "open"):
            raise ConnectionLost(f"{self._name} is not open", do="open the link first")
        if what != "open":
            self._resource.timeout = max(1, int(1000 * deadline.left))
        try:
            return worker.do(work, deadline.left + _GRACE_S)
        except queue.Empty:
            worker.account.cut()
            raise DeadlineError(f"{what} did not finish within {deadline.seconds:g} s") from None
        except pyvisa.errors.VisaIOError as error:
            if error.error_code == constants.StatusCode.error_timeout:
                raise DeadlineError(f"did not answer within {deadline.seconds:g} s") from None
            raise ConnectionLost(f"{self._name}: {error.description}", do="is it switched on?") from None
        except InstrumentError:
            raise
        except Exception as error:
            # The back end raises OSError, RuntimeError, RPCError, USBError and bare Exception, and ValueError
            # where it waits on a connection that it has closed.
            ended = isinstance(error, ValueError) and what != "open"
            why = ", its connection has ended" if ended else f" ({error})"
            raise ConnectionLost(f"{self._name}: {what} failed{why}", do="is it switched on?") from None


def scpi_link(address: str | Link) -> Link:
    """Return the link to an instrument that is controlled with SCPI.

    Parameters
    ----------
    address : str or Link
        A VISA resource, ``tcp://host:port`` for a raw socket, a serial device, or a link (returned as it is).

    Raises
    ------
    UsageError
        When the address is not valid.

    Examples
    --------
    >>> type(scpi_link("USB0::0x1AB1::0x04CE::DS1ZA::INSTR")).__name__
    'VisaLink'
    >>> type(scpi_link("TCPIP::192.0.2.7::5025::SOCKET")).__name__
    'TcpLink'
    """
    if not isinstance(address, str) or address.startswith("tcp://") or "::" not in address:
        return link_to(address)
    parts = address.split("::")
    if parts[-1].upper() == "SOCKET":
        # Not pyvisa-py's socket: it loops when the peer closes, and after a time-out it returns the answer to
        # the previous query.
        if len(parts) != 4 or not parts[2].isdigit():
            raise UsageError("is not a valid address", where=address, do="write TCPIP::host::port::SOCKET")
        return TcpLink(parts[1], int(parts[2]))
    return VisaLink(address)
