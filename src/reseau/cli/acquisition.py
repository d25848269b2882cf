"""Shared by the commands of `reseau capture`: options, and execution of a new or resumed session."""

from __future__ import annotations

import getpass
import json
import math
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, Self, TypeVar

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.options import Group
from .common import Place, remark_lines, say, say_notes

if TYPE_CHECKING:
    from ..archive import Archive, Session
    from ..capture import Bench
    from ..capture.engine import Decision
    from ..sessions.parameters import SessionParameters


def _from_toml(context: typer.Context, path: Path | None) -> Path | None:
    """Use the values of a TOML file as defaults of the options."""
    from ..core.errors import FormatError
    from ..io import read_text

    if path is None:
        return None
    try:
        given = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"is not TOML ({error})", where=path) from None
    known = {
        option.removeprefix("--"): parameter
        for parameter in context.command.params
        for option in parameter.opts
        if option.startswith("--") and option != "--options"
    }
    context.default_map = {}
    for key, value in given.items():
        parameter = known.get(key.replace("_", "-"))
        if parameter is None:
            raise FormatError(f"unknown key `{key}`", where=path, do=f"use {', '.join(sorted(known))}")
        several = parameter.nargs != 1 or parameter.multiple
        context.default_map[str(parameter.name)] = _as_text(value, several)
    return path


def _as_text(value: Any, several: bool) -> Any:
    """Convert a list or table of TOML to the form of the command line: 0,50 and tilt=0,roll=0, or a list."""
    if isinstance(value, Mapping):
        value = [f"{key}={json.dumps(each, default=str)}" for key, each in value.items()]
    return ",".join(str(each) for each in value) if isinstance(value, list) and not several else value


@dataclass(frozen=True)
class Where(Place):
    """Bench and session of a command of `reseau capture`."""

    context: typer.Context = field(kw_only=True)
    bench: Annotated[v.Bench | None, "Default: bench.toml."] = None
    name: Annotated[v.Name, "Default: plan and time (UTC)."] = ""
    resume: Annotated[v.Resume, "Here a session, with its original options."] = False
    home: v.Home = False
    options: Annotated[
        Path | None,
        typer.Option(
            "--options",
            is_eager=True,
            callback=_from_toml,
            metavar="PATH",
            help="TOML file with values of options.",
            rich_help_panel=Group.FILES.value,
        ),
    ] = None
    as_json: Annotated[v.AsJson, "Each event is a line."] = False

    def refuse_changes(self, allowed: Sequence[str]) -> None:
        """Refuse options that a resumed session would ignore.

        Raises
        ------
        UsageError
            If one is given.
        """
        known = {*allowed, *(each.name for each in fields(Where))}
        for parameter in self.context.command.params:
            source = self.context.get_parameter_source(str(parameter.name))
            if parameter.name not in known and source is not None and source.name == "COMMANDLINE":
                raise UsageError("cannot be changed with --resume", where=parameter.opts[0], do="omit it")


def ask_operator(request: str) -> None:
    """Print a request, and wait for Enter on standard input."""
    typer.echo(f"{request}, then press Enter", err=True)
    if not sys.stdin.readline():
        raise UsageError("standard input is closed", where=request, do="run the command in a terminal")


def conduct(
    where: Where,
    plan: str,
    parameters: Callable[[Bench], SessionParameters | Mapping[str, Any]],
    inputs: Mapping[str, Path | None] | None = None,
    *,
    operator: Callable[[str], None] = ask_operator,
    afterwards: Callable[[Session], None] = lambda session: None,
    also_resumed: Sequence[str] = (),
) -> None:
    """Begin or resume a session, carry it out, and print its outcome.

    Everything is checked before the session begins, because sessions cannot be deleted from an archive.

    Parameters
    ----------
    where : Where
        Bench and session.
    plan : str
        Plan of the session.
    parameters : callable
        Returns the parameters of a new session on a bench.
    inputs : mapping, optional
        Input files of a new session, by name.
    operator : callable
        Carries out requests to the operator.
    afterwards : callable
        Called with a complete session.
    also_resumed : sequence of str
        Options of the command that can be used with ``--resume``; the session determines all others.
    """
    from ..service.orders import held_by_service
    from ..sessions import conducting

    if where.resume:
        where.refuse_changes(also_resumed)
    # A new session is checked before an archive is made for it.
    new = None if where.resume else _new(where, plan, parameters, inputs or {})
    with where.open(create=not where.resume) as archive:
        name, given, bench, begin, order = new or _resumed(archive, where, plan)
        if where.home:
            given = given.model_copy(update={"home": True})
        bench = given.part_of(bench)
        if held_by_service(bench.file):
            _asked(where, archive, bench.file.name, name, order)
            return
        with conducting.lock(bench, archive, name), bench:
            if not given.home:
                given.check_homed(bench)
            session = begin(archive)
            with Display(where.as_json, given.frames_on(bench), plan == "scan", given.units) as display:
                facts = {"session": session.name, "archive": where.archive, "poses": given.expected}
                display.watch("begin", facts)
                why = conducting.capture(
                    session, bench, watch=display.watch, operator=display.aside(operator),
                    paused=display.aside(_paused), home=where.home,
                )  # fmt: skip
        _conclude(where, session, why)
        afterwards(session)


