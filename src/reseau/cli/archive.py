"""`reseau archive`: what was captured and computed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import AsJson, progress, say, suffix_of, writable
from .sessions import ArchivePlace, ObjectsPlace, SessionName, opened, procedure_of

if TYPE_CHECKING:
    from ..archive import ArchivedFrame

__all__ = ["app"]

app = typer.Typer(no_args_is_help=True, help="The archive: list, show, verify, export, compute again.")


@app.command("list")
def list_(archive: ArchivePlace = "archive", objects: ObjectsPlace = None, as_json: AsJson = False) -> None:
    """List the sessions."""
    from ..core.provenance import canonical_json

    with opened(archive, objects) as found:
        sessions = found.sessions()
    if as_json:
        rows = [vars(each) | {"begun": each.begun.isoformat()} for each in sessions]
        say(canonical_json({"schema": "reseau-sessions/1", "sessions": rows}))
        return
    for each in sessions:
        counts = f"{each.frames:6d} frames {each.results:3d} results"
        say(f"{each.begun:%Y-%m-%d %H:%M:%S}Z  {each.plan:<12} {counts}  {each.status:<10} {each.name}\n")


@app.command()
def show(
    session: SessionName,
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write the results to.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show a session: its frames with verdicts, its results and what they were made of."""
    from ..archive import described
    from ..core.provenance import canonical_json
    from ..io import write_whole

    with opened(archive, objects) as found:
        kept = found.session(session)
        if out is not None:
            contents = {result.name: kept.content(result) for result in kept.results()}
            _folder(out)
            for name, content in contents.items():
                write_whole(out / name, content)
        if as_json:
            say(canonical_json(described(kept)))
            return
        begun = f"{kept.begun:%Y-%m-%d %H:%M:%S}Z"
        say(f"{kept.name}: {kept.plan}, begun {begun} by {kept.software}, {kept.status}\n")
        for frame in kept.frames():
            say(f"  {frame.sha256[:12]}  {_verdict(frame):<8} {frame.name}\n")
        for made in kept.results():
            origin = f"of {len(made.inputs)} files, by {made.software}"
            say(f"  {made.sha256[:12]}  result   {made.name}, {origin}\n")


def _folder(path: Path) -> None:
    """Make a folder where there is none.

    Raises
    ------
    InputError
        When it cannot be made.
    """
    from ..core.errors import InputError

    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=path, do="name a folder") from None


def _verdict(frame: ArchivedFrame) -> str:
    if frame.verdict is None:
        return ""
    return "good" if frame.verdict.ok else frame.verdict.why


@app.command()
def verify(archive: ArchivePlace = "archive", objects: ObjectsPlace = None, as_json: AsJson = False) -> None:
    """Read every file again, and compare it with its hash."""
    from ..archive import verify as verified
    from ..core.provenance import canonical_json

    with opened(archive, objects) as found, progress("verifying", len(found.files())) as step:
        result = verified(found, step)
    if as_json:
        say(canonical_json({"schema": "reseau-verified/1", **vars(result), "sound": bool(result)}))
    else:
        say(f"{result.files} files, {result.size / 1e6:.1f} MB: {'sound' if result else 'damaged'}\n")
        say("".join(f"  {line}\n" for line in result.damaged))
        if result.unknown:
            say(f"{len(result.unknown)} further files of processes that were killed; they harm nothing\n")
    raise typer.Exit(0 if result else 1)


@app.command()
def export(
    session: SessionName,
    out: Annotated[Path, typer.Option("--out", "-o", help="Zip to write.")],
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
) -> None:
    """Write a session as one zip: frames, results, and a table of all."""
    from ..archive import export as exported

    suffix_of(writable(out), (".zip",))
    with opened(archive, objects) as found:
        count = exported(found.session(session), out)
    say(f"{out}: {count} files\n")


@app.command()
def rerun(
    session: SessionName,
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
    as_json: AsJson = False,
) -> None:
    """Compute the results of a session again, and say whether they are the same to the byte."""
    from ..capture import rerun as computed
    from ..core.errors import UsageError
    from ..core.provenance import canonical_json

    with opened(archive, objects) as found:
        kept = found.session(session)
        procedure = procedure_of(kept)
        if procedure is None:
            raise UsageError(f"{kept.plan} computes nothing", where=session)
        if not kept.results():
            raise UsageError(f"has no results; it is {kept.status}", where=session)
        done = computed(kept, procedure)
    same = all(each.same for each in done)
    if as_json:
        rows = [
            {"name": d.result.name, "sha256": d.result.sha256, "software": d.result.software, "same": d.same}
            for d in done
        ]
        say(canonical_json({"schema": "reseau-rerun/1", "same": same, "results": rows}))
    else:
        for each in done:
            outcome = (
                "the same to the byte" if each.same else f"differs; it was made by {each.result.software}"
            )
            say(f"{each.result.name}: {outcome}\n")
    raise typer.Exit(0 if same else 1)
