"""`reseau bench`: find, check and simulate instruments."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import writable
from ..core.options import Option
from . import bench_by_hand as by_hand
from .bench_by_hand import held_one
from .common import pairs_of, say, say_either, say_json
from .declared import Commands


def features(
    search: Annotated[
        str, typer.Argument(help="Text in name, category, unit, values or description. Default: all.")
    ] = "",
    bench: v.Bench = Path("bench.toml"),
    camera: v.Camera | None = None,
    set_: Annotated[v.Set | None, "Here a feature, within its range."] = None,
    save: Annotated[str, Option("Keep the present values in this user set.", called="save-set")] = "",
    compare: Annotated[
        str,
        Option("User sets to compare, as UserSet1,UserSet2; one: with the present."),
    ] = "",
    as_json: v.AsJson = False,
) -> None:
    """List features of a GenICam camera with values, ranges and units; set them; save and compare user sets.

    What is set stays until the camera is switched off or opened with other settings: keep it in a user set,
    or in the bench file with `reseau bench set camera features=...`.
    """
    from ..instruments import Camera

    wanted = pairs_of(set_, "--set", "Name=value")
    with held_one(bench, Camera, camera, "reseau bench features") as found:
        if not hasattr(found, "user_sets"):
            raise UsageError("has no GenICam features", where=found.name)
        if wanted:
            found.set_features(wanted)
        if save:
            found.save_user_set(save)
        if compare:
            _compare(found, [each.strip() for each in compare.split(",")], as_json)
            return
        listed = found.features(search)
        if wanted and not search:
            listed = [each for each in listed if each.name in wanted]
    if as_json:
        rows = [
            {key: value for key, value in vars(each).items() if value not in (None, "", ())}
            for each in listed
        ]
        say_json({"schema": "reseau-features/1", "features": rows})
        return
    category = ""
    for each in listed:
        if each.category != category:
            category = each.category
            say(f"{category}\n")
        say(f"  {each}\n")
    if not listed:
        say(f"no feature with {search!r}\n")


def _compare(camera: Any, names: list[str], as_json: bool) -> None:
    """Print the features that differ between two user sets, or between one and the present values."""
    if len(names) > 2 or not all(names):
        raise UsageError("takes one or two user sets", where="--compare", do="write UserSet1,UserSet2")
    different = camera.compare_user_sets(*names)
    names = [*names, "present"][:2]
    lines = [f"{key}: {one} in {names[0]}, {two} in {names[1]}" for key, (one, two) in different.items()]
    said = lines or [f"{names[0]} and {names[1]} do not differ"]
    say_either(as_json, {"schema": "reseau-user-sets/1", "sets": names, "different": different}, said)


app = Commands(help="Find, check, simulate, and use instruments by hand.")

app.command()(by_hand.status)
app.command()(by_hand.home)
app.command()(by_hand.move)
app.command()(by_hand.stop)
app.command("set")(by_hand.set_)
app.command()(by_hand.expose)
app.command()(by_hand.watch)
app.command()(features)


@app.command("list")
def list_(
    as_json: v.AsJson = False,
    write: Annotated[Path | None, Option("Write a bench file for what was found; a new file.")] = None,
) -> None:
    """Search for cameras, VISA instruments and serial ports, and list the installed drivers."""
    from ..capture import found_instruments
    from ..capture.bench import bench_text, drivers
    from ..io import write_whole

    if write is not None and write.exists():
        raise UsageError("exists", where=write, do="name a new file")
    found = found_instruments()
    if write is not None:
        write_whole(write, bench_text(found, write.stem))
    if as_json:
        addresses = {k: [] if isinstance(v, Exception) else list(v) for k, v in found.items()}
        errors = {k: str(v) for k, v in found.items() if isinstance(v, Exception)}
        document = {"schema": "reseau-instruments/1", "found": addresses, "errors": errors}
        say_json(document | {"drivers": list(drivers())})
        return
    for way, addresses_ in found.items():
        if isinstance(addresses_, Exception):
            say(f"{way}: {addresses_}\n")
        else:
            say("".join(f"{way}: {address}\n" for address in addresses_) or f"{way}: nothing found\n")
    say(f"drivers: {', '.join(drivers())}\n")
    if write is not None:
        say(f"{write}: complete it, then run `reseau bench check --bench {write}`\n")


@app.command()
def check(
    bench: v.Bench = Path("bench.toml"),
    timeout_s: Annotated[float, Option("Time limit for each instrument (s).", least=0.1)] = 10.0,
    as_json: v.AsJson = False,
) -> None:
    """Connect all instruments and run their self-tests; list all failures."""
    from ..capture import Bench

    found = Bench.read(bench)
    try:
        checked = found.check(timeout_s, "reseau bench check")
    finally:
        found.close()
    failed = sum(each.error is not None for each in checked)
    if as_json:
        rows = [
            {"name": c.name, "driver": c.driver, "address": c.address, "found": c.found}
            | ({"error": str(c.error)} if c.error else {})
            for c in checked
        ]
        say_json({"schema": "reseau-bench-check/1", "failed": failed, "instruments": rows})
    else:
        say(f"{found.file.name}\n")
        for last, each in zip([*[False] * (len(checked) - 1), True], checked, strict=True):
            branch, stem = ("└", " ") if last else ("├", "│")
            outcome = "failed" if each.error else "works"
            say(f"{branch}── {each.name} ({each.driver}): {outcome}\n")
            lines = [str(each.error)] if each.error else [f"{k}: {v}" for k, v in each.found.items()]
            say("".join(f"{stem}       {line}\n" for line in lines))
    raise typer.Exit(1 if failed else 0)


@app.command()
def doctor(
    bench: v.Bench = Path("bench.toml"),
    timeout_s: Annotated[float, Option("Time limit for each instrument (s).", least=0.1)] = 10.0,
    as_json: v.AsJson = False,
) -> None:
    """Look for what keeps instruments from working, and say what to do.

    Permissions, programs that hold a device, network and firewall, packet sizes and losses, time limits,
    firmware. Nothing is changed.
    """
    from ..capture import Bench

    found = Bench.read(bench).diagnose(timeout_s)
    wrong = sum(each.fine is False for findings in found.values() for each in findings)
    rows = {name: [vars(each) for each in findings] for name, findings in found.items()}
    marks = {True: "fine", None: "note", False: "wrong"}
    lines = (f"{name}: {marks[e.fine]}: {e}" for name, findings in found.items() for e in findings)
    say_either(as_json, {"schema": "reseau-bench-doctor/1", "wrong": wrong, "instruments": rows}, lines)
    raise typer.Exit(1 if wrong else 0)


@app.command()
def profile(
    name: Annotated[
        str, typer.Argument(help="A profile, or a file FILE.toml of your own. Default: list all.")
    ] = "",
    address: Annotated[str, Option("Try it: fetch a picture of the screen at this address.")] = "",
    out: v.Out | None = None,
) -> None:
    """Show what is known of oscilloscopes or a controller, as a file; check a file of your own; try it.

    Give a file of your own as `dialect` in the options of an oscilloscope or a table in the bench file.
    """
    from ..core.plugins import INSTRUMENTS, TOOLS, plugin
    from ..io import write_whole

    if not address:
        text = plugin(TOOLS, "profiles")(name)
        say(text) if out is None else write_whole(out, text)
        return
    writable(out)
    with plugin(INSTRUMENTS, "oscilloscope")("scope", address, dialect=name or None) as scope:
        picture = scope.screen()
        say(f"{scope.connect()}: {scope.dialect.name}, a picture of {len(picture.data)} bytes\n")
    if out is not None:
        write_whole(out, picture.data)


@dataclass(frozen=True)
class Simulated:
    """What a simulated bench has."""

    controller: Annotated[
        Literal["zaber", "smc100", "kinesis", "grbl", "marlin", "hand"],
        Option("Controller of the turntable."),
    ] = "zaber"
    family: Annotated[str, Option("Oscilloscope family: keysight, rigol-1000z, …")] = "keysight"
    scene: Annotated[
        Literal["screen", "testfield", "frame", "sensor"] | None,
        Option("Scene of the camera. Default: no camera."),
    ] = None
    scanners: Annotated[
        Literal["ping360", "bk", "compactpulser", "all"], Option("Ultrasonic scanner, or all of them.")
    ] = "ping360"
    environment: Annotated[
        Literal["scpi", "modbus", "line", "all"] | None,
        Option("Sensor of the environment, or all of them. Default: none."),
    ] = None
    repeatable: Annotated[bool, Option("Identical frames for identical states, without drift.")] = False
    flat: Annotated[bool, Option("Plane testfield. Default: bent by its mount, as in the paper.")] = False
    water: Annotated[bool, Option("Testfield or frame under water, camera behind a plane port.")] = False
    port_distance: Annotated[
        float, Option("With --water: distance of the port from the camera (mm).", least=1.0, most=200.0)
    ] = 60.0
    port_thickness: Annotated[
        float, Option("With --water: thickness of the port (mm).", least=0.1, most=100.0)
    ] = 12.0
    port_tilt: Annotated[
        float, Option("With --water: tilt of the port about the y-axis (degrees).", least=-15.0, most=15.0)
    ] = 0.0
    temperature: Annotated[
        float, Option("With --water: its temperature (°C), and so its index.", least=2.0, most=28.0)
    ] = 18.0
    cameras: Annotated[
        int, Option("Number of cameras before the testfield; several are a rig.", least=1, most=4)
    ] = 1

    def options(self) -> dict[str, Any]:
        """Return the options of the simulator."""
        water = {
            "distance_mm": self.port_distance, "thickness_mm": self.port_thickness,
            "tilt_deg": (0.0, self.port_tilt), "temperature_c": self.temperature,
        }  # fmt: skip
        return {
            "table": self.controller, "family": self.family, "camera": self.scene, "scanner": self.scanners,
            "repeatable": self.repeatable, "flat": self.flat, "cameras": self.cameras,
            "environment": self.environment, **({"water": water} if self.water else {}),
        }  # fmt: skip


@app.command()
def sim(simulated: Simulated, out: v.Out | None = None, seed: v.Seed = 0, seconds: v.Seconds = 0.0) -> None:
    """Start simulated instruments on their real protocols, and print a bench.toml for them."""
    import threading

    from ..capture import plugin
    from ..io import write_whole

    writable(out)
    with plugin("reseau.simulators", "bench")(seed, **simulated.options()) as bench:
        if simulated.scene and simulated.cameras == 1 and "[instruments.camera]" not in bench.toml:
            typer.echo(
                "no camera: it needs Aravis and PyGObject, which are not installed (on Debian: apt-get "
                "install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc, then "
                "pip install 'reseau[aravis]')",
                err=True,
            )
        if out is not None:
            write_whole(out, bench.toml)
            for name, text in bench.documents.items():
                write_whole(out.with_name(name), text)
        else:
            say(bench.toml)
            typer.get_text_stream("stdout").flush()
        hint = f"in another terminal: reseau bench check --bench {out}" if out else "bench.toml: see above"
        typer.echo(f"serving until Ctrl-C; {hint}", err=True)
        with suppress(KeyboardInterrupt):
            threading.Event().wait(seconds or None)
        complaints = [f"{name}: {text}" for name, texts in bench.violations.items() for text in texts]
    for complaint in complaints:
        typer.echo(complaint, err=True)
