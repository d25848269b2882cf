"""The procedures as an acquisition needs them: frame by frame as they come, what has been reached, what next.

The calls are those that work on files, in another order of arrival: the same frames give the same results,
to the byte.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np

from ..archive import Verdict
from ..bundle import Network, Result, adjust_network, calibration_of, camera_mapping
from ..core.data import Frame, ImagePoints
from ..core.errors import EstimationError
from ..core.failure import Code, Failure
from ..core.provenance import Provenance
from ..io import ReseauDesign
from ..optics import Pose, project
from ..optics.poses import matrix_to_vector, rotation_matrix
from .calibration import Calibrated, CalibrationOptions, CameraOptions, PlaneDesign, calibrate_camera
from .heights import Heights
from .measuring import Measurer
from .mount import HEIGHT, Mount
from .oscilloscope import PhotoI, PhotoII, PhotoIII, photo_i, photo_ii, photo_iii

__all__ = ["LiveOscilloscope", "LiveTestfield", "Place"]

_LEAST_IMAGES = 3
_MARGIN_PX = 6.0
_PREDICTED = "predicted"


class Place(Protocol):
    """A pose of the table; see :class:`reseau.capture.Step`."""

    @property
    def name(self) -> str:
        """What its frame is called."""

    @property
    def position(self) -> Mapping[str, float]:
        """Where the axes stand."""


P = TypeVar("P", bound=Place)


class LiveTestfield:
    """A camera calibrated while its photographs of a target come in.

    Parameters
    ----------
    design : PlaneDesign
        The target.
    measure : callable
        What measures it in a frame.
    model : CameraOptions
        What is to be estimated.
    name : str
        Of the calibration.
    options : mapping
        What of the parameters influenced the result, for its provenance.
    inputs : mapping
        SHA-256 of the files that it works with, by name; for its provenance.
    least_points : int
        A frame with fewer is no good.
    sigmas : (float, float, float), optional
        Standard deviations of a height that the axis ``z`` was moved to, of the two angles (rad) by which it
        is off the target's normal, and of the design's coordinates.
        With them frames taken one after the other that differ in height alone are of one pose; without, each
        has its own.
    """

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
    ) -> None:
        self.design, self.model, self.name = design, model, name
        self._measure, self._options, self._least = measure, dict(options or {}), least_points
        self._measured: dict[str, ImagePoints] = {}
        self._places: dict[str, Mapping[str, float]] = {}
        self._sigmas, self._pose = sigmas, dict[str, int]()
        self._stands: tuple[int, dict[str, float] | None] = (-1, None)
        self._inputs = dict(inputs or {})
        self._size: tuple[int, int] | None = None
        self._current: tuple[int, Calibrated | Failure] | None = None

    def on_frame(self, frame: Frame, step: Place) -> Verdict:
        """Measure the target in a frame."""
        found = self._measure(frame)
        if isinstance(found, Failure):
            return Verdict(False, found.reason)
        if len(found.points) < self._least:
            return Verdict(False, f"{len(found.points)} points are too few")
        self._size = (frame.width, frame.height)
        self._measured[step.name] = found.points
        self._places[step.name], self._inputs[step.name] = dict(step.position), frame.sha256
        self._stands = self._at(step)  # of good frames alone: no others come when it is computed again
        self._pose[step.name] = self._stands[0]
        return Verdict(True, facts={"points": len(found.points)})

    def _at(self, place: Place) -> tuple[int, dict[str, float] | None]:
        """The number of a pose, and where all axes stand in it but that of the height.

        A table that has been elsewhere does not come back to the same pose, but to another near it.
        """
        number, before = self._stands
        position = {axis: value for axis, value in place.position.items() if axis != HEIGHT}
        return (number, before) if position == before else (number + 1, position)

    def _heights(self, more: Place | None = None) -> Heights | None:
        """Poses and heights of what was measured; of a place, too, to which the table might go next."""
        if self._sigmas is None:
            return None
        reading = {name: float(place.get(HEIGHT, 0.0)) for name, place in self._places.items()}
        pose = dict(self._pose)
        if more is not None:
            pose[_PREDICTED], reading[_PREDICTED] = self._at(more)[0], float(more.position.get(HEIGHT, 0.0))
        return Heights(pose, reading, *self._sigmas)

    def calibrated(self) -> Calibrated | Failure:
        """The calibration by what has been measured so far."""
        count = len(self._measured)
        if self._current is None or self._current[0] != count:
            points = list(self._measured.items())
            options = CalibrationOptions(heights=self._heights())
            found = calibrate_camera(points, self.design, self._measure, self._size, self.model, options)
            self._current = (count, found)
        return self._current[1]

    @property
    def provenance(self) -> Provenance:
        """What the calibration was made of."""
        return Provenance(self._inputs, self._options)

    def progress(self) -> dict[str, float]:
        """Standard deviations of the camera's parameters, and sigma0; nothing before the third image."""
        if len(self._measured) < _LEAST_IMAGES:
            return {}
        found = self.calibrated()
        if isinstance(found, Failure):
            return {}
        names, _, _ = found.result.camera_columns(0)
        sigma = np.sqrt(np.diag(found.result.camera_covariance(0)))
        reached = {f"sigma_{name}": float(s) for name, s in zip(names, sigma, strict=True)}
        return reached | {"sigma0": float(found.result.sigma0)}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """The pose that lowers the standard deviation of a parameter most, and to what.

        Each candidate's image is predicted, and joins the network as if it had been measured as the others
        were: its covariance follows from the design matrix alone. While there are too few images for any
        calibration it is the first candidate, and nothing is predicted.

        Raises
        ------
        EstimationError
            When the parameter is not estimated, or the table's axes do not turn the target as its mount's
            should.
        """
        if not candidates:
            return None
        found = (
            self.calibrated()
            if len(self._measured) >= _LEAST_IMAGES
            else Failure("too few images", Code.TOO_FEW_IMAGES)
        )
        if isinstance(found, Failure):
            return candidates[0], None
        names, _, _ = found.result.camera_columns(0)
        if wanted not in names:
            raise EstimationError(f"is none of {', '.join(names)}", where=f"sigma_{wanted}")
        column = names.index(wanted)
        network, result = _adjusted(found.result), found.result
        mount = Mount.of(
            [self._places[name] for name in network.images],
            np.array([rotation_matrix(vector) for vector in result.rotation]),
            network.x0,
        )
        if isinstance(mount, Failure):
            raise EstimationError(mount.reason, where="next pose")
        sigma0 = float(result.sigma0)
        best: tuple[P, float] | None = None
        for candidate in candidates:
            joined = _joined(network, result, mount, candidate, self._heights(candidate))
            predicted = sigma0 * _sigma(network if joined is None else joined, column)
            if np.isfinite(predicted) and (best is None or predicted < best[1]):
                best = candidate, predicted
        return best

    def finish(self) -> dict[str, str]:
        """The calibration; ``times`` stay empty, the archive knows them.

        Raises
        ------
        EstimationError
            When it fails.
        """
        found = self.calibrated()
        if isinstance(found, Failure):
            raise EstimationError(found.reason, where=self.name)
        about = self.provenance.to_dict()
        calibration = calibration_of(found.result, "camera", name=self.name, provenance=about)
        return {"calibration.json": calibration.to_json()}


