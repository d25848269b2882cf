"""`reseau schedule`, `reseau recalibrate`, `reseau alarms`: runs that are due, carried out, and reported."""

from __future__ import annotations

import getpass
import signal
import threading
import time
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.errors import ReseauError, UsageError
from ..core.files import writable
from ..core.options import Option
from .calibrations import say_decision, time_of
from .common import Place, for_systemd, say, say_either, say_notes
from .declared import Commands

if TYPE_CHECKING:
    from ..service import Run


app = Commands(help="Schedules of recalibrations: add, show, export, run.")
alarms = Commands(help="Alarms: list, acknowledge, send.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the schedule.")]


@app.command()
def add(
    schedule: Annotated[Path, typer.Argument(help="Schedule, reseau-schedule/1.")],
    place: Place,
) -> None:
    """Add a schedule to an archive, or change one of the same name."""
    from ..service import Recalibrations, Schedule, Schedules

    given = Schedule.read(schedule)
    with place.open() as found:
        Recalibrations(found).get(given.recalibration)
        Schedules(found).add(given)
    say(f"{given.name}: {given.rule}, from {given.start} {given.zone}\n")


@app.command()
def remove(name: Name, place: Place) -> None:
    """Remove a schedule; its history stays in the archive."""
    from ..service import Schedules

    with place.open() as found:
        Schedules(found).remove(name)


@app.command("list")
def list_(place: Place) -> None:
    """List the schedules with the last and the next run."""
    from ..service import Schedules

    with place.open() as found:
        schedules = Schedules(found)
        for name in schedules.names():
            say(f"{name}\n")
            for run in schedules.runs(name)[-2:]:
                say(f"  {_row(run)}\n")


@app.command()
def show(
    name: Name,
    place: Place,
    at: v.At | None = None,
    ahead: Annotated[int, Option("Number of later runs.", least=0)] = 3,
    as_json: v.AsJson = False,
) -> None:
    """Show all runs of a schedule; exit status 1 if one is overdue, or the last one failed."""
    from ..service import Schedules

    with place.open() as found:
        runs = Schedules(found).runs(name, time_of(at, "--at"), ahead)
    say_either(as_json, {"schema": "reseau-runs/1", "runs": list(map(vars, runs))}, map(_row, runs))
    past = [each.state for each in runs if each.state != "scheduled"]
    raise typer.Exit(1 if past and past[-1] in ("overdue", "failed", "blocked") else 0)


def _row(run: Run) -> str:
    return f"{run.time:%Y-%m-%d %H:%M}Z  {run.state:<10} {run.why}"


@app.command()
def export(
    name: Name,
    out: Annotated[v.Out, "Here a calendar (.ics)."],
    place: Place,
) -> None:
    """Export the runs of a schedule as an iCalendar feed."""
    from ..io import write_whole
    from ..service import Schedules

    writable(out, ".ics")
    with place.open() as found:
        write_whole(out, Schedules(found).feed(name))


@app.command("run")
def run_(
    place: Place,
    once: Annotated[bool, Option("Carry out what is due now, and end.")] = False,
    every: v.Every = 300.0,
    notify: v.Notify | None = None,
    inside: v.Inside | None = None,
    repeat: v.Repeat = 24.0,
) -> None:
    """Carry out the runs that are due: as a daemon, or --once from cron or a timer of systemd."""
    over = threading.Event()
    if not once:
        for each in (signal.SIGTERM, signal.SIGINT):
            signal.signal(each, lambda *_: over.set())
    from ..service import Alarms, Recalibrations, Schedules
    from ..service.alarms import sender

    deliver = None if not notify else sender(notify, inside or ())
    if not once:
        say(f"looking at the schedules of {place.archive} every {every:g} s; Ctrl-C ends this\n")
    failed = False
    while True:
        try:
            with place.open() as found:
                for run in Schedules(found).run_due(Recalibrations(found).carry_out):
                    failed = failed or run.state != "done"
                    say(f"{run.schedule}: {run.time:%Y-%m-%d %H:%M}Z {run.state}: {run.why}\n")
                if deliver is not None:
                    Alarms(found).send(deliver, timedelta(hours=repeat))
        except ReseauError as error:
            if once:
                raise
            typer.echo(f"reseau: {error}", err=True)
        # A signal that the system delivers to another thread does not end a long wait.
        until = time.monotonic() + every
        while not (once or over.wait(0.1)) and time.monotonic() < until:
            pass
        if once or over.is_set():
            break
    raise typer.Exit(1 if once and failed else 0)


