"""`reseau design`: draw a target for printing in true size, and write its coordinates."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .common import say, suffix_of, writable

if TYPE_CHECKING:
    from ..designs.drawing import Drawable
    from ..io import BoardDesign, ReseauDesign, TestfieldDesign

__all__ = ["app"]


app = typer.Typer(
    help="Draw a target for printing in true size, and write its coordinates.", no_args_is_help=True
)


class Shape(StrEnum):
    """Shapes of a mark."""

    LINES = "line-grid"
    CROSS = "cross"
    DISK = "disk"
    SQUARE = "square"


class Paper(StrEnum):
    """Sizes of paper."""

    A4 = "A4"
    A3 = "A3"
    LETTER = "Letter"
    TABLOID = "Tabloid"
    OWN = "own"


class Polarity(StrEnum):
    """Whether marks are darker or brighter than the background."""

    DARK = "dark"
    BRIGHT = "bright"


class Kind(StrEnum):
    """Kinds of boards."""

    CHESS = "chess"
    PUZZLE = "puzzle"
    DELTILLE = "deltille"
    CHARUCO = "charuco"
    CIRCLES = "circles"
    APRILGRID = "aprilgrid"
    MARKERS = "markers"


Svg = Annotated[Path | None, typer.Option("--svg", help="SVG drawing to write.")]
Pdf = Annotated[Path | None, typer.Option("--pdf", help="PDF drawing to write.")]
PaperOf = Annotated[
    Paper,
    typer.Option(
        "--paper",
        help="Paper of the PDF. Larger targets are divided over several sheets, with marks to join them; own "
        "is a page as large as the target needs.",
    ),
]
Fitted = Annotated[
    float | None, typer.Option(help="Distance between neighbouring marks (mm). Default: fills the --paper.")
]
Design = Annotated[
    Path | None,
    typer.Option("--json", "--out", "-o", help="JSON design to write; - for standard output."),
]


@app.callback()
def _targets() -> None:
    """Draw a target for printing in true size, and write its coordinates."""


@app.command()
def reseau(
    columns: Annotated[int, typer.Option(help="Number of marks in a row.")] = 15,
    rows: Annotated[int, typer.Option(help="Number of marks in a column.")] = 11,
    pitch: Annotated[float, typer.Option(help="Distance between neighbouring marks (mm).")] = 10.0,
    shape: Annotated[Shape, typer.Option(help="Shape of a mark.")] = Shape.LINES,
    size: Annotated[
        float | None,
        typer.Option(help="Size of a mark (mm); not used for a line grid. Default: a fraction of --pitch."),
    ] = None,
    line_width: Annotated[float, typer.Option(help="Line width of a cross or line grid (mm).")] = 0.3,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright marks.")] = Polarity.DARK,
    origin: Annotated[str | None, typer.Option(help="Mark O, the origin of the common system.")] = None,
    axis: Annotated[str | None, typer.Option(help="Mark S, on the x-axis of the common system.")] = None,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "reseau",
    svg: Svg = None,
    pdf: Pdf = None,
    paper: PaperOf = Paper.A4,
    out: Design = None,
) -> None:
    """Design a reseau: a regular grid of marks."""
    from ..designs import regular_reseau
    from ..io import Mark

    lined = shape in (Shape.LINES, Shape.CROSS)
    diameter = None if shape is Shape.LINES else size or (pitch / 3 if shape is Shape.CROSS else pitch / 5)
    design = regular_reseau(
        columns,
        rows,
        pitch,
        Mark(shape=shape.value, size=diameter, line_width=line_width if lined else None),
        name=name,
        polarity=polarity.value,
        origin=origin,
        axis=axis,
    )
    _write(design, svg, pdf, out, paper, f"{columns} × {rows} marks, pitch {pitch:g} mm")


@app.command()
def sheet(
    columns: Annotated[int, typer.Option(help="Number of disks in a row.")] = 10,
    rows: Annotated[int, typer.Option(help="Number of disks in a column.")] = 13,
    pitch: Fitted = None,
    size: Annotated[
        float | None, typer.Option(help="Diameter of a disk (mm). Default: 0.22 times --pitch.")
    ] = None,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright disks.")] = Polarity.DARK,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "sheet",
    svg: Svg = None,
    pdf: Pdf = None,
    paper: PaperOf = Paper.A4,
    out: Design = None,
) -> None:
    """Design a sheet of disks, four of them in coded rings that identify all disks."""
    from ..designs import coded_sheet

    def of(pitch: float, size: float | None = None) -> ReseauDesign:
        return coded_sheet(columns, rows, pitch, size=size, name=name, polarity=polarity.value)

    pitch = _filling(of, paper) if pitch is None else pitch
    design = of(pitch, size)
    _write(design, svg, pdf, out, paper, f"{columns} × {rows} disks, pitch {pitch:g} mm")


@app.command("n-wires")
def n_wires(
    layers: Annotated[int, typer.Option(help="Number of layers, each with one N.")] = 3,
    width: Annotated[float, typer.Option(help="Distance of the parallel wires of a layer (mm).")] = 40.0,
    spacing: Annotated[float, typer.Option(help="Distance of the layers (mm).")] = 15.0,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "n-wires",
    out: Design = None,
) -> None:
    """Design an N-wire phantom: coordinates of parallel and slanted wires, to be edited to one's own."""
    from ..designs import n_wire_phantom

    design = n_wire_phantom(layers, width, spacing, name=name)
    _write(design, None, None, out, Paper.OWN, f"{layers} layers of {width:g} mm, {spacing:g} mm apart")


