"""`reseau design`: draw a target for printing in true size, and write its coordinates."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .common import say, suffix_of, writable

if TYPE_CHECKING:
    from ..io import BoardDesign, ReseauDesign, TestfieldDesign
    from ..io.targets import SpaceTargets

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


class Polarity(StrEnum):
    """Whether marks are darker or brighter than the background."""

    DARK = "dark"
    BRIGHT = "bright"


class Kind(StrEnum):
    """Kinds of boards."""

    CHESS = "chess"
    CHARUCO = "charuco"
    CIRCLES = "circles"
    APRILGRID = "aprilgrid"


Svg = Annotated[Path | None, typer.Option("--svg", help="SVG drawing to write.")]
Pdf = Annotated[Path | None, typer.Option("--pdf", help="PDF drawing to write.")]
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
    _write(design, svg, pdf, out, f"{columns} × {rows} marks, pitch {pitch:g} mm")


@app.command()
def sheet(
    columns: Annotated[int, typer.Option(help="Number of disks in a row.")] = 10,
    rows: Annotated[int, typer.Option(help="Number of disks in a column.")] = 10,
    pitch: Annotated[float, typer.Option(help="Distance between neighbouring disks (mm).")] = 25.0,
    size: Annotated[
        float | None, typer.Option(help="Diameter of a disk (mm). Default: 0.22 times --pitch.")
    ] = None,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright disks.")] = Polarity.DARK,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "sheet",
    svg: Svg = None,
    pdf: Pdf = None,
    out: Design = None,
) -> None:
    """Design a sheet of disks, four of them in coded rings that identify all disks."""
    from ..designs import coded_sheet

    design = coded_sheet(columns, rows, pitch, size=size, name=name, polarity=polarity.value)
    _write(design, svg, pdf, out, f"{columns} × {rows} disks, pitch {pitch:g} mm")


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
    _write(design, None, None, out, f"{layers} layers of {width:g} mm, {spacing:g} mm apart")


@app.command("testfield")
def coded_field(
    columns: Annotated[int, typer.Option(help="Number of squares in a row.")] = 8,
    rows: Annotated[int, typer.Option(help="Number of squares in a column.")] = 8,
    pitch: Annotated[float, typer.Option(help="Distance between the lines (mm).")] = 125.0,
    line_width: Annotated[float, typer.Option(help="Width of the lines (mm).")] = 2.0,
    small: Annotated[
        tuple[float, float, float, float],
        typer.Option(help="Sizes of small squares, triangles, crosses and circles (mm)."),
    ] = (9.0, 13.0, 15.0, 12.0),
    large: Annotated[
        tuple[float, float, float, float],
        typer.Option(help="Sizes of large squares, triangles, crosses and circles (mm)."),
    ] = (
        17.0,
        25.0,
        25.0,
        22.0,
    ),
    spread: Annotated[float, typer.Option(help="Distance between targets in a square (mm).")] = 30.0,
    turn_seed: Annotated[
        int | None, typer.Option(help="Rotate each target by an angle drawn from this seed.")
    ] = None,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright targets.")] = Polarity.DARK,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "testfield",
    svg: Svg = None,
    pdf: Pdf = None,
    out: Design = None,
) -> None:
    """Design a coded testfield: squares of sixteen targets, coded by their arrangement."""
    from ..designs import coded_testfield

    design = coded_testfield(
        columns,
        rows,
        pitch,
        line_width=line_width,
        small=small,
        large=large,
        spread=spread,
        turn_seed=turn_seed,
        polarity=polarity.value,
        name=name,
    )
    _write(design, svg, pdf, out, f"{columns} × {rows} squares, pitch {pitch:g} mm")


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
    out: Design = None,
) -> None:
    """Design the targets of a space frame, to be cut out and fixed to it; for `reseau blurred`."""
    from ..core.errors import UsageError
    from ..designs import space_frame

    if shape is not Shape.DISK and shape is not Shape.SQUARE:
        raise UsageError(f"is {shape.value!r}", where="--shape", do="use disk or square")
    kind: Literal["disk", "square"] = "disk" if shape is Shape.DISK else "square"
    design = space_frame(sides, count, size, shape=kind, polarity=polarity.value, name=name)
    _write(design, svg, pdf, out, f"{count} targets of {size:g} mm")


@app.command()
def board(
    kind: Annotated[Kind, typer.Option(help="Pattern of the board.")] = Kind.CHARUCO,
    columns: Annotated[int, typer.Option(help="Number of squares, circles or tags in a row.")] = 7,
    rows: Annotated[int, typer.Option(help="Number of squares, circles or tags in a column.")] = 10,
    pitch: Annotated[
        float, typer.Option(help="Side of a square, distance of rows of circles, or of tags (mm).")
    ] = 24.0,
    size: Annotated[
        float | None, typer.Option(help="Diameter of a circle, or side of a marker or tag (mm).")
    ] = None,
    dictionary: Annotated[str | None, typer.Option(help="Markers, as OpenCV's DICT_5X5_100.")] = None,
    first_id: Annotated[int, typer.Option(min=0, help="Number of the first marker.")] = 0,
    border_bits: Annotated[int, typer.Option(help="Width of the border of a marker (bits).")] = 1,
    legacy: Annotated[bool, typer.Option("--legacy", help="ChArUco layout of OpenCV before 4.6.")] = False,
    asymmetric: Annotated[
        bool, typer.Option("--asymmetric", help="Shift every second row of circles by half a step.")
    ] = False,
    given: Annotated[
        Path | None, typer.Option("--from", help="Board file of Kalibr or OpenCV to read (YAML, XML).")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "board",
    svg: Svg = None,
    pdf: Pdf = None,
    out: Design = None,
) -> None:
    """Design a chessboard, a ChArUco board, a circle grid or an AprilGrid."""
    if given is not None:
        from ..exchange import read_board

        design = read_board(given)
    else:
        from ..designs import board as board_of

        design = board_of(
            kind.value, columns, rows, pitch, size=size, dictionary=dictionary, first_id=first_id,
            border_bits=border_bits, legacy=legacy, asymmetric=asymmetric, name=name,
        )  # fmt: skip
    what = f"{design.kind}, {design.columns} × {design.rows}, pitch {design.pitch:g} mm"
    _write(design, svg, pdf, out, what)


def _write(
    design: ReseauDesign | TestfieldDesign | SpaceTargets | BoardDesign,
    svg: Path | None,
    pdf: Path | None,
    out: Path | None,
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
        from ..designs.drawing import design_pdf, design_svg  # needs matplotlib

        drawn = ((svg, design_svg), (pdf, design_pdf))
        files = {path: content(design) for path, content in drawn if path is not None}
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
