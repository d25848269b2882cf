"""`reseau design`: a target to print in true size, and its coordinates."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .common import AsJson, say, suffix_of, writable

__all__ = ["app"]

app = typer.Typer(
    help="Draw a target to print in true size, and write its coordinates.", no_args_is_help=True
)


class Shape(StrEnum):
    """Shapes of a mark."""

    LINES = "line-grid"
    CROSS = "cross"
    DISK = "disk"
    SQUARE = "square"


class Polarity(StrEnum):
    """Whether marks are darker or brighter than what is around them."""

    DARK = "dark"
    BRIGHT = "bright"


@app.callback()
def _targets() -> None:
    """Draw a target to print in true size, and write its coordinates."""


@app.command()
def reseau(
    columns: Annotated[int, typer.Option(help="Marks in a row.")] = 15,
    rows: Annotated[int, typer.Option(help="Marks in a column.")] = 11,
    pitch: Annotated[float, typer.Option(help="Distance of neighbouring marks, mm.")] = 10.0,
    shape: Annotated[Shape, typer.Option(help="Shape of a mark.")] = Shape.LINES,
    size: Annotated[float | None, typer.Option(help="Size of a mark, mm; none for lines.")] = None,
    line_width: Annotated[float, typer.Option(help="Width of the lines of a cross or grid, mm.")] = 0.3,
    polarity: Annotated[Polarity, typer.Option(help="Dark or bright marks.")] = Polarity.DARK,
    origin: Annotated[str | None, typer.Option(help="Mark O of the common system.")] = None,
    axis: Annotated[str | None, typer.Option(help="Mark S on its x-axis.")] = None,
    name: Annotated[str, typer.Option(help="Name of the design.")] = "reseau",
    svg: Annotated[Path | None, typer.Option("--svg", help="Drawing to write, SVG.")] = None,
    pdf: Annotated[Path | None, typer.Option("--pdf", help="Drawing to write, PDF.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Design to write, JSON.")] = None,
    as_json: AsJson = False,
) -> None:
    """Design a reseau: a regular grid of marks."""
    from ..designs import regular_reseau
    from ..formats import Mark, write_whole
    from ..report.drawing import design_pdf, design_svg

    for path, suffix in ((svg, ".svg"), (pdf, ".pdf"), (out, ".json")):
        if path is not None:
            suffix_of(writable(path), (suffix,))
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
    # All drawings before the first file: either all are there or none.
    files = {
        path: content(design)
        for path, content in ((svg, design_svg), (pdf, design_pdf), (out, lambda d: d.to_json()))
        if path is not None
    }
    for path, content in files.items():
        write_whole(path, content)
    if as_json:
        say(design.to_json())
    elif files:
        say("".join(f"{path}\n" for path in files))
    else:
        say(f"{name}: {columns} × {rows} marks, pitch {pitch:g} mm; give --svg, --pdf, --out or --json\n")
