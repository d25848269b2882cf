"""VISA resources as links: VXI-11, HiSLIP and USBTMC through pyvisa-py, with deadlines that hold.

pyvisa-py's own time-outs are per chunk, or none at all while a connection is opened; so its calls run in a
thread of their own, one that is not back in time has its sockets taken away, and none takes more than its
budget of bytes.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pyvisa
from pyvisa import constants

from reseau.core.errors import ConnectionLost, DeadlineError, InstrumentError, UsageError
from reseau.instruments import Deadline

from ..link import Link, TcpLink, link_to
from .budget import Account

__all__ = ["VisaLink", "resources", "scpi_link"]

_READ = 1 << 20
"""Bytes asked for at once; what is longer comes in several reads."""
_MOST = 16 << 20
"""Bytes that one call may take; several reads make a picture."""
_GRACE_S = 0.3
_MESSAGE_AVAILABLE = 0x10

_lock = threading.Lock()
_manager: pyvisa.ResourceManager | None = None


def _resource_manager() -> pyvisa.ResourceManager:
    """The one of the process: closing any of several would close all."""
    global _manager
    with _lock:
        if _manager is None:
            _manager = pyvisa.ResourceManager("@py")
        return _manager


def resources() -> tuple[str, ...]:
    """What VISA discovers: VXI-11 by broadcast, HiSLIP by mDNS, USB.

    Raises
    ------
    ConnectionLost
        When it cannot search, as on a machine without any network.
    """
    try:
        return tuple(_resource_manager().list_resources("?*"))
    except Exception as error:
        # Whatever a back end raises: there is no one class of them.
        raise ConnectionLost(f"VISA cannot search ({error})", do="is there a network?") from None


class _Worker:
    """A thread that does one thing after the other for a link."""

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
        """The result of some work; raises queue.Empty when it is not done in time."""
        answer: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
        self._jobs.put((work, answer))
        result, error = answer.get(timeout=max(0.001, seconds))
        if error is not None:
            raise error
        return result

    def end(self) -> None:
        """No more work; what hangs is waited for no longer than it is worth."""
        self._jobs.put(None)
        self._thread.join(_GRACE_S)


class VisaLink:
    """A VISA resource.

    Parameters
    ----------
    resource : str
        As VISA writes it.
    """

    def __init__(self, resource: str) -> None:
        self._name = resource
        self._resource: Any = None
        self._worker: _Worker | None = None

    def open(self, deadline: Deadline) -> None:
        """Open the resource anew, and clear what it may still want to say."""
        self.close()
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
        """Close it, if it is open."""
        resource, self._resource = self._resource, None
        worker, self._worker = self._worker, None
        if worker is None:
            return
        if resource is not None:
            # A VXI-11 link is closed by a call that a dead instrument does not answer.
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
        """Whether an answer waits, by the status byte."""
        try:
            status = self._do(lambda: self._resource.read_stb(), Deadline(1.0), "status")
        except DeadlineError:
            return False
        except ConnectionLost:
            # pyvisa-py cannot ask for it over USB; there a new question discards the answer before.
            if self._name.upper().startswith("USB"):
                return False
            raise
        return bool(int(status) & _MESSAGE_AVAILABLE)

    def read(self, deadline: Deadline) -> bytes:
        """What has come, or nothing after the deadline."""

        def work() -> bytes:
            data, _ = self._resource.visalib.read(self._resource.session, _READ)
            return bytes(data)

        try:
            return bytes(self._do(work, deadline, "read"))
        except DeadlineError:
            return b""

    def _do(self, work: Callable[[], Any], deadline: Deadline, what: str) -> Any:
        worker = self._worker
        if worker is None or (self._resource is None and what != "open"):
            raise ConnectionLost(f"{self._name} is not open")
        if what != "open":
            self._resource.timeout = max(1, int(1000 * deadline.left))
        try:
            return worker.do(work, deadline.left + _GRACE_S)
        except queue.Empty:
            worker.account.cut()
            raise DeadlineError(f"{what} was not done within {deadline.seconds:g} s") from None
        except pyvisa.errors.VisaIOError as error:
            if error.error_code == constants.StatusCode.error_timeout:
                raise DeadlineError(f"did not answer within {deadline.seconds:g} s") from None
            raise ConnectionLost(f"{self._name}: {error.description}", do="is it switched on?") from None
        except InstrumentError:
            raise
        except Exception as error:
            # Its back end raises OSError, RuntimeError, RPCError, USBError, ValueError and bare Exception.
            raise ConnectionLost(f"{self._name}: {what} failed ({error})", do="is it switched on?") from None


def scpi_link(address: str | Link) -> Link:
    """The link to an instrument that speaks SCPI.

    Parameters
    ----------
    address : str or Link
        A VISA resource, ``tcp://host:port`` for a raw socket, a serial device, or a link.

    Raises
    ------
    UsageError
        When it is no address.
    """
    if not isinstance(address, str) or address.startswith("tcp://") or "::" not in address:
        return link_to(address)
    parts = address.split("::")
    if parts[-1].upper() == "SOCKET":
        # Our own: pyvisa-py's spins when the peer closes, and answers the question before after a time-out.
        if len(parts) != 4 or not parts[2].isdigit():
            raise UsageError("is no address", where=address, do="write TCPIP::host::port::SOCKET")
        return TcpLink(parts[1], int(parts[2]))
    return VisaLink(address)
