"""`reseau capture`: acquisitions on a bench, into an archive, resumable."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import UsageError
from .common import parsed_design, say
from .events import Display
from .sessions import INPUT, ArchivePlace, ObjectsPlace, opened, procedure_of, steps_of

if TYPE_CHECKING:
    from ..archive import Archive, Session
    from ..capture import Acquisition, Bench, Decision, Limits, Plan

__all__ = [
    "AsEvents",
    "BenchPath",
    "CameraName",
    "Name",
    "PlanFile",
    "Resume",
    "Where",
    "app",
    "conduct",
    "operator",
]

app = typer.Typer(
    no_args_is_help=True,
    help="Acquisitions on a bench: every frame is in the archive before the next is taken.",
)


def _from_toml(context: typer.Context, path: Path | None) -> Path | None:
    """Have a TOML file give the options that the command line does not."""
    from ..errors import FormatError
    from ..formats import read_text

    if path is None:
        return None
    try:
        given = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"is no TOML ({error})", where=path) from None
    known = {name.name for name in context.command.params} - {"plan"}
    unknown = [key for key in given if key.replace("-", "_") not in known]
    if unknown:
        names = ", ".join(sorted(str(name) for name in known))
        raise FormatError(f"unknown key `{unknown[0]}`", where=path, do=f"there are {names}")
    context.default_map = {key.replace("-", "_"): value for key, value in given.items()}
    return path


PlanFile = Annotated[
    Path | None,
    typer.Option("--plan", is_eager=True, callback=_from_toml, help="TOML with options of this command."),
]
BenchPath = Annotated[Path | None, typer.Option("--bench", "-b", help="The bench; by default bench.toml.")]
Name = Annotated[str, typer.Option("--name", "-n", help="Of the session; by default plan and time.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with a session that did not end.")]
AsEvents = Annotated[bool, typer.Option("--json", help="Write every event as a line of JSON.")]
Average = Annotated[int, typer.Option(min=1, help="Exposures to a frame, averaged.")]
Checks = Annotated[int, typer.Option(min=0, help="Frames to look at before anything is taken; 0: none.")]
Retakes = Annotated[int, typer.Option(min=0, help="How often a bad frame is taken again.")]
CameraName = Annotated[str | None, typer.Option("--camera", help="Where the bench has several.")]


def operator(what: str) -> None:
    """Have someone do it, and say so by a line; at a terminal or through a pipe."""
    typer.echo(f"{what}, then press Enter", err=True)
    if not sys.stdin.readline():
        raise UsageError("nobody answers", where=what, do="run it where someone can")


@dataclass(frozen=True)
class Where:
    """Bench and session of a command, and who does what no instrument can."""

    archive: str
    objects: str | None
    bench: Path | None
    name: str
    camera: str | None
    resume: bool
    as_json: bool
    operator: Callable[[str], None] = operator


Parameters = Callable[["Bench"], dict[str, Any]]
Planned = Callable[["Acquisition", dict[str, Any]], "Plan"]


@app.command("testfield")
def coded_field(
    design: Annotated[Path | None, typer.Option("--design", "-d", help="Of the testfield or sheet.")] = None,
    archive: ArchivePlace = "archive",
    bench: BenchPath = None,
    name: Name = "",
    poses: Annotated[
        Path | None, typer.Option(help="CSV of poses, a column for each axis; by default the paper's 36.")
    ] = None,
    heights: Annotated[str, typer.Option(help="Of the board (mm), as 0,50,100: each pose at each.")] = "",
    until: Annotated[str, typer.Option(help="Choose poses until this holds, as 'sigma_c < 0.5 um'.")] = "",
    first: Annotated[int, typer.Option(min=4, help="Poses to begin with, where they are chosen.")] = 5,
    pitch: Annotated[
        float | None, typer.Option(min=1e-6, help="Of the pixels (mm), for Brown's model.")
    ] = None,
    free: Annotated[str, typer.Option(help="Parameters to estimate, as c,x0,y0,K1.")] = "",
    row_jitter: Annotated[float, typer.Option(min=0, help="Of the sensor, pixels.")] = 0.0,
    fill: Annotated[float, typer.Option(min=0, max=1, help="Light-sensitive part of the pixels.")] = 1.0,
    average: Average = 1,
    checks: Checks = 3,
    retakes: Retakes = 2,
    home: Annotated[
        bool, typer.Option("--home", help="Have axes without a reference find it first: they will move.")
    ] = False,
    park: Annotated[str, typer.Option(help="Where the table ends, as tilt=0,roll=0; else it stays.")] = "",
    camera: CameraName = None,
    objects: ObjectsPlace = None,
    resume: Resume = False,
    plan: PlanFile = None,
    as_json: AsEvents = False,
) -> None:
    """Record a testfield from many poses, and calibrate the camera while the recordings come in."""
    from ..capture import Goal, paper_steps, plans, read_steps, spread

    if until:
        Goal.parse(until)
    steps = read_steps(poses) if poses is not None else None

    def parameters(found: Bench) -> dict[str, Any]:
        chosen = steps or paper_steps(heights=_numbers(heights, "--heights"), axes=_axes(found))
        return {
            "steps": [[step.name, dict(step.position)] for step in chosen],
            "until": until,
            "first": first,
            "pitch": pitch,
            "free": [each.strip() for each in free.split(",") if each.strip()],
            "row_jitter": row_jitter,
            "fill": fill,
            "average": average,
            "checks": checks,
            "retakes": retakes,
            "home": home,
            "park": _position(park),
        }

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        every, how = steps_of(given), (given["average"], given["checks"])
        if given["until"]:
            goal, begin = Goal.parse(given["until"]), spread(every, given["first"])
            plan = plans.until(run, goal, begin, every, *how)
        else:
            plan = plans.poses(run, every, *how)
        return plans.homed(run, plan) if given["home"] else plan

    where = Where(archive, objects, bench, name, camera, resume, as_json)
    conduct(where, "testfield", planned, parameters, {"design.json": design})


@app.command()
def oscilloscope(
    reseau: Annotated[Path | None, typer.Option("--reseau", "-r", help="Design of the reseau.")] = None,
    object_: Annotated[Path | None, typer.Option("--object", help="Design of the test object.")] = None,
    archive: ArchivePlace = "archive",
    bench: BenchPath = None,
    name: Name = "",
    body: Annotated[bool, typer.Option("--body/--no-body", help="Whether PHOTO III is taken.")] = True,
    average: Average = 1,
    checks: Checks = 0,
    retakes: Retakes = 2,
    camera: CameraName = None,
    objects: ObjectsPlace = None,
    resume: Resume = False,
    plan: PlanFile = None,
    as_json: AsEvents = False,
) -> None:
    """Take PHOTO I, II and III of an oscilloscope, and refine them while they come in."""
    from ..capture import plans

    def parameters(found: Bench) -> dict[str, Any]:
        return {"body": body, "average": average, "checks": checks, "retakes": retakes, "park": {}}

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return plans.oscilloscope(run, given["body"], given["average"], given["checks"])

    where = Where(archive, objects, bench, name, camera, resume, as_json)
    conduct(where, "oscilloscope", planned, parameters, {"reseau.json": reseau, "object.json": object_})


@app.command()
def scan(
    archive: ArchivePlace = "archive",
    bench: BenchPath = None,
    name: Name = "",
    count: Annotated[int, typer.Option(min=1, help="Sections.")] = 1,
    objects: ObjectsPlace = None,
    resume: Resume = False,
    plan: PlanFile = None,
    as_json: AsEvents = False,
) -> None:
    """Sweep with the ultrasonic scanner, and keep the sections."""
    from ..capture import plans

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return plans.scan(run, given["count"])

    where = Where(archive, objects, bench, name, None, resume, as_json)
    conduct(where, "scan", planned, lambda _: {"count": count, "retakes": 0, "park": {}})


@app.command()
def frames(
    archive: ArchivePlace = "archive",
    bench: BenchPath = None,
    name: Name = "",
    count: Annotated[int, typer.Option(min=1, help="Frames.")] = 1,
    average: Average = 1,
    checks: Checks = 0,
    retakes: Retakes = 0,
    camera: CameraName = None,
    objects: ObjectsPlace = None,
    resume: Resume = False,
    plan: PlanFile = None,
    as_json: AsEvents = False,
) -> None:
    """Take frames one after the other."""
    from ..capture import plans

    def parameters(found: Bench) -> dict[str, Any]:
        return {"count": count, "average": average, "checks": checks, "retakes": retakes, "park": {}}

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return plans.frames(run, given["count"], given["average"], given["checks"])

    where = Where(archive, objects, bench, name, camera, resume, as_json)
    conduct(where, "frames", planned, parameters)


def conduct(
    where: Where,
    plan: str,
    planned: Planned,
    parameters: Parameters,
    inputs: Mapping[str, Path | None] | None = None,
    *,
    limits: Limits | None = None,
    afterwards: Callable[[Session], None] = lambda kept: None,
) -> None:
    """Begin a session or go on with one, carry its plan out, and say what came of it.

    Parameters
    ----------
    where : Where
        Bench and session.
    plan : str
        Kind of session.
    planned, parameters : callable
        What gives the plan of an acquisition and parameters; the parameters of a new session on a bench.
    inputs : mapping, optional
        Designs that a new session is given.
    limits : Limits, optional
        Of its frames.
    afterwards : callable
        Called with a session that is done.
    """
    from ..capture import Acquisition, BenchLock, carry_out

    with opened(where.archive, where.objects, create=not where.resume) as archive:
        if where.resume:
            kept, bench = _resumed(archive, where, plan)
        else:
            kept, bench = _begun(archive, where, plan, parameters, inputs or {})
        given = kept.parameters
        display = Display(where.as_json, len(given.get("steps", [])) or given.get("count"))
        addresses = [entry.address for entry in bench.file.instruments.values()]
        with BenchLock(addresses, f"session {kept.name}"), bench, display:
            run = Acquisition(
                bench, kept, procedure_of(kept), camera=where.camera or given.get("camera"),
                retakes=given["retakes"], limits=limits, watch=display.watch, operator=where.operator,
            )  # fmt: skip
            why = carry_out(run, planned(run, given), park=given["park"], paused=_paused)
        _conclude(where, kept, why)
        afterwards(kept)


def _begun(
    archive: Archive, where: Where, plan: str, parameters: Parameters, inputs: Mapping[str, Path | None]
) -> tuple[Session, Bench]:
    """A new session, with the files that it was given."""
    from ..capture import Bench, BenchFile
    from ..formats import read_text

    texts = {}
    for role, path in inputs.items():
        if path is None:
            raise UsageError("is needed", where=f"--{role.removesuffix('.json')}")
        texts[role] = read_text(path)
        parsed_design(texts[role], path)
    path = where.bench or Path("bench.toml")
    text = read_text(path)
    bench = Bench(BenchFile.parse_toml(text, where=path))
    name = where.name or f"{plan}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    kept = archive.begin(name, plan, parameters(bench), text)
    for role, content in texts.items():
        kept.store(role, content.encode("utf-8"), kind=INPUT, suffix=".json")
    return kept, bench


def _resumed(archive: Archive, where: Where, plan: str) -> tuple[Session, Bench]:
    """A session that was begun before: all but the bench is as it was begun."""
    from ..capture import Bench, BenchFile
    from ..formats import read_text

    if not where.name:
        open_ = [s.name for s in archive.sessions() if s.plan == plan and s.status != "done"]
        if len(open_) != 1:
            names = ", ".join(open_) or "none"
            raise UsageError(f"{names} can be resumed", where="--resume", do="name one with --name")
        where = replace(where, name=open_[0])
    kept = archive.session(where.name)
    if kept.plan != plan:
        raise UsageError(f"is a session of {kept.plan}", where=kept.name, do=f"use `capture {kept.plan}`")
    kept.recover()
    text = kept.bench if where.bench is None else read_text(where.bench)
    return kept, Bench(BenchFile.parse_toml(text, where=where.bench or kept.name))


def _conclude(where: Where, kept: Session, why: str | None) -> None:
    """Say how it ended; what was not reached is a failure."""
    if kept.status != "done":
        message = f"{kept.name}: stopped; `--resume --name {kept.name}` goes on"
    elif why:
        message = f"{kept.name}: {why}"
    else:
        if not where.as_json:
            say(f"{kept.name}: done, {len(kept.frames(kind='frame'))} frames in {where.archive}\n")
            say("".join(f"  {result.name}\n" for result in kept.results()))
        return
    typer.echo(f"reseau: {message}", err=True)
    raise typer.Exit(1)


def _paused() -> Decision:
    """What is to become of an interrupted session; where nobody can be asked it stops, to be resumed."""
    if not sys.stdin.isatty():
        return "stop"
    answers: dict[str, Decision] = {"r": "resume", "s": "stop", "a": "abort"}
    while True:
        typer.echo("paused: [r]esume, [s]top (to go on later), [a]bort? ", err=True, nl=False)
        line = sys.stdin.readline()
        if not line:
            return "stop"
        if line.strip().lower()[:1] in answers:
            return answers[line.strip().lower()[:1]]


def _axes(bench: Bench) -> tuple[str, ...]:
    """Axes of the table, where the bench has one."""
    from ..instruments import Turntable

    tables = [each for each in bench.instruments.values() if isinstance(each, Turntable)]
    if not tables:
        raise UsageError("has no table", where=bench.file.name, do="name poses by hand with `capture frames`")
    return tuple(tables[0].axes)


def _numbers(text: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise UsageError(f"is {text!r}", where=option, do="write numbers, as 0,50,100") from None


def _position(text: str) -> dict[str, float]:
    """A position written as ``tilt=0,roll=0``."""
    try:
        pairs = [part.split("=") for part in text.split(",") if part.strip()]
        return {axis.strip(): float(value) for axis, value in pairs}
    except ValueError:
        raise UsageError(f"is {text!r}", where="--park", do="write it like tilt=0,roll=0") from None
