"""`reseau calibrate`: calibrate a camera, or a rig of cameras, from photographs of a target."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import UsageError
from .bundle_compare import read_lens
from .bundle_options import (
    ComponentsOf,
    Distances,
    Eliminate,
    Memory,
    Reject,
    component_kind,
    level_of,
    outputs,
    positive,
    say_difference,
    say_left_out,
    say_model,
    say_motion,
    say_parameters,
    say_priors,
    say_refraction,
    say_rig,
    say_turntable,
)
from .common import (
    AsJson,
    Channel,
    ClusterAddress,
    Jobs,
    SensorFile,
    Store,
    overlay_files,
    progress,
    read_frame,
    remark_lines,
    required,
    say,
    say_files_left_out,
    sensor_correction,
)

if TYPE_CHECKING:
    from ..bundle import BoardChoice, Kind, ModelChoice
    from ..calibration import CameraMapping, FieldDifference, ProjectionField
    from ..core.data import Frame
    from ..core.provenance import Provenance
    from ..execution import Executor
    from ..io import BoardDesign, ReseauDesign, TestfieldDesign
    from ..procedures.calibrated import Calibrated
    from ..procedures.calibration_options import CalibrationOptions, CameraOptions
    from ..procedures.exposures import Taken
    from ..procedures.target_measurement import Photograph

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


class Target(StrEnum):
    """Model of the target."""

    FREE = "free"
    FLAT = "flat"
    AUTO = "auto"


LeaveOut = Annotated[
    list[str] | None, typer.Option(help="Image point to leave out, e.g. photo.jpg:A1; repeatable.")
]


def calibrate(
    images: Annotated[
        list[Path] | None,
        typer.Argument(help="Photographs of the target, folders of them, or measured image coordinates."),
    ] = None,
    design: Annotated[
        Path,
        typer.Option(
            "--design",
            "-d",
            help="Design of the testfield, board or reseau; by default it is looked for, among designs "
            "beside the photographs, in the folder above and the current one, and those that `reseau design` "
            "draws.",
        ),
    ] = Path("auto"),
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILES",
            help="Photographs of one of several cameras that are fixed to each other, in place of IMAGES: a "
            "folder or a pattern, e.g. 'left=left/*.png'; repeatable. Files with the same name, or the same "
            "last number in it, were taken at once.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to write: report, calibrations, files for OpenCV, ROS and COLMAP, and undistorted "
            "samples; by default, without --json, beside that of the photographs, which is called photos: "
            "photos-calibration. With the suffix .json the file of the calibration alone.",
        ),
    ] = None,
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
            help="Camera model, of all cameras; by default, or with `auto`, one is chosen for each camera. "
            "With --free alone brown with --pitch, otherwise opencv. An unknown name lists all.",
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
    rolling: Annotated[
        float | None,
        typer.Option(
            "--rolling-shutter",
            metavar="SECONDS",
            help="The sensor is read line by line while the camera moves; time from one line to the next "
            "(negative: from the last line on). The motion during each image is estimated.",
        ),
    ] = None,
    motion: Annotated[
        str,
        typer.Option(
            help="Components of the motion to estimate with a rolling shutter, by default vx,vy,vz,wx,wy,wz; "
            "with a narrow lens vx,vy,wz."
        ),
    ] = "",
    size: Annotated[
        str, typer.Option(help="Width×height in pixels, e.g. 640x480; required without photographs.")
    ] = "",
    channel: Annotated[Channel, typer.Option(help="Channel of colour images.")] = Channel.LUMA,
    sensor: SensorFile = None,
    sigma: Sigma = None,
    control: Control = None,
    refraction: Refraction = None,
    turntable: Annotated[
        Path | None,
        typer.Option(
            help="Angles of a turntable that carried the target, or the camera: CSV "
            "image,angle_deg[,sigma_deg][,pose]; its axis is estimated."
        ),
    ] = None,
    target_points: Annotated[
        Target,
        typer.Option(
            "--target",
            help="Points of the target: all free, flat as designed, or chosen by a test, which also says how "
            "much the target is bent.",
        ),
    ] = Target.FREE,
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
    memory: Memory = None,
    jobs: Jobs = None,
    cluster: ClusterAddress = "",
    store: Store = "",
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera from photographs of a target."""
    photographs, taken = _photographs(images or [], camera or [])
    files = list(photographs.values())
    executor = _executor(files, jobs, cluster, store)
    if overlay is not None and not executor.local:
        raise UsageError("is drawn by this machine only", where="--overlay", do="leave out --cluster")
    import numpy as np

    from ..core.provenance import sha256_of
    from ..exchange import read_target
    from ..execution import Outputs
    from ..io import write_whole
    from ..io.photographs import read_exif
    from ..measure import TestfieldOptions
    from ..procedures.calibration import calibrate_camera
    from ..procedures.exposures import photograph_reader, photographs_of
    from ..procedures.target_measurement import drawing_overlays, measurer_of
    from ..report.bundle import bundle_report
    from ..report.calibration_folder import calibration_folder

    folder = _folder(out, files, as_json)
    outputs(None if folder else out, report)
    drawn = {} if overlay is None else overlay_files(overlay, files)
    distance = positive(distance)
    kind, automatic = component_kind(components), str(design) == "auto"
    target = _found_target(files, channel, sensor) if automatic else read_target(design)
    others = {path.name: read_lens(path) for path in against or []}
    if others and taken:
        raise UsageError("requires one camera", where="--against", do="compare the cameras one by one")
    level = level_of(eliminate, "--eliminate")

    options = _options(
        sigma, control, refraction, leave_out or [], reject, kind, level, target_points, turntable, memory
    )
    lens = _camera(model, pitch, side, model_option or [], free, rolling, motion)
    measure = measurer_of(target, TestfieldOptions(row_jitter_px=row_jitter, fill=fill))
    measure = drawing_overlays(
        measure, {name: drawn[path] for name, path in photographs.items() if path in drawn}
    )
    read = photograph_reader(channel.value, None if sensor is None else sensor_correction(sensor))
    about = {
        "compute": "points of a target", "design": sha256_of(target.to_json().encode()), "fill": fill,
        "channel": channel.value, "row_jitter": row_jitter, "sensor": sha256_of(sensor) if sensor else None,
    }  # fmt: skip
    # Overlays are drawn while photographs are measured.
    kept = Outputs(store, about) if store and not drawn else None
    with executor, progress("measuring", len(files)) as step:
        said, frames = photographs_of(list(photographs.items()), read, one_lens=not taken, store=store)
        options = replace(options, focal_35_mm=said)
        found = calibrate_camera(
            _shown(frames, step), target, measure, _size(size), lens, options, taken or None, executor, kept
        )
        done = required(found, _named(files))
    for note in done.notes:
        typer.echo(f"note: {note}", err=True)
    named = (None if automatic else design, control, refraction, turntable, sensor)
    inputs = {path.name: path for path in named if path} | photographs
    provenance = _provenance(
        inputs,
        model=lens.model, pitch=pitch, options=dict(lens.options), free=free, sigma=sigma,
        reject=reject, row_jitter=row_jitter, fill=fill, channel=channel.value, eliminate=eliminate,
        leave_out=list(leave_out or []), components=kind, rolling_shutter=rolling, motion=motion or None,
        **({} if memory is None else {"memory": memory}),
    )  # fmt: skip
    differences = _differences(done, others)
    calibrations = [
        done.calibration(entry.id if taken else target.name, provenance.to_dict(), entry.id)
        for entry in done.result.network.cameras
    ]
    if report is not None or folder is not None:
        page = bundle_report(
            done.result, title=f"Calibration with {target.name}", provenance=provenance, against=differences,
            distances=distance, assessments=done.assessments, photograph=_pictures(photographs, channel),
            declined=done.declined,
            days=sorted({day for path in photographs.values() if (day := read_exif(path).day)}),
        )  # fmt: skip
    if report is not None:
        write_whole(report, page)
    written = list[tuple[str, str]]()
    if folder is not None:
        with progress("writing", 0) as step:
            network = done.result.network
            used = {
                entry.id: [photographs[network.images[i]] for i in np.flatnonzero(network.camera_of == c)]
                for c, entry in enumerate(network.cameras)
            }
            written = calibration_folder(folder, calibrations, page, used, step)
    elif out is not None:
        for calibration, path in zip(calibrations, done.files(out).values(), strict=True):
            calibration.write(path)
    if as_json:
        say("".join(calibration.to_json() for calibration in calibrations))
    else:
        _say(done, differences, distance or [])
    if folder is not None and not as_json:
        say(f"written: {folder}\n")
        say("".join(f"  {name:26} {what}\n" for name, what in written))


