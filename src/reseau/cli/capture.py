"""`reseau capture`: acquisitions on a bench into an archive; they can be resumed."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import writable
from ..core.options import Group, Option
from .acquisition import Where, ask_operator, conduct
from .blurred import BESIDE_RAYS
from .common import say
from .declared import Commands
from .sensor import event, lines

if TYPE_CHECKING:
    from ..archive import Session
    from ..capture import Bench
    from ..sessions.parameters import BlurredParameters, SensorParameters, TestfieldParameters

app = Commands(
    help="Acquire frames on a bench. Each frame is archived before the next exposure.",
)


@dataclass(frozen=True)
class Exposing:
    """How frames are taken, and with which camera."""

    average: v.Average = 1
    checks: v.Checks = 3
    retakes: v.Retakes = 2
    camera: v.Camera | None = None


@dataclass(frozen=True)
class Unchecked(Exposing):
    """The same, without checks before the first frame."""

    checks: v.Checks = 0


@dataclass(frozen=True)
class Heights:
    """What is known of a target on a z-stage."""

    heights: Annotated[
        tuple[str, ...],
        Option("Heights of the board (mm); record each pose at each height.", Group.TARGET, value="0,50,100"),
    ] = ()
    height_sigma: Annotated[
        float, Option("Standard deviation of a height (mm); used with --heights.", Group.TARGET, least=1e-9)
    ] = 0.01
    axis_sigma_mrad: Annotated[
        float,
        Option(
            "Standard deviation of the angle between z and the board normal (mrad).", Group.TARGET, least=1e-6
        ),
    ] = 10.0
    field_sigma: Annotated[
        float,
        Option(
            "Standard deviation of design coordinates (mm); used with --heights.", Group.TARGET, least=1e-9
        ),
    ] = 0.05

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Standard deviations: mm, rad, mm."""
        return self.height_sigma, self.axis_sigma_mrad / 1e3, self.field_sigma


@app.command("testfield")
def coded_field(
    where: Where,
    exposing: Exposing,
    on_stage: Heights,
    design: v.Design | None = None,
    poses: Annotated[v.Poses | None, "Default: the 36 poses of the paper."] = None,
    until: v.Until = "",
    first: v.First = 5,
    pitch_mm: v.PitchMm | None = None,
    free: v.Free = (),
    row_jitter_px: v.RowJitterPx = 0.0,
    fill: v.Fill = 1.0,
    park: v.Park | None = None,
    retreat: v.Retreat | None = None,
    table: v.Table | None = None,
) -> None:
    """Record a testfield from many poses, and calibrate the camera during the acquisition."""
    levels = _numbers(on_stage.heights, "--heights")

    def parameters(bench: Bench) -> TestfieldParameters:
        from ..capture import Goal, paper_steps
        from ..capture.steps import at_heights, read_steps
        from ..instruments import Turntable
        from ..sessions.parameters import TestfieldParameters

        if until:
            Goal.parse(until)
        axes = bench.one(Turntable, table).axes
        steps = at_heights(paper_steps(axes=tuple(axes)) if poses is None else read_steps(poses), levels)
        lifted = TestfieldParameters.lifted(steps)
        return TestfieldParameters(
            steps=tuple((step.name, dict(step.position)) for step in steps), until=until, first=first,
            pitch_mm=pitch_mm, free=free, sigmas=on_stage.sigmas if lifted else None,
            row_jitter_px=row_jitter_px, fill=fill, park=park or {}, retreat=retreat or {},
            table=table, **vars(exposing),
        )  # fmt: skip

    conduct(where, "testfield", parameters, {"design.json": design})


@app.command()
def blurred(
    where: Where,
    exposing: Exposing,
    network: Annotated[v.Network | None, "Its images are named as the poses."] = None,
    targets: v.Targets | None = None,
    lens: Annotated[v.Lens | None, "Here lens/1, with its sensor."] = None,
    poses: v.Poses | None = None,
    psf_px: Annotated[v.PsfPx, BESIDE_RAYS] = 0.5,
    search_px: v.SearchPx = 6.0,
    rounds: v.Rounds = 6,
    table: v.Table | None = None,
) -> None:
    """Record targets on a frame from all poses, measure them by rays, and adjust the network."""

    def parameters(bench: Bench) -> BlurredParameters:
        from ..capture.steps import read_steps
        from ..sessions.parameters import BlurredParameters

        if poses is None:
            raise UsageError("is missing", where="--poses", do="give a CSV with the images of the network")
        return BlurredParameters(
            steps=tuple((step.name, dict(step.position)) for step in read_steps(poses)), psf_px=psf_px,
            search_px=search_px, rounds=rounds, table=table, **vars(exposing),
        )  # fmt: skip

    inputs = {"network.json": network, "targets.json": targets, "lens.toml": lens}
    conduct(where, "blurred", parameters, inputs)


