"""The network: cameras, images, points and their observations, in columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np

from ...core.data import Array, Mask, Rows, covariances_of, rows_of_groups
from ...core.display import Display
from ...core.errors import UsageError
from ...io.network import CalibratedCameraEntry, CameraEntry, FilmCameraEntry, Network1
from ...optics.refraction.windows import Refraction
from .camera import Camera
from .rig import Rig
from .stage import Stage
from .turntable import stage_of_turntable

Datum = Literal["control", "minimal", "free"]

# An image has six unknowns: at least three points are needed.
LEAST_POINTS = 3
# With fewer image points, mappings take about as long as loops, which have to be compiled.
_FEW = 5000


@dataclass(frozen=True, eq=False, repr=False)
class Network(Display):
    """Input of a bundle adjustment: cameras, images, points and their observations, in columns.

    Parameters
    ----------
    cameras : tuple of Camera
        Interior orientations.
    images : tuple of str (m,)
        Names of the images.
    camera_of : ndarray of int (m,)
        Camera of each image.
    x0, rotation : ndarray (m, 3)
        Projection centres and rotation vectors (rad), NaN where unknown; x_c = R(X − X0).
    points : tuple of str (p,)
        Names of the points.
    xyz : ndarray (p, 3)
        Coordinates, NaN where unknown.
    sigma : ndarray (p, 3)
        0 holds a coordinate, NaN leaves it free, otherwise it is an observation.
    role : tuple of {"tie", "control", "check"} (p,)
        Use of each point; check points are estimated and compared with their coordinates.
    image_of, point_of : ndarray of int (n,)
        Image and point of each image observation.
    xy : ndarray (n, 2)
        Image coordinates in pixels, y down.
    cov : ndarray (n, 2, 2)
        Their covariances.
    distance_of : ndarray of int (d, 2)
        Points between which a distance was observed.
    distance : ndarray (d, 2)
        Distances and their standard deviations.
    datum : {"control", "minimal", "free"}
        What defines position, orientation and scale.
    datum_points : ndarray of bool (p,)
        Points of the inner constraints of a free network.
    groups : tuple of (str or None) (m,)
        Group of each image, for parameters per group.
    files : tuple of (str or None) (m,)
        File of each image.
    unit : str
        Unit of object space; a label.
    datum_chosen : bool
        Whether the datum points were chosen; otherwise weak points are left out of the inner constraints.
    stage : Stage, optional
        Stage that moved the object, or the cameras, between images of the same pose; one that is linear, or
        has an axis that is known in the system of the object, requires the datum ``control``.
    rig : Rig, optional
        Images that were taken at once by cameras fixed to each other; images of an exposure have the same
        reading of a stage.
    refraction : Refraction, optional
        Windows and media that the rays pass; without it, and for images without a path, all is in air.
    motion : ndarray (m, 6), optional
        Velocities and rotation rates of images of cameras with a shutter: observed, held or approximate
        values; zero by default. See :mod:`reseau.bundle.network.shutter`.
    notes : tuple of str
        What was assumed or left out when it was read.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> network
    <Network: 1 camera, 8 images, 20 points, 160 image points, datum free>
    >>> network.rays[:3], network.select(network.image_of > 0).seen[:3]
    (array([8, 8, 8]), array([ 0, 20, 20]))
    """

    cameras: tuple[Camera, ...]
    images: tuple[str, ...]
    camera_of: Rows
    x0: Array
    rotation: Array
    points: tuple[str, ...]
    xyz: Array
    sigma: Array
    role: tuple[str, ...]
    image_of: Rows
    point_of: Rows
    xy: Array
    cov: Array
    distance_of: Rows
    distance: Array
    datum: Datum
    datum_points: Mask
    groups: tuple[str | None, ...]
    files: tuple[str | None, ...]
    unit: str = "mm"
    datum_chosen: bool = False
    stage: Stage | None = None
    rig: Rig | None = None
    refraction: Refraction | None = None
    motion: Array | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        m, p, n = len(self.images), len(self.points), len(self.image_of)
        expected = {
            "camera_of": (m,), "x0": (m, 3), "rotation": (m, 3), "xyz": (p, 3), "sigma": (p, 3),
            "point_of": (n,), "xy": (n, 2), "cov": (n, 2, 2), "datum_points": (p,),
            "distance_of": (len(self.distance), 2), "distance": (len(self.distance), 2),
        }  # fmt: skip
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise UsageError(
                    f"has the shape {getattr(self, name).shape}, not {shape}", where=f"Network.{name}"
                )
        if not len(self.role) == p or not len(self.groups) == len(self.files) == m:
            raise UsageError("columns differ in length", where="Network")
        if self.stage is not None:
            self._check_stage(self.stage)
        if self.rig is not None and not np.array_equal(self.rig.camera, self.camera_of):
            raise UsageError(
                "requires an exposure, or −1, for each image of each camera", where="Network.rig"
            )
        if self.refraction is not None:
            self._check_refraction(self.refraction)
        if self.motion is not None and self.motion.shape != (m, 6):
            raise UsageError(f"has the shape {self.motion.shape}, not ({m}, 6)", where="Network.motion")
        for camera in self.cameras:
            if not (camera.parallel or camera.shutter is not None):
                continue
            what = "parallel rays" if camera.parallel else "a shutter"
            for name in ("stage", "rig", "refraction"):
                if getattr(self, name) is not None:
                    raise UsageError(
                        f"a camera with {what} cannot be combined with a {name}", where=camera.label
                    )

    def _check_stage(self, stage: Stage) -> None:
        if len(stage.pose) != len(self.images):
            raise UsageError("requires a pose, or −1, for each image", where="Network.stage")
        if stage.tied and self.datum != "control":
            raise UsageError(
                "requires the datum `control` for an axis that is given in the system of the object",
                where="Network.stage", do="give control points, or leave the axis free",
            )  # fmt: skip
        if self.rig is not None and ((self.rig.exposure < 0) & (stage.pose >= 0)).any():
            raise UsageError("images of a rig on a stage need an exposure each", where="Network.stage")
        first = self.same_reading
        columns = (stage.pose, stage.reading, stage.sigmas)
        for other in np.flatnonzero(first != np.arange(len(first))):
            one = first[other]
            if not all(np.array_equal(each[one], each[other], equal_nan=True) for each in columns):
                raise UsageError(
                    f"images {self.images[one]} and {self.images[other]} were taken at once, but differ in "
                    "pose, reading or its sigma",
                    where="Network.stage",
                )

    @property
    def same_reading(self) -> Rows:
        """First image (m,) with the reading of a stage of each image: that of its exposure."""
        first = np.arange(len(self.images), dtype=np.intp)
        if self.rig is not None:
            on = np.flatnonzero(self.rig.exposure >= 0)
            _, at, number = np.unique(self.rig.exposure[on], return_index=True, return_inverse=True)
            first[on] = on[at[number.ravel()]]
        return first

    @cached_property
    def kernels(self) -> tuple[tuple[str, str | None] | None, ...]:
        """Model and additional parameters of each camera for compiled loops; None where it is mapped.

        It is where a model has no kernel, and where few image points are observed.
        """
        few = len(self.image_of) < _FEW
        return tuple(None if few and each.mapped_alike else each.compiled_kind for each in self.cameras)

    @property
    def shutters(self) -> Mask:
        """Images whose lines are taken one after the other (m,)."""
        return np.array([camera.shutter is not None for camera in self.cameras])[self.camera_of]

    @property
    def parallel(self) -> Mask:
        """Images with parallel rays (m,)."""
        return np.array([camera.parallel for camera in self.cameras])[self.camera_of]

    @property
    def motions(self) -> Array:
        """Velocities and rotation rates (m, 6), as given."""
        return np.zeros((len(self.images), 6)) if self.motion is None else self.motion

    @cached_property
    def motion_free(self) -> Mask:
        """Components of the motion that are estimated (m, 6).

        With parallel rays these are vx, vy, wz at most: nothing depends on vz, and a rotation about the other
        axes is one about a point at a distance that is not determined.
        """
        none = np.zeros(6, dtype=bool)
        free = np.array([none if c.shutter is None else c.shutter.is_free for c in self.cameras])[
            self.camera_of
        ]
        free[self.parallel, 2:5] = False
        return free

    @cached_property
    def motion_sigma(self) -> Array:
        """Standard deviations of observed components (m, 6), 0 for the others."""
        none = np.zeros(6)
        sigma = np.array([none if c.shutter is None else c.shutter.sigmas for c in self.cameras])[
            self.camera_of
        ]
        return np.where(self.motion_free, sigma, 0.0)

    def _check_rig_windows(self, refraction: Refraction) -> None:
        where, through = "Network.refraction", refraction.path_of >= 0
        images = np.flatnonzero(through & refraction.on_rig[refraction.path_of])
        if self.rig is None or (self.rig.exposure[images] < 0).any():
            raise UsageError(
                "a window is on a rig, but an image that is seen through it has no `exposure`", where=where
            )
        cameras = np.unique(self.camera_of[images])
        if len(np.unique(self.rig.references(np.ones(len(self.images), dtype=bool))[cameras])) > 1:
            raise UsageError(
                "a window is on a rig, but no exposures connect the cameras that are seen through it",
                where=where,
            )

    def _check_refraction(self, refraction: Refraction) -> None:
        if len(refraction.path_of) != len(self.images):
            raise UsageError("requires a path, or −1, for each image", where="Network.refraction")
        if refraction.on_rig.any():
            self._check_rig_windows(refraction)
        moved = self.stage is not None and self.stage.carries == "object"
        if moved and any(window.on == "object" for window in refraction.windows):
            raise UsageError(
                "a window on the object cannot be combined with a stage that moves the object",
                where="Network.refraction",
            )

    @classmethod
    def from_document(cls, document: Network1, calibrated: Mapping[str, Camera] | None = None) -> Self:
        """Create the network of a ``reseau-network/1`` document.

        Parameters
        ----------
        document : Network1
            The document.
        calibrated : mapping of str to Camera, optional
            Cameras by id that replace those of the document; required for entries that name a calibration,
            see :func:`~reseau.bundle.calibrated_camera` and :func:`~reseau.bundle.film_camera`.

        Raises
        ------
        UsageError
            When a camera that names a calibration is missing, or a given camera is not in the document.
        """
        given = calibrated or {}
        for name in given:
            if name not in [entry.id for entry in document.cameras]:
                raise UsageError("is not a camera of the network", where=name)
        cameras = tuple(_camera(entry, given) for entry in document.cameras)
        images, points, seen = document.images, document.points, document.observations
        camera_row = {camera.id: i for i, camera in enumerate(cameras)}
        point_row = {name: i for i, name in enumerate(points.id)}
        image_row = {name: i for i, name in enumerate(images.id)}
        bars = document.distances
        ends = [] if bars is None else [bars.from_, bars.to]
        datum = np.ones(len(points.id), dtype=bool)
        if document.datum_points is not None:
            datum = np.isin(points.id, document.datum_points)
        return cls(
            cameras=cameras,
            images=images.id,
            camera_of=_rows(images.camera, camera_row),
            x0=_triples(images.X0),
            rotation=_triples(images.rotation),
            points=points.id,
            xyz=_triples(points.xyz),
            sigma=_triples(points.sigma),
            role=points.role,
            image_of=_rows(seen.image, image_row),
            point_of=_rows(seen.point, point_row),
            xy=np.array([seen.x, seen.y], dtype=np.float64).T.reshape(-1, 2),
            cov=covariances_of(seen.sx, seen.sy, seen.rho or 0.0),
            distance_of=np.array([_rows(end, point_row) for end in ends], dtype=np.intp).T.reshape(-1, 2),
            distance=np.array([] if bars is None else [bars.length, bars.sigma], dtype=np.float64)
            .T.reshape(-1, 2),
            datum=document.datum,
            datum_points=datum,
            groups=images.group or (None,) * len(images.id),
            files=images.file or (None,) * len(images.id),
            unit=document.unit,
            datum_chosen=document.datum_points is not None,
            rig=_rig(document, camera_row),
            refraction=None if document.refraction is None
            else document.refraction.refraction(images.id, images.camera),
            stage=None if document.turntable is None
            else stage_of_turntable(document.turntable, images.id, images.exposure),
            motion=None if images.motion is None
            else np.array([6 * [0.0] if row is None else row for row in images.motion], dtype=np.float64),
        )  # fmt: skip

    def _facts(self) -> list[tuple[str, str]]:
        counts = (
            (len(self.cameras), "camera"), (len(self.images), "image"), (len(self.points), "point"),
            (len(self.xy), "image point"),
        )  # fmt: skip
        facts = [*((f"{n} {what}{'s' * (n != 1)}", "") for n, what in counts), ("datum", self.datum)]
        if self.refraction is not None:
            windows = len(self.refraction.windows)
            facts.append((f"{windows} window{'s' * (windows != 1)}", ""))
        return facts

    @cached_property
    def rays(self) -> Rows:
        """Number of images of each point (p,)."""
        return np.bincount(self.point_of, minlength=len(self.points)).astype(np.intp)

    @cached_property
    def rays_of_images(self) -> list[Rows]:
        """Image observations of each image."""
        return rows_of_groups(self.image_of, len(self.images))

    @cached_property
    def rays_of_cameras(self) -> list[Rows]:
        """Image observations of each camera."""
        return rows_of_groups(self.camera_of[self.image_of], len(self.cameras))

    @cached_property
    def rays_of_points(self) -> list[Rows]:
        """Image observations of each point."""
        return rows_of_groups(self.point_of, len(self.points))

    @cached_property
    def seen(self) -> Rows:
        """Number of points of each image (m,)."""
        return np.bincount(self.image_of, minlength=len(self.images)).astype(np.intp)

    @property
    def held(self) -> Mask:
        """Coordinates that are held (p, 3)."""
        return np.asarray(self.sigma == 0)

    @property
    def observed(self) -> Mask:
        """Coordinates that are observations (p, 3)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.sigma > 0)

    @property
    def posed(self) -> Mask:
        """Images whose pose is known (m,)."""
        return finite(self.x0) & finite(self.rotation)

    def with_cameras(self, cameras: Mapping[str, Camera]) -> Self:
        """Return the network with some cameras replaced, by id.

        Raises
        ------
        UsageError
            When the network has no such camera.
        """
        known = [camera.id for camera in self.cameras]
        for name in cameras:
            if name not in known:
                raise UsageError("is not a camera of the network", where=name)
        return replace(self, cameras=tuple(cameras.get(camera.id, camera) for camera in self.cameras))

    def behind_windows(self, c: int) -> bool:
        """Whether any image of the c-th camera looks through windows."""
        refraction = self.refraction
        return refraction is not None and bool((refraction.path_of[self.camera_of == c] >= 0).any())

    def select(self, observations: Mask) -> Self:
        """Return the network with a selection of the image observations (n,)."""
        return replace(
            self,
            image_of=self.image_of[observations],
            point_of=self.point_of[observations],
            xy=self.xy[observations],
            cov=self.cov[observations],
        )


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Points with known coordinates.

    Parameters
    ----------
    names : tuple of str (k,)
        Names.
    xyz : ndarray (k, 3)
        Coordinates.
    sigma : ndarray (k, 3)
        0 holds a coordinate, NaN leaves it free, otherwise it is an observation.

    Examples
    --------
    >>> xyz = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
    >>> control = ControlPoints(("A", "B"), xyz, np.array([[0.0, 0.0, 0.0], [0.1, 0.1, np.nan]]))
    >>> (control.sigma == 0).sum(axis=1), np.isnan(control.sigma).sum(axis=1)
    (array([3, 0]), array([0, 1]))
    """

    names: tuple[str, ...]
    xyz: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Usable:
    """Observations, images and points that are used in an adjustment.

    Parameters
    ----------
    observations : ndarray of bool (n,)
        Image coordinates.
    images : ndarray of bool (m,)
        Images with at least three points and an approximate pose.
    points : ndarray of bool (p,)
        Points with enough rays for their unknown coordinates and with approximate coordinates.
    """

    observations: Mask
    images: Mask
    points: Mask


def usable(network: Network, counted: Mask, x0: Array, xyz: Array) -> Usable:
    """Select what can be adjusted.

    Parameters
    ----------
    network : Network
        The network.
    counted : ndarray of bool (n,)
        Image points with positive weights.
    x0 : ndarray (m, 3)
        Approximate projection centres, NaN where a pose is not known.
    xyz : ndarray (p, 3)
        Approximate coordinates, NaN where a point is not known.

    Notes
    -----
    Two rays are needed for three unknown coordinates, one ray for at most two. Points and images with too few
    rays are removed together with their rays, repeatedly until all that remain have enough.
    """
    images, points = finite(x0), finite(xyz)
    unknown = (~network.held & ~network.observed).sum(axis=1)
    needed = np.where(unknown == 0, 1, np.where(unknown <= 2, 1, 2))
    rows = counted.copy()
    while True:
        rows = rows & images[network.image_of] & points[network.point_of]
        rays = np.bincount(network.point_of[rows], minlength=len(points))
        seen = np.bincount(network.image_of[rows], minlength=len(images))
        fewer_points, fewer_images = points & (rays >= needed), images & (seen >= LEAST_POINTS)
        if (fewer_points == points).all() and (fewer_images == images).all():
            return Usable(rows, images, points)
        points, images = fewer_points, fewer_images


def finite(rows: Array) -> Mask:
    """Return which rows (k,) of an array (k, …) contain only finite numbers."""
    return np.asarray(np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))), dtype=np.bool_)


def _camera(entry: CameraEntry | CalibratedCameraEntry, calibrated: Mapping[str, Camera]) -> Camera:
    if entry.id in calibrated:
        return calibrated[entry.id]
    if isinstance(entry, CalibratedCameraEntry | FilmCameraEntry):
        raise UsageError(
            f"needs its calibration {entry.calibration}",
            where=f"camera {entry.id}",
            do="read the file with reseau.exchange.read_network",
        )
    return Camera.from_entry(entry)


def _rig(document: Network1, camera_row: dict[str, int]) -> Rig | None:
    """Rig of images with exposures, by name."""
    exposures, bases = document.images.exposure, document.bases
    if exposures is None or not any(exposures):
        return None
    names = {name: k for k, name in enumerate(dict.fromkeys(name for name in exposures if name))}
    ends = [] if bases is None else [bases.from_, bases.to]
    known = [] if bases is None else [bases.length, bases.sigma]
    return Rig(
        _rows(document.images.camera, camera_row),
        np.array([names[name] if name else -1 for name in exposures], dtype=np.intp),
        np.array([_rows(end, camera_row) for end in ends], dtype=np.intp).T.reshape(-1, 2),
        np.array(known, dtype=np.float64).T.reshape(-1, 2),
    )


def _rows(names: Sequence[str], rows: dict[str, int]) -> Rows:
    return np.array([rows[name] for name in names], dtype=np.intp)


def _triples(values: Sequence[Sequence[float | None] | None]) -> Array:
    """Triples (n, 3) with NaN for null."""
    nothing = (np.nan, np.nan, np.nan)
    return np.array([nothing if v is None else v for v in values], dtype=np.float64).reshape(-1, 3)
