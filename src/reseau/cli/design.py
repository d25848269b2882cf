"""`reseau design`: draw a target for printing in true size, and write its coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Option
from .common import overlay_files, progress, required, say, say_notes
from .declared import Commands

if TYPE_CHECKING:
    from ..designs.drawing import Drawable
    from ..io import BoardDesign, FiducialDesign, ReseauDesign, TestfieldDesign


app = Commands(help="Draw a target for printing in true size, and write its coordinates.")


@dataclass(frozen=True)
class Drawn:
    """What a design is written to."""

    out: Annotated[v.Out | None, "Here the design, JSON; - for standard output."] = None


@dataclass(frozen=True)
class Printed(Drawn):
    """The same, with drawings."""

    svg: v.Svg | None = None
    pdf: v.Pdf | None = None
    paper: v.Paper = "A4"


FITTED = "Default: fills the --paper."


@app.callback()
def _targets() -> None:
    """Draw a target for printing in true size, and write its coordinates."""


@app.command()
def reseau(
    printed: Printed,
    columns: v.Columns = 15,
    rows: v.Rows = 11,
    pitch: v.Pitch = 10.0,
    shape: v.Shape = "line-grid",
    size: Annotated[v.Size | None, "Not used for a line grid. Default: a fraction of --pitch."] = None,
    line_width: v.LineWidth = 0.3,
    polarity: v.Polarity = "dark",
    origin: Annotated[str | None, Option("Mark O, the origin of the common system.")] = None,
    axis: Annotated[str | None, Option("Mark S, on the x-axis of the common system.")] = None,
    name: v.Name = "reseau",
) -> None:
    """Design a reseau: a regular grid of marks."""
    from ..designs import regular_reseau
    from ..io import Mark

    lined = shape in ("line-grid", "cross")
    diameter = None if shape == "line-grid" else size or (pitch / 3 if shape == "cross" else pitch / 5)
    design = regular_reseau(
        columns,
        rows,
        pitch,
        Mark(shape=shape, size=diameter, line_width=line_width if lined else None),
        name=name,
        polarity=polarity,
        origin=origin,
        axis=axis,
    )
    _write(design, printed, f"{columns} × {rows} marks, pitch {pitch:g} mm")


@app.command()
def sheet(
    printed: Printed,
    columns: v.Columns = 10,
    rows: v.Rows = 13,
    pitch: Annotated[v.Pitch | None, FITTED] = None,
    size: Annotated[v.Size | None, "Default: 0.22 times --pitch."] = None,
    polarity: v.Polarity = "dark",
    name: v.Name = "sheet",
) -> None:
    """Design a sheet of disks, four of them in coded rings that identify all disks."""
    from ..designs import coded_sheet

    def of(pitch: float, size: float | None = None) -> ReseauDesign:
        return coded_sheet(columns, rows, pitch, size=size, name=name, polarity=polarity)

    pitch = _filling(of, printed.paper) if pitch is None else pitch
    design = of(pitch, size)
    _write(design, printed, f"{columns} × {rows} disks, pitch {pitch:g} mm")


@app.command("n-wires")
def n_wires(
    drawn: Drawn,
    layers: Annotated[int, Option("Number of layers, each with one N.")] = 3,
    width: Annotated[float, Option("Distance of the parallel wires of a layer (mm).")] = 40.0,
    spacing: Annotated[float, Option("Distance of the layers (mm).")] = 15.0,
    name: v.Name = "n-wires",
) -> None:
    """Design an N-wire phantom: coordinates of parallel and slanted wires, to be edited to one's own."""
    from ..designs import n_wire_phantom

    design = n_wire_phantom(layers, width, spacing, name=name)
    _write(design, drawn, f"{layers} layers of {width:g} mm, {spacing:g} mm apart")


@app.command()
def fiducials(
    camera: Annotated[
        str | None,
        typer.Argument(
            metavar="CAMERA",
            help="Name of a camera, a fiducial-design/1, or a CSV id,x,y[,sigma][,mark][,turn_deg] of its "
            "calibrated coordinates (mm) with --learn; by default the names of cameras are listed.",
        ),
    ] = None,
    out: Annotated[v.Out | None, "Here the design, JSON; - for standard output."] = None,
    learn: Annotated[Path | None, Option("Scan from which marks are learnt, each kind from one.")] = None,
    mark_at: Annotated[
        list[str] | None,
        Option("Mark that is learnt, and its place in the scan (px); repeatable.", value="ID=X,Y"),
    ] = None,
    mark_px: Annotated[v.MarkPx | None, "Here the diameter with even surroundings."] = None,
    overlay: v.Overlay | None = None,
) -> None:
    """Write the fiducial marks of an aerial camera, to be edited to its report, or learnt from a scan."""
    from ..core.errors import UsageError
    from ..designs import aerial_camera, aerial_cameras
    from ..io import FiducialDesign

    if camera is None:
        if out is not None:
            raise UsageError("needs the NAME of a camera", where="--out", do="without --out all are listed")
        for each, design in aerial_cameras().items():
            say(f"{each:18} {design.name}\n")
        return
    path = Path(camera)
    if learn is None and (mark_at or mark_px or overlay):
        raise UsageError("is needed by --mark-at, --mark-px and --overlay", where="--learn")
    if path.suffix.lower() == ".csv":
        if learn is None:
            raise UsageError("a table has no marks", where=camera, do="give --learn and --mark-at")
        design = FiducialDesign.read_csv(path, [place.partition("=")[0] for place in mark_at or []])
    else:
        design = FiducialDesign.read(path) if path.suffix else aerial_camera(camera)
    if learn is not None:
        design = _learnt(design, learn, mark_at or [], mark_px, overlay, every=path.suffix.lower() == ".csv")
    if out is None or str(out) == "-":
        say(design.to_json())
    else:
        writable(out, ".json")
        design.write(out)
        source = "" if design.source is None else f"; {design.source}"
        say(f"{out}: {design.name}, {len(design.points)} marks{source}\n")


