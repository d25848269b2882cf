"""What the routes share: archive, accounts, audit log, events, and the watch over what others store."""

from __future__ import annotations

import json
import queue
import secrets
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from ...archive import Archive
from ...core.errors import ReseauError, UsageError
from ...core.memory import keep_loaded
from ..accounts import LOCAL, Accounts, Principal
from ..audit import Audit
from ..state import StateFolder
from .events import Events
from .guard import Meters, log
from .options import ServeOptions

if TYPE_CHECKING:
    from ..benches import BenchLink
    from ..tiled import TiledPublisher

T = TypeVar("T")


def _load_the_rest(over: threading.Event) -> None:
    """Load what the first requests need, which would otherwise wait for it; first what the overview needs."""
    from .. import alarms

    del alarms
    if over.wait(_REST_S):  # meanwhile the first page is made
        return
    from ...report import overlay

    del overlay
    keep_loaded()


_LOOK_S, _ENTRY_S, _REST_S = 0.3, 600.0, 3.0
_ALARMS_S, _AGAIN_S = 30.0, 600.0
"""Time between looks at alarms that are to be sent, and between attempts that fail: each is recorded."""
_LOGGED = frozenset({"up", "down", "begin", "session", "end", "moving", "stopped", "asking"})
"""Events of benches that the log has, and not only the streams of events."""
_MOST_COMPUTED = 200
"""Results that are kept for further requests: what is asked for least recently is forgotten."""


