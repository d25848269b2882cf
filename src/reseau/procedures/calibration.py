"""Calibration of a camera, or of several fixed to each other, from photographs of a target.

The coordinates of the design are only approximate values: all points of the target are unknowns, and the
network has inner constraints over them (a free network). Scale and datum are those of the design on average
over its points; the unevenness of the target is estimated as heights. Points with known coordinates may be
given as control points instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from ..bundle import Camera, Network, Result, choose_board, choose_models, search_model
from ..bundle.diagnostics.checks import in_images
from ..bundle.diagnostics.fields import camera_mapping
from ..bundle.explanations.names import Misnamed, misnamed
from ..bundle.modelling.board import held_as_designed
from ..bundle.modelling.choice import ModelChoice
from ..bundle.network.network import ControlPoints
from ..bundle.network.rig import Rig
from ..bundle.network.turntable import stage_of_turntable
from ..calibration import CameraMapping
from ..core.data import Array, ImagePoints
from ..core.errors import UsageError
from ..core.failure import Code, Failure
from ..execution import Executor, Outputs
from ..io import BoardDesign
from ..io.network import TurntableEntry
from ..io.photographs import Exif
from ..optics import PixelGrid, camera_model
from ..optics.refraction import RefractedRays
from ..optics.refraction.windows import Refraction
from .calibrated import ONE_CAMERA, Calibrated
from .calibration_options import CalibrationOptions, CameraOptions, PlaneDesign
from .copies import copies_among, said_of_copies
from .exposures import Taken
from .target_measurement import MeasuredPhotograph, Measurer, Photograph, by_reason, few_of
from .told_target import measured_as_shown, named_alike, named_by_others, ways_to_turn

_LEAST_POINTS = 8
_LEAST_IMAGES = 3
# Relative standard deviation of a principal distance above which nothing follows from a calibration.
_HARDLY = 0.2
_FOCAL_OFF = 1.5
"""Factor beyond which the focal length of the homographies contradicts that which the camera says."""
_CONTRADICTED, _BETTER, _RENAMED = 1.5, 0.7, 3
"""Standard deviation of unit weight from which photographs may name the points of a regular target
differently; share of it to which the same names must lower it; most attempts."""
_SHIFTED = (
    "{}: a part of a regular pattern, whose names may be shifted by rows or columns: the pose of such a "
    "photograph may be shifted, too; the camera is not affected"
)
_UNNAMED = "which part of the target it shows is not certain, and no other photograph tells"
_LEFT_OUT = "{} image points are gross errors, and are left out: {}; --no-reject keeps them"
_VIEWS = "{} photographs are {} views: {} repeat their errors, and count once"
_MORE_TILTED = "add images with the camera tilted by 20 to 40 degrees in different directions"
# Relative standard deviation of a diagonal of the target.
_PRINTED = 1e-4
_NARROW = 1e-3


def calibrate_camera(
    frames: Iterable[Photograph],
    design: PlaneDesign,
    measure: Measurer,
    size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    model: CameraOptions | Mapping[str, CameraOptions] | None = None,
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
    model : CameraOptions, or mapping of str to CameraOptions, optional
        Camera model and parameters to estimate, of all cameras or of each by its name; by default the model
        is chosen, see :func:`reseau.bundle.choose_models`.
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
    seen = measured_as_shown(_checked(frames, taken), design, measure, executor, outputs)
    design, photographs = seen.corrected or design, seen.photographs
    measured, declined, sizes = _measured(photographs, size, taken)
    copies = copies_among(measured)
    measured = {name: points for name, points in measured.items() if name not in copies}
    declined |= {name: f"a copy of {original}" for name, original in copies.items()}
    measured = _without(measured, options.leave_out)
    notes = (*seen.notes, *said_of_copies(copies), *(note for each in photographs for note in each.notes))
    unsure = {
        each.name: measured[each.name] for each in photographs if not each.certain and each.name in measured
    }
    tied = taken is not None or options.turntable is not None
    if unsure and not tied:
        notes += (_SHIFTED.format(few_of(tuple(unsure))),)
    names, _ = _cameras_of((), taken)
    given = model if isinstance(model, Mapping) else {} if model is None else dict.fromkeys(names, model)
    if unknown := [name for name in given if name not in names]:
        raise UsageError("is no camera of the photographs", where=f"model of {unknown[0]}")
    models = {name: given.get(name, CameraOptions("auto")) for name in names}
    job = _Job(declined, sizes, notes, design, models, options, taken, seen.shown)
    # Poses that depend on each other would contradict each other with names that are shifted.
    done = job.calibrated({k: each for k, each in measured.items() if not (tied and k in unsure)})
    if unsure and tied:
        named = {}
        if taken and isinstance(design, BoardDesign) and not isinstance(done, Failure):
            named = named_by_others(unsure, taken, design, done.result)
        declined |= dict.fromkeys(unsure.keys() - named.keys(), _UNNAMED)
        if named:
            every = {k: named.get(k, each) for k, each in measured.items() if k in named or k not in unsure}
            done = job.calibrated(every)
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
            again = job.adjusted(alike, done.misnamed, done.result.network.cameras)
            if isinstance(again, Failure) or again.sigma0 > _BETTER * done.sigma0:
                break
            done = job.calibrated(alike)
    return done if isinstance(done, Failure) else done.described(corrected=seen.corrected)


@dataclass(frozen=True, eq=False)
class _Job:
    """All that a calibration is of, but the image points: some of these are found to be wrong."""

    declined: dict[str, str]
    sizes: Mapping[str, tuple[int, int]]
    notes: tuple[str, ...]
    design: PlaneDesign
    models: Mapping[str, CameraOptions]
    options: CalibrationOptions
    taken: Mapping[str, Taken] | None
    shown: str = ""
    """What photographs show in place of the target, in words."""

    def calibrated(self, measured: dict[str, ImagePoints]) -> Calibrated | Failure:
        """Calibrate from the points of photographs."""
        design, sizes, options, taken = self.design, self.sizes, self.options, self.taken
        cameras, of = _cameras_of(measured, taken)
        for c, name in enumerate(cameras):
            if of.count(c) < _LEAST_IMAGES:
                own = [image for image, at in zip(measured, of, strict=True) if at == c]
                which = f" of camera {name}" if taken else ""
                which += f" ({', '.join(own)})" if own else ""
                why = f"; {self.shown}" if self.shown else ""
                for reason, images in by_reason(self.declined).items():
                    why += f"; {few_of(images)}: {reason}"
                show = f"image{which} shows" if len(own) == 1 else f"images{which} show"
                return Failure(
                    f"{len(own)} {show} the target, {_LEAST_IMAGES} are needed, 10 are good{why}",
                    Code.TOO_FEW_IMAGES,
                )
        if not all(name in sizes for name in cameras):
            raise UsageError(
                "is not known without a photograph",
                where="size of the images",
                do="give width and height (image_size)",
            )
        stand_in = Camera(ONE_CAMERA, 1, 1, (1.0, 1.0), "opencv", np.zeros(len(camera_model("opencv").names)))
        wrong = left_out(network_of(measured, design, stand_in), cameras, sizes, of)
        if wrong is None:
            return self._decided(self.adjusted(measured, None), measured, None)
        # Which points are wrong is seen best with the target as designed: its errors are small beside theirs.
        more = options.target != "free" or options.control or options.heights or options.refraction
        first = self if more else replace(self, options=replace(options, target="flat"))
        done = first.adjusted(wrong.kept(measured), wrong.found)
        still = wrong if isinstance(done, Failure) else wrong.after(done.result)
        same = still is not None and np.array_equal(still.found.rows, wrong.found.rows)
        kept, found = (measured, None) if still is None else (still.kept(measured), still.found)
        if not same or not more:
            done = self.adjusted(kept, found)
        elif not isinstance(done, Failure):
            done = replace(done, misnamed=found)
        return self._decided(done, kept, found)

    def _decided(
        self, done: Calibrated | Failure, measured: dict[str, ImagePoints], wrong: Misnamed | None
    ) -> Calibrated | Failure:
        """What was adjusted from the points; without gross errors where these explain what is left."""
        if self.options.reject is not None:
            return done
        if isinstance(done, Failure):
            wrong_points = done.code is Code.NOT_CONVERGED
        else:
            wrong_points = [cause.code for cause in done.explanation.causes[:1]] == ["blunders"]
        if not wrong_points:
            return done
        without = replace(self, options=replace(self.options, reject=True)).adjusted(measured, wrong)
        if isinstance(without, Failure):
            return done
        rows = np.flatnonzero(without.result.rejected)
        if not len(rows):
            return without
        said = _LEFT_OUT.format(len(rows), in_images(without.result.network, rows))
        return replace(without, notes=(*without.notes, said))

    def adjusted(
        self, measured: dict[str, ImagePoints], wrong: Misnamed | None, known: tuple[Camera, ...] = ()
    ) -> Calibrated | Failure:
        """Adjust the points of photographs, of which those that are wrong were left out.

        Models of cameras that are known are not chosen again.
        """
        design, sizes, options, taken = self.design, self.sizes, self.options, self.taken
        notes, adjustment = self.notes, options.adjustment
        if options.reject is not None:
            adjustment = replace(adjustment, outliers="reject" if options.reject else "keep")
        measured = {name: points for name, points in measured.items() if len(points) >= _LEAST_POINTS}
        cameras, of = _cameras_of(measured, taken)
        refraction = None
        if options.refraction is not None:
            refraction = options.refraction.refraction(tuple(measured), tuple(cameras[c] for c in of))
        larger, said = _magnification(refraction), Exif(focal_35_mm=options.focal_35_mm)
        entries = []
        for c, name in enumerate(cameras):
            own = {image: points for (image, points), at in zip(measured.items(), of, strict=True) if at == c}
            entries.append(
                replace(
                    first_camera(
                        own, design, sizes[name], self.models[name], larger, said.focal_px(*sizes[name])
                    ),
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
        choices = dict[str, ModelChoice]()
        # With all points free: what is wrong with a target must not choose the model of the lens.
        if known:
            network = replace(network, cameras=known)
        elif automatic := [name for name in cameras if self.models[name].automatic]:
            given = [c for c, name in enumerate(cameras) if name not in automatic]
            chosen = choose_models(network, options=adjustment, known=given)
            if isinstance(chosen, Failure):
                first = self.models[automatic[0]].registered.name
                notes = (*notes, f"camera model {first}, none could be chosen: {chosen.reason}")
            else:
                network = replace(network, cameras=tuple(each.camera for each in chosen))
                choices = {c: one for c, one in zip(cameras, chosen, strict=True) if c in automatic}
        board = None
        if options.target == "flat":
            network = held_as_designed(network)
        if options.target == "auto":
            bent = choose_board(network, adjustment)
            if isinstance(bent, Failure):
                return bent
            board, network = bent, bent.network
        found = search_model(network, adjustment, options.components, options.eliminate)
        if isinstance(found, Failure):
            if found.code is Code.NOT_CONVERGED:
                return replace(found, reason=f"{found.reason}; {_MORE_TILTED}")
            return found
        # What was not chosen may yet be there.
        others = tuple(choices[name].rivals if name in choices else None for name in cameras)
        found = replace(found, rivals=others if choices else None)
        notes = (*notes, *_of_views(found))
        calibrated = Calibrated(found, measured, self.declined, choices, board, notes, wrong)
        loose = _without_scale(calibrated.result)
        return calibrated if loose is None else loose


def _cameras_of(images: Iterable[str], taken: Mapping[str, Taken] | None) -> tuple[list[str], list[int]]:
    """Names of the cameras, and the number of that of each image."""
    cameras = list(dict.fromkeys(each.camera for each in taken.values())) if taken else [ONE_CAMERA]
    return cameras, [cameras.index(taken[name].camera) if taken else 0 for name in images]


def _of_views(result: Result) -> list[str]:
    """A note where photographs repeat each other's errors, naming the most that do."""
    if result.shared is None:
        return []
    views, images = result.shared.views, np.array(result.network.images)
    count = np.bincount(views)
    alike = images[views == int(count.argmax())].tolist()
    return [_VIEWS.format(len(images), len(count), few_of(alike))] if len(count) < len(images) else []


