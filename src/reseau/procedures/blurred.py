"""Blurred targets of a design: orientation of the image by their corresponding rays, and their measurement.

Meid (1992), section 3, for one image: approximate image coordinates orient the image, the orientation gives
the images of the targets by rays, matching with these gives better image coordinates, and so on until they no
longer change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..adjust import GaussMarkov, Options, Parameters, adjust
from ..bundle import Camera, Network
from ..bundle.solver.datum import similarity_onto
from ..bundle.solver.spatial import resect
from ..core.data import Array, Frame, ImagePoints
from ..core.errors import UsageError
from ..core.failure import Code, Failure, Remark
from ..exchange.lenses import Lens
from ..io import ReseauDesign, TestfieldDesign
from ..measure.blurred import BlurredOptions, estimate_optics, measure_blurred
from ..measure.blurred.measure import BlurredResult, Varied
from ..measure.blurred.motion import Altered, Explained, Moving, focus_remark, measure_explained
from ..optics import Pose
from ..optics.formation import mark_outline
from ..optics.lenses import Paraxial, Prescription, RayMap, ThinLens
from ..optics.lenses.images import PlaneTarget, image_scale
from ..optics.lenses.ray_maps import CalibratedLens, LensCamera, SensorPlane
from ..optics.newton import newton
from ..optics.poses import matrix_to_vector, rotation_matrix
from ..optics.targets import target_outline
from .target_measurement import Measurer, measurer_of

Design = ReseauDesign | TestfieldDesign

SPACING_PX = 0.8
"""Largest distance of nodes along outlines: images shift by less than 1e-4 px against those of many nodes."""
_FAR = 1e5
"""Distance of an object far away, mm."""
_ROUNDS = 3
_SETTLED_PX = 0.3
"""A change of the predicted positions below this does not change the formed images noticeably."""
_FEWEST = 6
"""Points for an orientation: twice what its six unknowns need."""
_MISFIT, _LEAST_MISFIT_PX = 3.0, 0.05
"""Residuals of the orientation over sigmas, and in pixels, from which there is a warning."""
_FLAT = 0.01
"""Largest difference between a design and its points in a network, in extents of the design."""


@dataclass(frozen=True, eq=False)
class BlurredFrame:
    """Blurred targets of a frame, and its orientation.

    Parameters
    ----------
    measured : BlurredResult
    pose : Pose
        From the plane of the design to camera axes, millimetres.
    targets : tuple of PlaneTarget (n,)
        The targets in camera axes.
    rms_px : float
        Root mean square of the residuals of the orientation; NaN where it was given.
    camera : RayMap
        The lens, with the focus and the motion that were estimated.

    Examples
    --------
    See :func:`measure_blurred_frame`, which returns it; the orientation is a pose:

    >>> pose = Pose(np.zeros(3), np.array([0.0, 0.0, -500.0]))
    >>> pose(np.zeros((1, 3)))
    array([[  0.,   0., 500.]])
    """

    measured: BlurredResult
    pose: Pose
    targets: tuple[PlaneTarget, ...]
    rms_px: float
    camera: RayMap


def focused(lens: Prescription, distance: float) -> Prescription:
    """A lens with its image surface moved to where an object on the axis is sharp, in first order.

    Parameters
    ----------
    lens : Prescription
    distance : float
        From the first surface to the object, mm.

    Raises
    ------
    UsageError
        When the image of that object is not behind the lens.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, in_order
    >>> from reseau.optics.lenses.media import Constant
    >>> lens = Prescription(in_order([(0.02, 6.0, Constant(1.5)), (0.0, 96.0, AIR)]), stop=0, stop_radius=8.0)
    >>> round(float(focused(lens, 1000.0).surfaces[-1].vertex[2]), 2)
    113.11
    """
    first = Paraxial(lens)
    behind = first.image_distance(distance)
    if not 0 < behind < np.inf:
        raise UsageError(f"forms no real image of an object at {distance:g} mm", where=lens.name)
    last = max(k for k, surface in enumerate(lens.surfaces) if surface.kind != "plain")
    surface, image = lens.surfaces[last], lens.surfaces[-1]
    sign = np.sign(first.indices[last + 1])
    wanted = surface.vertex + sign * behind * surface.axes[:, 2]
    along = image.axes[:, 2]
    return lens.moved(((wanted - image.vertex) @ along) * along)


def lens_camera(
    lens: Lens,
    size_px: tuple[int, int],
    *,
    pitch_mm: float | None = None,
    distance: float | None = None,
    f_number: float | None = None,
) -> LensCamera:
    """A camera of a lens as read from a file.

    Parameters
    ----------
    lens : Lens
        See :func:`reseau.exchange.read_lens`.
    size_px : (int, int)
        Width and height of its images.
    pitch_mm : float, optional
        Size of a pixel where the file has no sensor; the axis is then at the centre of the image.
    distance : float, optional
        Distance from the first surface at which objects are sharp, mm; by default the image surface is where
        the prescription has it.
    f_number : float, optional
        Sets the radius of the stop.

    Raises
    ------
    UsageError
        When there is no sensor and no pitch, its size is another one, or no light passes the lens.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, in_order
    >>> from reseau.optics.lenses.media import Constant
    >>> lens = Prescription(in_order([(0.02, 6.0, Constant(1.5)), (0.0, 96.0, AIR)]), stop=0, stop_radius=8.0)
    >>> camera = lens_camera(Lens(lens), (1001, 801), pitch_mm=0.01, distance=1000.0)
    >>> camera.corresponding(np.array([[0.0, 0.0, 1000.0]]))
    array([[500., 400.]])
    """
    prescription, sensor = lens.prescription, lens.sensor
    if sensor is None:
        if pitch_mm is None:
            raise UsageError(
                "has no sensor",
                where=prescription.name,
                do="give --pitch-mm, or add [sensor] to the file",
            )
        width, height = size_px
        plane = SensorPlane((pitch_mm, pitch_mm), ((width - 1) / 2, (height - 1) / 2))
    elif pitch_mm is not None:
        raise UsageError("has a sensor; its pitch is not needed", where=prescription.name)
    elif tuple(sensor.size_px) != tuple(size_px):
        raise UsageError(
            "its sensor has {}×{} pixels, the image {}×{}".format(*sensor.size_px, *size_px),
            where=prescription.name,
        )
    else:
        plane = sensor.plane()
    if f_number is not None:
        first = Paraxial(prescription)
        radius = abs(first.focal_length) / (2 * f_number) / abs(first.entrance_pupil[1])
        prescription = replace(prescription, stop_radius=radius)
    camera = LensCamera(prescription if distance is None else focused(prescription, distance), plane)
    far = np.array([0.0, 0.0, distance or _FAR])
    if not np.isfinite(camera.corresponding(far[None])).all():
        raise UsageError(
            f"forms no image of a point on the axis: {camera.why_dark(far)}", where=prescription.name
        )
    return camera


def thin_lens_of(camera: Camera, *, distance: float, f_number: float) -> ThinLens:
    """Stand-in for the lens of a camera from its calibration: a thin lens with its principal distance.

    Parameters
    ----------
    camera : Camera
        With a principal distance.
    distance : float
        Distance from the lens at which objects are sharp, mm.
    f_number : float
        Focal length over the diameter of the entrance pupil.

    Raises
    ------
    UsageError
        When the camera has no principal distance.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> round(thin_lens_of(example_network().cameras[0], distance=1000.0, f_number=4.0).focal_length, 5)
    7.93651
    """
    mapping = camera.bare_mapping(camera.values)
    pitch = np.array([*camera.pitch_mm])
    small = 1e-4
    across = np.diff(mapping(np.array([[0.0, 0.0], [small, 0.0], [0.0, small]])), axis=0)
    away = float(np.abs(across[0, 0]) * pitch[0] / small)
    if not 0 < away < np.inf:
        raise UsageError("has no principal distance", where=camera.label, do="give the design of the lens")
    focal = 1 / (1 / away + 1 / distance)
    middle = mapping(np.zeros((1, 2)))[0]
    plane = SensorPlane((float(pitch[0]), float(pitch[1])), (float(middle[0]), float(middle[1])))
    return ThinLens(focal, focal / f_number, away, plane)


def targets_of(design: Design, pose: Pose, camera: RayMap) -> tuple[tuple[str, ...], list[PlaneTarget]]:
    """Names and targets of a design in camera axes.

    Parameters
    ----------
    design : ReseauDesign or TestfieldDesign
        In millimetres.
    pose : Pose
        From the plane of the design, z = 0, to camera axes.
    camera : RayMap
        The image of a target gives the spacing of the nodes along its outline.

    Raises
    ------
    UsageError
        When the design is not in millimetres, or its marks have no outline of their own.

    Examples
    --------
    >>> from reseau.designs import coded_testfield
    >>> from reseau.optics.lenses import ThinLens
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (500.0, 400.0)))
    >>> pose = Pose.from_angles(0.0, 0.0, 0.0, [0.0, 0.0, 1500.0])
    >>> names, targets = targets_of(coded_testfield(), pose, camera)
    >>> len(names) == len(targets), round(targets[0].centre[2])
    (True, 1500)
    """
    if design.unit != "mm":
        raise UsageError(f"the design is in {design.unit}, lenses are in mm", where=design.name)
    matrix = pose.matrix
    centres = pose(np.concatenate([design.xy, np.zeros((len(design.ids), 1))], axis=1))
    axes = matrix[:, :2]
    scales = image_scale(camera, centres, np.broadcast_to(axes, (len(centres), 3, 2)))
    if not np.isfinite(scales).any():
        raise UsageError("the design is not in the field of the lens", where=design.name)
    spacing = SPACING_PX / float(np.nanmedian(scales))
    if isinstance(design, TestfieldDesign):
        t = design.targets
        outlines = [
            target_outline(shape, size, angle, spacing)
            for shape, size, angle in zip(t.shape, t.size, t.angle, strict=True)
        ]
    else:
        mark = design.mark
        if mark.shape == "line-grid" or mark.size is None:
            raise UsageError("its marks have no outline of their own", where=design.name)
        outlines = [mark_outline(mark.shape, mark.size, mark.line_width, spacing)] * len(design.ids)
    return tuple(design.ids), [
        PlaneTarget(centre, axes, outline) for centre, outline in zip(centres, outlines, strict=True)
    ]


def orient_by_rays(camera: RayMap, design: Design, points: ImagePoints) -> tuple[Pose, float] | Failure:
    """Orient an image of a plane design: space resection with the corresponding rays of a lens.

    Parameters
    ----------
    camera : RayMap
    design : ReseauDesign or TestfieldDesign
    points : ImagePoints
        Measured points, named as in the design.

    Returns
    -------
    (Pose, float) or Failure
        From the plane of the design to camera axes, and the rms of the residuals in pixels.

    Examples
    --------
    >>> from reseau.designs import coded_testfield
    >>> from reseau.optics.lenses import ThinLens
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (500.0, 400.0)))
    >>> field, pose = coded_testfield(), Pose.from_angles(0.2, 0.1, 0.3, [30.0, -400.0, 1500.0])
    >>> plane = np.concatenate([field.xy, np.zeros((len(field.ids), 1))], axis=1)
    >>> cov = np.tile(1e-4 * np.eye(2), (len(plane), 1, 1))
    >>> seen = ImagePoints(field.ids, camera.corresponding(pose(plane)), cov)
    >>> found, rms = orient_by_rays(camera, field, seen)
    >>> found.x0.round(3), rms < 1e-6
    (array([  30., -400., 1500.]), True)
    """
    at = {name: k for k, name in enumerate(design.ids)}
    rows = [k for k, name in enumerate(points.names) if name in at]
    if len(rows) < _FEWEST:
        return Failure(f"{len(rows)} points; {_FEWEST} are needed to orient an image", Code.TOO_FEW_POINTS)
    plane = np.concatenate([design.xy[[at[points.names[k]] for k in rows]], np.zeros((len(rows), 1))], axis=1)
    xy = points.xy[rows]
    slopes = _approximate_slopes(camera, xy)
    start = resect(plane, slopes, 0.05)
    if start is None:
        return Failure("no pose agrees with the points", Code.WEAK_GEOMETRY)

    def computed(x: Array) -> Array:
        return camera.corresponding(Pose(x[:3], x[3:])(plane))

    names = ("rotation_x", "rotation_y", "rotation_z", "X0", "Y0", "Z0")
    values = np.concatenate([matrix_to_vector(start.rotation), start.x0])
    problem = GaussMarkov(computed, xy, points.cov[rows], Parameters(names, values))
    found = adjust(problem, Options(scale="a-priori"))
    if isinstance(found, Failure):
        return found
    residuals = computed(found.values) - xy
    return Pose(found.values[:3], found.values[3:]), float(np.sqrt((residuals**2).mean()))


def _approximate_slopes(camera: RayMap, xy: Array) -> Array:
    """X/Z and Y/Z (n, 2) of points of the image, by Newton's method for objects far away."""
    h = 1e-3

    def pixels(slopes: Array) -> Array:
        return camera.corresponding(_FAR * np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1))

    def slope_at(slopes: Array) -> tuple[Array, Array]:
        here = pixels(slopes)
        return here, np.stack([(pixels(slopes + step) - here) / h for step in h * np.eye(2)], axis=2)

    return newton(slope_at, xy, np.zeros_like(xy), np.zeros((1, 2)))


