"""`reseau measure`: image coordinates of targets in a frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import (
    AsJson,
    Channel,
    MaxRotation,
    Mirrored,
    Out,
    Overlay,
    SensorFile,
    orientation,
    overlay_files,
    progress,
    read_frame,
    required,
    say,
    suffix_of,
    writable,
)

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..core.failure import Failure
    from ..io import ReseauMeasurement
    from ..measure.points import Measured

__all__ = ["Task", "app", "measurement_csv"]


app = typer.Typer(help="Measure image coordinates of a target.", no_args_is_help=True)


@app.callback()
def _targets() -> None:
    """Measure image coordinates of a target."""


@app.command()
def reseau(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the reseau.")],
    out: Out = None,
    overlay: Overlay = None,
    mark_px: Annotated[
        float | None, typer.Option(help="Size of a mark (px); for a grid, the width of its lines.")
    ] = None,
    mirrored: Mirrored = None,
    max_rotation: MaxRotation = None,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor (px).")] = 0.0,
    channel: Annotated[Channel, typer.Option(help="Channel of a colour image.")] = Channel.LUMA,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the marks of a reseau, or of a sheet of disks with coded rings."""
    from ..io import ReseauDesign
    from ..measure import ReseauOptions, measure_reseau

    task = Task(image, out, overlay, as_json, "marks")
    target = ReseauDesign.read(design)
    options = ReseauOptions(
        mark_px=mark_px,
        row_jitter_px=row_jitter,
        **orientation(mirrored, max_rotation),
    )
    task.run(
        lambda: read_frame(image, channel.value, sensor),
        lambda frame: measure_reseau(frame, target, options),
    )


