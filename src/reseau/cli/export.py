"""`reseau export`: calibrations of cameras, and marks of scanned film, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import writable
from ..core.options import Option
from .common import say, say_notes

_SAME, _FAR = 1e-5, 0.3
"""Differences (px) that are rounding errors, and above which another format is proposed."""


def export(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="For --to a calibration of a camera, ours or of another program, or those of a rig; or "
            "oriented scans of one camera: results of `reseau measure fiducials`, `reseau orient` or "
            "`reseau measure reseau`, or a folder of them."
        ),
    ],
    to: Annotated[
        str | None,
        Option(
            "Format of the calibration: opencv, ros, kalibr, basalt, colmap, mrcal, metashape, "
            "photomodeler, dbat, matlab, openptv, reseau.",
            value="FORMAT",
        ),
    ] = None,
    out: v.Out | None = None,
    micmac: Annotated[
        Path | None,
        Option("Folder of the images for MicMac: writes Ori-InterneScan and id_fiducial.txt."),
    ] = None,
    metashape: Annotated[
        Path | None, Option("Script to write, which defines the marks in Metashape (.py).")
    ] = None,
    anyway: v.Anyway = False,
    design: Annotated[v.Design | None, "Here the reseau, for its measurements."] = None,
) -> None:
    """Write a calibration for another program, or marks of scanned film with their coordinates."""
    if to is not None or out is not None:
        _calibration(files, to, out, anyway)
        if micmac is None and metashape is None:
            return
    from ..exchange.film import film_files, metashape_script, read_film_marks, write_micmac
    from ..io import ReseauDesign, write_whole

    if micmac is None and metashape is None:
        raise UsageError("nothing to write", where="reseau export", do="give --to, --micmac or --metashape")
    writable(metashape, ".py")
    grid = None if design is None else ReseauDesign.read(design)
    marks = [read_film_marks(path, grid) for path in film_files(files)]
    if len({each.image for each in marks}) < len(marks):
        raise UsageError("two of the files are of one scan", where="reseau export")
    if micmac is not None:
        for file in write_micmac(micmac, marks):
            say(f"{file}\n")
    if metashape is not None:
        write_whole(metashape, metashape_script(marks))
        say(f"{metashape}: {len(marks)} scans\n")


def _calibration(files: list[Path], to: str | None, out: Path | None, anyway: bool) -> None:
    """Write a calibration, or those of a rig, in a format."""
    from ..core.numbers import plain
    from ..exchange.calibrations import calibration_formats
    from ..exchange.calibrations.formats import any_calibration, export_calibrations, formats_holding

    if to is None or out is None:
        raise UsageError("must be given together", where="--to FORMAT and --out FILE")
    calibrations = [any_calibration(source) for source in files]
    writable(out)
    if to == "reseau" and len(calibrations) == 1:
        calibrations[0].write(out)
        say(f"{out}: {calibrations[0].model.get('model', calibrations[0].kind)}\n")
        return
    written = export_calibrations(calibrations, to, out, anyway=anyway)
    say_notes(written[0].notes)
    for done in written:
        name = f" {done.camera.id}" if len(written) > 1 else ""
        say(f"{out}:{name} {to}, model {done.camera.model}\n")
        if done.greatest_px > _SAME:
            rms, most = plain(done.rms_px, 2), plain(done.greatest_px, 2)
            say(f"  differs from the calibration by {rms} px rms, {most} at most")
            rest = "" if done.share == 1 else f"; not compared in {100 * (1 - done.share):.2g} % of the image"
            say(f"{rest}\n")
    if max(done.greatest_px for done in written) > _FAR:
        whole = set.intersection(*(set(formats_holding(each)) for each in calibrations))
        known = ", ".join(name for name in calibration_formats() if name in whole)
        do = f"these formats have its own model: {known}" if known else "no other format has it either"
        say(f"  {to} has no model that describes this camera well; {do}\n")