def _learnt(
    design: FiducialDesign,
    scan: Path,
    at: list[str],
    mark_px: float | None,
    overlay: Path | None,
    every: bool,
) -> FiducialDesign:
    """The design with marks from a scan."""
    from ..core.errors import UsageError
    from ..io.images import open_scan
    from ..measure.fiducials import learn_marks

    if not at or mark_px is None:
        raise UsageError("needs --mark-at and --mark-px", where="--learn")
    places = {}
    for place in at:
        name, _, xy = place.partition("=")
        try:
            x, y = map(float, xy.split(","))
        except ValueError:
            raise UsageError(f"is {place!r}, not ID=X,Y", where="--mark-at") from None
        places[name] = (x, y)
    drawn = None if overlay is None else overlay_files(overlay, [scan])[scan]
    opened = open_scan(scan)
    with progress(f"learning marks from {scan.name}", 1):
        found = required(learn_marks(opened, design, places, mark_px), scan)
    kinds = {point.mark for point in design.points}
    if every and (rest := sorted(kinds - set(found.folds))):
        raise UsageError(f"no mark of the kind {', '.join(rest)} is given", where="--mark-at")
    if drawn is not None:
        found.overlay(opened.picture(), drawn)
    for line in found.lines():
        say(f"{scan.name}: {line}\n")
    return found.design


@app.command("testfield")
def coded_field(
    printed: Printed,
    columns: v.Columns = 8,
    rows: v.Rows = 8,
    pitch: Annotated[v.Pitch | None, "Here between the lines; the paper's is 125.", FITTED] = None,
    line_width: Annotated[v.LineWidth | None, "Default: 2/125 of --pitch."] = None,
    small: Annotated[
        tuple[float, float, float, float] | None,
        Option(
            "Sizes of small squares, triangles, crosses and circles (mm). Default: 9,13,15,12 at a pitch of "
            "125 mm."
        ),
    ] = None,
    large: Annotated[
        tuple[float, float, float, float] | None,
        Option(
            "Sizes of large squares, triangles, crosses and circles (mm). Default: 17,25,25,22 at a pitch of "
            "125 mm."
        ),
    ] = None,
    spread: Annotated[
        float | None, Option("Distance between targets in a square (mm). Default: 0.24 × --pitch.")
    ] = None,
    turn_seed: Annotated[int | None, Option("Rotate each target by an angle drawn from this seed.")] = None,
    polarity: v.Polarity = "dark",
    name: v.Name = "testfield",
) -> None:
    """Design a coded testfield: squares of sixteen targets, coded by their arrangement."""
    from ..designs import coded_testfield

    given: dict[str, Any] = {"line_width": line_width, "small": small, "large": large, "spread": spread}

    def of(pitch: float, **sizes: Any) -> TestfieldDesign:
        return coded_testfield(
            columns, rows, pitch, turn_seed=turn_seed, polarity=polarity, name=name, **sizes
        )

    pitch = _filling(of, printed.paper) if pitch is None else pitch
    design = of(pitch, **{key: value for key, value in given.items() if value is not None})
    _write(design, printed, f"{columns} × {rows} squares, pitch {pitch:g} mm")


@app.command()
def frame(
    printed: Printed,
    sides: Annotated[tuple[float, float, float], Option("Sides of the frame along X, Y and Z (mm).")] = (
        1200.0,
        900.0,
        400.0,
    ),
    number: v.Number = 28,
    size: v.Size = 20.0,
    shape: Annotated[v.Shape, "Here disk or square."] = "disk",
    polarity: v.Polarity = "dark",
    name: v.Name = "frame",
) -> None:
    """Design the targets of a space frame, to be cut out and fixed to it; for `reseau blurred`."""
    from ..core.errors import UsageError
    from ..designs import space_frame

    if shape not in ("disk", "square"):
        raise UsageError(f"is {shape!r}", where="--shape", do="use disk or square")
    design = space_frame(sides, number, size, shape=shape, polarity=polarity, name=name)
    _write(design, printed, f"{number} targets of {size:g} mm")


