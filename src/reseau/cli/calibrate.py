"""`reseau calibrate`: calibrate a camera, or a rig of cameras, from photographs of a target."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import writable
from ..core.options import Group, Option, options_of, values_of_texts
from .bundle_compare import read_lens
from .bundle_options import (
    level_of,
    positive,
    say_difference,
    say_estimated,
    say_left_out,
    say_model,
    say_parameters,
    say_priors,
)
from .common import (
    CameraChoice,
    Computing,
    Reading,
    compile_first,
    ended,
    overlay_files,
    pairs_of,
    progress,
    remark_lines,
    required,
    say,
    say_files_left_out,
    say_notes,
)

if TYPE_CHECKING:
    from ..bundle.modelling.board import BoardChoice
    from ..bundle.modelling.choice import ModelChoice
    from ..calibration import CameraMapping, FieldDifference
    from ..calibration.camera import ProjectionField
    from ..execution import Executor
    from ..procedures.calibrated import Calibrated
    from ..procedures.calibration_options import CalibrationOptions, CameraOptions
    from ..procedures.exposures import Taken


@dataclass(frozen=True)
class _Camera(CameraChoice):
    """The camera model, with what only photographs of a target need."""

    model: Annotated[
        v.Model,
        "Here of all cameras that --rig gives none of their own; by default, or with `auto`, one is chosen "
        "for each camera. With --free alone brown with --pitch-mm, otherwise opencv. An unknown name lists "
        "all.",
    ] = ""
    side: Annotated[
        Literal["image", "object"] | None,
        Option("Side of Brown's distortion. Default: object.", Group.CAMERA),
    ] = None
    model_option: Annotated[
        list[str] | None,
        Option(
            "Option of the camera model, e.g. balance_radius_mm=8; repeatable.",
            Group.CAMERA,
            value="NAME=VALUE",
        ),
    ] = None
    rolling_shutter: Annotated[
        float | None,
        Option(
            "The sensor is read line by line while the camera moves; time from one line to the next "
            "(negative: from the last line on). The motion during each image is estimated.",
            Group.CAMERA,
            value="SECONDS",
        ),
    ] = None
    motion: Annotated[
        tuple[str, ...],
        Option(
            "Components of the motion to estimate with a rolling shutter, by default vx,vy,vz,wx,wy,wz; "
            "with a narrow lens vx,vy,wz.",
            Group.CAMERA,
            value="vx,vy,wz",
        ),
    ] = ()

    def options(self) -> CameraOptions:
        """Return the options of the calibration.

        Raises
        ------
        UsageError
            When options contradict each other.
        """
        from ..bundle.network.shutter import Shutter
        from ..procedures.calibration_options import CameraOptions

        given = [*([] if self.side is None else [f"side={self.side}"]), *(self.model_option or ())]
        options = pairs_of(given, "--model-option", "name=value, each name once")
        if self.motion and self.rolling_shutter is None:
            raise UsageError("requires --rolling-shutter", where="--motion")
        shutter = None
        if self.rolling_shutter is not None:
            shutter = Shutter("rolling", self.rolling_shutter)
            shutter = replace(shutter, free=self.motion) if self.motion else shutter
        model = self.model or ("" if self.free or options else "auto")
        return CameraOptions(model, self.free, self.pitch_mm, dict(options), shutter)


@dataclass(frozen=True)
class _OfRig(_Camera):
    """What may be said of one camera of a rig."""

    image_size: v.ImageSize | None = None


def _rig(texts: list[str], camera: _Camera, size: tuple[int, int] | None) -> dict[str, tuple[str, _OfRig]]:
    """Files of each camera of a rig, and what is said of it; what is not is that of all.

    Raises
    ------
    UsageError
        When an option cannot be interpreted.
    """
    keys = "|".join(name.replace("_", "-") for name in options_of(_OfRig))
    found = {}
    for name, given in pairs_of(texts, "--rig", "name=files, each name once").items():
        files, *said = re.split(rf",(?=(?:{keys})=)", given)
        own = pairs_of(said, f"--rig {name}", "name=files,option=value, each option once")
        values = values_of_texts(
            _OfRig, {key.replace("-", "_"): text for key, text in own.items()}, f"--rig {name}"
        )
        found[name] = files, _OfRig(**({"image_size": size} | vars(camera) | values))
    return found


@dataclass(frozen=True)
class _Adjustment:
    """The network of the photographs, and its adjustment."""

    target: Annotated[
        Literal["free", "flat", "auto"],
        Option(
            "Points of the target: all free, flat as designed, or chosen by a test, which also says how "
            "much the target is bent.",
            Group.TARGET,
        ),
    ] = "free"
    control: Annotated[v.Control | None, "By default a free network."] = None
    refraction: Annotated[
        Path | None,
        Option("Windows and media before the target, reseau-refraction/1; lengths in mm.", Group.TARGET),
    ] = None
    turntable: Annotated[
        Path | None,
        Option(
            "Angles of a turntable that carried the target, or the camera: CSV "
            "image,angle_deg[,sigma_deg][,pose]; its axis is estimated.",
            Group.TARGET,
        ),
    ] = None
    sigma_px: Annotated[v.SigmaPx | None, "It replaces the measured ones."] = None
    leave_out: Annotated[
        list[str] | None,
        Option("Image point to leave out; repeatable.", Group.ADJUSTMENT, value="PHOTO:POINT"),
    ] = None
    reject: Annotated[
        v.Reject | None, "By default where that explains the residuals better than all else."
    ] = None
    components: v.Components | None = None
    eliminate: v.Eliminate | None = None
    memory_gb: v.MemoryGb | None = None

    @property
    def files(self) -> tuple[Path | None, ...]:
        """The files that are read."""
        return self.control, self.refraction, self.turntable

    def options(self) -> CalibrationOptions:
        """Return the options of the procedure; their files are read.

        Raises
        ------
        UsageError
            When an option cannot be interpreted.
        """
        from ..bundle import Options
        from ..exchange.tables import read_control, read_turntable
        from ..io.refraction import RefractionFile
        from ..procedures.calibration_options import CalibrationOptions

        pairs = []
        for text in self.leave_out or ():
            image, colon, point = text.rpartition(":")
            if not colon or not image or not point:
                raise UsageError(f"is {text!r}", where="--leave-out", do="write image:point, as photo.jpg:A1")
            pairs.append((image, point))
        return CalibrationOptions(
            Options(memory_gb=self.memory_gb),
            self.sigma_px,
            None if self.control is None else read_control(self.control),
            tuple(pairs),
            self.components,
            level_of(self.eliminate, "--eliminate"),
            refraction=None if self.refraction is None else RefractionFile.read(self.refraction),
            target=self.target,
            turntable=None if self.turntable is None else read_turntable(self.turntable),
            reject=self.reject,
        )


def calibrate(
    camera: _Camera,
    adjustment: _Adjustment,
    reading: Reading,
    computing: Computing,
    images: Annotated[
        list[Path] | None,
        typer.Argument(help="Photographs of the target, folders of them, or measured image coordinates."),
    ] = None,
    design: Annotated[
        v.Design,
        "By default, or with `auto`, it is looked for: among designs beside the photographs, in the folder "
        "above and the current one, and those that `reseau design` draws.",
    ] = Path("auto"),
    rig: Annotated[
        list[str] | None,
        Option(
            "Photographs of one of several cameras that are fixed to each other, in place of IMAGES: a "
            "folder or a pattern, e.g. 'left=left/*.png'; repeatable. Files with the same name, or the same "
            "last number in it, were taken at once. Options of the camera model, and image-size, may follow "
            "for this camera alone: 'front=front/*.png,model=fisheye'.",
            value="NAME=FILES[,OPTION=VALUE]",
        ),
    ] = None,
    out: Annotated[
        v.Out | None,
        "Here a folder for report, calibrations, files for OpenCV, ROS, COLMAP and undistorted samples; by "
        "default, without --json, photos-calibration beside the folder of the photographs, photos. With the "
        "suffix .json the file of the calibration alone.",
    ] = None,
    report: v.Report | None = None,
    overlay: Annotated[v.Overlay | None, "Here a folder, for each photograph."] = None,
    image_size: Annotated[v.ImageSize | None, "Required without photographs."] = None,
    row_jitter_px: v.RowJitterPx = 0.0,
    fill: v.Fill = 1.0,
    against: Annotated[
        list[Path] | None, Option("Calibration of the same camera to compare with; repeatable.")
    ] = None,
    distance: v.Distance | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Calibrate a camera from photographs of a target."""
    cameras = _rig(rig or [], camera, image_size)
    photographs, taken = _photographs(images or [], {name: files for name, (files, _) in cameras.items()})
    files = [path for _, path in photographs]
    executor = _executor(files, computing)
    if overlay is not None and not executor.local:
        raise UsageError("is drawn by this machine only", where="--overlay", do="leave out --cluster")
    from ..core.failure import Code, Failure
    from ..core.provenance import Provenance, sha256_of
    from ..exchange.boards import read_target
    from ..io import BoardDesign, write_whole
    from ..measure.testfield.measure import TestfieldOptions
    from ..procedures.calibrating import calibrate_photographs
    from ..procedures.calibration_folder import checked_output, folder_beside, write_calibrated

    place = out if out is not None or as_json else folder_beside(files)
    place = None if place is None else checked_output(place)
    writable(report, ".html")
    drawn = {} if overlay is None else overlay_files(overlay, files)
    distance = positive(distance)
    target = None if str(design) == "auto" else read_target(design)
    others = {path.name: read_lens(path) for path in against or []}
    if others and taken:
        raise UsageError("requires one camera", where="--against", do="compare the cameras one by one")
    options, lens = adjustment.options(), camera.options()
    lenses = {name: own.options() for name, (_, own) in cameras.items()}
    sizes = {name: own.image_size for name, (_, own) in cameras.items() if own.image_size is not None}
    if not computing.cluster:
        job = "auto" if target is None else "board" if isinstance(target, BoardDesign) else "calibrate"
        compile_first(job, computing.jobs)
    with executor, progress("measuring", len(files)) as step:
        found = calibrate_photographs(
            photographs, target, sizes if cameras else image_size, lenses or lens, options, taken,
            channel=reading.channel, correction=reading.correction,
            testfield=TestfieldOptions(row_jitter_px=row_jitter_px, fill=fill),
            overlays={name: drawn[path] for name, path in photographs if path in drawn},
            executor=executor, store=computing.store,
            about={"sensor": sha256_of(reading.sensor) if reading.sensor else None},
            note=lambda line: say_notes([line]), step=step,
        )  # fmt: skip
        sought = target is None and isinstance(found, Failure) and found.code is Code.NOT_FOUND
        done = required(found, "--design auto" if sought else _named(files))
    say_notes(done.notes)
    inputs = dict(photographs) | {
        path.name: path for path in (target and design, *adjustment.files, reading.sensor) if path
    }
    settings = {
        "model": lens.model, "options": dict(lens.options), "row_jitter_px": row_jitter_px, "fill": fill,
        "channel": reading.channel,
    }  # fmt: skip
    provenance = Provenance(
        {name: sha256_of(path) for name, path in inputs.items()},
        settings | _settings(camera) | _settings(adjustment) | ({"rig": rig} if rig else {}),
    )
    differences = _differences(done, others)
    calibrations, page = done.documents(provenance.to_dict()), ""
    if report is not None or (place is not None and place.suffix != ".json"):
        page = done.report_page(provenance=provenance, against=differences, distances=distance)
    if report is not None:
        write_whole(report, page)
    written = list[tuple[str, str]]()
    if place is not None:
        with progress("writing", 0) as step:
            written = write_calibrated(place, done, calibrations, page, step)
    if as_json:
        say("".join(calibration.to_json() for calibration in calibrations))
    else:
        _say(done, differences, distance)
        if written:
            say(f"written: {place}\n")
            say("".join(f"  {name:26} {what}\n" for name, what in written))
    ended(done.result.status)