def _folder(out: Path | None, files: list[Path], as_json: bool) -> Path | None:
    """The folder for all results, made before anything is computed; None where one file or none is wanted."""
    from ..report.calibration_folder import folder_beside, made_folder

    if out is None:
        return None if as_json else made_folder(folder_beside(files))
    return made_folder(out) if out.is_dir() or not out.suffix else None


def _named(files: list[Path]) -> str:
    """What a message about all photographs names: the only one, their folder, or nothing nearer."""
    folders = {path.parent for path in files}
    one = files[0] if len(files) == 1 else folders.pop() if len(folders) == 1 else Path()
    return str(one) if one.name else "photographs"


def _found_target(
    files: list[Path], channel: Channel, sensor: Path | None
) -> ReseauDesign | TestfieldDesign | BoardDesign:
    """The target that photographs show."""
    from ..procedures.exposures import photograph_reader
    from ..procedures.which_target import target_of

    read = photograph_reader(channel.value, None if sensor is None else sensor_correction(sensor))
    note, design = required(target_of(files, read), "--design auto")
    typer.echo(f"note: {note}", err=True)
    return design


def _photographs(images: list[Path], cameras: list[str]) -> tuple[dict[str, Path], dict[str, Taken]]:
    """Photographs by their names; with several cameras also when each was taken."""
    from ..procedures.exposures import exposures_of_files, files_of, photographs_named

    if not cameras:
        if not images:
            raise UsageError(
                "are missing", where="photographs", do="name IMAGES, or --camera for each camera"
            )
        say_files_left_out(images)
        images = photographs_named(images)
        named = {path.name: path for path in images}
        if len(named) < len(images):
            names = [path.name for path in images]
            twice = next(name for name in named if names.count(name) > 1)
            raise UsageError("two photographs have this name", where=twice)
        return named, {}
    if images:
        raise UsageError("cannot be combined with --camera", where=images[0])
    files: dict[str, list[Path]] = {}
    for text in cameras:
        name, equals, pattern = text.partition("=")
        if not equals or not name or not pattern or name in files:
            raise UsageError(f"is {text!r}", where="--camera", do="write name=files, each name once")
        files[name] = files_of(pattern)
        say_files_left_out([Path(pattern)])
    found = exposures_of_files(files)
    return {name: path for name, (path, _) in found.items()}, {name: at for name, (_, at) in found.items()}


