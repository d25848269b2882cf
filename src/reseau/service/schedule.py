"""Schedules: which runs are due, overdue, missed or blocked, and who starts them.

A schedule is a document in a journal of an archive; what happens to its runs are further entries. The state
of each run follows from them and from the clock, so that nothing has to be running for a run to be missed
visibly. A run is named by its time in UTC: a clock that was set back, or a change of daylight saving time,
does not start it again. A scheduler claims a run for a limited time; of two, the archive lets one succeed.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import ClassVar, Literal, Self
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from pydantic import Field, model_validator

from ..archive import Archive
from ..archive.journal import Entry, Journal
from ..core.errors import ArchiveError, InstrumentError, ReseauError, UsageError
from ..core.optional import optional
from ..io import Document
from .inforce import Configurations, a_time

_PREFIX = "schedules/"
State = Literal["scheduled", "due", "running", "blocked", "overdue", "missed", "done", "failed"]


class Schedule(Document):
    """When a recalibration is due, ``reseau-schedule/1``.

    Parameters
    ----------
    name : str
        Name of the schedule.
    recalibration : str
        Recalibration that it starts.
    configuration : str, optional
        Configuration whose service events make a run due at once.
    rule, start, zone, except_for
        See :class:`~reseau.service.schedule.Recurrence`; times as ``2026-03-02T08:00``.
    window_minutes : int
        A run may start from its time to this time later (min).

    Examples
    --------
    >>> weekly = Schedule(name="weekly", recalibration="left", rule="FREQ=WEEKLY;COUNT=52",
    ...                   start="2026-03-02T08:00", zone="Europe/Berlin")
    >>> weekly.recurrence.occurrences()[0].isoformat()
    '2026-03-02T07:00:00+00:00'
    """

    SCHEMA: ClassVar[str] = "reseau-schedule/1"

    name: str = Field(min_length=1)
    recalibration: str = Field(min_length=1)
    configuration: str | None = None
    rule: str
    start: str
    zone: str
    except_for: tuple[str, ...] = ()
    window_minutes: int = Field(default=240, ge=1)

    @model_validator(mode="after")
    def _valid(self) -> Self:
        try:
            _ = self.recurrence
        except UsageError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def recurrence(self) -> Recurrence:
        """The rule.

        Raises
        ------
        UsageError
            If it cannot be used.
        """
        try:
            start, *but = (datetime.fromisoformat(each) for each in (self.start, *self.except_for))
        except ValueError as error:
            raise UsageError(f"is not a time ({error})", where="start", do="use 2026-03-02T08:00") from None
        return Recurrence(self.rule, start, self.zone, tuple(but))

    @property
    def window(self) -> timedelta:
        """Time in which a run may start."""
        return timedelta(minutes=self.window_minutes)


@dataclass(frozen=True)
class Run:
    """A run of a schedule.

    Parameters
    ----------
    schedule : str
        Name of the schedule.
    time : datetime
        When it was due, UTC.
    state : str
        ``scheduled``, ``due`` (may start now), ``running``, ``blocked`` (could not start, may start again),
        ``overdue`` (its window has passed, and no later run was due yet), ``missed`` (a later run was due),
        ``done`` or ``failed``.
    why : str
        Outcome, or the reason why it failed or was blocked; for a run after a service event, the event.
    attempts : int
        How often it was started.
    key : str
        Name of the run in the journal.

    Examples
    --------
    >>> at = datetime.fromisoformat("2026-03-02T07:00Z")
    >>> Run("weekly", at, "due", "", 0, "20260302T070000Z").state
    'due'
    """

    schedule: str
    time: datetime
    state: State
    why: str
    attempts: int
    key: str

    @property
    def startable(self) -> bool:
        """Whether it may start now."""
        return self.state in ("due", "blocked")


class Claim:
    """The right to carry out a run, which is renewed while it is held; see :meth:`Schedules.claim`."""

    def __init__(
        self, journal: Journal, key: str, attempt: int, lease: timedelta, clock: Callable[[], datetime]
    ) -> None:
        self.key, self.attempt = key, attempt
        self._journal, self._lease, self._clock = journal, lease, clock
        self._over, self._beat = threading.Event(), 0
        self._thread = threading.Thread(target=self._renew, daemon=True)
        self._thread.start()

    def _renew(self) -> None:
        while not self._over.wait(self._lease.total_seconds() / 3):
            self._beat += 1
            name = f"{self.key} attempt {self.attempt} renewal {self._beat}"
            until = self._clock() + self._lease
            document = {"run": self.key, "attempt": self.attempt, "until": until.isoformat()}
            try:
                self._journal.append(name, "renewed", document)
            except ArchiveError:  # the next renewal tries again; the lease lasts three times as long
                continue

    def end(self, outcome: Literal["done", "failed", "blocked"], why: str) -> None:
        """Record the outcome, and give the run back."""
        self._over.set()
        self._thread.join()
        name = f"{self.key} attempt {self.attempt} end"
        document = {"run": self.key, "attempt": self.attempt, "outcome": outcome, "why": why}
        self._journal.append(name, "ended", document)


class Schedules:
    """Schedules of an archive.

    Parameters
    ----------
    archive : Archive
        The archive.
    lease : timedelta
        How long a run whose scheduler has disappeared counts as running.

    Examples
    --------
    >>> import tempfile
    >>> weekly = Schedule(name="weekly", recalibration="left", rule="FREQ=WEEKLY;COUNT=52",
    ...                   start="2026-03-02T08:00", zone="UTC")
    >>> begin, now = (datetime.fromisoformat(each) for each in ("2026-03-01T00:00Z", "2026-03-09T09:00Z"))
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     schedules = Schedules(archive)
    ...     schedules.add(weekly, begin)
    ...     [(f"{run.time:%m-%d}", run.state) for run in schedules.runs("weekly", now)]
    [('03-02', 'missed'), ('03-09', 'due'), ('03-16', 'scheduled')]
    """

    def __init__(self, archive: Archive, lease: timedelta = timedelta(minutes=10)) -> None:
        self._archive, self._lease = archive, lease
        self._who = {"host": socket.gethostname(), "process": os.getpid()}

    def names(self) -> list[str]:
        """Return the names of the schedules that were not removed."""
        every = self._archive.journals(_PREFIX)
        return [name for name in every if self._entries(name)[-1].kind != "removed"]

    def add(self, schedule: Schedule, at: datetime | None = None) -> None:
        """Add a schedule, or change one: its earlier runs stay as they were.

        Parameters
        ----------
        schedule : Schedule
            The schedule.
        at : datetime, optional
            From when on it counts, by default now: earlier occurrences are not shown as missed.
        """
        since = a_time(at or self._archive.clock())
        document = {"schedule": schedule.to_dict(), "since": since.isoformat()}
        self._archive.journal(_PREFIX + schedule.name).add("schedule", document)

    def remove(self, name: str, at: datetime | None = None) -> None:
        """Remove a schedule; its history stays."""
        self.get(name)
        since = a_time(at or self._archive.clock()).isoformat()
        self._archive.journal(_PREFIX + name).add("removed", {"since": since})

    def get(self, name: str) -> Schedule:
        """Return a schedule.

        Raises
        ------
        UsageError
            If there is none, or it was removed.
        """
        schedule = self._versions(name)[-1][1]
        if schedule is None:
            raise UsageError("was removed", where=name)
        return schedule

    def runs(self, name: str, now: datetime | None = None, ahead: int = 1) -> list[Run]:
        """Return all runs up to now and the next ones, in time order.

        Parameters
        ----------
        name : str
            The schedule.
        now : datetime, optional
            The present time.
        ahead : int
            Number of later runs.
        """
        time = a_time(now or self._archive.clock())
        versions = self._versions(name)
        ends = [since for since, _ in versions[1:]] + [None]
        found: dict[str, tuple[datetime, timedelta, str]] = {}
        for (since, schedule), end in zip(versions, ends, strict=True):
            if schedule is None:
                continue
            later = 0
            for each in schedule.recurrence.occurrences(since, end):
                later += each > time
                if later > ahead:
                    break
                found[f"{each:%Y%m%dT%H%M%SZ}"] = each, schedule.window, ""
            for at, what in self._service_events(schedule):
                if since <= at and (end is None or at < end):
                    found[f"event {at:%Y%m%dT%H%M%SZ}"] = at, schedule.window, f"service event: {what}"
        ordered = sorted(found.items(), key=lambda item: (item[1][0], item[0]))
        entries = self._entries(name)
        runs = []
        for number, (key, (at, window, why)) in enumerate(ordered):
            following = ordered[number + 1][1][0] if number + 1 < len(ordered) else None
            runs.append(self._run(name, key, at, window, why, following, entries, time))
        return runs

    def _service_events(self, schedule: Schedule) -> list[tuple[datetime, str]]:
        known = Configurations(self._archive)
        name = schedule.configuration
        return [] if name is None or name not in known.names() else known.events(name)

    def _run(
        self, name: str, key: str, at: datetime, window: timedelta, why: str, following: datetime | None,
        entries: list[Entry], now: datetime,
    ) -> Run:  # fmt: skip
        """State of a run by the entries about it and the time."""
        own = [each for each in entries if each.document.get("run") == key]
        attempts = [each for each in own if each.kind == "started"]
        ended = [each.document for each in own if each.kind == "ended"]
        last = ended[-1] if ended else None
        if last is not None and last["outcome"] in ("done", "failed"):
            return Run(name, at, last["outcome"], last["why"] or why, len(attempts), key)
        open_ones = {each.document["attempt"] for each in attempts} - {each["attempt"] for each in ended}
        lost = False
        if open_ones:
            leases = [
                datetime.fromisoformat(each.document["until"])
                for each in own
                if each.kind in ("started", "renewed") and each.document["attempt"] == max(open_ones)
            ]
            if max(leases) > now:
                return Run(name, at, "running", why, len(attempts), key)
            lost = True
        if now < at:
            return Run(name, at, "scheduled", why, len(attempts), key)
        if last is not None:
            why = last["why"]
        if lost:
            why = "its process ended without an outcome"
        # A run after a service event is due until it is carried out, or until the next run is due.
        if now <= at + window or (key.startswith("event") and (following is None or now < following)):
            return Run(name, at, "blocked" if last is not None else "due", why, len(attempts), key)
        state: State = "missed" if following is not None and following <= now else "overdue"
        return Run(name, at, state, why, len(attempts), key)

    def claim(self, run: Run, now: datetime | None = None) -> Claim | None:
        """Claim a run that may start.

        Returns
        -------
        Claim or None
            None if another scheduler was faster, or the run may not start (any more).
        """
        time = a_time(now or self._archive.clock())
        current = [each for each in self.runs(run.schedule, time) if each.key == run.key]
        if not current or not current[0].startable:
            return None
        attempt = current[0].attempts + 1
        journal = self._archive.journal(_PREFIX + run.schedule)
        until = time + self._lease
        document = {"run": run.key, "attempt": attempt, "until": until.isoformat()} | self._who
        if journal.append(f"{run.key} attempt {attempt}", "started", document) is None:
            return None
        return Claim(journal, run.key, attempt, self._lease, self._archive.clock)

    def run_due(
        self, carry_out: Callable[[Schedule, Run], str], now: datetime | None = None,
        only: Callable[[Schedule], bool] = lambda schedule: True,
    ) -> list[Run]:  # fmt: skip
        """Carry out all runs that may start now.

        Parameters
        ----------
        carry_out : callable
            Carries out a run and returns its outcome in a line. An :class:`InstrumentError` (an instrument
            is in use, not ready, or does not answer) blocks the run, which may start again in its window;
            any other error of the project fails it.
        now : datetime, optional
            The present time.
        only : callable
            Which schedules are looked at.

        Returns
        -------
        list of Run
            The runs that were started, with their outcome.
        """
        found = []
        for name in self.names():
            schedule = self.get(name)
            for run in self.runs(name, now) if only(schedule) else ():
                claim = self.claim(run, now) if run.startable else None
                if claim is None:
                    continue
                with _ended(claim):
                    try:
                        claim.end("done", carry_out(schedule, run))
                    except InstrumentError as error:
                        claim.end("blocked", str(error))
                    except ReseauError as error:
                        claim.end("failed", str(error))
                found += [each for each in self.runs(name, now) if each.key == run.key]
        return found

    def feed(self, name: str, now: datetime | None = None, ahead: int = 52) -> str:
        """Return the runs of a schedule as an iCalendar feed, with their states."""
        time = a_time(now or self._archive.clock())
        lines = ["BEGIN:VCALENDAR", "VERSION:2.0", "PRODID:-//reseau//schedule//EN"]
        window = self.get(name).window
        for each in self.runs(name, time, ahead):
            lines += [
                "BEGIN:VEVENT", f"UID:{_escaped(each.key.replace(' ', '-'))}-{_escaped(name)}@reseau",
                f"DTSTAMP:{_utc(time)}", f"DTSTART:{_utc(each.time)}", f"DTEND:{_utc(each.time + window)}",
                f"SUMMARY:{_escaped(name)}: {each.state}",
                *([f"DESCRIPTION:{_escaped(each.why)}"] if each.why else []), "END:VEVENT",
            ]  # fmt: skip
        return "".join(f"{_folded(line)}\r\n" for line in [*lines, "END:VCALENDAR"])

    def _versions(self, name: str) -> list[tuple[datetime, Schedule | None]]:
        """From when on which schedule counts; None: it was removed."""
        found: list[tuple[datetime, Schedule | None]] = []
        for each in self._entries(name):
            if each.kind in ("schedule", "removed"):
                content = each.document.get("schedule")
                schedule = None if content is None else Schedule.from_content(dict(content), where=name)
                found.append((datetime.fromisoformat(each.document["since"]), schedule))
        return found

    def _entries(self, name: str) -> list[Entry]:
        found = self._archive.journal(_PREFIX + name).entries()
        if not found:
            raise UsageError("is not a schedule of this archive", where=name, do="see `reseau schedule list`")
        return found


@contextmanager
def _ended(claim: Claim) -> Iterator[None]:
    """Record a run that ends by anything else than its outcome, such as Ctrl-C, as blocked."""
    try:
        yield
    except BaseException as error:
        claim.end("blocked", f"stopped ({type(error).__name__})")
        raise


_MOST = 100_000
"""Largest number of occurrences of a rule."""
_AHEAD = timedelta(days=3653)
"""How far an occurrence may be from the one before it."""
_CYCLE = 400
"""Years after which dates and days of the week repeat."""
_UNITS_S = {"HOURLY": 3600, "MINUTELY": 60, "SECONDLY": 1}


@dataclass(frozen=True)
class Recurrence:
    """A recurrence rule with its start.

    Parameters
    ----------
    rule : str
        RRULE of RFC 5545 with COUNT or UNTIL, such as ``FREQ=WEEKLY;BYDAY=MO;COUNT=52``.
    start : datetime
        First occurrence, local time without a zone.
    zone : str
        Name of the time zone (IANA), such as ``Europe/Berlin``.
    except_for : tuple of datetime
        Occurrences that are left out, local times.

    Raises
    ------
    UsageError
        If the rule is not one, has no end, too many occurrences, none within ten years after another one, or
        its first occurrence is not the start; or the zone is unknown.

    Notes
    -----
    A local time that a change to summer time skips is that with the offset before the change; of one that
    occurs twice the first is meant (RFC 5545, 3.3.5).

    Examples
    --------
    >>> weekly = Recurrence("FREQ=WEEKLY;COUNT=3", datetime(2026, 3, 22, 2, 30), "Europe/Berlin")
    >>> [f"{each:%m-%d %H:%M}" for each in weekly.occurrences()]
    ['03-22 01:30', '03-29 01:30', '04-05 00:30']
    """

    rule: str
    start: datetime
    zone: str
    except_for: tuple[datetime, ...] = ()

    def __post_init__(self) -> None:
        if self.start.tzinfo is not None or any(each.tzinfo is not None for each in self.except_for):
            raise UsageError("must be local times; the zone is given apart", where="start")
        _zone(self.zone)
        if self.start.microsecond:
            raise UsageError("has fractions of a second", where="start")
        if not _parts(self.rule).keys() & {"COUNT", "UNTIL"}:
            raise UsageError("has no end", where=f"rule {self.rule!r}", do="add COUNT or UNTIL")
        if _expanded(self.rule, self.start, self.zone)[:1] != (self.start,):
            raise UsageError(
                f"does not occur at its start {self.start:%Y-%m-%d %H:%M}", where=f"rule {self.rule!r}",
                do="let the start be an occurrence",
            )  # fmt: skip

    def occurrences(self, begin: datetime | None = None, end: datetime | None = None) -> list[datetime]:
        """Return the occurrences from `begin` to before `end`, UTC, in order."""
        zone, found = _zone(self.zone), []
        for local in _expanded(self.rule, self.start, self.zone):
            time = local.replace(tzinfo=zone).astimezone(UTC)
            if end is not None and time >= end:
                break
            if local not in self.except_for and (begin is None or time >= begin):
                found.append(time)
        return found


def _parts(rule: str) -> dict[str, str]:
    """Parts of a rule, by their names in capitals."""
    pairs = (part.strip().upper().partition("=") for part in rule.split(";") if part.strip())
    return {key: value for key, _, value in pairs}


@lru_cache(maxsize=16)
def _expanded(rule: str, start: datetime, zone: str) -> tuple[datetime, ...]:
    """Local times of a rule, from the first one on to its end."""
    known, parts, found = _zone(zone), _parts(rule), list[datetime]()
    until, count = _until(parts.get("UNTIL"), known), parts.get("COUNT")
    where, last = f"rule {rule!r}", start
    for local in _candidates(rule, start):
        if local - last > _AHEAD:
            break
        if until is not None and local.replace(tzinfo=known).astimezone(UTC) > until:
            return tuple(found)
        if len(found) == _MOST:
            raise UsageError(f"has more than {_MOST} occurrences", where=where)
        found.append(local)
        last = local
        if count is not None and len(found) >= int(count):
            return tuple(found)
    if until is not None and last.replace(tzinfo=known).astimezone(UTC) + _AHEAD > until:
        return tuple(found)
    raise UsageError(
        f"has no occurrence within ten years after {last:%Y-%m-%d %H:%M}", where=where,
        do="correct it, or end it there",
    )  # fmt: skip


def _candidates(rule: str, start: datetime) -> Iterator[datetime]:
    """Local times of a rule without its end.

    The library looks for a next occurrence up to the year 9999, for frequencies below a day step by step. It
    is given days only, in the last cycle of the calendar before that year; times of day are computed here.
    """
    with optional():
        from dateutil.rrule import rrulestr

    parts = {key: value for key, value in _parts(rule).items() if key != "UNTIL"}
    shift = (datetime.max.year - start.year) // _CYCLE * _CYCLE
    late = start.replace(year=start.year + shift)
    try:
        rrulestr(_text(parts), dtstart=start)  # whatever is wrong with it
        parts.pop("COUNT", None)
        if parts["FREQ"] not in _UNITS_S:
            for each in rrulestr(_text(parts), dtstart=late):
                yield each.replace(year=each.year - shift)
            return
        if "BYSETPOS" in parts:
            raise ValueError("BYSETPOS needs a frequency of a day or longer")
        times = {key: parts.pop(key, "") for key in ("BYHOUR", "BYMINUTE", "BYSECOND")}
        days = rrulestr(
            _text(parts | {"FREQ": "DAILY", "INTERVAL": "1"}),
            dtstart=late.replace(hour=0, minute=0, second=0),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"is no rule of RFC 5545 ({error})", where=f"rule {rule!r}") from None
    unit, interval = _UNITS_S[parts["FREQ"]], int(parts.get("INTERVAL", "1"))
    # What is below the frequency is that of the start, unless it is given; what is not below is any.
    given = [[int(each) for each in text.split(",")] if text else None for text in times.values()]
    hours, minutes, seconds = (
        np.array(own or ([of] if length < unit else range(most)))
        for own, of, length, most in zip(
            given, (start.hour, start.minute, start.second), (3600, 60, 1), (24, 60, 60), strict=True
        )
    )
    day = np.unique(hours[:, None, None] * 3600 + minutes[:, None] * 60 + seconds)
    begun = start.hour * 3600 + start.minute * 60 + start.second
    last = late
    for each in days:
        passed = day + 86400 * (each.date() - late.date()).days
        due = passed[(passed >= begun) & ((passed // unit - begun // unit) % interval == 0)]
        midnight = start - timedelta(seconds=begun)
        yield from (midnight + timedelta(seconds=int(second)) for second in due)
        last = each if len(due) else last
        if each - last > _AHEAD:
            return


def _text(parts: dict[str, str]) -> str:
    return ";".join(f"{key}={value}" for key, value in parts.items())


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise UsageError(
            "is not a time zone", where=repr(name), do="use a name such as Europe/Berlin"
        ) from None


def _until(text: str | None, zone: ZoneInfo) -> datetime | None:
    """The end of a rule, UTC."""
    if text is None:
        return None
    for pattern in ("%Y%m%dT%H%M%SZ", "%Y%m%dT%H%M%S", "%Y%m%d"):
        try:
            found = datetime.strptime(text, pattern)
        except ValueError:
            continue
        if pattern == "%Y%m%d":  # the whole day
            found += timedelta(days=1, seconds=-1)
        return found.replace(tzinfo=UTC if pattern.endswith("Z") else zone).astimezone(UTC)
    raise UsageError(f"{text!r} is not a date and time", where="UNTIL", do="use 20261231T000000Z")


def _utc(time: datetime) -> str:
    return f"{time.astimezone(UTC):%Y%m%dT%H%M%SZ}"


def _escaped(text: str) -> str:
    for plain, written in (("\\", "\\\\"), (";", "\\;"), (",", "\\,"), ("\n", "\\n")):
        text = text.replace(plain, written)
    return text.replace("\r", "")


def _folded(line: str) -> str:
    """Lines of at most 75 bytes, continued after a space."""
    found, width = [""], 0
    for letter in line:
        size = len(letter.encode("utf-8"))
        if width + size > 75:
            found.append("")
            width = 1
        found[-1] += letter
        width += size
    return "\r\n ".join(found)
