"""The network: cameras, images, points and what was observed of them, in columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from ...io.network import CAMERA_PARAMETERS, CameraEntry, Network1
from ...optics import PlaneMapping
from .stage import Stage

__all__ = ["Additional", "Camera", "ControlPoints", "Network", "Usable", "finite", "usable"]

Datum = Literal["control", "minimal", "free"]

# An image has six unknowns: three points.
_LEAST_POINTS = 3


@dataclass(frozen=True, eq=False)
class Additional:
    """Ebner's twelve orthogonal parameters of a camera, in one set or in several.

    Parameters
    ----------
    base_mm : float
        Base b of the grid over which they are orthogonal.
    free : bool
        Whether they are estimated; otherwise they are zero.
    per : {"camera", "group", "image"}
        What has a set of its own.
    dropped : frozenset of str
        Those that stay zero, as a result names them: ``b3``, or ``b3 of group G`` of a set per group.
    """

    base_mm: float
    free: bool = True
    per: Literal["camera", "group", "image"] = "camera"
    dropped: frozenset[str] = frozenset()

    def name(self, k: int, label: str) -> str:
        """What the k-th parameter of a set is called, k from 0, of what the label says."""
        return f"b{k + 1}" if self.per == "camera" else f"b{k + 1} of {label}"


@dataclass(frozen=True, eq=False)
class Camera:
    """One interior orientation, of one image or of many.

    Parameters
    ----------
    id : str
        Name.
    width, height : int
        Pixels of the image.
    pitch_mm : (float, float)
        Size of a pixel; without meaning for `opencv`.
    model : {"brown", "opencv", "mapping"}
        See :class:`reseau.optics.Brown` and :class:`reseau.optics.OpenCV`; or any other mapping.
    side : {"image", "object"}
        Whose coordinates Brown's distortion is a function of.
    balance_radius_mm : float
        R0 of Brown's radial distortion.
    values : ndarray (10,) or (12,)
        All parameters of the model, in its order; those of the mapping where there is one.
    free : tuple of str
        Those to be estimated.
    sigma : mapping of str to float
        Standard deviations of those whose values are observations.
    additional : Additional, optional
        Further parameters.
    mapping : PlaneMapping, optional
        From ideal directions to pixels, for a camera that is neither of the models.
    covariance : ndarray (u, u), optional
        Joint covariance of all parameters, where the values are those of an earlier calibration: free
        parameters with a variance above zero are observed. In place of `sigma`.
    """

    id: str
    width: int
    height: int
    pitch_mm: tuple[float, float]
    model: Literal["brown", "opencv", "mapping"]
    values: Array
    free: tuple[str, ...] = ()
    side: Literal["image", "object"] = "object"
    balance_radius_mm: float = 0.0
    sigma: dict[str, float] = field(default_factory=dict)
    additional: Additional | None = None
    mapping: PlaneMapping | None = None
    covariance: Array | None = None

    def __post_init__(self) -> None:
        if (self.model == "mapping") != (self.mapping is not None):
            raise UsageError("of the model `mapping` needs one, others none", where=f"camera {self.id}")
        if len(self.values) != len(self.names):
            raise UsageError(
                f"has {len(self.values)} values, not {len(self.names)}", where=f"camera {self.id}"
            )
        if self.covariance is not None:
            if self.covariance.shape != (len(self.names), len(self.names)):
                raise UsageError("needs a covariance of all parameters", where=f"camera {self.id}")
            if self.sigma:
                raise UsageError("has both `sigma` and `covariance`", where=f"camera {self.id}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return CAMERA_PARAMETERS[self.model] if self.mapping is None else tuple(self.mapping.names)

    @property
    def label(self) -> str:
        """What it is called in a sentence."""
        return self.id if self.id == "camera" else f"camera {self.id}"

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @classmethod
    def from_entry(cls, entry: CameraEntry) -> Self:
        """A camera as it stands in a ``reseau-network/1`` document; what is not named there is zero."""
        values = np.array([entry.parameters.get(name, 0.0) for name in CAMERA_PARAMETERS[entry.model]])
        extra = entry.additional
        return cls(
            id=entry.id,
            width=entry.width,
            height=entry.height,
            pitch_mm=entry.pitch_mm or (1.0, 1.0),
            model=entry.model,
            values=values,
            free=tuple(name for name in CAMERA_PARAMETERS[entry.model] if name in entry.free),
            side=entry.side or "object",
            balance_radius_mm=entry.balance_radius_mm,
            sigma=dict(entry.sigma or {}),
            additional=None if extra is None else Additional(extra.base_mm, extra.free, extra.per),
        )


@dataclass(frozen=True, eq=False)
class Network:
    """What goes into a bundle adjustment.

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
        What each point is for; check points are estimated and compared.
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
        Where position, orientation and scale come from.
    datum_points : ndarray of bool (p,)
        For inner constraints.
    groups : tuple of (str or None) (m,)
        Group of each image, for parameters per group.
    files : tuple of (str or None) (m,)
        File of each image.
    unit : str
        Of object space; a label.
    stage : Stage, optional
        That moved the field between images which share their exterior orientation; needs control.
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
    stage: Stage | None = None

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
        if self.stage is not None and (self.datum != "control" or len(self.stage.pose) != m):
            raise UsageError("needs control, and a pose for each image", where="Network.stage")

    @classmethod
    def from_document(cls, document: Network1) -> Self:
        """The network of a ``reseau-network/1`` document."""
        cameras = tuple(Camera.from_entry(entry) for entry in document.cameras)
        images, points, seen = document.images, document.points, document.observations
        camera_row = {camera.id: i for i, camera in enumerate(cameras)}
        point_row = {name: i for i, name in enumerate(points.id)}
        image_row = {name: i for i, name in enumerate(images.id)}
        sx, sy = np.array(seen.sx, dtype=np.float64), np.array(seen.sy, dtype=np.float64)
        cov = np.zeros((len(sx), 2, 2))
        cov[:, 0, 0], cov[:, 1, 1] = sx**2, sy**2
        if seen.rho is not None:
            cov[:, 0, 1] = cov[:, 1, 0] = np.array(seen.rho) * sx * sy
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
            cov=cov,
            distance_of=np.array([_rows(end, point_row) for end in ends], dtype=np.intp).T.reshape(-1, 2),
            distance=np.array([] if bars is None else [bars.length, bars.sigma], dtype=np.float64)
            .T.reshape(-1, 2),
            datum=document.datum,
            datum_points=datum,
            groups=images.group or (None,) * len(images.id),
            files=images.file or (None,) * len(images.id),
            unit=document.unit,
        )  # fmt: skip

    @cached_property
    def rays(self) -> Rows:
        """Number of images of each point (p,)."""
        return np.bincount(self.point_of, minlength=len(self.points)).astype(np.intp)

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

    def select(self, observations: Mask) -> Self:
        """The same network with some of the image observations (n,)."""
        return replace(
            self,
            image_of=self.image_of[observations],
            point_of=self.point_of[observations],
            xy=self.xy[observations],
            cov=self.cov[observations],
        )

    def with_cameras_per(self, what: Literal["image", "group"]) -> Self:
        """The same network with an interior orientation for each image, or for each group of images."""
        labels = [
            (int(c), name if what == "image" else str(group))
            for c, name, group in zip(self.camera_of, self.images, self.groups, strict=True)
        ]
        sets = list(dict.fromkeys(labels))
        cameras = tuple(replace(self.cameras[c], id=f"{self.cameras[c].id}/{label}") for c, label in sets)
        return replace(self, cameras=cameras, camera_of=np.array([sets.index(label) for label in labels]))


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Points whose coordinates are known.

    Parameters
    ----------
    names : tuple of str (k,)
        Names.
    xyz : ndarray (k, 3)
        Coordinates.
    sigma : ndarray (k, 3)
        0 holds a coordinate, NaN leaves it free, otherwise it is an observation.
    """

    names: tuple[str, ...]
    xyz: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Usable:
    """What takes part in an adjustment.

    Parameters
    ----------
    observations : ndarray of bool (n,)
        Image coordinates.
    images : ndarray of bool (m,)
        Images with three points at least, whose pose is known approximately.
    points : ndarray of bool (p,)
        Points with rays enough for their unknown coordinates, known approximately.
    """

    observations: Mask
    images: Mask
    points: Mask


def usable(network: Network, counted: Mask, x0: Array, xyz: Array) -> Usable:
    """What of a network can be adjusted.

    Parameters
    ----------
    network : Network
        The network.
    counted : ndarray of bool (n,)
        Image coordinates that have a weight.
    x0 : ndarray (m, 3)
        Approximate projection centres, NaN where a pose is not known.
    xyz : ndarray (p, 3)
        Approximate coordinates, NaN where a point is not known.

    Notes
    -----
    A ray gives two equations, but two rays are needed for three unknown coordinates. Whatever has too few is
    left out with its rays, and so on until all that remains has enough.
    """
    images, points = finite(x0), finite(xyz)
    unknown = (~network.held & ~network.observed).sum(axis=1)
    needed = np.where(unknown == 0, 1, np.where(unknown <= 2, 1, 2))
    rows = counted.copy()
    while True:
        rows = rows & images[network.image_of] & points[network.point_of]
        rays = np.bincount(network.point_of[rows], minlength=len(points))
        seen = np.bincount(network.image_of[rows], minlength=len(images))
        fewer_points, fewer_images = points & (rays >= needed), images & (seen >= _LEAST_POINTS)
        if (fewer_points == points).all() and (fewer_images == images).all():
            return Usable(rows, images, points)
        points, images = fewer_points, fewer_images


def finite(rows: Array) -> Mask:
    """Rows (k,) of an array (k, …) that hold finite numbers alone."""
    return np.asarray(np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))), dtype=np.bool_)


def _rows(names: Sequence[str], rows: dict[str, int]) -> Rows:
    return np.array([rows[name] for name in names], dtype=np.intp)


def _triples(values: Sequence[Sequence[float | None] | None]) -> Array:
    """Triples (n, 3) with NaN for null."""
    nothing = (np.nan, np.nan, np.nan)
    return np.array([nothing if v is None else v for v in values], dtype=np.float64).reshape(-1, 3)
