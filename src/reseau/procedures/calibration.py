"""Calibration of a camera, or of several fixed to each other, from photographs of a target.

The coordinates of the design are only approximate values: all points of the target are unknowns, and the
network has inner constraints over them (a free network). Scale and datum are those of the design on average
over its points; the unevenness of the target is estimated as heights. Points with known coordinates may be
given as control points instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import cv2
import numpy as np

from ..bundle import (
    BoardChoice,
    Camera,
    CameraEstimate,
    ControlPoints,
    Explanation,
    ImageEstimates,
    Misnamed,
    ModelChoice,
    Network,
    Options,
    PointEstimates,
    Result,
    Rig,
    Shutter,
    calibration_of,
    camera_mapping,
    choose_board,
    choose_models,
    explain,
    held_as_designed,
    model_search_entries,
    search_model,
)
from ..bundle.network import stage_of_turntable
from ..calibration import Calibration, CameraMapping
from ..core import vocabulary as v
from ..core.data import Array, Frame, ImagePoints
from ..core.display import Display
from ..core.errors import UsageError
from ..core.failure import Code, Failure, Remark
from ..execution import Executor, Outputs
from ..io import BoardDesign
from ..io.network import TurntableEntry
from ..io.photographs import Exif
from ..io.refraction import RefractionEntry
from ..optics import CameraModel, PixelGrid, camera_model
from ..optics.cameras import default_camera_model
from ..optics.refraction import RefractedRays, Refraction
from .assessment import Assessment, assess
from .exposures import Taken
from .misnamed_points import left_out
from .target_measurement import MeasuredPhotograph, Measurer, Photograph, measured_in_order, measurer_of
from .turned_targets import named_alike, ways_to_turn
from .z_stage import Heights

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "Calibrated",
    "CalibrationOptions",
    "CameraOptions",
    "Measurer",
    "calibrate_camera",
    "first_camera",
    "measurer_of",
    "network_of",
]

_LEAST_POINTS = 8
_LEAST_IMAGES = 3
# Relative standard deviation of a principal distance above which nothing follows from a calibration.
_HARDLY = 0.2
_FOCAL_OFF = 1.5
"""Factor beyond which the focal length of the homographies contradicts that which the camera says."""
_CONTRADICTED, _BETTER, _RENAMED = 1.5, 0.7, 3
"""Standard deviation of unit weight from which photographs may name the points of a regular target
differently; share of it to which the same names must lower it; most attempts."""
_MORE_TILTED = "add images with the camera tilted by 20 to 40 degrees in different directions"
_CAMERA = "camera"
"""Name of a camera that is alone."""
# Relative standard deviation of a diagonal of the target.
_PRINTED = 1e-4
_NARROW = 1e-3


class PlaneDesign(Protocol):
    """A plane target: names and coordinates of its points."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points (p)."""

    @property
    def xy(self) -> Array:
        """Coordinates (p, 2), x right and y up."""

    @property
    def unit(self) -> str:
        """Unit of the coordinates; a label."""