def _without_scale(result: Result) -> Failure | None:
    """A failure where the pixels in a radian at the centre, or a magnification, are hardly known, if any."""
    for c, camera in enumerate(result.network.cameras):
        if camera.registered is None or not camera.has_plane_mapping:
            continue
        names, how = list(camera.registered.of_role("scale")), ""
        values = result.fit.values.cameras[c, : len(camera.values)]
        if np.isfinite(camera.bare_mapping(values)(np.zeros((1, 2)))).all():
            lens = camera_mapping(result, c)
            names = [name for name in names if name in lens.names]
            if (relative := _relative_scale(lens)) <= _HARDLY:
                continue
            how = f", which is uncertain by {100 * relative:.0f} %"
        what = f"the images do not determine {names[0] if names else 'the scale'}{how}; {_MORE_TILTED}"
        # What contradicts the rest makes all sigmas large.
        first = "" if result.contradiction is None else f"{result.contradiction.text}; "
        return Failure(f"{first}{camera.label}: {what}", Code.NOT_IDENTIFIED)
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
    every = {each.camera for each in taken.values()} if taken else {ONE_CAMERA}
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
    return taken[name].camera if taken else ONE_CAMERA


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
        ONE_CAMERA, *size, pitch, model.registered.name, values, model.chosen, model.options,
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


