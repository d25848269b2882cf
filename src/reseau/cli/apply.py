"""`reseau apply`: correct points, or resample an image, by a stored calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import (
    AsJson,
    Out,
    is_points,
    points_document,
    progress,
    read_measurement,
    say,
    suffix_of,
    writable,
)

if TYPE_CHECKING:
    from ..refine import CameraCorrection

__all__ = ["apply"]

_IMAGES = (".tif", ".tiff", ".png", ".jpg", ".jpeg")


def apply(
    calibration: Annotated[Path, typer.Argument(help="Calibration file.")],
    source: Annotated[
        Path, typer.Argument(metavar="IMAGE|POINTS", help="Image, or coordinates (JSON, CSV).")
    ],
    out: Out = None,
    scale: Annotated[
        float | None, typer.Option(help="Pixels per unit of the corrected image; default: about as before.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Correct points, or resample an image into the corrected system."""
    from ..calibration.document import Calibration
    from ..refine import CameraCorrection

    correction = CameraCorrection.from_calibration(Calibration.read(calibration))
    if is_points(source):
        _points(correction, source, out, as_json)
    else:
        _image(correction, calibration, source, out, scale, as_json)


def _points(correction: CameraCorrection, source: Path, out: Path | None, as_json: bool) -> None:
    from ..core.provenance import canonical_json
    from ..io import write_whole

    suffix = ".csv" if out is None else suffix_of(writable(out), (".csv", ".json"))
    points = correction.apply(read_measurement(source).image_points())
    document = canonical_json(points_document(points, correction.unit, "common"))
    if out is not None:
        write_whole(out, document if suffix == ".json" else points.to_csv())
    if as_json:
        say(document)
    elif out is None:
        say(points.to_csv())
    else:
        say(f"{out}: {len(points)} points in {correction.unit}\n")


def _image(
    correction: CameraCorrection,
    calibration: Path,
    source: Path,
    out: Path | None,
    scale: float | None,
    as_json: bool,
) -> None:
    from ..calibration.document import Calibration
    from ..core.errors import UsageError
    from ..core.provenance import Provenance, canonical_json, sha256_of
    from ..io.images import read_image
    from ..refine import CorrectedImage, write_corrected

    if scale is not None and not scale > 0:
        raise UsageError(f"{scale:g} is not positive", where="--scale")
    out = out or source.with_name(f"{source.stem}-corrected{source.suffix}")
    suffix_of(writable(out), _IMAGES)
    frame = read_image(source)
    validity = Calibration.read(calibration).validity
    plan = CorrectedImage.plan(correction, (frame.width, frame.height), validity.get("extent"), scale)
    with progress(f"resampling {source.name}", plan.bands) as step:
        write_corrected(out, frame.pixels, plan, step)
    provenance = Provenance(
        {source.name: frame.sha256, calibration.name: sha256_of(calibration)}, {"scale": plan.scale}
    )
    if as_json:
        say(canonical_json(plan.to_dict() | {"image": str(out), "provenance": provenance.to_dict()}))
    else:
        x, y = plan.origin
        say(
            f"{out}: {plan.width} × {plan.height} px, {plan.scale:.6g} px/{correction.unit}, "
            f"first pixel at ({x:.6g}, {y:.6g}) {correction.unit}\n"
        )
