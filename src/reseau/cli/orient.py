"""`reseau orient`, `reseau measure fiducials`, `reseau measure perforations`: photographs on film."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..core import vocabulary as v
from ..core.errors import InputError, ReseauError
from ..core.options import Group, Option
from .common import Computing, out_files, overlay_files, progress, required, say, say_files_left_out, say_json
from .measure import Output

if TYPE_CHECKING:
    from ..io import FiducialOrientation, FrameOrientation
    from ..io.frame import RollSummary
    from ..sessions.film_files import OrientedFiles


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
    marked: Annotated[bool, Option("Write copies of the scans with marked corners.", Group.FILES)] = True,
    cut: Annotated[bool, Option("Write one picture for each frame, upright.", Group.FILES)] = False,
    roll: Annotated[bool, Option("Use the common shape of the frames of a roll.")] = True,
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
    if as_json:
        content = [each.to_dict() for each in found.documents]
        say_json(content[0] if len(found.jobs) == len(content) == 1 else content)
    else:
        for document in found.documents:
            say(_line(document))
        for roll in found.rolls:
            sx, sy = roll.corners.sigma or (0.0, 0.0)
            x, y = (1000 * scatter for scatter in roll.scatter_mm)
            of = " of {:g}x{:g} mm".format(*roll.format_mm) if len(found.rolls) > 1 else ""
            say(f"roll{of}: {roll.frames} frames, scatter of corners {x:.2g} µm in x, {y:.2g} µm in y, ")
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
    return text + (f" ({document.said})" if document.said else "") + "\n"


def fiducials(
    images: Annotated[
        list[Path],
        typer.Argument(help="Scanned photographs with their borders, or folders of them: TIFF, PNG, JPEG."),
    ],
    design: Annotated[
        v.Design,
        "Here the fiducial marks of the camera, fiducial-design/1, or the name of a camera that "
        "`reseau design fiducials` lists.",
    ],
    output: Output,
    transform: v.Transform = "affine",
    dpi: v.Dpi | None = None,
    rotation: Annotated[
        Literal["0", "90", "180", "270"] | None,
        Option(
            "Rotation of the camera's x-axis in the scan, degrees counter-clockwise. Default: "
            "determined by the marks if they are not symmetric."
        ),
    ] = None,
    mirrored: Annotated[
        v.Mirrored | None, "Default: determined by the marks if they are not symmetric."
    ] = None,
    negative: Annotated[v.Negative | None, "Default: determined by the marks."] = None,
) -> int:
    """Measure the fiducial marks of scanned aerial photographs, and orient them.

    The JSON document of a scan is its calibration for `reseau apply`, which also resamples the picture to
    millimetres of the camera. Of several scans --out and --overlay are folders.
    """
    from ..core.failure import Failure
    from ..core.provenance import sha256_of
    from ..designs import aerial_camera
    from ..io import FiducialDesign
    from ..io.images import open_scan, read_image
    from ..measure.fiducials import measure_fiducials
    from ..measure.fiducials.measure import FiducialOptions
    from ..procedures.exposures import photographs_named

    one = len(images) == 1 and not images[0].is_dir()
    images = photographs_named(images)
    drawn = {} if output.overlay is None else overlay_files(output.overlay, images)
    outs = out_files(output.out, images, one)
    named = design.parent == Path() and not design.suffix and not design.exists()
    camera = aerial_camera(design.name) if named else FiducialDesign.read(design)
    turn = None if rotation is None else int(rotation)
    options = FiducialOptions(dpi, turn, mirrored, negative, transform)
    documents = []
    with progress("measuring fiducial marks", len(images)) as step:
        for image in images:
            try:
                opened = open_scan(image)
                found = measure_fiducials(opened, camera, options, sha256_of(image))
                if image in drawn and not isinstance(found, Failure):
                    found.overlay(opened.picture(), drawn[image])
                elif image in drawn:
                    found.overlay(read_image(image), drawn[image])
                document = required(found, image).document()
            except ReseauError as error:
                if one:
                    raise
                typer.echo(f"reseau: {error}", err=True)
                continue
            finally:
                step()
            documents.append(document)
            each = replace(output, out=outs.get(image), as_json=one and output.as_json)
            each.deliver(document, csv_of, _marks if one or not output.as_json else lambda _: "")
    if not one and output.as_json:
        say_json([document.to_dict() for document in documents])
    elif not one:
        say(f"{len(documents)} of {len(images)} photographs oriented\n")
    return 0 if len(documents) == len(images) else 1


def csv_of(document: FiducialOrientation) -> str:
    """Measured marks as CSV ``id,x,y,sx,sy,rho``."""
    from ..io.frame import points_of

    return points_of({m.id: m.at for m in document.marks if m.at is not None}).to_csv(".4f", ".4f", ".4f")


def _marks(document: FiducialOrientation) -> str:
    """Describe the orientation: one line for the scan, one for each mark, and notes."""
    from ..core.numbers import measured

    assert document.transform is not None
    assert document.px_per_mm is not None
    good = sum(mark.ok for mark in document.marks)
    side = "mirrored, " if document.mirrored else ""
    lines = [
        f"{document.image}: {good} of {len(document.marks)} fiducial marks, {side}rotated by "
        f"{document.rotation_deg}°, {'negative, ' if document.negative else ''}"
        f"{25.4 * document.px_per_mm:.1f} dpi"
    ]
    sigma, kind = document.transform.sigma_mm, document.transform.kind
    if sigma is None:
        lines.append(f"{kind}: no residuals")
    else:
        lines.append(f"{kind}: residuals {1000 * sigma[0]:.2g} µm in X, {1000 * sigma[1]:.2g} µm in Y")
    for mark in document.marks:
        if mark.at is None:
            lines.append(f"  {mark.id}: {mark.why}")
            continue
        x, y = document.transform.residuals_mm[mark.id]
        c = mark.at
        lines.append(
            f"  {mark.id}: x {measured(c.x, c.sx, 'px')}, y {measured(c.y, c.sy, 'px')}, residuals "
            f"{1000 * x:.1f}, {1000 * y:.1f} µm"
        )
    return "\n".join([*lines, *(f"note: {note}" for note in document.notes)]) + "\n"


Box = tuple[float, float, float, float]


def perforations(
    scan: Annotated[Path, typer.Argument(help="Scan of 35 mm film that runs from top to bottom.")],
    left: Annotated[
        Box,
        Option(
            "Approximate edges of the first perforation of the left row (px).",
            value="LEFT,TOP,RIGHT,BOTTOM",
        ),
    ],
    right: Annotated[
        Box,
        Option(
            "Approximate edges of the first perforation of the right row (px).",
            value="LEFT,TOP,RIGHT,BOTTOM",
        ),
    ],
    perforation_px: Annotated[float, Option("Approximate pitch of the perforations (px).", least=1.0)],
    number: Annotated[v.Number, "Here of perforations in a row, at least 2."],
    channel: Annotated[v.Channel | None, "Here that with the darkest rims. Default: the last."] = None,
    reach: Annotated[float, Option("Search distance from the given edges (px).", least=1.0)] = 12.0,
    overlay: v.Overlay | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Measure the perforations of 35 mm film: scale, rotation and perspective of the scan.

    The scale follows from the pitch of 4.75 mm and the distance of the rows of 28.17 mm (ISO 2906).
    """
    import numpy as np

    from ..core.errors import UsageError
    from ..core.numbers import measured
    from ..io.images import open_scan
    from ..measure.film import film_plane
    from ..procedures.film_frame import film_scale

    if number < 2:
        raise UsageError(f"is {number}, not at least 2", where="--number")
    drawn = None if overlay is None else overlay_files(overlay, [scan])[scan]
    opened = open_scan(scan)
    name = channel or opened.channels[-1]
    if name not in opened.channels:
        do = f"use {', '.join(opened.channels)}"
        raise UsageError(f"the scan has no channel {name!r}", where="--channel", do=do)
    rows = [np.array([*box, perforation_px]) for box in (left, right)]
    plane = required(film_plane(opened, rows, number, channel=opened.channels.index(name), reach=reach), scan)
    if drawn is not None:
        plane.overlay(opened.picture(), drawn)
    found = film_scale(plane)
    if as_json:
        document: dict[str, Any] = {
            "schema": "reseau-film-plane/1",
            "edges": plane.edges,
            "rms_px": plane.rms_px,
            "quantities": {name: each.model_dump() for name, each in found.items()},
            "values": plane.values.tolist(),
            "covariance": plane.covariance.tolist(),
            "centre_px": plane.centre.tolist(),
            "unit_px": plane.unit,
        }
        say_json(document)
        return
    say(f"{scan.name}: {plane.edges} edges of perforations, rms {plane.rms_px:.2g} px\n")
    for name, each in found.items():
        say(f"  {name:<14} {measured(each.value, each.sigma, each.unit)}\n")