def measure_blurred_frame(
    frame: Frame,
    design: Design,
    camera: RayMap,
    pose: Pose | None = None,
    options: BlurredOptions | None = None,
    *,
    sharp: Measurer | None = None,
    focus_sigma_mm: float | None = None,
    exposure_lines: float | None = None,
) -> BlurredFrame | Failure:
    """Measure the blurred targets of a plane design in a frame.

    Without a pose, the targets are first measured as if they were sharp, and the image is oriented by the
    principal rays; measurement and orientation are then repeated until the images formed no longer change.

    Parameters
    ----------
    frame : Frame
    design : ReseauDesign or TestfieldDesign
        In millimetres.
    camera : RayMap
        The lens with its sensor.
    pose : Pose, optional
        From the plane of the design to camera axes, from a bundle adjustment; it is not changed.
    options : BlurredOptions, optional
    sharp : callable, optional
        Measures the targets as if they were sharp; by default as :func:`measurer_of` does.
    focus_sigma_mm : float, optional
        Standard deviation of the place of the image surface of a lens: it is estimated from all targets.
    exposure_lines : float, optional
        Lines of a rolling shutter that are read during an exposure; by default all are exposed at once.

    Returns
    -------
    BlurredFrame or Failure

    Raises
    ------
    UsageError
        When a focus is to be estimated of a map of rays that is not a lens.

    Examples
    --------
    >>> from reseau.designs import coded_testfield
    >>> from reseau.optics.lenses import ThinLens
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (500.0, 400.0)))
    >>> blank = Frame(np.random.default_rng(0).normal(100, 1, (800, 1000)), 255.0)
    >>> bool(measure_blurred_frame(blank, coded_testfield(), camera))
    False
    """
    options = options or BlurredOptions(polarity=design.polarity)
    given = focus_sigma_mm is not None
    taken = _Frame(frame, design, options, given, 0.0 if exposure_lines is None else 2 / exposure_lines)
    if pose is not None:
        sharpened = _focused(frame, design, camera, pose, options, focus_sigma_mm)
        if isinstance(sharpened, Failure):
            return sharpened
        found, _ = taken.measured(sharpened[0], pose, np.nan)
        return _some(_described(_noted(found, [focus_remark(*sharpened[1:])] if given else [])))
    first = (sharp or measurer_of(design))(frame)
    if isinstance(first, Failure):
        return replace(first, reason=f"no approximate positions: {first.reason}")
    points, before, moved = first.points, np.full((len(design.ids), 2), np.inf), 0.0
    reason: Explained | None = None
    for k in range(_ROUNDS):
        oriented = orient_by_rays(camera, design, points)
        if isinstance(oriented, Failure):
            return oriented
        sharpened = _focused(frame, design, camera, oriented[0], options, focus_sigma_mm)
        if isinstance(sharpened, Failure):
            return sharpened
        view, by, sigma = sharpened
        moved += by
        found, reason = taken.measured(view, *oriented, again=k > 0, reason=reason)
        if found.measured.found < _FEWEST:
            return Failure(
                f"{found.measured.found} of {len(design.ids)} targets are like their images by rays: "
                "check the lens, its focus and its aperture",
                Code.TOO_FEW_POINTS,
            )
        change = np.abs(found.measured.predicted - before)
        if k + 1 == _ROUNDS or np.nanmax(change) < _SETTLED_PX:
            break
        points, before, camera = found.measured.points, found.measured.predicted, found.camera
    # What is said of deviations concerns the targets measured as if they were sharp.
    notes = [remark for remark in first.remarks if remark.code != Code.INCONSISTENT]
    return _some(_described(_noted(found, [*notes, focus_remark(moved, sigma)] if given else notes)))


