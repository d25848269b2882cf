"""Publish the documents of sessions, which bluesky made, to a server of tiled.

A run is published when it has ended, as a whole, under the name that bluesky gave it; one that is there
already is left as it is. Therefore nothing is lost or doubled if server or service was away for a while.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any

from ..archive import Archive, Session
from ..core.errors import InputError, ReseauError
from ..core.optional import optional

_KINDS = ("start", "descriptor", "event", "stop")
_LOOK_S, _SESSIONS = 5.0, 50

Document = tuple[str, dict[str, Any]]


def runs_of(session: Session) -> Iterator[list[Document]]:
    """Yield the runs of a session that have ended, each as its documents; a resumed session has several.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     session = archive.begin("monday", "frames", {"count": 1})
    ...     for kind in ("start", "stop", "start"):
    ...         session.note(f"{kind} {len(list(session.notes()))}", kind, {"uid": kind})
    ...     [[kind for kind, _ in run] for run in runs_of(session)]
    [['start', 'stop']]
    """
    run: list[Document] = []
    for kind, document in session.notes():
        if kind not in _KINDS:
            continue
        run = [(kind, document)] if kind == "start" else [*run, (kind, document)]
        if kind == "stop" and run[0][0] == "start":
            yield run
            run = []


def publish(session: Session, client: Any) -> int:
    """Publish the runs of a session that are not on the server yet, and return how many these are.

    Parameters
    ----------
    session : Session
        The session.
    client : tiled.client.container.Container
        Where to; it can be written to.

    Raises
    ------
    InputError
        If the server does not take them.
    """
    with optional():
        from bluesky.callbacks.tiled_writer import TiledWriter
    count = 0
    try:
        for run in runs_of(session):
            if run[0][1]["uid"] not in client:
                write = TiledWriter(client)
                for kind, document in run:
                    write(kind, dict(document))
                count += 1
    except Exception as error:  # of the network, or of the server, in many kinds
        raise InputError(f"does not take documents ({error})", where="tiled") from None
    return count


class TiledPublisher:
    """Publishes what an archive has, and what is added to it, in a thread.

    Parameters
    ----------
    archive : Archive
        The archive.
    url : str
        Address of the server; its API key is in the environment, ``TILED_API_KEY``.
    client : object, optional
        A client of the server, instead.

    Examples
    --------
    >>> publisher = TiledPublisher(archive, "http://127.0.0.1:8000")        # doctest: +SKIP
    >>> publisher.start(), publisher.close()                                # doctest: +SKIP
    """

    def __init__(self, archive: Archive, url: str, client: Any = None) -> None:
        with optional():
            import tiled.client  # noqa: F401 - said at the start, not when a session ends
        self._archive, self._url, self._client = archive, url, client
        self._over, self.failing = threading.Event(), ""
        self._thread = threading.Thread(target=self._work, name="tiled", daemon=True)

    def start(self) -> None:
        """Start."""
        self._thread.start()

    def close(self) -> None:
        """End; what is not published yet is published after the next start."""
        self._over.set()
        self._thread.join(10)

    def look(self) -> int:
        """Publish what the latest sessions have and the server has not; return the number of runs."""
        if self._client is None:
            from tiled.client import from_uri

            try:
                self._client = from_uri(self._url, api_key=os.environ.get("TILED_API_KEY"))
            except Exception as error:  # of the network, in many kinds
                raise InputError(f"does not answer ({error})", where="tiled") from None
        sessions = self._archive.sessions(last=_SESSIONS)
        return sum(publish(self._archive.session(each.name), self._client) for each in sessions)

    def _work(self) -> None:
        last = None
        while not self._over.is_set():
            try:
                heads = self._archive.heads()
                if heads["events"] != last or self.failing:
                    self.look()
                    last, self.failing = heads["events"], ""
            except ReseauError as error:
                self._client, self.failing = None, str(error)
            self._over.wait(_LOOK_S)
