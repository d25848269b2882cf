"""`reseau capture`: acquisitions on a bench into an archive; they can be resumed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import UsageError
from .acquisition import CameraName, Where, conduct, in_session

if TYPE_CHECKING:
    from ..capture import Bench
    from ..sessions import BlurredParameters, TestfieldParameters

__all__ = ["app"]

app = typer.Typer(
    no_args_is_help=True,
    help="Acquire frames on a bench. Each frame is archived before the next exposure.",
)

Average = Annotated[int, typer.Option(min=1, help="Number of exposures averaged to one frame.")]
Checks = Annotated[
    int, typer.Option(min=0, help="Number of frames for the checks before the acquisition; 0: no checks.")
]
Retakes = Annotated[int, typer.Option(min=0, help="Number of additional attempts after a bad frame.")]
HeightSigma = Annotated[
    float, typer.Option(min=1e-9, help="Standard deviation of a height (mm); used with --heights.")
]
AxisSigma = Annotated[
    float,
    typer.Option(min=1e-6, help="Standard deviation of the angle between z and the board normal (mrad)."),
]
FieldSigma = Annotated[
    float, typer.Option(min=1e-9, help="Standard deviation of design coordinates (mm); used with --heights.")
]
Pitch = Annotated[float | None, typer.Option(min=1e-6, help="Pixel size (mm); selects Brown's model.")]
Poses = Annotated[
    Path | None,
    typer.Option(help="CSV of poses, one column for each axis. Default: the 36 poses of the paper."),
]
TableName = Annotated[str | None, typer.Option("--table", help="Turntable to use, if there are several.")]
RecordedTable = Annotated[
    str | None, typer.Option("--table", help="Turntable whose positions are recorded with each frame.")
]
ScannerName = Annotated[str | None, typer.Option("--scanner", help="Scanner to use, if there are several.")]
ScopeName = Annotated[
    str | None, typer.Option("--oscilloscope", help="Oscilloscope to use, if there are several.")
]


@app.command("testfield")
@in_session()
def coded_field(
    where: Where,
    design: Annotated[
        Path | None, typer.Option("--design", "-d", help="Design of the testfield or sheet.")
    ] = None,
    poses: Poses = None,
    heights: Annotated[
        str, typer.Option(help="Heights of the board (mm), as 0,50,100; record each pose at each height.")
    ] = "",
    height_sigma: HeightSigma = 0.01,
    axis_sigma: AxisSigma = 10.0,
    field_sigma: FieldSigma = 0.05,
    until: Annotated[
        str, typer.Option(help="Choose poses until a goal is reached, as 'sigma_c < 0.5 um'.")
    ] = "",
    first: Annotated[
        int, typer.Option(min=4, help="With --until: number of poses before the first chosen one.")
    ] = 5,
    pitch: Pitch = None,
    free: Annotated[str, typer.Option(help="Parameters to estimate, as c,x0,y0,K1.")] = "",
    row_jitter: Annotated[float, typer.Option(min=0, help="Row jitter of the sensor (px).")] = 0.0,
    fill: Annotated[
        float, typer.Option(min=0, max=1, help="Light-sensitive fraction of the pixel pitch.")
    ] = 1.0,
    average: Average = 1,
    checks: Checks = 3,
    retakes: Retakes = 2,
    park: Annotated[
        str, typer.Option(help="Final position of the table, as tilt=0,roll=0. Default: the last pose.")
    ] = "",
    retreat: Annotated[
        str, typer.Option(help="Position after an abort or an error. Default: no movement.")
    ] = "",
    camera: CameraName = None,
    table: TableName = None,
) -> None:
    """Record a testfield from many poses, and calibrate the camera during the acquisition."""
    final, away = _position(park, "--park"), _position(retreat, "--retreat")
    levels = _numbers(heights, "--heights")

    def parameters(bench: Bench) -> TestfieldParameters:
        from ..capture import Goal, at_heights, paper_steps, read_steps
        from ..instruments import Turntable
        from ..sessions import TestfieldParameters

        if until:
            Goal.parse(until)
        axes = bench.one(Turntable, table).axes
        steps = at_heights(paper_steps(axes=tuple(axes)) if poses is None else read_steps(poses), levels)
        lifted = TestfieldParameters.lifted(steps)
        return TestfieldParameters(
            steps=tuple((step.name, dict(step.position)) for step in steps), until=until, first=first,
            pitch=pitch, free=tuple(each.strip() for each in free.split(",") if each.strip()),
            sigmas=(height_sigma, axis_sigma / 1e3, field_sigma) if lifted else None,
            row_jitter=row_jitter, fill=fill, average=average, checks=checks, retakes=retakes,
            park=final, retreat=away, camera=camera, table=table,
        )  # fmt: skip

    conduct(where, "testfield", parameters, {"design.json": design})


@app.command()
@in_session()
def blurred(
    where: Where,
    network: Annotated[
        Path | None,
        typer.Option("--network", "-n", help="reseau-network/1 whose images are named as the poses."),
    ] = None,
    targets: Annotated[
        Path | None, typer.Option("--targets", "-t", help="Targets, reseau-targets/1.")
    ] = None,
    lens: Annotated[Path | None, typer.Option("--lens", "-l", help="Lens with its sensor, lens/1.")] = None,
    poses: Poses = None,
    psf: Annotated[
        float, typer.Option(min=0.1, help="Blur of sensor and diffraction beside that of the rays (px).")
    ] = 0.5,
    search: Annotated[
        float, typer.Option(min=1.0, help="Largest distance from the predicted position (px).")
    ] = 6.0,
    rounds: Annotated[int, typer.Option(min=1, help="Largest number of rounds.")] = 6,
    average: Average = 1,
    checks: Checks = 3,
    retakes: Retakes = 2,
    camera: CameraName = None,
    table: TableName = None,
) -> None:
    """Record targets on a frame from all poses, measure them by rays, and adjust the network."""

    def parameters(bench: Bench) -> BlurredParameters:
        from ..capture import read_steps
        from ..sessions import BlurredParameters

        if poses is None:
            raise UsageError("is missing", where="--poses", do="give a CSV with the images of the network")
        return BlurredParameters(
            steps=tuple((step.name, dict(step.position)) for step in read_steps(poses)), psf=psf,
            search=search, rounds=rounds, average=average, checks=checks, retakes=retakes,
            camera=camera, table=table,
        )  # fmt: skip

    inputs = {"network.json": network, "targets.json": targets, "lens.toml": lens}
    conduct(where, "blurred", parameters, inputs)


@app.command()
@in_session()
def oscilloscope(
    where: Where,
    reseau: Annotated[Path | None, typer.Option("--reseau", "-r", help="Design of the reseau.")] = None,
    object_: Annotated[Path | None, typer.Option("--object", help="Design of the test object.")] = None,
    body: Annotated[bool, typer.Option("--body/--no-body", help="Take PHOTO III.")] = True,
    average: Average = 1,
    checks: Checks = 0,
    retakes: Retakes = 2,
    camera: CameraName = None,
    scanner: ScannerName = None,
    scope: ScopeName = None,
) -> None:
    """Take PHOTO I, II and III of an oscilloscope, and correct them during the acquisition."""
    how: dict[str, Any] = {"body": body, "average": average, "checks": checks, "retakes": retakes, "park": {}}
    how |= {"camera": camera, "scanner": scanner, "oscilloscope": scope}
    inputs = {"reseau.json": reseau, "object.json": object_}
    conduct(where, "oscilloscope", lambda bench: how, inputs)


@app.command()
@in_session()
def scan(
    where: Where,
    count: Annotated[int, typer.Option(min=1, help="Number of sections.")] = 1,
    scanner: ScannerName = None,
    scope: ScopeName = None,
) -> None:
    """Take sections with the ultrasonic scanner, and screenshots if there is an oscilloscope."""
    how = {"count": count, "retakes": 0, "park": {}, "scanner": scanner, "oscilloscope": scope}
    conduct(where, "scan", lambda bench: how)


@app.command()
@in_session()
def frames(
    where: Where,
    count: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 1,
    average: Average = 1,
    checks: Checks = 0,
    retakes: Retakes = 0,
    camera: CameraName = None,
    table: RecordedTable = None,
) -> None:
    """Take frames with a camera."""
    how: dict[str, Any] = {"count": count, "average": average, "checks": checks, "retakes": retakes}
    how |= {"park": {}, "camera": camera} | ({} if table is None else {"table": table})
    conduct(where, "frames", lambda bench: how)


def _numbers(text: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise UsageError(
            f"cannot interpret {text!r}", where=option, do="write numbers, as 0,50,100"
        ) from None


def _position(text: str, option: str) -> dict[str, float]:
    """Parse a position such as ``tilt=0,roll=0``."""
    try:
        pairs = [part.split("=") for part in text.split(",") if part.strip()]
        return {axis.strip(): float(value) for axis, value in pairs}
    except ValueError:
        raise UsageError(
            f"cannot interpret {text!r}", where=option, do="write axis=value, as tilt=0,roll=0"
        ) from None