_Started = tuple[str, "SessionParameters", "Bench", Callable[["Archive"], "Session"], dict[str, Any]]
"""Name, parameters and bench of a session, a function that begins or recovers it once all is checked, and
what a service that holds the bench is asked for."""


def _asked(where: Where, archive: Archive, bench: str, name: str, order: dict[str, Any]) -> None:
    """Have the service that holds the bench carry out the session, and print its outcome."""
    from ..service.orders import asked
    from ..service.recalibration import slept

    say_notes([f"reseau serve holds bench {bench} and carries out {name} in its turn"])
    asked(archive, bench, "session", order, getpass.getuser(), name, slept)
    _conclude(where, archive.session(name), None)


def _new(
    where: Where,
    plan: str,
    parameters: Callable[[Bench], SessionParameters | Mapping[str, Any]],
    inputs: Mapping[str, Path | None],
) -> _Started:
    from ..capture import Bench, BenchFile
    from ..io import read_text
    from ..sessions import conducting, kinds

    texts = {}
    for role, path in inputs.items():
        if path is None:
            option = kinds.input_option(role).replace("_", "-")
            raise UsageError("is missing", where=f"--{option}", do="give the file")
        texts[role] = read_text(path)
        kinds.kind_of(plan).read(texts[role], role, path)
    path = where.bench or Path("bench.toml")
    text = read_text(path)
    bench = Bench(BenchFile.parse_toml(text, where=path))
    name = where.name or f"{plan}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    given = parameters(bench)
    checked = conducting.check(name, plan, given, texts, bench)
    order = {"name": name, "plan": plan, "parameters": checked.to_archive(), "inputs": texts}

    def begun(archive: Archive) -> Session:
        return conducting.begin(archive, name, plan, given, texts, bench=text)

    return name, checked, bench, begun, order


def _resumed(archive: Archive, where: Where, plan: str) -> _Started:
    from ..capture import Bench, BenchFile
    from ..io import read_text
    from ..sessions import conducting

    session = conducting.resume(archive, plan, where.name)
    text = session.bench if where.bench is None else read_text(where.bench)
    bench = Bench(BenchFile.parse_toml(text, where=where.bench or session.name))

    def recovered(archive: Archive) -> Session:
        session.recover()
        return session

    order = {"name": session.name, "plan": plan}
    return session.name, conducting.parameters_of(session), bench, recovered, order


def _conclude(where: Where, session: Session, why: str | None) -> None:
    """Print the outcome of a session; exit with 1 if it is incomplete or its goal was not reached."""
    if session.status != "done":
        message = f"{session.name}: stopped; resume with `--resume --name {session.name}`"
    elif why:
        message = f"{session.name}: {why}"
    else:
        if not where.as_json:
            counts = Counter(each.kind for each in session.frames())
            taken = [
                f"{counts[kind]} {kind}{'s' * (counts[kind] > 1)}"
                for kind in ("frame", "scan", "screen")
                if counts[kind]
            ]
            say(f"{session.name}: done, {', '.join(taken)} in {where.archive}\n")
            say("".join(f"  {result.name}\n" for result in session.results()))
        return
    typer.echo(f"reseau: {message}", err=True)
    raise typer.Exit(1)


def _paused() -> Decision:
    """Ask how to continue an interrupted session; without a terminal, stop it."""
    if not sys.stdin.isatty():
        return "stop"
    answers: dict[str, Decision] = {"r": "resume", "s": "stop", "a": "abort"}
    while True:
        typer.echo("paused: [r]esume, [s]top (resume later), [a]bort? ", err=True, nl=False)
        line = sys.stdin.readline()
        if not line:
            return "stop"
        if line.strip().lower()[:1] in answers:
            return answers[line.strip().lower()[:1]]


P = ParamSpec("P")
T = TypeVar("T")