def _provenance(inputs: Mapping[str, Path], **settings: Any) -> Provenance:
    from ..core.provenance import Provenance, sha256_of

    return Provenance({name: sha256_of(path) for name, path in inputs.items()}, settings)


def _options(
    sigma: float | None,
    control: Path | None,
    refraction: Path | None,
    leave_out: list[str],
    reject: bool,
    components: Kind | None,
    level: float | None,
    target: Target,
    turntable: Path | None,
    memory: float | None,
) -> CalibrationOptions:
    """Options of the procedure, from the options of the command."""
    from ..bundle import Options
    from ..exchange import read_control, read_turntable
    from ..io.refraction import RefractionFile
    from ..procedures.calibration_options import CalibrationOptions

    pairs = []
    for text in leave_out:
        image, colon, point = text.rpartition(":")
        if not colon or not image or not point:
            raise UsageError(f"is {text!r}", where="--leave-out", do="write image:point, as photo.jpg:A1")
        pairs.append((image, point))
    return CalibrationOptions(
        Options(outliers="reject" if reject else "keep", memory_gb=memory), sigma,
        None if control is None else read_control(control), tuple(pairs), components, level,
        refraction=None if refraction is None else RefractionFile.read(refraction), target=target.value,
        turntable=None if turntable is None else read_turntable(turntable),
    )  # fmt: skip


def _executor(images: list[Path], jobs: int | None, cluster: str, store: str) -> Executor:
    """What measures the photographs; its processes import in the background."""
    from ..core.processes import start_early
    from ..execution import Processes, executor_at
    from ..io import is_points

    modules = ["reseau.procedures.target_measurement"]
    executor = executor_at(jobs, cluster, store, modules, sum(not is_points(path) for path in images))
    if isinstance(executor, Processes):
        start_early(modules)
    return executor


def _shown(photographs: Iterator[Photograph], step: Callable[[str], None]) -> Iterator[Photograph]:
    """The photographs; each is a step of the progress bar."""
    for each in photographs:
        step(f"measuring {each[0] if isinstance(each, tuple) else each.name}")
        yield each


def _pictures(photographs: Mapping[str, Path], channel: Channel) -> Callable[[str], Frame | None]:
    """The photographs, read again one by one: all of them would fill the memory."""
    from ..io import is_points

    def read(name: str) -> Frame | None:
        path = photographs[name]
        return None if is_points(path) else read_frame(path, channel.value)

    return read


def _camera(
    model: str, pitch: float | None, side: str | None, more: list[str], free: str, rolling: float | None,
    motion: str,
) -> CameraOptions:  # fmt: skip
    """Camera model and parameters from the options of the command."""
    from ..bundle import Shutter
    from ..procedures.calibration_options import CameraOptions

    options: dict[str, str | float] = {} if side is None else {"side": side}
    for text in more:
        name, equals, value = text.partition("=")
        if not equals or name in options:
            raise UsageError(f"is {text!r}", where="--model-option", do="write name=value, each name once")
        options[name] = value
    names = tuple(name.strip() for name in free.split(",") if name.strip())
    chosen = tuple(name.strip() for name in motion.split(",") if name.strip())
    if chosen and rolling is None:
        raise UsageError("requires --rolling-shutter", where="--motion")
    shutter = None
    if rolling is not None:
        shutter = Shutter("rolling", rolling, chosen) if chosen else Shutter("rolling", rolling)
    model = model or ("" if names or options else "auto")
    return CameraOptions(model, names, None if pitch is None else (pitch, pitch), options, shutter)


