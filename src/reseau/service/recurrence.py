"""Recurrence after RFC 5545: when the runs of a schedule are due, in a time zone; and an iCalendar feed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from ..core.errors import UsageError
from ..core.optional import optional

__all__ = ["CalendarEvent", "Recurrence", "calendar_feed"]

_MOST = 100_000
"""Largest number of occurrences of a rule that are examined."""


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
        If the rule is not one, has no end, or its first occurrence is not the start; or the zone is unknown.

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
        keys = {part.partition("=")[0].strip().upper() for part in self.rule.split(";")}
        if not keys & {"COUNT", "UNTIL"}:
            raise UsageError("has no end", where=f"rule {self.rule!r}", do="add COUNT or UNTIL")
        if next(iter(self._local()), None) != self.start:
            raise UsageError(
                f"does not occur at its start {self.start:%Y-%m-%d %H:%M}", where=f"rule {self.rule!r}",
                do="let the start be an occurrence",
            )  # fmt: skip

    def occurrences(self, begin: datetime | None = None, end: datetime | None = None) -> list[datetime]:
        """Return the occurrences from `begin` to before `end`, UTC, in order.

        Raises
        ------
        UsageError
            If there are too many.
        """
        zone, found = _zone(self.zone), []
        until = _until(self.rule, zone)
        for local in self._local():
            time = local.replace(tzinfo=zone).astimezone(UTC)
            if (until is not None and time > until) or (end is not None and time >= end):
                break
            if local not in self.except_for and (begin is None or time >= begin):
                found.append(time)
        return found

    def _local(self) -> Iterator[datetime]:
        """Local times of the rule without UNTIL, which is a time of its own zone."""
        with optional():
            from dateutil.rrule import rrulestr

        parts = [part for part in self.rule.split(";") if not part.strip().upper().startswith("UNTIL")]
        try:
            rule: Any = rrulestr(";".join(parts), dtstart=self.start)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(f"is no rule of RFC 5545 ({error})", where=f"rule {self.rule!r}") from None
        for count, local in enumerate(rule):
            if count == _MOST:
                raise UsageError(f"has more than {_MOST} occurrences", where=f"rule {self.rule!r}")
            yield local


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise UsageError(
            "is not a time zone", where=repr(name), do="use a name such as Europe/Berlin"
        ) from None


def _until(rule: str, zone: ZoneInfo) -> datetime | None:
    """The end of a rule, UTC."""
    for part in rule.split(";"):
        key, _, text = part.strip().upper().partition("=")
        if key == "UNTIL":
            for pattern in ("%Y%m%dT%H%M%SZ", "%Y%m%dT%H%M%S", "%Y%m%d"):
                try:
                    found = datetime.strptime(text, pattern)
                except ValueError:
                    continue
                if pattern == "%Y%m%d":  # the whole day
                    found += timedelta(days=1, seconds=-1)
                return found.replace(tzinfo=UTC if pattern.endswith("Z") else zone).astimezone(UTC)
            raise UsageError(f"{text!r} is not a date and time", where="UNTIL", do="use 20261231T000000Z")
    return None


@dataclass(frozen=True)
class CalendarEvent:
    """An event of a calendar.

    Parameters
    ----------
    uid : str
        Unique name that stays the same.
    start, end : datetime
        Begin and end, UTC.
    summary, description : str
        Texts.

    Examples
    --------
    >>> now = datetime(2026, 3, 2, 8, tzinfo=UTC)
    >>> CalendarEvent("weekly-1", now, now + timedelta(hours=2), "weekly: due").summary
    'weekly: due'
    """

    uid: str
    start: datetime
    end: datetime
    summary: str
    description: str = ""


def calendar_feed(events: list[CalendarEvent], stamp: datetime) -> str:
    r"""Return an iCalendar file of events; `stamp` is the time at which it was made.

    Examples
    --------
    >>> now = datetime(2026, 3, 2, 8, tzinfo=UTC)
    >>> calendar_feed([CalendarEvent("a", now, now, "due, at once")], now).splitlines()[5:8]
    ['DTSTAMP:20260302T080000Z', 'DTSTART:20260302T080000Z', 'DTEND:20260302T080000Z']
    """
    lines = ["BEGIN:VCALENDAR", "VERSION:2.0", "PRODID:-//reseau//schedule//EN"]
    for each in events:
        lines += [
            "BEGIN:VEVENT", f"UID:{_escaped(each.uid)}", f"DTSTAMP:{_utc(stamp)}",
            f"DTSTART:{_utc(each.start)}", f"DTEND:{_utc(each.end)}", f"SUMMARY:{_escaped(each.summary)}",
            *([f"DESCRIPTION:{_escaped(each.description)}"] if each.description else []), "END:VEVENT",
        ]  # fmt: skip
    lines.append("END:VCALENDAR")
    return "".join(f"{_folded(line)}\r\n" for line in lines)


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