def alterable(camera: RayMap) -> Altered | None:
    """:func:`refocused` for a lens of which focus and stop may be others than stated; None for a stand-in."""
    inner = camera.camera if isinstance(camera, CalibratedLens) else camera
    return refocused if isinstance(inner, LensCamera) else None


def refocused(camera: RayMap, by_mm: float, wider: float = 0.0) -> RayMap:
    """A lens with its image surface moved along the light, and another stop.

    Parameters
    ----------
    camera : RayMap
        A lens, also with the places of a calibration.
    by_mm : float
    wider : float
        Logarithm of the factor on the radius of the stop.

    Raises
    ------
    UsageError
        When it is not a lens.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, in_order
    >>> from reseau.optics.lenses.media import Constant
    >>> lens = Prescription(in_order([(0.02, 6.0, Constant(1.5)), (0.0, 96.0, AIR)]), stop=0, stop_radius=8.0)
    >>> moved = refocused(LensCamera(lens, SensorPlane((0.01, 0.01), (0.0, 0.0))), 0.5)
    >>> float(moved.lens.surfaces[-1].vertex[2])
    102.5
    """
    if isinstance(camera, CalibratedLens | Moving):
        return replace(camera, camera=refocused(camera.camera, by_mm, wider))
    if not isinstance(camera, LensCamera):
        raise UsageError("has no image surface to be moved", where=type(camera).__name__)
    image = camera.lens.surfaces[-1]
    lens = camera.lens.moved((by_mm * image.axes[:, 2]).tolist())
    if wider and lens.stop_radius is not None:
        lens = replace(lens, stop_radius=lens.stop_radius * np.exp(wider))
    return replace(camera, lens=lens)


