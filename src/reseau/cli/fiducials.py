"""`reseau measure fiducials`: the inner orientation of a scanned photograph by its fiducial marks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..core import vocabulary as v
from ..core.files import writable
from .common import overlay_files, progress, required, say
from .measure import Output

if TYPE_CHECKING:
    from ..io import FiducialOrientation


def fiducials(
    scan: Annotated[Path, typer.Argument(help="Scanned photograph with its borders: TIFF, PNG, JPEG.")],
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
        typer.Option(
            help="Rotation of the camera's x-axis in the scan, degrees counter-clockwise. Default: "
            "determined by the marks if they are not symmetric."
        ),
    ] = None,
    mirrored: Annotated[
        v.Mirrored | None, "Default: determined by the marks if they are not symmetric."
    ] = None,
) -> None:
    """Measure the fiducial marks of a scanned aerial photograph, and orient it.

    The JSON document is the calibration of the scan for `reseau apply`, which also resamples the picture to
    millimetres of the camera.
    """
    from ..core.failure import Failure
    from ..core.provenance import sha256_of
    from ..designs import aerial_camera
    from ..io import FiducialDesign, write_whole
    from ..io.images import open_scan, read_image
    from ..measure.fiducials import FiducialOptions, measure_fiducials

    out, overlay = output.out, output.overlay
    suffix = ".json" if out is None else writable(out, ".json", ".csv").suffix.lower()
    drawn = None if overlay is None else overlay_files(overlay, [scan])[scan]
    named = design.parent == Path() and not design.suffix and not design.exists()
    camera = aerial_camera(design.name) if named else FiducialDesign.read(design)
    options = FiducialOptions(dpi, None if rotation is None else int(rotation), mirrored, transform)
    opened = open_scan(scan)
    with progress(f"measuring {scan.name}", 1):
        found = measure_fiducials(opened, camera, options, sha256_of(scan))
    if drawn is not None and isinstance(found, Failure):
        found.overlay(read_image(scan), drawn)
    elif drawn is not None:
        assert not isinstance(found, Failure)
        pixels = opened.window(0, opened.height, 0, opened.width)
        found.overlay(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels, drawn)
    result = required(found, scan)
    document = result.document()
    if out is not None:
        write_whole(out, document.to_json() if suffix == ".json" else csv_of(document))
    if output.as_json:
        say(document.to_json())
        return
    _say(document)


def csv_of(document: FiducialOrientation) -> str:
    """Measured marks as CSV ``id,x,y,sx,sy,rho``."""
    lines = ["id,x,y,sx,sy,rho"]
    for mark in document.marks:
        if mark.at is not None:
            c = mark.at
            lines.append(f"{mark.id},{c.x:.4f},{c.y:.4f},{c.sx:.4f},{c.sy:.4f},{c.rho:.4f}")
    return "\n".join(lines) + "\n"


def _say(document: FiducialOrientation) -> None:
    """Describe the orientation: one line for the scan, one for each mark, and notes."""
    from ..core.numbers import measured

    assert document.transform is not None
    assert document.px_per_mm is not None
    good = sum(mark.ok for mark in document.marks)
    side = "mirrored, " if document.mirrored else ""
    say(
        f"{document.image}: {good} of {len(document.marks)} fiducial marks, {side}rotated by "
        f"{document.rotation_deg}°, {25.4 * document.px_per_mm:.1f} dpi\n"
    )
    sigma, kind = document.transform.sigma_mm, document.transform.kind
    if sigma is None:
        say(f"{kind}: no residuals\n")
    else:
        say(f"{kind}: residuals {1000 * sigma[0]:.2g} µm in X, {1000 * sigma[1]:.2g} µm in Y\n")
    for mark in document.marks:
        if mark.at is None:
            say(f"  {mark.id}: {mark.why}\n")
            continue
        x, y = document.transform.residuals_mm[mark.id]
        c = mark.at
        say(
            f"  {mark.id}: x {measured(c.x, c.sx, 'px')}, y {measured(c.y, c.sy, 'px')}, residuals "
            f"{1000 * x:.1f}, {1000 * y:.1f} µm\n"
        )
    for note in document.notes:
        say(f"note: {note}\n")
