"""Programs that carry out what no instrument can: a robot, a switch of the light, a simulated laboratory."""

from __future__ import annotations

import json
import math
import os
import select
import socket
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

from ..core.errors import (
    ConnectionLost,
    DeadlineError,
    ProtocolError,
    RefusedError,
    StateError,
    UsageError,
)

_LONGEST = 65_536


@dataclass(frozen=True)
class RemoteOperator:
    r"""Sends the requests of a session to a program.

    The protocol is a line of JSON in UTF-8 each way, ``{"request": "cover the lens"}`` and ``{"done": true}``
    or ``{"error": "the cover is stuck"}``, on a connection of its own for each request.

    Parameters
    ----------
    address : str
        ``tcp://host:port``.
    seconds : float
        Time limit of a request (s).

    Examples
    --------
    >>> import threading
    >>> server = socket.create_server(("127.0.0.1", 0))
    >>> def answer():
    ...     with server.accept()[0] as client:
    ...         print(client.recv(100))
    ...         client.sendall(b'{"done": true}\n')
    >>> threading.Thread(target=answer).start()
    >>> RemoteOperator(f"tcp://127.0.0.1:{server.getsockname()[1]}")("cover the lens")
    b'{"request": "cover the lens"}\n'
    >>> server.close()
    """

    address: str
    seconds: float = 600.0

    def __post_init__(self) -> None:
        scheme, _, place = self.address.partition("://")
        host, colon, port = place.rpartition(":")
        if scheme != "tcp" or not host or not colon or not port.isdigit():
            raise UsageError(f"{self.address!r} is no address", where="operator", do="write tcp://host:port")

    def __call__(self, request: str) -> None:
        """Return when the request is carried out.

        Raises
        ------
        ConnectionLost, DeadlineError, ProtocolError
            If there is no answer, or none in time, or another than described.
        RefusedError
            If the program says that it could not carry out the request.
        """
        self._answer(request, {"request": request}, self.seconds)

    def read(self, request: str, unit: str, seconds: float | None = None) -> float:
        """Return the number that the answer to a request states, in a unit.

        The line sent has the unit, ``{"request": "set tilt to 30 deg", "unit": "deg"}``, and the answer the
        number, ``{"done": true, "value": 30.02}``.

        Raises
        ------
        InstrumentError
            As for a request, and if the answer has no number.
        """
        seconds = self.seconds if seconds is None else min(seconds, self.seconds)
        value = self._answer(request, {"request": request, "unit": unit}, seconds).get("value")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ProtocolError(f"answered {value!r}, not a number", where=self.address, command=request)
        return float(value)

    def _answer(self, request: str, message: dict[str, str], seconds: float) -> dict[str, Any]:
        host, _, port = self.address.removeprefix("tcp://").rpartition(":")
        line = b""
        end = time.monotonic() + seconds
        try:
            with socket.create_connection((host, int(port)), max(0.01, seconds)) as connection:
                connection.sendall(json.dumps(message).encode() + b"\n")
                while b"\n" not in line and len(line) < _LONGEST:
                    connection.settimeout(max(0.01, end - time.monotonic()))
                    more = connection.recv(4096)
                    if not more:
                        break
                    line += more
        except TimeoutError:
            raise DeadlineError(
                f"did not answer within {seconds:g} s", where=self.address, command=request
            ) from None
        except OSError as error:
            raise ConnectionLost(
                f"cannot be reached ({error})", where=self.address, command=request,
                do="start the program that `operator` names, or remove that line from the bench file",
            ) from None  # fmt: skip
        try:
            answer: dict[str, Any] = json.loads(line.partition(b"\n")[0])
            done, reason = bool(answer.get("done")), answer.get("error")
        except (ValueError, AttributeError):
            raise ProtocolError(f"answered {line[:80]!r}", where=self.address, command=request) from None
        if not done:
            raise RefusedError(str(reason or "did not carry it out"), where=self.address, command=request)
        return answer


class TerminalOperator:
    """The person at the terminal, who is asked on standard error and answers on standard input.

    Examples
    --------
    >>> TerminalOperator().address
    'terminal'
    """

    address = "terminal"

    def __init__(self) -> None:
        self._left = threading.Event()
        self._held = b""

    def __call__(self, request: str) -> None:
        """Return when the person has pressed Enter."""
        self._line(f"{request}, then press Enter", 3600.0)

    def read(self, request: str, unit: str, seconds: float | None = None) -> float:
        """Return the number that the person types.

        Raises
        ------
        DeadlineError
            If there is none in time.
        StateError
            If standard input is closed, or :meth:`leave` was called.
        """
        end = time.monotonic() + (3600.0 if seconds is None else seconds)
        while True:
            text = self._line(f"{request} ({unit}):", end - time.monotonic())
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                value = math.nan
            if math.isfinite(value):
                return value

    def leave(self) -> None:
        """End a question that waits."""
        self._left.set()

    def _line(self, question: str, seconds: float) -> str:
        print(question, end=" ", file=sys.stderr, flush=True)
        self._left.clear()
        end = time.monotonic() + seconds
        while b"\n" not in self._held:
            if self._left.is_set():
                raise StateError("was stopped", where=question)
            if time.monotonic() > end:
                raise DeadlineError(f"no answer within {seconds:g} s", where=question)
            data: bytes | None = None
            try:
                if select.select([sys.stdin], [], [], 0.1)[0]:
                    data = os.read(sys.stdin.fileno(), 1024)
            except (OSError, ValueError):  # it cannot be waited for: on Windows, or replaced
                data = sys.stdin.readline().encode()
            if data is not None:
                if not data:
                    raise StateError("standard input is closed", where=question, do="run it in a terminal")
                self._held += data
        line, _, self._held = self._held.partition(b"\n")
        return line.decode("utf-8", "replace").strip()
