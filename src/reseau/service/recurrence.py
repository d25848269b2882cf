"""Recurrence after RFC 5545: when the runs of a schedule are due, in a time zone; and an iCalendar feed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from ..core.errors import UsageError
from ..core.optional import optional

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
