"""`reseau calibrate`: calibrate a camera from photographs of a target."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .bundle_compare import read_lens
from .bundle_options import (
    ComponentsOf,
    Distances,
    Eliminate,
    Reject,
    component_kind,
    level_of,
    outputs,
    positive,
    say_difference,
    say_left_out,
    say_model,
    say_parameters,
    say_refraction,
)
from .common import (
    AsJson,
    Out,
    SensorFile,
    corrected,
    overlay_files,
    progress,
    read_frame,
    required,
    say,
)
from .measure import Channel

if TYPE_CHECKING:
    from ..bundle import Kind
    from ..calibration import CameraMapping, FieldDifference
    from ..calibration.document import Calibration
    from ..core.data import Frame, ImagePoints
    from ..core.provenance import Provenance
    from ..procedures.calibration import Calibrated, CalibrationOptions, CameraOptions

__all__ = ["calibrate"]

Sigma = Annotated[
    float | None,
    typer.Option(min=1e-6, help="Sigma of all image coordinates, pixels; replaces the measured sigmas."),
]
Control = Annotated[
    Path | None,
    typer.Option(help="Control points of the target, CSV id,x,y,z[,sx,sy,sz]; by default a free network."),
]
Refraction = Annotated[
    Path | None,
    typer.Option(help="Windows and media before the target, reseau-refraction/1; lengths in mm."),
]
LeaveOut = Annotated[
    list[str] | None, typer.Option(help="Image point to leave out, e.g. photo.jpg:A1; repeatable.")
]


def calibrate(
    images: Annotated[
        list[Path], typer.Argument(help="Photographs of the target, or files of measured image coordinates.")
    ],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the testfield or reseau.")],
    out: Out = None,
    report: Annotated[Path | None, typer.Option(help="Report to write, HTML.")] = None,
    overlay: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a PNG of each photograph: what was measured, what was declined, and why."
        ),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Camera model; by default brown with --pitch, otherwise opencv. An unknown name lists all.",
        ),
    ] = "",
    pitch: Annotated[float | None, typer.Option(min=1e-6, help="Pixel size, mm; required by brown.")] = None,
    side: Annotated[
        str | None, typer.Option(help="Side of Brown's distortion: object (default) or image.")
    ] = None,
    model_option: Annotated[
        list[str] | None,
        typer.Option(help="Option of the camera model, e.g. balance_radius_mm=8; repeatable."),
    ] = None,
    free: Annotated[str, typer.Option(help="Parameters to estimate, e.g. c,x0,y0,K1.")] = "",
    size: Annotated[
        str, typer.Option(help="Width×height in pixels, e.g. 640x480; required without photographs.")
    ] = "",
    channel: Annotated[Channel, typer.Option(help="Channel of colour images.")] = Channel.LUMA,
    sensor: SensorFile = None,
    sigma: Sigma = None,
    control: Control = None,
    refraction: Refraction = None,
    leave_out: LeaveOut = None,
    reject: Reject = False,
    components: ComponentsOf = None,
    eliminate: Eliminate = None,
    row_jitter: Annotated[float, typer.Option(help="Row jitter of the sensor, pixels.")] = 0.0,
    fill: Annotated[float, typer.Option(min=0, max=1, help="Light-sensitive fraction of a pixel.")] = 1.0,
    against: Annotated[
        list[Path] | None, typer.Option(help="Calibration of the same camera to compare with; repeatable.")
    ] = None,
    distance: Distances = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of processes; by default the number of cores.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera from photographs of a target."""
    workers = _processes(images, jobs)
    from ..io import parse_design, read_text
    from ..measure import TestfieldOptions
    from ..procedures.calibration import calibrate_camera, measurer_of
    from ..procedures.target_measurement import drawing_overlays

    outputs(out, report)
    drawn = {} if overlay is None else overlay_files(overlay, images)
    distance = positive(distance)
    target, kind = parse_design(read_text(design), design), component_kind(components)
    others = {path.name: read_lens(path) for path in against or []}
    level = level_of(eliminate, "--eliminate")
    options = _options(sigma, control, refraction, leave_out or [], reject, kind, level, workers)
    camera = _camera(model, pitch, side, model_option or [], free)
    measure = measurer_of(target, TestfieldOptions(row_jitter_px=row_jitter, fill=fill))
    measure = drawing_overlays(measure, {path.name: file for path, file in drawn.items()})
    with progress("measuring", len(images)) as step:
        frames = _frames(images, channel, sensor, step)
        done = required(calibrate_camera(frames, target, measure, _size(size), camera, options), design)
    provenance = _provenance(
        [design, *images, *(path for path in (control, refraction, sensor) if path)],
        model=camera.model, pitch=pitch, options=dict(camera.options), free=free, sigma=sigma,
        reject=reject, row_jitter=row_jitter, fill=fill, channel=channel.value, eliminate=eliminate,
        leave_out=list(leave_out or []), components=kind,
    )  # fmt: skip
    differences = _differences(done, others)
    calibration = _calibration(done, target.name, provenance)
    if report is not None:
        _write_report(report, done, f"Calibration with {target.name}", provenance, differences, distance)
    if out is not None:
        calibration.write(out)
    if as_json:
        say(calibration.to_json())
    else:
        _say(done, differences, distance or [])


def _provenance(inputs: list[Path], **settings: Any) -> Provenance:
    from ..core.provenance import Provenance, sha256_of

    return Provenance({path.name: sha256_of(path) for path in inputs}, settings)


