"""What the commands of `reseau capture` share: options, and the session that each begins or goes on with."""

from __future__ import annotations

import functools
import inspect
import json
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from ..core.errors import UsageError
from .common import parsed_design, say
from .events import Display
from .sessions import ArchivePlace, ObjectsPlace, opened, procedure_of

if TYPE_CHECKING:
    from ..archive import Archive, Session
    from ..capture import Acquisition, Bench, BenchLock, Decision, Limits, Plan

__all__ = ["CameraName", "Where", "conduct", "in_session", "operator"]


def _from_toml(context: typer.Context, path: Path | None) -> Path | None:
    """Have a TOML file give the options that the command line does not."""
    from ..core.errors import FormatError
    from ..io import read_text

    if path is None:
        return None
    try:
        given = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"is no TOML ({error})", where=path) from None
    known = {
        option.removeprefix("--"): parameter
        for parameter in context.command.params
        for option in parameter.opts
        if option.startswith("--") and option != "--plan"
    }
    context.default_map = {}
    for key, value in given.items():
        parameter = known.get(key.replace("_", "-"))
        if parameter is None:
            raise FormatError(f"unknown key `{key}`", where=path, do=f"there are {', '.join(sorted(known))}")
        several = parameter.nargs != 1 or parameter.multiple
        context.default_map[str(parameter.name)] = _as_written(value, several)
    return path


def _as_written(value: Any, several: bool) -> Any:
    """A list or a table of TOML as the command line has them: 0,50 and tilt=0,roll=0, or one by one."""
    if isinstance(value, Mapping):
        value = [f"{key}={json.dumps(each, default=str)}" for key, each in value.items()]
    return ",".join(str(each) for each in value) if isinstance(value, list) and not several else value


CameraName = Annotated[str | None, typer.Option("--camera", help="Where the bench has several.")]


@dataclass(frozen=True)
class Where:
    """Bench and session of a command; each field is an option of every command of `reseau capture`."""

    archive: ArchivePlace = "archive"
    objects: ObjectsPlace = None
    bench: Annotated[Path | None, typer.Option("--bench", "-b", help="The bench; by default bench.toml.")] = (
        None
    )
    name: Annotated[str, typer.Option("--name", "-n", help="Of the session; by default plan and time.")] = ""
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a session that did not end; all is as it was begun.")
    ] = False
    plan: Annotated[
        Path | None,
        typer.Option("--plan", is_eager=True, callback=_from_toml, help="TOML with options of this command."),
    ] = None
    as_json: Annotated[bool, typer.Option("--json", help="Write every event as a line of JSON.")] = False


