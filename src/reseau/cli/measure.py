"""`reseau measure`: image coordinates of targets in a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Option
from .common import Reading, orientation, overlay_files, progress, required, say
from .declared import Commands

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..core.failure import Failure
    from ..io import Document, ReseauMeasurement
    from ..measure.points import Measured


BY_DESIGN = "Default: determined by the design if it is not symmetric. Not used with nominal positions."
NOT_NOMINAL = "Not used with nominal positions."
_NAMED = 8
"""Marks that are printed of those that were not measured for one reason."""

D = TypeVar("D", bound="Document")
app = Commands(help="Measure image coordinates of a target.")

Image = Annotated[Path, typer.Argument(help="Image, or measured coordinates (JSON, CSV).")]


@dataclass(frozen=True)
class Output:
    """What a measurement writes."""

    out: v.Out | None = None
    overlay: v.Overlay | None = None
    as_json: v.AsJson = False

    def drawn(self, image: Path) -> Path | None:
        """Return the overlay of the image, if one is wanted; names of files are checked."""
        writable(self.out, ".json", ".csv")
        return None if self.overlay is None else overlay_files(self.overlay, [image])[image]

    def deliver(self, document: D, csv: Callable[[D], str], text: Callable[[D], str]) -> None:
        """Write a document to its file, and print it as JSON or as text."""
        from ..io import write_whole

        if self.out is not None:
            as_csv = self.out.suffix.lower() == ".csv"
            write_whole(self.out, csv(document) if as_csv else document.to_json())
        say(document.to_json() if self.as_json else text(document))


@app.callback()
def _targets() -> None:
    """Measure image coordinates of a target."""


@app.command()
def reseau(
    image: Image,
    design: v.Design,
    reading: Reading,
    output: Output,
    mark_px: Annotated[v.MarkPx | None, "For a grid, the width of its lines."] = None,
    mirrored: Annotated[v.Mirrored | None, BY_DESIGN] = None,
    max_rotation_deg: Annotated[v.MaxRotationDeg | None, NOT_NOMINAL] = None,
    row_jitter_px: v.RowJitterPx = 0.0,
    fill: v.Fill = 1.0,
) -> None:
    """Measure the marks of a reseau, or of a sheet of disks with coded rings."""
    from ..io import ReseauDesign
    from ..measure import measure_reseau
    from ..measure.reseau.marks import ReseauOptions

    task = Task(image, output, "marks")
    target = ReseauDesign.read(design)
    options = ReseauOptions(
        mark_px=mark_px, row_jitter_px=row_jitter_px, fill=fill, **orientation(mirrored, max_rotation_deg)
    )
    task.run(reading, lambda frame: measure_reseau(frame, target, options))


@app.command()
def pins(
    image: Image,
    design: v.Design,
    reading: Reading,
    output: Output,
    also: Annotated[
        list[Path] | None,
        Option("Other image of the sequence, to reject static spots; repeatable."),
    ] = None,
    max_length_px: Annotated[
        float | None,
        Option("Largest length of an echo (px). Default: 6 % of the frame diagonal.", least=1),
    ] = None,
    mirrored: Annotated[v.Mirrored | None, BY_DESIGN] = None,
    max_rotation_deg: Annotated[v.MaxRotationDeg | None, NOT_NOMINAL] = None,
) -> None:
    """Measure the rods of an ultrasonic test object, or the wires of an N-wire phantom."""
    from ..io import ReseauDesign
    from ..measure import measure_pins
    from ..measure.pins.detection import PinOptions

    task = Task(image, output, "rods")
    target = ReseauDesign.read(design)
    options = PinOptions(max_length_px=max_length_px, **orientation(mirrored, max_rotation_deg))
    task.run(
        reading,
        lambda frame: measure_pins(frame, target, options, [reading.frame(path) for path in also or []]),
    )


@app.command("testfield")
def coded_field(
    image: Image,
    design: v.Design,
    reading: Reading,
    output: Output,
    mirrored: v.Mirrored = False,
    row_jitter_px: v.RowJitterPx = 0.0,
    fill: v.Fill = 1.0,
) -> None:
    """Measure the targets of a coded testfield."""
    from ..io import TestfieldDesign
    from ..measure import measure_testfield
    from ..measure.testfield.measure import TestfieldOptions

    task = Task(image, output, "targets", "deviations from the mapping of the field")
    target = TestfieldDesign.read(design)
    if mirrored:
        target = target.from_behind()
    options = TestfieldOptions(row_jitter_px=row_jitter_px, fill=fill)
    task.run(reading, lambda frame: measure_testfield(frame, target, options))


@app.command()
def board(
    image: Image,
    design: v.Design,
    reading: Reading,
    output: Output,
    mirrored: v.Mirrored = False,
    row_jitter_px: v.RowJitterPx = 0.0,
    fill: v.Fill = 1.0,
) -> None:
    """Measure a chessboard, PuzzleBoard, deltille, ChArUco board, circle grid or grid of tags."""
    from ..exchange.boards import read_board
    from ..measure import measure_board
    from ..measure.boards.measure import BoardOptions
    from ..procedures.which_target import measured_or_shown

    task = Task(image, output, "points")
    target = read_board(design)
    options = BoardOptions(mirrored=mirrored, row_jitter_px=row_jitter_px, fill=fill)
    task.run(
        reading,
        lambda frame: measured_or_shown(frame, target, lambda each: measure_board(each, target, options)),
    )


@app.command()
def tags(
    image: Image,
    reading: Reading,
    output: Output,
    dictionary: v.Dictionary = "DICT_APRILTAG_36h11",
    border_bits: v.BorderBits = 1,
    row_jitter_px: v.RowJitterPx = 0.0,
    fill: v.Fill = 1.0,
) -> None:
    """Measure the corners of single ArUco markers or AprilTags, wherever they are in the scene."""
    from ..designs.boards import marker_dictionary
    from ..measure.boards.measure import BoardOptions
    from ..measure.boards.single_tags import measure_tags

    task = Task(image, output, "points")
    marker_dictionary(dictionary)
    options = BoardOptions(row_jitter_px=row_jitter_px, fill=fill)
    task.run(reading, lambda frame: measure_tags(frame, dictionary, border_bits, options))


class Task:
    """Measure one image, or read its coordinates; write and report what was found.

    The names of the outputs are checked first, before anything is computed.
    """

    def __init__(
        self, image: Path, output: Output, marks: str, spread: str = "leave-one-out deviations"
    ) -> None:
        self.image, self.output, self.marks, self.spread = image, output, marks, spread
        self.overlay = output.drawn(image)

    def run(self, reading: Reading, measure: Callable[[Frame], Any]) -> None:
        """Measure the image and deliver the result."""
        from ..io.reading import is_points, read_measurement

        if is_points(self.image):
            self._deliver(read_measurement(self.image), None)
            return
        frame = reading.frame(self.image)
        with progress(f"measuring {self.image.name}", 1):
            result: Measured | Failure = measure(frame)
        if self.overlay is not None:
            result.overlay(frame, self.overlay)
        found = required(result, self.image)
        self._deliver(found.measurement(), found)

    def _deliver(self, document: ReseauMeasurement, result: Measured | None) -> None:
        """Write the measurement to its file, and report what was measured."""
        self.output.deliver(
            document,
            lambda found: found.image_points().to_csv(".6f"),
            lambda found: self._text(found, result),
        )

    def _text(self, document: ReseauMeasurement, result: Measured | None) -> str:
        from ..core.numbers import measured
        from ..procedures.target_measurement import by_reason, few_of

        lines = [f"{self.image.name}: {document.found} of {document.expected} {self.marks} measured"]
        if result is not None:
            rms = result.rms()
            if rms[0] == rms[0]:  # NaN if too few points were measured
                lines.append(f"{self.spread} {rms[0]:.2g} px in x, {rms[1]:.2g} px in y (rms)")
        for why, names in by_reason({each.id: each.why for each in document.points if not each.ok}).items():
            lines.append(f"  {few_of(names, _NAMED)}: {why}")
        for point in document.points:
            if point.share is not None and point.s_share is not None:
                lines.append(f"  {point.id}: cut at {measured(point.share, point.s_share)} of its segment")
        return "\n".join([*lines, *(f"note: {note}" for note in document.notes)]) + "\n"