def _focused(
    frame: Frame,
    design: Design,
    camera: RayMap,
    pose: Pose,
    options: BlurredOptions,
    sigma_mm: float | None,
) -> tuple[RayMap, float, float] | Failure:
    """The lens with the focus estimated from all targets, its displacement and sigma; or as it is."""
    if sigma_mm is None:
        return camera, 0.0, 0.0
    focus = Varied(("focus_mm",), (sigma_mm,), lambda by: refocused(camera, float(by[0])))
    found = estimate_optics(frame, targets_of(design, pose, camera)[1], focus, options)
    if isinstance(found, Failure):
        return found
    return found.camera, float(found.values[0]), float(found.sigma[0])


def _noted(found: BlurredFrame, remarks: Sequence[Remark]) -> BlurredFrame:
    """The frame with remarks in front of its own."""
    return replace(found, measured=replace(found.measured, notes=(*remarks, *found.measured.notes)))


def _some(found: BlurredFrame) -> BlurredFrame | Failure:
    """The frame, or the most frequent reason why nothing was measured in it."""
    measured = found.measured
    if measured.ok.any():
        return found
    reasons = [str(why) for why in measured.why]
    most = max(set(reasons), key=reasons.count)
    code = measured.codes[reasons.index(most)] or Code.DECLINED
    return Failure(f"none of {len(measured.ids)} targets was measured; {reasons.count(most)}: {most}", code)


