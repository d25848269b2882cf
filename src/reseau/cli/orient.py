"""`reseau orient`: the inner orientation of scanned film frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.errors import InputError
from ..core.options import Option
from .common import Computing, overlay_files, progress, say, say_files_left_out

if TYPE_CHECKING:
    from ..io import FrameOrientation, RollSummary
    from ..sessions.film_files import OrientedFiles

__all__ = ["orient"]


def orient(
    images: Annotated[
        list[Path], typer.Argument(help="Scans of film frames, or folders of them: TIFF, PNG, JPEG, BMP.")
    ],
    computing: Computing,
    format_mm: v.FormatMm | None = None,
    corners: v.Corners | None = None,
    transform: v.Transform = "affine",
    dpi: v.Dpi | None = None,
    near: Annotated[
        tuple[float, float, float, float] | None,
        Option("Approximate position of the frame (px).", value="LEFT,TOP,RIGHT,BOTTOM"),
    ] = None,
    out: v.Out | None = None,
    marked: Annotated[
        bool, typer.Option(help="Write copies of the scans with marked corners.", rich_help_panel="Files")
    ] = True,
    cut: Annotated[
        bool, typer.Option(help="Write one picture for each frame, upright.", rich_help_panel="Files")
    ] = False,
    roll: Annotated[bool, typer.Option(help="Use the common shape of the frames of a roll.")] = True,
    overlay: Annotated[v.Overlay | None, "Here a folder, for each scan; FILE.png for a single one."] = None,
    as_json: v.AsJson = False,
) -> int:
    """Orient scanned film frames by their four edges.

    The JSON document of a frame is the calibration of its scan for `reseau apply`.
    """
    from ..procedures.exposures import photographs_named
    from ..sessions.film_files import orient_files, scan_jobs

    say_files_left_out(images)
    images = photographs_named(images)
    drawn = {} if overlay is None else overlay_files(overlay, images)
    jobs = scan_jobs(
        images, out, drawn, format_mm=format_mm, corners=corners, transform=transform, dpi=dpi, near=near,
        marked=marked and out is not None, cut=cut,
    )  # fmt: skip
    with (
        computing.executor(["reseau.sessions.film_files"], len(jobs)) as executor,
        progress("orienting frames", len(jobs)) as step,
    ):
        found = orient_files(jobs, executor, computing.store, roll=roll, step=step)
    _report(found, as_json)
    if found.summary is not None and not as_json:
        say("nothing written: give a folder by --out\n" if out is None else f"written: {out}\n")
    return 0 if any(each.status != "declined" for each in found.documents) and not found.failed else 1


def _report(found: OrientedFiles, as_json: bool) -> None:
    from ..core.provenance import canonical_json

    if as_json:
        content = [each.to_dict() for each in found.documents]
        say(canonical_json(content[0] if len(found.jobs) == len(content) == 1 else content))
    else:
        for document in found.documents:
            say(_line(document))
        roll = found.roll
        if roll is not None:
            sx, sy = roll.corners.sigma or (0.0, 0.0)
            x, y = (1000 * scatter for scatter in roll.scatter_mm)
            say(f"roll: {roll.frames} frames, scatter of corners {x:.2g} µm in x, {y:.2g} µm in y, ")
            say(f"calibrated corners ± {1000 * max(sx, sy):.2g} µm\n")
        if found.summary is not None:
            _print_summary(found.summary)
    for note in (note for each in found.outcomes for note in each.notes):
        typer.echo(f"reseau: {note}", err=True)
    failed = found.failed
    if failed and len(failed) == len(found.jobs):
        raise InputError(failed[0] if len(failed) == 1 else f"{failed[0]} (and {len(failed) - 1} more)")
    for line in failed:
        typer.echo(f"reseau: {line}", err=True)


def _print_summary(summary: RollSummary) -> None:
    """Print how many frames were oriented, with and without the roll, and again which of them were not."""
    rows = summary.frames
    say(f"{len(rows)} frames: " + ", ".join(f"{count} {what}" for what, count in summary.counts() if count))
    say("\n")
    lost = [row for row in rows if row.status in ("declined", "failed")]
    if len(lost) < len(rows):
        for row in lost:
            say(f"  {row.image}: {row.status}: {row.why.removeprefix(row.image + ': ')}\n")


def _line(document: FrameOrientation) -> str:
    """Describe a frame in one line."""
    from ..core.numbers import measured

    name = document.image if document.frame is None else f"{document.image}, frame {document.frame}"
    if document.corners is None or document.principal_point is None:
        return f"{name}: declined: {document.why}\n"
    largest = max(max(c.sx, c.sy) for c in document.corners.values())
    pp = document.principal_point
    text = f"{name}: {document.status}, principal point x {measured(pp.x, pp.sx, 'px')}, "
    text += f"y {measured(pp.y, pp.sy, 'px')}, "
    text += f"angle {measured(document.angle_deg or 0.0, document.angle_sigma_deg, 'deg')}"
    text += f", corners ± {largest:.2g} px at most"
    if document.transform is not None and document.transform.sigma_mm is not None:
        sx, sy = document.transform.sigma_mm
        text += f", {document.transform.kind}: residuals {sx:.2g} mm in X, {sy:.2g} mm in Y"
    elif document.transform is not None:
        text += f", {document.transform.kind}: no residuals (8 parameters from 4 corners)"
    if len(document.formats) > 1:
        sizes = (
            f"{each.format_mm[0]:g}x{each.format_mm[1]:g} ({each.probability:.2f})"
            for each in document.formats
        )
        text += f", format {' or '.join(sizes)}"
    return text + (f" ({document.why})" if document.why else "") + "\n"