@app.command()
def pins(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the test object's rods.")],
    out: Out = None,
    overlay: Overlay = None,
    also: Annotated[
        list[Path] | None,
        typer.Option(help="Other image of the sequence, to reject static spots; repeatable."),
    ] = None,
    max_length_px: Annotated[
        float | None,
        typer.Option(min=1, help="Maximum length of an echo (px). Default: 6 % of the frame diagonal."),
    ] = None,
    mirrored: Mirrored = None,
    max_rotation: MaxRotation = None,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the rods of an ultrasonic test object, or the wires of an N-wire phantom."""
    from ..io import ReseauDesign
    from ..measure import PinOptions, measure_pins

    task = Task(image, out, overlay, as_json, "rods")
    target = ReseauDesign.read(design)
    options = PinOptions(most_length_px=max_length_px, **orientation(mirrored, max_rotation))
    task.run(
        lambda: read_frame(image, sensor=sensor),
        lambda frame: measure_pins(
            frame, target, options, [read_frame(path, sensor=sensor) for path in also or []]
        ),
    )


@app.command("testfield")
def coded_field(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the testfield.")],
    out: Out = None,
    overlay: Overlay = None,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor (px).")] = 0.0,
    fill: Annotated[
        float, typer.Option(min=0, max=1, help="Light-sensitive fraction of the pixel pitch.")
    ] = 1.0,
    mirrored: Annotated[
        bool, typer.Option("--mirrored", help="The image shows the testfield from behind, or in a mirror.")
    ] = False,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the targets of a coded testfield."""
    from ..io import TestfieldDesign
    from ..measure import TestfieldOptions, measure_testfield

    task = Task(image, out, overlay, as_json, "targets", "deviations from the mapping of the field")
    target = TestfieldDesign.read(design)
    if mirrored:
        target = target.from_behind()
    options = TestfieldOptions(row_jitter_px=row_jitter, fill=fill)
    task.run(
        lambda: read_frame(image, sensor=sensor),
        lambda frame: measure_testfield(frame, target, options),
    )


@app.command()
def board(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the board.")],
    out: Out = None,
    overlay: Overlay = None,
    mirrored: Annotated[
        bool, typer.Option("--mirrored", help="The image shows the board from behind, or is mirrored.")
    ] = False,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor (px).")] = 0.0,
    fill: Annotated[float, typer.Option(min=0, max=1, help="Light-sensitive fraction of a pixel.")] = 1.0,
    channel: Annotated[Channel, typer.Option(help="Channel of a colour image.")] = Channel.LUMA,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure a chessboard, PuzzleBoard, deltille, ChArUco board, circle grid or grid of tags."""
    from ..exchange import read_board
    from ..measure import BoardOptions, measure_board

    task = Task(image, out, overlay, as_json, "points")
    target = read_board(design)
    options = BoardOptions(mirrored=mirrored, row_jitter_px=row_jitter, fill=fill)
    task.run(
        lambda: read_frame(image, channel.value, sensor),
        lambda frame: measure_board(frame, target, options),
    )


@app.command()
def tags(
    image: Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")],
    dictionary: Annotated[
        str, typer.Option(help="Markers, as OpenCV's DICT_4X4_50 or DICT_APRILTAG_36h11.")
    ] = "DICT_APRILTAG_36h11",
    border_bits: Annotated[int, typer.Option(min=1, max=4, help="Width of their borders (bits).")] = 1,
    out: Out = None,
    overlay: Overlay = None,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor (px).")] = 0.0,
    fill: Annotated[float, typer.Option(min=0, max=1, help="Light-sensitive fraction of a pixel.")] = 1.0,
    channel: Annotated[Channel, typer.Option(help="Channel of a colour image.")] = Channel.LUMA,
    sensor: SensorFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the corners of single ArUco markers or AprilTags, wherever they are in the scene."""
    from ..designs.boards import marker_dictionary
    from ..measure import BoardOptions, measure_tags

    task = Task(image, out, overlay, as_json, "points")
    marker_dictionary(dictionary)
    options = BoardOptions(row_jitter_px=row_jitter, fill=fill)
    task.run(
        lambda: read_frame(image, channel.value, sensor),
        lambda frame: measure_tags(frame, dictionary, border_bits, options),
    )


class Task:
    """Measure one image, or read its coordinates; write and report what was found.

    The names of the outputs are checked first, before anything is computed.
    """

    def __init__(
        self,
        image: Path,
        out: Path | None,
        overlay: Path | None,
        as_json: bool,
        marks: str,
        spread: str = "leave-one-out deviations",
    ) -> None:
        self.image, self.out, self.as_json, self.marks, self.spread = image, out, as_json, marks, spread
        self.suffix = ".json" if out is None else suffix_of(writable(out), (".json", ".csv"))
        self.overlay = overlay_files(overlay, [image])[image] if overlay is not None else None

    def run(self, read: Callable[[], Frame], measure: Callable[[Frame], Any]) -> None:
        """Measure the image and deliver the result."""
        from ..io import is_points, read_measurement

        if is_points(self.image):
            self._deliver(read_measurement(self.image), None)
            return
        frame = read()
        with progress(f"measuring {self.image.name}", 1):
            result: Measured | Failure = measure(frame)
        if self.overlay is not None:
            result.overlay(frame, self.overlay)
        found = required(result, self.image)
        self._deliver(found.measurement(), found)

    def _deliver(self, document: ReseauMeasurement, result: Measured | None) -> None:
        """Write the measurement to its file, and report what was measured."""
        from ..core.numbers import measured
        from ..io import write_whole

        if self.out is not None:
            write_whole(self.out, measurement_csv(document) if self.suffix == ".csv" else document.to_json())
        if self.as_json:
            say(document.to_json())
            return
        say(f"{self.image.name}: {document.found} of {document.expected} {self.marks} measured\n")
        if result is not None:
            rms = result.rms()
            if rms[0] == rms[0]:  # NaN if too few points were measured
                say(f"{self.spread} {rms[0]:.2g} px in x, {rms[1]:.2g} px in y (rms)\n")
        for point in document.points:
            if not point.ok:
                say(f"  {point.id}: {point.why}\n")
            elif point.share is not None and point.s_share is not None:
                say(f"  {point.id}: cut at {measured(point.share, point.s_share)} of its segment\n")
        for note in document.notes:
            say(f"note: {note}\n")


def measurement_csv(found: ReseauMeasurement) -> str:
    """Measured marks as CSV ``id,x,y,sx,sy``."""
    points = found.image_points()
    lines = ["id,x,y,sx,sy"]
    for name, (x, y), (sx, sy) in zip(points.names, points.xy, points.sigma, strict=True):
        lines.append(f"{name},{x:.6f},{y:.6f},{sx:.3e},{sy:.3e}")
    return "\n".join(lines) + "\n"
