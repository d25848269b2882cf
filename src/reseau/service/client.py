"""A client of the service, in Python: every operation of the API, files, and events that are resumed."""

from __future__ import annotations

import json
import os
import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote, urlsplit

from ..core.errors import (
    ArchiveError,
    ConnectionLost,
    EstimationError,
    InputError,
    InstrumentError,
    ReseauError,
    UsageError,
)
from ..core.optional import optional

_ERRORS: dict[str, type[ReseauError]] = {
    "archive": ArchiveError, "estimation": EstimationError, "input": InputError,
    "instrument": InstrumentError,
    "usage": UsageError, "not_found": UsageError, "unknown": UsageError, "forbidden": UsageError,
}  # fmt: skip


@dataclass(frozen=True)
class ServerEvent:
    """An event of the service.

    Parameters
    ----------
    id : str
        Its id, from which a stream can be resumed.
    kind, about : str
        What happened, and to what; ``reset`` when events are missing.
    facts : dict
        Its values.

    Examples
    --------
    >>> ServerEvent("5a-1", "archive", "frames", {"last": 7}).about
    'frames'
    """

    id: str
    kind: str
    about: str
    facts: dict[str, Any]


class Client:
    """A client of the service.

    Parameters
    ----------
    server : str
        Its address, such as ``https://bench.example.org``.
    token : str, optional
        Token; default: the environment variable ``RESEAU_TOKEN``.
    authority : Path, optional
        Certificate by which that of the service is checked, if it is not of a public authority (PEM).

    Raises
    ------
    UsageError
        If the address cannot be used, or would send a token without TLS to another machine.

    Examples
    --------
    >>> with Client("http://127.0.0.1:8480", "reseau_…") as client:  # doctest: +SKIP
    ...     [each["name"] for each in client.get("/sessions")["sessions"]]
    ['monday']
    """

    def __init__(self, server: str, token: str | None = None, authority: Path | None = None) -> None:
        with optional():
            import httpx
        parts = urlsplit(server)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise UsageError("is not an address", where=server, do="use http://127.0.0.1:8480")
        if parts.scheme == "http" and parts.hostname not in ("127.0.0.1", "localhost", "::1"):
            raise UsageError("would send the token without TLS", where=server, do="use https")
        secret = token if token is not None else os.environ.get("RESEAU_TOKEN", "")
        self.server = server.rstrip("/")
        verify: Any = True
        if authority is not None:
            try:
                verify = ssl.create_default_context(cafile=authority)
            except OSError as error:
                raise UsageError(f"is no certificate ({error.strerror})", where=authority) from None
        self._http = httpx.Client(
            base_url=f"{self.server}/api/1", timeout=330.0,
            headers={"Authorization": f"Bearer {secret}"} if secret else {},
            verify=verify, follow_redirects=False,
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def request(self, method: str, path: str, body: Any = None, **query: Any) -> Any:
        """Do an operation of the API, and return its answer.

        Parameters
        ----------
        method : str
            ``GET``, ``POST``, ``PUT``, ``PATCH`` or ``DELETE``.
        path : str
            Path after ``/api/1``, such as ``/sessions``.
        body : object, optional
            Content, JSON values.
        **query
            Parameters of the query.

        Raises
        ------
        ReseauError
            As the service answers, or if it does not answer.
        """
        answer = self._sent(method, path, json=body, params={k: v for k, v in query.items() if v is not None})
        return answer.json() if "json" in answer.headers.get("content-type", "") else answer.content

    def get(self, path: str, **query: Any) -> Any:
        """Read; see :meth:`request`."""
        return self.request("GET", path, **query)

    def post(self, path: str, body: Any = None) -> Any:
        """Change; see :meth:`request`."""
        return self.request("POST", path, {} if body is None else body)

    def file(self, path: str) -> bytes:
        """Return a file of the archive.

        Raises
        ------
        ReseauError
            As :meth:`request`.
        """
        content: bytes = self._sent("GET", path).content
        return content

    def sessions(self, like: str = "") -> Iterator[dict[str, Any]]:
        """Yield the sessions, latest first."""
        before = None
        while True:
            page = self.get("/sessions", like=like, before=before, count=200)
            yield from page["sessions"]
            before = page["before"]
            if before is None:
                return

    def stop(self, bench: str) -> float:
        """Stop everything on a bench; return how long the instruments took (ms)."""
        return float(self.post(f"/benches/{quote(bench, safe='')}/stop")["ms"])

    def upload(
        self,
        name: str,
        photographs: Sequence[Path],
        design: Path | None = None,
        *,
        inputs: Mapping[str, Path] | None = None,
        wait: bool = True,
        **given: Any,
    ) -> dict[str, Any]:
        """Calibrate from photographs.

        Parameters
        ----------
        name : str
            Name of the session.
        photographs : sequence of Path
            Files.
        design : Path, optional
            Design of the target; film needs none.
        inputs : mapping of str to Path, optional
            Other files: `test_object`, `corners`.
        wait : bool
            Whether to wait for the calibration.
        **given
            `subject`, `model`, `pitch_mm`, `free`, `format_mm`, `dpi`.

        Returns
        -------
        dict
            The session.

        Raises
        ------
        ReseauError
            As :meth:`request`.
        """
        try:
            files = [("photographs", (path.name, path.read_bytes())) for path in photographs]
            for role, path in {**({} if design is None else {"design": design}), **(inputs or {})}.items():
                files.append((role, (path.name, path.read_bytes())))
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", where=error.filename) from None
        made = self._sent("POST", "/uploads", files=files, data={"name": name, **given}).json()
        while wait and self.get(f"/jobs/{made['job']}")["state"] in ("waiting", "running"):
            time.sleep(0.2)
        found: dict[str, Any] = self.get(f"/sessions/{quote(name, safe='')}")
        return found

    def events(self, last: str = "", *, attempts: int = 20) -> Iterator[ServerEvent]:
        """Yield events as they happen; a connection that is lost is resumed after the last one.

        Parameters
        ----------
        last : str
            Id of the last event that is known.
        attempts : int
            Attempts to connect again, one second apart.

        Raises
        ------
        ConnectionLost
            If the service does not answer any more.
        """
        import httpx

        failed = 0
        while True:
            headers = {"Last-Event-ID": last} if last else {}
            try:
                with self._http.stream("GET", "/events", headers=headers, timeout=30.0) as answer:
                    if answer.status_code != 200:
                        answer.read()
                        self._checked(answer)
                    failed, fields = 0, dict[str, str]()
                    for line in answer.iter_lines():
                        key, _, value = line.partition(": ")
                        if line:
                            fields[key] = value
                        elif "event" in fields:
                            last = fields.get("id", last)
                            event, data = fields["event"], json.loads(fields.get("data", "{}"))
                            fields = {}
                            if event == "change":
                                yield ServerEvent(last, data["kind"], data["about"], data["facts"])
                            elif event == "reset":
                                yield ServerEvent(last, "reset", "", {})
                        else:
                            fields = {}
            except httpx.HTTPError as error:
                failed += 1
                if failed > attempts:
                    raise ConnectionLost(f"does not answer ({error})", where=self.server) from None
            time.sleep(1.0)

    def _sent(self, method: str, path: str, **content: Any) -> Any:
        import httpx

        try:
            answer = self._http.request(method, path, **content)
        except httpx.HTTPError as error:
            raise ConnectionLost(f"does not answer ({error})", where=self.server) from None
        self._checked(answer)
        return answer

    def _checked(self, answer: Any) -> None:
        """Raise the error that an answer has."""
        if answer.is_success:
            return
        try:
            error: Mapping[str, Any] = answer.json()["error"]
            kind = _ERRORS.get(error["code"], ReseauError)
        except (ValueError, KeyError, TypeError):
            raise InputError(f"answered {answer.status_code}", where=self.server) from None
        raise kind(error["what"], where=error["where"], do=error["do"])
