"""Shared by the commands of `reseau capture`: options, and execution of a new or resumed session."""

from __future__ import annotations

import json
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from .common import Place, say
from .events import Display

if TYPE_CHECKING:
    from ..archive import Archive, Session
    from ..capture import Bench
    from ..capture.engine import Decision
    from ..sessions import SessionParameters


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
            "--options", is_eager=True, callback=_from_toml, help="TOML file with values of options."
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
    from .. import sessions

    if where.resume:
        where.refuse_changes(also_resumed)
    # A new session is checked before an archive is made for it.
    new = None if where.resume else _new(where, plan, parameters, inputs or {})
    with where.open(create=not where.resume) as archive:
        name, given, bench, begin = new or _resumed(archive, where, plan)
        if where.home:
            given = given.model_copy(update={"home": True})
        bench = given.part_of(bench)
        with sessions.lock(bench, archive, name), bench:
            if not given.home:
                given.check_homed(bench)
            session = begin(archive)
            with Display(where.as_json, given.frames_on(bench), plan == "scan", given.units) as display:
                facts = {"session": session.name, "archive": where.archive, "poses": given.expected}
                display.watch("begin", facts)
                why = sessions.capture(
                    session, bench, watch=display.watch, operator=display.aside(operator),
                    paused=display.aside(_paused), home=where.home,
                )  # fmt: skip
        _conclude(where, session, why)
        afterwards(session)


_OPTION = {"object.json": "--test-object"}
"""Options of input files that have another name in the archive."""

_Started = tuple[str, "SessionParameters", "Bench", Callable[["Archive"], "Session"]]
"""Name, parameters and bench of a session, and a function that begins or recovers it once all is checked."""


def _new(
    where: Where,
    plan: str,
    parameters: Callable[[Bench], SessionParameters | Mapping[str, Any]],
    inputs: Mapping[str, Path | None],
) -> _Started:
    from .. import sessions
    from ..capture import Bench, BenchFile
    from ..io import read_text

    texts = {}
    for role, path in inputs.items():
        if path is None:
            raise UsageError(
                "is missing", where=_OPTION.get(role, f"--{Path(role).stem}"), do="give the file"
            )
        texts[role] = read_text(path)
        sessions.kind_of(plan).read(texts[role], role, path)
    path = where.bench or Path("bench.toml")
    text = read_text(path)
    bench = Bench(BenchFile.parse_toml(text, where=path))
    name = where.name or f"{plan}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    given = parameters(bench)
    checked = sessions.check(name, plan, given, texts, bench)
    return name, checked, bench, lambda archive: sessions.begin(archive, name, plan, given, texts, bench=text)


def _resumed(archive: Archive, where: Where, plan: str) -> _Started:
    from .. import sessions
    from ..capture import Bench, BenchFile
    from ..io import read_text

    session = sessions.resume(archive, plan, where.name)
    text = session.bench if where.bench is None else read_text(where.bench)
    bench = Bench(BenchFile.parse_toml(text, where=where.bench or session.name))

    def recovered(archive: Archive) -> Session:
        session.recover()
        return session

    return session.name, sessions.parameters_of(session), bench, recovered


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