@app.command()
def fiducials(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Name of a camera; by default all are listed.")
    ] = None,
    out: Design = None,
) -> None:
    """Write the fiducial marks of an aerial camera that is known by name, to be edited to its report."""
    from ..designs import aerial_camera, aerial_cameras

    if name is None:
        for each, design in aerial_cameras().items():
            say(f"{each:18} {design.name}\n")
        return
    design = aerial_camera(name)
    if out is None or str(out) == "-":
        say(design.to_json())
    else:
        suffix_of(writable(out), (".json",))
        design.write(out)
        say(f"{out}: {design.name}, {len(design.points)} marks; {design.source}\n")


@app.command("testfield")
def coded_field(
    columns: Annotated[int, typer.Option(help="Number of squares in a row.")] = 8,
    rows: Annotated[int, typer.Option(help="Number of squares in a column.")] = 8,
    pitch: Annotated[
        float | None,
        typer.Option(help="Distance between the lines (mm). Default: fills the --paper; the paper's is 125."),
    ] = None,
    line_width: Annotated[
        float | None, typer.Option(help="Width of the lines (mm). Default: 2/125 of --pitch.")
    ] = None,
    small: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            help="Sizes of small squares, triangles, crosses and circles (mm). Default: 9 13 15 12 "
            "at a pitch of 125 mm."
        ),
    ] = None,
    large: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            help="Sizes of large squares, triangles, crosses and circles (mm). Default: 17 25 25 22 "
            "at a pitch of 125 mm."
        ),
    ] = None,
    spread: Annotated[
        float | None, typer.Option(help="Distance between targets in a square (mm). Default: 0.24 × --pitch.")
    ] = None,
    turn_seed: Annotated[
        int | None, typer.Option(help="Rotate each target by an angle drawn from this seed.")
    ] = None,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright targets.")] = Polarity.DARK,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "testfield",
    svg: Svg = None,
    pdf: Pdf = None,
    paper: PaperOf = Paper.A4,
    out: Design = None,
) -> None:
    """Design a coded testfield: squares of sixteen targets, coded by their arrangement."""
    from ..designs import coded_testfield

    given: dict[str, Any] = {"line_width": line_width, "small": small, "large": large, "spread": spread}

    def of(pitch: float, **sizes: Any) -> TestfieldDesign:
        return coded_testfield(
            columns, rows, pitch, turn_seed=turn_seed, polarity=polarity.value, name=name, **sizes
        )

    pitch = _filling(of, paper) if pitch is None else pitch
    design = of(pitch, **{key: value for key, value in given.items() if value is not None})
    _write(design, svg, pdf, out, paper, f"{columns} × {rows} squares, pitch {pitch:g} mm")


@app.command()
def frame(
    sides: Annotated[
        tuple[float, float, float], typer.Option(help="Sides of the frame along X, Y and Z (mm).")
    ] = (1200.0, 900.0, 400.0),
    count: Annotated[int, typer.Option(help="Number of targets.")] = 28,
    size: Annotated[float, typer.Option(help="Diameter of a disk or side of a square (mm).")] = 20.0,
    shape: Annotated[Shape, typer.Option(help="disk or square.")] = Shape.DISK,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright targets.")] = Polarity.DARK,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "frame",
    svg: Svg = None,
    pdf: Pdf = None,
    paper: PaperOf = Paper.A4,
    out: Design = None,
) -> None:
    """Design the targets of a space frame, to be cut out and fixed to it; for `reseau blurred`."""
    from ..core.errors import UsageError
    from ..designs import space_frame

    if shape is not Shape.DISK and shape is not Shape.SQUARE:
        raise UsageError(f"is {shape.value!r}", where="--shape", do="use disk or square")
    kind: Literal["disk", "square"] = "disk" if shape is Shape.DISK else "square"
    design = space_frame(sides, count, size, shape=kind, polarity=polarity.value, name=name)
    _write(design, svg, pdf, out, paper, f"{count} targets of {size:g} mm")


