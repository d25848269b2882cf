"""`reseau measure`: image coordinates of targets in a frame."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import (
    AsJson,
    Out,
    SensorFile,
    corrected,
    is_points,
    progress,
    read_measurement,
    required,
    say,
    suffix_of,
    writable,
)

if TYPE_CHECKING:
    from ..core.data import Array
    from ..core.failure import Remark
    from ..io import ReseauMeasurement

__all__ = ["app", "measurement_csv"]


class Channel(StrEnum):
    """Channel of a colour image."""

    LUMA = "luma"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"


app = typer.Typer(help="Measure image coordinates of a target.", no_args_is_help=True)


@app.callback()
def _targets() -> None:
    """Measure image coordinates of a target."""


@app.command()
def reseau(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the reseau.")],
    out: Out = None,
    mark_px: Annotated[
        float | None, typer.Option(help="Size of a mark (px); for a grid, the width of its lines.")
    ] = None,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor (px).")] = 0.0,
    channel: Annotated[Channel, typer.Option(help="Channel of a colour image.")] = Channel.LUMA,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the marks of a reseau, or of a sheet of disks with coded rings."""
    from ..io import ReseauDesign
    from ..io.images import read_image
    from ..measure import ReseauOptions, measure_reseau

    suffix = _suffix(out)
    target = ReseauDesign.read(design)
    rms = None
    if is_points(image):
        found = read_measurement(image)
    else:
        frame = corrected(read_image(image, channel.value), sensor)
        options = ReseauOptions(mark_px=mark_px, row_jitter_px=row_jitter)
        with progress(f"measuring {image.name}", 1):
            result = required(measure_reseau(frame, target, options), image)
        found, rms = result.measurement(), result.rms()
    _deliver(image, found, out, suffix, as_json, rms, "marks")


@app.command()
def pins(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the test object's rods.")],
    out: Out = None,
    also: Annotated[
        list[Path] | None,
        typer.Option(help="Other image of the sequence, to reject static spots; repeatable."),
    ] = None,
    max_length_px: Annotated[
        float | None,
        typer.Option(min=1, help="Maximum length of an echo (px). Default: 6 % of the frame diagonal."),
    ] = None,
    max_rotation: Annotated[
        float, typer.Option(help="Maximum rotation of the test object (degrees).")
    ] = 12.0,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the rods of an ultrasonic test object."""
    from ..io import ReseauDesign
    from ..io.images import read_image
    from ..measure import PinOptions, measure_pins

    suffix = _suffix(out)
    target = ReseauDesign.read(design)
    rms = None
    notes: tuple[Remark, ...] = ()
    if is_points(image):
        found = read_measurement(image)
    else:
        frame = corrected(read_image(image), sensor)
        others = [corrected(read_image(path), sensor) for path in also or []]
        options = PinOptions(most_length_px=max_length_px, max_rotation_deg=max_rotation)
        with progress(f"measuring {image.name}", 1):
            result = required(measure_pins(frame, target, options, others), image)
        found, rms, notes = result.measurement(), result.rms(), result.notes
    _deliver(image, found, out, suffix, as_json, rms, "rods", notes)


@app.command("testfield")
def coded_field(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the testfield.")],
    out: Out = None,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor (px).")] = 0.0,
    fill: Annotated[
        float, typer.Option(min=0, max=1, help="Light-sensitive fraction of the pixel pitch.")
    ] = 1.0,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the targets of a coded testfield."""
    from ..io import TestfieldDesign
    from ..io.images import read_image
    from ..measure import TestfieldOptions, measure_testfield

    suffix = _suffix(out)
    target = TestfieldDesign.read(design)
    rms = None
    if is_points(image):
        found = read_measurement(image)
    else:
        frame = corrected(read_image(image), sensor)
        with progress(f"measuring {image.name}", 1):
            options = TestfieldOptions(row_jitter_px=row_jitter, fill=fill)
            result = required(measure_testfield(frame, target, options), image)
        found, rms = result.measurement(), result.rms()
    _deliver(
        image, found, out, suffix, as_json, rms, "targets", spread="deviations from the mapping of the field"
    )


def _suffix(out: Path | None) -> str:
    """Format of the output file, determined before measuring."""
    return ".json" if out is None else suffix_of(writable(out), (".json", ".csv"))


def _deliver(
    image: Path,
    found: ReseauMeasurement,
    out: Path | None,
    suffix: str,
    as_json: bool,
    rms: Array | None,
    marks: str,
    notes: tuple[Remark, ...] = (),
    spread: str = "leave-one-out deviations",
) -> None:
    """Write the measurement to its file, and report what was measured."""
    from ..io import write_whole

    if out is not None:
        write_whole(out, measurement_csv(found) if suffix == ".csv" else found.to_json())
    if as_json:
        say(found.to_json())
        return
    say(f"{image.name}: {found.found} of {found.expected} {marks} measured\n")
    if rms is not None and rms[0] == rms[0]:  # NaN if too few points were measured
        say(f"{spread} {rms[0]:.2g} px in x, {rms[1]:.2g} px in y (rms)\n")
    for point in found.points:
        if not point.ok:
            say(f"  {point.id}: {point.why}\n")
    for note in notes:
        say(f"note: {note}\n")


def measurement_csv(found: ReseauMeasurement) -> str:
    """Measured marks as CSV ``id,x,y,sx,sy``."""
    points = found.image_points()
    lines = ["id,x,y,sx,sy"]
    for name, (x, y), (sx, sy) in zip(points.names, points.xy, points.sigma, strict=True):
        lines.append(f"{name},{x:.6f},{y:.6f},{sx:.3e},{sy:.3e}")
    return "\n".join(lines) + "\n"
