"""The service's side of its benches: it starts their workers, finds them again, and speaks to them."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import Any

from ..capture.bench import BenchFile
from ..core.errors import ConnectionLost, DeadlineError, ReseauError, StateError
from ..io import read_text
from .orders import BUSY
from .state import StateFolder
from .wire import Certificates, Wire, checked_peer, error_of
from .worker import address_file

_START_S, _PAUSE_S, _LONGEST_PAUSE_S, _END_S = 60.0, 0.1, 10.0, 5.0
_MOST_WAITING = 4
"""Commands of a bench that wait for one another; further ones are refused."""

OnEvent = Callable[[str, dict[str, Any]], None]


class BenchLink:
    """The connection to the worker of a bench, which is started and restarted.

    Parameters
    ----------
    path : Path
        Bench file.
    archive : str
        Archive; `objects` its files, if it is a database.
    state : StateFolder
        Has the certificates.
    on_event : callable
        Called with each event of the worker: kind, and facts.
    elsewhere : (str, int), optional
        Address and port of a worker on another machine, which is neither started nor ended.

    Raises
    ------
    ReseauError
        If the file is not a bench.
    """

    def __init__(
        self,
        path: Path,
        archive: str,
        objects: str | None,
        state: StateFolder,
        on_event: OnEvent,
        elsewhere: tuple[str, int] | None = None,
    ) -> None:
        self._elsewhere, self._wrong = elsewhere, ""
        self.path, self._archive, self._objects = path, archive, objects
        self._state, self._on_event = state, on_event
        self.text = read_text(path)
        self.name = BenchFile.parse_toml(self.text, where=path).name
        self._certificates = Certificates(state)
        self._wire: Wire | None = None
        self._waiting: dict[int, Future[tuple[Any, bytes]]] = {}
        self._numbers, self._lock = itertools.count(1), threading.Lock()
        self._pid: int | None = None
        self._over = threading.Event()
        self._status: dict[str, Any] = {}
        self.restarts, self._met = -1, False
        self._thread = threading.Thread(target=self._keep, name=f"bench {self.name}", daemon=True)

    def start(self) -> None:
        """Start the worker, or find the one that runs."""
        self._thread.start()

    def close(self) -> None:
        """End the worker, unless a session runs: then it goes on alone."""
        self._over.set()
        if self._elsewhere is None:
            with contextlib.suppress(ReseauError):
                self.request("end", seconds=2.0)
        if self._wire is not None:
            self._wire.close()
        self._thread.join(5)
        end = time.monotonic() + _END_S
        busy = self._status.get("state") in BUSY
        while not self._ended() and not busy and time.monotonic() < end:
            time.sleep(0.02)

    def _ended(self) -> bool:
        """Whether the worker that this process started has ended."""
        if self._pid is not None:
            with contextlib.suppress(ChildProcessError):
                if os.waitpid(self._pid, os.WNOHANG)[0] == 0:
                    return False
            self._pid = None
        return True

    @property
    def status(self) -> dict[str, Any]:
        """The state of the bench as the worker said it last; `down` without a worker."""
        if self._wire is None:
            down = self._met or self.restarts > 0 or bool(self._wrong)
            more = {
                "state": "down" if down else "starting",
                "error": (self._wrong or "its worker does not answer") if down else "",
            }
            return _EMPTY | self._status | more | {"name": self.name, "moving": ""}
        return _EMPTY | {"name": self.name} | self._status

    def request(
        self, do: str, given: dict[str, Any] | None = None, seconds: float = 15.0, at: float | None = None
    ) -> Any:
        """Have the worker do something, and return the value that it answers.

        Parameters
        ----------
        do : str
            Name of the command.
        given : dict, optional
            Its arguments.
        seconds : float
            How long the answer may take.
        at : float, optional
            When it was asked for (`time.monotonic`); now by default. What was asked for before a stop is not
            done after it.

        Raises
        ------
        ReseauError
            As the worker answers, or if it does not.
        """
        return self.asked(do, given, seconds, at)[0]

    def asked(
        self, do: str, given: dict[str, Any] | None = None, seconds: float = 15.0, at: float | None = None
    ) -> tuple[Any, bytes]:
        """As :meth:`request`, with the bytes of the answer."""
        wire = self._wire
        if wire is None:
            raise ConnectionLost("its worker does not answer", where=f"bench {self.name}")
        answer: Future[tuple[Any, bytes]] = Future()
        with self._lock:
            if do not in _AT_ONCE and len(self._waiting) >= _MOST_WAITING:
                raise StateError("has other commands to carry out", where=f"bench {self.name}", do="wait")
            number = next(self._numbers)
            self._waiting[number] = answer
        try:
            when = time.monotonic() if at is None else at
            wire.send({"id": number, "do": do, "given": given or {}, "at": when})
            return answer.result(seconds)
        except FutureTimeout:
            raise DeadlineError(f"did not answer within {seconds:g} s", where=f"bench {self.name}") from None
        finally:
            with self._lock:
                self._waiting.pop(number, None)

    # The thread that keeps the connection.

    def _keep(self) -> None:
        pause = _PAUSE_S
        while not self._over.is_set():
            wire = self._found() or self._started()
            if wire is None:
                self._over.wait(pause)
                pause = min(2 * pause, _LONGEST_PAUSE_S)
                continue
            begun = time.monotonic()
            # What an earlier worker said last is not true of this one, which has not said anything yet.
            self._status = {}
            self._wire, self._met = wire, True
            self._on_event("up", {})
            try:
                wire.send({"id": 0, "do": "status"})
                while True:
                    self._received(*wire.receive())
            except ReseauError:
                self._wire = None
                wire.close()
                self._ended()
                with self._lock:
                    lost = list(self._waiting.values())
                for each in lost:
                    if not each.done():
                        each.set_exception(ConnectionLost("its worker ended", where=f"bench {self.name}"))
                if not self._over.is_set():
                    self._on_event("down", {})
                # One that ends again and again, such as by a driver that crashes, is not started at once.
                if time.monotonic() - begun > _LONGEST_PAUSE_S:
                    pause = _PAUSE_S
                self._over.wait(pause)
                pause = min(2 * pause, _LONGEST_PAUSE_S)

    def _received(self, header: dict[str, Any], body: bytes) -> None:
        if "event" in header:
            self._status = header.get("status", self._status)
            self._on_event(str(header["event"]), header.get("facts", {}))
            return
        with self._lock:
            answer = self._waiting.get(header.get("id", 0))
        if answer is None or answer.done():
            return
        if "error" in header:
            answer.set_exception(error_of(header["error"]))
        else:
            answer.set_result((header.get("value"), body))

    def _found(self) -> Wire | None:
        """The connection to a worker that runs already, with the same bench."""
        if self._elsewhere is not None:
            return self._remote(*self._elsewhere)
        try:
            about = json.loads(address_file(self._state, self.name).read_text())
            os.kill(int(about["pid"]), 0)
            wire = self._connected(int(about["port"]))
        except (OSError, ValueError, KeyError, ReseauError):
            return None
        if about.get("bench") == self.text:
            return wire
        with contextlib.suppress(ReseauError):  # the file was changed: the worker ends when it is idle
            if "error" in _answer(wire, "end"):
                return wire
        wire.close()
        time.sleep(1.0)
        return None

    def _started(self) -> Wire | None:
        """Start a worker, and return the connection to it."""
        if self._over.is_set() or self._elsewhere is not None:
            return None
        place = address_file(self._state, self.name)
        place.unlink(missing_ok=True)
        self.restarts += 1
        log = place.with_suffix(".log")
        out = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        command = [sys.executable, "-m", "reseau.service.worker", str(self.path), self._archive]
        # It is not a child that ends with this process: a session goes on without the service.
        self._pid = os.posix_spawn(
            sys.executable, [*command, self._objects or "", str(self._state.folder)], os.environ, setsid=True,
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
                (os.POSIX_SPAWN_OPEN, 2, str(log), out, 0o600),
            ],
        )  # fmt: skip
        end = time.monotonic() + _START_S
        while time.monotonic() < end and not self._over.wait(0.05):
            if self._ended():
                return None
            if place.is_file():
                with contextlib.suppress(OSError, ValueError, KeyError, ReseauError):
                    return self._connected(int(json.loads(place.read_text())["port"]))
        return None

    def _remote(self, host: str, port: int) -> Wire | None:
        """The connection to a worker on another machine; None, with the reason, if it is no right one."""
        try:
            wire = self._connected(port, host)
            answer = _answer(wire, "bench")
        except (OSError, ReseauError) as error:
            self._wrong = f"its worker on {host} does not answer ({error})"
            return None
        if answer.get("value") != self.text:
            self._wrong = f"its worker on {host} has another bench file"
            wire.close()
            return None
        self._wrong = ""
        return wire

    def _connected(self, port: int, host: str = "") -> Wire:
        raw = socket.create_connection((host or "127.0.0.1", port), timeout=5)
        try:
            context = self._certificates.context("service", elsewhere=bool(host))
            sock = context.wrap_socket(raw, server_hostname=host or None)
            checked_peer(sock, "worker")
        except (OSError, ReseauError):
            raw.close()
            raise
        return Wire(sock)


def _answer(wire: Wire, do: str) -> dict[str, Any]:
    """Have a worker do something that it does at once, before its events are followed."""
    wire.send({"id": 0, "do": do})
    while "event" in (answer := wire.receive()[0]):
        pass
    return answer


_AT_ONCE = frozenset(
    {"stop", "status", "bench", "settings", "picture", "pause", "continue", "abort", "answer", "end"}
)
_EMPTY: dict[str, Any] = {
    "state": "starting", "error": "", "session": None, "question": None, "moving": "", "instruments": {},
    "has_camera": False, "has_table": False, "picture": 0, "pid": None,
}  # fmt: skip