def _adjusted(result: Result) -> Network:
    """The network begun at its estimates: adjusted again, it is there at once."""
    network, values = result.network, result.fit.values
    camera = replace(network.cameras[0], values=values.cameras[0, : len(network.cameras[0].values)])
    return replace(network, cameras=(camera,), x0=values.x0, rotation=result.rotation, xyz=values.xyz)


def _joined(
    network: Network, result: Result, mount: Mount, place: Place, heights: Heights | None
) -> Network | None:
    """The network with an image from another pose; None when it would show next to nothing."""
    camera, pose = network.cameras[0], _predicted(network, result, mount, place, heights)
    seen = project(camera_mapping(result, 0).mapping, pose, network.xyz).xy
    size = np.array([camera.width, camera.height]) - 1
    inside = np.flatnonzero(((seen >= _MARGIN_PX) & (seen <= size - _MARGIN_PX)).all(axis=1))
    if len(inside) < 4:
        return None
    m = len(network.images)
    cov = np.median(network.cov, axis=0)
    images = (*network.images, _PREDICTED)
    axis = np.array([0.0, 0.0, mount.lifts]) if network.stage is None else network.stage.axis
    return replace(
        network,
        images=images,
        stage=None if heights is None else heights.stage(images, axis),
        camera_of=np.append(network.camera_of, 0),
        x0=np.vstack([network.x0, pose.x0]),
        rotation=np.vstack([network.rotation, matrix_to_vector(pose.matrix)]),
        image_of=np.concatenate([network.image_of, np.full(len(inside), m)]),
        point_of=np.concatenate([network.point_of, inside]),
        xy=np.concatenate([network.xy, seen[inside]]),
        cov=np.concatenate([network.cov, np.tile(cov, (len(inside), 1, 1))]),
        groups=(*network.groups, None),
        files=(*network.files, _PREDICTED),
    )


