"""`reseau remote`: sessions, calibrations, alarms and benches of a service, by its API."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import made_folder, writable
from ..core.options import Option
from .common import CameraChoice, say, say_either, say_json
from .declared import Commands

if TYPE_CHECKING:
    from ..service.client import Client


app = Commands(
    help="A service, by its API: sessions, calibrations, alarms, benches. The token is in RESEAU_TOKEN.",
)

Bench = Annotated[str, typer.Argument(help="Name of the bench.")]


@dataclass(frozen=True)
class Service:
    """The service that a command asks."""

    server: v.Server = "http://127.0.0.1:8480"
    authority: v.Authority | None = None

    def client(self) -> Client:
        """Return a client, to be used in a ``with`` statement."""
        from ..service.client import Client

        return Client(self.server, None, self.authority)


@app.command()
def sessions(
    service: Service,
    like: Annotated[str, Option("Part of the name or the plan.")] = "",
    limit: v.Limit = 50,
    as_json: v.AsJson = False,
) -> None:
    """List sessions, latest first."""
    import itertools

    with service.client() as client:
        found = list(itertools.islice(client.sessions(like), limit or None))
    lines = [
        f"{s['begun'][:16]}Z  {s['name']}  {s['plan']}  {s['frames']} frames  {s['status']}" for s in found
    ]
    say_either(as_json, found, lines)


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Name of the session.")],
    service: Service,
    out: Annotated[v.Out | None, "Here a folder, for the latest result of each name."] = None,
    as_json: v.AsJson = False,
) -> None:
    """Show a session."""
    with service.client() as client:
        found = client.get(f"/sessions/{quote(name, safe='')}")
        if out is not None:
            made_folder(out)
            for each in {r["name"]: r for r in found["results"]}.values():
                path = out / Path(each["name"]).name
                path.write_bytes(client.file(f"/sessions/{quote(name, safe='')}/results/{each['id']}/file"))
    lines = [f"{found['name']}: {found['status']} {found['why']}".rstrip()]
    lines.append(f"{found['good']} good frames" + (f" of {found['expected']}" if found["expected"] else ""))
    lines += [f"rejected {each['step']}: {each['why']}" for each in found["rejected"]]
    lines += [f"result {each['name']}" for each in found["results"]]
    say_either(as_json, found, lines)


@app.command()
def calibrations(service: Service, as_json: v.AsJson = False) -> None:
    """List the configurations with the calibration in force."""
    with service.client() as client:
        found = client.get("/configurations")
    lines = []
    for each in found:
        force = each["in_force"]
        since = f"in force since {force['since'][:16]}Z" if force else "no calibration in force"
        lines.append(f"{each['name']}: {since}, {each['to_review']} to review")
    say_either(as_json, found, lines)


@app.command()
def alarms(service: Service, as_json: v.AsJson = False) -> None:
    """List the open alarms; exit status 1 if there are any."""
    with service.client() as client:
        found = client.get("/alarms")
    say_either(as_json, found, [each["text"] for each in found])
    raise typer.Exit(1 if found else 0)


@app.command()
def benches(service: Service, as_json: v.AsJson = False) -> None:
    """List the benches with their states and sessions."""
    with service.client() as client:
        found = client.get("/benches")
    lines = []
    for each in found:
        session = each["session"]
        about = f", session {session['name']}: {session['state']}, {session['good']} good" if session else ""
        lines.append(f"{each['name']}: {each['state']} {each['error'] or each['moving']}".rstrip() + about)
    say_either(as_json, found, lines)


@app.command()
def stop(bench: Bench, service: Service) -> None:
    """Stop everything that moves or transmits on a bench; a session pauses."""
    with service.client() as client:
        say(f"{bench}: stopped within {client.stop(bench):.0f} ms\n")


@app.command()
def begin(
    bench: Bench,
    name: Annotated[str, typer.Argument(help="Name of the session.")],
    service: Service,
    plan: Annotated[str, Option("Plan: testfield, frames, sensor, …")] = "frames",
    parameters: Annotated[str, Option("Parameters of the plan, JSON.")] = "{}",
    file: Annotated[list[Path] | None, Option("Input file; repeatable.", called="input", letter="-i")] = None,
) -> None:
    """Begin a session on a bench."""
    from ..io import read_text

    try:
        given = json.loads(parameters)
    except ValueError as error:
        raise UsageError(f"is not JSON ({error})", where="--parameters") from None
    inputs = {path.name: read_text(path) for path in file or []}
    body = {"name": name, "plan": plan, "parameters": given, "inputs": inputs}
    with service.client() as client:
        client.post(f"/benches/{quote(bench, safe='')}/sessions", body)
    say(f"{bench}: session {name} has begun\n")


def _steer(action: str, words: str) -> Any:
    def command(bench: Bench, service: Service) -> None:
        with service.client() as client:
            found = client.post(f"/benches/{quote(bench, safe='')}/{action}")
        say(f"{bench}: {found['state']}\n")

    command.__doc__ = words
    return command


app.command("pause")(_steer("pause", "Pause the session of a bench after the present pose."))
app.command("resume")(_steer("resume", "Let a session that is paused go on."))
app.command("abort")(_steer("abort", "End the session of a bench at once; it can be resumed later."))


@app.command()
def upload(
    name: Annotated[str, typer.Argument(help="Name of the session.")],
    photographs: Annotated[list[Path], typer.Argument(help="Photographs of the target, or scans of film.")],
    service: Service,
    camera: CameraChoice,
    subject: v.Subject = "camera",
    design: v.Design | None = None,
    test_object: v.TestObject | None = None,
    corners: v.Corners | None = None,
    format_mm: v.FormatMm | None = None,
    dpi: v.Dpi | None = None,
) -> None:
    """Calibrate from files on the service, which archives them; exit status 1 if it fails."""
    given: dict[str, Any] = {
        "subject": subject,
        "model": camera.model,
        "free": ",".join(camera.free),
        "format_mm": "" if format_mm is None else "x".join(f"{side:g}" for side in format_mm),
        "pitch_mm": camera.pitch_mm,
        "dpi": dpi,
    }
    inputs = {"test_object": test_object, "corners": corners}
    with service.client() as client:
        found = client.upload(
            name, photographs, design, inputs={k: v for k, v in inputs.items() if v is not None},
            **{k: v for k, v in given.items() if v not in (None, "")},
        )  # fmt: skip
    say(f"{name}: {found['status']} {found['why']}".rstrip() + "\n")
    for each in found["rejected"]:
        say(f"rejected {each['step']}: {each['why']}\n")
    raise typer.Exit(0 if found["status"] == "done" else 1)


@app.command()
def events(
    service: Service,
    limit: v.Limit = 0,
) -> None:
    """Print events as they happen, a line of JSON each."""
    with service.client() as client:
        for number, each in enumerate(client.events(), start=1):
            say(json.dumps(vars(each)) + "\n")
            typer.get_text_stream("stdout").flush()
            if number == limit:
                break


@app.command()
def call(
    method: Annotated[str, typer.Argument(help="GET, POST, PUT, PATCH or DELETE.")],
    path: Annotated[str, typer.Argument(help="Path after /api/1, such as /sessions.")],
    service: Service,
    body: Annotated[str, typer.Argument(help="Content, JSON.")] = "",
    out: v.Out | None = None,
) -> None:
    """Do any operation of the API, and print or write its answer."""
    try:
        content = json.loads(body) if body else None
    except ValueError as error:
        raise UsageError(f"is not JSON ({error})", where="content") from None
    with service.client() as client:
        found = client.request(method.upper(), path, content)
    if isinstance(found, bytes):
        if out is None:
            raise UsageError("is a file", where=path, do="give --out")
        writable(out).write_bytes(found)
    elif out is not None:
        writable(out).write_text(json.dumps(found, indent=1))
    else:
        say_json(found)