@dataclass(frozen=True)
class CameraOptions:
    """Camera model of a calibration, and the parameters to estimate.

    Parameters
    ----------
    model : str, optional
        Name of a registered model, see :func:`reseau.optics.camera_models`, or ``auto``: it is chosen for
        each camera, see :func:`reseau.bundle.choose_models`. By default ``brown`` if the pixel size is given,
        otherwise ``opencv``.
    free : tuple of str
        Parameters to estimate; by default the usual ones of the model.
    pitch_mm : float or (float, float), optional
        Size of a pixel, one number where it is a square; required for models whose parameters are in
        millimetres.
    options : mapping of str to str or float
        Options of the model, such as the side of Brown's distortion.
    shutter : Shutter, optional
        For images that are read line by line while the camera moves; of the mode ``rolling``.

    Raises
    ------
    UsageError
        When the shutter is that of a line camera, the model, a parameter or an option is unknown, or the
        pixel size is missing.

    Examples
    --------
    >>> CameraOptions().model, CameraOptions(pitch_mm=0.005).chosen
    ('opencv', ('c', 'x0', 'y0', 'K1', 'K2', 'P1', 'P2'))
    """

    model: str = ""
    free: tuple[str, ...] = ()
    pitch_mm: tuple[float, float] | float | None = None
    options: Mapping[str, str | float] = field(default_factory=dict)
    shutter: Shutter | None = None

    def __post_init__(self) -> None:
        if isinstance(self.pitch_mm, int | float):
            object.__setattr__(self, "pitch_mm", (float(self.pitch_mm), float(self.pitch_mm)))
        if not self.model:
            object.__setattr__(self, "model", default_camera_model(self.pitch_mm is not None).name)
        model = self.registered
        if self.shutter is not None and self.shutter.mode == "line":
            # Approximate values of a line camera need points that are not in one plane.
            raise UsageError(
                "cannot be calibrated with a plane target", where="a line camera", do="adjust a network of it"
            )
        if self.automatic and (self.free or self.options):
            raise UsageError("has no parameters or options of its own", where="camera model auto")
        if model.needs_pitch and self.pitch_mm is None:
            raise UsageError("requires the pixel size", where=model.name)
        unknown = [name for name in self.free if name not in model.names]
        if unknown:
            raise UsageError(f"is not one of {', '.join(model.names)}", where=unknown[0])
        if not self.automatic:
            object.__setattr__(self, "options", model.checked_options(self.options))

    @property
    def automatic(self) -> bool:
        """Whether the model is to be chosen."""
        return self.model == "auto"

    @property
    def registered(self) -> CameraModel:
        """The registered model; the default one where it is to be chosen."""
        return default_camera_model(self.pitch_mm is not None) if self.automatic else camera_model(self.model)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Parameters to be estimated."""
        return self.free or self.registered.usual


@dataclass(frozen=True, eq=False)
class CalibrationOptions:
    """Options of a camera calibration.

    Parameters
    ----------
    adjustment : Options
        Options of the adjustment.
    sigma_px : float, optional
        Standard deviation of all image coordinates. Replaces the measured ones where the residuals are
        larger, because the target or the lens deviates from its model.
    control : ControlPoints, optional
        Control points for the datum; by default inner constraints over all points.
    leave_out : tuple of (str, str)
        Image points to leave out, by image and point.
    components : {"axes", "images", "cameras"}, optional
        Groups with separate factors on their standard deviations; see :func:`reseau.bundle.search_model`.
    eliminate : float, optional
        Significance level of the tests by which distortion parameters are dropped.
    heights : Heights, optional
        Heights of the target on a z-stage.
    refraction : RefractionEntry, optional
        Windows and media between the camera, whose name is ``camera`` if it is alone, and the target. The
        calibration is that of the camera in air. Without control points the diagonals of the target are
        distances of the design, known to a ten-thousandth: windows have dimensions, and the scale is not
        free.
    focal_35_mm : float, optional
        Approximate focal length as the camera says, for the format of 36 × 24 mm: taken for the start where
        that of the homographies is far from it.
    turntable : TurntableEntry, optional
        Turntable that carried the target, or the cameras; the axis is estimated. Photographs that are not in
        it were taken without.
    target : {"free", "flat", "auto"}
        Whether all points of the target are unknowns, or are held as designed; ``auto`` holds them where
        :func:`reseau.bundle.choose_board` finds the target flat and as designed.

    Raises
    ------
    UsageError
        When the target is not one of these, or is defined otherwise.
    """

    adjustment: Options = field(default_factory=Options)
    sigma_px: v.SigmaPx | None = None
    control: ControlPoints | None = None
    leave_out: tuple[tuple[str, str], ...] = ()
    components: v.Components | None = None
    eliminate: v.Eliminate | None = None
    heights: Heights | None = None
    refraction: RefractionEntry | None = None
    focal_35_mm: float | None = None
    turntable: TurntableEntry | None = None
    target: Literal["free", "flat", "auto"] = "free"

    def __post_init__(self) -> None:
        if self.target not in ("free", "flat", "auto"):
            raise UsageError(f"is {self.target!r}, not `free`, `flat` or `auto`", where="target")
        if self.turntable is not None and self.heights is not None:
            raise UsageError("cannot be combined with heights", where="turntable")
        if self.target != "free" and (self.control or self.heights or self.refraction):
            raise UsageError(
                f"cannot be {self.target!r} with control points, heights, or windows and media",
                where="target",
            )


@dataclass(frozen=True, eq=False, repr=False)
class Calibrated(Display):
    """A camera calibration with its measurements; truthy.

    Parameters
    ----------
    result : Result
        Result of the adjustment; a camera that is alone has the name ``camera``.
    measured : dict
        Measured image points, by image.
    declined : dict
        Reasons why images were left out, by image.
    choices : mapping of str to ModelChoice
        How the models of the cameras were chosen, by their names; empty where the model was given.
    board : BoardChoice, optional
        How the model of the target was chosen.
    notes : tuple of str
        How photographs were read.
    misnamed : Misnamed, optional
        Image points that were left out because they lie elsewhere than the others of their image say.
    """

    result: Result
    measured: dict[str, ImagePoints]
    declined: dict[str, str]
    choices: Mapping[str, ModelChoice] = field(default_factory=dict)
    board: BoardChoice | None = None
    notes: tuple[str, ...] = ()
    misnamed: Misnamed | None = None

    def __bool__(self) -> bool:
        return True

    def required(self) -> Calibrated:
        """Return the calibration itself; see :meth:`~reseau.core.failure.Failure.required`."""
        return self

    @property
    def choice(self) -> ModelChoice | None:
        """How the model of the only camera was chosen; None where it was given."""
        return self.choices.get(_CAMERA)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return self.result.sigma0

    @property
    def warnings(self) -> tuple[Remark, ...]:
        """Warnings about the adjustment."""
        return self.result.warnings

    @property
    def cameras(self) -> dict[str, CameraEstimate]:
        """Estimated parameters of the cameras, by their names; one that is alone is called ``camera``."""
        return self.result.cameras

    @cached_property
    def explanation(self) -> Explanation:
        """What is wrong, if anything."""
        return explain(self.result, self.misnamed)

    @cached_property
    def assessments(self) -> dict[str, Assessment]:
        """What the calibration of each camera is good for; of those with one set of parameters."""
        network = self.result.network
        one = {c for c, entry in enumerate(network.cameras) if entry.has_plane_mapping}
        return {
            entry.id: assess(self.result, c, self.explanation)
            for c, entry in enumerate(network.cameras)
            if c in one and (entry.additional is None or entry.additional.per == "camera")
        }

    @property
    def images(self) -> ImageEstimates:
        """Exterior orientations."""
        return self.result.images

    @property
    def points(self) -> PointEstimates:
        """Points of the target."""
        return self.result.points

    def calibration(
        self,
        name: str = "camera",
        provenance: Mapping[str, Any] | None = None,
        camera: str | None = None,
    ) -> Calibration:
        """Return the calibration of a camera as a document, with how its model was found.

        Parameters
        ----------
        name : str
            Name of the calibration.
        provenance : mapping, optional
            Inputs and options, see :class:`reseau.core.provenance.Provenance`.
        camera : str, optional
            Name of the camera; required with several.

        Raises
        ------
        UsageError
            When there is no such camera.
        """
        found = calibration_of(self.result, camera or _CAMERA, name=name, provenance=provenance)
        more = model_search_entries(self.result)
        assessed = self.assessments.get(camera or _CAMERA)
        if assessed is not None:
            more |= {"assessment": assessed.entries()}
        if (camera or _CAMERA) in self.choices:
            more |= {"camera_models": self.choices[camera or _CAMERA].entries()}
        if self.board is not None:
            more |= {"target": self.board.entries()}
        return found.model_copy(update={"validity": found.validity | more}) if more else found

    def write(self, path: Path | str) -> None:
        """Write the calibration, ``reseau-calibration/1``; of several cameras one file each.

        With several cameras their names are appended to that of the file: ``rig.json`` becomes
        ``rig-left.json`` and ``rig-right.json``.

        Raises
        ------
        InputError
            When a file cannot be written.
        """
        for camera, file in self.files(Path(path)).items():
            self.calibration(file.stem, camera=camera).write(file)

    def files(self, path: Path) -> dict[str, Path]:
        """Return the file of each camera, for the path given to all; see :meth:`write`."""
        names = [entry.id for entry in self.result.network.cameras]
        if len(names) == 1:
            return {names[0]: path}
        return {name: path.with_name(f"{path.stem}-{name}{path.suffix}") for name in names}

    def plot(self, photo: Frame | None = None) -> Sequence[Axes]:
        """Draw residuals over the image and the uncertainty of the projection side by side, with matplotlib.

        Parameters
        ----------
        photo : Frame, optional
            One of the photographs; drawn first, with the points measured in it.

        Returns
        -------
        sequence of matplotlib Axes
            Of the panels: one for each camera, one or two before them.
        """
        import matplotlib.pyplot as plt

        from ..core.figures import BLUE

        cameras = len(self.cameras)
        count = cameras + (1 if photo is None else 2)
        _, row = plt.subplots(1, count, figsize=(4.6 * count, 3.9), layout="constrained")
        panels = list(row)
        if photo is not None:
            photo.plot(panels[0])
            points = self.measured.get(photo.name)
            if points is not None:
                panels[0].plot(*points.xy.T, "o", color=BLUE, markerfacecolor="none", markersize=4)
                panels[0].set_title(f"{photo.name}: {len(points)} points", loc="left")
        self.result.plot(panels[-1 - cameras])
        for c, axes in enumerate(panels[-cameras:]):
            camera_mapping(self.result, c).plot(axes)
        return panels

    def _facts(self) -> list[tuple[str, str]]:
        count = sum(len(points) for points in self.measured.values())
        return [
            (f"{len(self.measured)} images", ""),
            (f"{count} image points", ""),
            (f"{len(self.declined)} declined", ""),
            ("sigma0", f"{self.sigma0:.3f}"),
            *(fact for camera in self.cameras.values() for fact in camera._facts()[len(self.cameras) == 1 :]),
        ]

    def _columns(self) -> dict[str, list[object]]:
        each = [camera._columns() for camera in self.cameras.values()]
        columns = {key: [value for one in each for value in one[key]] for key in each[0]}
        if len(each) == 1:
            return columns
        names = [name for name, one in zip(self.cameras, each, strict=True) for _ in next(iter(one.values()))]
        return {"camera": [*names], **columns}


def calibrate_camera(
    frames: Iterable[Photograph],
    design: PlaneDesign,
    measure: Measurer,
    size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    model: CameraOptions | None = None,
    options: CalibrationOptions | None = None,
    taken: Mapping[str, Taken] | None = None,
    executor: Executor | None = None,
    outputs: Outputs | None = None,
) -> Calibrated | Failure:
    """Calibrate a camera, or several that are fixed to each other, from photographs of a target.

    Parameters
    ----------
    frames : iterable of Frame or Unread, or of (name, ImagePoints) or (name, Failure)
        Photographs, of one size for each camera, measured image points, or why a photograph cannot be read.
        Those of another size than most are declined.
    design : PlaneDesign
        The target.
    measure : callable
        Function that measures the target in a frame; see
        :func:`~reseau.procedures.target_measurement.measurer_of`.
    size : (int, int), optional
        Width and height in pixels, or those of each camera by its name; required without frames.
    model : CameraOptions, optional
        Camera model and parameters to estimate; by default the model is chosen, see
        :func:`reseau.bundle.choose_models`.
    options : CalibrationOptions, optional
        Options of the calibration.
    taken : mapping of str to Taken, optional
        Camera and exposure of each photograph, by its name, of cameras that are fixed to each other; see
        :func:`~reseau.procedures.exposures.exposures_of_files`. By default all are of one camera.
    executor : Executor, optional
        What measures the photographs; by default this process.
    outputs : Outputs, optional
        Where measurements are kept; see
        :func:`~reseau.procedures.target_measurement.measured_in_order`.

    Returns
    -------
    Calibrated or Failure
        A failure when fewer than three images of a camera show the target, or the adjustment fails.

    Raises
    ------
    UsageError
        When two photographs have the same name, the size is not known, a point to leave
        out was not measured, or windows and media contradict each other.
    """
    options = options or CalibrationOptions()
    photographs = list(measured_in_order(_checked(frames, taken), measure, executor, outputs))
    measured, declined, sizes = _measured(photographs, size, taken)
    measured = _without(measured, options.leave_out)
    notes = tuple(note for each in photographs for note in each.notes)
    job = _Job(declined, sizes, notes, design, model, options, taken)
    done = job.calibrated(measured)
    if isinstance(design, BoardDesign) and ways_to_turn(design) and options.control is None:
        # A better camera tells better which photographs name the points in another way.
        for _ in range(_RENAMED):
            if isinstance(done, Failure) or done.sigma0 < _CONTRADICTED:
                break
            lenses = {
                image: camera_mapping(done.result, int(c))
                for image, c in zip(done.result.network.images, done.result.network.camera_of, strict=True)
            }
            alike = named_alike(done.measured, design, lenses)
            if all(points.names == done.measured[image].names for image, points in alike.items()):
                break
            again = job.calibrated(alike)
            if isinstance(again, Failure) or again.sigma0 > _BETTER * done.sigma0:
                break
            done = again
    return done


@dataclass(frozen=True, eq=False)
class _Job:
    """All that a calibration is of, but the image points: some of these are found to be wrong."""

    declined: dict[str, str]
    sizes: Mapping[str, tuple[int, int]]
    notes: tuple[str, ...]
    design: PlaneDesign
    model: CameraOptions | None
    options: CalibrationOptions
    taken: Mapping[str, Taken] | None

    def calibrated(self, measured: dict[str, ImagePoints]) -> Calibrated | Failure:
        """Calibrate from the points of photographs."""
        design, sizes, options, taken = self.design, self.sizes, self.options, self.taken
        cameras, of = _cameras_of(measured, taken)
        for c, name in enumerate(cameras):
            if of.count(c) < _LEAST_IMAGES:
                which = f" of camera {name}" if taken else ""
                why = "".join(f"; {images}: {reason}" for reason, images in _by_reason(self.declined).items())
                show = f"image{which} shows" if of.count(c) == 1 else f"images{which} show"
                return Failure(
                    f"{of.count(c)} {show} the target, {_LEAST_IMAGES} are needed, 10 are good{why}",
                    Code.TOO_FEW_IMAGES,
                )
        if not all(name in sizes for name in cameras):
            raise UsageError(
                "is not known without a photograph", where="size of the images", do="give width and height"
            )
        stand_in = Camera(_CAMERA, 1, 1, (1.0, 1.0), "opencv", np.zeros(len(camera_model("opencv").names)))
        wrong = left_out(network_of(measured, design, stand_in), cameras, sizes, of)
        if wrong is None:
            return self._adjusted(measured, None)
        # Which points are wrong is seen best with the target as designed: its errors are small beside theirs.
        more = options.target != "free" or options.control or options.heights or options.refraction
        first = self if more else replace(self, options=replace(options, target="flat"))
        done = first._adjusted(wrong.kept(measured), wrong.found)
        still = wrong if isinstance(done, Failure) else wrong.after(done.result)
        same = still is not None and np.array_equal(still.found.rows, wrong.found.rows)
        if still is not None and same and more:
            return done if isinstance(done, Failure) else replace(done, misnamed=still.found)
        kept, found = (measured, None) if still is None else (still.kept(measured), still.found)
        return self._adjusted(kept, found)

    def _adjusted(self, measured: dict[str, ImagePoints], wrong: Misnamed | None) -> Calibrated | Failure:
        """Adjust the points of photographs, of which those that are wrong were left out."""
        design, sizes, options, taken = self.design, self.sizes, self.options, self.taken
        notes = self.notes
        measured = {name: points for name, points in measured.items() if len(points) >= _LEAST_POINTS}
        cameras, of = _cameras_of(measured, taken)
        refraction = None
        if options.refraction is not None:
            refraction = options.refraction.refraction(tuple(measured), tuple(cameras[c] for c in of))
        model, larger = self.model or CameraOptions("auto"), _magnification(refraction)
        said = Exif(focal_35_mm=options.focal_35_mm)
        entries = []
        for c, name in enumerate(cameras):
            own = {image: points for (image, points), at in zip(measured.items(), of, strict=True) if at == c}
            entries.append(
                replace(
                    first_camera(own, design, sizes[name], model, larger, said.focal_px(*sizes[name])),
                    id=name,
                )
            )
        network = replace(network_of(measured, design, entries[0]), refraction=refraction)
        if taken:
            network = _fixed_to_each_other(network, entries, of, [taken[name].exposure for name in measured])
        if options.turntable is not None:
            network = _turned(
                network, options.turntable, [taken[name].exposure for name in measured] if taken else None
            )
        if options.heights is not None:
            network = options.heights.lifted(network)
        if options.control is not None:
            network = _controlled(network, options.control)
        elif refraction is not None:
            network = _scaled(network)
        if options.sigma_px is not None:
            network = replace(network, cov=np.tile(np.eye(2) * options.sigma_px**2, (len(network.xy), 1, 1)))
        if options.target == "flat":
            network = held_as_designed(network)
        choices = dict[str, ModelChoice]()
        if model.automatic:
            chosen = choose_models(network, options=options.adjustment)
            if isinstance(chosen, Failure):
                notes = (
                    *notes,
                    f"camera model {model.registered.name}, none could be chosen: {chosen.reason}",
                )
            else:
                network = replace(network, cameras=tuple(each.camera for each in chosen))
                choices = dict(zip(cameras, chosen, strict=True))
        board = None
        if options.target == "auto":
            bent = choose_board(network, options.adjustment)
            if isinstance(bent, Failure):
                return bent
            board, network = bent, bent.network
        found = search_model(network, options.adjustment, options.components, options.eliminate)
        if isinstance(found, Failure):
            if found.code is Code.NOT_CONVERGED:
                return replace(found, reason=f"{found.reason}; {_MORE_TILTED}")
            return found
        calibrated = Calibrated(found, measured, self.declined, choices, board, notes, wrong)
        loose = _without_scale(calibrated.result)
        return calibrated if loose is None else loose


def _cameras_of(images: Iterable[str], taken: Mapping[str, Taken] | None) -> tuple[list[str], list[int]]:
    """Names of the cameras, and the number of that of each image."""
    cameras = list(dict.fromkeys(each.camera for each in taken.values())) if taken else [_CAMERA]
    return cameras, [cameras.index(taken[name].camera) if taken else 0 for name in images]


def _without_scale(result: Result) -> Failure | None:
    """A failure where the pixels in a radian at the centre, or a magnification, are hardly known at all."""
    for c, camera in enumerate(result.network.cameras):
        if camera.registered is None or not camera.has_plane_mapping:
            continue
        lens = camera_mapping(result, c)
        relative = _relative_scale(lens)
        if relative > _HARDLY:
            scales = [name for name in camera.registered.of_role("scale") if name in lens.names]
            name = scales[0] if scales else "the scale"
            return Failure(
                f"{camera.label}: the images do not determine {name}, which is uncertain by "
                f"{100 * relative:.0f} %; " + _MORE_TILTED,
                Code.NOT_IDENTIFIED,
            )
    return None


def _relative_scale(lens: CameraMapping) -> float:
    """Relative standard deviation of the scale at the centre; some models share it between parameters."""
    mapping, zero = lens.mapping, np.zeros((1, 2))

    def scale(values: Array) -> float:
        moved = mapping.with_values(dict(zip(mapping.names, values.tolist(), strict=True)))
        return float(np.sqrt(abs(np.linalg.det(moved.derivatives(zero).d_xy[0]))))

    values, slope = np.array(mapping.values, dtype=np.float64), np.zeros(len(lens.rows))
    for k, row in enumerate(lens.rows):
        step = np.zeros(len(values))
        step[row] = 1e-4 * max(abs(values[row]), 1e-3)
        slope[k] = (scale(values + step) - scale(values - step)) / (2 * step[row])
    return float(np.sqrt(max(float(slope @ lens.covariance @ slope), 0.0))) / scale(values)


def _fixed_to_each_other(
    network: Network, cameras: Sequence[Camera], of: Sequence[int], exposures: Sequence[str]
) -> Network:
    """Return the network with several cameras, which are fixed to each other."""
    number = {name: k for k, name in enumerate(dict.fromkeys(exposures))}
    camera_of = np.array(of, dtype=np.intp)
    rig = Rig(camera_of, np.array([number[name] for name in exposures], dtype=np.intp))
    return replace(network, cameras=tuple(cameras), camera_of=camera_of, rig=rig)


def _turned(network: Network, turntable: TurntableEntry, exposures: Sequence[str] | None) -> Network:
    """Return the network with a turntable."""
    stage = stage_of_turntable(turntable, network.images, exposures)
    if stage is None:
        raise UsageError(
            f"has none of the photographs, but {turntable.image[0]}", where="turntable",
            do=f"name them as {network.images[0]}",
        )  # fmt: skip
    if stage.tied:
        raise UsageError("a known axis requires control points", where="turntable")
    return replace(network, stage=stage)


def _checked(frames: Iterable[Photograph], taken: Mapping[str, Taken] | None) -> Iterator[Photograph]:
    """Yield the photographs, each of a name of its own, and of a known camera."""
    names = set[str]()
    for frame in frames:
        name = frame[0] if isinstance(frame, tuple) else frame.name
        if name in names:
            raise UsageError("two photographs have this name", where=name)
        if taken is not None and name not in taken:
            raise UsageError("is of no known camera and exposure", where=name)
        names.add(name)
        yield frame


def _measured(
    photographs: Iterable[MeasuredPhotograph],
    size: tuple[int, int] | Mapping[str, tuple[int, int]] | None,
    taken: Mapping[str, Taken] | None,
) -> tuple[dict[str, ImagePoints], dict[str, str], dict[str, tuple[int, int]]]:
    """Return the image points of each photograph, reasons of declined ones, and image sizes by camera."""
    every = {each.camera for each in taken.values()} if taken else {_CAMERA}
    seen: dict[str, tuple[int, int]] = {}
    measured: dict[str, ImagePoints] = {}
    declined: dict[str, str] = {}
    for each in photographs:
        if isinstance(each.found, Failure):
            declined[each.name] = each.found.reason
            continue
        if len(each.found) < _LEAST_POINTS:
            declined[each.name] = f"{len(each.found)} points are too few"
            continue
        measured[each.name] = each.found
        if each.size is not None:
            seen[each.name] = each.size
    if size is None or isinstance(size, Mapping):
        sizes = {camera: one for camera, one in (size or {}).items() if camera in every}
    else:
        sizes = dict.fromkeys(every, size)
    for camera in every - sizes.keys():
        own = Counter(seen[name] for name in measured if name in seen and _camera_of(name, taken) == camera)
        if own:
            sizes[camera] = own.most_common(1)[0][0]
    for name in [name for name in measured if name in seen]:
        width, height = sizes[_camera_of(name, taken)]
        if seen[name] != (width, height):
            del measured[name]
            declined[name] = f"is {seen[name][0]}×{seen[name][1]} pixels, not {width}×{height}"
            if seen[name] == (height, width):
                declined[name] += ": turned by a program, take the file as the camera wrote it"
    return measured, declined, sizes


def _camera_of(name: str, taken: Mapping[str, Taken] | None) -> str:
    return taken[name].camera if taken else _CAMERA


def _by_reason(declined: Mapping[str, str]) -> dict[str, str]:
    """Each reason with the images to which it applies, of more than three the first and their number."""
    found: dict[str, list[str]] = {}
    for image, reason in declined.items():
        found.setdefault(reason, []).append(image)
    return {
        reason: ", ".join(images) if len(images) < 4 else f"{images[0]} and {len(images) - 1} others"
        for reason, images in found.items()
    }


def _without(
    measured: dict[str, ImagePoints], leave_out: Sequence[tuple[str, str]]
) -> dict[str, ImagePoints]:
    """Leave out image points."""
    for image, point in leave_out:
        points = measured.get(image)
        if points is None or point not in points.names:
            raise UsageError(
                "was not measured", where=f"point {point} in image {image}", do="name a measured image point"
            )
        keep = np.array([name != point for name in points.names])
        names = tuple(name for name in points.names if name != point)
        measured = measured | {image: ImagePoints(names, points.xy[keep], points.cov[keep])}
    return measured


def _controlled(network: Network, control: ControlPoints) -> Network:
    """Return the network with control points, which define the datum."""
    row = {name: k for k, name in enumerate(network.points)}
    xyz, sigma, role = network.xyz.copy(), network.sigma.copy(), list(network.role)
    for name, given, own in zip(control.names, control.xyz, control.sigma, strict=True):
        if name not in row:
            raise UsageError("was measured in no image", where=f"control point {name}")
        at, known = row[name], np.isfinite(own)
        xyz[at, known], sigma[at] = given[known], own
        role[at] = "control"
    return replace(network, xyz=xyz, sigma=sigma, role=tuple(role), datum="control")


def _scaled(network: Network) -> Network:
    """Return the network with its longest diagonals as distances."""
    rows = np.flatnonzero(network.rays > 1)
    x, y = network.xyz[rows, :2].T
    ends = [(rows[np.argmin(along)], rows[np.argmax(along)]) for along in (x + y, x - y)]
    pairs = np.array([pair for pair in ends if pair[0] != pair[1]], dtype=np.intp).reshape(-1, 2)
    length = np.linalg.norm(network.xyz[pairs[:, 1]] - network.xyz[pairs[:, 0]], axis=1)
    return replace(network, distance_of=pairs, distance=np.column_stack([length, _PRINTED * length]))


def network_of(
    measured: Mapping[str, ImagePoints],
    design: PlaneDesign,
    camera: Camera,
    groups: Sequence[str] | None = None,
) -> Network:
    """Create the free network of images of a plane target, with inner constraints over all its points.

    Parameters
    ----------
    measured : mapping of str to ImagePoints
        Measured points of each image, named as in the design.
    design : PlaneDesign
        Target with the approximate coordinates; heights are zero.
    camera : Camera
        Camera of all images.
    groups : sequence of str, optional
        Group of each image.
    """
    seen = sorted({name for points in measured.values() for name in points.names})
    known = {name: k for k, name in enumerate(design.ids)}
    names = tuple(sorted((name for name in seen if name in known), key=known.__getitem__))
    row = {name: k for k, name in enumerate(names)}
    at = [[k for k, name in enumerate(points.names) if name in row] for points in measured.values()]
    parts = list(zip(measured.values(), at, strict=True))
    xyz = np.zeros((len(names), 3))
    xyz[:, :2] = design.xy[[known[name] for name in names]]
    m, p = len(measured), len(names)
    return Network(
        cameras=(camera,),
        images=tuple(measured),
        camera_of=np.zeros(m, dtype=np.intp),
        x0=np.full((m, 3), np.nan),
        rotation=np.full((m, 3), np.nan),
        points=names,
        xyz=xyz,
        sigma=np.full((p, 3), np.nan),
        role=("tie",) * p,
        image_of=np.repeat(np.arange(m), [len(rows) for rows in at]).astype(np.intp),
        point_of=np.array([row[points.names[k]] for points, rows in parts for k in rows], dtype=np.intp),
        xy=np.concatenate([points.xy[rows] for points, rows in parts]),
        cov=np.concatenate([points.cov[rows] for points, rows in parts]),
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="free",
        datum_points=np.ones(p, dtype=bool),
        groups=(None,) * m if groups is None else tuple(groups),
        files=tuple(measured),
        unit=design.unit,
    )


def _magnification(refraction: Refraction | None) -> float:
    """How much larger than in air the windows on the camera show distant things; 1.33 for a port in water."""
    if refraction is None or not refraction.paths:
        return 1.0
    ports = refraction.ports()
    if not ports.paths:
        return 1.0
    only = replace(ports, paths=ports.paths[:1], path_of=np.zeros(1, dtype=np.intp))
    pose, every = (np.eye(3)[None], np.zeros((1, 3))), np.arange(2)
    far = 1e4 * float(np.abs(only.values).max(initial=1.0))
    points = far * np.array([[-_NARROW, -_NARROW, 1.0], [_NARROW, _NARROW, 1.0]])
    rays = RefractedRays.of(only.columns(only.values), only.path_of, *pose, points, 0 * every, every)
    return float((rays.uv[1] - rays.uv[0]).mean()) / (2 * _NARROW) if rays.reached.all() else 1.0


def first_camera(
    measured: Mapping[str, ImagePoints],
    design: PlaneDesign,
    size: tuple[int, int],
    model: CameraOptions,
    magnification: float = 1.0,
    focal_px: float | None = None,
) -> Camera:
    """Return a camera with approximate values, from the homographies of the images (Zhang 2000).

    With parallel rays, affine mappings of the plane have the magnification: it is not foreshortened along the
    axis about which the plane is tilted. `magnification` is that of windows before the camera, `focal_px`
    what the camera itself says.
    """
    known = dict(zip(design.ids, design.xy, strict=True))
    object_points, image_points = list[Any](), list[Any]()
    for points in measured.values():
        rows = [k for k, name in enumerate(points.names) if name in known]
        plane = np.array([known[points.names[k]] for k in rows]).reshape(-1, 2)
        object_points.append(np.column_stack([plane, np.zeros(len(rows))]).astype(np.float32))
        image_points.append(points.xy[rows].astype(np.float32))
    if model.registered.parallel:
        f = _scale(object_points, image_points)
    else:
        # Points of one line have no homography.
        pairs = [
            (plane, xy) for plane, xy in zip(object_points, image_points, strict=True)
            if len(xy) >= 4 and cv2.findHomography(plane[:, :2], xy)[0] is not None
        ]  # fmt: skip
        f = 0.0
        if pairs:
            planes, seen = [plane for plane, _ in pairs], [xy for _, xy in pairs]
            f = float(cv2.initCameraMatrix2D(planes, seen, size, 1.0)[0, 0])
        if not np.isfinite(f) or not 0.2 * max(size) < f < 100 * max(size):
            f = focal_px or 1.2 * max(size)
        if focal_px is not None and not focal_px / _FOCAL_OFF < f < _FOCAL_OFF * focal_px:
            f = focal_px
    f /= magnification
    pitch = model.pitch_mm if isinstance(model.pitch_mm, tuple) else (1.0, 1.0)
    values = model.registered.start_values(f, PixelGrid(*size, pitch))
    return Camera(
        _CAMERA, *size, pitch, model.registered.name, values, model.chosen, model.options,
        sigma=model.registered.priors(model.chosen), shutter=model.shutter,
    )  # fmt: skip


def _scale(object_points: Sequence[Any], image_points: Sequence[Any]) -> float:
    """Pixels per unit of object space: the largest scale of affine mappings, in the median of the images."""
    scales = []
    for plane, xy in zip(object_points, image_points, strict=True):
        design = plane[:, :2].astype(np.float64) - plane[:, :2].mean(axis=0)
        mapping = np.linalg.lstsq(design, xy - xy.mean(axis=0), rcond=None)[0]
        scales.append(float(np.linalg.svd(mapping, compute_uv=False)[0]))
    return float(np.median(scales))
