"""Computations that take longer than a request: one after the other, each in a process of its own."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

from ...archive import Archive
from ...core.errors import ReseauError
from .events import Events
from .guard import log

_LONGEST_S = 3600.0
_KEPT = 500


@dataclass(frozen=True)
class Job:
    """A computation.

    Parameters
    ----------
    number : int
        Its number since the start of the service.
    what : {"finish", "rerun"}
        What is computed.
    session : str
        Session that it is about.
    state : {"waiting", "running", "done", "failed"}
        Its state.
    found : object
        Outcome.
    why : str
        Why it failed.

    Examples
    --------
    >>> Job(1, "rerun", "monday", "done", {"calibration.json": True}).found
    {'calibration.json': True}
    """

    number: int
    what: Literal["finish", "rerun"]
    session: str
    state: Literal["waiting", "running", "done", "failed"] = "waiting"
    found: Any = None
    why: str = ""


class Jobs:
    """The computations of a service.

    Parameters
    ----------
    place : str
        Archive.
    objects : str, optional
        Its files, if it is a database.
    events : Events
        Called with each change.
    """

    def __init__(self, place: str, objects: str | None, events: Events) -> None:
        self._place, self._objects, self._events = place, objects or "", events
        self._jobs: dict[int, Job] = {}
        self._lock = threading.Lock()
        self._queue: queue.Queue[int | None] = queue.Queue()
        self._process: subprocess.Popen[bytes] | None = None
        self._over = False
        self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)

    def start(self, archive: Archive) -> None:
        """Start, with the uploads that an earlier service left unfinished."""
        from ..decoding import is_upload

        self._thread.start()
        for each in archive.sessions(last=200):
            if each.status == "not ended" and is_upload(archive.session(each.name)):
                self.add("finish", each.name)

    def close(self) -> None:
        """End; a computation that is cut off is done again after the next start."""
        self._over = True
        self._queue.put(None)
        with self._lock:
            if self._process is not None:
                self._process.kill()
        self._thread.join(5)

    def add(self, what: Literal["finish", "rerun"], session: str) -> Job:
        """Add a computation."""
        with self._lock:
            number = max(self._jobs, default=0) + 1
            job = self._jobs[number] = Job(number, what, session)
            for old in [n for n in self._jobs if n <= number - _KEPT]:
                del self._jobs[old]
        self._queue.put(number)
        return job

    def get(self, number: int) -> Job | None:
        """Return a computation, or None."""
        return self._jobs.get(number)

    def of(self, session: str) -> Job | None:
        """Return the last computation about a session, or None."""
        return next((job for job in reversed(list(self._jobs.values())) if job.session == session), None)

    def _change(self, number: int, **changes: Any) -> None:
        with self._lock:
            job = self._jobs[number] = replace(self._jobs[number], **changes)
        self._events.publish("job", job.session, {"number": number, "what": job.what, "state": job.state})

    def _work(self) -> None:
        while (number := self._queue.get()) is not None and not self._over:
            job = self._jobs[number]
            self._change(number, state="running")
            command = [sys.executable, "-m", "reseau.service.computing", job.what]
            found: dict[str, Any] = {}
            try:
                with self._lock:
                    self._process = subprocess.Popen(
                        [*command, self._place, self._objects, job.session], stdout=subprocess.PIPE,
                        stderr=subprocess.PIPE, stdin=subprocess.DEVNULL,
                    )  # fmt: skip
                out, errors = self._process.communicate(timeout=_LONGEST_S)
                with suppress(ValueError, IndexError):
                    found = json.loads(out.splitlines()[-1])
                if not found:
                    log("job", failed=errors.decode(errors="replace")[-2000:], session=job.session)
            except subprocess.TimeoutExpired:
                assert self._process is not None
                self._process.kill()
                found = {"error": f"takes longer than {_LONGEST_S:.0f} s"}
            except (OSError, ReseauError) as error:
                found = {"error": str(error)}
            if self._over:
                return
            why = found.get("error", "" if "found" in found else "the computation ended without a result")
            self._change(number, state="failed" if why else "done", found=found.get("found"), why=why)