@dataclass
class _Computed:
    """A result, and what it was computed from."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    key: object = None
    found: Any = None


class Service:
    """One service over one archive.

    Parameters
    ----------
    options : ServeOptions
        Its options.

    Raises
    ------
    ArchiveError
        If archive or accounts cannot be used.
    UsageError
        If it is open to others and there are no users.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Service(ServeOptions(f"{folder}/archive")) as service:
    ...     service.archive.sessions()
    []
    """

    def __init__(self, options: ServeOptions) -> None:
        self.options = options
        self.state = StateFolder.beside(options.archive, options.state)
        self.state.local_token()  # for programs of the same user
        self.accounts = Accounts(options.accounts or self.state.path("accounts.sqlite"))
        if options.open_to_others and not self.accounts.users():
            self.accounts.close()
            do = f"reseau service user add NAME --scope administer --state {self.state.folder}"
            raise UsageError("is open to others, but has no users", where="service", do=do)
        self.archive = Archive.open(options.archive, options.objects, create=True)
        self.audit = Audit(self.archive, self.state)
        self.events, self.meters = Events(), Meters()
        self._names: dict[Path, str] = {}
        self.jobs = Jobs(options.archive, options.objects, self.events)
        self.meters.clients.set_function(lambda: self.events.clients)
        self.urgent = ThreadPoolExecutor(8, "urgent")
        self._later = ThreadPoolExecutor(1, "later")
        self.benches: dict[str, BenchLink] = {}
        for path in options.benches:
            from ..benches import BenchLink

            link = BenchLink(
                path.absolute(), str(self._place(options.archive)), options.objects, self.state,
                self._on_event_of(path), options.workers.get(path),
            )  # fmt: skip
            if link.name in self.benches:
                raise UsageError("is the name of several benches", where=link.name, do="rename one")
            self.benches[link.name] = link
            self._names[path] = link.name
        self.tiled: TiledPublisher | None = None
        if options.tiled:
            from ..tiled import TiledPublisher

            self.tiled = TiledPublisher(self.archive, options.tiled)
        self._seen = self.archive.heads()  # what is stored from now on is an event
        self.started, self._begun = time.time(), time.monotonic()
        self._entries: dict[str, float] = {}
        self._computed: OrderedDict[str, _Computed] = OrderedDict()
        self._computing = threading.Lock()
        self._over = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="archive", daemon=True)
        self.failing = self.unsent = ""

    def __enter__(self) -> Service:
        self._watcher.start()
        threading.Thread(target=self._send_alarms, name="alarms", daemon=True).start()
        threading.Thread(target=_load_the_rest, args=(self._over,), name="load", daemon=True).start()
        self.jobs.start(self.archive)
        if self.tiled is not None:
            self.tiled.start()
        for each in self.benches.values():
            each.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self.tiled is not None:
            self.tiled.close()
        for each in self.benches.values():
            each.close()
        self.jobs.close()
        self.urgent.shutdown(wait=False, cancel_futures=True)
        self._later.shutdown()
        self.events.close()
        self._watcher.join(2.0)
        self.accounts.close()
        self.archive.close()

    @cached_property
    def cookie(self) -> str:
        """Name of the cookie; services on other ports of a machine have others."""
        return f"reseau-{self.options.port}"

    @property
    def uptime_s(self) -> float:
        """Time since its start (s), whatever was done to the clock."""
        return time.monotonic() - self._begun

    def entry_code(self) -> str:
        """Return a code that lets a browser of this machine in, once, within ten minutes."""
        code, now = secrets.token_urlsafe(24), time.monotonic()
        self._entries = {known: until for known, until in self._entries.items() if until > now}
        self._entries[code] = now + _ENTRY_S
        return code

    def enter(self, code: str) -> str | None:
        """Return the cookie for an entry code; None if it was used or is too old."""
        until = self._entries.pop(code, 0.0)
        return self.accounts.begin_login(LOCAL, "administer") if time.monotonic() < until else None

    def current(self, name: str, compute: Callable[[], T]) -> T:
        """Return what follows from journals and sessions, computed again when these or the minute change.

        Parameters
        ----------
        name : str
            What it is.
        compute : callable
            Computes it.
        """
        heads = self.archive.heads()
        stored = [heads.get(each, 0) for each in ("entries", "sessions", "ends", "results")]
        key = (*stored, int(time.time() // 60))
        with self._computing:
            kept = self._computed.setdefault(name, _Computed())
            self._computed.move_to_end(name)
            if len(self._computed) > _MOST_COMPUTED:
                self._computed.popitem(last=False)
        with kept.lock:
            if kept.key != key:
                kept.found = compute()
                kept.key = key
            found: T = kept.found
        return found

    @contextmanager
    def audited(
        self, who: Principal, action: str, about: str, facts: Mapping[str, Any] | None = None
    ) -> Iterator[None]:
        """Record an action before it is done, and its failure after it.

        Raises
        ------
        ArchiveError
            If it cannot be recorded; it must not be done then.
        """
        entry = self.audit.record(who.name, who.known_by, action, about, facts)
        try:
            yield
        except ReseauError as error:
            why = {"of": entry.number, "why": str(error)}
            self.audit.record(who.name, who.known_by, f"{action} failed", about, why)
            raise

    @staticmethod
    def _place(archive: str) -> str | Path:
        return archive if "://" in archive else Path(archive).absolute()

    def _on_event_of(self, path: Path) -> Callable[[str, dict[str, Any]], None]:
        def on_event(kind: str, facts: dict[str, Any]) -> None:
            name = self._names.get(path, str(path))
            self.events.publish("bench", name, {"what": kind, **facts})
            self.meters.events.labels("bench").inc()
            self.meters.workers.labels(name).set(0 if kind == "down" else 1)
            if kind == "down":
                self.meters.restarts.labels(name).inc()
            if kind in _LOGGED:
                session = self.benches[name].status["session"] or {}
                log(f"bench {kind}", **facts | {"bench": name, "session": session.get("name", "")})

        return on_event

    def record_later(self, who: Principal, action: str, about: str) -> None:
        """Record what must not wait for its record."""

        def record() -> None:
            with suppress(ReseauError):
                self.audit.record(who.name, who.known_by, action, about)

        self._later.submit(record)

    def _watch(self) -> None:
        """Publish what anybody stores in the archive, also other processes."""
        before = self._seen
        while not self._over.wait(_LOOK_S):
            try:
                now = self.archive.heads()
            except Exception as error:  # whatever it is, the service is not ready, and looks again
                if not self.failing:
                    log("archive", failed=str(error))
                self.failing = str(error)
                continue
            self.failing = ""
            for table, last in now.items():
                if before.get(table) != last:
                    self.events.publish("archive", table, {"last": last})
                    self.meters.events.labels("archive").inc()
            before = now

    def _send_alarms(self) -> None:
        """Send alarms as it is set; what could not be sent is said on the page, and tried again."""
        from ..alarms import Alarms

        known, failed, again = Alarms(self.archive), None, 0.0
        while not self._over.wait(_ALARMS_S):
            try:
                if (to := known.delivery) == failed and time.monotonic() < again:
                    continue
                failed, again = to, time.monotonic() + _AGAIN_S
                known.send_as_set()
                self.unsent, failed = "", None
            except Exception as error:  # whatever it is, the next alarm is sent, too
                log("alarms", failed=str(error))
                self.unsent = str(error)


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
