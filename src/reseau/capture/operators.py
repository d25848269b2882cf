"""Programs that carry out what no instrument can: a robot, a switch of the light, a simulated laboratory."""

from __future__ import annotations

import json
import socket
from dataclasses import dataclass

from ..core.errors import ConnectionLost, DeadlineError, ProtocolError, RefusedError, UsageError

__all__ = ["RemoteOperator"]

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
        host, _, port = self.address.removeprefix("tcp://").rpartition(":")
        line = b""
        try:
            with socket.create_connection((host, int(port)), self.seconds) as connection:
                connection.sendall(json.dumps({"request": request}).encode() + b"\n")
                while not line.endswith(b"\n") and len(line) < _LONGEST:
                    more = connection.recv(4096)
                    if not more:
                        break
                    line += more
        except TimeoutError:
            raise DeadlineError(
                f"did not answer within {self.seconds:g} s", where=self.address, command=request
            ) from None
        except OSError as error:
            raise ConnectionLost(
                f"cannot be reached ({error})", where=self.address, command=request,
                do="start the program that `operator` names, or remove that line from the bench file",
            ) from None  # fmt: skip
        try:
            answer = json.loads(line)
            done, reason = bool(answer.get("done")), answer.get("error")
        except (ValueError, AttributeError):
            raise ProtocolError(f"answered {line[:80]!r}", where=self.address, command=request) from None
        if not done:
            raise RefusedError(str(reason or "did not carry it out"), where=self.address, command=request)