@app.command()
def board(
    printed: Printed,
    kind: Annotated[
        Literal["chess", "puzzle", "deltille", "charuco", "circles", "aprilgrid", "markers"],
        Option("Pattern of the board."),
    ] = "charuco",
    columns: v.Columns = 7,
    rows: v.Rows = 10,
    pitch: Annotated[
        v.Pitch | None, "Side of a square, distance of rows of circles, or of tags.", FITTED
    ] = None,
    size: Annotated[v.Size | None, "Diameter of a circle, or side of a marker or tag."] = None,
    dictionary: v.Dictionary | None = None,
    first_id: Annotated[int, Option("Number of the first marker.", least=0)] = 0,
    border_bits: v.BorderBits = 1,
    legacy: Annotated[bool, Option("ChArUco layout of OpenCV before 4.6.")] = False,
    polarity: Annotated[v.Polarity, "Of circles."] = "dark",
    asymmetric: Annotated[bool, Option("Shift every second row of circles by half a step.")] = False,
    dots: Annotated[
        str | None,
        Option("Squares of a chessboard with a dot, column row …, as OpenCV's: '7 4 7 5 8 5'."),
    ] = None,
    start: Annotated[
        tuple[int, int], Option("Column and row of a PuzzleBoard's first corner in its code.")
    ] = (0, 0),
    given: Annotated[
        Path | None,
        Option(
            "Board file to read, of Kalibr or OpenCV (YAML, XML) or a design; --pitch and --size "
            "replace what it says.",
            called="from",
        ),
    ] = None,
    name: v.Name = "board",
) -> None:
    """Design a chessboard, PuzzleBoard, deltille, ChArUco board, circle grid or grid of tags."""
    from ..designs.boards import unusual_size

    if given is not None:
        from ..exchange.boards import read_board
        from ..io import BoardDesign as Board

        design = read_board(given)
        other = {key: value for key, value in (("pitch", pitch), ("size", size)) if value is not None}
        design = Board.from_content(design.to_dict() | other, where=given)
    else:
        from ..designs import board as board_of

        marked = _pairs(dots) if dots else ()

        def of(pitch: float, size: float | None = None) -> BoardDesign:
            return board_of(
                kind, columns, rows, pitch, size=size, dictionary=dictionary, first_id=first_id,
                border_bits=border_bits, legacy=legacy, polarity=polarity, asymmetric=asymmetric, dots=marked,
                start=start, name=name,
            )  # fmt: skip

        design = of(_filling(of, printed.paper) if pitch is None else pitch, size)
    if asked := unusual_size(design):
        say_notes([f"{asked}: give --pitch and --size in mm"])
    what = f"{design.kind}, {design.columns} × {design.rows}, pitch {design.pitch:g} mm"
    _write(design, printed, what)


def _pairs(text: str) -> tuple[tuple[int, int], ...]:
    """Pairs of whole numbers between blanks or commas."""
    from ..core.errors import UsageError

    words = text.replace(",", " ").split()
    if len(words) % 2 or not all(word.isdecimal() for word in words):
        raise UsageError(
            f"is {text!r}", where="--dots", do="give column and row of each square, as '7 4 7 5'"
        )
    return tuple((int(a), int(b)) for a, b in zip(words[::2], words[1::2], strict=True))


def _filling(of: Callable[[float], Drawable], paper: str) -> float:
    """The pitch with which a target fills the paper."""
    from ..designs.drawing import content_of
    from ..designs.paper import largest_pitch

    size = "A4" if paper == "own" else paper
    return largest_pitch(lambda pitch: content_of(of(pitch)), size)


def _write(design: Drawable, drawn: Drawn, what: str) -> None:
    """Write the requested drawings and design, either all or none, and report their paths."""
    from ..io import write_whole

    to_stdout = drawn.out is not None and str(drawn.out) == "-"
    out = None if to_stdout else drawn.out
    svg, pdf, paper = (
        (drawn.svg, drawn.pdf, drawn.paper) if isinstance(drawn, Printed) else (None, None, "own")
    )
    writable(svg, ".svg")
    writable(pdf, ".pdf")
    writable(out, ".json")
    files: dict[Path, str | bytes] = {}
    if svg is not None or pdf is not None:
        from ..designs.drawing import design_pdf, design_svg

        if svg is not None:
            files[svg] = design_svg(design)
        if pdf is not None:
            files[pdf] = design_pdf(design, None if paper == "own" else paper)
    if out is not None:
        files[out] = design.to_json()
    for path, content in files.items():
        write_whole(path, content)
    if to_stdout:
        say(design.to_json())
    elif files:
        say("".join(f"{path}\n" for path in files))
    else:
        say(f"{design.name}: {what}; give --svg, --pdf or --out\n")