def _described(found: BlurredFrame) -> BlurredFrame:
    """Add notes for the user: how large the blur is, what it does to centres, how the orientation fits."""
    measured = found.measured
    good = measured.ok
    if not good.any():
        return found
    offset = np.hypot(*measured.offset[good].T)
    notes = [
        Remark(
            f"blur of {np.nanmin(measured.blur_px[good]):.2g} to {np.nanmax(measured.blur_px[good]):.2g} px "
            f"(rms radius); centres of density lie up to {offset.max():.2g} px beside the corresponding rays",
            Code.BLURRED,
        )
    ]
    sigma = float(np.sqrt(np.mean(measured.points.sigma**2)))
    if found.rms_px > _MISFIT * sigma and found.rms_px > _LEAST_MISFIT_PX:
        notes.append(
            Remark(
                f"the orientation by rays of this lens leaves {found.rms_px:.2g} px (rms), where sigmas are "
                f"{sigma:.2g} px: distortion, focus or principal point differ from those of the lens file",
                Code.INCONSISTENT,
            )
        )
    return replace(found, measured=replace(measured, notes=(*measured.notes, *notes)))


def pose_in_network(network: Network, image: str, design: Design) -> Pose:
    """Pose from the plane of a design to the camera axes of an image of a network.

    Parameters
    ----------
    network : Network
        With the orientation of the image and the object points, such as the result of a bundle adjustment.
    image : str
        Its name, or that of its file.
    design : ReseauDesign or TestfieldDesign
        Its points are found among those of the network by their names; the plane is fitted to them.

    Raises
    ------
    UsageError
        When the image or its orientation is missing, fewer than three points are known, or scales disagree.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> from reseau.designs import coded_testfield
    >>> pose_in_network(example_network(), "nowhere.png", coded_testfield())
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: nowhere.png: is not an image of the network
    """
    row = _row_in(network, image)
    rotation, x0 = network.rotation[row], network.x0[row]
    if not np.isfinite([*rotation, *x0]).all():
        raise UsageError(
            "has no orientation in the network", where=image, do="use the result of `reseau bundle`"
        )
    at = {name: k for k, name in enumerate(network.points)}
    both = [(k, at[name]) for k, name in enumerate(design.ids) if name in at]
    both = [(k, p) for k, p in both if np.isfinite(network.xyz[p]).all()]
    if len(both) < 3:
        raise UsageError(
            f"{len(both)} points of the design {design.name} have coordinates in the network", where=image
        )
    scale = {"mm": 1.0, "m": 1000.0}.get(network.unit)
    if scale is None:
        raise UsageError(f"the network is in {network.unit!r}, lenses are in mm", where=image)
    k, p = (np.array(column) for column in zip(*both, strict=True))
    plane = np.concatenate([design.xy[k], np.zeros((len(k), 1))], axis=1)
    space = scale * network.xyz[p]
    _, turn, shift = similarity_onto(plane, space, scaled=False)
    misfit = float(np.abs(plane @ turn.T + shift - space).max())
    extent = float(np.ptp(plane, axis=0).max())
    if misfit > _FLAT * extent:
        raise UsageError(
            f"the points of the network differ by {misfit:.2g} mm from the design {design.name}", where=image
        )
    matrix = rotation_matrix(rotation) @ turn
    return Pose(matrix_to_vector(matrix), turn.T @ (scale * x0 - shift))


