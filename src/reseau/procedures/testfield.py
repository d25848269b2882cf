"""The testfield procedure (Vosselman and Förstner) in an acquisition: calibrate, and choose the next pose.

G. Vosselman and W. Förstner, The precision of a digital camera. Each frame is measured as it is taken
(sections 2 and 3) and joins the bundle adjustment. Live and from files the same functions are called: the
same frames give the same results to the byte. For files, the procedure is
:func:`reseau.procedures.calibration.calibrate_camera`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np

from ..archive import Verdict
from ..bundle import Network, Result, problem_of
from ..bundle.diagnostics.fields import camera_mapping
from ..bundle.modelling.calibration import with_estimates
from ..core.data import Array, Frame, ImagePoints
from ..core.environment import Surroundings
from ..core.errors import EstimationError
from ..core.failure import Code, Failure
from ..core.provenance import Provenance
from ..io.refraction import RefractionEntry
from ..optics import Pose
from ..optics.poses import matrix_to_vector, rotation_matrix
from ..optics.refraction import RefractedRays
from .calibrated import Calibrated
from .calibration import calibrate_camera
from .calibration_options import CalibrationOptions, CameraOptions, PlaneDesign
from .exposures import Taken
from .next_pose import PREDICTED, with_image
from .target_measurement import Measurer
from .z_stage import Heights

_LEAST_IMAGES = 3
_LEAST_EXPOSURES = 6
"""Exposures of a rig from which it is calibrated: from fewer, often frontal, ones the adjustment is long."""


class Place(Protocol):
    """A pose of the table; see :class:`reseau.capture.Step`."""

    @property
    def name(self) -> str:
        """Name of its frame."""

    @property
    def position(self) -> Mapping[str, float]:
        """Positions of the axes."""

    @property
    def camera(self) -> str:
        """Camera of a rig that took the frame; empty if there is one camera."""

    @property
    def exposure(self) -> str:
        """What the frame has in common with those that other cameras of the rig exposed at once."""


P = TypeVar("P", bound=Place)


class TestfieldProcedure:
    """Calibration of a camera, or of a rig of cameras, during the acquisition of images of a target.

    Frames of a rig say which camera took them, and in which exposure. Its cameras are then calibrated
    together, with their places to each other.

    Parameters
    ----------
    design : PlaneDesign
        The target.
    measure : callable
        Measures the target in a frame.
    model : CameraOptions
        Camera model and parameters to estimate.
    name : str
        Name of the calibration.
    options : mapping
        Parameters that influence the result, for the provenance.
    inputs : mapping
        SHA-256 of the input files by name, for the provenance.
    least_points : int
        Smallest number of points of a usable frame.
    sigmas : (float, float, float), optional
        Standard deviations of a height of the axis ``z`` (mm), of the two angles between this axis and the
        normal of the target (rad), and of the coordinates of the design (mm). With `sigmas`, consecutive
        frames that differ only in height have one orientation; without, each frame has its own.
    refraction : RefractionEntry, optional
        Windows and media before the camera; see
        :class:`~reseau.procedures.calibration_options.CalibrationOptions`.

    Examples
    --------
    >>> from reseau.designs import coded_testfield
    >>> from reseau.procedures.target_measurement import measurer_of
    >>> design = coded_testfield()
    >>> procedure = TestfieldProcedure(design, measurer_of(design), CameraOptions(), name="monday")
    >>> procedure.progress()
    {}
    """

    __test__: ClassVar[bool] = False  # not a class of tests

    def __init__(
        self,
        design: PlaneDesign,
        measure: Measurer,
        model: CameraOptions,
        *,
        name: str,
        options: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
        least_points: int = 8,
        sigmas: tuple[float, float, float] | None = None,
        refraction: RefractionEntry | None = None,
    ) -> None:
        self.design, self.model, self.name = design, model, name
        self._measure, self._options, self._least = measure, dict(options or {}), least_points
        self._surroundings = Surroundings()
        self._measured: dict[str, ImagePoints] = {}
        self._places: dict[str, Mapping[str, float]] = {}
        self._sigmas, self._pose, self._refraction = sigmas, dict[str, int](), refraction
        self._stands: tuple[int, dict[str, float] | None] = (-1, None)
        self._inputs = dict(inputs or {})
        self._sizes: dict[str, tuple[int, int]] = {}
        self._taken: dict[str, Taken] = {}
        self._current: tuple[int, Calibrated | Failure] | None = None

    def on_frame(self, frame: Frame, step: Place) -> Verdict:
        """Measure the target in a frame."""
        found = self._measure(frame)
        if isinstance(found, Failure):
            return Verdict(False, found.reason)
        if len(found.points) < self._least:
            return Verdict(False, f"{len(found.points)} points are too few")
        self._keep(step, found.points, (frame.width, frame.height), frame.sha256)
        return Verdict(True, facts={"points": len(found.points)})

    def _keep(self, step: Place, points: ImagePoints, size: tuple[int, int], sha256: str) -> None:
        self._sizes[step.camera] = size
        if step.camera:
            self._taken[step.name] = Taken(step.camera, step.exposure)
        self._measured[step.name] = points
        self._places[step.name], self._inputs[step.name] = dict(step.position), sha256
        self._surroundings.add(step.name, step)
        self._stands = self._at(step)  # only good frames: a rerun has no others
        self._pose[step.name] = self._stands[0]

    def recollection(self, step: Place) -> dict[str, Any]:
        """Return what was measured in the good frame of a step, for :meth:`recall`."""
        points, size = self._measured[step.name], self._sizes[self._camera_of(step.name)]
        return {
            "names": list(points.names), "xy": points.xy.tolist(), "cov": points.cov.tolist(),
            "size": list(size), "sha256": self._inputs[step.name],
        }  # fmt: skip

    def _camera_of(self, name: str) -> str:
        return self._taken[name].camera if name in self._taken else ""

    def recall(self, step: Place, measured: Mapping[str, Any]) -> Verdict:
        """Take over what was measured in a frame before, in place of measuring it again."""
        xy, cov = (np.array(measured[key], dtype=np.float64) for key in ("xy", "cov"))
        points = ImagePoints(tuple(measured["names"]), xy.reshape(-1, 2), cov.reshape(-1, 2, 2))
        width, height = measured["size"]
        self._keep(step, points, (int(width), int(height)), str(measured["sha256"]))
        return Verdict(True, facts={"points": len(points)})

    def _at(self, place: Place) -> tuple[int, dict[str, float] | None]:
        """The number of a pose, and the positions of all its axes except the height.

        A table that has moved does not return to exactly the same pose.
        """
        number, before = self._stands
        position = {axis: value for axis, value in place.position.items() if axis != HEIGHT}
        return (number, before) if position == before else (number + 1, position)

    def _heights(self, more: Place | None = None) -> Heights | None:
        """Poses and heights of the images, optionally with a candidate pose."""
        if self._sigmas is None:
            return None
        reading = {name: float(place.get(HEIGHT, 0.0)) for name, place in self._places.items()}
        pose = dict(self._pose)
        if more is not None:
            pose[PREDICTED], reading[PREDICTED] = self._at(more)[0], float(more.position.get(HEIGHT, 0.0))
        return Heights(pose, reading, *self._sigmas)

    def calibrated(self) -> Calibrated | Failure:
        """Return the calibration from the frames so far."""
        count = len(self._measured)
        if self._current is None or self._current[0] != count:
            points = list(self._measured.items())
            options = CalibrationOptions(heights=self._heights(), refraction=self._refraction)
            size = self._sizes if self._taken else self._sizes.get("")
            found = calibrate_camera(
                points, self.design, self._measure, size, self.model, options, self._taken or None
            )
            self._current = (count, found)
        return self._current[1]

    @property
    def provenance(self) -> Provenance:
        """Inputs and parameters of the calibration."""
        return Provenance(self._inputs, self._options, environment=self._surroundings.summary())

    def progress(self) -> dict[str, float]:
        """Return standard deviations of the camera parameters, and sigma0; nothing before the third image.

        Of a rig they are the largest of its cameras, from the sixth exposure on.

        They contain what the points of an image have in common. ``scatter`` is their ratio to the formal
        standard deviations: the root mean square over the parameters, of a rig that of its worst camera.
        """
        exposures = {taken.exposure for taken in self._taken.values()}
        if len(self._measured) < _LEAST_IMAGES or 0 < len(exposures) < _LEAST_EXPOSURES:
            return {}
        found = self.calibrated()
        if isinstance(found, Failure):
            return {}
        reached: dict[str, float] = {}
        scatter = 1.0
        for c in range(len(found.result.network.cameras)):
            estimate = found.result.camera(c)
            for name, s in zip(estimate.parameters, estimate.sigma, strict=True):
                reached[f"sigma_{name}"] = max(float(s), reached.get(f"sigma_{name}", 0.0))
            formal = estimate.sigma_formal
            ratio = estimate.sigma[formal > 0] / formal[formal > 0]
            scatter = max(scatter, float(np.sqrt(np.mean(ratio**2)))) if len(ratio) else scatter
        return reached | {"sigma0": float(found.result.sigma0), "scatter": scatter}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """Return the pose that lowers the standard deviation of a parameter most, and the predicted value.

        The image of each candidate is predicted and added to the network with the covariance of the other
        images; the standard deviation follows from the design matrix alone, and is enlarged as that of the
        images so far. While there are too few images
        for a calibration, the first candidate is returned without a prediction. For a rig there is none.

        Raises
        ------
        EstimationError
            If the parameter is not estimated, or the axes of the table do not match the mount of a testfield.
        """
        if not candidates or self._taken:
            return None  # the images of several cameras are not predicted
        found = (
            self.calibrated()
            if len(self._measured) >= _LEAST_IMAGES
            else Failure("too few images", Code.TOO_FEW_IMAGES)
        )
        if isinstance(found, Failure):
            return candidates[0], None
        names, _, _ = found.result.camera_columns(0)
        if wanted not in names:
            do = f"use {', '.join(names)}"
            raise EstimationError("is not estimated", where=f"sigma_{wanted}", do=do)
        column = names.index(wanted)
        network, result = with_estimates(found.result), found.result
        mount = Mount.of(
            [self._places[name] for name in network.images],
            np.array([rotation_matrix(vector) for vector in result.rotation]),
            network.x0,
        )
        if isinstance(mount, Failure):
            raise EstimationError(mount.reason, where="next pose")
        so_far = result.camera(0)
        enlarged = float(result.sigma0 * so_far.sigma[column] / so_far.sigma_formal[column])
        best: tuple[P, float] | None = None
        for candidate in candidates:
            joined = _joined(network, result, mount, candidate, self._heights(candidate))
            predicted = enlarged * _sigma(network if joined is None else joined, column)
            if np.isfinite(predicted) and (best is None or predicted < best[1]):
                best = candidate, predicted
        return best

    def finish(self) -> dict[str, str]:
        """Return the calibration, of a rig that of each camera; ``times`` are stored by the archive.

        Raises
        ------
        EstimationError
            If it fails.
        """
        found = self.calibrated()
        if isinstance(found, Failure):
            raise EstimationError(found.reason, where=self.name)
        made = self.provenance.to_dict()
        if not self._taken:
            return {"calibration.json": found.calibration(self.name, made).to_json()}
        return {
            f"calibration-{camera}.json": found.calibration(f"{self.name} {camera}", made, camera).to_json()
            for camera in found.cameras
        }


def _joined(
    network: Network, result: Result, mount: Mount, place: Place, heights: Heights | None
) -> Network | None:
    """The network with an image from another pose; None if the image shows fewer than four points."""
    pose = _predicted(network, result, mount, place, heights)
    axis = np.array([0.0, 0.0, mount.lifts]) if network.stage is None else network.stage.axis
    assert axis is not None  # a linear stage has one
    stage = None if heights is None else heights.stage((*network.images, PREDICTED), axis)
    return with_image(network, camera_mapping(result, 0), pose, _directions(network, pose), stage)


def _directions(network: Network, pose: Pose) -> Array:
    """Ideal directions (p, 2) of all points in another image with the windows of the first; NaN behind it."""
    x = (network.xyz - pose.x0) @ pose.matrix.T
    if network.parallel[0]:
        return x[:, :2]
    uv: Array = x[:, :2] / np.where(x[:, 2:] > 0, x[:, 2:], np.nan)
    bent, every = network.refraction, np.arange(len(uv))
    if bent is None or bent.path_of[0] < 0:
        return uv
    rays = RefractedRays.of(
        bent.columns(bent.values), bent.path_of[:1], pose.matrix[None], pose.x0[None], network.xyz, 0 * every,
        every,
    )  # fmt: skip
    return np.where(rays.reached[:, None], rays.uv, np.nan)


def _predicted(network: Network, result: Result, mount: Mount, place: Place, heights: Heights | None) -> Pose:
    """Predicted orientation: that of the same pose moved by the stage, or that given by the mount."""
    by_mount = mount.pose(place.position)
    same = [
        k
        for k, name in enumerate(network.images)
        if heights is not None and heights.pose[name] == heights.pose[PREDICTED]
    ]
    if heights is None or not same:
        return by_mount
    k, stage = same[-1], result.fit.values.stage
    axis = np.array([0.0, 0.0, mount.lifts]) if stage is None else stage.axis
    stood = heights.reading[network.images[k]] if stage is None else float(stage.reading[k])
    return Pose(network.rotation[k], network.x0[k] + (stood - heights.reading[PREDICTED]) * axis)


def _sigma(network: Network, column: int) -> float:
    """Standard deviation of a parameter of the camera, for unit variance factor."""
    # The estimates are those of the images so far: no search for their start, and no checks of the result.
    fit = problem_of(network)[0].adjusted()
    if isinstance(fit, Failure):
        return float("inf")
    _, columns, _ = Result(network, fit, np.zeros(len(network.xy), dtype=bool), ()).camera_columns(0)
    return float(np.sqrt(fit.cofactors.reduced.block(columns, columns)[column, column]))


TILT, ROLL, CAMERA_ROLL, HEIGHT = "tilt", "roll", "camera_roll", "z"
_WORST_DEG = 5.0
"""Largest rms deviation of poses from the mount; predictions need no better accuracy."""


@dataclass(frozen=True, eq=False)
class Mount:
    """Geometry of the mount.

    Parameters
    ----------
    about : int
        Tilt axis of the board in the mount: 0 for x, 1 for y.
    signs : (float, float, float)
        Signs of tilt, roll and camera roll.
    lifts : float
        Direction of z along the normal of the board: towards the camera (1) or away from it (−1).
    looks : ndarray (3, 3)
        Rotation from the mount to the camera with all axes at zero.
    centre : ndarray (3,)
        Projection centre in the system of the mount (mm).
    off_deg : float
        Rms angle between the given rotations and those of the mount (degrees).

    Examples
    --------
    >>> positions = [{"tilt": 0.0}, {"tilt": 30.0}, {"tilt": 30.0, "roll": 90.0}]
    >>> boards = [_rotations(position, 0, (1.0, 1.0, 1.0))[0] for position in positions]
    >>> x0 = np.array([board.T @ [0.0, 0.0, 500.0] for board in boards])
    >>> mount = Mount.of(positions, np.array(boards), x0)
    >>> mount.about, round(mount.off_deg, 3), round(float(mount.centre[2]), 3)
    (0, 0.0, 500.0)
    """

    about: int
    signs: tuple[float, float, float]
    lifts: float
    looks: Array
    centre: Array
    off_deg: float

    @classmethod
    def of(cls, positions: Sequence[Mapping[str, float]], rotations: Array, x0: Array) -> Self | Failure:
        """Determine the mount that fits given poses best.

        Parameters
        ----------
        positions : sequence of mapping
            Positions of the axes `tilt`, `roll`, `camera_roll` (degrees) and `z` (mm); missing axes are zero.
        rotations : ndarray (m, 3, 3)
            Rotations from the board to the camera.
        x0 : ndarray (m, 3)
            Projection centres in the system of the board (mm).

        Returns
        -------
        Mount or Failure
            A failure if no mount fits within 5 degrees.
        """
        found: list[Self] = []
        for about, *signs in itertools.product((1, 0), (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)):
            turns = [_rotations(position, about, tuple(signs)) for position in positions]
            boards = np.array([board for board, _ in turns])
            cameras = np.array([camera for _, camera in turns])
            # Each rotation is camera · looks · board; the rotation nearest to the mean (Horn et al. 1988).
            back = np.swapaxes(cameras, 1, 2) @ rotations @ np.swapaxes(boards, 1, 2)
            u, _, vt = np.linalg.svd(back.sum(axis=0))
            looks = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            off = cameras @ looks @ boards @ np.swapaxes(rotations, 1, 2)
            cosine = np.clip((np.trace(off, axis1=1, axis2=2) - 1) / 2, -1, 1)
            lifts, centre = _in_mount(boards, x0, positions)
            rms = float(np.rad2deg(np.sqrt(np.mean(np.arccos(cosine) ** 2))))
            found.append(cls(int(about), (signs[0], signs[1], signs[2]), lifts, looks, centre, rms))
        best = min(found, key=lambda mount: mount.off_deg)  # the first of equals: signs without effect are +
        if best.off_deg > _WORST_DEG:
            return Failure(
                f"the axes {TILT}, {ROLL} and {CAMERA_ROLL} do not match the mount of a testfield: "
                f"rms deviation of the poses {best.off_deg:.0f}°",
                Code.INCONSISTENT,
            )
        return best

    def pose(self, position: Mapping[str, float]) -> Pose:
        """Return the pose of the camera in the system of the board, for a position of the axes."""
        board, camera = _rotations(position, self.about, self.signs)
        lift = np.array([0.0, 0.0, self.lifts * position.get(HEIGHT, 0.0)])
        return Pose(matrix_to_vector(camera @ self.looks @ board), board.T @ self.centre - lift)


def _in_mount(boards: Array, x0: Array, positions: Sequence[Mapping[str, float]]) -> tuple[float, Array]:
    """Sign of z, and projection centre in the mount with z at zero, from poses (m)."""
    up = np.array([[0.0, 0.0, position.get(HEIGHT, 0.0)] for position in positions])
    found = {sign: (boards @ (x0 + sign * up)[:, :, None])[:, :, 0] for sign in (1.0, -1.0)}
    lifts = min(found, key=lambda sign: float(found[sign].var(axis=0).sum()))
    return lifts, found[lifts].mean(axis=0)


def _rotations(position: Mapping[str, float], about: int, signs: tuple[float, ...]) -> tuple[Array, Array]:
    """Rotations of the board in the mount and of the camera about its axis."""
    axes = np.eye(3)
    tilt, roll, camera = (
        rotation_matrix(axes[axis] * np.deg2rad(sign * position.get(name, 0.0)))
        for axis, sign, name in zip((about, 2, 2), signs, (TILT, ROLL, CAMERA_ROLL), strict=True)
    )
    return tilt @ roll, camera