_SERVICE = """\
# /etc/systemd/system/reseau-schedule.service: carries out the recalibrations that are due.
[Unit]
Description=Recalibrations that are due
After=network.target

[Service]
Type=oneshot
WorkingDirectory={where}
ExecStart={program} schedule run --once --archive {archive}

# /etc/systemd/system/reseau-schedule.timer
[Unit]
Description=Look for recalibrations that are due

[Timer]
OnCalendar=*:0/5
Persistent=true

[Install]
WantedBy=timers.target
"""


@app.command()
def units(archive: v.Archive = "archive") -> None:
    """Print a service and a timer for systemd."""
    say(for_systemd(_SERVICE, archive))


def recalibrate(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the recalibration.")],
    place: Place,
    repeats: Annotated[
        str | None, Option("Define it: the session of the archive that it repeats.", value="SESSION")
    ] = None,
    configuration: Annotated[
        str | None, Option("With --repeats: the configuration that it calibrates.", value="NAME")
    ] = None,
    rules: Annotated[v.Rules | None, "With --repeats."] = None,
    warm_up_minutes: Annotated[
        float, Option("With --repeats: wait before the first frame (min).", least=0)
    ] = 0.0,
    self_test: Annotated[bool, Option("With --repeats: test the instruments first.")] = False,
    data: Annotated[v.Data | None, "With --repeats: issue a certificate with these data."] = None,
    notify: v.Notify | None = None,
    inside: v.Inside | None = None,
    resume: v.Resume = False,
    as_json: v.AsJson = False,
) -> None:
    """Check the bench, acquire, measure, adjust, compare with the calibration in force, and decide.

    With --repeats it is defined and not carried out. A service that holds the bench carries it out in its
    turn. The exit status is 0 if the new calibration is accepted.
    """
    from ..service import AcceptanceRules, Recalibrations
    from ..service.certificates import CertificateData

    if repeats is None and (configuration is not None or rules is not None):
        raise UsageError("needs --repeats", where="--configuration, --rules")
    if repeats is not None and (configuration is None or rules is None or resume):
        raise UsageError("needs --configuration and --rules, and no --resume", where="--repeats")
    with place.open() as found:
        known = Recalibrations(found)
        if repeats is not None:
            assert configuration is not None
            assert rules is not None
            certificate = None if data is None else CertificateData.read(data).to_dict()
            made = known.define(
                name, found.session(repeats), configuration, AcceptanceRules.read(rules),
                warm_up_minutes=warm_up_minutes, self_test=self_test, certificate=certificate,
                notify=tuple(notify or ()), inside=tuple(inside or ()),
            )  # fmt: skip
            say(f"{name}: repeats {repeats}, plan {made.plan}, for {configuration}\n")
            return
        unfinished = known.unfinished(name)
        if resume and unfinished is None:
            raise UsageError("has no session that can be continued", where=name)
        if not resume and unfinished is not None:
            say_notes([f"{unfinished} is not done; --resume continues it"])
        decision = known.ask(name, unfinished or "" if resume else "", getpass.getuser())
    say_decision(decision, as_json)
    raise typer.Exit(0 if decision.outcome.startswith("accepted") else 1)


@alarms.command("list")
def list_alarms(
    place: Place,
    everything: Annotated[bool, Option("Also acknowledged ones.", called="all")] = False,
    as_json: v.AsJson = False,
) -> None:
    """List the alarms that nobody acknowledged; exit status 1 if there are any."""
    from ..service import Alarms

    with place.open() as found:
        known = Alarms(found).all() if everything else Alarms(found).open()
    lines = (
        f"{each.text}; sent {len(each.sent)} times"
        f"{f', acknowledged by {each.acknowledged}' if each.acknowledged else ''}\n  {each.key}"
        for each in known
    )
    say_either(as_json, {"schema": "reseau-alarms/1", "alarms": list(map(vars, known))}, lines)
    raise typer.Exit(1 if any(not each.acknowledged for each in known) else 0)


@alarms.command()
def acknowledge(
    key: Annotated[str, typer.Argument(help="Key of the alarm; see `list`.")],
    by: v.By,
    place: Place,
) -> None:
    """Acknowledge an alarm: it is not repeated."""
    from ..service import Alarms

    with place.open() as found:
        Alarms(found).acknowledge(key, by)


@alarms.command()
def send(
    notify: v.Notify,
    place: Place,
    inside: v.Inside | None = None,
    repeat: v.Repeat = 24.0,
) -> None:
    """Send the open alarms, each once, and again while nobody acknowledges it."""
    from ..service import Alarms
    from ..service.alarms import sender

    with place.open() as found:
        sent = Alarms(found).send(sender(notify, inside or ()), timedelta(hours=repeat))
    say(f"{len(sent)} sent\n")