_STAND_IN = "opencv"
"""Model of a camera of which only the size of its images is used."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Image points that are left out, and the others.

    Parameters
    ----------
    network : Network
        All image points, with the coordinates of the design.
    found : Misnamed
        Those that are left out.
    """

    network: Network
    found: Misnamed

    def kept(self, measured: Mapping[str, ImagePoints]) -> dict[str, ImagePoints]:
        """The measured points without those that are left out."""
        network = self.network
        wrong = {
            (network.images[network.image_of[k]], network.points[network.point_of[k]])
            for k in self.found.rows
        }
        kept = {}
        for image, points in measured.items():
            keep = np.array([(image, name) not in wrong for name in points.names])
            names = tuple(name for name, good in zip(points.names, keep, strict=True) if good)
            kept[image] = ImagePoints(names, points.xy[keep], points.cov[keep])
        return kept

    def after(self, result: Result) -> LeftOut | None:
        """Those that still lie in other places by the cameras of an adjustment without them."""
        adjusted = result.network
        plain = all(camera.has_plane_mapping for camera in adjusted.cameras)
        if adjusted.refraction is not None or not plain:
            return self
        by_name = {
            camera.id: camera_mapping(result, c, formal=True).mapping
            for c, camera in enumerate(adjusted.cameras)
        }
        lenses = [by_name[camera.id] for camera in self.network.cameras]
        found = misnamed(self.network, lenses, self.found)
        if found is None:
            return None
        # A camera by which more points lie nowhere, such as one with a pole, tells less than no camera.
        return self if found.nowhere > self.found.nowhere else replace(self, found=found)


def left_out(
    network: Network, cameras: Sequence[str], sizes: Mapping[str, tuple[int, int]], of: Sequence[int]
) -> LeftOut | None:
    """Find image points that lie in the places of others.

    Parameters
    ----------
    network : Network
        Image points and the design; its cameras are not used.
    cameras, sizes, of : sequence of str, mapping of str to (int, int), sequence of int
        Names of the cameras, sizes of their images, and the camera of each image.
    """
    values = np.zeros(len(camera_model(_STAND_IN).names))
    plain = tuple(Camera(name, *sizes[name], (1.0, 1.0), _STAND_IN, values) for name in cameras)
    network = replace(network, cameras=plain, camera_of=np.array(of, dtype=np.intp))
    found = misnamed(network)
    return None if found is None else LeftOut(network, found)
