"""Schedules: recurrence, states of runs, and schedulers that meet sleep, changes of clocks and each other."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.core.errors import EstimationError, FormatError, StateError, UsageError
from reseau.service import Configurations, Run, Schedule, Schedules
from reseau.service.schedule import Recurrence

ZONES = (
    "UTC", "Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "Asia/Kolkata", "America/Sao_Paulo"
)  # fmt: skip
DAYS = ("MO", "TU", "WE", "TH", "FR", "SA", "SU")


def random_rule(rng: np.random.Generator) -> str:
    """A rule of RFC 5545 without its end."""
    frequency = str(rng.choice(["HOURLY", "DAILY", "WEEKLY", "MONTHLY", "YEARLY"]))
    parts = [f"FREQ={frequency}", f"INTERVAL={rng.integers(1, 5)}"]

    def some(values: list[str], most: int) -> str:
        chosen = rng.choice(len(values), rng.integers(1, most + 1), replace=False)
        return ",".join(values[k] for k in sorted(chosen))

    if rng.random() < 0.5:
        days = list(DAYS)
        if frequency in ("MONTHLY", "YEARLY") and rng.random() < 0.5:
            days = [f"{n}{day}" for n in (1, 2, 3, -1) for day in DAYS]
        parts.append(f"BYDAY={some(days, 3)}")
    elif frequency != "WEEKLY" and rng.random() < 0.5:
        parts.append(f"BYMONTHDAY={some([str(k) for k in (1, 5, 15, 28, 31, -1, -3)], 3)}")
    if rng.random() < 0.3:
        parts.append(f"BYMONTH={some([str(k) for k in range(1, 13)], 5)}")
    if frequency != "HOURLY" and rng.random() < 0.3:
        parts.append(f"BYHOUR={some([str(k) for k in range(24)], 3)}")
    if rng.random() < 0.2:
        parts.append(f"BYMINUTE={some(['0', '10', '30'], 2)}")
    if frequency in ("MONTHLY", "YEARLY") and "BYDAY" in parts[-1] and rng.random() < 0.4:
        parts.append(f"BYSETPOS={rng.choice(['1', '-1', '2'])}")
    if rng.random() < 0.3:
        parts.append(f"WKST={rng.choice(DAYS)}")
    return ";".join(parts)


def synchronised(rule: str, start: datetime) -> datetime | None:
    """The first time of a rule after `start`."""
    from dateutil.rrule import rrulestr

    found: datetime | None = rrulestr(rule, dtstart=start).after(start)
    return found if found is not None and found.year < 2035 else None


@pytest.mark.parametrize("seed", range(5))
def test_occurrences_of_1000_random_rules_are_those_of_another_program(seed: int) -> None:
    icalendar = pytest.importorskip("icalendar", reason="needs recurring-ical-events")
    events = pytest.importorskip("recurring_ical_events")
    rng, compared, many = np.random.default_rng(seed), 0, 0
    while compared < 200:
        zone, rule = str(rng.choice(ZONES)), random_rule(rng)
        begin = datetime(2026, 1, 1) + timedelta(hours=int(rng.integers(0, 24 * 365)), minutes=30)
        start = synchronised(rule, begin)
        if start is None:
            continue
        if rng.random() < 0.5:
            rule += f";COUNT={rng.integers(1, 40)}"
        else:
            end = (start + timedelta(days=int(rng.integers(1, 200)))).replace(tzinfo=UTC)
            rule += f";UNTIL={end:%Y%m%dT%H%M%SZ}"
        own = Recurrence(rule, start, zone).occurrences()[:400]
        event = icalendar.Event()
        event.add("uid", "1")
        event.add("dtstart", start.replace(tzinfo=ZoneInfo(zone)))
        event.add("dtend", start.replace(tzinfo=ZoneInfo(zone)))
        event.add("rrule", icalendar.vRecur.from_ical(rule))
        calendar = icalendar.Calendar()
        calendar.add_component(event)
        low, high = own[0] - timedelta(days=3), own[-1] + timedelta(minutes=1)
        theirs = events.of(calendar).between(low, high)
        times = sorted(each["DTSTART"].dt.astimezone(UTC) for each in theirs)
        assert times == own, (rule, start, zone)
        compared, many = compared + 1, many + len(own)
    assert many > 2000


def test_times_that_a_change_of_the_clock_skips_or_repeats_occur_once() -> None:
    daily = Recurrence("FREQ=DAILY;COUNT=3", datetime(2026, 3, 28, 2, 30), "Europe/Berlin")
    assert [f"{each:%d %H:%M}" for each in daily.occurrences()] == ["28 01:30", "29 01:30", "30 00:30"]
    daily = Recurrence("FREQ=DAILY;COUNT=3", datetime(2026, 10, 24, 2, 30), "Europe/Berlin")
    assert [f"{each:%d %H:%M}" for each in daily.occurrences()] == ["24 00:30", "25 00:30", "26 01:30"]


@pytest.mark.parametrize(
    ("rule", "zone", "part"),
    [
        ("FREQ=WEEKLY", "UTC", "has no end; add COUNT or UNTIL"),
        ("FREQ=SOMETIMES;COUNT=3", "UTC", "is no rule of RFC 5545"),
        ("FREQ=WEEKLY;BYDAY=TU;COUNT=3", "UTC", "does not occur at its start 2026-03-02 08:00"),
        ("FREQ=WEEKLY;COUNT=3", "Mars/Olympus", "'Mars/Olympus': is not a time zone"),
        ("FREQ=WEEKLY;UNTIL=soon", "UTC", "UNTIL: 'SOON' is not a date and time"),
        ("COUNT=3", "UTC", "is no rule of RFC 5545"),
        ("FREQ=WEEKLY;COUNT=many", "UTC", "is no rule of RFC 5545"),
        ("FREQ=SECONDLY;COUNT=2;BYSETPOS=1", "UTC", "BYSETPOS needs a frequency of a day or longer"),
        *(
            (f"{rule};BYMONTH=2;BYMONTHDAY=30;COUNT=2", "UTC", "no occurrence within ten years")
            for rule in (
                "FREQ=SECONDLY",
                "FREQ=SECONDLY;BYHOUR=3",
                "FREQ=HOURLY;INTERVAL=5",
                "FREQ=DAILY",
                "FREQ=WEEKLY",
                "FREQ=MONTHLY",
                "FREQ=YEARLY",
            )
        ),
        # Every 16 s from 08:00:00 on, which never is a second 4 of the first minute after three.
        ("FREQ=SECONDLY;INTERVAL=16;BYHOUR=3;BYMINUTE=0;BYSECOND=4;COUNT=2", "UTC", "within ten years"),
        ("FREQ=YEARLY;INTERVAL=11;COUNT=2", "UTC", "no occurrence within ten years after 2026-03-02 08:00"),
        ("FREQ=HOURLY;COUNT=1000000", "UTC", "has more than 100000 occurrences"),
    ],
)
def test_unusable_rules_are_refused_in_one_line(rule: str, zone: str, part: str) -> None:
    with pytest.raises(UsageError, match=part):
        Recurrence(rule, datetime(2026, 3, 2, 8), zone)


def test_frequencies_below_a_day_are_expanded_as_by_the_library_that_goes_step_by_step() -> None:
    from dateutil.rrule import rrulestr

    rng = np.random.default_rng(3)
    for _ in range(60):
        parts = [f"FREQ={rng.choice(['HOURLY', 'MINUTELY', 'SECONDLY'])};INTERVAL={rng.integers(1, 40)}"]
        for name, low, high in (
            ("BYHOUR", 0, 24),
            ("BYMINUTE", 0, 60),
            ("BYSECOND", 0, 60),
            ("BYMONTH", 1, 13),
        ):
            if rng.random() < 0.3:
                parts.append(f"{name}={','.join(str(k) for k in range(low, high, int(rng.integers(2, 6))))}")
        if rng.random() < 0.3:
            parts.append("BYDAY=MO,WE,FR")
        rule, begun = ";".join(parts) + ";COUNT=30", datetime(2026, 3, 2, 8, 7, 12)
        try:
            start = rrulestr(rule, dtstart=begun)[0]
        except ValueError:  # it has found that the rule has no occurrence
            continue
        expected = [each.replace(tzinfo=UTC) for each in rrulestr(rule, dtstart=start)]
        assert Recurrence(rule, start, "UTC").occurrences() == expected, rule


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        (
            "FREQ=MINUTELY;INTERVAL=30;BYHOUR=8,9;COUNT=5",
            ["02 08:00", "02 08:30", "02 09:00", "02 09:30", "03 08:00"],
        ),
        ("FREQ=HOURLY;INTERVAL=5;BYMINUTE=0,15;COUNT=4", ["02 08:00", "02 08:15", "02 13:00", "02 13:15"]),
        ("FREQ=HOURLY;INTERVAL=25;BYDAY=MO,TH;COUNT=3", ["02 08:00", "05 11:00", "09 15:00"]),
        ("FREQ=YEARLY;INTERVAL=20;UNTIL=20300101T000000Z", ["02 08:00"]),
    ],
)
def test_rules_below_a_day_and_with_rare_occurrences_are_expanded(rule: str, expected: list[str]) -> None:
    found = Recurrence(rule, datetime(2026, 3, 2, 8), "UTC").occurrences()
    assert [f"{each:%d %H:%M}" for each in found] == expected


WEEKLY = Schedule(name="weekly", recalibration="left", configuration="left", rule="FREQ=WEEKLY;COUNT=52",
                  start="2026-03-02T08:00", zone="Europe/Berlin", window_minutes=120)  # fmt: skip


def week(number: float, hours: float = 0.0) -> datetime:
    """A time in the weeks from the first run on."""
    return datetime(2026, 3, 2, 7, tzinfo=UTC) + timedelta(weeks=number, hours=hours)


@pytest.fixture
def schedules(opened: Callable[[], Archive]) -> Iterator[Schedules]:
    with opened() as archive:
        made = Schedules(archive)
        made.add(WEEKLY, week(-0.5))
        yield made


def states(schedules: Schedules, now: datetime) -> list[str]:
    return [each.state for each in schedules.runs("weekly", now)]


def test_runs_are_scheduled_due_overdue_and_missed_and_never_dropped(schedules: Schedules) -> None:
    assert states(schedules, week(0, -1)) == ["scheduled"]
    assert states(schedules, week(0, 1)) == ["due", "scheduled"]
    assert states(schedules, week(0, 3)) == ["overdue", "scheduled"]
    assert states(schedules, week(1, 1)) == ["missed", "due", "scheduled"]
    assert states(schedules, week(3, 3)) == ["missed"] * 3 + ["overdue", "scheduled"]


def test_a_machine_that_slept_starts_nothing_after_the_window(schedules: Schedules) -> None:
    started: list[Run] = []

    def carry_out(_: Schedule, run: Run) -> str:
        started.append(run)
        return "accepted"

    assert schedules.run_due(carry_out, week(0, 3)) == []
    (run,) = schedules.run_due(carry_out, week(2, 1))
    assert (run.state, run.why, len(started)) == ("done", "accepted", 1)
    assert states(schedules, week(2, 1)) == ["missed", "missed", "done", "scheduled"]
    assert schedules.run_due(carry_out, week(2, 1.5)) == []


def test_a_clock_that_is_set_back_starts_no_run_again(schedules: Schedules) -> None:
    assert len(schedules.run_due(lambda *_: "ok", week(1, 1))) == 1
    for now in (week(1, 0.5), week(0, 23), week(1, 1)):
        assert not [run for run in schedules.run_due(lambda *_: "ok", now) if run.time == week(1)]
    assert [run.attempts for run in schedules.runs("weekly", week(1, 1)) if run.time == week(1)] == [1]


def test_summer_time_moves_a_run_and_keeps_its_local_time(schedules: Schedules) -> None:
    times = [each.time.astimezone(ZoneInfo("Europe/Berlin")) for each in schedules.runs("weekly", week(8))]
    assert {each.hour for each in times} == {8}
    assert {each.utcoffset() for each in times} == {timedelta(hours=1), timedelta(hours=2)}


def test_of_schedulers_at_once_one_carries_out_the_run(
    opened: Callable[[], Archive], schedules: Schedules
) -> None:
    inside, most, count, lock = 0, 0, 0, threading.Lock()

    def carry_out(*_: object) -> str:
        nonlocal inside, most, count
        with lock:
            inside, count = inside + 1, count + 1
            most = max(most, inside)
        threading.Event().wait(0.3)
        with lock:
            inside -= 1
        return "ok"

    def scheduler(_: int) -> int:
        with opened() as archive:
            return len(Schedules(archive).run_due(carry_out, week(0, 1)))

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(scheduler, range(6))) == 1
    assert (most, count) == (1, 1)


def test_a_run_of_a_scheduler_that_disappeared_is_carried_out_when_its_lease_has_ended(
    schedules: Schedules,
) -> None:
    (run, _) = schedules.runs("weekly", week(0, 0.1))
    claim = schedules.claim(run, week(0, 0.1))
    assert claim is not None
    claim._over.set()  # killed: neither renewed nor ended
    assert states(schedules, week(0, 0.2))[0] == "running"
    assert schedules.claim(run, week(0, 0.2)) is None
    assert schedules.runs("weekly", week(0, 0.5))[0].why == "its process ended without an outcome"
    (again,) = schedules.run_due(lambda *_: "accepted", week(0, 0.5))
    assert (again.state, again.attempts) == ("done", 2)


def test_a_lease_is_renewed_as_long_as_the_run_goes_on(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "archive", create=True) as archive:
        short = Schedules(archive, timedelta(seconds=0.6))
        now = datetime.now(UTC)
        start = f"{now - timedelta(minutes=1):%Y-%m-%dT%H:%M:%S}"
        short.add(WEEKLY.model_copy(update={"start": start, "zone": "UTC"}), now - timedelta(hours=1))
        claim = short.claim(short.runs("weekly")[0])
        assert claim is not None
        threading.Event().wait(2.0)
        assert short.runs("weekly")[0].state == "running"
        claim.end("done", "ok")
        assert short.runs("weekly")[0].state == "done"


@pytest.mark.slow
def test_a_bench_in_use_blocks_a_run_which_starts_again_in_its_window(schedules: Schedules) -> None:
    def busy(*_: object) -> str:
        raise StateError("is in use", where="camera")

    (run,) = schedules.run_due(busy, week(0, 0.5))
    assert (run.state, run.why) == ("blocked", "camera: is in use")
    (run,) = schedules.run_due(lambda *_: "accepted", week(0, 1))
    assert (run.state, run.attempts) == ("done", 2)


def test_a_run_that_stays_blocked_or_fails_is_shown_with_its_reason(schedules: Schedules) -> None:
    def dead(*_: object) -> str:
        raise StateError("is in use", where="camera")

    def bad(*_: object) -> str:
        raise EstimationError("too few points", where="left")

    schedules.run_due(dead, week(0, 0.5))
    assert next((r.state, r.why) for r in schedules.runs("weekly", week(0, 5))) == (
        "overdue",
        "camera: is in use",
    )
    (run,) = schedules.run_due(bad, week(1, 0.5))
    assert (run.state, run.why) == ("failed", "left: too few points")
    assert schedules.run_due(bad, week(1, 1)) == []


def test_a_run_that_is_interrupted_is_blocked_and_the_interrupt_goes_on(schedules: Schedules) -> None:
    def interrupted(*_: object) -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        schedules.run_due(interrupted, week(0, 0.5))
    assert schedules.runs("weekly", week(0, 0.6))[0].state == "blocked"


def test_after_a_service_event_a_run_is_due_at_once(schedules: Schedules) -> None:
    known = Configurations(schedules._archive)
    known.define("left", {"camera": "DMK 33"})
    known.event("left", "lens changed", at=week(0.5))
    (run,) = (each for each in schedules.runs("weekly", week(0.6)) if each.state == "due")
    assert (run.time, run.why) == (week(0.5), "service event: lens changed")
    assert len(schedules.run_due(lambda *_: "accepted", week(0.6))) == 1
    assert "due" not in states(schedules, week(0.7))


def test_a_changed_schedule_keeps_its_history(schedules: Schedules) -> None:
    schedules.run_due(lambda *_: "ok", week(0, 1))
    changed = WEEKLY.model_copy(update={"rule": "FREQ=DAILY;COUNT=400"})
    schedules.add(changed, week(2, 0.5))
    runs = schedules.runs("weekly", week(2, 49))
    assert [each.state for each in runs] == ["done", "missed", "missed", "missed", "due", "scheduled"]
    schedules.remove("weekly", week(2, 50))
    assert schedules.names() == []
    with pytest.raises(UsageError, match="weekly: was removed"):
        schedules.get("weekly")


def test_the_feed_is_read_by_another_program(schedules: Schedules) -> None:
    icalendar = pytest.importorskip("icalendar", reason="needs recurring-ical-events")
    schedules.run_due(lambda *_: "größer, als erlaubt; " * 8, week(0, 1))
    text = schedules.feed("weekly", week(1, 1), 5)
    assert all(len(line.encode()) <= 75 for line in text.split("\r\n"))
    found = icalendar.Calendar.from_ical(text).walk("VEVENT")
    assert [str(each["summary"]) for each in found[:3]] == [
        "weekly: done",
        "weekly: due",
        "weekly: scheduled",
    ]
    assert str(found[0]["description"]) == ("größer, als erlaubt; " * 8)
    assert [each["dtstart"].dt for each in found[:2]] == [week(0), week(1)]
    assert len({str(each["uid"]) for each in found}) == 7
    schedules.add(WEEKLY.model_copy(update={"name": "a\\b;c,d\ne"}), week(0))
    event, *_ = icalendar.Calendar.from_ical(schedules.feed("a\\b;c,d\ne", week(0))).walk("VEVENT")
    assert str(event["summary"]) == "a\\b;c,d\ne: due"


def test_a_schedule_is_checked_when_it_is_read() -> None:
    content = WEEKLY.to_dict() | {"rule": "FREQ=WEEKLY"}
    with pytest.raises(FormatError, match="has no end"):
        Schedule.from_content(content, where="weekly.json")
