"""`reseau export`: marks of scanned film for MicMac and Metashape."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..core.errors import UsageError
from .common import say, suffix_of, writable

__all__ = ["export"]


def export(
    scans: Annotated[
        list[Path],
        typer.Argument(
            help="Oriented scans of one camera: results of `reseau measure fiducials`, `reseau orient` or "
            "`reseau measure reseau` (JSON)."
        ),
    ],
    micmac: Annotated[
        Path | None,
        typer.Option(help="Folder of the images for MicMac: writes Ori-InterneScan and id_fiducial.txt."),
    ] = None,
    metashape: Annotated[
        Path | None, typer.Option(help="Script to write, which defines the marks in Metashape (.py).")
    ] = None,
    design: Annotated[
        Path | None, typer.Option("--design", "-d", help="Design of the reseau, for its measurements.")
    ] = None,
) -> None:
    """Export marks of scanned film with their coordinates in the camera."""
    from ..exchange import metashape_script, read_film_marks, write_micmac
    from ..io import ReseauDesign, write_whole

    if micmac is None and metashape is None:
        raise UsageError("nothing to write", where="reseau export", do="give --micmac or --metashape")
    if metashape is not None:
        suffix_of(writable(metashape), (".py",))
    grid = None if design is None else ReseauDesign.read(design)
    marks = [read_film_marks(path, grid) for path in scans]
    if len({each.image for each in marks}) < len(marks):
        raise UsageError("two of the files are of one scan", where="reseau export")
    if micmac is not None:
        for file in write_micmac(micmac, marks):
            say(f"{file}\n")
    if metashape is not None:
        write_whole(metashape, metashape_script(marks))
        say(f"{metashape}: {len(marks)} scans\n")
