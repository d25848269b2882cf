"""`reseau remote`: sessions, calibrations, alarms and benches of a service, by its API."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from ..core.errors import UsageError
from .common import AsJson, Out, say, writable

if TYPE_CHECKING:
    from ..service.client import Client

__all__ = ["app"]

app = typer.Typer(
    no_args_is_help=True,
    help="A service, by its API: sessions, calibrations, alarms, benches. The token is in RESEAU_TOKEN.",
)

Server = Annotated[
    str, typer.Option("--server", "-s", envvar="RESEAU_SERVER", help="Address of the service.")
]
Authority = Annotated[
    Path | None, typer.Option(help="Certificate by which that of the service is checked (PEM).")
]
Bench = Annotated[str, typer.Argument(help="Name of the bench.")]
LOCAL = "http://127.0.0.1:8480"


@contextmanager
def _client(server: str, authority: Path | None) -> Iterator[Client]:
    from ..service.client import Client

    with Client(server, None, authority) as client:
        yield client


def _shown(value: Any, as_json: bool, lines: list[str]) -> None:
    if as_json:
        say(json.dumps(value, indent=1, ensure_ascii=False) + "\n")
    else:
        say("".join(f"{line}\n" for line in lines))


@app.command()
def sessions(
    like: Annotated[str, typer.Option(help="Part of the name or the plan.")] = "",
    count: Annotated[int, typer.Option(min=1, help="Number of sessions.")] = 50,
    server: Server = LOCAL,
    authority: Authority = None,
    as_json: AsJson = False,
) -> None:
    """List sessions, latest first."""
    import itertools

    with _client(server, authority) as client:
        found = list(itertools.islice(client.sessions(like), count))
    lines = [
        f"{s['begun'][:16]}Z  {s['name']}  {s['plan']}  {s['frames']} frames  {s['status']}" for s in found
    ]
    _shown(found, as_json, lines)


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="Name of the session.")],
    out: Out = None,
    server: Server = LOCAL,
    authority: Authority = None,
    as_json: AsJson = False,
) -> None:
    """Show a session; --out writes the latest result of each name to a folder."""
    with _client(server, authority) as client:
        found = client.get(f"/sessions/{quote(name, safe='')}")
        if out is not None:
            out.mkdir(exist_ok=True)
            for each in {r["name"]: r for r in found["results"]}.values():
                path = out / Path(each["name"]).name
                path.write_bytes(client.file(f"/sessions/{quote(name, safe='')}/results/{each['id']}/file"))
    lines = [f"{found['name']}: {found['status']} {found['why']}".rstrip()]
    lines.append(f"{found['good']} good frames" + (f" of {found['expected']}" if found["expected"] else ""))
    lines += [f"rejected {each['step']}: {each['why']}" for each in found["rejected"]]
    lines += [f"result {each['name']}" for each in found["results"]]
    _shown(found, as_json, lines)


@app.command()
def calibrations(server: Server = LOCAL, authority: Authority = None, as_json: AsJson = False) -> None:
    """List the configurations with the calibration in force."""
    with _client(server, authority) as client:
        found = client.get("/configurations")
    lines = []
    for each in found:
        force = each["in_force"]
        since = f"in force since {force['since'][:16]}Z" if force else "no calibration in force"
        lines.append(f"{each['name']}: {since}, {each['to_review']} to review")
    _shown(found, as_json, lines)


@app.command()
def alarms(server: Server = LOCAL, authority: Authority = None, as_json: AsJson = False) -> None:
    """List the open alarms; exit status 1 if there are any."""
    with _client(server, authority) as client:
        found = client.get("/alarms")
    _shown(found, as_json, [each["text"] for each in found])
    raise typer.Exit(1 if found else 0)


@app.command()
def benches(server: Server = LOCAL, authority: Authority = None, as_json: AsJson = False) -> None:
    """List the benches with their states and sessions."""
    with _client(server, authority) as client:
        found = client.get("/benches")
    lines = []
    for each in found:
        session = each["session"]
        about = f", session {session['name']}: {session['state']}, {session['good']} good" if session else ""
        lines.append(f"{each['name']}: {each['state']} {each['error'] or each['moving']}".rstrip() + about)
    _shown(found, as_json, lines)


@app.command()
def stop(bench: Bench, server: Server = LOCAL, authority: Authority = None) -> None:
    """Stop everything that moves or transmits on a bench; a session pauses."""
    with _client(server, authority) as client:
        say(f"{bench}: stopped within {client.stop(bench):.0f} ms\n")


@app.command()
def begin(
    bench: Bench,
    name: Annotated[str, typer.Argument(help="Name of the session.")],
    plan: Annotated[str, typer.Option(help="Plan: testfield, frames, sensor, …")] = "frames",
    parameters: Annotated[str, typer.Option(help="Parameters of the plan, JSON.")] = "{}",
    file: Annotated[list[Path] | None, typer.Option("--input", "-i", help="Input file; repeatable.")] = None,
    server: Server = LOCAL,
    authority: Authority = None,
) -> None:
    """Begin a session on a bench."""
    from ..io import read_text

    try:
        given = json.loads(parameters)
    except ValueError as error:
        raise UsageError(f"is not JSON ({error})", where="--parameters") from None
    inputs = {path.name: read_text(path) for path in file or []}
    body = {"name": name, "plan": plan, "parameters": given, "inputs": inputs}
    with _client(server, authority) as client:
        client.post(f"/benches/{quote(bench, safe='')}/sessions", body)
    say(f"{bench}: session {name} has begun\n")


def _steer(action: str, words: str) -> Any:
    def command(bench: Bench, server: Server = LOCAL, authority: Authority = None) -> None:
        with _client(server, authority) as client:
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
    target: Annotated[str, typer.Option(help="camera, oscilloscope (PHOTO I, II, III) or film.")] = "camera",
    design: Annotated[Path | None, typer.Option("--design", "-d", help="Design of the target.")] = None,
    test_object: Annotated[Path | None, typer.Option("--object", help="Design of the test object.")] = None,
    corners: Annotated[Path | None, typer.Option(help="Calibrated corners, for film.")] = None,
    model: Annotated[str, typer.Option(help="Camera model.")] = "",
    pitch: Annotated[float | None, typer.Option(min=1e-6, help="Pixel size, mm.")] = None,
    free: Annotated[str, typer.Option(help="Parameters to estimate, e.g. c,x0,y0,K1.")] = "",
    frame: Annotated[str, typer.Option(help="Format of film in mm, as 36x24.")] = "",
    dpi: Annotated[float | None, typer.Option(min=10, help="Resolution of scans of film.")] = None,
    server: Server = LOCAL,
    authority: Authority = None,
) -> None:
    """Calibrate from files on the service, which archives them; exit status 1 if it fails."""
    given: dict[str, Any] = {
        "target": target,
        "model": model,
        "free": free,
        "film_format": frame,
        "pitch": pitch,
        "dpi": dpi,
    }
    inputs = {"test_object": test_object, "corners": corners}
    with _client(server, authority) as client:
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
    count: Annotated[int, typer.Option(min=0, help="End after this many; 0: no limit.")] = 0,
    server: Server = LOCAL,
    authority: Authority = None,
) -> None:
    """Print events as they happen, a line of JSON each."""
    with _client(server, authority) as client:
        for number, each in enumerate(client.events(), start=1):
            say(json.dumps(vars(each)) + "\n")
            typer.get_text_stream("stdout").flush()
            if number == count:
                break


@app.command()
def call(
    method: Annotated[str, typer.Argument(help="GET, POST, PUT, PATCH or DELETE.")],
    path: Annotated[str, typer.Argument(help="Path after /api/1, such as /sessions.")],
    body: Annotated[str, typer.Argument(help="Content, JSON.")] = "",
    out: Out = None,
    server: Server = LOCAL,
    authority: Authority = None,
) -> None:
    """Do any operation of the API, and print or write its answer."""
    try:
        content = json.loads(body) if body else None
    except ValueError as error:
        raise UsageError(f"is not JSON ({error})", where="content") from None
    with _client(server, authority) as client:
        found = client.request(method.upper(), path, content)
    if isinstance(found, bytes):
        if out is None:
            raise UsageError("is a file", where=path, do="give --out")
        writable(out).write_bytes(found)
    elif out is not None:
        writable(out).write_text(json.dumps(found, indent=1))
    else:
        say(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
