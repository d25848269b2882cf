"""`reseau capture`: acquisitions on a bench, into an archive, resumable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import UsageError
from .acquisition import CameraName, Where, conduct, in_session
from .sessions import model_of, steps_of

if TYPE_CHECKING:
    from ..capture import Acquisition, Bench, Goal, Plan, Step
    from ..procedures.calibration import CameraOptions

__all__ = ["app"]

app = typer.Typer(
    no_args_is_help=True,
    help="Acquisitions on a bench: every frame is in the archive before the next is taken.",
)

Average = Annotated[int, typer.Option(min=1, help="Exposures to a frame, averaged.")]
Checks = Annotated[int, typer.Option(min=0, help="Frames to look at before anything is taken; 0: none.")]
Retakes = Annotated[int, typer.Option(min=0, help="How often a bad frame is taken again.")]
HeightSigma = Annotated[float, typer.Option(min=1e-9, help="Of a height (mm), where there is z.")]
AxisSigma = Annotated[
    float, typer.Option(min=1e-6, help="Of z against the normal of the board (mrad), both ways.")
]
FieldSigma = Annotated[float, typer.Option(min=1e-9, help="Of the design's points (mm), where there is z.")]
Pitch = Annotated[float | None, typer.Option(min=1e-6, help="Of the pixels (mm), for Brown's model.")]
Poses = Annotated[
    Path | None, typer.Option(help="CSV of poses, a column for each axis; by default the paper's 36.")
]
TableName = Annotated[str | None, typer.Option("--table", help="Where the bench has several.")]
ScannerName = Annotated[str | None, typer.Option("--scanner", help="Where the bench has several.")]
ScopeName = Annotated[str | None, typer.Option("--oscilloscope", help="Where the bench has several.")]


@app.command("testfield")
@in_session()
def coded_field(
    where: Where,
    design: Annotated[Path | None, typer.Option("--design", "-d", help="Of the testfield or sheet.")] = None,
    poses: Poses = None,
    heights: Annotated[str, typer.Option(help="Of the board (mm), as 0,50,100: each pose at each.")] = "",
    height_sigma: HeightSigma = 0.01,
    axis_sigma: AxisSigma = 10.0,
    field_sigma: FieldSigma = 0.05,
    until: Annotated[str, typer.Option(help="Choose poses until this holds, as 'sigma_c < 0.5 um'.")] = "",
    first: Annotated[int, typer.Option(min=4, help="Poses to begin with, where they are chosen.")] = 5,
    pitch: Pitch = None,
    free: Annotated[str, typer.Option(help="Parameters to estimate, as c,x0,y0,K1.")] = "",
    row_jitter: Annotated[float, typer.Option(min=0, help="Of the sensor, pixels.")] = 0.0,
    fill: Annotated[float, typer.Option(min=0, max=1, help="Light-sensitive part of the pixels.")] = 1.0,
    average: Average = 1,
    checks: Checks = 3,
    retakes: Retakes = 2,
    home: Annotated[
        bool, typer.Option("--home", help="Have axes without a reference find it first: they will move.")
    ] = False,
    park: Annotated[str, typer.Option(help="Where the table ends, as tilt=0,roll=0; else it stays.")] = "",
    retreat: Annotated[str, typer.Option(help="… where it goes after an abort or an error.")] = "",
    camera: CameraName = None,
    table: TableName = None,
) -> None:
    """Record a testfield from many poses, and calibrate the camera while the recordings come in."""
    from ..capture import Goal, Step, at_heights, paper_steps, read_steps
    from ..instruments import Camera, Turntable

    goal = Goal.parse(until) if until else None
    ends, away = _position(park, "--park"), _position(retreat, "--retreat")

    def parameters(found: Bench) -> dict[str, Any]:
        found.one(Camera, camera)
        axes = found.one(Turntable, table).axes
        every = paper_steps(axes=tuple(axes)) if poses is None else read_steps(poses)
        steps = at_heights(every, _numbers(heights, "--heights"))
        _within(axes, [*steps, Step("--park", ends), Step("--retreat", away)])
        given = {
            "steps": [[step.name, dict(step.position)] for step in steps],
            "until": until,
            "first": first,
            "pitch": pitch,
            "free": [each.strip() for each in free.split(",") if each.strip()],
            "sigmas": [height_sigma, axis_sigma / 1e3, field_sigma] if _lifted(steps) else None,
            "row_jitter": row_jitter,
            "fill": fill,
            "average": average,
            "checks": checks,
            "retakes": retakes,
            "home": home,
            "park": ends,
            "retreat": away,
            "camera": camera,
            "table": table,
        }
        _of_model(goal, model_of(given))
        return given

    conduct(where, "testfield", _recordings, parameters, {"design.json": design})


def _recordings(run: Acquisition, given: dict[str, Any]) -> Plan:
    """The plan of a testfield's session."""
    from ..capture import Goal, plans, spread

    every, how = steps_of(given), (given["average"], given["checks"])
    if given["until"]:
        goal, begin = Goal.parse(given["until"]), spread(every, given["first"])
        plan = plans.until(run, goal, begin, every, *how)
    else:
        plan = plans.poses(run, every, *how)
    return plans.homed(run, plan) if given["home"] else plan