def in_session(*lasting: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of :class:`Where`, and hand them over as its first argument.

    Parameters
    ----------
    lasting : str
        Its own options that also count where a session is resumed; all others are as it was begun.
    """
    hints = get_type_hints(Where, include_extras=True)
    common = [
        inspect.Parameter(
            each.name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=hints[each.name]
        )
        for each in fields(Where)
    ]
    about = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)

    def given(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]

        @functools.wraps(command)
        def called(context: typer.Context, **options: Any) -> None:
            where = Where(**{each.name: options.pop(each.name) for each in fields(Where)})
            if where.resume:
                _as_begun(context, set(options) - set(lasting))
            command(where, **options)

        parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own]
        shown = [about, *parameters, *common]
        called.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in shown}
        return called

    return given


def _as_begun(context: typer.Context, options: set[str]) -> None:
    """Refuse options that a session which is resumed would not heed."""
    for parameter in context.command.params:
        source = context.get_parameter_source(str(parameter.name))
        if parameter.name in options and source is not None and source.name == "COMMANDLINE":
            raise UsageError("is as the session was begun", where=parameter.opts[0], do="leave it out")


def operator(what: str) -> None:
    """Have someone do it, and say so by a line; at a terminal or through a pipe."""
    typer.echo(f"{what}, then press Enter", err=True)
    if not sys.stdin.readline():
        raise UsageError("nobody answers", where=what, do="run it where someone can")


Parameters = Callable[["Bench"], dict[str, Any]]
Planned = Callable[["Acquisition", dict[str, Any]], "Plan"]


def conduct(
    where: Where,
    plan: str,
    planned: Planned,
    parameters: Parameters,
    inputs: Mapping[str, Path | None] | None = None,
    *,
    limits: Limits | None = None,
    operator: Callable[[str], None] = operator,
    afterwards: Callable[[Session], None] = lambda kept: None,
) -> None:
    """Begin a session or go on with one, carry its plan out, and say what came of it.

    What cannot be done is refused before a session begins: the archive would have it for ever.

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
    operator : callable
        Does what no instrument can.
    afterwards : callable
        Called with a session that is done.
    """
    with opened(where.archive, where.objects, create=not where.resume) as archive:
        begun = (_resumed if where.resume else _new)(archive, where, plan, parameters, inputs or {})
        with begun.locked(archive), begun.bench as bench:
            kept = begun.begin()
            why = _carried_out(where, kept, bench, planned, limits, operator)
        _conclude(where, kept, why)
        afterwards(kept)


def _carried_out(
    where: Where,
    kept: Session,
    bench: Bench,
    planned: Planned,
    limits: Limits | None,
    operator: Callable[[str], None],
) -> Any:
    """What the plan returned; while it is carried out, its events are shown."""
    from ..capture import Acquisition, carry_out

    given = kept.parameters
    # Where poses are chosen nobody knows how many it will be.
    total = None if given.get("until") else len(given.get("steps", [])) or given.get("count")
    with Display(where.as_json, total, sections=kept.plan == "scan") as display:
        display.watch("begin", {"session": kept.name, "archive": where.archive, "poses": total})
        chosen = {kind: given.get(kind) for kind in ("camera", "table", "oscilloscope", "scanner")}
        run = Acquisition(
            bench, kept, procedure_of(kept), **chosen, retakes=given["retakes"], limits=limits,
            watch=display.watch, operator=display.aside(operator),
        )  # fmt: skip
        return carry_out(
            run, planned(run, given), park=given["park"], retreat=given.get("retreat"),
            paused=display.aside(_paused),
        )  # fmt: skip


@dataclass(frozen=True)
class _Begun:
    """A session that is to be: its name, its bench, and what begins it."""

    name: str
    bench: Bench
    begin: Callable[[], Session]

    def locked(self, archive: Archive) -> BenchLock:
        """The lock of its instruments, and of itself."""
        from ..capture import BenchLock

        addresses = [entry.address for entry in self.bench.file.instruments.values()]
        return BenchLock([*addresses, f"{archive.place}: {self.name}"], f"session {self.name}")


def _new(
    archive: Archive, where: Where, plan: str, parameters: Parameters, inputs: Mapping[str, Path | None]
) -> _Begun:
    """A new session, which has the files that it was given from the beginning."""
    from ..capture import Bench, BenchFile
    from ..io import read_text

    texts = {}
    for role, path in inputs.items():
        if path is None:
            raise UsageError("is needed", where=f"--{Path(role).stem}")
        texts[role] = read_text(path)
        if Path(role).suffix == ".json":
            parsed_design(texts[role], path)
    path = where.bench or Path("bench.toml")
    text = read_text(path)
    bench = Bench(BenchFile.parse_toml(text, where=path))
    name = where.name or f"{plan}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    given = parameters(bench)
    return _Begun(name, bench, lambda: archive.begin(name, plan, given, text, texts))


def _resumed(archive: Archive, where: Where, plan: str, *_: object) -> _Begun:
    """A session that was begun before: all but the bench is as it was begun."""
    from ..capture import Bench, BenchFile
    from ..io import read_text

    if not where.name:
        open_ = [s.name for s in archive.sessions() if s.plan == plan and s.status != "done"]
        if len(open_) != 1:
            names = ", ".join(open_) or "none"
            raise UsageError(f"{names} can be resumed", where="--resume", do="name one with --name")
        where = replace(where, name=open_[0])
    kept = archive.session(where.name)
    if kept.plan != plan:
        raise UsageError(f"is a session of {kept.plan}", where=kept.name, do=f"use `capture {kept.plan}`")
    text = kept.bench if where.bench is None else read_text(where.bench)
    bench = Bench(BenchFile.parse_toml(text, where=where.bench or kept.name))

    def begin() -> Session:
        kept.recover()
        return kept

    return _Begun(kept.name, bench, begin)


def _conclude(where: Where, kept: Session, why: str | None) -> None:
    """Say how it ended; what was not reached is a failure."""
    if kept.status != "done":
        message = f"{kept.name}: stopped; `--resume --name {kept.name}` goes on"
    elif why:
        message = f"{kept.name}: {why}"
    else:
        if not where.as_json:
            counts = Counter(each.kind for each in kept.frames())
            taken = [f"{counts[kind]} {kind}s" for kind in ("frame", "scan", "screen") if counts[kind]]
            say(f"{kept.name}: done, {', '.join(taken)} in {where.archive}\n")
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