def _size(text: str) -> tuple[int, int] | None:

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


def _uncertainty(field: ProjectionField) -> str:
    """The uncertainty over the image, px; an unusable model has none."""
    import numpy as np

    sigma = field.sigma[np.isfinite(field.sigma)]
    if not len(sigma):
        return "unknown"
    return f"median {np.median(sigma):.2g} px, at most {sigma.max():.2g} px"


def _say(done: Calibrated, differences: dict[str, FieldDifference], distances: list[float]) -> None:
    from ..bundle import projection_field_at
    from ..calibration.assessment import two_digits
    from ..procedures.target_measurement import by_reason

    result = done.result
    for name, assessed in done.assessments.items():
        before = f"camera {name}: " if len(done.cameras) > 1 else ""
        say(before + "\n".join(assessed.lines) + "\n")
    for name, choice in done.choices.items():
        _say_choice(choice, f"camera {name}: " if len(done.cameras) > 1 else "")
    if done.board is not None:
        _say_board(done.board, result.network.unit)
    count = sum(len(points) for points in done.measured.values())
    say(f"{len(done.measured)} images, {count} image points, redundancy {result.redundancy}\n")
    say(f"sigma0 {result.sigma0:.4g}, residuals {done.rms:.3g} px rms, ")
    say(f"{int(result.rejected.sum())} left out\n")
    for c, entry in enumerate(result.network.cameras):
        if len(result.network.cameras) > 1:
            say(f"camera {entry.id}\n")
        say_parameters(result.camera(c))
        say_priors(result.priors(c))
        verdict = done.assessments.get(entry.id)
        if verdict is not None and verdict.errors is not None:
            most, usual = two_digits(verdict.errors.greatest_px), two_digits(verdict.errors.median_px)
            say(f"error of the projection: median {usual} px over the image, at most {most} px\n")
        for away in distances:
            field = _uncertainty(projection_field_at(result, c, away))
            say(f"  σ at {away:g} {result.network.unit}: {field}\n")
    if result.rig is not None:
        say_rig(result.rig)
    if result.stage is not None:
        say_turntable(result.stage)
    if result.motion is not None:
        say_motion(result.motion)
    if result.refraction is not None:
        say("windows and media\n")
        say_refraction(result.refraction)
    say_model(done.result)
    for name, found in differences.items():
        say_difference(name, found)
    say_left_out(result)
    for why, names in by_reason(done.declined).items():
        say(f"left out: {', '.join(names)}: {why}\n")
    say("".join(f"{line}\n" for line in remark_lines(done.warnings, done.tests)))


def _say_board(choice: BoardChoice, unit: str) -> None:
    """Print the comparison of the models of the target."""
    import numpy as np

    said = {"flat": "flat as designed", "warp": "bent; all points are free", "free": "all points free"}
    say(f"target {said[choice.chosen.name]}\n")
    for each in choice.models:
        line = f"  {each.name:5} {each.parameters:5} parameters  sigma0 {each.sigma0:.4f}  "
        line += f"length {each.length:.1f}"
        if np.isfinite(each.p):
            line += f"  p = {each.p:.2g} against the next"
        if np.isfinite(each.warp).all():
            pairs = zip("xy", each.warp, each.warp_sigma, strict=True)
            line += "  bent " + ", ".join(f"{v:.3g} ± {s:.2g} {unit} along {k}" for k, v, s in pairs)
        say(line + "\n")


def _say_choice(choice: ModelChoice, before: str) -> None:
    """Print the comparison of the camera models; those that were not considered are in the document."""
    import numpy as np

    say(f"{before}camera model {choice.chosen.candidate.label} ({choice.chosen.reason})\n")
    known = [each for each in choice.compared if np.isfinite(each.length)]
    if not known:
        return
    say("  model                                      sigma0   length  predicted  at the corners px\n")
    for each in known:
        line = (
            f"  {each.candidate.label[:40]:40} {each.sigma0:8.4f} {each.length:8.1f}  {each.predicted:9.4f}"
        )
        corner = f"{each.corner_px:7.2g}" if np.isfinite(each.corner_px) else "no image"
        sigma = f" ± {each.corner_sigma_px:.2g}" if np.isfinite(each.corner_sigma_px) else ""
        say(f"{line}  {corner}{sigma}  {each.reason}\n")