@app.command()
@in_session()
def oscilloscope(
    where: Where,
    reseau: Annotated[Path | None, typer.Option("--reseau", "-r", help="Design of the reseau.")] = None,
    object_: Annotated[Path | None, typer.Option("--object", help="Design of the test object.")] = None,
    body: Annotated[bool, typer.Option("--body/--no-body", help="Whether PHOTO III is taken.")] = True,
    average: Average = 1,
    checks: Checks = 0,
    retakes: Retakes = 2,
    camera: CameraName = None,
    scanner: ScannerName = None,
    scope: ScopeName = None,
) -> None:
    """Take PHOTO I, II and III of an oscilloscope, and refine them while they come in."""
    from ..capture import plans
    from ..instruments import Camera, Oscilloscope, UltrasonicScanner

    def parameters(found: Bench) -> dict[str, Any]:
        found.one(Camera, camera)
        for kind, name in ((UltrasonicScanner, scanner), (Oscilloscope, scope)):
            if name is not None or found.has(kind):  # the operator does without
                found.one(kind, name)
        how = {"body": body, "average": average, "checks": checks, "retakes": retakes, "park": {}}
        return how | {"camera": camera, "scanner": scanner, "oscilloscope": scope}

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return plans.oscilloscope(run, given["body"], given["average"], given["checks"])

    conduct(where, "oscilloscope", planned, parameters, {"reseau.json": reseau, "object.json": object_})


@app.command()
@in_session()
def scan(
    where: Where,
    count: Annotated[int, typer.Option(min=1, help="Sections.")] = 1,
    scanner: ScannerName = None,
    scope: ScopeName = None,
) -> None:
    """Sweep with the ultrasonic scanner, and keep the sections; beside each an oscilloscope's screen."""
    from ..capture import plans
    from ..instruments import Oscilloscope, UltrasonicScanner

    def parameters(found: Bench) -> dict[str, Any]:
        found.one(UltrasonicScanner, scanner)
        if scope is not None or found.has(Oscilloscope):
            found.one(Oscilloscope, scope)
        return {"count": count, "retakes": 0, "park": {}, "scanner": scanner, "oscilloscope": scope}

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return plans.scan(run, given["count"])

    conduct(where, "scan", planned, parameters)


@app.command()
@in_session()
def frames(
    where: Where,
    count: Annotated[int, typer.Option(min=1, help="Frames.")] = 1,
    average: Average = 1,
    checks: Checks = 0,
    retakes: Retakes = 0,
    camera: CameraName = None,
) -> None:
    """Take frames one after the other."""
    from ..capture import plans
    from ..instruments import Camera

    def parameters(found: Bench) -> dict[str, Any]:
        found.one(Camera, camera)
        how = {"count": count, "average": average, "checks": checks, "retakes": retakes, "park": {}}
        return how | {"camera": camera}

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return plans.frames(run, given["count"], given["average"], given["checks"])

    conduct(where, "frames", planned, parameters)


def _within(axes: Mapping[str, Any], steps: Sequence[Step]) -> None:
    """Refuse poses to which the table cannot go, before it goes to any."""
    for step in steps:
        for axis, value in step.position.items():
            if axis not in axes:
                have = ", ".join(axes)
                raise UsageError(f"the table has no axis {axis}", where=step.name, do=f"it has {have}")
            low, high = axes[axis].limits
            if not low <= value <= high:
                what = f"{axis} {value:g} is not between {low:g} and {high:g} {axes[axis].unit}"
                raise UsageError(what, where=step.name)


def _lifted(steps: Sequence[Step]) -> bool:
    """Whether the board is recorded at several heights."""
    from ..capture import HEIGHT

    return len({step.position.get(HEIGHT, 0.0) for step in steps}) > 1


def _of_model(goal: Goal | None, model: CameraOptions) -> None:
    """Refuse a goal for what is not estimated, or in a unit that it does not have."""
    from ..optics.cameras import unit_of

    if goal is None:
        return
    if goal.parameter not in model.chosen:
        raise UsageError(f"is none of {', '.join(model.chosen)}", where=f"sigma_{goal.parameter}")
    unit = unit_of(goal.parameter, model.model)
    if goal.unit and goal.unit != unit:
        raise UsageError(f"is in {unit or 'no unit'}, not {goal.unit}", where=f"sigma_{goal.parameter}")


def _numbers(text: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise UsageError(f"is {text!r}", where=option, do="write numbers, as 0,50,100") from None


def _position(text: str, option: str) -> dict[str, float]:
    """A position written as ``tilt=0,roll=0``."""
    try:
        pairs = [part.split("=") for part in text.split(",") if part.strip()]
        return {axis.strip(): float(value) for axis, value in pairs}
    except ValueError:
        raise UsageError(f"is {text!r}", where=option, do="write it like tilt=0,roll=0") from None
