"""`reseau archive`: list, show, verify, export and rerun sessions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.files import writable
from .common import Computing, Place, SessionName, progress, required, say, say_either, say_json
from .declared import Commands

if TYPE_CHECKING:
    from ..archive.records import ArchivedFrame


app = Commands(help="List, show, verify, export and recompute archived sessions.")


@app.command("list")
def list_(place: Place, as_json: v.AsJson = False) -> None:
    """List the sessions of an archive."""
    with place.open() as found:
        sessions = found.sessions()
    lines = (
        f"{each.begun:%Y-%m-%d %H:%M:%S}Z  {each.plan:<12} {each.frames:6d} frames {each.results:3d} results"
        f"  {each.status:<10} {each.name}"
        for each in sessions
    )
    say_either(as_json, {"schema": "reseau-sessions/1", "sessions": list(map(vars, sessions))}, lines)


@app.command()
def show(
    session: SessionName,
    place: Place,
    out: Annotated[v.Out | None, "Here a folder, for the results."] = None,
    as_json: v.AsJson = False,
) -> None:
    """Show a session: frames with verdicts, and results with their inputs."""
    from ..archive.exporting import describe

    with place.open() as found:
        stored = found.session(session)
        if out is not None:
            stored.write_results(out)
        if as_json:
            say_json(describe(stored))
            return
        start = f"{stored.begun:%Y-%m-%d %H:%M:%S}Z"
        say(f"{stored.name}: plan {stored.plan}, started {start} with {stored.software}, {stored.status}\n")
        for frame in stored.frames():
            say(f"  {frame.sha256[:12]}  {_verdict(frame):<8} {frame.name}\n")
        for made in stored.results():
            origin = f"from {len(made.inputs)} files, by {made.software}"
            say(f"  {made.sha256[:12]}  result   {made.name}, {origin}\n")


def _verdict(frame: ArchivedFrame) -> str:
    if frame.verdict is None:
        return ""
    return "good" if frame.verdict.ok else frame.verdict.why


@app.command()
def verify(place: Place, as_json: v.AsJson = False) -> None:
    """Read every file, and compare its SHA-256 with the index."""
    from ..archive.verification import verify as verified

    with place.open() as found, progress("verifying", len(found.files())) as step:
        result = verified(found, step)
    if as_json:
        say_json({"schema": "reseau-verified/1", **vars(result), "sound": bool(result)})
    else:
        say(f"{result.files} files, {result.size / 1e6:.1f} MB: {'intact' if result else 'damaged'}\n")
        say("".join(f"  {line}\n" for line in result.damaged))
        if result.unknown:
            say(f"{len(result.unknown)} unindexed files left by killed processes (harmless)\n")
        if result.temporary:
            say(f"{len(result.temporary)} temporary files left by killed processes, which can be deleted:\n")
            say("".join(f"  {line}\n" for line in result.temporary))
    raise typer.Exit(0 if result else 1)


@app.command()
def export(
    session: SessionName,
    out: Annotated[v.Out, "Here a zip file."],
    place: Place,
) -> None:
    """Export a session to a zip file: frames, results and a table of contents."""
    from ..archive.exporting import export as exported

    writable(out, ".zip")
    with place.open() as found:
        count = exported(found.session(session), out)
    say(f"{out}: {count} files\n")


@app.command()
def rerun(
    place: Place,
    computing: Computing,
    session: Annotated[
        str | None, typer.Argument(help="Name of the session; by default all that have results.")
    ] = None,
    as_json: v.AsJson = False,
) -> None:
    """Recompute the results of sessions from their frames, and compare them byte for byte."""
    from ..core.failure import Failure
    from ..sessions import conducting

    with place.open() as found:
        names = [each.name for each in found.sessions() if each.results] if session is None else [session]
    rows, same = [], True
    with computing.executor(["reseau.sessions.conducting"], len(names)) as executor:
        for name, done in conducting.rerun_all(place.archive, place.objects, names, executor):
            if isinstance(done, Failure):
                if session is not None:
                    required(done, name)
                same = False
                typer.echo(f"reseau: {done}", err=True)
                continue
            same &= all(each.same for each in done)
            for each in done:
                made = each.result
                about = {"name": made.name, "sha256": made.sha256, "software": made.software}
                if session is None:
                    about = {"session": name} | about
                rows.append(about | {"same": each.same})
                if not as_json:
                    outcome = "identical" if each.same else f"differs; made with {made.software}"
                    say(f"{'' if session is not None else name + ': '}{made.name}: {outcome}\n")
    if as_json:
        say_json({"schema": "reseau-rerun/1", "same": same, "results": rows})
    raise typer.Exit(0 if same else 1)