def _options(
    sigma: float | None,
    control: Path | None,
    refraction: Path | None,
    leave_out: list[str],
    reject: bool,
    components: Kind | None,
    level: float | None,
    workers: int,
) -> CalibrationOptions:
    """Options of the procedure, from the options of the command."""
    from ..bundle import Options
    from ..core.errors import UsageError
    from ..exchange import read_control
    from ..io.refraction import RefractionFile
    from ..procedures.calibration import CalibrationOptions

    pairs = []
    for text in leave_out:
        image, colon, point = text.rpartition(":")
        if not colon or not image or not point:
            raise UsageError(f"is {text!r}", where="--leave-out", do="write image:point, as photo.jpg:A1")
        pairs.append((image, point))
    return CalibrationOptions(
        Options(outliers="reject" if reject else "keep"), sigma,
        None if control is None else read_control(control), tuple(pairs), components, level, workers,
        refraction=None if refraction is None else RefractionFile.read(refraction),
    )  # fmt: skip


def _processes(images: list[Path], jobs: int | None) -> int:
    """Number of processes for the photographs; start them early so that they import in the background."""
    from ..core.processes import cores, start_early
    from ..io import is_points

    count = max(1, min(jobs or cores(), sum(not is_points(path) for path in images)))
    if count > 1:
        start_early(["reseau.procedures.target_measurement"])
    return count


def _calibration(done: Calibrated, name: str, provenance: Provenance) -> Calibration:
    """The calibration, with the entries of the model search."""
    return done.calibration(name, provenance.to_dict())


def _write_report(
    path: Path,
    done: Calibrated,
    title: str,
    provenance: Provenance,
    differences: dict[str, FieldDifference],
    distances: list[float] | None,
) -> None:
    from ..io import write_whole
    from ..report.bundle import bundle_report

    page = bundle_report(
        done.result, title=title, provenance=provenance, against=differences, distances=distances or ()
    )
    write_whole(path, page)


def _frames(
    paths: list[Path], channel: Channel, sensor: Path | None, step: Callable[[str], None]
) -> Iterator[Frame | tuple[str, ImagePoints]]:
    """Photographs, or measured image coordinates, in order."""
    from ..io import is_points, read_measurement

    for path in paths:
        step(f"measuring {path.name}")
        if is_points(path):
            yield path.name, read_measurement(path).image_points()
        else:
            yield corrected(read_frame(path, channel.value), sensor)


def _camera(model: str, pitch: float | None, side: str | None, more: list[str], free: str) -> CameraOptions:
    """Camera model and parameters from the options of the command."""
    from ..core.errors import UsageError
    from ..procedures.calibration import CameraOptions

    options: dict[str, str | float] = {} if side is None else {"side": side}
    for text in more:
        name, equals, value = text.partition("=")
        if not equals or name in options:
            raise UsageError(f"is {text!r}", where="--model-option", do="write name=value, each name once")
        options[name] = value
    names = tuple(name.strip() for name in free.split(",") if name.strip())
    return CameraOptions(model, names, None if pitch is None else (pitch, pitch), options)


def _size(text: str) -> tuple[int, int] | None:
    from ..core.errors import UsageError

    if not text:
        return None
    width, _, height = text.replace("×", "x").partition("x")
    if not width.isdigit() or not height.isdigit():
        raise UsageError(f"is {text!r}", where="--size", do="write 640x480")
    return int(width), int(height)


def _differences(done: Calibrated, others: dict[str, CameraMapping]) -> dict[str, FieldDifference]:
    from ..bundle import camera_mapping
    from ..calibration import calibration_difference

    return {
        name: calibration_difference(camera_mapping(done.result, 0), lens) for name, lens in others.items()
    }


def _say(done: Calibrated, differences: dict[str, FieldDifference], distances: list[float]) -> None:
    import numpy as np

    from ..bundle import camera_mapping, projection_field_at, sigma_between_images
    from ..calibration import projection_field

    result = done.result
    count = sum(len(points) for points in done.measured.values())
    say(f"{len(done.measured)} images, {count} image points, redundancy {result.redundancy}\n")
    say(f"sigma0 {result.sigma0:.4g}")
    v = result.residuals[~result.rejected]
    v = v[np.isfinite(v).all(axis=1)]
    say(f", residuals {np.sqrt((v**2).mean()):.3g} px rms, {int(result.rejected.sum())} left out\n")
    say_parameters(result.camera(0), sigma_between_images(result, 0))
    if result.refraction is not None:
        say("windows and media\n")
        say_refraction(result.refraction)
    sigma = projection_field(camera_mapping(result, 0)).sigma
    middle, worst = np.nanmedian(sigma), np.nanmax(sigma)
    say(f"uncertainty of the projection: median {middle:.2g} px over the image, at most {worst:.2g} px\n")
    for away in distances:
        sigma = projection_field_at(result, 0, away).sigma
        middle, worst = np.nanmedian(sigma), np.nanmax(sigma)
        say(f"  at {away:g} {result.network.unit}: median {middle:.2g} px, at most {worst:.2g} px\n")
    say_model(done.result)
    for name, found in differences.items():
        say_difference(name, found)
    say_left_out(result)
    for name, why in done.declined.items():
        say(f"left out: {name}: {why}\n")
    for warning in result.warnings:
        say(f"warning: {warning}\n")