def _predicted(network: Network, result: Result, mount: Mount, place: Place, heights: Heights | None) -> Pose:
    """Where the camera would be: moved by the stage from where it is in the same pose, or by the mount."""
    told = mount.pose(place.position)
    same = [
        k
        for k, name in enumerate(network.images)
        if heights is not None and heights.pose[name] == heights.pose[_PREDICTED]
    ]
    if heights is None or not same:
        return told
    k, stage = same[-1], result.fit.values.stage
    axis = np.array([0.0, 0.0, mount.lifts]) if stage is None else stage.axis
    stood = heights.reading[network.images[k]] if stage is None else float(stage.reading[k])
    return Pose(network.rotation[k], network.x0[k] + (stood - heights.reading[_PREDICTED]) * axis)


def _sigma(network: Network, column: int) -> float:
    """Standard deviation of unit weight one that a network gives a parameter of its camera."""
    found = adjust_network(network)
    if isinstance(found, Failure):
        return float("inf")
    return float(np.sqrt(found.camera_covariance(0)[column, column] / found.fit.variance))


class LiveOscilloscope:
    """The oscilloscope procedure while PHOTO I, II and III come in.

    Parameters
    ----------
    reseau, test_object : ReseauDesign
        The reseau; the rods.
    name : str
        Of the calibration.
    options, inputs : mapping
        For its provenance: parameters, and the SHA-256 of the files that it works with, by name.
    check : iterable of str
        Marks to be held out of PHOTO I.
    """

    def __init__(
        self,
        reseau: ReseauDesign,
        test_object: ReseauDesign,
        *,
        name: str,
        options: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
        check: Iterable[str] = (),
    ) -> None:
        self.reseau, self.test_object, self.name = reseau, test_object, name
        self._check = tuple(check)
        self._options, self._inputs = dict(options or {}), dict(inputs or {})
        self.first: PhotoI | None = None
        self.second: PhotoII | None = None
        self.third: PhotoIII | None = None

    def on_frame(self, frame: Frame, step: Place) -> Verdict:
        """Refine a photograph; which one it is, its step says."""
        found = self._refined(frame, step.name)
        if isinstance(found, Failure):
            return Verdict(False, found.reason)
        self._inputs[step.name] = frame.sha256
        points = {PhotoI: "points", PhotoII: "pins", PhotoIII: "points"}[type(found)]
        return Verdict(True, facts={"points": len(getattr(found, points))})

    def _refined(self, frame: Frame, photo: str) -> PhotoI | PhotoII | PhotoIII | Failure:
        if photo == "PHOTO I":
            one = photo_i(frame, self.reseau, check=self._check)
            self.first = None if isinstance(one, Failure) else one
            return one
        if photo == "PHOTO II":
            if self.first is None:
                return Failure("PHOTO I is not refined", Code.PREREQUISITE_MISSING)
            two = photo_ii(frame, self.reseau, self.test_object, self.first.camera)
            self.second = None if isinstance(two, Failure) else two
            return two
        if photo == "PHOTO III":
            if self.second is None:
                return Failure("PHOTO II is not refined", Code.PREREQUISITE_MISSING)
            three = photo_iii(frame, self.second.instrument, self.reseau)
            self.third = None if isinstance(three, Failure) else three
            return three
        return Failure(f"{photo} is no photograph of this procedure", Code.UNKNOWN_STEP)

    def progress(self) -> dict[str, float]:
        """Sigma of the refined image coordinates, where there is a correction."""
        return {}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """None: its three photographs are taken from one place."""
        return None

    def finish(self) -> dict[str, str]:
        """The calibration of camera and instrument, and the true coordinates of the body, where there is one.

        Raises
        ------
        EstimationError
            When PHOTO I or II could not be refined.
        """
        if self.second is None:
            what = "PHOTO I" if self.first is None else "PHOTO II"
            raise EstimationError("could not be refined", where=what, do="see the verdicts on its frames")
        provenance = Provenance(self._inputs, self._options)
        calibration = self.second.instrument.calibration(
            self.reseau, self.test_object, name=self.name, provenance=provenance.to_dict(), times={}
        )
        made = {"calibration.json": calibration.to_json()}
        if self.third is not None:
            made["true.csv"] = self.third.true.to_csv()
        return made
