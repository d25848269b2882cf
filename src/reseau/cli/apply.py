"""`reseau apply`: correct points, images, scans or frames with a calibration of any kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.options import Option
from .calibrations import time_of
from .common import Place, progress, say, say_files_left_out, suffix_of, writable

if TYPE_CHECKING:
    from ..calibration import CalibratedMapping, Calibration, CorrectedImage, SensorCorrection
    from ..core.data import ImagePoints

__all__ = ["apply"]

_IMAGES = (".tif", ".tiff", ".png", ".jpg", ".jpeg")
_OF = {
    "camera": "a camera",
    "oscilloscope": "an oscilloscope",
    "film_frame": "a film frame",
    "fiducials": "a photograph with fiducial marks",
    "sensor": "a sensor",
}

View = Literal["keep", "all"] | float


def apply(
    calibration: Annotated[
        Path,
        typer.Argument(
            help="Calibration of a camera, an oscilloscope, a film frame, fiducial marks or a sensor; "
            "with --archive the name of a configuration."
        ),
    ],
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="IMAGE|FOLDER|VIDEO|POINTS",
            help="Image, folder of images, video, or image coordinates (JSON, CSV).",
        ),
    ] = None,
    out: v.Out | None = None,
    scale: Annotated[
        float | None,
        typer.Option(
            help="Resolution of the corrected image: pixels per mm, or for a camera per pixel of the image. "
            "Default: that of the image."
        ),
    ] = None,
    fov: Annotated[
        str,
        typer.Option(
            help="Field of view of an undistorted image: keep (size and scale of the image), "
            "all (every pixel of the image), or the horizontal angle in degrees."
        ),
    ] = "keep",
    opencv_alpha: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="In place of --fov: from 0, only pixels that the image has, to 1, all pixels of the image; "
            "the size stays, as in OpenCV.",
        ),
    ] = None,
    tables: Annotated[
        Path | None,
        typer.Option(
            help="Tables of the undistorted image to write: .npz, .yml or .xml for OpenCV's remap, .pgm (two "
            "files) for the filter remap of ffmpeg."
        ),
    ] = None,
    inverse: Annotated[
        bool,
        typer.Option("--inverse", help="Distort points: undistorted pixels, or --directions."),
    ] = False,
    directions: Annotated[
        bool,
        typer.Option(
            "--directions", help="Write points of a camera as directions x/z, y/z instead of pixels."
        ),
    ] = False,
    object_coordinates: Annotated[
        bool, Option("Write points of an oscilloscope in the object coordinate system.")
    ] = False,
    exposure_ms: Annotated[
        float | None,
        typer.Option(min=0.0, help="Exposure time of the frame (ms). Default: that of the calibration."),
    ] = None,
    archive: Annotated[v.Archive | None, "Here with the calibrations in force of a configuration."] = None,
    objects: v.Objects | None = None,
    at: Annotated[v.At | None, "Here when the image was taken; required with --archive."] = None,
    as_json: v.AsJson = False,
) -> None:
    """Apply a calibration to points or to an image.

    Corrected points have covariances that include those of the points and of the calibration. Images are
    resampled: without distortion (camera), in the system of the reseau (oscilloscope), or in millimetres of
    the frame (film frame, fiducial marks). With the calibration of a sensor, the grey values are corrected.
    """
    from ..calibration import SensorCorrection, read_calibration
    from ..core.provenance import sha256_of
    from ..io import is_points
    from ..io.stacks import VIDEOS

    if scale is not None and not scale > 0:
        raise UsageError(f"{scale:g} is not positive", where="--scale")
    from_file = archive is None or calibration.is_file()
    in_archive = {"--at": at, "--objects": objects} if from_file else {}
    for name, given in in_archive.items():
        if given is not None:
            raise UsageError("needs --archive, and the name of a configuration", where=name)
    if archive is None or from_file:
        stored, origin = read_calibration(calibration), {calibration.name: sha256_of(calibration)}
    else:
        stored, origin = _in_force(archive, objects, str(calibration), at)
    view = _View(_fov(fov), scale, opencv_alpha)
    if opencv_alpha is not None and fov != "keep":
        raise UsageError("cannot be combined", where="--fov and --opencv-alpha")
    of_camera = {
        "--fov": fov != "keep", "--opencv-alpha": opencv_alpha is not None, "--directions": directions,
        "--tables": tables is not None, "--inverse": inverse,
    }  # fmt: skip
    _only(stored.kind, "camera", of_camera)
    _only(stored.kind, "oscilloscope", {"--object-coordinates": object_coordinates})
    _only(stored.kind, "sensor", {"--exposure-ms": exposure_ms is not None})
    mapping = _mapping(stored, object_coordinates)
    if out is not None and not (source is not None and source.is_dir()):
        beside = [out.with_suffix(".json")] if stored.kind == "camera" else []
        _spare([calibration, *([source] if source is not None else [])], [out, *beside])
    if tables is not None:
        _tables(mapping, tables, view)
        if source is None:
            return
    if source is None:
        raise UsageError("is missing", where="SOURCE", do="give an image, a folder, a video or points")
    if is_points(source):
        _points(mapping, source, out, as_json, None if directions else view, view, inverse)
    elif inverse:
        raise UsageError("applies to points only", where="--inverse")
    elif object_coordinates or directions:
        where = "--object-coordinates" if object_coordinates else "--directions"
        raise UsageError("applies to points only", where=where)
    elif isinstance(mapping, SensorCorrection):
        _frame(mapping, origin, source, out, exposure_ms, as_json)
    elif source.is_dir():
        _folder(stored, mapping, origin, source, out, view, as_json, calibration)
    elif source.suffix.lower() in VIDEOS:
        _video(stored, mapping, source, out, view)
    else:
        _image(stored, mapping, origin, source, out, view, as_json)


def _in_force(
    archive: str, objects: str | None, name: str, at: str | None
) -> tuple[Calibration, dict[str, str]]:
    """The calibration of a configuration that applies at a time, and its SHA-256 by its name.

    Raises
    ------
    UsageError
        If no time is given, or no calibration applies.
    """
    from ..core.provenance import sha256_of
    from ..service import Configurations

    time = time_of(at, "--at")
    if time is None:
        raise UsageError("is needed with --archive", where="--at", do="say when the image was taken")
    with Place(archive, objects).open() as found:
        applied = Configurations(found).applied(name, time)
    if applied is None:
        raise UsageError(f"has no calibration in force at {time:%Y-%m-%d %H:%M}Z", where=name)
    stored = applied.calibration
    return stored, {f"{name} {applied.key}": sha256_of(stored.to_json().encode("utf-8"))}


def _spare(inputs: list[Path], outputs: list[Path]) -> None:
    """Refuse to write over an input.

    Raises
    ------
    UsageError
        If a file to be written is one of those that are read.
    """
    for path in outputs:
        if any(given.exists() and path.exists() and path.samefile(given) for given in inputs):
            raise UsageError("is an input of this command", where=path, do="choose another name for --out")


def _only(kind: str, required: str, options: dict[str, bool]) -> None:
    """Refuse options that need another kind of calibration.

    Raises
    ------
    UsageError
        If such an option is used.
    """
    for name, used in options.items():
        if used and kind != required:
            raise UsageError(f"needs a calibration of {_OF[required]}, not of {_OF[kind]}", where=name)


class _View(NamedTuple):
    """Field of view of an undistorted image, and its resolution."""

    fov: View
    scale: float | None
    alpha: float | None


def _fov(text: str) -> View:
    """Parse the field of view.

    Raises
    ------
    UsageError
        If it is invalid.
    """
    if text in ("keep", "all"):
        return cast(View, text)
    try:
        return float(text.removesuffix("°"))
    except ValueError:
        raise UsageError(
            f"cannot interpret {text!r}", where="--fov", do="write keep, all or an angle in degrees"
        ) from None


def _mapping(stored: Calibration, object_system: bool) -> CalibratedMapping:
    """Return the mapping; for an oscilloscope only group A, unless object coordinates are requested.

    Raises
    ------
    UsageError
        If the calibration has no group B.
    """
    from ..calibration import InstrumentCorrection

    mapping = stored.mapping()
    if isinstance(mapping, InstrumentCorrection):
        return mapping if object_system else mapping.camera
    if object_system:
        raise UsageError(
            "needs a calibration with group B",
            where="--object-coordinates",
            do="calibrate with reseau refine --photo-ii and --test-object",
        )
    return mapping


def _raster(mapping: CalibratedMapping, size: tuple[int, int], view: _View) -> CorrectedImage:
    """Return the raster of the corrected image."""
    from ..calibration import (
        CameraCorrection,
        CameraMapping,
        CorrectedImage,
        FiducialMapping,
        FilmFrameMapping,
    )

    fov, scale, alpha = view
    if isinstance(mapping, CameraMapping):
        return CorrectedImage.undistorted(mapping, fov, 1.0 if scale is None else scale, alpha)
    if isinstance(mapping, FilmFrameMapping | FiducialMapping):
        return CorrectedImage.of_frame(mapping, scale)
    assert isinstance(mapping, CameraCorrection)
    return CorrectedImage.plan(mapping, size, scale)


def _points(
    mapping: CalibratedMapping,
    source: Path,
    out: Path | None,
    as_json: bool,
    shown: _View | None,
    view: _View,
    inverse: bool,
) -> None:
    """Correct points; for a camera, to pixels of the undistorted image, or without `shown` to directions."""
    from ..calibration import CameraMapping
    from ..core.provenance import canonical_json
    from ..io import points_document, write_whole

    if "points" not in mapping.applies_to:
        raise UsageError("a sensor calibration corrects images, not points", where=source, do="give an image")
    suffix = ".csv" if out is None else suffix_of(writable(out), (".csv", ".json"))
    more: dict[str, Any] = {}
    raster = None
    if isinstance(mapping, CameraMapping) and shown is not None:
        raster = _raster(mapping, mapping.size, view)
        more = {"camera": raster.pinhole}
    given = "image" if not inverse else mapping.system if raster is None else "undistorted"
    measured = _measured(source, given, more if inverse else {})
    if inverse:
        points = mapping.inverse(measured if raster is None else _to_directions(measured, raster))
        why, unit, system = mapping.why_not(points), "px", "image"
    else:
        points, why = mapping.apply(measured), mapping.why_not(measured)
        unit, system = mapping.unit, mapping.system
        if raster is not None:
            points, unit, system = _in_pixels(points, raster), "px", "undistorted"
    content, text = points_document(points, unit, system) | more, points.to_csv()
    if any(why):
        content["points"] = _nullable(content["points"]) | {"ok": [not w for w in why], "why": list(why)}
        head, *lines = text.splitlines()
        rows = [f"{line},{int(not w)},{w}" for line, w in zip(lines, why, strict=True)]
        text = "\n".join([f"{head},ok,why", *rows]) + "\n"
    document = canonical_json(content)
    if out is not None:
        write_whole(out, document if suffix == ".json" else text)
    if as_json:
        say(document)
    elif out is None:
        say(text)
    else:
        say(f"{out}: {len(points)} points in {unit}\n")
    _warn(points.names, why)


def _measured(source: Path, system: str, camera: dict[str, Any]) -> ImagePoints:
    """Read points, also those that this command wrote, with their covariances and their `camera`.

    Raises
    ------
    UsageError
        If the points are in another coordinate system, or in an undistorted image of another camera.
    FormatError
        If the file is incomplete.
    """
    import json

    import numpy as np

    from ..io import POINTS, points_of, read_measurement, read_text

    try:
        content = json.loads(read_text(source)) if source.suffix.lower() == ".json" else None
    except ValueError:
        content = None
    if not isinstance(content, dict) or content.get("schema") != POINTS:
        return read_measurement(source).image_points()
    if content.get("system") != system:
        raise UsageError(f"has points of the system {content.get('system')}, not {system}", where=source)
    for key, pinhole in camera.items():
        own = content.get(key) or {}
        if any(abs(own.get(name, np.inf) - value) > 1e-6 for name, value in pinhole.items()):
            raise UsageError(
                "has points of another undistorted image", where=source,
                do="repeat --fov, --opencv-alpha or --scale as for that one",
            )  # fmt: skip
    return points_of(content, source)


def _in_pixels(points: ImagePoints, raster: CorrectedImage) -> ImagePoints:
    """Convert directions to pixels of the undistorted image."""
    import numpy as np

    from ..core.data import ImagePoints

    slope = np.diag(raster.slope)
    return ImagePoints(points.names, raster.of_system(points.xy), slope @ points.cov @ slope)


def _to_directions(points: ImagePoints, raster: CorrectedImage) -> ImagePoints:
    """Convert pixels of the undistorted image to directions."""
    import numpy as np

    from ..core.data import ImagePoints

    slope = np.diag(1 / raster.slope)
    return ImagePoints(points.names, raster.to_system(points.xy), slope @ points.cov @ slope)


def _tables(mapping: CalibratedMapping, path: Path, view: _View) -> None:
    """Write the tables of the undistorted image."""
    from ..calibration import CameraMapping, write_tables

    assert isinstance(mapping, CameraMapping)
    raster = _raster(mapping, mapping.size, view)
    files = write_tables(writable(path), raster)
    say("".join(f"{file}: {raster.width} × {raster.height} px\n" for file in files))
    if len(files) == 2:
        # Without the format, ffmpeg takes the numbers of some tables for music.
        tables = " ".join(f"-f image2 -i {file}" for file in files)
        say(f"ffmpeg -i video.mp4 {tables} -lavfi remap undistorted.mp4\n")


def _folder(
    stored: Calibration,
    mapping: CalibratedMapping,
    origin: dict[str, str],
    source: Path,
    out: Path | None,
    view: _View,
    as_json: bool,
    calibration: Path,
) -> None:
    """Resample the images of a folder into another; one that cannot be read costs one line."""
    from ..core.errors import ImageError, InputError
    from ..procedures.exposures import photographs_in

    out = out or source.with_name(f"{source.resolve().name}-undistorted")
    if out.resolve() == source.resolve():
        raise UsageError("is the folder of the images", where=out, do="choose another one")
    images = photographs_in(source)
    say_files_left_out([source])
    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be created ({error.strerror})", where=out) from None
    done = 0
    for image in images:
        suffix = image.suffix if image.suffix.lower() in _IMAGES else ".png"
        try:
            _spare([calibration], [out / f"{image.stem}.json"])
            _image(stored, mapping, origin, image, out / f"{image.stem}{suffix}", view, as_json)
            done += 1
        except (ImageError, UsageError) as error:
            typer.echo(f"left out: {error}", err=True)
    if not done:
        raise InputError(f"none of its {len(images)} images could be corrected", where=source)


def _video(
    stored: Calibration, mapping: CalibratedMapping, source: Path, out: Path | None, view: _View
) -> None:
    """Undistort a video."""
    from ..calibration import CameraMapping, undistort_video

    if not isinstance(mapping, CameraMapping):
        raise UsageError("needs the calibration of a camera", where=source)
    suffix = ".mp4" if source.suffix.lower() == ".webm" else source.suffix
    out = writable(out or source.with_name(f"{source.stem}-undistorted{suffix}"))
    raster = _raster(mapping, mapping.size, view)
    with progress(f"undistorting {source.name}", 0) as step:
        count = undistort_video(source, out, raster, step)
    say(f"{out}: {count} frames of {raster.width} × {raster.height} px\n")


def _nullable(table: dict[str, list[Any]]) -> dict[str, list[Any]]:
    """Replace NaN by None, for points without a position."""
    return {
        key: [None if isinstance(v, float) and v != v else v for v in column] for key, column in table.items()
    }


def _warn(names: tuple[str, ...], why: tuple[str, ...]) -> None:
    """Warn of points outside the validity: the first ones, and the number of the others."""
    found = [f"point {name} {reason}" for name, reason in zip(names, why, strict=True) if reason]
    if len(found) > 3:
        found = [*found[:2], f"{len(found) - 2} more points are outside the validity, see the column `why`"]
    for line in found:
        typer.echo(f"warning: {line}", err=True)


def _image(
    stored: Calibration,
    mapping: CalibratedMapping,
    origin: dict[str, str],
    source: Path,
    out: Path | None,
    view: _View,
    as_json: bool,
) -> None:
    """Resample an image; for a camera, also write the parameters of the pinhole camera of the result."""
    from ..calibration import undistorted_camera, write_corrected
    from ..core.provenance import Provenance, canonical_json, sha256_of

    suffix = {"camera": "undistorted", "film_frame": "frame", "fiducials": "frame"}.get(
        stored.kind, "corrected"
    )
    out = out or source.with_name(f"{source.stem}-{suffix}{source.suffix}")
    suffix_of(writable(out), _IMAGES)
    planes = _planes(source, colours=stored.kind != "oscilloscope")
    height, width = planes[0].shape
    mapping.check_size(width, height, source)
    raster = _raster(mapping, (width, height), view)
    with progress(f"resampling {source.name}", raster.bands) as step:
        write_corrected(out, planes, raster, step)
    inputs = {source.name: sha256_of(source)} | origin
    if stored.kind == "camera":
        provenance = Provenance(inputs, {"fov": view.fov, "scale": view.scale, "alpha": view.alpha})
        camera, beside = undistorted_camera(raster, stored, provenance.to_dict()), out.with_suffix(".json")
        camera.write(beside)
        if as_json:
            say(camera.to_json())
        else:
            p = raster.pinhole
            say(f"{out}: {p['width']} × {p['height']} px, fx {p['fx']:.2f}, fy {p['fy']:.2f}, ")
            say(f"cx {p['cx']:.2f}, cy {p['cy']:.2f} px\n{beside}: camera of the undistorted image\n")
        return
    provenance = Provenance(inputs, {"scale": raster.scale[0]})
    if as_json:
        say(canonical_json(raster.to_dict() | {"image": str(out), "provenance": provenance.to_dict()}))
    else:
        (x, y), unit = raster.origin, mapping.unit
        say(
            f"{out}: {raster.width} × {raster.height} px, {raster.scale[0]:.6g} px/{unit}, "
            f"first pixel at ({x:.6g}, {y:.6g}) {unit}\n"
        )


def _planes(source: Path, *, colours: bool) -> tuple[Any, ...]:
    """Return the channels of an image, each (height, width); with `colours` false, only its grey values."""
    from ..calibration.raster import planes_of
    from ..io.images import open_scan, read_image

    return planes_of(open_scan(source)) if colours else (read_image(source).pixels,)


def _frame(
    correction: SensorCorrection,
    origin: dict[str, str],
    source: Path,
    out: Path | None,
    exposure_ms: float | None,
    as_json: bool,
) -> None:
    """Correct the grey values of a frame: a TIFF of floats, or a PNG of 16 bit up to the full scale."""
    import numpy as np

    from ..core.provenance import Provenance, canonical_json
    from ..io.images import read_image, write_image

    out = out or source.with_name(f"{source.stem}-corrected.tif")
    suffix = suffix_of(writable(out), (".tif", ".tiff", ".png"))
    exposure_us = None if exposure_ms is None else 1000 * exposure_ms
    frame = read_image(source)
    correction.check_size(frame.width, frame.height, source)
    found = correction.correct(frame, exposure_us)
    pixels, step = found.pixels, 1.0
    if suffix == ".png":
        step = found.full_scale / 65535
        pixels = np.clip(np.rint(pixels / step), 0, 65535).astype(np.uint16)
    write_image(out, pixels)
    used = correction.exposure_us if exposure_us is None else exposure_us
    inputs = {source.name: frame.sha256} | origin
    if as_json:
        content = {"image": str(out), "dn_per_step": step, "full_scale_dn": found.full_scale}
        provenance = Provenance(inputs, {"exposure_us": used})
        say(canonical_json(content | {"provenance": provenance.to_dict()}))
    else:
        kind = f"16 bit, {step:.6g} DN per step" if suffix == ".png" else "32 bit float"
        say(f"{out}: {found.width} × {found.height} px, {kind}, full scale {found.full_scale:.6g} DN\n")