@app.command()
def oscilloscope(
    where: Where,
    exposing: Unchecked,
    reseau: v.Reseau | None = None,
    test_object: v.TestObject | None = None,
    body: v.Body = True,
    scanner: v.Scanner | None = None,
    oscilloscope: v.Oscilloscope | None = None,
) -> None:
    """Take PHOTO I, II and III of an oscilloscope, and correct them during the acquisition."""
    how = {"body": body, "park": {}, "scanner": scanner, "oscilloscope": oscilloscope, **vars(exposing)}
    inputs = {"reseau.json": reseau, "object.json": test_object}
    conduct(where, "oscilloscope", lambda bench: how, inputs)


@app.command()
def scan(
    where: Where,
    count: v.Count = 1,
    scanner: v.Scanner | None = None,
    oscilloscope: v.Oscilloscope | None = None,
) -> None:
    """Take sections with the ultrasonic scanner, and screenshots if there is an oscilloscope."""
    how = {"count": count, "retakes": 0, "park": {}, "scanner": scanner, "oscilloscope": oscilloscope}
    conduct(where, "scan", lambda bench: how)


@app.command()
def frames(
    where: Where,
    exposing: Unchecked,
    count: v.Count = 1,
    table: Annotated[v.Table | None, "Its positions are recorded with each frame."] = None,
) -> None:
    """Take frames with a camera."""
    how = {"count": count, "park": {}, **vars(exposing)} | ({} if table is None else {"table": table})
    conduct(where, "frames", lambda bench: how)


def _numbers(words: Sequence[str], option: str) -> tuple[float, ...]:
    try:
        return tuple(map(float, words))
    except ValueError:
        raise UsageError(
            f"cannot interpret {','.join(words)!r}", where=option, do="write numbers, as 0,50,100"
        ) from None


@app.command()
def sensor(
    where: Where,
    out: Annotated[v.Out | None, "Here the calibration, in addition to the archive."] = None,
    camera: v.Camera | None = None,
    levels: v.Levels = 14,
    frames: v.Frames = 8,
    longest_ms: v.LongestMs = 1000.0,
    mtf: Annotated[bool, Option("Also measure the MTF, with a slanted edge.")] = False,
    region: v.Region | None = None,
    retakes: v.Retakes = 2,
    yes: Annotated[bool, Option("Do not prompt.")] = False,
) -> None:
    """Calibrate a camera's sensor: dark signal, response, linearity, noise, gain, full well, defects, MTF."""
    writable(out)

    def parameters(bench: Bench) -> SensorParameters:
        from ..sessions.parameters import SensorParameters

        return SensorParameters.on_bench(
            bench, camera=camera, levels=levels, frames=frames, longest_us=longest_ms * 1000, edge=mtf,
            region=region, retakes=retakes,
        )  # fmt: skip

    def afterwards(session: Session) -> None:
        _print_result(session, out, where.as_json)

    who = _print_request if yes else ask_operator
    conduct(where, "sensor", parameters, operator=who, afterwards=afterwards, also_resumed=("out", "yes"))


def _print_request(request: str) -> None:
    """Print a request to the operator without waiting."""
    typer.echo(request, err=True)


def _print_result(session: Session, out: Path | None, as_json: bool) -> None:
    """Print the calibration, and write it if `out` is given.

    Raises
    ------
    EstimationError
        If an edge was taken but could not be measured; all other results are stored.
    """
    from ..core.errors import EstimationError
    from ..io import write_whole
    from ..sessions.conducting import calibration_of, parameters_of

    found = calibration_of(session)
    if out is not None:
        write_whole(out, found.to_json())
    if as_json:
        say(json.dumps(event(found)) + "\n")
    else:
        say(lines(found) + (f"{out}\n" if out is not None else ""))
    if getattr(parameters_of(session), "edge_us", None) is not None and "psf" not in found.parameters:
        raise EstimationError(found.validity.get("edge", "no usable frame"), where="edge")


@app.command()
def own(
    where: Where,
    generator: Annotated[
        Path | None, Option("Python file with a generator `plan(run, …)`.", letter="-g")
    ] = None,
    set_: Annotated[v.Set | None, "Here arguments of the plan, as tilt=30."] = None,
    retakes: v.Retakes = 0,
    camera: v.Camera | None = None,
    table: v.Table | None = None,
) -> None:
    """Carry out your own plan: a Python generator, stored with the session."""
    values = dict(_value(text) for text in set_ or ())
    if generator is not None:
        from ..io import read_text
        from ..sessions.kinds import own_plan

        own_plan(read_text(generator), generator, values)
    how = {"set": values, "retakes": retakes, "park": {}, "camera": camera}
    how |= {} if table is None else {"table": table}
    conduct(where, "own", lambda bench: how, {"generator.py": generator})


def _value(text: str) -> tuple[str, Any]:
    """Parse an argument: its name, and its value in TOML (number, list …) or as text."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise UsageError(f"cannot interpret {text!r}", where="--set", do="write name=value, as tilt=30")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value