def _named(files: list[Path]) -> str:
    """What a message about all photographs names: the only one, their folder, or nothing nearer."""
    folders = {path.parent for path in files}
    one = files[0] if len(files) == 1 else folders.pop() if len(folders) == 1 else Path()
    return str(one) if one.name else "photographs"


def _photographs(
    images: list[Path], cameras: dict[str, str]
) -> tuple[list[tuple[str, Path]], dict[str, Taken]]:
    """Photographs with their names; with several cameras also when each was taken."""
    from ..procedures.exposures import exposures_of_files, files_of, photographs_named

    if not cameras:
        if not images:
            raise UsageError("are missing", where="photographs", do="name IMAGES, or --rig for each camera")
        say_files_left_out(images)
        return [(path.name, path) for path in photographs_named(images)], {}
    if images:
        raise UsageError("cannot be combined with --rig", where=images[0])
    files = {name: files_of(pattern) for name, pattern in cameras.items()}
    say_files_left_out(map(Path, cameras.values()))
    found = exposures_of_files(files)
    photographs = [(name, path) for name, (path, _) in found.items()]
    return photographs, {name: at for name, (_, at) in found.items()}


def _settings(options: CameraChoice | _Adjustment) -> dict[str, Any]:
    """Options that were given, but for files: these are inputs."""
    return {
        name: value
        for name, value in vars(options).items()
        if value not in (None, (), "") and not isinstance(value, Path)
    }


def _executor(images: list[Path], computing: Computing) -> Executor:
    """What measures the photographs; its processes import in the background."""
    from ..core.processes import start_early
    from ..execution import Processes
    from ..io.reading import is_points

    modules = ["reseau.procedures.target_measurement"]
    executor = computing.executor(modules, sum(not is_points(path) for path in images))
    if isinstance(executor, Processes):
        start_early(modules)
    return executor


def _differences(done: Calibrated, others: dict[str, CameraMapping]) -> dict[str, FieldDifference]:
    from ..bundle.diagnostics.fields import camera_mapping
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
    from ..bundle.diagnostics.fields import projection_field_at
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
    say_estimated(result)
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
    say(f"target {said[choice.chosen.name]} (each model with the same {choice.points} image points)\n")
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