def calibrated_by(camera: RayMap, network: Network, image: str) -> RayMap:
    """The lens with its images where the calibrated camera of an image of a network has them.

    Cameras behind windows, or with several sets of additional parameters, have no such mapping: then the lens
    is returned as it is.

    Parameters
    ----------
    camera : RayMap
    network : Network
    image : str
        Its name, or that of its file.

    Raises
    ------
    UsageError
        When the image is missing.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> from reseau.optics.lenses import ThinLens
    >>> thin = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (500.0, 400.0)))
    >>> network = example_network()
    >>> type(calibrated_by(thin, network, network.images[0])).__name__
    'CalibratedLens'
    """
    own = network.cameras[network.camera_of[_row_in(network, image)]]
    if network.refraction is not None or not own.has_plane_mapping:
        return camera
    return CalibratedLens(camera, own.plane_mapping())


def _row_in(network: Network, image: str) -> int:
    """Row of an image of a network, by its name or that of its file."""
    names = [name for name in (image, Path(image).name, Path(image).stem) if name in network.images]
    rows = [network.images.index(name) for name in names]
    rows += [k for k, file in enumerate(network.files) if file and Path(file).name == Path(image).name]
    if not rows:
        raise UsageError("is not an image of the network", where=image)
    return rows[0]


@dataclass(frozen=True)
class _Frame:
    """A frame, its design, and what is known of how it was taken."""

    frame: Frame
    design: Design
    options: BlurredOptions
    focus_given: bool
    per_line: float

    def measured(
        self, camera: RayMap, pose: Pose, rms_px: float, again: bool = False, reason: Explained | None = None
    ) -> tuple[BlurredFrame, Explained | None]:
        """Measure the targets, or measure them again with what explained their images with another pose."""
        names, targets = targets_of(self.design, pose, camera)
        job = self.frame, camera, names, targets, self.options
        if again:
            found = measure_blurred(*job)
            found = found if reason is None else reason.told(found)
        else:
            by = None if self.focus_given else alterable(camera)
            found, reason = measure_explained(*job, altered=by, per_line=self.per_line)
            camera = camera if reason is None else reason.optics.camera
        return BlurredFrame(found, pose, tuple(targets), rms_px, camera), reason