@app.command()
def board(
    kind: Annotated[Kind, typer.Option(help="Pattern of the board.")] = Kind.CHARUCO,
    columns: Annotated[int, typer.Option(help="Number of squares, circles or tags in a row.")] = 7,
    rows: Annotated[int, typer.Option(help="Number of squares, circles or tags in a column.")] = 10,
    pitch: Annotated[
        float | None,
        typer.Option(
            help="Side of a square, distance of rows of circles, or of tags (mm). Default: fills the --paper."
        ),
    ] = None,
    size: Annotated[
        float | None, typer.Option(help="Diameter of a circle, or side of a marker or tag (mm).")
    ] = None,
    dictionary: Annotated[str | None, typer.Option(help="Markers, as OpenCV's DICT_5X5_100.")] = None,
    first_id: Annotated[int, typer.Option(min=0, help="Number of the first marker.")] = 0,
    border_bits: Annotated[int, typer.Option(help="Width of the border of a marker (bits).")] = 1,
    legacy: Annotated[bool, typer.Option("--legacy", help="ChArUco layout of OpenCV before 4.6.")] = False,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright circles.")] = Polarity.DARK,
    asymmetric: Annotated[
        bool, typer.Option("--asymmetric", help="Shift every second row of circles by half a step.")
    ] = False,
    dots: Annotated[
        str | None,
        typer.Option(help="Squares of a chessboard with a dot, column row …, as OpenCV's: '7 4 7 5 8 5'."),
    ] = None,
    start: Annotated[
        tuple[int, int], typer.Option(help="Column and row of a PuzzleBoard's first corner in its code.")
    ] = (0, 0),
    given: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Board file to read, of Kalibr or OpenCV (YAML, XML) or a design; --pitch and --size "
            "replace what it says.",
        ),
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "board",
    svg: Svg = None,
    pdf: Pdf = None,
    paper: PaperOf = Paper.A4,
    out: Design = None,
) -> None:
    """Design a chessboard, PuzzleBoard, deltille, ChArUco board, circle grid or grid of tags."""
    from ..designs.boards import unusual_size

    if given is not None:
        from ..exchange import read_board
        from ..io import BoardDesign as Board

        design = read_board(given)
        other = {key: value for key, value in (("pitch", pitch), ("size", size)) if value is not None}
        design = Board.from_content(design.to_dict() | other, where=given)
    else:
        from ..designs import board as board_of

        marked = _pairs(dots) if dots else ()

        def of(pitch: float, size: float | None = None) -> BoardDesign:
            return board_of(
                kind.value, columns, rows, pitch, size=size, dictionary=dictionary, first_id=first_id,
                border_bits=border_bits, legacy=legacy, polarity=polarity.value,
                asymmetric=asymmetric, dots=marked, start=start, name=name,
            )  # fmt: skip

        design = of(_filling(of, paper) if pitch is None else pitch, size)
    if asked := unusual_size(design):
        typer.echo(f"note: {asked}: give --pitch and --size in mm", err=True)
    what = f"{design.kind}, {design.columns} × {design.rows}, pitch {design.pitch:g} mm"
    _write(design, svg, pdf, out, paper, what)


def _pairs(text: str) -> tuple[tuple[int, int], ...]:
    """Pairs of whole numbers between blanks or commas."""
    from ..core.errors import UsageError

    words = text.replace(",", " ").split()
    if len(words) % 2 or not all(word.isdecimal() for word in words):
        raise UsageError(
            f"is {text!r}", where="--dots", do="give column and row of each square, as '7 4 7 5'"
        )
    return tuple((int(a), int(b)) for a, b in zip(words[::2], words[1::2], strict=True))


def _filling(of: Callable[[float], Drawable], paper: Paper) -> float:
    """The pitch with which a target fills the paper."""
    from ..designs.drawing import content_of
    from ..designs.paper import largest_pitch

    size = Paper.A4 if paper is Paper.OWN else paper
    return largest_pitch(lambda pitch: content_of(of(pitch)), size.value)


def _write(
    design: Drawable,
    svg: Path | None,
    pdf: Path | None,
    out: Path | None,
    paper: Paper,
    what: str,
) -> None:
    """Write the requested drawings and design, either all or none, and report their paths."""
    from ..io import write_whole

    to_stdout = out is not None and str(out) == "-"
    out = None if to_stdout else out
    for path, suffix in ((svg, ".svg"), (pdf, ".pdf"), (out, ".json")):
        if path is not None:
            suffix_of(writable(path), (suffix,))
    files: dict[Path, str | bytes] = {}
    if svg is not None or pdf is not None:
        from ..designs.drawing import design_pdf, design_svg

        if svg is not None:
            files[svg] = design_svg(design)
        if pdf is not None:
            files[pdf] = design_pdf(design, None if paper is Paper.OWN else paper.value)
    if out is not None:
        files[out] = design.to_json()
    for path, content in files.items():
        write_whole(path, content)
    if to_stdout:
        say(design.to_json())
    elif files:
        say("".join(f"{path}\n" for path in files))
    else:
        say(f"{design.name}: {what}; give --svg, --pdf or --json\n")
