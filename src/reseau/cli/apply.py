"""`reseau apply`: correct points, images, scans or frames with a calibration of any kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import made_folder, writable
from ..core.options import Option
from .calibrations import time_of
from .common import Place, progress, say, say_files_left_out, say_json, say_notes

if TYPE_CHECKING:
    from ..calibration import Calibration
    from ..procedures.applying import Application, View


_IMAGES = (".tif", ".tiff", ".png", ".jpg", ".jpeg")
_OF = {
    "camera": "a camera",
    "oscilloscope": "an oscilloscope",
    "film_frame": "a film frame",
    "fiducials": "a photograph with fiducial marks",
    "sensor": "a sensor",
}


def apply(
    calibration: Annotated[
        Path,
        typer.Argument(
            help="Calibration of a camera, an oscilloscope, a film frame, fiducial marks or a sensor; for a "
            "folder of scans the one that `reseau orient` wrote; with --archive the name of a configuration."
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
        Option(
            "Resolution of the corrected image: pixels per mm, or for a camera per pixel of the image. "
            "Default: that of the image."
        ),
    ] = None,
    fov: Annotated[
        str,
        Option(
            "Field of view of an undistorted image: keep (size and scale of the image), "
            "all (every pixel of the image), or the horizontal angle in degrees."
        ),
    ] = "keep",
    opencv_alpha: Annotated[
        float | None,
        Option(
            "In place of --fov: from 0, only pixels that the image has, to 1, all pixels of the image; "
            "the size stays, as in OpenCV.",
            least=0.0,
            most=1.0,
        ),
    ] = None,
    tables: Annotated[
        Path | None,
        Option(
            "Tables of the undistorted image to write: .npz, .yml or .xml for OpenCV's remap, .pgm (two "
            "files) for the filter remap of ffmpeg."
        ),
    ] = None,
    inverse: Annotated[
        bool,
        Option("Distort points: undistorted pixels, or --directions."),
    ] = False,
    directions: Annotated[
        bool,
        Option("Write points of a camera as directions x/z, y/z instead of pixels."),
    ] = False,
    object_coordinates: Annotated[
        bool, Option("Write points of an oscilloscope in the object coordinate system.")
    ] = False,
    exposure_ms: Annotated[
        float | None,
        Option("Exposure time of the frame (ms). Default: that of the calibration.", least=0.0),
    ] = None,
    archive: Annotated[v.Archive | None, "Here with the calibrations in force of a configuration."] = None,
    objects: v.Objects | None = None,
    at: Annotated[v.At | None, "Here when the image was taken; required with --archive."] = None,
    anyway: v.Anyway = False,
    as_json: v.AsJson = False,
) -> None:
    """Apply a calibration to points or to an image.

    Corrected points have covariances that include those of the points and of the calibration. Images are
    resampled: without distortion (camera), in the system of the reseau (oscilloscope), or in millimetres of
    the frame (film frame, fiducial marks). With the calibration of a sensor, the grey values are corrected.
    """
    from ..calibration import read_calibration
    from ..core.provenance import sha256_of
    from ..io.reading import is_points
    from ..io.stacks import VIDEOS
    from ..procedures.applying import Application, View

    if scale is not None and not scale > 0:
        raise UsageError(f"{scale:g} is not positive", where="--scale")
    from_file = archive is None or calibration.is_file()
    in_archive = {"--at": at, "--objects": objects} if from_file else {}
    for name, given in in_archive.items():
        if given is not None:
            raise UsageError("needs --archive, and the name of a configuration", where=name)
    view = View(_fov(fov), scale, opencv_alpha)
    if calibration.is_dir() and archive is None:
        _roll(calibration, source, view, out, as_json)
        return
    if archive is None or from_file:
        stored, origin = read_calibration(calibration), {calibration.name: sha256_of(calibration)}
    else:
        stored, origin = _in_force(archive, objects, str(calibration), at)
    if opencv_alpha is not None and fov != "keep":
        raise UsageError("cannot be combined", where="--fov and --opencv-alpha")
    of_camera = {
        "--fov": fov != "keep", "--opencv-alpha": opencv_alpha is not None, "--directions": directions,
        "--tables": tables is not None, "--inverse": inverse,
    }  # fmt: skip
    _only(stored.kind, "camera", of_camera)
    _only(stored.kind, "oscilloscope", {"--object-coordinates": object_coordinates})
    _only(stored.kind, "sensor", {"--exposure-ms": exposure_ms is not None})
    applied = Application.of(stored, view, object_system=object_coordinates, origin=origin, anyway=anyway)
    say_notes((*applied.notes, *(() if source is None or is_points(source) else applied.about(source))))
    if out is not None and not (source is not None and source.is_dir()):
        beside = [out.with_suffix(".json")] if stored.kind == "camera" else []
        _spare([calibration, *([source] if source is not None else [])], [out, *beside])
    if tables is not None:
        _tables(applied, tables)
        if source is None:
            return
    if source is None:
        raise UsageError("is missing", where="SOURCE", do="give an image, a folder, a video or points")
    if is_points(source):
        _points(applied, source, out, as_json, inverse, directions)
    elif inverse:
        raise UsageError("applies to points only", where="--inverse")
    elif object_coordinates or directions:
        where = "--object-coordinates" if object_coordinates else "--directions"
        raise UsageError("applies to points only", where=where)
    elif stored.kind == "sensor":
        _frame(applied, source, out, exposure_ms, as_json)
    elif source.is_dir():
        from ..procedures.exposures import photographs_in

        say_files_left_out([source])
        images = [(path, path.stem, applied) for path in photographs_in(source)]
        _folder(images, source, out, as_json, calibration)
    elif source.suffix.lower() in VIDEOS:
        _video(applied, source, out)
    else:
        _image(applied, source, out, as_json)


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


def _fov(text: str) -> Literal["keep", "all"] | float:
    """Parse the field of view.

    Raises
    ------
    UsageError
        If it is invalid.
    """
    if text in ("keep", "all"):
        return cast(Literal["keep", "all"], text)
    try:
        return float(text.removesuffix("°"))
    except ValueError:
        raise UsageError(
            f"cannot interpret {text!r}", where="--fov", do="write keep, all or an angle in degrees"
        ) from None


def _points(
    applied: Application, source: Path, out: Path | None, as_json: bool, inverse: bool, directions: bool
) -> None:
    """Correct points; for a camera, to pixels of the undistorted image, or to directions."""
    from ..io import write_whole

    suffix = ".csv" if out is None else writable(out, ".csv", ".json").suffix.lower()
    found = applied.points(source, inverse=inverse, directions=directions)
    if out is not None:
        write_whole(out, found.to_json() if suffix == ".json" else found.to_csv())
    if as_json:
        say(found.to_json())
    elif out is None:
        say(found.to_csv())
    else:
        say(f"{out}: {len(found.points)} points in {found.unit}\n")
    _warn(found.points.names, found.why)


def _tables(applied: Application, path: Path) -> None:
    """Write the tables of the undistorted image."""
    files, raster = applied.tables(writable(path)), applied.raster()
    say("".join(f"{file}: {raster.width} × {raster.height} px\n" for file in files))
    if len(files) == 2:
        # Without the format, ffmpeg takes the numbers of some tables for music.
        tables = " ".join(f"-f image2 -i {file}" for file in files)
        say(f"ffmpeg -i video.mp4 {tables} -lavfi remap undistorted.mp4\n")


def _roll(orientations: Path, source: Path | None, view: View, out: Path | None, as_json: bool) -> None:
    """Resample the oriented frames of a folder of scans."""
    from ..procedures.applying import oriented_roll

    if source is None or not source.is_dir():
        raise UsageError("is a folder of orientations", where=orientations, do="give the folder of the scans")
    frames: list[tuple[Path, str, Application]] = []
    for scan, found in oriented_roll(orientations, source, view):
        frames += [(scan, name, applied) for name, applied in found]
        if not found:
            typer.echo(f"left out: {scan.name}: is not oriented in {orientations}", err=True)
    _folder(frames, source, out or source.with_name(f"{source.resolve().name}-frames"), as_json, orientations)


def _folder(
    images: list[tuple[Path, str, Application]],
    source: Path,
    out: Path | None,
    as_json: bool,
    calibration: Path,
) -> None:
    """Resample the images of a folder into another; one that cannot be read costs one line."""
    from ..core.errors import ImageError, InputError

    out = out or source.with_name(f"{source.resolve().name}-undistorted")
    if out.resolve() == source.resolve():
        raise UsageError("is the folder of the images", where=out, do="choose another one")
    made_folder(out)
    done = 0
    for image, name, applied in images:
        suffix = image.suffix if image.suffix.lower() in _IMAGES else ".png"
        try:
            _spare([calibration], [out / f"{name}.json"])
            _image(applied, image, out / f"{name}{suffix}", as_json)
            done += 1
        except (ImageError, UsageError) as error:
            typer.echo(f"left out: {error}", err=True)
    if not done:
        raise InputError(f"none of its {len(images)} images could be corrected", where=source)


def _video(applied: Application, source: Path, out: Path | None) -> None:
    """Undistort a video."""
    suffix = ".mp4" if source.suffix.lower() == ".webm" else source.suffix
    out = writable(out or source.with_name(f"{source.stem}-undistorted{suffix}"))
    with progress(f"undistorting {source.name}", 0) as step:
        count = applied.video(source, out, step)
    raster = applied.raster()
    say(f"{out}: {count} frames of {raster.width} × {raster.height} px\n")


def _warn(names: tuple[str, ...], why: tuple[str, ...]) -> None:
    """Warn of points outside the validity: the first ones, and the number of the others."""
    found = [f"point {name} {reason}" for name, reason in zip(names, why, strict=True) if reason]
    if len(found) > 3:
        found = [*found[:2], f"{len(found) - 2} more points are outside the validity, see the column `why`"]
    for line in found:
        typer.echo(f"warning: {line}", err=True)


def _image(applied: Application, source: Path, out: Path | None, as_json: bool) -> None:
    """Resample an image; for a camera, also write the parameters of the pinhole camera of the result."""
    from ..core.provenance import canonical_json

    kind = applied.calibration.kind
    suffix = {"camera": "undistorted", "film_frame": "frame", "fiducials": "frame"}.get(kind, "corrected")
    out = out or source.with_name(f"{source.stem}-{suffix}{source.suffix}")
    writable(out, *_IMAGES)
    with progress(f"resampling {source.name}", 0) as step:
        raster, camera, provenance = applied.image(source, out, step)
    if as_json:
        content = raster.to_dict() | {"image": str(out), "provenance": provenance.to_dict()}
        say(canonical_json(content) if camera is None else camera.to_json())
    elif camera is not None:
        p = raster.pinhole
        say(f"{out}: {p['width']} × {p['height']} px, fx {p['fx']:.2f}, fy {p['fy']:.2f}, ")
        say(f"cx {p['cx']:.2f}, cy {p['cy']:.2f} px\n")
        say(f"{out.with_suffix('.json')}: camera of the undistorted image\n")
    else:
        (x, y), unit = raster.origin, applied.mapping.unit
        say(
            f"{out}: {raster.width} × {raster.height} px, {raster.scale[0]:.6g} px/{unit}, "
            f"first pixel at ({x:.6g}, {y:.6g}) {unit}\n"
        )


def _frame(
    applied: Application, source: Path, out: Path | None, exposure_ms: float | None, as_json: bool
) -> None:
    """Correct the grey values of a frame: a TIFF of floats, or a PNG of 16 bit up to the full scale."""
    out = out or source.with_name(f"{source.stem}-corrected.tif")
    suffix = writable(out, ".tif", ".tiff", ".png").suffix.lower()
    found = applied.frame(source, out, None if exposure_ms is None else 1000 * exposure_ms)
    if as_json:
        content = {"image": str(out), "dn_per_step": found.dn_per_step, "full_scale_dn": found.full_scale}
        say_json(content | {"provenance": found.provenance.to_dict()})
    else:
        kind = f"16 bit, {found.dn_per_step:.6g} DN per step" if suffix == ".png" else "32 bit float"
        say(f"{out}: {found.width} × {found.height} px, {kind}, full scale {found.full_scale:.6g} DN\n")
