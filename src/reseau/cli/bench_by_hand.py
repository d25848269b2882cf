"""`reseau bench status|home|move|stop|set|expose|watch`: acts on the instruments of a bench by hand."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import InputError, ReseauError, StateError, UsageError
from ..core.files import writable
from ..core.options import Option
from .common import pairs_of, say, say_json

if TYPE_CHECKING:
    from ..capture import Bench
    from ..instruments import Turntable


_BENCH = Path("bench.toml")
_PATIENCE_S = 15.0
"""Time that a process has to end a session that `stop` interrupts."""


@contextmanager
def _held(bench: Bench, purpose: str) -> Iterator[None]:
    """Lock and connect instruments, and allow motion; after Ctrl-C or an error, stop them."""
    with bench.lock(purpose), bench:
        for each in bench.instruments.values():
            each.stage()
        try:
            yield
        except BaseException:
            with suppress(ReseauError):
                bench.stop()
            raise


@contextmanager
def held_one(path: Path, kind: type, name: str | None, purpose: str) -> Iterator[Any]:
    """An instrument of a bench, connected: the named one, or the only one of its kind."""
    from ..capture import Bench

    bench = Bench.read(path)
    found = bench.one(kind, name)
    with _held(bench.part([found.name]), purpose):
        yield found


def status(bench: v.Bench = _BENCH, as_json: v.AsJson = False) -> None:
    """Show identity, positions and settings of each instrument, or who uses it; nothing moves."""
    from ..capture import Bench

    rows = _states(Bench.read(bench))
    if as_json:
        say_json({"schema": "reseau-bench-status/1", "instruments": rows})
    else:
        for row in rows:
            say(f"{row['name']} ({row['driver']}): {row.get('error') or row['identity']}\n")
            lines = row.get("axes", {}) | row.get("environment", {})
            say("".join(f"  {name:<12} {words}\n" for name, words in lines.items()))
            settings = "  ".join(f"{name} {words}" for name, words in row.get("settings", {}).items())
            say(f"  {settings}\n" if settings else "")
    raise typer.Exit(1 if any("error" in row for row in rows) else 0)


def _states(bench: Bench) -> list[dict[str, Any]]:
    """State of each instrument: what it answers, or why it does not."""
    from ..capture import by_hand
    from ..instruments import EnvironmentSensor, Turntable

    rows = []
    for name, entry in bench.file.instruments.items():
        row: dict[str, Any] = {"name": name, "driver": entry.driver, "address": entry.address}
        part = bench.part([name], required=())
        try:
            with part.lock("reseau bench status"), part:
                instrument = part[name]
                row["identity"] = str(instrument.connect())
                settings = instrument.settings
                row["settings"] = {
                    key: f"{value:g} {settings.units.get(key, '')}".rstrip()
                    if isinstance(value, int | float)
                    else str(value)
                    for key, value in settings.to_dict().items()
                    if value != ""
                }
                if isinstance(instrument, Turntable):
                    row["axes"] = {axis: str(found) for axis, found in by_hand.axes_of(instrument).items()}
                if isinstance(instrument, EnvironmentSensor):
                    measured = instrument.environment().conditions
                    row["environment"] = {key: str(each) for key, each in measured.items()}
        except ReseauError as error:
            row["error"] = str(error)
        rows.append(row)
    return rows


def home(
    axes: Annotated[
        list[str] | None, typer.Argument(help="Axes. Default: those that have no reference.")
    ] = None,
    bench: v.Bench = _BENCH,
    table: v.Table | None = None,
) -> None:
    """Find the reference of axes, one after the other. The axes move; Ctrl-C stops them."""
    from ..capture import by_hand
    from ..instruments import Turntable

    with held_one(bench, Turntable, table, "reseau bench home") as found:
        homed = by_hand.home(found, axes or ())
        say(f"{', '.join(homed)}: homed\n" if homed else "all axes have their reference\n")
        _say_axes(found)


def move(
    positions: Annotated[list[str], typer.Argument(help="Positions, as tilt=30 roll=-10.")],
    bench: v.Bench = _BENCH,
    table: v.Table | None = None,
    relative: Annotated[bool, Option("The numbers are changes of the positions.")] = False,
) -> None:
    """Move axes, all at the same time, and wait. Ctrl-C stops them where they are."""
    from ..capture import by_hand
    from ..instruments import Turntable

    form = "axis=number, as tilt=30"
    try:
        wanted = {axis: float(text) for axis, text in pairs_of(positions, "positions", form).items()}
    except ValueError as error:
        raise UsageError(str(error), where="positions", do=f"write {form}") from None
    with held_one(bench, Turntable, table, "reseau bench move") as found:
        there = by_hand.targets(found, wanted, relative=relative)
        lost = [axis for axis in there if not found.state(axis).homed]
        if lost:
            why = ": ".join(filter(None, ["has no reference", found.state(lost[0]).reference]))
            raise StateError(why, where=lost[0], do=f"run `reseau bench home {' '.join(lost)}`")
        by_hand.move(found, there)
        _say_axes(found)


def _say_axes(table: Turntable) -> None:
    from ..capture import by_hand

    say("".join(f"{name:<12} {axis}\n" for name, axis in by_hand.axes_of(table).items()))


def stop(bench: v.Bench = _BENCH) -> None:
    """Stop all motion, transmission and recording, also those of a session of another process.

    Such a session is asked to stop: it can be resumed. This is no emergency stop: it needs this computer, the
    connection and the controller.
    """
    from ..capture import Bench

    found = Bench.read(bench)
    for pid, holder in _holders(found).items():
        say(f"telling {holder} to stop\n")
        try:
            os.kill(pid, signal.SIGTERM)
        except PermissionError:
            raise StateError("belongs to another user", where=holder, do="stop it there") from None
        except OSError:  # it has ended meanwhile; Windows has no class for that
            continue
    end = time.monotonic() + _PATIENCE_S
    while (holders := _holders(found)) and time.monotonic() < end:
        time.sleep(0.05)
    if holders:
        what = f"has not ended within {_PATIENCE_S:g} s; its instruments may still move"
        raise StateError(what, where=next(iter(holders.values())), do="switch them off")
    everything = found.part(found.instruments, required=())
    with everything.lock("reseau bench stop"):
        outcomes = everything.connect()
        silent = [name for name in everything.instruments if name not in outcomes]
        try:
            everything.without(silent).stop()
        finally:
            everything.close()
    say("".join(f"{name}: stopped\n" for name in outcomes))
    if silent:
        raise StateError("did not answer: it may still move", where=", ".join(silent), do="switch it off")


def _holders(bench: Bench) -> dict[int, str]:
    """Processes that use instruments of a bench, in words."""
    from ..capture import BenchLock

    found = (BenchLock.holder(entry.address) for entry in bench.file.instruments.values())
    return {each.pid: str(each) for each in found if each is not None and each.pid not in (0, os.getpid())}


def set_(
    instrument: Annotated[str, typer.Argument(help="Instrument of the bench.")],
    changes: Annotated[list[str], typer.Argument(help="Settings, as exposure_us=2000 gain=3.")],
    bench: v.Bench = _BENCH,
) -> None:
    """Change settings of an instrument, and in the bench file, which sets them at every connection."""
    from ..capture import Bench, BenchFile
    from ..io import read_text, write_whole

    text = read_text(bench)
    found = Bench(BenchFile.parse_toml(text, where=bench))
    one = found[instrument]
    before = one.settings.to_dict()
    wanted = dict(_setting(each, before, instrument) for each in changes)
    with _held(found.part([instrument]), "reseau bench set"):
        one.configure(**wanted)
    write_whole(bench, _with_settings(text, instrument, wanted))
    for name, value in wanted.items():
        unit = one.settings.units.get(name, "")
        say(f"{instrument}: {name} {before[name]} → {value} {unit}".rstrip() + "\n")


def _setting(text: str, known: dict[str, float | str], instrument: str) -> tuple[str, float | int | str]:
    """Name and value of a setting, in the type of its present value."""
    name, equals, value = text.partition("=")
    if not equals or name not in known:
        do = f"write name=value, with {', '.join(known)}"
        raise UsageError(f"cannot interpret {text!r}", where=instrument, do=do)
    if isinstance(known[name], str):
        return name, value
    try:
        return name, int(value) if isinstance(known[name], int) else float(value)
    except ValueError:
        raise UsageError(f"{value!r} is not a number", where=f"{instrument}: {name}") from None


def _with_settings(text: str, instrument: str, changes: dict[str, Any]) -> str:
    """The bench file with other settings; comments and order are kept."""
    import tomlkit

    document: Any = tomlkit.parse(text)
    entry = document["instruments"][instrument]
    if "settings" not in entry:
        entry["settings"] = tomlkit.inline_table()
    entry["settings"].update(changes)
    return tomlkit.dumps(document)


def expose(
    out: v.Out | None = None,
    bench: v.Bench = _BENCH,
    camera: v.Camera | None = None,
    exposure_us: Annotated[
        float | None, Option("Exposure of this frame (µs). Default: as set.", least=0.1)
    ] = None,
    auto: Annotated[v.Auto, "They are kept in the bench file."] = False,
    percentile: Annotated[
        float, Option("With --auto: percentile of the grey values.", least=1.0, most=100.0)
    ] = 99.5,
    share: Annotated[float, Option("With --auto: its share of full scale.", least=0.01, most=0.99)] = 0.8,
    longest_ms: Annotated[v.LongestMs, "Here with --auto; then the gain is raised."] = 50.0,
    as_json: v.AsJson = False,
) -> None:
    """Take a frame, and say how it is exposed and how sharp it is; it is not archived."""
    from ..capture.lighting import LightRule, steer
    from ..instruments import Camera
    from ..io import read_text, write_whole
    from ..io.images import write_image

    if auto and exposure_us is not None:
        raise UsageError("cannot be combined with --auto", where="--exposure-us")
    writable(out)
    with held_one(bench, Camera, camera, "reseau bench expose") as found:
        # Others set the exposure of the bench file again, when they connect.
        if exposure_us is not None:
            found.configure(exposure_us=exposure_us)
        steered = None
        if auto:
            steered = steer(found, LightRule(percentile, share, longest_us=1000 * longest_ms))
        frame = found.expose().frame
        name, kept = found.name, {key: found.settings.to_dict()[key] for key in _LIGHT if auto}
    facts = _facts(frame)
    if steered is not None:
        facts |= {"auto": {"percentile": percentile, "share": share, **vars(steered)}}
        write_whole(bench, _with_settings(read_text(bench), name, kept))
    if out is not None:
        write_image(out, frame.pixels)
    if as_json:
        say_json({"schema": "reseau-exposure/1", "width": frame.width, "height": frame.height} | facts)
        return
    say(f"{frame.width} × {frame.height} px: {_words(facts)}\n")
    if steered is not None:
        say(f"{name}: exposure_us {steered.exposure_us:g}, gain {steered.gain:g}, kept in {bench}\n")
        if not steered:
            typer.echo(f"warning: {steered.why}", err=True)
    if out is not None:
        say(f"{out}\n")


_LIGHT = ("exposure_us", "gain")
"""Settings that the rule for the light changes."""


def _facts(frame: Any) -> dict[str, Any]:
    """Exposure and sharpness of a frame."""
    from ..capture.checks import edge_sigma, exposure_fault, exposure_of
    from ..core.numbers import or_null

    saturated, bright = exposure_of(frame)
    edge = or_null(edge_sigma(frame))
    return {"saturated": saturated, "bright": bright, "edge_px": edge, "fault": exposure_fault(frame)}


def _words(facts: dict[str, Any]) -> str:
    edge = "no edges" if facts["edge_px"] is None else f"sharpest edges {facts['edge_px']:.2f} px"
    words = f"{100 * facts['saturated']:.2g} % saturated, brightest {100 * facts['bright']:.0f} %, {edge}"
    return words + (f"; {facts['fault']}" if facts["fault"] else "")


def watch(
    bench: v.Bench = _BENCH,
    every: v.Every = 1.0,
    limit: v.Limit = 0,
    camera: v.Camera | None = None,
    table: v.Table | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Show positions of the table, and exposure and sharpness of the camera, again and again.

    To aim, focus and light by hand. `reseau watch` shows the picture itself.
    """
    import json

    from ..capture import Bench, by_hand
    from ..instruments import Camera, Turntable

    found = Bench.read(bench)
    eye: Any = found.one(Camera, camera) if camera is not None or found.has(Camera) else None
    stand: Any = found.one(Turntable, table) if table is not None or found.has(Turntable) else None
    names = [each.name for each in (eye, stand) if each is not None]
    if not names:
        raise InputError("has no camera and no table", where=bench)
    number = 0
    with _held(found.part(names), "reseau bench watch"), suppress(KeyboardInterrupt):
        while not limit or number < limit:
            axes = {} if stand is None else by_hand.axes_of(stand)
            facts = {} if eye is None else _facts(eye.expose().frame)
            if as_json:
                at = {name: axis.position if axis.homed else None for name, axis in axes.items()}
                say(json.dumps({"axes": at, "camera": facts}) + "\n")
            else:
                places = "  ".join(
                    f"{name} {f'{axis.position:g} {axis.unit}' if axis.homed else 'not homed'}"
                    for name, axis in axes.items()
                )
                say("  |  ".join(filter(None, (places, _words(facts) if facts else ""))) + "\n")
            number += 1
            if not limit or number < limit:
                time.sleep(every)
