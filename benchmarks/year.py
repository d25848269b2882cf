"""A simulated year of weekly recalibrations, with all that a year brings, and its log.

    python benchmarks/year.py                  # six of the runs on the simulated bench
    python benchmarks/year.py --bench none     # all results drawn
    python benchmarks/year.py --archive URL --objects FOLDER     # with an index on PostgreSQL

Archive, schedule, sessions, locks, decisions, charts and alarms are those of the project; the clock of the
archive is simulated. In some weeks the simulated bench takes and measures its photographs over its protocols;
in the others it is only connected, and the calibration is drawn: the true camera, with the covariance of a
calibration of the bench, and half of its standard deviations between sessions. On Thursdays somebody reads
the alarms.

The exit status is 1 if one of the expectations at the end of the log does not hold.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from reseau.archive import Archive, Session
from reseau.calibration import Calibration
from reseau.capture import Bench, BenchFile, BenchLock, InstrumentEntry
from reseau.capture.bench import IN_PROCESS, built
from reseau.core.data import Array
from reseau.core.plugins import INSTRUMENTS, SIMULATORS, plugin
from reseau.core.threads import one_thread
from reseau.instruments import Instrument
from reseau.service import (
    AcceptanceRules,
    Alarms,
    Configurations,
    Limits,
    Recalibrations,
    Run,
    Schedule,
    Schedules,
)
from reseau.sessions import conducting

NAME, WEEKS = "left", 52
AXES = ("tilt", "roll", "camera_roll")
POSES = ((0.0, 0.0, 0.0), (30.0, 90.0, 90.0), (30.0, 180.0, 180.0), (30.0, 270.0, 270.0), (30.0, 0.0, 0.0))
ZONE = ZoneInfo("Europe/Berlin")
FIRST = datetime(2026, 1, 5, 8, tzinfo=ZONE)
RULES = AcceptanceRules(
    version=1, image=Limits(warning=0.15, action=0.4),
    refused_warnings=("camera-moved", "camera-unstable", "inconsistent", "not-identified", "weak-geometry"),
)  # fmt: skip
FREE = ("c", "x0", "y0", "K1")
REPEAT = timedelta(days=2)

IN_USE, OFF, BAD, TWO, BACK, DEAD, DRIFT, JUMP, LENS = 4, (7, 8), 15, 17, 20, 24, range(27, 37), 40, 44
"""Weeks, from 0, in which something happens; see `HAPPENS`."""
HAPPENS = {
    IN_USE: "somebody uses the bench until 10:00",
    OFF[0]: "the computer is off for two weeks",
    12: "summer time has begun",
    BAD: "a bad run: the focus was touched, and put back",
    TWO: "two schedulers look at once, from now on",
    BACK: "the clock is set back by two hours after the run",
    DEAD: "the table gives no right answer all day",
    DRIFT[0]: "c begins to drift, 0.6 sigma a week, for ten weeks",
    JUMP: "x0 jumps by 6 sigma",
    42: "summer time has ended",
    LENS: "on Wednesday the lens is changed",
}


class Year:
    """A bench, its archive, its clock, and what is true.

    Parameters
    ----------
    open_archive : callable
        Opens the archive with a clock.
    simulated : SimulatedBench
        Servers of the bench.
    on_bench : set of int
        Weeks whose photographs are taken on the bench; -1: those of the first calibration.
    seed : int
        Seed of the drawn calibrations.
    say : callable
        Takes the lines of the log.
    """

    def __init__(
        self,
        open_archive: Callable[[Callable[[], datetime]], Archive],
        simulated: Any,
        on_bench: set[int],
        seed: int,
        say: Callable[[str], None],
    ) -> None:
        self.now = FIRST - timedelta(days=3)
        self.open = lambda: open_archive(lambda: self.now.astimezone(UTC))
        self.archive = self.open()
        self.simulated, self.on_bench, self._say = simulated, on_bench, say
        self.rng = np.random.default_rng(seed)
        self.week, self.base, self.offset = -1, None, np.zeros(len(FREE))
        self.messages: list[tuple[datetime, str]] = []
        self.known, self.alarms = Configurations(self.archive), Alarms(self.archive)
        self.schedules = Schedules(self.archive)
        self.file = BenchFile.parse_toml(self._toml(), where="simulated bench")

    def say(self, text: str) -> None:
        """Write a line of the log, with the local time."""
        self._say(f"{self.now.astimezone(ZONE):%Y-%m-%d %a %H:%M}  {text}")

    def _toml(self) -> str:
        fast = self.simulated.toml.replace("speed = 50.0", "speed = 1000.0")
        if self.simulated.video is None:
            return str(fast)
        return f'{fast}\n[instruments.camera]\ndriver = "v4l2"\naddress = "{IN_PROCESS}"\n'

    def bench(self, file: BenchFile) -> Bench:
        """Table and camera of the simulated bench."""
        entries = {name: file.instruments[name] for name in ("table", "camera")}
        return Bench(file.model_copy(update={"instruments": entries}), self._built)

    def _built(self, name: str, entry: InstrumentEntry) -> Instrument:
        if entry.address != IN_PROCESS:
            return built(name, entry)
        made: Instrument = plugin(INSTRUMENTS, entry.driver)(
            name, self.simulated.video.open, settings={"exposure_us": 10_000.0}, seconds=30.0
        )
        return made

    def capture(self, session: Session, bench: Bench, **_: Any) -> None:
        """Take and adjust the photographs of a session, or draw its calibration."""
        if self.week in self.on_bench:
            conducting.capture(session, bench)
        else:
            session.keep("calibration.json", self._drawn().to_json())
            session.end("done")

    def _drawn(self) -> Calibration:
        """A calibration of the present camera: within-session and between-session errors."""
        assert self.base is not None
        root = np.linalg.cholesky(np.array(self.base.covariance.matrix))
        sigma = self.sigma()
        errors = root @ self.rng.normal(size=len(FREE)) + 0.5 * sigma * self.rng.normal(size=len(FREE))
        found = dict(self.base.parameters)
        for name, value in zip(FREE, self.truth + self.offset + errors, strict=True):
            found[name] = found[name].model_copy(update={"value": float(value)})
        return self.base.model_copy(update={"parameters": found})

    def sigma(self) -> Array:
        """Standard deviations of a calibration within its session."""
        assert self.base is not None
        return np.array([self.base.parameters[name].sigma for name in FREE])

    @property
    def truth(self) -> Array:
        """True parameters of the camera on the bench."""
        camera = self.simulated.laboratory.field.camera
        return np.array([dict(zip(camera.names, camera.values, strict=True))[name] for name in FREE])

    def begin(self) -> None:
        """Calibrate for the first time, and define what is repeated, and when."""
        steps = [[f"{k}", dict(zip(AXES, pose, strict=True))] for k, pose in enumerate(POSES)]
        given = {"steps": steps, "pitch_mm": 0.027, "free": list(FREE), "row_jitter_px": 0.0086, "fill": 0.8,
                 "home": True}  # fmt: skip
        inputs = {"design.json": self.simulated.laboratory.field.design.to_json()}
        session = conducting.begin(self.archive, "first", "testfield", given, inputs, bench=self._toml())
        if -1 in self.on_bench:
            with self.bench(self.file) as bench:
                conducting.capture(session, bench)
        else:
            session.keep("calibration.json", drawn_base(self.truth).to_json())
            session.end("done")
        self.base = conducting.calibration_of(session)
        self.known.define(NAME, {"camera": "simulated", "lens": "57.5 mm", "firmware": "1.0"})
        self.known.decide(NAME, self.base, RULES, since=self.now, by="Ada")
        self.review("first calibration")
        Recalibrations(self.archive).define(NAME, session, NAME, RULES)
        weekly = Schedule(name="weekly", recalibration=NAME, configuration=NAME,
                          rule=f"FREQ=WEEKLY;COUNT={WEEKS}",
                          start=f"{FIRST:%Y-%m-%dT%H:%M}", zone=str(ZONE), window_minutes=240)  # fmt: skip
        self.schedules.add(weekly)

    def review(self, why: str) -> None:
        """Accept what needs a review."""
        for each in self.known.history(NAME):
            if each.outcome == "needs review":
                made = self.known.review(NAME, each.key, "accepted", by="Ada", comment=why)
                self.say(f"Ada: {made.key} accepted ({why})")

    def look(self) -> list[Run]:
        """One look of `reseau schedule run --once`."""
        with self.open() as archive:
            carry_out = partial(Recalibrations(archive).carry_out, bench=self.bench, capture=self.capture)
            found = Schedules(archive).run_due(carry_out)
        for run in found:
            due = run.time.astimezone(ZONE)
            self.say(f"run of {due:%m-%d %H:%M} ({run.time:%H:%M}Z) {run.state}: {run.why}")
        return found

    def send(self) -> None:
        """One look of `reseau alarms send`."""

        def deliver(title: str, text: str) -> bool:
            for line in text.splitlines():
                self.messages.append((self.now, line))
                self.say(f"alarm: {line}")
            return True

        self.alarms.send(deliver, REPEAT)

    def acknowledge(self) -> None:
        """Somebody reads the alarms."""
        for each in self.alarms.open():
            self.alarms.acknowledge(each.key, "Ada")

    def a_week(self) -> None:
        """Monday with its looks at the schedule, and Thursday."""
        week = self.week
        monday = FIRST + timedelta(weeks=week)  # local time: the difference to UTC changes
        self.now = monday - timedelta(hours=1)
        if week in HAPPENS:
            self.say(f"--- {HAPPENS[week]}")
        if week in OFF:
            return
        sigma = np.sqrt(1.25) * self.sigma()
        if week in DRIFT:
            self.offset[0] += 0.6 * sigma[0]
        if week == JUMP:
            self.offset[1] += 6.0 * sigma[1]
        script = self.simulated.scripts["table"]
        script.at_random(1.0 if week == DEAD else 0.0)
        for hour in range(7, 14):
            self.now = monday.replace(hour=hour, minute=5)
            in_use = week == IN_USE and hour < 10
            with (
                BenchLock([self.file.instruments["table"].address], "Ben") if in_use else nullcontext(),
                bad(self),
            ):
                if week < TWO:
                    self.look()
                else:
                    with ThreadPoolExecutor(2) as pool:
                        for each in [pool.submit(self.look) for _ in range(2)]:
                            each.result()
        if week == BACK:
            for hour in (7, 8, 9):
                self.now = monday.replace(hour=hour, minute=35)
                self.look()
        self.now = monday.replace(hour=14)
        self.send()
        if week == LENS:
            self._change_lens(monday)
        self.now = monday.replace(hour=14) + timedelta(days=3)
        self.send()
        self.acknowledge()

    def _change_lens(self, monday: datetime) -> None:
        self.now = monday.replace(hour=10) + timedelta(days=2)
        field = self.simulated.laboratory.field
        values = field.camera.values.copy()
        values[0] += 0.2
        self.simulated.laboratory.field = replace(field, camera=replace(field.camera, values=values))
        self.offset[:] = 0.0
        self.known.event(NAME, "lens changed", by="Ada")
        none = self.known.applied(NAME, self.now) is None
        self.say(f"service event: lens changed; {'no calibration' if none else 'a calibration'} applies")
        self.now += timedelta(minutes=5)
        self.look()
        self.send()
        self.review("first with this lens")

    def run(self, weeks: int) -> bool:
        """Live through the first weeks of the year; return whether all that was expected by then holds."""
        self.begin()
        for self.week in range(weeks):
            self.a_week()
        self.now = FIRST + timedelta(weeks=weeks - 1, days=5)
        return self._expected(weeks)

    def _expected(self, weeks: int) -> bool:
        """Compare what happened with what must happen."""
        runs = self.schedules.runs("weekly", ahead=0)
        weekly = [run for run in runs if not run.key.startswith("event")]
        events = [run for run in runs if run.key.startswith("event")]
        decisions = {each.session: each for each in self.known.history(NAME)}
        done = {k: decisions[f"weekly-{run.key}"] for k, run in enumerate(weekly) if run.state == "done"}
        outcomes = [done[k].outcome if k in done else run.state for k, run in enumerate(weekly)]
        missing = sorted(set(range(weeks)) - set(done))
        usual = [outcome for k, outcome in enumerate(outcomes) if k in done and k != BAD]
        hours = [{run.time.astimezone(zone).hour for run in weekly} for zone in (ZONE, UTC)]
        signals = self._signals()
        late = {
            name: next((k - begin + 1 for k, series in signals if series == name and k >= begin), 0)
            for name, begin in (("c", DRIFT[0]), ("x0", JUMP))
        }
        early = [each for each in signals if each[0] < DRIFT[0]]
        others = [each for each in signals if each[1] not in ("c", "x0", "norm of the field")]
        applied = self.known.applied(NAME, (FIRST + timedelta(weeks=BAD, days=1)).astimezone(UTC))
        times = Counter(text.removesuffix(" (repeated)") for _, text in self.messages)
        rows: list[tuple[int, str, object, object]] = [
            (12, "a run each week, at 8:00 local time, 6:00 and 7:00 UTC",
             (len(weekly), *hours), (weeks, {8}, {6, 7})),
            (IN_USE, "with the bench in use the run was carried out at the third look, others at the first",
             [(k, run.attempts) for k, run in enumerate(weekly) if k in done and run.attempts > 1],
             [(IN_USE, 3)]),
            (OFF[1], "runs with the computer off, and with the dead table, are shown as missed",
             [(k, weekly[k].state) for k in missing],
             [(k, "missed") for k in (*OFF, DEAD) if k < weeks]),
            (DEAD, "the reason of the dead table is shown",
             "table" in weekly[min(DEAD, weeks - 1)].why, True),
            (BAD, "the bad run was rejected, and the calibration before stays in force for its week",
             (outcomes[min(BAD, weeks - 1)], applied is not None and applied.key == done[BAD - 1].key),
             ("rejected", True)),
            (0, "all others were accepted, some with a warning",
             set(usual) <= {"accepted", "accepted with warning"}, True),
            (LENS, "the service event made a run due at once, for a review",
             [(run.state, run.why.partition(":")[0]) for run in events], [("done", "needs review")]),
            (0, "no chart signals before the drift, and none of another parameter", early + others, []),
            (DRIFT[-1], "the drift of c is found within its ten weeks", 0 < late["c"] <= len(DRIFT), True),
            (JUMP + 4, "the jump of x0 is found within five runs", 0 < late["x0"] <= 5, True),
            (OFF[1], "alarms were sent once, and once more where nobody had acknowledged them by Thursday",
             set(times.values()) <= {1, 2} and 2 in times.values(), True),
            (BAD, "an alarm says that the bad run was rejected",
             BAD not in done or any(f"({done[BAD].key}) was rejected" in text for text in times), True),
        ]  # fmt: skip
        said = ", ".join(f"{n} {name}" for name, n in Counter(outcomes).most_common())
        found = ", ".join(f"{name} in its run {n}" for name, n in late.items() if n)
        self._say(
            f"\noutcomes: {said}\nalarms: {len(times)}, sent {sum(times.values())} times; drift: {found}"
        )
        for week, text, got, wanted in rows:
            if week < weeks:
                self._say(f"{'ok ' if got == wanted else 'NO '} {text}{'' if got == wanted else f': {got}'}")
        return all(got == wanted for week, _, got, wanted in rows if week < weeks)

    def _signals(self) -> list[tuple[int, str]]:
        """Week and series of the signals of charts that were sent."""
        found = []
        for at, text in self.messages:
            series, verb, _ = text.removeprefix(f"{NAME}: ").partition(" increases, ")
            if not verb:
                series, verb, _ = text.removeprefix(f"{NAME}: ").partition(" decreases, ")
            if verb and not text.endswith("(repeated)"):
                found.append(((at - FIRST).days // 7, series))
        return found


@contextmanager
def bad(year: Year) -> Iterator[None]:
    """The focus is off while a bad run is carried out."""
    change = np.array([0.35, 0.0, 0.0, 0.0]) if year.week == BAD else np.zeros(len(FREE))
    year.offset += change
    yield
    year.offset -= change


def drawn_base(truth: Array) -> Calibration:
    """A calibration as the simulated bench gives it from five photographs."""
    sigma = np.array([6.4e-3, 2.9e-4, 2.6e-4, 2.5e-6])
    return Calibration.from_content(
        {
            "schema": "reseau-calibration/1", "kind": "camera", "name": "field", "sigma0": 1.0,
            "redundancy": 900,
            "model": {"model": "brown", "width": 240, "height": 240, "pitch_mm": [0.027, 0.027]},
            "parameters": {
                name: {"value": float(value), "sigma": float(s), "unit": "1/mm^2" if name == "K1" else "mm"}
                for name, value, s in zip(FREE, truth, sigma, strict=True)
            },
            "covariance": {"names": list(FREE), "matrix": np.diag(sigma**2).tolist()},
            "validity": {"extent": [5.0, 5.0, 234.0, 234.0], "unit": "px"},
        },
        where="drawn",
    )  # fmt: skip


def live(
    open_archive: Callable[[Callable[[], datetime]], Archive],
    on_bench: set[int],
    seed: int,
    say: Callable[[str], None],
    weeks: int = WEEKS,
) -> bool:
    """Simulate the year, or its first weeks; return whether all that was expected by then holds."""
    options = {"camera": "testfield", "flat": True, "in_process": True}
    with one_thread(), plugin(SIMULATORS, "bench")(seed, **options) as simulated:
        year = Year(open_archive, simulated, on_bench, seed, say)
        try:
            return year.run(weeks)
        finally:
            year.archive.close()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bench", choices=("some", "none"), default="some")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--archive", help="default: a folder that is removed")
    parser.add_argument("--objects")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place, objects = given.archive or f"{folder}/archive", given.objects
        on_bench = {-1, 0, 1, 2, LENS, LENS + 1} if given.bench == "some" else set()
        found = live(
            lambda clock: Archive.open(place, objects, create=True, clock=clock), on_bench, given.seed, print
        )
    sys.exit(0 if found else 1)


if __name__ == "__main__":
    main()