class Display:
    """Prints the events of an acquisition.

    Parameters
    ----------
    as_json : bool
        Whether to print each event as a line of JSON on standard output.
    total : int, optional
        Number of poses, if known.
    sections : bool
        Whether to count sections of the scanner instead of frames.
    units : mapping of str to str, optional
        Units of the standard deviations, by parameter.
    """

    def __init__(
        self,
        as_json: bool,
        total: int | None,
        sections: bool = False,
        units: Mapping[str, str] | None = None,
    ) -> None:
        self._json, self._total, self._sections, self._units = as_json, total, sections, dict(units or {})
        self._poses, self._stored, self._frames, self._reached = 0, 0, 0, ""
        self._start = time.monotonic()
        self._bar: Any = None
        self._stream = sys.stdout  # the engine redirects sys.stdout while it runs

    def __enter__(self) -> Self:
        if not self._json and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
            from rich.table import Column

            # A narrow terminal shows only the start of the text.
            rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")
            text = TextColumn("{task.description}", table_column=rest)
            columns = BarColumn(bar_width=12), MofNCompleteColumn(), TimeRemainingColumn(), text
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True, expand=True)
            self._bar.start()
            self._task = self._bar.add_task("starting", total=self._total)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def aside(self, question: Callable[P, T]) -> Callable[P, T]:
        """Return a function that hides the bar while it asks a question."""

        def asked(*args: P.args, **kwargs: P.kwargs) -> T:
            if self._bar is None:
                return question(*args, **kwargs)
            self._bar.stop()
            try:
                return question(*args, **kwargs)
            finally:
                self._bar.start()

        return asked

    def watch(self, kind: str, facts: dict[str, Any]) -> None:
        """Print an event."""
        if self._json:
            # JSON has no NaN or infinity.
            plain = {
                k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in facts.items()
            }
            self._print(json.dumps({"event": kind, **plain}, default=str))
            return
        if kind == "precision":
            self._reached = self._precision(facts)
        if kind == "frame" or self._counted(facts):
            self._frames += 1
            self._poses += facts.get("ok", True)
            self._stored += facts.get("ok", True) and facts.get("there", False)
            if self._poses == self._stored:
                self._start = time.monotonic()
        line = self._line(kind, facts)
        if line:
            self._print(line)
        if self._bar is not None:
            first = self._reached.split("  ")[0]  # all of them are printed above the bar
            parts = [first, f"{self._frames} frames", facts.get("step") or kind]
            self._bar.update(self._task, completed=self._poses, description=" · ".join(filter(None, parts)))

    def _counted(self, facts: dict[str, Any]) -> bool:
        """Whether a picture is counted."""
        return self._sections and facts.get("kind") == "scan"

    def _line(self, kind: str, facts: dict[str, Any]) -> str:
        """Return the line for an event, or an empty string."""
        if kind == "begin":
            return f"session {facts['session']}"
        if kind == "frame":
            of = f"/{self._total}" if self._total else ""
            good = f"{facts['points']} points" if "points" in facts else "good"
            take = f" take {facts['take']}" if facts["take"] else ""
            outcome = good if facts["ok"] else facts["why"]
            return f"{self._poses}{of} {facts['step']}{take}: {outcome}{self._remaining()}"
        if kind == "picture":
            at = f"{self._poses}/{self._total} " if self._counted(facts) else ""
            return f"{at}{facts['step']}: {facts['kind']}"
        if kind == "precision":
            scatter = facts.get("scatter", 0.0)
            doubt = (
                f"\n    images have errors in common: sigmas are {scatter:.1f} times the formal ones"
                if scatter > 2
                else ""
            )
            return f"    {self._reached}{doubt}"
        if kind == "outlook":
            if "why" in facts:
                return f"    next {facts['step']}: no prediction ({facts['why']})"
            return f"    next {facts['step']}: {self._precision(facts)} predicted"
        if kind == "next":
            predicted = self._precision(facts)
            tail = f": {predicted} predicted" if predicted else ""
            return f"next pose {facts['step']}{tail}" if facts["step"] else "no pose is left"
        if kind == "check":
            return "checks: " + ("; ".join(facts["faults"]) or "passed")
        if kind == "interrupt":
            waits = f"pausing after {facts['waits_for'] or 'this step'}; Ctrl-C again pauses at once"
            return "pausing at once" if facts["at_once"] else waits
        if kind == "home":
            return f"homing {facts['axis']}"
        if kind == "asked":
            return f"asked {facts['operator']}: {facts['request']}"
        if kind == "verdict":
            return "\n".join((*facts["lines"], *remark_lines(facts["warnings"], facts["tests"])))
        if kind == "without":
            return f"without {facts['instrument']}: {facts['why']}"
        if kind == "again":
            return f"retry: {facts['why']}"
        if kind == "rest" and "failed" in facts:
            return f"stopped, but: {facts['failed']}"
        return ""

    def _print(self, line: str) -> None:
        if self._bar is not None and self._stream.isatty():
            self._bar.console.print(line, markup=False, highlight=False)
            return
        self._stream.write(line + "\n")
        self._stream.flush()

    def _remaining(self) -> str:
        """Remaining time, from the frames taken by this process."""
        taken = self._poses - self._stored
        if not self._total or not taken or self._poses >= self._total:
            return ""
        seconds = (time.monotonic() - self._start) / taken * (self._total - self._poses)
        return f", {seconds:.0f} s left"

    def _precision(self, facts: dict[str, Any]) -> str:
        """Standard deviations to two digits, with units."""
        parts = []
        for name, value in facts.items():
            if isinstance(value, float) and name != "scatter":
                unit = self._units.get(name.removeprefix("sigma_"), "")
                parts.append(f"{name} {value:.2g}{' ' if unit else ''}{unit}")
        return "  ".join(parts)
